"""A stall in the middle of a movie: frames get the times of their content if points determine them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from virest.app.simulate import simulate_command
from virest.camera.profile import CameraProfile
from virest.capture.folder import read_capture, resolve_profile
from virest.capture.records import STALL, STARTUP, Capture
from virest.capture.video import probe_movie, read_gray
from virest.inference.recorder_stall import at_shown_times, fit_stall, stall_window, start_up_stalls
from virest.restoration.lag_plan import at_lag, find_lag

STALLED = (17, 26)
REPEATS = (22, 24, 26)
JUMP = 20

Recorded = tuple[Capture, CameraProfile, dict[int, NDArray[np.uint8]]]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """40 hand-held frames with the pictures of each captured frame."""
    folder = tmp_path_factory.mktemp("stall") / "trip"
    simulate_command(folder, width=200, height=280, frames=40, exposure_ms=6, rate_rad_s=1.2, seed=8,
                     truth_frames=False)  # fmt: skip
    capture = read_capture(folder)
    profile, _ = resolve_profile(capture)
    index = probe_movie(capture.movie)
    pictures = {n: p for n, p in read_gray(capture.movie, index, range(40)) if p is not None}
    return capture, replace(profile, time_offset_s=0.0), pictures


def shown(slot: int) -> int:
    """The captured frame that a slot shows: three later from JUMP, used up by three repeats."""
    return slot + (len(REPEATS) - sum(r <= slot for r in REPEATS) if JUMP <= slot <= STALLED[1] else 0)


def stalled(capture: Capture) -> Capture:
    """The capture with the stall that its reader reports."""
    frames = tuple(
        replace(f, skip_reason="encoder stall", skip_codes=(STALL,)) if STALLED[0] <= f.index <= STALLED[1] else f
        for f in capture.frames
    )
    return replace(capture, frames=frames, stalls=(STALLED,))


def test_late_frames_get_the_times_of_their_content(recorded: Recorded) -> None:
    """The jump, visible only in the rotation, and all later slots are found; then no frame is skipped."""
    capture, profile, pictures = recorded
    late = stalled(capture)
    seen = {k: pictures[shown(k)] for k in stall_window(late, STALLED)}
    found = fit_stall(late, profile, STALLED, seen)
    assert found is not None
    assert (found.first, found.last) == (JUMP, STALLED[1])
    assert found.shows == tuple(shown(k) for k in range(JUMP, STALLED[1] + 1))
    assert abs(found.rest_s[0]) < 4 * found.rest_s[1] + 1e-3
    followed = at_shown_times(late, [found])
    for slot, frame in enumerate(followed.frames):
        assert frame.skip_reason is None
        assert (frame.index, frame.timestamp_ns) == (slot, capture.frames[slot].timestamp_ns)
        assert frame.time_s == capture.frames[shown(slot)].time_s


@pytest.mark.parametrize("caught_up", [(23, 25, 27), (25, 26, 30)], ids=["at once", "later"])
def test_missed_pictures_are_told_from_a_lag(recorded: Recorded, caught_up: tuple[int, int, int]) -> None:
    """A recorder repeats the previous picture, and is one behind until it drops one: at once, or some slots later."""
    capture, profile, pictures = recorded
    repeats = (22, 24, 26) if caught_up[0] == 23 else (22, 25, 27)
    stall = (16, repeats[-1])
    behind = {k: sum(r <= k < jump for r, jump in zip(repeats, caught_up, strict=True)) for k in range(40)}
    late = replace(stalled(capture), stalls=(stall,))
    seen = {k: pictures[k - behind[k]] for k in stall_window(late, stall)}
    found = fit_stall(late, profile, stall, seen)
    assert found is not None
    assert (found.first, found.last) == (repeats[0], max(k for k in behind if behind[k]))
    assert found.shows == tuple(k - behind[k] for k in range(found.first, found.last + 1))
    times = [frame.time_s for frame in at_shown_times(late, [found]).frames]
    assert times == [capture.frames[k - behind[k]].time_s for k in range(40)]


@pytest.mark.parametrize("lags", [False, True])
def test_missed_pictures_at_the_start_are_no_lag(recorded: Recorded, lags: bool) -> None:
    """The first 20 frames were taken for a recorder's start-up: those of a recorder that drops pictures are used."""
    capture, profile, pictures = recorded
    repeats = (7, 12, 16)
    if lags:
        shows = {k: k + sum(repeat > k for repeat in repeats) for k in range(40)}
    else:
        shows = {k: k - (k in repeats) for k in range(40)}
    frames = tuple(
        replace(f, skip_reason="start-up", skip_codes=(STARTUP,)) if f.index < 20 else f for f in capture.frames
    )
    capture = replace(capture, frames=frames, repeats=repeats, startup_lag_s=0.1)
    lag = find_lag(capture, profile, lambda wanted: ((k, pictures[shows[k]]) for k in wanted))
    assert lag is not None
    assert lag.lag_s == pytest.approx(0.1 if lags else 0.0, abs=1e-3)
    followed = at_lag(capture, profile, lag).frames[:17]
    assert not any(frame.only_startup for frame in followed)
    assert [frame.time_s for frame in followed] == [capture.frames[shows[k]].time_s for k in range(17)]
    states = profile.with_extensions(frame_lag_s=lag.lag_s, frame_lag_frames=lag.frames)
    assert start_up_stalls(capture, states) == (() if lags else ((1, 16),))


@pytest.mark.parametrize("case", ["as stamped", "another lateness", "slow", "no clock"])
def test_without_evidence_no_stall_is_corrected(recorded: Recorded, case: str) -> None:
    """Frames at their timestamps, frames late by half a period, a nearly still phone, and an unknown clock."""
    capture, profile, pictures = recorded
    late = stalled(capture)
    seen = {k: pictures[shown(k)] for k in stall_window(late, STALLED)}
    if case == "as stamped":
        seen = {k: pictures[k] for k in seen}
    if case == "another lateness":
        half = 0.5 / 30
        frames = tuple(replace(f, time_s=f.time_s + half * (JUMP <= f.index < 30)) for f in late.frames)
        late = replace(late, frames=frames)
    if case == "slow":
        late = replace(late, imu=replace(late.imu, gyro_rad_s=late.imu.gyro_rad_s * 1e-3))
        seen = dict.fromkeys(seen, pictures[10])
    if case == "no clock":
        profile = replace(profile, time_offset_s=None)
    assert fit_stall(late, profile, STALLED, seen) is None
