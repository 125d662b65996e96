"""Captures without frames: tracked points, timestamps and gyroscope samples from an analytic motion.

The orientation is a product of 5000 small rotations per second (SciPy), accurate to 2e-7 rad; row times are computed
independently. Only the records of the tested code are used.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.camera.shutter import Shutter
from virest.capture.imu import ImuSamples
from virest.capture.records import Frame
from virest.inference.observed_tracks import ObservedTracks, observe_tracks
from virest.inference.tracking import TrackPair

Array = NDArray[np.float64]
R_CAM_IMU = ((0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0))


@dataclass(frozen=True)
class Motion:
    """A camera's rotation, as sums of sines for each axis and a constant rate, and a constant velocity."""

    amplitude_rad_s: Array
    """(m, 3) camera axes."""
    frequency_hz: Array
    """(m, 3)."""
    phase_rad: Array
    """(m, 3)."""
    pan_rad_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    velocity_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """World axes = camera axes at the start of the table."""

    def rate(self, time_s: Array) -> Array:
        """(n, 3) rad/s, camera axes."""
        wave = np.sin(2 * np.pi * self.frequency_hz * time_s[:, None, None] + self.phase_rad)
        return (self.amplitude_rad_s * wave).sum(axis=1) + np.array(self.pan_rad_s)

    def orientation(self, first_s: float, last_s: float) -> Slerp:
        """R_world_cam as a function of time, from 5000 exact steps per second at the middle rate."""
        time_s = np.linspace(first_s, last_s, int((last_s - first_s) * 5_000) + 2)
        step = np.diff(time_s)[:, None]
        steps = Rotation.from_rotvec(self.rate(0.5 * (time_s[1:] + time_s[:-1])) * step).as_matrix()
        product = np.empty((len(time_s), 3, 3))
        product[0] = np.eye(3)
        for k, matrix in enumerate(steps):
            product[k + 1] = product[k] @ matrix
        return Slerp(time_s, Rotation.from_matrix(product))


def hand_motion(seed: int, rate_rad_s: float = 0.5, **changes: object) -> Motion:
    """Shake of a few hertz with random phases and the given RMS rate on each axis."""
    rng = np.random.default_rng(seed)
    frequency = rng.uniform(0.4, 6.0, (6, 3))
    amplitude = rng.uniform(0.5, 1.0, (6, 3)) / np.sqrt(frequency)
    amplitude *= rate_rad_s / np.sqrt(0.5 * (amplitude**2).sum(axis=0))
    return Motion(amplitude, frequency, rng.uniform(0, 2 * np.pi, (6, 3)), **changes)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Setup:
    """The recorded motion and how it is recorded."""

    motion: Motion
    time_offset_s: float = 0.0
    clock_skew: float = 0.0
    bias_rad_s: tuple[float, float, float] = (0.004, -0.006, 0.003)
    readout_time_s: float = 0.0207
    readout_direction: str = "right_to_left"
    timestamp: str = "exposure_start"
    exposure_s: float = 0.008
    width: int = 720
    height: int = 1280
    focal_px: float = 980.0
    frames: int = 40
    frame_period_s: float = 1 / 30
    points: int = 120
    noise_px: float = 0.1
    depth_m: tuple[float, float] = (1.5, 12.0)
    outliers: float = 0.0
    """Part of the points that belong to a moving object."""
    seed: int = 1


@dataclass(frozen=True)
class Synthetic:
    """The complete input of an estimator."""

    pairs: list[TrackPair]
    frame_time_s: Array
    exposure_s: Array
    imu: ImuSamples
    profile: CameraProfile
    """Contains everything but the offset and the bias."""
    orientation: Slerp = field(repr=False)

    def observed(self, profile: CameraProfile | None = None) -> ObservedTracks:
        """The tracks for a profile; None selects the recording's own."""
        return observed_pairs(self.pairs, self.frame_time_s, self.exposure_s, profile or self.profile)


