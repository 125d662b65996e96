"""Published deblurring methods at their best: true centre kernel, blended borders, best of several settings.

One kernel is used for the whole image, as in the paper's Table 1 and in scikit-image.  The image is extended by a
border that blends opposite edges, and the result is straightened by the same warp as ours.  scikit-image is imported
only when used.  Kernels here are for *convolution*; ours are for correlation, so they are flipped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len

from virest.arrays import Array, Picture
from virest.camera.response import ResponseCurve
from virest.evaluation.dong2020 import filtered, poisson_tv_l0
from virest.image_formation.kernels import KernelField, blur_chords, kernel_field
from virest.image_formation.row_motion import RowMotion
from virest.restoration.encoding import encode_picture
from virest.restoration.shutter import rowwise_map, warp

Plane = NDArray[np.float32]
Deconvolve = Callable[[Plane, Plane, Any], Plane]
ANCHOR = 0.5
BORDER_RADII = 2
"""Minimum width of the blended border on each side, in kernel radii."""
STRAIGHT_SAMPLES_PER_PX = 8
"""The kernel's ends are then placed to 1/16 px."""


@dataclass(frozen=True, slots=True)
class Baseline:
    """A method to compare with."""

    deconvolve: Deconvolve
    """(plane, convolution kernel, setting) → plane."""
    settings: tuple[Any, ...]
    """Settings tried on every frame; the one with the least squared error against truth counts."""
    title: str
    straight: bool = False
    """Uses a straight kernel of the paper's angle and length instead of the true blur path."""
    grey: bool = False
    """Works on grey levels instead of linear light."""
    library: str = ""
    """Required package; empty: none."""

    @property
    def available(self) -> bool:
        """Whether the required package is installed."""
        return not self.library or find_spec(self.library) is not None


def _inverse(plane: Plane, psf: Plane, least: float) -> Plane:
    """Inverse filter 1 / K, with |K| clamped from below in the denominator: conj(K) / max(|K|, least)²."""
    return filtered(plane, psf, lambda k: np.conj(k) / np.maximum(np.abs(k), np.float32(least)) ** 2)


def _wiener(plane: Plane, psf: Plane, noise_to_signal: float) -> Plane:
    """Wiener filter conj(K) / (|K|² + N/S) with the same N/S at all frequencies."""
    return filtered(plane, psf, lambda k: np.conj(k) / (np.abs(k) ** 2 + np.float32(noise_to_signal)))


def _scikit_wiener(plane: Plane, psf: Plane, balance: float) -> Plane:
    from skimage import restoration

    return np.asarray(restoration.wiener(plane, psf, balance, clip=False))


def _scikit_unsupervised(plane: Plane, psf: Plane, _unused: float) -> Plane:
    from skimage import restoration

    return np.asarray(restoration.unsupervised_wiener(plane, psf, clip=False, rng=0)[0])


def _scikit_richardson_lucy(plane: Plane, psf: Plane, iterations: float) -> Plane:
    from skimage import restoration

    light = np.maximum(plane, np.float32(1e-6))
    return np.asarray(restoration.richardson_lucy(light, psf, num_iter=int(iterations), clip=False))


NOISE_TO_SIGNAL = (0.003, 0.01, 0.03, 0.1, 0.3)
"""About half a decade apart; the best for each frame is used."""
SCIKIT: dict[str, Baseline] = {
    "wiener": Baseline(
        _scikit_wiener, (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0), "scikit-image wiener", library="skimage"
    ),
    "unsupervised_wiener": Baseline(
        _scikit_unsupervised, (0.0,), "scikit-image unsupervised_wiener", library="skimage"
    ),
    "richardson_lucy": Baseline(
        _scikit_richardson_lucy, (3, 8, 20), "scikit-image richardson_lucy", library="skimage"
    ),
}  # fmt: skip
PAPERS: dict[str, Baseline] = {
    "inverse": Baseline(_inverse, (0.1, 0.2, 0.4, 0.6), "inverse filter"),
    "wiener-flat": Baseline(_wiener, NOISE_TO_SIGNAL, "Wiener filter, white noise and signal"),
    "luan2022": Baseline(
        _wiener, NOISE_TO_SIGNAL, "one straight kernel from the gyroscope, grey levels (after Luan)", True, True
    ),
    "dong2020": Baseline(
        poisson_tv_l0,
        (30.0, 90.0, 270.0),
        "Poisson data, TV and L0 gradients (Dong et al. 2020, Wang's in the paper)",
    ),
}
BASELINES = PAPERS | {f"skimage {name}": baseline for name, baseline in SCIKIT.items()}


