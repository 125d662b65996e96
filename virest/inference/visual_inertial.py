"""Where the camera went, in metres: tracked points, gyroscope and accelerometer together (eqs 4-6; after VINS-Mono).

A capture is cut into stretches, each with its own gravity, accelerometer bias and delay; a stretch into windows of a
few seconds, each with its own velocity and plane.  Within a window the velocity at any instant follows from the
accelerometer.  Scale comes from accelerations only: whether the motion determines it is judged window by window, and
a window that fails gives its reason instead of a velocity.  What a picture shows is velocity over depth, which needs no
scale: it is judged for itself, and serves to restore where metres are not known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.capture.records import Frame
from virest.image_formation.point_model import IntegratedMotion, TrackTable, centre, ground, with_profile
from virest.inference.coarse_alignment import MIN_PAIRS
from virest.inference.depth import (
    FrameDepth,
    Sightings,
    TriangulatedPoints,
    frame_depth,
    triangulate,
    triangulate_relief,
)
from virest.inference.observed_tracks import WINDOW_S, ObservedTracks
from virest.inference.profile_terms import (
    FOCAL,
    GYRO_BIAS,
    NEAR_AXES,
    SMALL_BIAS,
    STATED_OFFSET,
    TIME_OFFSET,
    UNKNOWN_READOUT,
)
from virest.inference.relief import View, WindowRelief, find_relief, picture_grid
from virest.inference.robust import RAYLEIGH_MEDIAN
from virest.inference.track_fit import Term, TrackFit, fit_tracks, start_scene
from virest.inference.tracking_bias import SHARED_RELIEF
from virest.motion.displacement import Displacement
from virest.motion.optics import settling_time_s
from virest.motion.scene_motion import InertialMotion

Array = NDArray[np.float64]
STRETCH_S = 14.0
"""Windows that share gravity and the accelerometer's bias; in this time a gyroscope drifts by a few mrad."""
RUNS_PER_WINDOW, RUN_FRAMES = 4, 7
"""Frames to be tracked: runs of consecutive ones, spread over each window."""
POINTS_PER_WINDOW = 800
MIN_POINTS = 200
START_INVERSE_DEPTH_PER_M = 0.5
MAX_RELATIVE_STD = 0.1
"""Of the scale, and of the velocity over its rms within a window; beyond it no metres are said."""
MAX_FLOW_STD = 0.2
"""Of velocity over depth, part of its rms, where metres are not known: rotation alone errs by all of it.  Inertial data
of another recording, bent until they fit, leave 0.3 and more; those of the recording itself hardly 0.12."""
MAX_PRIOR_STD = 3.0
"""Reject fits that move a parameter of the profile by more than this many prior standard deviations."""
MIN_PARALLAX = 1.15
"""Rotation alone must leave this many times what is left with translation."""
MAX_LEFT = 0.15
"""Part of the parallax's power that the accelerometer's path may leave unexplained."""
MAX_SPREAD = 0.6
"""Spread of inverse depths about the plane, as part of its inverse depth."""
GRAVITY_M_S2, GRAVITY_TOLERANCE_M_S2 = 9.81, 0.7
MAX_ITERATIONS = 15
STILL_ITERATIONS = 8
"""Rotation alone is there to be compared with; it does not matter to the last digit."""
STATED_DEPTH_STD = 0.02
"""How far a profile's depth may be off, part of it."""
TRACKING_BIAS_PX = 0.04
"""Tracking's own bias under blur and codec: a steady error of a step, which is an error of the velocity."""
OFFSET_FLOOR_S = 3e-5
"""And its error in time."""
ACCEL_SCALE_STD = 0.01
"""How far a phone's accelerometer may be off in scale (makers' tolerance of its sensitivity): lengths go with it."""
IMU_MARGIN_S = 2.5
"""A stretch takes the inertial samples up to this far beyond its tracked points."""
NEAR_WINDOW_S = 1.5
"""Frames this far beyond a window's tracked points still take its velocity."""


