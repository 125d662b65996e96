"""`virest calibrate`: clock, readout, axes, bias and lens of a phone from an ordinary capture, without a target.

The coarse stage compares frame rotations with the gyroscope at every offset within 1 s, for any axes.  A robust fit to
tracked points follows, each at its own row's time: first on few points, for the readout's axis and sign and for the
camera's translation; then on many points, with all requested parameters.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from virest.calibration.calibrated_values import (
    GLOBAL_SHUTTER,
    NO_FINDING,
    CalibratedValue,
    beyond_limits,
    calibrated,
    correlations_of,
    global_shutter,
    is_determined,
    reset_undetermined,
    roughly_known,
    value_of,
    variances_of,
    with_estimates,
    without_readout,
)
from virest.calibration.unfitted_parameters import OPTIONAL, HeldValue, held_notes, held_values
from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.capture.imu_noise import noise_density
from virest.capture.records import Capture
from virest.effects.changes import keep_readout
from virest.errors import CalibrationError
from virest.image_formation.point_model import TrackTable, integrate_motion
from virest.image_formation.row_clock import as_global_shutter, right_way_round
from virest.inference import profile_terms as terms_of
from virest.inference.blur_bias import LEFT_BY_EVEN_BLUR, RELATIVE_STD, blur_bias_px, rolling_shift_px
from virest.inference.chance import student_tail
from virest.inference.coarse_alignment import MIN_PAIRS, SEARCH_S, CoarseAlignment, align_coarsely, align_with_skew
from virest.inference.coded_motion import coding_bias_px
from virest.inference.comparable_noise import residual_px, tracking_noise_px
from virest.inference.doubtful_log import Stretch, doubtful_stretches, doubts
from virest.inference.even_blur import even_guide, is_blurred
from virest.inference.log_bridges import touching, with_expected_rates
from virest.inference.observed_tracks import ObservedTracks, observe_tracks
from virest.inference.path_noise import path_errors_px
from virest.inference.recorder_lag import StartUpLag, fit_start_up_lag
from virest.inference.synchronisation import AGREEMENT_SLACK_S, DIRECTION_COST, DRIFT_P, other_reading
from virest.inference.track_fit import Term, TrackFit, fit_directed, fit_tracks, for_table, start_scene
from virest.inference.tracking import Guide, TrackPair
from virest.inference.tracking_bias import bias_std, remaining_std
from virest.inference.visual_inertial import START_INVERSE_DEPTH_PER_M
from virest.motion.scene_motion import DirectedMotion, InertialMotion, Motion

log = logging.getLogger(__name__)

FEW_POINTS, MANY_POINTS = 2000, 7000
"""Points of the fits for the readout's axis, and of the joint fit.  Half of the latter moves values by 1 σ at most and
widens σ 1.2 times; twice narrows it by 5 %."""
EXPLAINED_SCALE = 1.15
"""Whitened residuals with a scale below this need no translation."""
TRANSLATION_GAIN = 0.97
"""A translation is kept if it reduces the residual scale below this fraction."""
OUTLIER_WEIGHT, MANY_OUTLIERS = 0.1, 0.1
"""Tracks below this Cauchy weight (7.2 σ) do not follow the camera; a larger part of them is noted."""
EXCLUSION_PASSES = 3
"""Most fits after each of which image regions that move independently are excluded."""
SMALL_PART = 0.01
"""Smallest fraction of points that a note states as a number."""
CONSTANT_EXPOSURE_S = 1e-4
"""If exposures vary by less, an offset cannot be separated from their scale, nor from the timestamp reference."""
SUSPECTED_SIGMA, LEAST_DRIFT_S = 3.0, 1e-3
"""Clock skew is fitted if one step from the fit without it exceeds SUSPECTED_SIGMA, and this much per capture.

