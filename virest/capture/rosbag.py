"""ROS 1 and 2 bags and MCAP files, by the package `rosbags`, without ROS: pictures, inertial samples, the lens.

Topics are found by their message types: sensor_msgs Image or CompressedImage, Imu, CameraInfo.  Times are those of the
messages' headers.  Messages are decoded on demand.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Picture
from virest.capture.files import label
from virest.errors import CaptureError

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
IMU, CAMERA = "sensor_msgs/msg/Imu", "sensor_msgs/msg/CameraInfo"
ENDINGS = (".bag", ".mcap", ".db3")
EXTRA = "bags need the extra: pip install 'virest[rosbags]'"
_CHANNELS = {"rgb8": (3, False), "bgr8": (3, True), "mono8": (1, False), "8UC1": (1, False), "8UC3": (3, True)}
"""Encodings: channels, and whether blue comes first."""


@dataclass(frozen=True, slots=True)
class BagTopics:
    """Topics of a bag that make a capture."""

    image: str
    imu: str
    camera: str | None


@dataclass(frozen=True, slots=True)
class BagCamera:
    """The lens as given by CameraInfo."""

    width: int
    height: int
    matrix: Array
    """(3, 3)"""
    model: str
    distortion: tuple[float, ...]


def is_bag(path: Path) -> bool:
    """Whether a path is a bag file, or the folder of a ROS 2 bag."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() and any(p.suffix in ENDINGS for p in path.iterdir())
    return path.suffix.lower() in ENDINGS


class Bag:
    """An open bag.  Use it in a ``with`` block.  Raises CaptureError if it cannot be read."""

    def __init__(self, path: Path, image: str | None = None, imu: str | None = None) -> None:
        self.path = path
        self._requested = (image, imu)
        self._reader: Any = None

    def __enter__(self) -> Bag:
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise CaptureError(f"{label(self.path)}: is a ROS bag", hint=EXTRA) from None
        try:
            self._reader = AnyReader([self.path], default_typestore=get_typestore(Stores.LATEST))
            self._reader.open()
        except Exception as error:
            raise CaptureError(
                f"{label(self.path)}: cannot be read as a bag: {error}", hint="is the copy complete?"
            ) from error
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    def topics(self) -> BagTopics:
        """The topics to read: the requested ones, else of each kind the one with the most messages."""
        image = self._choose(IMAGES, self._requested[0], "image")
        imu = self._choose((IMU,), self._requested[1], "IMU")
        beside = image.rsplit("/", 1)[0].removesuffix("/compressed")
        cameras = [c.topic for c in self._reader.connections if c.msgtype == CAMERA]
        near = [topic for topic in cameras if topic.startswith(beside.rsplit("/", 1)[0])]
        return BagTopics(image, imu, next(iter(near or cameras), None))

    def camera(self, topic: str) -> BagCamera | None:
        """The first CameraInfo of the topic that holds a focal length."""
        for _, message in self._messages(topic):
            matrix = np.array(message.K if hasattr(message, "K") else message.k, float).reshape(3, 3)
            distortion = message.D if hasattr(message, "D") else message.d
            if matrix[0, 0] > 0:
                return BagCamera(
                    int(message.width),
                    int(message.height),
                    matrix,
                    str(message.distortion_model),
                    tuple(map(float, distortion)),
                )
        return None

    def samples(self, topic: str) -> tuple[NDArray[np.int64], Array]:
        """Times (n,), ns, and rates and specific force (n, 6), rad/s and m/s²."""
        times, rows = [], []
        for time_ns, message in self._messages(topic):
            rate, force = message.angular_velocity, message.linear_acceleration
            times.append(time_ns)
            rows.append((rate.x, rate.y, rate.z, force.x, force.y, force.z))
        return np.array(times, np.int64), np.array(rows, float).reshape(-1, 6)

    def pictures(self, topic: str) -> Iterator[tuple[int, Picture]]:
        """Time, ns, and pixels, RGB (h, w, 3) or grey (h, w), of each message."""
        for time_ns, message in self._messages(topic):
            yield time_ns, _pixels(message, label(self.path))

    def count(self, topic: str) -> int:
        """Number of messages of a topic."""
        return int(self._reader.topics[topic].msgcount)

    def _choose(self, kinds: tuple[str, ...], requested: str | None, what: str) -> str:
        found = {c.topic: c.msgcount for c in self._reader.connections if c.msgtype in kinds}
        if requested is not None and requested in found:
            return requested
        if requested is not None or not found:
            there = ", ".join(sorted({f"{c.topic} ({c.msgtype})" for c in self._reader.connections})[:8]) or "nothing"
            missing = f"no {what} topic {requested}" if requested else f"no {what} topic"
            text = f"{label(self.path)}: has {missing}: {there}"
            raise CaptureError(text, hint="a capture needs an image and an IMU topic")
        return max(sorted(found), key=lambda topic: found[topic])

    def _messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        connections = [c for c in self._reader.connections if c.topic == topic]
        for connection, _, data in self._reader.messages(connections=connections):
            message = self._reader.deserialize(data, connection.msgtype)
            stamp = message.header.stamp
            yield int(stamp.sec) * 10**9 + int(stamp.nanosec), message


def _pixels(message: Any, name: str) -> Picture:
    if hasattr(message, "format"):
        picture = cv2.imdecode(np.asarray(message.data, np.uint8), cv2.IMREAD_COLOR)
        if picture is None:
            raise CaptureError(f"{name}: a compressed picture ({message.format}) cannot be decoded", hint="JPEG or PNG")
        return np.asarray(picture[..., ::-1])
    if message.encoding not in _CHANNELS:
        raise CaptureError(f"{name}: pictures of encoding {message.encoding!r}", hint=f"one of {', '.join(_CHANNELS)}")
    channels, blue_first = _CHANNELS[message.encoding]
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
    picture = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    if channels == 1:
        return np.ascontiguousarray(picture[..., 0])
    return np.asarray(picture[..., ::-1] if blue_first else picture)
