"""Angles of eq 29 against angles that are known."""

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
    """Places 40 by 30 px apart, through an affine map."""
    grid = np.stack(np.meshgrid(40.0 * np.arange(columns), 30.0 * np.arange(rows)), axis=-1)
    return grid + 100 if matrix is None else grid @ matrix.T + 100


def test_the_angle_is_that_of_eq_29(rng: np.random.Generator) -> None:
    """Arc tangent of cross and dot product give what the paper's arc cosine gives."""
    a, b, c = rng.uniform(0, 600, (3, 50, 2))
    u, v = a - b, c - b
    paper = np.arccos((u * v).sum(-1) / np.sqrt((u**2).sum(-1)) / np.sqrt((v**2).sum(-1)))
    np.testing.assert_allclose(angle_rad(a, b, c), paper, atol=1e-7)


@pytest.mark.parametrize("shear", [-0.06, 0.02, 0.058])
def test_a_shear_shows_as_its_own_angle(shear: float) -> None:
    """x += shear · y: two corners open by the shear's angle, two close by it, for outer and neighbouring corners."""
    sheared = lattice(5, 7, np.array([[1, shear], [0, 1]]))
    expected = np.pi / 2 + np.arctan(shear) * np.array([-1, 1, -1, 1])
    outer = quadrilateral_angles_rad(Rectangle(0, 0, 4, 6).corners(sheared))
    np.testing.assert_allclose(outer, expected, atol=1e-12)
    cells = neighbour_angles_rad(sheared).reshape(-1, 4)
    assert len(cells) == 4 * 6
    np.testing.assert_allclose(cells, np.broadcast_to(expected, cells.shape), atol=1e-12)


def test_missing_corners_take_only_their_own_angles() -> None:
    """One missing inner corner of a lattice costs the 12 angles in which it stands."""
    points = lattice(4, 6)
    points[1, 2] = np.nan
    assert np.isnan(neighbour_angles_rad(points)).sum() == 4 * 3


def test_the_largest_rectangle_avoids_missing_corners() -> None:
    """With two outer corners gone, the rectangle of most cells that still has four known corners is taken."""
    known = np.ones((4, 6), bool)
    known[0, 0] = known[3, 5] = False
    found = largest_rectangle(known)
    assert found is not None
    assert (found.bottom - found.top) * (found.right - found.left) == 9
    assert all(known[r, c] for r in (found.top, found.bottom) for c in (found.left, found.right))


def test_no_rectangle_where_too_little_is_known() -> None:
    """A single row of corners makes no rectangle."""
    known = np.zeros((4, 6), bool)
    known[2] = True
    assert largest_rectangle(known) is None
