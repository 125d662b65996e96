"""``virest calibrate`` as users see it: tables, JSON, files and exit codes."""

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from virest.app import calibrate as command
from virest.app.calibrate import CalibrationOutput, describe, plan_calibration, run_calibration, unknown_extra
from virest.app.cli.calibrate import CALIBRATED_EXTRAS
from virest.app.outputs import json_line
from virest.app.simulate import simulate_command
from virest.camera.profile import CameraProfile
from virest.camera.profile_file import read_profile, write_profile
from virest.capture.folder import read_capture
from virest.capture.profile_source import read_any_profile
from virest.errors import CalibrationError, OutputError
from virest.inference import frame_selection, tracking

Virest = Callable[..., "subprocess.CompletedProcess[str]"]
OFFSET_S, READOUT_S, ROTATION, BIAS = 0.031, 0.0236, (0.012, -0.017, 0.021), (0.018, -0.011, 0.006)
HIDDEN = [
    f"time_offset={OFFSET_S}",
    f"readout_time={READOUT_S}",
    "imu_rotation={},{},{}".format(*ROTATION),
    "gyro_bias={},{},{}".format(*BIAS),
]
TRUTH = {"time_offset_s": OFFSET_S, "readout_time_s": READOUT_S, "rotation_rad": ROTATION, "gyro_bias_rad_s": BIAS}
UNITS = {"time_offset_s": 2e-3, "readout_time_s": 2e-3, "rotation_rad": 6e-3, "gyro_bias_rad_s": 6e-3}
"""Upper limit of each error, whatever its standard deviation."""


@pytest.fixture(scope="session")
def _shaken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("calibrated") / "shaken"
    simulate_command(folder, width=320, height=240, frames=60, exposure_ms=6, rate_rad_s=1.3, readout_ms=18,
                     effects=HIDDEN, crf=18, seed=41, truth_frames=False)  # fmt: skip
    return folder


@pytest.fixture
def shaken(_shaken: Path, tmp_path: Path) -> Path:
    """Two seconds of a shaken camera with hidden offset, readout time, axes and bias; the test may damage it."""
    return Path(shutil.copytree(_shaken, tmp_path / "shaken", ignore=shutil.ignore_patterns("truth")))


@pytest.fixture(scope="session")
def done(_shaken: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any], str]:
    """One calibration of this capture that several tests share: (folder written to, JSON mapping, text)."""
    folder = tmp_path_factory.mktemp("results")
    output = CalibrationOutput(folder / "camera.yaml", folder / "kalibr")
    return folder, *run_calibration(plan_calibration(_shaken), output)


def start_profile(capture: Path, **changes: Any) -> CameraProfile:
    """Read the capture's own profile after changing some keys of its YAML, given as ``section__key``."""
    content = yaml.safe_load((capture / "camera.yaml").read_text())
    for name, value in changes.items():
        section, key = name.split("__")
        content[section][key] = value
    (capture / "camera.yaml").write_text(yaml.safe_dump(content))
    return read_profile(capture / "camera.yaml")


def value_of(facts: dict[str, Any], name: str) -> dict[str, Any]:
    """One entry of ``values``."""
    return next(value for value in facts["values"] if value["name"] == name)


def assert_recovered(facts: dict[str, Any]) -> None:
    """Every hidden value lies within four standard deviations and within an absolute limit."""
    for name, truth in TRUTH.items():
        found = value_of(facts, name)
        error = np.abs(np.array(found["value"]) - truth)
        assert found["determined"], name
        assert (error < 4 * np.array(found["std"])).all(), (name, found)
        assert (error < UNITS[name]).all(), (name, found)


def assert_refused(result: "subprocess.CompletedProcess[str]", code: int, *says: str) -> None:
    """Standard error has one error line, the exit code is right, and standard output is empty."""
    errors = [line for line in result.stderr.splitlines() if line.startswith("virest: error: ")]
    assert result.returncode == code, result.stderr
    assert len(errors) == 1, result.stderr
    assert "Traceback" not in result.stderr
    assert result.stdout == ""
    for text in says:
        assert text in errors[0]


