"""The camera's motion during one frame, row by row (forward_model, sections 1, 2 and 5)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.image_formation.row_clock import ROW_END, ROW_MIDDLE, ROWS, RowClock, of_frame, row_time_s
from virest.motion.optics import MovingLens, moving_lens
from virest.motion.relief_surface import Relief
from virest.motion.trajectory import Trajectory, rotation_from_vector, vector_from_rotation

STEP_S = 2e-4
"""Step of the tabulated motion: at 50 rad/s² linear interpolation errs by 2.5e-7 rad."""
OUTSIDE_FRACTION = 0.25
"""The table extends this fraction of the readout beyond the first and last row, for points outside the picture."""

_LEAST_DISTANCE = 0.05
"""Smallest distance of the camera from the scene, relative to that at the reference time."""
_RELIEF_STEPS = 3
"""A point's position on the surface depends on its depth: each step reduces the error by the slope × parallax."""


@dataclass(frozen=True, slots=True)
class FrameTranslation:
    """The motion of the camera's centre during one frame, and the scene in front of it.

    All in camera axes at the frame's reference time t_ref: the centre is at v s + a s²/2 + j s³/6 + k s⁴/24 with
    s = t − t_ref.
    """

    velocity_m_s: Array
    """(3,) at the reference time."""
    acceleration_m_s2: Array
    """(3,) at the reference time, without gravity."""
    inverse_depth_plane: Array
    """(3,) 1/m: the inverse depth along the optical axis of a ray r with z = 1 is plane · r, floored at 0."""
    depth_m: float | None = None
    """At the picture's centre, for the log; None: unknown."""
    source: str = "none"
    """Source of the depth: ``triangulated``, ``profile`` or ``none``."""
    relief: Relief | None = None
    """Relief on the plane, at the reference time; None: unknown or none."""
    unit: int = 0
    """0: metres.  Otherwise only velocity over depth is known, and lengths must not be logged: frames with the same
    number share an unknown unit of length."""
    jerk_m_s3: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) j, at the reference time."""
    snap_m_s4: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) k: constant, and 0 for the motion over a single frame."""

    @property
    def in_metres(self) -> bool:
        """Whether lengths are in metres."""
        return self.unit == 0

    def position_m(self, since_reference_s: Array) -> Array:
        """Centre (..., 3) at times (...) from the reference."""
        s = np.asarray(since_reference_s, float)[..., None]
        return np.asarray(
            s
            * (self.velocity_m_s + s / 2 * (self.acceleration_m_s2 + s / 3 * (self.jerk_m_s3 + s / 4 * self.snap_m_s4)))
        )

    def inverse_depth(self, rays: Array) -> Array:
        """1 / depth (...) along the optical axis at the reference time, where rays (..., 3), z = 1, meet the scene."""
        plane = rays @ np.asarray(self.inverse_depth_plane, float)
        return np.maximum(plane if self.relief is None else plane + self.relief.at(rays), 0.0)

    def velocity_at(self, since_reference_s: Any) -> Array:
        """Velocity (..., 3) of the centre at times (...) from the reference, still in the axes at the reference."""
        s = np.asarray(since_reference_s, float)[..., None]
        return np.asarray(
            self.velocity_m_s + s * (self.acceleration_m_s2 + s / 2 * (self.jerk_m_s3 + s / 3 * self.snap_m_s4))
        )

    def meeting(self, velocity_m_s: Array, acceleration_m_s2: Array, after_s: float) -> FrameTranslation:
        """The same motion continued to another velocity and acceleration (3,) at a time from the reference.

        Both in this motion's axes.  The velocity is the cubic between the two instants (Hermite's interpolation).
        """
        gained = acceleration_m_s2 - self.acceleration_m_s2
        beyond = velocity_m_s - self.velocity_m_s - after_s * self.acceleration_m_s2
        snap = 12 * (gained * after_s / 2 - beyond) / after_s**3
        return replace(self, jerk_m_s3=gained / after_s - snap * after_s / 2, snap_m_s4=snap)


@dataclass(frozen=True, slots=True)
class FurtherTurn:
    """An additional rotation rate beyond the predicted motion: x' = exp(rate · t) x over a short t, camera axes.

    Linear between instants, constant before and after them.
    """

    time_s: Array
    """(n,) increasing, IMU clock."""
    rate_rad_s: Array
    """(n, 3) about the camera's axes at those instants."""

    def since(self, time_s: Array, rotation: Array) -> Array:
        """Accumulated rotation vectors (m, 3) since the first instant, in the axes that ``rotation`` starts from.

        time_s: (m,) evenly spaced.  rotation: (m, 3, 3) of the predicted motion, to the camera's axes at each.
        """
        rate = np.stack([np.interp(time_s, self.time_s, along) for along in self.rate_rad_s.T], -1)
        in_start_axes = np.squeeze(np.swapaxes(rotation, -1, -2) @ rate[..., None], -1)
        steps = 0.5 * (in_start_axes[1:] + in_start_axes[:-1]) * np.diff(time_s)[:, None]
        return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