That step may be a part of the whole only, so the fit decides: the skew is kept if chance makes one as significant with
a probability below DRIFT_P."""
SMALL_DRIFT_S = 0.02
"""Below this drift per capture, and without translation, the fit with a skew starts from the one without."""
OTHER_FOCAL = 0.1
"""Smallest relative error of the focal length that is corrected before the fit, or suspected in an error message."""
FRAME_LAG = "frame-lag"
"""Start-up lag; an additional key of ``--with``."""


@dataclass(frozen=True, slots=True)
class GeometryCalibration:
    """A calibrated profile and its quality."""

    profile: CameraProfile
    values: tuple[CalibratedValue, ...]
    correlations: tuple[tuple[str, str, float], ...]
    """Pairs of values with an error correlation above 0.9."""
    translation: str
    """``none``, ``inertial`` (accelerometer path before a plane) or ``direction`` (residuals across the parallax)."""
    residual_px: float
    """Robust standard deviation per coordinate of tracked minus predicted points, without relief along the parallax."""
    noise_px: float
    """Tracking noise in the same measure, without the camera model."""
    before_px: float
    """Residual of the start profile at the coarse offset."""
    explained: float
    """Fraction of the changes in frame rotation that the gyroscope explains."""
    moving_fraction: float
    """Fraction of the tracks that do not follow the camera's motion."""
    pairs: int
    tracks: int
    notes: tuple[str, ...]
    fit: TrackFit
    contradicted: tuple[str, ...] = ()
    """Values held fixed that the points contradict, by key of OPTIONAL."""

    @property
    def determined(self) -> bool:
        """Whether all values were determined."""
        return all(value.determined for value in self.values)


