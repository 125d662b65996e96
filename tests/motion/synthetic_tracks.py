"""A hand-held phone without frames: tracked points and inertial samples of a motion known in closed form.

The orientation consists of three angles and the position of a straight line, both with added waves, so rates and
accelerations are analytic derivatives. A point's blurred image is the mean of its path over the exposure (three Gauss
nodes), and its row's time is found by fixed-point iteration. Only the records of the tested code are used.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile, Extensions
from virest.camera.shutter import Shutter
from virest.capture.imu import ImuSamples
from virest.image_formation.point_model import TrackTable
from virest.inference.frame_rotations import FrameRotations
from virest.inference.observed_tracks import ObservedTracks, track_table
from virest.inference.tracking import TrackPair
from virest.motion.scene_motion import InertialMotion

Array = NDArray[np.float64]
Triple = tuple[float, float, float]
GRAVITY_M_S2 = np.array([1.2, 9.7, -0.8]) * 9.81 / np.linalg.norm([1.2, 9.7, -0.8])
NODES, SHARES = np.array([-0.5, 0.0, 0.5]) * np.sqrt(0.6), np.array([5.0, 8.0, 5.0]) / 18
R_CAM_IMU = Rotation.from_euler("ZYX", [1.61, 0.06, -3.05]).as_matrix()
"""Not an axis map: about a quarter turn plus some degrees."""


@dataclass(frozen=True)
class Setup:
    """The recorded motion and how it is recorded."""

    seed: int = 1
    rate_rad_s: float = 0.6
    """Typical rate about each axis."""
    about: Triple = (1.0, 1.0, 1.0)
    """Part of that rate in yaw (about z), pitch (about y) and roll (about x)."""
    sway_m: float = 0.0
    velocity_m_s: Triple = (0.0, 0.0, 0.0)
    plane_per_m: Triple | None = None
    """m of the wall m · X = 1, relative to the camera's position at the middle; None: no wall."""
    inverse_depth_per_m: tuple[float, float] = (0.0, 0.0)
    """Range of each point's inverse depth without a wall; 0 is infinitely far."""
    width: int = 480
    height: int = 640
    focal_px: float = 520.0
    pixel_aspect: float = 1.0
    """fy over fx."""
    centre_px: tuple[float, float] = (233.0, 326.0)
    k1: float = 0.0
    k2: float = 0.0
    focal_drift_per_s: float = 0.0
    stabilised: tuple[float, float] = (0.0, 1.0)
    """Fraction and cutoff in Hz of the lens's stabiliser."""
    travel_rad: float | None = None
    """Its largest shift; None: no ends."""
    at_end: str = "runs_on"
    time_offset_s: float = 0.013
    clock_skew: float = 0.0
    gyro_bias_rad_s: Triple = (0.004, -0.006, 0.003)
    gyro_scale: float = 1.0
    gyro_lowpass_hz: float = 0.0
    """Cutoff of a second-order Butterworth low pass on the rates; 0: none."""
    gyro_lag_s: tuple[float, ...] = ()
    """Time constants of first-order low passes on the rates, in series."""
    gyro_window_s: float = 0.0
    """Length of a window, around each timestamp, whose mean rate is logged."""
    gyro_axes: tuple[Triple, Triple, Triple] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    """Rows: what each axis reads of the rates about x, y and z."""
    r_cam_imu: tuple[Triple, ...] = tuple(map(tuple, R_CAM_IMU.tolist()))  # type: ignore[assignment]
    arm_m: Triple = (0.0, 0.0, 0.0)
    accel_bias_m_s2: Triple = (0.05, -0.08, 0.03)
    accel_delay_s: float = 0.0
    accelerometer: bool = True
    gyro_noise_rad_s: float = 0.0
    readout_time_s: float = 0.0207
    readout_direction: str = "right_to_left"
    timestamp: str = "exposure_start"
    exposure_s: float = 0.008
    exposure_swing: float = 0.3
    """Relative variation of the exposures."""
    frames: int = 30
    points: int = 40
    noise_px: float = 0.1
    outliers: float = 0.0
    """Part of the points that belong to a moving object."""


@dataclass(frozen=True)
class Waves:
    """A sum of sines for each of three coordinates, and its derivatives."""

    amplitude: Array
    """(m, 3)."""
    omega: Array
    """(m, 3) rad/s."""
    phase: Array
    """(m, 3)."""

    def at(self, time_s: Array, order: int = 0) -> Array:
        """(..., 3) at times (...)."""
        angle = np.asarray(time_s, float)[..., None, None] * self.omega + self.phase + order * np.pi / 2
        return (self.amplitude * self.omega**order * np.sin(angle)).sum(axis=-2)


