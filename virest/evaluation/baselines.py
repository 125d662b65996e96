"""Other people's deblurring at its best: true centre kernel, no circular border, the best of some settings.

One kernel serves the whole picture, as in the paper's Table 1 and in scikit-image; the picture goes on blended around
its edges, and the result is straightened by the same warp as ours.  scikit-image is loaded only when it is asked for.
Kernels here are *convolutions*; ours are correlations, so they are turned round.
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

from virest.camera.response import ResponseCurve
from virest.evaluation.dong2020 import Weights, filtered, poisson_tv_l0
from virest.image_formation.kernels import KernelField, blur_chords, kernel_field
from virest.image_formation.row_motion import RowMotion
from virest.restoration.encoding import encode_picture
from virest.restoration.shutter import rowwise_map, warp

Picture = NDArray[np.uint8]
Plane = NDArray[np.float32]
Deconvolve = Callable[[Plane, Plane, Any], Plane]
ANCHOR = 0.5
BORDER_RADII = 2
"""The blended border is this many kernel radii wide on each side."""
STRAIGHT_SAMPLES_PER_PX = 8


@dataclass(frozen=True, slots=True)
class Baseline:
    """A method that is compared with."""

    deconvolve: Deconvolve
    """(plane, convolution kernel, setting) to plane."""
    settings: tuple[Any, ...]
    """All are tried on every frame; the best by squared error against truth counts."""
    title: str
    straight: bool = False
    """Takes the straight line of the paper's angle and length for the kernel, in place of the true path."""
    grey: bool = False
    """Works on grey levels, as if they were light."""
    library: str = ""
    """What has to be installed."""

    @property
    def available(self) -> bool:
        """Whether its library is there."""
        return not self.library or find_spec(self.library) is not None


def _inverse(plane: Plane, psf: Plane, least: float) -> Plane:
    """1 / K, where K is larger than ``least``; below that its phase only."""
    return filtered(plane, psf, lambda k: np.conj(k) / np.maximum(np.abs(k), np.float32(least)) ** 2)


def _wiener(plane: Plane, psf: Plane, noise_to_signal: float) -> Plane:
    """Conj(K) / (|K|² + N/S), the same N/S at all frequencies."""
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
        tuple(Weights(tv=tv) for tv in (30.0, 90.0, 270.0)),
        "Poisson data, TV and L0 gradients (Dong et al. 2020, Wang's in the paper)",
    ),
}
BASELINES = PAPERS | {f"skimage {name}": baseline for name, baseline in SCIKIT.items()}


def baseline_pictures(
    baseline: Baseline, picture: Picture, motion: RowMotion, curve: ResponseCurve
) -> Iterator[Picture]:
    """Restored and straightened pictures, one for each of the baseline's settings."""
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
    """One picture, channel by channel, in linear light; without a curve in grey levels."""
    curve = curve or ResponseCurve("linear")
    table = curve.linear_table()
    light = [deconvolved_inside(deconvolve, table[picture[..., k]], psf) for k in range(3)]
    return encode_picture([plane.astype(np.float32, copy=False) for plane in light], curve)


def centre_psf(motion: RowMotion) -> Plane:
    """Give the true kernel at the picture's centre, zero at mid-exposure, as a convolution takes it."""
    kernel = kernel_field(motion, _centre(motion), ANCHOR).arrays(positive=True)[0]
    return kernel[::-1, ::-1] / kernel.sum()


def straight_psf(motion: RowMotion) -> Plane:
    """The straight line of the paper's angle and length (eqs 15, 16) at the picture's centre, zero at its middle."""
    chord = blur_chords(motion, _centre(motion))[0]
    count = max(int(np.ceil(STRAIGHT_SAMPLES_PER_PX * np.linalg.norm(chord))), 1)
    part = (np.arange(count) + 0.5) / count - 0.5
    kernel = KernelField(_centre(motion), (part[:, None] * chord)[None], ANCHOR).arrays(positive=True)[0]
    return kernel[::-1, ::-1] / kernel.sum()


def _centre(motion: RowMotion) -> NDArray[np.float64]:
    return np.array([[(motion.profile.width - 1) / 2, (motion.profile.height - 1) / 2]])


def deconvolved_inside(deconvolve: Callable[[Plane], Plane], plane: Plane, psf: Plane) -> Plane:
    """Deconvolve a picture with a border that goes on smoothly around the corner, and cut the border off."""
    border = BORDER_RADII * (psf.shape[0] // 2)
    result = deconvolve(blended(plane, border))
    return result[border : border + plane.shape[0], border : border + plane.shape[1]]


def blended(plane: Plane, border: int) -> Plane:
    """Widen on all sides by at least ``border``: mirror pictures of both edges, blended into each other by a cosine."""
    for axis in (0, 1):
        plane = _blended_rows(plane.swapaxes(0, axis), border).swapaxes(0, axis)
    return np.ascontiguousarray(plane)


def _blended_rows(plane: Plane, border: int) -> Plane:
    """After the last row comes its mirror picture, which fades into the one that leads to the first row."""
    between = next_fast_len(len(plane) + 2 * border, real=True) - len(plane)
    part = (0.5 - 0.5 * np.cos(np.pi * (np.arange(between) + 0.5) / between)).astype(plane.dtype)
    after, before = plane[::-1][:between], plane[:between][::-1]
    bridge = (1 - part)[:, None] * after + part[:, None] * before
    return np.roll(np.concatenate([plane, bridge]), border, axis=0)