@dataclass(frozen=True, slots=True)
class Window:
    """A few seconds, judged."""

    start_s: float
    """First tracked frame's stamp, camera clock."""
    end_s: float
    scale_std: float
    """Relative standard deviation of the metric scale: that of the plane's inverse depth along the optical axis."""
    velocity_std: float
    """rms standard deviation of the velocity over its rms."""
    parallax: float
    """What rotation alone leaves over what is left with translation."""
    residual: float
    """Robust standard deviation of what is left, in units of the tracking noise."""
    reason: str
    """Why the window's velocity is not known in metres; empty: it is."""
    spread: float = 0.0
    """Standard deviation of inverse depths about the plane, part of the plane's."""
    flow_std: float = 0.0
    """rms standard deviation of velocity over depth, part of its rms."""
    over_depth: bool = False
    """Whether velocity over depth is known although metres are not."""

    @property
    def usable(self) -> bool:
        """Whether pictures may be restored by the window's velocity over its depth."""
        return not self.reason or self.over_depth


@dataclass(frozen=True, slots=True)
class Stretch:
    """Windows fitted together."""

    fit: TrackFit
    table: TrackTable
    windows: tuple[Window, ...]
    points: TriangulatedPoints
    velocity_floor_m_s: Array
    """(windows,) what tracking's own bias makes of the velocity."""
    nudged: tuple[IntegratedMotion, ...]
    """The fit's ground with each value of its terms one quotient's step further."""
    reliefs: tuple[WindowRelief | None, ...] = ()
    """By window; None: the plane tells held-out points as well as a surface does."""

    @property
    def scene(self) -> InertialMotion:
        """The fitted path and planes."""
        assert isinstance(self.fit.scene, InertialMotion)
        return self.fit.scene

    def gravity(self) -> tuple[Array, Array]:
        """Gravity (3,) in world axes, m/s², and its standard deviations."""
        return self.scene.gravity_m_s2, self._std(slice(0, 3))

    def accel_bias(self) -> tuple[Array, Array]:
        """The accelerometer's bias (3,) in IMU axes, m/s², and its standard deviations."""
        return self.scene.accel_bias_m_s2, self._std(slice(3, 6))

    def accel_delay(self) -> tuple[float, float]:
        """Seconds by which accelerations are older than their stamps, and the standard deviation."""
        return self.scene.accel_delay_s, float(self._std(slice(6, 7))[0])

    def _std(self, part: slice) -> Array:
        return np.sqrt(np.maximum(np.diag(self.scene_covariance)[part], 0.0))

    @property
    def scene_covariance(self) -> Array:
        """Of the scene's vector."""
        terms = len(self.fit.change)
        return self.fit.covariance[terms:, terms:]

    def origin_s(self, window: int) -> float:
        """Middle of a window, IMU clock."""
        return float(self.fit.profile.imu_time_s(self.table.origin_s[window]))

    def velocity(self, window: int, time_s: Array) -> Array:
        """Velocity (n, 3) of the camera's centre in world axes, IMU clock (n,)."""
        return self._velocity(self.fit.ground, window, time_s)

    def seen_velocity(self, window: int, stamp_s: Array) -> tuple[Array, Array]:
        """Velocity (n, 3) in the camera's axes at stamps (n,), camera clock, and its covariance (n, 3, 3)."""
        velocity, _, slope, _ = self._seen(window, stamp_s)
        covariance = self.fit.doubt.of(slope) + SHARED_RELIEF**2 * self.fit.doubt.by_relief(slope)
        scale = ACCEL_SCALE_STD**2 * velocity[:, :, None] * velocity[:, None, :]
        return velocity, covariance + scale + self.velocity_floor_m_s[window] ** 2 * np.eye(3)

    def flow(self, window: int, stamp_s: Array) -> tuple[Array, Array]:
        """Velocity over depth (n, 3) on the optical axis, 1/s, camera axes at stamps (n,), and its covariance.

        A common scale of velocity and depth cancels, however little is known of it.
        """
        velocity, nearness, slope, nearness_slope = self._seen(window, stamp_s)
        slope = nearness[:, None, None] * slope + velocity[:, :, None] * nearness_slope[:, None, :]
        floor = self.velocity_floor_m_s[window] * nearness
        return nearness[:, None] * velocity, self.fit.doubt.of(slope) + (floor**2)[:, None, None] * np.eye(3)

    def _seen(self, window: int, stamp_s: Array) -> tuple[Array, Array, Array, Array]:
        """Velocity (n, 3) in camera axes, inverse depth (n,) of the plane on the optical axis, and their slopes.

        Slopes (n, 3, k) and (n, k) are per unit of everything that was fitted.  The terms of the profile count too: a
        turned IMU turns gravity with it, which costs the velocity nothing.
        """
        velocity, nearness, rotation = self._seen_from(self.fit.ground, window, stamp_s)
        slope = np.zeros((len(stamp_s), 3, len(self.fit.covariance)))
        nearness_slope = np.zeros((len(stamp_s), slope.shape[-1]))
        quotients = [step for term in self.fit.terms for step in term.quotient]
        for k, (nudged, quotient) in enumerate(zip(self.nudged, quotients, strict=True)):
            moved, nearer, _ = self._seen_from(nudged, window, stamp_s)
            slope[..., k] = (moved - velocity) / quotient
            nearness_slope[:, k] = (nearer - nearness) / quotient
        own = len(quotients) + 7 + 6 * window
        back = np.swapaxes(rotation, -1, -2)
        time_s = np.asarray(self.fit.profile.imu_time_s(stamp_s))
        moves, origin = self.fit.ground.displacement, np.array([self.origin_s(window)])
        assert moves is not None
        slope[..., len(quotients) : len(quotients) + 7] = back @ _velocity_slope(moves, time_s, origin)
        slope[..., own : own + 3] = back
        nearness_slope[:, own + 3 : own + 6] = rotation[..., 2]
        return velocity, nearness, slope, nearness_slope

    def _seen_from(self, known: IntegratedMotion, window: int, stamp_s: Array) -> tuple[Array, Array, Array]:
        """Velocity in camera axes, inverse depth on the optical axis, and R_world_cam, (n, 3), (n,), (n, 3, 3)."""
        time_s = np.asarray(known.profile.imu_time_s(stamp_s))
        rotation = known.trajectory.orientation(time_s)
        velocity = np.einsum("nji,nj->ni", rotation, self._velocity(known, window, time_s))
        return velocity, np.maximum(rotation[..., 2] @ self.scene.plane_per_m[window], 1e-6), rotation

    def _velocity(self, known: IntegratedMotion, window: int, time_s: Array) -> Array:
        moves, scene = known.displacement, self.scene
        assert moves is not None
        origin = np.array([float(known.profile.imu_time_s(self.table.origin_s[window]))])
        slope = _velocity_slope(moves, time_s, origin)
        own = np.concatenate([scene.gravity_m_s2, scene.accel_bias_m_s2, [scene.accel_delay_s]])
        velocity = scene.velocity_m_s[window] + moves.path(time_s, 1) - moves.path(origin, 1)
        # the IMU's distance from the camera adds −R (ω × p_cam_imu)
        turning = np.cross(known.trajectory.rate_rad_s(time_s), moves.arm_cam_m)
        arm = np.einsum("nij,nj->ni", known.trajectory.orientation(time_s), turning)
        return np.asarray(velocity + slope @ own - arm)

    def plane_std_per_m(self, window: int) -> float:
        """Standard deviation of the plane's inverse depth along the optical axis at the window's middle."""
        _, nearness, _, slope = self._seen(window, self.table.origin_s[[window]])
        return float(np.hypot(np.sqrt(self.fit.doubt.of(slope[:, None, :])[0, 0, 0]), ACCEL_SCALE_STD * nearness[0]))

    def place(self, window: int, time_s: Array) -> Array:
        """Camera's centre (n, 3) from its place at the window's middle, world axes."""
        moves = self.fit.ground.displacement
        assert moves is not None
        velocity = np.broadcast_to(self.scene.velocity_m_s[window], (len(time_s), 3))
        return centre(moves, self.scene, velocity, time_s, np.full(len(time_s), self.origin_s(window)))[0]

    def plane(self, window: int, time_s: float) -> Array:
        """The window's plane (3,) in camera axes at a time: the inverse depth of a ray r with z = 1 is plane · r."""
        plane = self.scene.plane_per_m[window]
        distance = max(1 - float(plane @ self.place(window, np.array([time_s]))[0]), 0.05)
        return np.asarray(self.fit.ground.trajectory.orientation(time_s).T @ plane / distance)

    def depth(self, window: int, time_s: float) -> FrameDepth:
        """The scene before the camera at a time, IMU clock: a plane, and a surface on it where the window has one."""
        found = self.frame_plane(window, time_s)
        relief = self.reliefs[window] if self.reliefs else None
        if relief is None:
            return found
        surface = relief.surface(self.view(window, time_s, found.plane_per_m))
        if surface is None:
            return found
        lens = self.fit.ground.lens
        middle = lens.rays(0.5 * np.array([lens.lens.width - 1.0, lens.lens.height - 1.0]), time_s)
        return found.with_relief(surface, middle, self.windows[window].scale_std)

    def frame_plane(self, window: int, time_s: float) -> FrameDepth:
        """The plane through the points about a time."""
        return frame_depth(
            self.points,
            window,
            time_s,
            self.fit.ground.trajectory.orientation(time_s),
            self.place(window, np.array([time_s]))[0],
            self.fit.ground.lens,
            self.plane(window, time_s),
            self.fit.depth_spread_per_m,
            self.windows[window].scale_std,
        )

    def view(self, window: int, time_s: float, plane_per_m: Array) -> View:
        """The camera's pose at a time before a plane."""
        place = self.place(window, np.array([time_s]))[0]
        return View(time_s, self.fit.ground.trajectory.orientation(time_s), place, plane_per_m)


