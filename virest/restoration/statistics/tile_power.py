"""Power spectra of a picture's tiles and of their kernels, and a picture's white noise."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.camera.response import ResponseCurve
from virest.inference.robust import NORMAL_MEDIAN
from virest.restoration.statistics.rings import SIDE

_WINDOW = np.outer(np.hanning(SIDE + 2)[1:-1], np.hanning(SIDE + 2)[1:-1]).astype(np.float32)
_WINDOW_SUM = float(_WINDOW.sum())
_WINDOW_POWER = np.float32((_WINDOW**2).sum())
MANY_TILES, FEW_TILES = 12, 8
"""Largest number of measured tiles; with FEW_TILES, weak noise is known to about a third only."""
_ON_PATH = 2e-3
"""Kernel values above this are on the path."""
_FILLING_PX = (5, 15, 45, 135)
"""Sides of the neighbourhoods from which unknown pixels are filled in, tried in this order."""


def cut(plane: NDArray[np.uint8], corner: tuple[int, int]) -> NDArray[np.uint8]:
    """The tile of a plane or picture at ``corner``, (top, left)."""
    return plane[corner[0] : corner[0] + SIDE, corner[1] : corner[1] + SIDE]


def light_in_grey_levels(light: NDArray[np.float32], curve: ResponseCurve) -> NDArray[np.float32]:
    """Light of a tile (height, width) scaled to grey levels by the curve's slope at its mean."""
    mean_level = 255 * float(curve.encode(np.array(light.mean())))
    return np.asarray(light * np.interp(mean_level, np.arange(256), curve.slope_table()), np.float32)


def known_part(
    clipped: NDArray[np.uint8], corner: tuple[int, int], kernel: NDArray[np.float32]
) -> NDArray[np.float32] | None:
    """1.0 where no blur path reaches a tile's pixel from clipped light, else 0.0; None: no light is clipped."""
    tile = cut(clipped, corner)
    if not tile.any():
        return None
    reach = (kernel + kernel[::-1, ::-1] > _ON_PATH).astype(np.uint8)
    return np.float32(1) - cv2.dilate(cv2.dilate(tile, reach), np.ones((3, 3), np.uint8))


def windowed_power(
    tile: NDArray[np.uint8] | NDArray[np.float32], known: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Power of a tile minus its mean under a Hann window; white noise of variance σ² gives σ² everywhere.

    Unknown pixels (0 in ``known``) are filled in smoothly and do not count in the normalisation.
    """
    values, power = tile.astype(np.float32), float(_WINDOW_POWER)
    if known is not None:
        values, power = _smoothly_filled(values, known), max(float(np.vdot(_WINDOW**2, known)), 1.0)
    mean = np.float32(np.vdot(values, _WINDOW) / _WINDOW_SUM)
    return _power((values - mean) * _WINDOW) / np.float32(power)


def _smoothly_filled(values: NDArray[np.float32], known: NDArray[np.float32]) -> NDArray[np.float32]:
    """Fill each unknown pixel with the mean of the known ones around it, over the smallest sufficient neighbourhood."""
    filled, left = values * known, known == 0
    for side in _FILLING_PX:
        near = cv2.blur(known, (side, side))
        here = left & (near > 0.1)
        filled[here] = (cv2.blur(values * known, (side, side))[here]) / near[here]
        left &= ~here
    if left.any():
        filled[left] = filled[~left].mean() if not left.all() else 0.0
    return filled


def variance_within(plane: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    """Variance of a plane within the square of ``side`` pixels around each pixel."""
    mean = cv2.blur(plane, (side, side))
    power = cv2.blur(cv2.multiply(plane, plane), (side, side))
    return np.asarray(cv2.subtract(power, cv2.multiply(mean, mean)), np.float32)


def passed_power(kernel: NDArray[np.float32]) -> NDArray[np.float32]:
    """|K|² of a kernel, smoothed as the tile's window smooths spectra."""
    padded = np.zeros((SIDE, SIDE), np.float32)
    padded[: kernel.shape[0], : kernel.shape[1]] = kernel
    return cv2.blur(_power(padded, kernel.shape[0]), (3, 3), borderType=cv2.BORDER_REPLICATE)


def _power(tile: NDArray[np.float32], rows: int = 0) -> NDArray[np.float32]:
    """|F|² at the horizontal frequencies 1 ... side / 2 − 1 of the transform, (side, side / 2 − 1).

    rows: number of leading rows that may differ from 0; 0: all.
    """
    packed = cv2.dft(tile, nonzeroRows=rows)[:, 1:-1]
    squares = packed * packed
    return squares[:, ::2] + squares[:, 1::2]


def white_noise(plane: NDArray[np.uint8]) -> float:
    """Standard deviation of a plane's white noise, grey levels, from the median absolute mixed second difference.

    Immerkær 1996, doi:10.1006/cviu.1996.0060; the median ignores edges and texture.
    """
    above, here, below = (plane[first : len(plane) - 4 + first : 4].astype(np.int16) for first in (1, 2, 3))
    down = above - 2 * here + below
    residual = down[:, 1:-3:4] - 2 * down[:, 2:-2:4] + down[:, 3:-1:4]
    return _median(np.abs(residual)) / NORMAL_MEDIAN / 6.0


def _median(levels: NDArray[np.int16]) -> float:
    """The median of non-negative integers from their histogram, which is faster than sorting."""
    reached = np.cumsum(np.bincount(levels.ravel()))
    middles = (reached[-1] + 1) // 2, reached[-1] // 2 + 1
    return float(np.mean(np.searchsorted(reached, middles)))
