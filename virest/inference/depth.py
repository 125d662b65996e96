"""Scene depth (eq 11): matched points triangulated with the camera's metric displacement between their rows.

Both observations of a point have the time of their own row.  A point seen from c₁ along r at inverse depth ρ is
expected at project(R₂ᵀ (R₁ r + (c₁ − c₂) ρ)); ρ is fitted to the tracked position.  A frame's depth is a plane through
the points near it, ρ(r) = m · r, with the plane of its whole window as the prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from virest.arrays import Array, Index, Mask
from virest.image_formation.point_model import SMALLEST_DEPTH, IntegratedMotion, Poses, TrackTable, predict
from virest.inference.robust import CAUCHY, NORMAL_MEDIAN, cauchy_weight
from virest.motion.optics import MovingLens
from virest.motion.relief_surface import Relief
from virest.motion.scene_motion import InertialMotion

PASSES = 3
"""Gauss-Newton steps of a point near the plane; 2 give the same depths to 0.001 σ."""
RELIEF_PASSES, RELIEF_REACH = 6, 3.0
"""The same of points at any distance, and the largest change in one step, in inverse depths of the plane."""
FARTHEST = 0.02
"""Inverse depths are clipped to at least this fraction of the plane's."""
MAX_ACROSS = 4.0
"""Largest deviation across the parallax, in standard deviations of the tracking noise."""
QUOTIENT = 1e-3
"""Step of the difference quotient, relative to the inverse depth."""
MAX_RELATIVE_STD = 0.5
"""Points with a larger relative standard deviation of the inverse depth are dropped."""
LEAST_INVERSE_PER_M = 1e-6
"""Inverse depth below which nothing is seen: a thousand kilometres."""
MIN_POINTS = 20
"""Fewest points of a frame that shift its plane from its window's."""
NEAR_S = 1.0
"""A frame uses points seen within this time of it."""
OUTSIDE = 0.05
"""A frame uses points up to this fraction of the picture's size beyond its edge."""
REWEIGHTINGS = 6
"""Passes against outliers; half or twice as many change depths by less than 0.03 σ."""
LEAST_SPREAD = 0.02
"""Smallest relative standard deviation, at one frame, of a plane fitted to a whole window."""


@dataclass(frozen=True, slots=True)
class TriangulatedPoints:
    """Points of the scene, each from one pair of frames."""

    window: Index
    """(n,)."""
    place_m: Array
    """(n, 3) world axes, relative to the camera centre at the window's middle."""
    time_s: Array
    """(n,) when first seen, IMU clock."""
    inverse_depth_per_m: Array
    """(n,) along the optical axis of the first observation."""
    std_per_m: Array
    """(n,)."""

    def __len__(self) -> int:
        return len(self.window)

    def chosen(self, use: Mask) -> TriangulatedPoints:
        """Some of the points."""
        return TriangulatedPoints(
            self.window[use], self.place_m[use], self.time_s[use], self.inverse_depth_per_m[use], self.std_per_m[use]
        )