@dataclass(frozen=True, slots=True)
class RowMotion:
    """The camera's pose over one frame, relative to its pose at the reference time.

    x_t = R_t_ref x_ref + t_t_ref takes camera coordinates at the reference time to those at time t.
    """

    time_s: Array
    """(m,) evenly spaced, IMU clock."""
    rotation_vector: Array
    """(m, 3) log of R_t_ref."""
    translation_m: Array | None
    """(m, 3) t_t_ref; None: unknown, rotation only."""
    start_s: float
    """Start of the first row's exposure, IMU clock."""
    exposure_s: float
    """True exposure of each row; 0 where unknown."""
    readout_time_s: float
    reference_s: float
    """The time that the restored picture shows, IMU clock."""
    profile: CameraProfile
    lens: MovingLens | None = None
    """At every instant of the frame; None: no focal length, no geometry."""
    translation: FrameTranslation | None = None
    """The source of translation_m; None: unknown, rotation only."""

    @property
    def optics(self) -> MovingLens:
        """The lens; raises ValueError if there is none."""
        if self.lens is None:
            raise ValueError("the geometry needs intrinsics; frames without a focal length are copied")
        return self.lens

    @property
    def middle_s(self) -> float:
        """Middle of the frame: of the exposure of the row halfway through the readout."""
        return float(row_time_s(self.start_s, self.readout_time_s, 0.5, self.exposure_s, ROW_MIDDLE))

    @property
    def end_s(self) -> float:
        """End of the exposure of the row after the last one."""
        return float(row_time_s(self.start_s, self.readout_time_s, 1.0, self.exposure_s, ROW_END))

    def row_time_s(self, points_px: Array, exposure_share: Any) -> Array:
        """Time at which the rows through pixels (..., 2) reach a share of their exposure."""
        fraction = RowClock(self.profile).readout_fraction(points_px)
        return np.asarray(row_time_s(self.start_s, self.readout_time_s, fraction, self.exposure_s, exposure_share))

    def pose(self, time_s: Any) -> tuple[Array, Array | None]:
        """(R_t_ref (..., 3, 3), t_t_ref (..., 3) or None) at times (...)."""
        position = np.clip((np.asarray(time_s, float) - self.time_s[0]) / self._step_s, 0, len(self.time_s) - 1.001)
        index = position.astype(np.intp)
        part = (position - index)[..., None]
        vector = self.rotation_vector[index] * (1 - part) + self.rotation_vector[index + 1] * part
        if self.translation_m is None:
            return rotation_from_vector(vector), None
        shift = self.translation_m[index] * (1 - part) + self.translation_m[index + 1] * part
        return rotation_from_vector(vector), shift

    def relative_pose(self, from_s: Any, to_s: Any) -> tuple[Array, Array | None]:
        """(R_to_from, t_to_from): camera coordinates at one time to those at another."""
        r_from, t_from = self.pose(from_s)
        r_to, t_to = self.pose(to_s)
        rotation = r_to @ np.swapaxes(r_from, -1, -2)
        if t_from is None or t_to is None:
            return rotation, None
        return rotation, t_to - np.squeeze(rotation @ t_from[..., None], -1)

    def inverse_depth(self, rays: Array, time_s: Any) -> Array:
        """1 / depth (...) along the optical axis at times (...), where rays (..., 3), z = 1, meet the scene.

        0 without a plane.  n · X = 1 at the reference becomes (R n) · X = 1 + (R n) · t at another time.  With relief,
        the intersection with the plane is the starting point of an iteration.
        """
        rotation, shift = self.pose(time_s)
        if self.translation is None or shift is None:
            return np.zeros(rays.shape[:-1])
        turned = rotation @ np.asarray(self.translation.inverse_depth_plane, float)
        nearer = np.maximum(1 + (turned * shift).sum(-1), _LEAST_DISTANCE)
        nearness = np.maximum((turned * rays).sum(-1) / nearer, 0.0)
        for _ in range(_RELIEF_STEPS if self.translation.relief is not None else 0):
            back = np.squeeze(np.swapaxes(rotation, -1, -2) @ (rays - shift * nearness[..., None])[..., None], -1)
            seen = back / np.maximum(back[..., 2:], _LEAST_DISTANCE)
            at_reference = self.translation.inverse_depth(seen)
            ahead = (rotation[..., 2, :] * seen).sum(-1) + shift[..., 2] * at_reference
            nearness = at_reference / np.maximum(ahead, _LEAST_DISTANCE)
        return nearness

    def turned(self, further: FurtherTurn) -> RowMotion:
        """The motion with an additional rotation, zero at the reference time; the translation is unchanged."""
        rotation = rotation_from_vector(self.rotation_vector)
        since = further.since(self.time_s, rotation)
        at_reference = np.array([np.interp(self.reference_s, self.time_s, along) for along in since.T])
        turned = rotation @ rotation_from_vector(since - at_reference)
        shift = self.translation_m
        if shift is not None:
            shift = np.squeeze(turned @ np.swapaxes(rotation, -1, -2) @ shift[..., None], -1)
        return replace(self, rotation_vector=vector_from_rotation(turned), translation_m=shift)

    @property
    def _step_s(self) -> float:
        return float(self.time_s[1] - self.time_s[0])


