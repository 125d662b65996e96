"""Rotation between consecutive frames, from tracked points and from the gyroscope, for the coarse offset search."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from virest.arrays import Array
from virest.camera.intrinsics import Intrinsics
from virest.inference.tracking import TrackPair
from virest.motion.trajectory import Trajectory, vector_from_rotation

REWEIGHTINGS = 8
"""Passes against outliers; half or twice as many change no offset of two simulated captures."""


@dataclass(frozen=True, slots=True)
class FrameRotations:
    """Rotation over pairs of frames: x_second = exp(vector) x_first for rays in camera axes."""

    first_s: Array
    """(p,) time of the first frame's centre row, camera clock."""
    second_s: Array
    """(p,)."""
    vector_rad: Array
    """(p, 3)."""

    @property
    def middle_s(self) -> Array:
        """(p,) midpoint of the two."""
        return 0.5 * (self.first_s + self.second_s)

    def detrended(self, values: Array) -> Array:
        """(..., p, 3) without a constant and a linearly drifting rate, such as gyroscope bias or a steady pan."""
        lasting = self.second_s - self.first_s
        basis = np.stack([lasting, lasting * (self.middle_s - self.middle_s.mean())], axis=-1)
        q, _ = np.linalg.qr(basis / np.linalg.norm(basis, axis=0).clip(1e-9))
        return values - q @ (q.T @ values)


def picture_rotation(lens: Intrinsics, pair: TrackPair) -> Array:
    """Robust rotation vector (3,) that takes the first frame's rays to the second's.

    Wahba's problem (Kabsch 1976) with Cauchy weights, scaled by the median deviation of the previous pass.
    """
    first, second = _unit(lens.rays(pair.points_first_px)), _unit(lens.rays(pair.points_second_px))
    weight = np.ones(len(first))
    rotation = np.eye(3)
    for _ in range(REWEIGHTINGS):
        u, _, vt = np.linalg.svd((second * weight[:, None]).T @ first)
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        deviation = np.linalg.norm(second - first @ rotation.T, axis=-1)
        weight = 1.0 / (1.0 + (deviation / max(float(np.median(deviation)), 1e-6)) ** 2)
    return vector_from_rotation(rotation)


def gyro_turns(trajectory: Trajectory, first_s: Array, second_s: Array) -> Array:
    """Rotation vectors (..., 3) that the gyroscope predicts between times (...) on the IMU clock."""
    after = trajectory.orientation(second_s)
    return vector_from_rotation(np.swapaxes(after, -1, -2) @ trajectory.orientation(first_s))


def _unit(rays: Array) -> Array:
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)
