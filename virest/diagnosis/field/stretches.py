"""Intervals of the inertial log that do not follow the camera: the frames they affect, and bridges across them.

They are excluded from the ladder, tested with the points inside them, and bridged by rates estimated from these
points.  A bridge is 0 at both ends and smooth in between.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from scipy.linalg import block_diag

from virest.arrays import Array, Mask
from virest.camera.field import AXES, Field
from virest.capture.imu import ImuSamples
from virest.diagnosis.field.forms import FieldForm
from virest.inference.doubtful_log import CONTRADICTED, Stretch
from virest.inference.observed_tracks import ObservedTracks

KNOT_STEP_S = 0.015
"""Knot spacing of a bridge.  What a clipped peak lacks starts with a kink between two readings: over the peaks of a
hand at 1 to 2 rad/s, the angle of a spline with this spacing errs by 0.1 mrad in the median and 0.3 mrad at most, about
a tracker's noise; with twice the spacing by 0.3 and 1.4 mrad."""

LEAST_READINGS, MOST_READINGS = 20, 80
"""Trusted readings that tell noise and slope, else all do; most readings, about, on which rates are conditioned."""
LEAST_NOISE_RAD_S = 1e-3
"""Least noise of a reading: 0.06°/s, a step of a 16-bit gyroscope."""


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
            expected, covariance = _given_readings(imu, axis, knots, untrusted)
            if stretch.kind != CONTRADICTED:
                values[1:-1, axis] = (expected - np.interp(knots, imu.time_s, imu.gyro_rad_s[:, axis]))[1:-1]
            root = np.zeros((inner + 2, 3, inner))
            root[1:-1, axis] = np.linalg.cholesky(covariance[1:-1, 1:-1])
            basis.append(root.reshape(-1, inner))
        rows = tuple(map(tuple, values.tolist()))
        fields.append(Field("rate", ("time",), (tuple(knots.tolist()),), rows, (), stamp_0_ns))
        bases.append(np.concatenate(basis, axis=1))
    return FieldForm(tuple(fields), block_diag(*bases))


def _given_readings(imu: ImuSamples, axis: int, time_s: Array, untrusted: Sequence[Stretch]) -> tuple[Array, Array]:
    """Mean (n,) and covariance (n, n) of an axis's rate at some times, given the readings outside untrusted intervals.

    A Matérn process of smoothness 5/2 (Rasmussen and Williams 2006, Gaussian Processes for Machine Learning, eq 4.17)
    with the variance of the log and of its slopes over KNOT_STEP_S.
    """
    rate, outside = imu.gyro_rad_s[:, axis], np.ones(len(imu), bool)
    for stretch in untrusted:
        outside &= (imu.time_s <= stretch.from_s) | (imu.time_s >= stretch.to_s)
    known_s, known = imu.time_s[outside], rate[outside]
    usual_s, usual = (known_s, known) if len(known) >= LEAST_READINGS else (imu.time_s, rate)
    noise = max(float(np.mean(np.diff(usual, 3) ** 2)) / 20, LEAST_NOISE_RAD_S**2)
    slope = max(_slope_variance(usual_s, usual) - 2 * noise / KNOT_STEP_S**2, noise / KNOT_STEP_S**2)
    mean, variance = float(rate.mean()), max(float(rate.var()) - noise, noise)
    length_s = float(np.sqrt(5 / 3 * variance / slope))
    near = np.flatnonzero((known_s > time_s[0] - 2 * length_s) & (known_s < time_s[-1] + 2 * length_s))
    near = near[:: len(near) // MOST_READINGS + 1]
    known_s, known = known_s[near], known[near]

    def covariance(first_s: Array, second_s: Array) -> Array:
        apart = np.sqrt(5.0) * np.abs(first_s[:, None] - second_s) / length_s
        return np.asarray(variance * (1 + apart + apart**2 / 3) * np.exp(-apart))

    across = covariance(time_s, known_s)
    weights = np.linalg.solve(covariance(known_s, known_s) + noise * np.eye(len(known_s)), across.T).T
    left = covariance(time_s, time_s) - weights @ across.T + LEAST_NOISE_RAD_S**2 * np.eye(len(time_s))
    return mean + weights @ (known - mean), left


def _slope_variance(time_s: Array, rate: Array) -> float:
    """Mean square slope, (rad/s²)², of a rate (n,) between readings about KNOT_STEP_S apart."""
    later = np.searchsorted(time_s, time_s + KNOT_STEP_S)
    first = np.flatnonzero(later < len(time_s))
    step_s = time_s[later[first]] - time_s[first]
    near = step_s <= max(2 * KNOT_STEP_S, float(step_s.min()))
    return float(np.mean(((rate[later[first]] - rate[first])[near] / step_s[near]) ** 2))


def axis_names(stretches: Iterable[Stretch]) -> str:
    """Readable names of the axes of some intervals."""
    axes = sorted({axis for stretch in stretches for axis in stretch.axes})
    return ", ".join(AXES[axis] for axis in axes)
