"""Calibrating captures unlike a phone's, or with a profile far from the truth."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnosis.strange_phone import Strange, StrangePhone
from motion.synthetic_tracks import Setup

from virest.app.calibrate import find_calibration, plan_calibration
from virest.app.simulate import simulate_command
from virest.calibration.geometry import _divides_movie, _is_significant, calibrate_geometry
from virest.camera.profile import CameraProfile
from virest.camera.profile_file import read_profile, write_profile
from virest.capture.video import GrayReader, probe_movie
from virest.errors import CalibrationError
from virest.inference.guide_choice import track_guided
from virest.inference.tracking import Guide, TrackPair, track_frames

LARGEST_SIGMA = 4.0
SIZE = {"width": 320, "height": 240, "frames": 45, "exposure_ms": 6.0, "rate_rad_s": 1.2, "truth_frames": False}
OFFSET_S = 0.012


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Simulate a capture once for all tests of this module: ``capture("name", readout_ms=0)`` returns its folder."""
    root = tmp_path_factory.mktemp("awkward")

    def made(name: str, *effects: str, **options: Any) -> Path:
        if not (root / name).is_dir():
            simulate_command(root / name, effects=[f"time_offset={OFFSET_S}", *effects], **{**SIZE, **options})
        return root / name

    return made


def calibrated(folder: Path, *extra: str, config: Path | None = None) -> tuple[dict[str, Any], CameraProfile]:
    """(mapping for ``--json``, calibrated profile)."""
    facts, found, _ = find_calibration(plan_calibration(folder, config, extra))
    return facts, found.profile


def value_of(facts: dict[str, Any], name: str) -> dict[str, Any]:
    """The value with this name."""
    return next(dict(value) for value in facts["values"] if value["name"] == name)


def test_tracking_with_equal_blur_improves_the_readout_time(capture: Callable[..., Path]) -> None:
    """The error is less than half, and the tracking noise less than 80 %, of that without equalised blur."""
    options = {"exposure_ms": 10.0, "rate_rad_s": 1.0, "scene": "board", "seed": 54, "frames": 60, "depth_m": 2.0}
    plan = plan_calibration(capture("blurred", **options))
    gray = GrayReader.of(plan.capture.movie)
    pairs = track_guided(plan.capture, plan.profile, gray, plan.frames)
    guides: list[Guide] = []

    def track_again(guide: Guide) -> list[TrackPair]:
        guides.append(guide)
        return track_frames(gray, plan.frames, guide=guide)

    once, twice = (
        calibrate_geometry(plan.capture, plan.profile, pairs, ("focal",), None, again) for again in (None, track_again)
    )
    assert len(guides) == 1
    off_s = [abs(found.profile.shutter.readout_time_s - 0.02) for found in (once, twice)]
    assert twice.noise_px < 0.8 * once.noise_px
    assert off_s[1] < 0.5 * off_s[0]


def test_a_second_tracking_without_points_changes_nothing(capture: Callable[..., Path]) -> None:
    """The first tracking is used."""
    plan = plan_calibration(capture("alone", seed=55))
    pairs = track_guided(plan.capture, plan.profile, GrayReader.of(plan.capture.movie), plan.frames)
    once, again = (
        calibrate_geometry(plan.capture, plan.profile, pairs, track_again=none) for none in (None, lambda _guide: [])
    )
    assert again.profile == once.profile


def test_a_global_shutter_is_found(capture: Callable[..., Path]) -> None:
    """Starting from 20 ms of readout, the result is 0 without direction, and the offset is right."""
    facts, profile = calibrated(capture("wrong", "readout_time=0", seed=52))
    readout, offset = value_of(facts, "readout_time_s"), value_of(facts, "time_offset_s")
    assert facts["verdict"] == "calibrated"
    assert (readout["value"], readout["determined"]) == (0.0, True)
    assert 0 < readout["std"] < 3e-4
    assert "readout_direction" not in {value["name"] for value in facts["values"]}
    assert abs(offset["value"] - OFFSET_S) < LARGEST_SIGMA * offset["std"]
    assert (profile.shutter.readout_time_s, profile.time_offset_s) == (0.0, offset["value"])
    assert "readout_direction" not in profile.estimates
    assert not [note for note in facts["notes"] if "implausible" in note]


