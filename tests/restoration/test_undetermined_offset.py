"""Clocks without a determined offset: frames are not restored as if the clocks agreed."""

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
    """Six frames, which have fewer pairs than an agreement test needs."""
    recording = recorded(STILL)
    times = zip(recording.stamp_s, recording.exposure_s, strict=True)
    frames = tuple(Frame(k, k, float(t), float(e)) for k, (t, e) in enumerate(times))
    return Capture("still", Path(), Path("movie.mp4"), 96, 128, frames, recording.imu, CaptureMetadata(), "REALTIME", 0)


def gray(numbers):
    """The same picture for every frame."""
    picture = np.random.default_rng(1).integers(0, 256, (128, 96)).astype(np.uint8)
    return ((number, picture) for number in numbers)


def test_without_a_time_offset_frames_are_copied() -> None:
    """An undetermined offset is not 0: frames are copied, and the log names the calibration command."""
    unknown = replace(recorded(STILL).profile, time_offset_s=None)
    plan = plan_restoration(still_capture(), unknown, RestorationSettings(), gray)
    assert plan.copy_reason is not None
    assert "virest calibrate" in plan.copy_reason
    assert any("time offset not determined" in warning for warning in plan.warnings)


def test_an_untestable_offset_is_used_with_a_warning() -> None:
    """With fewer than eight pairs the offset cannot be checked."""
    plan = plan_restoration(still_capture(), recorded(STILL).profile, RestorationSettings(), gray)
    assert plan.copy_reason is None
    assert any(warning.startswith(UNCHECKED) for warning in plan.warnings)
