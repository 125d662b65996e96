"""Coarse alignment of frames and gyroscope: time offset and axes, from frame-to-frame rotations alone.

At each offset the best rotation between the rotation vectors of frames and gyroscope (Kabsch 1976) is computed in
closed form, so the sensor may be mounted in any orientation.  If the motion does not determine it (rotation about a
single axis), the profile's own rotation and the 24 axis maps are compared instead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np

from virest.arrays import Array, Mask
from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.inference.frame_rotations import FrameRotations, gyro_turns
from virest.motion.integration import integrate_gyro

SEARCH_S = 1.0
"""Range of the search on both sides: twice the largest offset of the real captures, nearly half a second."""
STEP_S = 0.004
"""Of the searched offsets; half or twice changes no fit that starts there (two simulated captures)."""
MIN_COVERED = 0.75
"""Smallest fraction of the pairs that must lie inside the inertial data."""
PLANAR = 0.05
"""Motion whose second axis has less than this fraction of the first one's power does not determine a rotation."""
KEEP_PROFILE = 1.15
"""Keep the profile's axes unless another rotation leaves less than 1 / this of their unexplained part."""
MAX_PROFILE_LEFT = 0.3
"""Keep the profile's axes at the same offset if they leave less than this fraction unexplained."""
SAME_VALLEY_S = 0.06
"""Offsets of the profile's axes and of free ones that lie this close are the same."""
SKEWS = (-0.0045, -0.003, -0.0015, 0.0015, 0.003, 0.0045)
"""Changes of the clock skew that are tried: up to 13 ms over 3 s."""
SKEW_GAIN = 0.8
"""Accept another clock rate if it leaves less than this fraction of what the profile's rate leaves unexplained."""
SOFTENING = 3.0
"""Pairs beyond this many typical deviations are down-weighted."""
GAINS = (0.4, 2.5)
"""Bounds of the gain of pitch and yaw if the focal length is guessed."""
MIN_PAIRS = 8
"""Fewer pairs of frames do not determine an offset."""
MIN_MOTION_PX = 0.4
"""Smallest rms of the changing part of the frame-to-frame rotation, px at the focal length."""
MIN_EXPLAINED, MIN_EXPLAINED_BY_PAIR, MAX_MIN_EXPLAINED = 0.5, 5.0, 0.9
"""Frames follow the gyroscope if it explains at least 0.5 + 5 / pairs, at most 0.9, of their rotation: with few pairs,
unrelated motion reaches 0.7 at some offset within 1 s; with 40 pairs it stays below 0.5."""
MIN_DISTINCT = 1.6
"""The best offset must leave less than 1 / this of what the runner-up leaves unexplained."""


@dataclass(frozen=True, slots=True)
class CoarseAlignment:
    """The offset and axes at which frames and gyroscope agree best."""

    time_offset_s: float
    """For the middle of readout and exposure: needs no further correction."""
    rotation_cam_imu: Array
    """(3, 3)."""
    explained: float
    """Fraction of the frames' changing rotation that the gyroscope explains there."""
    runner_up: float
    """The same at the best offset outside its valley."""
    runner_up_s: float
    axes_changed: bool
    """Whether another rotation than the profile's was chosen."""
    motion_rad: float
    """rms of the changing part of the frame-to-frame rotation."""
    at_end: bool
    """Whether the offset lies at the end of the search."""
    gain: float
    """Pitch and yaw in the frames over those of the gyroscope; 1 if the focal length is known."""
    offset_s: Array
    """(k,) all offsets searched."""
    explained_at: Array
    """(k,) fraction that each of them explains."""

    def explained_near(self, offset_s: float, within_s: float) -> float:
        """The most that is explained within some time of an offset; -inf where none was tried."""
        return float(np.max(self.explained_at, where=np.abs(self.offset_s - offset_s) <= within_s, initial=-np.inf))

    def doubt(self, pairs: int, focal_px: float) -> tuple[str, str] | None:
        """(why the offset is not trustworthy, what to do); None if it is trustworthy."""
        motion_px = self.motion_rad * focal_px
        if motion_px < MIN_MOTION_PX:
            return (
                f"the rotation hardly changes between frames ({motion_px:.2f} px)",
                "shake the phone about all three axes; a camera at rest or a steady pan determines nothing",
            )
        if self.explained < min(MIN_EXPLAINED + MIN_EXPLAINED_BY_PAIR / pairs, MAX_MIN_EXPLAINED):
            return (
                f"the frames do not follow the gyroscope: it explains {max(self.explained, 0):.0%} of their rotation",
                "was the movie stabilised in the camera, or is it from another recording?",
            )
        if self.at_end:
            return (
                f"the time offset is at the end of the search range ({self.time_offset_s:+.2f} s)",
                "give a time_offset_s near the true one",
            )
        if 1 - self.runner_up < MIN_DISTINCT * (1 - self.explained):
            return (
                f"offsets of {self.time_offset_s:+.3f} and {self.runner_up_s:+.3f} s fit the frames about equally well",
                "move less regularly",
            )
        return None


