"""One picture, deblurred: linear light in, linear light out, by the method that the settings name."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.camera.response import ResponseCurve
from virest.degradation.blur import Image, SpaceVariantBlur, TileGrid, tile_grid
from virest.degradation.kernels import KernelField
from virest.restoration import tiles
from virest.restoration.deconvolution import (
    LEVELS_PER_UNIT,
    hyper_laplacian,
    richardson_lucy,
    shrinkage_levels,
)
from virest.restoration.settings import RestorationSettings
from virest.restoration.statistics import LUMA_BLUE, LUMA_RED, PictureStatistics, on_spectrum

CLIPPED_LEVELS = 2.0
"""A pixel this close to the top was clipped."""
PULLED_DOWN_LEVELS = 8.0
"""Next to a clipped pixel, the movie's codec returns clipped ones up to about this far below the top."""
COLOUR_SCALE, COARSE_COLOUR_SCALE = 2, 3
COLOUR_TILE_PX = 384
"""Colour differences hold so little detail that kernels need not follow the paths as closely, nor pixels the movie's.

The coarse scale, with few iterations, costs up to 0.05 dB.
"""
CODEC_REACH_PX = 2.5
"""A lamp's edge is smeared about so far by the movie's codec."""
LEAST_MEASURED, ENOUGH_MEASURED, MEASURED_OVER_PX = 0.35, 0.65, 33
"""Part of what is not clipped that lies clear of clipped light, from which on restoring begins, and is all taken;
seen over so many pixels and the path to both sides."""
FEW_ITERATIONS, FEW_SCALE = 2, 0.6
"""Few steps do not reach as far into the weak gradients; a smaller unit makes up for it."""
REDUCTIONS = (1.5, 4 / 3)
"""A picture so many times smaller serves few iterations as well, where noise hides all finer detail."""
Surroundings = tuple[float, int, int]
FULL_MARGIN, THIN_MARGIN, THINNEST_MARGIN = (0.0, 16, 16), (0.3, 4, 16), (0.3, 3, 12)
"""What a tile sees around it is as long as the blur path, less this part of the tiles' overlap; its least length, px;
and the least length of the tile's bridge.

The bridge is as long as the path: a steep one is an edge that the deconvolution carries into the tile.  Where tiles
overlap widely, a window's ramp gives next to no weight to what a margin would keep away; the thinnest margins are for
pictures that are reduced.
"""
COARSE_OVERLAP, FINE_OVERLAP, WIDE_OVERLAP = 6, 4, 3
"""Tiles overlap by this part of their side: those of colour, those of luma, and those of luma in few iterations."""
MOST_WRONG, LEAST_TILE, FIELD_SAMPLES = 0.7, 0.7, (6, 5)
"""Error in noises that a tile's kernel may make of edges half a step away; part of the preset's side to which tiles
shrink for it; rows and columns of places at which the kernels' change is looked at."""
OVERLAP_GIVE = 0.1
"""Wide overlaps may be narrower by so much, where fewer tiles then reach to the picture's edge."""
FIRST_BETA, LAST_BETA, FEW_BETAS = 0.2, 12.0, (0.25, 1.0)
"""Penalties of the splitting, in units of the gradients' own scale; those of few iterations."""
START_ITERATIONS, SETTLED_BETA = 5, 0.3
"""The whole-picture method starts from that many steps of the tiled one, so its penalties can start higher."""
BAND_ROWS = 64
"""Of a picture, that stay in the cache."""
BORDER_NOISE_TO_SIGNAL = 0.003
"""Least N / S of tiles that see beyond the picture."""
RESIDUAL_SHARE = 0.05
"""Part of the picture's power that a residual holds: texture too faint for the sparse prior."""
UNEVEN_NOISE_TO_SIGNAL = 0.03
"""Least N / S of a picture whose power lies at few places: an error of the kernel there, or of what a tile sees around
itself, is by so much in proportion to the power, and stands out of the noise."""
LINEAR_SHARE = 0.5
"""Part of such a picture that is the linear filter's: its gradients are not sparse, the prior makes them steps."""
WEIGHED_PX = 5
"""Side of the neighbourhood whose light tells a pixel's slope: in it the recorded noise evens out."""
SHRUNK_PARTS, LOOKED_AT = 8, 4
"""Neighbourhoods are summed in a picture in which they have about so many pixels a side, or more; of the rows that fall
on such a pixel so many are looked at, or a few more."""
SlopeMaker = Callable[[int, int, tuple[int, int]], Image]
FieldMaker = Callable[[NDArray[np.float64]], KernelField]
LightOfRows = Callable[[slice], list[Image]]
"""Light of each channel over some rows of a picture, (rows, width): what is made band by band stays in the cache."""


