"""Steps that would do harm according to the frames, where their blur contradicts the profile's exposure time.

A frame has two motions: the predicted one, with the stated exposure, and the observed one, with that which the blur
shows.  The stated one is kept, but a step that the observed motion says would do harm is skipped.
"""

from __future__ import annotations

import numpy as np

from virest.arrays import Array
from virest.image_formation.kernels import blur_chords
from virest.image_formation.row_motion import RowMotion
from virest.image_formation.warp import straightened_points

GRID = 5
"""Grid points in each direction at which two motions are compared."""
MOST_OUTSIDE = 0.25
"""Skip deblurring when more than this fraction of the predicted path lies outside the observed one.  A path that is a
third too long leaves about as much error as it removes."""
MOST_LEFT = 0.75
"""Fraction of the rows' displacement that may remain under the observed motion, which is itself an estimate."""
OTHER_BLUR = "the blur observed in this frame disagrees with the profile: not deblurred"
OTHER_ROWS = "the row displacement observed in this frame disagrees with the profile: not straightened"


def deblurring_harms(predicted: RowMotion, seen: RowMotion) -> bool:
    """Whether more than MOST_OUTSIDE of the predicted blur paths lies outside the observed ones.

    A predicted path that is too short removes less blur than there is, which does no harm.  The part beyond or beside
    the observed path would remove blur that is not there.
    """
    points = _grid_points(predicted)
    chord, true = blur_chords(predicted, points), blur_chords(seen, points)
    along = np.clip((chord * true).sum(-1) / np.maximum((true**2).sum(-1), 1e-12), 0.0, 1.0)
    return _rms(chord - along[:, None] * true) > MOST_OUTSIDE * _rms(chord)


def straightening_harms(predicted: RowMotion, seen: RowMotion, anchor: float) -> bool:
    """Whether straightening would leave points about as far from their observed positions as recorded, or farther."""
    points = _grid_points(predicted)
    true = straightened_points(seen, points, anchor)
    return _rms(straightened_points(predicted, points, anchor) - true) > MOST_LEFT * _rms(points - true)


def _grid_points(motion: RowMotion) -> Array:
    width, height = motion.profile.width, motion.profile.height
    x, y = (np.linspace(0, length - 1, GRID) for length in (width, height))
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)


def _rms(vectors: Array) -> float:
    return float(np.sqrt(np.mean((vectors**2).sum(axis=-1))))
