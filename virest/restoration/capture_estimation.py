"""Estimate a capture's unknown values and check its profile, once, before its frames are restored.

Missing values are estimated from tracked points.  The clocks and blur paths of the profile are compared with those of
the frames.  Camera translation and scene depth are estimated where the capture determines them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.camera.shutter import STAMP_FRACTION
from virest.capture.folder import GUESSED_FOCAL, Capture, Frame
from virest.capture.frame_coding import FrameCoding
from virest.capture.imu import ImuSamples
from virest.effects.changes import rotation_between
from virest.effects.table import EFFECTS
from virest.image_formation.row_clock import RowClock
from virest.image_formation.row_motion import FrameTranslation, RowMotion, frame_times_s
from virest.inference.camera_travel import FrameMotion, VisualInertialAlignment
from virest.inference.coarse_alignment import MIN_EXPLAINED, STEP_S, align_coarsely
from virest.inference.doubtful_log import doubts
from virest.inference.frame_exposures import OwnExposures
from virest.inference.frame_selection import choose_pairs
from virest.inference.guide_choice import find_guide
from virest.inference.log_bridges import with_expected_rates
from virest.inference.observed_tracks import ObservedTracks, observe_tracks
from virest.inference.spectral_limit import allow, widest_gaussian_px
from virest.inference.synchronisation import (
    AGREEMENT_SLACK_S,
    OffsetEstimate,
    check_agreement,
    estimate_time_offset,
    refine_time_offset,
    shown_axes,
    shown_readout,
)
from virest.inference.tracking import TrackPair, track_pairs
from virest.inference.unsharp_mask import MOST_FRAMES
from virest.inference.visual_inertial import align, choose_runs
from virest.motion.integration import integrate_gyro
from virest.motion.optics import MovingLens, moving_lens
from virest.restoration.blur_length_check import (
    PathScale,
    TilePowers,
    frames_to_measure,
    log_lengths,
    log_likelihood_of_lengths,
    path_scale,
    store_powers,
)
from virest.restoration.capture import (
    FOCAL_UNKNOWN,
    RestorationPlan,
    at_true_times,
    moved_over_frame,
)
from virest.restoration.conflict_plan import (
    MAX_FOCAL_SPREAD,
    MAX_OFFSET_STD_S,
    POINTS_SOURCE,
    estimated_offset,
    explains_points,
    settle,
)
from virest.restoration.frame_time_plan import FrameTimes, find_frame_times, for_own_exposures
from virest.restoration.lag_plan import GrayReader, at_lag, find_lag, with_lag
from virest.restoration.neighbour_plan import with_neighbour_survey
from virest.restoration.neighbours.survey import store_lumas, survey_runs
from virest.restoration.plan_notes import NoteCode, PlanNote
from virest.restoration.profile_conflict import VALUE_P
from virest.restoration.settings import RestorationSettings

MIN_COARSE_EXPLAINED = 0.5
"""Least fraction of the frames' rotation that the gyroscope must explain at a coarse offset for it to be refined."""
OFFSET_DOUBT_S, BIAS_FLOOR_RAD_S = 0.003, 1e-3
"""Replace a stated offset that differs by this much, s, from the frames'; systematic standard deviation of a
gyroscope bias, since tracking can cause as much."""
OTHER_OFFSET = "the frames indicate a time offset of"
UNCHECKED = "agreement of frames and gyroscope could not be tested"
OTHER_PATHS = "the frames show blur paths"
CALIBRATE_EXPOSURE = "calibrate --with exposure-scale, or diagnose"
NOT_ESTIMATED = "translation and depth not estimated: rotation only"


