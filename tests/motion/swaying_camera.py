"""A camera that sways in front of a wall, without frames: tracked points, gyroscope and accelerometer in closed form.

The orientation is the product of small rotations of synthetic_motion; the position is a sum of sinusoids with analytic
derivatives; row times are computed independently. Only the records of the tested code are used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from motion.synthetic_motion import R_CAM_IMU, hand_motion
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.camera.shutter import Shutter
from virest.capture.imu import ImuSamples
from virest.inference.observed_tracks import ObservedTracks
from virest.inference.tracking import TrackPair

Array = NDArray[np.float64]
GRAVITY_M_S2 = np.array([1.2, 9.7, -0.8]) * 9.81 / np.linalg.norm([1.2, 9.7, -0.8])


@dataclass(frozen=True)
class Sway:
    """The recorded motion and how it is recorded."""

    seed: int = 3
    sway_m: float = 0.07
    """RMS length."""
    velocity_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Constant, added to the sway."""
    rate_rad_s: float = 0.6
    depth_m: float = 1.8
    normal: tuple[float, float, float] = (-0.25, 0.15, 1.0)
    """Normal of the wall, before normalisation."""
    relief_m: float = 0.0
    """Standard deviation of the points' distance from the wall."""
    panel: float | None = None
    """Distance of a panel in front of part of the wall, relative to the wall's distance."""
    accel_bias_m_s2: tuple[float, float, float] = (0.05, -0.08, 0.03)
    accel_delay_s: float = 0.0
    accelerometer: bool = True
    arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Origin of the IMU in camera axes."""
    time_offset_s: float = 0.013
    gyro_bias_rad_s: tuple[float, float, float] = (0.004, -0.006, 0.003)
    frames: int = 90
    runs: tuple[int, ...] = (8, 30, 52, 74)
    """First frames of the tracked runs of RUN frames."""
    points: int = 60
    noise_px: float = 0.15
    exposure_s: float = 0.009
    readout_time_s: float = 0.018
    width: int = 480
    height: int = 640
    focal_px: float = 520.0


RUN = 7
PERIOD_S, FAR_M = 1 / 30, 1e5
CENTRE_PX = np.array([233.0, 326.0])


class SwayingCamera:
    """The truth and the estimator's input."""

    def __init__(self, setup: Sway) -> None:
        self.setup = setup
        self.stamp_s = PERIOD_S * np.arange(setup.frames)
        span_s = (-1.0, self.stamp_s[-1] + 1.0)
        self.orientation: Slerp = hand_motion(setup.seed, setup.rate_rad_s).orientation(
            span_s[0] - 0.1, span_s[1] + 0.1
        )
        rng = np.random.default_rng(setup.seed)
        self._frequency = rng.uniform(0.5, 2.5, (5, 3))
        self._phase = rng.uniform(0, 2 * np.pi, (5, 3))
        amplitude = 1 / (1 + self._frequency)
        self._amplitude = amplitude * setup.sway_m / np.sqrt(0.5 * (amplitude**2).sum())
        facing = self.orientation(self.stamp_s[-1] / 2)
        self.normal = facing.apply(np.array(setup.normal) / np.linalg.norm(setup.normal))
        foot = self.position(np.array([self.stamp_s[-1] / 2]))[0] + facing.apply([0, 0, setup.depth_m])
        self.distance = float(self.normal @ foot)
        self.imu = self._imu(span_s, rng)
        self.pairs = [self._pair(k, rng) for first in setup.runs for k in range(first, first + RUN - 1)]
        self.profile = CameraProfile(
            setup.width,
            setup.height,
            intrinsics=Intrinsics(setup.width, setup.height, setup.focal_px, setup.focal_px, *CENTRE_PX),
            shutter=Shutter(setup.readout_time_s, "right_to_left"),
            r_cam_imu=R_CAM_IMU,
            p_cam_imu_m=setup.arm_m,
            time_offset_s=setup.time_offset_s,
        )

    def position(self, time_s: Array, order: int = 0) -> Array:
        """Camera centre (n, 3) or its derivative, world axes; IMU clock (n,)."""
        omega = 2 * np.pi * self._frequency
        angle = omega * np.asarray(time_s)[:, None, None] + self._phase + order * np.pi / 2
        wave = (self._amplitude * omega**order * np.sin(angle)).sum(axis=1)
        steady = np.array(self.setup.velocity_m_s)
        return wave + (np.asarray(time_s)[:, None] * steady if order == 0 else steady * (order == 1))

    def velocity_cam(self, camera_s: float) -> Array:
        """Velocity (3,) in camera axes at an instant on the camera's clock."""
        time_s = camera_s + self.setup.time_offset_s
        return self.orientation(time_s).inv().apply(self.position(np.array([time_s]), 1)[0])

    def plane(self, camera_s: float) -> Array:
        """The wall's plane (3,) in camera axes at a camera-clock instant: inverse depth of a ray with z = 1."""
        time_s = camera_s + self.setup.time_offset_s
        away = self.distance - self.normal @ self.position(np.array([time_s]))[0]
        return self.orientation(time_s).inv().apply(self.normal) / away

    @property
    def observed(self) -> ObservedTracks:
        """The tracker's observations."""
        assert self.profile.intrinsics is not None
        exposure = np.full(self.setup.frames, self.setup.exposure_s)
        noise = np.full(len(self.pairs), self.setup.noise_px)
        return ObservedTracks(tuple(self.pairs), self.stamp_s, exposure, True, noise, self.profile.intrinsics)

    def _imu(self, span_s: tuple[float, float], rng: np.random.Generator) -> ImuSamples:
        setup, r_cam_imu = self.setup, np.array(R_CAM_IMU)
        time_s = np.arange(*span_s, 1 / 200)
        motion = hand_motion(setup.seed, setup.rate_rad_s)
        gyro = (
            motion.rate(time_s) @ r_cam_imu + np.array(setup.gyro_bias_rad_s) + rng.normal(0, 0.0015, (len(time_s), 3))
        )
        felt_s = time_s - setup.accel_delay_s
        rate, step = motion.rate(felt_s), 1e-4
        turning = (motion.rate(felt_s + step) - motion.rate(felt_s - step)) / (2 * step)
        arm = np.broadcast_to(setup.arm_m, rate.shape)
        force = self.orientation(felt_s).inv().apply(self.position(felt_s, 2) - GRAVITY_M_S2)
        force = force + np.cross(turning, arm) + np.cross(rate, np.cross(rate, arm))
        accel = force @ r_cam_imu + np.array(setup.accel_bias_m_s2) + rng.normal(0, 0.02, force.shape)
        return ImuSamples(time_s, gyro, accel if setup.accelerometer else np.full_like(accel, np.nan))

    def _pair(self, k: int, rng: np.random.Generator) -> TrackPair:
        setup = self.setup
        size = np.array([setup.width, setup.height])
        first_px = rng.uniform((10, 10), size - 10, (setup.points, 2))
        first_s = self._seen_s(first_px, self.stamp_s[k])
        rays = np.concatenate([(first_px - CENTRE_PX) / setup.focal_px, np.ones((setup.points, 1))], axis=1)
        way, start = self.orientation(first_s).apply(rays), self.position(first_s)
        along = self._along(start, way)
        world = start + way * (along + rng.normal(0, setup.relief_m, len(along)))[:, None]
        second_px = first_px.copy()
        for _ in range(8):
            second_s = self._seen_s(second_px, self.stamp_s[k + 1])
            local = self.orientation(second_s).inv().apply(world - self.position(second_s))
            second_px = local[:, :2] / local[:, 2:] * setup.focal_px + CENTRE_PX
        inside = (second_px > 0).all(axis=1) & (second_px < size - 1).all(axis=1)
        noise = rng.normal(0, setup.noise_px, second_px.shape)
        return TrackPair(k, k + 1, first_px[inside], (second_px + noise)[inside])

    def _along(self, start: Array, way: Array) -> Array:
        """Factors by which directions (n, 3) reach the visible surface: the panel or the wall."""
        wall = (self.distance - start @ self.normal) / (way @ self.normal)
        wall = np.where(wall > 0, wall, FAR_M)  # above the horizon
        if self.setup.panel is None:
            return wall
        panel = (self.setup.panel * self.distance - start @ self.normal) / (way @ self.normal)
        edge = self.orientation(self.stamp_s[-1] / 2).apply([0.8, 0.6, 0.0])
        hangs = (start + way * panel[:, None]) @ edge > 0.12 * self.distance
        return np.where(hangs, panel, wall)

    def inverse_depth(self, camera_s: float, points_px: Array) -> Array:
        """Inverse depth along the optical axis at pixels (n, 2) at an instant on the camera's clock."""
        time_s = np.full(len(points_px), camera_s + self.setup.time_offset_s)
        rays = np.concatenate([(points_px - CENTRE_PX) / self.setup.focal_px, np.ones((len(points_px), 1))], axis=1)
        return 1 / self._along(self.position(time_s), self.orientation(time_s).apply(rays))

    def _seen_s(self, points_px: Array, stamp_s: float) -> Array:
        """Middle of the exposure of the columns through the points, IMU clock."""
        along = 1 - (points_px[:, 0] + 1) / self.setup.width
        return stamp_s + along * self.setup.readout_time_s + 0.5 * self.setup.exposure_s + self.setup.time_offset_s


def turned_aside(profile: CameraProfile, angle_rad: float) -> CameraProfile:
    """A profile with a slightly wrong mounting of the IMU."""
    matrix = Rotation.from_rotvec([angle_rad, -angle_rad / 2, angle_rad]).as_matrix() @ profile.rotation_cam_imu
    return replace(profile, r_cam_imu=tuple(map(tuple, matrix.tolist())))
