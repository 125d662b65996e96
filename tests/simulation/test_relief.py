"""Objects in front of a plane: they are nearer, so they move more, and they hide what is behind them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from virest.simulation.scenes import ReliefScene, Scene, add_moving_objects, add_near_objects

NEAR_M, FAR_M, FOCAL = 1.1, 1.9, 50.0
CENTRE = np.array([59.5, 39.5])
POSE = Rotation.from_rotvec([0.05, -0.08, 0.2])
PLACE_M = np.array([0.12, -0.07, 0.15])


def chart(rng: np.random.Generator) -> np.ndarray:
    """A smooth chart whose colours encode the place: red grows with x, green with y."""
    y, x = np.mgrid[0:80, 0:120].astype(np.float32)
    return np.dstack([x / 120, y / 80, np.full_like(x, float(rng.uniform(0.1, 0.9)))]).astype(np.float32)


def colour_at(pixel: np.ndarray, blue: float) -> np.ndarray:
    """Colour at a place of the chart."""
    return np.array([pixel[0] / 120, pixel[1] / 80, blue])


def ray_to(point_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x/z and y/z of a world point seen from the moved camera."""
    seen = POSE.inv().apply(point_m - PLACE_M)
    return np.full((1, 1), seen[0] / seen[2], np.float32), np.full((1, 1), seen[1] / seen[2], np.float32)


def relief(rng: np.random.Generator) -> tuple[ReliefScene, float, float]:
    """A relief whose nearer plane covers the left half of the chart, and the blue values of both planes."""
    far, near = chart(rng), chart(rng)
    cover = np.zeros((80, 120, 1), np.float32)
    cover[:, :60] = 1
    before = Scene(np.concatenate([near * cover, cover], axis=2), FOCAL, NEAR_M)
    return ReliefScene(far, FOCAL, FAR_M, (0.0, 0.0, 1.0), nearer=(before,)), float(far[0, 0, 2]), float(near[0, 0, 2])


def test_a_point_of_each_plane_is_seen_along_its_ray(rng: np.random.Generator):
    """From a moved and turned camera, the nearer plane hides the farther one except at its gap."""
    scene, far_blue, near_blue = relief(rng)
    both = scene.chart_from_ray(POSE.as_matrix(), PLACE_M)
    on_near = np.array([-0.31, 0.11, NEAR_M])
    seen = scene.sample(both, *ray_to(on_near))[0, 0]
    np.testing.assert_allclose(seen, colour_at(CENTRE + FOCAL * on_near[:2] / NEAR_M, near_blue), atol=2e-3)
    on_far = np.array([0.83, -0.2, FAR_M])
    seen = scene.sample(both, *ray_to(on_far))[0, 0]
    np.testing.assert_allclose(seen, colour_at(CENTRE + FOCAL * on_far[:2] / FAR_M, far_blue), atol=2e-3)


def test_poses_at_several_times_give_pairs_of_homographies(rng: np.random.Generator):
    """Each pose has one pair, the same as when computed alone."""
    scene, *_ = relief(rng)
    turns = Rotation.from_rotvec([[0, 0, 0], [0.1, 0.2, 0.3], [0, -0.2, 0]]).as_matrix()
    places = np.array([[0, 0, 0], [0.1, 0, 0], PLACE_M])
    all_at_once = scene.chart_from_ray(turns, places)
    assert all_at_once.shape == (3, 2, 3, 3)
    np.testing.assert_allclose(all_at_once[2], scene.chart_from_ray(turns[2], places[2]))


def test_near_objects_hide_part_of_the_scene(rng: np.random.Generator):
    """The farther plane is unchanged, and covered light is never above the cover."""
    plane = Scene(chart(rng), FOCAL, FAR_M)
    scene = add_near_objects(plane, rng, depth_m=NEAR_M, focal_px=FOCAL)
    (near,) = scene.nearer
    assert (scene.depth_m, near.depth_m) == (FAR_M, NEAR_M)
    np.testing.assert_array_equal(scene.chart, plane.chart)
    cover = near.chart[..., 3]
    assert 0.02 < cover.mean() < 0.9
    assert (near.chart[..., :3].max(axis=2) <= cover + 1e-6).all()


def test_moving_objects_move_in_three_directions(rng: np.random.Generator):
    """Three planes of objects move in directions a third of a turn apart, from where they were drawn at time 0."""
    plane = Scene(chart(rng), FOCAL)
    scene = add_moving_objects(plane, rng, speed_px_s=100.0, focal_px=FOCAL)
    drifts = np.array([p.drift_per_s for p in scene.nearer])
    assert drifts.shape == (3, 2)
    assert (np.hypot(*drifts.T) * FOCAL > 60).all()
    assert scene.fastest_per_s == np.hypot(*drifts.T).max()
    angles = np.sort(np.arctan2(drifts[:, 1], drifts[:, 0]))
    np.testing.assert_allclose(np.diff(angles), 2 * np.pi / 3, atol=1e-9)
    start, later = (scene.chart_from_ray(np.eye(3), np.zeros(3), time_s) for time_s in (0.0, 0.1))
    np.testing.assert_allclose(later[0], start[0])
    np.testing.assert_allclose((start - later)[1:, :2, 2], 0.1 * FOCAL * drifts)
