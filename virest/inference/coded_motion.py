"""The bias of tracked points from block motion prediction: coded points are pulled towards their neighbours.

An encoder predicts a block's motion from blocks coded before it, mainly above, and spends bits on another motion only
where that pays.  Differences of a fraction of a pixel do not pay: the block then moves like the picture at a distance d
above it, and lies off by ε = -(d . ∇) s, s being the step from the frame before.  The encoder sees that error in its
own decoded picture and predicts the next frame from there, so errors do not add up: a frame is off by its own ε, and
the tracked step from one frame to the next by

    ε(k) - ε(k - 1) = -(d . ∇) (s(k) - s(k - 1)).

A steady rotation thus has no bias.  Where rows are read at other times, a changing motion differs from row to row:
points seem to lag if read from top to bottom, and to lead from bottom to top.  Pitch moves a picture's border further
than its centre: while its rate changes, the bottom of the picture seems to lag behind its top, by 9 and 15 µs at 0.5
and 0.2 bits per pixel, whatever the readout (``bench --only coding``).

The residual error in the decoded picture decreases with the square root of the bit rate: at low rates the squared error
of transform coding is inverse to the rate (Mallat & Falzon 1998, doi:10.1109/78.668554).  Detail converts it to a
length as it does the noise of a step, so the bias is a fraction of that noise.  It depends little on the speed of the
motion: a block keeps its predicted motion until that is wrong by a certain length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from virest.arrays import Array
from virest.image_formation.point_model import IntegratedMotion, Prediction, TrackTable, predict
from virest.motion.scene_motion import Motion

BITS_PER_PX = 0.1
"""Bit rate of the fractions below."""
MEAN = np.array([0.02, 0.105, -0.005, 0.01])
DEVIATION = np.array([0.03, 0.06, 0.02, 0.03])
"""Bias of a step as a fraction of its noise: mean, and standard deviation between captures.  Towards the blocks to the
left and above, where steps differ otherwise than in the frame before, and where steps differ lastingly, which hardly
matters.  ``python -m virest.app.bench --only coding`` prints them for its captures."""
USUAL = np.hypot(MEAN, DEVIATION)
"""Root mean square of the fractions."""
MOST_NOISE_PX = 0.16
"""Largest noise at which the encoder's errors were measured; noise above that has other causes, mostly blur."""
BLOCK_PX = 16.0
"""Side of a block: the largest distance over which motion is predicted."""
LEAST_SLOPE = 1e-4
"""Steps that change less than this per pixel have no bias."""
MOST_SLOPE = 1.0
"""Largest change of a step per pixel; larger values belong to points where the lens model folds back."""


@dataclass(frozen=True, slots=True)
class StepSlopes:
    """Predicted differences (2, n, 2) between n points' steps, per pixel to the right and down."""

    changed: Array
    """Less those of the steps from the frame before."""
    lasting: Array
    """Of the steps themselves."""


def step_slopes(known: IntegratedMotion, table: TrackTable, scene: Motion | None, at: Prediction) -> StepSlopes:
    """Predicted differences between points' steps; at: the table's prediction."""
    period_s = table.second_stamp_s - table.first_stamp_s
    before = replace(
        table, first_stamp_s=table.first_stamp_s - period_s, second_stamp_s=table.second_stamp_s - period_s
    )
    now = _slopes(known, table, scene, at)
    return StepSlopes(now - _slopes(known, before, scene, predict(known, before, scene)), now)


def _slopes(known: IntegratedMotion, table: TrackTable, scene: Motion | None, at: Prediction) -> Array:
    beside = [replace(table, first_px=table.first_px + way, second_px=table.second_px + way) for way in np.eye(2)]
    steps = [predict(known, one, scene).second_px - way for one, way in zip(beside, np.eye(2), strict=True)]
    return np.clip(np.array(steps) - at.second_px, -MOST_SLOPE, MOST_SLOPE)


def drawn_px(slopes: StepSlopes, noise_px: Array, bits_per_px: float) -> Array:
    """Errors (4, n, 2) of steps, of the usual size each, in the order of MEAN.  noise_px: (n,) of a step."""
    error_px = USUAL[:, None] * np.minimum(noise_px, MOST_NOISE_PX) * np.sqrt(BITS_PER_PX / bits_per_px)
    ways = np.concatenate([slopes.changed, slopes.lasting])
    away_px = np.minimum(error_px / np.maximum(_rms(ways)[:, None], LEAST_SLOPE), BLOCK_PX)
    return np.asarray(-away_px[..., None] * ways)


def coding_bias_px(known: IntegratedMotion, table: TrackTable, scene: Motion | None) -> Array:
    """Mean error (n, 2) of the tracked second points from the encoder's motion prediction."""
    slopes = step_slopes(known, table, scene, predict(known, table, scene))
    drawn = drawn_px(slopes, table.noise_px[table.pair], table.bits_per_px)
    return np.asarray(np.tensordot(MEAN / USUAL, drawn, axes=1))


def _rms(vectors: Array) -> Array:
    """Root mean square (...) of the lengths of vectors (..., n, 2)."""
    return np.asarray(np.sqrt(np.mean((vectors**2).sum(axis=-1), axis=-1)))
