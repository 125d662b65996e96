"""Velocity, scale and accelerometer errors from tracks in front of a wall, and motions that do not determine them."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from motion.swaying_camera import GRAVITY_M_S2, RUN, Sway, SwayingCamera, turned_aside
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.capture.records import Frame
from virest.inference import visual_inertial
from virest.inference.camera_travel import FrameMotion, Stretch, VisualInertialAlignment
from virest.inference.visual_inertial import align, choose_runs

SWAYS = {
    "portrait": Sway(),
    "short arm": Sway(seed=4, depth_m=1.2, sway_m=0.05, arm_m=(0.03, -0.05, 0.01), normal=(0.3, -0.2, 1.0)),
    "uneven wall": Sway(seed=5, depth_m=2.4, sway_m=0.09, relief_m=0.2, rate_rad_s=0.9),
}


@lru_cache(maxsize=8)
def recorded(setup: Sway) -> SwayingCamera:
    """Make each setup only once."""
    return SwayingCamera(setup)


@lru_cache(maxsize=8)
def aligned(setup: Sway) -> VisualInertialAlignment:
    """The alignment of a setup, made only once."""
    camera = recorded(setup)
    return align(camera.observed, camera.imu, camera.profile)


def trusted(found: VisualInertialAlignment) -> bool:
    """Whether any window's velocity is known in metres."""
    return any(not window.reason for window in found.windows)


def motions(camera: SwayingCamera, found: VisualInertialAlignment) -> list[tuple[float, FrameMotion]]:
    """Motion of every fourth frame that has one."""
    all_of_them = [(s, found.frame(s, s, s + 0.027)) for s in camera.stamp_s[::4]]
    return [(s, motion) for s, motion in all_of_them if isinstance(motion, FrameMotion)]


def velocity_error(camera: SwayingCamera, found: VisualInertialAlignment) -> float:
    """RMS error relative to the RMS of the true velocity."""
    truth = np.array([camera.velocity_cam(s) for s, _ in motions(camera, found)])
    velocity = np.array([motion.velocity_m_s for _, motion in motions(camera, found)])
    return float(np.sqrt(((velocity - truth) ** 2).sum() / (truth**2).sum()))


@pytest.mark.parametrize("name", SWAYS)
def test_velocity_and_depth_are_recovered_within_their_deviations(name: str) -> None:
    """Errors are below 5 %, also for frames between the tracked runs."""
    camera, found = recorded(SWAYS[name]), aligned(SWAYS[name])
    assert trusted(found), found.refused
    seen = motions(camera, found)
    assert len(seen) == len(camera.stamp_s[::4])
    assert velocity_error(camera, found) < 0.05
    std_m_s = found.velocity_std_m_s(np.array([m.reference_s for _, m in seen]))
    deviation = np.array([m.velocity_m_s - camera.velocity_cam(s) for s, m in seen]) / std_m_s
    assert 0.2 < np.sqrt(np.mean(np.square(deviation))) < 1.5
    middle = camera.profile.intrinsics.rays(np.array([239.5, 319.5]))  # type: ignore[union-attr]
    depth = np.array([1 / (camera.plane(s) @ middle) for s, _ in seen])
    np.testing.assert_allclose([m.depth.depth_m for _, m in seen], depth, rtol=0.05)


GROUND = Sway(seed=6, sway_m=0.12, depth_m=-30.0, normal=(0.0, 1.0, -0.05), points=90)
"""A level camera 1.5 m above the ground, whose optical axis ends above the horizon."""


def test_a_level_camera_travels_over_the_ground() -> None:
    """Points on the ground tell the scale; no depth is at the centre."""
    camera, found = recorded(GROUND), aligned(GROUND)
    assert trusted(found), found.refused
    assert velocity_error(camera, found) < 0.08
    seen = motions(camera, found)
    assert np.isinf([m.depth.depth_m for _, m in seen]).any()
    below = camera.profile.intrinsics.rays(np.array([239.5, 600.0]))  # type: ignore[union-attr]
    nearness = [(m.depth.plane_per_m @ below, camera.plane(s) @ below) for s, m in seen]
    np.testing.assert_allclose(*np.transpose(nearness), rtol=0.06)


def test_a_stated_depth_is_that_of_the_points_on_the_ground() -> None:
    """The optical axis has none: the plane stays where the points see it, and the path with it."""
    camera, free = recorded(GROUND), aligned(GROUND).stretches[0]
    depth_m = 1 / float(camera.plane(float(free.table.origin_s[0])) @ free.nearness_rays[0])
    found = align(camera.observed, camera.imu, camera.profile, depth_m)
    assert trusted(found), found.refused
    assert velocity_error(camera, found) < 0.08


