"""Restore one frame's luma quickly at planning, for comparison with its neighbours."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.image_formation.blur import Image, tile_grid
from virest.image_formation.kernel_spread import kernel_spread
from virest.image_formation.kernels import blur_chords, smooth_field
from virest.image_formation.light import equivalent_length_px, flicker_of_rows, most_defocus_px
from virest.image_formation.row_motion import RowMotion
from virest.restoration.blurred import blurred_picture
from virest.restoration.frame import deblur_method
from virest.restoration.neighbours.reduced_tiles import reduced
from virest.restoration.neighbours.refinement import RefinedMotion
from virest.restoration.settings import RestorationSettings
from virest.restoration.statistics.of_picture import SAMPLE_TILE_PX, measured_centres, picture_statistics
from virest.restoration.statistics.records import PictureStatistics
from virest.restoration.statistics.tile_power import FEW_TILES
from virest.restoration.taken_part import blurred_part, no_gain_reason, trusted_share
from virest.restoration.tile_layout import THIN_MARGIN
from virest.restoration.tile_methods import tile_hyper_laplacian

ANCHOR = 0.5
"""Fraction of the exposure at which rows are restored: mid-exposure, as in the comparison with neighbours."""


def try_restoration(
    luma: NDArray[np.uint8],
    motion: RowMotion,
    settings: RestorationSettings,
    refined: RefinedMotion | None,
    coding_step: float | None,
) -> tuple[Image, Image] | None:
    """Restore a luma (height, width); None if it would not be deblurred.

    Returns its linear light as recorded and as restored, without flicker, at the reduced size at which neighbours are
    compared.
    """
    height, width = luma.shape
    longest_px = _longest_px(motion)
    if deblur_method(motion, settings, longest_px)[0] == "none":
        return None
    curve, field = motion.profile.curve, smooth_field(motion, ANCHOR)
    statistics = _few_statistics(luma, motion, coding_step)
    covariance_px2 = np.zeros((2, 2)) if refined is None else refined.path_covariance_px2()
    spread = kernel_spread(field, width, height, covariance_px2)
    model = statistics[0].with_kernel_variance(spread)
    if no_gain_reason(model, model.expected_gain_db):
        return None
    blurred = blurred_picture(cv2.merge([luma] * 3), curve, statistics, field, longest_px)
    sharp, recorded = tile_hyper_laplacian(replace(blurred, spread=spread), settings, THIN_MARGIN), blurred.light[0]
    part = trusted_share(model) * blurred_part(motion, settings.min_blur_px, settings.tile_px)
    restored = recorded + part * (np.clip(sharp, *curve.light_range) - recorded)
    rows = flicker_of_rows(motion)
    if rows is not None:
        recorded, restored = recorded / rows, restored / rows
    return reduced(recorded), reduced(restored)


def blur_error(
    luma: NDArray[np.uint8], motion: RowMotion, settings: RestorationSettings, coding_step: float | None
) -> float | None:
    """Mean square error, grey levels squared, of a luma (height, width) by its blur; None: it is not deblurred."""
    if deblur_method(motion, settings, _longest_px(motion))[0] == "none":
        return None
    measured = _few_statistics(luma, motion, coding_step)[0]
    return None if no_gain_reason(measured, measured.expected_gain_db) else measured.blur_error


def _longest_px(motion: RowMotion) -> float:
    centres_px = tile_grid(motion.profile.height, motion.profile.width, SAMPLE_TILE_PX, 0).centres_px
    chord_px = float(np.linalg.norm(blur_chords(motion, centres_px), axis=-1).max())
    return float(equivalent_length_px(chord_px, most_defocus_px(motion.profile)))


def _few_statistics(
    luma: NDArray[np.uint8], motion: RowMotion, coding_step: float | None
) -> tuple[PictureStatistics, PictureStatistics]:
    centres_px = measured_centres(luma, motion, coding_step)
    kernels = smooth_field(motion, ANCHOR)(centres_px)
    return picture_statistics(luma, kernels, motion.profile.curve, FEW_TILES, coding_step)