def align_coarsely(
    turns: FrameRotations,
    imu: ImuSamples,
    profile: CameraProfile,
    search_s: float = SEARCH_S,
    *,
    own_axes: bool = False,
    free_focal: bool = False,
) -> CoarseAlignment | None:
    """Search offsets within ± search_s of the profile's; None if the inertial data cover the pairs at no offset.

    Bias and slow drift are free.  own_axes: try only the profile's axes.  free_focal: with the profile's axes, fit a
    common gain of pitch and yaw, as a guessed focal length needs.
    """
    centre = profile.time_offset_s or 0.0
    steps = int(np.ceil(search_s / STEP_S))
    offsets = centre + STEP_S * np.arange(-steps, steps + 1, dtype=float)
    in_imu = integrate_gyro(imu, replace(profile, r_cam_imu=tuple(map(tuple, np.eye(3).tolist()))))
    first = turns.first_s * (1 + profile.clock_skew) + offsets[:, None]
    second = turns.second_s * (1 + profile.clock_skew) + offsets[:, None]
    inside = (first >= in_imu.span_s[0]) & (second <= in_imu.span_s[1])
    gyro = turns.detrended(gyro_turns(in_imu, first, second))
    seen = turns.detrended(turns.vector_rad)
    motion = float(np.sqrt(np.mean((seen**2).sum(axis=-1))))
    covered = inside.mean(axis=1) >= MIN_COVERED
    if not covered.any() or motion <= 0:
        return None
    axes = profile.rotation_cam_imu
    gain = _gains(seen, gyro @ axes.T, inside) if free_focal else np.ones(len(offsets))
    own = np.where(covered, _explained(seen, gyro, inside, axes[None], gain), -np.inf)
    best, explained, keep = int(np.argmax(own)), own, True
    if not own_axes:
        free, rotation = _best_rotations(seen, gyro, inside)
        free = np.where(covered, free, -np.inf)
        best_free = int(np.argmax(free))
        same = abs(offsets[best] - offsets[best_free]) <= SAME_VALLEY_S
        keep = 1 - own[best] < max(KEEP_PROFILE * (1 - free[best_free]), 1e-3)
        keep = keep or (same and 1 - own[best] < MAX_PROFILE_LEFT)
        if not keep:
            best, explained, gain, axes = best_free, free, np.ones(len(offsets)), rotation[best_free]
    other = _runner_up(explained, best)
    return CoarseAlignment(
        float(offsets[best]), axes, float(explained[best]), -np.inf if other is None else float(explained[other]),
        float(offsets[best if other is None else other]), not keep, motion, best in (0, len(offsets) - 1),
        float(gain[best]), offsets, explained,
    )  # fmt: skip


