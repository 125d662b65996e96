"""The camera's orientation as a function of time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from virest.arrays import Array, Index

_SMALL_SQUARE = 0.01
"""rad²: below, the series of sine and cosine to the fifth term are exact to rounding, 0.01⁵ / 11! = 3e-18."""


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Orientation of the camera at any time, from knots and exact exponentials of the integrated rate between them.

    Between knot k and k+1 the rate is a cubic polynomial, and R_world_cam(t) = R_k exp(integral of the rate).
    World axes are the camera axes at the first knot.
    """

    time_s: Array
    """(n,) knots: the gyroscope's samples, IMU clock from stamp_0."""
    rotation_world_cam: Array
    """(n, 3, 3) at the knots."""
    rate_polynomials: Array
    """(4, 3, n - 1) camera-frame rate in rad/s, highest power first, in the time since the knot."""

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last knot."""
        return float(self.time_s[0]), float(self.time_s[-1])

    def rate_rad_s(self, time_s: Any) -> Array:
        """Camera-frame angular rate (..., 3) at times (...)."""
        interval, since = self._locate(np.asarray(time_s, float))
        return _vectors(_rate(self.rate_polynomials.take(interval, axis=2), since))

    def angular_acceleration_rad_s2(self, time_s: Any) -> Array:
        """Change of the camera-frame rate (..., 3) at times (...)."""
        interval, since = self._locate(np.asarray(time_s, float))
        a, b, c = self.rate_polynomials[:3].take(interval, axis=2)
        return _vectors((3 * a * since + 2 * b) * since + c)

    def orientation(self, time_s: Any) -> Array:
        """R_world_cam (..., 3, 3) at times (...)."""
        interval, since = self._locate(np.asarray(time_s, float))
        angle = turned_angle(self.rate_polynomials.take(interval, axis=2), since)
        return np.asarray(self.rotation_world_cam.take(interval, axis=0) @ _exponential(*angle))

    def mean_orientation(self, middle_s: Array, exposure_s: Array) -> Orientations:
        """R_world_cam averaged over exposures around the times (n,): R exp(ω' E² / 24), to second order.

        The two rotations since the knot are combined as exp(u) exp(v) ≈ exp(u + v + ½ u × v): v is about 1e-4 rad.
        """
        interval, since = self._locate(middle_s)
        pieces = self.rate_polynomials.take(interval, axis=2)
        angle = turned_angle(pieces, since)
        a, b, c, _ = pieces
        bend = ((3 * a * since + 2 * b) * since + c) * (exposure_s**2 / 24)
        both = angle + bend + 0.5 * _cross(angle, bend)
        return Orientations(self.rotation_world_cam.take(interval, axis=0), _exponential(*both))

    def turned_by(self, rate_polynomials: Array) -> Turning:
        """To first order, the rotations due to further rates (4, 3, n − 1, k), in camera axes."""
        step_s, rotation = np.diff(self.time_s)[:, None], self.rotation_world_cam
        angle = np.moveaxis(_integral(rate_polynomials, step_s), 1, 0)
        last = _rate(rate_polynomials[:, :, -1], step_s[-1])
        rate = np.moveaxis(np.concatenate([rate_polynomials[3], last[:, None]], axis=1), 1, 0)
        at_knots = np.zeros(rate.shape)
        np.cumsum(0.5 * (rotation[:-1] + rotation[1:]) @ angle, axis=0, out=at_knots[1:])
        flat = (part.reshape(len(part), -1) for part in (at_knots, rotation @ rate))
        return Turning(at_knots, hermite(self.time_s, *flat))

    def _locate(self, time_s: Array) -> tuple[Index, Array]:
        """Interval of each time (...), and the seconds since its knot (...). Times beyond the knots are clipped."""
        held = np.minimum(np.maximum(time_s, self.time_s[0]), self.time_s[-1])
        interval = np.minimum(np.maximum(self.time_s.searchsorted(held, "right") - 1, 0), len(self.time_s) - 2)
        return interval, held - self.time_s[interval]


@dataclass(frozen=True, slots=True)
class Turning:
    """Small rotations θ of a camera about world axes, k at once: R becomes exp(θ) R."""

    at_knots: Array
    """(n, 3, k) rotation vectors at the trajectory's knots."""
    spline: CubicHermiteSpline
    """(3 k) the same at any time, flat."""

    def at(self, time_s: Array, exposure_s: Array | float = 0.0) -> Array:
        """θ (m, 3, k) at times (m,), or averaged over exposures around them: θ + θ'' E² / 24, to second order."""
        held = np.clip(time_s, self.spline.x[0], self.spline.x[-1])
        found = self.spline(held)
        if np.any(exposure_s):
            found = found + self.spline(held, 2) * (np.asarray(exposure_s) ** 2 / 24)[..., None]
        return np.asarray(found).reshape(-1, *self.at_knots.shape[1:])


@dataclass(frozen=True, slots=True)
class Orientations:
    """R_world_cam at n times, as the knot's and the rotation since: rotating twice costs less than their product."""

    knot: Array
    """(n, 3, 3)."""
    since: Array
    """(n, 3, 3)."""

    def halves(self) -> tuple[Orientations, Orientations]:
        """Those at the first n / 2 times, and those at the others."""
        middle = len(self.knot) // 2
        first, second = slice(middle), slice(middle, None)
        return Orientations(self.knot[first], self.since[first]), Orientations(self.knot[second], self.since[second])

    def to_world(self, rays: Array) -> Array:
        """Rays (n, 3) from camera to world axes."""
        return turned(self.knot, turned(self.since, rays))

    def to_camera(self, rays: Array) -> Array:
        """Rays (n, 3) from world to camera axes."""
        in_knot = np.einsum("nji,nj->ni", self.knot, rays)
        return np.asarray(np.einsum("nji,nj->ni", self.since, in_knot))

    def per_world(self, slopes: Array) -> Array:
        """Slopes (n, k, 3) with respect to camera axes, converted to world axes."""
        to_camera = np.swapaxes(self.knot @ self.since, -1, -2)
        return np.asarray(slopes @ np.ascontiguousarray(to_camera))  # products of transposed views take three times


def hermite(time_s: Array, values: Array, slopes: Array) -> CubicHermiteSpline:
    """The spline through values and slopes (n, k) at n times; its pieces as SciPy computes them, without its checks."""
    step = np.diff(time_s)[:, None]
    slope, begin = np.diff(values, axis=0) / step, slopes[:-1]
    bend = (begin + slopes[1:] - 2 * slope) / step
    pieces = np.stack([bend / step, (slope - begin) / step - bend, begin, values[:-1]])
    return CubicHermiteSpline.construct_fast(pieces, time_s, True, 0)


def turned(rotation: Array, rays: Array) -> Array:
    """Apply rotations (n, 3, 3) to rays (n, 3)."""
    return np.asarray(np.einsum("nij,nj->ni", rotation, rays))


def turned_angle(pieces: Array, since_s: Array) -> Array:
    """Rotation vector (3, ...) after a given time at the rate of polynomials (4, 3, ...), highest power first.

    The rate's integral and the second term of the Magnus series for a rate that changes linearly: Δt²/12 ω₀ × ω₁ (body
    axes).
    """
    return np.asarray(_integral(pieces, since_s) + since_s**2 / 12.0 * _cross(pieces[3], _rate(pieces, since_s)))


def _rate(pieces: Array, since_s: Array) -> Array:
    """Rate (3, ...) of polynomials (4, 3, ...), highest power first, after a given time."""
    a, b, c, d = pieces
    return np.asarray(((a * since_s + b) * since_s + c) * since_s + d)


def _integral(pieces: Array, since_s: Array) -> Array:
    """Its integral (3, ...) from the piece's start."""
    a, b, c, d = pieces
    return np.asarray(since_s * (d + since_s * (c / 2 + since_s * (b / 3 + since_s * (a / 4)))))


def _cross(u: Array, v: Array) -> Array:
    """u × v of vectors (3, ...)."""
    cross = np.empty_like(u)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        cross[i] = u[j] * v[k] - u[k] * v[j]
    return cross


def _vectors(parts: Array) -> Array:
    """(3, ...) as (..., 3)."""
    return np.ascontiguousarray(np.moveaxis(parts, 0, -1))


def rotation_from_vector(vector: Array) -> Array:
    """exp: rotation matrices (..., 3, 3) of rotation vectors (..., 3)."""
    return _exponential(vector[..., 0], vector[..., 1], vector[..., 2])


def _exponential(x: Array, y: Array, z: Array) -> Array:
    """Rotation matrices (..., 3, 3) of the vectors with these parts (...), by Rodrigues' formula."""
    squared = x * x + y * y + z * z
    if squared.max(initial=0.0) < _SMALL_SQUARE:
        sine = 1 + squared * (-1 / 6 + squared * (1 / 120 + squared * (-1 / 5040 + squared / 362880)))
        cosine = 0.5 + squared * (-1 / 24 + squared * (1 / 720 + squared * (-1 / 40320 + squared / 3628800)))
    else:
        half = np.maximum(0.5 * np.sqrt(squared), 1e-150)
        share = np.sin(half) / half
        sine, cosine = share * np.cos(half), 0.5 * share * share
    matrix = np.empty((*x.shape, 3, 3))
    for i, part in enumerate((x, y, z)):
        matrix[..., i, i] = 1 - cosine * (squared - part * part)
    for i, j, along, product in ((2, 1, x, y * z), (0, 2, y, x * z), (1, 0, z, x * y)):
        across, along = cosine * product, sine * along
        matrix[..., i, j] = across + along
        matrix[..., j, i] = across - along
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
