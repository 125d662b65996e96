"""How the camera moved while one frame was taken, row by row (forward_model, sections 1, 2 and 5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile
from virest.motion.trajectory import Trajectory, rotation_from_vector, vector_from_rotation

Array = NDArray[np.float64]
STEP_S = 2e-4
"""Grid of the tabulated motion: at 50 rad/s² a straight line over it is off by 2.5e-7 rad."""
OUTSIDE_FRACTION = 0.25
"""The table reaches this part of the readout beyond the first and last row, for points outside the picture."""


@dataclass(frozen=True, slots=True)
class RowMotion:
    """The camera's pose over one frame, against its pose at the reference time.

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

    def row_start_s(self, points_px: Array) -> Array:
        """Start of exposure of the rows through pixels (..., 2)."""
        fraction = self.profile.shutter.readout_fraction(points_px, self.profile.width, self.profile.height)
        return self.start_s + fraction * self.readout_time_s

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

    @property
    def _step_s(self) -> float:
        return float(self.time_s[1] - self.time_s[0])


def row_motion(
    trajectory: Trajectory,
    profile: CameraProfile,
    stamp_s: float,
    logged_exposure_s: float | None,
    reference: str = "exposure-start",
    velocity_m_s: Array | None = None,
) -> RowMotion:
    """Tabulate the motion around one frame.

    stamp_s: the frame's stamp, camera clock from stamp_0.  reference: ``exposure-start`` of the first row read, or
    ``frame-middle`` = that + readout/2 + exposure/2.  velocity_m_s: (3,) of the camera in camera axes at the
    reference time, constant over the frame; None: unknown.
    """
    exposure_s = profile.shutter.true_exposure_s(logged_exposure_s or 0.0)
    readout_s = profile.shutter.readout_time_s
    start_s = float(profile.imu_time_s(profile.shutter.first_row_start_s(stamp_s, logged_exposure_s or 0.0)))
    reference_s = start_s + (0.5 * (readout_s + exposure_s) if reference == "frame-middle" else 0.0)
    first_s = start_s - OUTSIDE_FRACTION * readout_s - STEP_S
    last_s = start_s + (1 + OUTSIDE_FRACTION) * readout_s + exposure_s + STEP_S
    steps = np.arange(int(np.ceil((last_s - first_s) / STEP_S)) + 2, dtype=np.float64)
    time_s = first_s + STEP_S * steps
    r_world_ref = trajectory.orientation(reference_s)
    r_world_t = trajectory.orientation(time_s)
    r_t_ref = np.swapaxes(r_world_t, -1, -2) @ r_world_ref
    translation = None
    if velocity_m_s is not None:
        moved = (time_s - reference_s)[:, None] * np.asarray(velocity_m_s)
        translation = -np.squeeze(r_t_ref @ moved[..., None], -1)
    return RowMotion(
        time_s, vector_from_rotation(r_t_ref), translation, start_s, exposure_s, readout_s, reference_s, profile
    )
