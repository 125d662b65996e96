"""Where light was too much or too little to be measured, and what the blur carried from there."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.degradation.blur import Image
from virest.restoration.bands import LevelsOfRows
from virest.restoration.blurred import CODEC_REACH_PX, BlurredPicture

LEAST_MEASURED, ENOUGH_MEASURED, MEASURED_OVER_PX = 0.35, 0.65, 33
"""Part of what is not clipped that lies clear of clipped light, from which on restoring begins, and is all taken;
seen over so many pixels and the path to both sides."""


def near_clipped(blurred: BlurredPicture) -> Image | None:
    """1 where the blur path touches clipped light, falling to 0 over a path's length beyond; None: nothing clipped."""
    holes = blurred.holes
    if holes is None:
        return None
    touched = cv2.dilate(holes.astype(np.uint8), _path_reach(blurred))
    side = 2 * int(np.ceil(blurred.longest_px / 2 + CODEC_REACH_PX)) + 1
    around = cv2.dilate(touched, np.ones((side, side), np.uint8)).astype(np.float32)
    return cv2.blur(around, (side, side))


def measured_part(holes: Image) -> Image:
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
    measured, left = (cv2.blur(part, (side, side)) for part in (measured_part(holes), 1 - holes))
    share = (measured / np.maximum(left, 1e-3) - LEAST_MEASURED) / (ENOUGH_MEASURED - LEAST_MEASURED)
    return cv2.blur(np.clip(share, 0, 1), (side, side))


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


def unseen_kept(sharp: LevelsOfRows, recorded: NDArray[np.uint8], blurred: BlurredPicture) -> LevelsOfRows:
    """The grey levels (height, width, 3) that were recorded where nothing says more.

    Among them are some that no light gives, as noise and codec leave them beyond the curve's ends.
    """
    masks = unseen_masks(blurred)
    if all(mask is None for mask in masks):
        return sharp

    def kept(rows: slice) -> Image:
        levels = sharp(rows)
        for channel, unseen in enumerate(masks):
            if unseen is not None:
                np.copyto(levels[..., channel], recorded[rows, :, channel], where=unseen[rows] > 0)
        return levels

    return kept


def _path_reach(blurred: BlurredPicture) -> NDArray[np.uint8]:
    """The blur path at the picture's middle, to both sides, as a structuring element."""
    height, width = blurred.light[0].shape
    path = blurred.field(np.array([[(width - 1) / 2, (height - 1) / 2]])).arrays(positive=True)[0]
    return (path + path[::-1, ::-1] > 2e-3).astype(np.uint8)
