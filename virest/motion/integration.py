"""Integration of inertial samples (eqs 4-10), with exact exponentials and partial first and last intervals."""

from __future__ import annotations

import numpy as np

from virest.arrays import Array
from virest.camera.field import FORCES, RATES
from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.motion.measured_rate import MeasuredRate, measured_rate
from virest.motion.trajectory import Trajectory, rotation_from_vector, turned_angle


def integrate_gyro(imu: ImuSamples, profile: CameraProfile, measured: MeasuredRate | None = None) -> Trajectory:
    """Integrate angular rate to orientation: R[k+1] = R[k] exp(∫ ω dt) (eqs 7, 8 with the exact exponential).

    The rate between samples is a cubic spline, so a partial interval (eq 9's Δt_last) is integrated exactly.  measured:
    the result of :func:`measured_rate`, if already known.  The profile's low-pass filter is undone.  Raises ImuError
    for fewer than two samples.
    """
    polynomials = camera_rate(imu, profile, measured or measured_rate(imu))
    steps = rotation_from_vector(turned_angle(polynomials, np.diff(imu.time_s)).T)
    return Trajectory(imu.time_s, _running_product(steps), polynomials)


def missing_rate_rad_s(imu: ImuSamples, profile: CameraProfile) -> Array | None:
    """Sum of the profile's fields of kind ``rate`` at the samples (n, 3), IMU axes; None without such fields.

    Rate covariates are the gyroscope's readings after correction for bias, scale and misalignment.
    """
    fields = [field for field in profile.extensions.field if field.kind == "rate"]
    if not fields:
        return None
    rate = profile.true_rate_rad_s(imu.gyro_rad_s)
    known = {"time": imu.time_s}
    known |= {name: rate[:, k] for k, name in enumerate(RATES)}
    known |= {name: np.nan_to_num(imu.accel_m_s2[:, k]) for k, name in enumerate(FORCES)}
    return np.asarray(sum(field.at(*(known[name] for name in field.covariates)) for field in fields))


def camera_rate(imu: ImuSamples, profile: CameraProfile, measured: MeasuredRate) -> Array:
    """True rate in camera axes, pieces (4, 3, n − 1) as in :class:`Trajectory`.

    R_cam_imu (((I + Γ) S)⁻¹ (measured, its filter undone, − bias) + fields of kind ``rate``).
    """
    extensions = profile.extensions
    unbiased = measured.before_filter(extensions.gyro_lowpass_hz, extensions.gyro_averaging_s).copy()
    unbiased[3] -= np.array(profile.gyro_bias_rad_s)[:, None]
    polynomials = np.asarray(profile.rotation_cam_imu @ profile.gyro_correction @ unbiased)
    if (missing := missing_rate_rad_s(imu, profile)) is not None:
        polynomials[2] += profile.rotation_cam_imu @ (np.diff(missing, axis=0).T / np.diff(imu.time_s))
        polynomials[3] += profile.rotation_cam_imu @ missing[:-1].T
    return polynomials


def _running_product(steps: Array) -> Array:
    """Cumulative matrix product with the identity in front."""
    return np.concatenate([np.eye(3)[None], _products(steps)])


def _products(steps: Array) -> Array:
    """Cumulative products of the steps: products of neighbouring pairs first, then recursively.

    Two products per step in total, in log2(n) vectorised passes.
    """
    if len(steps) < 2:
        return steps
    done = np.empty_like(steps)
    done[0] = steps[0]
    done[1::2] = _products(steps[:-1:2] @ steps[1::2])
    done[2::2] = done[1:-1:2] @ steps[2::2]
    return done