def plan_restoration(
    capture: Capture,
    profile: CameraProfile,
    settings: RestorationSettings,
    read_gray: GrayReader,
    coding: Mapping[int, FrameCoding] | None = None,
) -> RestorationPlan:
    """Estimate the profile's missing values from a few dozen frames, and check that frames and gyroscope agree.

    read_gray: gives (index, luma) of the requested frames, in order.  The cost does not grow with the movie's length.
    coding: how frames were coded, by frame index, filled in as frames are read; missing: unknown.
    """
    coding = {} if coding is None else coding
    bridged = with_expected_rates(profile, capture.imu, capture.stamp_0_ns)
    if bridged is not profile:
        inferred = "rates there are inferred from the readings around; virest diagnose estimates them from points"
        notes = tuple(PlanNote(NoteCode.DOUBTFUL_LOG, f"{text}: {inferred}") for text in doubts(capture.imu, profile))
        plan = plan_restoration(capture, bridged, settings, read_gray, coding)
        return replace(plan, said=(*notes, *plan.said))
    if own := OwnExposures.stated_by(profile):
        capture = replace(capture, frames=own.of(capture.frames))
        even = profile.with_extensions(exposures_late_frames=0, exposure_gain=())
        return for_own_exposures(plan_restoration(capture, even, settings, read_gray, coding), own)
    lag = None if settings.keep_start_up else find_lag(capture, profile, read_gray)
    if lag is None:
        return _planned(capture, profile, settings, read_gray, coding)
    return with_lag(_planned(at_lag(capture, profile, lag), profile, settings, read_gray, coding), lag)


def _planned(
    capture: Capture,
    profile: CameraProfile,
    settings: RestorationSettings,
    read_gray: GrayReader,
    coding: Mapping[int, FrameCoding],
) -> RestorationPlan:
    def planned(capture: Capture, profile: CameraProfile) -> RestorationPlan:
        return _planned(capture, profile, settings, read_gray, coding)

    plan = RestorationPlan(
        profile, settings, _default_notes(profile, capture), None, capture.imu_gaps_s, applied_extensions(profile)
    )
    frames = tuple(
        replace(f, skip_reason=None) if settings.keep_start_up and f.only_startup else f
        for f in capture.frames[profile.extensions.frame_lag_frames :]
    )
    if not any(f.skip_reason is None for f in frames):
        return plan
    if profile.depth_m is None and not capture.imu.has_accelerometer:
        plan = _without_translation(plan, "no accelerometer")
    chosen = set(choose_pairs(frames, capture.imu, time_offset_s=profile.time_offset_s or 0.0))
    runs = choose_runs(frames) if _wants_translation(profile, capture) else []
    powers: dict[int, TilePowers] = {}
    curve = profile.curve
    path_px = _rough_paths_px(capture, profile, chosen)
    measured = frames_to_measure(list(path_px), np.array(list(path_px.values()))) if settings.deblur != "none" else ()
    surveyed, lumas = survey_runs(path_px, path_px), dict[int, NDArray[np.uint8]]()
    wanted = sorted(chosen.union(runs))
    guide = find_guide(capture, profile, read_gray, wanted)
    kept = {n for run in surveyed for n in run}.union(sorted(path_px, key=path_px.__getitem__)[:MOST_FRAMES])
    pictures = store_lumas(read_gray(wanted), kept, lumas)
    all_pairs = track_pairs(store_powers(pictures, measured, curve, powers), guide=guide)
    tracked = [pair for pair in all_pairs if pair.first in chosen and pair.second in chosen]
    if profile.time_offset_s is None or profile.intrinsics is None:
        observed = observe_tracks(capture, tracked, profile)
        plan = _with_estimates(plan, capture.imu, observed)
        if plan.refuses(NoteCode.OTHER_AXES):
            shown = None if profile.axes_known else shown_axes(observed, capture.imu, profile)
            return plan if shown is None else _noted_axes(planned(capture, shown), profile)
    lens = plan.profile.intrinsics
    if (stated := _with_shown_readout(plan, profile, capture, tracked)) is not None:
        return _noted_readout(planned(capture, stated))
    alignment, followed = None, False
    if runs and plan.profile.intrinsics is not None:
        alignment = _aligned(plan.profile, profile, capture, all_pairs)
        plan = _with_clock(plan, profile, alignment)
    explained = alignment is not None and explains_points(alignment)
    if not explained or profile.readout_known:
        settled, followed = settle(plan, profile, capture, tracked, explained=explained)
        if settled.profile is not plan.profile and runs:
            alignment = _aligned(settled.profile, profile, capture, all_pairs)
            settled = _with_clock(settled, profile, alignment)
        plan = settled
    if plan.profile.intrinsics != lens and (stated := _with_shown_readout(plan, profile, capture, tracked)) is not None:
        return _noted_readout(planned(capture, stated))
    if plan.refusal is None:
        times = find_frame_times(plan, profile, capture, tracked, lambda n: track_pairs(read_gray(n), guide=guide))
        retimed = None if times is None else _retimed(plan, times, capture, powers, planned)
        if retimed is not None:
            return retimed
    if plan.refusal is None and not _clock_agrees(alignment, plan.profile):
        resting = _through_resting_lens(tracked, capture, plan.profile)
        agreement = check_agreement(observe_tracks(capture, resting, plan.profile), capture.imu, plan.profile)
        if not agreement.tested and not followed:
            plan = plan.noted(NoteCode.UNCHECKED, f"{UNCHECKED} ({agreement.reason})")
        if not agreement.agrees and not followed:
            plan = plan.refused(NoteCode.DISAGREEMENT, f"frames and gyroscope disagree: {agreement.reason}")
        elif profile.time_offset_s is not None and agreement.best_offset_s is not None:
            offset_s, std_s = agreement.best_offset_s, STEP_S
            estimate = refine_time_offset(
                observe_tracks(capture, tracked, plan.profile),
                capture.imu,
                replace(plan.profile, time_offset_s=offset_s),
            )
            if estimate.determined:
                offset_s, std_s = estimate.time_offset_s, estimate.std_s
            plan = _with_offset_conflict(plan, profile.time_offset_s, offset_s, std_s, POINTS_SOURCE)
    if plan.refusal is not None:
        return plan
    if alignment is not None:
        plan = _with_translations(plan, capture, alignment)
    plan = _without_false_defocus(plan, capture, lumas)
    plan, lengths = _with_blur_length_check(plan, profile, capture, powers)
    if lengths is not None and (scale := _exposure_of_points(plan, profile, capture, tracked, lengths)) is not None:
        again = planned(capture, profile.with_shutter(exposure_scale=scale * profile.shutter.exposure_scale))
        if again.refusal is None and again.contradicted is None:
            text = (
                f"blur and tracked points show exposures of {scale:.2f} times the profile's, which are used instead: "
                f"{CALIBRATE_EXPOSURE}"
            )
            return again.noted(NoteCode.BLUR_LENGTH, text)
    return with_neighbour_survey(plan, capture, surveyed, lumas, coding)


