"""Stabilisers at which a fit begins: a grid of fractions, cutoffs and travels, compared with tracked points.

A lens that reaches the ends of its travel does not follow a hand's shake most of the time.  Then neither a stabiliser
without ends nor one with a wrong cutoff explains the points, and a fit from there does not reach the right one.  On the
grid a stabiliser moves a point by the difference of its shifts at the point's two times, so thousands cost little.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from virest.arrays import Array
from virest.effects.changes import inverse_travel
from virest.image_formation.point_model import predict
from virest.inference.fit_start import FitStart
from virest.motion.optics import stabiliser_shift
from virest.motion.scene_motion import InertialMotion

CUTOFFS_HZ = np.geomspace(0.05, 12.8, 17)
"""A factor of √2 apart: where the lens reaches an end, fits from twice or half the true cutoff end elsewhere."""
FRACTIONS = (0.15, 0.3, 0.45, 0.6, 0.75, 0.9)
TRAVELS_RAD = np.geomspace(0.004, 0.045, 8)
"""A factor of √2 apart.  Voice coils move a phone's lens by 0.05 to 0.15 mm at focal lengths of 4 to 6 mm."""
GRID_S = 2e-3
"""Step of the shifts' path: at 10 rad/s² linear interpolation errs by 5e-6 rad."""


def stabiliser_starts(start: FitStart) -> Array:
    """Changes (2, k) of the term ``stabilisation`` to the best stabilisers without and with ends of travel.

    They replace the profile's own stabiliser.  Judged by the points' median distance from the prediction; of a motion
    with unknown directions only the rotation is predicted.
    """
    known, table = start.known, start.table
    lens, extensions = known.lens.lens, start.profile.extensions
    at = predict(known, table, start.scene if isinstance(start.scene, InertialMotion) else None)
    both_s, exposure_s = at.poses.both_s, at.poses.both_exposure_s
    left = (table.second_px - at.second_px) / (lens.fx_px, lens.fy_px) + _step(known.lens.shift_at(both_s, exposure_s))
    grid_s = np.arange(known.trajectory.span_s[0], known.trajectory.span_s[1], GRID_S)
    rate = known.trajectory.rate_rad_s(grid_s)
    best: dict[bool, tuple[float, tuple[float, ...]]] = {}
    for cutoff_hz in CUTOFFS_HZ:
        path = stabiliser_shift(grid_s, rate, 1.0, cutoff_hz)
        swing = np.stack([np.interp(both_s, grid_s, path[:, axis]) for axis in (0, 1)], axis=-1)
        for fraction, travel in product(FRACTIONS, (np.inf, *TRAVELS_RAD)):
            off = left - _step(np.clip(fraction * swing, -travel, travel))
            distance = float(np.median((off**2).sum(axis=-1)))
            ends = bool(np.isfinite(travel))
            if ends not in best or distance < best[ends][0]:
                best[ends] = distance, (fraction, cutoff_hz, 1 / travel)
    chosen = np.array([best[ends][1] for ends in (False, True)])
    change = np.zeros((2, 5))
    change[:, 0] = chosen[:, 0] - extensions.stabilisation_fraction
    change[:, 1] = np.log(chosen[:, 1] / extensions.stabilisation_cutoff_hz)
    change[:, 4] = chosen[:, 2] - inverse_travel(start.profile)
    return change


def _step(both: Array) -> Array:
    """Values (n, 2) at the points' second times minus those at their first, from both (2 n, 2)."""
    count = len(both) // 2
    return both[count:] - both[:count]
