"""Tracked points of a capture and the terms that its profile leaves open: the start of the geometric ladder."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Index, Mask
from virest.camera.profile import CameraProfile
from virest.capture.records import NO_STAMP, Capture, Frame
from virest.diagnosis.candidates import FarStart
from virest.diagnosis.field.bridging import doubtful_pairs
from virest.diagnosis.field.contradicted import climb_with_bridges, with_fields_or_bridges
from virest.diagnosis.geometric_effects import PLAIN_READOUT
from virest.diagnosis.geometric_evidence import Evidence, Model, make_evidence
from virest.diagnosis.geometric_ladder import climb
from virest.diagnosis.geometric_verdict import GeometricVerdict
from virest.diagnosis.picture_ladder import Reader
from virest.effects.records import Effect
from virest.effects.table import EFFECTS
from virest.image_formation.light import flicker
from virest.image_formation.row_clock import RowClock
from virest.inference import profile_terms as terms_of
from virest.inference.coarse_alignment import MIN_MOTION_PX, align_coarsely, align_with_skew
from virest.inference.doubtful_log import Stretch
from virest.inference.frame_rotations import gyro_turns
from virest.inference.frame_selection import high_motion_frames
from virest.inference.observed_tracks import ASTRAY, CELLS, ObservedTracks
from virest.inference.parallel import ParallelMap, one_by_one
from virest.inference.recorder_lag import Schedule
from virest.inference.track_evidence import lengths_and_ways
from virest.inference.track_fit import Term, TrackFit
from virest.inference.track_noise import step_noise_px
from virest.motion.integration import integrate_gyro

WHOLE_FRAMES, FRAMES_IN_RUNS = 450, 240
"""Captures of up to the first number of frames (15 s at 30 frames per second) are tracked in every frame; longer ones
in runs of frames whose total length is the second number."""
MIN_PAIRS = 6
"""Fewest pairs of frames; each is then a time block of its own: three to fit and three to judge."""
MIN_EXPLAINED = 0.3
"""Least part of the frames' rotation that the gyroscope must explain for a fit to start; below what `calibrate` needs
(coarse_alignment.MIN_EXPLAINED), because the profile may be wrong."""
AXIS_EXPLAINED = 0.6
"""Minimum squared correlation between the rotations of frames and gyroscope about one axis."""
WELL_EXPLAINED = 0.98
"""If the rotations agree better than this, no distant clock rate is searched for."""
STRAY_PART = 0.1
"""A larger fraction of independently moving points is not chance."""
MIN_COMMON_MOTION = 0.3
"""Minimum intraclass correlation of points that move together."""
NEIGHBOURHOOD = np.add.outer(np.arange(CELLS) // 2 * CELLS, np.arange(CELLS) // 2).ravel()
"""Index of the block of two by two cells that each cell belongs to."""


def frames_to_follow(capture: Capture, profile: CameraProfile) -> list[int]:
    """Movie indices, ascending: every stamped frame; of a long capture the start-up and the runs with most motion."""
    stamped = [frame.index for frame in capture.frames if NO_STAMP not in frame.skip_codes]
    if len(stamped) <= WHOLE_FRAMES:
        return stamped
    chosen = high_motion_frames(capture.frames, capture.imu, FRAMES_IN_RUNS, profile.time_offset_s or 0.0)
    startup = [frame.index for frame in capture.frames if frame.only_startup][:FRAMES_IN_RUNS]
    return sorted({*chosen, *startup})


@dataclass(frozen=True, slots=True)
class TrackedPoints:
    """Tracked points and the profile from which their ladder begins."""

    capture: Capture
    observed: ObservedTracks
    start: CameraProfile
    null_terms: tuple[Term, ...]
    schedules: Sequence[Schedule]
    far: FarStart
    rungs_allowed: int
    each: ParallelMap = one_by_one
    contradicted: tuple[Stretch, ...] = ()
    """Intervals of the log of which an earlier climb found that the points contradict them."""

    def climbed(self, progress: Callable[[float], None]) -> GeometricVerdict:
        """Climb the ladder, and climb it again without image regions that move otherwise, if there are any.

        Regions whose residuals stand out along the parallax alone are nearer or further than the rest of the scene,
        and do not move independently.
        """
        found = self._climbed(self.observed, progress)
        if not self.rungs_allowed:
            return found
        cells = self.observed.astray_cells(found.table.first_px, found.fit.distance)
        cell = self.observed.cells(found.table.first_px)
        independent, share = cells[cell], float(cells[cell].mean())
        neighbourhood = len(cells) * found.table.pair + NEIGHBOURHOOD[cell]
        weighted_px = found.fit.difference_px * found.fit.weight[:, None]
        if (
            share < STRAY_PART
            or _common_motion(weighted_px[independent], neighbourhood[independent]) < MIN_COMMON_MOTION
        ):
            return found
        rest = self.observed.without_cells(cells)
        again = self._climbed(replace(rest, noise_px=step_noise_px(rest.pairs)), progress)
        if stands_out_across(found.fit, independent):
            again.independent_share = share
        how = "move independently" if again.independent_share else "are nearer or further than the others"
        again.notes.append(f"{share:.0%} of the points lie in image regions that {how} and were excluded")
        return again

    def described(self, found: GeometricVerdict, lit: CameraProfile) -> GeometricVerdict:
        """Add the fields that a verdict's residuals require under the lighting found by the photometric stage.

        Flicker shifts the mean time of each row's light, which looks like an uneven readout.
        """
        if not self.rungs_allowed or found.evidence is None:
            return found
        undoubted = None if found.undoubted is None else _under(found.undoubted, lit)
        return with_fields_or_bridges(replace(_under(found, lit), undoubted=undoubted), self.capture, self.start)

    def _climbed(self, observed: ObservedTracks, progress: Callable[[float], None]) -> GeometricVerdict:
        def climbing(evidence: Evidence, bridged: Callable[[Model], Model] | None) -> GeometricVerdict:
            return climb(
                evidence, self.start, self.null_terms, self.schedules, self.far, progress, self.rungs_allowed,
                self.each, bridged,
            )  # fmt: skip

        if self.rungs_allowed:
            return climb_with_bridges(observed, self.capture, self.start, climbing, self.contradicted)
        evidence = make_evidence(
            self.capture.imu, doubtful_pairs(observed, self.capture, self.start).for_ladder(observed), self.start
        )
        found = climbing(evidence, None)
        found.evidence = evidence
        return found


def stands_out_across(fitted: TrackFit, part: Mask) -> bool:
    """Whether some points' residuals exceed the others' across the parallax too; True without parallax."""
    if fitted.along_px is None:
        return True
    way = lengths_and_ways(fitted.along_px)[1]
    left = fitted.difference_px / fitted.noise_px[:, None]
    across = np.abs(left[:, 1] * way[:, 0] - left[:, 0] * way[:, 1])
    return float(np.median(across[part])) > ASTRAY * float(np.median(across[~part]))


def _common_motion(difference_px: Array, group: Index) -> float:
    """Intraclass correlation of residuals (n, 2) within groups, here neighbours in one pair of frames.

    Badly tracked neighbours share nothing; points on one moving object share its motion.
    """
    count = np.bincount(group)
    ordered = float((count * (count - 1)).sum())
    squared = float((difference_px**2).sum())
    common = sum(float((np.bincount(group, column) ** 2).sum()) for column in difference_px.T) - squared
    return common / max(ordered, 1.0) / max(squared / max(len(group), 1), 1e-12)


def at_model_times(capture: Capture, geometric: GeometricVerdict) -> list[Frame]:
    """Usable frames, with the timestamps that the model gives them."""
    lag = geometric.model.lag
    frames = []
    for frame in capture.frames:
        if frame.skip_reason is None or (frame.only_startup and lag):
            shift = lag[frame.index] if lag else 0.0
            frames.append(replace(frame, time_s=frame.time_s + shift, skip_reason=None, skip_codes=()))
    return frames


# ── lighting that disturbs tracking ──────────────────────────────────────────────────────────────────────────────


def lighting_changes(profile: CameraProfile) -> bool:
    """Whether light changes within frames, which biases tracked points; the tracker evens changes of whole frames."""
    return bool(profile.extensions.flicker_amplitude)


def _under(found: GeometricVerdict, lit: CameraProfile) -> GeometricVerdict:
    return replace(found, model=replace(found.model, profile=with_flicker_of(found.model.profile, lit)))


def with_flicker_of(profile: CameraProfile, lit: CameraProfile) -> CameraProfile:
    """The profile with the flicker of another: flicker shifts the mean time of each row's light."""
    light = lit.extensions
    return profile.with_extensions(
        flicker_amplitude=light.flicker_amplitude,
        flicker_frequency_hz=light.flicker_frequency_hz,
        flicker_phase_rad=light.flicker_phase_rad,
    )


