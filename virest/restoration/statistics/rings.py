"""Rings of spatial frequency in the spectrum of a measured tile.

A spectrum has shape (side, side / 2 − 1): all vertical frequencies, and the horizontal ones 1 ... side / 2 − 1.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from virest.arrays import Index

RINGS, SIDE = 24, 128
"""Number of rings up to 0.5 cycles per pixel, and the side, px, of the measured tiles."""


@lru_cache(maxsize=8)
def ring_index(side: int) -> Index:
    """Ring of each place of a spectrum; RINGS beyond 0.5 cycles per pixel, at the lowest ones and near the axes."""
    fy, fx = np.fft.fftfreq(side)[:, None], np.arange(1, side // 2)[None, :] / side
    radius = np.hypot(fx, fy)
    ring = (radius / 0.5 * RINGS).astype(np.intp)
    return np.where(
        (radius < 0.5) & (radius > 2.5 / side) & (np.abs(fx) > 1.5 / side) & (np.abs(fy) > 1.5 / side), ring, RINGS
    )


@lru_cache(maxsize=1)
def place_ring() -> Index:
    """Ring of each place of a spectrum; the highest ring for those beyond 0.5 cycles per pixel."""
    fy, fx = np.fft.fftfreq(SIDE)[:, None], np.arange(1, SIDE // 2)[None, :] / SIDE
    return np.minimum((np.hypot(fx, fy) / 0.5 * RINGS).astype(np.intp), RINGS - 1)


@lru_cache(maxsize=1)
def axes() -> tuple[Index, Index]:
    """Rows and columns of the places near the axes, which :func:`ring_index` leaves out."""
    fy, fx = np.fft.fftfreq(SIDE)[:, None], np.arange(1, SIDE // 2)[None, :] / SIDE
    radius = np.hypot(fx, fy)
    rows, columns = np.nonzero((ring_index(SIDE) == RINGS) & (radius > 2.5 / SIDE) & (radius < 0.5))
    return rows, columns
