"""EuRoC / ASL folders: finding, reading and rejecting them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from other_writing import T0_NS, imu_rows, stamps, write_euroc

from virest.camera.kalibr import ImuNoise
from virest.camera.orb_slam import format_orb_slam
from virest.capture.folder import Capture, read_capture, resolve_profile
from virest.capture.video import probe_movie, read_frames, read_gray
from virest.errors import CaptureError, ClockError, ImuError, VideoError


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    """A sequence of eight pictures, 96 × 64."""
    write_euroc(tmp_path / "V1_01")
    return tmp_path / "V1_01"


def codes(capture: Capture) -> set[str]:
    """Codes of the notes."""
    return {note.code for note in capture.notes}


def test_a_sequence_is_read_completely(tmp_path):
    """Timestamps, order of samples and pixels are as written."""
    pictures = write_euroc(tmp_path / "V1_01")
    capture = read_capture(tmp_path / "V1_01")
    assert (capture.kind, capture.name, capture.width, capture.height) == ("EuRoC", "V1_01", 96, 64)
    assert [frame.timestamp_ns for frame in capture.frames] == stamps(8)
    assert len(capture.usable) == 8
    time_ns, values = imu_rows(stamps(8)[0], stamps(8)[-1])[7]
    np.testing.assert_allclose(capture.imu.time_s[7], (time_ns - T0_NS) / 1e9, atol=1e-12)
    np.testing.assert_array_equal(np.r_[capture.imu.gyro_rad_s[7], capture.imu.accel_m_s2[7]], values)
    index = probe_movie(capture.movie)
    for number, picture in read_frames(capture.movie, index, 0, 99):
        np.testing.assert_array_equal(picture, pictures[number])
    assert [number for number, _ in read_gray(capture.movie, index, [6, 1, 3])] == [6, 1, 3]
    _, gray = next(read_gray(capture.movie, index, [5]))
    np.testing.assert_array_equal(gray, cv2.cvtColor(pictures[5], cv2.COLOR_RGB2GRAY))


def test_the_profile_comes_from_sensor_yaml(sequence):
    """Lens and both poses are used: x_cam = inv(T_BC) T_BI x_imu; readout time and offset stay unknown."""
    capture = read_capture(sequence)
    profile, source = resolve_profile(capture)
    assert "metadata" in source
    assert profile.intrinsics is not None
    assert (profile.intrinsics.fx_px, profile.intrinsics.cy_px, profile.intrinsics.model) == (78.5, 33.0, "radtan")
    assert profile.intrinsics.coefficients == (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0)
    assert not profile.readout_known
    assert profile.time_offset_s is None
    # the body's x axis is the camera's −y axis; the sensor's y axis is the body's −x axis
    np.testing.assert_allclose(profile.rotation_cam_imu @ [0, -1, 0], [0.0149, -0.9999, 0.0041], atol=1e-4)
    body_from_cam = np.array([-0.0216401454975, -0.064676986768, 0.00981073058949])
    rotation = profile.rotation_cam_imu @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(profile.p_cam_imu_m, rotation @ ([0.1, 0.2, 0.3] - body_from_cam), atol=1e-9)


@pytest.mark.parametrize("part", ["", "mav0", "mav0/cam1"])
def test_the_path_selects_the_camera(tmp_path, part):
    """The sequence and its mav0 folder select the first camera.

    A camera's folder selects that camera with its own shutter.
    """
    write_euroc(tmp_path / "seq", 4)
    pictures = write_euroc(tmp_path / "seq", 6, "cam1")
    with (tmp_path / "seq/mav0/cam1/sensor.yaml").open("a") as file:
        file.write("line_delay_nanoseconds: 29473.7\n")
    capture = read_capture(tmp_path / "seq" / part)
    assert len(capture.frames) == (len(pictures) if part.endswith("cam1") else 4)
    profile, _ = resolve_profile(capture)
    assert profile.readout_known == part.endswith("cam1")
    assert profile.shutter.readout_direction == "top_to_bottom"
    assert profile.shutter.readout_time_s == pytest.approx(64 * 29473.7e-9 if part.endswith("cam1") else 0.0)


def test_lines_of_a_camera_read_sideways_are_columns(sequence):
    """The line delay then counts once per column."""
    with (sequence / "mav0/cam0/sensor.yaml").open("a") as file:
        file.write("line_delay_nanoseconds: 100000\nreadout_direction: right_to_left\n")
    assert resolve_profile(read_capture(sequence))[0].shutter.readout_time_s == pytest.approx(96 * 1e-4)


def test_exposures_of_tum_vi_are_joined_by_time(sequence):
    """dso/cam0/times.txt gives exposures in milliseconds; a missing row is interpolated."""
    times = [f"{t} {t // 10**9}.{t % 10**9:09d} {0.5 + k}" for k, t in enumerate(stamps(8)) if k != 4]
    (sequence / "dso/cam0").mkdir(parents=True)
    (sequence / "dso/cam0/times.txt").write_text("\n".join(["# id time exposure", *times]) + "\n")
    capture = read_capture(sequence)
    assert capture.frames[3].exposure_s == pytest.approx(3.5e-3)
    assert capture.frames[4].exposure_s == pytest.approx(4.5e-3)
    assert "exposure-interpolated" in {note.code for note in capture.notes}


def test_without_sensor_yaml_a_camera_chain_is_used(sequence):
    """Kalibr's chain beside the sequence supplies the camera of the same name."""
    (sequence / "mav0/cam0/sensor.yaml").unlink()
    assert "axes-unknown" in codes(read_capture(sequence))
    chain = (
        "cam0:\n  T_cam_imu: [[0,-1,0,0],[1,0,0,0],[0,0,1,0.5],[0,0,0,1]]\n  camera_model: pinhole\n"
        "  distortion_coeffs: [0.01,0.02,0.03,0.04]\n  distortion_model: equidistant\n"
        "  intrinsics: [70,71,48,32]\n  resolution: [96,64]\n  timeshift_cam_imu: 0.004\n"
    )
    (sequence / "dso").mkdir()
    (sequence / "dso/camchain.yaml").write_text(chain)
    profile, _ = resolve_profile(read_capture(sequence))
    assert profile.intrinsics is not None
    assert (profile.intrinsics.model, profile.intrinsics.fy_px, profile.time_offset_s) == ("fisheye", 71.0, 0.004)


