"""Angles at a board's corners (eq 29): a rolling shutter shears the board, and straightening must undo that.

A board is a lattice of points (rows, columns, 2) in pixels, rows downwards, columns to the right, NaN where not found.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from virest.arrays import Array, Mask


def angle_rad(a: Array, b: Array, c: Array) -> Array:
    """Angle at b between the lines to a and to c, points (..., 2), in [0, π] (eq 29).

    Computed as the arctangent of cross and dot product, which equals eq 29's arccosine and stays accurate near 0 and π.
    """
    u, v = a - b, c - b
    cross = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
    return np.arctan2(np.abs(cross), (u * v).sum(-1))


def quadrilateral_angles_rad(corners: Array) -> Array:
    """Angles (..., 4) at the corners (..., 4, 2) of quadrilaterals, corners in cyclic order."""
    return angle_rad(np.roll(corners, 1, axis=-2), corners, np.roll(corners, -1, axis=-2))


@dataclass(frozen=True, slots=True)
class Rectangle:
    """Lattice rows and columns of the outer corners to compare."""

    top: int
    left: int
    bottom: int
    right: int

    def corners(self, lattice: Array) -> Array:
        """Corner points (4, 2): top left, top right, bottom right, bottom left."""
        rows, columns = [self.top, self.top, self.bottom, self.bottom], [self.left, self.right, self.right, self.left]
        return lattice[rows, columns]


def largest_rectangle(known: Mask) -> Rectangle | None:
    """Rectangle of the most lattice cells whose four corners are all known; known: (rows, columns).  None if none."""
    best, most = None, 0
    for top, bottom in ((i, k) for i in range(len(known)) for k in range(i + 1, len(known))):
        columns = np.flatnonzero(known[top] & known[bottom])
        cells = (bottom - top) * int(np.ptp(columns)) if len(columns) > 1 else 0
        if cells > most:
            best, most = Rectangle(top, int(columns[0]), bottom, int(columns[-1])), cells
    return best


def neighbour_angles_rad(lattice: Array) -> Array:
    """Angles between neighbouring corners (n,): four per lattice cell, NaN where a corner is missing.

    The order depends only on the lattice's shape, so the angles of two images can be subtracted.
    """
    cells = [lattice[:-1, :-1], lattice[:-1, 1:], lattice[1:, 1:], lattice[1:, :-1]]
    return quadrilateral_angles_rad(np.stack(cells, axis=-2)).ravel()
