"""``virest diagnose``: its files, its table and its exit codes, for given diagnoses."""

import dataclasses
import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

from virest.app import cli, diagnose
from virest.app.simulate import simulate_command
from virest.camera.profile_file import parse_profile, read_profile
from virest.diagnosis.findings import (
    Diagnosis,
    Finding,
    HeldOutGain,
    Nominal,
    ParameterChange,
    Remaining,
    Rival,
    Rung,
)
from virest.errors import CalibrationError, OutputError
from virest.inference.parallel import ParallelMap

CAUSE_KEYS = {"name", "parameters", "held_out", "rivals", "p_value", "sentence", "figures"}
TOP_KEYS = {"schema", "verdict", "nominal", "causes", "fields", "unexplained", "restoration_gain", "extended_profile"}
NOMINAL_KEYS = {"geometry_rms_px", "geometry_noise_px", "photometric_rms", "blur_rms_px", "tracks", "frames"}
DRAW_FIGURES = diagnose.draw_figures
Say = Callable[[str, float], None]


def offset_cause() -> Finding:
    """A time offset with a rival."""
    change = ParameterChange(0.0, 0.0042, 0.00011)
    rivals = (Rival("timestamp_reference", 0.23),)
    gain = HeldOutGain("geometry_rms_px", 1.4, 0.22, 0.2)
    return Finding("time_offset", {"time_offset_s": change}, gain, rivals, 1e-9, "the clocks are\n 4 ms apart")


def odd_cause() -> Finding:
    """A cause with a list, a word, an infinite value and no standard deviation."""
    changes = {
        "gyro_bias_rad_s": ParameterChange([0.0, 0.0, 0.0], [0.01, -0.02, 0.03], [0.001, 0.002, float("nan")]),
        "depth_m": ParameterChange(None, float("inf"), None),
        "timestamp": ParameterChange("exposure_start", "exposure_end", None),
    }
    return Finding("gyro_bias", changes, HeldOutGain("geometry_rms_px", 0.3, 0.22, 0.2), (), 0.01, "drifts")


def diagnosis(source: diagnose.Source, verdict: str, causes: tuple[Finding, ...]) -> Diagnosis:
    """A diagnosis of the tiny capture."""
    rng = np.random.default_rng(3)
    nominal = source.profile
    extended = dataclasses.replace(nominal, time_offset_s=0.0042) if causes else nominal
    some = {name: rng.normal(size=200) for name in ("row", "time", "radius", "rate", "x_px", "y_px")}
    tried = {"time_offset": 0.22, "readout_time": 0.9}
    rungs = (
        Rung("time_offset", tried, 1.4, "geometry_rms_px"),
        Rung(None, {"gyro_bias": 0.23}, 0.22, "geometry_rms_px"),
    )
    said = "something goes on along radius"
    left = Remaining(0.4, "radius", 0.01, 0.05, "geometry_rms_px", verdict == "unexplained", said)
    return Diagnosis(
        verdict, Nominal(1.4, 0.2, None, float("nan"), 1234, 24), causes, left, nominal, extended, rungs,
        {"before": some, "after": some}, ("blur was not judged: too little of it",),
    )  # fmt: skip


@pytest.fixture
def ladder(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Make the ladder return a given verdict."""

    def give(verdict: str = "explained", *causes: Finding, error: Exception | None = None) -> None:
        def climb(source: diagnose.Source, progress: Say, _each: ParallelMap, _kept_back: object = ()) -> Diagnosis:
            progress("points", 0.5)
            assert [number for number, _ in source.pictures([7, 3, 4])] == [3, 4, 7]
            assert next(source.gray([5]))[1].shape == (120, 160)  # type: ignore[union-attr]
            if error is not None:
                raise error
            return diagnosis(source, verdict, causes)

        monkeypatch.setattr(diagnose, "climb", climb)

    return give


@pytest.fixture(autouse=True)
def blank_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace figures by blank files, since drawing takes most of the time, and use one process."""

    def blank(_capture: object, found: Diagnosis, _each: ParallelMap) -> tuple[dict[str, bytes], list[list[str]]]:
        names = [f"figures/{number:02d}_{cause.name}.png" for number, cause in enumerate(found.causes, start=1)]
        return dict.fromkeys(names, b"\x89PNG"), [[name] for name in names]

    monkeypatch.setattr(diagnose, "draw_figures", blank)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0}, raising=False)


def run(*arguments: object) -> int:
    """The command, in this process."""
    return cli.run(["diagnose", *map(str, arguments)])