def observed_pairs(pairs: list[TrackPair], stamp_s: Array, exposure_s: Array, profile: CameraProfile) -> ObservedTracks:
    """Tracked pairs of a movie without a capture folder."""
    times = zip(stamp_s, exposure_s, strict=True)
    frames = tuple(Frame(k, k, float(t), None if np.isnan(e) else float(e)) for k, (t, e) in enumerate(times))
    return observe_tracks(SimpleNamespace(frames=frames, bits_per_px=np.inf), pairs, profile)  # type: ignore[arg-type]


def make(setup: Setup, imu_hz: float = 200.0) -> Synthetic:
    """Record a cloud of points with a rolling shutter; each point is tracked at its row's mid-exposure."""
    rng = np.random.default_rng(setup.seed)
    frame_time_s = setup.frame_period_s * np.arange(setup.frames)
    first_s, last_s = -1.6 - abs(setup.time_offset_s), frame_time_s[-1] + 1.6 + abs(setup.time_offset_s)
    orientation = setup.motion.orientation(first_s - 0.1, last_s + 0.1)
    imu_s = np.arange(first_s, last_s, 1 / imu_hz)
    r_cam_imu = np.array(R_CAM_IMU)
    gyro = setup.motion.rate(imu_s) @ r_cam_imu + np.array(setup.bias_rad_s)
    gyro = gyro + rng.normal(0, 0.002, gyro.shape)
    profile = CameraProfile(
        setup.width,
        setup.height,
        intrinsics=Intrinsics(setup.width, setup.height, setup.focal_px, setup.focal_px, 351.0, 655.0),
        shutter=Shutter(setup.readout_time_s, setup.readout_direction, setup.timestamp),
        r_cam_imu=R_CAM_IMU,
        clock_skew=setup.clock_skew,
    )
    pairs = [_pair(setup, orientation, k, frame_time_s, rng) for k in range(setup.frames - 1)]
    imu = ImuSamples(imu_s, gyro, np.full_like(gyro, np.nan))
    return Synthetic(pairs, frame_time_s, np.full(setup.frames, setup.exposure_s), imu, profile, orientation)


def _pair(setup: Setup, orientation: Slerp, k: int, frame_time_s: Array, rng: np.random.Generator) -> TrackPair:
    first_px = rng.uniform((10, 10), (setup.width - 10, setup.height - 10), (setup.points, 2))
    depth = rng.uniform(*setup.depth_m, setup.points)
    first_s = _seen_s(setup, first_px, frame_time_s[k])
    velocity = np.array(setup.motion.velocity_m_s)
    centre = np.array([351.0, 655.0])
    rays = np.concatenate([(first_px - centre) / setup.focal_px, np.ones((setup.points, 1))], axis=1)
    world = orientation(first_s).apply(rays * depth[:, None]) + first_s[:, None] * velocity
    second_px = first_px.copy()
    for _ in range(8):
        second_s = _seen_s(setup, second_px, frame_time_s[k + 1])
        local = orientation(second_s).inv().apply(world - second_s[:, None] * velocity)
        second_px = local[:, :2] / local[:, 2:] * setup.focal_px + centre
    moving = np.arange(setup.points) < setup.outliers * setup.points
    second_px = second_px + moving[:, None] * np.array([6.0, -4.0]) * np.sin(0.7 * k)
    second_px = second_px + rng.normal(0, setup.noise_px, second_px.shape)
    inside = (second_px > 0).all(axis=1) & (second_px < (setup.width - 1, setup.height - 1)).all(axis=1)
    return TrackPair(k, k + 1, first_px[inside], second_px[inside])


def _seen_s(setup: Setup, points_px: Array, stamp_s: float) -> Array:
    """Middle of the exposure of the rows through the points, IMU clock."""
    along = {
        "top_to_bottom": points_px[:, 1] / setup.height,
        "bottom_to_top": 1 - (points_px[:, 1] + 1) / setup.height,
        "left_to_right": points_px[:, 0] / setup.width,
        "right_to_left": 1 - (points_px[:, 0] + 1) / setup.width,
    }[setup.readout_direction]
    before = {"exposure_start": 0.0, "exposure_middle": 0.5, "exposure_end": 1.0}[setup.timestamp]
    first_row_s = (stamp_s - before * setup.exposure_s) * (1 + setup.clock_skew) + setup.time_offset_s
    return first_row_s + along * setup.readout_time_s + 0.5 * setup.exposure_s
