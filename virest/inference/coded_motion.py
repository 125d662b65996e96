"""How far coding draws points to the motion of the blocks above them and to their left.

A coder predicts a block's motion from the blocks that it has coded before, above first, and spends bits on another
motion only where that pays.  Within a fraction of a pixel it does not: a point then steps as the picture does a little
above it.  Where rows are read downwards that is the motion of an earlier moment, so points seem to lag, and where they
are read upwards to lead: in captures of one motion that were coded alike, downwards, upwards, to the right and to the
left, offsets were off by −88, +88, −15 and +23 µs (photographs at 0.1 bit a pixel), and by under 4 where hardly coded.

What is left of it in the decoded picture grows with what the coder drops, and its length depends little on how fast
the picture moves: a block keeps the motion that it was given until that is wrong by a certain length.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from virest.image_formation.point_model import IntegratedMotion, Prediction, TrackTable, predict
from virest.motion.scene_motion import Motion

Array = NDArray[np.float64]
DRAWN_PER_PX = (1.0, 2.5)
"""Usual error of a step that the blocks to the left and above make, over the square of a step's noise, both in px:
``python -m virest.app.bench --only coding`` prints it."""
MOST_PX = 0.06
"""No longer errors were seen, at 0.16 px of noise; more noise than that is not the coder's alone."""
FURTHEST_PX = 16.0
"""Side of a block."""
ALIKE = 1e-4
"""Steps that change less than this from pixel to pixel are not drawn anywhere."""
STEEPEST = 1.0
"""Change of a step per pixel that no motion exceeds: beyond are points that a lens folds back."""


def step_slopes(known: IntegratedMotion, table: TrackTable, scene: Motion | None, at: Prediction) -> Array:
    """Change (2, n, 2) of points' steps per pixel to the right and down, as the model predicts it."""
    found = []
    for way in np.eye(2):
        beside = replace(table, first_px=table.first_px + way, second_px=table.second_px + way)
        found.append(predict(known, beside, scene).second_px - at.second_px - way)
    return np.clip(np.array(found), -STEEPEST, STEEPEST)


def drawn_px(slopes: Array, noise_px: Array) -> Array:
    """Errors (2, n, 2) of steps that slopes (2, n, 2) and the noise of a step (n,) make: of one deviation each."""
    usual = np.sqrt(np.mean((slopes**2).sum(axis=-1), axis=-1))[:, None]
    error_px = np.minimum(np.array(DRAWN_PER_PX)[:, None] * noise_px**2, MOST_PX)
    away_px = np.minimum(error_px / np.maximum(usual, ALIKE), FURTHEST_PX)
    return np.asarray(-away_px[..., None] * slopes)
