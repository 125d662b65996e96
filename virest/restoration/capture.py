"""Restore a capture by a plan (see :mod:`capture_estimation`): check, deblur and warp each frame."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile
from virest.capture.folder import Frame
from virest.capture.frame_coding import FrameCoding
from virest.capture.imu import ImuSamples
from virest.capture.join import median_period_s, outside_reason
from virest.image_formation.row_motion import FrameTranslation, RowMotion, row_motion
from virest.inference.frame_exposures import OwnExposures
from virest.inference.recorder_lag import as_stamped
from virest.inference.unsharp_mask import UnsharpMask, without_mask
from virest.motion.integration import integrate_gyro
from virest.motion.optics import MovingLens, moving_lens
from virest.motion.trajectory import Trajectory
from virest.restoration.coded_blur import FRAMES_BACK, Predicted
from virest.restoration.frame import (
    RestoredFrame,
    copied_frame,
    restore_frame,
)
from virest.restoration.neighbours.confirmation import ConfirmedGain
from virest.restoration.neighbours.refinement import MissingTurn
from virest.restoration.neighbours.sights import FrameNeighbours, Sight, with_neighbours
from virest.restoration.parameters import degradation_parameters, unknown_parameters
from virest.restoration.plan_notes import NoteCode, PlanNote
from virest.restoration.settings import JOINT_METHODS, RestorationSettings

UNTRUSTED = "the inertial log does not follow the camera"
LAG_TO_THE_END = 0.8
"""If the recorder's lag is still shrinking this far into the movie (fraction of its frames), it may last to the end."""
ALMOST = 1e-6
"""Frame periods: guards against rounding when the lag is truncated to whole periods."""
FOCAL_UNKNOWN = "focal length unknown; it could not be estimated from the frames: give fx_px in camera.yaml"


@dataclass(frozen=True, slots=True)
class RestorationPlan:
    """Everything a worker needs besides frames and inertial samples."""

    profile: CameraProfile
    """Unknown values are filled in where they could be estimated."""
    settings: RestorationSettings
    said: tuple[PlanNote, ...] = ()
    """Notes to the user about the whole capture."""
    refusal: PlanNote | None = None
    """Why every frame is copied; None: frames are restored."""
    imu_gaps_s: tuple[tuple[float, float], ...] = ()
    """Gaps in the inertial data, start and end: frames that reach into one are skipped."""
    notes: tuple[str, ...] = ()
    """Extensions of the nominal model that the profile enables and the run applies."""
    translations: Mapping[int, FrameTranslation] | None = None
    """By movie index, at the settings' reference time; None or missing: rotation only."""
    contradicted: CameraProfile | None = None
    """The profile with the exposure that the frames' blur shows, where it contradicts the stated one: steps that would
    do harm according to it are skipped; None: no contradiction."""

    missing_turn: MissingTurn | None = None
    """Rotation that neighbouring frames show and the prediction lacks; None: none, or not measurable."""

    points_off_rad_s: float | None = None
    """Standard deviation, per axis, of the rotation rate by which tracked points lie off; None: they do not."""

    undetected_rad_s: float | None = None
    """Standard deviation, per axis, of a missing rotation rate that the frames do not show; None: not measurable."""

    mask: UnsharpMask | None = None
    """The phone's sharpening, undone before deblurring; None: none detected."""

    confirmed: ConfirmedGain | None = None
    """How much of the predicted gain neighbouring frames confirm; None: not measurable."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """The texts of ``said``."""
        return tuple(note.text for note in self.said)

    @property
    def copy_reason(self) -> str | None:
        """The text of ``refusal``."""
        return None if self.refusal is None else self.refusal.text

    def noted(self, code: NoteCode, *texts: str) -> RestorationPlan:
        """The plan with further notes."""
        return replace(self, said=(*self.said, *(PlanNote(code, text) for text in texts)))

    def without(self, code: NoteCode) -> RestorationPlan:
        """The plan without notes of this code, nor a refusal of this code."""
        kept = tuple(note for note in self.said if note.code is not code)
        return replace(self, said=kept, refusal=None if self.refuses(code) else self.refusal)

    def refused(self, code: NoteCode, text: str) -> RestorationPlan:
        """The plan changed to copy all frames, for this reason."""
        return replace(self, refusal=PlanNote(code, text))

    def refuses(self, *codes: NoteCode) -> bool:
        """Whether all frames are copied, for a reason with one of these codes."""
        return self.refusal is not None and self.refusal.code in codes

    @property
    def reach(self) -> int:
        """Number of neighbouring frames on each side that a frame's restoration uses."""
        if self.copy_reason is not None:
            return 0
        if self.settings.deblur == "none":
            return 0 if self.missing_turn is None and not self.profile.over_time("rate") else 1
        return max(self.most_joined_on_a_side, FRAMES_BACK)

    @property
    def most_joined_on_a_side(self) -> int:
        """Number of frames on each side that may take part in a frame's joint restoration."""
        return self.settings.neighbours if self.settings.deblur in JOINT_METHODS else 0

    def of(self, frames: Iterable[Frame]) -> RestorationPlan:
        """The plan reduced to what a worker needs for these frames."""
        if self.translations is None:
            return self
        numbers = [frame.index for frame in frames]
        return replace(self, translations={n: self.translations[n] for n in numbers if n in self.translations})