def calibrate_geometry(
    capture: Capture,
    profile: CameraProfile,
    pairs: Sequence[TrackPair],
    extra: Sequence[str] = (),
    progress: Callable[[str], None] | None = None,
    track_again: Callable[[Guide], Sequence[TrackPair]] | None = None,
) -> GeometryCalibration:
    """Fit time offset, readout, IMU–camera rotation, gyroscope bias and the terms in ``extra``.

    extra: keys of OPTIONAL, and FRAME_LAG.  progress: called with the name of each finished stage.  track_again: tracks
    frames with a guide; once a fit explains the points, they are tracked in equally blurred frames.  Raises
    CalibrationError if the data do not determine even the offset: a camera at rest, a steady pan, too few points,
    frames that do not follow the gyroscope.
    """
    report = progress or (lambda _: None)
    bridged = with_expected_rates(profile, capture.imu, capture.stamp_0_ns)
    if bridged is not profile:
        unused = "pairs of frames there are not used"
        if _divides_movie(capture, profile):
            # beyond a stretch the direction of gravity, and so the path from the accelerometer, is uncertain
            gyro = replace(capture.imu, accel_m_s2=np.full_like(capture.imu.accel_m_s2, np.nan))
            capture, unused = replace(capture, imu=gyro), "pairs of frames there, and the accelerometer, are not used"
        found = calibrate_geometry(capture, bridged, pairs, extra, progress, track_again)
        of_phone = found.profile.with_fields(profile.fields)  # bridges hold for this log alone
        notes = tuple(f"{text}: {unused}" for text in doubts(capture.imu, profile))
        return replace(found, profile=of_phone, notes=(*notes, *found.notes))
    stretches = doubtful_stretches(capture.imu)
    observed = observe_tracks(capture, pairs, profile)
    lag = None
    if FRAME_LAG in extra and len(observed.pairs) >= MIN_PAIRS:
        lag = fit_start_up_lag(capture, observed, profile)
        observed = _at_true_times(capture, observed, lag)
    names = list(dict.fromkeys([*extra, *(["focal"] if profile.intrinsics is None else [])]))
    whole, coarse, start = _started(observed, capture.imu, profile, names)
    observed = _covered(whole, capture.imu, start, stretches)
    if len(observed.pairs) < MIN_PAIRS:
        raise CalibrationError(f"{len(observed.pairs)} pairs of frames lie inside the inertial data")
    report("coarse")
    rough = _readout_axis(capture.imu, observed.table(FEW_POINTS), start, names)
    report("readout")
    joint = _fit_jointly(capture.imu, observed, rough, names)
    drift = joint.held.get("clock-skew")
    span_s = float(np.ptp(joint.fit.seconds))
    drifted = False
    if drift is not None and _may_drift(drift, span_s):
        with_skew = [*names, "clock-skew"]
        if rough.is_plain and abs(float(drift.change[0])) * span_s < SMALL_DRIFT_S:
            _, again, begun = _started(observed, capture.imu, _skewed(profile, drift), names)
            near = replace(rough, profile=_skewed(joint.fit.profile, drift, float(np.mean(joint.fit.seconds))))
        else:  # the first fit may be far off: search for offset and skew again
            whole, again, begun = _started(whole, capture.imu, profile, with_skew)
            observed = _covered(whole, capture.imu, begun, stretches)
            near = _readout_axis(capture.imu, observed.table(FEW_POINTS), begun, with_skew)
        drifting = _fit_jointly(capture.imu, observed, near, with_skew)
        skewed = _conclude(capture.imu, profile, begun, again, near, drifting)
        if _is_significant(skewed, profile.clock_skew):
            start, coarse, rough, joint, names, drifted = begun, again, near, drifting, with_skew, True
    explained = joint.corrected and joint.fit.scale < EXPLAINED_SCALE
    if track_again is not None and explained and is_blurred(joint.fit, joint.table):
        even = observe_tracks(capture, track_again(even_guide(capture, joint.fit, joint.table)), profile)
        even = even if lag is None else _at_true_times(capture, even, lag)
        even = _covered(even, capture.imu, start, stretches)
        if len(even.pairs) >= MIN_PAIRS:
            fitted = replace(rough, profile=joint.fit.profile, scene=joint.fit.scene)
            joint = _fit_jointly(capture.imu, even, fitted, names, even_blur=True)
    found = _conclude(capture.imu, profile, start, coarse, rough, joint)
    if drifted:
        found = replace(found, notes=(_drift_note(found, profile.clock_skew), *found.notes))
    report("joint")
    notes = (*found.notes, *held_notes(joint.held, names), *_uneven_note(found.profile, profile))
    found = replace(found, notes=notes, contradicted=tuple(name for name, value in joint.held.items() if value.wrong))
    return found if lag is None else _with_lag(found, lag)


def _skewed(profile: CameraProfile, skew: HeldValue, at_s: float = 0.0) -> CameraProfile:
    """The profile with a clock skew that was held fixed; frames at ``at_s`` keep their time."""
    change = float(skew.change[0])
    offset_s = (profile.time_offset_s or 0.0) - at_s * change if at_s else profile.time_offset_s
    return replace(profile, clock_skew=profile.clock_skew + change, time_offset_s=offset_s)


def _may_drift(skew: HeldValue, span_s: float) -> bool:
    """Whether a skew that was held fixed may be significant and large.

    A single offset is then right at one instant only, although it looks well determined.
    """
    if skew.std[0] > calibrated("clock_skew").max_std:
        return False
    return skew.sigma > SUSPECTED_SIGMA and abs(float(skew.change[0])) * span_s > LEAST_DRIFT_S


def _is_significant(skewed: GeometryCalibration, given_skew: float) -> bool:
    """Whether chance hardly ever makes a clock skew as far from the given one as the fitted skew is."""
    fit = skewed.fit
    freedom = max(float(fit.stretches[fit.slices["clock_skew"]][0]) - 1, 1.0)
    sigma = abs(skewed.profile.clock_skew - given_skew) / _skew_std(skewed)
    return 2 * student_tail(sigma, freedom) < DRIFT_P


