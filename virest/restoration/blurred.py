"""A recorded picture in linear light, with everything needed to restore it."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.camera.response import ResponseCurve
from virest.image_formation.blur import Image
from virest.image_formation.kernel_spread import KernelSpread
from virest.image_formation.kernels import KernelField
from virest.image_formation.reach import around
from virest.restoration.neighbours.joint import NeighbourPicture
from virest.restoration.statistics.records import LUMA_BLUE, LUMA_GREEN, LUMA_RED, PictureStatistics

CLIPPED_LEVELS = 2.0
"""Pixels within this many grey levels of the top count as clipped."""
PULLED_DOWN_LEVELS = 8.0
"""Next to a clipped pixel, the movie's codec lowers clipped ones by up to about this many grey levels."""
CODEC_REACH_PX = 2.5
"""The movie's codec smears the edge of a clipped highlight about this far."""
SHRUNK_PARTS, LOOKED_AT = 8, 4
"""Neighbourhood means are computed at reduced size, where the side has at least SHRUNK_PARTS pixels, from LOOKED_AT of
the rows behind each reduced pixel."""
SlopeMaker = Callable[[int, int, tuple[int, int]], Image]
"""See :attr:`BlurredPicture.slopes`."""
FieldMaker = Callable[[Array], KernelField]


@dataclass(frozen=True, slots=True)
class BlurredPicture:
    """A recorded picture and everything needed to restore it."""

    light: list[Image]
    """Linear light of each channel, (height, width)."""
    slopes: SlopeMaker
    """Gives the tone curve's local slope, grey levels per unit of light, as a picture.

    Arguments: channel index, side of the neighbourhood in px, (width, height) of the result; see
    :func:`_slopes_around`.
    """
    dark: list[Image | None]
    """1.0 where a channel's light is too dark to be measured; None: nowhere."""
    clipped: list[Image | None]
    """1.0 where a channel's light is clipped; None: nowhere."""
    statistics: PictureStatistics
    """Statistics of the luma."""
    chroma: PictureStatistics
    """Statistics of the colour differences."""
    field: FieldMaker
    """Kernels at given tile centres."""
    longest_px: float
    """Longest blur path in the picture."""
    holes: Image | None
    """1.0 where all channels are clipped, and where any is nearby; None: nowhere; see :func:`_holes`."""
    curve: ResponseCurve
    """Tone curve that encodes light to grey levels."""
    spread: KernelSpread | None = None
    """Uncertainty of the kernels; None: exact."""
    neighbours: tuple[NeighbourPicture, ...] = ()
    """Further measurements of the same sharp luma."""
    kept: Image | None = None
    """Vignetting (height, width) to apply to the restored picture, since ``light`` is without it; None: none."""


def blurred_picture(
    picture: NDArray[np.uint8],
    curve: ResponseCurve,
    statistics: tuple[PictureStatistics, PictureStatistics],
    field: FieldMaker,
    longest_px: float,
) -> BlurredPicture:
    """Linearise a picture (height, width, 3) by the inverse of the tone curve.  statistics: of luma and chroma."""
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

    Grey levels have about the same noise everywhere; in light it is that noise over the slope, so nearly all of it is
    in bright pixels.  A deconvolution that weighs all pixels of a tile equally spreads that noise to dark pixels, where
    their own, steeper slope would show it as detail.
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
    """The curve's slope table; at censored levels, interpolated from their neighbours."""
    levels, known = np.arange(256), ~curve.censored_table()
    return np.interp(levels, levels[known], curve.slope_table()[known]).astype(np.float32)


def _dark(channel: NDArray[np.uint8], curve: ResponseCurve) -> Image | None:
    """1.0 where the channel is below the curve's lower limit A; None: nowhere."""
    table = curve.censored_table() & ~curve.clipped_table()
    return cv2.LUT(channel, table.astype(np.float32)) if table[int(channel.min())] else None


def _clipped(channel: NDArray[np.uint8], curve: ResponseCurve) -> Image | None:
    """1.0 where the channel is clipped, or next to clipped pixels and lowered a little by the codec; None: nowhere."""
    table = curve.clipped_table(CLIPPED_LEVELS)
    if not table[int(channel.max())]:
        return None
    clipped, found = cv2.LUT(channel, table.astype(np.uint8)), np.zeros(channel.shape, np.float32)
    near = around(clipped, 2)
    pulled_down = cv2.LUT(channel[near], curve.clipped_table(PULLED_DOWN_LEVELS).astype(np.uint8))
    found[near] = cv2.dilate(clipped[near], np.ones((5, 5), np.uint8)) & pulled_down
    return found


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
    """1.0 where all channels are clipped, and where any is nearby, so that the light is unknown; None: nowhere.

    A clipped highlight is too bright for all channels, and its rim for some.  Where no pixel nearby has all channels
    clipped it is a saturated colour: the other channels show it, and nearly all of its light was measured.
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
    """Luma of linear light.  It is restored separately from the colour differences, whose noise and detail differ."""
    red, green, blue = light
    return cv2.scaleAdd(blue, LUMA_BLUE, cv2.addWeighted(red, LUMA_RED, green, LUMA_GREEN, 0.0))


def block_means(plane: Image, side: int) -> Image:
    """Means over blocks of ``side`` × ``side`` whole pixels, the last ones smaller.

    Area interpolation with fractional ratios takes twice as long.  OpenCV is fastest with blocks of 2 × 2 pixels, so
    larger even ones are built from these.
    """
    if side == 1:
        return plane
    if side > 2 and side % 2 == 0:
        return block_means(block_means(plane, 2), side // 2)
    height, width = plane.shape
    means = np.empty((-(-height // side), -(-width // side)), np.float32)
    for rows in _blocks(height, side):
        for columns in _blocks(width, side):
            part = means[rows.start // side : -(-rows.stop // side), columns.start // side : -(-columns.stop // side)]
            part[:] = cv2.resize(plane[rows, columns], part.shape[::-1], interpolation=cv2.INTER_AREA)
    return means


def _blocks(length: int, side: int) -> list[slice]:
    """The range of whole blocks, and the range of the rest, if not empty."""
    whole = length - length % side
    return [part for part in (slice(0, whole), slice(whole, length)) if part.stop > part.start]


def with_vignetting(light: Image, blurred: BlurredPicture) -> Image:
    """Light with the restored picture's vignetting applied."""
    if blurred.kept is None:
        return light
    return cv2.multiply(light, cv2.resize(blurred.kept, light.shape[::-1], interpolation=cv2.INTER_AREA))


def reduced(blurred: BlurredPicture, times: float) -> BlurredPicture:
    """The luma of a picture at 1 / times its size, with everything needed to restore it scaled to match; no colour.

    Neighbours are left out.
    """
    height, width = blurred.light[0].shape
    size = (max(round(width / times), 1), max(round(height / times), 1))

    def slopes(channel: int, side_px: int, asked: tuple[int, int]) -> Image:
        return blurred.slopes(channel, round(side_px * times), asked)

    def field(centres_px: Array) -> KernelField:
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