def _without_false_defocus(
    plan: RestorationPlan, capture: Capture, lumas: Mapping[int, NDArray[np.uint8]]
) -> RestorationPlan:
    """The plan without a defocus that the frames contradict: undone, it would draw waves beside every edge."""
    stated_px = plan.profile.extensions.defocus_sigma_px
    if not stated_px:
        return plan
    widest_px = [widest_gaussian_px(luma, plan.profile.curve) for luma in lumas.values()]
    if allow(widest_px, capture.bits_per_px, stated_px):
        return plan
    text = (
        f"frames show finer detail than the profile's defocus of {stated_px:.2f} px leaves: it is not undone; diagnose "
        "tells a focus that moves"
    )
    profile = plan.profile.with_extensions(defocus_sigma_px=0.0)
    dropped = set(applied_extensions(plan.profile)) - set(applied_extensions(profile))
    notes = tuple(note for note in plan.notes if note not in dropped)
    return replace(plan, profile=profile, notes=notes).noted(NoteCode.FINER_DETAIL, text)


# ── translation and depth ────────────────────────────────────────────────────────────────────────────────────────


def _wants_translation(profile: CameraProfile, capture: Capture) -> bool:
    """False for a scene at infinity, which has no parallax, and without an accelerometer, which gives the scale."""
    far = profile.depth_m is not None and np.isinf(profile.depth_m)
    return not far and capture.imu.has_accelerometer


def _aligned(
    filled: CameraProfile, given: CameraProfile, capture: Capture, pairs: list[TrackPair]
) -> VisualInertialAlignment:
    """Fit the translation; if the offset is still unknown, start from the coarse one where rotations agree best.

    With translation and hardly any rotation there is none: the fit then starts from an offset of 0, which is nearly
    right on phones, and is judged by what it explains.
    """
    observed = observe_tracks(capture, pairs, filled)
    start = filled
    if given.time_offset_s is None and "time_offset_s" not in filled.estimates and len(observed.pairs):
        coarse = align_coarsely(observed.turns(filled), capture.imu, filled)
        found = coarse is not None and coarse.explained >= MIN_COARSE_EXPLAINED and not coarse.at_end
        offset_s = coarse.time_offset_s if coarse is not None and found else 0.0
        start = filled.with_estimate("time_offset_s", offset_s, None, "coarse", time_offset_s=offset_s)
    return align(observed, capture.imu, start, given.depth_m)