@dataclass(frozen=True, slots=True)
class BlurredPicture:
    """A recorded picture and what restoring it needs to know."""

    light: list[Image]
    """Linear light of each channel, (height, width)."""
    slopes: SlopeMaker
    """Grey levels per unit of light of a channel, by its number, over neighbourhoods of a side in pixels.

    As a picture of a given (width, height); see :func:`_slopes_around`.
    """
    dark: list[Image | None]
    """1.0 where a channel's light was too little to be measured; None: nowhere."""
    clipped: list[Image | None]
    """1.0 where a channel's light was too much to be measured; None: nowhere."""
    statistics: PictureStatistics
    """Of the luma."""
    chroma: PictureStatistics
    field: FieldMaker
    """Kernels at given tile centres."""
    longest_px: float
    """Longest blur path in the picture."""
    holes: Image | None
    """1.0 where light is clipped in all channels, and in any beside such; None: nowhere; see :func:`_holes`."""


def blurred_picture(
    picture: NDArray[np.uint8],
    curve: ResponseCurve,
    statistics: tuple[PictureStatistics, PictureStatistics],
    field: FieldMaker,
    longest_px: float,
) -> BlurredPicture:
    """Take a picture (height, width, 3) through the inverse of the exposure curve."""
    channels = cv2.split(picture)
    light = [cv2.LUT(channel, curve.linear_table()) for channel in channels]
    dark = [_dark(channel, curve) for channel in channels]
    clipped = [_clipped(channel, curve) for channel in channels]

    def slopes(channel: int, side_px: int, size: tuple[int, int]) -> Image:
        return _slopes_around(light[channel], curve, side_px, size)

    return BlurredPicture(light, slopes, dark, clipped, *statistics, field, longest_px, _holes(clipped, longest_px))