def without_accelerometer(folder: Path, out: Path) -> Path:
    """A copy of a capture whose log has no accelerometer values."""
    shutil.copytree(folder, out)
    log = out / "gyro_accel.csv"
    head, *rows = (line.split(",") for line in log.read_text().splitlines())
    emptied = [[*row[:4], "null", "null", "null", *row[7:]] for row in rows]
    log.write_text("\n".join(",".join(row) for row in [head, *emptied]) + "\n")
    return out


def test_translation_without_an_accelerometer_widens_the_deviations(
    capture: Callable[..., Path], tmp_path: Path
) -> None:
    """Near a wall, yaw and pitch look like translation; the standard deviations of axes and bias account for it."""
    folder = without_accelerometer(capture("wall", depth_m=1.5, seed=73), tmp_path / "gyro-only")
    facts, profile = calibrated(folder)
    assert facts["translation"] == "direction"
    for name, true in (("rotation_rad", 0.0), ("gyro_bias_rad_s", 0.0), ("readout_time_s", 0.02)):
        value = value_of(facts, name)
        error = np.abs(np.subtract(value["value"], true))
        assert (error < LARGEST_SIGMA * np.array(value["std"])).all(), name
    assert np.abs(profile.gyro_bias_rad_s).max() < 0.006


def wrong_focal(folder: Path, out: Path, factor: float) -> Path:
    """A profile of the capture with another focal length."""
    profile = read_profile(folder / "camera.yaml")
    assert profile.intrinsics is not None
    write_profile(replace(profile, intrinsics=profile.intrinsics.scaled_focal(factor)), out)
    return out


@pytest.mark.parametrize("factor", [0.5, 1.8])
def test_a_focal_length_far_off_is_found(capture: Callable[..., Path], tmp_path: Path, factor: float) -> None:
    """Calibration works even if the frames do not seem to follow the gyroscope at the given focal length."""
    folder = capture("plain", seed=53)
    facts, _ = calibrated(folder, "focal", config=wrong_focal(folder, tmp_path / "wrong.yaml", factor))
    focal, offset = value_of(facts, "fx_px"), value_of(facts, "time_offset_s")
    assert facts["verdict"] == "calibrated"
    assert focal["start"] == pytest.approx(256 * factor)
    assert abs(focal["value"] - 256) < LARGEST_SIGMA * focal["std"]
    assert abs(offset["value"] - OFFSET_S) < LARGEST_SIGMA * offset["std"]


def test_a_wrong_focal_length_is_named_in_the_error(capture: Callable[..., Path], tmp_path: Path) -> None:
    """The hint names the option to pass and the focal length ratio that would explain the motion."""
    folder = capture("plain", seed=53)
    with pytest.raises(CalibrationError, match="do not follow") as refused:
        calibrated(folder, config=wrong_focal(folder, tmp_path / "wrong.yaml", 1.8))
    assert "--with focal" in str(refused.value.hint)
    assert "0.5" in str(refused.value.hint)


def test_drifting_clocks_are_fitted_without_a_request(capture: Callable[..., Path]) -> None:
    """A fit that starts with a constant offset ends where one with a clock skew from the start does."""
    plan = plan_calibration(capture("drifting", "clock_skew=0.002", seed=54))
    gray = GrayReader(plan.capture.movie, probe_movie(plan.capture.movie))
    pairs = track_guided(plan.capture, plan.profile, gray, plan.frames)
    unasked, asked = (calibrate_geometry(plan.capture, plan.profile, pairs, extra) for extra in ((), ("clock-skew",)))
    assert "fitted too" in unasked.notes[0]
    for one, other in zip(unasked.values, asked.values, strict=True):
        assert (one.name, one.determined) == (other.name, other.determined)
        if one.std is not None:
            assert (np.abs(np.subtract(one.value, other.value)) < 0.1 * np.array(one.std)).all(), one.name
            np.testing.assert_allclose(one.std, other.std, rtol=0.05)


@pytest.mark.parametrize(("blocks", "significant"), [(2.5, False), (12.0, True)])
def test_a_drift_seen_in_few_time_blocks_needs_more_deviations(blocks: float, significant: bool) -> None:
    """7 σ would be certain for a normal distribution, but is common for Student's t with 1.5 degrees of freedom."""
    skew = SimpleNamespace(name="clock_skew", std=0.0005)
    fit = SimpleNamespace(stretches=np.array([blocks]), slices={"clock_skew": slice(0, 1)})
    found: Any = SimpleNamespace(fit=fit, values=(skew,), profile=SimpleNamespace(clock_skew=0.0035))
    assert _is_significant(found, 0.0) == significant


