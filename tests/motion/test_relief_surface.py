"""Surfaces of inverse depth: a panel in front of a wall, and scenes without relief."""

from __future__ import annotations

from dataclasses import astuple, replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from motion.swaying_camera import CENTRE_PX, Sway, SwayingCamera

from virest.camera.intrinsics import Intrinsics
from virest.inference.camera_travel import FrameMotion, VisualInertialAlignment
from virest.inference.depth import SightedPoints, TriangulatedPoints
from virest.inference.relief import measure_roughness, picture_grid
from virest.inference.visual_inertial import align
from virest.motion.optics import MovingLens
from virest.motion.relief_surface import Relief, angles

SCENE = Sway(seed=9, depth_m=1.5, sway_m=0.09, points=220, panel=0.6)
LENS = MovingLens(Intrinsics(640, 480, 500.0, 500.0, 310.0, 236.0))


@lru_cache(maxsize=4)
def aligned(setup: Sway) -> tuple[SwayingCamera, VisualInertialAlignment]:
    """Align a swaying camera."""
    camera = SwayingCamera(setup)
    return camera, align(camera.observed, camera.imu, camera.profile)


def at(found: VisualInertialAlignment, time_s: float) -> FrameMotion:
    """The frame around an instant on the camera's clock."""
    motion = found.frame(time_s, time_s, time_s + 0.027)
    assert isinstance(motion, FrameMotion), motion
    return motion


def pixels(setup: Sway) -> np.ndarray[Any, Any]:
    """A grid of pixels over the frame."""
    x, y = np.meshgrid(np.arange(15.0, setup.width - 10, 18), np.arange(15.0, setup.height - 10, 18))
    return np.stack([x.ravel(), y.ravel()], axis=-1)


@pytest.mark.parametrize("panel", [0.6, 0.4])
def test_a_panel_in_front_of_a_wall_is_recovered(panel: float) -> None:
    """Most of the frame has one of the two depths within a tenth of the step, far better than with a plane."""
    setup = replace(SCENE, panel=panel)
    camera, found = aligned(setup)
    points_px = pixels(setup)
    rays = np.concatenate([(points_px - CENTRE_PX) / setup.focal_px, np.ones((len(points_px), 1))], axis=1)
    for time_s in (0.7, 1.45, 2.2):
        depth, truth = at(found, time_s).depth, camera.inverse_depth(time_s, points_px)
        assert depth.relief is not None
        step = np.ptp(truth)
        plane = rays @ depth.plane_per_m - truth
        left = plane + depth.relief.at(rays)
        assert np.quantile(np.abs(left), 0.75) < 0.1 * step
        assert np.sqrt((left**2).mean()) < 0.6 * np.sqrt((plane**2).mean())
        scale = found.windows[0].scale_std * np.abs(truth)
        assert (np.abs(left) < 2 * np.hypot(depth.relief.std_at(rays), scale)).mean() > 0.9


def test_the_logged_depth_is_that_of_the_surface() -> None:
    """The depth at the centre of the frame is right within three deviations."""
    camera, found = aligned(SCENE)
    middle = np.array([[239.5, 319.5]])
    depth = at(found, 1.45).depth
    assert abs(depth.depth_m - 1 / camera.inverse_depth(1.45, middle)[0]) < 3 * depth.std_m
    assert depth.std_m < 0.5 * depth.depth_m


@pytest.mark.parametrize(
    "setup",
    [
        pytest.param(Sway(seed=9, depth_m=1.5, sway_m=0.09, points=200), id="a wall alone"),
        pytest.param(Sway(seed=9, depth_m=1.5, sway_m=0.09, points=200, relief_m=0.2), id="depths without order"),
        pytest.param(Sway(seed=9, depth_m=1.5, sway_m=0.09, points=12, panel=0.6), id="few tracks"),
    ],
)
def test_the_plane_is_kept_if_a_surface_does_not_predict_better(setup: Sway) -> None:
    """The frame then equals that of its plane, digit for digit."""
    _, found = aligned(setup)
    for stretch in found.stretches:
        assert stretch.reliefs == (None,) * len(stretch.windows)
        for window in range(len(stretch.windows)):
            instant = stretch.origin_s(window)
            np.testing.assert_equal(
                astuple(stretch.depth(window, instant)), astuple(stretch.frame_plane(window, instant))
            )


def mosaic(count: int = 300, pairs: int = 8, noise: float = 0.01) -> SightedPoints:
    """Points on patches of 0.1 rad at two inverse depths 0.3 apart, each seen once per pair."""
    rng = np.random.default_rng(4)
    rays = LENS.rays(rng.uniform((0, 0), (639, 479), (count * pairs, 2)), np.zeros(count * pairs))
    cell = np.floor(angles(rays) / 0.1 + 40).astype(int)
    above = 0.3 * rng.integers(0, 2, (80, 80))[cell[:, 0], cell[:, 1]] - 0.15
    found = above + rng.normal(0, noise, len(rays))
    inverse = 0.5 + found
    pair = np.repeat(np.arange(pairs), count)
    points = TriangulatedPoints(
        np.zeros(len(rays), np.intp), rays / inverse[:, None], 0.03 * pair, inverse, np.full(len(rays), noise)
    )
    return SightedPoints(points, pair, np.zeros((len(rays), 3)), rays, found, np.zeros(len(rays)))


def test_the_variogram_gives_sill_and_length() -> None:
    """For patches at two equally likely depths, the sill is half the step, nearly reached at the patch size."""
    grid = picture_grid(LENS, 0.0)
    rough = measure_roughness(mosaic(), grid)
    assert rough is not None
    assert rough.sill_per_m == pytest.approx(0.15, rel=0.1)
    assert rough.nugget_per_m < 0.05
    assert 0.03 < rough.length_rad < 0.1


def test_outside_its_grid_a_surface_is_constant() -> None:
    """Between nodes it is bilinear."""
    values = np.array([[0.1, 0.3, -0.2], [0.5, 0.2, 0.4]], np.float32)
    relief = Relief(np.array([-0.2, -0.1]), np.array([0.4, 0.2]), values, values)
    x, y = np.tan([-0.1, 0.3])
    np.testing.assert_allclose(relief.at(np.array([[x, 0, 1], [y, 0, 1]])), [0.275, 0.1], atol=1e-6)
    assert relief.at(np.array([0.0, 0.0, 1.0])) == pytest.approx(0.25)
