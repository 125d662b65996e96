"""Qualities of restored frames and limits of plans that no other test covers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.camera.response import ResponseCurve
from virest.image_formation.light import FrameLight
from virest.inference.synchronisation import OffsetEstimate
from virest.restoration import capture_estimation
from virest.restoration.capture import RestorationPlan
from virest.restoration.frame import _without_flicker
from virest.restoration.settings import PRESETS
from virest.restoration.shutter import warp


def test_straightening_keeps_fine_detail() -> None:
    """At a shift of half a pixel, a wave of 5 px keeps 90 % of its contrast; linear interpolation would lose 20 %."""
    x = np.arange(120, dtype=np.float32)
    wave = np.tile(128 + 80 * np.sin(2 * np.pi * x / 5), (16, 1)).astype(np.uint8)
    source = np.stack(np.meshgrid(x + 0.5, np.arange(16, dtype=np.float32)), axis=-1).astype(np.float32)
    middle = warp(wave, source)[:, 10:-10].astype(float)
    assert np.std(middle) > 0.9 * np.std(wave[:, 10:-10].astype(float))


def test_straightened_pixels_get_the_vignetting_of_their_destination() -> None:
    """Light moved from a corner inwards gets the inner vignetting; flicker is removed."""
    curve = ResponseCurve("srgb")
    height, width = 12, 20
    recorded = np.full((height, width), 0.5, np.float32)
    kept = np.linspace(0.6, 1.0, width, dtype=np.float32)[None].repeat(height, axis=0)
    grey = int(np.rint(255 * curve.encode(0.5 * 0.3)))
    picture = np.full((height, width, 3), grey, np.uint8)
    shown = curve.linear_table()[_without_flicker(picture, curve, FrameLight(recorded, recorded, kept))][..., 1]
    expected = curve.linear_table()[grey] / 0.5 * kept
    np.testing.assert_allclose(shown, expected, rtol=0.03)


@pytest.mark.parametrize(("std_s", "copied"), [(0.001, False), (0.004, True), (2.0, True)])
def test_frames_are_copied_if_the_offset_is_too_uncertain(
    std_s: float, copied: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At 1 rad/s and 500 px, an error of 4 ms is 2 px, as much as the blur to be removed."""
    estimate = OffsetEstimate(0.02, std_s, True, explained=0.99)
    monkeypatch.setattr(capture_estimation, "estimate_time_offset", lambda *_: estimate)
    lens = Intrinsics(640, 480, 500.0, 500.0, 319.5, 239.5)
    profile = replace(CameraProfile(640, 480, intrinsics=lens), time_offset_s=None)
    plan = capture_estimation._with_estimates(RestorationPlan(profile, PRESETS["balanced"]), None, None)  # type: ignore[arg-type]
    assert (plan.copy_reason is not None) is copied