def baseline_pictures(
    baseline: Baseline, picture: Picture, motion: RowMotion, curve: ResponseCurve
) -> Iterator[Picture]:
    """Restored and straightened frames, one per setting of the baseline."""
    source = rowwise_map(motion, ANCHOR)
    psf = straight_psf(motion) if baseline.straight else centre_psf(motion)
    for setting in baseline.settings:
        deconvolve = partial(_with_setting, baseline.deconvolve, psf, setting)
        yield warp(deblurred(picture, deconvolve, psf, None if baseline.grey else curve), source)


def _with_setting(deconvolve: Deconvolve, psf: Plane, setting: Any, plane: Plane) -> Plane:
    return deconvolve(plane, psf, setting)


def deblurred(
    picture: Picture, deconvolve: Callable[[Plane], Plane], psf: Plane, curve: ResponseCurve | None
) -> Picture:
    """Deblur a frame channel by channel, in linear light, or in grey levels without a curve."""
    curve = curve or ResponseCurve("linear")
    table = curve.linear_table()
    light = [deconvolved_inside(deconvolve, table[picture[..., k]], psf) for k in range(3)]
    return encode_picture([plane.astype(np.float32, copy=False) for plane in light], curve)


def centre_psf(motion: RowMotion) -> Plane:
    """True blur kernel at the frame's centre, for convolution, its origin at mid-exposure."""
    kernel = kernel_field(motion, _centre(motion), ANCHOR).arrays(positive=True)[0]
    return kernel[::-1, ::-1] / kernel.sum()


def straight_psf(motion: RowMotion) -> Plane:
    """Straight kernel of the paper's angle and length (eqs 15, 16) at the frame's centre, its origin at the middle."""
    chord = blur_chords(motion, _centre(motion))[0]
    count = max(int(np.ceil(STRAIGHT_SAMPLES_PER_PX * np.linalg.norm(chord))), 1)
    part = (np.arange(count) + 0.5) / count - 0.5
    kernel = KernelField(_centre(motion), (part[:, None] * chord)[None], ANCHOR).arrays(positive=True)[0]
    return kernel[::-1, ::-1] / kernel.sum()


def _centre(motion: RowMotion) -> Array:
    return np.array([[(motion.profile.width - 1) / 2, (motion.profile.height - 1) / 2]])


def deconvolved_inside(deconvolve: Callable[[Plane], Plane], plane: Plane, psf: Plane) -> Plane:
    """Deconvolve an image extended by a smooth periodic border, then crop the border."""
    border = BORDER_RADII * (psf.shape[0] // 2)
    result = deconvolve(blended(plane, border))
    return result[border : border + plane.shape[0], border : border + plane.shape[1]]


def blended(plane: Plane, border: int) -> Plane:
    """Extend periodically by at least ``border`` on all sides: mirrored edges, cross-faded by a raised cosine."""
    for axis in (0, 1):
        plane = _blended_rows(plane.swapaxes(0, axis), border).swapaxes(0, axis)
    return np.ascontiguousarray(plane)


def _blended_rows(plane: Plane, border: int) -> Plane:
    """Append rows that cross-fade the mirrored end of the plane into its mirrored start, then centre the plane."""
    between = next_fast_len(len(plane) + 2 * border, real=True) - len(plane)
    weight = (0.5 - 0.5 * np.cos(np.pi * (np.arange(between) + 0.5) / between)).astype(plane.dtype)
    after, before = plane[::-1][:between], plane[:between][::-1]
    bridge = (1 - weight)[:, None] * after + weight[:, None] * before
    return np.roll(np.concatenate([plane, bridge]), border, axis=0)
