"""The bias of tracked points from block motion prediction: points are pulled towards the motion of their neighbours.

An encoder predicts a block's motion from blocks coded before it, mainly above, and spends bits on another motion only
where that pays.  Differences of a fraction of a pixel do not pay: a point then moves like the picture slightly above
it.  With a readout from top to bottom, that is the motion at an earlier time, so points seem to lag; from bottom to top
they seem to lead.  In equally coded captures of the same motion, read down, up, right and left, offsets were off by
−88, +88, −15 and +23 µs (photographs at 0.1 bit per pixel), and by less than 4 µs when hardly compressed.  For the same
reason the flow is flattened: yaw and pitch move the border of a picture further than its centre, and the coded picture
less so, as with a smaller k1.

The residual error in the decoded picture decreases with the square root of the bit rate: at low rates the squared error
of transform coding is inverse to the rate (Mallat & Falzon 1998, doi:10.1109/78.668554).  Detail converts it to a
length as it does the noise of a step, so the bias is a fraction of that noise.  It depends little on the speed of the
motion: a block keeps its predicted motion until that is wrong by a certain length.  Differences that stay in the
picture from frame to frame, such as those of a roll, are followed better than those of rows' times.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from virest.arrays import Array, Index
from virest.image_formation.point_model import IntegratedMotion, Prediction, TrackTable, predict
from virest.image_formation.row_clock import RowClock
from virest.motion.scene_motion import Motion

BITS_PER_PX = 0.1
"""Bit rate of the fractions below."""
MEAN = np.array([0.035, 0.08, 0.04, 0.20, 0.03])
DEVIATION = np.array([0.035, 0.03, 0.07, 0.12, 0.03])
"""Bias of a step as a fraction of its noise: mean, and standard deviation between captures.  Towards the blocks to the
left and above, where steps differ at one instant; the same where they differ because columns or rows are read at other
times; and from the curved part of the flow to its affine part.  ``python -m virest.app.bench --only coding`` prints
them for its captures.  The last is from 12 captures of two simulators at up to 0.6 bits per pixel."""
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
LEAST_CURVED_PX = 1e-3
"""Guard against a division by zero.  A flow is flattened by at most its curvature, here 0.001 px."""


@dataclass(frozen=True, slots=True)
class StepSlopes:
    """Predicted differences between n points' steps: per pixel, and from an affine flow."""

    at_once: Array
    """(2, n, 2) per pixel to the right and down, as if all rows were exposed at the same time."""
    by_rows: Array
    """(2, n, 2) what the rows' own times add."""
    curved_px: Array
    """(n, 2) the steps less the best affine flow of their pair."""


def step_slopes(known: IntegratedMotion, table: TrackTable, scene: Motion | None, at: Prediction) -> StepSlopes:
    """Predicted differences between points' steps."""
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
    curved_px = _beyond_affine(table.first_px, at.second_px - table.first_px, table.pair)
    return StepSlopes(np.array(at_once), np.array(whole) - np.array(at_once), curved_px)


def _beyond_affine(points_px: Array, steps_px: Array, pair: Index) -> Array:
    """Steps (n, 2) less the affine flow that fits those of their pair best."""
    basis = np.concatenate([np.ones((len(pair), 1)), points_px - points_px.mean(axis=0)], axis=-1)
    basis /= np.maximum(np.abs(basis).max(axis=0, initial=0.0), 1e-9)
    products = basis[:, :, None] * np.concatenate([basis, steps_px], axis=-1)[:, None, :]
    sums = np.stack([np.bincount(pair, column) for column in products.reshape(len(pair), -1).T], axis=-1)
    sums = sums.reshape(-1, 3, 5)
    flow = np.linalg.pinv(sums[..., :3], rcond=1e-9, hermitian=True) @ sums[..., 3:]
    return np.asarray(steps_px - np.squeeze(basis[:, None, :] @ flow[pair], 1))


def drawn_px(slopes: StepSlopes, noise_px: Array, bits_per_px: float) -> Array:
    """Errors (5, n, 2) of steps, of the usual size each, in the order of MEAN.  noise_px: (n,) of a step."""
    error_px = USUAL[:, None] * np.minimum(noise_px, MOST_NOISE_PX) * np.sqrt(BITS_PER_PX / bits_per_px)
    steepness = _rms(slopes.at_once + slopes.by_rows)[:, None]
    away_px = np.minimum(error_px[:4].reshape(2, 2, -1) / np.maximum(steepness, LEAST_SLOPE), BLOCK_PX)
    pulled = -away_px[..., None] * np.stack([slopes.at_once, slopes.by_rows])
    flattened = np.minimum(error_px[4] / np.maximum(_rms(slopes.curved_px), LEAST_CURVED_PX), 1.0)
    return np.concatenate([pulled.reshape(4, -1, 2), -(flattened[:, None] * slopes.curved_px)[None]])


def coding_bias_px(known: IntegratedMotion, table: TrackTable, scene: Motion | None) -> Array:
    """Mean error (n, 2) of the tracked second points from the encoder's motion prediction."""
    slopes = step_slopes(known, table, scene, predict(known, table, scene))
    drawn = drawn_px(slopes, table.noise_px[table.pair], table.bits_per_px)
    return np.asarray(np.tensordot(MEAN / USUAL, drawn, axes=1))


def _rms(vectors: Array) -> Array:
    """Root mean square (...) of the lengths of vectors (..., n, 2)."""
    return np.asarray(np.sqrt(np.mean((vectors**2).sum(axis=-1), axis=-1)))
