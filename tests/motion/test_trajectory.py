"""Properties of orientations: exponential and logarithm, composition, constant ends."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.motion.integration import integrate_gyro
from virest.motion.trajectory import quaternion_wxyz, rotation_from_vector, vector_from_rotation


@pytest.mark.parametrize("size_rad", [0.0, 1e-12, 1e-6, 0.03, 0.0999, 0.1001, 1.0, 3.0])
def test_the_logarithm_inverts_the_exponential(size_rad: float) -> None:
    """The rotation vector of a vector's rotation is the vector, from zero to nearly half a turn."""
    rng = np.random.default_rng(3)
    direction = rng.normal(size=(50, 3))
    vector = size_rad * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    np.testing.assert_allclose(vector_from_rotation(rotation_from_vector(vector)), vector, atol=1e-9)


@pytest.mark.parametrize("size_rad", [0.02, 1.3])
def test_the_exponential_equals_scipys(size_rad: float) -> None:
    """Rotation matrices agree, including handedness and the series for small angles."""
    vector = np.random.default_rng(4).normal(0, size_rad, (100, 3))
    np.testing.assert_allclose(rotation_from_vector(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)


def test_quaternion_is_w_x_y_z_with_w_positive() -> None:
    """Of the two signs, the one with w >= 0 is returned."""
    vector = np.array([0.3, -0.8, 1.1])
    expected = Rotation.from_rotvec(vector).as_quat(scalar_first=True)
    np.testing.assert_allclose(quaternion_wxyz(rotation_from_vector(vector)), expected, atol=1e-12)


def test_rotations_compose() -> None:
    """The rotation from a to c is that from a to b followed by that from b to c."""
    rng = np.random.default_rng(5)
    imu = ImuSamples(np.arange(0, 1, 0.005), rng.normal(0, 1, (200, 3)), np.full((200, 3), np.nan))
    trajectory = integrate_gyro(imu, CameraProfile(64, 48))
    r_a, r_b, r_c = trajectory.orientation(np.array([0.1013, 0.3331, 0.7777]))
    np.testing.assert_allclose((r_a.T @ r_b) @ (r_b.T @ r_c), r_a.T @ r_c, atol=1e-12)
    np.testing.assert_allclose(r_a.T @ r_a, np.eye(3), atol=1e-12)


def test_the_orientation_is_constant_outside_the_samples() -> None:
    """Before the first and after the last sample the orientation does not change."""
    imu = ImuSamples(np.arange(0, 1, 0.005), np.full((200, 3), 0.7), np.full((200, 3), np.nan))
    trajectory = integrate_gyro(imu, CameraProfile(64, 48))
    first, last = trajectory.span_s
    np.testing.assert_array_equal(trajectory.orientation(first - 3.0), trajectory.orientation(first))
    np.testing.assert_array_equal(trajectory.orientation(last + 3.0), trajectory.orientation(last))
