"""A diagnosis with the extended profile, or the true one, finds nothing more."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from virest.app.diagnose import extended_text, open_source
from virest.app.simulate import simulate_command
from virest.camera.profile_file import read_profile
from virest.diagnosis.findings import CONSISTENT, EXPLAINED, Diagnosis
from virest.diagnosis.ladder import diagnose_capture

pytestmark = pytest.mark.scenario


def _capture(folder: Path, effects: list[str], seed: int, **options: Any) -> Path:
    simulate_command(
        folder, width=320, height=240, seed=seed, effects=effects, rate_rad_s=1.1, truth_frames=False, overwrite=True,
        **{"frames": 21, "exposure_ms": 8, **options},
    )  # fmt: skip
    return folder


def _diagnosed(folder: Path, config: Path | None = None) -> Diagnosis:
    source = open_source(folder, config)
    return diagnose_capture(source.capture, source.profile, source.pictures, source.gray)


def test_the_extended_profile_explains_the_capture(work: Path) -> None:
    """The extended profile contains the cause, and a second diagnosis uses it."""
    folder = _capture(work / "again", ["scene_depth=1.5"], 516, sway_m=0.12)
    found = _diagnosed(folder)
    assert [cause.name for cause in found.causes] == ["scene_depth"]
    assert found.verdict == EXPLAINED
    extended = work / "again.yaml"
    extended.write_text(extended_text("again", found), encoding="utf-8")
    assert open_source(folder, extended).profile.depth_m == pytest.approx(1.5, rel=0.02)
    again = _diagnosed(folder, extended)
    assert again.verdict == CONSISTENT
    assert not again.causes
    assert not again.fields


def test_the_true_profile_has_no_cause(work: Path) -> None:
    """Exposure scale, defocus and gains of the profile are not changes."""
    effects = ["exposure_time=0.7", "defocus=1.8", "gain_drift=0.05"]
    folder = _capture(work / "true_profile", effects, 522, exposure_ms=14)
    found = _diagnosed(folder, folder / "truth" / "camera.yaml")
    assert found.verdict == CONSISTENT
    assert not found.causes


def test_a_fitted_unknown_readout_is_written(work: Path) -> None:
    """It is no cause, but the extended profile states it, since the offset fitted with it depends on it."""
    source = open_source(_capture(work / "unknown_readout", [], 518))
    shutter = replace(source.profile.shutter, readout_time_s=0.0)
    given = replace(source.profile, shutter=shutter, readout_known=False, time_offset_s=None)
    found = diagnose_capture(source.capture, given, source.pictures, source.gray)
    assert found.verdict == CONSISTENT
    extended = work / "readout.yaml"
    extended.write_text(extended_text("readout", found), encoding="utf-8")
    profile = read_profile(extended)
    assert profile.readout_known
    for name, value, truth in (
        ("readout_time_s", profile.shutter.readout_time_s, 0.02),
        ("time_offset_s", profile.time_offset_s, 0.0),
    ):
        assert abs(value - truth) < 4 * profile.estimates[name].std


def test_an_open_bias_is_fitted_and_no_cause(work: Path) -> None:
    """A profile that gives it as null does not err; one that gives 0 does."""
    source = open_source(_capture(work / "open_bias", ["gyro_bias=0.02,-0.01,0.015"], 519))
    given = [source.profile, replace(source.profile, open_imu=("gyro_bias_rad_s",))]
    stated, still_open = (diagnose_capture(source.capture, one, source.pictures, source.gray) for one in given)
    assert [cause.name for cause in stated.causes] == ["gyro_bias"]
    assert still_open.verdict == CONSISTENT
    assert not still_open.causes
    extended = work / "bias.yaml"
    extended.write_text(extended_text("bias", still_open), encoding="utf-8")
    profile = read_profile(extended)
    assert profile.open_imu == ()
    off = np.subtract(profile.gyro_bias_rad_s, (0.02, -0.01, 0.015))
    assert np.all(np.abs(off) < 4 * np.array(profile.estimates["gyro_bias_rad_s"].std))
