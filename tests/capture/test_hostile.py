"""Hostile files are rejected quickly in one line, without the memory that they claim."""

import os
import resource
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_writing import PERIOD_NS, moving_pictures, write_movie

from virest.capture import files, video
from virest.capture.folder import read_capture
from virest.capture.marslogger_android import (
    read_edge_epochs,
    read_frame_timestamps,
    read_gyro_accel,
    read_movie_metadata,
)
from virest.capture.pictures import read_picture_list
from virest.capture.video import probe_movie, read_frames, read_gray
from virest.errors import CaptureError, VideoError

TABLE = (b"moov", b"trak", b"mdia", b"minf", b"stbl")
GYRO_HEAD = "Timestamp[nanosec], gx[rad/s], gy[rad/s], gz[rad/s], ax[m/s^2], ay[m/s^2], az[m/s^2]\n"


def find_box(data: bytes, path: tuple[bytes, ...], start: int = 0, end: int | None = None) -> int:
    """Position of a box in an MP4 file."""
    end = len(data) if end is None else end
    while start + 8 <= end:
        size, kind = struct.unpack_from(">I4s", data, start)
        if kind == path[0]:
            return start if len(path) == 1 else find_box(data, path[1:], start + 8, start + size)
        start += size
    raise ValueError(path)


def grown_by_mb(function: Callable[[], object]) -> float:
    """Growth of this process's peak memory."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    function()
    return (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024


def outcome_of(reader: Callable[[Path], Any], path: Path) -> Any:
    """The result of a reader, or the text of its error."""
    try:
        return reader(path)
    except CaptureError as error:
        return str(error)


@pytest.fixture
def movie(tmp_path: Path) -> Path:
    """An intact movie of a few frames, 64 × 96."""
    path = tmp_path / "movie.mp4"
    write_movie(path, moving_pictures(6), [i * PERIOD_NS for i in range(6)])
    return path


# ── movies ───────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("count", [1 << 24, 1 << 28, 0x7FFFFFFF])
def test_a_table_that_claims_millions_of_frames_gets_no_memory(movie: Path, count: int) -> None:
    """Twelve bytes claim an index of a gigabyte."""
    data = bytearray(movie.read_bytes())
    struct.pack_into(">II", data, find_box(data, (*TABLE, b"stsz")) + 12, 1, count)
    struct.pack_into(">I", data, find_box(data, (*TABLE, b"stsc")) + 20, count)
    movie.write_bytes(data)

    def refused() -> None:
        with pytest.raises(VideoError, match="no frames"):
            probe_movie(movie)

    assert grown_by_mb(refused) < 300


def test_a_frame_of_two_gigabytes_ends_the_movie(movie: Path) -> None:
    """The frames before it are read; the claim does not cause a memory error."""
    data = bytearray(movie.read_bytes())
    sizes = find_box(data, (*TABLE, b"stsz")) + 20
    struct.pack_into(">I", data, sizes + 4 * 5, 0x7FFFFFFF)
    movie.write_bytes(data)
    index = probe_movie(movie)
    assert len(index) == 5
    assert [frame for frame, picture in read_gray(movie, index, range(5)) if picture is not None] == [0, 1, 2, 3, 4]


def test_a_header_that_claims_huge_frames_is_not_trusted(movie: Path) -> None:
    """The container states 50000 × 50000, but the frames are small: they are read as they are, or rejected."""
    data = bytearray(movie.read_bytes())
    struct.pack_into(">HH", data, find_box(data, (*TABLE, b"stsd")) + 48, 50000, 50000)
    movie.write_bytes(data)
    found = outcome_of(probe_movie, movie)
    assert "picture size" in found if isinstance(found, str) else (found.width, found.height) == (64, 96)


def test_frames_above_the_pixel_limit_are_not_decoded(movie: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The limit also applies in the decoder, where a later header may change the size."""
    index = probe_movie(movie)
    monkeypatch.setattr(video, "MAX_PIXELS", 64 * 96 - 1)
    with pytest.raises(VideoError, match="picture size 64x96"):
        probe_movie(movie)
    assert all(picture is None for _, picture in read_frames(movie, index, 0, 3))
    monkeypatch.setattr(video, "MAX_PIXELS", 64 * 96)
    assert all(picture is not None for _, picture in read_gray(movie, index, range(3)))


