"""Which parts of a prediction a change of the profile invalidates, so that the others can be reused.

A value that is not listed here invalidates everything: forgetting one costs time but never gives a stale prediction.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cache
from typing import Any

from virest.camera.profile import CameraProfile


@dataclass(frozen=True, slots=True)
class Touched:
    """Parts of a prediction that a change invalidates."""

    rates: bool
    """The true rates: integrate everything again."""
    axes: bool
    """The rotation from IMU to camera: rotate trajectory and path."""
    lens: bool
    """The lens, or its motion."""
    only_motion: bool
    """Nothing but rates and axes."""


RATES, AXES, LENS, NOTHING, EVERYTHING = "rates", "axes", "lens", "nothing", "everything"
OF_PROFILE = {
    **dict.fromkeys(("gyro_bias_rad_s", "gyro_scale"), RATES),
    "r_cam_imu": AXES,
    "intrinsics": LENS,
    # when a point is seen, and how bright: each prediction reads these from the profile
    **dict.fromkeys(("width", "height", "shutter", "readout_known", "time_offset_s", "clock_skew"), NOTHING),
    **dict.fromkeys(("response", "sensor_width_mm", "sensor_height_mm", "focal_length_mm", "depth_m"), NOTHING),
    **dict.fromkeys(("device", "estimates", "imu_untrusted_s", "imu_untrusted_stamp_0_ns", "lens_shape"), NOTHING),
    **dict.fromkeys(("open_imu", "axes_known"), NOTHING),
}
"""Profile fields that do not invalidate everything."""
OF_EXTENSIONS = {
    **dict.fromkeys(("gyro_lowpass_hz", "gyro_averaging_s", "gyro_misalignment_rad"), RATES),
    **dict.fromkeys(("focal_drift_per_s", "stabilisation_fraction", "stabilisation_cutoff_hz"), LENS),
    **dict.fromkeys(("stabilisation_travel_rad", "stabilisation_at_end", "stabilisation_lean_rad"), LENS),
    **dict.fromkeys(("frame_lag_s", "frame_lag_frames"), NOTHING),
    **dict.fromkeys(("exposures_late_frames", "exposure_gain"), NOTHING),
    **dict.fromkeys(("vignetting_corner_loss", "gain", "defocus_sigma_px"), NOTHING),
    **dict.fromkeys(("flicker_amplitude", "flicker_frequency_hz", "flicker_phase_rad"), NOTHING),
}
"""Extensions that do not invalidate everything."""
OF_FIELDS = {"rate": RATES, "scale": LENS, "delay": NOTHING, "gain": NOTHING, "blur": NOTHING}
"""Fields in ``extensions.field``, by kind; those of other kinds are held by the shutter and the lens."""


def touched(before: CameraProfile, after: CameraProfile) -> Touched:
    """What differs between the predictions of two profiles."""
    found = {OF_PROFILE.get(name, EVERYTHING) for name in _changed(before, after) if name != "extensions"}
    if before.extensions is not after.extensions:
        changed = _changed(before.extensions, after.extensions)
        found |= {OF_EXTENSIONS.get(name, EVERYTHING) for name in changed if name != "field"}
        if "field" in changed:
            found |= {OF_FIELDS.get(kind, EVERYTHING) for kind in _changed_kinds(before, after)}
    # fields over logged covariates are on the camera clock: on the IMU clock they move with the clocks
    logged = any(field.log is not None for field in after.extensions.field)
    later = logged and _clocks(before) != _clocks(after)
    rates, only_motion = not found.isdisjoint({RATES, EVERYTHING}), found <= {RATES, AXES} and not later
    return Touched(rates, AXES in found, LENS in found or later, only_motion)


def _clocks(profile: CameraProfile) -> tuple[Any, ...]:
    """What relates the camera's clock to that of the IMU."""
    return profile.time_offset_s, profile.clock_skew, _of_kind(profile, "delay")


def _changed(before: Any, after: Any) -> set[str]:
    if before is after:
        return set()
    pairs = ((name, getattr(before, name), getattr(after, name)) for name in _names(before.__class__))
    return {name for name, one, other in pairs if one is not other and one != other}


@cache
def _names(kind: Any) -> tuple[str, ...]:
    """A dataclass's fields."""
    return tuple(entry.name for entry in fields(kind))


def _changed_kinds(before: CameraProfile, after: CameraProfile) -> set[str]:
    kinds = {field.kind for profile in (before, after) for field in profile.extensions.field}
    return {kind for kind in kinds if _of_kind(before, kind) != _of_kind(after, kind)}


def _of_kind(profile: CameraProfile, kind: str) -> list[Any]:
    return [field for field in profile.extensions.field if field.kind == kind]
