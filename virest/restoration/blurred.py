"""A recorded picture in linear light, with all that restoring it needs to know."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.camera.response import ResponseCurve
from virest.image_formation.blur import Image
from virest.image_formation.kernel_spread import KernelSpread
from virest.image_formation.kernels import KernelField
from virest.restoration.neighbours.joint import NeighbourPicture
from virest.restoration.statistics.records import LUMA_BLUE, LUMA_RED, PictureStatistics

CLIPPED_LEVELS = 2.0
"""A pixel this close to the top was clipped."""
PULLED_DOWN_LEVELS = 8.0
"""Next to a clipped pixel, the movie's codec returns clipped ones up to about this far below the top."""
CODEC_REACH_PX = 2.5
"""A lamp's edge is smeared about so far by the movie's codec."""
SHRUNK_PARTS, LOOKED_AT = 8, 4
"""Neighbourhoods are summed in a picture in which they have this many pixels a side or more; this many of the rows
that fall on such a pixel are read."""
SlopeMaker = Callable[[int, int, tuple[int, int]], Image]
FieldMaker = Callable[[NDArray[np.float64]], KernelField]


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
    curve: ResponseCurve
    """Takes light back to grey levels."""
    spread: KernelSpread | None = None
    """How well the kernels are known; None: as if exactly."""
    neighbours: tuple[NeighbourPicture, ...] = ()
    """Further measurements of the same sharp luma."""
    kept: Image | None = None
    """Vignetting (height, width) that the restored picture has and ``light`` has not; None: none."""


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

    holes = _holes(clipped, longest_px)
    return BlurredPicture(light, slopes, dark, clipped, *statistics, field, longest_px, holes, curve)


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
    clipped, found = cv2.LUT(channel, table.astype(np.uint8)), np.zeros(channel.shape, np.float32)
    near = around(clipped, 2)
    pulled_down = cv2.LUT(channel[near], curve.clipped_table(PULLED_DOWN_LEVELS).astype(np.uint8))
    found[near] = cv2.dilate(clipped[near], np.ones((5, 5), np.uint8)) & pulled_down
    return found


def around(mask: NDArray[np.uint8], reach: int) -> tuple[slice, slice]:
    """Rows and columns of all that is not 0 in a mask (height, width), widened on each side by a margin in pixels."""
    left, top, width, height = cv2.boundingRect(mask)
    return slice(max(top - reach, 0), top + height + reach), slice(max(left - reach, 0), left + width + reach)


def clipped_anywhere(picture: NDArray[np.uint8], curve: ResponseCurve) -> NDArray[np.uint8] | None:
    """1 where any channel of a picture (height, width, 3), or a luma (height, width), is clipped; None: nowhere."""
    table = curve.clipped_table(CLIPPED_LEVELS)
    if not table[int(picture.max())]:
        return None
    brightest = int(np.argmax(table)) - 1
    if picture.ndim == 2:
        return (picture > brightest).view(np.uint8)
    return (cv2.inRange(picture, (0, 0, 0), (brightest,) * 3) == 0).view(np.uint8)


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


def luma_of(light: list[Image]) -> Image:
    """Luma of linear light; it and the colour differences are restored apart: noise and detail differ between them."""
    red, green, blue = light
    return cv2.scaleAdd(blue, LUMA_BLUE, cv2.addWeighted(red, LUMA_RED, green, 1 - LUMA_RED - LUMA_BLUE, 0.0))


def as_kept(light: Image, blurred: BlurredPicture) -> Image:
    """Light as the restored picture has it, with its vignetting."""
    if blurred.kept is None:
        return light
    return cv2.multiply(light, cv2.resize(blurred.kept, light.shape[::-1], interpolation=cv2.INTER_AREA))


def reduced(blurred: BlurredPicture, times: float) -> BlurredPicture:
    """The luma of a picture at 1 / times its size, and all that restoring it needs, to scale; no colour."""
    height, width = blurred.light[0].shape
    size = (max(round(width / times), 1), max(round(height / times), 1))

    def slopes(channel: int, side_px: int, asked: tuple[int, int]) -> Image:
        return blurred.slopes(channel, round(side_px * times), asked)

    def field(centres_px: NDArray[np.float64]) -> KernelField:
        return blurred.field((centres_px + 0.5) * times - 0.5).scaled(1 / times)

    luma, holes = cv2.resize(luma_of(blurred.light), size, interpolation=cv2.INTER_LINEAR), blurred.holes
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
        neighbours=(),
        spread=None if blurred.spread is None else blurred.spread.scaled(1 / times),
    )
