"""Statistics of a picture for restoration: tile selection, long blur paths, defocus, and tone-curve uncertainty."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.camera.response import ResponseCurve
from virest.image_formation.blur import tile_grid
from virest.image_formation.kernels import KernelField, blur_chords
from virest.image_formation.row_motion import RowMotion
from virest.restoration.blurred import clipped_anywhere
from virest.restoration.statistics.measure import measure_picture
from virest.restoration.statistics.records import ROUNDING_POWER, PictureStatistics, coded_variance, falling_power
from virest.restoration.statistics.rings import SIDE

SAMPLE_TILE_PX = 128
"""Spacing of the tiles on which a picture's noise is measured."""
MIN_SAMPLES = 6
"""Measure at least this many tiles, the most blurred ones."""
_COARSE_PX = 8
"""Side of the block means in which a tile's detail is looked for: shake blurs finer detail."""
_LAPLACIAN_POWER = 20.0
"""Sum of the squared weights of OpenCV's Laplacian: the factor by which it raises the variance of white noise."""
LARGEST_RADIUS = SIDE // 4
"""Largest kernel radius, px: larger kernels leave too little of a tile that its window does not attenuate."""
CURVE_SLOPE_STD = 0.1
"""Standard deviation of the true tone curve's slope relative to the profile's, from one brightness to another.

A phone's true curve differs from one that was not measured on it.  A slope error ε makes an error of ε times the
picture's own detail wherever brightness changes, blurred or not: extra noise ε² S.  On 22 simulated captures
0.103 ± 0.015 gains most (``python -m virest.app.bench --only fits``); it is not based on measured curves."""
_LEAST_FALL = 2.0
"""Least exponent of the fall of picture power with frequency: f⁻² is that of edges alone, without texture."""


def measured_centres(picture: NDArray[np.uint8], motion: RowMotion, coding_step: float | None) -> Array:
    """Centres (m, 2) of the tiles of a picture (height, width[, 3]) to measure: the most blurred that show detail."""
    height, width = picture.shape[:2]
    centres_px = tile_grid(height, width, SAMPLE_TILE_PX, 0).centres_px
    return most_blurred(motion, detailed(picture, centres_px, coding_step))


def detailed(picture: NDArray[np.uint8], centres_px: Array, coding_step: float | None) -> Array:
    """Centres (m, 2) of the tiles of a picture (height, width[, 3]) that show more than a coder drops; all if none do.

    The coder drops what is below its error, with its noise (reverse water-filling, see :func:`coder_noise`), so a white
    wall looks free of noise, whatever the error elsewhere.  A tile counts as blank if even its coarse detail, the
    Laplacian of block means, has less power than that error in its middle half, which the window keeps.
    """
    height, width = picture.shape[:2]
    rows, columns = max(height // _COARSE_PX, 1), max(width // _COARSE_PX, 1)
    luma = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    coarse = cv2.resize(luma.astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA)
    power = cv2.blur(cv2.Laplacian(coarse, cv2.CV_32F) ** 2, (SIDE // (2 * _COARSE_PX),) * 2)
    x, y = ((centres_px + 0.5) / _COARSE_PX).astype(int).T
    power = power[np.clip(y, 0, rows - 1), np.clip(x, 0, columns - 1)] * (_COARSE_PX**2 / _LAPLACIAN_POWER)
    shown = power > (ROUNDING_POWER if coding_step is None else coded_variance(coding_step))
    return centres_px[shown] if shown.any() else centres_px


def most_blurred(motion: RowMotion, centres_px: Array) -> Array:
    """Centres (m, 2) of the tiles to measure: the MIN_SAMPLES most blurred, and all with half the longest path or more.

    A path of 1 px cancels no frequency, so it cannot separate noise from signal; and coding noise is where motion is.
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
    bounds_luma: bool = True,
) -> tuple[PictureStatistics, PictureStatistics]:
    """Statistics of luma and chroma of a picture (height, width, 3), or of luma alone (height, width).

    Noise shows where the motion paths cancel frequencies; Gaussian defocus, the same in all directions, would hide it.
    So the fit uses the paths alone, which gives the noise and the spectrum of the defocused picture, and defocus is
    divided out afterwards.  If paths are too long for a tile, the picture is measured at reduced size; frequencies
    above the finest measured one take its values.  coding_step, bounds_luma: as in :func:`measure_picture`.
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
    found = measure_picture(
        picture, field, curve, clipped_anywhere(picture, curve), most_tiles, coding_step, bounds_luma
    )
    luma, chroma = (
        without_defocus(one.scaled(times) if times > 1 and one.measured else one, sigma_px).with_error_share(
            CURVE_SLOPE_STD**2
        )
        for one in found
    )
    return luma, chroma


def without_defocus(defocused: PictureStatistics, sigma_px: float | Array) -> PictureStatistics:
    """Spectra of the picture before Gaussian defocus; sigma_px: one value, or (n,) for the measured tiles.

    The Gaussian leaves almost nothing of high frequencies, so dividing by it there gives no valid spectrum.  No scene's
    power falls more slowly than f⁻², so S is limited to that ring by ring, and recorded power beyond it counts as
    noise.  Where the remaining signal is below the noise, S falls at least as f⁻³.
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
    below_noise = np.flatnonzero(passed * signal < noise)
    below_noise = below_noise[below_noise > 0]
    if len(below_noise):
        last = below_noise[0] - 1
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
