"""`virest diagnose`: what the model gets wrong on a capture, why, and what each cause gains where it was not fitted.

First what moves points (tracked from frame to frame), for brightness and blur are only comparable once points are where
they should be; then brightness, then blur.  What is left is tested for structure.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from virest.calibration.start_up import Schedule, lag_schedules
from virest.camera.profile import CameraProfile
from virest.camera.response import ResponseCurve
from virest.camera.shutter import STAMP_FRACTION
from virest.capture.records import NO_STAMP, Capture, Frame
from virest.degradation.light import flicker
from virest.diagnosis import picture_ladder
from virest.diagnosis.findings import (
    CONSISTENT,
    EXPLAINED,
    GEOMETRY,
    PHOTOMETRY,
    UNEXPLAINED,
    Diagnosis,
    Finding,
    Nominal,
    ParameterChange,
    Remaining,
    Rival,
)
from virest.diagnosis.geometric_evidence import make_evidence
from virest.diagnosis.geometric_ladder import MAX_RUNGS, FarClock, GeometricVerdict, climb, findings_of, varies
from virest.diagnosis.picture_ladder import Reader, climb_blur, climb_photometry, judge_curve
from virest.diagnosis.structure import Structure, structures
from virest.errors import CaptureError
from virest.motion import profile_terms as terms_of
from virest.motion.coarse_alignment import align_coarsely, align_with_skew
from virest.motion.integration import integrate_gyro
from virest.motion.observed_tracks import CELLS, ObservedTracks, observe_tracks
from virest.motion.track_fit import Term
from virest.motion.track_model import seen_s
from virest.motion.track_noise import step_noise_px
from virest.motion.tracking import track_pairs
from virest.motion.turns import gyro_turns

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
MIN_PAIRS = 6
MIN_EXPLAINED, MIN_MOTION_PX = 0.3, 0.4
AXIS_EXPLAINED = 0.6
"""Least squared correlation about one axis."""
WELL_EXPLAINED = 0.98
"""Turns that agree so well leave no other clock rate to look for far off."""
COINCIDENCE_SIGMA = 3.5
STRUCTURE_PX, STRUCTURE_NOISES = 0.05, 0.4
"""Structure of this size, and of this part of the noise, has a cause."""
STRUCTURE_P = 1e-4
TRACKING_BIAS_PX = 0.02
SCALE_EXCESS = 1.25
"""Differences this many times their noise, measured without the model, are not all noise."""
LEAST_IN_PAIR = 8
STRAY_DISTANCE, STRAY_PART = 6.0, 0.1
TOGETHER = 0.3
"""Least intraclass correlation of points that move together."""
NEIGHBOURHOOD = np.add.outer(np.arange(CELLS) // 2 * CELLS, np.arange(CELLS) // 2).ravel()
"""Number of the block of two by two cells that each cell lies in."""
CALM = 40.0
"""Brightness this many typical deviations off counts half: a band of the sensor is evidence, a passer-by is not."""
PHOTOMETRIC_STRUCTURE = 1.5
"""Grey levels."""


def diagnose_capture(
    capture: Capture,
    profile: CameraProfile,
    pictures: Reader,
    gray: Reader,
    progress: Callable[[str, float], None] | None = None,
) -> Diagnosis:
    """Climb the ladder on one capture; pictures gives (index, RGB), gray (index, luma) of the frames asked for.

    Raises CaptureError where there is nothing to judge by: too few points.
    """
    say = progress or (lambda _text, _part: None)
    indices = [frame.index for frame in capture.frames if NO_STAMP not in frame.skip_codes]
    say("tracking", 0.02)
    observed = observe_tracks(capture, track_pairs(gray(indices)), profile)
    start, null_terms, notes, far, follows = _with_null_values(observed, capture, profile)
    observed = observed.covered(capture.imu, start)
    if len(observed.pairs) < MIN_PAIRS:
        raise CaptureError(
            f"{len(observed.pairs)} pairs of frames have points to follow, {MIN_PAIRS} are needed",
            hint="a longer capture, or one with more texture",
        )
    say("points", 0.15)
    schedules = lag_schedules(capture, capture.repeats) if not profile.extensions.frame_lag_frames else []
    rungs_allowed = MAX_RUNGS if follows or schedules else 0
    if not rungs_allowed:
        notes.append("the pictures do not follow the gyroscope at any offset: no cause was fitted to the points")
    points = _Points(capture, observed, start, tuple(null_terms), schedules, far, rungs_allowed)
    first = geometric = points.climbed(lambda part: say("points", 0.15 + 0.35 * part))
    frames = _at_model_times(capture, geometric)
    trajectory = integrate_gyro(capture.imu, geometric.model.profile)
    say("brightness", 0.5)
    photometric = climb_photometry(capture, frames, geometric.model.profile, trajectory, pictures)
    if _points_left(geometric).significant and _pulses(photometric.profile):
        say("points again", 0.65)
        even = _evened(gray, frames, photometric.profile)
        again = observe_tracks(capture, track_pairs(even([frame.index for frame in frames])), profile)
        points = replace(points, observed=again.covered(capture.imu, start), start=_pulsing(start, photometric.profile))
        geometric = points.climbed(lambda part: say("points again", 0.65 + 0.1 * part))
    findings = _stamped(geometric, findings_of(geometric), observed.exposure_s)
    moves_right = not _points_left(geometric).significant
    say("blur", 0.75)
    hypothesis = _exposure_hypothesis(findings, observed.exposure_s)
    blurred, is_exposure = picture_ladder.PictureVerdict(photometric.profile), False
    if moves_right:
        shown = replace(capture, frames=tuple(frames))
        lit = _merged(geometric.model.profile, photometric.profile, photometric.profile, False)
        blurred, is_exposure = climb_blur(shown, lit, integrate_gyro(capture.imu, lit), gray, hypothesis)
    else:
        notes.append("points do not go where the model says: blur, and what it does to the curve, were not judged")
    if is_exposure and hypothesis is not None:
        exposure = _as_exposure(findings, hypothesis, float(np.median(observed.exposure_s)))
        geometric = replace(points, start=_exposed(points.start, hypothesis)).climbed(
            lambda part: say("points again", 0.8)
        )
        findings = [exposure, *_stamped(geometric, findings_of(geometric), observed.exposure_s)]
        blurred = _one_exposure(blurred)
    elif any(finding.name == "exposure_time" for finding in findings):
        blurred, is_exposure = _one_exposure(blurred), True
    extended = _merged(geometric.model.profile, photometric.profile, blurred.profile, is_exposure)
    say("curve", 0.92)
    curve = picture_ladder.PictureVerdict(extended)
    if moves_right and not _paths_uncertain(extended, geometric):
        curve = judge_curve(extended, photometric.observations, frames, integrate_gyro(capture.imu, extended), pictures)
        extended = curve.profile
    say("what is left", 0.97)
    findings = [*findings, *photometric.findings, *blurred.findings, *curve.findings]
    findings.sort(key=lambda f: -f.held_out.before / max(f.held_out.after, 1e-9))
    remaining = _remaining(geometric, photometric)
    verdict = UNEXPLAINED if remaining.significant else EXPLAINED if findings else CONSISTENT
    nominal = Nominal(
        first.nominal_rms_px, first.noise_px, photometric.photometric_rms, blurred.blur_rms_px,
        observed.tracks, len(indices),
    )  # fmt: skip
    rungs = (*geometric.rungs, *photometric.rungs, *blurred.rungs, *curve.rungs)
    residuals = {"before": _residuals(first, True), "after": _residuals(geometric, False)}
    all_notes = (*notes, *geometric.notes, *photometric.notes, *blurred.notes, *curve.notes)
    return Diagnosis(
        verdict, nominal, tuple(findings), remaining, first.nominal.profile, extended, rungs, residuals, all_notes
    )


@dataclass(frozen=True, slots=True)
class _Points:
    """Tracked points and where their ladder begins."""

    capture: Capture
    observed: ObservedTracks
    start: CameraProfile
    null_terms: tuple[Term, ...]
    schedules: Sequence[Schedule]
    far: FarClock
    rungs_allowed: int

    def climbed(self, progress: Callable[[float], None]) -> GeometricVerdict:
        """The ladder's end, climbed again without the parts of the picture that move together on their own."""
        found = self._climbed(self.observed, progress)
        if not self.rungs_allowed:
            return found
        cells = self.observed.astray_cells(found.table.first_px, found.fit.distance)
        place = self.observed.cells(found.table.first_px)
        there, astray = cells[place], float(cells[place].mean())
        neighbours = len(cells) * found.table.pair + NEIGHBOURHOOD[place]
        calm = found.fit.difference_px * found.fit.weight[:, None]
        if astray < STRAY_PART or _together(calm[there], neighbours[there]) < TOGETHER:
            return found
        rest = self.observed.without_cells(cells)
        again = self._climbed(replace(rest, noise_px=step_noise_px(rest.pairs)), progress)
        again.astray = astray
        again.notes.append(f"{astray:.0%} of the points lie in parts of the picture that go their own way: left out")
        return again

    def _climbed(self, observed: ObservedTracks, progress: Callable[[float], None]) -> GeometricVerdict:
        evidence = make_evidence(self.capture.imu, observed)
        return climb(evidence, self.start, self.null_terms, self.schedules, self.far, progress, self.rungs_allowed)


