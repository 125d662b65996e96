"""Corners of calibration boards, detected by OpenCV with subpixel refinement.

Chessboards: findChessboardCornersSB (Duda & Frese 2018).  Its Radon-transform localisation is half as sensitive to
coding noise as gradients, and it copes with boards cut off by the frame and with marks in the white squares.
AprilGrids (Kalibr: tags 36h11 with a black square at each crossing): detected by tag number, corners refined as saddle
points.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Index
from virest.camera.intrinsics import Intrinsics

Grey = NDArray[np.uint8]
ATTEMPTS = (((5, 4), 0), ((5, 4), cv2.CALIB_CB_NORMALIZE_IMAGE), ((4, 3), cv2.CALIB_CB_NORMALIZE_IMAGE))
"""Minimum inner corners along both sides, and OpenCV flags; a larger minimum size is detected more reliably."""
MAX_UNEVEN = 0.12
"""RMS deviation from a planar lattice, in lattice steps, above which a chessboard is a false detection (in leaves).

A rolling shutter bends a board less.
"""
MIN_TAGS = 4
"""Fewer do not determine the grid's columns and perspective."""
MAX_GRID_COLUMNS = 12
"""Usual grids have six."""
MAX_WINDOW_PX, MIN_WINDOW_PX = 7, 2
"""Half widths of the window: more would reach beyond the border, less holds too few pixels."""
TAG_CELLS = 8
"""Cells along a tag's side, border included; the refinement window is limited to the border."""
REFINE_STEPS, REFINE_PX = 60, 1e-3
"""Most iterations of OpenCV's corner refinement, and the step at which it ends."""


@dataclass(frozen=True, slots=True)
class Board:
    """A board detected in one image."""

    kind: str
    """``chessboard`` or ``aprilgrid``."""
    points_px: Array
    """(rows, columns, 2), rows downwards, columns to the right; NaN where a corner was not found."""
    board_xy: Array
    """(rows, columns, 2) corner positions on the board, in its own unit; for a chessboard up to a translation."""
    numbered: bool = False
    """Whether ``board_xy`` is the same in all images; not so for a chessboard, which the frame may cut off."""

    @property
    def step_px(self) -> float:
        """Median distance of neighbouring corners."""
        steps = [np.linalg.norm(np.diff(self.points_px, axis=axis), axis=-1).ravel() for axis in (0, 1)]
        return float(np.nanmedian(np.concatenate(steps)))

    def box_px(self) -> tuple[float, float, float, float]:
        """Bounding box (x0, y0, x1, y1) of all corners."""
        low, high = np.nanmin(self.points_px, axis=(0, 1)), np.nanmax(self.points_px, axis=(0, 1))
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def find_board(grey: Grey, kind: str = "auto") -> Board | None:
    """Find the board in a grey image; kind: ``chessboard``, ``aprilgrid`` or ``auto``.  None if there is none."""
    if kind != "chessboard":
        found = find_aprilgrid(grey)
        if found is not None or kind == "aprilgrid":
            return found
    return find_chessboard(grey)


def find_chessboard(grey: Grey) -> Board | None:
    """Find the largest fully visible part of a chessboard."""
    for least, flag in ATTEMPTS:
        found, corners, meta = cv2.findChessboardCornersSBWithMeta(grey, least, cv2.CALIB_CB_LARGER | flag)
        if found:
            lattice = _upright(corners.reshape(*meta.shape, 2).astype(float))
            board = Board("chessboard", lattice, _unit_lattice(*lattice.shape[:2]))
            if np.sqrt(np.mean((plane_lattice(board) - lattice) ** 2)) < MAX_UNEVEN * board.step_px:
                return board
    return None


