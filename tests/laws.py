"""Laws of all operators, written once, and the moving camera used to test them.

The camera's truth comes from SciPy's rotations at a constant rate. Of the code under test only the records are used, so
a sign error made twice does not cancel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.camera.shutter import Shutter
from virest.capture.imu import ImuSamples
from virest.image_formation.row_motion import FrameTranslation, RowMotion, row_motion
from virest.image_formation.warp import seen_by_rows
from virest.motion.integration import integrate_gyro
from virest.motion.trajectory import Trajectory

Array = NDArray[Any]
Operator = Callable[[Array], Array]
Shape = tuple[int, ...]

RADTAN = ("radtan", (-0.11, 0.03, 0.0013, -0.0021, -0.004))
FISHEYE = ("fisheye", (0.03, -0.012, 0.004, -0.001))
UNDISTORTED = ("none", ())
R_CAM_IMU = Rotation.from_rotvec([0.3, -1.1, 2.0])
"""None of the phone's axes is along one of the camera's."""


# ── laws ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def random_picture(shape: Shape, rng: np.random.Generator) -> NDArray[np.float32]:
    """Values around zero, so that no law holds for positive pictures only."""
    return rng.normal(size=shape).astype(np.float32)


def assert_linear(operator: Operator, shape: Shape, rng: np.random.Generator, rtol: float = 1e-4) -> None:
    """Check A(2.5 x − 0.7 y) = 2.5 A x − 0.7 A y."""
    x, y = random_picture(shape, rng), random_picture(shape, rng)
    a, b = np.float32(2.5), np.float32(-0.7)
    expected = a * operator(x) + b * operator(y)
    np.testing.assert_allclose(operator(a * x + b * y), expected, atol=rtol * np.abs(expected).max())


def assert_adjoint(
    apply: Operator, adjoint: Operator, x_shape: Shape, y_shape: Shape, rng: np.random.Generator, rtol: float = 1e-4
) -> None:
    """Check <A x, y> = <x, Aᵀ y> and the given shapes."""
    x, y = random_picture(x_shape, rng), random_picture(y_shape, rng)
    forward, back = apply(x), adjoint(y)
    assert forward.shape == y_shape
    assert back.shape == x_shape
    scale = float(np.linalg.norm(forward) * np.linalg.norm(y))
    assert abs(float(np.vdot(forward, y)) - float(np.vdot(x, back))) <= rtol * scale


def assert_round_trip(there: Operator, back: Operator, values: Array, atol: float) -> None:
    """Check that applying an operator and its inverse changes nothing."""
    np.testing.assert_allclose(back(there(values)), values, rtol=0, atol=atol)


def assert_energy(
    apply: Operator, adjoint: Operator, x_shape: Shape, y_shape: Shape, rng: np.random.Generator, rtol: float = 1e-4
) -> None:
    """Check that the operator neither makes nor loses light: a constant stays, and the adjoint keeps the sum."""
    np.testing.assert_allclose(apply(np.full(x_shape, 0.37, np.float32)), np.full(y_shape, 0.37), rtol=rtol)
    y = random_picture(y_shape, rng)
    assert abs(float(adjoint(y).sum(dtype=float) - y.sum(dtype=float))) <= rtol * float(np.abs(y).sum(dtype=float))


# ── a camera that turns at a constant rate ───────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class TurningCamera:
    """A phone with a constant turn rate and a constant velocity, calculated by hand-made formulas."""

    profile: CameraProfile
    rate_rad_s: tuple[float, float, float] = (0.35, -0.8, 0.5)
    """Camera axes."""
    velocity_m_s: tuple[float, float, float] | None = None
    """Camera axes at the reference time."""
    stamp_s: float = 0.1
    exposure_s: float | None = 0.012
    """As logged."""
    reference: str = "exposure-start"

    @property
    def trajectory(self) -> Trajectory:
        """The orientation that the package integrates from this phone's gyroscope."""
        time_s = np.arange(-0.2, 0.6, 0.004)
        true_imu = self.profile.rotation_cam_imu.T @ np.array(self.rate_rad_s)
        measured = true_imu * self.profile.gyro_scale + self.profile.gyro_bias_rad_s
        samples = ImuSamples(time_s, np.tile(measured, (len(time_s), 1)), np.full((len(time_s), 3), np.nan))
        return integrate_gyro(samples, self.profile)

    @property
    def motion(self) -> RowMotion:
        """The package's row motion for this camera."""
        translation = None
        if self.velocity_m_s is not None:
            translation = FrameTranslation(np.array(self.velocity_m_s), np.zeros(3), np.zeros(3))
        return row_motion(self.trajectory, self.profile, self.stamp_s, self.exposure_s, self.reference, translation)

    def seen(self, points_px: Array, from_s: Any, to_s: Any, reference_s: float, depth_m: float = np.inf) -> Array:
        """Truth: pixels (n, 2) at ``to_s`` of points at pixels (n, 2) at ``from_s``, times (n,) or scalars.

        World axes are the camera axes at reference_s; a point is at depth_m along the optical axis at ``from_s``.
        """
        lens, rate = self.profile.intrinsics, np.array(self.rate_rad_s)
        assert lens is not None
        rays = lens.rays(points_px)
        count = len(rays)
        from_s, to_s = (np.broadcast_to(np.asarray(t, float), count) - reference_s for t in (from_s, to_s))
        world = Rotation.from_rotvec(from_s[:, None] * rate).apply(rays)
        if np.isfinite(depth_m):
            velocity = np.array(self.velocity_m_s)
            world = depth_m * world + (from_s - to_s)[:, None] * velocity
        return lens.project(Rotation.from_rotvec(to_s[:, None] * rate).inv().apply(world))

    def row_start_s(self, points_px: Array, start_s: float) -> Array:
        """Truth: start of exposure of the rows through pixels, by forward_model, section 1."""
        x, y = np.asarray(points_px)[..., 0], np.asarray(points_px)[..., 1]
        width, height = self.profile.width, self.profile.height
        part = {
            "top_to_bottom": y / height,
            "bottom_to_top": 1 - (y + 1) / height,
            "left_to_right": x / width,
            "right_to_left": 1 - (x + 1) / width,
        }[self.profile.shutter.readout_direction]
        return start_s + part * self.profile.shutter.readout_time_s


