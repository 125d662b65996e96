"""Weight of the restored picture in the output: by the local blur, and by the expected gain."""

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
"""Do not deblur a frame with a lower expected gain: the expectation is that of an ideal filter."""
LEAST_CONFIRMED_DB = 0.5
"""Do not deblur a frame with a lower gain according to neighbours: half the predictions are off by more.

Of 1052 frames of 58 simulated captures 79 have a lower prediction.  They gain 0.19 dB on average, and 9 of the 21
frames that lose more than 0.1 dB are among them."""
LEAST_SHARE, FULL_TRUST_DB = 0.7, 1.0
"""Weight of the restored picture at an expected gain of 0 dB, and gain, dB, at which the weight reaches 1."""
LEAST_GAINING_SHARE, CERTAIN_GAIN_DB = 0.5, 2.5
"""The same for the gain expected after restoring, which includes what neighbours confirm.

The share of the change that leaves the least error rises from 0.68 below 1 dB to 0.95 above 2.5 dB, with a deviation of
0.22 between frames.  This weight is slightly less, since less costs little gain and more may harm.  Of 1463 frames of
37 simulated phone captures (``fast``) 5 lose more than 0.1 dB and the worst 0.3 dB, instead of 34 and 1.4 dB, and the
mean gain rises from 1.54 to 1.57 dB.  On 143 frames that follow their profile it falls from 2.96 to 2.94 dB.  At 3 dB 2
frames lose, and those that follow their profile gain 2.91 dB."""
LEAST_JOINED_SHARE = 0.2
"""Instead of LEAST_GAINING_SHARE for a frame restored with neighbours, whose prediction is too high for a short blur.

Of 432 frames of twelve simulated captures (``balanced``) the best share is 0.45 below 1 dB, 0.6 below 1.5 dB, 0.75
below 2 dB and 0.95 above 3 dB.  With LEAST_GAINING_SHARE 10 frames lose more than 0.1 dB, at worst 1.0 dB; with this
share 5, at worst 0.4 dB, and the mean gain is the same."""
CERTAIN_DEVIATIONS = 1.25
"""The weight is in proportion to the expected gain below this many of its deviations.  Of 855 frames of 18 captures
(``balanced``) 4 lose instead of 6, the worst 0.2 instead of 0.6 dB, with the same mean gain; at 2 deviations none, for
0.04 dB less."""
SURE_GAIN_DB = 3.0
"""Above this gain, dB, the loss of gradients that are weaker than the noise does not matter."""
PART_STEP_PX = 80
"""Grid spacing of the minimum-blur test."""


def no_gain_reason(luma: PictureStatistics, expected_db: float, least_db: float = MIN_GAIN_DB) -> str:
    """Why the picture is not deblurred; empty: it is."""
    if not luma.measured:
        return "picture too small, or its blur too long, for its noise to be measured: not deblurred"
    if expected_db < least_db:
        return f"deblurring is expected to gain only {max(expected_db, 0.0):.2f} dB: not deblurred"
    return ""


def blurred_part(motion: RowMotion, min_blur_px: float, tile_px: int) -> NDArray[np.float32] | np.float32:
    """Weight 0 where the blur path is shorter than ``min_blur_px``, rising to 1 at twice that length.

    The limit is larger where the path changes by more than ``min_blur_px`` from a tile's centre to its side, as around
    the centre of rotation about the optical axis: the tile uses its centre's kernel.  tile_px: side of a tile; 0 if
    kernels vary smoothly.  Returns (height, width), or one number for the whole picture.
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
    """Weight of each pixel: ``share``, rising to 1 along the streaks of clipped light, where the gain is not texture.

    (height, width), or one number for the whole picture.
    """
    near = near_clipped(blurred) if share < 1.0 else None
    return np.float32(share) if near is None else np.float32(share) + np.float32(1.0 - share) * near


def trusted_share(luma: PictureStatistics) -> float:
    """Weight of the restored picture in the output, 0 to 1; the rest is the recorded one.

    With little expected gain, the regularisation's error is as large as the blur's.  The two errors differ, so a
    mean of both pictures is better than either.  With noise as large as the picture's gradients (a very coarsely coded
    movie), the prior removes texture that the recorded picture has.  This matters little if the expected gain is large,
    unless the gradients are below the noise, so that the expectation is unreliable.
    """
    share = LEAST_SHARE + (1 - LEAST_SHARE) * min(1.0, luma.expected_gain_db / FULL_TRUST_DB)
    sure = min(1.0, luma.expected_gain_db / SURE_GAIN_DB) * min(1.0, luma.gradient_scale / luma.noise_levels)
    return float(share * (1 - luma.below_noise * (1 - sure)))


def gaining_share(expected_db: float, std_db: float, joined: bool) -> float:
    """Largest weight of the restored picture in the output for a positive expected gain and its deviation.

    joined: whether it is restored with neighbours.
    """
    least = LEAST_JOINED_SHARE if joined else LEAST_GAINING_SHARE
    share = least + (1 - least) * min(1.0, expected_db / CERTAIN_GAIN_DB)
    return min(share, expected_db / max(CERTAIN_DEVIATIONS * std_db, expected_db))
