"""Where tracked points should be: one model of clock, gyroscope, lens, readout, translation and depth (eqs 4-14, 28).

A point seen at p₁ in one frame is seen in the next at

    p₂ = project(R(t₂)ᵀ (R(t₁) r₁ + (c(t₁) − c(t₂)) ρ)),   r₁ = rays(p₁),

with R, c the camera's orientation and centre in world axes and each t the middle of the exposure of the point's row.
A point's blurred image sits at the mean of its path, so R is taken as the mean over the exposure, R exp(ω' E²/24).
ρ is the inverse depth of r₁ on the plane m · X = 1, whose origin is the camera's centre at the window's middle:
ρ = m · R r₁ / (1 − m · c).  Windows are stretches of a few seconds, each with its own velocity and plane.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.motion.displacement import Displacement, integrate_accelerometer
from virest.motion.integration import integrate_gyro
from virest.motion.optics import MovingLens, moving_lens
from virest.motion.scene_motion import DirectedMotion, InertialMotion, Motion
from virest.motion.tracking import TrackPair
from virest.motion.trajectory import Trajectory, rotation_from_vector

Array = NDArray[np.float64]
Index = NDArray[np.intp]
SMALLEST_DEPTH = 0.05
"""Points are held at least this part of the typical depth before the camera."""
RAY_STEP = 1e-5


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


@dataclass(frozen=True, slots=True)
class TrackTable:
    """All tracked points of all pairs in one table."""

    pair: Index
    """(n,) number of the pair, rising from 0."""
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
    """(n,) the frame's stamp from stamp_0, camera clock."""
    second_stamp_s: Array
    first_exposure_s: Array
    """(n,) as logged; 0 where unknown."""
    second_exposure_s: Array
    origin_s: Array
    """(windows,) middle of each window, camera clock from stamp_0."""
    noise_px: Array
    """(pairs,) standard deviation of a tracked step per coordinate, measured without any camera model."""

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

    def chosen(self, rows: NDArray[np.bool_]) -> TrackTable:
        """The table with some of its points; pairs keep their numbers."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _PER_POINT})


@dataclass(frozen=True, slots=True)
class Ground:
    """What a profile makes of the inertial samples: kept while its gyroscope and lens stay the same."""

    profile: CameraProfile
    trajectory: Trajectory
    displacement: Displacement | None
    lens: MovingLens


@dataclass(frozen=True, slots=True)
class Prediction:
    """Points as the model sees them, and how they depend on the scene and on the camera's translation."""

    second_px: Array
    """(n, 2)."""
    first_s: Array
    """(n,) IMU clock."""
    second_s: Array
    along_px: Array | None = None
    """(n, 2) change of second_px per unit of inverse depth; None without translation."""
    slopes: Array | None = None
    """(n, 2, k) change per entry of the motion's vector."""


def ground(imu: ImuSamples, profile: CameraProfile, *, translation: bool) -> Ground:
    """Integrate the inertial samples with a profile's bias, scale and rotation."""
    trajectory = integrate_gyro(imu, profile)
    displacement = integrate_accelerometer(imu, profile, trajectory) if translation else None
    return Ground(profile, trajectory, displacement, moving_lens(trajectory, profile))


def with_profile(known: Ground, imu: ImuSamples, profile: CameraProfile) -> Ground:
    """Return the ground for another profile; what does not depend on the change is kept."""
    before = known.profile
    same = ("gyro_bias_rad_s", "gyro_scale", "r_cam_imu", "p_cam_imu_m")
    if any(getattr(before, name) != getattr(profile, name) for name in same):
        return ground(imu, profile, translation=known.displacement is not None)
    return replace(known, profile=profile, lens=moving_lens(known.trajectory, profile))