def row_motion(
    trajectory: Trajectory,
    profile: CameraProfile,
    stamp_s: float,
    logged_exposure_s: float | None,
    reference: str = "exposure-start",
    translation: FrameTranslation | None = None,
    lens: MovingLens | None = None,
) -> RowMotion:
    """Tabulate the motion around one frame.

    stamp_s: the frame's timestamp, camera clock from stamp_0.  reference: ``exposure-start`` of the first row read, or
    ``frame-middle`` = that + readout/2 + exposure/2.  translation: of the camera's centre; None: unknown.  lens: for
    the whole trajectory, if available; otherwise it is computed.
    """
    exposure_s = profile.shutter.true_exposure_s(logged_exposure_s or 0.0)
    start_s, reference_s = frame_times_s(profile, stamp_s, logged_exposure_s, reference)
    if lens is None and profile.intrinsics is not None:
        lens = moving_lens(trajectory, profile)
    own = of_frame(profile, stamp_s, logged_exposure_s or 0.0)
    span_s = start_s, float(RowClock(own).end_s(stamp_s, logged_exposure_s or 0.0))
    return _tabulated(trajectory, span_s, start_s, exposure_s, reference_s, own, lens, translation)


def covering_both(motion: RowMotion, other: RowMotion, trajectory: Trajectory, lens: MovingLens) -> RowMotion:
    """The motion of one frame, tabulated over the rows of another frame too; its row clock and reference are kept.

    lens: for the whole trajectory.  The translation leads from the frame's to the other frame's; where that is unknown,
    or in another unit, it is extrapolated.
    """
    span_s = min(motion.start_s, other.start_s), max(motion.end_s, other.end_s)
    return _tabulated(
        trajectory, span_s, motion.start_s, motion.exposure_s, motion.reference_s, motion.profile, lens,
        _leading_to(motion, other, trajectory),
    )  # fmt: skip


def _leading_to(motion: RowMotion, other: RowMotion, trajectory: Trajectory) -> FrameTranslation | None:
    """A frame's translation, continued to that of another frame where both are known in the same unit."""
    here, there, after_s = motion.translation, other.translation, other.reference_s - motion.reference_s
    if here is None or there is None or here.unit != there.unit or not after_s:
        return here
    turn = trajectory.orientation(motion.reference_s).T @ trajectory.orientation(other.reference_s)
    return here.meeting(turn @ there.velocity_m_s, turn @ there.acceleration_m_s2, after_s)


def with_row_clock_of(motion: RowMotion, other: RowMotion) -> RowMotion:
    """The same motion and reference time, with the row clock of another frame."""
    return replace(
        motion, start_s=other.start_s, exposure_s=other.exposure_s, readout_time_s=other.readout_time_s,
        profile=other.profile,
    )  # fmt: skip


def _tabulated(
    trajectory: Trajectory,
    span_s: tuple[float, float],
    start_s: float,
    exposure_s: float,
    reference_s: float,
    profile: CameraProfile,
    lens: MovingLens | None,
    translation: FrameTranslation | None,
) -> RowMotion:
    """A motion's table over a span of even rows, extended for uneven ones and for points just outside the picture."""
    readout_s, uneven = profile.shutter.readout_time_s, profile.shutter.uneven
    late_s = np.zeros(1) if uneven is None else uneven.at(ROWS)
    first_s = span_s[0] + late_s.min(initial=0.0) - OUTSIDE_FRACTION * readout_s - STEP_S
    last_s = span_s[1] + late_s.max(initial=0.0) + OUTSIDE_FRACTION * readout_s + STEP_S
    steps = np.arange(int(np.ceil((last_s - first_s) / STEP_S)) + 2, dtype=np.float64)
    time_s = first_s + STEP_S * steps
    r_world_ref = trajectory.orientation(reference_s)
    r_world_t = trajectory.orientation(time_s)
    r_t_ref = np.swapaxes(r_world_t, -1, -2) @ r_world_ref
    shift = None
    if translation is not None:
        shift = -np.squeeze(r_t_ref @ translation.position_m(time_s - reference_s)[..., None], -1)
    if lens is not None:
        lens = lens.between(float(time_s[0]), float(time_s[-1]))
    vector = vector_from_rotation(r_t_ref)
    return RowMotion(
        time_s, vector, shift, start_s, exposure_s, readout_s, reference_s, profile, lens, translation
    )  # fmt: skip


def frame_times_s(
    profile: CameraProfile, stamp_s: float, logged_exposure_s: float | None, reference: str
) -> tuple[float, float]:
    """(start of the first row's exposure, reference time) of a frame, IMU clock; arguments as :func:`row_motion`.

    Both are those of an even readout: delays of rows are counted from it.
    """
    logged = logged_exposure_s or 0.0
    clock = RowClock(of_frame(profile, stamp_s, logged))
    start_s = float(clock.time_s(stamp_s, logged))
    return start_s, start_s if reference != "frame-middle" else float(clock.middle_s(stamp_s, logged))
