"""Layout of a picture's tiles, and the noise-to-signal ratio assumed for them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import repeat

import cv2
import numpy as np

from virest.arrays import Array
from virest.image_formation.blur import Image
from virest.image_formation.reach import along_paths
from virest.restoration import tiles
from virest.restoration.blurred import CODEC_REACH_PX, BlurredPicture
from virest.restoration.neighbours.joint import NeighbourPicture
from virest.restoration.neighbours.registration import CLIPPED_LIGHT
from virest.restoration.settings import RestorationSettings
from virest.restoration.statistics.on_tiles import on_spectrum, packed, packed_frequency
from virest.restoration.statistics.records import PictureStatistics

Surroundings = tuple[float, int, int]
"""Fraction of the overlap that the margin is reduced by, least margin, px, and least bridge, px."""
FULL_MARGIN, THIN_MARGIN, THINNEST_MARGIN = (0.0, 16, 16), (0.3, 4, 16), (0.3, 3, 12)
"""The margin is as long as the longest blur path, minus the given fraction of the overlap; the bridge is as long as the
path.

A short bridge is a steep edge, whose ringing would reach into the tile.  Where tiles overlap widely, the window's ramp
gives almost no weight to what a margin would keep out.  THINNEST_MARGIN is for pictures at reduced size.
"""
COARSE_OVERLAP, FINE_OVERLAP, WIDE_OVERLAP = 6, 4, 3
"""Tile side over overlap: of colour, of luma, and of luma with few iterations."""
MOST_WRONG, LEAST_TILE, LEAST_TILE_PX, FIELD_SAMPLES = 0.7, 0.7, 48.0, (6, 5)
"""Largest error at edges, in noise standard deviations, by using a tile's kernel half a tile step away; least fraction
of the preset's side that varying paths shrink tiles to; least side, px, that uneven defocus shrinks them to; rows and
columns of the grid on which the kernels' variation is evaluated."""
OVERLAP_GIVE = 0.1
"""Wide overlaps may be narrower by this fraction, if fewer tiles then cover the picture."""
BORDER_NOISE_TO_SIGNAL = 0.003
"""Least N / S of tiles that reach beyond the picture, where its border has no unusual contrast."""
USUAL_CONTRAST = 2.0
"""Contrast (standard deviation) along the border, over the picture's, that parts of a scene reach without a lamp."""
UNEVEN_NOISE_TO_SIGNAL = 0.03
"""Least N / S of a picture whose power lies at few frequencies: errors of the kernel or of a tile's surroundings are
proportional to the power there, and exceed the noise."""


STD_STEP_PX = 0.05
"""Step, px, to which registration deviations are rounded, so that their spectra can be cached."""


def luma_tiles(
    blurred: BlurredPicture, settings: RestorationSettings, around: Surroundings = FULL_MARGIN
) -> tiles.TileDeconvolution:
    """Tiles over the picture's luma, smaller than the preset's where the kernels vary fast."""
    path_side_px, light_side_px = _largest_sides_px(blurred)
    side_px = float(settings.tile_px)
    if around is not FULL_MARGIN:
        side_px = float(np.clip(path_side_px, LEAST_TILE * side_px, side_px))
    side_px = min(side_px, max(light_side_px, LEAST_TILE_PX))
    overlap_parts = FINE_OVERLAP if around is FULL_MARGIN else WIDE_OVERLAP
    return tile_deconvolution(blurred, int(side_px), overlap_parts, around=around)


def _largest_sides_px(blurred: BlurredPicture) -> tuple[float, float]:
    """Largest tile sides, px, for which the centre's kernel is accurate enough: for the paths, and for the light there.

    Half a tile step from the centre, a third of the side, the wrong kernel changes edges by MOST_WRONG noise standard
    deviations.  Paths vary over the picture with camera roll and row time; defocus increases towards the corners, and
    flicker moves the light along the paths from row to row.  With more noise all matter less.
    """
    y, x, paths_px, sigma_px = sampled_kernels(blurred)
    changes = [np.diff(paths_px[:, :, ::4], axis=axis) / (at[1] - at[0]) for axis, at in enumerate((y, x))]
    per_px = np.sqrt(0.5 * sum(np.mean(np.linalg.norm(c, axis=-1).mean(-1)) ** 2 for c in changes))
    softer = np.mean(np.hypot(*np.gradient(sigma_px, y, x)))
    wrong_px = MOST_WRONG * blurred.statistics.noise_levels / blurred.statistics.gradient_scale
    sides_px = (float(3 * wrong_px / max(change, 1e-6)) for change in (per_px, softer, _pulse_change(blurred, y, x)))
    path_side_px, *light_sides_px = sides_px
    return path_side_px, min(light_sides_px)


