"""Rolling-shutter correction by a constant image velocity, from the frames alone: no gyroscope, no perspective.

After Schubert, Demmel, Usenko, Stückler & Cremers 2018 (ECCV, Direct sparse odometry with rolling shutter): motion is
taken as constant during the readout, and each row is moved back by its motion since the first row.  Here the motion is
an affine image velocity field, fitted to points tracked to the previous and next frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.camera.shutter import Shutter
from virest.image_formation.row_clock import row_time_s
from virest.inference.tracking import TrackPair

MIN_POINTS = 12
"""Four times the three points that determine an affine field."""
REWEIGHTINGS = 12
"""Iterations of the reweighting."""
LEAST_SCALE_PX = 0.05
"""About the noise of a tracked point: with less, exact points would outweigh all others."""
FIXED_POINT_STEPS = 8
"""Each step reduces the error by the field's derivative times the readout, a few percent."""


@dataclass(frozen=True, slots=True)
class PictureVelocity:
    """Affine velocity field of image points, constant during one frame."""

    centre_px: Array
    """(2,) centre of the frame."""
    terms: Array
    """(3, 2): velocity at the centre, px/s, and its derivatives along x and y, 1/s."""

    def at(self, points_px: Array) -> Array:
        """Velocity (..., 2) in px/s at points (..., 2)."""
        return self.terms[0] + (points_px - self.centre_px) @ self.terms[1:]


def fit_velocity(
    pairs: Sequence[TrackPair],
    frame: int,
    middle_s: Mapping[int, float],
    shutter: Shutter,
    width: int,
    height: int,
) -> PictureVelocity | None:
    """Fit a frame's velocity field to points tracked to its neighbours; None if there are too few.

    d = v(p) Δt, Δt between the mid-exposures of the rows that see the point.  middle_s: mid-exposure of the first row,
    by frame.  Robust: iteratively reweighted least squares (Cauchy).
    """
    found = [
        _displacements(pair, frame, middle_s, shutter, width, height)
        for pair in pairs
        if frame in (pair.first, pair.second)
    ]
    if not found or sum(len(points) for points, _, _ in found) < MIN_POINTS:
        return None
    points, moved, passed_s = (np.concatenate(parts) for parts in zip(*found, strict=True))
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    design = np.column_stack([np.ones(len(points)), points - centre]) * passed_s[:, None]
    weight = np.ones(len(points))
    terms = np.zeros((3, 2))
    for _ in range(REWEIGHTINGS):
        root = np.sqrt(weight)[:, None]
        terms = np.linalg.lstsq(root * design, root * moved, rcond=None)[0]
        left = np.linalg.norm(moved - design @ terms, axis=-1)
        weight = 1 / (1 + (left / max(2 * float(np.median(left)), LEAST_SCALE_PX)) ** 2)
    return PictureVelocity(centre, terms)


def velocity_map(
    velocity: PictureVelocity, shutter: Shutter, width: int, height: int, since_reference_s: float
) -> NDArray[np.float32]:
    """Source pixel in the recorded frame of each pixel of the straightened one, (height, width, 2).

    since_reference_s: time from the straightened frame's reference time to the first row's mid-exposure.
    """
    pixels = np.stack(np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float)), axis=-1)
    speed, seen = velocity.at(pixels), pixels
    for _ in range(FIXED_POINT_STEPS):
        passed_s = row_time_s(since_reference_s, shutter.readout_time_s, shutter.readout_fraction(seen, width, height))
        seen = pixels + speed * passed_s[..., None]
    return seen.astype(np.float32)


def _displacements(
    pair: TrackPair, frame: int, middle_s: Mapping[int, float], shutter: Shutter, width: int, height: int
) -> tuple[Array, Array, Array]:
    """Points in the frame (n, 2), their displacements to the other frame (n, 2) and the time between (n,)."""
    own, other = pair.points_first_px, pair.points_second_px
    if frame != pair.first:
        own, other = other, own
    neighbour = pair.second if frame == pair.first else pair.first
    fraction = [shutter.readout_fraction(points, width, height) for points in (own, other)]
    passed_s = row_time_s(middle_s[neighbour] - middle_s[frame], shutter.readout_time_s, fraction[1] - fraction[0])
    return own, other - own, passed_s
