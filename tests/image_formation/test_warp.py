"""The map of points: signs, depth, individual row times, and its inverse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from laws import FISHEYE, RADTAN, UNDISTORTED, AtDepth, TurningCamera, phone, recorded_points
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from virest.camera.shutter import READOUT_DIRECTIONS
from virest.image_formation.neighbour import turn_jacobian_px
from virest.image_formation.row_motion import FrameTranslation, row_motion
from virest.image_formation.warp import (
    corner_points,
    dense_map,
    moved_between,
    seen_by_rows,
    straightened_points,
)
from virest.motion.optics import MovingLens, stabiliser_shift
from virest.motion.relief_surface import Relief

LENSES = [pytest.param(lens, id=lens[0]) for lens in (UNDISTORTED, RADTAN, FISHEYE)]


def _points() -> NDArray[np.float64]:
    """Corners and inner points of a frame of 200 × 136."""
    inside = np.random.default_rng(3).uniform((0, 0), (199, 135), (40, 2))
    return np.concatenate([corner_points(200, 136), inside])


@pytest.mark.parametrize(
    ("axis", "start", "expected"),
    [
        ("yaw right", (104.0, 63.92), (-1, 0)),
        ("pitch up", (104.0, 63.92), (0, 1)),
        ("roll clockwise", (180.0, 63.92), (0, -1)),
    ],
)
def test_points_move_against_the_camera(axis: str, start: tuple[float, float], expected: tuple[int, int]) -> None:
    """Yaw right moves points left, pitch up moves them down, and a clockwise roll moves them anticlockwise."""
    turn = {"yaw right": (0, 1, 0), "pitch up": (1, 0, 0), "roll clockwise": (0, 0, 1)}[axis]
    motion = TurningCamera(phone(), rate_rad_s=turn).motion
    moved = (moved_between(motion, np.array([start]), motion.start_s, motion.start_s + 0.01) - start)[0]
    assert np.sign(np.round(moved, 1)).tolist() == list(expected)
    assert np.abs(moved).max() == pytest.approx(0.01 * (76 if axis == "roll clockwise" else 218), rel=0.03)


def test_a_turning_phone_moves_points_the_other_way() -> None:
    """From gyroscope samples, a yaw right of 0.8 rad/s moves the centre point left by f ω t."""
    motion = TurningCamera(phone(), rate_rad_s=(0, 0.8, 0)).motion
    centre = np.array([[104.0, 63.92]])
    moved = moved_between(motion, centre, motion.start_s, motion.start_s + 0.01) - centre
    np.testing.assert_allclose(moved, [[-220 * np.tan(0.008), 0]], atol=1e-5)


@pytest.mark.parametrize("lens", LENSES)
def test_points_with_depth_move_as_projected_points(lens: tuple[str, tuple[float, ...]]) -> None:
    """Rotation and translation move a pixel like the projection of a point in space at that depth."""
    camera = TurningCamera(phone(lens=lens), velocity_m_s=(0.4, -0.25, 0.6))
    motion, points = camera.motion, _points()
    from_s, to_s = motion.start_s + 0.003, motion.start_s + 0.029
    expected = camera.seen(points, from_s, to_s, motion.reference_s, depth_m=1.7)
    np.testing.assert_allclose(moved_between(AtDepth(motion, 1 / 1.7), points, from_s, to_s), expected, atol=1e-3)
    at_infinity = camera.seen(points, from_s, to_s, motion.reference_s)
    np.testing.assert_allclose(moved_between(motion, points, from_s, to_s), at_infinity, atol=1e-5)
    assert np.abs(expected - at_infinity).max() > 0.5


def test_each_point_may_have_its_own_depth() -> None:
    """With a list of inverse depths each point moves as it does alone."""
    motion, points = TurningCamera(phone(), velocity_m_s=(0.4, -0.25, 0.6)).motion, _points()[:3]
    inverse_depth = np.array([0.0, 0.4, 1.5])
    together = straightened_points(AtDepth(motion, inverse_depth), points, 0.5)
    alone = [
        straightened_points(AtDepth(motion, d), p[None], 0.5)[0] for p, d in zip(points, inverse_depth, strict=True)
    ]
    np.testing.assert_allclose(together, alone, atol=1e-12)


@pytest.mark.parametrize("direction", READOUT_DIRECTIONS)
@pytest.mark.parametrize("lens", LENSES)
def test_straightening_inverts_recording(direction: str, lens: tuple[str, tuple[float, ...]]) -> None:
    """A point's recorded position is straightened to the point, for all directions and lenses, and vice versa."""
    camera = TurningCamera(phone(lens=lens, readout_direction=direction), reference="frame-middle")
    motion, points, anchor = camera.motion, _points(), 0.3
    there = recorded_points(motion, points, anchor)
    assert np.abs(there - points).max() > 0.7
    np.testing.assert_allclose(straightened_points(motion, there, anchor), points, atol=1e-6)
    back = recorded_points(motion, straightened_points(motion, points, anchor), anchor)
    np.testing.assert_allclose(back, points, atol=1e-6)


