"""The files of a run, and the keys of every line (section 2 of the contract)."""

import json
from pathlib import Path

import pytest
from story import process, read_png

pytestmark = pytest.mark.scenario

LINE = {
    "capture", "frame", "timestamp_ns", "exposure_s", "status", "output", "warnings", "valid_px",
    "motion", "depth_m", "depth_source", "blur", "shutter", "response", "deblur", "seconds",
}  # fmt: skip
PARTS = {
    "motion": {"delta_position_m", "delta_q_wxyz", "rate_rad_s", "velocity_m_s"},
    "blur": {"angle_rad", "length_px", "tiles"},
    "shutter": {"readout_time_s", "method", "corners_px", "max_displacement_px"},
    "deblur": {"method"},
    "seconds": {"decode", "estimate", "deblur", "shutter", "write"},
}


def test_a_run_writes_pictures_lines_and_counts(virest, hand_held: Path, tmp_path: Path):
    """The folder has one PNG and one line per frame, in order, and run.json has the counts."""
    result = process(virest, hand_held, tmp_path, "--preset", "fast")
    written = {path.relative_to(result.folder).as_posix() for path in result.folder.rglob("*") if path.is_file()}
    assert written == {"parameters.jsonl", "run.json"} | {f"frames/{k:06d}.png" for k in range(4)}
    assert [line["frame"] for line in result.lines] == [0, 1, 2, 3]
    counts = result.account["counts"]
    assert {s: counts[s] for s in ("restored", "copied", "skipped", "failed")} == {
        "restored": 4, "copied": 0, "skipped": 0, "failed": 0}  # fmt: skip
    assert counts["straightened"] == 4
    assert {len(entry["sha256"]) for entry in result.account["inputs"]} == {64}
    for line in result.lines:
        assert read_png(result.folder / line["output"]).shape == (480, 360, 3)


def test_every_line_has_the_documented_keys(virest, hand_held: Path, tmp_path: Path):
    """Each line of a restored frame has every key, with plain numbers of the right size and range."""
    stamps = (hand_held / "frame_timestamps.txt").read_text().splitlines()[1:]
    for line in process(virest, hand_held, tmp_path, "--preset", "fast").lines:
        assert set(line) >= LINE
        for part, keys in PARTS.items():
            assert set(line[part]) >= keys, part
        assert line["capture"] == "hand_held"
        assert line["timestamp_ns"] == int(stamps[line["frame"]].split(",")[0])
        assert line["exposure_s"] == pytest.approx(0.014)
        assert line["status"] == "restored"
        assert line["depth_source"] == "none"
        assert line["response"] == "srgb"
        assert len(line["motion"]["delta_q_wxyz"]) == 4
        assert len(line["motion"]["rate_rad_s"]) == 3
        assert all(set(tile) == {"centre_px", "angle_rad", "length_px"} for tile in line["blur"]["tiles"])
        x0, y0, x1, y1 = line["valid_px"]
        assert 0 <= x0 < x1 <= 360
        assert 0 <= y0 < y1 <= 480


def test_json_prints_the_log(virest, hand_held: Path, tmp_path: Path):
    """``--json`` prints exactly the lines of parameters.jsonl, and nothing else, on standard output."""
    arguments = ("--out", tmp_path, "--preset", "fast", "--frames", "1:3", "--json", "--jobs", 2)
    done = virest("process", hand_held, *arguments)
    assert done.returncode == 0, done.stderr
    assert done.stdout == (tmp_path / "hand_held" / "parameters.jsonl").read_text()
    assert [json.loads(line)["frame"] for line in done.stdout.splitlines()] == [1, 2]
