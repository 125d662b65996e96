"""Encoder stalls in mid-movie: find which capture each slot shows, by comparing tracked points with the gyroscope.

An encoder that resumes after a pause takes the current picture: from some slot on, the content is m captures later than
its timestamps, and each of m repeats reduces the lag by one.  So slot k of a stall shows capture k + m − (repeats up to
k), or its own before the jump.  Repeats are visible, the jump is not, but each position of it predicts other rotations
between successive frames.  A position is accepted only if it explains the rotations decisively better than any other.

A recorder that misses a picture repeats the previous one instead: the repeat shows a capture that is too early, and so
do the slots after it if the recorder catches up only later, by dropping a picture.  These positions are tried too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.capture.records import STALL, Capture
from virest.capture.startup import REPEATS_APART, find_stalls
from virest.image_formation.row_clock import RowClock
from virest.inference.frame_rotations import gyro_turns, picture_rotation
from virest.inference.observed_tracks import MIN_TRACKS
from virest.inference.tracking import TrackPair, track_pairs
from virest.motion.integration import integrate_gyro
from virest.motion.trajectory import Trajectory

CONTEXT = 8 + REPEATS_APART
"""Frames on both sides of a stall; those beyond REPEATS_APART are at their timestamps, and determine the scatter of the
rotations."""
MIN_CONTEXT = 6
"""Fewest of these whose rotations could be measured."""
REPEAT_PX, MOVED_PX = 0.1, 0.5
"""A frame repeats its predecessor if points move less than REPEAT_PX where the gyroscope predicts over MOVED_PX."""
AFTER_REPEAT = 2
"""Frames after another stall's repeat whose rotations do not count as usual: content may catch up there."""
LEAST_NOISE_PX = 0.1
"""Least scatter of the rotations that is assumed, px at the focal length."""
DECISIVE_CHI2 = 37.0
"""Smallest chi-square advantage of the best position over any other: exp(−37 / 2) is 1e-8, and 1e-6 if rotations
scatter 15 % more than in the neighbouring frames."""
OTHER_SIGMA, MOST_REST = 3.0, 0.2
"""Reject a lag that differs from a whole number of captures by more than these standard deviations and periods."""
MOST_RMS_RATIO = 1.5
"""Largest rms residual inside the stall relative to its surroundings for the rotations to count as explained."""


@dataclass(frozen=True, slots=True)
class Retimed:
    """A stall whose content was identified."""

    stall: tuple[int, int]
    """First and last slot as reported."""
    first: int
    """First slot that may show another capture than its own."""
    last: int
    shows: tuple[int, ...]
    """The capture that each slot from ``first`` to ``last`` shows."""
    rest_s: tuple[float, float]
    """Mean residual lag, and its standard deviation."""


def stall_window(capture: Capture, stall: tuple[int, int]) -> range:
    """The frames to analyse."""
    return range(max(stall[0] - CONTEXT, 0), min(stall[1] + CONTEXT + 1, len(capture.frames)))


def start_up_stalls(capture: Capture, profile: CameraProfile) -> tuple[tuple[int, int], ...]:
    """The runs around repeats among the first frames, of a profile that states that these have no recorder lag."""
    last, lag_s = profile.extensions.frame_lag_frames, profile.extensions.frame_lag_s
    repeats = tuple(repeat for repeat in capture.repeats if repeat <= last)
    return find_stalls(repeats, None, 1, 0.0) if repeats and not lag_s else ()


def fit_stall(
    capture: Capture, profile: CameraProfile, stall: tuple[int, int], pictures: Mapping[int, NDArray[np.uint8]]
) -> Retimed | None:
    """The captures that the slots of a stall show; None if points do not determine them.

    profile: with focal length and time offset; pictures: luma by movie index, those of :func:`stall_window`.
    """
    lens = profile.intrinsics
    if lens is None or profile.time_offset_s is None:
        return None
    window = stall_window(capture, stall)
    slots = [k for k in window[1:] if k in pictures and k - 1 in pictures]
    pairs = {k: pair for k in slots if (pair := _pair(pictures, k)) is not None}
    time_s, trajectory = _middle_s(capture, profile), integrate_gyro(capture.imu, profile)
    if time_s[window[0]] < trajectory.span_s[0] or time_s[window[-1]] > trajectory.span_s[1]:
        return None

    def predicted_px(first: Sequence[int], second: Sequence[int]) -> Array:
        return gyro_turns(trajectory, time_s[list(first)], time_s[list(second)]) * lens.fx_px

    expected = dict(zip(slots, predicted_px([k - 1 for k in slots], slots), strict=True))
    repeated = [k for k in slots if np.linalg.norm(expected[k]) > MOVED_PX and _is_repeat(pairs.get(k))]
    repeats = [k for k in repeated if stall[0] < k <= stall[1]]
    seen = [k for k in slots if pairs.get(k) is not None and k not in repeated]
    turned = np.array([picture_rotation(lens, pairs[k]) for k in seen]).reshape(-1, 3) * lens.fx_px
    inside = np.array([stall[0] <= k <= stall[1] + REPEATS_APART + 1 for k in seen], bool)
    elsewhere = [np.array(seen) - repeat for repeat in repeated if repeat not in repeats]
    around = ~inside & ~np.any([(after >= 0) & (after <= AFTER_REPEAT) for after in elsewhere], axis=0)
    if not repeats or around.sum() < MIN_CONTEXT or not inside.any():
        return None
    if stall[1] + len(repeats) >= len(capture.frames):
        return None

    def left_px(trial: _Trial) -> Array:
        shows = trial[1]
        return np.asarray(turned - predicted_px([shows[k - 1] for k in seen], [shows[k] for k in seen]))

    late = [(start, _shows(window, start, repeats)) for start in range(stall[0], repeats[0])]
    early = _early_trials(window, repeats, lambda trial: float((left_px(trial)[inside] ** 2).sum()))
    trials = [*late, *early]
    left = np.array([left_px(trial) for trial in trials])
    noise_px = max(float(np.sqrt(np.mean(left[0][around] ** 2))), LEAST_NOISE_PX)
    misfit = (left[:, inside] ** 2).sum(axis=(1, 2)) / noise_px**2
    best = int(np.argmin(misfit))
    unexplained = misfit[best] > MOST_RMS_RATIO**2 * 3 * inside.sum()
    if unexplained or np.partition(misfit, 1)[1] - misfit[best] < DECISIVE_CHI2:
        return None
    start, shows = trials[best]
    last = max([stall[1], *(k for k in window if shows[k] != k)])
    within = [k for k, i in zip(seen, inside, strict=True) if i]
    rest_s = _rest_s(
        trajectory, time_s[[shows[k - 1] for k in within]], time_s[[shows[k] for k in within]],
        left[best][inside], lens.fx_px, noise_px,
    )  # fmt: skip
    if abs(rest_s[0]) > max(OTHER_SIGMA * rest_s[1], MOST_REST * float(np.median(np.diff(time_s)))):
        return None
    return Retimed(stall, start, last, tuple(shows[k] for k in range(start, last + 1)), rest_s)