def _skew_std(found: GeometryCalibration) -> float:
    """Standard deviation of a fitted clock skew."""
    return float(np.max([np.max(np.asarray(v.std, float)) for v in found.values if v.name == "clock_skew"]))


def _drift_note(found: GeometryCalibration, given_skew: float) -> str:
    """Note that the clock skew was fitted without being requested."""
    span_ms, skew = 1e3 * float(np.ptp(found.fit.seconds)), found.profile.clock_skew - given_skew
    drift_ms, std_ms = span_ms * skew, span_ms * _skew_std(found)
    return f"the clocks drift apart by {drift_ms:+.1f} ± {std_ms:.1f} ms over the capture: clock-skew was fitted too"


def _divides_movie(capture: Capture, profile: CameraProfile) -> bool:
    """Whether a doubtful stretch of the log may lie between two frames; an unknown offset may be SEARCH_S."""
    slack_s = SEARCH_S if profile.time_offset_s is None else AGREEMENT_SLACK_S
    time_s = np.asarray(profile.imu_time_s(np.array([frame.time_s for frame in capture.frames])))
    first_s, last_s = float(np.nanmin(time_s)) - slack_s, float(np.nanmax(time_s)) + slack_s
    return any(stretch.to_s > first_s and stretch.from_s < last_s for stretch in doubtful_stretches(capture.imu))


def _covered(
    observed: ObservedTracks, imu: ImuSamples, profile: CameraProfile, stretches: Sequence[Stretch]
) -> ObservedTracks:
    """The pairs within the log by a profile's clocks, without those in its doubtful stretches unless few remain."""
    observed = observed.covered(imu, profile)
    trusted = observed.chosen(~touching(observed, stretches, (1 + profile.clock_skew, profile.time_offset_s or 0.0)))
    return trusted if len(trusted.pairs) >= MIN_PAIRS else observed


def _at_true_times(capture: Capture, observed: ObservedTracks, lag: StartUpLag) -> ObservedTracks:
    """Correct the pairs' timestamps by the start-up lag; if it is undetermined, exclude pairs of start-up frames."""
    if lag.determined:
        return replace(observed, stamp_s=observed.stamp_s + np.array(lag.by_frame_s))
    usable = np.array([frame.skip_reason is None for frame in capture.frames])
    return observed.chosen(np.array([usable[pair.first] and usable[pair.second] for pair in observed.pairs]))


def _with_lag(found: GeometryCalibration, lag: StartUpLag) -> GeometryCalibration:
    frames = lag.frames if lag.lag_s else 0  # that a recording has no lag holds for no other
    profile = found.profile.with_extensions(frame_lag_s=lag.lag_s, frame_lag_frames=frames)
    value = CalibratedValue("lag_s", 0.0, lag.lag_s, None, lag.determined, lag.note)
    return replace(found, profile=profile, values=(*found.values, value))


# ── coarse ───────────────────────────────────────────────────────────────────────────────────────────────────────


def _started(
    observed: ObservedTracks, imu: ImuSamples, profile: CameraProfile, names: Sequence[str]
) -> tuple[ObservedTracks, CoarseAlignment, CameraProfile]:
    """The points with the lens they start from, the coarse alignment, and the profile with its offset, axes and skew.

    names: keys of the values to fit.  If one is the focal length, a wrong one is scaled until the frames follow the
    gyroscope.  Raises CalibrationError if they never do.
    """
    if len(observed.pairs) < MIN_PAIRS:
        raise CalibrationError(
            f"{len(observed.pairs)} pairs of frames have enough trackable points, {MIN_PAIRS} are needed",
            hint="film something with texture, for a few seconds",
        )
    if len(imu) < 8:
        raise CalibrationError(f"{len(imu)} gyroscope samples", hint="check gyro_accel.csv")
    coarse, skew = _aligned(observed, imu, profile, "clock-skew" in names)
    doubt = coarse.doubt(len(observed.pairs), observed.lens.fx_px)
    if doubt is not None and (other := _other_focal(observed, imu, profile)) is not None:
        if "focal" not in names:
            hint = (
                f"at {other.gain:.2f} times the profile's focal length it explains {other.explained:.0%}: "
                "pass --with focal, or correct intrinsics.fx_px"
            )
            raise CalibrationError(doubt[0], hint=hint)
        observed = replace(observed, lens=observed.lens.scaled_focal(other.gain))
        coarse, skew = _aligned(observed, imu, profile, "clock-skew" in names)
        doubt = coarse.doubt(len(observed.pairs), observed.lens.fx_px)
    if doubt is not None:
        raise CalibrationError(doubt[0], hint=other_reading(observed, imu, profile) or doubt[1])
    axes = tuple(map(tuple, coarse.rotation_cam_imu.tolist()))
    start = replace(profile, time_offset_s=coarse.time_offset_s, r_cam_imu=axes, clock_skew=skew)
    return observed, coarse, replace(start, intrinsics=observed.lens)


