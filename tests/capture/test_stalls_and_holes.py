"""Encoder stalls in the middle of a movie, unlogged exposures, and movies whose clock drifts."""

from __future__ import annotations

import numpy as np
import pytest
from capture_writing import PERIOD_NS, START_NS, CaptureWriter, moving_pictures, write_movie

from virest.app.inspect import as_json
from virest.capture.folder import read_capture
from virest.capture.join import align_frames, pts_tolerance_ns
from virest.capture.startup import find_stalls
from virest.errors import ClockError


def codes(capture) -> set[str]:
    """Codes of a capture's notes."""
    return {note.code for note in capture.notes}


def test_a_missing_exposure_is_interpolated(tmp_path):
    """An exposure of zero would shift the frame's middle; a note names the frame."""
    writer = CaptureWriter(tmp_path / "c", exposure_ns="5000000")
    writer.write()
    lines = (writer.folder / "movie_metadata.csv").read_text().splitlines()
    for k in range(30):
        fields = lines[1 + k].split(",")
        fields[4] = str(5_000_000 + 100_000 * k)
        lines[1 + k] = ",".join(fields)
    del lines[1 + 12]
    (writer.folder / "movie_metadata.csv").write_text("\n".join(lines) + "\n")
    capture = read_capture(writer.folder)
    assert capture.frames[12].exposure_s == pytest.approx(6.2e-3, abs=1e-5)
    note = next(note for note in capture.notes if note.code == "exposure-interpolated")
    assert note.text.endswith(": 12")


def test_repeats_long_after_the_start_are_a_stall(tmp_path):
    """Frames around the repeats may lag their timestamps and are skipped; other frames stay."""
    writer = CaptureWriter(tmp_path / "c", count=110, repeats=(80, 83))
    capture = read_capture(writer.write())
    assert "encoder-stall" in codes(capture)
    assert capture.stalls == ((74, 83),)
    out = [frame.index for frame in capture.frames if frame.skip_reason]
    assert out == list(range(74, 84))
    assert as_json(capture)["stalls"] == [[74, 83]]


def test_a_repeat_at_the_end_of_the_start_up_is_seen(tmp_path):
    """The start-up is 2 s; the first frame after it is compared with the last one in it."""
    assert read_capture(CaptureWriter(tmp_path / "c", count=110, repeats=(60, 62)).write()).stalls == ((54, 62),)


def test_a_phone_at_rest_repeats_without_a_stall(tmp_path):
    """Frames of a phone that does not turn may be equal."""
    writer = CaptureWriter(tmp_path / "c", count=110, repeats=(80, 83), rate_rad_s=0.0)
    assert not read_capture(writer.write()).stalls


def test_an_encoder_that_falls_behind_shows_in_the_unix_columns():
    """A stall lasts as long as the encoder is late; an encoder that is always irregular has no stall."""
    lag_s = np.full(200, 0.110)
    lag_s[90:96] += [0.3, 0.25, 0.2, 0.15, 0.1, 0.02]
    assert find_stalls((), lag_s, 20, 1 / 30) == ((90, 94),)
    assert find_stalls((), lag_s + 0.2 * (np.arange(200) % 3 == 0), 20, 1 / 30) == ()


def test_a_movie_that_runs_at_its_nominal_rate_joins_with_a_note(tmp_path):
    """Frames are 33.4 ms apart in the movie and 33.401 ms in the timestamps.

    99 µs in the end, far less than a lost frame.
    """
    writer = CaptureWriter(tmp_path / "c", count=100)
    writer.stamps_ns = [START_NS + k * (PERIOD_NS + 1000) for k in range(100)]
    writer.metadata_ns = [stamp + 437 for stamp in writer.stamps_ns]
    writer.write()
    write_movie(writer.folder / "movie.mp4", moving_pictures(100), [k * PERIOD_NS for k in range(100)])
    capture = read_capture(writer.folder)
    assert "stamps-drift" in codes(capture)
    assert capture.frames[-1].time_s == pytest.approx(99 * (PERIOD_NS + 1000) / 1e9, abs=1e-9)


@pytest.mark.parametrize("spoiled", ["a step", "another rate"])
def test_only_a_slow_drift_is_joined_row_by_row(spoiled: str):
    """A step in the timestamps or a rate error of 3 % indicates a lost frame or another recording."""
    pts = np.arange(60, dtype=np.int64) * PERIOD_NS
    stamps = pts + np.where(pts > pts[57], 3_000_000, 0) if spoiled == "a step" else (pts * 1.03).astype(np.int64)
    if spoiled == "a step":
        assert align_frames(pts, stamps, pts_tolerance_ns(11_111.0)).drift_ns == 0.0
    else:
        with pytest.raises(ClockError):
            align_frames(pts, stamps, pts_tolerance_ns(11_111.0))


def test_inspect_counts_frames_and_shows_the_clock_difference(tmp_path):
    """A REALTIME source shifts nothing, but the difference in edge_epochs.txt is shown."""
    writer = CaptureWriter(tmp_path / "c")
    writer.write()
    source = "#Camera frame timestamp source according to CameraCharacteristics.SENSOR_INFO_TIMESTAMP_SOURCE is "
    writer.text(
        "edge_epochs.txt",
        [source + "SENSOR_INFO_TIMESTAMP_SOURCE_REALTIME.", "28670339410000\t28660339410000\t10000000000"],
    )
    facts = as_json(read_capture(writer.folder))
    assert facts["frames"] == {"recorded": 30, "usable": 30, "skipped": {}}
    assert facts["clock"] == {"source": "REALTIME", "shift_s": 0.0, "edge_epochs_difference_s": 10.0}
