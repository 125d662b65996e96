"""Row times and poses between times, compared with SciPy's rotations at a constant rate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from laws import TurningCamera, phone
from scipy.spatial.transform import Rotation

from virest.camera.shutter import READOUT_DIRECTIONS, Shutter
from virest.capture.imu import ImuSamples
from virest.image_formation.row_motion import FrameTranslation, FurtherTurn, RowMotion, covering_both, row_motion
from virest.motion.integration import integrate_gyro
from virest.motion.relief_surface import Relief

CAMERA = TurningCamera(phone(), velocity_m_s=(0.4, -0.25, 0.6))


def test_poses_at_a_constant_rate() -> None:
    """At rate ω, R_t_ref = exp(−ω (t − ref)), for any bias, scale, mounting and clock of the gyroscope."""
    motion = CAMERA.motion
    time_s = motion.start_s + np.linspace(0, 0.03, 7)
    rotation, _ = motion.pose(time_s)
    since = (time_s - motion.reference_s)[:, None]
    expected = Rotation.from_rotvec(-since * np.array(CAMERA.rate_rad_s)).as_matrix()
    np.testing.assert_allclose(rotation, expected, atol=1e-9)


def test_poses_include_the_translation() -> None:
    """A point fixed in the world is at R_t_ref (X − v (t − ref)) in camera axes."""
    motion = CAMERA.motion
    point, velocity = np.array([0.3, -0.2, 2.5]), np.array(CAMERA.velocity_m_s)
    since = 0.0173
    rotation, translation = motion.pose(motion.reference_s + since)
    expected = Rotation.from_rotvec(-since * np.array(CAMERA.rate_rad_s)).apply(point - since * velocity)
    assert translation is not None
    np.testing.assert_allclose(rotation @ point + translation, expected, atol=1e-6)


SWAY = FrameTranslation(
    np.array([0.4, -0.25, 0.6]), np.array([-3.0, 5.0, 2.0]), np.array([0.08, -0.11, 0.45]), 1 / 0.45, "profile"
)
"""An accelerating camera in front of a tilted plane."""


def test_the_position_of_an_accelerated_camera() -> None:
    """The centre is at v (t − ref) + ½ a (t − ref)² in the axes at the reference; its velocity is v + a (t − ref)."""
    motion = row_motion(CAMERA.trajectory, CAMERA.profile, 0.1, 0.012, translation=SWAY)
    since = 0.0231
    rotation, shift = motion.pose(motion.reference_s + since)
    assert shift is not None
    centre = -rotation.T @ shift
    np.testing.assert_allclose(centre, since * SWAY.velocity_m_s + since**2 / 2 * SWAY.acceleration_m_s2, atol=1e-7)
    np.testing.assert_allclose(SWAY.velocity_at(0.1), [0.1, 0.25, 0.8])


@pytest.mark.parametrize("apart_s", [1 / 30, 0.1, -0.1])
def test_motion_between_two_frames_joins_their_motions(apart_s: float) -> None:
    """A hand sways by 3 cm at 2.5 Hz: extrapolation from one frame is 14 mm off in another 0.1 s later."""
    sway_m, per_s = np.array([0.03, -0.02, 0.01]), 2 * np.pi * 2.5

    def at(stamp_s: float) -> RowMotion:
        """A frame's motion: sway_m sin(per_s t) in the axes of the IMU's start, turned to the frame's."""
        start_s = row_motion(CAMERA.trajectory, CAMERA.profile, stamp_s, 0.012).reference_s
        back = CAMERA.trajectory.orientation(start_s).T
        angle = per_s * (start_s - begun_s)
        parts = [np.cos(angle), -np.sin(angle), -np.cos(angle)]
        v, a, j = (back @ (sway_m * per_s ** (n + 1) * part) for n, part in enumerate(parts))
        travel = FrameTranslation(v, a, SWAY.inverse_depth_plane, jerk_m_s3=j)
        return row_motion(CAMERA.trajectory, CAMERA.profile, stamp_s, 0.012, translation=travel)

    begun_s = row_motion(CAMERA.trajectory, CAMERA.profile, 0.13, 0.012).reference_s
    here, there = at(0.15), at(0.15 + apart_s)
    lens = here.optics
    both = covering_both(here, there, CAMERA.trajectory, lens)
    time_s = np.linspace(there.start_s, there.end_s, 5)
    rotation, shift = both.pose(time_s)
    assert shift is not None
    centre = -np.squeeze(np.swapaxes(rotation, -1, -2) @ shift[..., None], -1)
    gone = np.sin(per_s * (time_s - begun_s)) - np.sin(per_s * (here.reference_s - begun_s))
    expected = gone[:, None] * sway_m @ CAMERA.trajectory.orientation(here.reference_s)
    np.testing.assert_allclose(centre, expected, atol=8e-4)