def _aligned(
    observed: ObservedTracks, imu: ImuSamples, profile: CameraProfile, free_skew: bool
) -> tuple[CoarseAlignment, float]:
    """The coarse alignment and its clock skew.  Raises CalibrationError if no offset covers the frames."""
    turns = observed.turns(profile)
    found = align_with_skew(turns, imu, profile) if free_skew else None
    coarse, skew = found or (align_coarsely(turns, imu, profile), profile.clock_skew)
    if coarse is None:
        raise CalibrationError(
            "no offset within one second makes the inertial data cover the frames", hint="see virest inspect"
        )
    return coarse, skew


def _other_focal(observed: ObservedTracks, imu: ImuSamples, profile: CameraProfile) -> CoarseAlignment | None:
    """The alignment with another focal length at which the frames follow the gyroscope; None: there is none."""
    found = align_coarsely(observed.turns(profile), imu, profile, free_focal=True)
    if found is None or found.doubt(len(observed.pairs), observed.lens.fx_px) is not None:
        return None
    return found if abs(found.gain - 1) > OTHER_FOCAL else None


# ── readout and translation ──────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class _Rough:
    profile: CameraProfile
    scene: Motion | None
    direction_known: bool
    before: TrackFit
    """Fit of the time offset alone, with the start profile's readout."""

    @property
    def is_plain(self) -> bool:
        """Whether the points determined the readout's axis and needed no translation."""
        return self.direction_known and self.scene is None


def _readout_axis(imu: ImuSamples, table: TrackTable, start: CameraProfile, names: Sequence[str]) -> _Rough:
    """Fit a readout of either sign along rows and along columns, and keep the better axis.

    names: optional values of the joint fit.  Except for the focal length, they are fitted here only if they explain
    much of what rotation leaves, since a wrong lens looks like translation.
    """
    asked = _optional(names)
    wanted = [terms_of.TIME_OFFSET, terms_of.GYRO_BIAS, terms_of.IMU_ROTATION]
    wanted += [term for term in asked if term is terms_of.FOCAL]
    along = "left_to_right" if start.shutter.reads_columns else "top_to_bottom"
    across = "top_to_bottom" if start.shutter.reads_columns else "left_to_right"
    before = fit_tracks(imu, table, start, wanted[:1], max_iterations=4)
    first = _fit_with_translation(imu, table, as_global_shutter(start, along), [*wanted, terms_of.READOUT], asked)
    scene, fitted = first.scene, first.terms
    second = fit_tracks(imu, table, as_global_shutter(start, across), fitted, scene)
    difference = (first.cost - second.cost) / max(min(first.scale, second.scale) ** 2, 1e-9)
    best = second if difference > 0 else first
    if best is second and best.scene is not None:
        plain = fit_tracks(imu, table, best.profile, fitted)
        best = plain if plain.scale < EXPLAINED_SCALE else best
    log.debug("readout: cost %.1f %s, %.1f %s", first.cost, along, second.cost, across)
    rough = _Rough(best.profile, best.scene, abs(difference) > DIRECTION_COST, before)
    return _with_uneven_rows(rough, start)


