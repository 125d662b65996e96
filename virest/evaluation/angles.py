"""Angles at a board's corners (eq 29): a rolling shutter shears the board, straightening has to bring them back.

A board is a lattice of points (rows, columns, 2) in pixels, rows down and columns to the right, NaN where not found.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def angle_rad(a: Array, b: Array, c: Array) -> Array:
    """Angle at b between the lines to a and to c, points (..., 2), in [0, π] (eq 29).

    By the arc tangent of cross and dot product, the same as eq 29's arc cosine and exact near 0 and π too.
    """
    u, v = a - b, c - b
    cross = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
    return np.arctan2(np.abs(cross), (u * v).sum(-1))


def quadrilateral_angles_rad(corners: Array) -> Array:
    """Angles (..., 4) at corners (..., 4, 2) given around the quadrilateral."""
    return angle_rad(np.roll(corners, 1, axis=-2), corners, np.roll(corners, -1, axis=-2))


@dataclass(frozen=True, slots=True)
class Rectangle:
    """Lattice rows and columns of the outer corners that are compared."""

    top: int
    left: int
    bottom: int
    right: int

    def corners(self, lattice: Array) -> Array:
        """The four points (4, 2): top left, top right, bottom right, bottom left."""
        rows, columns = [self.top, self.top, self.bottom, self.bottom], [self.left, self.right, self.right, self.left]
        return lattice[rows, columns]


def largest_rectangle(known: NDArray[np.bool_]) -> Rectangle | None:
    """The rectangle of most lattice cells whose four corners are all known (rows, columns); None: there is none."""
    best, most = None, 0
    for top, bottom in ((i, k) for i in range(len(known)) for k in range(i + 1, len(known))):
        columns = np.flatnonzero(known[top] & known[bottom])
        cells = (bottom - top) * int(np.ptp(columns)) if len(columns) > 1 else 0
        if cells > most:
            best, most = Rectangle(top, int(columns[0]), bottom, int(columns[-1])), cells
    return best


def neighbour_angles_rad(lattice: Array) -> Array:
    """All angles between neighbouring corners, (n,): four in each cell of the lattice, NaN where a corner is missing.

    In an order that depends on the lattice's shape only, so that two pictures' angles can be subtracted.
    """
    cells = [lattice[:-1, :-1], lattice[:-1, 1:], lattice[1:, 1:], lattice[1:, :-1]]
    return quadrilateral_angles_rad(np.stack(cells, axis=-2)).ravel()
