"""The camera's estimated translation: windows of a few seconds, stretches of windows, and the motion over a frame."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import takewhile

import numpy as np

from virest.arrays import Array
from virest.image_formation.point_model import IntegratedMotion, TrackTable, centre
from virest.inference.depth import LEAST_INVERSE_PER_M, FrameDepth, TriangulatedPoints, frame_depth
from virest.inference.profile_terms import GYRO_BIAS, TIME_OFFSET
from virest.inference.relief import View, WindowRelief
from virest.inference.track_fit import TrackFit
from virest.inference.tracking_bias import SHARED_RELIEF
from virest.motion.displacement import Displacement
from virest.motion.scene_motion import InertialMotion

OFFSET_FLOOR_S = 3e-5
"""Systematic error of the time offset, added to its standard deviation."""
ACCEL_SCALE_STD = 0.01
"""Scale error of a phone's accelerometer (sensitivity tolerance of its makers); lengths scale with it."""
LEAST_SPAN_S = 0.002
"""Shortest time, s, over which a frame's acceleration and jerk are taken: frames without readout may be shorter."""
NEAR_WINDOW_S = 1.5
"""Frames up to this far from a window's tracked points still use its velocity."""


@dataclass(frozen=True, slots=True)
class Window:
    """Quality of the fit over a few seconds."""

    start_s: float
    """First tracked frame's stamp, camera clock."""
    end_s: float
    scale_std: float
    """Relative standard deviation of the metric scale: that of the plane's inverse depth on the window's ray."""
    velocity_std: float
    """rms standard deviation of the velocity over its rms."""
    parallax: float
    """Residual with rotation alone over the residual with translation."""
    residual: float
    """Robust standard deviation of the residual, in units of the tracking noise."""
    reason: str
    """Why the window's velocity is not known in metres; empty if it is."""
    spread: float = 0.0
    """Standard deviation of inverse depths about the plane, relative to the plane's."""
    flow_std: float = 0.0
    """rms standard deviation of velocity over depth, relative to its rms."""
    over_depth: bool = False
    """Whether velocity over depth is known although the metric velocity is not."""

    @property
    def usable(self) -> bool:
        """Whether frames may be restored with the window's velocity over depth."""
        return not self.reason or self.over_depth