def _together(difference_px: Array, group: NDArray[np.intp]) -> float:
    """How much of the differences (n, 2) neighbours of one moment share: their intraclass correlation.

    Neighbours that are badly tracked share nothing; a thing that moves is shared by its points.
    """
    count = np.bincount(group)
    ordered = float((count * (count - 1)).sum())
    squared = float((difference_px**2).sum())
    common = sum(float((np.bincount(group, column) ** 2).sum()) for column in difference_px.T) - squared
    return common / max(ordered, 1.0) / max(squared / max(len(group), 1), 1e-12)


def _paths_uncertain(profile: CameraProfile, geometric: GeometricVerdict) -> bool:
    """Whether blur depends on more than turns: then what blur mixes says little about the curve."""
    extensions = profile.extensions
    return bool(extensions.stabilisation_fraction or extensions.defocus_sigma_px or geometric.model.scene is not None)


def _exposed(profile: CameraProfile, scale: float) -> CameraProfile:
    shutter = profile.shutter
    return replace(profile, shutter=replace(shutter, exposure_scale=shutter.exposure_scale * scale))


def _pulsing(profile: CameraProfile, lit: CameraProfile) -> CameraProfile:
    """The profile with the lamps' flicker: it moves the mean time of each row's light."""
    light = lit.extensions
    extensions = replace(
        profile.extensions,
        flicker_amplitude=light.flicker_amplitude,
        flicker_frequency_hz=light.flicker_frequency_hz,
        flicker_phase_rad=light.flicker_phase_rad,
    )
    return replace(profile, extensions=extensions)