def test_the_plane_is_fixed_in_the_world() -> None:
    """A point on the plane has, at any time, the inverse depth that the plane gives for its ray."""
    motion = row_motion(CAMERA.trajectory, CAMERA.profile, 0.1, 0.012, translation=SWAY)
    rays = np.array([[0.3, -0.2, 1.0], [-0.4, 0.25, 1.0]])
    points = rays / (rays @ SWAY.inverse_depth_plane)[:, None]
    for since in (0.0, 0.011, 0.03):
        time_s = motion.reference_s + since
        rotation, shift = motion.pose(time_s)
        seen = points @ rotation.T + shift
        np.testing.assert_allclose(motion.inverse_depth(seen / seen[:, 2:], time_s), 1 / seen[:, 2], atol=1e-9)
    beyond = np.array([[0.0, 9.0, 1.0]])
    assert motion.inverse_depth(beyond, motion.reference_s).tolist() == [0.0]


BUMP = Relief(
    np.array([-0.6, -0.5]),
    np.array([1.2, 1.0]),
    np.array([[0.0, 0.05, 0.0, -0.1], [0.1, 0.4, 0.2, 0.0], [0.0, 0.1, 0.0, 0.05]], np.float32),
    np.full((2, 2), 0.01, np.float32),
)


def test_a_surface_is_fixed_in_the_world() -> None:
    """A point on the surface has, at any time, the inverse depth that the surface gives for its ray."""
    motion = row_motion(CAMERA.trajectory, CAMERA.profile, 0.1, 0.012, translation=replace(SWAY, relief=BUMP))
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 7), np.linspace(-0.4, 0.4, 6))
    rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=-1)
    above = BUMP.at(rays)
    points = rays / (rays @ SWAY.inverse_depth_plane + above)[:, None]
    assert np.ptp(above) > 0.3
    for since in (0.0, 0.011, 0.03):
        time_s = np.full(len(points), motion.reference_s + since)
        rotation, shift = motion.pose(time_s)
        seen = np.einsum("nij,nj->ni", rotation, points) + shift
        np.testing.assert_allclose(motion.inverse_depth(seen / seen[:, 2:], time_s), 1 / seen[:, 2], atol=2e-4)


def test_relative_poses_compose() -> None:
    """The pose from a to b and from b to c equals that from a to c; there and back is the identity."""
    motion = CAMERA.motion
    a, b, c = motion.start_s + np.array([0.001, 0.0113, 0.0278])
    (r_ab, t_ab), (r_bc, t_bc), (r_ac, t_ac) = (motion.relative_pose(*p) for p in ((a, b), (b, c), (a, c)))
    assert t_ab is not None
    np.testing.assert_allclose(r_bc @ r_ab, r_ac, atol=1e-13)
    np.testing.assert_allclose(r_bc @ t_ab + t_bc, t_ac, atol=1e-13)
    r_ba, t_ba = motion.relative_pose(b, a)
    np.testing.assert_allclose(r_ba @ r_ab, np.eye(3), atol=1e-13)
    np.testing.assert_allclose(r_ba @ t_ab + t_ba, 0, atol=1e-13)


