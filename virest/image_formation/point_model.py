"""Prediction of tracked points: one model of clock, gyroscope, lens, readout, translation and depth (eqs 4-14, 28).

A point seen at p₁ in one frame is seen in the next at

    p₂ = project(R(t₂)ᵀ (R(t₁) r₁ + (c(t₁) − c(t₂)) ρ)),   r₁ = rays(p₁),

with R, c the camera's orientation and centre in world axes and each t the middle of the exposure of the point's row.
A point's blurred image lies at the mean of its blur path, so R is the mean over the exposure, R exp(ω' E²/24).
ρ is the inverse depth of r₁ on the plane m · X = 1, whose origin is the camera's centre at the window's middle:
ρ = m · R r₁ / (1 − m · c).  Windows are a few seconds long, each with its own velocity and plane.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from virest.arrays import Array, Index, Mask
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.effects.touches import touched
from virest.image_formation.row_clock import RowClock
from virest.motion.displacement import Displacement, force_at_samples, integrate_accelerometer
from virest.motion.integration import integrate_gyro
from virest.motion.measured_rate import MeasuredRate, measured_rate
from virest.motion.optics import MovingLens, moving_lens
from virest.motion.scene_motion import DirectedMotion, InertialMotion, Motion
from virest.motion.trajectory import Orientations, Trajectory

SMALLEST_DEPTH = 0.05
"""Smallest depth of points in front of the camera, relative to the typical depth."""
RAY_STEP = 1e-5
"""Step of forward differences over a ray: derivatives err by 4e-6 of their size, in proportion to it down to 1e-7."""
SHIFT_STEP_S = 2e-3
"""Step of a stabiliser's path: at 10 rad/s² linear interpolation errs by 5e-6 rad, far below the tracking noise."""


_PER_POINT = (
    "pair",
    "window",
    "first",
    "second",
    "first_px",
    "second_px",
    "first_stamp_s",
    "second_stamp_s",
    "first_exposure_s",
    "second_exposure_s",
)


@dataclass(frozen=True)
class TrackTable:
    """All tracked points of all pairs in one table."""

    pair: Index
    """(n,) number of the pair, non-decreasing from 0."""
    window: Index
    """(n,) number of the pair's window."""
    first: Index
    """(n,) movie index of the first frame."""
    second: Index
    first_px: Array
    """(n, 2)."""
    second_px: Array
    """(n, 2)."""
    first_stamp_s: Array
    """(n,) the frame's timestamp from stamp_0, camera clock."""
    second_stamp_s: Array
    first_exposure_s: Array
    """(n,) as logged; 0 where unknown."""
    second_exposure_s: Array
    origin_s: Array
    """(windows,) middle of each window, camera clock from stamp_0."""
    noise_px: Array
    """(pairs,) standard deviation of a tracked step per coordinate, measured without a camera model."""
    bits_per_px: float = np.inf
    """The movie's, mean; inf: pictures that no encoder has predicted from each other."""

    def __len__(self) -> int:
        return len(self.pair)

    @property
    def n_pairs(self) -> int:
        """Number of pairs."""
        return int(self.pair[-1]) + 1 if len(self.pair) else 0

    @property
    def n_windows(self) -> int:
        """Number of windows."""
        return len(self.origin_s)

    def __getstate__(self) -> dict[str, Any]:
        """The fields alone: what follows from them is not sent to other processes."""
        return {one.name: getattr(self, one.name) for one in fields(self)}

    @cached_property
    def both_px(self) -> Array:
        """(2 n, 2) the first points, then the second: one call for both costs little more than one for either."""
        return np.concatenate([self.first_px, self.second_px])

    @cached_property
    def both_stamp_s(self) -> Array:
        """(2 n,) their frames' timestamps."""
        return np.concatenate([self.first_stamp_s, self.second_stamp_s])

    @cached_property
    def both_exposure_s(self) -> Array:
        """(2 n,) their frames' exposures, as logged."""
        return np.concatenate([self.first_exposure_s, self.second_exposure_s])

    def chosen(self, rows: Mask) -> TrackTable:
        """The table with some of its points; pairs keep their numbers."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _PER_POINT})


@dataclass(frozen=True, slots=True)
class IntegratedMotion:
    """Inertial samples integrated with a profile: reusable while its gyroscope and lens parameters stay the same."""

    profile: CameraProfile
    trajectory: Trajectory
    displacement: Displacement | None
    lens: MovingLens
    measured: Measured


@dataclass(frozen=True, slots=True)
class Measured:
    """Results from the inertial samples that do not depend on the profile and are computed once."""

    gyro: MeasuredRate
    force: tuple[Array, Array] | None
    """The result of :func:`force_at_samples`."""


@dataclass(frozen=True, slots=True)
class Poses:
    """Times of the points' observations and the camera's orientations then: the same for every lens and scene."""

    trajectory: Trajectory
    exposure_scale: float
    both_s: Array
    """(2 n,) IMU clock: the first observations, then the second."""
    both_exposure_s: Array
    """(2 n,) around those times, over which motion is averaged."""
    before: Orientations
    """At the first observation."""
    after: Orientations
    """At the second observation."""

    @property
    def first_s(self) -> Array:
        """(n,) times of the first observations."""
        return self.both_s[: len(self.both_s) // 2]

    @property
    def second_s(self) -> Array:
        """(n,) times of the second observations."""
        return self.both_s[len(self.both_s) // 2 :]

    @property
    def first_exposure_s(self) -> Array:
        """(n,) exposures of the first observations."""
        return self.both_exposure_s[: len(self.both_s) // 2]

    @property
    def second_exposure_s(self) -> Array:
        """(n,) exposures of the second observations."""
        return self.both_exposure_s[len(self.both_s) // 2 :]

    def again(self, lens: MovingLens, rays: Array) -> Array:
        """Pixels (..., n, 2) of rays (..., n, 3), camera axes, at the second observation."""
        return lens.project(rays, self.second_s, self.second_exposure_s)


@dataclass(frozen=True, slots=True)
class Sightings:
    """Rays through the first points with the stabiliser at rest: the same for every motion of a lens."""

    lens: Intrinsics
    rays: Array
    """(n, 3)."""


@dataclass(frozen=True, slots=True)
class Prediction:
    """Predicted points, and their dependence on the scene and on the camera's translation."""

    second_px: Array
    """(n, 2)."""
    poses: Poses
    along_px: Array | None = None
    """(n, 2) change of second_px per unit of inverse depth; None without translation."""
    slopes: Array | None = None
    """(n, 2, k) change per entry of the motion's vector."""
    moved: Moved | None = None
    """The camera's motion between the two observations; None without translation."""
    per_step: Array | None = None
    """(n, 2, 3) change of second_px per unit of the camera's step over a point's depth, world axes; if requested."""
    sights: Sightings | None = None
    """Rays through the first points."""

    @property
    def first_s(self) -> Array:
        """(n,) times of the first points, IMU clock."""
        return self.poses.first_s

    @property
    def second_s(self) -> Array:
        """(n,) times of the second points, IMU clock."""
        return self.poses.second_s


