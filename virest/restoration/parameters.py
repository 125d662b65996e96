"""The log's account of one frame's degradation."""

from __future__ import annotations

from typing import Any

import numpy as np

from virest.camera.profile import CameraProfile
from virest.camera.response import ResponseCurve
from virest.image_formation.blur import tile_grid
from virest.image_formation.kernels import angle_and_length, blur_chords
from virest.image_formation.row_clock import ROW_END, ROW_MIDDLE, ROW_START
from virest.image_formation.row_motion import RowMotion
from virest.image_formation.warp import corner_points, straightened_points
from virest.motion.trajectory import Trajectory, quaternion_wxyz
from virest.restoration.settings import RestorationSettings

LOG_TILE_PX = 128
"""Spacing of the tiles in the log."""


def degradation_parameters(motion: RowMotion, trajectory: Trajectory, settings: RestorationSettings) -> dict[str, Any]:
    """The log's account of one frame: motion (eqs 4-10), blur (eqs 12-18), shutter (eq 28)."""
    profile = motion.profile
    width, height = profile.width, profile.height
    centre = np.array([[(width - 1) / 2, (height - 1) / 2]])
    start_s, middle_s, end_s = (float(motion.row_time_s(centre, h)[0]) for h in (ROW_START, ROW_MIDDLE, ROW_END))
    r_end_start, t_end_start = motion.relative_pose(start_s, end_s)
    moved_m = None if t_end_start is None or not _in_metres(motion) else (-r_end_start.T @ t_end_start).tolist()
    depth_m, depth_source = _depth(motion)
    grid = tile_grid(height, width, LOG_TILE_PX, LOG_TILE_PX // 4)
    points = np.concatenate([centre, grid.centres_px])
    angle, length = angle_and_length(blur_chords(motion, points))
    corners = straightened_points(motion, corner_points(width, height))
    return {
        "motion": {
            "delta_position_m": moved_m,
            "delta_q_wxyz": quaternion_wxyz(r_end_start.T).tolist(),
            "rate_rad_s": trajectory.rate_rad_s(middle_s).tolist(),
            "velocity_m_s": _velocity_m_s(motion, start_s),
        },
        "depth_m": depth_m,
        "depth_source": depth_source,
        "blur": {
            "angle_rad": float(angle[0]),
            "length_px": float(length[0]),
            "tiles": [
                {"centre_px": c, "angle_rad": a, "length_px": n}
                for c, a, n in zip(points[1:].tolist(), angle[1:].tolist(), length[1:].tolist(), strict=True)
            ],
        },
        "shutter": {
            "readout_time_s": motion.readout_time_s,
            "method": settings.shutter,
            "corners_px": corners.tolist(),
            "max_displacement_px": float(np.linalg.norm(corners - corner_points(width, height), axis=1).max()),
        },
        "response": (profile.response or ResponseCurve("srgb")).describe(),
    }


def _depth(motion: RowMotion) -> tuple[float | None, str]:
    """Depth at the picture's centre and where it is from; a plane at infinity has none."""
    if motion.translation is None or motion.translation.depth_m is None or np.isinf(motion.translation.depth_m):
        return None, "none"
    return motion.translation.depth_m, motion.translation.source


def _in_metres(motion: RowMotion) -> bool:
    return motion.translation is not None and motion.translation.in_metres


def _velocity_m_s(motion: RowMotion, time_s: float) -> list[float] | None:
    """Velocity of the camera's centre at a time, in its axes at that time (eq 5)."""
    if motion.translation is None or not motion.translation.in_metres:
        return None
    rotation, _ = motion.pose(time_s)
    return list((rotation @ motion.translation.velocity_at(time_s - motion.reference_s)).tolist())


def unknown_parameters(profile: CameraProfile) -> dict[str, Any]:
    """The log's keys for a frame whose motion is not known."""
    return {
        "motion": {"delta_position_m": None, "delta_q_wxyz": None, "rate_rad_s": None, "velocity_m_s": None},
        "depth_m": None,
        "depth_source": "none",
        "blur": {"angle_rad": None, "length_px": None, "tiles": []},
        "shutter": {
            "readout_time_s": profile.shutter.readout_time_s if profile.readout_known else None,
            "method": "none",
            "corners_px": None,
            "max_displacement_px": None,
        },
        "response": (profile.response or ResponseCurve("srgb")).describe(),
        "deblur": {"method": "none"},
    }
