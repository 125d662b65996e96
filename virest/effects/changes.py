"""How steps change a profile, and which steps lead from one profile to another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from virest.arrays import Array
from virest.camera.gyro_filter import cutoff_hz, delay_s
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.errors import SettingsError

CUTOFFS_HZ = (0.02, 20.0)
"""Bounds of a stabiliser's cutoff while it is fitted."""
LEAST_INVERSE_TRAVEL = 1.0
"""1/rad: a lens that could tilt the picture by a radian reaches no end."""


def lens_of(profile: CameraProfile) -> Intrinsics:
    """The profile's lens. Raises SettingsError where the focal length is unknown."""
    if profile.intrinsics is None:
        raise SettingsError("the focal length is unknown", hint="set intrinsics.fx_px in camera.yaml")
    return profile.intrinsics


def shift_offset(profile: CameraProfile, v: Array) -> CameraProfile:
    """Add v[0] seconds to the time offset."""
    return replace(profile, time_offset_s=(profile.time_offset_s or 0.0) + float(v[0]))


def rotate_imu(profile: CameraProfile, v: Array) -> CameraProfile:
    """Put exp(v) on the left of R_cam_imu."""
    turned = Rotation.from_rotvec(v).as_matrix() @ profile.rotation_cam_imu
    return replace(profile, r_cam_imu=tuple(map(tuple, turned.tolist())))


def rotation_between(before: CameraProfile, after: CameraProfile) -> Array:
    """Rotation vector (3,) of R_after R_beforeᵀ."""
    return np.asarray(Rotation.from_matrix(after.rotation_cam_imu @ before.rotation_cam_imu.T).as_rotvec())


def add_bias(profile: CameraProfile, v: Array) -> CameraProfile:
    """Add v rad/s to the gyroscope's bias."""
    return replace(profile, gyro_bias_rad_s=tuple((np.array(profile.gyro_bias_rad_s) + v).tolist()))


def scale_gyro(profile: CameraProfile, v: Array) -> CameraProfile:
    """Multiply the gyroscope's scale by exp(v[0])."""
    return replace(profile, gyro_scale=tuple((np.array(profile.gyro_scale) * np.exp(v[0])).tolist()))


def skew_gyro_axes(profile: CameraProfile, v: Array) -> CameraProfile:
    """Multiply the scales of axes x, y, z by exp(v[0], v[1], −v[0] − v[1]); add v[2:] rad to the misalignment."""
    scale = np.array(profile.gyro_scale) * np.exp([v[0], v[1], -v[0] - v[1]])
    turned = np.array(profile.extensions.gyro_misalignment_rad) + v[2:]
    skewed = profile.with_extensions(gyro_misalignment_rad=tuple(turned.tolist()))
    return replace(skewed, gyro_scale=tuple(scale.tolist()))


def gyro_axes_between(before: CameraProfile, after: CameraProfile) -> Array:
    """(5,) the steps of :func:`skew_gyro_axes` between two profiles."""
    ratio = np.log(axis_scale(after)) - np.log(axis_scale(before))
    turned = np.subtract(after.extensions.gyro_misalignment_rad, before.extensions.gyro_misalignment_rad)
    return np.concatenate([ratio[:2], turned])


def axis_scale(profile: CameraProfile) -> Array:
    """Scales (3,) of the gyroscope's axes over their mean."""
    return np.array(profile.gyro_scale) / mean_gyro_scale(profile)


def mean_gyro_scale(profile: CameraProfile) -> float:
    """Geometric mean of the scales of the gyroscope's axes."""
    return float(np.exp(np.log(profile.gyro_scale).mean()))


def delay_gyro(profile: CameraProfile, v: Array) -> CameraProfile:
    """Add v[0] seconds to the delay of the gyroscope's low-pass filter; no physical filter has a negative delay."""
    late_s = delay_s(profile.extensions.gyro_lowpass_hz) + float(v[0])
    return profile.with_extensions(gyro_lowpass_hz=cutoff_hz(late_s))


