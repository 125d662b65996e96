"""Interpolate measured spectra onto the packed spectrum of a restored tile."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Index
from virest.restoration.statistics.records import PictureStatistics
from virest.restoration.statistics.rings import RINGS, SIDE


@lru_cache(maxsize=8)
def packed_frequency(size: int) -> NDArray[np.float32]:
    """Frequency, cycles per pixel, of each value of OpenCV's packed spectrum, (size, size)."""
    index = (np.arange(size) + 1) // 2
    along = np.minimum(np.arange(size), size - np.arange(size)) / size
    packed = np.hypot(along[:, None], index[None, :] / size)
    packed[:, 0] = index / size
    packed[:, -1] = np.hypot(index / size, 0.5)
    return packed.astype(np.float32)


def packed(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Real, even values over half a spectrum (size, size / 2 + 1), in OpenCV's packed layout (size, size)."""
    size = len(values)
    index = (np.arange(size) + 1) // 2
    found = values[:, index]
    found[:, 0], found[:, -1] = values[index, 0], values[index, size // 2]
    return found


def on_spectrum(
    statistics: PictureStatistics, ring_values: Array, size: int, scale: float = 1.0, by_place: bool = True
) -> NDArray[np.float32]:
    """The rings' noise-to-signal ratio interpolated to a tile's packed spectrum; falls as f² below the lowest ring.

    scale: pixels of the measured picture per pixel of the tile, 2 for a picture of half the size.  by_place: use the
    per-frequency S where it was measured.
    """
    below, part, falling = _between_rings(size, _widening(statistics, scale))
    levels = np.log(ring_values).astype(np.float32)
    values = np.exp(levels[below] + part * np.append(np.diff(levels), np.float32(0))[below]) * falling
    if statistics.places is not None and by_place:
        values = values / _resampled_places(statistics.places.share, size, _widening(statistics, scale))
    return np.asarray(values, np.float32)


def _widening(statistics: PictureStatistics, scale: float) -> float:
    """Pixels of the picture on which the rings were measured, perhaps at reduced size, per pixel of a tile."""
    return scale * float(statistics.frequency[0] + statistics.frequency[-1]) / 0.5


def _resampled_places(share: NDArray[np.float32], size: int, scale: float) -> NDArray[np.float32]:
    """Values per frequency interpolated to a packed spectrum (size, size); beyond them, the nearest."""
    rising = np.roll(share, SIDE // 2, axis=0)
    return cv2.remap(rising, *_spectrum_coordinates(size, scale), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


@lru_cache(maxsize=8)
def _spectrum_coordinates(size: int, scale: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Column and row of the measured spectrum, rows from the lowest frequency up, for each packed value."""
    packed = (np.arange(size) + 1) // 2 / size
    fx, fy = (a.copy() for a in np.broadcast_arrays(packed[None, :], np.fft.fftfreq(size)[:, None]))
    fx[:, -1] = 0.5
    fy[:, 0] = fy[:, -1] = packed
    return (fx / scale * SIDE - 1).astype(np.float32), (fy / scale * SIDE + SIDE // 2).astype(np.float32)


@lru_cache(maxsize=8)
def _between_rings(size: int, scale: float) -> tuple[Index, NDArray[np.float32], NDArray[np.float32]]:
    """For each packed value: ring below it, fraction of the way to the next, and factor f² below the lowest ring."""
    position = packed_frequency(size) / scale * (RINGS / 0.5) - 0.5
    held = np.clip(position, 0, RINGS - 1)
    below = np.floor(held).astype(np.intp)
    falling = np.minimum((position + 0.5) / 0.5, 1.0) ** 2
    return below, (held - below).astype(np.float32), falling.astype(np.float32)