def _velocity_slope(moves: Displacement, time_s: Array, origin_s: Array) -> Array:
    """Change (n, 3, 7) of the velocity since an origin (1,) per unit of gravity, accelerometer bias and delay."""
    per_bias = (moves.per_bias(time_s, 1) - moves.per_bias(origin_s, 1)).reshape(-1, 3, 3)
    per_delay = moves.per_delay(time_s, 1) - moves.per_delay(origin_s, 1)
    since = (time_s - origin_s)[:, None, None] * np.eye(3)
    return np.concatenate([since, -per_bias, per_delay[..., None]], axis=-1)


@dataclass(frozen=True, slots=True)
class FrameMotion:
    """The camera's centre over one frame, and what it looked at; camera axes at the frame's reference time."""

    velocity_m_s: Array
    """(3,) at the reference time."""
    reference_s: float
    """Camera clock."""
    acceleration_m_s2: Array
    """(3,) mean over the frame, without gravity."""
    depth: FrameDepth
    unscaled: str = ""
    """Why only velocity over depth is known, not metres; empty: metres are."""


@dataclass(frozen=True, slots=True)
class VisualInertialAlignment:
    """Velocity, gravity, scale and accelerometer bias along a capture, as far as its motion determines them."""

    stretches: tuple[Stretch, ...]
    reason: str
    """Why nothing could be fitted at all; empty otherwise."""

    @property
    def windows(self) -> tuple[Window, ...]:
        """All windows in order of time."""
        return tuple(window for stretch in self.stretches for window in stretch.windows)

    @property
    def trusted(self) -> bool:
        """Whether any window's velocity is known in metres."""
        return any(not window.reason for window in self.windows)

    @property
    def refused(self) -> str:
        """Why not all windows' velocities are known in metres, the commonest reason first; empty if all are."""
        if self.reason:
            return self.reason
        reasons = [window.reason for window in self.windows if window.reason]
        return max(reasons, key=reasons.count) if reasons else ""

    def find(self, camera_time_s: float, *, over_depth: bool = False) -> tuple[Stretch, int] | str:
        """The window that an instant (camera clock) belongs to, or why there is none.

        over_depth: windows that know velocity over depth only will do.
        """
        at = [(s, k, _distance(w, camera_time_s), w) for s in self.stretches for k, w in enumerate(s.windows)]
        near = [entry for entry in at if entry[2] <= NEAR_WINDOW_S]
        if not near:
            return self.reason or "no tracked points about this frame"
        good = [entry for entry in near if not entry[3].reason or (over_depth and entry[3].over_depth)]
        if not good or min(entry[2] for entry in good) > min(entry[2] for entry in near) + 0.5 * NEAR_WINDOW_S:
            return min(near, key=lambda entry: entry[2])[3].reason
        stretch, window, _, _ = min(good, key=lambda entry: entry[2])
        return stretch, window

    def frame(self, reference_s: float, start_s: float, end_s: float) -> FrameMotion | str:
        """Motion over a frame that is taken from start_s to end_s, camera clock; or why it is not known."""
        found = self.find(0.5 * (start_s + end_s))
        unscaled = found if isinstance(found, str) else ""
        if unscaled:
            found = self.find(0.5 * (start_s + end_s), over_depth=True)
        if isinstance(found, str):
            return found
        stretch, window = found
        known = stretch.fit.ground
        time_s = np.asarray(known.profile.imu_time_s(np.array([reference_s, start_s, max(end_s, start_s + 1e-3)])))
        velocity = stretch.velocity(window, time_s)
        rotation = known.trajectory.orientation(time_s[0])
        acceleration = (velocity[2] - velocity[1]) / (time_s[2] - time_s[1])
        depth = stretch.depth(window, float(time_s[0]))
        return FrameMotion(velocity[0] @ rotation, reference_s, acceleration @ rotation, depth, unscaled)

    def velocity_std_m_s(self, camera_time_s: Array) -> Array:
        """Standard deviations (n, 3) of the velocity in camera axes at times (n,); NaN where metres are not known.

        Each takes the velocity a dozen times, all of a window's at once: for one frame after the other that is slow.
        """
        places = [self.find(float(time_s)) for time_s in camera_time_s]
        known = [(None, -1) if isinstance(place, str) else place for place in places]
        found = np.full((len(places), 3), np.nan)
        for stretch in self.stretches:
            for window in range(len(stretch.windows)):
                here = np.array([one is stretch and number == window for one, number in known])
                if here.any():
                    covariance = stretch.seen_velocity(window, camera_time_s[here])[1]
                    found[here] = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
        return found

    def clock(self) -> tuple[float, float] | None:
        """Time offset and its standard deviation over the stretches with usable windows; None: there are none."""
        found = [s for s in self.stretches if any(w.usable for w in s.windows)]
        if not found:
            return None
        offset = np.array([s.fit.profile.time_offset_s or 0.0 for s in found])
        std = np.array([_std_with_relief(s.fit, TIME_OFFSET.name)[0] for s in found])
        mean, spread = _mean(offset, np.maximum(std, 1e-6))
        return mean, float(np.hypot(spread, OFFSET_FLOOR_S))

    def gyro_bias(self) -> tuple[Array, Array] | None:
        """Gyroscope bias (3,) and its standard deviations over the stretches with usable windows."""
        found = [s for s in self.stretches if any(w.usable for w in s.windows)]
        if not found:
            return None
        values = np.array([s.fit.profile.gyro_bias_rad_s for s in found])
        stds = np.maximum([_std_with_relief(s.fit, GYRO_BIAS.name) for s in found], 1e-7)
        pairs = [_mean(values[:, k], stds[:, k]) for k in range(3)]
        return np.array([value for value, _ in pairs]), np.array([std for _, std in pairs])