def phone(
    width: int = 200,
    height: int = 136,
    focal_px: float = 220.0,
    lens: tuple[str, tuple[float, ...]] = UNDISTORTED,
    readout_time_s: float = 0.021,
    readout_direction: str = "top_to_bottom",
    **changes: Any,
) -> CameraProfile:
    """Make a phone with an off-centre lens, non-square pixels, and a gyroscope with bias and scale."""
    model, coefficients = lens
    centre = (0.52 * width, 0.47 * height)
    return CameraProfile(
        width,
        height,
        intrinsics=Intrinsics(width, height, focal_px, 0.985 * focal_px, *centre, model, coefficients),
        shutter=changes.pop("shutter", Shutter(readout_time_s, readout_direction)),
        r_cam_imu=tuple(map(tuple, R_CAM_IMU.as_matrix().tolist())),
        **{
            "time_offset_s": 0.0031,
            "clock_skew": 2e-4,
            "gyro_bias_rad_s": (0.02, -0.03, 0.011),
            "gyro_scale": (1.01, 0.99, 1.02),
            **changes,
        },
    )


def texture(height: int, width: int, seed: int = 7, slope: float = 1.1) -> NDArray[np.float64]:
    """Make a picture with the spectrum of a natural one, in [0.03, 0.9]."""
    rng = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None])
    frequency[0, 0] = 1.0
    spectrum = np.fft.rfft2(rng.normal(size=(height, width))) / frequency**slope
    spectrum[0, 0] = 0
    plane = np.fft.irfft2(spectrum, (height, width))
    return np.clip(0.45 + 0.16 * plane / plane.std(), 0.03, 0.9)


def psnr_db(picture: Array, truth: Array, border: int = 0) -> float:
    """PSNR for pictures with a peak of 255, without a border."""
    inner = (slice(border, -border or None),) * 2
    error = np.asarray(picture, float)[inner] - np.asarray(truth, float)[inner]
    return float(10 * np.log10(255.0**2 / np.mean(error**2)))


def recorded_points(motion: RowMotion, points_px: Array, anchor: float = 0.0) -> Array:
    """Recorded positions of points of the picture at the reference time."""
    return seen_by_rows(motion, points_px, motion.reference_s, anchor)


class AtDepth:
    """A motion in front of points with these inverse depths, 1/m, in the axes of their first observation."""

    def __init__(self, motion: RowMotion, inverse_depth: Array | float) -> None:
        self.motion, self.nearness = motion, np.asarray(inverse_depth, float)

    def __getattr__(self, name: str) -> Any:
        """Everything else is the motion's."""
        return getattr(self.motion, name)

    def inverse_depth(self, rays: Array, time_s: Any) -> Array:
        """The inverse depths, which are the same at any time."""
        return np.broadcast_to(self.nearness, rays.shape[:-1])
