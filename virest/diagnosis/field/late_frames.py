"""Timestamps that jitter: whether the points of each pair of frames agree on a delay of their own.

A delay for each frame is hundreds of numbers.  Whether they explain the points is tested pair by pair: the delay that
half of a pair's points show must explain the other half.
"""

from __future__ import annotations

import numpy as np

from virest.arrays import Array
from virest.diagnosis.field.design import PointResiduals
from virest.diagnosis.field.forms import FieldForm
from virest.inference.chance import chance_of, sign_tail

GUARD = 1e-12
"""Against a division by zero: points that a delay does not move."""


def late_frames_p(seen: PointResiduals, form: FieldForm) -> float:
    """P value of a delay of the second frame of each pair, by its gain on points that it was not fitted to.

    form: a delay of its own for each frame.  Every other point of a pair is fitted, and the others are judged, and vice
    versa.  Without an effect, held-out gains are negative in the mean, and a third of them is positive.  A t test of
    their mean and a test of their signs against one half share the level: a few large gains limit the former.
    """
    moved = seen.whitening.of(form.moved_by_second(seen.fit.profile, seen.table, seen.moved_by)[..., None])[..., 0]
    half = 2 * seen.table.pair + np.arange(len(seen.table)) % 2
    count = 2 * seen.table.n_pairs
    pull = np.bincount(half, seen.weight * (moved * seen.left).sum(axis=-1), count).reshape(-1, 2)
    curvature = np.bincount(half, seen.weight * (moved**2).sum(axis=-1), count).reshape(-1, 2)
    late: Array = pull / np.maximum(curvature, GUARD)
    gain = (2 * pull * late[:, ::-1] - curvature * late[:, ::-1] ** 2).sum(axis=1)
    return min(2 * min(chance_of(gain), sign_tail(gain)), 1.0)