def _pulses(profile: CameraProfile) -> bool:
    """Whether light changes between frames, which pulls at the points that are followed."""
    return bool(profile.extensions.flicker_amplitude or profile.extensions.gain)


def _evened(gray: Reader, frames: Sequence[Frame], profile: CameraProfile) -> Reader:
    """The same pictures without flicker and gain, to follow points by."""
    by_index = {frame.index: frame for frame in frames}
    curve = profile.response or ResponseCurve("srgb")
    height, width, shutter = profile.height, profile.width, profile.shutter
    along = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    fraction = shutter.readout_fraction(along[:, :1] if not shutter.reads_columns else along[:1], width, height)

    def even(wanted: Sequence[int]) -> Iterator[tuple[int, NDArray[np.uint8] | None]]:
        for index, picture in gray(wanted):
            frame = by_index.get(index)
            if picture is None or frame is None:
                yield index, picture
                continue
            exposure_s = shutter.true_exposure_s(frame.exposure_s or 0.0)
            start_s = profile.imu_time_s(shutter.first_row_start_s(frame.time_s, frame.exposure_s or 0.0))
            light = flicker(profile, start_s + fraction * shutter.readout_time_s + 0.5 * exposure_s, exposure_s)
            gain = profile.extensions.gain[index] if index < len(profile.extensions.gain) else 1.0
            linear = curve.linear_table()[picture] / (light * gain)
            yield index, np.clip(np.rint(255 * curve.encode(linear)), 0, 255).astype(np.uint8)

    return even