def track_table(
    pairs: Sequence[TrackPair],
    stamp_s: Array,
    exposure_s: Array,
    noise_px: Array,
    windows: Sequence[Sequence[int]] | None = None,
) -> TrackTable:
    """Lay out pairs; stamp_s, exposure_s (frames,) by movie index, exposure 0 where unknown.

    windows: numbers of the pairs in each window; None: one window.
    """
    windows = windows or [range(len(pairs))]
    sizes = [len(pair) for pair in pairs]
    first = np.repeat([pair.first for pair in pairs], sizes)
    second = np.repeat([pair.second for pair in pairs], sizes)
    number = np.zeros(len(pairs), np.intp)
    for k, members in enumerate(windows):
        number[list(members)] = k
    middles = np.array([0.5 * (stamp_s[pair.first] + stamp_s[pair.second]) for pair in pairs])
    origin = np.array([middles[number == k].mean() if (number == k).any() else 0.0 for k in range(len(windows))])
    return TrackTable(
        np.repeat(np.arange(len(pairs)), sizes),
        np.repeat(number, sizes),
        first,
        second,
        np.concatenate([pair.points_first_px for pair in pairs]),
        np.concatenate([pair.points_second_px for pair in pairs]),
        stamp_s[first],
        stamp_s[second],
        exposure_s[first],
        exposure_s[second],
        origin,
        noise_px,
    )


def seen_s(profile: CameraProfile, points_px: Array, stamp_s: Array, exposure_s: Array) -> Array:
    """Middle of the exposure of the points' rows, IMU clock (n,); under pulsing lamps the mean time of the light."""
    shutter = profile.shutter
    fraction = shutter.readout_fraction(points_px, profile.width, profile.height)
    start_s = shutter.first_row_start_s(stamp_s, exposure_s) + fraction * shutter.readout_time_s
    middle_s = np.asarray(profile.imu_time_s(start_s + 0.5 * shutter.true_exposure_s(exposure_s)))
    if not profile.extensions.flicker_amplitude:
        return middle_s
    return middle_s + pulse_delay_s(profile, middle_s, np.asarray(shutter.true_exposure_s(exposure_s)))


def pulse_delay_s(profile: CameraProfile, middle_s: Array, exposure_s: Array) -> Array:
    """How much later than its middle the light of an exposure arrives on the mean, (n,), under pulsing lamps.

    Mean of τ over |τ| < E/2 weighted by 1 + a sin(ω(t + τ) + φ): a cos(ωt + φ) (sin x − x cos x) 2/ω² over the light,
    E + a sin(ωt + φ) 2 sin(x)/ω, x = ωE/2.
    """
    extensions = profile.extensions
    omega, amplitude = 2 * np.pi * extensions.flicker_frequency_hz, extensions.flicker_amplitude
    angle, half = omega * middle_s + extensions.flicker_phase_rad, 0.5 * omega * exposure_s
    moment = amplitude * np.cos(angle) * 2 * (np.sin(half) - half * np.cos(half)) / omega**2
    light = exposure_s + amplitude * np.sin(angle) * 2 * np.sin(half) / omega
    return np.asarray(moment / np.maximum(light, 1e-6))


def predict(known: Ground, table: TrackTable, scene: Motion | None, *, slopes: bool = False) -> Prediction:
    """Predict the second points (n, 2); scene None: rotation only."""
    profile, scale = known.profile, known.profile.shutter.exposure_scale
    first_s = seen_s(profile, table.first_px, table.first_stamp_s, table.first_exposure_s)
    second_s = seen_s(profile, table.second_px, table.second_stamp_s, table.second_exposure_s)
    before = mean_orientation(known.trajectory, first_s, scale * table.first_exposure_s)
    after = mean_orientation(known.trajectory, second_s, scale * table.second_exposure_s)
    rays = known.lens.rays(table.first_px, first_s)
    back = np.swapaxes(after, -1, -2)
    if scene is None:
        return Prediction(known.lens.project(turned(back, turned(before, rays)), second_s), first_s, second_s)
    world = turned(before, rays)
    if isinstance(scene, DirectedMotion):
        step = scene.direction[scene.group(table.pair)]
        moved = _Moved(step, np.zeros(len(table)), np.zeros((len(table), 3, 0)))
    else:
        moved = _moved_inertially(known, table, scene, world, first_s, second_s, slopes)
    return _seen_again(known, world, back, moved, first_s, second_s)


@dataclass(frozen=True, slots=True)
class _Moved:
    """Displacement c(t₁) − c(t₂) of the camera and the inverse depth of each point, world axes."""

    step: Array
    """(n, 3)."""
    inverse_depth: Array
    """(n,)."""
    per_entry: Array | None
    """(n, 3, k) change of step · inverse depth per entry of the motion's vector."""


