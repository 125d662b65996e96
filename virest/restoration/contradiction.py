"""Steps that would be a loss by what the pictures say of a profile's clock and blur, where they contradict it.

Two motions of one frame: the predicted one, by the given profile, and the seen one, by the profile as the pictures have
it.  A stated value stays as it is stated; but what it would make worse by the pictures' account is not done.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from virest.image_formation.kernels import blur_chords
from virest.image_formation.row_motion import RowMotion
from virest.image_formation.warp import straightened_points

Array = NDArray[np.float64]

PLACES = 5
"""Places each way at which two motions are compared."""
MOST_FOREIGN = 0.25
"""Skip deblurring when more than this part of the predicted path lies outside the observed one: a path a third as
long again as the
true one leaves about as much error as it takes away."""
MOST_LEFT = 0.75
"""Part of the rows' displacement that straightening may leave by the seen motion, which is an estimate itself."""
OTHER_BLUR = "the pictures put this frame's blur elsewhere than the profile does: not deblurred"
OTHER_ROWS = "the pictures put this frame's rows elsewhere than the profile does: not straightened"


def deblurring_loses(predicted: RowMotion, seen: RowMotion) -> bool:
    """Whether more than MOST_FOREIGN of the predicted paths lies beyond the seen ones.

    A predicted path that is too short takes less blur away than there is, and does no harm; what reaches beyond the
    seen path, or aside of it, is taken away where it is not.
    """
    places = _places(predicted)
    chord, true = blur_chords(predicted, places), blur_chords(seen, places)
    along = np.clip((chord * true).sum(-1) / np.maximum((true**2).sum(-1), 1e-12), 0.0, 1.0)
    return _rms(chord - along[:, None] * true) > MOST_FOREIGN * _rms(chord)


def straightening_loses(predicted: RowMotion, seen: RowMotion, anchor: float) -> bool:
    """Whether points would lie about as far from where the seen motion puts them as they do as recorded, or more."""
    places = _places(predicted)
    true = straightened_points(seen, places, anchor)
    return _rms(straightened_points(predicted, places, anchor) - true) > MOST_LEFT * _rms(places - true)


def _places(motion: RowMotion) -> Array:
    width, height = motion.profile.width, motion.profile.height
    x, y = (np.linspace(0, length - 1, PLACES) for length in (width, height))
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)


def _rms(vectors: Array) -> float:
    return float(np.sqrt(np.mean((vectors**2).sum(axis=-1))))