# ── what the profile leaves open ─────────────────────────────────────────────────────────────────────────────────


def _with_null_values(
    observed: ObservedTracks, capture: Capture, profile: CameraProfile
) -> tuple[CameraProfile, list[Term], list[str], FarClock, bool]:
    """The profile with unknown values begun somewhere, terms to fit on every rung, and far-off starts of the clocks.

    The last: whether the turns of pictures and gyroscope agree at any offset, as far as the camera turns.
    """
    terms: list[Term] = []
    notes: list[str] = []
    if profile.intrinsics is None:
        profile = replace(profile, intrinsics=observed.lens)
        terms.append(terms_of.FOCAL)
        notes.append("focal length unknown: fitted on every rung, from a guess")
    if not profile.readout_known:
        terms.append(terms_of.READOUT)
    far = _agree_at(observed, capture, profile)
    agree = far is not None or _hardly_turns(observed, profile) or _one_axis_agrees(observed, capture, profile)
    if profile.time_offset_s is not None:
        return profile, terms, notes, far or FarClock(), agree
    if far is None:
        notes.append("the time offset is unknown and the pictures do not tell it: 0 taken")
        return replace(profile, time_offset_s=0.0), terms, notes, FarClock(), agree
    terms.append(terms_of.TIME_OFFSET)
    begun = replace(profile, time_offset_s=far.offset_s)
    return begun, terms, notes, FarClock(0.0, far.skewed_offset_s - far.offset_s, far.skew), agree


def _hardly_turns(observed: ObservedTracks, profile: CameraProfile) -> bool:
    """Whether the pictures' turns are too small to be compared with a gyroscope's."""
    if len(observed.pairs) < MIN_PAIRS:
        return True
    turns = observed.turns(profile)
    changing = turns.detrended(turns.vector_rad)
    return float(np.sqrt(np.mean((changing**2).sum(axis=-1)))) * observed.lens.fx_px < MIN_MOTION_PX


def _one_axis_agrees(observed: ObservedTracks, capture: Capture, profile: CameraProfile) -> bool:
    """Whether turns about some axis follow the gyroscope's by any factor: a stabiliser takes most of pitch and yaw."""
    profile = replace(profile, time_offset_s=profile.time_offset_s or 0.0)
    turns = observed.covered(capture.imu, profile).turns(profile)
    if len(turns.vector_rad) < MIN_PAIRS:
        return False
    times = (np.asarray(profile.imu_time_s(s)) for s in (turns.first_s, turns.second_s))
    told = turns.detrended(gyro_turns(integrate_gyro(capture.imu, profile), *times))
    seen = turns.detrended(turns.vector_rad)
    product = (seen * told).sum(axis=0) ** 2
    square = np.maximum((seen**2).sum(axis=0) * (told**2).sum(axis=0), 1e-30)
    return bool(np.max(product / square) > AXIS_EXPLAINED)


def _agree_at(observed: ObservedTracks, capture: Capture, profile: CameraProfile) -> FarClock | None:
    """Changes of the profile's clocks at which turns agree best; None where they agree nowhere."""
    if len(observed.pairs) < MIN_PAIRS:
        return None
    turns, given_s = observed.turns(profile), profile.time_offset_s or 0.0
    coarse = align_coarsely(turns, capture.imu, profile)
    if coarse is None or coarse.explained < MIN_EXPLAINED or coarse.at_end:
        return None
    far = FarClock(coarse.time_offset_s - given_s)
    if coarse.explained < WELL_EXPLAINED and (other := align_with_skew(turns, capture.imu, profile)) is not None:
        skewed, skew = other
        far = replace(far, skewed_offset_s=skewed.time_offset_s - given_s, skew=skew - profile.clock_skew)
    return far


