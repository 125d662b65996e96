"""A stall in the middle of a movie: frames get the times of their content if points determine them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from virest.app.simulate import simulate_command
from virest.camera.profile import CameraProfile
from virest.capture.folder import read_capture, resolve_profile
from virest.capture.records import STALL, Capture
from virest.capture.video import probe_movie, read_gray
from virest.inference.recorder_stall import at_shown_times, fit_stall, stall_window

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
