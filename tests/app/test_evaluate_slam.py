"""``evaluate slam``: sequences of a capture, a SLAM program as a command, and structure from motion."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from virest.app.evaluate_slam import SlamOptions, run_slam
from virest.app.slam_captures import DEVICES, SEQUENCES, SlamCapture, make_capture, smaller
from virest.app.slam_sequences import fill_command, run_command, split_command, write_sequences
from virest.errors import CaptureError, OutputError, SettingsError
from virest.restoration.settings import PRESETS

pytest.importorskip("evo", reason="the extra [slam] is not installed")

TINY = SlamCapture(
    "tiny", "", width=192, height=160, focal_px=150.0, frames=14, walk_m=(0.2, 0.02, 0.03), rate_rad_s=0.7, seed=9
)  # fmt: skip
PRETENDER = """
import sys
from pathlib import Path
sequence, out, truth, seed = sys.argv[1:5]
stamps = [int(p.stem) for p in (Path(sequence) / "mav0/cam0/data").glob("*.png")]
rows = [line.split() for line in Path(truth).read_text().splitlines()]
step = {"global": 0.0, "rolling": 0.02, "restored": 0.002}[Path(sequence).name] * (1 + 0.1 * int(seed))
when = {"0": lambda t: t, "1": lambda t: f"{t * 1e-9:.9f}", "2": lambda t: f"{(t - min(stamps)) * 1e-9:.6f}"}[seed]
lines = []
for k, (stamp, row) in enumerate(zip(sorted(stamps), rows)):
    x, y, z = (2.5 * float(v) for v in row[1:4])
    lines.append(f"{when(stamp)} {x} {y + 2.5 * step * (-1) ** k} {z} 0 0 0 1")
Path(out).write_text("\\n".join(lines))
"""


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny capture with its truth; the profile leaves distance and offset open."""
    return make_capture(TINY, tmp_path_factory.mktemp("slam") / "tiny")


@pytest.fixture(scope="module")
def judged(capture: Path, tmp_path_factory: pytest.TempPathFactory):
    """A run with a program that knows the true path and distorts it by kind and seed: folder, facts, text, code."""
    folder = tmp_path_factory.mktemp("judged")
    script, out = folder / "pre tender.py", folder / "out put"
    script.write_text(PRETENDER)
    truth = out / "sequences" / "tiny" / "truth.tum"
    command = f"'{sys.executable}' '{script}' {{sequence}} {{trajectory}} '{truth}' {{seed}}"
    options = SlamOptions(command=command, seeds=3, out=out, preset="fast")
    return out, *run_slam([capture], options)


def test_a_program_is_scored_by_kind_with_median_and_range(judged):
    """Zigzags of 20 mm and 2 mm are measured as such for any scale and clock.

    Restoration removes 90 % of the added error.
    """
    _, facts, text, code = judged
    (row,) = facts["results"]
    assert code == 0
    assert row["kinds"]["global"]["median_m"] == pytest.approx(0, abs=1e-6)
    assert row["kinds"]["rolling"]["median_m"] == pytest.approx(0.022, rel=0.1)
    assert row["kinds"]["restored"]["low_m"] == pytest.approx(0.002, rel=0.1)
    assert row["kinds"]["restored"]["high_m"] == pytest.approx(0.0024, rel=0.1)
    assert row["added_error_removed"] == pytest.approx(0.9, abs=0.02)
    assert not row["worse_than_recorded"]
    assert facts["versions"].keys() == {"virest", "evo"}
    assert "tiny" in text


def test_the_three_sequences_hold_the_same_frames(judged, capture: Path):
    """They use EuRoC's layout with the capture's timestamps; the pictures differ, and the truth is the simulator's."""
    out, facts, _, _ = judged
    stamps = [int(line.split(",")[0]) for line in (capture / "frame_timestamps.txt").read_text().splitlines()[1:]]
    folders = {kind: out / "sequences" / "tiny" / kind for kind in ("global", "rolling", "restored")}
    for folder in folders.values():
        assert [int(line) for line in (folder / "times.txt").read_text().splitlines()] == stamps
        rows = (folder / "mav0" / "cam0" / "data.csv").read_text().splitlines()[1:]
        assert rows == [f"{stamp},{stamp}.png" for stamp in stamps]
    shown = {k: cv2.imread(str(f / "mav0" / "cam0" / "data" / f"{stamps[6]}.png"), 0) for k, f in folders.items()}
    true = cv2.imread(str(capture / "truth" / "frames" / "000006.png"), 0)
    np.testing.assert_array_equal(shown["global"], true)
    inside = (slice(24, -24), slice(24, -24))
    error = {kind: np.abs(shown[kind][inside].astype(float) - true[inside]).mean() for kind in shown}
    assert error["restored"] < 0.6 * error["rolling"]
    assert json.loads((out / "results.json").read_text()) == json.loads(json.dumps(facts))


