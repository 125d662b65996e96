"""Inputs found by the fuzzer (tests/fuzz_readers.py) and similar ones: each gives a one-line error."""

import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_writing import PERIOD_NS, moving_pictures, write_movie

from virest.app.settings import read_settings
from virest.camera.kalibr import parse_imu
from virest.camera.yaml_mapping import load_yaml_mapping
from virest.capture.euroc import parse_sensor
from virest.capture.marslogger_android import read_gyro_accel
from virest.capture.pictures import read_picture_list
from virest.capture.profile_source import read_any_profile
from virest.capture.video import MovieIndex, probe_movie
from virest.errors import VirestError

LENS = b"cam0: {intrinsics: [1, 1, 1, 1], "
PROFILE = b"virest_profile: 1\nimage: {width: 64, height: 48}\n"


def refusal(reader: Callable[[Path], Any], path: Path, data: bytes) -> str:
    """The error of a reader for these bytes, with numpy's warnings treated as errors."""
    path.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(VirestError) as caught:
            reader(path)
    text = str(caught.value)
    assert len(text.splitlines()) == 1
    assert path.name in text
    assert len(text) < 400
    return text


FOUND_YAML = {
    "unknown key below a line": (b"_p: 0", "unknown key '_p'"),
    "unknown key of nothing": (b'"": 1', "unknown key ''"),
    "unknown key like a kind of pydantic's": (PROFILE + b"shutter: {literal: 1}", "unknown key 'shutter.literal'"),
    "number with line ends": (PROFILE + b'response: {kind: gamma, gamma: "0\n\n\n\n."}', "gamma: is not a number"),
    "number that Python writes only in part": (PROFILE + b"x: 0x" + b"f" * 5000, "digits"),
    "key that Python writes only in part": (b"0x" + b"f" * 5000 + b": 1", "digits"),
    "number of base 60 beyond a float": (b"x: 1" + b":1" * 400 + b".5", "digits"),
    "tag for true or false": (b"x: !!bool y", "does not match its form"),
    "tag for a number, of nothing": (b'x: !!int ""', "does not match its form"),
    "tag for a time": (b"x: !!timestamp soon", "does not match its form"),
    "axes beyond a float's square": (
        PROFILE + b"imu: {T_cam_imu: [[1e+200,1e+200,0,0],[1e+200,-1e+200,0,0],[0,0,1,0]]}",
        "is too large",
    ),
    "endless picture": (LENS + b"resolution: [.inf, 480]}", "cam0.resolution"),
    "lens of no number": (b"cam0: {resolution: [64, 48], intrinsics: [1, 1, 1, .nan]}", "cam0.intrinsics"),
    "list of models": (LENS + b"resolution: [64, 48], distortion_model: [radtan]}", "distortion_model"),
    "model of two lines": (b'cam0: {camera_model: "a\\nb"}', "camera_model"),
}


@pytest.mark.parametrize("case", FOUND_YAML)
def test_malformed_profiles_give_a_specific_error(tmp_path: Path, case: str) -> None:
    """Malformed keys, numbers and tags in virest's and Kalibr's profiles."""
    data, says = FOUND_YAML[case]
    assert says in refusal(read_any_profile, tmp_path / "camera.yaml", data)


def test_a_settings_key_with_an_underscore_is_named_with_a_suggestion(tmp_path: Path) -> None:
    """The message names the key itself and the nearest known key."""
    text = refusal(read_settings, tmp_path / "settings.yaml", b"_deblur: tiled")
    assert "unknown key '_deblur', did you mean 'deblur'?" in text


def test_a_noise_value_beyond_a_float_is_refused(tmp_path: Path) -> None:
    """Kalibr's imu.yaml with an integer of 401 digits."""
    refusal(lambda path: parse_imu(load_yaml_mapping(path)), tmp_path / "imu.yaml", b"update_rate: 1" + b"0" * 400)


POSES = {
    "beyond a float's square": b"1.0e+200, 1.0e+200, 0, 0, 1.0e+200, -1.0e+200, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1",
    "no last row": b"0, -1, 0, 0.02, 1, 0, 0, 0.06, 0, 0, 1, 0.01, 0, 0, 0, 0",
    "large last number": b"0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1" + b"0" * 240,
}


@pytest.mark.parametrize("pose", POSES)
def test_a_sensor_pose_that_is_not_rigid_is_refused(tmp_path: Path, pose: str) -> None:
    """Products that overflow, and a matrix without an inverse."""
    rows = b"[" + POSES[pose] + b"]"
    movie = MovieIndex(64, 48, 1, np.arange(2), (0,), (0,))  # type: ignore[arg-type]

    def read(path: Path) -> None:
        parse_sensor(load_yaml_mapping(path), np.eye(4), path.name, movie, [])

    assert "T_BS" in refusal(read, tmp_path / "sensor.yaml", b"T_BS: {data: " + rows + b"}")


def test_a_header_with_tabs_in_its_names_is_recognised(tmp_path: Path) -> None:
    """White space in column names does not prevent the file's recognition; it is then read or rejected."""
    refusal(read_gyro_accel, tmp_path / "gyro_accel.csv", b"oc],gx[rad/\t\ts],ad")
    path = tmp_path / "gyro_accel.csv"
    path.write_bytes(
        b"Timestamp[nanosec], gx[rad/\ts], gy[rad/s], gz[rad/s], ax[m/s^2], ay[m/s^2], az[m/s^2]\n"
        b"1000,0.1,0.2,0.3,1,2,9\n2000,0.2,0.3,0.4,1,2,9\n"
    )
    assert read_gyro_accel(path).gyro_rad_s.tolist() == [[0.1, 0.2, 0.3], [0.2, 0.3, 0.4]]


def test_a_time_with_tabs_and_other_line_ends_is_shown_in_one_line(tmp_path: Path) -> None:
    """Python treats more characters as line ends than the table reader does."""
    header = b"Timestamp[nanosec], gx[rad/s], gy[rad/s], gz[rad/s], ax[m/s^2], ay[m/s^2], az[m/s^2]\n"
    assert "'12 3<tab>4'" in refusal(read_gyro_accel, tmp_path / "gyro_accel.csv", header + b"12\x0b3\t4,1,2,3,4,5,6\n")


def test_a_picture_name_beyond_the_last_column_is_refused(tmp_path: Path) -> None:
    """Sixteen fields are read; the error mentions field 17."""
    assert "field 17" in refusal(read_picture_list, tmp_path / "data.csv", b"1," + b"," * 15 + b"a.png\n")


def test_picture_names_with_superscript_digits_are_sorted(tmp_path: Path) -> None:
    """Python treats a superscript two as a digit, but it is not a number."""
    for name in ("²10.png", "²9.png"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "times.txt").write_text("1000000000\n2000000000\n")
    assert read_picture_list(tmp_path / "times.txt").names == ("²9.png", "²10.png")


def test_a_sample_larger_than_its_movie_is_not_a_memory_error(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """FFmpeg reports 512 MB in a file of 4 kB as lack of memory.

    The log reports the impossible size, and the rest is read.
    """
    path = tmp_path / "movie.mp4"
    write_movie(path, moving_pictures(4, width=32, height=32), [i * PERIOD_NS for i in range(4)])
    data = bytearray(path.read_bytes())
    struct.pack_into(">I", data, data.index(b"stsz") + 16 + 4 * 2, 0x20000667)
    path.write_bytes(data)
    assert len(probe_movie(path)) == 2
    assert "claims an impossible size" in caplog.text
    assert "memory" not in caplog.text
