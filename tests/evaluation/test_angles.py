"""Angles of eq 29 compared with known angles."""

import numpy as np
import pytest

from virest.evaluation.angles import (
    Rectangle,
    angle_rad,
    largest_rectangle,
    neighbour_angles_rad,
    quadrilateral_angles_rad,
)


def lattice(rows: int, columns: int, matrix: np.ndarray | None = None) -> np.ndarray:
    """Points 40 px by 30 px apart, optionally mapped by an affine matrix."""
    grid = np.stack(np.meshgrid(40.0 * np.arange(columns), 30.0 * np.arange(rows)), axis=-1)
    return grid + 100 if matrix is None else grid @ matrix.T + 100


def test_the_angle_is_that_of_eq_29(rng: np.random.Generator) -> None:
    """The arc tangent of cross and dot product equals the paper's arc cosine."""
    a, b, c = rng.uniform(0, 600, (3, 50, 2))
    u, v = a - b, c - b
    paper = np.arccos((u * v).sum(-1) / np.sqrt((u**2).sum(-1)) / np.sqrt((v**2).sum(-1)))
    np.testing.assert_allclose(angle_rad(a, b, c), paper, atol=1e-7)


@pytest.mark.parametrize("shear", [-0.06, 0.02, 0.058])
def test_a_shear_changes_corners_by_its_angle(shear: float) -> None:
    """x += shear · y opens two corners by the angle of the shear and closes two, for outer and neighbouring corners."""
    sheared = lattice(5, 7, np.array([[1, shear], [0, 1]]))
    expected = np.pi / 2 + np.arctan(shear) * np.array([-1, 1, -1, 1])
    outer = quadrilateral_angles_rad(Rectangle(0, 0, 4, 6).corners(sheared))
    np.testing.assert_allclose(outer, expected, atol=1e-12)
    cells = neighbour_angles_rad(sheared).reshape(-1, 4)
    assert len(cells) == 4 * 6
    np.testing.assert_allclose(cells, np.broadcast_to(expected, cells.shape), atol=1e-12)


def test_a_missing_corner_removes_only_its_own_angles() -> None:
    """A missing inner corner of a lattice removes 12 angles."""
    points = lattice(4, 6)
    points[1, 2] = np.nan
    assert np.isnan(neighbour_angles_rad(points)).sum() == 4 * 3


def test_the_largest_rectangle_avoids_missing_corners() -> None:
    """Without two outer corners, the rectangle with the most cells and four known corners is used."""
    known = np.ones((4, 6), bool)
    known[0, 0] = known[3, 5] = False
    found = largest_rectangle(known)
    assert found is not None
    assert (found.bottom - found.top) * (found.right - found.left) == 9
    assert all(known[r, c] for r in (found.top, found.bottom) for c in (found.left, found.right))


def test_too_few_corners_give_no_rectangle() -> None:
    """A single row of corners gives no rectangle."""
    known = np.zeros((4, 6), bool)
    known[2] = True
    assert largest_rectangle(known) is None
