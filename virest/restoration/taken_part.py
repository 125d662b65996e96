"""How much of a restored picture to take: where it was blurred, and as far as it is to be trusted."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.image_formation.kernels import blur_chords
from virest.image_formation.light import defocus_px, equivalent_length_px
from virest.image_formation.row_motion import RowMotion
from virest.restoration.blurred import BlurredPicture
from virest.restoration.clipped_light import near_clipped
from virest.restoration.statistics.records import PictureStatistics

MIN_GAIN_DB = 0.1
"""A picture of which the measured noise promises less is left alone: the promise is an ideal filter's."""
LEAST_SHARE, FULL_TRUST_DB = 0.7, 1.0
"""Part of a restored picture that is taken where next to nothing is to be gained, and gain from which all of it is."""
SURE_GAIN_DB = 3.0
"""Above this gain the loss of gradients that the noise drowns does not matter."""
PART_STEP_PX = 80
"""Grid spacing of the minimum-blur test."""


def too_little_to_gain(luma: PictureStatistics, expected_db: float) -> str:
    """Why the picture is better left as it was recorded; empty: it is not."""
    if not luma.measured:
        return "picture too small, or its blur too long, for its noise to be measured: left alone"
    if expected_db < MIN_GAIN_DB:
        return f"deblurring is expected to gain only {max(expected_db, 0.0):.2f} dB, left alone"
    return ""


def blurred_part(motion: RowMotion, min_blur_px: float, tile_px: int) -> NDArray[np.float32] | np.float32:
    """0 where the blur path is shorter than ``min_blur_px`` and nothing is to be gained, 1 from twice that on.

    So too where it is shorter than the path changes from a tile's middle to its side, as around the centre of a turn
    about the optical axis: the tile has the kernel of its middle.  tile_px: its side, 0 where kernels go over into each
    other.  (height, width), or one number for all.
    """
    width, height = motion.profile.width, motion.profile.height
    x, y = (np.linspace(0, length - 1, max(2, length // PART_STEP_PX)) for length in (width, height))
    points_px = np.stack(np.meshgrid(x, y), -1)
    chords = blur_chords(motion, points_px)
    length_px = equivalent_length_px(np.linalg.norm(chords, axis=-1), defocus_px(motion.profile, points_px))
    change = np.linalg.norm([np.gradient(chords, x, axis=1), np.gradient(chords, y, axis=0)], axis=(0, -1))
    least_px = np.maximum(min_blur_px, tile_px / 2 * change)
    part = np.clip(length_px / least_px - 1.0, 0.0, 1.0).astype(np.float32)
    if part.min() == 1.0:
        return np.float32(1.0)
    return cv2.resize(part, (width, height), interpolation=cv2.INTER_LINEAR)


def share_map(blurred: BlurredPicture, share: float) -> NDArray[np.float32] | np.float32:
    """How much to take of each pixel: all along the streaks of clipped light, where what is gained is not the texture.

    (height, width), or one number for all.
    """
    near = near_clipped(blurred) if share < 1.0 else None
    return np.float32(share) if near is None else np.float32(share) + np.float32(1.0 - share) * near


def trusted_share(luma: PictureStatistics) -> float:
    """How much of a restored picture to take, the rest being the recorded one.

    Where little can be gained the regularisation's own error weighs as much as the blur; the two differ, so a mean of
    both pictures is better than either.  Under noise about as large as the picture's own gradients (a very coarsely
    coded movie) the prior wipes out texture that the recorded picture has; where much is promised that is little,
    unless nothing stands out of the noise and the promise is empty.
    """
    share = LEAST_SHARE + (1 - LEAST_SHARE) * min(1.0, luma.expected_gain_db / FULL_TRUST_DB)
    sure = min(1.0, luma.expected_gain_db / SURE_GAIN_DB) * min(1.0, luma.gradient_scale / luma.noise_levels)
    return float(share * (1 - luma.drowned * (1 - sure)))
