"""Plan with frames at the times that their points show: stamps that jitter, and exposure times that are logged wrongly.

Both delay each frame by an amount of its own, in mid-exposure.  The first is a delay per frame; the second follows from
the exposures of other rows or from the frames' brightness, so it needs no numbers.  Their likelihoods decide.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from virest.arrays import Array
from virest.camera.field import Field
from virest.camera.profile import CameraProfile
from virest.camera.shutter import STAMP_FRACTION
from virest.capture.imu import ImuSamples
from virest.capture.records import Capture, Frame
from virest.image_formation.row_clock import RowClock
from virest.inference.frame_delays import MIN_PAIRS, FrameDelays, Turns, fit_frame_delays, unexplained_turns
from virest.inference.frame_exposures import (
    AS_LOGGED,
    LEAST_GAIN_STD,
    ROWS_LATE,
    OwnExposures,
    by_brightness,
    unlogged_log_light,
)
from virest.inference.observed_tracks import ObservedTracks, frame_times, observe_tracks
from virest.inference.tracking import TrackPair
from virest.restoration.capture import RestorationPlan
from virest.restoration.plan_notes import NoteCode
from virest.restoration.profile_conflict import CONTRADICTED, MOST_LEFT, VALUE_P

log = logging.getLogger(__name__)

POINTS_PER_PAIR = 60
"""Points of a pair that are used: three numbers are fitted to them."""
MOST_FRAMES = 3000
"""Frames of a movie that are tracked for delays of their own, the first ones: 3000 of 640×480 take 20 s."""
DELAY_PASSES = 2
"""Fits of delays from which exposures follow: a delay is that of a middle, which moves with the exposure itself."""
LEAST_EXPOSURE = 0.1
"""Least part of its logged exposure time that a frame can have had: delays that need less come from stamps."""
SAME_START_S, LEAST_OWN = 1e-4, 0.5
"""Distance at which a knot is that of a frame; least part of frames and knots that are, for delays of single frames."""
SOURCE = "tracked points against the gyroscope, frame by frame"


@dataclass(frozen=True, slots=True)
class FrameTimes:
    """Times of frames that explain the points better than their stamps do."""

    capture: Capture
    """With the exposures that the frames had."""
    profile: CameraProfile
    """The given one, with a delay for each frame."""
    text: str
    """Message about it."""
    own: OwnExposures = AS_LOGGED
    """Exposures of the frames, other than the logged ones."""
    instead: FrameTimes | None = None
    """Exposures of the frames that would delay them by as much; only blur tells them from stamps that jitter."""
    most_left: float | None = MOST_LEFT
    """Largest part of the contradiction that may remain; None: any, since times of a few frames hardly change it."""

    def explain(self, before: RestorationPlan, after: RestorationPlan) -> bool:
        """Whether most of what contradicts the points is gone with these times, and no frame is lost."""
        if after.refusal is not None and before.refusal is None:
            return False
        left, rest = (plan.points_off_rad_s or 0.0 for plan in (before, after))
        return self.most_left is None or rest**2 <= self.most_left * left**2

    def noted(self, plan: RestorationPlan) -> RestorationPlan:
        """The plan that was made with these times, for the capture as it was read."""
        return for_own_exposures(plan, self.own).noted(NoteCode.TRUE_TIMES, self.text)


def for_own_exposures(plan: RestorationPlan, own: OwnExposures) -> RestorationPlan:
    """A plan that was made with the frames' own exposures, for a capture whose table of them is off."""
    contradicted = None if plan.contradicted is None else own.on(plan.contradicted)
    return replace(plan, profile=own.on(plan.profile), contradicted=contradicted)