def without_lighting_changes(gray: Reader, frames: Sequence[Frame], profile: CameraProfile) -> Reader:
    """The same pictures without flicker, for tracking."""
    by_index = {frame.index: frame for frame in frames}
    curve = profile.curve
    height, width, shutter, clock = profile.height, profile.width, profile.shutter, RowClock(profile)
    along = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    rows_px = along[:1] if shutter.reads_columns else along[:, :1]

    def corrected(wanted: Sequence[int]) -> Iterator[tuple[int, NDArray[np.uint8] | None]]:
        for index, picture in gray(wanted):
            frame = by_index.get(index)
            if picture is None or frame is None:
                yield index, picture
                continue
            logged_s = frame.exposure_s or 0.0
            middle_s = clock.seen_s(rows_px, frame.time_s, logged_s)
            light = flicker(profile, middle_s, shutter.true_exposure_s(logged_s))
            linear = curve.linear_table()[picture] / light
            yield index, np.clip(np.rint(255 * curve.encode(linear)), 0, 255).astype(np.uint8)

    return corrected


# ── values that the profile leaves open ──────────────────────────────────────────────────────────────────────────


def with_null_values(
    observed: ObservedTracks, capture: Capture, profile: CameraProfile
) -> tuple[CameraProfile, list[Term], list[str], FarStart, bool]:
    """(profile with initial guesses, terms to fit on every rung, notes, far starts of clocks and axes, agreement).

    Agreement: whether the rotations of frames and gyroscope agree at some offset or about some axis, or are too small
    to be compared.
    """
    terms: list[Term] = []
    notes: list[str] = []
    unknown_lens = profile.intrinsics is None
    profile = replace(profile, intrinsics=observed.lens)
    far = _agree_at(observed, capture, profile)
    agree = far is not None or _hardly_turns(observed, profile) or _one_axis_agrees(observed, capture, profile)
    informative = (agree or bool(capture.repeats)) and not at_rest(observed, profile)
    if unknown_lens:
        terms += [terms_of.FOCAL] if informative else []
        notes.append(
            "focal length unknown: "
            f"{'fitted at every step from an initial guess' if informative else 'an initial guess is used'}"
        )
    if not profile.readout_known and informative:
        terms.append(terms_of.READOUT if profile.time_offset_s is None else PLAIN_READOUT)
    if informative:
        terms += [terms_of.TERMS[name] for name, effect in EFFECTS.items() if _is_open(effect, profile)]
    if profile.time_offset_s is not None:
        return profile, terms, notes, far or FarStart(), agree
    if far is None:
        notes.append("the time offset is unknown and could not be estimated from the frames: 0 is used")
        return replace(profile, time_offset_s=0.0), terms, notes, FarStart(), agree
    terms += [terms_of.TIME_OFFSET] if informative else []
    aligned = replace(profile, time_offset_s=far.offset_s)
    return aligned, terms, notes, FarStart(0.0, far.skewed_offset_s - far.offset_s, far.skew, far.axes), agree


