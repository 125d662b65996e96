"""Blur of what moves on its own: people, vehicles, and near things that a rotation does not describe.

Content that the neighbours show at other places than predicted also moved during the exposures, at the same speed: the
blur path is the predicted one plus the speed times the time since the anchor.  With the predicted kernel alone a person
who walks through the picture rings.  Two or more neighbours tell a speed from noise, since their shifts must grow with
the time between the frames.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from virest.arrays import Array, Picture
from virest.image_formation.kernels import KernelField
from virest.image_formation.neighbour import NeighbourView
from virest.inference.chance import chi2_median
from virest.inference.tracking import TrackingSettings, track_pairs
from virest.restoration.neighbours.joint import (
    NeighbourPicture,
    NeighbourRegistration,
    affine_at,
    affine_fit,
    between_tiles,
)

FALSE_ALARM = 1e-3
"""Probability of a speed in a tile that has none, for normal noise.  Shifts err more often: of the tiles of a static
scene (2880, a phone capture simulated outside) 4 % get a speed, 0.1 % one of more than 0.35 px per exposure."""

FEW_POINTS = TrackingSettings(halve_above_px=400, points_per_cell=2)
"""The points that tell whether anything moves on its own."""
ADJACENT, FOLLOWING, LEAST_POINTS = 4, 3, 3
"""A point moves if three of the four next to it follow, to half of its path; three such points are content that moves.
Found in 144 of 144 frames with figures that walk, and in 4 of 288 frames of static scenes, whose points err by chance
(nine phone captures simulated outside)."""


@dataclass(frozen=True, slots=True)
class OwnMotion:
    """Speed of the content against the predicted motion."""

    tiles_px: Array
    """(n, 2) centres of a grid of tiles."""
    speed_px_s: Array
    """(n, 2); 0 where noise explains it."""

    def kernels(self, field: Callable[[Array], KernelField], exposure_s: float) -> Callable[[Array], KernelField]:
        """Kernels of a picture with this exposure, with the speed in their paths.

        At a time t after the anchor, a pixel shows what lay a path of speed · t further back.
        """

        def moving(centres_px: Array) -> KernelField:
            predicted = field(centres_px)
            samples = predicted.paths_px.shape[1]
            since_s = exposure_s * ((np.arange(samples) + 0.5) / samples - predicted.anchor)
            speed_px_s = between_tiles(self.speed_px_s, self.tiles_px, centres_px)
            return replace(predicted, paths_px=predicted.paths_px - since_s[:, None] * speed_px_s[:, None])

        return moving

    def of_neighbours(self, found: Sequence[NeighbourPicture]) -> tuple[NeighbourPicture, ...]:
        """The neighbours with the speed in their kernels: it is the same in all frames."""
        return tuple(replace(one, registration=self._moving(one.registration)) for one in found)

    def _moving(self, one: NeighbourRegistration) -> NeighbourRegistration:
        return replace(one, field=self.kernels(one.field, one.view.neighbour.exposure_s))


def moves_on_its_own(view: NeighbourView, first: Picture, second: Picture, least_px: float) -> bool:
    """Whether content of a frame moves by more than ``least_px`` per exposure against the predicted motion.

    Points of the frame's luma (height, width) are tracked into a neighbour's.  Smooth errors of the prediction are no
    motion of the content, so an affine part is taken off.  Points that adjacent ones do not follow are errors.
    """
    pairs = track_pairs([(0, first), (1, second)], FEW_POINTS)
    if not pairs:
        return False
    here_px = pairs[0].points_first_px
    shift_px = pairs[0].points_second_px - view.places_px(here_px)
    predicted = np.isfinite(shift_px).all(axis=1)  # a strong distortion has no inverse everywhere
    if np.count_nonzero(predicted) <= ADJACENT:
        return False
    here_px, shift_px = here_px[predicted], shift_px[predicted]
    affine, _ = affine_fit(here_px, shift_px, np.ones(len(here_px)))
    path_px = view.frame.exposure_s * (shift_px - affine_at(affine, here_px)) / view.apart_s(here_px)[:, None]
    length_px = np.linalg.norm(path_px, axis=1)
    _, near = cKDTree(here_px).query(here_px, ADJACENT + 1)
    alike = np.linalg.norm(path_px[near[:, 1:]] - path_px[:, None], axis=2) < 0.5 * length_px[:, None]
    moving = (length_px > least_px) & (np.count_nonzero(alike, axis=1) >= FOLLOWING)
    return int(np.count_nonzero(moving)) >= LEAST_POINTS


def own_motion(registrations: Sequence[NeighbourRegistration]) -> OwnMotion | None:
    """The speeds of the tiles that two or more neighbours show; None where no tile is seen that often.

    The speed is the least-squares slope of a tile's shifts over the times between the frames.  Its variance follows
    from the shifts' precision and from what the slope leaves, in this tile or in the median of all, whichever is more:
    two or three shifts hardly show their scatter.  A speed that noise of that variance reaches in FALSE_ALARM of the
    tiles counts as 0, and a larger one loses less.  Where a neighbour shows x + d at the predicted position of x, the
    content of x has moved by -d.
    """
    if len(registrations) < 2:
        return None
    shift_px = np.array([one.own_shift_px for one in registrations])
    apart_s = np.array([one.apart_s for one in registrations])[..., None]
    precision = np.array([one.precision for one in registrations])[..., None]
    lever_s2 = np.maximum((precision * apart_s**2).sum(axis=0), 1e-12)
    speed_px_s = -(precision * apart_s * shift_px).sum(axis=0) / lever_s2
    left_px2 = (precision * (shift_px + apart_s * speed_px_s) ** 2).sum(axis=0)
    freedom = np.count_nonzero(precision, axis=0) - 1
    often = freedom[:, 0] > 0
    if not often.any():
        return None
    medians = np.array([chi2_median(max(n, 1)) for n in range(len(registrations))])
    usual_px2 = np.median((left_px2 / medians[np.maximum(freedom, 0)])[often])
    variance = (np.maximum(left_px2 / np.maximum(freedom, 1), usual_px2) / lever_s2).sum(axis=1)
    by_chance = -np.log(FALSE_ALARM) * variance  # squared length of a speed that is noise: chi-square of two freedoms
    sure = np.maximum(1 - by_chance / np.maximum((speed_px_s**2).sum(axis=1), 1e-12), 0.0)
    return OwnMotion(registrations[0].centres_px, speed_px_s * (often * sure)[:, None])
