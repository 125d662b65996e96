"""Straightening: one warp from the picture whose rows were seen one after another to the picture of one instant."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

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
"""Grid of a map; where it holds a lens's distortion, finer for wide lenses."""
LINES_OFF_PX = 0.01
"""Largest error of linear interpolation over a grid's cells, in pixels."""


def rowwise_map(motion: RowMotion, anchor: float, *, undistort: bool = False) -> NDArray[np.float32]:
    """Where each pixel of the straightened picture was recorded, (height, width, 2): every row at its own time.

    undistort: of the straightened picture of a pinhole, so that one warp reads what both steps move.
    """
    if not undistort:
        return dense_map(motion, anchor)

    def recorded(points: NDArray[np.float64]) -> NDArray[np.float64]:
        shown = distorted_points(motion.optics, points, motion.reference_s)
        return seen_by_rows(motion, shown, motion.reference_s, anchor, None, PIXELS_WITHIN_PX)

    return grid_filled(motion, recorded, _lens_spacing_px(motion))


def _lens_spacing_px(motion: RowMotion) -> int:
    """Grid over which a distortion bends by :data:`LINES_OFF_PX`: its slope changes by up to about 1 over f pixels."""
    focal_px = min(motion.optics.lens.fx_px, motion.optics.lens.fy_px)
    return int(np.clip(np.sqrt(8 * LINES_OFF_PX * focal_px), LEAST_SPACING_PX, USUAL_SPACING_PX))


def perspective_map(motion: RowMotion, anchor: float, *, undistort: bool = False) -> NDArray[np.float32]:
    """The same by the paper's four corners (eqs 23-28): one homography between recorded and straightened corners."""
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
    """Cubic interpolation of grey levels of 255 at ``source_px``; where there are no data the edge is repeated.

    In floats, since OpenCV's fixed-point sums take half as long again; band by band: what is read stays in the cache.
    """
    levels = picture.astype(np.float32, copy=False)
    warped = np.empty((*source_px.shape[:2], *picture.shape[2:]), np.uint8)
    for rows in bands(len(warped)):
        read = cv2.remap(levels, source_px[rows], None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        rounded(read, warped[rows])
    return warped


def rounded(levels: NDArray[np.float32], into: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
    """The nearest of 256 grey levels."""
    return np.asarray(cv2.convertScaleAbs(cv2.max(levels, 0.0), into), np.uint8)


def valid_rectangle(source_px: NDArray[np.float32], step: int = 4) -> tuple[int, int, int, int]:
    """(x0, y0, x1, y1), x1 and y1 one past the end: a large rectangle whose every pixel was recorded.

    Its sides move in from the picture's own, always the one with the largest part of missing pixels.  The map is
    smooth, so every ``step``-th pixel is looked at; the rectangle begins and ends on such pixels.
    All 0 where there is none.
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


def _every(length: int, step: int) -> NDArray[np.intp]:
    return np.append(np.arange(0, length - 1, step), length - 1)
