"""Isolated edges in a picture, and grey-level profiles across them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Index, Picture

TANGENT_PX = (-2.0, -1.0, 0.0, 1.0, 2.0)
"""Offsets of the parallel profiles that are averaged: edges are straight over this length."""
MARGIN_PX = 7
"""Edges closer to the picture's border are ignored."""


@dataclass(frozen=True, slots=True)
class EdgeSettings:
    """Which edges are measured."""

    edges_per_frame: int = 400
    cell_px: int = 20
    """Side of the squares; each gives one edge for each of four directions."""
    min_slope_levels: float = 2.0
    """Smallest slope of a candidate, grey levels per pixel after smoothing by 1 px."""


def find_edges(picture: Picture, settings: EdgeSettings) -> tuple[Array, Array]:
    """Ridges of the gradient: points (n, 2) and unit normals (n, 2) from dark to bright, spread over the picture."""
    smooth = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), 1.0)
    slope_x, slope_y = (cv2.Scharr(smooth, cv2.CV_32F, *order) / 32 for order in ((1, 0), (0, 1)))
    slope = np.hypot(slope_x, slope_y)
    margin = MARGIN_PX
    slope[:margin], slope[-margin:], slope[:, :margin], slope[:, -margin:] = 0, 0, 0, 0
    y, x = np.nonzero(slope > settings.min_slope_levels)
    normal = np.stack([slope_x[y, x], slope_y[y, x]], -1) / slope[y, x, None]
    here = np.stack([x, y], -1).astype(np.float32)
    ahead, behind = (sampled(slope, here + sign * normal) for sign in (1, -1))
    crest = (slope[y, x] >= ahead) & (slope[y, x] > behind)
    kept = np.flatnonzero(crest)[_strongest_per_cell(here[crest], normal[crest], slope[y, x][crest], settings)]
    return here[kept].astype(float), normal[kept].astype(float)


def _strongest_per_cell(points: Any, normal: Any, strength: Any, settings: EdgeSettings) -> Index:
    """Index of the strongest edge of each cell and direction, thinned evenly to ``edges_per_frame``."""
    direction = np.floor(np.arctan2(normal[:, 1], normal[:, 0]) % np.pi / (np.pi / 4)).astype(np.intp) % 4
    cell = (points // settings.cell_px).astype(np.intp)
    key = (cell[:, 1] * 100_000 + cell[:, 0]) * 4 + direction
    order = np.lexsort((-strength, key))
    best = order[np.r_[True, np.diff(key[order]) > 0]] if len(order) else order
    if len(best) <= settings.edges_per_frame:
        return best
    return best[np.linspace(0, len(best) - 1, settings.edges_per_frame).astype(np.intp)]


def sampled(plane: Any, points: Any) -> NDArray[np.float32]:
    """Bicubic samples (n, m) or (n,) of a plane at (n, m, 2) or (n, 2); NaN within 1 px of the border."""
    shape = np.shape(points)[:-1]
    # One row: OpenCV processes a map row by row, so 16,384 rows of one pixel would take 25 times as long.
    flat = np.ascontiguousarray(np.asarray(points, np.float32).reshape(1, -1, 2))
    chunks = [
        cv2.remap(plane, flat[:, i : i + 16_384], None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        for i in range(0, flat.shape[1], 16_384)
    ]
    values = np.concatenate(chunks, axis=1).reshape(shape) if chunks else np.zeros(shape, np.float32)
    limit = np.array([plane.shape[1] - 2, plane.shape[0] - 2])
    inside = ((flat[0] >= 1) & (flat[0] <= limit)).all(axis=-1).reshape(shape)
    return np.where(inside, values, np.float32(np.nan))


def parallel_profiles(picture: Picture, points: Array, normals: Array, along_px: Array) -> Array:
    """Means (n, m) of parallel profiles across edges, grey levels, at distances along the normals.

    Lanczos over 8 pixels, because OpenCV's cubic itself sharpens: it doubles the overshoot of an unsharpened movie.
    """
    tangents = np.stack([-normals[:, 1], normals[:, 0]], -1)
    total = np.zeros((len(points), len(along_px)))
    if not len(points):
        return total
    plane = picture.astype(np.float32)
    for beside in TANGENT_PX:
        where = (points + beside * tangents)[:, None] + along_px[:, None] * normals[:, None]
        x, y = where[..., 0].astype(np.float32), where[..., 1].astype(np.float32)
        total += cv2.remap(plane, x, y, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT)
    return total / len(TANGENT_PX)


def moved_profiles(profiles: Array, middle_px: Array, along_px: Array, grid_px: Array) -> Array:
    """Profiles (n, m) sampled evenly at ``along_px``, with their middles (n,) moved to 0, on a grid; linear between."""
    at = (grid_px + middle_px[:, None] - along_px[0]) / (along_px[1] - along_px[0])
    index = np.clip(at.astype(np.intp), 0, len(along_px) - 2)
    share, rows = at - index, np.arange(len(profiles))[:, None]
    return np.asarray(profiles[rows, index] * (1 - share) + profiles[rows, index + 1] * share)