def _rest_s(
    trajectory: Trajectory, first_s: Array, second_s: Array, left_px: Array, focal_px: float, noise_px: float
) -> tuple[float, float]:
    """Common residual lag of all frames and its standard deviation, by least squares."""
    step_s = 1e-3
    moved = gyro_turns(trajectory, first_s + step_s, second_s + step_s) - gyro_turns(trajectory, first_s, second_s)
    slope = focal_px * moved / step_s
    power = max(float((slope**2).sum()), 1e-12)
    return float((slope * left_px).sum()) / power, noise_px / float(np.sqrt(power))


def at_shown_times(capture: Capture, found: Sequence[Retimed]) -> Capture:
    """The capture with stalled slots at the times and exposures of the captures that they show; other skips remain."""
    frames = list(capture.frames)
    for one in found:
        shows = dict(zip(range(one.first, one.last + 1), one.shows, strict=True))
        # slots before the jump are at their timestamps
        for slot in range(one.stall[0], one.last + 1):
            source, frame = capture.frames[shows.get(slot, slot)], frames[slot]
            only = frame.skip_codes == (STALL,)
            frames[slot] = replace(
                frame,
                time_s=source.time_s,
                exposure_s=source.exposure_s,
                skip_reason=None if only else frame.skip_reason,
                skip_codes=() if only else frame.skip_codes,
            )
    return replace(capture, frames=tuple(frames))


def _pair(pictures: Mapping[int, NDArray[np.uint8]], k: int) -> TrackPair | None:
    found = track_pairs([(k - 1, pictures[k - 1]), (k, pictures[k])])
    return found[0] if found and len(found[0]) >= MIN_TRACKS else None


def _is_repeat(pair: TrackPair | None) -> bool:
    """Whether a frame repeats its predecessor; identical frames give no pair."""
    if pair is None:
        return True
    return float(np.median(np.linalg.norm(pair.points_second_px - pair.points_first_px, axis=-1))) < REPEAT_PX


def _middle_s(capture: Capture, profile: CameraProfile) -> Array:
    """Time of the middle row of each capture, IMU clock."""
    stamp_s = np.array([frame.time_s for frame in capture.frames])
    exposure_s = np.array([frame.exposure_s or 0.0 for frame in capture.frames])
    return np.asarray(RowClock(profile).middle_s(stamp_s, exposure_s))


_Trial = tuple[int, dict[int, int]]
"""The first slot that may show another capture than its own, and the capture that each slot shows."""


def _early_trials(window: range, repeats: Sequence[int], misfit: Callable[[_Trial], float]) -> list[_Trial]:
    """Content too early from each repeat until a jump: the positions of one jump after the other, the best one kept."""
    jumps = [next(k for k in range(repeat, window[-1] + 2) if k not in repeats) for repeat in repeats]
    found: list[_Trial] = []
    for i, earliest in enumerate(jumps):
        latest = min([r for r in repeats if r >= earliest] + [earliest + REPEATS_APART, window[-1]])
        tried = [[*jumps[:i], jump, *jumps[i + 1 :]] for jump in range(earliest, latest + 1)]
        trials = [(repeats[0], _shows_early(window, repeats, at)) for at in tried]
        jumps = tried[int(np.argmin([misfit(trial) for trial in trials]))]
        found += [trial for trial in trials if trial not in found]
    return found


def _shows_early(window: range, repeats: Sequence[int], jumps: Sequence[int]) -> dict[int, int]:
    """The capture that each slot shows if content is too early from each repeat until the jump that belongs to it."""
    return {k: k - sum(r <= k < jump for r, jump in zip(repeats, jumps, strict=True)) for k in window}


def _shows(window: range, start: int, repeats: Sequence[int]) -> dict[int, int]:
    """The capture that each slot shows if content is late from ``start`` on."""
    late = {k: len(repeats) - sum(repeat <= k for repeat in repeats) for k in window}
    return {k: k + (late[k] if k >= start else 0) for k in window}
