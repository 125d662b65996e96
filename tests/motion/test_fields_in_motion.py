"""Fields of focal length, rate, delay and blur in the trajectory, the moving lens and the simulator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml

from virest.camera.field import Field
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.camera.profile_file import format_profile, parse_profile
from virest.camera.shutter import Shutter
from virest.capture.imu import ImuSamples
from virest.image_formation.row_clock import RowClock
from virest.image_formation.row_motion import row_motion
from virest.motion.integration import integrate_gyro, missing_rate_rad_s
from virest.motion.optics import moving_lens
from virest.simulation.exposure import make_view
from virest.simulation.hand_motion import random_hand_motion
from virest.simulation.hidden import NOTHING, Hidden, defocused, focal_scale, gyro_reading, late_rows_s

CAMERA = CameraProfile(
    160, 120, intrinsics=Intrinsics(160, 120, 130.0, 130.0, 80.0, 58.0), shutter=Shutter(0.02, "top_to_bottom"),
    time_offset_s=0.0, gyro_bias_rad_s=(0.01, -0.02, 0.03), gyro_scale=(1.02, 0.99, 1.01),
)  # fmt: skip
OUTWARDS = Field(
    "scale",
    ("radius", "time"),
    ((0.0, 50.0, 100.0), (0.0, 1.0)),
    tuple((0.02 * r * t,) for r in (0, 1, 4) for t in (0, 1)),
)
ZOOM = Field("scale", ("time",), ((0.0, 0.5, 1.5),), ((0.0,), (0.01,), (0.03,)))
FIELDS = (
    Field("rate", ("rate_x",), ((-2.0, 0.0, 2.0),), ((-0.2, 0.0, 0.0), (0.0,) * 3, (0.15, 0.0, 0.0))),
    Field("rate", ("accel_z",), ((-20.0, 20.0),), ((-0.1, 0.05, 0.0), (0.1, -0.05, 0.0))),
    Field("rate", ("rate_y", "time"), ((-1.0, 1.0), (0.0, 1.0)), tuple((0.0, y, 0.0) for y in (0, -0.03, 0, 0.03))),
    Field("rate", ("time",), ((0.0, 0.5, 1.0),), ((0.0,) * 3, (0.0, 0.04, -0.03), (0.0,) * 3)),
)  # fmt: skip


def log() -> ImuSamples:
    """One second of rotation and forces."""
    time_s = np.arange(0.0, 1.0, 0.005)
    rate = np.stack([1.7 * np.sin(7 * time_s), 0.6 * np.cos(4 * time_s), 0.4 * np.sin(3 * time_s)], axis=-1)
    force = np.stack([np.sin(5 * time_s), 9.0 + 0.0 * time_s, 3 * np.cos(2 * time_s)], axis=-1)
    return ImuSamples(time_s, rate, force)


def test_a_rate_field_is_added_to_the_trajectory() -> None:
    """The camera's rate is R ((measured − bias) / scale + fields), sample by sample."""
    imu, profile = log(), CAMERA.with_fields(FIELDS)
    added = missing_rate_rad_s(imu, profile)
    assert added is not None
    before, after = (integrate_gyro(imu, p).rate_rad_s(imu.time_s[:-1]) for p in (CAMERA, profile))
    assert after - before == pytest.approx(added[:-1] @ CAMERA.rotation_cam_imu.T, abs=1e-9)
    assert float(np.abs(added).max()) > 0.1


def test_rate_fields_invert_the_simulated_gyroscope() -> None:
    """Simulator and trajectory agree: true rate → reading → true rate."""
    imu, profile = log(), CAMERA.with_fields(FIELDS)
    reading = gyro_reading(profile, imu.time_s, imu.gyro_rad_s, imu.accel_m_s2)
    known = replace(imu, gyro_rad_s=reading)
    true = (reading - np.array(profile.gyro_bias_rad_s)) / np.array(profile.gyro_scale)
    added = missing_rate_rad_s(known, profile)
    assert added is not None
    assert true + added == pytest.approx(imu.gyro_rad_s, abs=1e-6)