@pytest.mark.parametrize("direction", READOUT_DIRECTIONS)
@pytest.mark.parametrize("anchor", [0.0, 0.5, 1.0])
def test_straightened_points_match_explicit_projections(direction: str, anchor: float) -> None:
    """A recorded pixel belongs where its ray at its own row's anchor projects at the reference time."""
    camera = TurningCamera(phone(lens=RADTAN, readout_direction=direction), velocity_m_s=(0.4, -0.25, 0.6))
    motion, points = camera.motion, _points()
    at = camera.row_start_s(points, motion.start_s) + anchor * 0.012
    expected = camera.seen(points, at, motion.reference_s, motion.reference_s, depth_m=2.0)
    np.testing.assert_allclose(straightened_points(AtDepth(motion, 0.5), points, anchor), expected, atol=1e-3)
    far = camera.seen(points, at, motion.reference_s, motion.reference_s)
    np.testing.assert_allclose(straightened_points(motion, points, anchor), far, atol=1e-5)


@pytest.mark.parametrize("direction", READOUT_DIRECTIONS)
def test_a_recorded_point_lies_in_the_row_that_records_it(direction: str) -> None:
    """``seen_by_rows`` returns the point's position at exactly the time of the row there."""
    camera = TurningCamera(phone(readout_direction=direction), rate_rad_s=(1.4, -2.2, 0.9))
    motion, points = camera.motion, _points()
    at_s = motion.start_s + 0.007
    seen = seen_by_rows(motion, points, at_s, 0.5)
    row_s = camera.row_start_s(seen, motion.start_s) + 0.5 * 0.012
    np.testing.assert_allclose(camera.seen(points, at_s, row_s, motion.reference_s), seen, atol=1e-3)


def test_a_global_shutter_needs_no_straightening() -> None:
    """Without a readout, straightening to the exposure's start changes nothing at anchor 0."""
    motion = TurningCamera(phone(readout_time_s=0.0)).motion
    np.testing.assert_allclose(straightened_points(motion, _points()), _points(), atol=1e-9)
    np.testing.assert_allclose(recorded_points(motion, _points()), _points(), atol=1e-9)
    there = recorded_points(motion, _points(), 0.5)
    np.testing.assert_allclose(straightened_points(motion, there, 0.5), _points(), atol=1e-9)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize(("width", "height"), [(200, 136), (131, 257), (97, 65)])
def test_the_dense_map_is_accurate(lens: tuple[str, tuple[float, ...]], width: int, height: int) -> None:
    """Interpolation between grid points is off by less than 0.02 px at any pixel, also for odd sizes."""
    profile = phone(width, height, focal_px=1.2 * max(width, height), lens=lens, readout_direction="right_to_left")
    motion = TurningCamera(profile, reference="frame-middle").motion
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    exact = recorded_points(motion, np.stack([x, y], -1).astype(float), 0.5)
    dense = dense_map(motion, 0.5)
    assert dense.shape == (height, width, 2)
    assert dense.dtype == np.float32
    np.testing.assert_allclose(dense, exact, atol=0.02)


def test_the_dense_map_follows_a_surface() -> None:
    """With relief, the map is mostly off by less than 0.1 px, and the inverse map leads back."""
    camera = TurningCamera(phone(320, 240, focal_px=300.0, readout_direction="right_to_left"))
    values = np.array([[0.0, 0.2, 0.0, 0.0], [0.0, 0.9, 0.1, 0.0], [0.0, 0.0, 0.0, -0.2]], np.float32)
    relief = Relief(np.array([-0.5, -0.4]), np.array([1.0, 0.8]), values, values)
    moving = FrameTranslation(np.array([0.9, -0.5, 0.2]), np.zeros(3), np.array([0.1, -0.05, 0.5]), relief=relief)
    motion = row_motion(camera.trajectory, camera.profile, 0.1, 0.012, translation=moving)
    x, y = np.meshgrid(np.arange(320), np.arange(240))
    points_px = np.stack([x, y], -1).astype(float)
    exact = recorded_points(motion, points_px, 0.5)
    flat = recorded_points(
        row_motion(camera.trajectory, camera.profile, 0.1, 0.012, translation=replace(moving, relief=None)),
        points_px,
        0.5,
    )
    assert np.abs(exact - flat).max() > 2
    off = np.abs(dense_map(motion, 0.5) - exact)
    assert np.quantile(off, 0.95) < 0.1
    assert off.max() < 0.6
    np.testing.assert_allclose(straightened_points(motion, exact, 0.5), points_px, atol=5e-3)


