"""Start-up content lag: while the recorder starts, frames show later content than their timestamps.

Timestamps queue up while the encoder starts and are then paired with whatever picture is current; exact repeats of
pictures use up the queue.  There are two kinds of evidence: the Unix columns (the capture-to-encoder delay falls to its
steady value), and frames that repeat although the phone rotates.  Repeats of a phone at rest do not count.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.capture.join import consecutive_runs

LOOK_S = 2.0
"""In every capture examined the queue was empty by then."""
REPEAT_MAX_DIFFERENCE = 0.6
"""Grey levels; a repeat coded by H.264 differs by 0.31–0.36, a frame of a moving phone by 2 or more."""
REPEAT_MAX_SHARE = 0.25
"""Largest difference of a repeat relative to the median difference of its neighbours."""
NEIGHBOURS = 5
"""On each side, about a third of a second in all."""
MIN_MOTION_PX = 0.5
"""With less predicted motion between two frames, pictures may be alike without being repeats."""
MOTION_WINDOW_S = (-0.05, 0.45)
"""Range of a picture's true time relative to its timestamp."""
STEADY_PERCENTILE = 5.0
"""Of the delays: nearly the smallest, without its outliers."""
MIN_LAGS = 5
"""Fewer delays have no reliable percentile."""
SUSPECT_SIZE = 0.75
"""A coded frame below this fraction of its neighbours' median size may be a repeat; repeats of honor_v10 have 0.35 to
0.65 of it."""
MOST_SUSPECTS = 24
"""Most frames after the start-up to decode, smallest first, so that the cost does not grow with the movie."""
MOST_STALLED = 0.25
"""If a larger fraction of the frames leaves the encoder late, that is its normal operation and not a stall."""
REPEATS_APART = 6
"""Repeats that use up a lag are at most this many frames apart, the first at most as many after the stall's start."""
SETTLED_FRAMES = 10
"""Frames without repeats that end the start-up; repeats are at most six frames apart."""


@dataclass(frozen=True, slots=True)
class Startup:
    """Evidence of the recorder lag."""

    frames: int = 0
    """Number of leading frames whose content is, or may be, later than their timestamps."""
    lag_s: float | None = None
    """Smallest lag of frame 0 that explains the evidence; None without a lag."""
    repeats: tuple[int, ...] = ()
    """Frames that repeat their predecessor."""
    stalls: tuple[tuple[int, int], ...] = ()
    """(first, last) frame of each later run whose content may be later than its timestamps."""
    unix_lag_s: tuple[float, float] | None = None
    """Delay from capture to encoder output at the first frame and in steady state; None: no Unix columns."""


def picture_differences(pictures: list[NDArray[np.uint8] | None]) -> Array:
    """(n,) mean absolute difference of each picture to its predecessor, grey levels; NaN if either is missing."""
    differences = np.full(len(pictures), np.nan)
    for i in range(1, len(pictures)):
        before, here = pictures[i - 1], pictures[i]
        if before is not None and here is not None:
            differences[i] = cv2.absdiff(before, here).mean()
    return differences


def find_repeats(differences: Array, motion_px: Array) -> tuple[int, ...]:
    """Frames that repeat their predecessor although the phone rotated.

    differences: (n,) of :func:`picture_differences`; motion_px: (n,) of :func:`expected_motion_px`.
    """
    found = []
    for i in np.flatnonzero(differences < REPEAT_MAX_DIFFERENCE):
        near = differences[max(i - NEIGHBOURS, 1) : i + NEIGHBOURS + 1]
        usual = np.nanmedian(near)
        if differences[i] < REPEAT_MAX_SHARE * usual and motion_px[i] > MIN_MOTION_PX:
            found.append(int(i))
    return tuple(found)


