"""What was found out about one frame's degradation, as a record; the log's lines are made from it."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile
from virest.camera.response import ResponseCurve
from virest.image_formation.blur import tile_grid
from virest.image_formation.kernels import angle_and_length, blur_chords
from virest.image_formation.row_clock import ROW_END, ROW_MIDDLE, ROW_START
from virest.image_formation.row_motion import RowMotion
from virest.image_formation.warp import corner_points, straightened_points
from virest.motion.trajectory import Trajectory, quaternion_wxyz

LOG_TILE_PX = 128
"""Spacing of the tiles in the log."""

Json = dict[str, Any]
Numbers = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ExposureMotion:
    """The camera's motion over the exposure of the centre's row, in its axes at the start (eqs 4-10)."""

    delta_position_m: Numbers | None = None
    """(3,); None where travel is not known in metres."""
    delta_q_wxyz: Numbers | None = None
    """(4,), start from end; None where the motion is not known."""
    rate_rad_s: Numbers | None = None
    """(3,), in the middle of the exposure."""
    velocity_m_s: Numbers | None = None
    """(3,), at the start."""


@dataclass(frozen=True, slots=True)
class TileBlur:
    """The blur at one place (eqs 12-18)."""

    centre_px: Numbers
    angle_rad: float
    length_px: float


@dataclass(frozen=True, slots=True)
class FrameBlur:
    """The blur at the frame's centre and tile by tile; None: not known."""

    angle_rad: float | None = None
    length_px: float | None = None
    tiles: tuple[TileBlur, ...] = ()

    @property
    def longest_px(self) -> float:
        """The longest blur of any tile."""
        return max(tile.length_px for tile in self.tiles)


@dataclass(frozen=True, slots=True)
class FrameShutter:
    """The rolling shutter's displacement, and how it was undone."""

    readout_time_s: float | None
    method: str = "none"
    """``none``: it was not."""
    corners_px: tuple[Numbers, ...] | None = None
    """(4, 2): where the centres of the corner pixels go (eq 28)."""
    max_displacement_px: float | None = None


@dataclass(frozen=True, slots=True)
class JoinedNeighbour:
    """A frame that another was restored with."""

    frame: int
    weight: float


@dataclass(frozen=True, slots=True)
class Deblurring:
    """How a frame was deblurred, and what that is expected to gain."""

    method: str
    preset: str
    iterations: int
    strength: float
    tile_px: int
    noise_grey_levels: float
    expected_gain_db: float | None
    """None where no neighbour confirms it."""
    expected_gain_std_db: float | None
    promised_gain_db: float
    """Of an ideal filter at the measured noise."""
    path_std_px: float
    """Standard deviation of the blur path, one axis."""
    neighbours: tuple[JoinedNeighbour, ...]
    neighbours_gain_db: float
    share: float
    """Part of the deblurred picture that is taken, the rest being the recorded one."""
    defocus_sigma_px: float


@dataclass(frozen=True, slots=True)
class DegradationParameters:
    """What was found out about one frame, and what was done about it.  The fields stand in the log's order."""

    motion: ExposureMotion
    depth_m: float | None
    """At the frame's centre."""
    depth_source: str
    """``triangulated``, ``profile`` or ``none``."""
    blur: FrameBlur
    shutter: FrameShutter
    response: str
    """The response curve, in words."""
    deblur: Deblurring | None = None
    """None: not deblurred."""

    @property
    def deblur_method(self) -> str:
        """``none`` where the frame was not deblurred."""
        return "none" if self.deblur is None else self.deblur.method

    @property
    def expected_gain_db(self) -> float | None:
        """None where it was not deblurred, or no neighbour confirms a gain."""
        return None if self.deblur is None else self.deblur.expected_gain_db

    def as_json(self) -> Json:
        """The part of a line of ``parameters.jsonl`` that this record holds."""
        line: Json = _plain(self)
        return line if self.deblur is not None else line | {"deblur": {"method": "none"}}


def _plain(value: Any) -> Any:
    """Records as mappings, tuples as lists."""
    if is_dataclass(value):
        return {one.name: _plain(getattr(value, one.name)) for one in fields(value)}
    return [_plain(one) for one in value] if isinstance(value, tuple) else value


def degradation_parameters(motion: RowMotion, trajectory: Trajectory) -> DegradationParameters:
    """Motion (eqs 4-10), blur (eqs 12-18) and rolling shutter (eq 28) of one frame of which nothing was undone yet."""
    profile = motion.profile
    width, height = profile.width, profile.height
    centre = np.array([[(width - 1) / 2, (height - 1) / 2]])
    start_s, middle_s, end_s = (float(motion.row_time_s(centre, h)[0]) for h in (ROW_START, ROW_MIDDLE, ROW_END))
    r_end_start, t_end_start = motion.relative_pose(start_s, end_s)
    moved_m = None if t_end_start is None or not _in_metres(motion) else _numbers(-r_end_start.T @ t_end_start)
    depth_m, depth_source = _depth(motion)
    grid = tile_grid(height, width, LOG_TILE_PX, LOG_TILE_PX // 4)
    points = np.concatenate([centre, grid.centres_px])
    angle, length = angle_and_length(blur_chords(motion, points))
    tiles = zip(points[1:].tolist(), angle[1:].tolist(), length[1:].tolist(), strict=True)
    corners = straightened_points(motion, corner_points(width, height))
    return DegradationParameters(
        ExposureMotion(
            moved_m,
            _numbers(quaternion_wxyz(r_end_start.T)),
            _numbers(trajectory.rate_rad_s(middle_s)),
            _velocity_m_s(motion, start_s),
        ),
        depth_m,
        depth_source,
        FrameBlur(float(angle[0]), float(length[0]), tuple(TileBlur(tuple(c), a, n) for c, a, n in tiles)),
        FrameShutter(
            motion.readout_time_s,
            corners_px=tuple(_numbers(corner) for corner in corners),
            max_displacement_px=float(np.linalg.norm(corners - corner_points(width, height), axis=1).max()),
        ),
        (profile.response or ResponseCurve("srgb")).describe(),
    )


def unknown_parameters(profile: CameraProfile) -> DegradationParameters:
    """Of a frame whose motion is not known."""
    readout_s = profile.shutter.readout_time_s if profile.readout_known else None
    response = (profile.response or ResponseCurve("srgb")).describe()
    return DegradationParameters(ExposureMotion(), None, "none", FrameBlur(), FrameShutter(readout_s), response)


def _numbers(vector: NDArray[np.float64]) -> Numbers:
    return tuple(vector.tolist())


def _depth(motion: RowMotion) -> tuple[float | None, str]:
    """Depth at the picture's centre and where it is from; a plane at infinity has none."""
    if motion.translation is None or motion.translation.depth_m is None or np.isinf(motion.translation.depth_m):
        return None, "none"
    return motion.translation.depth_m, motion.translation.source


def _in_metres(motion: RowMotion) -> bool:
    return motion.translation is not None and motion.translation.in_metres


def _velocity_m_s(motion: RowMotion, time_s: float) -> Numbers | None:
    """Velocity of the camera's centre at a time, in its axes at that time (eq 5)."""
    if motion.translation is None or not motion.translation.in_metres:
        return None
    rotation, _ = motion.pose(time_s)
    return _numbers(rotation @ motion.translation.velocity_at(time_s - motion.reference_s))