@pytest.mark.parametrize("fields", [(ZOOM,), (ZOOM, OUTWARDS)])
def test_a_scale_field_is_the_same_in_lens_and_simulator(fields: tuple[Field, ...]) -> None:
    """Projection inverts rays at any time, and the simulator uses the same rays."""
    imu, profile = log(), CAMERA.with_fields(fields)
    lens = moving_lens(integrate_gyro(imu, profile), profile)
    points = np.array([[10.0, 20.0], [150.0, 111.0]])
    time_s = np.array([0.3, 0.9])
    assert lens.project(lens.rays(points, time_s), time_s) == pytest.approx(points, abs=1e-4)
    assert focal_scale(profile, NOTHING, 0.5, 0.0) == pytest.approx(1.01)
    motion = random_hand_motion(
        np.random.default_rng(1), rate_rms_rad_s=0.5, duration_s=1.0, sway_rms_m=0.0, margin_s=1
    )
    x, y = make_view(profile, motion).rays(0.9, slice(None), slice(None))
    seen = lens.rays(np.array([150.0, 111.0]), np.array(0.9))
    assert (x[111, 150], y[111, 150]) == pytest.approx(tuple(seen[:2]), abs=1e-5)


def test_a_row_delay_is_the_same_in_the_simulator() -> None:
    """The simulator delays each row as the profile does."""
    late = Field("delay", ("row",), ((0.0, 0.5, 1.0),), ((0.0,), (0.003,), (0.001,)))
    profile = CAMERA.with_fields([late])
    fraction = np.arange(120) / 120
    rows = np.stack([np.zeros(120), np.arange(120.0)], axis=-1)
    seen_s = 0.02 * (profile.shutter.readout_fraction(rows, 160, 120) - fraction)
    assert late_rows_s(profile, NOTHING, fraction, 0.0) == pytest.approx(seen_s)


def test_a_delay_over_row_and_time_is_the_same_everywhere() -> None:
    """The clock of points, the motion of a frame and the simulator have the same delay."""
    rows = Field("delay", ("row",), ((0.0, 1.0),), ((0.0,), (0.002,)))
    later = tuple((0.003 * (0.4 + r * r) * t,) for r in (0.0, 0.5, 1.0) for t in (0.0, 1.0))
    profile = CAMERA.with_fields([rows, Field("delay", ("row", "time"), ((0.0, 0.5, 1.0), (0.0, 1.0)), later)])
    points = np.stack([np.zeros(120), np.arange(120.0)], axis=-1)
    fraction, stamp_s = np.arange(120) / 120, 0.6
    even_s = RowClock(CAMERA).seen_s(points, stamp_s, 0.008)
    late_s = RowClock(profile).seen_s(points, stamp_s, 0.008) - even_s
    by_row = 0.4 + np.minimum(1.1 * fraction, 1) ** 2  # the first row is late too
    assert late_s == pytest.approx(0.002 * fraction + 0.0018 * by_row, abs=1e-9)
    motion = row_motion(integrate_gyro(log(), profile), profile, stamp_s, 0.008)
    assert motion.row_time_s(points, 0.5) - even_s == pytest.approx(late_s, abs=2e-5)
    assert late_rows_s(profile, NOTHING, fraction, stamp_s) == pytest.approx(late_s, abs=1e-9)