def _with_uneven_rows(rough: _Rough, given: CameraProfile) -> _Rough:
    """Restore the profile's uneven row delays if the points confirm its readout direction."""
    uneven, found = given.shutter.uneven, right_way_round(rough.profile)
    if uneven is None:
        return rough
    if not rough.direction_known:
        found = keep_readout(found, given)
    if found.shutter.readout_direction != given.shutter.readout_direction or not found.shutter.readout_time_s:
        return rough
    return replace(rough, profile=found.with_shutter(uneven=uneven))


def _uneven_note(fitted: CameraProfile, given: CameraProfile) -> tuple[str, ...]:
    """Note that the profile's uneven row delays could not be kept."""
    if given.shutter.uneven is None or fitted.shutter.uneven is not None:
        return ()
    return (
        f"the profile's delay over the row belongs to rows read {given.shutter.readout_direction}, which the points "
        "contradict: it was omitted; virest diagnose finds it again",
    )


def _fit_with_translation(
    imu: ImuSamples, table: TrackTable, start: CameraProfile, wanted: list[Term], asked: list[Term]
) -> TrackFit:
    """Fit with the simplest translation that explains the points: none, the accelerometer's, or a direction.

    No translation is fitted if the requested terms explain the points.  If they explain much of the rest, they are
    fitted beside the translation, which would otherwise start from a wrong lens.
    """
    plain = fit_tracks(imu, table, start, wanted)
    if plain.scale < EXPLAINED_SCALE:
        return plain
    beside = [term for term in asked if term not in wanted]
    if beside:
        bent = fit_tracks(imu, table, plain.profile, [*wanted, *beside])
        if bent.scale < EXPLAINED_SCALE:
            return bent
        if bent.scale < TRANSLATION_GAIN * plain.scale:
            plain, start, wanted = bent, bent.profile, [*wanted, *beside]
    known = integrate_motion(imu, start, translation=True)
    if known.displacement is not None:
        scene = start_scene(imu, known, table, START_INVERSE_DEPTH_PER_M)
        inertial = fit_tracks(imu, table, start, wanted, scene)
        return inertial if inertial.scale < TRANSLATION_GAIN * plain.scale else plain
    return fit_directed(imu, table, start, wanted)


# ── joint fit ────────────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class _Joint:
    fit: TrackFit
    table: TrackTable
    observed: ObservedTracks
    """The points, without those of image regions that move independently."""
    excluded: float
    """Fraction of the points excluded as moving independently."""
    corrected: bool
    """Whether the bias of blur and encoder was removed from the points."""
    even: bool
    """Whether the points were tracked in equally blurred frames."""
    held: dict[str, HeldValue]
    """Optional values that were not fitted, by key of OPTIONAL."""


def _optional(names: Sequence[str]) -> list[Term]:
    return [OPTIONAL[name] for name in names if name in OPTIONAL]


