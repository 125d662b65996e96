"""Changing the time origin or clock of a profile keeps its values at each instant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from virest.camera.field import Field
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile, Extensions
from virest.camera.recounting import counted_from, on_camera_clock
from virest.capture.imu import ImuSamples
from virest.motion.integration import integrate_gyro
from virest.motion.optics import moving_lens

STAMP = 5_000
FIELDS = (
    Field("scale", ("time",), ((0.0, 1.0, 2.0),), ((0.0,), (0.01,), (0.03,)), (), STAMP),
    Field("delay", ("time",), ((0.0, 1.0, 2.0),), ((0.0,), (2e-3,), (-1e-3,)), (), STAMP),
    Field("delay", ("row",), ((0.0, 0.5, 1.0),), ((0.0,), (1e-3,), (0.0,))),
)
PROFILE = CameraProfile(
    640, 480, intrinsics=Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0), time_offset_s=0.02, clock_skew=1e-3,
    extensions=Extensions(focal_drift_per_s=0.01), imu_untrusted_s=((0.5, 0.6),), imu_untrusted_stamp_0_ns=STAMP,
).with_fields(FIELDS)  # fmt: skip
STILL = ImuSamples(np.linspace(-1, 3, 9), np.zeros((9, 3)), np.zeros((9, 3)))
RAY = np.array([0.4, 0.2, 1.0])


def seen_px(profile: CameraProfile, imu_time_s: float) -> np.ndarray:
    """Projection of a ray at an IMU time."""
    return moving_lens(integrate_gyro(STILL, profile), profile).project(RAY, np.array(imu_time_s))


def test_a_profile_counted_from_a_later_timestamp() -> None:
    """Clock, lens and untrusted intervals stay at the same instants and belong to the capture that begins there."""
    later = counted_from(PROFILE, 0.7, 9_000)
    for time_s in (0.8, 1.3, 1.9):
        np.testing.assert_allclose(later.imu_time_s(time_s - 0.7), PROFILE.imu_time_s(time_s) - 0.7, atol=1e-12)
        np.testing.assert_allclose(seen_px(later, time_s - 0.7), seen_px(PROFILE, time_s), atol=1e-6)
    np.testing.assert_allclose(later.imu_untrusted_s, [(-0.2, -0.1)])
    assert {field.stamp_0_ns for field in later.fields} == {9_000, None}
    assert later.imu_untrusted_stamp_0_ns == 9_000


def test_a_profile_on_the_camera_s_clock() -> None:
    """A log on the camera's clock needs no offset, skew or delay, and the lens stays the same."""
    changed = on_camera_clock(PROFILE)
    assert (changed.time_offset_s, changed.clock_skew) == (0.0, 0.0)
    assert [field.covariates for field in changed.fields] == [("row",), ("time",)]
    for time_s in (0.3, 1.1, 1.8):
        imu_s = float(PROFILE.imu_time_s(time_s))
        np.testing.assert_allclose(seen_px(changed, time_s), seen_px(PROFILE, imu_s), atol=0.01)
        np.testing.assert_allclose(changed.imu_time_s(time_s), time_s, atol=1e-12)
    np.testing.assert_allclose(PROFILE.imu_time_s(np.array(changed.imu_untrusted_s)), [(0.5, 0.6)], atol=1e-6)


def test_an_unknown_offset_stays_unknown() -> None:
    """Changing the origin or the clock does not define it."""
    unknown = replace(PROFILE, time_offset_s=None)
    assert on_camera_clock(unknown).time_offset_s is None
    assert counted_from(unknown, 0.5, None).time_offset_s is None
