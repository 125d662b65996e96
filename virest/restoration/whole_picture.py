"""Methods that restore a picture as a whole, with its space-variant blur operator and the adjoint."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from virest.image_formation.blur import Image, SpaceVariantBlur, TileGrid, tile_grid
from virest.restoration.blurred import BlurredPicture, luma_of, with_vignetting
from virest.restoration.clipped_light import near_clipped
from virest.restoration.colour import with_colour
from virest.restoration.deconvolution import hyper_laplacian, richardson_lucy
from virest.restoration.encoding import grey_levels
from virest.restoration.row_chunks import RowRenderer
from virest.restoration.settings import RestorationSettings
from virest.restoration.tile_methods import beta_schedule, tile_hyper_laplacian

START_ITERATIONS, SETTLED_BETA = 5, 0.3
"""The whole-picture method starts from this many iterations of the tiled one, so its penalties can start higher."""
WEIGHED_PX = 5
"""Side of the neighbourhood whose mean light gives a pixel's curve slope: it averages the noise out."""


def by_richardson_lucy(blurred: BlurredPicture, settings: RestorationSettings) -> RowRenderer:
    """Richardson–Lucy on each channel separately; censored pixels have no weight."""
    operator = _whole_operator(blurred, positive=True)
    sharp = []
    for light, dark, clipped in zip(blurred.light, blurred.dark, blurred.clipped, strict=True):
        weight = np.ones_like(light) - sum(mask for mask in (dark, clipped) if mask is not None)
        start = _extended(light, operator.border)
        result = richardson_lucy(light, operator.apply, operator.adjoint, start, weight, settings.iterations)
        sharp.append(_inner(result, operator.border))
    sharp = [grey_levels(with_vignetting(plane, blurred), blurred.curve) for plane in sharp]
    return lambda rows: cv2.merge([plane[rows] for plane in sharp])


def by_global_hyper_laplacian(blurred: BlurredPicture, settings: RestorationSettings) -> RowRenderer:
    """Luma with the whole-picture operator, censored pixels without weight; colour by tiles at reduced resolution.

    Near clipped light the tiled solution is kept: its highlights were estimated with light constrained to be positive.
    """
    operator, near = _whole_operator(blurred), near_clipped(blurred)
    height, width = blurred.light[0].shape
    statistics, slope = blurred.statistics, blurred.slopes(1, WEIGHED_PX, (width, height))
    uneven = statistics.unevenness
    if uneven:
        in_tiles = tile_hyper_laplacian(blurred, settings)
        if uneven == 1.0:
            return with_colour(blurred, in_tiles, settings)
    start = tile_hyper_laplacian(blurred, replace(settings, iterations=START_ITERATIONS))
    result = hyper_laplacian(
        luma_of(blurred.light),
        operator.apply,
        operator.adjoint,
        _extended(start, operator.border),
        _data_weight(slope, blurred),
        _extended(slope, operator.border),
        (settings.strength * statistics.noise_levels) ** -2,
        statistics.gradient_scale,
        beta_schedule(settings.iterations, SETTLED_BETA),
        settings.inner_iterations,
    )
    sharp = _inner(result, operator.border)
    whole = sharp if near is None else sharp + near * (start - sharp)
    return with_colour(
        blurred, cv2.addWeighted(in_tiles, uneven, whole, 1 - uneven, 0.0) if uneven else whole, settings
    )


def _whole_operator(blurred: BlurredPicture, positive: bool = False) -> SpaceVariantBlur:
    height, width = blurred.light[0].shape
    grid: TileGrid = tile_grid(height, width, 96, 32)
    return SpaceVariantBlur(grid, blurred.field(grid.centres_px).arrays(positive=positive))


def _extended(channel: Image, border: int) -> Image:
    return cv2.copyMakeBorder(channel, border, border, border, border, cv2.BORDER_REPLICATE)


def _data_weight(slope: Image, blurred: BlurredPicture) -> Image:
    """Weight of each pixel's luma: its curve slope; 0 within one pixel of ``holes`` and where all channels are dark."""
    holes, dark = blurred.holes, [mask for mask in blurred.dark if mask is not None]
    if holes is not None:
        slope = slope * (1 - cv2.dilate(holes, np.ones((3, 3), np.uint8)))
    return slope * (1 - np.minimum.reduce(dark)) if len(dark) == len(blurred.dark) else slope


def _inner(picture: Image, border: int) -> Image:
    return picture[border:-border, border:-border]
