"""ROS 1 and ROS 2 bags and MCAP files become captures without ROS."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("rosbags")

from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore

from virest.app.import_bag import ImportOptions, run_import
from virest.capture.folder import read_capture, resolve_profile
from virest.capture.video import probe_movie, read_frames
from virest.errors import CaptureError, OutputError

COUNT, START_S = 6, 1_600_000_000
RATES, FORCE = (0.1, -0.25, 0.75), (0.3, 9.7, -0.4)
WIDTH, HEIGHT = 48, 32


def pictures() -> list[np.ndarray]:
    """RGB pictures whose channels differ."""
    rng = np.random.default_rng(6)
    return [rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8) for _ in range(COUNT)]


def messages(store: object, encoding: str) -> list[tuple[str, str, int, object]]:
    """Topic, type, time and message of a short recording."""
    types = store.types  # type: ignore[attr-defined]
    time_type, header_type = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
    first = "seq" in header_type.__dataclass_fields__

    def header(time_ns: int) -> object:
        stamp = time_type(sec=time_ns // 10**9, nanosec=time_ns % 10**9)
        return header_type(**({"seq": 0} if first else {}), stamp=stamp, frame_id="cam")

    found: list[tuple[str, str, int, object]] = []
    vector = types["geometry_msgs/msg/Vector3"]
    quaternion = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    for k in range(120):
        time_ns = START_S * 10**9 - 200_000_000 + k * 5_000_000
        imu = types["sensor_msgs/msg/Imu"](
            header=header(time_ns), orientation=quaternion, orientation_covariance=np.zeros(9),
            angular_velocity=vector(*RATES), angular_velocity_covariance=np.zeros(9),
            linear_acceleration=vector(*FORCE), linear_acceleration_covariance=np.zeros(9),
        )  # fmt: skip
        found.append(("/imu", "sensor_msgs/msg/Imu", time_ns, imu))
    for k, picture in enumerate(pictures()):
        time_ns = START_S * 10**9 + k * 40_000_000 + (7_000_000 if k > 3 else 0)
        if encoding == "jpeg":
            data = cv2.imencode(".png", picture[..., ::-1])[1].ravel()
            kind = "sensor_msgs/msg/CompressedImage"
            message = types[kind](header=header(time_ns), format="png", data=data)
        else:
            kind = "sensor_msgs/msg/Image"
            stored = picture[..., ::-1] if encoding == "bgr8" else picture
            rows = np.pad(stored.reshape(HEIGHT, -1), ((0, 0), (0, 4)))
            message = types[kind](header=header(time_ns), height=HEIGHT, width=WIDTH, encoding=encoding,
                                  is_bigendian=0, step=rows.shape[1], data=rows.ravel())  # fmt: skip
        found.append(("/cam/image_raw", kind, time_ns + 1_000, message))
    info_type = types["sensor_msgs/msg/CameraInfo"]
    roi = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    k = np.array([40.0, 0.0, 23.0, 0.0, 41.0, 16.0, 0.0, 0.0, 1.0])
    lens = {"d": np.array([0.1, -0.02, 0.001, 0.002, 0.0]), "k": k, "r": np.eye(3).ravel(), "p": np.zeros(12)}
    if "K" in info_type.__dataclass_fields__:
        lens = {name.upper(): value for name, value in lens.items()}
    info = info_type(header=header(START_S * 10**9), height=HEIGHT, width=WIDTH, distortion_model="plumb_bob",
                     binning_x=0, binning_y=0, roi=roi, **lens)  # fmt: skip
    found.append(("/cam/camera_info", "sensor_msgs/msg/CameraInfo", START_S * 10**9, info))
    return found


def write_bag(path: Path, kind: str, encoding: str) -> Path:
    """A bag of this kind; returns the path that a user would give."""
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    if kind == "ros1":
        writer = rosbag1.Writer(path.with_suffix(".bag"))
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    with writer:
        known = {}
        for topic, msgtype, time_ns, message in messages(store, encoding):
            if topic not in known:
                known[topic] = writer.add_connection(topic, msgtype, typestore=store)
            data = store.serialize_ros1(message, msgtype) if kind == "ros1" else store.serialize_cdr(message, msgtype)
            writer.write(known[topic], time_ns, data)
    if kind == "mcap":
        return path / f"{path.name}.mcap"
    return path.with_suffix(".bag") if kind == "ros1" else path


@pytest.mark.parametrize(("kind", "encoding"), [("ros1", "bgr8"), ("ros2", "rgb8"), ("mcap", "jpeg")])
def test_a_bag_becomes_a_capture(tmp_path: Path, kind: str, encoding: str) -> None:
    """Pixels, header times, samples and lens are the same; values that a bag does not contain stay unknown."""
    bag = write_bag(tmp_path / "walk", kind, encoding)
    facts, text = run_import(bag, ImportOptions(tmp_path / "out"))
    assert (facts["frames"], facts["samples"], facts["image"]) == (COUNT, 120, "/cam/image_raw")
    assert "virest calibrate" in text
    capture = read_capture(tmp_path / "out")
    assert [frame.timestamp_ns - START_S * 10**9 for frame in capture.frames][3:5] == [120_000_000, 167_000_000]
    np.testing.assert_allclose(capture.imu.gyro_rad_s[4], RATES)
    np.testing.assert_allclose(capture.imu.accel_m_s2[4], FORCE)
    for (_, decoded), picture in zip(
        read_frames(capture.movie, probe_movie(capture.movie), 0, COUNT - 1), pictures(), strict=True
    ):
        np.testing.assert_array_equal(decoded, picture)
    profile = resolve_profile(capture)[0]
    assert profile.intrinsics is not None
    assert (profile.intrinsics.fx_px, profile.intrinsics.fy_px, profile.intrinsics.cx_px) == (40.0, 41.0, 23.0)
    assert profile.intrinsics.coefficients == (0.1, -0.02, 0.001, 0.002, 0.0)
    assert profile.time_offset_s is None
    assert not profile.readout_known


def test_an_import_replaces_only_an_earlier_import(tmp_path: Path) -> None:
    """An existing folder is rejected; ``overwrite`` replaces only an unchanged earlier import."""
    bag = write_bag(tmp_path / "walk", "ros1", "rgb8")
    run_import(bag, ImportOptions(tmp_path / "out"))
    with pytest.raises(OutputError, match="exists already"):
        run_import(bag, ImportOptions(tmp_path / "out"))
    run_import(bag, ImportOptions(tmp_path / "out", overwrite=True))
    (tmp_path / "out" / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="exists already"):
        run_import(bag, ImportOptions(tmp_path / "out", overwrite=True))
    assert (tmp_path / "out" / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("kind", ["ros1", "ros2"])
def test_the_error_for_a_bag_names_virest_import(tmp_path: Path, kind: str) -> None:
    """A bag given as a capture is rejected with the command that converts it."""
    with pytest.raises(CaptureError) as caught:
        read_capture(write_bag(tmp_path / "walk", kind, "rgb8"))
    assert "virest import" in str(caught.value)


def test_wrong_topics_and_damaged_bags_are_errors(tmp_path: Path) -> None:
    """The error for a missing topic lists the existing ones; a damaged file cannot be read as a bag."""
    bag = write_bag(tmp_path / "walk", "ros1", "rgb8")
    with pytest.raises(CaptureError, match=r"no image topic /left.*/cam/image_raw"):
        run_import(bag, ImportOptions(tmp_path / "out", image="/left"))
    (tmp_path / "cut.bag").write_bytes(bag.read_bytes()[:500])
    with pytest.raises(CaptureError, match="cannot be read as a bag"):
        run_import(tmp_path / "cut.bag", ImportOptions(tmp_path / "out"))
    assert not (tmp_path / "out").exists()
