"""Sensor Logger, OpenCamera-Sensors and Stray Scanner, with fixtures written from their documented formats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from other_writing import write_film

from virest.capture.detect import choose_reader
from virest.capture.folder import read_capture, resolve_profile
from virest.capture.sensor_logger import named_start_ns
from virest.errors import CaptureError, ClockError, ImuError, VideoError

COUNT = 16
EPOCH_MS = 1_770_510_090_123
G = 9.80665
RATES, FORCE = (0.1, -0.25, 0.75), (0.3, 9.7, -0.4)
"""x, y, z of every sample; all differ, so that a swap shows."""


def csv_rows(start_ns: int, order: str, values: tuple[float, float, float]) -> str:
    """Rows of time, seconds_elapsed and three axes in the given order, from 1 s before to 2 s after the start."""
    named = dict(zip("xyz", values, strict=True))
    times = range(start_ns - 10**9, start_ns + 2 * 10**9, 10**7)
    rows = [f"{t},{(t - start_ns) / 1e9:.9f},{','.join(str(named[axis]) for axis in order)}" for t in times]
    return "\n".join([f"time,seconds_elapsed,{','.join(order)}", *rows]) + "\n"


@pytest.fixture
def sensor_logger(tmp_path: Path) -> Path:
    """An Android export with the axes in the app's order z, y, x."""
    folder = tmp_path / "2026-02-08_00-21-30"
    (folder / "Camera").mkdir(parents=True)
    write_film(folder / "Camera" / f"{EPOCH_MS}.mp4", COUNT)
    start_ns = EPOCH_MS * 10**6
    (folder / "Gyroscope.csv").write_text(csv_rows(start_ns, "zyx", RATES))
    (folder / "TotalAcceleration.csv").write_text(csv_rows(start_ns + 3, "zyx", FORCE))
    (folder / "Metadata.csv").write_text("version,device name,platform\n3,Pixel 7,android\n")
    return folder


def test_a_sensor_logger_export_is_read(sensor_logger: Path) -> None:
    """Axes are read by name, frames start at the time in the movie's name, and the offset stays unknown."""
    capture = read_capture(sensor_logger)
    assert capture.kind == "Sensor Logger"
    assert len(capture.usable) == COUNT
    assert capture.frames[0].timestamp_ns == EPOCH_MS * 10**6
    np.testing.assert_allclose(capture.imu.gyro_rad_s[5], RATES)
    np.testing.assert_allclose(capture.imu.accel_m_s2[5], FORCE)
    assert resolve_profile(capture)[0].time_offset_s is None
    assert "exposure-unknown" in {note.code for note in capture.notes}


def test_ios_accelerations_change_their_sign(sensor_logger: Path) -> None:
    """iOS logs gravity instead of the specific force. Without TotalAcceleration.csv, two other files are added."""
    (sensor_logger / "Metadata.csv").write_text("version,platform\n3,ios\n")
    np.testing.assert_allclose(read_capture(sensor_logger).imu.accel_m_s2[5], -np.array(FORCE))
    (sensor_logger / "TotalAcceleration.csv").unlink()
    start_ns = EPOCH_MS * 10**6
    (sensor_logger / "Accelerometer.csv").write_text(csv_rows(start_ns, "zyx", (0.1, 0.2, 0.3)))
    assert np.isnan(read_capture(sensor_logger).imu.accel_m_s2).all()
    (sensor_logger / "Gravity.csv").write_text(csv_rows(start_ns, "zyx", (1.0, -9.0, 0.5)))
    np.testing.assert_allclose(read_capture(sensor_logger).imu.accel_m_s2[5], (-1.1, 8.8, -0.8))


def test_quoted_tables_of_sensor_logger_are_read(sensor_logger: Path) -> None:
    """As R and other writers leave them."""
    for path in sensor_logger.glob("*.csv"):
        rows = [",".join(f'"{field}"' for field in line.split(",")) for line in path.read_text().splitlines()]
        path.write_text("\n".join(rows) + "\n")
    np.testing.assert_allclose(read_capture(sensor_logger).imu.gyro_rad_s[5], RATES)


def test_nanoseconds_that_were_floats_are_refused(sensor_logger: Path) -> None:
    """The time is named; the gyroscope was blamed."""
    path = sensor_logger / "Gyroscope.csv"
    path.write_text(path.read_text().replace("3000000,", "3000000.0,"))
    with pytest.raises(ClockError, match=r"time '\d+\.0' has lost its digits"):
        read_capture(sensor_logger)