def test_corners_are_listed_clockwise_from_the_top_left() -> None:
    """P1 to P4 are the centres of the corner pixels, in the log's order."""
    assert corner_points(7, 5).tolist() == [[0, 0], [6, 0], [6, 4], [0, 4]]


def test_geometry_without_a_lens_is_refused() -> None:
    """No point can be moved without a focal length."""
    blind = TurningCamera(replace(phone(), intrinsics=None)).motion
    with pytest.raises(ValueError, match="intrinsics"):
        straightened_points(blind, _points())


@pytest.mark.parametrize("lens", LENSES)
def test_points_of_the_frames_plane_move_as_points_in_space(lens: tuple[str, tuple[float, ...]]) -> None:
    """Rotation, translation, focal drift and stabilisation together.

    Each end is an explicit projection at its own time.
    """
    plane = np.array([0.06, -0.1, 0.5])
    sway = FrameTranslation(np.array([0.5, -0.3, 0.2]), np.array([-2.0, 4.0, 1.0]), plane, 2.0, "profile")
    profile = phone(lens=lens)
    moving = replace(profile.extensions, focal_drift_per_s=0.3, stabilisation_fraction=0.8, stabilisation_cutoff_hz=1.5)
    camera = TurningCamera(replace(profile, extensions=moving))
    motion = row_motion(camera.trajectory, camera.profile, 0.1, 0.012, translation=sway)
    points = _points()
    rays = motion.optics.rays(points, motion.reference_s)
    space = rays / (rays @ plane)[:, None]
    since = np.linspace(0.001, 0.03, len(points))
    at_s = motion.reference_s + since
    centre = since[:, None] * (sway.velocity_m_s + since[:, None] / 2 * sway.acceleration_m_s2)
    turned = Rotation.from_rotvec(-since[:, None] * np.array(camera.rate_rad_s)).apply(space - centre)
    expected = motion.optics.project(turned, at_s)
    there = moved_between(motion, points, motion.reference_s, at_s)
    np.testing.assert_allclose(there, expected, atol=1e-3)
    np.testing.assert_allclose(moved_between(motion, there, at_s, motion.reference_s), points, atol=1e-6)
    straight = straightened_points(motion, recorded_points(motion, points, 0.5), 0.5)
    np.testing.assert_allclose(straight, points, atol=1e-4)
    assert np.abs(there - moved_between(AtDepth(motion, 0.0), points, motion.reference_s, at_s)).max() > 1.0


def test_full_stabilisation_keeps_the_frame_still() -> None:
    """If yaw and pitch are cancelled completely with a very low cutoff, the centre of the frame stays still."""
    rate = (0.35, -0.8, 0.0)
    motion = TurningCamera(phone(), rate).motion
    time_s = motion.start_s + np.linspace(0, 0.03, 31)
    shift = stabiliser_shift(time_s, np.tile(rate, (31, 1)), 1.0, 1e-6)
    held = replace(motion, lens=MovingLens(motion.optics.lens, 0.0, time_s, shift))
    centre = np.array([[104.0, 63.92]])
    free, kept = (moved_between(m, centre, m.start_s, m.start_s + 0.02) - centre for m in (motion, held))
    assert np.abs(free).max() > 3
    np.testing.assert_allclose(kept, 0, atol=0.02)


@pytest.mark.parametrize("lens", LENSES)
def test_the_rotation_jacobian_matches_rotated_rays(lens: tuple[str, tuple[float, ...]]) -> None:
    """It equals difference quotients of exact rotations, x' = exp(angle) x, for each lens with its distortion."""
    camera = TurningCamera(phone(lens=lens))
    motion = row_motion(camera.trajectory, camera.profile, 0.1, 0.012)
    points = _points()
    found = turn_jacobian_px(motion, points)
    assert found.shape == (len(points), 2, 3)
    rays = motion.optics.rays(points, motion.reference_s)
    for axis, turn in enumerate(1e-4 * np.eye(3)):
        there, back = (
            motion.optics.project(Rotation.from_rotvec(way * turn).apply(rays), motion.reference_s) for way in (1, -1)
        )
        np.testing.assert_allclose(found[..., axis], (there - back) / 2e-4, atol=1e-3 * np.abs(found).max())