def _with_clock(plan: RestorationPlan, given: CameraProfile, alignment: VisualInertialAlignment) -> RestorationPlan:
    """Adopt the joint fit's offset if the profile has none or another, and its gyroscope bias where that differs."""
    clock, bias = alignment.clock(), alignment.gyro_bias()
    if clock is None or bias is None:
        return plan
    offset_s, std_s = clock
    if std_s > MAX_OFFSET_STD_S:
        return plan
    source = "tracked points against gyroscope and accelerometer"
    if given.time_offset_s is not None:
        plan = _with_offset_conflict(plan, given.time_offset_s, offset_s, std_s, source)
    else:
        profile = plan.profile.with_estimate("time_offset_s", offset_s, std_s, source, time_offset_s=offset_s)
        plan = replace(plan.without(NoteCode.TIME_OFFSET).without(NoteCode.NOT_FOLLOWING), profile=profile)
        plan = plan.noted(NoteCode.TIME_OFFSET, estimated_offset(offset_s, std_s))
    values, spread = bias[0], np.hypot(bias[1], BIAS_FLOOR_RAD_S)
    if not np.any(np.abs(values - plan.profile.gyro_bias_rad_s) > 3 * spread):
        return plan
    held = tuple(float(value) for value in values)
    profile = plan.profile.with_estimate("gyro_bias_rad_s", list(held), spread.tolist(), source, gyro_bias_rad_s=held)
    return replace(plan, profile=profile)


def _with_offset_conflict(
    plan: RestorationPlan, given_s: float, offset_s: float, std_s: float, source: str
) -> RestorationPlan:
    """Replace the profile's time offset by the frames', with a note, where they differ significantly.

    A wrong offset misplaces rows by the rotation rate's change over it, and an offset from tracked points holds at
    mid-exposure whatever the cause, be it the clock, a gyroscope's low pass or another exposure time.
    """
    if abs(offset_s - given_s) < max(OFFSET_DOUBT_S, 3 * std_s):
        return plan
    text = (
        f"{OTHER_OFFSET} {offset_s * 1e3:+.1f} ± {std_s * 1e3:.1f} ms, used instead of the profile's "
        f"{given_s * 1e3:+.1f} ms: calibrate"
    )
    profile = plan.profile.with_estimate("time_offset_s", offset_s, std_s, source, time_offset_s=offset_s)
    return replace(plan, profile=profile).noted(NoteCode.OTHER_OFFSET, text)


def _rough_paths_px(capture: Capture, profile: CameraProfile, chosen: Iterable[int]) -> dict[int, float]:
    """Approximate blur path length of the chosen frames with known exposure, by movie index."""
    frames = [capture.frames[index] for index in sorted(chosen) if capture.frames[index].exposure_s]
    if not frames:
        return {}
    rate_rad_s = np.linalg.norm(capture.imu.gyro_rad_s - profile.gyro_bias_rad_s, axis=1)
    offset_s = profile.time_offset_s or 0.0
    at_frames = np.interp([f.time_s + offset_s for f in frames], capture.imu.time_s, rate_rad_s)
    exposure_s = np.array([profile.shutter.true_exposure_s(f.exposure_s) for f in frames])
    focal_px = profile.intrinsics.fx_px if profile.intrinsics else GUESSED_FOCAL * max(profile.width, profile.height)
    return dict(zip((f.index for f in frames), (focal_px * at_frames * exposure_s).tolist(), strict=True))


def _with_motion(
    plan: RestorationPlan, capture: Capture, powers: Mapping[int, TilePowers]
) -> list[tuple[RowMotion, TilePowers]]:
    """The spectra of frames with the motion that a plan gives these, in their order in the movie."""
    profile = plan.profile
    trajectory = integrate_gyro(capture.imu, profile)
    lens, known = moving_lens(trajectory, profile), plan.translations or {}
    frames = at_true_times(capture.frames, profile, capture.repeats)
    return [
        (
            moved_over_frame(trajectory, lens, frames[index], plan.settings.reference, known.get(index), profile),
            powers[index],
        )
        for index in sorted(powers)
    ]