def find_aprilgrid(grey: Grey) -> Board | None:
    """Find an AprilGrid's tag corners; its number of columns is inferred from the positions of the tag numbers."""
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11))
    quads, numbers, _ = detector.detectMarkers(grey)
    if numbers is None or len(numbers) < MIN_TAGS:
        return None
    tags, number = np.array([q[0] for q in quads], float), numbers.ravel().astype(int)
    tags, number = tags[np.argsort(number)], np.sort(number)
    layout = _grid_columns(tags.mean(axis=1), number)
    if layout is None or len(np.unique(number)) < len(number):
        return None
    columns, picture_from_grid = layout
    grid_from_picture: Array = np.linalg.inv(picture_from_grid).astype(float)
    rough = _tag_lattice(tags, number, columns, grid_from_picture)
    side = float(np.median(np.linalg.norm(tags - np.roll(tags, 1, axis=1), axis=-1)))
    lattice = _refined(grey, rough, int(np.clip(side / TAG_CELLS - 0.5, MIN_WINDOW_PX, MAX_WINDOW_PX)))
    both = _upright(np.concatenate([lattice, _tag_corners_xy(lattice, grid_from_picture)], axis=-1))
    return Board("aprilgrid", both[..., :2], both[..., 2:], numbered=True)


def matched(board: Board | None, truth: Board) -> Array:
    """A board's corners on the truth's lattice (rows, columns, 2); NaN where there are none.

    Boards that are not numbered are aligned at the lattice offset with the least median corner displacement, which must
    be below half a square.
    """
    result = np.full_like(truth.points_px, np.nan)
    if board is None or board.kind != truth.kind:
        return result
    if board.numbered:
        return _match_numbered(board, truth)
    rows, columns = result.shape[:2]
    height, width = board.points_px.shape[:2]
    offsets = [(i, j) for i in range(1 - height, rows) for j in range(1 - width, columns)]
    shifted = [_shift_lattice(board.points_px, result, *offset) for offset in offsets]
    moved = [np.nanmedian(np.linalg.norm(points - truth.points_px, axis=-1)) for points in shifted]
    best = int(np.argmin(moved))
    return shifted[best] if moved[best] < 0.5 * truth.step_px else result


def plane_lattice(board: Board, lens: Intrinsics | None = None) -> Array:
    """Corners predicted by the homography from the board that best fits those found, through the lens if given.

    At least six corners; the residual of the least-squares fit is the detector's error.
    """
    known = np.isfinite(board.points_px).all(-1)
    if lens is None or not lens.is_distorted:
        homography, _ = cv2.findHomography(board.board_xy[known], board.points_px[known], 0)
        return cv2.perspectiveTransform(board.board_xy.reshape(1, -1, 2), homography).reshape(board.points_px.shape)
    rays = lens.rays(board.points_px[known])
    homography, _ = cv2.findHomography(board.board_xy[known], rays[:, :2] / rays[:, 2:], 0)
    flat = cv2.perspectiveTransform(board.board_xy.reshape(1, -1, 2), homography)[0]
    return lens.project(np.column_stack([flat, np.ones(len(flat))])).reshape(board.points_px.shape)


def _refined(grey: Grey, lattice: Array, window_px: int) -> Array:
    """Saddle points with subpixel accuracy (Förstner); corners whose window leaves the image are dropped."""
    known = np.isfinite(lattice).all(-1)
    height, width = grey.shape
    reach = window_px + 1
    known &= (lattice > reach).all(-1) & (lattice[..., 0] < width - 1 - reach) & (lattice[..., 1] < height - 1 - reach)
    result = np.full_like(lattice, np.nan)
    if known.any():
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, REFINE_STEPS, REFINE_PX)
        start = np.ascontiguousarray(lattice[known][:, None], np.float32)
        result[known] = cv2.cornerSubPix(grey, start, (window_px, window_px), (-1, -1), criteria)[:, 0]
    return result


def _upright(lattice: Array) -> Array:
    """Transpose and flip the lattice so that columns run right and rows down; its first two channels are pixels."""
    across, down = (np.nanmean(np.diff(lattice[..., :2], axis=axis), axis=(0, 1)) for axis in (1, 0))
    if abs(across[0]) < abs(down[0]):
        lattice, across, down = lattice.swapaxes(0, 1), down, across
    return lattice[:: 1 if down[1] > 0 else -1, :: 1 if across[0] > 0 else -1]