@dataclass(frozen=True, slots=True)
class Stretch:
    """Windows fitted together."""

    fit: TrackFit
    table: TrackTable
    windows: tuple[Window, ...]
    points: TriangulatedPoints
    nearness_rays: Array
    """(windows, 3) rays, z = 1, camera axes, on which the planes' nearness is judged; in general the optical axis."""
    velocity_floor_m_s: Array
    """(windows,) velocity error from the systematic tracking error."""
    perturbed: tuple[IntegratedMotion, ...]
    """The fit's integrated motion with each value of its terms changed by its difference step."""
    reliefs: tuple[WindowRelief | None, ...] = ()
    """By window; None: the plane predicts held-out points as well as a surface does."""

    @property
    def scene(self) -> InertialMotion:
        """The fitted path and planes."""
        assert isinstance(self.fit.scene, InertialMotion)
        return self.fit.scene

    def origin_s(self, window: int) -> float:
        """Middle of a window, IMU clock."""
        return float(self.fit.profile.imu_time_s(self.table.origin_s[window]))

    def velocity(self, window: int, time_s: Array) -> Array:
        """Velocity (n, 3) of the camera's centre in world axes, IMU clock (n,)."""
        return self._velocity(self.fit.integrated, window, time_s)

    def seen_velocity(self, window: int, stamp_s: Array) -> tuple[Array, Array]:
        """Velocity (n, 3) in the camera's axes at stamps (n,), camera clock, and its covariance (n, 3, 3)."""
        velocity, _, slope, _ = self._seen(window, stamp_s)
        model = self.fit.covariance_model
        covariance = model.propagate(slope) + SHARED_RELIEF**2 * model.propagate_relief(slope)
        scale = ACCEL_SCALE_STD**2 * velocity[:, :, None] * velocity[:, None, :]
        return velocity, covariance + scale + self.velocity_floor_m_s[window] ** 2 * np.eye(3)

    def flow(self, window: int, stamp_s: Array) -> tuple[Array, Array]:
        """Velocity over depth (n, 3) on the window's ray, 1/s, camera axes at stamps (n,), and its covariance.

        A common scale of velocity and depth cancels, even if it is unknown.
        """
        velocity, nearness, slope, nearness_slope = self._seen(window, stamp_s)
        slope = nearness[:, None, None] * slope + velocity[:, :, None] * nearness_slope[:, None, :]
        floor = self.velocity_floor_m_s[window] * nearness
        covariance = self.fit.covariance_model.propagate(slope) + (floor**2)[:, None, None] * np.eye(3)
        return nearness[:, None] * velocity, covariance

    def _seen(self, window: int, stamp_s: Array) -> tuple[Array, Array, Array, Array]:
        """Velocity (n, 3) in camera axes, inverse depth (n,) of the plane on the window's ray, and their slopes.

        Slopes (n, 3, k) and (n, k) are per unit of every fitted value, the profile's terms included: rotating the IMU
        rotates gravity with it and leaves the velocity unchanged.
        """
        velocity, nearness, rotation = self._seen_from(self.fit.integrated, window, stamp_s)
        slope = np.zeros((len(stamp_s), 3, len(self.fit.covariance)))
        nearness_slope = np.zeros((len(stamp_s), slope.shape[-1]))
        quotients = [step for term in self.fit.terms for step in term.quotient]
        for k, (perturbed, quotient) in enumerate(zip(self.perturbed, quotients, strict=True)):
            moved, nearer, _ = self._seen_from(perturbed, window, stamp_s)
            slope[..., k] = (moved - velocity) / quotient
            nearness_slope[:, k] = (nearer - nearness) / quotient
        own = len(quotients) + 7 + 6 * window
        back = np.swapaxes(rotation, -1, -2)
        time_s = np.asarray(self.fit.profile.imu_time_s(stamp_s))
        moves, origin = self.fit.integrated.displacement, np.array([self.origin_s(window)])
        assert moves is not None
        slope[..., len(quotients) : len(quotients) + 7] = back @ _velocity_slope(moves, time_s, origin)
        slope[..., own : own + 3] = back
        nearness_slope[:, own + 3 : own + 6] = rotation @ self.nearness_rays[window]
        return velocity, nearness, slope, nearness_slope

    def _seen_from(self, known: IntegratedMotion, window: int, stamp_s: Array) -> tuple[Array, Array, Array]:
        """Velocity in camera axes, inverse depth on the window's ray, and R_world_cam, (n, 3), (n,), (n, 3, 3)."""
        time_s = np.asarray(known.profile.imu_time_s(stamp_s))
        rotation = known.trajectory.orientation(time_s)
        velocity = np.einsum("nji,nj->ni", rotation, self._velocity(known, window, time_s))
        nearness = rotation @ self.nearness_rays[window] @ self.scene.plane_per_m[window]
        return velocity, np.maximum(nearness, LEAST_INVERSE_PER_M), rotation

    def _velocity(self, known: IntegratedMotion, window: int, time_s: Array) -> Array:
        moves, scene = known.displacement, self.scene
        assert moves is not None
        origin = np.array([float(known.profile.imu_time_s(self.table.origin_s[window]))])
        slope = _velocity_slope(moves, time_s, origin)
        own = np.concatenate([scene.gravity_m_s2, scene.accel_bias_m_s2, [scene.accel_delay_s]])
        velocity = scene.velocity_m_s[window] + moves.velocity(time_s, origin)[0]
        # the IMU's distance from the camera adds −R (ω × p_cam_imu)
        turning = np.cross(known.trajectory.rate_rad_s(time_s), moves.arm_cam_m)
        arm = np.einsum("nij,nj->ni", known.trajectory.orientation(time_s), turning)
        return np.asarray(velocity + slope @ own - arm)

    def plane_std_per_m(self, window: int) -> float:
        """Standard deviation of the plane's inverse depth on the window's ray at the window's middle."""
        _, nearness, _, slope = self._seen(window, self.table.origin_s[[window]])
        variance = self.fit.covariance_model.propagate(slope[:, None, :])[0, 0, 0]
        return float(np.hypot(np.sqrt(variance), ACCEL_SCALE_STD * nearness[0]))

    def place(self, window: int, time_s: Array) -> Array:
        """Camera centre (n, 3) relative to its position at the window's middle, world axes."""
        moves = self.fit.integrated.displacement
        assert moves is not None
        velocity = np.broadcast_to(self.scene.velocity_m_s[window], (len(time_s), 3))
        return centre(moves, self.scene, velocity, time_s, np.full(len(time_s), self.origin_s(window)))[0]

    def plane(self, window: int, time_s: float) -> Array:
        """The window's plane (3,) in camera axes at a time: the inverse depth of a ray r with z = 1 is plane · r."""
        plane = self.scene.plane_per_m[window]
        distance = max(1 - float(plane @ self.place(window, np.array([time_s]))[0]), 0.05)
        return np.asarray(self.fit.integrated.trajectory.orientation(time_s).T @ plane / distance)

    def depth(self, window: int, time_s: float) -> FrameDepth:
        """The scene before the camera at a time, IMU clock: a plane, and a surface on it where the window has one."""
        found = self.frame_plane(window, time_s)
        relief = self.reliefs[window] if self.reliefs else None
        if relief is None:
            return found
        surface = relief.surface(self.view(window, time_s, found.plane_per_m))
        if surface is None:
            return found
        lens = self.fit.integrated.lens
        middle = lens.rays(0.5 * np.array([lens.lens.width - 1.0, lens.lens.height - 1.0]), time_s)
        return found.with_relief(surface, middle, self.windows[window].scale_std)

    def frame_plane(self, window: int, time_s: float) -> FrameDepth:
        """The plane through the points about a time."""
        return frame_depth(
            self.points,
            window,
            time_s,
            self.fit.integrated.trajectory.orientation(time_s),
            self.place(window, np.array([time_s]))[0],
            self.fit.integrated.lens,
            self.plane(window, time_s),
            self.fit.depth_spread_per_m,
            self.windows[window].scale_std,
        )

    def view(self, window: int, time_s: float, plane_per_m: Array) -> View:
        """The camera's pose at a time, with the plane in front of it."""
        place = self.place(window, np.array([time_s]))[0]
        return View(time_s, self.fit.integrated.trajectory.orientation(time_s), place, plane_per_m)