def _pulse_change(blurred: BlurredPicture, y: Array, x: Array) -> float:
    """How far flicker moves the light along the paths, px per px across the rows: mean over points y × x."""
    points_px = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    field = blurred.field(np.concatenate([points_px, points_px + 1.0]))  # one px further: rows may be columns
    if field.light is None:
        return 0.0
    here, beside = np.split(field.light / field.light.sum(axis=1, keepdims=True), 2)
    ahead = np.abs(np.cumsum(beside - here, axis=1))[:, :-1]
    steps_px = np.linalg.norm(np.diff(field.paths_px[: len(here)], axis=1), axis=-1)
    return float((ahead * steps_px).sum(axis=1).mean())


def sampled_kernels(blurred: BlurredPicture) -> tuple[Array, Array, Array, Array]:
    """Kernels at the middles of equal parts of the picture: the parts' y and x, paths (y, x, m, 2), defocus (y, x).

    All in px.
    """
    y, x = (
        (np.arange(count) + 0.5) * length / count - 0.5
        for count, length in zip(FIELD_SAMPLES, blurred.light[0].shape, strict=True)
    )
    field = blurred.field(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
    sigma_px = np.broadcast_to(field.defocus_sigma_px, len(field.paths_px))
    return y, x, field.paths_px.reshape(len(y), len(x), -1, 2), sigma_px.reshape(len(y), len(x))


def tile_deconvolution(
    blurred: BlurredPicture,
    side: int,
    overlap_parts: int,
    scale: float = 1.0,
    around: Surroundings = FULL_MARGIN,
) -> tiles.TileDeconvolution:
    """Tiles over the picture, or over one ``scale`` times smaller, with kernels scaled to match."""
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
    spread = blurred.spread
    variance = None if spread is None else lambda size: packed(spread.variance(size, 1 / scale))
    return tiles.TileDeconvolution(grid, kernels, max(margin, held), bridge, variance)


def noise_to_signal(
    deconvolution: tiles.TileDeconvolution,
    settings: RestorationSettings,
    statistics: PictureStatistics,
    scale: float = 1.0,
) -> Image:
    """Measured N / S on a tile's packed spectrum, at least :func:`uneven_noise_to_signal`."""
    ratio = measured_noise_to_signal(deconvolution, settings, statistics, scale)
    if statistics.unevenness:
        mean = ratio[0, 0]
        ratio = np.maximum(ratio, np.float32(uneven_noise_to_signal(statistics)))
        ratio[0, 0] = mean
    return ratio


def measured_noise_to_signal(
    deconvolution: tiles.TileDeconvolution,
    settings: RestorationSettings,
    statistics: PictureStatistics,
    scale: float = 1.0,
) -> Image:
    """Measured N / S on a tile's packed spectrum."""
    return on_spectrum(statistics, settings.strength**2 * statistics.noise_to_signal, deconvolution.size, scale)


def uneven_noise_to_signal(statistics: PictureStatistics) -> float:
    """Least N / S of a picture whose power lies at few frequencies."""
    return UNEVEN_NOISE_TO_SIGNAL * statistics.unevenness


def border_noise_to_signal(deconvolution: tiles.TileDeconvolution, light: Image, reach_px: float) -> list[float]:
    """Least N / S of each tile: 0 inside the picture, more where its part of the border varies more than all else does.

    A tile that reaches beyond the picture assumes that the outermost pixels continue.  The error of that guess is
    proportional to the contrast there: where a lamp enters a dark picture, its blur begins within a pixel and never
    ends, and the inverse of the blur carries a comb of dark and bright spots far inwards.  light: (height, width).
    reach_px: how far inwards blur brings what lies outside.
    """
    grid, margin, reach = deconvolution.grid, deconvolution.margin, max(round(reach_px), 4)
    height, width = light.shape
    seen, at_border = [], []
    for top, left in grid.corners():
        rows = slice(max(top - margin, 0), min(top + grid.side + margin, height))
        columns = slice(max(left - margin, 0), min(left + grid.side + margin, width))
        tile = light[rows, columns]
        beyond = (top < margin, top + grid.side > height - margin, left < margin, left + grid.side > width - margin)
        above, below, before, after = (reach * outside for outside in beyond)
        inside = tile[above : len(tile) - below, before : tile.shape[1] - after]
        strips = [tile[:above], tile[len(tile) - below :], tile[:, :before], tile[:, tile.shape[1] - after :]]
        seen.append(_variance(tile))
        at_border.append((_variance(inside), max(map(_variance, strips))) if any(beyond) else None)
    mean, usual = float(np.mean(seen)), USUAL_CONTRAST**2
    return [
        0.0 if found is None else BORDER_NOISE_TO_SIGNAL * max(1.0, found[1] / max(usual * max(mean, found[0]), 1e-12))
        for found in at_border
    ]


def _variance(light: Image) -> float:
    return float(cv2.meanStdDev(light)[1][0, 0]) ** 2 if light.size else 0.0


def in_tiles(ratio: Image, least: Sequence[float], factors: Iterable[float] | None = None) -> Iterator[Image]:
    """N / S of each tile: ``factors`` times the picture's, and at least ``least``.

    factors: None: 1.  A ratio is valid until the next.
    """
    own, mean = np.empty_like(ratio), ratio[0, 0]
    for lowest, factor in zip(least, repeat(1.0) if factors is None else factors, strict=False):
        scaled = ratio if factor == 1.0 else cv2.multiply(ratio, factor, own)
        if lowest:
            scaled = cv2.max(scaled, lowest, own)
            scaled[0, 0] = factor * mean  # the mean is no noise
        yield scaled


def join_neighbours(
    blurred: BlurredPicture,
    deconvolution: tiles.TileDeconvolution,
    own: Sequence[Image],
    channels: Callable[[NeighbourPicture], Sequence[Image]],
    ratio: Image,
    scale: float = 1.0,
    factors: Sequence[float] | None = None,
) -> None:
    """Add the neighbours to the data term of all tiles.

    own: the frame's channels, at the deconvolution's scale.  channels: gives those of a neighbour.  ratio: N / S on a
    tile's packed spectrum, multiplied by each tile's own of the ``factors``; None: by 1.
    """
    if not blurred.neighbours:
        return
    centres_px = (deconvolution.grid.centres_px + 0.5) * scale - 0.5
    size, further = own[0].shape[::-1], []
    for neighbour in blurred.neighbours:
        one = neighbour.registration
        kernels = one.field(centres_px).scaled(1 / scale).arrays()
        stds_px = STD_STEP_PX * np.round(one.std_at_px(centres_px) / STD_STEP_PX)
        kept = [_kept_sharpness(std_px / scale, deconvolution.size) for std_px in stds_px.tolist()]
        trust = cv2.resize(one.trust, size, interpolation=cv2.INTER_LINEAR)
        unknown = _beyond_range(blurred, neighbour)
        if unknown is not None:
            trust[cv2.resize(unknown, size, interpolation=cv2.INTER_AREA) > 0] = 0.0
        variance = None if one.spread is None else packed(one.spread.variance(deconvolution.size, 1 / scale))
        weight = one.coding_noise_ratio
        further.append(tiles.FurtherPicture(channels(neighbour), kernels, kept, trust, weight, variance))
    deconvolution.join(own, further, ratio, factors)


def _beyond_range(blurred: BlurredPicture, neighbour: NeighbourPicture) -> Image | None:
    """1.0 where a neighbour is clipped, and where it shows the frame's clipped highlights, (height, width); or None.

    These were removed from the frame's tiles, but not from the neighbours.
    """
    rim = np.ones((2 * int(np.ceil(CODEC_REACH_PX)) + 1,) * 2, np.uint8)
    clipped = (neighbour.light * np.float32(neighbour.registration.gain) > CLIPPED_LIGHT).astype(np.uint8)
    if blurred.holes is not None:
        shown = along_paths(blurred.holes.astype(np.uint8), neighbour.registration.field, cv2.dilate)
        clipped = cv2.max(clipped, shown)
    return cv2.dilate(clipped, rim).astype(np.float32) if cv2.hasNonZero(clipped) else None


@lru_cache(maxsize=128)
def _kept_sharpness(shift_std_px: float, size: int) -> tuple[Image, Image]:
    """Mean attenuation s by a registration error of this deviation per axis, packed (size, size), and 1 − s²."""
    kept = np.exp(-0.5 * (2 * np.pi * shift_std_px * packed_frequency(size)) ** 2)
    return kept, 1 - kept * kept
