"""Displacement of the camera from specific force (eqs 4-6).

Position is linear in the unknowns: p(t) = P(t) + v (t − t₀) + ½ g (t − t₀)² − B(t) b, with the velocity v at t₀ and
gravity g in world axes and the accelerometer's bias b in IMU axes.  P and B are integrated once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from virest.arrays import Array, Index
from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.motion.trajectory import Trajectory, Turning, hermite

MIN_FINITE = 0.98
"""Smallest fraction of the rows with an acceleration; gaps are interpolated."""


@dataclass(frozen=True, slots=True)
class Displacement:
    """Path of the camera's centre from the accelerometer alone, trajectory's axes; from rest at the first row."""

    trajectory: Trajectory
    spline: CubicHermiteSpline
    """(m, 15), by rows of (3, 5): P of the IMU, metres, for zero gravity, velocity and bias; its change per m/s² of
    bias along each IMU axis; its change per second of delay of the accelerations."""
    arm_cam_m: Array
    """(3,) the IMU's origin in camera axes."""

    def at(self, time_s: Array, origin_s: Array, window: Index | None = None) -> tuple[Array, Array, Array]:
        """P (n, 3), B (n, 3, 3) and the change per delay (n, 3), all from rest at origin_s (w,) of each window.

        window: (n,) window of each time; None: each time has its own.
        """
        window = np.arange(len(time_s)) if window is None else window
        arm = self._arm(time_s) - self._arm(origin_s)[window] if self.arm_cam_m.any() else 0.0
        path, per_bias, per_delay = _parts(_from_rest(self.spline, time_s, origin_s, window))
        return path + arm, per_bias, per_delay

    def velocity(self, time_s: Array, origin_s: Array) -> tuple[Array, Array, Array]:
        """Velocity of the IMU since an origin (1,): (n, 3), per bias (n, 3, 3) and per delay (n, 3), world axes."""
        return _parts(self.spline(time_s, 1) - self.spline(origin_s, 1))

    def acceleration(self, time_s: Array) -> Array:
        """Specific force of the camera's centre in world axes (..., 3), at times (...), without the arm's part."""
        return _parts(self.spline(time_s, 2))[0]

    def turned(self, turn: Array, trajectory: Trajectory) -> Displacement:
        """The same in world axes rotated by (3, 3), along a trajectory in these axes."""
        rows = np.kron(turn, np.eye(5))
        pieces = self.spline.c @ rows.T
        spline = CubicHermiteSpline.construct_fast(pieces, self.spline.x, self.spline.extrapolate, self.spline.axis)
        return Displacement(trajectory, spline, self.arm_cam_m)

    def turned_by(
        self, turning: Turning, force: Array, force_change: Array, time_s: Array, origin_s: Array, window: Index
    ) -> Array:
        """To first order, the change (n, 3, k) of the centre at times (n,) due to small rotations of the camera.

        force (m, 3), force_change (m, 3, k): specific force at the trajectory's knots, m/s², camera axes, and changes
        of it.  From rest at origin_s (w,) of each window.
        """
        way, shape = self.trajectory, (-1, *turning.at_knots.shape[1:])
        to_world = way.rotation_world_cam
        pushed = np.cross(turning.at_knots, to_world @ force[..., None], axis=1) + to_world @ force_change
        path = _integrated_twice(way.time_s, pushed.reshape(len(pushed), -1))
        moved = _from_rest(path, time_s, origin_s, window).reshape(shape)
        if self.arm_cam_m.any():
            now, begun = (np.cross(turning.at(t), self._arm(t)[..., None], axis=1) for t in (time_s, origin_s))
            moved += now - begun[window]
        return np.asarray(moved)

    def _arm(self, time_s: Array) -> Array:
        """Camera's centre relative to the IMU, world axes: −R_world_cam p_cam_imu."""
        return -np.squeeze(self.trajectory.orientation(time_s) @ self.arm_cam_m[:, None], -1)


def _from_rest(path: CubicHermiteSpline, time_s: Array, origin_s: Array, window: Index) -> Array:
    """A path (n, k) at times (n,), from rest at the origin (w,) of each window."""
    begun, speed = path(origin_s)[window], path(origin_s, 1)[window]
    return np.asarray(path(time_s) - begun - speed * (time_s - origin_s[window])[:, None])


def _parts(values: Array) -> tuple[Array, Array, Array]:
    """The spline's values (..., 15) as position (..., 3), bias (..., 3, 3) and delay (..., 3) parts."""
    rows = values.reshape(*values.shape[:-1], 3, 5)
    return rows[..., 0], np.ascontiguousarray(rows[..., 1:4]), rows[..., 4]


def force_at_samples(imu: ImuSamples) -> tuple[Array, Array] | None:
    """Specific force and its slope at the samples, IMU axes (n, 3) each, gaps bridged; None without an accelerometer.

    Independent of the profile.
    """
    finite = np.isfinite(imu.accel_m_s2).all(axis=1)
    if finite.mean() < MIN_FINITE or finite.sum() < 4:
        return None
    force = CubicSpline(imu.time_s[finite], imu.accel_m_s2[finite], axis=0)
    inside = np.clip(imu.time_s, imu.time_s[finite][0], imu.time_s[finite][-1])
    return np.asarray(force(inside)), np.asarray(force(inside, 1))


def integrate_accelerometer(
    imu: ImuSamples, profile: CameraProfile, trajectory: Trajectory, measured: tuple[Array, Array] | None = None
) -> Displacement | None:
    """Integrate specific force twice along the gyroscope's orientation; None without an accelerometer.

    Between samples the world-axis force is linear: v ← v + ½ (a₀ + a₁) Δt, p ← p + v Δt + (2 a₀ + a₁) Δt² / 6.
    measured: the result of :func:`force_at_samples`, if already known.
    """
    measured = measured or force_at_samples(imu)
    if measured is None:
        return None
    world_imu = trajectory.rotation_world_cam @ profile.rotation_cam_imu
    force, slope = (world_imu @ rows[..., None] for rows in measured)
    rate = np.concatenate([force, world_imu, slope], axis=-1).reshape(-1, 15)
    return Displacement(trajectory, _integrated_twice(imu.time_s, rate), np.array(profile.p_cam_imu_m))


def _integrated_twice(time_s: Array, rate: Array) -> CubicHermiteSpline:
    """The spline (k values) of the double integral of a rate (n, k), from rest."""
    step, velocity, position = np.diff(time_s)[:, None], np.zeros_like(rate), np.zeros_like(rate)
    np.cumsum(0.5 * step * (rate[:-1] + rate[1:]), axis=0, out=velocity[1:])
    moved = velocity[:-1] * step + step**2 * (2 * rate[:-1] + rate[1:]) / 6
    np.cumsum(moved, axis=0, out=position[1:])
    return hermite(time_s, position, velocity)