def test_the_acceleration_of_a_frame_is_its_mean() -> None:
    """Velocity and acceleration at the reference give the velocity at the frame's end, in the reference's axes."""
    camera, found = recorded(SWAYS["portrait"]), aligned(SWAYS["portrait"])
    for start_s, motion in motions(camera, found):
        end = camera.orientation(start_s + 0.013).inv() * camera.orientation(start_s + 0.04)
        expected = end.apply(camera.velocity_cam(start_s + 0.027))
        np.testing.assert_allclose(motion.velocity_m_s + 0.027 * motion.acceleration_m_s2, expected, atol=0.04)


def scene_stds(stretch: Stretch) -> list[NDArray[np.float64]]:
    """Standard deviations of gravity, the accelerometer's bias and its delay."""
    return np.split(np.sqrt(np.diag(stretch.fit.covariance)[len(stretch.fit.change) :][:7]), [3, 6])


def test_gravity_and_bias_are_determined_together() -> None:
    """Little rotation hardly separates them, as their deviations show; their difference is accurate."""
    camera, found = recorded(SWAYS["portrait"]), aligned(SWAYS["portrait"])
    stretch = found.stretches[0]
    gravity, bias = stretch.scene.gravity_m_s2, stretch.scene.accel_bias_m_s2
    gravity_std, bias_std, _ = scene_stds(stretch)
    start = stretch.fit.integrated.trajectory.time_s[0]
    true_gravity = camera.orientation(start).inv().apply(GRAVITY_M_S2)
    assert np.all(np.abs(gravity - true_gravity) < 4 * gravity_std + 0.05)
    assert np.all(np.abs(bias - camera.setup.accel_bias_m_s2) < 4 * bias_std)
    origin = stretch.origin_s(0)
    to_imu = camera.profile.rotation_cam_imu.T @ stretch.fit.integrated.trajectory.orientation(origin).T
    true_rest = camera.profile.rotation_cam_imu.T @ camera.orientation(origin).inv().apply(-GRAVITY_M_S2)
    np.testing.assert_allclose(to_imu @ -gravity + bias, true_rest + camera.setup.accel_bias_m_s2, atol=0.04)


def test_an_accelerometer_delay_is_found() -> None:
    """The delay is estimated, and the velocity stays accurate."""
    late = replace(SWAYS["portrait"], accel_delay_s=0.005)
    found = aligned(late)
    *_, std_s = scene_stds(found.stretches[0])
    assert found.stretches[0].scene.accel_delay_s == pytest.approx(0.005, abs=max(3 * std_s[0], 5e-4))
    assert velocity_error(recorded(late), found) < 0.05


def test_a_slightly_wrong_profile_is_not_mistaken_for_parallax() -> None:
    """A mounting off by 2° and an offset off by 8 ms are fitted too, and the right offset is reported."""
    camera = recorded(SWAYS["portrait"])
    off = replace(turned_aside(camera.profile, 0.025), time_offset_s=0.005)
    found = align(camera.observed, camera.imu, off)
    assert trusted(found), found.refused
    clock = found.clock()
    assert clock is not None
    assert clock[0] == pytest.approx(0.013, abs=max(3 * clock[1], 3e-4))
    bias = found.gyro_bias()
    assert bias is not None
    np.testing.assert_allclose(bias[0], camera.setup.gyro_bias_rad_s, atol=0.003)
    assert velocity_error(camera, found) < 0.06