def _unit_lattice(rows: int, columns: int) -> Array:
    return np.stack(np.meshgrid(np.arange(columns, dtype=float), np.arange(rows, dtype=float)), axis=-1)


def _grid_columns(centres_px: Array, number: Index) -> tuple[int, Array] | None:
    """Number of tag columns for which row-by-row numbering fits a plane, and the image-from-grid homography (3, 3)."""
    best: tuple[float, int, Array] | None = None
    for columns in range(2, MAX_GRID_COLUMNS + 1):
        grid = np.stack([number % columns, number // columns], axis=-1).astype(float)
        if len(np.unique(grid[:, 0])) < 2 or len(np.unique(grid[:, 1])) < 2:
            continue
        homography, _ = cv2.findHomography(grid, centres_px, 0)
        if homography is None:
            continue
        predicted = cv2.perspectiveTransform(grid[None], homography)[0]
        error = float(np.sqrt(np.mean((predicted - centres_px) ** 2)))
        if best is None or error < best[0]:
            best = error, columns, homography
    side = float(np.median(np.linalg.norm(np.diff(centres_px, axis=0), axis=-1)))
    return None if best is None or best[0] > 0.2 * side else best[1:]


def _tag_lattice(tags: Array, number: Index, columns: int, grid_from_picture: Array) -> Array:
    """Arrange tag corners (n, 4, 2) in a lattice (2 rows, 2 columns, 2) by their side of the tag's centre."""
    flat = cv2.perspectiveTransform(tags.reshape(1, -1, 2), grid_from_picture).reshape(tags.shape)
    grid = np.stack([number % columns, number // columns], axis=-1)
    from_centre = flat - grid[:, None]
    rows = int(grid[:, 1].max()) + 1
    lattice = np.full((2 * rows, 2 * columns, 2), np.nan)
    row, column = (2 * grid[:, None, k] + (from_centre[..., k] > 0) for k in (1, 0))
    lattice[row, column] = tags
    return lattice


def _tag_corners_xy(lattice: Array, grid_from_picture: Array) -> Array:
    """Corner positions on the board in units of the tag pitch; half a tag's side is measured from the corners."""
    flat = cv2.perspectiveTransform(np.nan_to_num(lattice).reshape(1, -1, 2), grid_from_picture).reshape(lattice.shape)
    known = np.isfinite(lattice).all(-1)
    rows, columns = lattice.shape[0] // 2, lattice.shape[1] // 2
    centres = np.repeat(np.repeat(_unit_lattice(rows, columns), 2, axis=0), 2, axis=1)
    half = float(np.median(np.abs(flat - centres)[known]))
    x, y = (np.repeat(np.arange(n), 2) + np.tile([-half, half], n) for n in (columns, rows))
    return np.stack(np.meshgrid(x, y), axis=-1)


def _match_numbered(board: Board, truth: Board) -> Array:
    """Corners of a numbered board on the truth's lattice, matched by their position on the board."""
    result = np.full_like(truth.points_px, np.nan)
    distance = np.linalg.norm(board.board_xy[:, :, None, None] - truth.board_xy[None, None], axis=-1)
    nearest = distance.reshape(*distance.shape[:2], -1).argmin(-1)
    close = distance.reshape(*distance.shape[:2], -1).min(-1) < 0.1
    result.reshape(-1, 2)[nearest[close]] = board.points_px[close]
    return result


def _shift_lattice(points: Array, empty: Array, row: int, column: int) -> Array:
    """Copy points into an empty lattice with the first one at (row, column); points outside are dropped."""
    result = empty.copy()
    rows, columns = empty.shape[:2]
    height, width = points.shape[:2]
    into = slice(max(row, 0), min(row + height, rows)), slice(max(column, 0), min(column + width, columns))
    result[into] = points[into[0].start - row : into[0].stop - row, into[1].start - column : into[1].stop - column]
    return result
