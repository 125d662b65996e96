"""The bias of tracked points from block motion prediction: points are pulled towards their upper and left neighbours.

An encoder predicts a block's motion from blocks coded before it, mainly above, and spends bits on another motion only
where that pays.  Differences of a fraction of a pixel do not pay: a point then moves like the picture slightly above
it.  With a readout from top to bottom, that is the motion at an earlier time, so points seem to lag; from bottom to top
they seem to lead.  In equally coded captures of the same motion, read down, up, right and left, offsets were off by
−88, +88, −15 and +23 µs (photographs at 0.1 bit per pixel), and by less than 4 µs when hardly compressed.

The residual error in the decoded picture grows with the detail that the encoder drops.  Its length depends little on
the speed of the motion: a block keeps its predicted motion until that is wrong by a certain length.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from virest.image_formation.point_model import IntegratedMotion, Prediction, TrackTable, predict
from virest.motion.scene_motion import Motion

Array = NDArray[np.float64]
DRAWN_PER_PX = (1.0, 2.5)
"""Usual error of a step from the blocks to the left and above, over the square of the step's noise, both in px:
``python -m virest.app.bench --only coding`` prints it."""
MOST_ERROR_PX = 0.06
"""Largest error found, at 0.16 px of noise; noise above that has other causes than the encoder."""
BLOCK_PX = 16.0
"""Side of a block: the largest distance over which motion is predicted."""
LEAST_SLOPE = 1e-4
"""Steps that change less than this per pixel have no bias."""
MOST_SLOPE = 1.0
"""Largest change of a step per pixel; larger values belong to points where the lens model folds back."""


def step_slopes(known: IntegratedMotion, table: TrackTable, scene: Motion | None, at: Prediction) -> Array:
    """Predicted change (2, n, 2) of points' steps per pixel to the right and down."""
    found = []
    for way in np.eye(2):
        beside = replace(table, first_px=table.first_px + way, second_px=table.second_px + way)
        found.append(predict(known, beside, scene).second_px - at.second_px - way)
    return np.clip(np.array(found), -MOST_SLOPE, MOST_SLOPE)


def drawn_px(slopes: Array, noise_px: Array) -> Array:
    """Errors (2, n, 2) of steps, one standard deviation each, from slopes (2, n, 2) and the noise (n,) of a step."""
    usual = np.sqrt(np.mean((slopes**2).sum(axis=-1), axis=-1))[:, None]
    error_px = np.minimum(np.array(DRAWN_PER_PX)[:, None] * noise_px**2, MOST_ERROR_PX)
    away_px = np.minimum(error_px / np.maximum(usual, LEAST_SLOPE), BLOCK_PX)
    return np.asarray(-away_px[..., None] * slopes)