def expected_motion_px(
    frame_time_s: Array,
    imu_time_s: Array,
    gyro_rad_s: Array,
    focal_px: float,
    period_s: float,
) -> Array:
    """(n,) motion of the picture's centre, px per frame, from the phone's mean rotation rate around each frame."""
    speed = np.linalg.norm(gyro_rad_s[:, :2], axis=1)
    total = np.concatenate([[0.0], np.cumsum(speed)])
    first = np.searchsorted(imu_time_s, frame_time_s + MOTION_WINDOW_S[0])
    last = np.searchsorted(imu_time_s, frame_time_s + MOTION_WINDOW_S[1])
    mean = (total[last] - total[first]) / np.maximum(last - first, 1)
    return mean * focal_px * period_s


def suspects(packet_bytes: NDArray[np.int64], keyframes: tuple[int, ...], first: int) -> list[int]:
    """Frames from ``first`` on that are coded so small that they may repeat their predecessor, in rising order."""
    if len(packet_bytes) - first < 2 * NEIGHBOURS:
        return []
    size = packet_bytes.astype(float)
    size[list(keyframes)] = np.nan
    padded = np.pad(size, NEIGHBOURS, constant_values=np.nan)
    usual = np.nanmedian(np.lib.stride_tricks.sliding_window_view(padded, 2 * NEIGHBOURS + 1), axis=1)
    part = size / usual
    part[:first] = np.nan
    found = np.flatnonzero(part < SUSPECT_SIZE)
    return sorted(found[np.argsort(part[found], kind="stable")][:MOST_SUSPECTS].tolist())


def find_stalls(
    repeats: tuple[int, ...], unix_lag_s: Array | None, first: int, period_s: float
) -> tuple[tuple[int, int], ...]:
    """(first, last) of the runs of frames from ``first`` on that may show later content than their timestamps.

    An encoder that resumes after a pause takes the current picture, and repeats use up the lag: a run extends from
    REPEATS_APART frames before a repeat to the last repeat.  Unix columns: the delay from capture to encoder output
    exceeds its median by more than two periods.
    """
    late: set[int] = set()
    for repeat in repeats:
        late |= set(range(max(repeat - REPEATS_APART, first), repeat + 1))
    if unix_lag_s is not None and np.isfinite(unix_lag_s[first:]).sum() >= MIN_LAGS:
        steady = float(np.nanpercentile(unix_lag_s[first:], 50))
        above = np.flatnonzero(unix_lag_s[first:] > steady + 2 * period_s)
        late |= {first + int(k) for k in above} if len(above) < MOST_STALLED * (len(unix_lag_s) - first) else set()
    return tuple(consecutive_runs(late))


def judge_startup(unix_lag_s: Array | None, repeats: tuple[int, ...], frame_count: int, period_s: float) -> Startup:
    """Combine both kinds of evidence.

    unix_lag_s: (n,) encoder output − capture result of each frame, NaN where unknown; None without Unix columns.
    """
    first, steady, late = _unix_witness(unix_lag_s, period_s)
    frames = max(late, repeats[-1] + 1 if repeats else 0)
    if frames and frame_count - frames < SETTLED_FRAMES:
        frames = frame_count
    shown = None if first is None or steady is None else (first, steady)
    if not frames:
        return Startup(unix_lag_s=shown)
    fallen = first - steady if first is not None and steady is not None and late else 0.0
    return Startup(frames, max(fallen, len(repeats) * period_s), repeats, unix_lag_s=shown)


def _unix_witness(lag_s: Array | None, period_s: float) -> tuple[float | None, float | None, int]:
    """(lag of the first frame, steady lag, number of leading frames above the steady lag by more than a period)."""
    if lag_s is None or np.isfinite(lag_s).sum() < MIN_LAGS:
        return None, None, 0
    finite = lag_s[np.isfinite(lag_s)]
    steady = float(np.percentile(finite, STEADY_PERCENTILE))
    # not <=: a frame without metadata (NaN) does not end the run
    settled = np.flatnonzero(lag_s <= steady + period_s)
    return float(finite[0]), steady, int(settled[0]) if len(settled) else len(lag_s)
