"""Convert a profile to times counted from a later timestamp, or to the camera's own clock."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from virest.camera.field import TIMED_BY_IMU, Field
from virest.camera.profile import CameraProfile


def counted_from(profile: CameraProfile, later_s: float, stamp_ns: int | None) -> CameraProfile:
    """The profile with its times counted from a timestamp this much later on the camera's clock.

    ``t_imu − s = (t − s)(1 + skew) + offset`` for another s has the offset ``offset + skew · later``;
    ``f (1 + drift t)`` has another f and drift, flicker another phase.  Values of a single capture now belong to the
    one that starts with the later timestamp stamp_ns; None: unknown.
    """
    extensions, lens = profile.extensions, profile.intrinsics
    drift = extensions.focal_drift_per_s
    if lens is not None and drift:
        lens = lens.scaled_focal(1 + drift * later_s)
    turned = 2 * np.pi * float(np.remainder(extensions.flicker_frequency_hz * later_s, 1.0))
    changed = replace(
        profile,
        intrinsics=lens,
        time_offset_s=None if profile.time_offset_s is None else profile.time_offset_s + profile.clock_skew * later_s,
        extensions=replace(
            extensions,
            focal_drift_per_s=drift / (1 + drift * later_s),
            flicker_phase_rad=extensions.flicker_phase_rad + turned,
        ),
        imu_untrusted_s=tuple((begin - later_s, end - later_s) for begin, end in profile.imu_untrusted_s),
        imu_untrusted_stamp_0_ns=None if profile.imu_untrusted_stamp_0_ns is None else stamp_ns,
    )
    owned = [replace(f, stamp_0_ns=stamp_ns) if f.belongs_to_one_capture else f for f in profile.fields]
    return changed.with_fields([_of_longer(field.later(later_s), 1 + drift * later_s) for field in owned])


def on_camera_clock(profile: CameraProfile) -> CameraProfile:
    """The profile for a log converted to the camera's clock: without offset, skew and delays over time.

    Focal drift, flicker and untrusted stretches of the log are converted to that clock.
    """

    def camera_s(imu_s: float) -> float:
        return float(profile.camera_time_s(imu_s))

    extensions, lens = profile.extensions, profile.intrinsics
    offset_s, drift, rate = profile.time_offset_s or 0.0, extensions.focal_drift_per_s, 1 + profile.clock_skew
    if lens is not None and drift:
        lens = lens.scaled_focal(1 + drift * offset_s)
    changed = replace(
        profile,
        intrinsics=lens,
        time_offset_s=None if profile.time_offset_s is None else 0.0,
        clock_skew=0.0,
        extensions=replace(
            extensions,
            focal_drift_per_s=drift * rate / (1 + drift * offset_s),
            flicker_phase_rad=extensions.flicker_phase_rad + 2 * np.pi * extensions.flicker_frequency_hz * offset_s,
            flicker_frequency_hz=extensions.flicker_frequency_hz * rate,
        ),
        imu_untrusted_s=tuple((camera_s(begin), camera_s(end)) for begin, end in profile.imu_untrusted_s),
    )
    kept = [f for f in profile.fields if (f.kind, f.covariates) != ("delay", ("time",))]
    timed = [f.with_times(camera_s) if f.kind in TIMED_BY_IMU else f for f in kept]
    return changed.with_fields([_of_longer(field, 1 + drift * offset_s) for field in timed])


def _of_longer(field: Field, scale: float) -> Field:
    """A field of the focal length, relative to a length multiplied by this factor; other fields are unchanged."""
    if field.kind != "scale" or scale == 1.0:
        return field
    return field.with_values(np.array(field.values) / scale, np.array(field.std) / scale if field.std else None)
