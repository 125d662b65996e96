"""The frames of a long capture that are tracked."""

from __future__ import annotations

import numpy as np

from virest.capture.imu import ImuSamples
from virest.capture.records import Frame
from virest.inference.frame_selection import high_motion_frames


def recorded(frames: int, rate_hz: float) -> tuple[list[Frame], ImuSamples]:
    """A capture that rotates for 2 s out of every 7 s."""
    time_s = np.arange(0.0, frames / rate_hz, 0.005)
    lively = (time_s % 7.0 > 3.0) & (time_s % 7.0 < 5.0)
    gyro = np.stack([np.sin(9 * time_s), np.cos(7 * time_s), np.sin(11 * time_s)], axis=-1) * lively[:, None]
    slots = [Frame(k, k * 10**7, k / rate_hz, 0.01, 100.0) for k in range(frames)]
    return slots, ImuSamples(time_s, gyro, np.full((len(time_s), 3), np.nan))


def test_runs_cover_the_capture_and_have_high_motion() -> None:
    """From 60 s, six runs of 1.5 s are selected: one in each 10 s, where the motion is largest."""
    frames, imu = recorded(1800, 30.0)
    chosen = np.array(high_motion_frames(frames, imu, 270))
    runs = np.split(chosen, np.flatnonzero(np.diff(chosen) > 1) + 1)
    assert [len(run) for run in runs] == [45] * 6
    assert [int(run[0]) // 300 for run in runs] == [0, 1, 2, 3, 4, 5]
    assert all(2.5 < (run.mean() / 30.0) % 7.0 < 5.5 for run in runs)


def test_a_short_capture_is_tracked_completely() -> None:
    """Up to the limit every usable frame is selected."""
    frames, imu = recorded(90, 25.0)
    left_out = Frame(31, frames[31].timestamp_ns, frames[31].time_s, 0.01, 100.0, "no IMU", ("no-imu",))
    assert high_motion_frames([*frames[:31], left_out, *frames[32:]], imu, 90) == [*range(31), *range(32, 90)]