def test_the_pose_at_the_reference_is_the_identity() -> None:
    """Nothing has moved at the reference time, for either kind of reference."""
    for reference in ("exposure-start", "frame-middle"):
        motion = replace(CAMERA, reference=reference).motion
        rotation, translation = motion.pose(motion.reference_s)
        np.testing.assert_allclose(rotation, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(translation, 0, atol=1e-7)


def test_without_a_velocity_only_the_rotation_is_known() -> None:
    """An unknown translation is None and never zero."""
    motion = TurningCamera(phone()).motion
    assert motion.translation_m is None
    assert motion.relative_pose(motion.start_s, motion.start_s + 0.01)[1] is None


def test_times_of_a_frame_match_a_hand_calculation() -> None:
    """Timestamp 2 s at exposure end, 10 ms logged × 1.2 = 12 ms: start 1.988 s, then skew 1e-3 and offset 0.05 s."""
    shutter = Shutter(0.02, "bottom_to_top", "exposure_end", 1.2)
    profile = phone(shutter=shutter, clock_skew=1e-3, time_offset_s=0.05)
    camera = TurningCamera(profile, stamp_s=2.0, exposure_s=0.010, reference="frame-middle")
    motion = camera.motion
    assert motion.start_s == pytest.approx(1.988 * 1.001 + 0.05)
    assert motion.exposure_s == pytest.approx(0.012)
    assert motion.reference_s == pytest.approx(motion.start_s + 0.010 + 0.006)
    assert replace(camera, reference="exposure-start").motion.reference_s == motion.start_s


def test_an_unknown_exposure_counts_as_zero() -> None:
    """The start of each row is still known."""
    motion = TurningCamera(phone(), exposure_s=None).motion
    assert motion.exposure_s == 0.0
    assert motion.start_s == pytest.approx(0.1 * (1 + 2e-4) + 0.0031)


@pytest.mark.parametrize("direction", READOUT_DIRECTIONS)
def test_rows_start_at_their_own_times(direction: str) -> None:
    """A row's start is the first row's plus its part of the readout, in all four directions."""
    camera = TurningCamera(phone(readout_direction=direction))
    points = np.array([[0, 0], [199, 135], [37, 101], [-5, 140]], float)
    motion = camera.motion
    np.testing.assert_allclose(motion.row_time_s(points, 0.0), camera.row_start_s(points, motion.start_s), atol=1e-12)


def test_the_pose_table_follows_a_shaking_hand() -> None:
    """At 6 Hz and 3 rad/s the tabulated pose is accurate to 1 µrad, also between grid points."""
    time_s = np.arange(-0.2, 0.5, 0.0025)
    rate = 3.0 * np.sin(2 * np.pi * 6 * time_s[:, None] + np.array([0.3, 1.9, 4.0]))
    profile = phone()
    samples = ImuSamples(time_s, rate @ profile.rotation_cam_imu, np.full((len(time_s), 3), np.nan))
    trajectory = integrate_gyro(samples, profile)
    motion = row_motion(trajectory, profile, 0.13, 0.015)
    at = motion.start_s + np.random.default_rng(0).uniform(0, 0.036, 200)
    expected = np.swapaxes(trajectory.orientation(at), -1, -2) @ trajectory.orientation(motion.reference_s)
    np.testing.assert_allclose(motion.pose(at)[0], expected, atol=1e-6)


def test_an_additional_rotation_is_integrated_in_camera_axes():
    """A rate that changes from pair to pair is added to a fast rotation."""
    rate, time_s = np.array([0.8, -1.5, 2.0]), np.linspace(-0.1, 0.3, 801)
    further = FurtherTurn(np.array([0.0, 0.04]), np.array([[0.3, 0.0, 0.0], [0.0, -0.2, 0.0]]))
    lacking = np.stack([np.interp(time_s, further.time_s, along) for along in further.rate_rad_s.T], -1)
    profile, motions = replace(phone(), gyro_scale=(1.0, 1.0, 1.0)), []
    for camera in (np.tile(rate, (len(time_s), 1)), rate - lacking):
        gyro = camera @ profile.rotation_cam_imu
        trajectory = integrate_gyro(ImuSamples(time_s, gyro, np.full_like(gyro, np.nan)), profile)
        motions.append(row_motion(trajectory, profile, 0.01, 0.01))
    predicted, true = motions
    assert np.abs(true.rotation_vector - predicted.rotation_vector).max() > 1e-3
    np.testing.assert_allclose(predicted.turned(further).rotation_vector, true.rotation_vector, atol=5e-6)