def _seen_again(known: Ground, world: Array, back: Array, moved: _Moved, first_s: Array, second_s: Array) -> Prediction:
    rays = turned(back, world + moved.step * moved.inverse_depth[:, None])
    rays[:, 2] = np.maximum(rays[:, 2], SMALLEST_DEPTH)
    expected = known.lens.project(rays, second_s)
    if moved.per_entry is None:
        return Prediction(expected, first_s, second_s)
    lens_slope = np.stack(
        [(known.lens.project(rays + RAY_STEP * axis, second_s) - expected) / RAY_STEP for axis in np.eye(3)], axis=-1
    )
    per_world = lens_slope @ back
    along = np.squeeze(per_world @ moved.step[..., None], -1)
    return Prediction(expected, first_s, second_s, along, per_world @ moved.per_entry)


def _moved_inertially(
    known: Ground,
    table: TrackTable,
    scene: InertialMotion,
    world: Array,
    first_s: Array,
    second_s: Array,
    slopes: bool,
) -> _Moved:
    assert known.displacement is not None
    window, plane = table.window, scene.plane_per_m[table.window]
    origin_s = np.asarray(known.profile.imu_time_s(table.origin_s))[window]
    velocity = scene.velocity_m_s[window]
    centre_1, bias_1, delay_1 = centre(known.displacement, scene, velocity, first_s, origin_s)
    centre_2, bias_2, delay_2 = centre(known.displacement, scene, velocity, second_s, origin_s)
    clearance = np.maximum(1 - (plane * centre_1).sum(axis=-1), SMALLEST_DEPTH)
    inverse_depth = np.maximum((plane * world).sum(axis=-1) / clearance, 0.0)
    step = centre_1 - centre_2
    if not slopes:
        return _Moved(step, inverse_depth, None)
    since_1, since_2, each = first_s - origin_s, second_s - origin_s, np.eye(3)[None]
    nearer = (inverse_depth / clearance)[:, None] * plane  # change of the inverse depth per metre of the first centre
    per_plane = world / clearance[:, None] + (inverse_depth / clearance)[:, None] * centre_1
    if scene.plane_axes is not None:
        per_plane = np.einsum("ni,nij->nj", per_plane, scene.plane_axes[window])
    first, second = (
        _shared_slopes(each, since, bias, delay)
        for since, bias, delay in ((since_1, bias_1, delay_1), (since_2, bias_2, delay_2))
    )
    shared = (first - second) * inverse_depth[:, None, None]
    shared = shared + step[:, :, None] * np.einsum("ni,nik->nk", nearer, first)[:, None, :]
    own = np.zeros((len(world), 3, scene.windows, 6))
    rows = np.arange(len(world))
    own[rows, :, window, :3] = each * ((since_1 - since_2) * inverse_depth)[:, None, None]
    own[rows, :, window, :3] += step[:, :, None] * (nearer * since_1[:, None])[:, None, :]
    own[rows, :, window, 3:] = step[:, :, None] * per_plane[:, None, :]
    return _Moved(step, inverse_depth, np.concatenate([shared, own.reshape(len(world), 3, -1)], axis=-1))


def _shared_slopes(each: Array, since: Array, bias: Array, delay: Array) -> Array:
    """Change (n, 3, 7) of the camera's centre per gravity, accelerometer bias and delay."""
    return np.concatenate([each * (0.5 * since**2)[:, None, None], -bias, delay[..., None]], axis=-1)


def centre(
    displacement: Displacement, scene: InertialMotion, velocity: Array, time_s: Array, origin_s: Array
) -> tuple[Array, Array, Array]:
    """Camera centre (n, 3) from its place at origin_s, world axes, and its changes per bias (n, 3, 3), delay (n, 3)."""
    path, per_bias, per_delay = displacement.at(time_s, origin_s)
    since = (time_s - origin_s)[:, None]
    moved = path + velocity * since + 0.5 * scene.gravity_m_s2 * since**2
    return moved - per_bias @ scene.accel_bias_m_s2 + per_delay * scene.accel_delay_s, per_bias, per_delay


def mean_orientation(trajectory: Trajectory, middle_s: Array, exposure_s: Array) -> Array:
    """R_world_cam averaged over exposures about the times (n,): R exp(ω' E² / 24), to second order."""
    bend = trajectory.angular_acceleration_rad_s2(middle_s) * (exposure_s**2 / 24)[:, None]
    return trajectory.orientation(middle_s) @ rotation_from_vector(bend)


def turned(rotation: Array, rays: Array) -> Array:
    """Apply rotations (n, 3, 3) to rays (n, 3)."""
    return np.einsum("nij,nj->ni", rotation, rays)