def _retimed(
    plan: RestorationPlan,
    times: FrameTimes,
    capture: Capture,
    powers: Mapping[int, TilePowers],
    planned: Callable[[Capture, CameraProfile], RestorationPlan],
) -> RestorationPlan | None:
    """The plan with the frames' true times, or with the exposures that delay them as much; None: no better."""
    by_stamps, other = planned(times.capture, times.profile), times.instead
    if not times.explain(plan, by_stamps):
        return None
    by_stamps = times.noted(by_stamps)
    if other is None:
        return by_stamps
    by_exposures = planned(other.capture, other.profile)
    explained, by_exposures = other.explain(plan, by_exposures), other.noted(by_exposures)
    return by_exposures if explained and _lengths_prefer(by_exposures, by_stamps, capture, powers) else by_stamps


def _lengths_prefer(
    plan: RestorationPlan, other: RestorationPlan, capture: Capture, powers: Mapping[int, TilePowers]
) -> bool:
    """Whether the length of blur in the frames makes a plan's paths likelier by far than those of another one.

    Of two hypotheses, the wrong one is k times as likely as the right one with a probability of at most 1 / k.
    """
    by_plan = [log_lengths(_with_motion(one, capture, powers)) for one in (plan, other)]
    measured = np.isfinite(by_plan).all(axis=0)
    likelihood, of_other = (log_likelihood_of_lengths(lengths[measured]) for lengths in by_plan)
    return likelihood > of_other + np.log(1 / VALUE_P)


def _with_blur_length_check(
    plan: RestorationPlan, given: CameraProfile, capture: Capture, powers: Mapping[int, TilePowers]
) -> tuple[RestorationPlan, PathScale | None]:
    """Note blur paths of another length than predicted, and set ``contradicted`` so that harmful steps are skipped.

    Returns the plan, and the length; None: as predicted, or not measured.

    An offset from tracked points holds at mid-exposure, so it is corrected for the different exposure time.  A stated
    offset is kept for the observed motion if the points do not contradict it, or if the different exposure time
    explains the contradiction, which the note then says.
    """
    profile = plan.profile
    if not powers or profile.intrinsics is None:
        return plan, None
    frames = at_true_times(capture.frames, profile, capture.repeats)
    found = path_scale(_with_motion(plan, capture, powers), capture.bits_per_px)
    if found is None or not found.contradicts:
        return plan, None
    shutter, offset_s, explained = profile.shutter, profile.time_offset_s or 0.0, ""
    if profile.time_offset_s != given.time_offset_s:
        logged_s = float(np.median([frames[index].exposure_s or 0.0 for index in powers]))
        to_middle_s = (0.5 - STAMP_FRACTION[shutter.timestamp]) * shutter.true_exposure_s(logged_s)
        offset_s += (1 - found.scale) * to_middle_s
        tolerance_s = max(OFFSET_DOUBT_S, 3 * found.scale * found.std * abs(to_middle_s))
        if given.time_offset_s is not None and abs(offset_s - given.time_offset_s) < tolerance_s:
            explained = (
                f", which explains the time offset of {1e3 * (profile.time_offset_s or 0.0):+.1f} ms that is used"
            )
            offset_s = given.time_offset_s
            plan = plan.without(NoteCode.OTHER_OFFSET)
    text = f"{OTHER_PATHS} {found} times as long as the profile says{explained}: {CALIBRATE_EXPOSURE}"
    shutter = replace(shutter, exposure_scale=shutter.exposure_scale * found.scale)
    contradicted = replace(profile, shutter=shutter, time_offset_s=offset_s)
    return replace(plan, contradicted=contradicted).noted(NoteCode.BLUR_LENGTH, text), found