def test_hidden_values_are_recovered(done: tuple[Path, dict[str, Any], str]) -> None:
    """Offset, readout time, axes and bias match the truth; the residual is close to the tracking noise."""
    _, facts, _ = done
    assert_recovered(facts)
    assert value_of(facts, "readout_direction")["value"] == "top_to_bottom"
    assert facts["verdict"] == "calibrated"
    assert facts["residual_px"] < 1.5 * facts["noise_px"] < facts["before_px"]


def test_the_program_prints_one_json_object_and_writes_the_profile(virest: Virest, shaken: Path) -> None:
    """``--json`` prints one object with every key; its profile matches the written file; nothing else is written."""
    result = virest("calibrate", "shaken", "--json", "--out", "found.yaml", cwd=shaken.parent)
    assert result.returncode == 0, result.stderr
    facts = json.loads(result.stdout)
    assert_recovered(facts)
    assert {"capture", "values", "not_determined", "correlations", "translation", "residual_px", "before_px",
            "noise_px", "moving_fraction", "notes", "verdict", "profile", "written", "imu"} <= set(facts)  # fmt: skip
    assert facts["written"] == ["found.yaml"]
    assert sorted(p.name for p in shaken.parent.iterdir()) == ["found.yaml", "shaken"]
    profile = read_profile(shaken.parent / "found.yaml")
    assert facts["profile"]["imu"]["time_offset_s"] == pytest.approx(profile.time_offset_s, rel=1e-9)
    assert set(profile.estimates) >= {*TRUTH, "readout_direction"}