def _std_with_relief(fit: TrackFit, name: str) -> Array:
    """Standard deviations (k,) of a term's values, with what relief that stands in its place does to them."""
    return np.hypot(fit.std(name), SHARED_RELIEF * fit.by_relief[fit.slices[name]])


def _distance(window: Window, time_s: float) -> float:
    return max(window.start_s - time_s, time_s - window.end_s, 0.0)


def _mean(value: Array, std: Array) -> tuple[float, float]:
    """Weighted mean and its standard deviation, widened where the values disagree."""
    weight = std**-2.0
    mean = float((weight * value).sum() / weight.sum())
    disagreement = float((((value - mean) / std) ** 2).sum()) / max(len(value) - 1, 1)
    return mean, float(np.sqrt(max(disagreement, 1.0) / weight.sum()))


# ── which frames ─────────────────────────────────────────────────────────────────────────────────────────────────


def choose_runs(frames: Sequence[Frame]) -> list[int]:
    """Movie indices to decode and track: runs of consecutive usable frames, spread over windows of the capture."""
    usable = [frame for frame in frames if frame.skip_reason is None]
    if not usable:
        return []
    time_s = np.array([frame.time_s for frame in usable])
    parts = max(int(np.ceil((time_s[-1] - time_s[0]) / WINDOW_S)), 1) * RUNS_PER_WINDOW
    edges = np.linspace(time_s[0], time_s[-1], parts + 1)[1:-1]
    chosen: set[int] = set()
    for part in np.split(np.arange(len(usable)), np.searchsorted(time_s, edges)):
        chosen.update(_run(usable, part))
    return sorted(chosen)


