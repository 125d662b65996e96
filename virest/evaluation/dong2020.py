"""Non-blind deconvolution under Poisson noise with total-variation and L0 gradient regularisation.

After Dong, Tao, Xu & Chen 2020 (doi:10.1109/TIP.2020.3038518, the paper's "Wang"), with the kernel given:

    min over f ≥ 0 of  photons Σ (K f − g log K f)  +  tv Σ |∇f|  +  l0 #(∇f ≠ 0)

solved by ADMM: K f, ∇f for the total variation and ∇f for the L0 norm are split off, each with a closed-form step, and
f follows from one division in the frequency domain.  The image is treated as periodic, so its edges must be blended
first.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

Plane = NDArray[np.float32]
Spectrum = NDArray[Any]


PHOTONS = 2000.0
"""Photon count at light 1; the weight of the data term."""
ITERATIONS, DATA_PENALTY, GRADIENT_PENALTY = 25, 500.0, 200.0


def poisson_tv_l0(observed: Plane, psf: Plane, tv: float, l0: float = 1.0) -> Plane:
    """Deconvolve light (height, width) ≥ 0 that was convolved with ``psf``, whose origin is at its centre."""
    shape = observed.shape
    kernel = centred_spectrum(psf, shape)
    across, down = (centred_spectrum(np.array(d, np.float32), shape) for d in ([[1, -1, 0]], [[1], [-1], [0]]))
    data, steep = np.float32(DATA_PENALTY), np.float32(GRADIENT_PENALTY)
    system = data * np.abs(kernel) ** 2 + 2 * steep * (np.abs(across) ** 2 + np.abs(down) ** 2)
    sharp: Plane = observed.astype(np.float32)
    duals = [np.zeros(shape, np.float32) for _ in range(3)]
    for _ in range(ITERATIONS):
        spectrum = _spectrum(sharp)
        blurred, right, below = (_plane(spectrum * filter_, shape) for filter_ in (kernel, across, down))
        light = _poisson_step(blurred + duals[0], observed)
        smooth = _shrunk(right + duals[1], below + duals[2], tv / GRADIENT_PENALTY)
        sparse = _thresholded(right, below, l0 / GRADIENT_PENALTY)
        duals = [d + a - b for d, a, b in zip(duals, (blurred, right, below), (light, *smooth), strict=True)]
        targets = (light - duals[0], smooth[0] - duals[1] + sparse[0], smooth[1] - duals[2] + sparse[1])
        scales = (data, steep, steep)
        pulled = sum(
            s * np.conj(k) * _spectrum(t) for s, k, t in zip(scales, (kernel, across, down), targets, strict=True)
        )
        sharp = np.maximum(_plane(pulled / np.maximum(system, 1e-6), shape), np.float32(0))
    return sharp


def centred_spectrum(psf: Plane, shape: tuple[int, ...]) -> Spectrum:
    """Spectrum, on a plane of ``shape``, of a kernel centred on the origin."""
    placed = np.zeros(shape, np.float32)
    placed[: psf.shape[0], : psf.shape[1]] = psf
    return _spectrum(np.roll(placed, (-(psf.shape[0] // 2), -(psf.shape[1] // 2)), axis=(0, 1)))


def filtered(plane: Plane, psf: Plane, factor: Callable[[Spectrum], Spectrum]) -> Plane:
    """Filter a plane in the frequency domain by ``factor(K)``, K being the kernel's spectrum."""
    return _plane(_spectrum(plane) * factor(centred_spectrum(psf, plane.shape)), plane.shape)


def _poisson_step(near: Plane, observed: Plane) -> Plane:
    """Minimise photons (w − g log w) + penalty/2 (w − near)² over w: the positive root of a quadratic."""
    ratio = np.float32(PHOTONS / DATA_PENALTY)
    half = 0.5 * (near - ratio)
    return np.asarray(half + np.sqrt(half * half + ratio * observed), np.float32)


def _shrunk(right: Plane, below: Plane, threshold: float) -> tuple[Plane, Plane]:
    """Shrink gradients by the threshold (isotropic total variation)."""
    length = np.sqrt(right * right + below * below)
    factor = np.maximum(1 - np.float32(threshold) / np.maximum(length, np.float32(1e-8)), np.float32(0))
    return right * factor, below * factor


def _thresholded(right: Plane, below: Plane, part: float) -> tuple[Plane, Plane]:
    """Set gradients with a squared length of at most 2 × part to zero (L0 norm)."""
    kept = (right * right + below * below) > 2 * part
    return right * kept, below * kept


def _spectrum(plane: Plane) -> Spectrum:
    return np.asarray(fft.rfft2(plane), np.complex64)


def _plane(spectrum: Spectrum, shape: tuple[int, ...]) -> Plane:
    return np.asarray(fft.irfft2(spectrum, s=shape), np.float32)