def _at_model_times(capture: Capture, geometric: GeometricVerdict) -> list[Frame]:
    """Frames that can be looked at, with the stamps that the model gives them."""
    lag = geometric.model.lag
    frames = []
    for frame in capture.frames:
        if frame.skip_reason is None or (frame.only_startup and lag):
            shift = lag[frame.index] if lag else 0.0
            frames.append(replace(frame, time_s=frame.time_s + shift, skip_reason=None, skip_codes=()))
    return frames


# ── causes that look alike ───────────────────────────────────────────────────────────────────────────────────────


def _stamped(geometric: GeometricVerdict, findings: list[Finding], exposure_s: Array) -> list[Finding]:
    """At constant exposure an offset of just half or one exposure is another meaning of the stamp."""
    if varies(exposure_s) or float(np.median(exposure_s)) <= 0:
        return findings
    nominal = geometric.nominal.profile
    exposure = nominal.shutter.true_exposure_s(float(np.median(exposure_s)))
    result = []
    for finding in findings:
        if finding.name == "timestamp_reference":
            known = tuple(rival for rival in finding.rivals if rival.name != "time_offset")
            result.append(replace(finding, rivals=(Rival("time_offset", finding.held_out.after), *known)))
            continue
        if finding.name != "time_offset":
            result.append(finding)
            continue
        change = finding.parameters["time_offset_s"]
        shift, std = change.estimate - (change.nominal or 0.0), float(change.std)
        others = [rival for rival in finding.rivals if rival.name != "timestamp_reference"]
        meaning = _meaning(nominal.shutter.timestamp, shift, exposure, std)
        if meaning is None:
            result.append(finding)
            continue
        result.append(
            replace(
                finding,
                name="timestamp_reference",
                parameters={"timestamp": ParameterChange(nominal.shutter.timestamp, meaning, None)},
                rivals=(Rival("time_offset", finding.held_out.after), *others),
                sentence=f"a frame's stamp means its {meaning}; or the clocks differ by {shift:.4g} s",
            )
        )
        shutter = replace(geometric.model.profile.shutter, timestamp=meaning)
        geometric.model = replace(
            geometric.model,
            profile=replace(geometric.model.profile, shutter=shutter, time_offset_s=nominal.time_offset_s),
        )
    return result


def _meaning(now: str, shift_s: float, exposure_s: float, std_s: float) -> str | None:
    """The stamp's meaning that an offset amounts to: its first row starts later by (now − meaning) exposures."""
    for meaning, fraction in STAMP_FRACTION.items():
        expected = (STAMP_FRACTION[now] - fraction) * exposure_s
        if meaning != now and abs(shift_s - expected) < COINCIDENCE_SIGMA * std_s:
            return meaning
    return None


def _exposure_hypothesis(findings: Sequence[Finding], exposure_s: Array) -> float | None:
    """The exposure scale whose longer or shorter middle would look like the time offset found."""
    exposure = float(np.median(exposure_s))
    for finding in findings:
        if finding.name == "time_offset" and not varies(exposure_s) and exposure > 0:
            change = finding.parameters["time_offset_s"]
            return 1.0 + 2.0 * (change.estimate - (change.nominal or 0.0)) / exposure
    return None


def _as_exposure(findings: Sequence[Finding], scale: float, exposure_s: float) -> Finding:
    """Put an offset down to the exposure: the points tell its size better than the blur."""
    finding = next(f for f in findings if f.name == "time_offset")
    std = 2.0 * float(finding.parameters["time_offset_s"].std) / exposure_s
    return replace(
        finding,
        name="exposure_time",
        parameters={"exposure_scale": ParameterChange(1.0, scale, std)},
        rivals=(Rival("time_offset", finding.held_out.after),),
        sentence=picture_ladder.SENTENCES["exposure_time"].format(exposure_scale=f"{scale:.3g}"),
    )