def _run(usable: Sequence[Frame], part: NDArray[np.intp]) -> list[int]:
    """The unbroken run nearest to the middle of a part, or the whole of a short one."""
    if len(part) <= RUN_FRAMES:
        return [usable[int(k)].index for k in part]
    starts = part[: len(part) - RUN_FRAMES + 1]
    order = np.argsort(np.abs(starts - starts.mean()), kind="stable")
    for start in starts[order]:
        run = [usable[int(k)].index for k in range(int(start), int(start) + RUN_FRAMES)]
        if run[-1] - run[0] == RUN_FRAMES - 1:
            return run
    return []


# ── the fit ──────────────────────────────────────────────────────────────────────────────────────────────────────


def align(
    observed: ObservedTracks, imu: ImuSamples, profile: CameraProfile, depth_m: float | None = None
) -> VisualInertialAlignment:
    """Fit velocity, gravity, accelerometer bias and planes to tracked points, and judge what the motion determines.

    Clock, IMU rotation and gyroscope bias are fitted along, within what a careful profile may be off; unknown ones
    (time_offset_s None) freely.  depth_m: of the scene where the profile states it; the scale then needs no
    acceleration.  Never raises for poor data: windows carry their reasons.
    """
    if profile.intrinsics is None:
        return VisualInertialAlignment((), "the focal length is unknown")
    observed = observed.covered(imu, profile)
    if len(observed.pairs) < MIN_PAIRS:
        return VisualInertialAlignment((), f"{len(observed.pairs)} pairs of frames with enough points to follow")
    if not imu.has_accelerometer:
        return VisualInertialAlignment((), "no accelerometer to tell the camera's path")
    stretches = []
    for part in _parts(observed):
        stretch = _fit_stretch(part, imu, profile, depth_m)
        if stretch is not None:
            stretches.append(stretch)
    return VisualInertialAlignment(tuple(stretches), "" if stretches else "too few points or accelerations")