def _exposure_of_points(
    plan: RestorationPlan,
    given: CameraProfile,
    capture: Capture,
    tracked: Sequence[TrackPair],
    lengths: PathScale,
) -> float | None:
    """Factor on all exposures with which the tracked points agree with a stated offset; None if blur shows another.

    A longer exposure moves its middle away from the stamp, as an offset does; it lengthens blur paths, as no offset
    does.  Points determine it more accurately, and both agree only if the exposure is wrong.
    """
    shutter = given.shutter
    logged_s = [frame.exposure_s for frame in capture.frames if frame.exposure_s]
    to_middle_s = (0.5 - STAMP_FRACTION[shutter.timestamp]) * shutter.true_exposure_s(float(np.median(logged_s)))
    if given.time_offset_s is None or not to_middle_s:
        return None
    estimate = refine_time_offset(observe_tracks(capture, tracked, plan.profile), capture.imu, plan.profile)
    factor = 1 + (estimate.time_offset_s - given.time_offset_s) / to_middle_s
    if not estimate.determined or factor <= 0:
        return None
    apart = abs(np.log(factor / lengths.scale))
    return factor if apart < 2 * np.hypot(lengths.std, estimate.std_s / abs(to_middle_s)) else None


def _clock_agrees(alignment: VisualInertialAlignment | None, profile: CameraProfile) -> bool:
    """Whether a reliable joint fit already confirms the clock, and so that frames and gyroscope belong together."""
    clock = None if alignment is None else alignment.clock()
    return clock is not None and abs(clock[0] - (profile.time_offset_s or 0.0)) < AGREEMENT_SLACK_S


def _with_translations(plan: RestorationPlan, capture: Capture, alignment: VisualInertialAlignment) -> RestorationPlan:
    """Add the translation and depth plane of every frame for which they are known, with notes about all frames."""
    profile, reference = plan.profile, plan.settings.reference
    frames = [f for f in at_true_times(capture.frames, profile, capture.repeats) if np.isfinite(f.time_s)]
    motions = {frame.index: _motion(alignment, profile, frame, reference) for frame in frames}
    known = {index: motion for index, motion in motions.items() if isinstance(motion, FrameMotion)}
    if not known:
        return _without_translation(plan, alignment.refused or "no frames")
    plan = plan.without(NoteCode.TRANSLATION)
    open_frames = [motion for index, motion in motions.items() if index not in known]
    if open_frames:
        reason = max(map(str, open_frames), key=[str(motion) for motion in open_frames].count)
        text = f"{NOT_ESTIMATED} in {len(open_frames)} of {len(motions)} frames ({reason})"
        plan = plan.noted(NoteCode.TRANSLATION, text)
    unscaled = [motion.unscaled for motion in known.values() if motion.unscaled]
    if unscaled:
        reason = max(unscaled, key=unscaled.count)
        text = f"velocity over depth known, but not in metres, in {len(unscaled)} of {len(motions)} frames ({reason})"
        plan = plan.noted(NoteCode.TRANSLATION, text)
    translations = {index: _translation(motion, profile.depth_m) for index, motion in known.items()}
    scaled = [motion for motion in known.values() if not motion.unscaled]
    notes = (*plan.notes, _translation_note(scaled, alignment)) if scaled else plan.notes
    return replace(plan, notes=notes, translations=translations)


def _without_translation(plan: RestorationPlan, reason: str) -> RestorationPlan:
    return plan.without(NoteCode.TRANSLATION).noted(NoteCode.TRANSLATION, f"{NOT_ESTIMATED} ({reason})")


def _motion(
    alignment: VisualInertialAlignment, profile: CameraProfile, frame: Frame, reference: str
) -> FrameMotion | str:
    """Translation during the frame's exposure and readout, or the reason why it is unknown.

    Times are passed in the camera clock; the alignment converts them by its own clock fit.
    """
    clock = RowClock(profile)
    start_s, reference_s = frame_times_s(profile, frame.time_s, frame.exposure_s, reference)
    last_s = clock.end_s(frame.time_s, frame.exposure_s or 0.0)
    return alignment.frame(*(float(clock.camera_time_s(time_s)) for time_s in (reference_s, start_s, last_s)))


def _translation(motion: FrameMotion, stated_depth_m: float | None) -> FrameTranslation:
    """The frame's translation and depth plane; the depth for the log is the stated one, if any."""
    depth = motion.depth
    found_m = None if motion.unscaled else depth.depth_m
    return FrameTranslation(
        motion.velocity_m_s,
        motion.acceleration_m_s2,
        depth.plane_per_m,
        found_m if stated_depth_m is None else stated_depth_m,
        "triangulated" if stated_depth_m is None else "profile",
        depth.relief,
        motion.window if motion.unscaled else 0,
        motion.jerk_m_s3,
    )


