"""`virest diagnose`: what the model gets wrong on a capture, the causes, and each cause's gain on held-out data.

Geometry comes first, because brightness and blur are comparable only once points are where the model puts them; then
brightness, then blur.  The remaining residuals are tested for structure.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace

import numpy as np

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.capture.records import NO_STAMP, Capture, Frame
from virest.diagnosis.ambiguities import (
    as_exposure,
    exposure_hypothesis,
    merged,
    offset_as_timestamp,
    offset_beside_averaging,
)
from virest.diagnosis.edge_overshoot import judge_sharpening
from virest.diagnosis.field.bridging import LEAST_PAIRS_LEFT, doubtful_pairs
from virest.diagnosis.field.brightness import (
    instead_of_flicker,
    instead_of_gain,
    light_field,
    with_light_field,
    without_flicker,
    without_gain,
)
from virest.diagnosis.field.contradicted import known_stretches
from virest.diagnosis.field.focus import blur_fields
from virest.diagnosis.field.records import Distrusted
from virest.diagnosis.field.words import finding_of
from virest.diagnosis.findings import (
    CONSISTENT,
    EXPLAINED,
    UNEXPLAINED,
    Diagnosis,
    FieldFinding,
    Finding,
    Nominal,
    Rival,
)
from virest.diagnosis.followed_log import with_followed_log
from virest.diagnosis.geometric_findings import findings_of, with_depth_of, with_unknowns_of
from virest.diagnosis.geometric_ladder import MAX_RUNGS
from virest.diagnosis.geometric_verdict import GeometricVerdict
from virest.diagnosis.own_exposures import (
    delay_of_frames,
    exposures_of_blur,
    exposures_of_points,
    measured_log_light,
    rows_late,
    with_late_exposures,
    with_own_exposures_told,
)
from virest.diagnosis.photometry_fit import fit_photometry
from virest.diagnosis.picture_ladder import PictureVerdict, Reader, climb_blur, climb_light, judge_curve, light_varies
from virest.diagnosis.refit_photometry import settle_light
from virest.diagnosis.residual_tests import points_left, remaining_structure, residuals
from virest.diagnosis.selection import BLUR_LEVELS
from virest.diagnosis.tracking_stage import (
    MIN_PAIRS,
    TrackedPoints,
    at_model_times,
    at_rest,
    frames_to_follow,
    lighting_changes,
    with_flicker_of,
    with_null_values,
    without_lighting_changes,
)
from virest.errors import CaptureError
from virest.image_formation.point_model import predict
from virest.inference.frame_exposures import OwnExposures
from virest.inference.guide_choice import find_guide, track_guided
from virest.inference.observed_tracks import ObservedTracks, observe_tracks
from virest.inference.parallel import Background, ParallelMap, begun, one_by_one
from virest.inference.recorder_lag import lag_schedules
from virest.inference.synchronisation import other_reading
from virest.inference.tracking import track_pairs
from virest.motion.integration import integrate_gyro
from virest.motion.scene_motion import InertialMotion
from virest.restoration.capture import at_true_times

Progress = Callable[[str, float], None]
MOST_TRAVEL_PX = 0.35
"""Maximum path length from camera translation: a tenth of the shortest blur that the curve is estimated from, so that
translation rotates a blur path by at most 0.1 rad."""


def diagnose_capture(
    capture: Capture,
    profile: CameraProfile,
    pictures: Reader,
    gray: Reader,
    progress: Progress | None = None,
    each: ParallelMap = one_by_one,
    kept_back: Collection[int] = (),
) -> Diagnosis:
    """Climb the ladder on one capture; pictures yields (index, RGB), gray (index, luma) of the requested frames.

    kept_back: movie indices of frames excluded from all fits of points, blur and curve.  each: runs calls in parallel;
    gray is then sent to other processes.  Raises CaptureError if too few pairs of frames have trackable points.
    """
    report = progress or (lambda _text, _part: None)
    session = _climbed(capture, profile, pictures, gray, report, each, frozenset(kept_back))
    found = session.conclude()
    own = session.own_exposures(found)
    if own is None and delay_of_frames(found):
        own = exposures_of_blur(capture, profile, gray)
    if own is None:
        return found

    def again(text: str, part: float) -> None:
        report(f"{text}, with the frames' own exposures", part)

    corrected = _climbed(capture, own.on(profile), pictures, gray, again, each, frozenset(kept_back)).conclude()
    return with_own_exposures_told(found, corrected, own)


def _climbed(
    capture: Capture,
    profile: CameraProfile,
    pictures: Reader,
    gray: Reader,
    report: Progress,
    each: ParallelMap,
    kept_back: frozenset[int],
) -> DiagnosisSession:
    """The session after all stages; frames whose exposure was logged in no row are kept back as well."""
    report("tracking", 0.02)
    kept_back |= _without_own_exposure(len(capture.frames), profile.extensions.exposures_late_frames)
    capture = replace(capture, frames=at_true_times(capture.frames, profile, capture.repeats))
    points, notes = _tracked(capture, profile, gray, each, kept_back)
    report("points", 0.15)
    first = points.climbed(lambda part: report("points", 0.15 + 0.35 * part))
    session = DiagnosisSession(
        capture, points, first, first, PictureVerdict(first.model.profile), notes=notes, each=each
    )
    session.kept_back = kept_back
    session.start_field_search()
    report("brightness", 0.5)
    session.judge_light(pictures, gray, profile, lambda part: report("points again", 0.65 + 0.1 * part))
    report("blur", 0.75)
    session.judge_blur(gray, lambda _part: report("points again", 0.85))
    report("curve", 0.92)
    session.judge_curve(pictures)
    session.settle_light()
    report("edges", 0.95)
    session.judge_edges(gray)
    report("what is left", 0.97)
    return session


def _without_own_exposure(frames: int, rows_late: int) -> frozenset[int]:
    """Movie indices of the frames before the first row or after the last one of a table that is some rows off."""
    return frozenset(range(min(-rows_late, frames)) if rows_late < 0 else range(max(frames - rows_late, 0), frames))


def _tracked(
    capture: Capture, profile: CameraProfile, gray: Reader, each: ParallelMap, kept_back: frozenset[int]
) -> tuple[TrackedPoints, list[str]]:
    """(points tracked in the frames to follow, including the start-up, without held-back frames; notes)."""
    indices = frames_to_follow(capture, profile)
    observed = observe_tracks(capture, track_guided(capture, profile, gray, indices, each), profile)
    observed = _without_held_back(observed, capture, profile, kept_back)
    start, null_terms, notes, far, follows = with_null_values(observed, capture, profile)
    observed = observed.covered(capture.imu, start)
    if len(observed.pairs) < MIN_PAIRS:
        raise CaptureError(
            f"{len(observed.pairs)} pairs of frames have trackable points, {MIN_PAIRS} are needed",
            hint="a longer capture, or one with more texture",
        )
    schedules = lag_schedules(capture, capture.repeats) if not profile.extensions.frame_lag_frames else []
    still = at_rest(observed, start)
    rungs_allowed = MAX_RUNGS if (follows or schedules) and not still else 0
    stamped_frames = sum(NO_STAMP not in frame.skip_codes for frame in capture.frames)
    if len(indices) < stamped_frames:
        notes.append(
            f"points were tracked in {len(indices)} of {stamped_frames} frames, in runs spread over the capture"
        )
    if still:
        notes.append("the camera is at rest: clocks, readout and lens cannot be estimated from the points")
    elif not rungs_allowed:
        notes.append("the frames do not follow the gyroscope at any offset: no cause was fitted to the points")
    if (not follows or far.axes) and (reading := other_reading(observed, capture.imu, start)):
        notes.append(f"the gyroscope may be logged in another unit or sign: {reading}")
    return TrackedPoints(capture, observed, start, tuple(null_terms), schedules, far, rungs_allowed, each), notes


def _without_held_back(
    observed: ObservedTracks, capture: Capture, profile: CameraProfile, kept_back: frozenset[int]
) -> ObservedTracks:
    """The pairs without held-back frames, except those in doubtful log intervals, if enough pairs lie outside these.

    The excepted pairs take no part in the ladder, and only their own points can bridge the interval.
    """
    seen = np.array([not kept_back & {pair.first, pair.second} for pair in observed.pairs], bool)
    hit = doubtful_pairs(observed, capture, profile).hit
    return observed.chosen(seen | hit if (seen & ~hit).sum() >= LEAST_PAIRS_LEFT else seen)


@dataclass(slots=True)
class DiagnosisSession:
    """State of one diagnosis, advanced stage by stage."""

    capture: Capture
    points: TrackedPoints
    first: GeometricVerdict
    """Verdict before the photometric stage."""
    geometric: GeometricVerdict
    light: PictureVerdict
    light_of_patches: PictureVerdict | None = None
    """Verdict on brightness before the curve that blur shows."""
    blur: PictureVerdict | None = None
    curve: PictureVerdict | None = None
    edges: PictureVerdict | None = None
    findings: list[Finding] = field(default_factory=list)
    """Causes found in the points, as revised by the blur stage."""
    notes: list[str] = field(default_factory=list)
    each: ParallelMap = one_by_one
    kept_back: frozenset[int] = frozenset()
    """Movie indices of frames that only the photometric stage may use."""
    instead_of: tuple[str, ...] = ()
    """Causes that a map of the light replaces."""
    exposures_late_frames: int = 0
    """Rows by which the exposure table is off if that explains a delay of frames; known at the end."""
    _needs_fields_unlit: Callable[[], bool] | None = None
    """Returns whether the points of the first verdict require fields without flicker; None: not started."""

    @property
    def frames(self) -> list[Frame]:
        """Usable frames, with the timestamps of the first model."""
        return at_model_times(self.capture, self.first)

    @property
    def frames_to_fit(self) -> list[Frame]:
        """Frames that blur and curve are fitted to."""
        return [frame for frame in self.frames if frame.index not in self.kept_back]

    def _all_frames(self) -> tuple[Frame, ...]:
        """Every frame, by movie index; unusable and held-back frames have no exposure."""
        usable = {frame.index: frame for frame in self.frames_to_fit}
        return tuple(usable.get(frame.index, replace(frame, exposure_s=None)) for frame in self.capture.frames)

    def start_field_search(self) -> None:
        """Start a search for fields in the background, without flicker: no other light changes its result."""
        if isinstance(self.each, Background) and not self.first.fields:
            points = replace(self.points, each=one_by_one)
            self._needs_fields_unlit = begun(self.each, _needs_fields, points, self.first)

    def _with_fields(self, lit: CameraProfile) -> GeometricVerdict:
        """The geometric verdict with the fields that its residuals require under this lighting."""
        own = self.geometric.model.profile
        same = self.geometric is self.first and with_flicker_of(own, lit) == own
        searched = self._needs_fields_unlit if self.geometric.undoubted is None else None
        if same and searched is not None and not searched():
            return self.geometric
        return self.points.described(self.geometric, lit)

    def judge_light(
        self, pictures: Reader, gray: Reader, given: CameraProfile, progress: Callable[[float], None]
    ) -> None:
        """Judge brightness; if the lighting changes and point residuals are significant, track again without it."""
        frames, moved = self.frames, self.geometric.model.profile
        trajectory = integrate_gyro(self.capture.imu, moved)
        self.light = climb_light(self.capture, frames, moved, trajectory, pictures, self.each)
        if points_left(self.geometric).significant and lighting_changes(self.light.profile):
            corrected = without_lighting_changes(gray, frames, self.light.profile)
            followed = set(frames_to_follow(self.capture, given)) & {frame.index for frame in frames}
            guide = find_guide(self.capture, given, gray, sorted(followed))
            retracked = observe_tracks(self.capture, track_pairs(corrected(sorted(followed)), guide=guide), given)
            retracked = _without_held_back(retracked, self.capture, given, self.kept_back)
            start = self.points.start
            self.points = replace(
                self.points,
                observed=retracked.covered(self.capture.imu, start),
                start=with_flicker_of(start, self.light.profile),
            )
            self.geometric = self.points.climbed(progress)
        self.geometric = self._with_flicker_or_bands(progress)
        self.light = self.light_of_patches = with_exposure_of(self.light, self.geometric.model.profile)
        self.findings = self._of_points(self.points.observed.exposure_s)

    def _with_flicker_or_bands(self, progress: Callable[[float], None]) -> GeometricVerdict:
        """The geometric verdict under this lighting; without a flicker that is none.

        A map of the light that explains the patches as well replaces a phase-locked flicker.  Bands do so only if the
        points contradict the flicker, which moves the mean time of each row's light: if they need fields with it, and
        none or fewer without.  Otherwise they are a rival.
        """
        patches, lit = self.light.observations, self.light.profile
        flicker = next((cause for cause in self.light.findings if cause.name == "flicker"), None)
        found = None if flicker is None or patches is None else instead_of_flicker(patches, lit)
        if flicker is None or patches is None or found is None:
            return self._with_fields(lit)
        own, unlit = self.points.start, without_flicker(lit)
        if own.extensions.flicker_amplitude != unlit.extensions.flicker_amplitude:  # the points were climbed with it
            points = replace(self.points, start=with_flicker_of(own, unlit))
            plain = points.described(points.climbed(progress), unlit)
        else:
            points, plain = self.points, self._with_fields(unlit)
        others = [cause for cause in self.light.findings if cause is not flicker]
        if found.is_bands and len((under := self._with_fields(lit)).fields) <= len(plain.fields):
            told = replace(flicker, rivals=(*flicker.rivals, Rival("gain over row", found.held_out.after)))
            self.light = replace(self.light, findings=[*others, told])
            return under
        self.points, fitted = points, self.light.fitted
        if fitted is not None:
            effects = [effect for effect in fitted.effects if effect.name != "flicker"]
            fitted = fit_photometry(patches, unlit, effects) if effects else None
        self.light = replace(
            self.light, profile=unlit if fitted is None else fitted.profile, findings=others, fitted=fitted
        )
        self.instead_of = found.rivals
        return plain

    def _of_points(self, exposure_s: Array) -> list[Finding]:
        found = offset_as_timestamp(self.geometric, findings_of(self.geometric), exposure_s)
        return offset_beside_averaging(found)

    def judge_blur(self, gray: Reader, progress: Callable[[float], None]) -> None:
        """Judge blur unless the scene's points disagree; blur distinguishes a wrong exposure from a time offset."""
        self.blur = PictureVerdict(self.light.profile)
        exposure_s = self.points.observed.exposure_s
        change = exposure_hypothesis(self.findings, exposure_s, self.geometric.nominal.profile)
        hypothesis, is_exposure = None if change is None else float(change.estimate), False
        if _disagree(self.geometric):
            self.notes.append("tracked points disagree with the model: blur and the exposure curve were not tested")
        else:
            lit = merged(self.geometric.model.profile, self.light.profile, self.light.profile, False)
            shown = replace(self.capture, frames=self._all_frames())
            self.blur, is_exposure = climb_blur(
                shown, lit, integrate_gyro(self.capture.imu, lit), gray, hypothesis, self.each
            )
        if is_exposure and change is not None:
            exposure = as_exposure(self.findings, change)
            start = self.points.start.with_shutter(exposure_scale=change.estimate)
            points = replace(self.points, start=start, contradicted=known_stretches(self.geometric))
            self.geometric = points.described(points.climbed(progress), self.light.profile)
            self.findings = [exposure, *self._of_points(exposure_s)]
        if any(finding.name == "exposure_time" for finding in self.findings):  # the points determined it better
            self.blur.findings = [finding for finding in self.blur.findings if finding.name != "exposure_time"]
            is_exposure = True
        moved = with_depth_of(self.findings, self.geometric.model.profile)
        extended = merged(moved, self.light.profile, self.blur.profile, is_exposure)
        self.curve = PictureVerdict(extended)

    def judge_curve(self, pictures: Reader) -> None:
        """Estimate the curve from how blur mixes light, where the blur paths are accurate."""
        assert self.curve is not None
        extended = self.curve.profile
        if _disagree(self.geometric):
            return
        if _paths_uncertain(extended, self.geometric):
            if self.light.observations is None or not light_varies(self.light.observations):
                self.curve.notes.append(
                    "blur depends on more than rotation: the exposure curve could not be tested at constant exposure"
                )
            return
        trajectory = integrate_gyro(self.capture.imu, extended)
        frames = self.frames_to_fit
        self.curve = judge_curve(extended, self.light.observations, frames, trajectory, pictures, self.each)

    def settle_light(self) -> None:
        """Refit the photometric values under the final curve and exposure."""
        assert self.blur is not None
        assert self.curve is not None
        causes = [*self.findings, *self.blur.findings]
        light, profile = settle_light(self.light, self.curve, self.points.start, causes)
        self.light = with_followed_log(light, self.capture.frames, self.each)
        self.curve = replace(self.curve, profile=profile)

    def judge_edges(self, gray: Reader) -> None:
        """Detect sharpening by the phone; no blur overshoots, so the blur paths need not be accurate."""
        assert self.blur is not None
        assert self.curve is not None
        shown, extended = replace(self.capture, frames=self._all_frames()), self.curve.profile
        trajectory = integrate_gyro(self.capture.imu, extended)
        self.edges = judge_sharpening(shown, extended, trajectory, gray, self.each, self.blur.steps)

    def _with_late_exposures(self, told: FieldFinding) -> FieldFinding:
        """A delay of frames with the exposure table as rival, whose rows are then tried."""
        rows = rows_late(told, self.capture.frames, self.geometric.model.profile)
        self.exposures_late_frames = self.exposures_late_frames or rows
        return with_late_exposures(told, rows)

    def own_exposures(self, found: Diagnosis) -> OwnExposures | None:
        """Exposures that explain delays or gains of frames which a diagnosis found; None: those logged."""
        if self.exposures_late_frames:
            return OwnExposures(self.exposures_late_frames)
        drift = any(cause.name == "gain_drift" for cause in found.causes)
        late = delay_of_frames(found) is not None
        if not late and not drift:
            return None
        measured = measured_log_light(self.light_of_patches or self.light, len(self.capture.frames))
        return exposures_of_points(self.geometric, self.capture.frames, measured, late)

    def conclude(self) -> Diagnosis:
        """The diagnosis, assembled from all stages."""
        assert self.blur is not None
        assert self.curve is not None
        assert self.edges is not None
        stages = (self.light, self.blur, self.curve, self.edges)
        findings = [*self.findings, *(finding for stage in stages for finding in stage.findings)]
        findings.sort(key=lambda f: -f.held_out.before / max(f.held_out.after, 1e-9))
        told = [finding_of(entry, self.geometric.noise_px) for entry in self.geometric.fields]
        fields = [self._with_late_exposures(field) for field in told]
        extended, light = self.curve.profile, self.light
        if (patches := light.observations) is not None:
            drifts = any(finding.name == "gain_drift" for finding in findings)
            instead = instead_of_gain(patches, extended) if drifts else None
            if instead is not None:
                extended, light = without_gain(extended), replace(light, profile=without_gain(light.profile))
                findings = [finding for finding in findings if finding.name != "gain_drift"]
            if (found := instead or light_field(patches, extended)) is not None:
                found = replace(found, rivals=(*found.rivals, *self.instead_of))
                extended, fields = with_light_field(extended, found), [*fields, found.finding]
                light = replace(light, profile=with_light_field(light.profile, found))
        if self.blur.edges is not None:
            trajectory = integrate_gyro(self.capture.imu, extended)
            soft, extended = blur_fields(self.blur.edges, extended, trajectory, self.capture, self.blur.focus)
            fields = [*fields, *soft]
            if soft:
                uniform_px = (
                    extended.extensions.defocus_sigma_px - self.first.nominal.profile.extensions.defocus_sigma_px
                )
                if not BLUR_LEVELS.matters("defocus", abs(uniform_px)):  # the field explains the blur
                    findings = [finding for finding in findings if finding.name != "defocus"]
        left = remaining_structure(self.geometric, light)
        first, observed = self.first, self.points.observed
        stated = [entry for field in fields for entry in field.fields]
        distrusted = [entry for entry in self.geometric.fields if isinstance(entry, Distrusted)]
        withheld = [field for entry in distrusted for field in entry.withheld]
        trusted = {interval for entry in distrusted for interval in entry.better_than_none}
        kept = [held for held in extended.fields if not any(map(held.is_in_place_of, withheld))]
        with_std = [next((s for s in stated if s.is_in_place_of(held)), held) for held in kept]
        untrusted = tuple(interval for interval in extended.imu_untrusted_s if interval not in trusted)
        extended = replace(extended.with_fields([held.rounded() for held in with_std]), imu_untrusted_s=untrusted)
        extended = with_unknowns_of(self.geometric, extended)
        # the stabiliser's lean belongs to the start of this log: a restoration that begins later must not use it
        without_lean = extended.with_extensions(stabilisation_lean_rad=(0.0, 0.0))
        stamps = sum(NO_STAMP not in frame.skip_codes for frame in self.capture.frames)
        nominal = Nominal(
            first.nominal_rms_px, first.noise_px, self.light.photometric_rms, self.blur.blur_rms_px,
            observed.tracks, stamps,
        )  # fmt: skip
        return Diagnosis(
            UNEXPLAINED if left.significant else EXPLAINED if findings or fields else CONSISTENT,
            nominal,
            tuple(findings),
            left,
            first.nominal.profile,
            without_lean,
            (*self.geometric.rungs, *(rung for stage in stages for rung in stage.rungs)),
            {"before": residuals(first, True), "after": residuals(self.geometric, False)},
            (*self.notes, *self.geometric.notes, *(note for stage in stages for note in stage.notes)),
            tuple(fields),
        )