def files_in(folder: Path) -> list[str]:
    """All files below a folder."""
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def test_diagnosis_json_has_exactly_the_documented_keys(tiny: Path, tmp_path: Path, ladder, monkeypatch) -> None:
    """diagnosis.json has the gain, null for NaN, "inf" for infinity, and names of figures that exist."""
    monkeypatch.setattr(diagnose, "draw_figures", DRAW_FIGURES)
    ladder("explained", offset_cause(), odd_cause())
    assert run(tiny, "--out", tmp_path / "out") == 0
    folder = tmp_path / "out/tiny"
    text = (folder / "diagnosis.json").read_text()
    facts = json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
    assert set(facts) == TOP_KEYS
    assert facts["schema"] == "virest/diagnosis/1"
    assert set(facts["nominal"]) == NOMINAL_KEYS
    assert facts["nominal"]["photometric_rms"] is None is facts["nominal"]["blur_rms_px"]
    assert set(facts["unexplained"]) == {"p_value", "strongest_along", "size", "limit", "unit"}
    assert {"sharpness_before", "sharpness_after"} <= set(facts["restoration_gain"])
    first, second = facts["causes"]
    assert set(first) == set(second) == CAUSE_KEYS
    assert first["parameters"] == {"time_offset_s": {"nominal": 0.0, "estimate": 0.0042, "std": 0.00011}}
    assert first["rivals"] == [{"name": "timestamp_reference", "held_out_after": 0.23}]
    held_out = first["held_out"]
    assert set(held_out) == {"quantity", "before", "after", "gain"}
    assert held_out["gain"] == pytest.approx(1 - (0.22**2 - 0.2**2) / (1.4**2 - 0.2**2))
    assert second["parameters"]["depth_m"] == {"nominal": None, "estimate": "inf", "std": None}
    assert second["parameters"]["gyro_bias_rad_s"]["std"] == [0.001, 0.002, None]
    for figure in {path for cause in facts["causes"] for path in cause["figures"]}:
        assert (folder / figure).read_bytes().startswith(b"\x89PNG")
    assert first["figures"][0] == "figures/01_time_offset.png"
    assert set(files_in(folder)) >= {"diagnosis.json", facts["extended_profile"], "figures/pictures.png"}


def test_the_extended_profile_can_be_used(tiny: Path, tmp_path: Path, ladder) -> None:
    """extended.yaml reads as a profile that includes the causes and their standard deviations."""
    ladder("explained", offset_cause(), odd_cause())
    assert run(tiny, "--out", tmp_path / "out") == 0
    path = tmp_path / "out/tiny/extended.yaml"
    profile = read_profile(path)
    assert profile.time_offset_s == 0.0042
    assert parse_profile(yaml.safe_load(path.read_text())) == profile
    assert profile.estimates["time_offset_s"].std == pytest.approx(0.00011)
    assert profile.estimates["gyro_bias_rad_s"].std is None


def test_the_table_reads_from_cause_to_verdict(tiny: Path, tmp_path: Path, ladder, capfd) -> None:
    """Cause, value ± deviation, before and after, gain; then the sentence, rivals, the remaining residual.

    The verdict last.
    """
    ladder("unexplained", offset_cause(), odd_cause())
    assert run(tiny, "--out", tmp_path / "out") == 0
    lines = capfd.readouterr().out.splitlines()
    row = next(line for line in lines if line.startswith("time_offset "))
    for part in ("0.0042", "0.00011", "1.4", "0.22"):
        assert part in row
    assert max(len(line) for line in lines[1:4]) <= 95
    assert "time_offset: the clocks are 4 ms apart (held-out geometry_rms_px)" in lines
    assert "  equally good explanations: timestamp_reference (0.23)" in lines
    assert any("gyro_bias_rad_s[1]" in line and "-0.02" in line for line in lines)
    assert "unexplained: something goes on along radius" in lines
    assert "note: blur was not judged: too little of it" in lines
    assert lines[-1] == "verdict: unexplained"


def test_json_is_one_line_with_the_content_of_diagnosis_json(tiny: Path, tmp_path: Path, ladder, capfd) -> None:
    """Standard output holds the content of diagnosis.json and nothing else."""
    ladder("explained", offset_cause())
    assert run(tiny, "--out", tmp_path / "out", "--json") == 0
    out = capfd.readouterr().out
    assert len(out.splitlines()) == 1
    assert json.loads(out) == json.loads((tmp_path / "out/tiny/diagnosis.json").read_text())


@pytest.mark.parametrize(("verdict", "code"), [("consistent", 0), ("explained", 10), ("unexplained", 10)])
def test_check_fails_unless_consistent(tiny: Path, tmp_path: Path, ladder, verdict: str, code: int) -> None:
    """``--check`` exits with 10 for any verdict but consistent; the files are written in each case."""
    ladder(verdict, *([offset_cause()] if verdict == "explained" else []))
    assert run(tiny, "--out", tmp_path / "out", "--check") == code
    facts = json.loads((tmp_path / "out/tiny/diagnosis.json").read_text())
    assert facts["verdict"] == verdict
    assert len(facts["causes"]) == (verdict == "explained")


def test_a_diagnosis_is_replaced_only_on_request(tiny: Path, tmp_path: Path, ladder) -> None:
    """Exit 8 before any work. ``--overwrite`` replaces it and removes figures of causes that are gone."""
    ladder("explained", offset_cause())
    out = tmp_path / "out"
    assert run(tiny, "--out", out) == 0
    (out / "tiny/figures/mine.png").write_bytes(b"mine")
    before = (out / "tiny/diagnosis.json").read_bytes()
    ladder(error=AssertionError("no work is done"))
    assert run(tiny, "--out", out) == 8
    assert (out / "tiny/diagnosis.json").read_bytes() == before
    ladder("consistent")
    assert run(tiny, "--out", out, "--overwrite") == 0
    assert json.loads((out / "tiny/diagnosis.json").read_text())["verdict"] == "consistent"
    assert "figures/01_time_offset.png" not in files_in(out / "tiny")
    assert "figures/mine.png" in files_in(out / "tiny")


