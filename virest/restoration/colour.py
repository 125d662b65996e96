"""Restoration of the colour differences, which hold little detail, to go with a restored luma."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import cv2
import numpy as np

from virest.image_formation.blur import Image, TileGrid
from virest.restoration.blurred import BlurredPicture, block_means, luma_of, with_vignetting
from virest.restoration.encoding import grey_levels
from virest.restoration.neighbours.joint import HALF, NeighbourPicture
from virest.restoration.positive_light import (
    LIGHT_STEPS,
    blur_along_paths,
    consistent_light,
    shrunk,
    without_negative_light,
)
from virest.restoration.row_chunks import RowRenderer
from virest.restoration.settings import FEW_ITERATIONS, RestorationSettings
from virest.restoration.statistics.measure import STORED_COLOUR_PX
from virest.restoration.statistics.records import LUMA_BLUE, LUMA_GREEN, LUMA_RED, PictureStatistics
from virest.restoration.statistics.tile_power import variance_within
from virest.restoration.tile_layout import (
    COARSE_OVERLAP,
    border_noise_to_signal,
    in_tiles,
    join_neighbours,
    measured_noise_to_signal,
    tile_deconvolution,
    uneven_noise_to_signal,
)

COLOUR_SCALE, COARSE_COLOUR_SCALE = 2, 4
"""Reductions of the colour differences: a movie (4:2:0) stores them at half size.  Under long paths the light is
corrected at the coarse scale; with few iterations the differences are restored there too, which costs up to 0.05 dB."""
COLOUR_TILE_PX = 192
"""Side of their tiles, which may be larger than the luma's: colour differences hold little detail."""
COARSE_COLOUR_BLUR_PX = COARSE_COLOUR_SCALE * 3**0.5
"""Path length L that blurs as much as the coarse scale s does: block means have variance s²/12 and linear interpolation
s²/6, against L²/12.  With shorter paths the coarse scale would lose detail."""
DETAIL_SCATTER = 1.0
"""Standard deviation of the logarithm of a tile's power at 0.04 to 0.3 cycles per pixel, given its variance: 384 tiles
of 256 px in 32 sharp frames of photographs, print and drawings."""
NEARBY_SIDE, FINE_SIDE = 5, 3
"""Sides, in pixels of the colour differences, of the squares for their regression on the luma: for blurred pictures, in
addition to the path on both sides, and for sharp ones."""


def with_colour(blurred: BlurredPicture, sharp: Image, settings: RestorationSettings) -> RowRenderer:
    """Combine a sharp luma, in linear light and perhaps at reduced size, with the restored colour differences.

    These are restored at half size or less, since a movie stores no more of them, and enlarged as differences of grey
    levels: an edge of luma changes these less than differences of light, and a small error in light is a large one in
    dark grey levels.
    """
    height, width = blurred.light[0].shape
    few = settings.iterations <= FEW_ITERATIONS
    coarsest = COARSE_COLOUR_SCALE if blurred.longest_px > COARSE_COLOUR_BLUR_PX else COLOUR_SCALE
    scale, steps = (coarsest, 1) if few else (COLOUR_SCALE, LIGHT_STEPS)
    along = blur_along_paths(blurred, coarsest) if blurred.longest_px >= coarsest else None
    if along is not None:
        sharp = without_negative_light(blurred, sharp, along, steps)
    small, recorded = shrunk(sharp, blurred, scale), _small_differences(blurred, scale)
    red_blue = _sharp_differences(blurred, recorded, small, settings, scale)
    seen, light = (
        [cv2.add(luma, difference) for difference in _three_differences(*differences)]
        for luma, differences in (recorded, (small, red_blue))
    )
    if along is not None:
        light = consistent_light(blurred, small, seen, light, along, scale, steps)
    small_grey, *differences = _grey_differences(blurred, small, light)
    slopes = _regression_slopes(small_grey, differences, blurred.statistics.noise_levels**2, FINE_SIDE)
    rests = [cv2.subtract(d, cv2.multiply(s, small_grey)) for d, s in zip(differences, slopes, strict=True)]

    def full(planes: list[Image]) -> Image:
        size = (scale * small.shape[1], scale * small.shape[0])
        return cv2.resize(cv2.merge(planes), size, interpolation=cv2.INTER_LINEAR)[:height, :width]

    factors, rest = full([cv2.add(slope, 1.0) for slope in slopes]), full(rests)
    luma = grey_levels(with_vignetting(sharp, blurred), blurred.curve)
    if luma.shape != (height, width):
        luma = cv2.resize(luma, (width, height), interpolation=cv2.INTER_CUBIC)

    def levels(rows: slice) -> Image:
        picture = cv2.merge([luma[rows]] * 3)
        cv2.multiply(picture, factors[rows], picture)
        cv2.max(cv2.add(picture, rest[rows], picture), 0.0, picture)
        return cv2.threshold(picture, 255.0, 0.0, cv2.THRESH_TRUNC, picture)[1]

    return levels


