"""The frames of a long capture to track: runs of consecutive frames with rotation, spread over the whole capture.

More points help only until other errors dominate, while their cost keeps growing.  Clock rates and drifts, however,
need the full length of a capture.  So runs are taken from every part of it, each long enough for the accelerometer to
determine the camera's path.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from virest.arrays import Array
from virest.capture.imu import ImuSamples
from virest.capture.join import median_period_s
from virest.capture.records import Frame

RUN_S, MIN_RUN_FRAMES, MAX_RUN_FRAMES = 1.5, 20, 80
"""Length of a run, and its bounds at low and high frame rates."""


def high_motion_frames(
    frames: Sequence[Frame], imu: ImuSamples, max_frames: int, time_offset_s: float = 0.0
) -> list[int]:
    """Movie indices, ascending: all usable frames of a short capture, else high-motion runs, max_frames in all."""
    usable = [frame for frame in frames if frame.skip_reason is None]
    return sorted(set(choose_pairs(frames, imu, max_frames, run_frames(usable), time_offset_s)))


def run_frames(frames: Sequence[Frame]) -> int:
    """Number of frames in a run."""
    period_s = median_period_s(np.array([frame.time_s for frame in frames])) if len(frames) > 1 else None
    return int(np.clip(round(RUN_S / period_s), MIN_RUN_FRAMES, MAX_RUN_FRAMES)) if period_s else MIN_RUN_FRAMES


def choose_pairs(
    frames: Sequence[Frame], imu: ImuSamples, max_frames: int = 60, run_frames: int = 10, time_offset_s: float = 0.0
) -> list[int]:
    """Movie indices of the frames to decode and track: runs of consecutive usable frames, spread over the capture.

    The capture is divided into equal parts.  Each gives its run of highest motion (rms of the rate about its mean,
    limited to three times the capture's median so that blurred frames do not displace all others).
    """
    usable = [frame for frame in frames if frame.skip_reason is None]
    if len(usable) <= max_frames:
        return [frame.index for frame in usable]
    runs_wanted = max(max_frames // run_frames, 1)
    motion = _motion_power(usable, imu, time_offset_s)
    chosen: list[int] = []
    for part in np.array_split(np.arange(len(usable)), runs_wanted):
        starts = [i for i in part[: max(len(part) - run_frames + 1, 1)] if _unbroken(usable, int(i), run_frames)]
        if starts:
            best = max(starts, key=lambda i: motion[i : i + run_frames].mean())
            chosen += [frame.index for frame in usable[best : best + run_frames]]
    return chosen or [frame.index for frame in usable[:max_frames]]


def _motion_power(frames: Sequence[Frame], imu: ImuSamples, time_offset_s: float) -> Array:
    power = ((imu.gyro_rad_s - imu.gyro_rad_s.mean(axis=0)) ** 2).sum(axis=1)
    at_frames = np.interp([frame.time_s + time_offset_s for frame in frames], imu.time_s, power)
    smooth = np.convolve(at_frames, np.full(5, 0.2), mode="same")
    return np.minimum(smooth, 9.0 * np.median(smooth))


def _unbroken(frames: Sequence[Frame], start: int, length: int) -> bool:
    run = frames[start : start + length]
    return len(run) == length and run[-1].index - run[0].index == length - 1
