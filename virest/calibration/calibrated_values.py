"""Values that a calibration reports and writes: which are determined well enough, and how the others are handled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from virest.arrays import Array
from virest.calibration.physical_limits import is_global, limit_reasons
from virest.camera.profile import CameraProfile
from virest.effects.changes import keep_readout, rotation_between
from virest.effects.records import Calibrated
from virest.effects.table import EFFECTS
from virest.image_formation.row_clock import right_way_round
from virest.inference.chance import student_deviation
from virest.inference.observed_tracks import ObservedTracks
from virest.inference.track_fit import TrackFit

SOURCE = "tracked points against the inertial data"
"""Source of the estimates in a profile that a calibration wrote."""
MIN_STRETCHES = 2.5
"""A value must be supported by this effective number of time blocks; with fewer, nothing confirms it."""
LARGE_CORRELATION = 0.9
"""Correlation of two errors that is reported: either value is then known 2.3 times better if the other is given."""
NO_FINDING = "no camera has it"
GLOBAL_SHUTTER = "global shutter: no readout direction"
ROUGH_OFFSET_S = 0.01
"""A time offset with at most this standard deviation is written as rough; a worse one is no better than a default."""


@dataclass(frozen=True, slots=True)
class CalibratedValue:
    """One profile value before and after calibration."""

    name: str
    """As in the profile: time_offset_s, readout_time_s, readout_direction, rotation_rad, gyro_bias_rad_s, fx_px ..."""
    start: float | list[float] | str | None
    value: float | list[float] | str | None
    """Fitted value; the start value if not determined."""
    std: float | list[float] | None
    determined: bool
    note: str = ""
    rough: bool = False
    """Less precise than required, but written with its standard deviation."""
    implausible: bool = False
    """The fitted value is physically impossible; the start value is kept."""


def calibrated(effect: str) -> Calibrated:
    """Calibration entry of an effect in the table of effects."""
    found = EFFECTS[effect].calibrated
    assert found is not None
    return found


def global_shutter(fit: TrackFit, variances: dict[str, Array]) -> bool:
    """Whether the fitted readout is that of a global shutter, which has no direction."""
    if "readout_time" not in variances:
        return False
    return is_global(fit.profile.shutter.readout_time_s, float(np.sqrt(variances["readout_time"][0])))


def without_readout(profile: CameraProfile, given: CameraProfile) -> CameraProfile:
    """The profile with a readout of 0 and the given direction; the middle row keeps its time."""
    bare = given.with_shutter(readout_time_s=0.0, uneven=None)
    return keep_readout(profile, bare).with_shutter(uneven=None)


def beyond_limits(fit: TrackFit, observed: ObservedTracks, rolling: bool) -> dict[str, str]:
    """Fitted terms with physically impossible values, and the reason for each.

    rolling: whether the readout is a rolling shutter's; a global shutter's is possible.
    """
    stamps = observed.stamp_s[np.isfinite(observed.stamp_s)]
    period_s, fitted = float(np.median(np.diff(stamps))), right_way_round(fit.profile)
    reasons = limit_reasons(fitted, period_s, float(np.median(observed.exposure_s)))
    if not rolling:
        reasons.pop("readout_time", None)
    return {term.name: reasons[term.name] for term in fit.terms if term.name in reasons}


def is_determined(fit: TrackFit, name: str, variance: Array, rolling: bool) -> bool:
    """Whether a term is precise enough and supported by enough time blocks.

    A rolling shutter's readout within two standard deviations of 0 is not determined, since its direction is unknown.
    """
    known = bool(np.all(np.sqrt(variance) <= calibrated(name).max_std))
    if rolling and name == "readout_time" and abs(fit.profile.shutter.readout_time_s) < 2 * float(np.sqrt(variance[0])):
        return False
    return known and bool(np.all(fit.stretches[fit.slices[name]] >= MIN_STRETCHES))


def roughly_known(offset: CalibratedValue, fit: TrackFit) -> CalibratedValue:
    """Mark an undetermined time offset as rough if it is known to ROUGH_OFFSET_S from enough time blocks."""
    std_s = float(np.max(np.asarray(offset.std, float)))
    if offset.determined or std_s > ROUGH_OFFSET_S or fit.stretches[fit.slices["time_offset"]][0] < MIN_STRETCHES:
        return offset
    return replace(offset, rough=True, note=f"rough: {1e3 * calibrated('time_offset').max_std:g} ms are wanted")


def variances_of(fit: TrackFit, bias: dict[str, Array]) -> dict[str, Array]:
    """Variance of each term's values, with errors common to all points; the time offset refers to the first row.

    bias: standard deviation of the tracking bias by term.  Scatter between few time blocks counts as Student's t.
    """
    found = {}
    for term in fit.terms:
        own = fit.slices[term.name]
        few_blocks = np.array([student_deviation(max(blocks - 1.0, 1.0)) for blocks in fit.stretches[own]])
        found[term.name] = (few_blocks * fit.std(term.name)) ** 2 + bias[term.name] ** 2 + fit.by_error[own] ** 2
    if "readout_time" in found:
        cross = fit.covariance[fit.slices["time_offset"], fit.slices["readout_time"]][0]
        first_row = found["time_offset"] + 0.25 * found["readout_time"] - cross
        found["time_offset"] = np.maximum(first_row, found["time_offset"])
    return found


def reset_undetermined(
    fit: TrackFit, given: CameraProfile, start: CameraProfile, determined: dict[str, bool]
) -> CameraProfile:
    """The fitted profile with undetermined values reset to ``given``, the IMU axes to the coarse ones in ``start``."""
    profile, before = fit.profile, replace(given, r_cam_imu=start.r_cam_imu)
    for name in (name for name, known in determined.items() if not known):
        profile = calibrated(name).keep(profile, before)
    return profile


def value_of(
    name: str, given: CameraProfile, profile: CameraProfile, fitted: CameraProfile, variance: Array, determined: bool
) -> CalibratedValue:
    """Build one value.  fitted: profile with all fitted values, used to convert relative deviations to units."""
    shown = calibrated(name)
    std = np.sqrt(variance)
    before, after = shown.read(given), shown.read(profile)
    if name == "imu_rotation":
        before, after = [0.0, 0.0, 0.0], rotation_between(given, profile).tolist()
    if shown.is_factor and isinstance(scale := shown.read(fitted), float):
        std = std * abs(scale)
    if name == "readout_time" and determined:
        after = profile.shutter.readout_time_s
    stds = std.tolist()
    return CalibratedValue(shown.name, before, after, stds if len(stds) > 1 else stds[0], determined)


def with_estimates(profile: CameraProfile, values: Sequence[CalibratedValue]) -> CameraProfile:
    """Add the estimates of determined and rough values to the profile."""
    for value in values:
        if (value.determined or value.rough) and value.value is not None:
            profile = profile.with_estimate(value.name, value.value, value.std, SOURCE)
    known = profile.readout_known or any(v.name == "readout_time_s" and v.determined for v in values)
    return replace(profile, readout_known=known)


def correlations_of(fit: TrackFit, variances: dict[str, Array]) -> tuple[tuple[str, str, float], ...]:
    """Pairs of values with correlated errors (|ρ| > LARGE_CORRELATION), and their correlation."""
    names = [
        f"{calibrated(t.name).name}{'' if len(t) == 1 else '[' + str(k) + ']'}"
        for t in fit.terms
        for k in range(len(t))
    ]
    count = len(names)
    total = np.sqrt(np.concatenate([variances[t.name] for t in fit.terms]))
    correlation = fit.covariance[:count, :count] / np.outer(total, total)
    rows, columns = np.triu_indices(count, 1)
    strong = np.abs(correlation[rows, columns]) > LARGE_CORRELATION
    return tuple(
        (names[i], names[j], float(correlation[i, j])) for i, j in zip(rows[strong], columns[strong], strict=True)
    )
