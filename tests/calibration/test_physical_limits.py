"""Physical limits of camera parameters."""

from __future__ import annotations

from dataclasses import replace

import pytest

from virest.calibration.physical_limits import impossible, is_depth, is_global, limit_reasons
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.camera.shutter import Shutter

PERIOD_S, EXPOSURE_S = 1 / 30, 0.008
PHONE = CameraProfile(
    640, 480, intrinsics=Intrinsics(640, 480, 520, 520, 319, 239), shutter=Shutter(0.0207), time_offset_s=0.4
)


def test_an_ordinary_phone_is_within_the_limits() -> None:
    """No parameter of an ordinary camera is at its limit, even with an unknown exposure."""
    assert not impossible(PHONE, PERIOD_S, EXPOSURE_S)
    assert not impossible(PHONE, PERIOD_S, 0.0)


@pytest.mark.parametrize("readout_s", [2.9e-4, -2.9e-4, 0.0334, 0.06])
def test_implausible_readout_times_are_impossible(readout_s: float) -> None:
    """A rolling shutter takes between 1 ms and a frame period; a global shutter takes 0."""
    shutter = replace(PHONE.shutter, readout_time_s=readout_s)
    assert impossible(replace(PHONE, shutter=shutter), PERIOD_S, EXPOSURE_S) == {"readout_time"}


@pytest.mark.parametrize("readout_s", [0.0, 6e-5, -6e-5])
def test_a_global_shutter_is_within_the_limits(readout_s: float) -> None:
    """A readout time of 0, or fitted close to 0, is not an implausible rolling shutter."""
    profile = replace(PHONE, shutter=replace(PHONE.shutter, readout_time_s=readout_s))
    assert not impossible(profile, PERIOD_S, EXPOSURE_S)
    assert not limit_reasons(profile, PERIOD_S, EXPOSURE_S)


def test_a_readout_is_zero_within_its_deviation() -> None:
    """The limit is three deviations, unless a rolling shutter lies within them too."""
    assert is_global(0.0)
    assert is_global(-2.9e-4, 1e-4)
    assert not is_global(2.9e-4, 5e-5)
    assert not is_global(0.0, 4e-4)
    assert not is_global(0.0207, 1e-5)


@pytest.mark.parametrize("scale", [0.05, 4.5, 20.0])
def test_an_exposure_must_fit_into_its_frame(scale: float) -> None:
    """An exposure of 36 ms in a frame period of 33 ms is impossible, as is a value at the limit of the fit."""
    shutter = replace(PHONE.shutter, exposure_scale=scale)
    assert impossible(replace(PHONE, shutter=shutter), PERIOD_S, EXPOSURE_S) == {"exposure_time"}


@pytest.mark.parametrize("focal_px", [190.0, 7000.0])
def test_a_focal_length_must_match_the_sensor(focal_px: float) -> None:
    """Neither 190 px nor 7000 px is a plausible focal length for a width of 640 px."""
    lens = Intrinsics(640, 480, focal_px, focal_px, 319, 239)
    assert impossible(replace(PHONE, intrinsics=lens), PERIOD_S, EXPOSURE_S) == {"focal_length"}


def test_a_scene_depth_must_be_plausible() -> None:
    """A depth lies neither inside the lens nor at the end of the fit's range."""
    assert [is_depth(depth) for depth in (0.02, 0.5, 1e4)] == [False, True, False]


def test_reasons_name_the_value_found() -> None:
    """Each value at or beyond its limits has a reason; a phone has none."""
    assert not limit_reasons(PHONE, PERIOD_S, EXPOSURE_S)
    lens = Intrinsics(640, 480, 190, 190, 319, 239)
    shutter = replace(PHONE.shutter, readout_time_s=2.9e-4)
    odd = replace(PHONE, intrinsics=lens, shutter=shutter, gyro_scale=(1.0, 0.7, 1.0), clock_skew=-0.03)
    reasons = limit_reasons(odd, PERIOD_S, EXPOSURE_S)
    assert set(reasons) == {"focal_length", "readout_time", "gyro_scale", "clock_skew"}
    assert "190 px" in reasons["focal_length"]
    assert "0.29 ms" in reasons["readout_time"]
    assert "0.700" in reasons["gyro_scale"]