def _translation_note(known: list[FrameMotion], alignment: VisualInertialAlignment) -> str:
    depth, std = (np.median([getattr(m.depth, name) for m in known]) for name in ("depth_m", "std_m"))
    speed = np.sqrt(np.mean([(m.velocity_m_s**2).sum() for m in known]))
    std_m_s = alignment.velocity_std_m_s(np.array([m.reference_s for m in known]))
    spread = np.sqrt(np.nanmean((std_m_s**2).sum(axis=1)))
    points = int(np.median([m.depth.points for m in known]))
    ahead = f"depth {depth:.2f} ± {std:.2f} m" if np.isfinite(depth) else "no surface"
    return (
        f"translation of {len(known)} frames from points and accelerometer: velocity {speed:.3f} ± {spread:.3f} m/s "
        f"rms, {ahead} at the centre, from about {points} points per frame"
    )


def applied_extensions(profile: CameraProfile) -> tuple[str, ...]:
    """One line for each extension of the nominal model that the profile enables and the run applies."""
    lines: dict[str, int] = {effect.applied(profile): 1 for effect in EFFECTS.values() if effect.applied(profile)}
    lines |= {f"field of {field.kind} over {', '.join(field.covariates)}: followed": 1 for field in profile.fields}
    bridged = len(profile.imu_untrusted_s) - len(profile.unbridged_s)
    lines[f"{bridged} stretches of an inertial log that is not trusted: bridged from the pictures"] = bridged
    return tuple(line for line, size in lines.items() if size)


def _through_resting_lens(pairs: list[TrackPair], capture: Capture, profile: CameraProfile) -> list[TrackPair]:
    """Tracks as the profile's lens would show them at stamp_0 with its stabiliser at rest.

    If the clock or focal length is still unknown, the lens's motion is unknown too, and the tracks are unchanged.
    """
    ext = profile.extensions
    moves = ext.focal_drift_per_s or ext.stabilisation_fraction or any(f.kind == "scale" for f in ext.field)
    if not moves or profile.intrinsics is None or profile.time_offset_s is None:
        return pairs
    lens = moving_lens(integrate_gyro(capture.imu, profile), profile)

    def resting(index: int, points_px: Array) -> Array:
        return resting_points(lens, profile, capture.frames[index], points_px)

    return [
        replace(
            pair,
            points_first_px=resting(pair.first, pair.points_first_px),
            points_second_px=resting(pair.second, pair.points_second_px),
        )
        for pair in pairs
    ]


def resting_points(lens: MovingLens, profile: CameraProfile, frame: Frame, points_px: Array) -> Array:
    """Points (n, 2) of a frame, each at its row's mid-exposure, as the lens at rest would project them."""
    time_s = RowClock(profile).seen_s(points_px, frame.time_s, frame.exposure_s or 0.0)
    return lens.lens.project(lens.rays(points_px, time_s))


def _default_notes(profile: CameraProfile, capture: Capture) -> tuple[PlanNote, ...]:
    """A note for each unknown value, which is set to its documented default."""
    notes = []
    if profile.response is None:
        notes.append(PlanNote(NoteCode.DEFAULT_TAKEN, "exposure curve unknown: srgb assumed"))
    if not profile.readout_known:
        notes.append(PlanNote(NoteCode.DEFAULT_TAKEN, "readout time unknown: 0 assumed, rows are not straightened"))
    if all(frame.exposure_s is None for frame in capture.frames):
        notes.append(PlanNote(NoteCode.DEFAULT_TAKEN, "exposure times unknown: frames are not deblurred"))
    if profile.depth_m is None:
        notes.append(PlanNote(NoteCode.TRANSLATION, NOT_ESTIMATED))
    return tuple(notes)