def _slopes_around(light: Image, curve: ResponseCurve, side_px: int, size: tuple[int, int]) -> Image:
    """The curve's slope at a neighbourhood's mean light, as a picture of ``size`` (width, height).

    Grey levels have about the same noise everywhere; in light that is their noise over the curve's slope, so that
    nearly all of it is in what is bright, and so is most of the mean light.  A deconvolution that weighs all pixels of
    a tile alike spreads that noise over the dark parts, where a slope of their own would show it as detail.
    """
    height, width = light.shape
    shrunk = max(1, side_px // SHRUNK_PARTS)
    few, side = (max(1, width // shrunk), max(1, height // shrunk)), max(1, side_px // shrunk)
    rows = light[:: max(1, shrunk // LOOKED_AT)]
    around = cv2.blur(cv2.resize(rows, few, interpolation=cv2.INTER_AREA), (side, side))
    slopes = cv2.LUT(np.rint(255 * curve.encode(around)).astype(np.uint8), _measured_slopes(curve))
    return cv2.resize(slopes, size, interpolation=cv2.INTER_LINEAR)


@functools.lru_cache(maxsize=8)
def _measured_slopes(curve: ResponseCurve) -> NDArray[np.float32]:
    """The curve's slope table; levels that tell no light have their neighbours'."""
    levels, known = np.arange(256), ~curve.censored_table()
    return np.interp(levels, levels[known], curve.slope_table()[known]).astype(np.float32)


def _dark(channel: NDArray[np.uint8], curve: ResponseCurve) -> Image | None:
    """1.0 where the channel is below the curve's A."""
    table = curve.censored_table() & ~curve.clipped_table()
    return cv2.LUT(channel, table.astype(np.float32)) if table[int(channel.min())] else None


def _clipped(channel: NDArray[np.uint8], curve: ResponseCurve) -> Image | None:
    """1.0 where the channel is clipped, and where its neighbours are and the codec has pulled it down a little."""
    table = curve.clipped_table(CLIPPED_LEVELS)
    if not table[int(channel.max())]:
        return None
    clipped = cv2.LUT(channel, table.astype(np.uint8))
    near = cv2.dilate(clipped, np.ones((5, 5), np.uint8))
    return (near & cv2.LUT(channel, curve.clipped_table(PULLED_DOWN_LEVELS).astype(np.uint8))).astype(np.float32)


def clipped_anywhere(picture: NDArray[np.uint8], curve: ResponseCurve) -> NDArray[np.uint8] | None:
    """1 where any channel of a picture (height, width, 3) is clipped; None: nowhere."""
    table = curve.clipped_table(CLIPPED_LEVELS)
    if not table[int(picture.max())]:
        return None
    brightest = int(np.argmax(table)) - 1
    return (cv2.inRange(picture, (0, 0, 0), (brightest,) * 3) == 0).view(np.uint8)


def deblur(blurred: BlurredPicture, settings: RestorationSettings) -> LightOfRows:
    """The sharp picture's light, channel by channel, at the kernels' anchor."""
    methods: dict[str, Callable[[BlurredPicture, RestorationSettings], LightOfRows]] = {
        "inverse": _by_tile_filter,
        "wiener": _by_tile_filter,
        "gradient-wiener": _by_tile_filter,
        "hyper-laplacian": _by_tile_hyper_laplacian,
        "richardson-lucy": _by_richardson_lucy,
        "hyper-laplacian-global": _by_global_hyper_laplacian,
    }
    if settings.deblur not in methods:
        raise ValueError(f"no deblurring method '{settings.deblur}'")
    return _with_unseen_kept(methods[settings.deblur](blurred, settings), blurred)


def _with_unseen_kept(sharp: LightOfRows, blurred: BlurredPicture) -> LightOfRows:
    """The recorded light where nothing says more."""
    masks = unseen_masks(blurred)
    if all(mask is None for mask in masks):
        return sharp

    def kept(rows: slice) -> list[Image]:
        planes = sharp(rows)
        for plane, light, unseen in zip(planes, blurred.light, masks, strict=True):
            if unseen is not None:
                cv2.copyTo(light[rows], unseen[rows], plane)
        return planes

    return kept


def unseen_masks(blurred: BlurredPicture) -> list[NDArray[np.uint8] | None]:
    """1 where a channel's light is censored, dark or clipped, with all its neighbours along the path; None: nowhere."""
    if all(mask is None for mask in (*blurred.dark, *blurred.clipped)):
        return [None] * len(blurred.light)
    reach = _path_reach(blurred)
    masks: list[NDArray[np.uint8] | None] = []
    for pair in zip(blurred.dark, blurred.clipped, strict=True):
        eroded = [cv2.erode(mask.astype(np.uint8), reach) for mask in pair if mask is not None]
        masks.append(np.maximum.reduce(eroded) if eroded else None)
    return masks


# ── tile by tile ─────────────────────────────────────────────────────────────────────────────────────────────────


def _luma_tiles(
    blurred: BlurredPicture, settings: RestorationSettings, around: Surroundings = FULL_MARGIN
) -> tiles.TileDeconvolution:
    """Tiles over the picture."""
    if around is FULL_MARGIN:
        return _tile_deconvolution(blurred, settings.tile_px, FINE_OVERLAP, around=around)
    side = int(np.clip(_kernel_holds_px(blurred), LEAST_TILE * settings.tile_px, settings.tile_px))
    return _tile_deconvolution(blurred, side, WIDE_OVERLAP, around=around)


def _kernel_holds_px(blurred: BlurredPicture) -> float:
    """Side of a tile at whose middle's kernel half a step away, a third of its side, moves edges by a noise's worth.

    Paths change over the picture as the camera rolls and as the rows go by; under noise that matters less.
    """
    height, width = blurred.light[0].shape
    y, x = (
        (np.arange(count) + 0.5) * length / count for count, length in zip(FIELD_SAMPLES, (height, width), strict=True)
    )
    field = blurred.field(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
    paths_px = field.paths_px[:, ::4].reshape(len(y), len(x), -1, 2)
    changes = [np.diff(paths_px, axis=axis) / (at[1] - at[0]) for axis, at in enumerate((y, x))]
    per_px = np.sqrt(0.5 * sum(np.mean(np.linalg.norm(c, axis=-1).mean(-1)) ** 2 for c in changes))
    wrong_px = MOST_WRONG * blurred.statistics.noise_levels / blurred.statistics.gradient_scale
    return float(3 * wrong_px / max(per_px, 1e-6))


def _tile_deconvolution(
    blurred: BlurredPicture,
    side: int,
    overlap_parts: int,
    scale: float = 1.0,
    around: Surroundings = FULL_MARGIN,
) -> tiles.TileDeconvolution:
    """Tiles over the picture, or over one that is ``scale`` times smaller, with kernels to its measure."""
    height, width = (int(np.ceil(length / scale)) for length in blurred.light[0].shape)
    per_overlap, least_margin_px, least_bridge_px = around
    seen_px = blurred.longest_px - per_overlap * side / overlap_parts
    margin = int(np.clip(seen_px / scale, least_margin_px / scale, 96))
    bridge = int(np.clip(blurred.longest_px / scale, least_bridge_px / scale, 96))
    give = OVERLAP_GIVE if overlap_parts == WIDE_OVERLAP else 0.0
    grid = tiles.quick_grid(height, width, int(side / scale), 2 * margin + bridge, overlap_parts, give)
    field = blurred.field((grid.centres_px + 0.5) * scale - 0.5)
    kernels = field.scaled(1 / scale).arrays()
    held = kernels.shape[1] // 2 + 1 - (0 if around is FULL_MARGIN else grid.side // 2)
    return tiles.TileDeconvolution(grid, kernels, max(margin, held), bridge)


def _by_tile_filter(blurred: BlurredPicture, settings: RestorationSettings) -> LightOfRows:
    deconvolution = _luma_tiles(blurred, settings)
    projected = _projected_luma(blurred, deconvolution, settings)
    factors = _tile_factors(deconvolution, settings, blurred.statistics)
    sharp = deconvolution.blend(cv2.multiply(s, f) for s, f in zip(projected, factors, strict=True))
    return _with_colour(blurred, deconvolution.with_lamps(sharp), settings)


def _tile_factors(
    deconvolution: tiles.TileDeconvolution, settings: RestorationSettings, statistics: PictureStatistics
) -> Iterator[Image]:
    """What follows conj(K) in each tile: by the method that the settings name, the measured N / S one by default."""
    match settings.deblur:
        case "inverse":
            return deconvolution.filters(tiles.inverse_filter)
        case "wiener":
            weight = statistics.frequency
            flat = float(np.sum(statistics.noise * weight) / np.sum(statistics.signal * weight))
            ratio = np.full((deconvolution.size,) * 2, settings.strength**2 * flat, np.float32)
            ratio[0, 0] = 0.0  # the mean is no noise
            return deconvolution.filters(lambda power: tiles.wiener_filter(power, ratio))
    ratio, guarded = _noise_to_signal(deconvolution, settings, statistics.between_rings_and_level)
    return deconvolution.filters(
        lambda power: tiles.wiener_filter(power, ratio), lambda power: tiles.wiener_filter(power, guarded)
    )


def _noise_to_signal(
    deconvolution: tiles.TileDeconvolution,
    settings: RestorationSettings,
    statistics: PictureStatistics,
    scale: float = 1.0,
) -> tuple[Image, Image]:
    """Measured N / S on a tile's spectrum: for tiles inside the picture, and for those that see beyond it."""
    ratio = on_spectrum(statistics, settings.strength**2 * statistics.noise_to_signal, deconvolution.size, scale)
    guarded = np.maximum(ratio, BORDER_NOISE_TO_SIGNAL)
    if statistics.unevenness:
        least = np.float32(UNEVEN_NOISE_TO_SIGNAL * statistics.unevenness)
        ratio, guarded, mean = np.maximum(ratio, least), np.maximum(guarded, least), ratio[0, 0]
        ratio[0, 0] = mean
    guarded[0, 0] = ratio[0, 0]
    return ratio, guarded


# ── colour ───────────────────────────────────────────────────────────────────────────────────────────────────────


def _luma(light: list[Image]) -> Image:
    """Luma of linear light; it and the colour differences are restored apart: noise and detail differ between them."""
    red, green, blue = light
    return cv2.scaleAdd(blue, LUMA_BLUE, cv2.addWeighted(red, LUMA_RED, green, 1 - LUMA_RED - LUMA_BLUE, 0.0))


def _with_colour(blurred: BlurredPicture, sharp: Image, settings: RestorationSettings) -> LightOfRows:
    """Red, green and blue of a sharp luma and the colour differences, which hold little detail.

    These are filtered at half size or less, since a movie stores no more of them, by the measured Wiener filter.
    """
    height, width = sharp.shape
    scale = COLOUR_SCALE if settings.iterations > FEW_ITERATIONS else COARSE_COLOUR_SCALE
    deconvolution = _tile_deconvolution(blurred, COLOUR_TILE_PX, COARSE_OVERLAP, scale)
    ratios = _noise_to_signal(deconvolution, settings, blurred.chroma, scale)
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
    luma = _luma([red, green, blue])
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


# ── clipped light ────────────────────────────────────────────────────────────────────────────────────────────────


def _holes(clipped: list[Image | None], longest_px: float) -> Image | None:
    """1.0 where light is clipped in all channels, and in any beside such: what is recorded there is no measurement.

    A lamp is far too bright for all channels, and its rim for some.  Where nothing around has more than one channel
    clipped it is a vivid surface: the others show its colour, and nearly all of its light was measured.
    """
    masks = [mask for mask in clipped if mask is not None]
    if len(masks) < len(clipped):
        return None
    white = functools.reduce(cv2.min, masks)
    if not cv2.hasNonZero(white):
        return None
    side = 2 * int(np.ceil(longest_px / 2 + CODEC_REACH_PX)) + 1
    return cv2.min(functools.reduce(cv2.max, masks), cv2.dilate(white, np.ones((side, side), np.uint8)))


def near_clipped(blurred: BlurredPicture) -> Image | None:
    """1 where the blur path touches clipped light, falling to 0 over a path's length beyond; None: nothing clipped."""
    holes = blurred.holes
    if holes is None:
        return None
    touched = cv2.dilate(holes.astype(np.uint8), _path_reach(blurred))
    side = 2 * int(np.ceil(blurred.longest_px / 2 + CODEC_REACH_PX)) + 1
    around = cv2.dilate(touched, np.ones((side, side), np.uint8)).astype(np.float32)
    return cv2.blur(around, (side, side))


def _measured_part(holes: Image) -> Image:
    """0 in holes, rising to 1 around them: the codec spreads a lamp's edge over its neighbours.

    A sharp edge of the weights would show as an outline around the lamp.
    """
    part = np.ones_like(holes)
    near = _around(holes, int(4 * CODEC_REACH_PX) + 3)
    wide = cv2.GaussianBlur(cv2.dilate(holes[near], np.ones((5, 5), np.uint8)), (0, 0), CODEC_REACH_PX)
    part[near] = (1 - holes[near]) * (1 - wide)
    return part


def _around(mask: Image, reach: int) -> tuple[slice, slice]:
    """Rows and columns of all that is not 0 in a mask (height, width), and so many pixels more on each side."""
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return slice(max(top - reach, 0), top + height + reach), slice(max(left - reach, 0), left + width + reach)


def measured_share(blurred: BlurredPicture) -> Image | None:
    """How much of a restored picture to take where light is clipped, (height, width); None: all of it, everywhere.

    Thin things on a clipped background lie within the margins of the holes: next to nothing of them was measured.
    """
    holes = blurred.holes
    if holes is None:
        return None
    side = 2 * int(np.ceil(blurred.longest_px)) + MEASURED_OVER_PX
    measured, left = (cv2.blur(part, (side, side)) for part in (_measured_part(holes), 1 - holes))
    share = (measured / np.maximum(left, 1e-3) - LEAST_MEASURED) / (ENOUGH_MEASURED - LEAST_MEASURED)
    return cv2.blur(np.clip(share, 0, 1), (side, side))


def _path_reach(blurred: BlurredPicture) -> NDArray[np.uint8]:
    """The blur path at the picture's middle, to both sides, as a structuring element."""
    height, width = blurred.light[0].shape
    path = blurred.field(np.array([[(width - 1) / 2, (height - 1) / 2]])).arrays(positive=True)[0]
    return (path + path[::-1, ::-1] > 2e-3).astype(np.uint8)


def _projected_luma(
    blurred: BlurredPicture, deconvolution: tiles.TileDeconvolution, settings: RestorationSettings
) -> Image:
    """Spectra of Kᵀ g, (tiles, size, size); tiles with clipped light are tamed."""
    luma, holes = _luma(blurred.light), blurred.holes
    if holes is not None:
        numbers = deconvolution.touched(holes)
        kernels = blurred.field(deconvolution.grid.centres_px[numbers]).arrays(positive=True)
        deconvolution.tame(numbers, kernels, luma, _measured_part(holes), float(luma.max()))
    return deconvolution.back_projected(luma)


def _by_tile_hyper_laplacian(blurred: BlurredPicture, settings: RestorationSettings) -> LightOfRows:
    """Hyper-Laplacian for the luma, measured Wiener for the colour differences."""
    times = _reduction(blurred.statistics, settings)
    if times == 1.0:
        around = THIN_MARGIN if settings.iterations <= FEW_ITERATIONS else FULL_MARGIN
        return _with_colour(blurred, _tile_hyper_laplacian(blurred, settings, around), settings)
    height, width = blurred.light[0].shape
    small = replace(settings, tile_px=round(settings.tile_px / times))
    sharp = _tile_hyper_laplacian(_reduced(blurred, times), small, THINNEST_MARGIN)
    return _with_colour(blurred, cv2.resize(sharp, (width, height), interpolation=cv2.INTER_CUBIC), settings)


def _reduction(statistics: PictureStatistics, settings: RestorationSettings) -> float:
    """How many times smaller the luma is restored: as much as loses nothing that stands out of the noise."""
    few = settings.iterations <= FEW_ITERATIONS
    return next((times for times in REDUCTIONS if few and statistics.finest < 0.5 / times), 1.0)


def _reduced(blurred: BlurredPicture, times: float) -> BlurredPicture:
    """The luma of a picture so many times smaller, and all that restoring it needs, to its measure; no colour."""
    height, width = blurred.light[0].shape
    size = (max(round(width / times), 1), max(round(height / times), 1))

    def slopes(channel: int, side_px: int, asked: tuple[int, int]) -> Image:
        return blurred.slopes(channel, round(side_px * times), asked)

    def field(centres_px: NDArray[np.float64]) -> KernelField:
        return blurred.field((centres_px + 0.5) * times - 0.5).scaled(1 / times)

    luma, holes = cv2.resize(_luma(blurred.light), size, interpolation=cv2.INTER_LINEAR), blurred.holes
    if holes is not None:
        holes = (cv2.resize(holes, size, interpolation=cv2.INTER_AREA) > 0).astype(np.float32)
    return replace(
        blurred,
        light=[luma] * 3,
        slopes=slopes,
        dark=[None] * 3,
        clipped=[holes] * 3,
        holes=holes,
        statistics=blurred.statistics.scaled(1 / times),
        field=field,
        longest_px=blurred.longest_px / times,
    )


def _tile_hyper_laplacian(
    blurred: BlurredPicture, settings: RestorationSettings, around: Surroundings = FULL_MARGIN
) -> Image:
    deconvolution = _luma_tiles(blurred, settings, around)
    statistics, few = blurred.statistics, settings.iterations <= FEW_ITERATIONS
    unit = statistics.gradient_scale * (FEW_SCALE if few else 1.0)
    noise = settings.strength * np.array([statistics.noise_levels, _border_noise(blurred)])
    trust, guarded = (float(t) for t in (unit / noise) ** 2)
    gradients = tiles.gradient_power(deconvolution.size)
    projected = _projected_luma(blurred, deconvolution, settings)
    start = statistics.between_rings_and_level if few else statistics
    ratios = _noise_to_signal(deconvolution, settings, start)
    linear = sharp = deconvolution.blend(deconvolution.solutions(projected, *ratios))
    emptier = _emptier(statistics, deconvolution.size)
    before, scale = sharp, blurred.slopes(1, settings.tile_px, sharp.shape[::-1]) * np.float32(1.0 / unit)
    for step, beta in enumerate(_beta_schedule(settings.iterations)):
        ahead, before = _further_on(sharp, before, step), sharp
        pull = _gradient_targets(ahead, scale, shrinkage_levels(beta))
        pulled = deconvolution.pulled(projected, pull, beta / trust, beta / guarded)
        inner, at_border = (gradients * np.float32(beta / t) + emptier for t in (trust, guarded))
        sharp = deconvolution.blend(deconvolution.solutions(pulled, inner, at_border))
    if settings.iterations > FEW_ITERATIONS:
        sharp += _returned_residual(deconvolution, projected, sharp, statistics)
    if statistics.unevenness:
        share = LINEAR_SHARE * statistics.unevenness
        sharp = cv2.addWeighted(linear, share, sharp, 1 - share, 0.0)
    return deconvolution.with_lamps(sharp)


def _emptier(statistics: PictureStatistics, size: int) -> Image | np.float32:
    """N / S beyond that of the rings: a prior of gradients lets noise through where a grating leaves nothing."""
    if not statistics.unevenness:
        return np.float32(0)
    rings = on_spectrum(statistics, statistics.noise_to_signal, size, by_place=False)
    places = on_spectrum(statistics, statistics.noise_to_signal, size)
    least = np.float32(UNEVEN_NOISE_TO_SIGNAL * statistics.unevenness)
    emptier = cv2.max(cv2.subtract(np.maximum(places, least), rings), 0.0)
    emptier[0, 0] = 0.0
    return emptier


def _further_on(sharp: Image, before: Image, step: int) -> Image:
    """The picture on along its last step, by more as the steps settle: it takes two thirds as many of them.

    Nesterov 1983's momentum, as Beck and Teboulle 2009 (doi:10.1137/080716542) apply it to shrinkage.
    """
    momentum = step / (step + 1)
    return cv2.addWeighted(sharp, 1 + momentum, before, -momentum, 0.0) if momentum else sharp


def _border_noise(blurred: BlurredPicture) -> float:
    """Noise to assume where tiles see beyond the picture, grey levels: what is guessed there is a rough guess.

    A weakly regularised inverse would carry the guess's error many blur lengths inwards.
    """
    statistics = blurred.statistics
    power = np.interp(2.0 / max(blurred.longest_px, 4.0), statistics.frequency, statistics.signal)
    return max(statistics.noise_levels, float(np.sqrt(BORDER_NOISE_TO_SIGNAL * power)))


def _returned_residual(
    deconvolution: tiles.TileDeconvolution, projected: Image, sharp: Image, statistics: PictureStatistics
) -> Image:
    """Fine texture that the prior took for noise: the residual g − K f, filtered as a picture of little power."""
    ratio = on_spectrum(statistics, statistics.noise_to_signal / RESIDUAL_SHARE, deconvolution.size)
    guarded = np.maximum(ratio, BORDER_NOISE_TO_SIGNAL / RESIDUAL_SHARE)
    left = (
        cv2.subtract(back, cv2.multiply(power, spectrum))
        for back, power, spectrum in zip(projected, deconvolution.powers, deconvolution.spectra(sharp), strict=True)
    )
    return deconvolution.blend(deconvolution.solutions(left, ratio, guarded))


def _gradient_targets(sharp: Image, scale: Image, factors: Image) -> Image:
    """Dᵀ w, with w the shrunk gradients; factors: w / v over |v| · 32, as :func:`shrinkage_levels` tabulates it.

    Band by band: what is worked on stays in the cache.
    """
    pull = np.zeros_like(sharp)
    for top in range(0, len(sharp), BAND_ROWS):
        rows = slice(top, top + BAND_ROWS + 1)
        band, steepness, pulled = sharp[rows], scale[rows], pull[rows]
        _pull_along(band[:-1], band[1:], steepness[:-1], factors, pulled[:-1], pulled[1:])
        band, steepness, pulled = (p[top : top + BAND_ROWS] for p in (sharp, scale, pull))
        _pull_along(band[:, :-1], band[:, 1:], steepness[:, :-1], factors, pulled[:, :-1], pulled[:, 1:])
    return pull


def _pull_along(
    behind: Image, ahead: Image, steepness: Image, factors: Image, pull_behind: Image, pull_ahead: Image
) -> None:
    """Add the shrunk gradient between neighbours to the pull on the one ahead, and take it from the one behind."""
    if not len(behind):
        return
    gradient = cv2.subtract(ahead, behind)
    level = cv2.convertScaleAbs(cv2.multiply(gradient, steepness), alpha=LEVELS_PER_UNIT)
    gradient = cv2.multiply(gradient, cv2.LUT(level, factors))
    pull_ahead += gradient
    pull_behind -= gradient


def _beta_schedule(iterations: int, first: float = FIRST_BETA) -> tuple[float, ...]:
    """Rising penalties of the half-quadratic splitting, in units of the gradients' own scale."""
    if iterations <= FEW_ITERATIONS:
        return FEW_BETAS[-max(iterations, 1) :]
    return tuple(float(b) for b in np.geomspace(first, LAST_BETA, iterations))


# ── over the whole picture ───────────────────────────────────────────────────────────────────────────────────────


def _whole_operator(blurred: BlurredPicture, positive: bool = False) -> SpaceVariantBlur:
    height, width = blurred.light[0].shape
    grid: TileGrid = tile_grid(height, width, 96, 32)
    return SpaceVariantBlur(grid, blurred.field(grid.centres_px).arrays(positive=positive))


def _extended(channel: Image, border: int) -> Image:
    return cv2.copyMakeBorder(channel, border, border, border, border, cv2.BORDER_REPLICATE)


def _by_richardson_lucy(blurred: BlurredPicture, settings: RestorationSettings) -> LightOfRows:
    operator = _whole_operator(blurred, positive=True)
    sharp = []
    for light, dark, clipped in zip(blurred.light, blurred.dark, blurred.clipped, strict=True):
        weight = np.ones_like(light) - sum(mask for mask in (dark, clipped) if mask is not None)
        start = _extended(light, operator.border)
        result = richardson_lucy(light, operator.apply, operator.adjoint, start, weight, settings.iterations)
        sharp.append(_inner(result, operator.border))
    return lambda rows: [plane[rows].copy() for plane in sharp]


def _by_global_hyper_laplacian(blurred: BlurredPicture, settings: RestorationSettings) -> LightOfRows:
    """Luma over the whole operator, where censored pixels have no weight; colour as in tiles, all that a movie stores.

    Near clipped light the tiles' solution stays: its lamps were found with light held positive.
    """
    operator, near = _whole_operator(blurred), near_clipped(blurred)
    height, width = blurred.light[0].shape
    statistics, slope = blurred.statistics, blurred.slopes(1, WEIGHED_PX, (width, height))
    uneven = statistics.unevenness
    if uneven:
        in_tiles = _tile_hyper_laplacian(blurred, settings)
        if uneven == 1.0:
            return _with_colour(blurred, in_tiles, settings)
    start = _tile_hyper_laplacian(blurred, replace(settings, iterations=START_ITERATIONS))
    result = hyper_laplacian(
        _luma(blurred.light),
        operator.apply,
        operator.adjoint,
        _extended(start, operator.border),
        _data_weight(slope, blurred),
        _extended(slope, operator.border),
        (settings.strength * statistics.noise_levels) ** -2,
        statistics.gradient_scale,
        _beta_schedule(settings.iterations, SETTLED_BETA),
        settings.inner_iterations,
    )
    sharp = _inner(result, operator.border)
    whole = sharp if near is None else sharp + near * (start - sharp)
    return _with_colour(
        blurred, cv2.addWeighted(in_tiles, uneven, whole, 1 - uneven, 0.0) if uneven else whole, settings
    )


def _data_weight(slope: Image, blurred: BlurredPicture) -> Image:
    """Weight of each pixel's luma: none where any channel is clipped, with its neighbours, or all are too dark."""
    holes, dark = blurred.holes, [mask for mask in blurred.dark if mask is not None]
    if holes is not None:
        slope = slope * (1 - cv2.dilate(holes, np.ones((3, 3), np.uint8)))
    return slope * (1 - np.minimum.reduce(dark)) if len(dark) == len(blurred.dark) else slope


def _inner(picture: Image, border: int) -> Image:
    return picture[border:-border, border:-border]
