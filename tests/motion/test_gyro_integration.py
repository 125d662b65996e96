"""Integration of angular rates compared with a brute-force product of small rotations."""

from __future__ import annotations

import numpy as np
import pytest
from motion.synthetic_motion import R_CAM_IMU, Motion
from scipy.spatial.transform import Rotation

from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.errors import ImuError
from virest.motion.integration import integrate_gyro
from virest.motion.measured_rate import measured_rate
from virest.motion.trajectory import rotation_from_vector

MOTION = Motion(
    amplitude_rad_s=np.array([[0.8, -0.3, 0.5], [0.2, 0.6, -0.4]]),
    frequency_hz=np.array([[1.3, 2.1, 0.7], [4.0, 3.1, 5.2]]),
    phase_rad=np.array([[0.2, 1.4, -0.9], [2.5, -0.3, 0.8]]),
    pan_rad_s=(0.3, -0.2, 0.1),
)
PROFILE = CameraProfile(64, 48, r_cam_imu=R_CAM_IMU, gyro_bias_rad_s=(0.01, -0.02, 0.03), gyro_scale=(1.02, 0.97, 1.01))


def recorded(time_s: np.ndarray) -> ImuSamples:
    """Readings of PROFILE's gyroscope for MOTION: scale × true + bias, IMU axes."""
    true_imu = MOTION.rate(time_s) @ np.array(R_CAM_IMU)
    gyro = true_imu * PROFILE.gyro_scale + PROFILE.gyro_bias_rad_s
    return ImuSamples(time_s, gyro, np.full_like(gyro, np.nan))


def angle_between(matrices: np.ndarray, truth: Rotation) -> float:
    """Largest angle in rad between rotations, relative to the first time."""
    own = Rotation.from_matrix(matrices)
    return float(((own[0].inv() * own).inv() * (truth[0].inv() * truth)).magnitude().max())


@pytest.mark.parametrize("jitter_s", [0.0, 4e-4])
def test_partial_intervals_are_integrated_accurately(jitter_s: float) -> None:
    """Between any two instants, on samples or not, the rotation is accurate to 1e-6 rad at 400 Hz."""
    rng = np.random.default_rng(7)
    time_s = np.arange(-0.1, 1.1, 1 / 400)
    imu = recorded(time_s + rng.uniform(-jitter_s, jitter_s, len(time_s)))
    query_s = np.sort(rng.uniform(0.0, 1.0, 60))
    truth = MOTION.orientation(-0.05, 1.05)(query_s)
    assert angle_between(integrate_gyro(imu, PROFILE).orientation(query_s), truth) < 1e-6


def test_the_rate_matches_the_analytic_rate() -> None:
    """Bias, scale and axes are corrected, also between samples."""
    imu = recorded(np.arange(0, 1, 1 / 400))
    trajectory = integrate_gyro(imu, PROFILE)
    np.testing.assert_allclose(trajectory.rate_rad_s(imu.time_s), MOTION.rate(imu.time_s), atol=1e-12)
    between_s = np.array([0.1234, 0.5678])
    np.testing.assert_allclose(trajectory.rate_rad_s(between_s), MOTION.rate(between_s), atol=2e-5)


@pytest.mark.parametrize("samples", [2, 3, 4, 5, 8, 9, 64, 157])
def test_steps_are_multiplied_in_order(samples: int) -> None:
    """Rotations at the samples equal the product of single steps, for odd and even counts."""
    imu = recorded(np.arange(samples) * 0.02)
    found = integrate_gyro(imu, PROFILE, measured_rate(imu))
    a, b, c, d = np.swapaxes(found.rate_polynomials, 1, 2) * np.array([1 / 4, 1 / 3, 1 / 2, 1.0])[:, None, None]
    step = 0.02
    turn = np.eye(3)
    for k in range(samples - 1):
        start, end = found.rate_rad_s(imu.time_s[k]), found.rate_rad_s(imu.time_s[k + 1])
        angle = step * (d[k] + step * (c[k] + step * (b[k] + step * a[k])))
        turn = turn @ rotation_from_vector(angle + step**2 / 12 * np.cross(start, end))
        np.testing.assert_allclose(found.rotation_world_cam[k + 1], turn, atol=1e-12)


def test_a_gap_is_bridged_by_a_straight_line() -> None:
    """Across a gap in the samples the rate is linear without oscillation, and integration stays accurate after it."""
    time_s = np.concatenate([np.arange(0, 0.4, 0.005), np.arange(0.5, 1, 0.005)])
    imu = recorded(time_s)
    trajectory = integrate_gyro(imu, PROFILE)
    before, after = MOTION.rate(time_s[79:81])
    np.testing.assert_allclose(
        trajectory.rate_rad_s(0.5 * (time_s[79] + time_s[80])), 0.5 * (before + after), atol=1e-9
    )
    query_s = np.linspace(0.55, 0.95, 20)
    assert angle_between(trajectory.orientation(query_s), MOTION.orientation(0.5, 1.0)(query_s)) < 2e-5


def test_one_sample_is_refused() -> None:
    """A single sample has no interval to integrate over."""
    with pytest.raises(ImuError, match="at least 2"):
        integrate_gyro(ImuSamples(np.zeros(1), np.zeros((1, 3)), np.zeros((1, 3))), PROFILE)