STILL = {"sway_m": 0.0, "seed": 6}
STEADY = Sway(**STILL, velocity_m_s=(0.5, -0.2, 0.3))  # type: ignore[arg-type]
REFUSED: dict[str, tuple[Sway, str]] = {
    "still camera": (Sway(**STILL, rate_rad_s=1e-3), "too little parallax"),  # type: ignore[arg-type]
    "pure rotation": (Sway(**STILL), "too little parallax"),  # type: ignore[arg-type]
    "far away": (Sway(depth_m=150.0), "too little parallax"),
    "no accelerometer": (Sway(accelerometer=False), "no accelerometer"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_undetermined_motion_is_refused_with_a_reason(name: str) -> None:
    """No window is trusted, and every frame has the reason instead of a velocity."""
    setup, reason = REFUSED[name]
    found = aligned(setup)
    assert not trusted(found)
    assert reason in found.refused
    said = found.frame(1.0, 1.0, 1.03)
    assert isinstance(said, str)
    assert reason in said
    assert found.clock() is None


@pytest.mark.parametrize("shift", [197, -150])
def test_an_accelerometer_of_another_time_is_refused(shift: int) -> None:
    """Accelerations from elsewhere in the recording determine no scale."""
    camera = recorded(SWAYS["portrait"])
    imu = ImuSamples(camera.imu.time_s, camera.imu.gyro_rad_s, np.roll(camera.imu.accel_m_s2, shift, axis=0))
    found = align(camera.observed, imu, camera.profile)
    assert not trusted(found)
    assert found.refused


def test_steady_translation_is_known_relative_to_depth() -> None:
    """Metres are refused with a reason; velocity over depth and the clock offset are right."""
    camera, found = recorded(STEADY), aligned(STEADY)
    assert not trusted(found)
    assert "scale undetermined" in found.refused
    seen = motions(camera, found)
    assert len(seen) == len(camera.stamp_s[::4])
    assert all("scale undetermined" in motion.unscaled for _, motion in seen)
    ray = np.array([0.1, -0.2, 1.0])
    flow = np.array([motion.velocity_m_s * (motion.depth.plane_per_m @ ray) for _, motion in seen])
    truth = np.array([camera.velocity_cam(s) * (camera.plane(s) @ ray) for s, _ in seen])
    np.testing.assert_allclose(flow, truth, atol=0.05 * np.sqrt(np.mean((truth**2).sum(axis=-1))))
    clock = found.clock()
    assert clock is not None
    assert clock[0] == pytest.approx(STEADY.time_offset_s, abs=3 * clock[1])


def test_slow_sway_is_known_in_metres() -> None:
    """The common uncertainty of IMU rotation, gravity and bias does not count as uncertainty of the velocity."""
    slow = Sway(seed=8, sway_m=0.015, depth_m=0.7, rate_rad_s=0.3)
    found = aligned(slow)
    assert trusted(found), found.refused
    assert velocity_error(recorded(slow), found) < 0.1
    assert all(window.velocity_std < 0.1 for window in found.windows)


def test_an_unrelated_recording_is_refused() -> None:
    """Inertial data of another motion give neither metres nor velocity over depth."""
    camera, other = recorded(SWAYS["portrait"]), recorded(replace(STEADY, seed=11))
    for profile in (camera.profile, replace(camera.profile, time_offset_s=None)):
        found = align(camera.observed, other.imu, profile)
        assert not trusted(found)
        assert isinstance(found.frame(1.0, 1.0, 1.03), str)
        assert found.clock() is None


def test_a_given_depth_determines_the_scale_of_steady_translation() -> None:
    """The velocity is then known without any acceleration."""
    camera = recorded(STEADY)
    found = align(camera.observed, camera.imu, camera.profile, depth_m=1.8)
    assert trusted(found), found.refused
    assert velocity_error(camera, found) < 0.06


def test_without_a_focal_length_or_points_nothing_is_fitted() -> None:
    """A reason is returned and no error is raised."""
    camera = recorded(SWAYS["portrait"])
    blind: CameraProfile = replace(camera.profile, intrinsics=None)
    assert "focal length" in align(camera.observed, camera.imu, blind).refused
    few = camera.observed.chosen(np.arange(len(camera.pairs)) < 3)
    assert "3 pairs" in align(few, camera.imu, camera.profile).refused


def test_long_captures_are_divided_into_stretches_and_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each window has a velocity; a frame far from all points has a reason instead."""
    monkeypatch.setattr(visual_inertial, "STRETCH_S", 4.5)
    camera = recorded(Sway(seed=8, frames=255, points=35, runs=tuple(range(10, 245, 21))))
    found = align(camera.observed, camera.imu, camera.profile)
    assert len(found.stretches) == 2
    assert len(found.windows) >= 3
    assert all(not window.reason for window in found.windows), found.refused
    assert velocity_error(camera, found) < 0.06
    assert isinstance(found.frame(20.0, 20.0, 20.03), str)


# ── selection of frames ──────────────────────────────────────────────────────────────────────────────────────────


def frames(count: int, without: tuple[int, ...] = ()) -> list[Frame]:
    """Frames at 30 per second, some of them unusable."""
    return [Frame(k, k, k / 30, skip_reason="no IMU" if k in without else None) for k in range(count)]


def test_runs_are_unbroken_and_spread_over_the_capture() -> None:
    """From 20 s less than a third is tracked, in runs of consecutive frames less than 1.5 s apart."""
    chosen = choose_runs(frames(600, without=tuple(range(100, 600, 16))))
    assert 150 < len(chosen) < 200
    runs = np.split(np.array(chosen), np.flatnonzero(np.diff(chosen) > 1) + 1)
    assert all(len(run) % RUN == 0 for run in runs)
    assert np.max(np.diff(np.concatenate([[0], chosen, [599]]))) < 45
    assert not set(chosen) & set(range(100, 600, 16))


def test_short_captures_are_tracked_completely() -> None:
    """A capture without a usable frame is not tracked."""
    assert choose_runs(frames(20)) == list(range(20))
    assert choose_runs(frames(3, without=(0, 1, 2))) == []