def _runner_up(explained: Array, best: int) -> int | None:
    """The best offset outside the best one's valley, which ends where twice as much is left, or half is explained."""
    left = 1 - explained[best]
    worse = 1 - explained > min(2 * left, 0.5 * (1 + left))
    numbers = np.arange(len(worse))
    below = np.max(numbers[worse & (numbers < best)], initial=-1)
    above = np.min(numbers[worse & (numbers > best)], initial=len(worse))
    held = np.concatenate([[-np.inf], explained, [-np.inf]])
    peak = (explained >= held[:-2]) & (explained > held[2:]) & ((numbers <= below) | (numbers >= above))
    return int(np.argmax(np.where(peak, explained, -np.inf))) if peak.any() else None


def align_with_skew(
    turns: FrameRotations, imu: ImuSamples, profile: CameraProfile, search_s: float = 1.0
) -> tuple[CoarseAlignment, float] | None:
    """Align coarsely at several clock skews; the profile's stays unless another fits much better."""
    best = align_coarsely(turns, imu, profile, search_s)
    skew = profile.clock_skew
    for change in SKEWS:
        other = align_coarsely(turns, imu, replace(profile, clock_skew=profile.clock_skew + change), search_s)
        if other is None:
            continue
        needed = SKEW_GAIN if skew == profile.clock_skew else 1.0
        if best is None or 1 - other.explained < needed * (1 - best.explained):
            best, skew = other, profile.clock_skew + change
    return None if best is None else (best, skew)


def axis_maps() -> Array:
    """The 24 rotations that map coordinate axes to coordinate axes, (24, 3, 3)."""
    maps = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) > 0:
                maps.append(matrix)
    return np.array(maps)


def _best_rotations(seen: Array, gyro: Array, inside: Mask) -> tuple[Array, Array]:
    """Explained fraction (k,) and rotation (k, 3, 3) at each offset, reweighted once against outlying pairs."""
    weight = inside.astype(float)
    for _ in range(2):
        cross = np.einsum("pi,kpj,kp->kij", seen, gyro, weight)
        u, s, vt = np.linalg.svd(cross)
        flip = np.ones((len(cross), 3))
        flip[:, 2] = np.linalg.det(u @ vt)
        rotation = (u * flip[:, None, :]) @ vt
        weight = _soft_weights(seen, gyro, inside, rotation)
    planar = s[:, 1] < PLANAR * s[:, 0]
    explained = _explained(seen, gyro, inside, rotation)
    if planar.any():
        by_map = np.array([_explained(seen, gyro[planar], inside[planar], m[None]) for m in axis_maps()])
        rotation[planar] = axis_maps()[by_map.argmax(axis=0)]
        explained[planar] = by_map.max(axis=0)
    return explained, rotation


def _gains(seen: Array, gyro: Array, inside: Mask) -> Array:
    """Gains (k,) of pitch and yaw, frames over gyroscope, both in camera axes."""
    used = inside[..., None]
    cross = (seen[:, :2] * gyro[..., :2] * used).sum(axis=(1, 2))
    return np.clip(cross / np.maximum((gyro[..., :2] ** 2 * used).sum(axis=(1, 2)), 1e-18), *GAINS)


def _soft_weights(seen: Array, gyro: Array, inside: Mask, rotation: Array) -> Array:
    squared = ((seen - gyro @ np.swapaxes(rotation, -1, -2)) ** 2).sum(axis=-1)
    scale = np.maximum(np.median(squared, axis=1, keepdims=True), 1e-14)
    return inside / (1 + squared / (SOFTENING**2 * scale))


def _explained(seen: Array, gyro: Array, inside: Mask, rotation: Array, gain: Array | None = None) -> Array:
    """1 − (residual power) / (power), saturated beyond the typical rotation, so that outlying pairs do not dominate."""
    predicted = gyro @ np.swapaxes(rotation, -1, -2)
    if gain is not None:
        predicted[..., :2] *= gain[:, None, None]
    left = ((seen - predicted) ** 2).sum(axis=-1)
    before = np.broadcast_to((seen**2).sum(axis=-1), left.shape)
    scale = np.median((seen**2).sum(axis=-1)) + 1e-12
    return 1 - (np.log1p(left / scale) * inside).sum(axis=1) / np.maximum(
        (np.log1p(before / scale) * inside).sum(axis=1), 1e-18
    )