def restore_frames(
    frames: Iterable[tuple[Frame, NDArray[np.uint8] | None]],
    imu: ImuSamples,
    plan: RestorationPlan,
    only: Collection[int] | None = None,
    coding: Mapping[int, FrameCoding] | None = None,
) -> Iterator[RestoredFrame]:
    """Restore frames one by one; ``imu`` covers them.  Frames without a picture are passed over.

    frames: in movie order.  only: indices of the frames to restore, the others serving as neighbours; None: all.
    coding: how frames were coded, by frame index, filled in as frames are decoded; missing: unknown.
    """
    profile, coding = plan.profile, {} if coding is None else coding
    trajectory = integrate_gyro(imu, profile) if profile.intrinsics is not None else None
    lens = moving_lens(trajectory, profile) if trajectory is not None else None
    translations, neighbours, undistort = plan.translations or {}, None, plan.settings.undistort
    if trajectory is not None and lens is not None and plan.reach:
        neighbours = FrameNeighbours(trajectory, lens, plan.missing_turn)

    def sight(frame: Frame, picture: NDArray[np.uint8]) -> Sight:
        if trajectory is None:
            return Sight(frame, picture, None)
        motion = moved_over_frame(
            trajectory, lens, frame, plan.settings.reference, translations.get(frame.index), profile
        )
        outside = outside_reason(motion.start_s, motion.end_s, imu.time_s, plan.imu_gaps_s)
        why = outside[1] if outside else ""
        if plan.mask is None or plan.copy_reason is not None:
            return Sight(frame, picture, motion, why, coding=coding.get(frame.index))
        return Sight(frame, without_mask(picture, plan.mask), motion, why, picture, coding.get(frame.index))

    sights = (sight(frame, picture) for frame, picture in frames if picture is not None)
    for before, here, after in with_neighbours(sights, plan.reach):
        frame, motion = here.frame, here.motion
        picture = here.picture if here.recorded is None else here.recorded
        if only is not None and frame.index not in only:
            continue
        if motion is None or trajectory is None:
            yield copied_frame(frame, picture, profile, plan.copy_reason or FOCAL_UNKNOWN, undistort=undistort)
            continue
        if here.outside:
            yield RestoredFrame(frame, "skipped", None, (here.outside,), degradation=unknown_parameters(profile))
            continue
        reason = plan.copy_reason or untrusted_reason(motion)
        if reason:
            found = degradation_parameters(motion, trajectory)
            yield copied_frame(frame, picture, profile, reason, found, undistort=undistort)
            continue
        seen = None
        if plan.contradicted is not None:
            moved = translations.get(frame.index)
            seen = moved_over_frame(trajectory, lens, frame, plan.settings.reference, moved, plan.contradicted)
        refined, compared = None, None
        if neighbours is not None:
            count = max(plan.most_joined_on_a_side, 1)
            near_before, near_after = before[max(len(before) - count, 0) :], after[:count]
            refined = neighbours.refined(near_before, here, near_after)
            if plan.most_joined_on_a_side and plan.settings.most_joined:
                joined = (*near_before, *near_after)
                compared = partial(neighbours.joined, joined, here, refined, plan.settings.most_joined)
            else:
                adjacent = (*before[-1:], *after[:1])
                compared = partial(neighbours.checked, adjacent, here, refined, plan.settings.min_blur_px)
        unmasked = None if here.recorded is None else here.picture
        yield restore_frame(
            frame,
            picture,
            motion,
            trajectory,
            plan.settings,
            seen,
            refined,
            plan.confirmed,
            compared,
            unmasked,
            here.coding_step,
            plan.undetected_rad_s if plan.missing_turn is None else None,
            predicted_from(before, here),
        )