def average_gyro(profile: CameraProfile, v: Array) -> CameraProfile:
    """Add v[0] s² to the square of the gyroscope's averaging time, which has no negative values."""
    squared = profile.extensions.gyro_averaging_s**2 + float(v[0])
    return profile.with_extensions(gyro_averaging_s=float(np.sqrt(max(squared, 0.0))))


def lengthen_readout(profile: CameraProfile, v: Array) -> CameraProfile:
    """Add v[0] seconds to the readout time; the first row keeps its time."""
    return profile.with_shutter(readout_time_s=max(profile.shutter.readout_time_s + float(v[0]), 0.0))


def keep_readout(profile: CameraProfile, given: CameraProfile) -> CameraProfile:
    """Restore the given readout time and direction; the middle row keeps its time."""
    middle = (profile.time_offset_s or 0.0) + 0.5 * profile.shutter.readout_time_s
    readout_time_s, direction = given.shutter.readout_time_s, given.shutter.readout_direction
    back = profile.with_shutter(readout_time_s=readout_time_s, readout_direction=direction)
    return replace(back, time_offset_s=middle - 0.5 * readout_time_s)


def keep_lens(*names: str) -> Callable[[CameraProfile, CameraProfile], CameraProfile]:
    """A function that restores these values of a given lens; without a given lens the profile has none either."""

    def keep(profile: CameraProfile, given: CameraProfile) -> CameraProfile:
        lens, before = profile.intrinsics, given.intrinsics
        if lens is None or before is None:
            return replace(profile, intrinsics=before)
        return replace(profile, intrinsics=replace(lens, **{name: getattr(before, name) for name in names}))

    return keep


def keep_value(name: str) -> Callable[[CameraProfile, CameraProfile], CameraProfile]:
    """A function that restores a given value."""
    return lambda profile, given: replace(profile, **{name: getattr(given, name)})


def add_readout(profile: CameraProfile, v: Array) -> CameraProfile:
    """Add v[0] seconds to the readout time; the middle row keeps its time.  A negative sum reverses the direction."""
    signed = profile.shutter.readout_time_s + float(v[0])
    return shift_offset(profile, np.array([-0.5 * v[0]])).with_shutter(readout_time_s=signed)


def scale_focal(profile: CameraProfile, v: Array) -> CameraProfile:
    """Multiply the focal lengths by exp(v[0])."""
    return replace(profile, intrinsics=lens_of(profile).scaled_focal(float(np.exp(v[0]))))


def stretch_pixels(profile: CameraProfile, v: Array) -> CameraProfile:
    """Multiply fy by exp(v[0]); fx stays."""
    lens = lens_of(profile)
    return replace(profile, intrinsics=replace(lens, fy_px=lens.fy_px * float(np.exp(v[0]))))


def pixel_aspect(profile: CameraProfile) -> float:
    """fy / fx; 1 while the focal length is unknown."""
    return 1.0 if profile.intrinsics is None else profile.intrinsics.fy_px / profile.intrinsics.fx_px


def k1_of(profile: CameraProfile) -> float:
    """First radial coefficient; 0 without distortion."""
    return _coefficient(profile, 0)


def k2_of(profile: CameraProfile) -> float:
    """Second radial coefficient; 0 without distortion."""
    return _coefficient(profile, 1)


def add_k1(profile: CameraProfile, v: Array) -> CameraProfile:
    """Add v[0] to k1."""
    return _with_coefficient(profile, 0, k1_of(profile) + float(v[0]))


def add_k2(profile: CameraProfile, v: Array) -> CameraProfile:
    """Add v[0] to k2."""
    return _with_coefficient(profile, 1, k2_of(profile) + float(v[0]))


