"""Bridges over untrusted stretches of the gyroscope log: the rates that the readings around them suggest.

A bridge is a field of the rate over time on the untrusted axes, 0 at both ends, that is added to the log.  The true
rate is a Gaussian process given the trusted readings: it rises beyond a limit at the slope with which it reached it,
and is as uncertain as the motion of the hand makes it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from virest.arrays import Array, Mask
from virest.camera.field import Field
from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.inference.doubtful_log import CONTRADICTED, Stretch, doubtful_stretches
from virest.inference.observed_tracks import ObservedTracks
from virest.inference.untrusted_rates import rates_given_log

KNOT_STEP_S = 0.015
"""Knot spacing of a bridge.  What a clipped peak lacks starts with a kink between two readings: over the peaks of a
hand at 1 to 2 rad/s, the angle of a spline with this spacing errs by 0.1 mrad in the median and 0.3 mrad at most, about
a tracker's noise; with twice the spacing by 0.3 and 1.4 mrad."""


@dataclass(frozen=True, slots=True)
class Bridge:
    """Expected rates in a stretch, and their covariance."""

    field: Field
    """With standard deviations.  Where only the points contradict a log, the expected rate is the log's."""
    root: Array
    """(knots, 3, free) root of the covariance of the knots' values."""


def expected_bridge(imu: ImuSamples, stretch: Stretch, stretches: Sequence[Stretch], stamp_0_ns: int) -> Bridge:
    """The bridge over one of the stretches, given the readings outside all of them."""
    inner = max(round((stretch.to_s - stretch.from_s) / KNOT_STEP_S), 1)
    knots = np.round(np.linspace(stretch.from_s, stretch.to_s, inner + 2), 6)
    values, roots = np.zeros((inner + 2, 3)), []
    for axis in stretch.axes:
        untrusted = [other for other in stretches if axis in other.axes]
        expected, covariance = rates_given_log(imu, axis, knots, untrusted)
        if stretch.kind != CONTRADICTED:
            values[1:-1, axis] = (expected - np.interp(knots, imu.time_s, imu.gyro_rad_s[:, axis]))[1:-1]
        root = np.zeros((inner + 2, 3, inner))
        root[1:-1, axis] = np.linalg.cholesky(covariance[1:-1, 1:-1])
        roots.append(root)
    root = np.concatenate(roots, axis=-1)
    rows, std = (tuple(map(tuple, part.tolist())) for part in (values, np.linalg.norm(root, axis=-1)))
    return Bridge(Field("rate", ("time",), (tuple(knots.tolist()),), rows, std, stamp_0_ns), root)


def with_expected_rates(profile: CameraProfile, imu: ImuSamples, stamp_0_ns: int) -> CameraProfile:
    """The profile with bridges over the stretches where the log itself looks wrong, and that it does not bridge."""
    stretches = doubtful_stretches(imu)
    missing = [s for s in stretches if not profile.bridges(s.from_s, s.to_s)]
    if not missing:
        return profile
    bridges = [expected_bridge(imu, stretch, stretches, stamp_0_ns).field for stretch in missing]
    return profile.with_fields([*profile.fields, *bridges])


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
