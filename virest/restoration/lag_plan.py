"""Detect a recorder's start-up lag that the profile does not state, and plan at the frames' true times."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile
from virest.capture.records import Capture
from virest.inference.coarse_alignment import MIN_PAIRS
from virest.inference.observed_tracks import observe_tracks
from virest.inference.recorder_lag import StartUpLag, fit_start_up_lag
from virest.inference.tracking import track_pairs
from virest.restoration.capture import RestorationPlan, at_true_times
from virest.restoration.plan_notes import NoteCode

GrayReader = Callable[[Sequence[int]], Iterator[tuple[int, NDArray[np.uint8]]]]
"""Gives (index, luma) of the requested frames, in order."""
MOST_FRAMES = 90
"""Largest number of start-up frames to read."""
SOURCE = "repeated frames, and frame rotations against the gyroscope"


def find_lag(capture: Capture, profile: CameraProfile, read_gray: GrayReader) -> StartUpLag | None:
    """The lag of the first frames, 0 s if they have none; None: no sign of one, or rotations do not tell."""
    lagging = [frame.index for frame in capture.frames if frame.only_startup][:MOST_FRAMES]
    if profile.extensions.frame_lag_frames or not capture.repeats or len(lagging) <= MIN_PAIRS:
        return None
    observed = observe_tracks(capture, list(track_pairs(read_gray(lagging))), profile)
    if len(observed.pairs) < MIN_PAIRS:
        return None
    found = fit_start_up_lag(capture, observed, profile)
    return found if found.determined else None


def at_lag(capture: Capture, profile: CameraProfile, lag: StartUpLag) -> Capture:
    """The capture with start-up frames at the times and exposures of the captures that they show."""
    return replace(capture, frames=at_true_times(capture.frames, _profile_with_lag(profile, lag), capture.repeats))


def with_lag(plan: RestorationPlan, lag: StartUpLag) -> RestorationPlan:
    """A plan that was made at true times, with the lag added to its profiles and notes."""
    contradicted = None if plan.contradicted is None else _profile_with_lag(plan.contradicted, lag)
    text = f"recorder lag of {lag.lag_s:.2f} s: the first {lag.frames} frames are used at their true times"
    if not lag.lag_s:
        text = f"repeated frames mean no recorder lag: up to frame {lag.frames}, {lag.note}"
    profile = _profile_with_lag(plan.profile, lag)
    return replace(plan, profile=profile, contradicted=contradicted).noted(NoteCode.TRUE_TIMES, text)


def _profile_with_lag(profile: CameraProfile, lag: StartUpLag) -> CameraProfile:
    extensions = replace(profile.extensions, frame_lag_s=lag.lag_s, frame_lag_frames=lag.frames)
    return profile.with_estimate("lag_s", lag.lag_s, None, SOURCE, extensions=extensions)
