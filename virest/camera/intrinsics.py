"""The lens: projection of rays in camera axes to pixels, and back.

Camera axes: x right, y down, z forward.  Pixel (0, 0) is the centre of the top-left pixel.
Distortion models are OpenCV's: ``radtan`` (Brown 1971; k1 k2 p1 p2 k3) and ``fisheye``
(Kannala & Brandt 2006, doi:10.1109/TPAMI.2006.153; k1 k2 k3 k4).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from virest.arrays import Array
from virest.camera.field import Field
from virest.errors import SettingsError

COEFFICIENT_NAMES: dict[str, tuple[str, ...]] = {
    "none": (),
    "radtan": ("k1", "k2", "p1", "p2", "k3"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
_UNDISTORT_STEPS, _RAY_TOLERANCE = 12, 1e-9
"""Most steps of Newton's method, and the step in x/z at which it ends: 1e-6 px at a focal length of 1000 px.  Six steps
leave less than 3e-15 on five polynomial and three fisheye lenses, one of which folds back within the picture."""
_WITHIN_FOLD = 1e-2
"""Relative distance kept from the radius at which the distortion folds back, so that Newton's method converges."""


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A pinhole camera with lens distortion."""

    width: int
    """Pixels of a stored row."""
    height: int
    """Number of stored rows."""
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    model: str = "none"
    """``none``, ``radtan`` or ``fisheye``."""
    coefficients: tuple[float, ...] = ()
    """In the order of COEFFICIENT_NAMES."""
    displaced: Field | None = None
    """Displacement of points from the model; None: none."""

    def __post_init__(self) -> None:
        if self.model not in COEFFICIENT_NAMES:
            raise SettingsError(
                f"unknown distortion model '{self.model}'",
                hint=f"use one of {', '.join(COEFFICIENT_NAMES)}",
            )
        if len(self.coefficients) != len(COEFFICIENT_NAMES[self.model]):
            raise SettingsError(
                f"distortion model '{self.model}' takes {len(COEFFICIENT_NAMES[self.model])} coefficients, "
                f"got {len(self.coefficients)}"
            )

    @property
    def matrix(self) -> Array:
        """K of the paper, (3, 3)."""
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1.0]])

    @property
    def named_coefficients(self) -> dict[str, float]:
        """The distortion coefficients by name, such as ``k1``; empty without distortion."""
        return dict(zip(COEFFICIENT_NAMES[self.model], self.coefficients, strict=True))

    @property
    def is_distorted(self) -> bool:
        """Whether distortion moves any pixel; that of the equidistant fisheye does even with zero coefficients."""
        return self.model == "fisheye" or any(self.coefficients) or self.displaced is not None

    @property
    def pinhole(self) -> Intrinsics:
        """The camera of the same focal lengths and principal point without distortion."""
        return replace(self, model="none", coefficients=(), displaced=None)

    def radius_px(self, points_px: Array) -> Array:
        """Distance (...) of pixels (..., 2) from the principal point."""
        return np.hypot(points_px[..., 0] - self.cx_px, points_px[..., 1] - self.cy_px)

    def scaled_focal(self, scale: float) -> Intrinsics:
        """The same lens with both focal lengths multiplied by ``scale``."""
        return replace(self, fx_px=self.fx_px * scale, fy_px=self.fy_px * scale)

    def project(self, rays: Array) -> Array:
        """Pixels (..., 2) of rays (..., 3) in camera axes; z > 0 is in front of the camera."""
        plane = rays[..., :2] / rays[..., 2:]
        points = self._distort(plane) * (self.fx_px, self.fy_px) + (self.cx_px, self.cy_px)
        return points if self.displaced is None else points + self.displaced.at(points[..., 0], points[..., 1])

    def rays(self, points_px: Array) -> Array:
        """Rays (..., 3) with z = 1 through pixels (..., 2): the inverse of :meth:`project`."""
        if self.displaced is not None:
            points_px = self.displaced.undisplaced(points_px)
        distorted = (np.asarray(points_px, float) - (self.cx_px, self.cy_px)) / (self.fx_px, self.fy_px)
        plane = self._undistort(distorted)
        return np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1)

    def _distort(self, plane: Array) -> Array:
        if self.model != "fisheye" and not any(self.coefficients):
            return plane
        if self.model == "fisheye":
            radius = np.linalg.norm(plane, axis=-1, keepdims=True)
            theta = np.arctan(radius)
            scale = _fisheye_angle(theta, self.coefficients) / np.maximum(radius, 1e-12)
            return plane * np.where(radius > 1e-9, scale, 1.0)
        k1, k2, p1, p2, k3 = self.coefficients
        x, y = plane[..., 0], plane[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return np.stack(
            [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y],
            axis=-1,
        )

    def _undistort(self, distorted: Array) -> Array:
        """Newton's method on the distortion.

        Beyond the radius at which radial distortion folds back, no ray is seen: pixels there get the rays just inside,
        which are finite and change little with the lens.
        """
        if self.model != "fisheye" and not any(self.coefficients):
            return distorted
        if self.model == "fisheye":
            angle = np.linalg.norm(distorted, axis=-1, keepdims=True)
            theta = angle.copy()
            for _ in range(_UNDISTORT_STEPS):
                slope = _fisheye_slope(theta, self.coefficients)
                theta -= (_fisheye_angle(theta, self.coefficients) - angle) / np.where(np.abs(slope) > 1e-3, slope, 1.0)
            theta = np.clip(theta, 0.0, 1.55)
            return distorted * np.where(angle > 1e-9, np.tan(theta) / np.maximum(angle, 1e-12), 1.0)
        most = (1 - _WITHIN_FOLD) * _fold_radius(self.coefficients)
        radius = np.linalg.norm(distorted, axis=-1, keepdims=True)
        if np.max(radius, initial=0.0) > most:
            distorted = distorted * np.minimum(1.0, most / np.maximum(radius, most))
        plane = distorted.copy()
        for _ in range(_UNDISTORT_STEPS):
            error = self._distort(plane) - distorted
            step = _solve_2x2(self._distortion_jacobian(plane), error)
            plane -= step
            if np.max(np.abs(step), initial=0.0) < _RAY_TOLERANCE:
                break
        return plane

    def _distortion_jacobian(self, plane: Array) -> Array:
        k1, k2, p1, p2, k3 = self.coefficients
        x, y = plane[..., 0], plane[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
        cross = x * y * slope + 2 * p1 * x + 2 * p2 * y
        return np.stack(
            [
                np.stack([radial + x * x * slope + 2 * p1 * y + 6 * p2 * x, cross], axis=-1),
                np.stack([cross, radial + y * y * slope + 6 * p1 * y + 2 * p2 * x], axis=-1),
            ],
            axis=-2,
        )


@lru_cache(maxsize=256)
def _fold_radius(coefficients: tuple[float, ...]) -> float:
    """First maximum of r (1 + k1 r² + k2 r⁴ + k3 r⁶) over r, units of the focal length; inf: none."""
    k1, k2, k3 = (k if abs(k) > _RAY_TOLERANCE else 0.0 for k in (*coefficients[:2], coefficients[4]))
    roots = np.polynomial.polynomial.polyroots(np.trim_zeros(np.array([1.0, 3 * k1, 5 * k2, 7 * k3]), "b"))
    squares = [root.real for root in roots if abs(root.imag) < _RAY_TOLERANCE and root.real > 0]
    if not squares:
        return np.inf
    r2 = min(squares)
    return float(np.sqrt(r2) * (1 + r2 * (k1 + r2 * (k2 + r2 * k3))))


def _fisheye_angle(theta: Array, k: tuple[float, ...]) -> Array:
    t2 = theta * theta
    return theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))


def _fisheye_slope(theta: Array, k: tuple[float, ...]) -> Array:
    t2 = theta * theta
    return 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])))


def _solve_2x2(matrix: Array, right: Array) -> Array:
    a, b, c, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 0], matrix[..., 1, 1]
    determinant = a * d - b * c
    determinant = np.where(np.abs(determinant) > 1e-6, determinant, 1.0)
    x = (d * right[..., 0] - b * right[..., 1]) / determinant
    y = (a * right[..., 1] - c * right[..., 0]) / determinant
    return np.stack([x, y], axis=-1)