def integrate_motion(
    imu: ImuSamples, profile: CameraProfile, *, translation: bool, measured: Measured | None = None
) -> IntegratedMotion:
    """Integrate the inertial samples with a profile's bias, scale and rotation; measured: of an earlier call."""
    measured = measured or Measured(measured_rate(imu), force_at_samples(imu) if translation else None)
    trajectory = integrate_gyro(imu, profile, measured.gyro)
    displacement = integrate_accelerometer(imu, profile, trajectory, measured.force) if translation else None
    return IntegratedMotion(profile, trajectory, displacement, moving_lens(trajectory, profile, SHIFT_STEP_S), measured)


def with_profile(known: IntegratedMotion, imu: ImuSamples, profile: CameraProfile) -> IntegratedMotion:
    """The integrated motion for another profile, reusing everything that the change does not affect."""
    change = touched(known.profile, profile)
    if change.rates:
        return integrate_motion(imu, profile, translation=known.displacement is not None, measured=known.measured)
    like = None if change.axes else known.lens
    if change.axes:
        known = _turned_about(known, profile.rotation_cam_imu @ known.profile.rotation_cam_imu.T)
    if change.axes or change.lens:
        known = replace(known, lens=moving_lens(known.trajectory, profile, SHIFT_STEP_S, like))
    return replace(known, profile=profile)


def _turned_about(known: IntegratedMotion, turn: Array) -> IntegratedMotion:
    """The integrated motion with the camera's axes rotated by (3, 3) on the IMU; world axes rotate with them."""
    way = known.trajectory
    trajectory = Trajectory(way.time_s, turn @ way.rotation_world_cam @ turn.T, turn @ way.rate_polynomials)
    displacement = None if known.displacement is None else known.displacement.turned(turn, trajectory)
    return replace(known, trajectory=trajectory, displacement=displacement)


def seen_s(profile: CameraProfile, points_px: Array, stamp_s: Array, exposure_s: Array) -> Array:
    """Middle of the exposure of the points' rows, IMU clock (n,); with flicker, the mean time of the light."""
    middle_s = RowClock(profile).seen_s(points_px, stamp_s, exposure_s)
    if not profile.extensions.flicker_amplitude:
        return middle_s
    return middle_s + pulse_delay_s(profile, middle_s, np.asarray(profile.shutter.true_exposure_s(exposure_s)))


