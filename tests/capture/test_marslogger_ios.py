"""Both iOS apps: units, signs, clocks, intrinsics and errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from other_writing import write_film

from virest.capture.folder import read_capture, resolve_profile
from virest.errors import CaptureError, ClockError, ImuError, VideoError

T0_NS = 91_234_567_891_234
GYRO_HEAD = "Timestamp[nanosec], gx[rad/s], gy[rad/s], gz[rad/s], ax[m/s^2], ay[m/s^2], az[m/s^2]"
FRAME_HEAD = "Timestamp[nanosec], fx[px], fy[px], cx[px], cy[px], exposure duration[nanosec]"
ARKIT_IMU = (
    "motion_timestamp_s,unix_timestamp_s,user_acceleration_x_g,user_acceleration_y_g,user_acceleration_z_g,"
    "rotation_rate_x_rad_s,rotation_rate_y_rad_s,rotation_rate_z_rad_s,gravity_x_g,gravity_y_g,gravity_z_g,"
    "attitude_quaternion_x,attitude_quaternion_y,attitude_quaternion_z,attitude_quaternion_w"
)
POSES = [f"transform_m{row}{column}" for column in range(4) for row in range(4)]
ENTRIES = [f"intrinsics_m{row}{column}" for column in range(3) for row in range(3)]
COUNT = 20


def write_objective_c(folder: Path, *, seconds: bool = False, lens: str = "75.10, 75.20, 47.30, 31.70") -> list[int]:
    """A folder of the first app with a movie exported from the Photos app; returns the timestamps."""
    folder.mkdir(exist_ok=True)
    stamps = write_film(folder / "IMG_0042.MOV", COUNT, T0_NS)
    imu = range(T0_NS - 50_000_000, stamps[-1] + 100_000_000, 10_000_000)
    values = "0.100000, -0.200000, 0.300000, 0.490000, 9.310000, -1.470000"
    if seconds:
        head = ["#Recording starts at Sat_Jun_01_2019_10_00_00", GYRO_HEAD.replace("nanosec", "sec")]
        rows = [f"{np.float32(t / 1e9):.7f}, {values}" for t in imu]
        (folder / "raw_accel_gyro.csv").write_text("\n".join([*head, *rows]) + "\n")
        rows = [f"{np.float32(t / 1e9):.7f}, {lens}, 0.0083000" for t in stamps]
        (folder / "movie_metadata.csv").write_text("\n".join([FRAME_HEAD.replace("nanosec", "sec"), *rows]) + "\n")
        return stamps
    (folder / "gyro_accel.csv").write_text("\n".join([GYRO_HEAD, *(f"{t}, {values}" for t in imu)]) + "\n")
    rows = [f"{t}, {lens}, 8300000" for t in stamps]
    (folder / "movie_metadata.csv").write_text("\n".join([FRAME_HEAD, *rows]) + "\n")
    return stamps


def write_arkit(folder: Path, *, uptime_s: float = 91_234.567891234, spare: int = 2, transposed: bool = False) -> float:
    """A folder of the ARKit app; ``spare`` rows in the middle belong to frames that the encoder dropped."""
    folder.mkdir(exist_ok=True)
    steps = write_film(folder / "camera.mov", COUNT)
    times = sorted([*steps, *(steps[9] + 11_000_000 * (k + 1) for k in range(spare))])
    numbers = dict.fromkeys([*POSES, *ENTRIES], "0")
    numbers |= {"intrinsics_m00": "1500", "intrinsics_m11": "1502", "intrinsics_m22": "1"}
    numbers |= {"intrinsics_m20" if transposed else "intrinsics_m02": "955.5"}
    numbers |= {"intrinsics_m21" if transposed else "intrinsics_m12": "641.5"}
    head = ["frame_timestamp_s", "unix_timestamp_s", *numbers, "image_width", "image_height", "tracking_state"]
    rows = [[f"{uptime_s + t / 1e9:.9g}", "1.7e+09", *numbers.values(), "1920", "1280", "normal"] for t in times]
    (folder / "frames.csv").write_text("\n".join(",".join(row) for row in [head, *rows]) + "\n")
    imu = np.arange(uptime_s - 0.1, uptime_s + steps[-1] / 1e9 + 0.2, 0.01)
    values = "0.01,-0.02,0.03,0.1,-0.2,0.3,0.05,-0.99,-0.1,0,0,0,1"
    (folder / "imu.csv").write_text("\n".join([ARKIT_IMU, *(f"{t:.9g},1.7e+09,{values}" for t in imu)]) + "\n")
    return uptime_s


def test_objective_c_app(tmp_path):
    """Frames, exposures and intrinsics come from the rows.

    Accelerations are converted from the app's g to the standard g.
    """
    stamps = write_objective_c(tmp_path / "rec")
    capture = read_capture(tmp_path / "rec")
    assert capture.kind == "MARSLogger for iOS"
    assert [frame.timestamp_ns for frame in capture.frames] == stamps
    assert len(capture.usable) == COUNT
    assert capture.frames[5].exposure_s == pytest.approx(0.0083)
    np.testing.assert_allclose(capture.imu.gyro_rad_s[3], [0.1, -0.2, 0.3])
    np.testing.assert_allclose(capture.imu.accel_m_s2[3], np.array([0.05, 0.95, -0.15]) * 9.80665, atol=1e-5)
    profile, _ = resolve_profile(capture)
    assert profile.intrinsics is not None
    lens = profile.intrinsics
    assert (lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px) == (75.1, 75.2, 47.3, 31.7)
    # landscape with the home button on the right: the phone's right side is up, its top points to the left
    np.testing.assert_array_equal(profile.rotation_cam_imu @ [1, 0, 0], [0, -1, 0])
    np.testing.assert_array_equal(profile.rotation_cam_imu @ [0, 1, 0], [-1, 0, 0])


def test_unknown_intrinsics_of_old_phones(tmp_path):
    """Intrinsics of 1.00, 1.00, 0.50, 0.50 are placeholders for unknown values."""
    write_objective_c(tmp_path / "rec", lens="1.00, 1.00, 0.50, 0.50")
    assert resolve_profile(read_capture(tmp_path / "rec"))[0].intrinsics is None


@pytest.mark.parametrize("fy", ["null", "0", "-75.2", "9000000"])
def test_an_implausible_focal_length_is_not_used(tmp_path, fy):
    """fy is then taken from fx, for square pixels."""
    write_objective_c(tmp_path / "rec", lens=f"75.10, {fy}, 47.30, 31.70")
    lens = resolve_profile(read_capture(tmp_path / "rec"))[0].intrinsics
    assert (lens.fx_px, lens.fy_px) == (75.1, 75.1)


def test_32_bit_seconds_are_corrected_with_the_movie(tmp_path):
    """Before June 2019 times were rounded to a grid of 8 ms; the movie's PTS remove the rounding."""
    stamps = write_objective_c(tmp_path / "rec", seconds=True)
    capture = read_capture(tmp_path / "rec")
    found = np.array([frame.timestamp_ns for frame in capture.frames])
    steps = np.diff(found) - np.diff(stamps)
    assert np.abs(steps).max() < 12_000  # one tick of the movie's clock
    assert abs(found[0] - stamps[0]) < 4_000_000
    assert capture.frames[5].exposure_s == pytest.approx(0.0083)


