"""Which way the camera travels, where no accelerometer tells: unit vectors from the parallax that differences show.

A point's parallax lies along the flow F d of the direction d; by how much, its unknown depth says.  So only what lies
across counts (the epipolar constraint for a small turn), and the directions are eliminated from every fit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from virest.inference.robust import CAUCHY, NORMAL_MEDIAN, cauchy_weight

Array = NDArray[np.float64]
Index = NDArray[np.intp]
FIRST_PASSES, LATER_PASSES = 12, 4


def find_directions(flow: Array, difference: Array, group: Index, groups: int, start: Array | None) -> Array:
    """Find unit vectors (groups, 3) whose flow the differences (n, 2) follow best; flow (n, 2, 3) in the same units.

    Across F d, a difference r measures d · (r × F) / |F d|: linear in d but for the length, which each pass takes from
    the one before; Cauchy weights at the noise across.
    """
    across = difference[:, :1] * flow[:, 1] - difference[:, 1:] * flow[:, 0]
    first = start is None
    if start is None:
        size = np.maximum(np.linalg.norm(difference, axis=-1), np.quantile(np.abs(difference), 0.2) + 1e-9)
        rows = across / np.maximum(size * np.linalg.norm(flow, axis=(1, 2)), 1e-12)[:, None]
        start = _least(rows, group, groups)
    direction = start
    for _ in range(FIRST_PASSES if first else LATER_PASSES):
        length = np.linalg.norm(np.einsum("nij,nj->ni", flow, direction[group]), axis=-1)
        unit = across / np.maximum(length, 1e-12)[:, None]
        distance = np.abs(np.einsum("ni,ni->n", unit, direction[group]))
        scale = max(float(np.median(distance)) / NORMAL_MEDIAN, 1e-3)
        weight = cauchy_weight(distance**2, CAUCHY * scale)
        direction = _least(unit * np.sqrt(weight)[:, None], group, groups)
    return direction


def without_directions(
    rows: Array, left: Array, weight: Array, difference: Array, flow: Array, direction: Array, group: Index
) -> tuple[Array, Array]:
    """Rows (n, 2, k) and differences (n, 2), both across only, less what turning the directions would explain.

    difference (n, 2): whole, in the same units as ``left``.  Schur complement of two tangents for each direction.
    """
    tangents = np.linalg.svd(direction[:, None, :])[2][:, 1:]
    moved = np.einsum("nij,nj->ni", flow, direction[group])
    size = np.maximum(np.linalg.norm(moved, axis=-1), 1e-12)
    way = moved / size[:, None]
    normal = np.stack([-way[:, 1], way[:, 0]], axis=-1)
    turn = np.einsum("ni,nij,nkj->nk", normal, flow, tangents[group]) / size[:, None]
    columns = turn * (way * difference).sum(axis=-1)[:, None]
    both = np.concatenate([np.einsum("ni,nik->nk", normal, rows), (normal * left).sum(axis=-1)[:, None]], axis=1)
    groups = len(direction)
    square = _group_sum(columns[:, :, None] * (columns * weight[:, None])[:, None, :], group, groups)
    square = square + 1e-6 * np.trace(square, axis1=1, axis2=2)[:, None, None] * np.eye(2) + 1e-12 * np.eye(2)
    cross = _group_sum(columns[:, :, None] * (both * weight[:, None])[:, None, :], group, groups)
    both = both - np.einsum("nk,nkj->nj", columns, np.linalg.solve(square, cross)[group])
    return normal[:, :, None] * both[:, None, :-1], normal * both[:, -1:]


def _least(rows: Array, group: Index, groups: int) -> Array:
    """Unit vectors (groups, 3) with the least Σ (row · d)²."""
    return np.asarray(np.linalg.eigh(_group_sum(rows[:, :, None] * rows[:, None, :], group, groups))[1][..., 0])


def _group_sum(values: Array, group: Index, groups: int) -> Array:
    flat = values.reshape(len(values), -1)
    total: Array = np.stack([np.bincount(group, column, groups) for column in flat.T], axis=-1)
    return total.reshape(groups, *values.shape[1:])
