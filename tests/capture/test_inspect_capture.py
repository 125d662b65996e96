"""Output of ``virest inspect`` for intact and damaged captures."""

from __future__ import annotations

import json

from virest.app.inspect import as_json, inspect_capture
from virest.capture.folder import read_capture


def test_an_intact_capture_is_summarised(writer):
    """Counts, clocks, rates, spans and exposure appear in both forms, and the exit code is 0."""
    facts, text, code = inspect_capture(writer.write())
    assert code == 0
    assert json.loads(json.dumps(facts, allow_nan=False)) == facts
    assert facts["counts"]["movie_frames"] == 30
    assert facts["exposure_s"] == [0.005, 0.005]
    assert abs(facts["rate_hz"]["imu"] - 200) < 1e-6
    for word in ("64x96", "not logged", "30 frames", "200.0 Hz", "5.000 ms", "20.000 ms"):
        assert word in text
    assert as_json(read_capture(writer.folder)) == facts


def test_dropped_rows_and_skipped_frames_are_explained(writer):
    """Each dropped row and each run of skipped frames has a reason."""
    writer.imu_ns = [t for t in writer.imu_ns if t > writer.stamps_ns[3]]
    writer.imu_ns.insert(40, writer.imu_ns[39])
    facts, text, code = inspect_capture(writer.write())
    assert code == 0
    assert facts["dropped"] == {"gyro_accel.csv": {"row written twice": 1}}
    assert [run["codes"] for run in facts["skipped"]] == [["no-imu"]] * len(facts["skipped"])
    assert {run["first"] for run in facts["skipped"]} <= {0, 1, 2, 3}
    assert "before the first IMU row" in text


def test_an_unusable_capture_shows_its_readable_parts(writer):
    """With a broken movie the tables are still counted, the error comes first, and the exit code is 4."""
    writer.write()
    (writer.folder / "movie.mp4").write_bytes(b"cut")
    facts, text, code = inspect_capture(writer.folder)
    assert code == 4
    assert facts["usable"] is False
    assert facts["notes"][0]["severity"] == "error"
    assert facts["counts"]["gyro_accel.csv rows"] == len(writer.imu_ns)
    assert "NOT usable" in text
    assert json.dumps(facts, allow_nan=False)


def test_a_missing_path_exits_with_4(tmp_path):
    """A path that does not exist is an unusable capture."""
    facts, text, code = inspect_capture(tmp_path / "none")
    assert code == 4
    assert "no such folder" in text
    assert facts["notes"]


def test_a_broken_profile_is_a_note(writer):
    """An invalid camera.yaml is reported before any work; the capture itself is usable."""
    writer.write()
    (writer.folder / "camera.yaml").write_text("virest_profile: 1\nimage: {width: 64, height: 96}\nshuter: {}\n")
    facts, text, code = inspect_capture(writer.folder)
    assert code == 0
    assert "did you mean 'shutter'" in text
    assert facts["profile"] is None
