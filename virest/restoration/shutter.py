"""Straightening: one warp from the picture with rows exposed at different times to the picture of one instant."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Index
from virest.image_formation.row_motion import RowMotion
from virest.image_formation.warp import (
    PIXELS_WITHIN_PX,
    corner_points,
    dense_map,
    grid_filled,
    seen_by_rows,
    straightened_points,
)
from virest.restoration.row_chunks import bands
from virest.restoration.undistortion import distorted_points

USUAL_SPACING_PX, LEAST_SPACING_PX = 16, 4
"""Largest and least grid spacing of a map that includes lens distortion; wide lenses need a finer grid."""
LINES_OFF_PX = 0.01
"""Largest error of linear interpolation over a grid's cells, px."""


def rowwise_map(motion: RowMotion, anchor: float, *, undistort: bool = False) -> NDArray[np.float32]:
    """Where each pixel of the straightened picture was recorded, (height, width, 2), with each row at its own time.

    undistort: also correct lens distortion, so that one warp does both.
    """
    if not undistort:
        return dense_map(motion, anchor)

    def recorded(points: Array) -> Array:
        shown = distorted_points(motion.optics, points, motion.reference_s)
        return seen_by_rows(motion, shown, motion.reference_s, anchor, PIXELS_WITHIN_PX)

    return grid_filled(motion, recorded, _lens_spacing_px(motion))


def _lens_spacing_px(motion: RowMotion) -> int:
    """Grid spacing at which interpolating the distortion errs by :data:`LINES_OFF_PX`: its curvature is up to 1 / f."""
    focal_px = min(motion.optics.lens.fx_px, motion.optics.lens.fy_px)
    return int(np.clip(np.sqrt(8 * LINES_OFF_PX * focal_px), LEAST_SPACING_PX, USUAL_SPACING_PX))


def perspective_map(motion: RowMotion, anchor: float, *, undistort: bool = False) -> NDArray[np.float32]:
    """As :func:`rowwise_map`, by the paper's homography between four recorded and straightened corners (eqs 23-28)."""
    width, height = motion.profile.width, motion.profile.height
    recorded = corner_points(width, height)
    straightened = straightened_points(motion, recorded, anchor)
    homography = cv2.getPerspectiveTransform(straightened.astype(np.float32), recorded.astype(np.float32))
    x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    if undistort:
        spacing_px = _lens_spacing_px(motion)
        shown = grid_filled(motion, lambda p: distorted_points(motion.optics, p, motion.reference_s), spacing_px)
        x, y = np.moveaxis(shown.astype(np.float64), -1, 0)
    denominator = homography[2, 0] * x + homography[2, 1] * y + homography[2, 2]
    source_x = (homography[0, 0] * x + homography[0, 1] * y + homography[0, 2]) / denominator
    source_y = (homography[1, 0] * x + homography[1, 1] * y + homography[1, 2]) / denominator
    return np.stack([source_x, source_y], -1).astype(np.float32)


def warp(picture: NDArray[np.uint8 | np.float32], source_px: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Resample grey levels, 0 to 255, at ``source_px`` by cubic interpolation; the picture's edges are replicated.

    It uses floats, since OpenCV's fixed-point arithmetic takes half as long again, and works band by band, so that the
    data stay in the cache.
    """
    levels = picture.astype(np.float32, copy=False)
    warped = np.empty((*source_px.shape[:2], *picture.shape[2:]), np.uint8)
    for rows in bands(len(warped)):
        read = cv2.remap(levels, source_px[rows], None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        rounded(read, warped[rows])
    return warped


def rounded(levels: NDArray[np.float32], into: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
    """Round to 8-bit grey levels."""
    return np.asarray(cv2.convertScaleAbs(cv2.max(levels, 0.0), into), np.uint8)


def valid_rectangle(source_px: NDArray[np.float32], step: int = 4) -> tuple[int, int, int, int]:
    """(x0, y0, x1, y1), x1 and y1 exclusive: a large rectangle in which every pixel was recorded; all 0 if none exists.

    Starting from the whole picture, the side with the largest fraction of missing pixels is moved inwards, repeatedly.
    The map is smooth, so only every ``step``-th pixel is tested; the rectangle begins and ends on such pixels.
    """
    height, width = source_px.shape[:2]
    columns, rows = _every(width, step), _every(height, step)
    x, y = np.moveaxis(source_px[np.ix_(rows, columns)], -1, 0)
    missing = (x < -0.5) | (x > width - 0.5) | (y < -0.5) | (y > height - 0.5)
    sums = cv2.integral(missing.astype(np.uint8))

    def part_missing(left: int, top: int, right: int, bottom: int) -> float:
        lost = sums[bottom, right] - sums[bottom, left] - sums[top, right] + sums[top, left]
        return float(lost / ((right - left) * (bottom - top)))

    x0, y0, x1, y1 = 0, 0, len(columns), len(rows)
    while x1 - x0 > 1 and y1 - y0 > 1:
        sides = (
            part_missing(x0, y0, x0 + 1, y1),
            part_missing(x0, y0, x1, y0 + 1),
            part_missing(x1 - 1, y0, x1, y1),
            part_missing(x0, y1 - 1, x1, y1),
        )
        worst = int(np.argmax(sides))
        if sides[worst] == 0:
            break
        x0, y0, x1, y1 = x0 + (worst == 0), y0 + (worst == 1), x1 - (worst == 2), y1 - (worst == 3)
    if part_missing(x0, y0, x1, y1):
        return 0, 0, 0, 0
    return int(columns[x0]), int(rows[y0]), int(columns[x1 - 1]) + 1, int(rows[y1 - 1]) + 1


def _every(length: int, step: int) -> Index:
    return np.append(np.arange(0, length - 1, step), length - 1)