def test_a_time_with_an_extra_digit_drops_one_row(tmp_path):
    """The app prints an extra digit if a fraction rounds up; only that row is dropped."""
    write_objective_c(tmp_path / "rec")
    path = tmp_path / "rec/gyro_accel.csv"
    lines = path.read_text().splitlines()
    lines[6] = "912345678910000000" + lines[6][lines[6].index(",") :]
    path.write_text("\n".join(lines) + "\n")
    capture = read_capture(tmp_path / "rec")
    assert capture.counts["gyro_accel.csv dropped: time falls or leaps"] == 1
    assert len(capture.usable) == COUNT


@pytest.mark.parametrize("transposed", [False, True])
def test_arkit_app(tmp_path, transposed):
    """Surplus rows are ignored, the specific force has the opposite sign, and intrinsics are scaled to the movie."""
    uptime_s = write_arkit(tmp_path / "rec", transposed=transposed)
    capture = read_capture(tmp_path / "rec")
    assert capture.kind == "MARSLogger for iOS (ARKit)"
    assert len(capture.usable) == len(capture.frames) == COUNT
    assert abs(capture.frames[0].timestamp_ns - round(uptime_s * 1e9)) < 60_000
    np.testing.assert_allclose(np.diff([f.time_s for f in capture.frames])[7:9], [0.0504, 0.0334], atol=2e-5)
    np.testing.assert_allclose(capture.imu.gyro_rad_s[0], [0.1, -0.2, 0.3])
    np.testing.assert_allclose(capture.imu.accel_m_s2[0], np.array([-0.06, 1.01, 0.07]) * 9.80665, rtol=1e-6)
    lens = resolve_profile(capture)[0].intrinsics
    assert lens is not None
    np.testing.assert_allclose([lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px], [75.0, 75.1, 47.3, 31.6])
    assert any(note.code == "stamps-slid" for note in capture.notes)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("size", ["0,0", "null,null", "1920,-1280"])
