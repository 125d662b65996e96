"""A rotating camera and any number of its frames: the map of `warp` in one call for many frames.

A :class:`RowMotion` tabulates one frame's motion, with translation and depth.  Here poses come from the trajectory
directly, and timestamps broadcast with the points.  Both are motions for `warp`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.capture.records import Frame
from virest.image_formation.row_clock import RowClock
from virest.motion.optics import MovingLens, moving_lens
from virest.motion.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class TurningCamera:
    """A profile along a trajectory; rotation only."""

    profile: CameraProfile
    trajectory: Trajectory
    lens: MovingLens
    """At every instant of the trajectory."""

    def frames(self, stamp_s: Any, exposure_s: Any) -> TurningFrames:
        """Frames with these timestamps and logged exposures; see :class:`TurningFrames`."""
        return TurningFrames(self, stamp_s, exposure_s)

    def frame(self, frame: Frame) -> TurningFrames:
        """A single frame."""
        return TurningFrames(self, frame.time_s, frame.exposure_s or 0.0)


@dataclass(frozen=True, slots=True)
class TurningFrames:
    """Some frames of a rotating camera."""

    camera: TurningCamera
    stamp_s: Any
    """Camera clock from stamp_0; broadcasts with points (..., 2) without their last axis."""
    exposure_s: Any
    """As logged; 0 where unknown."""

    @property
    def optics(self) -> MovingLens:
        """The lens at every instant."""
        return self.camera.lens

    @property
    def readout_time_s(self) -> float:
        """Readout time of the profile's shutter, s."""
        return self.camera.profile.shutter.readout_time_s

    def row_time_s(self, points_px: Array, exposure_share: Any) -> Array:
        """IMU time at which the rows through pixels (..., 2) of the frames reach a share of their exposure."""
        return RowClock(self.camera.profile).seen_s(points_px, self.stamp_s, self.exposure_s, exposure_share)

    def pose(self, time_s: Any) -> tuple[Array, None]:
        """(R_cam_world (..., 3, 3), None) at times (...)."""
        return np.swapaxes(self.camera.trajectory.orientation(time_s), -1, -2), None

    def inverse_depth(self, rays: Array, time_s: Any) -> Array:
        """0: far away."""
        return np.zeros(rays.shape[:-1])


def turning_camera(trajectory: Trajectory, profile: CameraProfile) -> TurningCamera:
    """A camera along a trajectory; raises ValueError if the profile has no focal length."""
    return TurningCamera(profile, trajectory, moving_lens(trajectory, profile))
