"""From inertial samples to motion (eqs 4-10), with exact exponentials and partial first and last intervals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.errors import ImuError
from virest.motion.trajectory import Trajectory, coning, rotation_from_vector

Array = NDArray[np.float64]
GAP_PERIODS = 5.0
"""A pause longer than this many median sample periods ends one spline and begins the next."""


def camera_rate(imu: ImuSamples, profile: CameraProfile) -> Array:
    """True angular rate in camera axes (n, 3): R_cam_imu (measured − bias) / scale."""
    true_rate = (imu.gyro_rad_s - np.array(profile.gyro_bias_rad_s)) / np.array(profile.gyro_scale)
    return true_rate @ profile.rotation_cam_imu.T


def integrate_gyro(imu: ImuSamples, profile: CameraProfile) -> Trajectory:
    """Turn angular rate into orientation: R[k+1] = R[k] exp(∫ ω dt) (eqs 7, 8 with the exact exponential).

    The rate between samples is a cubic spline through them, so a partial interval (eq 9's Δt_last) is integrated
    exactly as far as it goes.  Raises ImuError if fewer than two samples are given.
    """
    if len(imu) < 2:
        raise ImuError(f"{len(imu)} gyroscope samples, at least 2 are needed", hint="check gyro_accel.csv")
    polynomials = _rate_polynomials(imu.time_s, camera_rate(imu, profile))
    step_s = np.diff(imu.time_s)[:, None]
    a, b, c, d = polynomials
    angle = step_s * (d + step_s * (c / 2 + step_s * (b / 3 + step_s * a / 4)))
    end_rate = ((a * step_s + b) * step_s + c) * step_s + d
    steps = rotation_from_vector(angle + coning(d, end_rate, step_s))
    return Trajectory(imu.time_s, _running_product(steps), polynomials)


def _rate_polynomials(time_s: Array, rate: Array) -> Array:
    """Cubic pieces (4, n − 1, 3); straight lines across gaps and in runs too short for a spline."""
    step = np.diff(time_s)
    pieces = np.zeros((4, len(step), 3))
    pieces[2] = np.diff(rate, axis=0) / step[:, None]
    pieces[3] = rate[:-1]
    breaks = np.flatnonzero(step > GAP_PERIODS * np.median(step)) + 1
    for run in np.split(np.arange(len(time_s)), breaks):
        if len(run) >= 4:
            pieces[:, run[0] : run[-1]] = CubicSpline(time_s[run], rate[run], axis=0).c
    return pieces


def _running_product(steps: Array) -> Array:
    """Cumulative matrix product with the identity in front, by doubling: log2(n) vectorised passes."""
    product = np.concatenate([np.eye(3)[None], steps])
    reach = 1
    while reach < len(product):
        product[reach:] = product[:-reach] @ product[reach:]
        reach *= 2
    return product