def _velocity_slope(moves: Displacement, time_s: Array, origin_s: Array) -> Array:
    """Change (n, 3, 7) of the velocity since an origin (1,) per unit of gravity, accelerometer bias and delay."""
    _, per_bias, per_delay = moves.velocity(time_s, origin_s)
    since = (time_s - origin_s)[:, None, None] * np.eye(3)
    return np.concatenate([since, -per_bias, per_delay[..., None]], axis=-1)


@dataclass(frozen=True, slots=True)
class FrameMotion:
    """The camera's translation over one frame, and the scene in front; camera axes at the frame's reference time."""

    velocity_m_s: Array
    """(3,) at the reference time."""
    reference_s: float
    """Camera clock."""
    acceleration_m_s2: Array
    """(3,) at the reference time, without gravity."""
    jerk_m_s3: Array
    """(3,) constant over the frame."""
    depth: FrameDepth
    window: int
    """Number of the window, counted from 1 over all stretches: its lengths share one unit, known or not."""
    unscaled: str = ""
    """Why velocity is known only over depth, not in metres; empty if it is known in metres."""


@dataclass(frozen=True, slots=True)
class VisualInertialAlignment:
    """Velocity, gravity, scale and accelerometer bias along a capture, as far as its motion determines them."""

    stretches: tuple[Stretch, ...]
    reason: str
    """Why no stretch could be fitted; empty otherwise."""

    @property
    def windows(self) -> tuple[Window, ...]:
        """All windows in order of time."""
        return tuple(window for stretch in self.stretches for window in stretch.windows)

    @property
    def refused(self) -> str:
        """The most frequent reason why windows have no metric velocity; empty if all have one."""
        if self.reason:
            return self.reason
        reasons = [window.reason for window in self.windows if window.reason]
        return max(reasons, key=reasons.count) if reasons else ""

    def find(self, camera_time_s: float, *, over_depth: bool = False) -> tuple[Stretch, int] | str:
        """The window that an instant (camera clock) belongs to, or the reason why there is none.

        over_depth: accept windows with velocity over depth only.
        """
        at = [
            (s, k, max(w.start_s - camera_time_s, camera_time_s - w.end_s, 0.0), w)
            for s in self.stretches
            for k, w in enumerate(s.windows)
        ]
        near = [entry for entry in at if entry[2] <= NEAR_WINDOW_S]
        if not near:
            return self.reason or "no tracked points near this frame"
        good = [entry for entry in near if not entry[3].reason or (over_depth and entry[3].over_depth)]
        if not good or min(entry[2] for entry in good) > min(entry[2] for entry in near) + 0.5 * NEAR_WINDOW_S:
            return min(near, key=lambda entry: entry[2])[3].reason
        stretch, window, _, _ = min(good, key=lambda entry: entry[2])
        return stretch, window

    def frame(self, reference_s: float, start_s: float, end_s: float) -> FrameMotion | str:
        """Motion over a frame taken from start_s to end_s, camera clock; or the reason why it is unknown."""
        found = self.find(0.5 * (start_s + end_s))
        unscaled = found if isinstance(found, str) else ""
        if unscaled:
            found = self.find(0.5 * (start_s + end_s), over_depth=True)
        if isinstance(found, str):
            return found
        stretch, window = found
        known = stretch.fit.integrated
        seen_s = np.array([reference_s, *np.linspace(start_s, max(end_s, start_s + LEAST_SPAN_S), 3)])
        time_s = np.asarray(known.profile.imu_time_s(seen_s))
        velocity = stretch.velocity(window, time_s) @ known.trajectory.orientation(time_s[0])
        half_jerk, acceleration, _ = np.polyfit(time_s[1:] - time_s[0], velocity[1:], 2)
        depth = stretch.depth(window, float(time_s[0]))
        before = takewhile(lambda other: other is not stretch, self.stretches)
        number = 1 + window + sum(len(other.windows) for other in before)
        return FrameMotion(velocity[0], reference_s, acceleration, 2 * half_jerk, depth, number, unscaled)

    def velocity_std_m_s(self, camera_time_s: Array) -> Array:
        """Standard deviations (n, 3) of the velocity in camera axes at times (n,); NaN where not known in metres.

        All times of a window are computed together, because each needs a dozen velocities.
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
        """Time offset and its standard deviation over the stretches with usable windows; None without any."""
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
    """Standard deviations (k,) of a term's values, with the errors from fixed relief."""
    return np.hypot(fit.std(name), SHARED_RELIEF * fit.by_relief[fit.slices[name]])


def _mean(value: Array, std: Array) -> tuple[float, float]:
    """Weighted mean and its standard deviation, inflated if the values disagree."""
    weight = std**-2.0
    mean = float((weight * value).sum() / weight.sum())
    disagreement = float((((value - mean) / std) ** 2).sum()) / max(len(value) - 1, 1)
    return mean, float(np.sqrt(max(disagreement, 1.0) / weight.sum()))
