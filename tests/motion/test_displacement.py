"""The accelerometer's path compared with paths in closed form, and its dependence on bias and delay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from motion.synthetic_tracks import GRAVITY_M_S2, Recording, Setup, recorded
from scipy.spatial.transform import Rotation

from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.image_formation.point_model import centre
from virest.motion.displacement import Displacement, integrate_accelerometer
from virest.motion.integration import integrate_gyro

SWAYING = Setup(seed=4, sway_m=0.06, velocity_m_s=(0.1, -0.2, 0.15), arm_m=(0.03, -0.05, 0.01), plane_per_m=(0, 0, 0.5))
TIMES_S, ORIGIN_S = np.array([0.213, 0.55, 0.8, 1.131]), np.full(4, 0.62)


def displacement(imu: ImuSamples, profile: CameraProfile) -> Displacement:
    """Integrate; an accelerometer is required."""
    found = integrate_accelerometer(imu, profile, integrate_gyro(imu, profile))
    assert found is not None
    return found


def with_forces(recording: Recording, change: np.ndarray) -> ImuSamples:
    """The recording's samples with changed accelerations."""
    return replace(recording.imu, accel_m_s2=recording.imu.accel_m_s2 + change)


def test_constant_acceleration_of_a_rotating_sensor_gives_a_parabola() -> None:
    """½ a t² is accurate to 1 nm from any origin, for any mounting and uneven sample times."""
    rng = np.random.default_rng(8)
    time_s = -0.3 + np.cumsum(rng.uniform(0.003, 0.007, 400))
    r_cam_imu = Rotation.from_rotvec([0.4, -1.9, 0.7])
    spin, acceleration = np.array([0.9, -0.5, 1.4]), np.array([0.7, -2.0, 9.1])
    turned = Rotation.from_rotvec((time_s - time_s[0])[:, None] * spin)
    force = r_cam_imu.inv().apply(turned.inv().apply(acceleration))
    imu = ImuSamples(time_s, np.tile(r_cam_imu.inv().apply(spin), (400, 1)), force)
    profile = CameraProfile(64, 48, r_cam_imu=tuple(map(tuple, r_cam_imu.as_matrix().tolist())))
    path = displacement(imu, profile)
    moved = path.at(TIMES_S, ORIGIN_S)[0]
    np.testing.assert_allclose(moved, 0.5 * acceleration * ((TIMES_S - ORIGIN_S) ** 2)[:, None], atol=1e-9)
    np.testing.assert_allclose(path.acceleration(TIMES_S), np.tile(acceleration, (4, 1)), atol=1e-7)


def test_the_path_of_a_swaying_hand_follows_from_true_parameters() -> None:
    """Velocity, gravity, bias and lever arm together with the accelerations give the true path within 0.1 mm."""
    recording = recorded(SWAYING)
    scene = recording.scene(recording.table())
    origin_s = float(recording.profile.imu_time_s(recording.table().origin_s)[0])
    time_s = origin_s + np.linspace(-0.5, 0.5, 11)
    path = displacement(recording.imu, recording.profile)
    found = centre(path, scene, np.tile(scene.velocity_m_s[0], (11, 1)), time_s, np.full(11, origin_s))[0]
    truth = recording.position(time_s) - recording.position(np.array([origin_s]))
    assert np.abs(truth).max() > 0.05
    np.testing.assert_allclose(found, recording.in_trajectory_axes(truth), atol=1e-4)


def test_the_bias_derivative_is_the_effect_of_a_bias() -> None:
    """Adding b to every acceleration moves the path by exactly B b."""
    recording = recorded(SWAYING)
    bias = np.array([0.4, -0.9, 0.2])
    plain = displacement(recording.imu, recording.profile).at(TIMES_S, ORIGIN_S)
    biased = displacement(with_forces(recording, bias), recording.profile).at(TIMES_S, ORIGIN_S)
    np.testing.assert_allclose(biased[0] - plain[0], plain[1] @ bias, atol=1e-10)
    assert np.abs(plain[1] @ bias).max() > 0.05


def test_the_delay_derivative_corrects_a_small_delay() -> None:
    """A delay of 2 ms, corrected to first order, leaves less than a tenth of its error."""
    prompt, late = recorded(SWAYING), recorded(replace(SWAYING, accel_delay_s=0.002))
    truth = displacement(prompt.imu, prompt.profile).at(TIMES_S, ORIGIN_S)[0]
    wrong, _, slope = displacement(late.imu, late.profile).at(TIMES_S, ORIGIN_S)
    damage = np.abs(wrong - truth).max()
    assert damage > 1e-3
    assert np.abs(wrong + 0.002 * slope - truth).max() < 0.1 * damage


def test_the_path_starts_at_rest_at_its_origin() -> None:
    """The path and its derivatives are zero at the origin, and the lever arm rotates with the camera."""
    path = displacement(recorded(SWAYING).imu, recorded(SWAYING).profile)
    for part in path.at(np.array([0.62]), np.array([0.62])):
        np.testing.assert_allclose(part, 0, atol=1e-12)
    armless = displacement(recorded(SWAYING).imu, replace(recorded(SWAYING).profile, p_cam_imu_m=(0.0, 0.0, 0.0)))
    shift = path.at(TIMES_S, ORIGIN_S)[0] - armless.at(TIMES_S, ORIGIN_S)[0]
    turned = recorded(SWAYING).orientation(TIMES_S).apply(SWAYING.arm_m)
    start = recorded(SWAYING).orientation(ORIGIN_S).apply(SWAYING.arm_m)
    np.testing.assert_allclose(shift, recorded(SWAYING).in_trajectory_axes(start - turned), atol=1e-6)


@pytest.mark.parametrize(("missing", "bridged"), [(3, True), (30, False)])
def test_few_gaps_are_bridged_and_many_refused(missing: int, bridged: bool) -> None:
    """One row in a hundred without an acceleration does no harm; one in twelve leaves no path."""
    recording = recorded(SWAYING)
    hole = np.zeros((len(recording.imu), 1))
    hole[np.random.default_rng(2).choice(len(hole), missing, replace=False)] = np.nan
    found = integrate_accelerometer(
        with_forces(recording, hole), recording.profile, integrate_gyro(recording.imu, recording.profile)
    )
    assert (found is not None) == bridged
    if found is not None:
        whole = displacement(recording.imu, recording.profile).at(TIMES_S, ORIGIN_S)[0]
        np.testing.assert_allclose(found.at(TIMES_S, ORIGIN_S)[0], whole, atol=1e-3)


def test_a_camera_at_rest_measures_only_gravity() -> None:
    """At rest the specific force is minus gravity."""
    recording = recorded(replace(SWAYING, rate_rad_s=0.0, sway_m=0.0, accel_bias_m_s2=(0.0, 0.0, 0.0)))
    force = displacement(recording.imu, recording.profile).acceleration(TIMES_S)
    np.testing.assert_allclose(force, -np.tile(recording.in_trajectory_axes(GRAVITY_M_S2), (4, 1)), atol=1e-2)