def _is_open(effect: Effect, profile: CameraProfile) -> bool:
    return effect.calibrated is not None and effect.calibrated.name in profile.open_imu


def at_rest(observed: ObservedTracks, profile: CameraProfile) -> bool:
    """Whether neither rotations nor points move by more than a tracker's error per frame: nothing is determined."""
    steps = (np.linalg.norm(pair.points_second_px - pair.points_first_px, axis=-1) for pair in observed.pairs)
    moved_px = np.median(np.concatenate([np.zeros(1), *steps]))
    return bool(moved_px < MIN_MOTION_PX) and _hardly_turns(observed, profile)


def _hardly_turns(observed: ObservedTracks, profile: CameraProfile) -> bool:
    """Whether the frame rotations are too small to be compared with the gyroscope's."""
    if len(observed.pairs) < MIN_PAIRS:
        return True
    turns = observed.turns(profile)
    changing = turns.detrended(turns.vector_rad)
    return float(np.sqrt(np.mean((changing**2).sum(axis=-1)))) * observed.lens.fx_px < MIN_MOTION_PX


def _one_axis_agrees(observed: ObservedTracks, capture: Capture, profile: CameraProfile) -> bool:
    """Whether rotations about some axis are proportional to the gyroscope's.

    An optical stabiliser removes most of pitch and yaw, not roll.
    """
    profile = replace(profile, time_offset_s=profile.time_offset_s or 0.0)
    turns = observed.covered(capture.imu, profile).turns(profile)
    if len(turns.vector_rad) < MIN_PAIRS:
        return False
    times = (np.asarray(profile.imu_time_s(s)) for s in (turns.first_s, turns.second_s))
    measured = turns.detrended(gyro_turns(integrate_gyro(capture.imu, profile), *times))
    seen = turns.detrended(turns.vector_rad)
    product = (seen * measured).sum(axis=0) ** 2
    square = np.maximum((seen**2).sum(axis=0) * (measured**2).sum(axis=0), 1e-30)
    return bool(np.max(product / square) > AXIS_EXPLAINED)


def _agree_at(observed: ObservedTracks, capture: Capture, profile: CameraProfile) -> FarStart | None:
    """Changes of the profile's clocks and axes at which the rotations agree best; None if they agree nowhere."""
    if len(observed.pairs) < MIN_PAIRS:
        return None
    turns, given_s = observed.turns(profile), profile.time_offset_s or 0.0
    coarse = align_coarsely(turns, capture.imu, profile)
    if coarse is None or coarse.explained < MIN_EXPLAINED or coarse.at_end:
        return None
    turned = tuple(map(tuple, coarse.rotation_cam_imu.tolist())) if coarse.axes_changed else None
    far = FarStart(coarse.time_offset_s - given_s, axes=turned)
    if coarse.explained < WELL_EXPLAINED and (other := align_with_skew(turns, capture.imu, profile)) is not None:
        skewed, skew = other
        far = replace(far, skewed_offset_s=skewed.time_offset_s - given_s, skew=skew - profile.clock_skew)
    return far