@pytest.mark.parametrize(
    ("stem", "start_ns"),
    [
        ("1770510090", 1770510090 * 10**9),
        (str(EPOCH_MS), EPOCH_MS * 10**6),
        ("1770510090666860288", 1770510090666860288),
    ],
)
def test_the_start_time_is_read_from_the_movie_s_name(stem: str, start_ns: int) -> None:
    """The number of digits distinguishes seconds, milliseconds and nanoseconds; other names give no start time."""
    assert named_start_ns(Path(f"{stem}.mp4")) == start_ns
    assert named_start_ns(Path("VID_0001.mp4")) is None


def test_a_movie_without_a_start_begins_with_the_samples(sensor_logger: Path) -> None:
    """A renamed movie is still read, and a note states the assumption."""
    movie = sensor_logger / "Camera" / f"{EPOCH_MS}.mp4"
    movie.rename(movie.with_name("clip.mp4"))
    capture = read_capture(sensor_logger)
    assert capture.frames[0].timestamp_ns == EPOCH_MS * 10**6 - 10**9
    assert "stamps-ambiguous" in {note.code for note in capture.notes}


def test_a_gyroscope_file_without_axes_is_refused(sensor_logger: Path) -> None:
    """The error lists the file's columns."""
    (sensor_logger / "Gyroscope.csv").write_text("time,seconds_elapsed,a,b,c\n1,2,3,4,5\n")
    with pytest.raises(ImuError, match="columns are time, seconds_elapsed, a, b, c"):
        read_capture(sensor_logger)