def test_arkit_pictures_of_no_size_have_no_known_lens(tmp_path, size):
    """There is no numpy warning."""
    write_arkit(tmp_path / "rec")
    path = tmp_path / "rec/frames.csv"
    path.write_text(path.read_text().replace("1920,1280", size))
    assert resolve_profile(read_capture(tmp_path / "rec"))[0].intrinsics is None


def test_arkit_times_after_a_long_uptime_are_coarse(tmp_path):
    """After 28 hours, nine digits leave 1 ms. The movie makes frame times exact, and a note reports the grid."""
    uptime_s = write_arkit(tmp_path / "rec", uptime_s=912_345.678123, spare=0)
    capture = read_capture(tmp_path / "rec")
    assert any(note.code == "coarse-times" for note in capture.notes)
    assert abs(capture.frames[0].timestamp_ns - round(uptime_s * 1e9)) < 300_000
    assert len(capture.usable) == COUNT


def test_faulty_ios_folders_give_a_specific_error(tmp_path):
    """A missing movie, two movies, another recording's movie, and missing files or columns."""
    stamps = write_objective_c(tmp_path / "a")
    (tmp_path / "a/other.mp4").write_bytes(b"x")
    with pytest.raises(VideoError, match=r"IMG_0042\.MOV, other\.mp4"):
        read_capture(tmp_path / "a")
    (tmp_path / "a/other.mp4").unlink()
    rows = [f"{stamps[0] + k * 41_000_000}, 75, 75, 47, 31, 8300000" for k in range(COUNT)]
    (tmp_path / "a/movie_metadata.csv").write_text("\n".join([FRAME_HEAD, *rows]) + "\n")
    with pytest.raises(ClockError, match="first differ at frame"):
        read_capture(tmp_path / "a")
    (tmp_path / "a/IMG_0042.MOV").unlink()
    with pytest.raises(VideoError, match="no movie"):
        read_capture(tmp_path / "a")
    (tmp_path / "a/gyro_accel.csv").unlink()
    with pytest.raises(ImuError, match="gyro_accel"):
        read_capture(tmp_path / "a")
    write_arkit(tmp_path / "b")
    (tmp_path / "b/frames.csv").write_text((tmp_path / "b/frames.csv").read_text().replace("image_width", "width"))
    with pytest.raises(CaptureError, match=r"frames\.csv: has no column image_width"):
        read_capture(tmp_path / "b")
    (tmp_path / "b/imu.csv").unlink()
    with pytest.raises(ImuError, match=r"imu\.csv"):
        read_capture(tmp_path / "b")
