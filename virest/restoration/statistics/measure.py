"""Measure the noise and signal spectra of a picture: choose tiles, transform them, fit the rings."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Index
from virest.camera.response import ResponseCurve
from virest.capture.pixels import BT601_LUMA
from virest.image_formation.kernels import KernelField
from virest.restoration.statistics.place_fit import place_statistics, unevenness
from virest.restoration.statistics.records import PictureStatistics, unknown_picture
from virest.restoration.statistics.ring_fit import RingCells, fit_rings
from virest.restoration.statistics.rings import SIDE
from virest.restoration.statistics.tile_power import (
    MANY_TILES,
    cut,
    known_part,
    light_in_grey_levels,
    passed_power,
    variance_within,
    white_noise,
    windowed_power,
)

_MAX_CLIPPED = 0.002
"""Use tiles with a larger fraction of clipped pixels only if too few tiles have less."""

STORED_COLOUR_PX = 2
"""Side of the square of pixels that share one colour sample in a 4:2:0 movie.

A sample's error covers the whole square, so the power of the coder's error is the square's area times as high.
"""


def measure_picture(
    picture: NDArray[np.uint8],
    field: KernelField,
    curve: ResponseCurve,
    clipped: NDArray[np.uint8] | None = None,
    most_tiles: int = MANY_TILES,
    coding_step: float | None = None,
    bounds_luma: bool = True,
) -> tuple[PictureStatistics, PictureStatistics]:
    """Fit |G|² = |K|² S + N over tiles at the field's centres, ring by ring.

    picture: (height, width, 3) RGB, or luma (height, width), whose statistics are then returned for the chroma too.
    clipped: (height, width), 1 where light is clipped; such pixels, and those that a blur path reaches from them, are
    left out.  coding_step: the coder's quantiser step, grey levels, which bounds its noise; None: unknown.
    bounds_luma: False if the luma may hold more, such as the error of uncertain kernels.  Returns the statistics of
    luma and of chroma, the latter for both colour differences together.
    """
    corners = _corners(field, picture.shape[:2])
    if not corners or field.radius_px >= SIDE // 2:
        return unknown_picture(), unknown_picture()
    chosen = _least_clipped(clipped, corners, most_tiles)
    kernels = field.chosen(chosen).arrays()
    passed = np.stack([passed_power(kernel) for kernel in kernels])
    real = 0.5 * (1 + passed - np.stack([passed_power(_minus_impulse(kernel)) for kernel in kernels]))
    known = [
        None if clipped is None else known_part(clipped, corners[i], k) for i, k in zip(chosen, kernels, strict=True)
    ]

    parts = [_planes(cut(picture, corners[i])) for i in chosen]

    def observed(plane: int, tiles: Iterable[int]) -> NDArray[np.float32]:
        return np.stack([windowed_power(parts[i][plane], known[i]) for i in tiles])

    tiles = zip(chosen, known, strict=True)
    light = np.stack(
        [
            windowed_power(light_in_grey_levels(_luma_light(cut(picture, corners[i]), curve), curve), seen)
            for i, seen in tiles
        ]
    )
    luma, *red_blue = _planes(_some_rows(picture))
    cells, white_levels, grey = RingCells(passed), white_noise(luma), observed(0, range(len(parts)))
    luma_step = coding_step if bounds_luma else None
    spectra, colour = [(light, cells, white_levels, luma_step), (grey, cells, white_levels, luma_step)], grey
    if red_blue:
        colourful, part_of_picture = _most_colourful(parts)
        colour_step = None if coding_step is None else STORED_COLOUR_PX * coding_step
        colour = (observed(1, colourful) + observed(2, colourful)) * np.float32(0.5)
        spectra.append((colour, RingCells(passed[colourful]), white_noise(red_blue[0]), colour_step))
    of_light, of_luma, *of_chroma = fit_rings(*spectra)
    of_luma = replace(
        of_luma,
        noise_levels=of_light.noise_levels,
        real=_ring_means(cells, real),
        cells=(cells.count, cells.passed),
    )
    weight = unevenness(of_luma, grey, passed)
    if weight:
        of_luma = replace(of_luma, places=place_statistics(of_luma, grey, passed, weight))
    if not of_chroma:
        return of_luma, of_luma
    planes = [plane.astype(np.float32) for i in colourful for plane in parts[i][1:]]
    variance = float(np.mean([variance_within(plane, round(of_chroma[0].period_px)).mean() for plane in planes]))
    samples = len(colourful) * (SIDE / STORED_COLOUR_PX) ** 2
    of_chroma = [
        replace(of_chroma[0].with_signal_variance(variance, samples, of_luma), part_of_picture=part_of_picture)
    ]
    if weight:
        of_chroma = [replace(of_chroma[0], places=place_statistics(of_chroma[0], colour, passed[colourful], weight))]
    return of_luma, of_chroma[0]


def _planes(picture: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], ...]:
    """Luma and both colour differences of a picture (height, width, 3), or a luma (height, width) alone."""
    return (picture,) if picture.ndim == 2 else tuple(cv2.split(cv2.cvtColor(picture, cv2.COLOR_RGB2YCrCb)))


def _most_colourful(parts: Sequence[tuple[NDArray[np.uint8], ...]]) -> tuple[Index, float]:
    """Index, ascending, of the half of the tiles whose colours vary most, and all tiles' mean variance over theirs.

    The others hold little colour, and a filter that is optimal for them would remove the colour of these.
    """
    variances = np.array([sum(float(cv2.meanStdDev(plane)[1][0, 0]) ** 2 for plane in part[1:]) for part in parts])
    chosen = np.sort(np.argsort(variances)[len(parts) // 2 :])
    of_chosen = float(variances[chosen].mean())
    return chosen, float(variances.mean()) / of_chosen if of_chosen else 1.0


def _minus_impulse(kernel: NDArray[np.float32]) -> NDArray[np.float32]:
    """A kernel minus the unit impulse."""
    left = kernel.copy()
    left[kernel.shape[0] // 2, kernel.shape[1] // 2] -= 1
    return left


def _ring_means(cells: RingCells, values: NDArray[np.float32]) -> Array:
    """(RINGS,) mean of values over each ring's cells; ½ in empty rings."""
    count = cells.count.sum(axis=1)
    return np.where(count > 0, (cells.count * cells.means(values)).sum(axis=1) / np.maximum(count, 1), 0.5)


