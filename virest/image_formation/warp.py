"""Where points go: the one map p(t) ~ K (R_t_ref K⁻¹ p_ref + t_t_ref / Z) (forward_model, section 5; eqs 23-28).

Rolling shutter, blur paths and the log's corner points are this map between different times.  Points are undistorted
before it and distorted after it, by the lens as it is at either time.  Depth is along the optical axis where a point is
seen first, in metres; its inverse 0 means rotation only, and None that of the frame's plane or surface.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from virest.image_formation.row_motion import RowMotion
from virest.motion.optics import MovingLens

Array = NDArray[np.float64]
FIXED_POINT_PX = 1e-5
"""Rows are known well enough once points move less than this."""
PIXELS_WITHIN_PX = 1e-3
"""The same where points name pixels of a picture; what is then left is a thirtieth of it."""
FIXED_POINT_STEPS = 8
"""Row times depend on where a point lands; each step shrinks the error about thirtyfold."""
CELLS_PER_KNOT, MIN_KNOTS = 3, 12
"""Cells of a map's grid for each knot of its splines, and least number of knots: one in about 2 ms of a readout."""


class CameraMotion(Protocol):
    """What the map asks of a motion: of one frame (`RowMotion`), or of many at once (`TurningFrames`)."""

    @property
    def optics(self) -> MovingLens:
        """The lens at every instant."""

    @property
    def readout_time_s(self) -> float:
        """From the first row to the last."""

    def pose(self, time_s: Any) -> tuple[Array, Array | None]:
        """(R (..., 3, 3), t (..., 3) or None) from fixed axes to the camera's at times (...)."""

    def row_time_s(self, points_px: Array, exposure_share: Any) -> Array:
        """When the rows through pixels (..., 2) are exposed to a share of their exposure."""

    def inverse_depth(self, rays: Array, time_s: Any) -> Array:
        """1 / depth (...) of what rays (..., 3), z = 1, meet at times (...)."""


def moved_between(motion: CameraMotion, points_px: Array, from_s: Any, to_s: Any, inverse_depth: Any = None) -> Array:
    """Where points seen at pixels (..., 2) at one time are seen at another."""
    return _shown(motion, *_fixed_points(motion, points_px, from_s, inverse_depth), to_s)


def straightened_points(motion: RowMotion, points_px: Array, anchor: float = 0.0, inverse_depth: Any = None) -> Array:
    """p_g of eq 28: where points of the recorded picture, (..., 2), belong at the reference time.

    anchor: the part of its exposure at which each row is taken to be seen; 0 its start (the paper), 0.5 its middle.
    """
    seen_s = motion.row_time_s(points_px, anchor)
    return moved_between(motion, points_px, seen_s, motion.reference_s, inverse_depth)


def recorded_points(motion: RowMotion, points_px: Array, anchor: float = 0.0, inverse_depth: Any = None) -> Array:
    """The inverse of :func:`straightened_points`: where points of the picture at the reference time were recorded."""
    return seen_by_rows(motion, points_px, motion.reference_s, anchor, inverse_depth)


def seen_by_rows(
    motion: CameraMotion,
    points_px: Array,
    at_s: Any,
    anchor: float,
    inverse_depth: Any = None,
    within_px: float = FIXED_POINT_PX,
) -> Array:
    """Where points seen at pixels (..., 2) at time ``at_s`` lie in the picture whose rows are seen at their anchors.

    A fixed point, since the row that sees a point depends on where it sees it; found once steps are below within_px.
    Where many frames are seen at once, the motion is that of the frames that see; its poses hold at ``at_s`` too.
    """
    seen = points_px
    fixed = _fixed_points(motion, points_px, at_s, inverse_depth)
    for _ in range(FIXED_POINT_STEPS if motion.readout_time_s else 1):
        before = seen
        seen = _shown(motion, *fixed, motion.row_time_s(seen, anchor))
        if np.abs(seen - before).max(initial=0.0) < within_px:
            break
    return seen


def corner_points(width: int, height: int) -> Array:
    """P1..P4 of the paper, as pixel centres: top left, top right, bottom right, bottom left, (4, 2)."""
    return np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], float)


def dense_map(motion: RowMotion, anchor: float, spacing_px: int = 16, inverse_depth: Any = None) -> NDArray[np.float32]:
    """:func:`recorded_points` of every pixel, (height, width, 2) as cv2.remap takes it.

    Computed on a grid and filled in; the map is smooth, so this is off by less than 0.01 px.
    """

    def recorded(points: Array) -> Array:
        return seen_by_rows(motion, points, motion.reference_s, anchor, inverse_depth, PIXELS_WITHIN_PX)

    return grid_filled(motion, recorded, spacing_px)


def grid_filled(
    motion: RowMotion, mapping: Callable[[Array], Array], spacing_px: int = 16, times: int = 1
) -> NDArray[np.float32]:
    """A smooth map of pixels, (height, width, 2): worked out at the knots of cubic splines, which give it on a grid.

    times: at the middles of squares of this many pixels, a divisor of ``spacing_px``; (height // times, ...) of them.

    Straight lines between the grid's nodes are the quickest way to all pixels, splines the one from fewest knots.
    Before relief a map bends at depth edges, where splines would swing: every node is worked out.
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
    """Middles of cells of ``spacing`` pixels over 0 ... length − 1, and of one more cell on both sides."""
    cells = np.arange(-1, int(np.ceil(length / spacing)) + 1, dtype=np.float64)
    return (cells + 0.5) * spacing - 0.5


@lru_cache(maxsize=8)
def _all_nodes(length: int, spacing: int) -> tuple[Array, Array]:
    """As :func:`_knots` with a knot at each node."""
    nodes = _nodes(length, spacing)
    return nodes, np.eye(len(nodes))


@lru_cache(maxsize=8)
def _knots(length: int, spacing: int) -> tuple[Array, Array]:
    """Knots (m,) of a spline over :func:`_nodes`, and the weights (nodes, m) that give its values there."""
    nodes = _nodes(length, spacing)
    count = min(max(MIN_KNOTS, -(-len(nodes) // CELLS_PER_KNOT)), len(nodes))
    knots = np.linspace(nodes[0], nodes[-1], count)
    return knots, np.asarray(CubicSpline(knots, np.eye(count))(nodes))


def _fixed_points(motion: CameraMotion, points_px: Array, at_s: Any, inverse_depth: Any) -> tuple[Array, Array | None]:
    """Points (..., 3), fixed axes, in units of their depths at ``at_s``; 1 / those, (...)."""
    rays = motion.optics.rays(points_px, at_s)
    rotation, translation = motion.pose(at_s)
    back = np.swapaxes(rotation, -1, -2)
    if translation is None:
        return np.squeeze(back @ rays[..., None], -1), None
    nearness = motion.inverse_depth(rays, at_s) if inverse_depth is None else np.asarray(inverse_depth, float)
    return np.squeeze(back @ (rays - translation * nearness[..., None])[..., None], -1), nearness


def _shown(motion: CameraMotion, points: Array, nearness: Array | None, at_s: Any) -> Array:
    """Pixels (..., 2) at which the points of :func:`_fixed_points` are seen at times (...)."""
    rotation, translation = motion.pose(at_s)
    moved = np.squeeze(rotation @ points[..., None], -1)
    if translation is not None and nearness is not None:
        moved = moved + translation * nearness[..., None]
    return motion.optics.project(moved, at_s)