def pulse_delay_s(profile: CameraProfile, middle_s: Array, exposure_s: Array) -> Array:
    """Mean delay (n,) of the light relative to the middle of an exposure, with flicker.

    Mean of τ over |τ| < E/2 weighted by 1 + a sin(ω(t + τ) + φ): a cos(ωt + φ) (sin x − x cos x) 2/ω² over the light,
    E + a sin(ωt + φ) 2 sin(x)/ω, x = ωE/2.
    """
    extensions = profile.extensions
    omega, amplitude = 2 * np.pi * extensions.flicker_frequency_hz, extensions.flicker_amplitude
    angle, half = omega * middle_s + extensions.flicker_phase_rad, 0.5 * omega * exposure_s
    moment = amplitude * np.cos(angle) * 2 * (np.sin(half) - half * np.cos(half)) / omega**2
    light = exposure_s + amplitude * np.sin(angle) * 2 * np.sin(half) / omega
    return np.asarray(moment / np.maximum(light, 1e-6))


def predict(
    known: IntegratedMotion,
    table: TrackTable,
    scene: Motion | None,
    *,
    slopes: bool = False,
    like: Prediction | None = None,
) -> Prediction:
    """Predict the second points (n, 2); scene None: rotation only.

    like: an earlier prediction of the same table, whose unaffected parts are reused.
    """
    poses, sights = _poses(known, table, like), _sights(known.lens, table, like)
    world = world_rays(known, table, poses, sights)
    if scene is None or isinstance(scene, DirectedMotion):
        rays = poses.after.to_camera(world)
        expected = poses.again(known.lens, rays)
        if scene is None:
            return Prediction(expected, poses, sights=sights)
        per_step = poses.after.per_world(lens_slope(known.lens, rays, poses, expected))
        step = scene.direction[scene.group(table.pair)]
        along = np.squeeze(per_step @ step[..., None], -1)
        return Prediction(expected, poses, along, per_step=per_step, sights=sights)
    paths = like.moved.paths if like is not None and like.moved is not None and like.poses is poses else None
    paths = paths or _paths(known, table, scene, poses)
    seen = _seen_again(known, world, poses, _moved_inertially(table, scene, world, paths, slopes))
    return replace(seen, sights=sights)


def world_rays(known: IntegratedMotion, table: TrackTable, poses: Poses, sights: Sightings | None) -> Array:
    """Rays (n, 3) through the first points, world axes."""
    at_rest = known.lens.rays_at_rest(table.first_px, poses.first_s) if sights is None else sights.rays
    return poses.before.to_world(known.lens.from_rest(at_rest, poses.first_s, poses.first_exposure_s))


def _sights(lens: MovingLens, table: TrackTable, like: Prediction | None) -> Sightings | None:
    """Rays through the first points, reused from an earlier prediction with the same lens.

    None: the focal length changes, so rays depend on the time.
    """
    if lens.focal_drift_per_s or lens.zoom:
        return None
    if like is not None and like.sights is not None and like.sights.lens == lens.lens:
        return like.sights
    return Sightings(lens.lens, lens.lens.rays(table.first_px))


def lens_slope(lens: MovingLens, rays: Array, poses: Poses, expected: Array) -> Array:
    """Change (n, 2, 3) of pixels per unit of each part of rays (n, 3)."""
    steps = poses.again(lens, rays + RAY_STEP * np.eye(3)[:, None])
    return np.ascontiguousarray(np.moveaxis((steps - expected) / RAY_STEP, 0, -1))


def _poses(known: IntegratedMotion, table: TrackTable, like: Prediction | None) -> Poses:
    """Times and orientations of the points' observations; those of an earlier prediction if they are the same."""
    profile, scale = known.profile, known.profile.shutter.exposure_scale
    both_s = seen_s(profile, table.both_px, table.both_stamp_s, table.both_exposure_s)
    if like is not None:
        old = like.poses
        same = old.trajectory is known.trajectory and old.exposure_scale == scale
        if same and np.array_equal(both_s, old.both_s):
            return old
    exposure_s = scale * table.both_exposure_s
    before, after = known.trajectory.mean_orientation(both_s, exposure_s).halves()
    return Poses(known.trajectory, scale, both_s, exposure_s, before, after)


@dataclass(frozen=True, slots=True)
class Paths:
    """Parts of the camera's centre at one observation of each point, relative to its window's middle."""

    since_s: Array
    """(n,) from the window's middle."""
    path: Array
    """(n, 3) without velocity, gravity, bias and delay, world axes."""
    per_bias: Array
    """(n, 3, 3)."""
    per_delay: Array
    """(n, 3)."""

    def centre(self, scene: InertialMotion, velocity: Array) -> Array:
        """Camera's centre (n, 3), world axes."""
        moved = self.path + velocity * self.since_s[:, None] + 0.5 * scene.gravity_m_s2 * self.since_s[:, None] ** 2
        biased = (self.per_bias.reshape(-1, 3) @ scene.accel_bias_m_s2).reshape(-1, 3)
        return moved - biased + self.per_delay * scene.accel_delay_s

    def shared_slopes(self) -> Array:
        """Change (n, 3, 7) of the centre per gravity, accelerometer bias and delay."""
        fallen = np.eye(3) * (0.5 * self.since_s**2)[:, None, None]
        return np.concatenate([fallen, -self.per_bias, self.per_delay[..., None]], axis=-1)