def _sharp_differences(
    blurred: BlurredPicture,
    recorded: tuple[Image, list[Image]],
    sharp: Image,
    settings: RestorationSettings,
    scale: int,
) -> Iterator[Image]:
    """Sharp light of red and of blue minus the luma's, ``scale`` times smaller, as the luma ``sharp`` is.

    recorded: from :func:`_small_differences`.

    Blur is linear, so the part of a difference that is proportional to the luma nearby is so in the sharp picture too,
    if the slope is constant over a path; the luma is restored with a better prior.  The luma enters as
    its deviation from its local mean: where it is plain, slopes scatter, and a slope times the luma itself would carry
    that scatter into the rest.  The rest is restored by the measured Wiener filter.
    """
    deconvolution = tile_deconvolution(blurred, COLOUR_TILE_PX, COARSE_OVERLAP, scale)
    luma, differences = recorded
    side = 2 * int(np.ceil(blurred.longest_px / scale)) + NEARBY_SIDE
    steepness = blurred.slopes(1, scale * side, luma.shape[::-1])
    noise = blurred.statistics.noise_levels / steepness
    slopes = [
        cv2.blur(slope, (side, side))
        for slope in _regression_slopes(luma, differences, cv2.multiply(noise, noise), side)
    ]
    nearby = cv2.blur(luma, (side, side))
    ratio = measured_noise_to_signal(deconvolution, settings, blurred.chroma, scale)
    uneven = uneven_noise_to_signal(blurred.chroma)
    factors = _noise_to_signal_factors(deconvolution.grid, differences, steepness, blurred.chroma, scale)

    def left_over(luma: Image, differences: list[Image]) -> list[Image]:
        detail = cv2.subtract(luma, nearby)
        return [cv2.subtract(d, cv2.multiply(s, detail)) for d, s in zip(differences, slopes, strict=True)]

    own = left_over(luma, differences)
    join_neighbours(
        blurred,
        deconvolution,
        own,
        lambda neighbour: left_over(*_neighbour_differences(neighbour, scale)),
        ratio,
        scale,
        factors,
    )
    sharp_detail = cv2.subtract(sharp, nearby)
    for number, (left, slope) in enumerate(zip(own, slopes, strict=True)):
        projected = deconvolution.back_projected(left, number)
        at_border = border_noise_to_signal(deconvolution, left, blurred.longest_px / scale)
        least = [max(lowest, uneven) for lowest in at_border]
        filtered = deconvolution.blend(deconvolution.solutions(projected, in_tiles(ratio, least, factors)))
        yield cv2.add(filtered, cv2.multiply(slope, sharp_detail))


