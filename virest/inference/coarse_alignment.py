"""Pictures and gyroscope brought roughly together: time offset and axes, from turns alone.

At each offset the best rotation between the pictures' turns and the gyroscope's (Kabsch 1976) is found in closed form,
so a sensor mounted any way round is no obstacle.  Where the motion determines no rotation (turns
about one axis), the profile's own and the 24 axis maps are compared instead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.inference.frame_rotations import FrameRotations, gyro_turns
from virest.motion.integration import integrate_gyro

Array = NDArray[np.float64]
STEP_S = 0.004
MIN_COVERED = 0.75
"""Least part of the pairs that must lie inside the inertial data."""
PLANAR = 0.05
"""Turns whose second axis has less than this part of the first one's power do not determine a rotation."""
KEEP_PROFILE = 1.15
"""The profile's own axes stay unless another rotation leaves less than 1 / this of what they leave unexplained."""
MAX_PROFILE_LEFT = 0.3
"""And unless they leave more than this part unexplained."""
SAME_VALLEY_S = 0.06
SKEWS = (-0.0045, -0.003, -0.0015, 0.0015, 0.003, 0.0045)
SKEW_GAIN = 0.8
"""Another clock rate is taken if it leaves less than this part of what the profile's leaves unexplained."""
SOFTENING = 3.0
"""Pairs further off than this many typical deviations are held back."""
GAINS = (0.4, 2.5)
"""Of pitch and yaw, where the focal length is guessed."""
MIN_PAIRS = 8
"""Fewer pairs of frames tell no clocks."""
MIN_MOTION_PX = 0.4
"""Least rms of the pictures' changing turns from frame to frame, at the focal length."""
MIN_EXPLAINED, MIN_EXPLAINED_BY_PAIR, MAX_MIN_EXPLAINED = 0.5, 5.0, 0.9
"""Pictures follow the gyroscope if it explains 0.5 + 5 / pairs, at most 0.9, of their turns: with few pairs, unrelated
motion reaches 0.7 at some offset within a second; with 40 it stays below 0.5."""
MIN_DISTINCT = 1.6
"""The best offset leaves less than 1 / this of what the runner-up leaves unexplained."""


@dataclass(frozen=True, slots=True)
class CoarseAlignment:
    """Where pictures and gyroscope agree best."""

    time_offset_s: float
    """At the middle of the readout, exposure's middle: add nothing more."""
    rotation_cam_imu: Array
    """(3, 3)."""
    explained: float
    """Part of the pictures' changing turns that the gyroscope then explains."""
    runner_up: float
    """The same at the best offset outside its valley."""
    runner_up_s: float
    axes_changed: bool
    """Whether another rotation than the profile's was taken."""
    motion_rad: float
    """rms of the pictures' changing turns from frame to frame."""
    at_end: bool
    """Whether the offset lies at the end of the search."""
    gain: float
    """Pitch and yaw in the pictures over those of the gyroscope; 1 where the focal length is known."""
    offset_s: Array
    """(k,) all that were tried."""
    explained_at: Array
    """(k,) what each of them explains."""

    def explained_near(self, offset_s: float, within_s: float) -> float:
        """The most that is explained within some time of an offset; -inf where none was tried."""
        return float(np.max(self.explained_at, where=np.abs(self.offset_s - offset_s) <= within_s, initial=-np.inf))

    def doubt(self, pairs: int, focal_px: float) -> tuple[str, str] | None:
        """Why the offset is not to be trusted, and what to do; None: it is."""
        motion_px = self.motion_rad * focal_px
        if motion_px < MIN_MOTION_PX:
            return (
                f"the pictures hardly change their turn ({motion_px:.2f} px from frame to frame)",
                "shake the phone about all three axes; a camera at rest or a steady pan determines nothing",
            )
        if self.explained < min(MIN_EXPLAINED + MIN_EXPLAINED_BY_PAIR / pairs, MAX_MIN_EXPLAINED):
            return (
                f"the pictures do not follow the gyroscope: it explains {max(self.explained, 0):.0%} of their turns",
                "stabilised in the camera, or not of this recording?",
            )
        if self.at_end:
            return (
                f"the time offset lies at the end of the search ({self.time_offset_s:+.2f} s)",
                "give a time_offset_s to search about",
            )
        if 1 - self.runner_up < MIN_DISTINCT * (1 - self.explained):
            return (
                f"offsets of {self.time_offset_s:+.3f} and {self.runner_up_s:+.3f} s fit the pictures about equally",
                "move less regularly",
            )
        return None


def align_coarsely(
    turns: FrameRotations,
    imu: ImuSamples,
    profile: CameraProfile,
    search_s: float = 1.0,
    *,
    own_axes: bool = False,
    free_focal: bool = False,
) -> CoarseAlignment | None:
    """Search offsets within ± search_s of the profile's; None if the inertial data cover the pairs nowhere.

    Bias and slow drift are free.  own_axes: no others than the profile's are tried.  free_focal: one gain for pitch and
    yaw is fitted with the profile's axes, as a guessed focal length needs.
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
    """The best offset outside the valley of the best one: where twice as much is left, or half as much explained."""
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
    """The 24 rotations that take axes to axes, (24, 3, 3)."""
    maps = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) > 0:
                maps.append(matrix)
    return np.array(maps)


def _best_rotations(seen: Array, gyro: Array, inside: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Explained part (k,) and rotation (k, 3, 3) at each offset, reweighted once against pairs gone astray."""
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


def _gains(seen: Array, gyro: Array, inside: NDArray[np.bool_]) -> Array:
    """Pitch and yaw in the pictures over those of the gyroscope (k,), both in camera axes."""
    used = inside[..., None]
    cross = (seen[:, :2] * gyro[..., :2] * used).sum(axis=(1, 2))
    return np.clip(cross / np.maximum((gyro[..., :2] ** 2 * used).sum(axis=(1, 2)), 1e-18), *GAINS)


def _soft_weights(seen: Array, gyro: Array, inside: NDArray[np.bool_], rotation: Array) -> Array:
    squared = ((seen - gyro @ np.swapaxes(rotation, -1, -2)) ** 2).sum(axis=-1)
    scale = np.maximum(np.median(squared, axis=1, keepdims=True), 1e-14)
    return inside / (1 + squared / (SOFTENING**2 * scale))


def _explained(
    seen: Array, gyro: Array, inside: NDArray[np.bool_], rotation: Array, gain: Array | None = None
) -> Array:
    """1 − (what is left) / (what there was), soft beyond the typical turn: single pairs gone astray do not decide."""
    told = gyro @ np.swapaxes(rotation, -1, -2)
    if gain is not None:
        told[..., :2] *= gain[:, None, None]
    left = ((seen - told) ** 2).sum(axis=-1)
    before = np.broadcast_to((seen**2).sum(axis=-1), left.shape)
    scale = np.median((seen**2).sum(axis=-1)) + 1e-12
    return 1 - (np.log1p(left / scale) * inside).sum(axis=1) / np.maximum(
        (np.log1p(before / scale) * inside).sum(axis=1), 1e-18
    )
