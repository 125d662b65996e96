"""The camera's direction of travel without an accelerometer: unit vectors from the parallax in tracked points.

A point's parallax lies along the flow F d of the direction d, with a length that its unknown depth determines.  So only
residuals across it count (the epipolar constraint for small rotations), and the directions are eliminated from fits.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from virest.arrays import Array, Index
from virest.inference.robust import CAUCHY, NORMAL_MEDIAN, cauchy_weight

FIRST_PASSES, LATER_PASSES = 12, 4
"""Passes from an unknown direction, and from one of an earlier pass; half or twice as many change a time offset by
less than 0.01 σ, and its standard deviation by 9 % at most."""
_UPPER = np.triu_indices(3)


def find_directions(flow: Array, difference: Array, group: Index, groups: int, start: Array | None) -> Array:
    """Find unit vectors (groups, 3) whose flow fits the differences (n, 2) best; flow (n, 2, 3) in the same units.

    Across F d, a difference r measures d · (r × F) / |F d|: linear in d except for the norm, which is taken from the
    previous pass; Cauchy weights at the noise across.
    """
    ahead, down = np.ascontiguousarray(flow.transpose(1, 2, 0))
    across = difference[:, 0] * down - difference[:, 1] * ahead
    square = across[_UPPER[0]] * across[_UPPER[1]]
    belongs = _members(group, groups)
    first = start is None
    if start is None:
        size = np.maximum(np.linalg.norm(difference, axis=-1), np.quantile(np.abs(difference), 0.2) + 1e-9)
        start = _least(square / np.maximum(size * np.linalg.norm(flow, axis=(1, 2)), 1e-12) ** 2, belongs)
    direction = start
    for _ in range(FIRST_PASSES if first else LATER_PASSES):
        way = direction.T.take(group, axis=1)
        squared = np.maximum((ahead * way).sum(axis=0) ** 2 + (down * way).sum(axis=0) ** 2, 1e-24)
        distance = np.abs((across * way).sum(axis=0)) / np.sqrt(squared)
        scale = max(float(np.median(distance)) / NORMAL_MEDIAN, 1e-3)
        direction = _least(square * (cauchy_weight(distance**2, CAUCHY * scale) / squared), belongs)
    return direction


def without_directions(
    rows: Array, left: Array, weight: Array, difference: Array, flow: Array, direction: Array, group: Index
) -> tuple[Array, Array]:
    """Rows (n, 2, k) and differences (n, 2) across the parallax only, with the directions eliminated.

    difference (n, 2): both components, in the units of ``left``.  Schur complement of two tangents per direction.
    """
    ahead, down = np.ascontiguousarray(flow.transpose(1, 2, 0))
    facing = direction.T.take(group, axis=1)
    way = np.stack([(ahead * facing).sum(axis=0), (down * facing).sum(axis=0)])
    size = np.maximum(np.hypot(*way), 1e-12)
    along_x, along_y = way / size
    across = along_x * down - along_y * ahead
    tangents = _tangents(direction).transpose(1, 2, 0).take(group, axis=2)
    length = along_x * difference[:, 0] + along_y * difference[:, 1]
    columns = np.ascontiguousarray(((tangents * across).sum(axis=1) * (length / size)).T)
    both = np.empty((len(group), rows.shape[2] + 1))
    both[:, :-1] = along_x[:, None] * rows[:, 1] - along_y[:, None] * rows[:, 0]
    both[:, -1] = along_x * left[:, 1] - along_y * left[:, 0]
    belongs, weighed = _members(group, len(direction)), (columns * weight[:, None])[:, :, None]
    square = _group_sum(weighed * columns[:, None, :], belongs)
    square = square + 1e-6 * np.trace(square, axis1=1, axis2=2)[:, None, None] * np.eye(2) + 1e-12 * np.eye(2)
    cross = np.linalg.solve(square, _group_sum(weighed * both[:, None, :], belongs))
    for one, part in zip(columns.T, cross.swapaxes(0, 1), strict=True):
        both -= one[:, None] * part[group]
    normal = np.stack([-along_y, along_x], axis=-1)
    return normal[:, :, None] * both[:, None, :-1], normal * both[:, -1:]


def _least(square: Array, belongs: csr_array) -> Array:
    """Unit vectors d (groups, 3) that minimise Σ (row · d)², from the rows' products (6, n) in the order of _UPPER."""
    total = np.empty((belongs.shape[0], 3, 3))
    total[:, *_UPPER] = total[:, *_UPPER[::-1]] = belongs @ np.ascontiguousarray(square.T)
    return np.asarray(np.linalg.eigh(total)[1][..., 0])


def _tangents(direction: Array) -> Array:
    """Two unit vectors (n, 2, 3) across each of the unit vectors (n, 3) and across each other."""
    one = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction), axis=-1)])
    one /= np.linalg.norm(one, axis=-1, keepdims=True)
    return np.stack([one, np.cross(direction, one)], axis=1)


def _members(group: Index, groups: int) -> csr_array:
    """(groups, n): 1 where a row belongs to a group."""
    order, count = np.argsort(group, kind="stable"), len(group)
    begin = np.searchsorted(group[order], np.arange(groups + 1))
    return csr_array((np.ones(count), order, begin), (groups, count))


def _group_sum(values: Array, belongs: csr_array) -> Array:
    total = belongs @ values.reshape(len(values), -1)
    return np.asarray(total.reshape(-1, *values.shape[1:]))
