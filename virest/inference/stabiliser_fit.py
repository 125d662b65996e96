"""Stabilisers at which a fit begins, and whether the lens reaches the ends that it found.

The starts are the best of a grid of fractions, cutoffs and travels, compared with tracked points.

A lens that reaches the ends of its travel does not follow a hand's shake most of the time.  Then neither a stabiliser
without ends nor one with a wrong cutoff explains the points, and a fit from there does not reach the right one.  On the
grid a stabiliser moves a point by the difference of its shifts at the point's two times, so thousands cost little.
"""

from __future__ import annotations

import numpy as np

from virest.arrays import Array
from virest.camera.profile import RUNS_ON, STOPS, CameraProfile
from virest.image_formation.point_model import predict
from virest.inference.chance import chi2_tail
from virest.inference.fit_start import FitStart
from virest.inference.profile_terms import STABILISATION
from virest.inference.track_fit import TrackFit
from virest.motion.optics import NO_END_RAD, moving_lens, stabiliser_shift
from virest.motion.scene_motion import InertialMotion

GRID_CUTOFFS_HZ = np.geomspace(0.05, 12.8, 17)
"""A factor of √2 apart: where the lens reaches an end, fits from twice or half the true cutoff end elsewhere."""
FRACTIONS = np.array((0.15, 0.3, 0.45, 0.6, 0.75, 0.9))[:, None, None]
TRAVELS_RAD = np.geomspace(0.004, 0.045, 8)
"""A factor of √2 apart.  Voice coils move a phone's lens by 0.05 to 0.15 mm at focal lengths of 4 to 6 mm."""
STOP_RAD = np.geomspace(0.005, 0.08, 9)
"""Travels over fractions, for filters that stop at the ends."""
INVERSE_TRAVEL = 4
"""Index of 1 / travel among the term's values."""
POINTS = 500
"""Most points that are compared."""
REACHED_P = 1e-5
"""Significance level of a travel that is shorter than the path that the lens would take without ends."""
GRID_S = 4e-3
"""Step of the shifts' path: at 10 rad/s² linear interpolation errs by 2e-5 rad."""


def stabiliser_starts(start: FitStart) -> list[CameraProfile]:
    """The start's profile with the best stabiliser without ends, with ends where its filter runs on, and stops.

    Judged by the points' median distance from the prediction; of a motion with unknown directions only the rotation is
    predicted.
    """
    known, table = start.known, start.table
    table = table.chosen(np.arange(len(table)) % -(-len(table) // POINTS) == 0)
    at = predict(known, table, start.scene if isinstance(start.scene, InertialMotion) else None)
    both_s, lens = at.poses.both_s, known.lens.lens
    own = _step(known.lens.shift_at(both_s, at.poses.both_exposure_s))
    left = (table.second_px - at.second_px) / (lens.fx_px, lens.fy_px) + own
    grid_s = np.arange(known.trajectory.span_s[0], known.trajectory.span_s[1], GRID_S)
    rate = known.trajectory.rate_rad_s(grid_s)
    knot = np.clip(np.searchsorted(grid_s, both_s) - 1, 0, len(grid_s) - 2)
    after = np.clip((both_s - grid_s[knot]) / (grid_s[knot + 1] - grid_s[knot]), 0.0, 1.0)[:, None]
    before = 1.0 - after

    def swing(cutoff_hz: Array | float, stop_rad: Array | float) -> Array:
        """Shifts (..., 2 n, 2) of lenses that cancel all of the shake above cutoffs (...), between ends ± stop_rad."""
        path = stabiliser_shift(grid_s, rate, 1.0, cutoff_hz, travel_rad=stop_rad)
        return before * path[..., knot, :] + after * path[..., knot + 1, :]

    endless, limited, stopping = [], [], []
    free = swing(GRID_CUTOFFS_HZ, NO_END_RAD)
    for cutoff_hz, own_free in zip(GRID_CUTOFFS_HZ.tolist(), free, strict=True):
        path = FRACTIONS * own_free
        endless.append(_best(left, FRACTIONS * _step(own_free), cutoff_hz, None))
        for travel_rad in TRAVELS_RAD:
            clipped = np.minimum(np.maximum(path, -travel_rad), travel_rad)
            limited.append(_best(left, _step(clipped), cutoff_hz, travel_rad))
        for stop_rad, stopped in zip(STOP_RAD, swing(cutoff_hz, STOP_RAD), strict=True):
            travels_rad = FRACTIONS.ravel() * stop_rad
            stopping.append(_best(left, FRACTIONS * _step(stopped), cutoff_hz, travels_rad))
    found = []
    for judged, at_end in ((endless, RUNS_ON), (limited, RUNS_ON), (stopping, STOPS)):
        _, fraction, cutoff_hz, travel_rad = min(judged)
        found.append(
            start.profile.with_extensions(
                stabilisation_fraction=fraction,
                stabilisation_cutoff_hz=cutoff_hz,
                stabilisation_travel_rad=travel_rad,
                stabilisation_at_end=at_end,
                stabilisation_lean_rad=(0.0, 0.0),
            )
        )
    return found


def without_idle_ends(fit: TrackFit) -> CameraProfile | None:
    """The fitted profile without ends of travel, where the lens does not reach them significantly; else None."""
    profile, term = fit.profile, STABILISATION.name
    travel_rad = profile.extensions.stabilisation_travel_rad
    if travel_rad is None or term not in fit.slices:
        return None
    endless = profile.with_extensions(stabilisation_travel_rad=None, stabilisation_lean_rad=(0.0, 0.0))
    shift = moving_lens(fit.integrated.trajectory, endless).shift_at(fit.seconds)
    beyond = float(np.abs(shift).max()) - travel_rad
    std = fit.std(term)[INVERSE_TRAVEL] * travel_rad**2
    return None if beyond > 0 and chi2_tail((beyond / std) ** 2, 1) < REACHED_P else endless


Judged = tuple[float, float, float, float | None]
"""Points' median squared distance; fraction, cutoff (Hz) and travel (rad) of a stabiliser."""


def _best(left: Array, step: Array, cutoff_hz: float, travel_rad: Array | float | None) -> Judged:
    """The best of stabilisers that move points by steps (fractions, n, 2), where the points lie off by ``left``."""
    off = left - step
    distance = np.median(np.einsum("fni,fni->fn", off, off), axis=-1)
    best = int(np.argmin(distance))
    travel = None if travel_rad is None else float(np.broadcast_to(travel_rad, len(distance))[best])
    return float(distance[best]), float(FRACTIONS.ravel()[best]), cutoff_hz, travel


def _step(both: Array) -> Array:
    """Values (..., n, 2) at the points' second times minus those at their first, from both (..., 2 n, 2)."""
    count = both.shape[-2] // 2
    return np.asarray(both[..., count:, :] - both[..., :count, :])