def _one_exposure(blurred: picture_ladder.PictureVerdict) -> picture_ladder.PictureVerdict:
    blurred.findings = [finding for finding in blurred.findings if finding.name != "exposure_time"]
    return blurred


def _merged(
    moved: CameraProfile,
    lit: CameraProfile,
    blurred: CameraProfile,
    is_exposure: bool,
) -> CameraProfile:
    """Every cause in one profile: geometry from the first, light from the second, blur from the third."""
    light = lit.extensions
    extensions = replace(
        moved.extensions,
        vignetting_corner_loss=light.vignetting_corner_loss,
        flicker_amplitude=light.flicker_amplitude,
        flicker_frequency_hz=light.flicker_frequency_hz,
        flicker_phase_rad=light.flicker_phase_rad,
        gain=light.gain,
        defocus_sigma_px=blurred.extensions.defocus_sigma_px,
    )
    shutter = moved.shutter if is_exposure else replace(moved.shutter, exposure_scale=blurred.shutter.exposure_scale)
    return replace(moved, response=lit.response, extensions=extensions, shutter=shutter)


# ── what is left ─────────────────────────────────────────────────────────────────────────────────────────────────


def _residuals(geometric: GeometricVerdict, nominal: bool) -> dict[str, Array]:
    """Differences (px) and what they may run along."""
    fitted = geometric.nominal_fit if nominal else geometric.fit
    table = geometric.nominal_table if nominal else geometric.table
    profile, lens = fitted.profile, fitted.profile.intrinsics
    assert lens is not None
    centre = np.array([lens.cx_px, lens.cy_px])
    second_s = seen_s(profile, table.second_px, table.second_stamp_s, table.second_exposure_s)
    rate = np.linalg.norm(fitted.ground.trajectory.rate_rad_s(second_s), axis=-1)
    return {
        "x_px": fitted.difference_px[:, 0],
        "y_px": fitted.difference_px[:, 1],
        "row": profile.shutter.readout_fraction(table.second_px, profile.width, profile.height),
        "time": second_s,
        "radius": np.linalg.norm(table.second_px - centre, axis=-1),
        "rate": rate,
        "column": table.second_px[:, 0],
        "line": table.second_px[:, 1],
        "pair": table.pair.astype(float),
        "weight": fitted.weight,
        "distance": fitted.distance,
    }


def _remaining(geometric: GeometricVerdict, photometric: picture_ladder.PictureVerdict) -> Remaining:
    """The strongest structure, in the points first, then in brightness."""
    geometric_left = _points_left(geometric)
    if geometric_left.significant or photometric.observations is None:
        return geometric_left
    light_left = _light_left(photometric)
    return light_left if light_left.significant else geometric_left


def _points_left(geometric: GeometricVerdict) -> Remaining:
    fitted, table = geometric.fit, geometric.table
    profile, lens = fitted.profile, fitted.profile.intrinsics
    assert lens is not None
    noise = geometric.noise_px
    from_centre = table.second_px - np.array([lens.cx_px, lens.cy_px])
    radius = np.linalg.norm(from_centre, axis=-1)
    outwards = from_centre / np.maximum(radius, 1.0)[:, None]
    radial = (fitted.difference_px * outwards).sum(axis=-1)
    difference = np.concatenate([fitted.difference_px, radial[:, None]], axis=-1)
    second_s = seen_s(profile, table.second_px, table.second_stamp_s, table.second_exposure_s)
    covariates = {
        "row": profile.shutter.readout_fraction(table.second_px, profile.width, profile.height),
        "radius": radius,
        "x": table.second_px[:, 0],
        "y": table.second_px[:, 1],
        "rate": np.linalg.norm(fitted.ground.trajectory.rate_rad_s(second_s), axis=-1),
    }
    found = structures(difference, fitted.weight, covariates, table.pair, TRACKING_BIAS_PX)
    found.append(_along_time(fitted.difference_px, fitted.weight, table.pair))
    strongest = max(found, key=lambda s: s.size)
    stray = max(float(np.mean(fitted.distance > STRAY_DISTANCE * max(fitted.scale, 1.0))), geometric.astray)
    limit = max(STRUCTURE_PX, STRUCTURE_NOISES * noise)
    excess = geometric.final_rms_px / max(noise, 1e-9)
    log.debug("left: %s, limit %.3f, excess %.3f, stray %.3f", found, limit, excess, stray)
    structured = strongest.size > limit and strongest.p_value < STRUCTURE_P
    significant = structured or excess > SCALE_EXCESS or stray > STRAY_PART
    along = strongest.along
    size = strongest.size
    if not structured and excess > SCALE_EXCESS:
        size = float(np.sqrt(max(geometric.final_rms_px**2 - noise**2, 0.0)))
    if not structured and stray > STRAY_PART:
        along = "place"
    p_value = strongest.p_value
    if not structured and significant:
        p_value = min(s.p_value for s in found)
        p_value = min(p_value, *_more_than_noise(fitted.distance, table.pair, noise / geometric.step_noise_px))
    sentence = f"{size:.3f} px remain, strongest along {along}" if significant else ""
    return Remaining(p_value, along, size, GEOMETRY, significant, sentence)


