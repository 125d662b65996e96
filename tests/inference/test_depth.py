"""Triangulated points compared with their wall, and planes of frames with synthetic points."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from motion.swaying_camera import Sway, SwayingCamera
from scipy.spatial.transform import Rotation

from virest.camera.intrinsics import Intrinsics
from virest.inference.camera_travel import Stretch
from virest.inference.depth import FrameDepth, TriangulatedPoints, frame_depth
from virest.inference.visual_inertial import align
from virest.motion.optics import MovingLens

LENS = MovingLens(Intrinsics(640, 480, 500.0, 500.0, 310.0, 236.0))
PLANE_PER_M = np.array([0.08, -0.11, 0.45])
TURN = Rotation.from_rotvec([0.2, -0.3, 0.4]).as_matrix()
CENTRE_M = np.array([0.05, -0.08, 0.03])
ROUGH_PER_M = PLANE_PER_M * 1.1


@lru_cache(maxsize=2)
def stretch(relief_m: float) -> tuple[SwayingCamera, Stretch]:
    """Align a swaying camera in front of a smooth or rough wall."""
    camera = SwayingCamera(Sway(seed=9, relief_m=relief_m, depth_m=1.5, sway_m=0.09))
    return camera, align(camera.observed, camera.imu, camera.profile).stretches[0]


def test_triangulated_points_lie_on_the_wall_within_their_deviations() -> None:
    """Eq 11 with each point's own row time: distances from the plane match the tracking noise."""
    _, found = stretch(0.0)
    points, plane = found.points, found.scene.plane_per_m[0]
    assert len(points) > 0.6 * len(found.table)
    off = 1 - points.place_m @ plane  # relative: m · X = 1 on the plane
    deviation = off * points.inverse_depth_per_m / points.std_per_m
    assert abs(np.median(deviation)) < 0.15
    assert 0.8 < np.median(np.abs(deviation)) / 0.6745 < 1.25


def test_relief_is_seen_in_the_points() -> None:
    """Points 0.25 m in front of and behind the wall are found there and not on the plane."""
    _, found = stretch(0.25)
    points, plane = found.points, found.scene.plane_per_m[0]
    clear = points.std_per_m < 0.03 * points.inverse_depth_per_m
    distance = (points.place_m[clear] @ plane - 1) / np.linalg.norm(plane)
    assert clear.sum() > 100
    assert 0.5 * 1.4826 * np.subtract(*np.quantile(distance, [0.75, 0.25])) == pytest.approx(0.25, rel=0.35)


def laid_out(count: int, moving: float = 0.0, noise: float = 0.004, seed: int = 2) -> TriangulatedPoints:
    """Points on PLANE_PER_M seen from CENTRE_M by a camera rotated by TURN; some belong to another object."""
    rng = np.random.default_rng(seed)
    rays = LENS.rays(rng.uniform((0, 0), (639, 479), (count, 2)), np.zeros(count))
    inverse = rays @ PLANE_PER_M + rng.normal(0, noise, count)
    inverse[: int(moving * count)] *= 1.7
    place = CENTRE_M + (rays / inverse[:, None]) @ TURN.T
    window = np.zeros(count, np.intp)
    return TriangulatedPoints(window, place, rng.uniform(4.2, 5.8, count), inverse, np.full(count, noise))


def depth_of(points: TriangulatedPoints, spread: float = 0.0, relative_std: float = 0.0, window: int = 0) -> FrameDepth:
    """The frame at 5 s, from a rough plane of the window."""
    return frame_depth(points, window, 5.0, TURN, CENTRE_M, LENS, ROUGH_PER_M, spread, relative_std)


def test_a_frame_s_plane_fits_its_points() -> None:
    """A fifth of the points belong to a nearer object; the depth is that of the frame's centre."""
    found = depth_of(laid_out(300, moving=0.2), spread=0.02)
    np.testing.assert_allclose(found.plane_per_m, PLANE_PER_M, rtol=0.04, atol=0.004)
    middle = np.array([(319.5 - 310) / 500, (239.5 - 236) / 500, 1.0])
    assert found.depth_m == pytest.approx(1 / (PLANE_PER_M @ middle), rel=0.015)
    assert 200 < found.points <= 300
    assert found.reason == ""


def test_the_deviation_of_a_depth_is_right() -> None:
    """It matches the errors over many draws of the noise, and the scale's deviation is added to it."""
    middle = LENS.rays(np.array([319.5, 239.5]), 5.0)
    truth = 1 / (PLANE_PER_M @ middle)
    found = [depth_of(laid_out(60, noise=0.03, seed=k), spread=0.2) for k in range(60)]
    deviation = [(f.depth_m - truth) / f.std_m for f in found]
    assert np.sqrt(np.mean(np.square(deviation))) < 1.3
    without_scale, with_scale = depth_of(laid_out(60)), depth_of(laid_out(60), relative_std=0.05)
    assert with_scale.std_m**2 - without_scale.std_m**2 == pytest.approx((0.05 * truth) ** 2, rel=0.02)


def test_too_few_points_keep_the_window_s_plane() -> None:
    """Points of another window or time do not count, and a reason is given."""
    points = laid_out(300)
    late = TriangulatedPoints(
        points.window, points.place_m, points.time_s + 3, points.inverse_depth_per_m, points.std_per_m
    )
    for found in (depth_of(laid_out(12)), depth_of(points, window=1), depth_of(late)):
        np.testing.assert_array_equal(found.plane_per_m, ROUGH_PER_M)
        assert found.points == 0
        assert "points with parallax" in found.reason
