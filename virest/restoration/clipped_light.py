"""Pixels whose light was clipped or too dark to be measured, and the pixels that blur reaches from there."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.image_formation.blur import Image
from virest.image_formation.reach import along_paths, around
from virest.restoration.blurred import CODEC_REACH_PX, BlurredPicture
from virest.restoration.row_chunks import RowRenderer

LEAST_MEASURED, ENOUGH_MEASURED, MEASURED_OVER_PX = 0.35, 0.65, 33
"""Fractions of the unclipped pixels with undisturbed light at which restoring begins and at which it has full weight;
and side, px, of the neighbourhood, which is extended by the path on both sides."""


def near_clipped(blurred: BlurredPicture) -> Image | None:
    """1 where the blur path touches clipped light, falling to 0 over a path's length beyond; None: nothing clipped."""
    holes = blurred.holes
    if holes is None:
        return None
    touched = along_paths(holes.astype(np.uint8), blurred.field, cv2.dilate)
    side = 2 * int(np.ceil(blurred.longest_px / 2 + CODEC_REACH_PX)) + 1
    around = cv2.dilate(touched, np.ones((side, side), np.uint8)).astype(np.float32)
    return cv2.blur(around, (side, side))


def measured_part(holes: Image) -> Image:
    """Weight 0 in holes, rising to 1 around them, since the codec spreads a highlight's edge to its neighbours.

    A sharp edge of the weights would show as an outline around the highlight.
    """
    part = np.ones_like(holes)
    near = around(holes.astype(np.uint8), int(4 * CODEC_REACH_PX) + 3)
    wide = cv2.GaussianBlur(cv2.dilate(holes[near], np.ones((5, 5), np.uint8)), (0, 0), CODEC_REACH_PX)
    part[near] = (1 - holes[near]) * (1 - wide)
    return part


def measured_share(blurred: BlurredPicture) -> Image | None:
    """Weight of the restored picture near clipped light, (height, width); None: 1 everywhere.

    Thin objects on a clipped background lie within the margins of the holes, so almost nothing of them was measured.
    """
    holes = blurred.holes
    if holes is None:
        return None
    side = 2 * int(np.ceil(blurred.longest_px)) + MEASURED_OVER_PX
    measured, left = (cv2.blur(part, (side, side)) for part in (measured_part(holes), 1 - holes))
    share = (measured / np.maximum(left, 1e-3) - LEAST_MEASURED) / (ENOUGH_MEASURED - LEAST_MEASURED)
    return cv2.blur(np.clip(share, 0, 1), (side, side))


def _floor(recorded: NDArray[np.uint8], blurred: BlurredPicture) -> NDArray[np.uint8] | None:
    """Lowest restored levels (height, width, 3): beside clipped light, the lowest recorded ones a path's length around.

    How bright a highlight is, its rim does not say well enough for what lies beside it: errors that darken it show as
    a row of beads.  None: nothing is clipped.
    """
    holes = blurred.holes
    if holes is None:
        return None
    rim = np.ones((2 * int(np.ceil(CODEC_REACH_PX)) + 1,) * 2, np.uint8)
    beside = cv2.dilate(along_paths(holes.astype(np.uint8), blurred.field, cv2.dilate), rim)
    side = 2 * int(np.ceil(blurred.longest_px + CODEC_REACH_PX)) + 1
    near = around(beside, side)
    floor = np.zeros_like(recorded)
    floor[near] = cv2.erode(recorded[near], np.ones((side, side), np.uint8)) * beside[near][..., None]
    return floor


def unmeasured_masks(blurred: BlurredPicture) -> list[NDArray[np.uint8] | None]:
    """1 where a channel is dark, or clipped, all along the blur path around a pixel; None per channel: nowhere."""
    if all(mask is None for mask in (*blurred.dark, *blurred.clipped)):
        return [None] * len(blurred.light)
    masks: list[NDArray[np.uint8] | None] = []
    for pair in zip(blurred.dark, blurred.clipped, strict=True):
        eroded = [along_paths(mask.astype(np.uint8), blurred.field, cv2.erode) for mask in pair if mask is not None]
        mask = np.maximum.reduce(eroded) if eroded else None
        masks.append(mask if mask is not None and cv2.hasNonZero(mask) else None)
    return masks


def keep_unmeasured(sharp: RowRenderer, recorded: NDArray[np.uint8], blurred: BlurredPicture) -> RowRenderer:
    """The restored picture, but with the recorded grey levels (height, width, 3) where nothing was measured.

    These include levels beyond the curve's ends, from noise and the codec, that no light would give.
    """
    masks, floor = unmeasured_masks(blurred), _floor(recorded, blurred)
    if floor is None and all(mask is None for mask in masks):
        return sharp

    def kept(rows: slice) -> Image:
        levels = sharp(rows)
        if floor is not None:
            np.maximum(levels, floor[rows], out=levels)
        for channel, unseen in enumerate(masks):
            if unseen is not None and cv2.hasNonZero(unseen[rows]):
                np.copyto(levels[..., channel], recorded[rows, :, channel], where=unseen[rows] > 0)
        return levels

    return kept
