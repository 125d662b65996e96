"""Uncertainty of kernels: variance of their spectra from an uncertain end of the blur path.

If a blur path d(t) is known up to a constant speed, d(t) + a τ(t) with a of covariance C (pixels over the exposure) and
τ the fraction of the exposure since the anchor, then the kernel's spectrum K(f) has a mean and a variance.  The
expected data term ‖K x − g‖² is (|E K|² + Var K)|x|² − …: where the phase of K is unknown, E K is small relative to
Var K, and nothing is restored.  Var K is evaluated at the four points ±√2 σ along the axes of C, which reproduce its
mean and covariance (Julier & Uhlmann 1997, doi:10.1117/12.280797); a linearisation would grow without bound.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from virest.arrays import Array
from virest.image_formation.kernels import KernelField

GRID = 3
"""Grid points along each side at which the spread is evaluated; it varies over a picture as slowly as the motion."""


@dataclass(frozen=True, slots=True)
class KernelSpread:
    """Kernels at grid points, for displaced ends of the blur path."""

    fields: tuple[KernelField, ...]
    """One per displacement."""

    def scaled(self, scale: float) -> KernelSpread:
        """The same in a picture ``scale`` times as large."""
        return KernelSpread(tuple(field.scaled(scale) for field in self.fields))

    def variance(self, size: int, scale: float = 1.0) -> NDArray[np.float32]:
        """Var K over half a spectrum (size, size / 2 + 1), mean over the grid; for a picture ``scale`` times as large.

        |K|² of a kernel of radius r has an autocorrelation of radius 2 r, so 4 r + 1 frequencies per axis determine it:
        only these are computed, the others are interpolated exactly.
        """
        fields = [field.scaled(scale) for field in self.fields]
        radius = min(max(field.radius_px for field in fields), (size - 1) // 2)
        few = min(fft.next_fast_len(4 * radius + 1, real=True), size)
        spectra = np.stack([fft.rfft2(field.arrays(radius), (few, few)) for field in fields])
        variance = ((np.abs(spectra) ** 2).mean(axis=0) - np.abs(spectra.mean(axis=0)) ** 2).mean(axis=0)
        if few < size:
            shifts = np.roll(fft.irfft2(variance, (few, few)), (2 * radius, 2 * radius), (0, 1))
            over_shifts = np.zeros((size, size), np.float32)
            over_shifts[: 4 * radius + 1, : 4 * radius + 1] = shifts[: 4 * radius + 1, : 4 * radius + 1]
            variance = fft.rfft2(np.roll(over_shifts, (-2 * radius, -2 * radius), (0, 1))).real
        return np.asarray(np.maximum(variance, 0.0), np.float32)


def kernel_spread(
    field: Callable[[Array], KernelField], width: int, height: int, covariance_px2: Array
) -> KernelSpread | None:
    """The spread of a picture's kernels; None if the covariance (2, 2) of the path's end is zero."""
    variances, axes = np.linalg.eigh(covariance_px2)
    if variances.max() <= 0:
        return None
    x, y = ((np.arange(GRID) + 0.5) * length / GRID for length in (width, height))
    at = field(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
    samples = at.paths_px.shape[1]
    since = ((np.arange(samples) + 0.5) / samples - at.anchor)[:, None]
    ends = [
        sign * np.sqrt(2 * max(v, 0.0)) * axis for v, axis in zip(variances, axes.T, strict=True) for sign in (1, -1)
    ]
    return KernelSpread(tuple(replace(at, paths_px=at.paths_px + since * end) for end in ends))
