"""Statistics of a picture as restoring takes them: most blurred places; long paths, defocus, doubt about the curve."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.camera.response import ResponseCurve
from virest.image_formation.kernels import KernelField, blur_chords
from virest.image_formation.row_motion import RowMotion
from virest.restoration.blurred import clipped_anywhere
from virest.restoration.statistics.measure import measure_picture
from virest.restoration.statistics.records import PictureStatistics, falling_power
from virest.restoration.statistics.rings import SIDE

SAMPLE_TILE_PX = 128
"""Spacing of the tiles on which a picture's noise is measured."""
MIN_SAMPLES = 6
"""Least number of measured tiles, the most blurred ones."""
LARGEST_RADIUS = SIDE // 4
"""Kernels of a larger radius leave too little of a measured tile that is not bent by its window."""
CURVE_SLOPE_STD = 0.1
"""One standard deviation of the real tone curve's slope over the profile's, from one brightness to another.

No phone keeps to a curve that nobody measured on it.  A slope that differs by ε makes an error of ε times the picture's
own detail wherever brightness changes, blurred or not: ε² S beside the noise.  On 14 simulated captures 0.093 ± 0.011
gains most (``python -m virest.app.bench --only fits``); no measured curves stand behind it."""
_LEAST_FALL = 2.0
"""The power of pictures falls with frequency at least so steeply: f⁻² is that of edges alone, without texture."""


def most_blurred(motion: RowMotion, centres_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Centres (m, 2) of the tiles to measure on: the most blurred, and all that are blurred half as much.

    A path of a pixel cancels nothing, and tells no noise from signal; a coder's noise is where the motion is.
    """
    length_px = np.linalg.norm(blur_chords(motion, centres_px), axis=-1)
    ranked = np.sort(length_px)[::-1]
    least_px = min(ranked[0] / 2, ranked[min(MIN_SAMPLES, len(ranked)) - 1])
    return np.asarray(centres_px[length_px >= least_px])


def picture_statistics(
    picture: NDArray[np.uint8],
    field: KernelField,
    curve: ResponseCurve,
    most_tiles: int,
    coding_step: float | None = None,
) -> tuple[PictureStatistics, PictureStatistics]:
    """Statistics of luma and chroma of a picture (height, width, 3) or of a luma alone, (height, width).

    Noise shows where the paths cancel; a Gaussian, the same all round, hides it.  So the paths alone are fitted, which
    measures the noise and the defocused picture, and that is focused afterwards.  Paths too long for a tile are
    measured on a picture that is smaller; the finer frequencies take the finest one's.  coding_step: as of
    :func:`measure_picture`.
    """
    sigma_px, times = np.asarray(field.defocus_sigma_px, float), 1
    field = replace(field, defocus_sigma_px=0.0)
    while field.scaled(1 / times).radius_px > LARGEST_RADIUS and min(picture.shape[:2]) >= 2 * times * SIDE:
        times *= 2
    if times > 1:
        height, width = picture.shape[:2]
        picture = cv2.resize(picture, (width // times, height // times), interpolation=cv2.INTER_AREA)
        field = replace(field.scaled(1 / times), centres_px=(field.centres_px + 0.5) / times - 0.5)
        coding_step = None if coding_step is None else coding_step / times
    found = measure_picture(picture, field, curve, clipped_anywhere(picture, curve), most_tiles, coding_step)
    luma, chroma = (
        focused(one.scaled(times) if times > 1 and one.measured else one, sigma_px).with_error_share(CURVE_SLOPE_STD**2)
        for one in found
    )
    return luma, chroma


def focused(defocused: PictureStatistics, sigma_px: float | NDArray[np.float64]) -> PictureStatistics:
    """Spectra of the picture before a Gaussian came over it, of one size or of (n,) at the places that were measured.

    The Gaussian leaves next to nothing of high frequencies, and what is recorded there divided by next to nothing is no
    picture: no scene's power falls slower than f⁻².  So S is held to that law ring by ring, and what was recorded
    beyond it counts as noise; where less than the noise is left, S falls as f⁻³.
    """
    if not np.any(sigma_px) or not defocused.measured:
        return defocused
    frequency = defocused.frequency
    left = np.exp(-((2 * np.pi * np.reshape(sigma_px, (-1, 1)) * frequency) ** 2)).mean(axis=0)
    through = defocused.passed * defocused.signal
    rise, signal = frequency**_LEAST_FALL, defocused.signal / left
    signal[1:] = np.minimum.accumulate((signal * rise)[1:]) / rise[1:]
    passed = defocused.passed * left
    noise = np.maximum(defocused.noise, through - passed * signal)
    drowned = np.flatnonzero(passed * signal < noise)
    drowned = drowned[drowned > 0]
    if len(drowned):
        last = drowned[0] - 1
        signal[last + 1 :] = np.minimum(signal, falling_power(frequency, signal, last))[last + 1 :]
    places = defocused.places and defocused.places.after(left)
    real, cells = defocused.real, defocused.cells
    return replace(
        defocused,
        signal=signal,
        noise=noise,
        passed=passed,
        places=places,
        real=None if real is None else real * np.sqrt(left),
        cells=None if cells is None else (cells[0], cells[1] * left[:, None]),
    )
