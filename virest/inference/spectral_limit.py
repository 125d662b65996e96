"""The widest Gaussian blur that a frame's spectrum allows.

A Gaussian of standard deviation σ multiplies the power at frequency f by exp(−4π² f² σ²).  The power of a sharp picture
does not rise with frequency (Field, JOSA A 4, 2379, 1987, finds f⁻²), and blur along a path only lowers it further, so
for any two frequencies f < g with power S above the noise

    σ² ≤ (ln S(f) − ln S(g)) / (4π² (g² − f²))

Soft content makes edges as wide as a defocus does, but leaves fine detail elsewhere in the frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Index, Picture
from virest.camera.response import ResponseCurve

SIDE_PX, MOST_DOWN, MOST_ACROSS = 64, 16, 24
"""Side of the tiles whose powers are averaged, and their most rows and columns."""
LOWEST_PER_PX, RING_PER_PX = 0.05, 0.025
"""Frequency of the first ring and width of all: a Hann window of 64 px resolves 0.03 cycles per pixel."""
APART = 3
"""Rings between the two that are compared at least: nearer ones share frequencies through the window."""
NOISE_SLOPE = 2.0
"""Coding noise falls with frequency as f⁻² at most."""
SHARPEST_FRAMES, LEAST_BITS = 0.25, 0.25
"""Part of the frames that may show more detail than a blur of all frames leaves, by noise and coding, and bits per
pixel from which detail is the picture's.  Limits of 24 captures with a defocus of 1.8 or 3 px (four scenes) were 1.0 to
1.4 times it and more at 0.25 to 0.5 bit per pixel, and 0.3 to 1.1 times at 0.15."""
SIGNAL_TO_NOISE = 2.0
"""Least signal over noise of a ring that is compared."""


ROUNDING_POWER = (0.375 * SIDE_PX) ** 2 / 12 / 255**2
"""Power of rounding to 8 bits in a tile under a Hann window."""


def widest_gaussian_px(luma: Picture, curve: ResponseCurve) -> float:
    """Upper limit of the standard deviation, px, of a Gaussian blur of the light of a frame; inf: no limit is seen.

    luma: (h, w) uint8.  The power at the highest frequencies is taken for noise.
    """
    power = _ring_powers(np.asarray(curve.linear_table()[luma], np.float32))
    frequency = LOWEST_PER_PX + RING_PER_PX * (np.arange(len(power)) + 0.5)
    noise = max(power[-2:].mean(), ROUNDING_POWER) * (frequency[-1] / frequency) ** NOISE_SLOPE
    shown = np.flatnonzero(power - noise > SIGNAL_TO_NOISE * noise)
    log_signal, squared = np.log(power[shown] - noise[shown]), frequency[shown] ** 2
    apart = shown[None, :] - shown[:, None] >= APART
    if not apart.any():
        return np.inf
    fall = log_signal[:, None] - log_signal[None, :]
    variance = fall[apart] / (4 * np.pi**2 * (squared[None, :] - squared[:, None])[apart])
    return float(np.sqrt(max(variance.min(), 0.0)))


def allow(widest_px: Sequence[float], bits_per_px: float, gaussian_px: float) -> bool:
    """Whether a Gaussian blur of all frames leaves as little detail as three of four frames show.

    widest_px: limits of frames.  At low bit rates the detail may be the coder's, and any blur is allowed.
    """
    if not widest_px or bits_per_px < LEAST_BITS:
        return True
    return gaussian_px <= float(np.quantile(widest_px, SHARPEST_FRAMES, method="lower"))


def _ring_powers(light: NDArray[np.float32]) -> Array:
    """Mean power in each ring, over tiles spread evenly over the frame; inf-free even for small frames."""
    height, width = light.shape
    side = min(SIDE_PX, height, width)
    down, across = (
        np.linspace(0, size - side, int(np.clip(2 * size // side - 1, 1, most))).astype(int)
        for size, most in ((height, MOST_DOWN), (width, MOST_ACROSS))
    )
    windows = np.lib.stride_tricks.sliding_window_view(light, (side, side))
    tiles = windows[down[:, None], across[None, :]].reshape(-1, side, side)
    ramp = np.hanning(side + 2)[1:-1].astype(np.float32)
    tapered = (tiles - tiles.mean(axis=(1, 2), keepdims=True)) * ramp[:, None] * ramp
    power = (np.abs(np.fft.rfft2(tapered)) ** 2).mean(axis=0).ravel()
    ring = _ring(side)
    count = ring.max() + 1
    return np.asarray(np.bincount(ring + 1, power, count + 1) / np.maximum(np.bincount(ring + 1), 1))[1:]


@lru_cache(maxsize=2)
def _ring(side: int) -> Index:
    """Ring of each frequency of the flat spectrum; −1 outside all."""
    radius = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)).ravel()
    ring = np.floor((radius - LOWEST_PER_PX) / RING_PER_PX).astype(np.intp)
    return np.where((ring < 0) | (radius >= 0.5), -1, ring)