def keep_coefficient(number: int) -> Callable[[CameraProfile, CameraProfile], CameraProfile]:
    """A function that restores a coefficient of a given lens, and its model where no distortion is left."""

    def keep(profile: CameraProfile, given: CameraProfile) -> CameraProfile:
        if profile.intrinsics is None:
            return profile
        kept = _with_coefficient(profile, number, _coefficient(given, number))
        lens, before = lens_of(kept), given.intrinsics
        if before is None or before.model != "none" or any(lens.coefficients):
            return kept
        return replace(kept, intrinsics=replace(lens, model="none", coefficients=before.coefficients))

    return keep


def _coefficient(profile: CameraProfile, number: int) -> float:
    lens = profile.intrinsics
    return 0.0 if lens is None or not lens.coefficients else lens.coefficients[number]


def _with_coefficient(profile: CameraProfile, number: int, value: float) -> CameraProfile:
    """The profile with one coefficient of its lens changed; a lens without distortion becomes radial-tangential."""
    lens = lens_of(profile)
    if lens.model == "none":
        lens = replace(lens, model="radtan", coefficients=(0.0,) * 5)
    coefficients = (*lens.coefficients[:number], value, *lens.coefficients[number + 1 :])
    return replace(profile, intrinsics=replace(lens, coefficients=coefficients))


def shift_principal_point(profile: CameraProfile, v: Array) -> CameraProfile:
    """Add v px to the principal point."""
    lens = lens_of(profile)
    return replace(profile, intrinsics=replace(lens, cx_px=lens.cx_px + float(v[0]), cy_px=lens.cy_px + float(v[1])))


def principal_shift(before: CameraProfile, after: CameraProfile) -> Array:
    """Displacement (2,) of the principal point, px."""
    if before.intrinsics is None or after.intrinsics is None:
        return np.zeros(2)
    one, other = before.intrinsics, after.intrinsics
    return np.array([other.cx_px - one.cx_px, other.cy_px - one.cy_px])


def scale_exposure(profile: CameraProfile, v: Array) -> CameraProfile:
    """Multiply the exposure scale by exp(v[0])."""
    return profile.with_shutter(exposure_scale=profile.shutter.exposure_scale * float(np.exp(v[0])))


def drift_focal(profile: CameraProfile, v: Array) -> CameraProfile:
    """Add v[0] 1/s to the drift of the focal length."""
    return profile.with_extensions(focal_drift_per_s=profile.extensions.focal_drift_per_s + float(v[0]))


def inverse_travel(profile: CameraProfile) -> float:
    """1 / travel of the stabiliser, 1/rad; 0 where it has no ends."""
    travel_rad = profile.extensions.stabilisation_travel_rad
    return 0.0 if travel_rad is None else 1.0 / travel_rad


def stabilise(profile: CameraProfile, v: Array) -> CameraProfile:
    """Add v[0] to the stabiliser's fraction, v[2:4] rad to its initial lean and v[4] to 1 / travel (1/rad).

    Its cutoff is multiplied by exp(v[1]).  An inverse travel of 0 has no ends, and the points' slope there is 0.
    """
    before = profile.extensions
    lean, inverse = before.stabilisation_lean_rad, inverse_travel(profile) + float(v[4])
    return profile.with_extensions(
        stabilisation_fraction=before.stabilisation_fraction + float(v[0]),
        stabilisation_cutoff_hz=float(np.clip(before.stabilisation_cutoff_hz * np.exp(v[1]), *CUTOFFS_HZ)),
        stabilisation_lean_rad=(lean[0] + float(v[2]), lean[1] + float(v[3])),
        stabilisation_travel_rad=1 / inverse if inverse > LEAST_INVERSE_TRAVEL else None,
    )


def stabilised_between(before: CameraProfile, after: CameraProfile) -> Array:
    """(5,) the fraction's change, else 0: only that has a zero to count from, and the lean is not part of the cause."""
    change = after.extensions.stabilisation_fraction - before.extensions.stabilisation_fraction
    return np.array([change, 0.0, 0.0, 0.0, 0.0])


def skew_clock(profile: CameraProfile, v: Array) -> CameraProfile:
    """Add v[0] to the clock skew."""
    return replace(profile, clock_skew=profile.clock_skew + float(v[0]))
