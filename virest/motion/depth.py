"""How far the scene is (eq 11): matched points triangulated by the camera's metric displacement between their rows.

Both sights of a point have their own row's time.  A point seen along r at inverse depth ρ from c₁ is expected at
project(R₂ᵀ (R₁ r + (c₁ − c₂) ρ)); ρ is what brings it to where it was tracked.  A frame's depth is a plane through the
points about it, ρ(r) = m · r, drawn to the plane of its whole window where the points tell less.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from virest.motion.optics import MovingLens
from virest.motion.scene_motion import InertialMotion
from virest.motion.track_model import SMALLEST_DEPTH, Ground, TrackTable, centre, mean_orientation, seen_s, turned

Array = NDArray[np.float64]
PASSES = 3
QUOTIENT = 1e-3
"""Step of the difference quotient, part of the inverse depth."""
MAX_RELATIVE_STD = 0.5
"""Points whose inverse depth is known no better than this part of it tell nothing."""
MIN_POINTS = 20
NEAR_S = 1.0
"""Points seen within this time of a frame speak for it."""
OUTSIDE = 0.05
"""Points up to this part of the picture beyond its edge speak for it too."""
CAUCHY = 2.4
REWEIGHTINGS = 6
FEWEST_SPREAD = 0.02
"""A plane fitted to a whole window is trusted no better than to this part of its inverse depth at one frame."""
NORMAL_MEDIAN = 0.6745


@dataclass(frozen=True, slots=True)
class TriangulatedPoints:
    """Points of the scene, each from one pair of frames."""

    window: NDArray[np.intp]
    """(n,)."""
    place_m: Array
    """(n, 3) world axes, from the camera's centre at the window's middle."""
    time_s: Array
    """(n,) when first seen, IMU clock."""
    inverse_depth_per_m: Array
    """(n,) along the optical axis of the first sight."""
    std_per_m: Array
    """(n,)."""

    def __len__(self) -> int:
        return len(self.window)


@dataclass(frozen=True, slots=True)
class FrameDepth:
    """The scene before one frame."""

    plane_per_m: Array
    """(3,) camera axes at the frame's time: the inverse depth of a ray r with z = 1 is plane · r."""
    depth_m: float
    """Along the optical axis at the picture's centre."""
    std_m: float
    """Includes the metric scale's."""
    points: int
    """Triangulated points that the plane goes through; 0: the window's plane."""
    reason: str = ""
    """Why the frame's own points were not used."""


def triangulate(known: Ground, scene: InertialMotion, table: TrackTable) -> TriangulatedPoints:
    """Find the inverse depth of every matched point whose parallax tells it.

    Gauss-Newton on one unknown a point, from the plane of its window; its standard deviation is the pair's tracking
    noise over the parallax.  Points before which the camera hardly moved, or with an absurd depth, are left out.
    """
    assert known.displacement is not None
    profile = known.profile
    first_s = seen_s(profile, table.first_px, table.first_stamp_s, table.first_exposure_s)
    second_s = seen_s(profile, table.second_px, table.second_stamp_s, table.second_exposure_s)
    origin_s = np.asarray(profile.imu_time_s(table.origin_s))[table.window]
    velocity, plane = scene.velocity_m_s[table.window], scene.plane_per_m[table.window]
    centre_1 = centre(known.displacement, scene, velocity, first_s, origin_s)[0]
    centre_2 = centre(known.displacement, scene, velocity, second_s, origin_s)[0]
    scale = profile.shutter.exposure_scale
    before = mean_orientation(known.trajectory, first_s, scale * table.first_exposure_s)
    back = np.swapaxes(mean_orientation(known.trajectory, second_s, scale * table.second_exposure_s), -1, -2)
    way = turned(before, known.lens.rays(table.first_px, first_s))
    clearance = np.maximum(1 - (plane * centre_1).sum(axis=-1), SMALLEST_DEPTH)
    expected = np.maximum((plane * way).sum(axis=-1) / clearance, 0.0)
    depth, std = _inverse_depths(
        known.lens, turned(back, way), turned(back, centre_1 - centre_2), table, second_s, expected
    )
    good = (std < MAX_RELATIVE_STD * expected) & (np.abs(depth - expected) < expected) & (depth > 0.1 * expected)
    place = centre_1[good] + way[good] / depth[good, None]
    return TriangulatedPoints(table.window[good], place, first_s[good], depth[good], std[good])