def test_a_wide_lens_is_found_while_the_camera_sways_before_a_wall() -> None:
    """Translation alone cannot replace the lens: a fit of it would end at a wrong offset and stay there."""
    setup = Setup(
        seed=5, frames=61, points=40, width=640, height=480, focal_px=440.0, centre_px=(319.5, 239.5), k1=-0.22,
        k2=0.07, plane_per_m=(0.0, 0.0, 0.33), sway_m=0.03, rate_rad_s=0.9, readout_direction="top_to_bottom",
        exposure_swing=0.0, noise_px=0.06,
    )  # fmt: skip
    phone = StrangePhone(setup, Strange())
    lens = phone.profile.intrinsics
    assert lens is not None
    plain = replace(phone.profile, intrinsics=replace(lens, model="none", coefficients=()), depth_m=None)
    found = calibrate_geometry(phone.capture, plain, phone.pairs, ("distortion", "higher-distortion"))
    assert found.profile.intrinsics is not None
    assert found.profile.intrinsics.coefficients[:2] == pytest.approx((-0.22, 0.07), abs=0.004)
    assert found.profile.time_offset_s == pytest.approx(setup.time_offset_s, abs=2e-4)
    assert found.residual_px < 1.2 * setup.noise_px


def _filled(time_s: np.ndarray, rate: np.ndarray, _force: np.ndarray) -> np.ndarray:
    """A log whose gap from 1 s to 1.13 s was filled with straight lines."""
    inside = (time_s > 1.0) & (time_s < 1.13)
    filled = rate.copy()
    ends_s = [time_s[~inside & (time_s <= 1.0)][-1], time_s[~inside & (time_s >= 1.13)][0]]
    for axis in range(3):
        filled[inside, axis] = np.interp(time_s[inside], ends_s, np.interp(ends_s, time_s, rate[:, axis]))
    return filled


def _clipped(_time_s: np.ndarray, rate: np.ndarray, _force: np.ndarray) -> np.ndarray:
    return np.clip(rate, -0.75, 0.75)


def test_only_a_stretch_between_frames_makes_gravity_uncertain() -> None:
    """The accelerometer is used where all frames were taken after the stretch, by clocks that are known."""
    phone = StrangePhone(Setup(seed=93, frames=75, rate_rad_s=0.9), Strange(gyro=_filled))
    later = replace(phone.capture, frames=phone.capture.frames[45:])
    assert _divides_movie(phone.capture, phone.profile)
    assert not _divides_movie(later, phone.profile)
    assert _divides_movie(later, replace(phone.profile, time_offset_s=None))


@pytest.mark.parametrize(("log", "named"), [(_clipped, "clipped"), (_filled, "interpolated")])
def test_wrong_stretches_of_the_log_do_not_bias_the_calibration(log: Any, named: str) -> None:
    """Their pairs and the path from the accelerometer are not used, a note says so, and no field is left behind."""
    setup = Setup(
        seed=93, frames=75, width=480, height=360, points=70, focal_px=400.0, rate_rad_s=0.9, noise_px=0.06,
        plane_per_m=(0.0, 0.0, 0.33), sway_m=0.03, readout_direction="top_to_bottom", exposure_swing=0.0,
    )  # fmt: skip
    phone = StrangePhone(setup, Strange(gyro=log))
    plain = replace(phone.profile, time_offset_s=0.0, gyro_bias_rad_s=(0.0, 0.0, 0.0), depth_m=None)
    found = calibrate_geometry(phone.capture, plain, phone.pairs)
    assert any(named in note for note in found.notes)
    assert not found.profile.fields
    truth = {
        "time_offset_s": setup.time_offset_s,
        "readout_time_s": phone.profile.shutter.readout_time_s,
        "gyro_bias_rad_s": setup.gyro_bias_rad_s,
    }
    values = {value.name: value for value in found.values if value.name in truth}
    assert values.keys() == truth.keys()
    for name, value in values.items():
        assert value.determined or name == "gyro_bias_rad_s"
        assert np.all(np.abs(np.subtract(value.value, truth[name])) < LARGEST_SIGMA * np.array(value.std))