def _parts(observed: ObservedTracks) -> list[ObservedTracks]:
    """Stretches of about STRETCH_S, in whole windows."""
    middle = np.array([observed.stamp_s[pair.second] for pair in observed.pairs])
    count = max(int(np.ceil((middle[-1] - middle[0]) / STRETCH_S)), 1)
    edges = np.linspace(middle[0], middle[-1], count + 1)[1:-1]
    number = np.searchsorted(edges, middle, side="right")
    return [observed.chosen(number == k) for k in range(count)]


def nuisance_terms(profile: CameraProfile) -> tuple[Term, ...]:
    """What is fitted beside the scene: everything that could pass for parallax.

    Before a tilted wall another travel with another turn shows nearly the same picture (a plane's second motion); that
    turn would have to be a bias that no phone's gyroscope has.
    """
    known = profile.time_offset_s is not None and "time_offset_s" not in profile.estimates
    terms = [STATED_OFFSET if known else TIME_OFFSET, SMALL_BIAS, NEAR_AXES]
    if not profile.readout_known:
        terms.append(UNKNOWN_READOUT)
    focal = profile.estimates.get("fx_px")
    if focal is not None and isinstance(focal.std, float) and focal.std and profile.intrinsics is not None:
        terms.append(replace(FOCAL, prior_std=(focal.std / profile.intrinsics.fx_px,)))
    return tuple(terms)


