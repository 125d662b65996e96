"""The camera's orientation as a function of time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Orientation of the camera at any time, from knots joined by exact exponentials of the integrated rate.

    Between knot k and k+1 the rate is a cubic polynomial, and R_world_cam(t) = R_k exp(integral of the rate).
    World axes are the camera axes at the first knot.
    """

    time_s: Array
    """(n,) knots: the gyroscope's samples, IMU clock from stamp_0."""
    rotation_world_cam: Array
    """(n, 3, 3) at the knots."""
    rate_polynomials: Array
    """(4, n - 1, 3) camera-frame rate in rad/s, highest power first, in the time since the knot."""

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last knot."""
        return float(self.time_s[0]), float(self.time_s[-1])

    def rate_rad_s(self, time_s: Any) -> Array:
        """Camera-frame angular rate (..., 3) at times (...)."""
        interval, since = self._locate(np.asarray(time_s, float))
        a, b, c, d = self.rate_polynomials[:, interval]
        return ((a * since + b) * since + c) * since + d

    def angular_acceleration_rad_s2(self, time_s: Any) -> Array:
        """Change of the camera-frame rate (..., 3) at times (...)."""
        interval, since = self._locate(np.asarray(time_s, float))
        a, b, c, _ = self.rate_polynomials[:, interval]
        return (3 * a * since + 2 * b) * since + c

    def orientation(self, time_s: Any) -> Array:
        """R_world_cam (..., 3, 3) at times (...)."""
        time_s = np.asarray(time_s, float)
        interval, since = self._locate(time_s)
        a, b, c, d = self.rate_polynomials[:, interval]
        angle = since * (d + since * (c / 2 + since * (b / 3 + since * a / 4)))
        end_rate = ((a * since + b) * since + c) * since + d
        return self.rotation_world_cam[interval] @ rotation_from_vector(angle + coning(d, end_rate, since))

    def _locate(self, time_s: Array) -> tuple[NDArray[np.intp], Array]:
        """Interval of each time, and the seconds since its knot, (..., 1). Outside the knots the ends are held."""
        held = np.clip(time_s, self.time_s[0], self.time_s[-1])
        interval = np.clip(np.searchsorted(self.time_s, held, side="right") - 1, 0, len(self.time_s) - 2)
        return interval, (held - self.time_s[interval])[..., None]


def coning(rate_start: Array, rate_end: Array, duration_s: Array) -> Array:
    """Second term of the Magnus series for a rate that changes linearly: Δt²/12 ω₀ × ω₁ (body axes)."""
    return duration_s**2 / 12.0 * np.cross(rate_start, rate_end)


def rotation_from_vector(vector: Array) -> Array:
    """exp: rotation matrices (..., 3, 3) of rotation vectors (..., 3), by Rodrigues' formula."""
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    squared = x * x + y * y + z * z
    half = np.maximum(0.5 * np.sqrt(squared), 1e-150)
    part = np.sin(half) / half
    sine, cosine = part * np.cos(half), 0.5 * part * part
    matrix = np.empty((*vector.shape[:-1], 3, 3))
    matrix[..., 0, 0] = 1 - cosine * (y * y + z * z)
    matrix[..., 1, 1] = 1 - cosine * (x * x + z * z)
    matrix[..., 2, 2] = 1 - cosine * (x * x + y * y)
    for i, j, along, product in ((2, 1, x, y * z), (0, 2, y, x * z), (1, 0, z, x * y)):
        matrix[..., i, j] = cosine * product + sine * along
        matrix[..., j, i] = cosine * product - sine * along
    return matrix


def vector_from_rotation(matrix: Array) -> Array:
    """log: rotation vectors (..., 3) of rotation matrices (..., 3, 3) well below half a turn."""
    skew = 0.5 * np.stack(
        [
            matrix[..., 2, 1] - matrix[..., 1, 2],
            matrix[..., 0, 2] - matrix[..., 2, 0],
            matrix[..., 1, 0] - matrix[..., 0, 1],
        ],
        axis=-1,
    )
    sine = np.linalg.norm(skew, axis=-1, keepdims=True)
    cosine = (np.trace(matrix, axis1=-2, axis2=-1)[..., None] - 1) / 2
    angle = np.arctan2(sine, cosine)
    return skew * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-12), 1.0)


def quaternion_wxyz(matrix: Array) -> Array:
    """Unit quaternion (4,), w x y z with w >= 0, of a rotation matrix."""
    vector = vector_from_rotation(matrix)
    angle = float(np.linalg.norm(vector))
    return np.concatenate([[np.cos(angle / 2)], 0.5 * np.sinc(angle / (2 * np.pi)) * vector])