def test_two_processes_give_the_same_values_as_one(
    virest_here: Virest, shaken: Path, done: tuple[Path, dict[str, Any], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Dividing the work over the available cores does not change a digit of the result."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    monkeypatch.setattr(tracking, "PART_FRAMES", 30)
    result = virest_here("calibrate", shaken, "--json", "--out", "found.yaml")
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["values"] == json.loads(json_line(done[1]))["values"]


def test_the_written_profile_reads_back_with_its_estimates(done: tuple[Path, dict[str, Any], str]) -> None:
    """Numbers, lists and words in ``estimates`` survive the file, and writing the profile again changes nothing."""
    folder, facts, _ = done
    profile = read_profile(folder / "camera.yaml")
    assert profile.estimates["readout_direction"].value == "top_to_bottom"
    for name in TRUTH:
        found, written = value_of(facts, name), profile.estimates[name]
        assert (written.value, written.std) == (found["value"], found["std"])
        assert written.source
    write_profile(profile, folder / "again.yaml")
    again = read_profile(folder / "again.yaml")
    # reading a rotation orthogonalises it, which changes its last digit
    np.testing.assert_allclose(again.rotation_cam_imu, profile.rotation_cam_imu, atol=1e-14)
    assert replace(again, r_cam_imu=profile.r_cam_imu) == profile


def test_the_text_output_is_a_table(done: tuple[Path, dict[str, Any], str]) -> None:
    """Each value and each component of a list has a row; residuals, translation and written files follow."""
    folder, facts, text = done
    lines = text.splitlines()
    assert lines[0] == "shaken: calibrated"
    rows = {line.split()[0]: line.split() for line in lines[2:]}
    assert rows["time_offset_s"][4] == "yes"
    assert float(rows["gyro_bias_rad_s[1]"][2]) == pytest.approx(
        facts["profile"]["imu"]["gyro_bias_rad_s"][1], abs=1e-3
    )
    assert any(line.startswith("residual ") and " -> " in line for line in lines)
    assert any(line.startswith("camera translation: ") for line in lines)
    assert lines[-1] == f"wrote {folder / 'kalibr' / 'imu.yaml'}"


def test_an_undetermined_value_is_reported_and_kept(done: tuple[Path, dict[str, Any], str]) -> None:
    """The table shows no calibrated number for an undetermined value; correlated values are named."""
    _, facts, _ = done
    open_value = {"name": "fx_px", "start": 500.0, "value": 500.0, "std": 44.0, "determined": False, "note": ""}
    pair = {"first": "fx_px", "second": "gyro_scale", "correlation": -0.97}
    text = describe({**facts, "values": [open_value], "not_determined": ["fx_px"], "correlations": [pair]})
    assert next(line for line in text.splitlines() if line.startswith("fx_px")).split() == [
        "fx_px",
        "500",
        "–",
        "44",
        "no",
    ]
    assert "kept at the starting value: fx_px" in text
    assert "fx_px and gyro_scale are correlated: -0.97" in text


def test_the_kalibr_files_describe_the_same_camera(done: tuple[Path, dict[str, Any], str]) -> None:
    """The camera chain reads back as the same camera; imu.yaml holds the capture's noise."""
    folder, _, _ = done
    ours, chain = read_profile(folder / "camera.yaml"), read_any_profile(folder / "kalibr" / "camchain-imucam.yaml")
    assert chain.intrinsics == ours.intrinsics
    assert chain.shutter.readout_time_s == pytest.approx(ours.shutter.readout_time_s)
    assert chain.time_offset_s == ours.time_offset_s
    np.testing.assert_allclose(chain.rotation_cam_imu, ours.rotation_cam_imu, atol=1e-12)
    noise = yaml.safe_load((folder / "kalibr" / "imu.yaml").read_text())
    assert noise["update_rate"] == pytest.approx(200, rel=1e-3)
    assert noise["gyroscope_noise_density"] == pytest.approx(0.0015 / np.sqrt(200), rel=0.25)
    assert noise["accelerometer_noise_density"] == pytest.approx(0.02 / np.sqrt(200), rel=0.25)


def test_a_null_offset_is_estimated(shaken: Path, tmp_path: Path) -> None:
    """A profile with neither offset nor readout time gets both."""
    start_profile(shaken, imu__time_offset_s=None, shutter__readout_time_s=None)
    facts, text = run_calibration(plan_calibration(shaken), CalibrationOutput(tmp_path / "c.yaml"))
    assert value_of(facts, "time_offset_s")["start"] is None
    assert "unknown" in text
    assert abs(facts["profile"]["imu"]["time_offset_s"] - OFFSET_S) < UNITS["time_offset_s"]
    assert abs(facts["profile"]["shutter"]["readout_time_s"] - READOUT_S) < UNITS["readout_time_s"]


def test_config_overrides_the_capture_s_own_profile(shaken: Path, tmp_path: Path) -> None:
    """Starting values come from ``--config``.

    Here an offset of 300 ms and another focal length, which is calibrated too.
    """
    content = yaml.safe_load((shaken / "camera.yaml").read_text())
    true_px = content["intrinsics"]["fx_px"]
    content["imu"]["time_offset_s"], content["intrinsics"]["fx_px"], content["intrinsics"]["fy_px"] = 0.3, 270.0, 270.0
    (tmp_path / "other.yaml").write_text(yaml.safe_dump(content))
    plan = plan_calibration(shaken, tmp_path / "other.yaml", ("focal",))
    facts, _ = run_calibration(plan, CalibrationOutput(tmp_path / "c.yaml"))
    assert facts["profile_source"].endswith("other.yaml")
    assert value_of(facts, "time_offset_s")["start"] == 0.3
    focal = value_of(facts, "fx_px")
    assert abs(focal["value"] - true_px) < max(4 * focal["std"], 0.005 * true_px)
    assert_recovered(facts)


def test_a_focal_length_that_absorbs_a_gyroscope_scale_error_is_reported(shaken: Path, tmp_path: Path) -> None:
    """Roll about the optical axis separates the two: a scale 2 % too high gives a note, a correct scale gives none."""
    for scale, said in ((1.02, True), (1.0, False)):
        start_profile(shaken, imu__gyro_scale=[scale] * 3)
        output = CalibrationOutput(tmp_path / f"{scale}.yaml")
        facts, _ = run_calibration(plan_calibration(shaken, None, ("focal",)), output)
        notes = [note for note in facts["notes"] if "gyro-scale" in note]
        assert bool(notes) is said
        if said:
            assert "--with focal,gyro-scale" in notes[0]
            assert float(notes[0].split("gyro-scale (")[1].split("%")[0]) == pytest.approx(-1.96, abs=0.4)


def test_a_wrong_fixed_focal_length_is_reported_as_the_cause(shaken: Path, tmp_path: Path) -> None:
    """Half the focal length leaves a residual that hides the other values.

    The verdict and the notes name the focal length, not the motion.
    """
    true_px = read_profile(shaken / "camera.yaml").intrinsics.fx_px
    start_profile(shaken, intrinsics__fx_px=0.5 * true_px, intrinsics__fy_px=0.5 * true_px)
    facts, _ = run_calibration(plan_calibration(shaken), CalibrationOutput(tmp_path / "camera.yaml"))
    assert facts["not_determined"]
    assert "motion" not in facts["verdict"]
    assert "focal" in facts["verdict"]
    (note,) = (note for note in facts["notes"] if "intrinsics.fx_px" in note)
    assert "--with focal" in note
    assert not any("record a few more seconds" in note for note in facts["notes"])


def test_an_implausible_value_is_not_adopted(shaken: Path, tmp_path: Path) -> None:
    """Rates logged 1.3 times too large determine a gyroscope scale that is implausible and is not adopted."""
    table = shaken / "gyro_accel.csv"
    head, *rows = table.read_text().splitlines()
    fields = [row.split(",") for row in rows]
    scaled = [[f[0], *(f"{1.3 * float(value):.9g}" for value in f[1:4]), *f[4:]] for f in fields]
    table.write_text("\n".join([head, *(",".join(row) for row in scaled)]) + "\n")
    output = CalibrationOutput(tmp_path / "camera.yaml")
    facts, text = run_calibration(plan_calibration(shaken, None, ("gyro-scale",)), output)
    value = value_of(facts, "gyro_scale")
    assert not value["determined"]
    assert value["std"] < 0.02
    assert "gyro_scale" in facts["not_determined"]
    assert read_profile(tmp_path / "camera.yaml").gyro_scale == (1.0, 1.0, 1.0)
    assert any("gyro_scale would be 1." in note and "implausible" in note for note in facts["notes"])
    assert "gyro_scale (implausible value)" in facts["verdict"]
    assert "no camera has it" in text


def test_an_imu_yaml_with_another_rate_is_reported(
    done: tuple[Path, dict[str, Any], str], shaken: Path, tmp_path: Path
) -> None:
    """An imu.yaml beside the camera chain that states 125 Hz instead of 200 Hz gives a note."""
    folder, _, _ = done
    for name in ("camchain-imucam.yaml", "imu.yaml"):
        text = (folder / "kalibr" / name).read_text()
        (tmp_path / name).write_text(text.replace("update_rate: 200", "update_rate: 125"))
    plan = plan_calibration(shaken, tmp_path / "camchain-imucam.yaml")
    facts, _ = run_calibration(plan, CalibrationOutput(tmp_path / "c.yaml"))
    assert [note for note in facts["notes"] if "125 Hz" in note and "200 Hz" in note]


def test_a_long_capture_is_sampled_in_runs_of_frames(
    shaken: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Above the frame limit, runs of consecutive frames spread over the capture suffice for the calibration."""
    monkeypatch.setattr(command, "MAX_FRAMES", 40)
    monkeypatch.setattr(frame_selection, "MIN_RUN_FRAMES", 10)
    monkeypatch.setattr(frame_selection, "RUN_S", 0.33)
    plan = plan_calibration(shaken)
    runs = np.split(np.array(plan.frames), np.flatnonzero(np.diff(plan.frames) > 1) + 1)
    assert len(plan.frames) == 40
    assert min(map(len, runs)) >= 10
    assert plan.frames[0] < 15
    assert plan.frames[-1] > 44
    calls: list[int] = []
    facts, _ = run_calibration(plan, CalibrationOutput(tmp_path / "c.yaml"), calls.append)
    assert sum(calls) <= plan.steps
    assert sum(calls) >= len(plan.frames)
    assert facts["pairs"] < 40
    assert (facts["frames"], facts["frames_recorded"]) == (40, len(plan.capture.frames))
    assert f"used 40 of {len(plan.capture.frames)} frames" in describe(facts)
    assert_recovered(facts)


def test_the_names_of_with_match_the_library() -> None:
    """The command and the library accept the same names; the error for a misspelt name suggests the nearest one."""
    assert set(command.EXTRA_NAMES) == set(CALIBRATED_EXTRAS)
    assert unknown_extra("clock-skew") is None
    assert "'focal'" in str(unknown_extra("focl"))
    assert "'principal-point'" in str(unknown_extra("principal_point"))


def test_errors_are_one_line_with_their_exit_code(virest: Virest, shaken: Path) -> None:
    """Usage 2, profile 3, capture 4, output 8: one line, nothing on standard output, nothing written."""
    folder = shaken.parent
    (folder / "bad.yaml").write_text("virest_profile: 1\nimage: {width: 320, hight: 240}\n")
    (folder / "empty").mkdir()
    (folder / "taken.yaml").write_text("mine\n")
    before = sorted(p.name for p in folder.iterdir())
    cases: list[tuple[tuple[str, ...], int, str]] = [
        (("shaken", "--with", "focal,clock-scew"), 2, "'clock-skew'"),
        (("shaken", "--config", "bad.yaml"), 3, "height"),
        (("empty",), 4, "movie.mp4"),
        (("nowhere",), 4, "nowhere"),
        (("-",), 2, "0 captures"),
        (("shaken", "--out", "taken.yaml"), 8, "exists already"),
        (("shaken", "--out", "no/where.yaml"), 8, "does not exist"),
    ]
    for arguments, code, says in cases:
        assert_refused(virest("calibrate", *arguments, cwd=folder), code, says)
    assert (folder / "taken.yaml").read_text() == "mine\n"
    assert sorted(p.name for p in folder.iterdir()) == before


def test_a_capture_that_determines_nothing_exits_with_6_and_writes_no_file(virest: Virest, tmp_path: Path) -> None:
    """For a camera on a tripod, one line says what to do, and no profile is written."""
    simulate_command(tmp_path / "still", width=320, height=240, frames=20, rate_rad_s=0.0, seed=4)
    result = virest("calibrate", "still", "--json", cwd=tmp_path)
    assert_refused(result, 6, "shake the phone")
    assert [p.name for p in tmp_path.iterdir()] == ["still"]


def test_an_existing_profile_is_replaced_only_on_request(shaken: Path, tmp_path: Path) -> None:
    """Without ``overwrite`` the old file stays as it is; with it the new file replaces it completely."""
    taken = tmp_path / "camera.yaml"
    taken.write_text("mine\n")
    plan = plan_calibration(shaken)
    with pytest.raises(OutputError, match="exists already"):
        run_calibration(plan, CalibrationOutput(taken))
    assert taken.read_text() == "mine\n"
    run_calibration(plan, CalibrationOutput(taken, overwrite=True))
    assert read_profile(taken).estimates
    assert not list(tmp_path.glob("*.part"))


def test_nothing_is_written_when_the_fit_fails(shaken: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An error of the library leaves neither a profile nor Kalibr's folder."""

    def refuse(*_: Any) -> None:
        raise CalibrationError("the frames do not follow the gyroscope")

    monkeypatch.setattr(command, "calibrate_geometry", refuse)
    with pytest.raises(CalibrationError):
        run_calibration(plan_calibration(shaken), CalibrationOutput(tmp_path / "c.yaml", tmp_path / "kalibr"))
    assert [p.name for p in tmp_path.iterdir()] == ["shaken"]


def test_start_up_frames_are_left_out_of_the_fit(shaken: Path) -> None:
    """Frames that lag their timestamps at start-up are used only if the lag itself is fitted."""
    capture = read_capture(shaken)
    profile = read_profile(shaken / "camera.yaml")
    late = [replace(f, skip_reason="later", skip_codes=("start-up",)) if f.index < 7 else f for f in capture.frames]
    begun = replace(capture, frames=tuple(late))
    assert command.choose_frames(begun, profile)[0] == 7
    assert command.choose_frames(begun, profile, with_startup=True)[0] == 0