def predicted_from(before: Sequence[Sight], here: Sight) -> tuple[Predicted, ...]:
    """The frames that the coder predicted a frame from, one from the next, the nearest first; at most FRAMES_BACK."""
    found: list[Predicted] = []
    for earlier in before[: -FRAMES_BACK - 1 : -1]:
        coding, consecutive = here.coding, earlier.frame.index == here.frame.index - 1
        if coding is None or not coding.from_previous or not consecutive or not earlier.usable:
            break
        assert earlier.motion is not None
        found.append(Predicted(earlier.motion, coding.step))
        here = earlier
    return tuple(found)


def untrusted_reason(motion: RowMotion) -> str | None:
    """Why a frame is copied whose rows reach into an untrusted interval that is not bridged; None: none do."""
    parts = (p for p in motion.profile.unbridged_s if motion.start_s < p[1] and motion.end_s > p[0])
    return next((f"{UNTRUSTED} from {start:.3f} to {end:.3f} s" for start, end in parts), None)


def moved_over_frame(
    trajectory: Trajectory,
    lens: MovingLens | None,
    frame: Frame,
    reference: str,
    translation: FrameTranslation | None,
    profile: CameraProfile,
) -> RowMotion:
    """The camera's motion over one frame's rows, according to a profile."""
    return row_motion(trajectory, profile, frame.time_s, frame.exposure_s, reference, translation, lens)


def at_true_times(frames: Sequence[Frame], profile: CameraProfile, repeats: Sequence[int] = ()) -> tuple[Frame, ...]:
    """All frames of a movie; those of the recorder's start-up get the time and exposure of the capture they show.

    frame_lag: slot k shows capture k + lag − repeats so far; exact repeats reduce the lag to 0 over the first slots.
    repeats: slots observed to repeat.  If their number differs from the lag, repeats are assumed evenly spaced, unless
    the movie ends before the lag reaches 0: then the observed ones are used, and all slots keep the remaining lag.
    A lag of 0 s: the first slots show what they are stamped, but each repeat shows what its predecessor shows.  Frames
    that were skipped only for the start-up become usable.  Exposures logged in other rows are given back.
    """
    frames = OwnExposures.stated_by(profile).of(frames)
    lagging = profile.extensions.frame_lag_frames
    period_s = median_period_s(np.array([frame.time_s for frame in frames]))
    periods = profile.extensions.frame_lag_s / period_s if period_s > 0 else 0.0
    lag, last, slots = round(periods), lagging, np.arange(len(frames))
    if not lagging:
        return tuple(frames)
    used = np.sort(np.array([slot for slot in repeats if 0 < slot <= lagging], int))
    unfinished = 0 < len(used) < periods and lagging >= LAG_TO_THE_END * len(frames)
    if unfinished:
        lag, last = int(periods + ALMOST), len(frames) - 1
    elif lag and len(used) != lag:
        used = np.round(np.arange(1, lag + 1) * lagging / lag).astype(int)
    rest_s = (periods - lag) * period_s if unfinished else 0.0
    shows = slots + lag - np.searchsorted(used, slots, side="right") if lag else as_stamped(slots, used)
    early = [_showing(frame, frames, int(shows[k]), period_s, rest_s) for k, frame in enumerate(frames[: last + 1])]
    return (*early, *frames[last + 1 :])


def _showing(frame: Frame, frames: Sequence[Frame], capture: int, period_s: float, later_s: float) -> Frame:
    """A slot's frame with the time and exposure of the capture that it shows; stamp and index stay the slot's."""
    source = frames[min(capture, len(frames) - 1)]
    time_s = source.time_s + max(capture - len(frames) + 1, 0) * period_s + later_s
    frame = replace(frame, time_s=time_s, exposure_s=source.exposure_s)
    return replace(frame, skip_reason=None, skip_codes=()) if frame.only_startup else frame
