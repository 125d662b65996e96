"""Motion of image points: the one map p(t) ~ K (R_t_ref K⁻¹ p_ref + t_t_ref / Z) (forward_model, section 5; eqs 23-28).

Rolling shutter, blur paths and the log's corner points are this map between different times.  Points are undistorted
before it and distorted after it, by the lens at the respective time.  Depth is along the optical axis at the first
time, in metres; an inverse of 0 means rotation only, and None the frame's plane or surface.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from virest.arrays import Array
from virest.image_formation.row_motion import RowMotion
from virest.motion.optics import MovingLens

FIXED_POINT_PX = 1e-5
"""The iteration over row times ends when points move less than this."""
PIXELS_WITHIN_PX = 1e-3
"""The same for positions of a picture's pixels; the remaining error is about 1/30 of it."""
FIXED_POINT_STEPS = 8
"""Row times depend on where a point lands; each step reduces the error about 30-fold."""
CELLS_PER_KNOT, MIN_KNOTS = 3, 12
"""Cells of a map's grid per knot of its splines, and smallest number of knots: one in about 2 ms of a readout."""


class CameraMotion(Protocol):
    """A motion for the map: of one frame (`RowMotion`), or of many at once (`TurningFrames`)."""

    @property
    def optics(self) -> MovingLens:
        """The lens at every instant."""

    @property
    def readout_time_s(self) -> float:
        """Readout time of the shutter, s."""

    def pose(self, time_s: Any) -> tuple[Array, Array | None]:
        """(R (..., 3, 3), t (..., 3) or None) from fixed axes to the camera's at times (...)."""

    def row_time_s(self, points_px: Array, exposure_share: Any) -> Array:
        """Time at which the rows through pixels (..., 2) reach a share of their exposure."""

    def inverse_depth(self, rays: Array, time_s: Any) -> Array:
        """1 / depth (...) where rays (..., 3), z = 1, meet the scene at times (...)."""


def moved_between(motion: CameraMotion, points_px: Array, from_s: Any, to_s: Any) -> Array:
    """Pixels (..., 2) at another time of points seen at pixels (..., 2) at one time."""
    return _shown(motion, *_fixed_points(motion, points_px, from_s), to_s)


def straightened_points(motion: RowMotion, points_px: Array, anchor: float = 0.0) -> Array:
    """p_g of eq 28: positions at the reference time of points of the recorded picture, (..., 2).

    anchor: fraction of its exposure that represents each row; 0: its start (the paper), 0.5: its middle.
    """
    seen_s = motion.row_time_s(points_px, anchor)
    return moved_between(motion, points_px, seen_s, motion.reference_s)


def seen_by_rows(
    motion: CameraMotion, points_px: Array, at_s: Any, anchor: float, within_px: float = FIXED_POINT_PX
) -> Array:
    """Positions in the picture of anchored rows of points seen at pixels (..., 2) at time ``at_s``.

    Found by fixed-point iteration until steps are below within_px, since the row that sees a point depends on its
    position.  For many frames at once, the motion is that of the target frames; its poses must also cover ``at_s``.
    """
    seen = points_px
    fixed = _fixed_points(motion, points_px, at_s)
    for _ in range(FIXED_POINT_STEPS if motion.readout_time_s else 1):
        before = seen
        seen = _shown(motion, *fixed, motion.row_time_s(seen, anchor))
        if np.abs(seen - before).max(initial=0.0) < within_px:
            break
    return seen


def corner_points(width: int, height: int) -> Array:
    """P1..P4 of the paper, as pixel centres: top left, top right, bottom right, bottom left, (4, 2)."""
    return np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], float)


def dense_map(motion: RowMotion, anchor: float) -> NDArray[np.float32]:
    """Where the rows saw every pixel of the reference time, (height, width, 2), as cv2.remap expects it.

    Computed on a grid and interpolated; the map is smooth, so the error is below 0.01 px.
    """

    def recorded(points: Array) -> Array:
        return seen_by_rows(motion, points, motion.reference_s, anchor, PIXELS_WITHIN_PX)

    return grid_filled(motion, recorded)


def grid_filled(
    motion: RowMotion, mapping: Callable[[Array], Array], spacing_px: int = 16, times: int = 1
) -> NDArray[np.float32]:
    """A smooth map of all pixels, (height, width, 2): computed at knots, by cubic splines on a grid, bilinear between.

    times: evaluate at the centres of squares of this side, a divisor of ``spacing_px``; (height // times, ...) of them.

    Splines need the fewest computed knots; bilinear interpolation is the fastest way from the grid to all pixels.  With
    relief, a map has kinks at depth edges, where splines would oscillate: every grid node is then computed.
    """
    width, height = motion.profile.width, motion.profile.height
    bent = motion.translation is not None and motion.translation.relief is not None
    (x, across), (y, down) = ((_all_nodes if bent else _knots)(length, spacing_px) for length in (width, height))
    at_knots = mapping(np.stack(np.meshgrid(x, y), -1))
    values = (across @ np.tensordot(down, at_knots, 1)).astype(np.float32)
    cell = spacing_px // times
    size = (values.shape[1] * cell, values.shape[0] * cell)
    filled = cv2.resize(values, size, interpolation=cv2.INTER_LINEAR)
    return filled[cell : cell + height // times, cell : cell + width // times]


def _nodes(length: int, spacing: int) -> Array:
    """Centres of cells of ``spacing`` pixels over 0 ... length − 1, and of one more cell on each side."""
    cells = np.arange(-1, int(np.ceil(length / spacing)) + 1, dtype=np.float64)
    return (cells + 0.5) * spacing - 0.5


@lru_cache(maxsize=8)
def _all_nodes(length: int, spacing: int) -> tuple[Array, Array]:
    """As :func:`_knots` with a knot at each node."""
    nodes = _nodes(length, spacing)
    return nodes, np.eye(len(nodes))


@lru_cache(maxsize=8)
def _knots(length: int, spacing: int) -> tuple[Array, Array]:
    """Knots (m,) of a spline over :func:`_nodes`, and the weights (nodes, m) of its values there."""
    nodes = _nodes(length, spacing)
    count = min(max(MIN_KNOTS, -(-len(nodes) // CELLS_PER_KNOT)), len(nodes))
    knots = np.linspace(nodes[0], nodes[-1], count)
    return knots, np.asarray(CubicSpline(knots, np.eye(count))(nodes))


def _fixed_points(motion: CameraMotion, points_px: Array, at_s: Any) -> tuple[Array, Array | None]:
    """Points (..., 3), fixed axes, in units of their depths at ``at_s``; 1 / those, (...)."""
    rays = motion.optics.rays(points_px, at_s)
    rotation, translation = motion.pose(at_s)
    back = np.swapaxes(rotation, -1, -2)
    if translation is None:
        return np.squeeze(back @ rays[..., None], -1), None
    nearness = motion.inverse_depth(rays, at_s)
    return np.squeeze(back @ (rays - translation * nearness[..., None])[..., None], -1), nearness


def _shown(motion: CameraMotion, points: Array, nearness: Array | None, at_s: Any) -> Array:
    """Pixels (..., 2) at which the points of :func:`_fixed_points` are seen at times (...)."""
    rotation, translation = motion.pose(at_s)
    moved = np.squeeze(rotation @ points[..., None], -1)
    if translation is not None and nearness is not None:
        moved = moved + translation * nearness[..., None]
    return motion.optics.project(moved, at_s)
