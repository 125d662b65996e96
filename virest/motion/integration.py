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


def integrate_gyro(imu: ImuSamples, profile: CameraProfile, measured: Array | None = None) -> Trajectory:
    """Turn angular rate into orientation: R[k+1] = R[k] exp(∫ ω dt) (eqs 7, 8 with the exact exponential).

    The rate between samples is a cubic spline through them, so a partial interval (eq 9's Δt_last) is integrated
    exactly as far as it goes.  measured: what :func:`gyro_polynomials` says, where that is known already.  Raises
    ImuError if fewer than two samples are given.
    """
    polynomials = _camera_rate(gyro_polynomials(imu) if measured is None else measured, profile)
    step_s = np.diff(imu.time_s)[:, None]
    a, b, c, d = polynomials
    angle = step_s * (d + step_s * (c / 2 + step_s * (b / 3 + step_s * a / 4)))
    end_rate = ((a * step_s + b) * step_s + c) * step_s + d
    steps = rotation_from_vector(angle + coning(d, end_rate, step_s))
    return Trajectory(imu.time_s, _running_product(steps), polynomials)


def gyro_polynomials(imu: ImuSamples) -> Array:
    """Measured rate between the samples, IMU axes: cubic pieces (4, n − 1, 3), highest power first.

    Straight lines across gaps and in runs too short for a spline.  No profile changes them.  Raises ImuError if fewer
    than two samples are given.
    """
    if len(imu) < 2:
        raise ImuError(f"{len(imu)} gyroscope samples, at least 2 are needed", hint="check gyro_accel.csv")
    time_s, rate = imu.time_s, imu.gyro_rad_s
    step = np.diff(time_s)
    pieces = np.zeros((4, len(step), 3))
    pieces[2] = np.diff(rate, axis=0) / step[:, None]
    pieces[3] = rate[:-1]
    breaks = np.flatnonzero(step > GAP_PERIODS * np.median(step)) + 1
    for run in np.split(np.arange(len(time_s)), breaks):
        if len(run) >= 4:
            pieces[:, run[0] : run[-1]] = CubicSpline(time_s[run], rate[run], axis=0).c
    return pieces


def _camera_rate(measured: Array, profile: CameraProfile) -> Array:
    """True rate in camera axes of measured pieces (4, n − 1, 3): R_cam_imu (measured − bias) / scale, which is linear."""
    unbiased = measured.copy()
    unbiased[3] -= np.array(profile.gyro_bias_rad_s)
    return np.asarray(unbiased @ (profile.rotation_cam_imu / np.array(profile.gyro_scale)).T)


def _running_product(steps: Array) -> Array:
    """Cumulative matrix product with the identity in front."""
    return np.concatenate([np.eye(3)[None], _products(steps)])


def _products(steps: Array) -> Array:
    """Products of the first one, two, ... of the steps: neighbours are paired and the pairs' products worked out first.

    Two products a step in all, in log2(n) vectorised passes.
    """
    if len(steps) < 2:
        return steps
    done = np.empty_like(steps)
    done[0] = steps[0]
    done[1::2] = _products(steps[:-1:2] @ steps[1::2])
    done[2::2] = done[1:-1:2] @ steps[2::2]
    return done
