"""A capture: records in, restored frames out.  Fill what the profile leaves open, then gate, deblur and warp."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile, Extensions
from virest.capture.folder import Capture, Frame
from virest.capture.imu import ImuSamples
from virest.capture.join import outside_reason
from virest.degradation.row_motion import row_motion
from virest.motion.alignment import OffsetEstimate, check_agreement, choose_pairs, estimate_time_offset
from virest.motion.integration import integrate_gyro
from virest.motion.tracking import TrackPair, track_pairs
from virest.restoration.frame import (
    RestoredFrame,
    copied_frame,
    degradation_parameters,
    restore_frame,
    unknown_parameters,
)
from virest.restoration.settings import RestorationSettings

GrayReader = Callable[[Sequence[int]], Iterator[tuple[int, NDArray[np.uint8]]]]
MAX_OFFSET_STD_S = 0.003
"""An estimated offset known no better than this restores nothing: at a hand's 30 rad/s² the rates, and so the blur
paths, would be off by 0.1 rad/s."""
MAX_FOCAL_SPREAD = 0.05
"""An estimated focal length known no better than this part restores nothing: all paths would be off by it."""
FOCAL_UNKNOWN = "focal length unknown and not to be had from the pictures; give fx_px in camera.yaml"


@dataclass(frozen=True, slots=True)
class RestorationPlan:
    """Everything a worker needs besides pictures and inertial samples."""

    profile: CameraProfile
    """Unknown values filled in, as far as they could be."""
    settings: RestorationSettings
    warnings: tuple[str, ...] = ()
    """What holds for the whole capture."""
    copy_reason: str | None = None
    """Why no frame may be restored; None: they may."""
    imu_gaps_s: tuple[tuple[float, float], ...] = ()
    """Holes in the inertial data: frames that reach into one are left out."""


def restore_frames(
    frames: Iterable[tuple[Frame, NDArray[np.uint8] | None]], imu: ImuSamples, plan: RestorationPlan
) -> Iterator[RestoredFrame]:
    """Restore frames one by one; ``imu`` covers them. Frames without a picture are passed over."""
    profile = plan.profile
    trajectory = integrate_gyro(imu, profile) if profile.intrinsics is not None else None
    for frame, picture in frames:
        if picture is None:
            continue
        if trajectory is None:
            yield copied_frame(frame, picture, profile, plan.copy_reason or FOCAL_UNKNOWN)
            continue
        motion = row_motion(trajectory, profile, frame.time_s, frame.exposure_s, plan.settings.reference)
        end_s = motion.start_s + motion.readout_time_s + motion.exposure_s
        outside = outside_reason(motion.start_s, end_s, imu.time_s, plan.imu_gaps_s)
        if outside:
            yield RestoredFrame(frame, "skipped", None, (outside[1],), parameters=unknown_parameters(profile))
            continue
        if plan.copy_reason:
            said = degradation_parameters(motion, trajectory, plan.settings)
            yield copied_frame(frame, picture, profile, plan.copy_reason, said)
            continue
        yield restore_frame(frame, picture, motion, trajectory, plan.settings)


def plan_restoration(
    capture: Capture,
    profile: CameraProfile,
    settings: RestorationSettings,
    read_gray: GrayReader,
) -> RestorationPlan:
    """Fill what the profile leaves open from a few dozen frames, and ask whether pictures and gyroscope agree at all.

    read_gray: gives (index, luma) of the frames asked for, in order.  The cost does not grow with the movie.
    """
    plan = RestorationPlan(profile, settings, _unknowns(profile, capture), None, capture.imu_gaps_s)
    frames = tuple(
        replace(f, skip_reason=None) if settings.keep_start_up and f.only_startup else f for f in capture.frames
    )
    if not any(f.skip_reason is None for f in frames):
        return plan
    pairs = track_pairs(read_gray(choose_pairs(frames, capture.imu, time_offset_s=profile.time_offset_s or 0.0)))
    if profile.time_offset_s is None or profile.intrinsics is None:
        plan = _filled(plan, capture, pairs)
    if plan.copy_reason is None:
        agreement = check_agreement(pairs, *_times(capture), capture.imu, plan.profile)
        if not agreement.agrees:
            plan = replace(plan, copy_reason=f"pictures and gyroscope disagree: {agreement.reason}")
    return plan


def _times(capture: Capture) -> tuple[list[float], list[float | None]]:
    return [f.time_s for f in capture.frames], [f.exposure_s for f in capture.frames]


def _unknowns(profile: CameraProfile, capture: Capture) -> tuple[str, ...]:
    """A warning for each value that a documented default stands in for."""
    warnings = []
    if profile.response is None:
        warnings.append("response curve unknown: srgb taken")
    if not profile.readout_known:
        warnings.append("readout time unknown: 0 taken, rows are not straightened")
    if all(frame.exposure_s is None for frame in capture.frames):
        warnings.append("exposure times unknown: frames are not deblurred")
    if profile.depth_m is None:
        warnings.append("translation and depth not estimated: rotation only")
    extended = [f.name for f in fields(Extensions) if getattr(profile.extensions, f.name) != f.default]
    if extended:
        warnings.append(f"extensions not applied to the pictures: {', '.join(extended)}")
    return tuple(warnings)


def _filled(plan: RestorationPlan, capture: Capture, pairs: list[TrackPair]) -> RestorationPlan:
    """The plan with time offset, gyroscope bias and focal length as far as the pictures determine them."""
    estimate = estimate_time_offset(pairs, *_times(capture), capture.imu, plan.profile)
    plan = _with_focal(plan, estimate)
    if plan.profile.time_offset_s is not None:
        return plan
    if not estimate.determined:
        warning = f"time offset not determined ({estimate.reason}): 0 taken"
        return replace(plan, profile=replace(plan.profile, time_offset_s=0.0), warnings=(*plan.warnings, warning))
    offset_s = estimate.at_readout(plan.profile.shutter.readout_time_s)
    profile = plan.profile.with_estimate(
        "time_offset_s", offset_s, estimate.std_s, "tracked points against the gyroscope", time_offset_s=offset_s
    )
    profile = _with_bias(profile, estimate)
    said = f"time offset estimated: {offset_s * 1e3:+.2f} ± {estimate.std_s * 1e3:.2f} ms"
    plan = replace(plan, profile=profile, warnings=(*plan.warnings, said))
    if estimate.std_s > MAX_OFFSET_STD_S and plan.copy_reason is None:
        return replace(plan, copy_reason=f"time offset only known to ± {estimate.std_s * 1e3:.1f} ms")
    return plan


def _with_bias(profile: CameraProfile, estimate: OffsetEstimate) -> CameraProfile:
    """Take the gyroscope's bias over where it is significant and no parallax can have faked it."""
    bias, std = np.array(estimate.bias_rad_s), np.array(estimate.bias_std_rad_s)
    if estimate.translation != "rotation" or not np.all(np.isfinite(std)) or np.all(np.abs(bias) < 3 * std):
        return profile
    source = "tracked points against the gyroscope"
    values = tuple(float(b) for b in bias)
    return profile.with_estimate("gyro_bias_rad_s", list(values), std.tolist(), source, gyro_bias_rad_s=values)


def _with_focal(plan: RestorationPlan, estimate: OffsetEstimate) -> RestorationPlan:
    """Take the focal length over where the profile has none and the pictures determine it well enough."""
    profile = plan.profile
    if profile.intrinsics is not None:
        return plan
    focal, std = estimate.focal_px, estimate.focal_std_px
    if focal is None or std is None or std > MAX_FOCAL_SPREAD * focal:
        known = "" if focal is None or std is None else f" (about {focal:.0f} ± {std:.0f} px)"
        return replace(plan, copy_reason=FOCAL_UNKNOWN + known)
    return replace(plan, profile=profile.with_focal(focal, std, "tracked points against the gyroscope"))