def test_16_bit_and_grey_pictures_are_read(tmp_path):
    """16-bit pictures are rounded to 8 bits; grey ones have three equal channels."""
    write_euroc(tmp_path / "seq", 3)
    folder = tmp_path / "seq/mav0/cam0/data"
    deep = (np.arange(96 * 64, dtype=np.float64) * 10.6).astype(np.uint16).reshape(64, 96)
    cv2.imwrite(str(folder / f"{stamps(3)[1]}.png"), deep)
    capture = read_capture(tmp_path / "seq", look_at_pictures=False)
    _, picture = next(read_frames(capture.movie, probe_movie(capture.movie), 1, 1))
    assert picture is not None
    np.testing.assert_array_equal(picture[..., 0], np.rint(deep / 257.0))
    np.testing.assert_array_equal(picture[..., 0], picture[..., 2])


def test_missing_and_broken_pictures_are_counted_or_none(sequence):
    """A missing listed picture is dropped and counted; a truncated one, or one of another size, is None."""
    data = sequence / "mav0/cam0/data"
    names = sorted(data.iterdir())
    names[2].unlink()
    names[4].write_bytes(names[4].read_bytes()[:60])
    cv2.imwrite(str(names[5]), np.zeros((10, 10), np.uint8))
    capture = read_capture(sequence, look_at_pictures=False)
    assert "pictures-missing" in codes(capture)
    assert capture.counts["cam0/data.csv dropped: picture is missing"] == 1
    found = dict(read_frames(capture.movie, probe_movie(capture.movie), 0, 9))
    assert [number for number, picture in found.items() if picture is None] == [3, 4]