def _noise_to_signal_factors(
    grid: TileGrid, differences: list[Image], steepness: Image, chroma: PictureStatistics, scale: int
) -> list[float]:
    """N / S of each tile over that of the measured tiles, from the variance of its own colour differences.

    Colours lie unevenly: a cup on a grey floor has hundreds of times the floor's power, and the mean N / S would either
    remove its colour or amplify the floor's noise.  Variances are in grey levels of Cr and Cb (BT.601).  A tile's
    variance predicts its detail to a factor of exp(DETAIL_SCATTER) only; within that the measured N / S holds.

    differences: light of red and blue minus the luma's.  steepness: grey levels per unit of light.
    """
    if chroma.signal_variance is None:
        return [1.0] * len(grid.centres_px)
    side = round(chroma.period_px / scale)
    found = [
        variance_within(cv2.multiply(difference, steepness, scale=0.5 / (1 - luma_share)), side)
        for difference, luma_share in zip(differences, (LUMA_RED, LUMA_BLUE), strict=True)
    ]
    variance = cv2.addWeighted(found[0], 0.5, found[1], 0.5, 0.0)  # the mean of Cr and Cb, as in the statistics
    recorded = [cv2.mean(variance[top : top + grid.side, left : left + grid.side])[0] for top, left in grid.corners()]
    noise = chroma.variance_within_period(chroma.noise)
    least = chroma.least_variance((grid.side * scale / STORED_COLOUR_PX) ** 2)
    logarithms = np.log(chroma.signal_variance / np.maximum(np.array(recorded) - noise, least))
    factors = np.exp(np.sign(logarithms) * np.maximum(np.abs(logarithms) - DETAIL_SCATTER, 0.0))
    return [float(factor) for factor in factors]


def _neighbour_differences(neighbour: NeighbourPicture, scale: int) -> tuple[Image, list[Image]]:
    """Luma of a neighbour's light, and red and blue minus it, at the size of the colour differences."""
    red, green, blue = (block_means(plane, scale // HALF) for plane in cv2.split(neighbour.half_light))
    luma = luma_of([red, green, blue])
    return luma, [cv2.subtract(plane, luma) for plane in (red, blue)]


def _regression_slopes(luma: Image, differences: list[Image], noise_power: Any, side: int) -> list[Image]:
    """Local slopes of the differences over the luma, within ``side`` × ``side`` pixels; 0 if the luma is only noise.

    He, Sun and Tang 2013 (doi:10.1109/TPAMI.2012.213), the guided filter's local linear model.
    """

    def around(plane: Image) -> Image:
        return cv2.blur(plane, (side, side))

    mean = around(luma)
    power = cv2.max(cv2.subtract(around(cv2.multiply(luma, luma)), cv2.multiply(mean, mean)), 0.0)
    divisor = cv2.add(power, noise_power)
    together = (cv2.subtract(around(cv2.multiply(luma, d)), cv2.multiply(mean, around(d))) for d in differences)
    return [cv2.divide(product, divisor) for product in together]


def _three_differences(red: Image, blue: Image) -> list[Image]:
    """Light of red, green and blue minus the luma's, from that of red and blue."""
    return [red, cv2.addWeighted(red, -LUMA_RED / LUMA_GREEN, blue, -LUMA_BLUE / LUMA_GREEN, 0.0), blue]


def _grey_differences(blurred: BlurredPicture, luma: Image, channels: Sequence[Image]) -> list[Image]:
    """Grey levels of the luma, and those of red, green and blue minus it; channels: light of the three."""
    grey, *levels = (grey_levels(with_vignetting(light, blurred), blurred.curve) for light in (luma, *channels))
    return [grey, *(cv2.subtract(level, grey) for level in levels)]


def _small_differences(blurred: BlurredPicture, scale: int) -> tuple[Image, list[Image]]:
    """Luma, and red and blue minus it, ``scale`` times smaller; clipped pixels, without colour, are filled in."""
    red, green, blue = (block_means(plane, scale) for plane in blurred.light)
    luma = luma_of([red, green, blue])
    differences = [cv2.subtract(plane, luma) for plane in (red, blue)]
    holes = blurred.holes
    if holes is None:
        return luma, differences
    known = 1 - block_means(cv2.dilate(holes, np.ones((3, 3), np.uint8)), scale)
    return luma, _filled_in(differences, known)


def _filled_in(planes: list[Image], known: Image) -> list[Image]:
    """Fill unknown pixels with weighted means of the known ones, over increasingly large neighbourhoods."""
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
