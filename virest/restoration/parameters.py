"""The degradation of one frame, as a record from which the log's lines are made."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.image_formation.blur import tile_grid
from virest.image_formation.kernels import angle_and_length, blur_chords
from virest.image_formation.row_clock import ROW_END, ROW_MIDDLE, ROW_START
from virest.image_formation.row_motion import RowMotion
from virest.image_formation.warp import corner_points, straightened_points
from virest.motion.trajectory import Trajectory, quaternion_wxyz

LOG_TILE_PX = 128
"""Spacing, px, of the tiles in the log."""

Json = dict[str, Any]
Numbers = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ExposureMotion:
    """The camera's motion during the exposure of the centre row, in camera axes at its start (eqs 4-10)."""

    delta_position_m: Numbers | None = None
    """(3,); None: translation unknown, or not in metres."""
    delta_q_wxyz: Numbers | None = None
    """(4,), start from end; None: motion unknown."""
    rate_rad_s: Numbers | None = None
    """(3,) at mid-exposure; None: motion unknown."""
    velocity_m_s: Numbers | None = None
    """(3,) at the start; None: translation unknown, or not in metres."""


@dataclass(frozen=True, slots=True)
class TileBlur:
    """The blur at one tile's centre (eqs 12-18)."""

    centre_px: Numbers
    angle_rad: float
    length_px: float


@dataclass(frozen=True, slots=True)
class FrameBlur:
    """The blur at the frame's centre and tile by tile; None: unknown."""

    angle_rad: float | None = None
    length_px: float | None = None
    tiles: tuple[TileBlur, ...] = ()

    @property
    def longest_px(self) -> float:
        """The longest blur of all tiles."""
        return max(tile.length_px for tile in self.tiles)


@dataclass(frozen=True, slots=True)
class FrameShutter:
    """The rolling shutter's displacement, and how it was corrected."""

    readout_time_s: float | None
    method: str = "none"
    """``none``: not corrected."""
    corners_px: tuple[Numbers, ...] | None = None
    """(4, 2) straightened positions of the corner pixels' centres (eq 28)."""
    max_displacement_px: float | None = None
    """Largest displacement of a corner."""


@dataclass(frozen=True, slots=True)
class JoinedNeighbour:
    """A neighbouring frame used in a joint restoration."""

    frame: int
    """Movie index."""
    weight: float
    """Mean weight over the picture."""


@dataclass(frozen=True, slots=True)
class Deblurring:
    """How a frame was deblurred, and the expected gain."""

    method: str
    preset: str
    iterations: int
    strength: float
    tile_px: int
    noise_grey_levels: float
    expected_gain_db: float | None
    """None: not tested on neighbours."""
    expected_gain_std_db: float | None
    promised_gain_db: float
    """Gain of an ideal filter at the measured noise."""
    path_std_px: float | None
    """Standard deviation of the blur path, per axis; None: no neighbours show it."""
    neighbours: tuple[JoinedNeighbour, ...]
    neighbours_gain_db: float
    """Part of an ideal filter's gain that the neighbours add."""
    share: float
    """Weight of the deblurred picture in the output; the rest is the recorded one."""
    defocus_sigma_px: float


@dataclass(frozen=True, slots=True)
class DegradationParameters:
    """One frame's degradation, and how it was corrected.  The fields are in the log's order."""

    motion: ExposureMotion
    depth_m: float | None
    """At the frame's centre."""
    depth_source: str
    """``triangulated``, ``profile`` or ``none``."""
    blur: FrameBlur
    shutter: FrameShutter
    response: str
    """Description of the response curve."""
    deblur: Deblurring | None = None
    """None: not deblurred."""

    @property
    def deblur_method(self) -> str:
        """The method, or ``none`` if the frame was not deblurred."""
        return "none" if self.deblur is None else self.deblur.method

    @property
    def expected_gain_db(self) -> float | None:
        """The expected gain; None if the frame was not deblurred or the gain not tested on neighbours."""
        return None if self.deblur is None else self.deblur.expected_gain_db

    def as_json(self) -> Json:
        """The record's part of a line of ``parameters.jsonl``."""
        line: Json = _plain(self)
        return line if self.deblur is not None else line | {"deblur": {"method": "none"}}


def _plain(value: Any) -> Any:
    """Records converted to mappings, and tuples to lists."""
    if is_dataclass(value):
        return {one.name: _plain(getattr(value, one.name)) for one in fields(value)}
    return [_plain(one) for one in value] if isinstance(value, tuple) else value


def degradation_parameters(motion: RowMotion, trajectory: Trajectory) -> DegradationParameters:
    """Motion (eqs 4-10), blur (eqs 12-18) and rolling shutter (eq 28) of one frame before any correction."""
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
        profile.curve.describe(),
    )


def unknown_parameters(profile: CameraProfile) -> DegradationParameters:
    """Parameters of a frame whose motion is unknown."""
    readout_s = profile.shutter.readout_time_s if profile.readout_known else None
    response = profile.curve.describe()
    return DegradationParameters(ExposureMotion(), None, "none", FrameBlur(), FrameShutter(readout_s), response)


def _numbers(vector: Array) -> Numbers:
    return tuple(vector.tolist())


def _depth(motion: RowMotion) -> tuple[float | None, str]:
    """Depth at the picture's centre, None if infinite, and its source; None and ``none`` if unknown."""
    if motion.translation is None or motion.translation.depth_m is None:
        return None, "none"
    depth_m = motion.translation.depth_m
    return None if np.isinf(depth_m) else depth_m, motion.translation.source


def _in_metres(motion: RowMotion) -> bool:
    return motion.translation is not None and motion.translation.in_metres


def _velocity_m_s(motion: RowMotion, time_s: float) -> Numbers | None:
    """Velocity of the camera's centre at a time, in camera axes then (eq 5); None: unknown, or not in metres."""
    if motion.translation is None or not motion.translation.in_metres:
        return None
    rotation, _ = motion.pose(time_s)
    return _numbers(rotation @ motion.translation.velocity_at(time_s - motion.reference_s))
