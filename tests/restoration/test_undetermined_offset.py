"""Clocks that nothing tells: frames are not restored as if they agreed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from motion.synthetic_tracks import Setup, recorded

from virest.capture.records import Capture, CaptureMetadata, Frame
from virest.restoration.capture_estimation import UNCHECKED, plan_restoration
from virest.restoration.settings import RestorationSettings

STILL = Setup(seed=3, frames=6, width=96, height=128, focal_px=100.0)


def still_capture() -> Capture:
    """Six frames: fewer pairs than an agreement needs."""
    recording = recorded(STILL)
    times = zip(recording.stamp_s, recording.exposure_s, strict=True)
    frames = tuple(Frame(k, k, float(t), float(e)) for k, (t, e) in enumerate(times))
    return Capture("still", Path(), Path("movie.mp4"), 96, 128, frames, recording.imu, CaptureMetadata(), "REALTIME", 0)


def gray(numbers):
    """The same picture again and again."""
    picture = np.random.default_rng(1).integers(0, 256, (128, 96)).astype(np.uint8)
    return ((number, picture) for number in numbers)


def test_an_undetermined_offset_restores_nothing() -> None:
    """It is not 0: frames are copied, and the log names the command that finds it."""
    unknown = replace(recorded(STILL).profile, time_offset_s=None)
    plan = plan_restoration(still_capture(), unknown, RestorationSettings(), gray)
    assert plan.copy_reason is not None
    assert "virest calibrate" in plan.copy_reason
    assert any("time offset not determined" in warning for warning in plan.warnings)


def test_a_stated_offset_that_too_few_pairs_can_test_is_used_and_the_log_says_so() -> None:
    """Fewer than eight pairs are no agreement."""
    plan = plan_restoration(still_capture(), recorded(STILL).profile, RestorationSettings(), gray)
    assert plan.copy_reason is None
    assert any(warning.startswith(UNCHECKED) for warning in plan.warnings)