def _inverse_depths(
    lens: MovingLens, far: Array, step: Array, table: TrackTable, second_s: Array, start: Array
) -> tuple[Array, Array]:
    """(n,) inverse depths and their standard deviations; far, step (n, 3): point at infinity and its shift a unit."""

    def seen(inverse_depth: Array) -> Array:
        rays = far + step * inverse_depth[:, None]
        rays[:, 2] = np.maximum(rays[:, 2], SMALLEST_DEPTH)
        return lens.project(rays, second_s)

    depth = start.copy()
    for _ in range(PASSES):
        quotient = QUOTIENT * np.maximum(start, 1e-3)
        at = seen(depth)
        slope = (seen(depth + quotient) - at) / quotient[:, None]
        power = np.maximum((slope**2).sum(axis=-1), 1e-12)
        change = (slope * (table.second_px - at)).sum(axis=-1) / power
        depth = depth + np.clip(change, -start, start)
    return depth, table.noise_px[table.pair] / np.sqrt(power)


def frame_depth(
    points: TriangulatedPoints,
    window: int,
    time_s: float,
    rotation_world_cam: Array,
    centre_m: Array,
    lens: MovingLens,
    plane_per_m: Array,
    spread_per_m: float,
    relative_std: float,
) -> FrameDepth:
    """Lay a plane through the points about a frame.

    rotation_world_cam (3, 3), centre_m (3,): the camera at time_s, from the window's middle.  plane_per_m: the window's
    plane in camera axes at time_s; spread_per_m: standard deviation of inverse depths about it; relative_std: of the
    metric scale.
    """
    size = np.array([lens.lens.width, lens.lens.height], float)
    middle = lens.rays(0.5 * (size - 1), time_s)
    near = (points.window == window) & (np.abs(points.time_s - time_s) < NEAR_S)
    local = (points.place_m[near] - centre_m) @ rotation_world_cam
    ahead = local[:, 2] > SMALLEST_DEPTH / max(float(np.linalg.norm(plane_per_m)), 1e-6)
    local = local[ahead]
    rays = local / local[:, 2:]
    seen = lens.project(rays, np.full(len(rays), time_s)) if len(rays) else np.zeros((0, 2))
    inside = (np.abs(seen - 0.5 * size) < (0.5 + OUTSIDE) * size).all(axis=-1)
    rays, inverse = rays[inside], 1.0 / local[inside, 2]
    std = points.std_per_m[near][ahead][inside] * (inverse / points.inverse_depth_per_m[near][ahead][inside]) ** 2
    prior = max(spread_per_m, FEWEST_SPREAD * float(np.linalg.norm(plane_per_m)))
    if len(rays) < MIN_POINTS:
        own = FrameDepth(plane_per_m, 0.0, 0.0, 0, f"{len(rays)} points with parallax: the window's plane")
        variance = 0.0 if spread_per_m == 0 else spread_per_m**2
        return _concluded(own, middle, variance, relative_std)
    plane, covariance, used = _robust_plane(rays, inverse, np.hypot(std, spread_per_m), plane_per_m, prior)
    return _concluded(FrameDepth(plane, 0.0, 0.0, used), middle, float(middle @ covariance @ middle), relative_std)


def _concluded(found: FrameDepth, middle: Array, variance: float, relative_std: float) -> FrameDepth:
    """Depth at the picture's middle; variance of its inverse from the points alone."""
    inverse = max(float(found.plane_per_m @ middle), 1e-6)
    relative = float(np.hypot(np.sqrt(variance) / inverse, relative_std))
    return FrameDepth(found.plane_per_m, 1 / inverse, relative / inverse, found.points, found.reason)


def _robust_plane(rays: Array, inverse: Array, std: Array, start: Array, prior_std: float) -> tuple[Array, Array, int]:
    """Plane (3,), its covariance, and the number of points that go with it: Cauchy weights about the start."""
    plane, information = start, np.eye(3) / prior_std**2
    rows, left = rays / std[:, None], inverse / std
    for _ in range(REWEIGHTINGS):
        squared = (left - rows @ plane) ** 2
        scale = max(float(np.sqrt(np.median(squared))) / NORMAL_MEDIAN, 1.0)
        weight = 1.0 / (1.0 + squared / (CAUCHY * scale) ** 2)
        weighted = rows * (weight / scale**2)[:, None]
        covariance = np.linalg.inv(weighted.T @ rows + information)
        plane = covariance @ (weighted.T @ left + information @ start)
    return np.asarray(plane), np.asarray(covariance), int((weight > 0.25).sum())