def test_the_number_of_frames_has_a_limit(movie: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The error states the limit."""
    monkeypatch.setattr(video, "MAX_FRAMES", 3)
    with pytest.raises(VideoError, match="more than 3 frames"):
        probe_movie(movie)


# ── tables ───────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_line_of_ten_gigabytes_is_refused_after_its_first_bytes(tmp_path: Path) -> None:
    """The file is sparse; reading it completely would take very long."""
    path = tmp_path / "gyro_accel.csv"
    path.write_text(GYRO_HEAD + "1" * (2 * files.MAX_LINE_BYTES))
    with path.open("r+b") as file:
        file.truncate(10 << 30)
    assert grown_by_mb(lambda: outcome_of(read_gyro_accel, path)) < 50
    assert "more than" in outcome_of(read_gyro_accel, path)
    with path.open("r+b") as file:
        file.truncate(3 << 30)
    with pytest.raises(CaptureError, match=r"NUL bytes|line has more than"):
        read_gyro_accel(path)


HUGE = ["9223372036854775807", "9223372036854775808", "1" * 400, "-9223372036854775808", "1e999", "nan", "0x7fff"]


@pytest.mark.parametrize("number", HUGE)
def test_numbers_that_overflow_give_a_dropped_row_or_one_line(tmp_path: Path, number: str) -> None:
    """Times and values of every table are tried."""
    rows = [f"{1_000_000_000 + i * 5_000_000},0.1,0.2,0.3,0,9.8,0" for i in range(8)]
    for column in range(7):
        fields = rows[4].split(",")
        fields[column] = number
        path = tmp_path / "gyro_accel.csv"
        path.write_text(GYRO_HEAD + "\n".join([*rows[:4], ",".join(fields), *rows[5:]]) + "\n")
        _reads_or_refuses(read_gyro_accel, path)
    (tmp_path / "frame_timestamps.txt").write_text(f"Frame timestamp[nanosec]\n1000\n{number}\n2000000\n3000000\n")
    _reads_or_refuses(read_frame_timestamps, tmp_path / "frame_timestamps.txt")
    head = "Timestamp[nanosec],fx[px],fy[px],Frame No.,Exposure time[nanosec],Sensor frame duration[nanosec],ISO\n"
    (tmp_path / "movie_metadata.csv").write_text(head + f"1000,{number},1,2,{number},{number},{number}\n")
    _reads_or_refuses(read_movie_metadata, tmp_path / "movie_metadata.csv")
    (tmp_path / "edge_epochs.txt").write_text(f"{number} 0 {number}\n{number} {number}\n")
    _reads_or_refuses(read_edge_epochs, tmp_path / "edge_epochs.txt")


def _reads_or_refuses(reader: Callable[[Path], object], path: Path) -> None:
    """The reader returns rising times or a one-line error."""
    found = outcome_of(reader, path)
    if isinstance(found, str):
        assert len(found.splitlines()) == 1
        assert len(found) < 400
    elif hasattr(found, "time_ns"):
        assert (np.diff(found.time_ns) > 0).all()


@pytest.mark.parametrize("shift", [2**62, -(2**62), 2**63 - 1, -(2**63)])
@pytest.mark.parametrize("name", ["edge_epochs.txt", "gyro_accel.csv", "frame_timestamps.txt"])
def test_distant_clocks_give_one_line_or_a_warning(writer, name: str, shift: int) -> None:
    """Differences of timestamps do not fit in 64 bits."""
    writer.write()
    path = writer.folder / name
    if name == "edge_epochs.txt":
        text = "#Camera frame timestamp source according to CameraCharacteristics.SENSOR_INFO_TIMESTAMP_SOURCE is "
        path.write_text(f"{text}SENSOR_INFO_TIMESTAMP_SOURCE_UNKNOWN\n{shift} 0 {shift}\n")
    else:
        head, *rows = path.read_text().splitlines()
        moved = [f"{int(row.partition(',')[0]) + shift},{row.partition(',')[2]}".rstrip(",") for row in rows]
        path.write_text("\n".join([head, *moved]) + "\n")
    found = outcome_of(read_capture, writer.folder)
    if isinstance(found, str):
        assert len(found.splitlines()) == 1
    else:
        assert any(note.severity == "warning" and (name in note.text or "slid" in note.text) for note in found.notes)
        assert all(abs(frame.time_s) < 1e6 for frame in found.frames)


def test_a_picture_name_of_a_thousand_letters_is_refused(tmp_path: Path) -> None:
    """No file system has such a name; the picture counts as missing."""
    (tmp_path / "data.csv").write_text(f"#timestamp [ns],filename\n1000000000,{'a' * 1000}.png\n")
    assert "none of its 1 rows has a picture" in outcome_of(read_picture_list, tmp_path / "data.csv")


def test_pipes_anywhere_in_a_folder_do_not_hang(writer) -> None:
    """A pipe replaces each file that readers look for."""
    writer.write()
    names = ("camera.yaml", "frames.csv", "imu.csv", "raw_accel_gyro.csv", "a.gcsv", "data.csv", "mav0", "imu0", "data")
    for name in names:
        (writer.folder / name).unlink(missing_ok=True)
        os.mkfifo(writer.folder / name)
    program = (
        "import sys, pathlib; from virest.capture.folder import read_capture; from virest.errors import VirestError\n"
        "try:\n    read_capture(pathlib.Path(sys.argv[1]))\nexcept VirestError as error:\n    print(error)"
    )
    command = [sys.executable, "-c", program, str(writer.folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert (done.returncode, done.stderr) == (0, "")