class Recording:
    """The truth and the estimator's input."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        rng = np.random.default_rng(setup.seed)
        omega = 2 * np.pi * rng.uniform(0.5, 4.5, (5, 3))
        rates = rng.uniform(0.5, 1.0, (5, 3))
        rates *= np.array(setup.about) * setup.rate_rad_s / np.sqrt(0.5 * (rates**2).sum(axis=0))
        self._angles = Waves(rates / omega, omega, rng.uniform(0, 2 * np.pi, (5, 3)))
        omega = 2 * np.pi * rng.uniform(0.4, 2.2, (4, 3))
        lengths = 1 / omega
        lengths *= setup.sway_m / np.sqrt(0.5 * (lengths**2).sum())
        self._places = Waves(lengths, omega, rng.uniform(0, 2 * np.pi, (4, 3)))
        self.stamp_s = np.arange(setup.frames) / 29.7
        self.exposure_s = setup.exposure_s * (1 + setup.exposure_swing * np.sin(0.9 * np.arange(setup.frames)))
        self._rng = rng

    # ── the motion, IMU clock ──

    def orientation(self, time_s: Array) -> Rotation:
        """R_world_cam."""
        return Rotation.from_euler("ZYX", self._angles.at(time_s).reshape(-1, 3))

    def rate(self, time_s: Array) -> Array:
        """(n, 3) rad/s, camera axes: the classical rates of yaw, pitch and roll."""
        (_, b, c), (da, db, dc) = self._angles.at(time_s).T, self._angles.at(time_s, 1).T
        return np.stack(
            [
                dc - da * np.sin(b),
                db * np.cos(c) + da * np.cos(b) * np.sin(c),
                da * np.cos(b) * np.cos(c) - db * np.sin(c),
            ],
            axis=-1,
        )

    def position(self, time_s: Array, order: int = 0) -> Array:
        """Camera centre (n, 3) or its derivative, world axes."""
        steady = np.array(self.setup.velocity_m_s)
        straight = (np.asarray(time_s)[..., None] * steady, steady, 0.0 * steady)[order]
        return self._places.at(time_s, order) + straight

    def specific_force(self, time_s: Array) -> Array:
        """Specific force (n, 3) at an ideal accelerometer, camera axes."""
        arm, rate, step = np.array(self.setup.arm_m), self.rate(time_s), 1e-4
        turning = (self.rate(time_s + step) - self.rate(time_s - step)) / (2 * step)
        force = self.orientation(time_s).inv().apply(self.position(time_s, 2) - GRAVITY_M_S2)
        return force + np.cross(turning, arm) + np.cross(rate, np.cross(rate, arm))

    # ── the recording ──

    @cached_property
    def imu(self) -> ImuSamples:
        """Gyroscope and accelerometer at 210 Hz, from 1 s before the first timestamp to 1 s after the last."""
        setup, to_imu = self.setup, np.array(self.setup.r_cam_imu)
        time_s = np.arange(-1.0, self.stamp_s[-1] + 1.0, 1 / 210) + setup.time_offset_s
        gyro = setup.gyro_scale * self._passed_rate(time_s) @ to_imu @ np.array(setup.gyro_axes).T
        gyro = gyro + np.array(setup.gyro_bias_rad_s)
        gyro = gyro + np.random.default_rng(setup.seed + 90).normal(0, 1, gyro.shape) * setup.gyro_noise_rad_s
        force = self.specific_force(time_s - setup.accel_delay_s) @ to_imu + np.array(setup.accel_bias_m_s2)
        return ImuSamples(time_s, gyro, force if setup.accelerometer else np.full_like(force, np.nan))

    def _passed_rate(self, time_s: Array) -> Array:
        """Rates (n, 3) after the gyroscope's low-pass filter, in steps of 0.1 ms by the trapezoidal rule."""
        setup, cutoff_hz, step_s = self.setup, self.setup.gyro_lowpass_hz, 1e-4
        if not (cutoff_hz or setup.gyro_lag_s or setup.gyro_window_s):
            return self.rate(time_s)
        longest_s = max(3 / cutoff_hz if cutoff_hz else 0.0, 20 * sum(setup.gyro_lag_s), setup.gyro_window_s)
        fine_s = np.arange(time_s[0] - longest_s, time_s[-1] + setup.gyro_window_s + step_s, step_s)
        passed = self.rate(fine_s)
        if cutoff_hz:
            slow = np.pi * cutoff_hz * step_s  # s: 2 (1 - 1/z) / (step (1 + 1/z)) in H = 1 / (1 + √2 s/ω + s²/ω²)
            back = [1 + np.sqrt(2) * slow + slow**2, 2 * slow**2 - 2, 1 - np.sqrt(2) * slow + slow**2]
            passed = lfilter(slow**2 * np.array([1, 2, 1]), back, passed, axis=0)
        for lag_s in setup.gyro_lag_s:
            slow = 0.5 * step_s / lag_s
            passed = lfilter(slow * np.array([1, 1]), [1 + slow, slow - 1], passed, axis=0)
        if setup.gyro_window_s:
            passed = uniform_filter1d(passed, round(setup.gyro_window_s / step_s) | 1, axis=0, mode="nearest")
        return np.stack([np.interp(time_s, fine_s, column) for column in passed.T], axis=1)

    @cached_property
    def profile(self) -> CameraProfile:
        """The phone's true profile."""
        s = self.setup
        focal_px = s.focal_px, s.focal_px * s.pixel_aspect
        lens = Intrinsics(s.width, s.height, *focal_px, *s.centre_px)
        if s.k1 or s.k2:
            lens = Intrinsics(s.width, s.height, *focal_px, *s.centre_px, "radtan", (s.k1, s.k2, 0.0, 0.0, 0.0))
        return CameraProfile(
            s.width,
            s.height,
            intrinsics=lens,
            shutter=Shutter(s.readout_time_s, s.readout_direction, s.timestamp),
            r_cam_imu=s.r_cam_imu,
            p_cam_imu_m=s.arm_m,
            time_offset_s=s.time_offset_s,
            clock_skew=s.clock_skew,
            gyro_bias_rad_s=s.gyro_bias_rad_s,
            gyro_scale=(s.gyro_scale,) * 3,
            depth_m=np.inf,
            extensions=Extensions(
                s.focal_drift_per_s,
                *s.stabilised,
                gyro_lowpass_hz=s.gyro_lowpass_hz,
                stabilisation_travel_rad=s.travel_rad,
                stabilisation_at_end=s.at_end,
            ),
        )

    @cached_property
    def pairs(self) -> list[TrackPair]:
        """Points of every two consecutive frames."""
        s, size = self.setup, np.array([self.setup.width, self.setup.height])
        first = np.repeat(np.arange(s.frames - 1), s.points)
        guess_px = self._rng.uniform((10, 10), size - 10, (len(first), 2))
        time_s = self.seen_s(guess_px, first)
        plane_ray = (guess_px - s.centre_px) / (s.focal_px, s.focal_px * s.pixel_aspect)
        way = self.orientation(time_s).apply(np.concatenate([plane_ray, np.ones((len(first), 1))], axis=1))
        start = self.position(time_s)
        inverse = self._inverse_depth(way, start)
        first_px, second_px = (self._seen_px(way, start, inverse, frame, guess_px) for frame in (first, first + 1))
        moving = np.arange(len(first)) % s.points < s.outliers * s.points
        second_px = second_px + moving[:, None] * np.array([6.0, -4.0]) * np.sin(0.7 * first + 1)[:, None]
        noisy_px = second_px + self._rng.normal(0, 1, second_px.shape) * s.noise_px
        inside = np.ones(len(first), bool)
        for points_px in (first_px, second_px):
            inside &= (points_px > 0).all(axis=1) & (points_px < size - 1).all(axis=1)
        rows = [inside & (first == k) for k in range(s.frames - 1)]
        return [TrackPair(k, k + 1, first_px[use], noisy_px[use]) for k, use in enumerate(rows)]

    @property
    def observed(self) -> ObservedTracks:
        """The pairs as an estimator's input."""
        assert self.profile.intrinsics is not None
        noise_px = np.full(len(self.pairs), max(self.setup.noise_px, 0.02))
        return ObservedTracks(tuple(self.pairs), self.stamp_s, self.exposure_s, True, noise_px, self.profile.intrinsics)

    def table(self, windows: list[list[int]] | None = None) -> TrackTable:
        """All points."""
        return track_table(self.pairs, self.stamp_s, self.exposure_s, self.observed.noise_px, windows)

    def scene(self, table: TrackTable) -> InertialMotion:
        """The true motion and wall, in the axes of the gyroscope's trajectory."""
        origin_s = np.asarray(self.profile.imu_time_s(table.origin_s))
        arm = np.cross(self.rate(origin_s), self.setup.arm_m)
        velocity = self.position(origin_s, 1) + self.orientation(origin_s).apply(arm)
        plane = np.array(self.setup.plane_per_m or (0.0, 0.0, 0.0))
        moved = (self.position(origin_s) - self._middle) @ plane
        return InertialMotion(
            self.in_trajectory_axes(velocity),
            self.in_trajectory_axes(GRAVITY_M_S2),
            np.array(self.setup.accel_bias_m_s2),
            self.setup.accel_delay_s,
            self.in_trajectory_axes(plane / (1 - moved[:, None])),
        )

    def turns(self, offset_s: float = 0.0) -> FrameRotations:
        """Rotation of every pair at its middle row, computed without points; timestamps may have another zero."""
        s = self.setup
        middle = np.array([[(s.width - 1) / 2, (s.height - 1) / 2]])
        seen = np.concatenate([self.seen_s(middle, np.array([k])) for k in range(s.frames)])
        after, before = self.orientation(seen[1:]), self.orientation(seen[:-1])
        camera_s = (seen - s.time_offset_s) / (1 + s.clock_skew) + offset_s
        return FrameRotations(camera_s[:-1], camera_s[1:], (after.inv() * before).as_rotvec())

    def in_trajectory_axes(self, vectors: Array) -> Array:
        """Rotate world vectors into the camera's axes at the first inertial sample."""
        return self.orientation(self.imu.time_s[:1])[0].inv().apply(vectors)

    def seen_s(self, points_px: Array, frame: NDArray[np.intp]) -> Array:
        """Middle of the exposure of the rows through points (n, 2) of frames (n,), IMU clock."""
        s = self.setup
        along = {
            "top_to_bottom": points_px[:, 1] / s.height,
            "bottom_to_top": 1 - (points_px[:, 1] + 1) / s.height,
            "left_to_right": points_px[:, 0] / s.width,
            "right_to_left": 1 - (points_px[:, 0] + 1) / s.width,
        }[s.readout_direction]
        before = {"exposure_start": 0.0, "exposure_middle": 0.5, "exposure_end": 1.0}[s.timestamp]
        first_row_s = (self.stamp_s[frame] - before * self.exposure_s[frame]) * (1 + s.clock_skew) + s.time_offset_s
        return first_row_s + along * s.readout_time_s + 0.5 * self.exposure_s[frame]

    @cached_property
    def _shift(self) -> tuple[Array, Array]:
        """The stabiliser's shift (m, 2) in units of the focal length: a high-pass filter in steps of 0.2 ms."""
        fraction, cutoff_hz = self.setup.stabilised
        time_s = np.arange(self.imu.time_s[0], self.imu.time_s[-1], 2e-4)
        decay = np.exp(-2 * np.pi * cutoff_hz * 2e-4)
        end = np.inf if self.setup.travel_rad is None else self.setup.travel_rad
        if self.setup.at_end == "stops":
            theta, at = [], np.zeros(3)
            for rate in self.rate(time_s + 1e-4):
                at = np.clip(decay * at + 2e-4 * np.sqrt(decay) * rate, -end / fraction, end / fraction)
                theta.append(at)
            theta = np.array(theta)
        else:
            theta = lfilter([2e-4 * np.sqrt(decay)], [1.0, -decay], self.rate(time_s + 1e-4), axis=0)
        return time_s + 2e-4, np.clip(fraction * theta[:, [1, 0]] * (1.0, -1.0), -end, end)

    @property
    def _middle(self) -> Array:
        middle_s = np.array([0.5 * (self.stamp_s[0] + self.stamp_s[-1])])
        return self.position(middle_s * (1 + self.setup.clock_skew) + self.setup.time_offset_s)[0]

    def _inverse_depth(self, way: Array, start: Array) -> Array:
        if self.setup.plane_per_m is None:
            return self._rng.uniform(*self.setup.inverse_depth_per_m, len(way))
        plane = np.array(self.setup.plane_per_m)
        return (way @ plane) / (1 - (start - self._middle) @ plane)

    def _seen_px(self, way: Array, start: Array, inverse: Array, frame: NDArray[np.intp], guess_px: Array) -> Array:
        points_px = guess_px
        for _ in range(7):
            middle_s = self.seen_s(points_px, frame)
            times = [middle_s + node * self.exposure_s[frame] for node in NODES]
            points_px = sum(  # type: ignore[assignment]
                share * self._project(way, start, inverse, time_s) for share, time_s in zip(SHARES, times, strict=True)
            )
        return points_px

    def _project(self, way: Array, start: Array, inverse: Array, time_s: Array) -> Array:
        s = self.setup
        local = self.orientation(time_s).inv().apply(way + (start - self.position(time_s)) * inverse[:, None])
        plane = local[:, :2] / local[:, 2:]
        if s.stabilised[0]:
            plane = plane + np.stack([np.interp(time_s, self._shift[0], way) for way in self._shift[1].T], axis=-1)
        squared = (plane**2).sum(axis=1, keepdims=True)
        bent = plane * (1 + s.k1 * squared + s.k2 * squared**2)
        focal_px = s.focal_px * (1 + s.focal_drift_per_s * time_s[:, None])
        return bent * focal_px * (1.0, s.pixel_aspect) + s.centre_px


@lru_cache(maxsize=16)
def recorded(setup: Setup) -> Recording:
    """Make each recording only once."""
    return Recording(setup)
