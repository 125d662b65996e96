"""The bias of tracked points from block motion prediction: points are pulled towards their upper and left neighbours.

An encoder predicts a block's motion from blocks coded before it, mainly above, and spends bits on another motion only
where that pays.  Differences of a fraction of a pixel do not pay: a point then moves like the picture slightly above
it.  With a readout from top to bottom, that is the motion at an earlier time, so points seem to lag; from bottom to top
they seem to lead.  In equally coded captures of the same motion, read down, up, right and left, offsets were off by
−88, +88, −15 and +23 µs (photographs at 0.1 bit per pixel), and by less than 4 µs when hardly compressed.

The residual error in the decoded picture grows with the detail that the encoder drops.  Its length depends little on
the speed of the motion: a block keeps its predicted motion until that is wrong by a certain length.  Differences that
stay in the picture from frame to frame, such as those of a roll, are followed better than those of rows' times.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from virest.image_formation.point_model import IntegratedMotion, Prediction, TrackTable, predict
from virest.image_formation.row_clock import RowClock
from virest.motion.scene_motion import Motion

Array = NDArray[np.float64]
AT_ONCE_PER_PX, BY_ROWS_PER_PX = (0.5, 1.0), (1.2, 2.3)
"""Usual error of a step from the blocks to the left and above, over the square of the step's noise, both in px: where
steps differ at one instant, and where they differ because rows are read at other times.
``python -m virest.app.bench --only coding`` prints both; at one instant as at 0.1 bits per pixel, where the points' own
noise matters least."""
MOST_ERROR_PX = 0.06
"""Largest error found, at 0.16 px of noise; noise above that has other causes than the encoder."""
BLOCK_PX = 16.0
"""Side of a block: the largest distance over which motion is predicted."""
LEAST_SLOPE = 1e-4
"""Steps that change less than this per pixel have no bias."""
MOST_SLOPE = 1.0
"""Largest change of a step per pixel; larger values belong to points where the lens model folds back."""


@dataclass(frozen=True, slots=True)
class StepSlopes:
    """Predicted change of n points' steps per pixel."""

    at_once: Array
    """(2, n, 2) to the right and down, as if all rows were exposed at the same time."""
    by_rows: Array
    """(2, n, 2) what the rows' own times add."""


def step_slopes(known: IntegratedMotion, table: TrackTable, scene: Motion | None, at: Prediction) -> StepSlopes:
    """Predicted change of points' steps per pixel."""
    seen_s, sights = RowClock(known.profile).seen_s, ("first", "second")

    def slope(beside: TrackTable, way: Array) -> Array:
        return np.clip(predict(known, beside, scene).second_px - at.second_px - way, -MOST_SLOPE, MOST_SLOPE)

    at_once, whole = [], []
    for way in np.eye(2):
        points = [getattr(table, f"{sight}_px") + way for sight in sights]
        beside = replace(table, first_px=points[0], second_px=points[1])
        whole.append(slope(beside, way))
        times = [(getattr(table, f"{sight}_stamp_s"), getattr(table, f"{sight}_exposure_s")) for sight in sights]
        later_s = [seen_s(p, *t) - seen_s(p - way, *t) for p, t in zip(points, times, strict=True)]
        if not np.any(later_s):
            at_once.append(whole[-1])
            continue
        stamps = [stamp - later for (stamp, _), later in zip(times, later_s, strict=True)]
        at_once.append(slope(replace(beside, first_stamp_s=stamps[0], second_stamp_s=stamps[1]), way))
    return StepSlopes(np.array(at_once), np.array(whole) - np.array(at_once))


def drawn_px(slopes: StepSlopes, noise_px: Array) -> Array:
    """Errors (4, n, 2) of steps, one standard deviation each: left and above at one instant, then by rows' times.

    noise_px: (n,) of a step.
    """
    usual = np.sqrt(np.mean(((slopes.at_once + slopes.by_rows) ** 2).sum(axis=-1), axis=-1))[:, None]

    def drawn(of: Array, per_px: tuple[float, float]) -> Array:
        error_px = np.minimum(np.array(per_px)[:, None] * noise_px**2, MOST_ERROR_PX)
        away_px = np.minimum(error_px / np.maximum(usual, LEAST_SLOPE), BLOCK_PX)
        return np.asarray(-away_px[..., None] * of)

    return np.concatenate([drawn(slopes.at_once, AT_ONCE_PER_PX), drawn(slopes.by_rows, BY_ROWS_PER_PX)])