def _more_than_noise(distance: Array, pair: NDArray[np.intp], noise: float) -> tuple[float, float]:
    """Probabilities that pairs' whitened distances are noise alone, and that so many points stray by chance.

    One-sided t tests over the pairs: of their capped mean squares against 2 noise² (SCALE_EXCESS allowed for), and of
    their parts of strays against STRAY_PART.
    """
    count = np.maximum(np.bincount(pair), 1)
    used = np.bincount(pair) > LEAST_IN_PAIR
    square = np.bincount(pair, np.minimum(distance, STRAY_DISTANCE) ** 2) / count
    stray = np.bincount(pair, distance > STRAY_DISTANCE) / count
    tests = ((square, 2 * (SCALE_EXCESS * noise) ** 2), (stray, STRAY_PART))
    first, second = (float(stats.ttest_1samp(v[used], mean, alternative="greater").pvalue) for v, mean in tests)
    return first, second


def _along_time(difference: Array, weight: Array, pair: NDArray[np.intp]) -> Structure:
    """Between the pairs: how much more their mean differences scatter than their points do."""
    total = np.maximum(np.bincount(pair, weight), 1e-9)
    excess, chi2, freedom = 0.0, 0.0, 0
    for column in difference.T:
        mean = np.bincount(pair, weight * column) / total
        variance = np.bincount(pair, (weight * (column - mean[pair])) ** 2) / total**2
        used = np.bincount(pair) > LEAST_IN_PAIR
        spread = 2 * variance[used] + TRACKING_BIAS_PX**2
        excess += float(np.mean(np.maximum(mean[used] ** 2 - spread, 0.0)))
        chi2 += float(np.sum(mean[used] ** 2 / spread))
        freedom += int(used.sum())
    return Structure("time", float(np.sqrt(excess / 2)), float(stats.chi2.sf(chi2, max(freedom, 1))))


def _light_left(photometric: picture_ladder.PictureVerdict) -> Remaining:
    observations = photometric.observations
    assert observations is not None
    left = picture_ladder.residual_levels(observations, photometric.profile)
    covariates = {
        name: values
        for name, values in observations.covariates(photometric.profile).items()
        if name in ("row", "radius", "brightness", "row_fraction", "x_px", "y_px")
    }
    weight = 1.0 / (1.0 + (left / (CALM * max(float(np.median(np.abs(left))) / 0.6745, 1.0))) ** 2)
    found = structures(left[:, None], weight, covariates, observations.frame.astype(np.intp), 0.5)
    strongest = max(found, key=lambda s: s.size)
    log.debug("light left: %s", found)
    significant = strongest.size > PHOTOMETRIC_STRUCTURE and strongest.p_value < STRUCTURE_P
    sentence = f"{strongest.size:.1f} grey levels remain, strongest along {strongest.along}" if significant else ""
    return Remaining(strongest.p_value, strongest.along, strongest.size, PHOTOMETRY, significant, sentence)
