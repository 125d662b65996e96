"""The recorder's start-up lag: content later than its timestamps, until exact repeats have used up the lag.

A recorder that only drops frames repeats pictures too: each repeat then shows what its predecessor shows, and all other
frames what they are stamped.  The rotations of the frames tell which it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from virest.arrays import Array, Index
from virest.camera.profile import CameraProfile
from virest.capture.join import median_period_s
from virest.capture.records import Capture
from virest.inference.coarse_alignment import align_coarsely
from virest.inference.observed_tracks import ObservedTracks

EXTRA_PERIODS = (0.0, 0.5, 1.0, 1.5, 2.0)
"""Further frame periods of lag to try if the recording ends before repeats have used it up."""
MOST_DISAGREEMENT = 0.7
"""Accept a lag, or that there is none, if it reduces the disagreement of the rotations to at most this fraction."""

Schedule = tuple[float, int, tuple[float, ...]]
"""(lag_s at slot 0, last lagging slot, delay of each slot's content, s)."""


def lag_schedules(capture: Capture, repeats: Sequence[int]) -> list[Schedule]:
    """Schedules consistent with the repeats found; none without a repeat."""
    if not repeats:
        return []
    period_s = median_period_s(np.array([frame.time_s for frame in capture.frames]))
    slots = np.arange(len(capture.frames))
    so_far = np.searchsorted(np.sort(np.array(repeats)), slots, side="right")
    last, total = max(repeats), len(repeats)
    whole_movie = last >= 0.8 * len(slots)
    found = []
    for extra in EXTRA_PERIODS if whole_movie else (0.0,):
        shift = np.where(slots <= last, total + extra - so_far, extra) * period_s
        found.append(((total + extra) * period_s, int(last), tuple(shift.tolist())))
    return found


def as_stamped(slots: Index, repeats: Sequence[int] | Index) -> Index:
    """The capture that each slot (n,) shows if a repeat shows that of its predecessor, and all others their own."""
    return np.asarray(np.maximum.accumulate(np.where(np.isin(slots, repeats), slots[0], slots)))


@dataclass(frozen=True, slots=True)
class StartUpLag:
    """The recorder's start-up lag, estimated from the frames' rotations."""

    lag_s: float
    """Lag of slot 0; 0 if none was accepted, or if the frames were determined to have none."""
    frames: int
    """The last lagging slot."""
    by_frame_s: tuple[float, ...]
    determined: bool
    note: str


def fit_start_up_lag(capture: Capture, observed: ObservedTracks, profile: CameraProfile) -> StartUpLag:
    """Find the schedule at which frames and gyroscope agree best; observed: must include the first frames."""
    none = StartUpLag(0.0, 0, (), False, "no frame repeats another: a lag cannot be determined")
    schedules = lag_schedules(capture, capture.repeats)
    if not schedules:
        return none
    left = [_disagreement(capture, observed, profile, by_frame) for _, _, by_frame in schedules]
    without = _disagreement(capture, observed, profile, (0.0,) * len(capture.frames))
    best = int(np.argmin(left))
    stamp_s = np.array([frame.time_s for frame in capture.frames])
    repeated_s = stamp_s[as_stamped(np.arange(len(stamp_s)), capture.repeats)] - stamp_s
    if _disagreement(capture, observed, profile, repeated_s) <= min(without, MOST_DISAGREEMENT * left[best]):
        note = "frames show what they are stamped; repeats show what their predecessors show"
        return StartUpLag(0.0, max(capture.repeats), tuple(repeated_s.tolist()), True, note)
    if not left[best] < MOST_DISAGREEMENT * without:
        return replace(none, note="the rotations agree no better with a lag than without")
    lag_s, last, by_frame = schedules[best]
    return StartUpLag(lag_s, last, by_frame, True, f"used up by frame {last}")


def _disagreement(
    capture: Capture, observed: ObservedTracks, profile: CameraProfile, by_frame_s: Sequence[float] | Array
) -> float:
    """Fraction of the frames' changing rotation that the gyroscope leaves unexplained at the best offset."""
    late = replace(observed, stamp_s=observed.stamp_s + np.array(by_frame_s))
    coarse = align_coarsely(late.turns(profile), capture.imu, profile)
    return 1.0 if coarse is None else 1.0 - coarse.explained
