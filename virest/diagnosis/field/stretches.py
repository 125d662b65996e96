"""Intervals of the inertial log that do not follow the camera: the frames they affect, and bridges across them.

They are excluded from the ladder, tested with the points inside them, and bridged by rates estimated from these
points.  A bridge is 0 at both ends and smooth in between.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.linalg import block_diag

from virest.arrays import Array, Mask
from virest.camera.field import AXES, Field
from virest.capture.imu import ImuSamples
from virest.diagnosis.field.forms import FieldForm
from virest.inference.doubtful_log import Stretch
from virest.inference.observed_tracks import ObservedTracks

KNOT_STEP_S = 0.015
"""Knot spacing of a bridge.  What a clipped peak lacks starts with a kink between two readings: over the peaks of a
hand at 1 to 2 rad/s, the angle of a spline with this spacing errs by 0.1 mrad in the median and 0.3 mrad at most, about
a tracker's noise; with twice the spacing by 0.3 and 1.4 mrad."""


def touching(observed: ObservedTracks, stretches: Iterable[Stretch], to_imu: tuple[float, float]) -> Mask:
    """Which pairs (pairs,) overlap an interval; to_imu: clock rate and offset from the camera's stamps to the log."""
    rate, offset_s = to_imu
    span = 0.05 + float(observed.exposure_s.max(initial=0.0))
    begin = np.array([observed.stamp_s[pair.first] for pair in observed.pairs]) * rate + offset_s
    end = np.array([observed.stamp_s[pair.second] for pair in observed.pairs]) * rate + offset_s + span
    hit = np.zeros(len(observed.pairs), bool)
    for stretch in stretches:
        hit |= (begin < stretch.to_s) & (end > stretch.from_s)
    return hit


def bridging_form(stretches: Iterable[Stretch], stamp_0_ns: int, walk: Array) -> FieldForm:
    """Rates over time within the intervals, 0 at their ends, on the untrusted axes.

    walk: (3,) rad/s/√s, :func:`rate_walk`.  The prior of a rate is a Brownian bridge between the ends: unobserved parts
    are interpolated linearly, with the standard deviation of the motion of the hand.
    """
    fields, bases = [], []
    for stretch in stretches:
        duration_s = stretch.to_s - stretch.from_s
        inner = max(round(duration_s / KNOT_STEP_S), 1)
        time_s = np.linspace(0.0, duration_s, inner + 2)[1:-1]
        bridge = np.minimum.outer(time_s, time_s) - np.outer(time_s, time_s) / duration_s
        axes = list(stretch.axes)
        knots = tuple(float(t) for t in np.round(np.linspace(stretch.from_s, stretch.to_s, inner + 2), 6))
        fields.append(Field("rate", ("time",), (knots,), ((0.0,) * 3,) * len(knots), (), stamp_0_ns))
        at_knots = np.eye(len(knots))[:, 1:-1] @ np.linalg.cholesky(bridge)
        bases.append(np.kron(at_knots, np.diag(walk)[:, axes]))
    return FieldForm(tuple(fields), block_diag(*bases))


def rate_walk(imu: ImuSamples) -> Array:
    """Random-walk density of each axis' rate (3,) over one KNOT_STEP_S, rad/s/√s: rms over the whole log."""
    time_s = imu.time_s[imu.time_s <= imu.time_s[-1] - KNOT_STEP_S]
    later = np.stack([np.interp(time_s + KNOT_STEP_S, imu.time_s, rate) for rate in imu.gyro_rad_s.T], axis=-1)
    return np.asarray(np.sqrt(np.mean((later - imu.gyro_rad_s[: len(time_s)]) ** 2, axis=0) / KNOT_STEP_S))


def axis_names(stretches: Iterable[Stretch]) -> str:
    """Readable names of the axes of some intervals."""
    axes = sorted({axis for stretch in stretches for axis in stretch.axes})
    return ", ".join(AXES[axis] for axis in axes)
