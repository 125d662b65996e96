"""A neighbouring frame relative to a frame: where its pixels lie in the frame's picture, and their blur paths there.

Both frames show one scene.  With f the frame's sharp picture, its rows at their anchors, a neighbour's pixel q also
integrates f along a path: at each instant t of its row's exposure it sees the point at p(q, t) in the frame, by the map
of :mod:`warp` (forward_model, section 5).  So the neighbour's picture, warped to the frame's pixels, is a blur of the
same f by other kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.image_formation.kernels import KernelField, field_along, instants, splined_nodes
from virest.image_formation.row_motion import FurtherTurn, RowMotion, covering_both, with_row_clock_of
from virest.image_formation.warp import PIXELS_WITHIN_PX, grid_filled, seen_by_rows
from virest.motion.optics import MovingLens
from virest.motion.trajectory import Trajectory

STEP_RAD = 1e-5
"""Step of numerical slopes: about 0.01 px."""


@dataclass(frozen=True, slots=True)
class NeighbourView:
    """Two frames' rows under one motion: poses are relative to the frame's reference time."""

    frame: RowMotion
    """With the frame's row clock."""
    neighbour: RowMotion
    """The same motion with the neighbour's row clock."""
    anchor: float
    """Fraction of their exposure at which rows are seen in both pictures."""

    def places_px(self, points_px: Array) -> Array:
        """Pixels at which the neighbour recorded what the frame's anchored picture shows at pixels (..., 2)."""
        seen_s = self.frame.row_time_s(points_px, self.anchor)
        return seen_by_rows(self.neighbour, points_px, seen_s, self.anchor, PIXELS_WITHIN_PX)

    def apart_s(self, points_px: Array) -> Array:
        """(n,) time from the frame's to the neighbour's observation of what the frame shows at pixels (n, 2)."""
        seen_s = self.frame.row_time_s(points_px, self.anchor)
        return self.neighbour.row_time_s(self.places_px(points_px), self.anchor) - seen_s

    def middles_s(self) -> tuple[float, float]:
        """Middles of both frames' exposures, IMU clock."""
        return self.frame.middle_s, self.neighbour.middle_s

    def map_px(
        self, moved: Callable[[Array], Array] = lambda points_px: points_px, times: int = 1
    ) -> NDArray[np.float32]:
        """:meth:`places_px` of every pixel, (height, width, 2), as cv2.remap expects it.

        moved: a smooth map applied to pixels (..., 2) first.  times: factor by which the pictures are reduced.
        """
        found = grid_filled(self.frame, lambda points_px: self.places_px(moved(points_px)), times=times)
        return found if times == 1 else (found + np.float32(0.5)) / np.float32(times) - np.float32(0.5)

    def field(self) -> Callable[[Array], KernelField]:
        """Kernels of the neighbour's picture after warping to the frame's pixels, at any centres (n, 2)."""

        def nodes(centres_px: Array) -> Array:
            places = self.places_px(centres_px)
            gathered_s = instants(self.neighbour, places)
            points = np.broadcast_to(places[:, None], (*gathered_s.shape, 2))
            seen = seen_by_rows(self.frame, points, gathered_s, self.anchor, PIXELS_WITHIN_PX)
            return seen - centres_px[:, None]

        at = splined_nodes(self.frame, nodes)

        def along(centres_px: Array) -> KernelField:
            # flicker and defocus are those where the neighbour recorded them
            field = field_along(self.neighbour, self.places_px(centres_px), at(centres_px), self.anchor)
            return replace(field, centres_px=centres_px)

        return along


def neighbour_view(
    frame: RowMotion,
    neighbour: RowMotion,
    trajectory: Trajectory,
    lens: MovingLens,
    anchor: float = 0.5,
    further: FurtherTurn | None = None,
) -> NeighbourView:
    """The view of one frame from another; lens: for the whole trajectory.

    further: rotation that the trajectory lacks, over both frames.
    """
    both = covering_both(frame, neighbour, trajectory, lens)
    if further is not None:
        both = both.turned(further)
    return NeighbourView(both, with_row_clock_of(both, neighbour), anchor)


def turn_jacobian_px(motion: RowMotion, points_px: Array) -> Array:
    """Pixels per radian, (n, 2, 3), by which points (n, 2) move under a rotation of the camera: x' = exp(angle) x."""
    rays = motion.optics.rays(points_px, motion.reference_s)
    turned = [rays + STEP_RAD * np.cross(axis, rays) for axis in np.eye(3)]
    here = motion.optics.project(rays, motion.reference_s)
    return np.stack([(motion.optics.project(t, motion.reference_s) - here) / STEP_RAD for t in turned], -1)