@pytest.mark.parametrize(
    "name", ["../../../secret.png", "/etc/secret.png", "..\\secret.png", "C:/secret.png", "a/../../b.png"]
)
def test_names_never_lead_out_of_the_folder(sequence, name):
    """A list that names a picture outside the folder is rejected."""
    (sequence.parent / "secret.png").write_bytes(b"secret")
    path = sequence / "mav0/cam0/data.csv"
    path.write_text(path.read_text() + f"{stamps(9)[-1]},{name}\n")
    with pytest.raises(VideoError, match="outside the folder"):
        read_capture(sequence)


@pytest.mark.parametrize(
    ("file", "content", "error", "words"),
    [
        ("mav0/cam0/data.csv", "", CaptureError, "data.csv"),
        ("mav0/cam0/data.csv", "#timestamp [ns],filename\n1.40364E+18,a.png\n", CaptureError, "data.csv"),
        ("mav0/imu0/data.csv", "#timestamp [ns],w,w,w,a,a,a\n", ImuError, "0 usable"),
        ("mav0/imu0/data.csv", f"1.40364E+18,1,2,3,4,5,6\n{T0_NS},1,2,3,4,5,6\n", ClockError, "lost its digits"),
        ("mav0/imu0/data.csv", "5,1,2,3,4,5,6\n6,1,2,3,4,5,6\n", ClockError, "apart"),
        ("mav0/cam0/sensor.yaml", "T_BS: [1, 2", CaptureError, "sensor.yaml"),
        ("mav0/cam0/sensor.yaml", "T_BS: {data: [1, 2, 3]}\n", CaptureError, "rigid"),
        ("mav0/cam0/sensor.yaml", "intrinsics: [a, b, c, d]\n", CaptureError, "number"),
        ("mav0/cam0/sensor.yaml", "resolution: 5\n", CaptureError, "resolution"),
    ],
)  # fmt: skip
def test_bad_euroc_files_give_one_line(sequence, file, content, error, words):
    """Each fault is a one-line error with exit code 4."""
    (sequence / file).write_text(content)
    with pytest.raises(error, match=words) as fault:
        read_capture(sequence)
    assert fault.value.exit_code == 4
    assert "\n" not in str(fault.value)


def test_missing_parts_are_named(sequence):
    """Without samples or pictures, the error names the missing part."""
    (sequence / "mav0/imu0/data.csv").rename(sequence / "samples")
    with pytest.raises(ImuError, match=r"imu0/data\.csv: no such file"):
        read_capture(sequence)
    (sequence / "samples").rename(sequence / "mav0/imu0/data.csv")
    for picture in (sequence / "mav0/cam0/data").iterdir():
        picture.unlink()
    with pytest.raises(VideoError, match="none of its 8 rows has a picture"):
        read_capture(sequence)


def test_a_sensor_yaml_of_another_size_is_not_used(sequence):
    """Intrinsics for another picture size are left out with a note."""
    path = sequence / "mav0/cam0/sensor.yaml"
    path.write_text(path.read_text().replace("[96, 64]", "[752, 480]"))
    capture = read_capture(sequence)
    assert "sensor-size" in codes(capture)
    assert resolve_profile(capture)[0].intrinsics is None


def test_orb_slam_settings_are_read_by_opencv(sequence, tmp_path):
    """OpenCV's reader, which ORB-SLAM3 uses, finds real numbers, integers and T_b_c1."""
    profile, _ = resolve_profile(read_capture(sequence))
    path = tmp_path / "orb.yaml"
    path.write_text(format_orb_slam(profile, 20.0, ImuNoise(200.0, 1e-4, 0.01), ["a comment"]))
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    pose = storage.getNode("IMU.T_b_c1").mat()
    expected = np.eye(4)
    expected[:3, :3], expected[:3, 3] = profile.rotation_cam_imu, profile.p_cam_imu_m
    np.testing.assert_allclose(pose, np.linalg.inv(expected), atol=1e-6)
    assert storage.getNode("Camera.fps").isInt()
    for name in ("Camera1.fx", "Camera1.k1", "Camera1.p2", "IMU.Frequency", "IMU.NoiseGyro"):
        assert storage.getNode(name).isReal(), name
    assert storage.getNode("IMU.NoiseGyro").real() == pytest.approx(1e-4)