def test_an_existing_folder_is_not_written_into(judged, capture: Path):
    """A folder that is not empty is an error."""
    with pytest.raises(OutputError, match="not empty"):
        run_slam([capture], SlamOptions(command="x {sequence} {trajectory}", out=judged[0]))


def test_a_capture_without_truth_is_an_error(capture: Path, tmp_path: Path):
    """Nothing can be scored without the true path: exit 4."""
    with pytest.raises(CaptureError, match="no such file"):
        write_sequences(tmp_path, tmp_path / "out", PRESETS["fast"])
    facts, text, code = run_slam([tmp_path], SlamOptions(command="true {sequence} {trajectory}"))
    assert code == 4
    assert facts["results"][0]["exit_code"] == 4
    assert "failed" in text


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("slam {sequence}", "has no {trajectory}"),
        ("slam {sequence} {trajectory} {vocabulary}", "has an unknown {vocabulary}"),
        ("slam '{sequence} {trajectory}", "No closing quotation"),
    ],
)
def test_a_command_with_wrong_placeholders_is_refused(text: str, said: str):
    """The error names the missing or unknown placeholder."""
    with pytest.raises(SettingsError, match=said):
        split_command(text)


def test_a_value_stays_one_argument_and_reaches_no_shell(tmp_path: Path):
    """Spaces, quotes, semicolons and dollar signs in a path are passed on unchanged."""
    nasty = f"a b'; touch {tmp_path}/made; $(touch {tmp_path}/made) {{seed}}"
    words = fill_command(split_command("prog -s{sequence} {trajectory}"), {"sequence": nasty, "trajectory": "t"})
    assert words == ["prog", f"-s{nasty}", "t"]
    written = tmp_path / "said"
    code = "import sys, pathlib; pathlib.Path(sys.argv[2]).write_text(sys.argv[1])"
    assert run_command([sys.executable, "-c", code, nasty, str(written)], tmp_path / "log", 60)
    assert written.read_text() == nasty
    assert not (tmp_path / "made").exists()


def test_a_hanging_program_is_stopped_and_a_missing_one_is_named(tmp_path: Path):
    """A run that exceeds the time limit fails; a program that does not exist is a settings error."""
    assert not run_command([sys.executable, "-c", "import time; time.sleep(60)"], tmp_path / "log", 0.3)
    assert "stopped after 0.3 s" in (tmp_path / "log").read_text()
    with pytest.raises(SettingsError, match="no-such-slam"):
        run_command(["no-such-slam"], tmp_path / "log", 5)


def test_settings_for_orb_slam_hold_the_lens(judged):
    """The file has the keys of both ORB-SLAM generations, with the lens of the profile."""
    text = (judged[0] / "sequences" / "tiny" / "orb_slam.yaml").read_text()
    assert text.startswith("%YAML:1.0")
    for line in ("Camera.fx: 150.0", "Camera1.cy: 79.5", "Camera.width: 192", "Camera.fps: 15"):
        assert line in text.splitlines()


def test_errors_have_their_exit_codes(virest, tmp_path: Path):
    """2 for options that exclude each other, 3 for a command without its placeholders, 4 for a missing folder."""
    assert virest("evaluate", "slam", tmp_path, "--devices").returncode == 2
    refused = virest("evaluate", "slam", tmp_path, "--command", "slam {sequence}")
    assert (refused.returncode, refused.stdout) == (3, "")
    assert "{trajectory}" in refused.stderr
    command = "true {sequence} {trajectory}"
    missing = virest("evaluate", "slam", tmp_path / "none", "--command", command, "--json")
    assert missing.returncode == 4
    assert json.loads(missing.stdout)["summary"]["failed"] == 1


def test_standard_captures_have_unique_names_and_seeds():
    """No two share a folder or a motion; every readout time is shorter than the frame period."""
    plans = [*SEQUENCES, *DEVICES]
    assert len({plan.name for plan in plans}) == len({plan.seed for plan in plans}) == len(plans)
    assert all(plan.readout_ms < 1000 / plan.fps for plan in plans)


@pytest.mark.scenario
def test_structure_from_motion_profits_from_restored_frames(tmp_path: Path):
    """Restoration removes 90 % of the error that the rolling shutter adds on a short walk before a tilted wall."""
    pytest.importorskip("pycolmap", reason="the extra [slam] is not installed")
    wall = dataclasses.replace(SEQUENCES[0], name="walk", near_m=None, seed=77, fps=12.0, rate_rad_s=1.1)
    plan = smaller(wall, 12)
    capture = make_capture(plan, tmp_path / "walk")
    facts, _, code = run_slam([capture], SlamOptions(seeds=1, preset="fast"))
    (row,) = facts["results"]
    assert code == 0
    assert [row["kinds"][kind]["tracked"] for kind in ("global", "restored")] == [1.0, 1.0]
    assert row["kinds"]["rolling"]["median_m"] > 5 * row["kinds"]["global"]["median_m"]
    assert row["added_error_removed"] > 0.9
    assert not row["worse_than_recorded"]
