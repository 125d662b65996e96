"""How far the pictures turned from frame to frame, and when the gyroscope did: the coarse search for a time offset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from virest.camera.intrinsics import Intrinsics
from virest.inference.tracking import TrackPair
from virest.motion.trajectory import Trajectory, vector_from_rotation

Array = NDArray[np.float64]
REWEIGHTINGS = 8
SOFT_CAP = 1.0
"""A pair's deviation counts fully up to about this part of the typical turn; beyond it ever less (moving objects)."""


@dataclass(frozen=True, slots=True)
class FrameRotations:
    """Rotation of the pictures over pairs of frames: x_second = exp(vector) x_first for rays in camera axes."""

    first_s: Array
    """(p,) when the centre of the first picture was seen, camera clock."""
    second_s: Array
    """(p,)."""
    vector_rad: Array
    """(p, 3)."""

    @property
    def middle_s(self) -> Array:
        """(p,) between the two."""
        return 0.5 * (self.first_s + self.second_s)

    def detrended(self, values: Array) -> Array:
        """(..., p, 3) without what a constant and a steadily drifting rate would make: gyro bias, or a steady pan."""
        lasting = self.second_s - self.first_s
        basis = np.stack([lasting, lasting * (self.middle_s - self.middle_s.mean())], axis=-1)
        q, _ = np.linalg.qr(basis / np.linalg.norm(basis, axis=0).clip(1e-9))
        return values - q @ (q.T @ values)


@dataclass(frozen=True, slots=True)
class OffsetScan:
    """How well the gyroscope explains the pictures' turns at each offset tried."""

    offset_s: Array
    """(k,)."""
    explained: Array
    """(k,) 1 − (what is left) / (what there was), both after detrending; at most 1, below 0 worse than no gyroscope."""
    gain: Array
    """(k,) pitch and yaw in the pictures over those of the gyroscope; 1 where the focal length is known."""

    def peaks(self) -> NDArray[np.intp]:
        """Find indices of the local maxima, ends included, best first."""
        held = np.concatenate([[-np.inf], self.explained, [-np.inf]])
        top = np.flatnonzero((held[1:-1] >= held[:-2]) & (held[1:-1] > held[2:]))
        return top[np.argsort(-self.explained[top])]


def picture_rotation(lens: Intrinsics, pair: TrackPair) -> Array:
    """Rotation vector (3,) that takes the first picture's rays to the second's, robustly.

    Wahba's problem (Kabsch 1976) with Cauchy weights, whose scale is the median deviation of the pass before.
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


def picture_turns(lens: Intrinsics, pairs: Sequence[TrackPair], first_s: Array, second_s: Array) -> FrameRotations:
    """Rotation of every pair; first_s, second_s: (p,) camera clock at which the pictures' centres were seen."""
    vectors = np.array([picture_rotation(lens, pair) for pair in pairs]).reshape(-1, 3)
    return FrameRotations(first_s, second_s, vectors)


def gyro_turns(trajectory: Trajectory, first_s: Array, second_s: Array) -> Array:
    """Predict what the pictures' rotation vectors (..., 3) should be between times (...) on the IMU clock."""
    after = trajectory.orientation(second_s)
    return vector_from_rotation(np.swapaxes(after, -1, -2) @ trajectory.orientation(first_s))


def scan_offsets(
    turns: FrameRotations, trajectory: Trajectory, clock_skew: float, offsets_s: Array, free_gain: bool = False
) -> OffsetScan:
    """Compare the pictures' turns with the gyroscope's at each offset; bias and slow drift are free.

    Offsets at which any pair would lie outside the inertial data are tried with the pairs that are left, and are given
    up below three quarters of them.  free_gain: fit one gain for pitch and yaw, as an unknown focal length needs.
    """
    first = turns.first_s * (1 + clock_skew) + offsets_s[:, None]
    second = turns.second_s * (1 + clock_skew) + offsets_s[:, None]
    start_s, end_s = trajectory.span_s
    inside = (first >= start_s) & (second <= end_s)
    predicted = turns.detrended(gyro_turns(trajectory, first, second))
    seen = turns.detrended(turns.vector_rad)
    gain = _gains(seen, predicted, inside) if free_gain else np.ones(len(offsets_s))
    predicted[..., :2] *= gain[:, None, None]
    scale = SOFT_CAP * np.sqrt(np.median((seen**2).sum(axis=-1))) + 1e-6
    before = _soft_energy(np.broadcast_to(seen, predicted.shape), scale, inside)
    explained = 1.0 - _soft_energy(seen - predicted, scale, inside) / np.maximum(before, 1e-18)
    enough = inside.sum(axis=1) >= 0.75 * len(turns.first_s)
    return OffsetScan(offsets_s, np.where(enough, explained, -np.inf), gain)


def _gains(seen: Array, predicted: Array, inside: NDArray[np.bool_]) -> Array:
    used = inside[..., None]
    cross = (seen[:, :2] * predicted[..., :2] * used).sum(axis=(1, 2))
    power = (predicted[..., :2] ** 2 * used).sum(axis=(1, 2))
    return np.clip(cross / np.maximum(power, 1e-18), 0.4, 2.5)


def _soft_energy(vectors: Array, scale: float, inside: NDArray[np.bool_]) -> Array:
    squared = (vectors**2).sum(axis=-1)
    return (np.log1p(squared / scale**2) * inside).sum(axis=-1)


def _unit(rays: Array) -> Array:
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)
