"""What may be wrong with a profile's geometry, one term each: how a step changes it, and how far off it may be."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.errors import SettingsError
from virest.inference.track_fit import Term
from virest.motion.trajectory import rotation_from_vector

Array = NDArray[np.float64]
INF = float("inf")
GYRO_SCALE_OFF = 0.15
"""Makers trim gyroscopes to 3 % (BMI160, LSM6DSO, ICM-20602: sensitivity tolerance); five times that is a fault."""


def _lens(profile: CameraProfile) -> Intrinsics:
    if profile.intrinsics is None:
        raise SettingsError("the focal length is unknown", hint="set intrinsics.fx_px in camera.yaml")
    return profile.intrinsics


def _shutter(profile: CameraProfile, **changes: Any) -> CameraProfile:
    return replace(profile, shutter=replace(profile.shutter, **changes))


def _extend(profile: CameraProfile, **changes: Any) -> CameraProfile:
    return replace(profile, extensions=replace(profile.extensions, **changes))


def shift_offset(profile: CameraProfile, v: Array) -> CameraProfile:
    """Add v[0] seconds to the time offset."""
    return replace(profile, time_offset_s=(profile.time_offset_s or 0.0) + float(v[0]))


def rotate_imu(profile: CameraProfile, v: Array) -> CameraProfile:
    """Put exp(v) on the left of R_cam_imu."""
    return replace(profile, r_cam_imu=tuple(map(tuple, (rotation_from_vector(v) @ profile.rotation_cam_imu).tolist())))


def add_bias(profile: CameraProfile, v: Array) -> CameraProfile:
    """Add v rad/s to the gyroscope's bias."""
    return replace(profile, gyro_bias_rad_s=tuple((np.array(profile.gyro_bias_rad_s) + v).tolist()))


def scale_gyro(profile: CameraProfile, v: Array) -> CameraProfile:
    """Multiply the gyroscope's scale by exp(v[0])."""
    return replace(profile, gyro_scale=tuple((np.array(profile.gyro_scale) * np.exp(v[0])).tolist()))


def add_readout(profile: CameraProfile, v: Array) -> CameraProfile:
    """Add v[0] seconds to the readout, the picture's middle row kept where it was; through 0 it turns about."""
    signed = profile.shutter.readout_time_s + float(v[0])
    kept = shift_offset(profile, np.array([-0.5 * v[0]]))
    return _shutter(kept, readout_time_s=signed)


def scale_focal(profile: CameraProfile, v: Array) -> CameraProfile:
    """Multiply the focal lengths by exp(v[0])."""
    return replace(profile, intrinsics=_lens(profile).scaled_focal(float(np.exp(v[0]))))


def add_k1(profile: CameraProfile, v: Array) -> CameraProfile:
    """Add v[0] to k1."""
    lens = _lens(profile)
    if lens.model == "none":
        lens = replace(lens, model="radtan", coefficients=(0.0,) * 5)
    coefficients = (lens.coefficients[0] + float(v[0]), *lens.coefficients[1:])
    return replace(profile, intrinsics=replace(lens, coefficients=coefficients))


def shift_principal_point(profile: CameraProfile, v: Array) -> CameraProfile:
    """Add v px to the principal point."""
    lens = _lens(profile)
    return replace(profile, intrinsics=replace(lens, cx_px=lens.cx_px + float(v[0]), cy_px=lens.cy_px + float(v[1])))


def scale_exposure(profile: CameraProfile, v: Array) -> CameraProfile:
    """Multiply the exposure scale by exp(v[0])."""
    return _shutter(profile, exposure_scale=profile.shutter.exposure_scale * float(np.exp(v[0])))


def drift_focal(profile: CameraProfile, v: Array) -> CameraProfile:
    """Add v[0] 1/s to the drift of the focal length."""
    return _extend(profile, focal_drift_per_s=profile.extensions.focal_drift_per_s + float(v[0]))


def stabilise(profile: CameraProfile, v: Array) -> CameraProfile:
    """Add v[0] to the stabiliser's fraction, multiply its cutoff by exp(v[1]), add v[2:] rad to its lean at first."""
    before = profile.extensions
    cutoff = float(np.clip(before.stabilisation_cutoff_hz * np.exp(v[1]), 0.02, 20.0))
    fraction = before.stabilisation_fraction + float(v[0])
    lean = before.stabilisation_lean_rad
    return _extend(
        profile,
        stabilisation_fraction=fraction,
        stabilisation_cutoff_hz=cutoff,
        stabilisation_lean_rad=(lean[0] + float(v[2]), lean[1] + float(v[3])),
    )


def skew_clock(profile: CameraProfile, v: Array) -> CameraProfile:
    """Add v[0] to the clock skew."""
    return replace(profile, clock_skew=profile.clock_skew + float(v[0]))


TIME_OFFSET = Term("time_offset", shift_offset, (1e-4,), (0.02,), (INF,))
READOUT = Term("readout_time", add_readout, (2e-4,), (0.01,), (INF,))
IMU_ROTATION = Term("imu_rotation", rotate_imu, (1e-3,) * 3, (0.1,) * 3, (INF,) * 3)
GYRO_BIAS = Term("gyro_bias", add_bias, (1e-3,) * 3, (0.05,) * 3, (0.1,) * 3)
GYRO_SCALE = Term("gyro_scale", scale_gyro, (1e-3,), (0.1,), (0.3,))
FOCAL = Term("focal_length", scale_focal, (1e-3,), (0.1,), (0.5,))
K1 = Term("radial_distortion", add_k1, (1e-3,), (0.1,), (0.5,))
PRINCIPAL_POINT = Term("principal_point", shift_principal_point, (1.0, 1.0), (20.0, 20.0), (200.0, 200.0))
CLOCK_SKEW = Term("clock_skew", skew_clock, (1e-4,), (0.005,), (0.05,))
EXPOSURE_SCALE = Term("exposure_time", scale_exposure, (0.05,), (0.3,), (0.7,))
FOCAL_DRIFT = Term("focal_drift", drift_focal, (1e-3,), (0.03,), (0.2,))
STABILISATION = Term("stabilisation", stabilise, (0.02, 0.1, 0.01, 0.01), (0.3, 0.5, 0.1, 0.1), (1.0, 1.5, 0.05, 0.05))