def _some_rows(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Rows 0 to 3 of every 8 of a picture (height, width, ...): enough for :func:`white_noise`, which samples rows."""
    height, width, *channels = picture.shape
    return picture[: height - height % 8].reshape(-1, 8, width, *channels)[:, :4].reshape(-1, width, *channels)


def _luma_light(tile: NDArray[np.uint8], curve: ResponseCurve) -> NDArray[np.float32]:
    """Luma (height, width) of the linear light of a tile, (height, width, 3) or already luma (height, width)."""
    light = cv2.LUT(tile, curve.linear_table())
    if light.ndim == 2:
        return np.asarray(light, np.float32)
    return np.asarray(cv2.transform(light, np.array([BT601_LUMA], np.float32)))


def _least_clipped(clipped: NDArray[np.uint8] | None, corners: list[tuple[int, int]], most_tiles: int) -> Index:
    """Index of at most ``most_tiles`` tiles to measure, evenly spaced among those with the least clipped light."""
    chosen = np.arange(len(corners))
    if clipped is not None:
        parts = np.array([np.count_nonzero(cut(clipped, corner)) for corner in corners]) / SIDE**2
        chosen = np.flatnonzero(parts <= max(_MAX_CLIPPED, float(np.quantile(parts, 0.25))))
    return chosen[:: int(np.ceil(len(chosen) / most_tiles))]


def _corners(field: KernelField, shape: tuple[int, ...]) -> list[tuple[int, int]]:
    """(top, left) of the tile around each centre, moved inside the picture; none if the picture is too small."""
    height, width = shape
    if min(height, width) < SIDE:
        return []
    corners = np.clip(field.centres_px[:, ::-1] - SIDE / 2, 0, (height - SIDE, width - SIDE))
    return [(top, left) for top, left in corners.astype(int).tolist()]
