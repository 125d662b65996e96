"""Gyroflow's log beside a movie, and movies with embedded samples."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from other_writing import write_film

from virest.capture.folder import read_capture, resolve_profile
from virest.capture.gyroflow import orientation_matrix, read_header, read_log
from virest.capture.source import ORIGIN_NS
from virest.errors import CaptureError, ImuError, VideoError

COUNT = 16
HEADER = {
    "version": "1.3",
    "id": "test",
    "orientation": "YxZ",
    "vendor": "potatocam",
    "videofilename": "../../etc/passwd",
    "frame_readout_time": "15.23",
    "frame_readout_direction": "1",
    "tscale": "0.001",
    "gscale": "0.00122173047",
    "ascale": "0.00048828125",
}


def write_log(path: Path, columns: int = 6, first: str = "GYROFLOW IMU LOG", **changes: str | None) -> None:
    """A log of integer counts; ``changes`` replaces keys of the header or, with None, leaves them out."""
    header = {key: value for key, value in {**HEADER, **changes}.items() if value is not None}
    counts = [39, 86, 183, -137, -1689, 986, 3, 4, 5][:columns]
    rows = [f"{t},{','.join(map(str, [counts[0] + t % 7, *counts[1:]]))}" for t in range(-40, 700, 5)]
    names = ["t", "gx", "gy", "gz", "ax", "ay", "az", "mx", "my", "mz"][: columns + 1]
    path.write_text("\n".join([first, *(f"{k},{v}" for k, v in header.items()), ",".join(names), *rows]) + "\n")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A movie with its log, and another movie without one."""
    place = tmp_path / "clip"
    place.mkdir()
    write_film(place / "C0042.MP4", COUNT)
    (place / "C0042.LRF.mp4").write_bytes(b"preview")
    write_log(place / "C0042.gcsv")
    return place


def test_a_log_and_its_movie_make_a_capture(folder):
    """The movie with the log's name is used; samples are scaled and rotated; readout and direction are read."""
    capture = read_capture(folder)
    assert (capture.kind, capture.movie.name) == ("Gyroflow", "C0042.MP4")
    assert len(capture.usable) == COUNT
    assert capture.frames[0].timestamp_ns == ORIGIN_NS
    assert capture.imu.time_s[0] == pytest.approx(-0.040)
    x = 39 + -40 % 7
    np.testing.assert_allclose(capture.imu.gyro_rad_s[0], np.array([86, -x, 183]) * 0.00122173047)
    np.testing.assert_allclose(capture.imu.accel_m_s2[0], np.array([-1689, 137, 986]) * 0.00048828125 * 9.80665)
    profile, source = resolve_profile(capture)
    assert "metadata" in source
    assert (profile.device, profile.readout_known) == ("potatocam", True)
    assert profile.shutter.readout_time_s == pytest.approx(0.01523)
    assert profile.shutter.readout_direction == "bottom_to_top"
    assert profile.time_offset_s is None
    # Gyroflow's axes: X up, Y left, Z back
    np.testing.assert_array_equal(profile.rotation_cam_imu @ np.eye(3), [[0, -1, 0], [-1, 0, 0], [0, 0, -1]])
    assert any(note.code == "exposure-unknown" for note in capture.notes)


def test_the_orientation_matches_the_telemetry_parser(tmp_path):
    """The same letters give the same vector for all tested signs and orders."""
    parser = pytest.importorskip("telemetry_parser")
    for letters in ("XYZ", "YxZ", "zXy", "xzY", "Zyx"):
        path = tmp_path / f"{letters}.gcsv"
        write_log(path, orientation=letters)
        theirs = parser.Parser(str(path)).normalized_imu()[5]
        table = read_log(path, read_header(path))
        np.testing.assert_allclose(table.gyro_rad_s[5], np.deg2rad(theirs["gyro"]), rtol=1e-9)
        np.testing.assert_allclose(table.accel_m_s2[5], theirs["accl"], rtol=1e-9)
        # the package counts from the log's first row, virest from the first frame
        assert (table.time_ns[5] - table.time_ns[0]) / 1e6 == pytest.approx(theirs["timestamp_ms"])