# ── OpenCamera-Sensors ───────────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture(params=["beside", "above"])
def open_camera(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """The sensors' folder with the movie inside it, or in the parent folder under the sensors' name."""
    folder = tmp_path / "20260208_002130"
    folder.mkdir()
    name, start_ns = "VID_20260208_002130", 5_000_000_000_000
    steps = write_film((folder if request.param == "beside" else tmp_path) / f"{name}.mp4", COUNT, start_ns)
    if request.param == "above":
        write_film(tmp_path / "VID_20250101_000000.mp4", 4)
    times = range(start_ns - 10**9, start_ns + 2 * 10**9, 5 * 10**6)
    rows = {"gyro": RATES, "accel": FORCE}
    for sensor, values in rows.items():
        (folder / f"{name}_{sensor}.csv").write_text("".join(f"{','.join(map(str, values))},{t}\n" for t in times))
    (folder / f"{name}_timestamps.csv").write_text("".join(f"{t}\n" for t in steps))
    return folder


def test_an_opencamera_recording_is_read(open_camera: Path) -> None:
    """Frames have timestamps on the sensors' clock; axes are Android's."""
    capture = read_capture(open_camera)
    assert capture.kind == "OpenCamera-Sensors"
    assert len(capture.usable) == COUNT
    assert capture.frames[0].timestamp_ns == 5_000_000_000_000
    assert capture.frames[9].time_s == pytest.approx(9 * 0.0334 + 0.017)
    np.testing.assert_allclose(capture.imu.gyro_rad_s[7], RATES)
    np.testing.assert_allclose(capture.imu.accel_m_s2[7], FORCE)


def test_the_error_for_an_opencamera_folder_names_the_missing_movie(open_camera: Path) -> None:
    """The error gives the expected file name."""
    for movie in (*open_camera.glob("*.mp4"), *open_camera.parent.glob("VID_20260208*.mp4")):
        movie.unlink()
    with pytest.raises(VideoError, match=r"vid_20260208_002130\.mp4"):
        read_capture(open_camera)


@pytest.mark.parametrize("open_camera", ["beside"], indirect=True)
def test_what_an_opencamera_table_loses_is_counted(open_camera: Path) -> None:
    """Rows without numbers, out of order or twice are dropped with their reason; the header is no row."""
    gyro, stamps = (next(open_camera.glob(f"*_{name}.csv")) for name in ("gyro", "timestamps"))
    rows = gyro.read_text().splitlines()
    rows[100], rows[200], rows[300] = rows[100].replace("0.1,", "nan,"), "cut", rows[310]
    gyro.write_text("\n".join(["X,Y,Z,time", *rows]) + "\n")
    times = stamps.read_text().splitlines()
    stamps.write_text("\n".join([*times[:5], times[4], *times[5:]]) + "\n")
    capture = read_capture(open_camera)
    dropped = {key: number for key, number in capture.counts.items() if "dropped" in key}
    assert dropped == {
        f"{gyro.name} dropped: cut or unreadable row": 2,
        f"{gyro.name} dropped: time falls or leaps": 1,
        f"{stamps.name} dropped: time equals its predecessor's": 1,
    }
    assert len(capture.usable) == COUNT
    assert capture.counts["gyro_rows"] == len(rows)


@pytest.mark.parametrize("open_camera", ["beside"], indirect=True)
@pytest.mark.parametrize("name", ["gyro", "accel", "timestamps"])
def test_opencamera_tables_are_read_within_bounds(open_camera: Path, name: str) -> None:
    """Endless lines, bytes that are no text, folders and pipes are refused before they are read."""
    path = next(open_camera.glob(f"*_{name}.csv"))
    for content, says in ((b"1," * 40_000, "a line has more than"), (b"\0\n", "has NUL bytes")):
        path.write_bytes(content)
        with pytest.raises(CaptureError, match=says):
            read_capture(open_camera)
    path.unlink()
    path.mkdir()
    with pytest.raises(CaptureError, match="is a folder"):
        read_capture(open_camera)


# ── Stray Scanner ────────────────────────────────────────────────────────────────────────────────────────────────────


def write_scan(folder: Path, gravity: float) -> Path:
    """A scan whose accelerations have gravity of this magnitude."""
    folder.mkdir()
    start_s = 412.5
    steps = write_film(folder / "rgb.mp4", COUNT, width=128, height=96)
    (folder / "camera_matrix.csv").write_text("110.5, 0.0, 63.0\n0.0, 111.0, 48.5\n0.0, 0.0, 1.0")
    rows = [f"{start_s + t / 1e9:.9f}, {k:06d}, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0" for k, t in enumerate(steps)]
    (folder / "odometry.csv").write_text("timestamp, frame, x, y, z, qx, qy, qz, qw\n" + "\n".join(rows) + "\n")
    force = ", ".join(f"{-v / G * gravity:.9f}" for v in FORCE)
    samples = [f"{start_s - 1 + k / 100:.6f}, {force}, {RATES[0]}, {RATES[1]}, {RATES[2]}" for k in range(300)]
    head = "timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\n"
    (folder / "imu.csv").write_text(head + "\n".join(samples) + "\n")
    return folder


@pytest.mark.parametrize("gravity", [1.0, G])
def test_a_stray_scan_is_read(tmp_path: Path, gravity: float) -> None:
    """Intrinsics come from the file; accelerations in g or m/s² become specific force."""
    capture = read_capture(write_scan(tmp_path / "71de12f9", gravity))
    assert capture.kind == "Stray Scanner"
    assert len(capture.usable) == COUNT
    assert capture.frames[9].time_s == pytest.approx(9 * 0.0334 + 0.017, abs=2e-6)
    np.testing.assert_allclose(capture.imu.gyro_rad_s[7], RATES)
    np.testing.assert_allclose(capture.imu.accel_m_s2[7], FORCE, atol=1e-6)
    lens = resolve_profile(capture)[0].intrinsics
    assert lens is not None
    assert (lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px) == (110.5, 111.0, 63.0, 48.5)


def test_rows_that_a_scan_loses_are_counted(tmp_path: Path) -> None:
    """Rows of the frames' file too, which has no metadata beside it."""
    folder = write_scan(tmp_path / "scan", 1.0)
    rows = (folder / "odometry.csv").read_text().splitlines()
    (folder / "odometry.csv").write_text("\n".join([*rows[:5], rows[4], *rows[5:]]) + "\n")
    assert read_capture(folder).counts["odometry.csv dropped: time equals its predecessor's"] == 1


def test_accelerations_without_gravity_are_not_used(tmp_path: Path) -> None:
    """Values in an unknown unit are left out with a note."""
    capture = read_capture(write_scan(tmp_path / "scan", 0.05))
    assert not capture.imu.has_accelerometer
    assert "accel-implausible" in {note.code for note in capture.notes}


def test_a_damaged_matrix_is_an_error(tmp_path: Path) -> None:
    """Text, or intrinsics of another picture size, are rejected."""
    folder = write_scan(tmp_path / "scan", 1.0)
    wrong = ("9e4,0,1\n0,9e4,1", "110,0,63\n0,0,48", "110,0,63\n0,nan,48", "110,0,63\n0,1e9,48")
    cases = [("one, two\n", "not a 3 x 3 matrix"), *((f"{text}\n0,0,1\n", "do not fit a 128x96") for text in wrong)]
    for text, says in cases:
        (folder / "camera_matrix.csv").write_text(text)
        with pytest.raises(CaptureError, match=says):
            read_capture(folder)


def test_capture_kinds_are_recognised_by_content(sensor_logger: Path, tmp_path: Path) -> None:
    """A file with the right name alone does not make a capture of that kind."""
    (sensor_logger / "Gyroscope.csv").write_text("t,x,y,z\n1,2,3,4\n")
    with pytest.raises(CaptureError, match="holds no movie"):
        choose_reader(sensor_logger)