@pytest.mark.parametrize("covariates", [("row",), ("row", "time")])
def test_the_motion_over_a_frame_reaches_to_its_latest_row(covariates: tuple[str, ...]) -> None:
    """A row may be later than in an even readout by more than a quarter of the readout."""
    knots = ((0.0, 1.0),) * len(covariates)
    values = ((0.0,), (0.014,)) if len(knots) == 1 else ((0.0,), (0.0,), (0.014,), (0.014,))
    profile = CAMERA.with_fields([Field("delay", covariates, knots, values)])
    trajectory = integrate_gyro(log(), profile)
    motion = row_motion(trajectory, profile, 0.3, 0.004)
    ends_s = motion.row_time_s(np.array([[0.0, 119.0]]), 1.0)
    expected = np.swapaxes(trajectory.orientation(ends_s), -1, -2) @ trajectory.orientation(motion.reference_s)
    assert motion.reference_s == pytest.approx(0.3)
    assert motion.pose(ends_s)[0] == pytest.approx(expected, abs=1e-6)


def test_rows_that_start_late_at_long_exposures_do_so_in_a_frame_and_in_the_simulator() -> None:
    """The last row is late by 0 ms at an exposure of 4 ms, 1 ms at 8 ms and 2 ms at 12 ms."""
    values = ((0.0,), (0.0,), (0.0,), (0.002,))
    profile = CAMERA.with_fields([Field("delay", ("row", "exposure"), ((0.0, 1.0), (0.004, 0.012)), values)])
    points = np.stack([np.zeros(120), np.arange(120.0)], axis=-1)
    fraction = np.arange(120) / 120
    for exposure_s, last_s in ((0.003, 0.0), (0.008, 0.001), (0.012, 0.002)):
        even_s = RowClock(CAMERA).seen_s(points, 0.5, exposure_s)
        late_s = RowClock(profile).seen_s(points, 0.5, exposure_s) - even_s
        assert late_s == pytest.approx(last_s * fraction, abs=1e-9)
        motion = row_motion(integrate_gyro(log(), profile), profile, 0.5, exposure_s)
        assert motion.row_time_s(points, 0.5) - even_s == pytest.approx(late_s, abs=2e-5)
        assert late_rows_s(profile, NOTHING, fraction, 0.5, exposure_s) == pytest.approx(late_s, abs=1e-9)
    assert parse_profile(yaml.safe_load(format_profile(profile))).fields == profile.fields


def test_a_simulated_frame_has_the_blur_of_its_field() -> None:
    """A point spreads by the field's deviation at the frame's timestamp; a hidden corner blur affects only corners."""
    blur = Field("blur", ("time",), ((0.0, 1.0),), ((0.0,), (3.0,)), (), 0)
    light = np.zeros((121, 161, 3), np.float32)
    light[[60, 20], [80, 20]] = 1.0
    profile = CAMERA.with_fields([blur])
    assert defocused(profile, NOTHING, light, 0.0) == pytest.approx(light)
    seen = defocused(profile, NOTHING, light, 0.6)[..., 0]
    rows = np.arange(121) - 60
    part = seen[:, 60:101]
    assert np.sqrt((part.sum(axis=1) * rows**2).sum() / part.sum()) == pytest.approx(1.8, rel=0.03)
    cornered = defocused(CAMERA, Hidden(corner_blur_px=3.0), light, 0.0)[..., 0]
    assert cornered[60, 80] > 0.9
    assert cornered[20, 20] < 0.2


def test_a_logged_focal_length_is_that_of_the_frame_on_a_clock_that_runs_fast() -> None:
    """The log is on the camera's clock: offset, skew and a wandering clock lead from there to the IMU's time."""
    logged = Field("scale", ("focus",), ((0.0, 1.0),), ((0.0,), (0.1,)), log=((0.0, 0.4, 0.8), (0.0, 1.0, 0.2)))
    late = Field("delay", ("time",), ((0.0, 1.0),), ((0.03,), (0.0,)))
    profile = replace(CAMERA.with_fields([logged, late]), clock_skew=0.15, time_offset_s=0.02)
    lens = moving_lens(integrate_gyro(log(), profile), profile)
    seen = lens.project(np.array([0.1, 0.2, 1.0]), profile.imu_time_s(0.4))
    assert seen == pytest.approx([80.0 + 13.0 * 1.1, 58.0 + 26.0 * 1.1], abs=1e-9)
