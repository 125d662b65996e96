"""Folders of pictures with timestamps."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from capture_writing import GYRO_7
from other_writing import colour_pictures, imu_rows, stamps

from virest.capture.folder import read_capture
from virest.capture.pictures import decode_picture, read_picture_list
from virest.capture.video import probe_movie, read_frames
from virest.errors import CaptureError, ClockError, VideoError


def write_pictures(folder: Path, names: list[str]) -> list[np.ndarray]:
    """Write pictures with these names as PNG or another lossless format."""
    pictures = colour_pictures(len(names))
    for name, picture in zip(names, pictures, strict=True):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), picture[..., ::-1])
    return pictures


def write_samples(folder: Path, name: str) -> None:
    """The same samples in MARSLogger's, EuRoC's or TUM-VI's format."""
    rows = imu_rows(stamps(6)[0], stamps(6)[-1])
    separator, head = (" ", "# timestamp[ns] w a") if name.endswith(".txt") else (",", GYRO_7)
    (folder / name).write_text("\n".join([head, *(separator.join(map(str, (t, *v))) for t, v in rows)]) + "\n")


@pytest.mark.parametrize(
    ("kind", "samples"),
    [("names", "imu.csv"), ("data", "gyro_accel.csv"), ("tum", "imu.txt"), ("order", "gyro_accel.csv")],
)
def test_every_timestamp_format_gives_the_same_capture(tmp_path, kind, samples):
    """Times in file names, a list in ns, a list in seconds, and timestamps in order give the same frames."""
    times = stamps(6)
    names = {
        "names": [f"{t}.png" for t in times],
        "data": [f"p{k}.png" for k in range(6)],
        "tum": [f"rgb/{t // 10**9}.{t % 10**9:09d}.png" for t in times],
        "order": [f"images/frame{k + 8}.png" for k in range(6)],
    }[kind]
    pictures = write_pictures(tmp_path, names)
    write_samples(tmp_path, samples)
    match kind:
        case "data":
            lines = [f"{t},{name}" for t, name in zip(times, names, strict=True)]
            (tmp_path / "data.csv").write_text("#timestamp [ns],filename\n" + "\n".join(lines) + "\n")
        case "tum":
            lines = [f"{t // 10**9}.{t % 10**9:09d} {name}" for t, name in zip(times, names, strict=True)]
            (tmp_path / "rgb.txt").write_text("# color images\n# timestamp filename\n" + "\n".join(lines))
        case "order":
            (tmp_path / "frame_timestamps.txt").write_text("\n".join(["Frame timestamp[nanosec]", *map(str, times)]))
    capture = read_capture(tmp_path)
    assert capture.kind == "pictures"
    assert [frame.timestamp_ns for frame in capture.frames] == times
    assert capture.imu.gyro_rad_s[0].tolist() == [0.1, -0.25, 0.75]
    assert capture.imu.accel_m_s2[0].tolist() == [0.3, 9.7, -0.4]
    index = probe_movie(capture.movie)
    for number, picture in read_frames(capture.movie, index, 1, 4):
        np.testing.assert_array_equal(picture, pictures[number])


def test_a_quoted_list_is_read(tmp_path):
    """CSV writers put names in quotes."""
    write_pictures(tmp_path, [f"p{k}.png" for k in range(6)])
    rows = [f'{time},"p{k}.png"' for k, time in enumerate(stamps(6))]
    (tmp_path / "data.csv").write_text("\n".join(['"time","name"', *rows]) + "\n")
    assert read_picture_list(tmp_path / "data.csv").names == tuple(f"p{k}.png" for k in range(6))


def test_timestamps_in_order_need_one_picture_each(tmp_path):
    """With a surplus picture the assignment of timestamps is ambiguous."""
    write_pictures(tmp_path, [f"{k}.png" for k in range(7)])
    (tmp_path / "frame_timestamps.txt").write_text("\n".join(["Frame timestamp[nanosec]", *map(str, stamps(6))]) + "\n")
    with pytest.raises(ClockError, match=r"6 of 6 stamps.*7 pictures"):
        read_picture_list(tmp_path / "frame_timestamps.txt")


def test_special_files_are_not_read_as_pictures(tmp_path):
    """A pipe named like a picture does not hang, and a folder without pictures is rejected."""
    os.mkfifo(tmp_path / "1.png")
    with pytest.raises(VideoError):
        read_picture_list(tmp_path)
    assert decode_picture(tmp_path / "1.png") is None
    with pytest.raises(CaptureError):
        read_capture(tmp_path)


def test_a_picture_that_claims_a_huge_size_is_not_decoded(tmp_path):
    """A few bytes cannot request the memory of a picture of 40000 × 40000."""
    header = b"IHDR" + struct.pack(">IIBBBBB", 40_000, 40_000, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    (tmp_path / "5.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk)
    assert decode_picture(tmp_path / "5.png") is None