def _fit_jointly(
    imu: ImuSamples, observed: ObservedTracks, rough: _Rough, names: Sequence[str], *, even_blur: bool = False
) -> _Joint:
    """Fit all requested values to many points, without image regions that move independently and without mean bias.

    even_blur: guided pairs were tracked in equally blurred frames, and have no bias of blur.
    """
    wanted = [terms_of.TIME_OFFSET, terms_of.READOUT, terms_of.IMU_ROTATION, terms_of.GYRO_BIAS, *_optional(names)]
    excluded = 0.0
    for _ in range(EXCLUSION_PASSES):
        table = observed.table(MANY_POINTS)
        fit = fit_tracks(imu, table, rough.profile, wanted, for_table(rough.scene, table))
        observed, newly_excluded = observed.without_astray(table.first_px, fit.distance)
        excluded += (1 - excluded) * newly_excluded
        if not newly_excluded:
            break
    corrected = bool(np.any(table.first_exposure_s)) and not isinstance(fit.scene, DirectedMotion)
    errors_px = []
    if isinstance(fit.scene, InertialMotion):
        errors_px.append(path_errors_px(imu, fit.integrated, table, fit.scene))
    if corrected:  # without an accelerometer the blur due to translation is unknown
        table = _in_the_mean_of_rows(fit, table)
        guided = np.array([pair.guided for pair in observed.pairs])
        blur_px = blur_bias_px(fit.integrated, table, guided)
        coding_px = coding_bias_px(fit.integrated, table, fit.scene)
        even = (even_blur & guided)[table.pair, None]
        table = replace(table, second_px=table.second_px - np.where(even, 0.0, blur_px) - coding_px)
        errors_px.append(np.where(even, LEFT_BY_EVEN_BLUR, RELATIVE_STD)[None] * blur_px)
    if errors_px:
        fit = fit_tracks(imu, table, fit.profile, wanted, fit.scene, errors_px=np.concatenate(errors_px))
    vary = observed.exposure_known and float(np.ptp(observed.exposure_s)) > CONSTANT_EXPOSURE_S
    held = held_values(imu, table, fit, float(np.median(observed.noise_px)), vary)
    return _Joint(fit, table, observed, excluded, corrected, even_blur, held)


def _in_the_mean_of_rows(fit: TrackFit, table: TrackTable) -> TrackTable:
    """The points at which a readout without motion along its rows would have seen them."""
    first_px = rolling_shift_px(fit.integrated, table.first_px, table.first_stamp_s, table.first_exposure_s)
    second_px = rolling_shift_px(fit.integrated, table.second_px, table.second_stamp_s, table.second_exposure_s)
    return replace(table, first_px=table.first_px - first_px, second_px=table.second_px - second_px)


# ── conclusions ──────────────────────────────────────────────────────────────────────────────────────────────────


def _conclude(
    imu: ImuSamples, given: CameraProfile, start: CameraProfile, coarse: CoarseAlignment, rough: _Rough, joint: _Joint
) -> GeometryCalibration:
    """Assess and assemble the result."""
    fit, observed = joint.fit, joint.observed
    noise = float(np.median(observed.noise_px))
    if joint.even:
        gyro_rad_s = _gyro_mean_std_rad_s(imu, float(np.ptp(fit.seconds)))
        bias = {term.name: remaining_std(fit, term.name, gyro_rad_s) for term in fit.terms}
    else:
        bias = {term.name: bias_std(fit, term.name, noise) for term in fit.terms}
    variances = variances_of(fit, bias)
    if isinstance(fit.scene, DirectedMotion):
        turn_rad, rate_rad_s = _mistaken_rotation(joint, coarse)
        variances["imu_rotation"] = variances["imu_rotation"] + turn_rad**2
        variances["gyro_bias"] = variances["gyro_bias"] + rate_rad_s**2
    rolling = not global_shutter(fit, variances)
    determined = {term.name: is_determined(fit, term.name, variances[term.name], rolling) for term in fit.terms}
    beyond = {name: reason for name, reason in beyond_limits(fit, observed, rolling).items() if determined[name]}
    determined = {name: known and name not in beyond for name, known in determined.items()}
    is_global = not rolling and determined["readout_time"]
    profile = right_way_round(reset_undetermined(fit, given, start, determined))
    if is_global:
        profile = without_readout(profile, given)
    elif not rough.direction_known and not determined["readout_time"]:
        profile = keep_readout(profile, given)
    values = tuple(
        value_of(term.name, given, profile, fit.profile, variances[term.name], determined[term.name])
        for term in fit.terms
    )
    values = tuple(roughly_known(value, fit) if value.name == "time_offset_s" else value for value in values)
    kept = {calibrated(name).name for name in beyond}
    values = tuple(
        replace(value, note=NO_FINDING, implausible=True) if value.name in kept else value for value in values
    )
    if is_global:
        values = tuple(replace(v, note=GLOBAL_SHUTTER) if v.name == "readout_time_s" else v for v in values)
    else:
        direction_known = rough.direction_known and determined["readout_time"]
        words = given.shutter.readout_direction, profile.shutter.readout_direction
        values = (*values[:2], CalibratedValue("readout_direction", *words, None, direction_known), *values[2:])
    profile = with_estimates(profile, values)
    moving = float(np.mean(fit.weight < OUTLIER_WEIGHT))
    notes = _notes(coarse, fit, moving, joint.excluded, observed, determined)
    notes = (*notes, *(f"{calibrated(name).name} would be {reason}: that is implausible, so the given value was kept; "
                       "virest diagnose may find the real cause" for name, reason in beyond.items()))  # fmt: skip
    return GeometryCalibration(
        profile, values, correlations_of(fit, variances), _translation(fit), residual_px(fit),
        tracking_noise_px(observed, fit), residual_px(rough.before), coarse.explained, moving,
        len(observed.pairs), observed.tracks, notes, fit,
    )  # fmt: skip


