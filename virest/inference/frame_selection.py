"""Which frames of a long capture are followed: runs of neighbours where the camera turns, spread over all of it.

What tracked points tell grows with their number only until other errors remain, while the work grows on; but the
clocks' rates and whatever drifts want the whole length of a capture.  So runs are taken from every part of it, each
long enough for the accelerometer to tell the camera's path.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from virest.capture.imu import ImuSamples
from virest.capture.join import median_period_s
from virest.capture.records import Frame
from virest.inference.alignment import choose_pairs

RUN_S, MIN_RUN_FRAMES, MAX_RUN_FRAMES = 1.5, 20, 80


def high_motion_frames(
    frames: Sequence[Frame], imu: ImuSamples, max_frames: int, time_offset_s: float = 0.0
) -> list[int]:
    """Movie indices, rising: every usable frame of a short capture, lively runs of a longer one, max_frames in all."""
    usable = [frame for frame in frames if frame.skip_reason is None]
    return sorted(set(choose_pairs(frames, imu, max_frames, run_frames(usable), time_offset_s)))


def run_frames(frames: Sequence[Frame]) -> int:
    """How many frames make a run."""
    period_s = median_period_s(np.array([frame.time_s for frame in frames])) if len(frames) > 1 else None
    return int(np.clip(round(RUN_S / period_s), MIN_RUN_FRAMES, MAX_RUN_FRAMES)) if period_s else MIN_RUN_FRAMES
