"""Intervals of the inertial log that do not follow the camera: the frames they affect, and bridges across them.

They are excluded from the ladder, tested with the points inside them, and bridged by rates estimated from these
points.  A bridge is 0 at both ends and smooth in between.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from scipy.linalg import block_diag

from virest.arrays import Mask
from virest.camera.field import AXES, Field
from virest.capture.imu import ImuSamples
from virest.diagnosis.field.forms import FieldForm
from virest.inference.doubtful_log import CONTRADICTED, Stretch
from virest.inference.observed_tracks import ObservedTracks
from virest.inference.untrusted_rates import rates_given_log

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


def bridging_form(stretches: Sequence[Stretch], stamp_0_ns: int, imu: ImuSamples) -> FieldForm:
    """Rates over time within the intervals, 0 at their ends, on the untrusted axes.

    The prior of the true rate is a Gaussian process given the trusted readings around the interval: it rises beyond a
    limit at the slope with which it reached it, and is as uncertain as the motion of the hand makes it.  Where only the
    points contradict a log, the expected rate is the log's.
    """
    fields, bases = [], []
    for stretch in stretches:
        inner = max(round((stretch.to_s - stretch.from_s) / KNOT_STEP_S), 1)
        knots = np.round(np.linspace(stretch.from_s, stretch.to_s, inner + 2), 6)
        values, basis = np.zeros((inner + 2, 3)), []
        for axis in stretch.axes:
            untrusted = [other for other in stretches if axis in other.axes]
            expected, covariance = rates_given_log(imu, axis, knots, untrusted)
            if stretch.kind != CONTRADICTED:
                values[1:-1, axis] = (expected - np.interp(knots, imu.time_s, imu.gyro_rad_s[:, axis]))[1:-1]
            root = np.zeros((inner + 2, 3, inner))
            root[1:-1, axis] = np.linalg.cholesky(covariance[1:-1, 1:-1])
            basis.append(root.reshape(-1, inner))
        rows = tuple(map(tuple, values.tolist()))
        fields.append(Field("rate", ("time",), (tuple(knots.tolist()),), rows, (), stamp_0_ns))
        bases.append(np.concatenate(basis, axis=1))
    return FieldForm(tuple(fields), block_diag(*bases))


def axis_names(stretches: Iterable[Stretch]) -> str:
    """Readable names of the axes of some intervals."""
    axes = sorted({axis for stretch in stretches for axis in stretch.axes})
    return ", ".join(AXES[axis] for axis in axes)