def _mistaken_rotation(joint: _Joint, coarse: CoarseAlignment) -> tuple[float, float]:
    """Standard deviations of axes (rad) and gyroscope bias (rad/s) due to translation taken for rotation.

    Without an accelerometer, yaw and pitch before a plane differ from translation by second-order terms only.  What the
    fit leaves unexplained may thus be a rotation in every pair: at a constant rate, or in step with the camera's own.
    """
    observed = joint.observed
    excess = residual_px(joint.fit) ** 2 - tracking_noise_px(observed, joint.fit) ** 2
    turn_rad = max(excess, 0.0) ** 0.5 / observed.lens.fx_px
    period_s = float(
        np.median([observed.stamp_s[pair.second] - observed.stamp_s[pair.first] for pair in observed.pairs])
    )
    return turn_rad / coarse.motion_rad, turn_rad / period_s


def _gyro_mean_std_rad_s(imu: ImuSamples, span_s: float) -> float:
    """Standard deviation of the gyroscope's mean white noise over a time, which is indistinguishable from a bias."""
    return (noise_density(imu.time_s, imu.gyro_rad_s) or 0.0) / max(span_s, 0.1) ** 0.5


def _translation(fit: TrackFit) -> str:
    if fit.scene is None:
        return "none"
    return "inertial" if isinstance(fit.scene, InertialMotion) else "direction"


def _notes(
    coarse: CoarseAlignment,
    fit: TrackFit,
    moving: float,
    excluded: float,
    observed: ObservedTracks,
    determined: dict[str, bool],
) -> tuple[str, ...]:
    notes = []
    if coarse.axes_changed:
        notes.append("the profile's T_cam_imu does not fit: axes were estimated from the rotations")
    if isinstance(fit.scene, DirectedMotion):
        notes.append("the camera translates and there is no accelerometer: points were judged across their parallax")
    if excluded:
        part = f"{excluded:.0%}" if excluded >= SMALL_PART else f"less than {SMALL_PART:.0%}"
        notes.append(f"{part} of the points lie in image regions that move independently and were excluded")
    if moving > MANY_OUTLIERS:
        notes.append(f"{moving:.0%} of the tracks do not follow the camera (moving objects, or not a plane)")
    if not observed.exposure_known:
        notes.append("exposure times unknown: the offset refers to the middle of the exposure")
    elif np.ptp(observed.exposure_s) < CONSTANT_EXPOSURE_S and determined["time_offset"]:
        notes.append(
            "at constant exposure an offset cannot be distinguished from another timestamp reference: "
            f"exposure_end would give {1e3 * float(np.median(observed.exposure_s)):+.2f} ms more"
        )
    return tuple(notes)