def _fit_stretch(
    observed: ObservedTracks, imu: ImuSamples, profile: CameraProfile, depth_m: float | None
) -> Stretch | None:
    if len(observed.pairs) < MIN_PAIRS:
        return None
    span_s = observed.stamp_s[observed.pairs[-1].second] - observed.stamp_s[observed.pairs[0].first]
    table = observed.table(POINTS_PER_WINDOW * max(int(np.ceil(span_s / WINDOW_S)), 1))
    if len(table) < MIN_POINTS:
        return None
    first, last = (float(profile.imu_time_s(t)) for t in (table.first_stamp_s.min(), table.second_stamp_s.max()))
    imu = imu.between(first - IMU_MARGIN_S - settling_time_s(profile), last + IMU_MARGIN_S)
    terms = nuisance_terms(profile)
    still = fit_tracks(imu, table, profile, terms, max_iterations=STILL_ITERATIONS)
    known = ground(imu, profile, translation=True)
    if known.displacement is None:
        return None
    inverse_depth = START_INVERSE_DEPTH_PER_M if depth_m is None else 1 / depth_m
    scene = start_scene(imu, known, table, inverse_depth)
    fit = fit_tracks(imu, table, profile, terms, scene, known=known, max_iterations=MAX_ITERATIONS)
    if depth_m is not None:
        fit = _at_depth(fit, imu, table, profile, terms, depth_m)
    assert isinstance(fit.scene, InertialMotion)
    points = triangulate(fit.ground, fit.scene, table)
    stretch = Stretch(fit, table, (), points, _velocity_floor(fit, table), _nudged(fit, imu))
    stretch = replace(stretch, windows=tuple(_judged(stretch, still, k, depth_m) for k in range(table.n_windows)))
    sights = triangulate_relief(fit.ground, fit.scene, observed.table(observed.tracks))
    reliefs = tuple(_relief(stretch, sights, k) for k in range(table.n_windows))
    windows = tuple(_with_a_surface(window, relief) for window, relief in zip(stretch.windows, reliefs, strict=True))
    return replace(stretch, windows=windows, reliefs=reliefs)


def _relief(stretch: Stretch, sights: Sightings, window: int) -> WindowRelief | None:
    """What stands out of a window's planes, if it tells held-out points better."""
    if not stretch.windows[window].usable:
        return None
    grid = picture_grid(stretch.fit.ground.lens, stretch.origin_s(window))

    def view(time_s: float) -> View:
        return stretch.view(window, time_s, stretch.frame_plane(window, time_s).plane_per_m)

    return find_relief(sights.chosen(sights.points.window == window), grid, view)


def _nudged(fit: TrackFit, imu: ImuSamples) -> tuple[IntegratedMotion, ...]:
    """The fit's ground with each value of its terms one quotient's step further."""
    steps = [(term, np.diag(term.quotient)[k]) for term in fit.terms for k in range(len(term))]
    return tuple(with_profile(fit.ground, imu, term.change(fit.profile, step)) for term, step in steps)


def _velocity_floor(fit: TrackFit, table: TrackTable) -> Array:
    """A steady error of TRACKING_BIAS_PX a step, at each window's depth."""
    assert isinstance(fit.scene, InertialMotion)
    assert fit.profile.intrinsics is not None
    step_s = float(np.median(table.second_stamp_s - table.first_stamp_s))
    depth_m = 1 / np.maximum(np.linalg.norm(fit.scene.plane_per_m, axis=-1), 1e-3)
    return np.asarray(TRACKING_BIAS_PX / fit.profile.intrinsics.fx_px * depth_m / max(step_s, 1e-3))


def _at_depth(
    fit: TrackFit, imu: ImuSamples, table: TrackTable, profile: CameraProfile, terms: tuple[Term, ...], depth_m: float
) -> TrackFit:
    """Fit again with each window's plane at the stated depth along the optical axis, tilted as the pictures say."""
    scene = fit.scene
    assert isinstance(scene, InertialMotion)
    origin = np.asarray(profile.imu_time_s(table.origin_s))
    axis = fit.ground.trajectory.orientation(origin)[:, :, 2]
    ratio = (1 / depth_m) / np.maximum((scene.plane_per_m * axis).sum(axis=-1), 0.02)[:, None]
    plane = scene.plane_per_m * ratio
    spread = STATED_DEPTH_STD * float(np.linalg.norm(plane, axis=-1).mean())
    held = replace(
        scene, velocity_m_s=scene.velocity_m_s / ratio, plane_per_m=plane, plane_std_per_m=(spread, spread, spread)
    )
    return fit_tracks(imu, table, profile, terms, held, max_iterations=MAX_ITERATIONS)


