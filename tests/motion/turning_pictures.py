"""Frames of a distant wall taken row by row by a turning phone, and its gyroscope log, without encoding.

The orientation comes from synthetic_motion's exact steps; rows and exposures are computed one by one. Only the records
of the tested code are used.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from motion.synthetic_motion import R_CAM_IMU, Motion, hand_motion
from numpy.typing import NDArray
from scipy.spatial.transform import Slerp

from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.camera.response import ResponseCurve
from virest.camera.shutter import Shutter
from virest.capture.imu import ImuSamples
from virest.capture.records import Capture, CaptureMetadata, Frame

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
PERIOD_S = 1 / 30
FINER = 2
"""Pixels of the wall's drawing per pixel of the frame."""


def chessboard(square_px: float, size: int = 3000) -> Picture:
    """Squares of this size in the frame, over the whole wall."""
    y, x = np.mgrid[:size, :size] // (square_px * FINER)
    board = np.where((x + y) % 2 == 0, 40, 205).astype(np.uint8)
    return np.asarray(cv2.GaussianBlur(board, (0, 0), FINER / 2))


def grating(period_px: float, size: int = 3000) -> Picture:
    """Waves along two directions."""
    y, x = 2 * np.pi * np.mgrid[:size, :size] / (period_px * FINER)
    return np.asarray(125 + 45 * np.sin(x + 0.2 * y) + 45 * np.sin(y - 0.3 * x), np.uint8)


def blobs(size: int = 3000, seed: int = 0) -> Picture:
    """Texture without repetition."""
    rng = np.random.default_rng(seed)
    total = np.zeros((size, size), np.float32)
    for sigma in (3.0, 6.0, 16.0):
        layer = cv2.GaussianBlur(rng.normal(size=(size, size)).astype(np.float32), (0, 0), sigma)
        total += layer / layer.std()
    return np.clip(128 + 30 * total, 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class Phone:
    """The recorded motion and how it is recorded."""

    wall: Picture
    motion: Motion
    width: int = 480
    height: int = 360
    focal_px: float = 400.0
    readout_s: float = 0.02
    exposure_s: float = 0.004
    frames: int = 14
    instants: int = 4
    noise_levels: float = 1.5

    @property
    def profile(self) -> CameraProfile:
        """The true profile."""
        centre = (self.width - 1) / 2, (self.height - 1) / 2
        return CameraProfile(
            self.width,
            self.height,
            intrinsics=Intrinsics(self.width, self.height, self.focal_px, self.focal_px, *centre),
            shutter=Shutter(self.readout_s, "top_to_bottom", "exposure_start"),
            response=ResponseCurve("linear"),
            r_cam_imu=R_CAM_IMU,
            time_offset_s=0.0,
            depth_m=np.inf,
        )

    def record(self) -> Recording:
        """Take the frames and the log."""
        last_s = self.frames * PERIOD_S + 1.2
        orientation = self.motion.orientation(-1.2, last_s + 0.1)
        rng = np.random.default_rng(5)
        time_s = np.arange(-1.1, last_s, 0.005)
        gyro = self.motion.rate(time_s) @ np.array(R_CAM_IMU) + rng.normal(0, 0.002, (len(time_s), 3))
        frames = tuple(Frame(k, round(k * PERIOD_S * 1e9), k * PERIOD_S, self.exposure_s) for k in range(self.frames))
        imu = ImuSamples(time_s, gyro, np.full_like(gyro, np.nan))
        capture = Capture(
            "c", Path("c"), Path("c"), self.width, self.height, frames, imu, CaptureMetadata(), "REALTIME", 0
        )
        middle = orientation(np.array([0.5 * self.frames * PERIOD_S])).as_matrix()[0]
        pictures = [self._taken(orientation, middle, k * PERIOD_S, rng) for k in range(self.frames)]
        return Recording(self, capture, pictures, orientation, middle)

    def _taken(self, orientation: Slerp, middle: Array, stamp_s: float, rng: np.random.Generator) -> Picture:
        """One frame: the mean over instants of each row's exposure, with noise."""
        rows_s = stamp_s + np.arange(self.height) / self.height * self.readout_s
        parts = (np.arange(self.instants) + 0.5) / self.instants * self.exposure_s
        light = np.mean([self.view(orientation, middle, rows_s + part) for part in parts], axis=0)
        noisy = light + rng.normal(0, self.noise_levels, light.shape)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)

    def view(self, orientation: Slerp, middle: Array, rows_s: Array) -> Array:
        """The wall as seen by rows at single times (height,)."""
        x, y = np.meshgrid(np.arange(self.width), np.arange(self.height))
        rays = np.stack([x - (self.width - 1) / 2, y - (self.height - 1) / 2, np.full(x.shape, self.focal_px)], -1)
        turned = rays @ np.swapaxes(middle.T @ orientation(rows_s).as_matrix(), -1, -2)
        place = turned[..., :2] / turned[..., 2:] * (self.focal_px * FINER) + self.wall.shape[0] / 2
        across, down = np.moveaxis(place.astype(np.float32), -1, 0)
        seen = cv2.remap(self.wall, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        return np.asarray(seen, float)


@dataclass(frozen=True)
class Recording:
    """A capture with its frames in memory."""

    phone: Phone
    capture: Capture
    pictures: list[Picture]
    orientation: Slerp
    middle: Array

    def gray(self, numbers: Sequence[int]) -> Iterator[tuple[int, Picture]]:
        """Grey frames, as from a capture's reader."""
        for number in numbers:
            yield number, self.pictures[number]

    def sharp(self, number: int) -> Array:
        """The frame without blur and readout, at the start of its exposure."""
        rows_s = np.full(self.phone.height, number * PERIOD_S)
        return self.phone.view(self.orientation, self.middle, rows_s)

    def with_log(self, gyro_rad_s: Array) -> Recording:
        """The same frames with another log."""
        imu = replace(self.capture.imu, gyro_rad_s=gyro_rad_s)
        return replace(self, capture=replace(self.capture, imu=imu))

    @property
    def frames(self) -> list[int]:
        """All movie indices."""
        return list(range(len(self.pictures)))


def shaken(wall: Picture, rate_rad_s: float, seed: int = 3, **changes: object) -> Recording:
    """A hand's shake with the given RMS rate on each axis."""
    return Phone(wall, hand_motion(seed, rate_rad_s), **changes).record()  # type: ignore[arg-type]