def find_frame_times(
    plan: RestorationPlan,
    given: CameraProfile,
    capture: Capture,
    pairs: Sequence[TrackPair],
    track_all: Callable[[Sequence[int]], Sequence[TrackPair]],
) -> FrameTimes | None:
    """Times of frames that tracked points require; None if stamps and logged exposures explain them.

    pairs: of the frames that planning looks at.  track_all: tracks other frames, by movie index, if it must be known
    when each frame was taken.
    """
    profile = plan.profile
    if profile.intrinsics is None or profile.time_offset_s is None:
        return None
    if profile.over_time("delay"):
        return _with_further_delays(plan, given, capture, track_all)
    observed = observe_tracks(capture, pairs, profile)
    turns = _turns(observed, capture.imu, profile)
    found = None if turns is None else fit_frame_delays(turns)
    if turns is None or found is None:
        return None
    noise_px = float(np.median(observed.noise_px))
    moved_px = found.jitter_s * turns.rate_rad_s * profile.intrinsics.fx_px
    log.debug("frames' delays of %.2g s (p = %.2g) move points by %.2g px", found.jitter_s, found.p, moved_px)
    late = found.p < VALUE_P and moved_px >= np.sqrt(CONTRADICTED**2 - 1) * noise_px
    if not late and not _light_differs(capture, observed, profile):
        return None
    usable = [frame for frame in capture.frames if frame.skip_reason is None]
    wanted = [frame.index for frame in usable[:MOST_FRAMES]]
    if set(wanted) - {n for pair in pairs for n in (pair.first, pair.second)}:
        observed = observe_tracks(capture, track_all(wanted), profile)
        turns = _turns(observed, capture.imu, profile)
        found = (fit_frame_delays(turns) if turns is not None else None) or found
    if own := _own_exposures(capture, observed, profile, found):
        text = f"{_described(own, bright=True)}: each frame is restored with its own"
        corrected = replace(capture, frames=own.of(capture.frames))
        return FrameTimes(corrected, given, text, own, most_left=MOST_LEFT if late else None)
    if not late:
        return None
    text = (
        f"stamps differ from frame to frame by {1e3 * found.jitter_s:.1f} ms (rms) from the times that points show, "
        "which are used instead"
    )
    text += f" in the first {MOST_FRAMES} frames" if len(usable) > MOST_FRAMES else ""
    instead = None
    if own := _exposures_by_delays(capture, observed, profile, found):
        said = f"{_described(own)}: each frame is restored with its own"
        instead = FrameTimes(replace(capture, frames=own.of(capture.frames)), given, said, own)
    # a frame more, which has no delay, since beyond its last knot a field is constant
    delayed = _with_delays(given, profile, capture, usable[: MOST_FRAMES + 1], found)
    return FrameTimes(capture, delayed, text, instead=instead)


def _exposures_by_delays(
    capture: Capture, observed: ObservedTracks, profile: CameraProfile, delays: FrameDelays
) -> OwnExposures:
    """Exposures that delay frames as found, but for a common delay; the logged ones where a stamp marks the middle.

    An exposure of E instead of the logged one moves a frame's middle by (½ − f) (E − logged), its stamp being at a
    fraction f of the exposure.  Delays are found once more with the exposures that follow from them.
    """
    to_middle = 0.5 - STAMP_FRACTION[profile.shutter.timestamp]
    if not to_middle or any(frame.exposure_s is None for frame in capture.frames):
        return AS_LOGGED
    found: FrameDelays | None = delays
    gain = np.ones(len(capture.frames))
    for number in range(DELAY_PASSES):
        if number:
            found = _delays_with(OwnExposures(gain=tuple(gain.tolist())), capture, observed, profile)
        if found is None or len(found.frame) < MIN_PAIRS:
            return AS_LOGGED
        trend = np.polynomial.Polynomial.fit(found.frame, found.late_s, 1)
        longer_s = (found.late_s - trend(found.frame)) / to_middle
        logged_s = np.array([capture.frames[k].exposure_s for k in found.frame], float)
        gain[found.frame] += longer_s / profile.shutter.true_exposure_s(logged_s)
        if gain.min() < LEAST_EXPOSURE:
            return AS_LOGGED
    return OwnExposures(gain=tuple(gain.tolist())) if gain.std() > LEAST_GAIN_STD else AS_LOGGED


def _delays_with(
    own: OwnExposures, capture: Capture, observed: ObservedTracks, profile: CameraProfile
) -> FrameDelays | None:
    """The delays that frames with these exposures still have."""
    corrected = replace(capture, frames=own.of(capture.frames))
    turns = _turns(replace(observed, exposure_s=frame_times(corrected)[1]), capture.imu, profile)
    return None if turns is None else fit_frame_delays(turns)


def _with_further_delays(
    plan: RestorationPlan,
    given: CameraProfile,
    capture: Capture,
    track_all: Callable[[Sequence[int]], Sequence[TrackPair]],
) -> FrameTimes | None:
    """Delays of frames that given delays of single frames leave out, such as those that a fit kept back.

    They are those that points show against the given ones of the other frames, but for an offset and a skew, which each
    fit takes out for itself.  None if the given delay is a curve over time, or if no frame is left out.
    """
    usable = [frame for frame in capture.frames if frame.skip_reason is None][:MOST_FRAMES]
    field, *more = given.over_time("delay")
    starts_s, knots_s = _starts_s(plan.profile, usable), np.array(field.knots[0])
    after = np.searchsorted(knots_s, starts_s).clip(1, len(knots_s) - 1)
    own = np.minimum(np.abs(starts_s - knots_s[after - 1]), np.abs(starts_s - knots_s[after])) < SAME_START_S
    if more or own.all() or own.sum() < LEAST_OWN * max(len(usable), len(knots_s)):
        return None
    numbers = [frame.index for frame in usable]
    delays = plan.profile.over_time("delay")
    stripped = plan.profile.with_fields([one for one in plan.profile.fields if one not in delays])
    turns = _turns(observe_tracks(capture, track_all(numbers), stripped), capture.imu, stripped)
    found = None if turns is None else fit_frame_delays(turns)
    if found is None:
        return None
    shown = np.isin(numbers, found.frame)
    place = np.searchsorted(found.frame, np.array(numbers)[shown])
    late_s, std_s = np.zeros(len(usable)), np.full(len(usable), found.jitter_s)
    late_s[shown], std_s[shown] = found.late_s[place], found.std_s[place]
    both = own & shown
    if both.sum() <= 2:
        return None
    apart = np.polynomial.Polynomial.fit(starts_s[both], field.at_time(starts_s[both])[:, 0] - late_s[both], 1)
    late_s[shown] += apart(starts_s[shown])
    late_s[own] = field.at_time(starts_s[own])[:, 0]
    if field.std:
        std_s[own] = field.std_over_time(starts_s[own])[:, 0]
    others = [one for one in given.fields if one != field]
    completed = given.with_fields([*others, _delay_field(starts_s, late_s, std_s, capture)])
    text = f"{(~own).sum()} frames that the profile gives no delay of their own get the one that points show"
    return FrameTimes(capture, completed, text, most_left=None)