@dataclass(frozen=True, slots=True)
class SightedPoints:
    """Triangulated points with their first observation."""

    points: TriangulatedPoints
    pair: Index
    """(n,) number of the pair of frames."""
    from_m: Array
    """(n, 3) camera centre, world axes, relative to its position at the window's middle."""
    rays: Array
    """(n, 3) with z = 1, camera axes at the observation."""
    above_per_m: Array
    """(n,) inverse depth above the window's plane."""
    across: Array
    """(n,) distance of the second observation from the parallax line, in standard deviations of the tracking noise."""

    def __len__(self) -> int:
        return len(self.pair)

    def chosen(self, use: Mask) -> SightedPoints:
        """Some of the points."""
        return SightedPoints(
            self.points.chosen(use), self.pair[use], self.from_m[use], self.rays[use], self.above_per_m[use],
            self.across[use],
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class FrameDepth:
    """The scene in front of one frame."""

    plane_per_m: Array
    """(3,) camera axes at the frame's time: the inverse depth of a ray r with z = 1 is plane · r."""
    depth_m: float
    """Along the optical axis at the picture's centre; inf where the plane lies below a horizon there."""
    std_m: float
    """Includes that of the metric scale; inf with an infinite depth."""
    points: int
    """Number of triangulated points that determine the plane; 0: the window's plane."""
    reason: str = ""
    """Why the frame's own points were not used."""
    relief: Relief | None = None
    """Relief on the plane; None: none that the points resolve."""

    def with_relief(self, relief: Relief, middle: Array, relative_std: float) -> FrameDepth:
        """The same scene with relief on its plane; middle (3,): the ray through the picture's centre."""
        inverse = float(self.plane_per_m @ middle + relief.at(middle))
        depth_m, std_m = _depth_m(inverse, float(relief.std_at(middle)), relative_std)
        return replace(self, depth_m=depth_m, std_m=std_m, relief=relief)


def triangulate(known: IntegratedMotion, scene: InertialMotion, table: TrackTable) -> TriangulatedPoints:
    """Find the inverse depth of every matched point that the parallax determines and that lies near the plane.

    Points with hardly any parallax or with an implausible depth are dropped.
    """
    sights = _sights(known, scene, table, PASSES, 1.0)
    depth, expected = sights.points.inverse_depth_per_m, sights.points.inverse_depth_per_m - sights.above_per_m
    near = (np.abs(sights.above_per_m) < expected) & (depth > 0.1 * expected)
    return sights.points.chosen(near & (sights.points.std_per_m < MAX_RELATIVE_STD * expected))


def triangulate_relief(known: IntegratedMotion, scene: InertialMotion, table: TrackTable) -> SightedPoints:
    """Find the inverse depth of every matched point that the parallax determines, at any distance from the plane.

    Points off their parallax line are dropped: they are mismatches or move independently.
    """
    sights = _sights(known, scene, table, RELIEF_PASSES, RELIEF_REACH)
    expected = sights.points.inverse_depth_per_m - sights.above_per_m
    std = sights.points.std_per_m
    good = (std < MAX_RELATIVE_STD * expected) & (sights.points.inverse_depth_per_m > -2 * std)
    good &= sights.across < MAX_ACROSS
    sights, expected = sights.chosen(good), expected[good]
    depth = sights.points.inverse_depth_per_m
    far = np.maximum(depth, FARTHEST * expected)
    place = sights.from_m + (sights.points.place_m - sights.from_m) * (depth / far)[:, None]
    return replace(sights, points=replace(sights.points, place_m=place, inverse_depth_per_m=far))


def _sights(
    known: IntegratedMotion, scene: InertialMotion, table: TrackTable, passes: int, reach: float
) -> SightedPoints:
    """Gauss-Newton on the inverse depth of each point, from its window's plane; a pass changes it by at most ``reach``.

    The standard deviation is the pair's tracking noise over the parallax.
    """
    prediction = predict(known, table, scene)
    poses, moved = prediction.poses, prediction.moved
    assert moved is not None
    assert moved.paths is not None
    centre_1 = moved.paths[0].centre(scene, scene.velocity_m_s[table.window])
    rays, expected = known.lens.rays(table.first_px, poses.first_s, poses.first_exposure_s), moved.inverse_depth
    way = poses.before.to_world(rays)
    view = _Parallax(known.lens, poses.after.to_camera(way), poses.after.to_camera(moved.step), table, poses)
    depth, std, across = view.inverse_depths(expected, passes, reach)
    safe = np.where(np.abs(depth) > 1e-9, depth, 1e-9)
    points = TriangulatedPoints(table.window, centre_1 + way / safe[:, None], poses.first_s, depth, std)
    return SightedPoints(points, table.pair, centre_1, rays, depth - expected, across)


@dataclass(frozen=True, slots=True)
class _Parallax:
    """The second observation of points as a function of their inverse depths."""

    lens: MovingLens
    far: Array
    """(n, 3) the point at infinity."""
    step: Array
    """(n, 3) its shift per unit of inverse depth."""
    table: TrackTable
    poses: Poses

    def seen(self, inverse_depth: Array) -> Array:
        """Pixels (n, 2)."""
        rays = self.far + self.step * inverse_depth[:, None]
        rays[:, 2] = np.maximum(rays[:, 2], SMALLEST_DEPTH)
        return self.poses.again(self.lens, rays)

    def inverse_depths(self, start: Array, passes: int, reach: float) -> tuple[Array, Array, Array]:
        """(n,) inverse depths, their standard deviations, and residuals across the parallax in tracking noise σ."""
        depth, noise = start.copy(), self.table.noise_px[self.table.pair]
        for _ in range(passes):
            quotient = QUOTIENT * np.maximum(start, 1e-3)
            at = self.seen(depth)
            slope = (self.seen(depth + quotient) - at) / quotient[:, None]
            power = np.maximum((slope**2).sum(axis=-1), 1e-12)
            left = self.table.second_px - at
            change = (slope * left).sum(axis=-1) / power
            depth = depth + np.clip(change, -reach * start, reach * start)
        across = np.abs(left[:, 0] * slope[:, 1] - left[:, 1] * slope[:, 0]) / np.sqrt(power)
        return depth, noise / np.sqrt(power), across / noise


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
    """Fit a plane to the points near a frame.

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
    prior = max(spread_per_m, LEAST_SPREAD * float(np.linalg.norm(plane_per_m)))
    if len(rays) < MIN_POINTS:
        own = FrameDepth(plane_per_m, 0.0, 0.0, 0, f"only {len(rays)} points with parallax: the window's plane is used")
        variance = 0.0 if spread_per_m == 0 else spread_per_m**2
        return _concluded(own, middle, variance, relative_std)
    plane, covariance, used = _robust_plane(rays, inverse, np.hypot(std, spread_per_m), plane_per_m, prior)
    return _concluded(FrameDepth(plane, 0.0, 0.0, used), middle, float(middle @ covariance @ middle), relative_std)


def _concluded(found: FrameDepth, middle: Array, variance: float, relative_std: float) -> FrameDepth:
    """Depth at the picture's centre; variance: of its inverse, from the points alone."""
    depth_m, std_m = _depth_m(float(found.plane_per_m @ middle), float(np.sqrt(variance)), relative_std)
    return FrameDepth(found.plane_per_m, depth_m, std_m, found.points, found.reason)


def _depth_m(inverse_per_m: float, std_per_m: float, relative_std: float) -> tuple[float, float]:
    """Depth and its standard deviation from the inverse depth, its deviation, and that of the metric scale."""
    if inverse_per_m <= LEAST_INVERSE_PER_M:
        return np.inf, np.inf
    return 1 / inverse_per_m, float(np.hypot(std_per_m / inverse_per_m, relative_std)) / inverse_per_m


def _robust_plane(rays: Array, inverse: Array, std: Array, start: Array, prior_std: float) -> tuple[Array, Array, int]:
    """Plane (3,), its covariance, and the number of inliers, with Cauchy weights; the start is the prior."""
    plane, information = start, np.eye(3) / prior_std**2
    rows, left = rays / std[:, None], inverse / std
    for _ in range(REWEIGHTINGS):
        squared = (left - rows @ plane) ** 2
        scale = max(float(np.sqrt(np.median(squared))) / NORMAL_MEDIAN, 1.0)
        weight = cauchy_weight(squared, CAUCHY * scale)
        weighted = rows * (weight / scale**2)[:, None]
        covariance = np.linalg.inv(weighted.T @ rows + information)
        plane = covariance @ (weighted.T @ left + information @ start)
    return np.asarray(plane), np.asarray(covariance), int((weight > 0.25).sum())