# ── judgement ────────────────────────────────────────────────────────────────────────────────────────────────────


def _judged(stretch: Stretch, still: TrackFit, window: int, depth_m: float | None) -> Window:
    fit, table = stretch.fit, stretch.table
    mine = table.window == window
    start_s, end_s = float(table.first_stamp_s[mine].min()), float(table.second_stamp_s[mine].max())
    times = np.linspace(start_s, end_s, 32)
    velocity, covariance = stretch.seen_velocity(window, times)
    spread = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1).mean())
    speed = max(float(np.sqrt((velocity**2).sum(axis=-1).mean())), 1e-6)
    axis = fit.ground.trajectory.orientation(stretch.origin_s(window))[:, 2]
    inverse = max(float(stretch.scene.plane_per_m[window] @ axis), 1e-6)
    scale_std = stretch.plane_std_per_m(window) / inverse
    flow, flow_covariance = stretch.flow(window, times)
    flow_std = np.sqrt(np.trace(flow_covariance, axis1=-2, axis2=-1).mean() / max((flow**2).sum(axis=-1).mean(), 1e-12))
    left, before = _left(fit, mine), _left(still, mine)
    found = Window(
        start_s,
        end_s,
        scale_std,
        float(spread) / speed,
        before / max(left, 1e-6),
        left,
        "",
        fit.depth_spread_per_m / inverse,
        float(flow_std),
    )
    gravity = float(np.linalg.norm(stretch.scene.gravity_m_s2))
    reason = _no_parallax(found) or _no_fit(found, gravity, before) or _far_from_profile(fit)
    if reason:
        return replace(found, reason=reason)
    return replace(found, reason=_no_metres(found), over_depth=found.flow_std < MAX_FLOW_STD)


def _left(fit: TrackFit, mine: NDArray[np.bool_]) -> float:
    """Robust standard deviation per coordinate of a window's whitened differences."""
    return float(np.median(fit.distance[mine])) / RAYLEIGH_MEDIAN


def _no_parallax(found: Window) -> str:
    if found.parallax < MIN_PARALLAX:
        return f"no parallax to speak of: rotation alone leaves {found.parallax:.2f} times what translation does"
    return ""


def _no_fit(found: Window, gravity_m_s2: float, before: float) -> str:
    unexplained = max(found.residual**2 - 1, 0.0) / max(before**2 - 1, 1e-6)
    if unexplained > MAX_LEFT or abs(gravity_m_s2 - GRAVITY_M_S2) > GRAVITY_TOLERANCE_M_S2:
        return (
            f"the accelerometer does not fit the pictures: {unexplained:.0%} of the parallax unexplained, "
            f"gravity {gravity_m_s2:.2f} m/s²"
        )
    return ""


def _far_from_profile(fit: TrackFit) -> str:
    for term in fit.terms:
        ratio = float(np.max(np.abs(fit.value(term.name)) / np.array(term.prior_std)))
        if ratio > MAX_PRIOR_STD:
            name = term.name.replace("_", " ")
            return f"pictures and accelerometer fit only with a {name} {ratio:.0f} deviations from the profile's"
    return ""


def _no_metres(found: Window) -> str:
    for name, std in (("scale", found.scale_std), ("velocity", found.velocity_std)):
        if std > MAX_RELATIVE_STD:
            return f"{name} undetermined: ± {min(std, 1):.0%}{' or more' if std > 1 else ''}"
    return ""


def _with_a_surface(window: Window, relief: WindowRelief | None) -> Window:
    """Depths that spread too far for a plane need a surface."""
    if not window.usable or relief is not None or window.spread <= MAX_SPREAD:
        return window
    return replace(window, reason=f"no common plane: inverse depths spread by {window.spread:.0%}", over_depth=False)