def _with_estimates(plan: RestorationPlan, imu: ImuSamples, observed: ObservedTracks) -> RestorationPlan:
    """The plan with time offset, gyroscope bias and focal length estimated from tracked points, or refused."""
    estimate = estimate_time_offset(observed, imu, plan.profile)
    plan = _with_focal(plan, estimate)
    if plan.profile.time_offset_s is not None:
        return plan
    if not estimate.determined:
        plan = plan.noted(NoteCode.TIME_OFFSET, f"time offset not determined ({estimate.reason})")
        if estimate.other_axes:
            return plan.refused(NoteCode.OTHER_AXES, "the gyroscope's axes are not the profile's: virest calibrate")
        if estimate.explained < MIN_EXPLAINED:
            return plan.refused(NoteCode.NOT_FOLLOWING, "the frames do not follow the gyroscope")
        if plan.refusal:
            return plan
        return plan.refused(NoteCode.TIME_OFFSET, "time offset not determined: virest calibrate")
    offset_s = estimate.time_offset_s
    profile = plan.profile.with_estimate(
        "time_offset_s", offset_s, estimate.std_s, POINTS_SOURCE, time_offset_s=offset_s
    )
    profile = _with_bias(profile, estimate)
    plan = replace(plan, profile=profile).noted(NoteCode.TIME_OFFSET, estimated_offset(offset_s, estimate.std_s))
    if estimate.std_s > MAX_OFFSET_STD_S and plan.refusal is None:
        return plan.refused(NoteCode.TIME_OFFSET, f"time offset only known to ± {estimate.std_s * 1e3:.1f} ms")
    return plan


def _noted_axes(plan: RestorationPlan, given: CameraProfile) -> RestorationPlan:
    """The plan with a note on the axes that are not the default ones."""
    angle = np.degrees(np.linalg.norm(rotation_between(given, plan.profile)))
    text = f"the gyroscope's axes are turned by {angle:.0f}° from the default ones, as tracked points show"
    return plan.noted(NoteCode.OTHER_AXES, text)


def _with_shown_readout(
    plan: RestorationPlan, given: CameraProfile, capture: Capture, tracked: Sequence[TrackPair]
) -> CameraProfile | None:
    """The given profile with the readout that points show, seen through the plan's lens and clock; None: none shown."""
    follows = plan.refusal is None or plan.refuses(NoteCode.TIME_OFFSET)
    if given.readout_known or plan.profile.intrinsics is None or not follows:
        return None
    observed = observe_tracks(capture, tracked, plan.profile)
    known = {"offset_known": given.time_offset_s is not None, "focal_known": given.intrinsics is not None}
    found = shown_readout(observed, capture.imu, plan.profile, **known)
    if found is None:
        return None
    shutter, std_s = found
    value, source = shutter.readout_time_s, POINTS_SOURCE
    return given.with_estimate("readout_time_s", value, std_s, source, shutter=shutter, readout_known=True)


def _noted_readout(plan: RestorationPlan) -> RestorationPlan:
    """The plan with a note on its readout, as estimated."""
    shutter, estimate = plan.profile.shutter, plan.profile.estimates["readout_time_s"]
    std_ms = 1e3 * float(np.max(np.asarray(estimate.std, float)))
    text = f"readout time estimated: {1e3 * shutter.readout_time_s:.2f} ± {std_ms:.2f} ms, {shutter.readout_direction}"
    return plan.noted(NoteCode.READOUT, text)


def _with_bias(profile: CameraProfile, estimate: OffsetEstimate) -> CameraProfile:
    """Adopt the gyroscope bias if it is significant in any axis; it has no finite deviation if it may be parallax."""
    bias, std = np.array(estimate.bias_rad_s), np.array(estimate.bias_std_rad_s)
    if not np.all(np.isfinite(std)) or np.all(np.abs(bias) < 3 * std):
        return profile
    source = POINTS_SOURCE
    values = tuple(float(b) for b in bias)
    return profile.with_estimate("gyro_bias_rad_s", list(values), std.tolist(), source, gyro_bias_rad_s=values)


def _with_focal(plan: RestorationPlan, estimate: OffsetEstimate) -> RestorationPlan:
    """Adopt the focal length if the profile has none and the frames determine it within MAX_FOCAL_SPREAD."""
    profile = plan.profile
    if profile.intrinsics is not None:
        return plan
    focal, std = estimate.focal_px, estimate.focal_std_px
    if focal is None or std is None or std > MAX_FOCAL_SPREAD * focal:
        known = "" if focal is None or std is None else f" (about {focal:.0f} ± {std:.0f} px)"
        return plan.refused(NoteCode.FOCAL_LENGTH, FOCAL_UNKNOWN + known)
    return replace(plan, profile=profile.with_focal(focal, std, POINTS_SOURCE))