@dataclass(frozen=True, slots=True)
class Moved:
    """Displacement c(t₁) − c(t₂) of the camera and the inverse depth of each point, world axes."""

    step: Array
    """(n, 3)."""
    paths: tuple[Paths, Paths] | None
    """At both observations, if the path is from the accelerometer."""
    inverse_depth: Array
    """(n,)."""
    per_entry: Array | None
    """(n, 3, k) change of step · inverse depth per entry of the motion's vector."""


def _paths(known: IntegratedMotion, table: TrackTable, scene: InertialMotion, poses: Poses) -> tuple[Paths, Paths]:
    assert known.displacement is not None
    origin_s, count = np.asarray(known.profile.imu_time_s(table.origin_s)), len(table)
    window = np.concatenate([table.window, table.window])
    found = (poses.both_s - origin_s[window], *known.displacement.at(poses.both_s, origin_s, window))
    return Paths(*(part[:count] for part in found)), Paths(*(part[count:] for part in found))


def _seen_again(known: IntegratedMotion, world: Array, poses: Poses, moved: Moved) -> Prediction:
    rays = poses.after.to_camera(world + moved.step * moved.inverse_depth[:, None])
    rays[:, 2] = np.maximum(rays[:, 2], SMALLEST_DEPTH)
    expected = poses.again(known.lens, rays)
    if moved.per_entry is None:
        ahead = rays + RAY_STEP * poses.after.to_camera(moved.step)
        return Prediction(expected, poses, (poses.again(known.lens, ahead) - expected) / RAY_STEP, None, moved)
    per_world = poses.after.per_world(lens_slope(known.lens, rays, poses, expected))
    along = np.squeeze(per_world @ moved.step[..., None], -1)
    return Prediction(expected, poses, along, per_world @ moved.per_entry, moved)


def _moved_inertially(
    table: TrackTable, scene: InertialMotion, world: Array, paths: tuple[Paths, Paths], slopes: bool
) -> Moved:
    window, plane = table.window, scene.plane_per_m[table.window]
    centre_1, centre_2 = (path.centre(scene, scene.velocity_m_s[window]) for path in paths)
    clearance = np.maximum(1 - (plane * centre_1).sum(axis=-1), SMALLEST_DEPTH)
    inverse_depth = np.maximum((plane * world).sum(axis=-1) / clearance, 0.0)
    step = centre_1 - centre_2
    if not slopes:
        return Moved(step, paths, inverse_depth, None)
    since_1, since_2, each = paths[0].since_s, paths[1].since_s, np.eye(3)[None]
    nearer = (inverse_depth / clearance)[:, None] * plane  # change of the inverse depth per metre of the first centre
    per_plane = world / clearance[:, None] + (inverse_depth / clearance)[:, None] * centre_1
    per_plane[inverse_depth == 0] = 0.0  # beyond the plane's horizon
    if scene.plane_axes is not None:
        per_plane = np.einsum("ni,nij->nj", per_plane, scene.plane_axes[window])
    first, second = (path.shared_slopes() for path in paths)
    shared = (first - second) * inverse_depth[:, None, None]
    shared = shared + step[:, :, None] * np.einsum("ni,nik->nk", nearer, first)[:, None, :]
    own = np.zeros((len(world), 3, scene.windows, 6))
    rows = np.arange(len(world))
    own[rows, :, window, :3] = each * ((since_1 - since_2) * inverse_depth)[:, None, None]
    own[rows, :, window, :3] += step[:, :, None] * (nearer * since_1[:, None])[:, None, :]
    own[rows, :, window, 3:] = step[:, :, None] * per_plane[:, None, :]
    per_entry = np.concatenate([shared, own.reshape(len(world), 3, -1)], axis=-1)
    return Moved(step, paths, inverse_depth, per_entry)


def centre(
    displacement: Displacement, scene: InertialMotion, velocity: Array, time_s: Array, origin_s: Array
) -> tuple[Array, Array, Array]:
    """Camera centre (n, 3) relative to origin_s, world axes, and its changes per bias (n, 3, 3), delay (n, 3)."""
    path = Paths(time_s - origin_s, *displacement.at(time_s, origin_s))
    return path.centre(scene, velocity), path.per_bias, path.per_delay
