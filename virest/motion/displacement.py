"""From specific force to displacement (eqs 4-6): what the accelerometer knows of the camera's path.

Position is linear in what the accelerometer leaves open: p(t) = P(t) + v (t − t₀) + ½ g (t − t₀)² − B(t) b, with the
velocity v and gravity g at t₀ in world axes and the accelerometer's bias b in IMU axes.  P and B are integrated once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.motion.trajectory import Trajectory

Array = NDArray[np.float64]
FIFTH_DIFFERENCES = 252**0.5
MIN_FINITE = 0.98
"""Least part of the rows with an acceleration; the holes are bridged by straight lines."""


@dataclass(frozen=True, slots=True)
class Displacement:
    """Path of the camera's centre by the accelerometer alone, the trajectory's axes; from rest at the first row."""

    trajectory: Trajectory
    path: CubicHermiteSpline
    """(m, 3) of the IMU, metres, as if gravity, velocity and bias were nought."""
    per_bias: CubicHermiteSpline
    """(m, 9) its change per m/s² of bias along each IMU axis."""
    per_delay: CubicHermiteSpline
    """(m, 3) its change per second by which the accelerations are older than their stamps."""
    arm_cam_m: Array
    """(3,) the IMU's origin in camera axes."""

    def at(self, time_s: Array, origin_s: Array, window: NDArray[np.intp] | None = None) -> tuple[Array, Array, Array]:
        """Compute P (n, 3), B (n, 3, 3) and the change per delay (n, 3), all from rest at origin_s (w,) of each window.

        window: (n,) number of each time's; None: each time has its own.
        """
        window = np.arange(len(time_s)) if window is None else window
        arm = self._arm(time_s) - self._arm(origin_s)[window] if self.arm_cam_m.any() else 0.0
        return (
            self._from_rest(self.path, time_s, origin_s, window) + arm,
            self._from_rest(self.per_bias, time_s, origin_s, window).reshape(-1, 3, 3),
            self._from_rest(self.per_delay, time_s, origin_s, window),
        )

    def acceleration(self, time_s: Array) -> Array:
        """Specific force of the camera's centre in world axes (..., 3), at times (...), without the arm's part."""
        return np.asarray(self.path(time_s, 2))

    @staticmethod
    def _from_rest(spline: CubicHermiteSpline, time_s: Array, origin_s: Array, window: NDArray[np.intp]) -> Array:
        begun, speed = spline(origin_s)[window], spline(origin_s, 1)[window]
        return np.asarray(spline(time_s) - begun - speed * (time_s - origin_s[window])[:, None])

    def _arm(self, time_s: Array) -> Array:
        """Camera's centre seen from the IMU, world axes: −R_world_cam p_cam_imu."""
        return -np.squeeze(self.trajectory.orientation(time_s) @ self.arm_cam_m[:, None], -1)


def drift_std_m(imu: ImuSamples, span_s: float) -> float:
    """Standard deviation of the displacement after span_s that the accelerometer's white noise alone makes.

    σ √Δt T^1.5 / √3; σ from fifth differences, which a hand's motion hardly reaches.  Inf without an accelerometer.
    """
    force = imu.accel_m_s2[np.isfinite(imu.accel_m_s2).all(axis=1)]
    if len(force) < 12:
        return float("inf")
    noise = float(np.median(np.std(np.diff(force, n=5, axis=0), axis=0))) / FIFTH_DIFFERENCES
    return noise * float(np.sqrt(np.median(np.diff(imu.time_s)) / 3)) * span_s**1.5


def force_at_samples(imu: ImuSamples) -> tuple[Array, Array] | None:
    """Specific force and its slope at the samples, IMU axes (n, 3) each, holes bridged; None without an accelerometer.

    No profile changes them.
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
    measured: what :func:`force_at_samples` says, where that is known already.
    """
    measured = measured or force_at_samples(imu)
    if measured is None:
        return None
    world_imu = trajectory.rotation_world_cam @ profile.rotation_cam_imu
    world_force, slope = (np.einsum("nij,nj->ni", world_imu, rows) for rows in measured)
    path, per_bias, per_delay = (
        _integrated_twice(imu.time_s, row) for row in (world_force, world_imu.reshape(-1, 9), slope)
    )
    return Displacement(trajectory, path, per_bias, per_delay, np.array(profile.p_cam_imu_m))


def _integrated_twice(time_s: Array, rate: Array) -> CubicHermiteSpline:
    step = np.diff(time_s)[:, None]
    zero = np.zeros((1, rate.shape[1]))
    velocity = np.concatenate([zero, np.cumsum(0.5 * step * (rate[:-1] + rate[1:]), axis=0)])
    moved = velocity[:-1] * step + step**2 * (2 * rate[:-1] + rate[1:]) / 6
    return CubicHermiteSpline(time_s, np.concatenate([zero, np.cumsum(moved, axis=0)]), velocity)