def with_exposure_of(light: PictureVerdict, moved: CameraProfile) -> PictureVerdict:
    """A verdict on brightness with another profile's exposure scale, whose cause a field may have replaced since."""
    return replace(light, profile=light.profile.with_shutter(exposure_scale=moved.shutter.exposure_scale))


def _disagree(found: GeometricVerdict) -> bool:
    """Whether the points contradict the model, beyond those that move on their own."""
    left = points_left(found)
    return left.significant and not left.only_strays


def _needs_fields(points: TrackedPoints, found: GeometricVerdict) -> bool:
    return bool(points.described(found, found.model.profile).fields)


def _paths_uncertain(profile: CameraProfile, geometric: GeometricVerdict) -> bool:
    """Whether blur depends on more than rotation; light mixing then says little about the curve."""
    extensions = profile.extensions
    moved = bool(extensions.stabilisation_fraction or extensions.defocus_sigma_px)
    return moved or travel_blur_px(geometric) > MOST_TRAVEL_PX


def travel_blur_px(geometric: GeometricVerdict) -> float:
    """90th percentile over the points of the path that camera translation adds within an exposure, px.

    0 without translation in the model; infinite if the translation is not inertial.
    """
    fitted, table = geometric.fit, geometric.table
    if geometric.model.scene is None:
        return 0.0
    if not isinstance(fitted.scene, InertialMotion):
        return float("inf")
    seen = (predict(fitted.integrated, table, scene).second_px for scene in (fitted.scene, None))
    apart_s = np.maximum(table.second_stamp_s - table.first_stamp_s, 1e-6)
    exposure_s = np.asarray(fitted.profile.shutter.true_exposure_s(table.second_exposure_s))
    travelled_px = np.linalg.norm(np.subtract(*seen), axis=-1) * exposure_s / apart_s
    return float(np.quantile(travelled_px, 0.9))