def _described(own: OwnExposures, bright: bool = False) -> str:
    """What is wrong with the logged exposures, in words."""
    if own.rows_late:
        return f"exposure times are logged {rows_apart(own.rows_late)}"
    factors = f"by factors {min(own.gain):.2f} to {max(own.gain):.2f}"
    return (
        f"exposure times differ from the logged ones as {'brightness does' if bright else 'frames are late'}, {factors}"
    )


def rows_apart(rows_late: int) -> str:
    """By how many frames a row is off, in words."""
    count, way = abs(rows_late), "late" if rows_late > 0 else "early"
    return f"{count} frame{'s' * (count > 1)} {way}"


def _turns(observed: ObservedTracks, imu: ImuSamples, profile: CameraProfile) -> Turns | None:
    observed = observed.covered(imu, profile)
    if not observed.pairs:
        return None
    return unexplained_turns(imu, observed.table(POINTS_PER_PAIR * len(observed.pairs)), profile)


def _light_differs(capture: Capture, observed: ObservedTracks, profile: CameraProfile) -> bool:
    """Whether the brightness of tracked frames changes as if exposures differed from the logged ones noticeably."""
    if any(frame.exposure_s is None for frame in capture.frames):
        return False
    log_light = unlogged_log_light(capture.frames, observed.pairs, profile.curve)
    return bool(np.nanstd(log_light) > LEAST_GAIN_STD)


def _own_exposures(
    capture: Capture, observed: ObservedTracks, profile: CameraProfile, delays: FrameDelays
) -> OwnExposures:
    """Exposures of other rows, or that follow the brightness, if they are likelier than the logged ones by far.

    Of two hypotheses, the wrong one is k times as likely as the right one with a probability of at most 1 / k (Markov's
    inequality).  Each has delays besides, so that none needs to explain everything.
    """
    exposure_s = [frame.exposure_s for frame in capture.frames]
    tried = [OwnExposures(rows) for rows in ROWS_LATE] if len(set(exposure_s)) > 1 else []
    if None not in exposure_s:
        tried.append(by_brightness(capture.frames, observed.pairs, profile.curve))
    costs: list[float] = []
    for own in tried:
        found = _delays_with(own, capture, observed, profile)
        costs.append(np.inf if found is None else found.cost)
    best = int(np.argmin(costs)) if costs else 0
    likelier = bool(costs) and costs[best] < delays.cost - np.log(len(tried) / VALUE_P)
    return tried[best] if likelier else AS_LOGGED


def _with_delays(
    given: CameraProfile, profile: CameraProfile, capture: Capture, usable: Sequence[Frame], found: FrameDelays
) -> CameraProfile:
    """The given profile with a delay for each usable frame, none for those whose points do not show it."""
    late = dict(zip(found.frame.tolist(), zip(found.late_s, found.std_s, strict=True), strict=True))
    late_s, std_s = np.transpose([late.get(frame.index, (0.0, found.jitter_s)) for frame in usable])
    return given.with_fields([*given.fields, _delay_field(_starts_s(profile, usable), late_s, std_s, capture)])


def _starts_s(profile: CameraProfile, frames: Sequence[Frame]) -> Array:
    """Starts of the first rows of frames, camera clock."""
    clock = RowClock(profile)
    return np.array([float(clock.start_on_camera_s(f.time_s, f.exposure_s or 0.0)) for f in frames])


def _delay_field(starts_s: Array, late_s: Array, std_s: Array, capture: Capture) -> Field:
    """A delay of each frame, by the starts of their first rows; one of frames with the same start counts."""
    knots, last = np.unique(starts_s[::-1], return_index=True)
    rows = [_column(values[::-1][last]) for values in (late_s, std_s)]
    return Field("delay", ("time",), (tuple(knots.tolist()),), rows[0], rows[1], capture.stamp_0_ns)


def _column(values: Array) -> tuple[tuple[float, ...], ...]:
    return tuple((float(value),) for value in values)