def test_a_log_without_accelerometer_or_scales(folder):
    """Three columns leave the acceleration unknown; without scales, counts are in rad/s and ms."""
    write_log(folder / "C0042.gcsv", columns=3, tscale=None, gscale=None, orientation="xyz", frame_readout_time=None)
    capture = read_capture(folder)
    assert not capture.imu.has_accelerometer
    assert capture.imu.gyro_rad_s[0].tolist() == [-41.0, -86.0, -183.0]
    assert not resolve_profile(capture)[0].readout_known
    assert {"mirrored-axes", "gyro-large"} <= {note.code for note in capture.notes}
    assert np.linalg.det(orientation_matrix("xyz")) < 0 < np.linalg.det(orientation_matrix("YxZ"))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"orientation": "XXZ"}, "names no three axes"),
        ({"gscale": "-1"}, "gscale"),
        ({"tscale": "fast"}, "tscale"),
        ({"frame_readout_time": "soon"}, "frame_readout_time"),
        ({"first": "something else"}, "begins with 'something else'"),
    ],
)
def test_bad_gyroflow_logs_give_an_error(folder, changes, words):
    """The error names the key or value at fault."""
    write_log(folder / "C0042.gcsv", **changes)
    with pytest.raises(CaptureError, match=words) as fault:
        read_capture(folder)
    assert fault.value.exit_code == 4


def test_an_ambiguous_movie_or_log_is_refused(folder):
    """Two logs, or several movies without the log's name, are errors."""
    write_log(folder / "C0043.gcsv")
    with pytest.raises(ImuError, match=r"2 \.gcsv files"):
        read_capture(folder)
    (folder / "C0042.gcsv").unlink()
    with pytest.raises(VideoError, match="needs one movie"):
        read_capture(folder)
    (folder / "C0043.gcsv").write_text("GYROFLOW IMU LOG\nversion,1.3\n")
    with pytest.raises(ImuError, match="has no line t,gx,gy,gz"):
        read_capture(folder)


# ── samples embedded in the movie ────────────────────────────────────────────────────────────────────────────────


def parser_of(samples: list[dict[str, object]], camera: str = "GoPro", model: str | None = "HERO9 Black"):
    """A substitute for the package that returns these samples for any movie."""
    given = SimpleNamespace(camera=camera, model=model, normalized_imu=lambda: samples)
    return SimpleNamespace(Parser=lambda _path: given)


@pytest.fixture
def film(tmp_path: Path) -> Path:
    """A folder that contains only a movie."""
    place = tmp_path / "GX010042"
    place.mkdir()
    write_film(place / "GX010042.MP4", COUNT)
    return place


def test_samples_embedded_in_the_movie(film, monkeypatch):
    """The package's ms, deg/s and m/s² are converted; rows without gyroscope values are dropped and counted."""
    samples: list[dict[str, object]] = [
        {"timestamp_ms": 5.0 * k, "gyro": (10.0, -20.0, 30.0), "accl": (9.8, 0.1, -0.2) if k % 2 else None}
        for k in range(-2, 160)
    ]
    samples.append({"timestamp_ms": 800.0, "gyro": None, "accl": (1.0, 2.0, 3.0)})
    monkeypatch.setitem(sys.modules, "telemetry_parser", parser_of(samples))
    capture = read_capture(film)
    assert capture.kind == "telemetry (GoPro HERO9 Black)"
    assert len(capture.usable) == COUNT
    assert capture.imu.time_s[:2] == pytest.approx([-0.010, -0.005])
    np.testing.assert_allclose(capture.imu.gyro_rad_s[4], np.deg2rad([10.0, -20.0, 30.0]))
    assert capture.imu.accel_m_s2[1].tolist() == [9.8, 0.1, -0.2]
    assert np.isnan(capture.imu.accel_m_s2[0]).all()
    assert capture.counts["GX010042.MP4 dropped: gyroscope null or NaN"] == 1
    assert resolve_profile(capture)[0].device == "GoPro HERO9 Black"


def test_without_the_package_the_error_names_it(film, monkeypatch):
    """The error names the extra to install."""
    monkeypatch.setitem(sys.modules, "telemetry_parser", None)
    with pytest.raises(ImuError, match=r"pip install 'virest\[telemetry\]'"):
        read_capture(film)


def test_a_movie_without_telemetry_is_refused(film, monkeypatch):
    """The real package rejects a plain movie; a movie with empty samples is rejected too."""
    pytest.importorskip("telemetry_parser")
    with pytest.raises(ImuError, match="holds no inertial samples"):
        read_capture(film)
    monkeypatch.setitem(sys.modules, "telemetry_parser", parser_of([]))
    with pytest.raises(ImuError, match="0 usable"):
        read_capture(film)
