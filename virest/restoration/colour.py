"""Colour differences, which hold little detail, beside a luma that is restored."""

from __future__ import annotations

import cv2
import numpy as np

from virest.degradation.blur import Image
from virest.restoration.blurred import BlurredPicture, LightOfRows, luma_of
from virest.restoration.settings import FEW_ITERATIONS, RestorationSettings
from virest.restoration.statistics import LUMA_BLUE, LUMA_RED
from virest.restoration.tile_layout import COARSE_OVERLAP, noise_to_signal, tile_deconvolution

COLOUR_SCALE, COARSE_COLOUR_SCALE = 2, 3
COLOUR_TILE_PX = 384
"""Colour differences hold so little detail that kernels need not follow the paths as closely, nor pixels the movie's.

The coarse scale, with few iterations, costs up to 0.05 dB.
"""


def with_colour(blurred: BlurredPicture, sharp: Image, settings: RestorationSettings) -> LightOfRows:
    """Red, green and blue of a sharp luma and the colour differences, which hold little detail.

    These are filtered at half size or less, since a movie stores no more of them, by the measured Wiener filter.
    """
    height, width = sharp.shape
    scale = COLOUR_SCALE if settings.iterations > FEW_ITERATIONS else COARSE_COLOUR_SCALE
    deconvolution = tile_deconvolution(blurred, COLOUR_TILE_PX, COARSE_OVERLAP, scale)
    ratios = noise_to_signal(deconvolution, settings, blurred.chroma, scale)
    size = (scale * deconvolution.grid.width, scale * deconvolution.grid.height)
    red, blue = (
        cv2.resize(
            deconvolution.blend(deconvolution.solutions(deconvolution.back_projected(plane), *ratios)),
            size,
            interpolation=cv2.INTER_LINEAR,
        )[:height, :width]
        for plane in _small_differences(blurred, scale)
    )
    green_luma = 1 - LUMA_RED - LUMA_BLUE

    def light(rows: slice) -> list[Image]:
        luma, more_red, more_blue = sharp[rows], red[rows], blue[rows]
        green = cv2.scaleAdd(more_red, -LUMA_RED / green_luma, luma)
        cv2.scaleAdd(more_blue, -LUMA_BLUE / green_luma, green, green)
        return [cv2.add(luma, more_red), green, cv2.add(luma, more_blue)]

    return light


def _small_differences(blurred: BlurredPicture, scale: int) -> list[Image]:
    """Red and blue less luma, ``scale`` times smaller; clipped ones, which show no colour, from around them."""
    red, green, blue = (_block_means(plane, scale) for plane in blurred.light)
    luma = luma_of([red, green, blue])
    differences = [cv2.subtract(plane, luma) for plane in (red, blue)]
    holes = blurred.holes
    if holes is None:
        return differences
    known = 1 - _block_means(cv2.dilate(holes, np.ones((3, 3), np.uint8)), scale)
    return _filled_in(differences, known)


def _block_means(plane: Image, side: int) -> Image:
    """Means over squares of whole pixels, the last ones smaller: an area's mean of other sides takes twice as long."""
    height, width = plane.shape
    means = np.empty((-(-height // side), -(-width // side)), np.float32)
    for rows in _blocks(height, side):
        for columns in _blocks(width, side):
            part = means[rows.start // side : -(-rows.stop // side), columns.start // side : -(-columns.stop // side)]
            part[:] = cv2.resize(plane[rows, columns], part.shape[::-1], interpolation=cv2.INTER_AREA)
    return means


def _blocks(length: int, side: int) -> list[slice]:
    """Where the whole pieces of ``side`` are, and where the rest is."""
    whole = length - length % side
    return [part for part in (slice(0, whole), slice(whole, length)) if part.stop > part.start]


def _filled_in(planes: list[Image], known: Image) -> list[Image]:
    """Weighted means of what is known, over wider and wider neighbourhoods."""
    weight, filled = known, [cv2.multiply(plane, known) for plane in planes]
    for side in (3, 9, 27, 81):
        near = cv2.blur(weight, (side, side))
        reached = near > 1e-2
        share = np.where(reached, (1 - weight) / np.maximum(near, 1e-2), np.float32(0))
        filled = [cv2.add(plane, cv2.multiply(cv2.blur(plane, (side, side)), share)) for plane in filled]
        weight = np.where(reached, np.float32(1), weight)
        if weight.min() == 1:
            break
    return filled
