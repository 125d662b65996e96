"""``virest calibrate-curve`` as users see it."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from bracket_making import FIVE, FIVE_LOW_TOP, SRGB, make_bracket

from virest.app.calibrate_curve import calibrate_curve
from virest.app.simulate import simulate_command
from virest.calibration.response_curve import curve_distance_levels
from virest.camera.profile_file import parse_profile
from virest.camera.response import ResponseCurve

Virest = Callable[..., subprocess.CompletedProcess[str]]


def write_bracket(folder: Path, curve: ResponseCurve, wrong: dict[int, float] | None = None) -> Path:
    """Write PNGs and their CSV; return the CSV's path. ``wrong`` gives factors on the listed exposures."""
    folder.mkdir(exist_ok=True)
    lines = ["file,exposure_s"]
    for i, picture in enumerate(make_bracket(curve, np.random.default_rng(4), width=300, height=220)):
        cv2.imwrite(str(folder / picture.file), picture.levels[..., ::-1])
        lines.append(f"{picture.file},{picture.exposure * (wrong or {}).get(i, 1.0):.9g}")
    table = folder / "exposures.csv"
    table.write_text("\n".join(lines) + "\n")
    return table


def test_a_bracket_gives_a_response_block_for_a_profile(virest: Virest, tmp_path: Path) -> None:
    """The command writes documented JSON, a YAML block that a profile accepts, and a figure; nothing else."""
    table = write_bracket(tmp_path / "bracket", FIVE, {2: 1.5})
    done = virest("calibrate-curve", "bracket", "--exposures", table, "--out", "c.yaml", "--plot", "c.png", "--json",
                  cwd=tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["response"]["kind"] == "five_segment"
    assert {"rms_grey_levels", "curve_std_grey_levels", "covered_exposure", "pictures", "notes"} <= set(facts)
    assert 0.0 < facts["curve_std_grey_levels"] < 2.0
    assert [p["contradicts"] for p in facts["pictures"]] == [i == 2 for i in range(8)]
    assert facts["pictures"][2]["exposure_error_ev"] == pytest.approx(np.log2(1.5), abs=0.03)
    block = yaml.safe_load((tmp_path / "c.yaml").read_text())
    assert block == {"response": facts["response"]}
    profile = parse_profile({"virest_profile": 1, "image": {"width": 720, "height": 1280}, **block})
    assert profile.response is not None
    assert curve_distance_levels(profile.response, FIVE, tuple(facts["covered_exposure"])) < 1.5
    assert cv2.imread(str(tmp_path / "c.png")) is not None
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bracket", "c.png", "c.yaml"]


def test_the_curve_command_prints_a_table(virest: Virest, tmp_path: Path) -> None:
    """Each picture has a row with its verdict; the curve is written to curve.yaml by default."""
    table = write_bracket(tmp_path / "bracket", SRGB)
    done = virest("calibrate-curve", "bracket", "--exposures", table, "--kind", "srgb", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("srgb\n")
    assert "\nthe curve is known to ± " in done.stdout
    assert len([line for line in done.stdout.splitlines() if line.startswith("0") and " no" in line]) == 8
    assert (tmp_path / "curve.yaml").is_file()
    assert done.stderr == ""


def test_curve_errors_are_one_line_with_their_exit_code(virest: Virest, tmp_path: Path) -> None:
    """Nothing is written, and only the error line is printed."""
    table = write_bracket(tmp_path / "bracket", SRGB)
    rows = table.read_text().splitlines()
    (tmp_path / "one.csv").write_text("\n".join(rows[:2]) + "\n")
    (tmp_path / "same.csv").write_text("\n".join([rows[0], *(r.split(",")[0] + ",0.01" for r in rows[1:])]) + "\n")
    (tmp_path / "nan.csv").write_text("\n".join([rows[0], rows[1].split(",")[0] + ",nan"]) + "\n")
    cases: list[tuple[tuple[object, ...], int, str]] = [
        (("bracket", "--exposures", "one.csv"), 6, "1 picture"),
        (("bracket", "--exposures", "same.csv"), 6, "one exposure"),
        (("bracket", "--exposures", "nan.csv"), 4, "line 2"),
        (("bracket",), 4, "EXIF"),
        (("bracket", "--plot", "c.doc"), 2, ".png"),
        (("bracket", "--exposures", table, "--out", "no/where.yaml"), 8, "does not exist"),
    ]
    for arguments, code, says in cases:
        result = virest("calibrate-curve", *arguments, cwd=tmp_path)
        assert result.returncode == code, (arguments, result.stderr)
        assert len(result.stderr.splitlines()) == 1, result.stderr
        assert says in result.stderr
        assert result.stdout == ""
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bracket", "nan.csv", "one.csv", "same.csv"]


@pytest.mark.parametrize(
    ("truth", "exposures"),
    [(SRGB, {"auto_exposure_ev": 5.0, "auto_exposure_steps": 9, "frames": 27}),
     (FIVE_LOW_TOP, {"auto_exposure_ev": 5.0, "auto_exposure_steps": 9, "frames": 27}),
     (FIVE, {"auto_exposure_ev": 4.0, "frames": 45})],
    ids=["srgb-steps", "low-top-steps", "five-walk"],
)  # fmt: skip
def test_a_still_capture_under_auto_exposure_gives_the_curve(
    tmp_path: Path, truth: ResponseCurve, exposures: dict[str, Any]
) -> None:
    """Exposure and ISO change in steps or in a random walk; after H.264 the curve is right within 2 grey levels."""
    simulate_command(tmp_path / "trip", width=320, height=240, exposure_ms=5, rate_rad_s=0.0, readout_ms=10,
                     response=truth, seed=3, truth_frames=False, **exposures)  # fmt: skip
    facts, _ = calibrate_curve(tmp_path / "trip")
    block = {k: tuple(v) if isinstance(v, list) else v for k, v in facts["response"].items()}
    found, covered = ResponseCurve(**block), tuple(facts["covered_exposure"])
    assert curve_distance_levels(found, truth, covered) < 2.0
    low, high = 255 * found.encode(np.array(covered))
    assert low < 30
    assert high > 0.93 * 255 * truth.y_max
    assert not any(p["contradicts"] for p in facts["pictures"])


def test_a_capture_with_constant_exposure_is_refused(virest: Virest, tmp_path: Path) -> None:
    """Exit 6: one exposure does not determine the curve."""
    simulate_command(tmp_path / "trip", width=160, height=120, frames=6, rate_rad_s=0.0)
    done = virest("calibrate-curve", "trip", cwd=tmp_path)
    assert done.returncode == 6
    assert "its 6 frames have one exposure" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_brackets_that_determine_nothing_exit_with_6(virest: Virest, tmp_path: Path) -> None:
    """A folder of one picture, clipped pictures, and two exposures without overlap."""
    light = np.random.default_rng(8).uniform(0.0, 1.0, (90, 120, 1)).repeat(3, axis=2) ** 2 * 200 + 20
    scene = cv2.GaussianBlur(light, (0, 0), 3)
    white, black = np.full((90, 120, 3), 255, np.uint8), np.zeros((90, 120, 3), np.uint8)
    folders = {
        "one": ([scene], [0.01], "1 picture"),
        "clipped": ([white, black, white, black], [0.01, 0.02, 0.04, 0.08], "clipped throughout"),
        "apart": ([scene / 60, np.minimum(scene * 60, 255)], [0.0001, 0.36], "no overlap|clipped throughout"),
    }
    for name, (pictures, exposures, says) in folders.items():
        (tmp_path / name).mkdir()
        for i, picture in enumerate(pictures):
            cv2.imwrite(str(tmp_path / name / f"{i}.png"), np.rint(picture).astype(np.uint8))
        rows = [f"{i}.png,{exposure}" for i, exposure in enumerate(exposures)]
        (tmp_path / name / "e.csv").write_text("\n".join(["file,exposure_s", *rows]) + "\n")
        done = virest("calibrate-curve", name, "--exposures", f"{name}/e.csv", cwd=tmp_path)
        assert done.returncode == 6, (name, done.stderr)
        assert re.search(says, done.stderr), done.stderr
        assert len(done.stderr.splitlines()) == 1
    assert not list(tmp_path.glob("*.yaml"))