def test_a_diagnosis_keeps_the_run_of_the_same_name(tiny: Path, tmp_path: Path, ladder) -> None:
    """The diagnosis is written beside the frames of ``process``, which stay."""
    out = tmp_path / "out"
    assert cli.run(["process", str(tiny), "--out", str(out), "--frames", "2:4", "--jobs", "1", "-q"]) == 0
    before = {name: (out / "tiny" / name).read_bytes() for name in files_in(out / "tiny")}
    ladder("consistent")
    assert run(tiny, "--out", out) == 0
    assert before == {name: (out / "tiny" / name).read_bytes() for name in before}
    assert "diagnosis.json" in files_in(out / "tiny")


def test_a_full_disk_leaves_no_partial_output(tiny: Path, tmp_path: Path, ladder, monkeypatch) -> None:
    """A disk that fills up at the last file leaves neither figures nor folders; exit 8."""
    ladder("explained", offset_cause())
    write = diagnose.write_whole

    def fill_up(path: Path, data: bytes) -> None:
        if path.name == "diagnosis.json":
            raise OutputError("no space left")
        write(path, data)

    monkeypatch.setattr(diagnose, "write_whole", fill_up)
    out = tmp_path / "out"
    out.mkdir()
    assert run(tiny, "--out", out) == 8
    assert list(out.iterdir()) == []


@pytest.mark.parametrize(
    ("error", "code"), [(CalibrationError("too little motion"), 6), (OutputError("locked"), 8), (ValueError("ours"), 1)]
)
def test_a_failing_ladder_gives_its_own_exit_code(tiny: Path, tmp_path: Path, ladder, error, code: int, capfd) -> None:
    """The error goes to standard error, and no file is written."""
    ladder(error=error)
    assert run(tiny, "--out", tmp_path / "out") == code
    captured = capfd.readouterr()
    assert captured.out == ""
    assert "error" in captured.err
    assert not (tmp_path / "out").exists()


def test_unusable_inputs_have_their_exit_codes(tiny: Path, tmp_path: Path, ladder) -> None:
    """No such capture: 4; a profile of another size: 3; an output that is a file: 8; no argument: 2."""
    ladder("consistent")
    assert run(tmp_path / "nowhere", "--out", tmp_path / "out") == 4
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text((tiny / "camera.yaml").read_text().replace("width: 160", "width: 320"))
    assert run(tiny, "--config", wrong, "--out", tmp_path / "out") == 3
    assert run(tiny, "--config", tmp_path / "none.yaml", "--out", tmp_path / "out") == 3
    (tmp_path / "file").write_text("x")
    assert run(tiny, "--out", tmp_path / "file") == 8
    assert run() == 2
    assert not (tmp_path / "out").exists()


@pytest.mark.scenario
def test_a_halved_readout_time_is_found(tmp_path: Path, monkeypatch) -> None:
    """Two processes find the right cause and its value within four deviations; neighbouring frames then agree better.

    One process finds the same.
    """
    blank = diagnose.draw_figures
    monkeypatch.setattr(diagnose, "draw_figures", DRAW_FIGURES)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    size = {"width": 256, "height": 192, "frames": 24, "readout_ms": 24.0, "rate_rad_s": 1.1, "noise_levels": 1.0}
    simulate_command(tmp_path / "trip", **size, effects=["readout_time=0.012"], seed=3)  # type: ignore[arg-type]
    assert run(tmp_path / "trip", "--out", tmp_path / "out", "--check", "-q") == 10
    facts = json.loads((tmp_path / "out/trip/diagnosis.json").read_text())
    assert facts["verdict"] == "explained"
    cause = facts["causes"][0]
    assert cause["name"] == "readout_time"
    found = cause["parameters"]["readout_time_s"]
    assert found["estimate"] == pytest.approx(0.012, abs=4 * found["std"])
    assert cause["held_out"]["gain"] > 0.9
    gain = facts["restoration_gain"]
    assert gain["disagreement_after_px"] < 0.4 * gain["disagreement_before_px"]
    assert all((tmp_path / "out/trip" / path).is_file() for path in cause["figures"])
    assert read_profile(tmp_path / "out/trip/extended.yaml").shutter.readout_time_s == pytest.approx(found["estimate"])
    monkeypatch.setattr(diagnose, "draw_figures", blank)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0}, raising=False)
    assert run(tmp_path / "trip", "--out", tmp_path / "alone", "-q") == 0
    alone = json.loads((tmp_path / "alone/trip/diagnosis.json").read_text())
    for cause in [*facts["causes"], *alone["causes"]]:
        del cause["figures"]
    assert facts == alone, "one process gives the same diagnosis as two"
