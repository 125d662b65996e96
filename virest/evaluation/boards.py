"""Corners of calibration boards, found by OpenCV and refined to parts of a pixel.

Chessboards by findChessboardCornersSB (Duda & Frese 2018: lines through the Radon transform, which a coder's noise
moves half as much as gradients), also where the board goes on beyond the picture or bears marks in its white fields;
AprilGrids (Kalibr's: tags 36h11 with a black square at each crossing) by the tags' numbers, refined as saddles.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.camera.intrinsics import Intrinsics

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]
ATTEMPTS = (((5, 4), 0), ((5, 4), cv2.CALIB_CB_NORMALIZE_IMAGE), ((4, 3), cv2.CALIB_CB_NORMALIZE_IMAGE))
"""Least inner corners along both sides, with OpenCV's options: a pattern that is asked to be large is found surely."""
MAX_UNEVEN = 0.12
"""A lattice further from a plane's, part of its step, was seen in leaves; a rolling shutter bends less."""
MIN_TAGS = 4
MAX_GRID_COLUMNS = 12
MAX_WINDOW_PX, MIN_WINDOW_PX = 7, 2
TAG_CELLS = 8
"""Cells along a tag's side, border included: an AprilGrid's window holds no more than the border."""
REFINE_STEPS, REFINE_PX = 60, 1e-3


@dataclass(frozen=True, slots=True)
class Board:
    """A board seen in one picture."""

    kind: str
    """``chessboard`` or ``aprilgrid``."""
    points_px: Array
    """(rows, columns, 2), rows down, columns to the right; NaN where a corner was not found."""
    places: Array
    """(rows, columns, 2) where the corners lie on the board, in its own unit, up to a shift of a chessboard."""
    numbered: bool = False
    """Whether lattice places are the same in all pictures; a chessboard cut off by the picture's edge has none."""

    @property
    def step_px(self) -> float:
        """Typical distance of neighbouring corners."""
        steps = [np.linalg.norm(np.diff(self.points_px, axis=axis), axis=-1).ravel() for axis in (0, 1)]
        return float(np.nanmedian(np.concatenate(steps)))

    def box_px(self) -> tuple[float, float, float, float]:
        """(x0, y0, x1, y1) around all corners."""
        low, high = np.nanmin(self.points_px, axis=(0, 1)), np.nanmax(self.points_px, axis=(0, 1))
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def find_board(grey: Grey, kind: str = "auto") -> Board | None:
    """Find the board of a grey picture; kind: ``chessboard``, ``aprilgrid`` or ``auto``.  None: none was found."""
    if kind != "chessboard":
        found = find_aprilgrid(grey)
        if found is not None or kind == "aprilgrid":
            return found
    return find_chessboard(grey)


def find_chessboard(grey: Grey) -> Board | None:
    """Find the largest part of a chessboard that is seen whole."""
    for least, flag in ATTEMPTS:
        found, corners, meta = cv2.findChessboardCornersSBWithMeta(grey, least, cv2.CALIB_CB_LARGER | flag)
        if found:
            lattice = _upright(corners.reshape(*meta.shape, 2).astype(float))
            board = Board("chessboard", lattice, _unit_places(*lattice.shape[:2]))
            if np.sqrt(np.mean((plane_lattice(board) - lattice) ** 2)) < MAX_UNEVEN * board.step_px:
                return board
    return None


def find_aprilgrid(grey: Grey) -> Board | None:
    """Find an AprilGrid's tag corners; its number of columns follows from where the numbers lie."""
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11))
    quads, numbers, _ = detector.detectMarkers(grey)
    if numbers is None or len(numbers) < MIN_TAGS:
        return None
    tags, number = np.array([q[0] for q in quads], float), numbers.ravel().astype(int)
    tags, number = tags[np.argsort(number)], np.sort(number)
    laid = _grid_columns(tags.mean(axis=1), number)
    if laid is None or len(np.unique(number)) < len(number):
        return None
    columns, picture_from_grid = laid
    grid_from_picture: Array = np.linalg.inv(picture_from_grid).astype(float)
    rough = _tag_lattice(tags, number, columns, grid_from_picture)
    side = float(np.median(np.linalg.norm(tags - np.roll(tags, 1, axis=1), axis=-1)))
    lattice = _refined(grey, rough, int(np.clip(side / TAG_CELLS - 0.5, MIN_WINDOW_PX, MAX_WINDOW_PX)))
    both = _upright(np.concatenate([lattice, _tag_places(lattice, grid_from_picture)], axis=-1))
    return Board("aprilgrid", both[..., :2], both[..., 2:], numbered=True)


def matched(board: Board | None, truth: Board) -> Array:
    """A board's corners at the truth's lattice places, (rows, columns, 2) of the truth; NaN where there are none.

    Unnumbered boards are laid over each other where the median corner moves least, by less than half a field.
    """
    result = np.full_like(truth.points_px, np.nan)
    if board is None or board.kind != truth.kind:
        return result
    if board.numbered:
        return _at_places(board, truth)
    rows, columns = result.shape[:2]
    height, width = board.points_px.shape[:2]
    offsets = [(i, j) for i in range(1 - height, rows) for j in range(1 - width, columns)]
    laid = [_laid(board.points_px, result, *offset) for offset in offsets]
    moved = [np.nanmedian(np.linalg.norm(points - truth.points_px, axis=-1)) for points in laid]
    best = int(np.argmin(moved))
    return laid[best] if moved[best] < 0.5 * truth.step_px else result


def plane_lattice(board: Board, lens: Intrinsics | None = None) -> Array:
    """Where corners of a flat board belong, by the homography that fits the found ones best, through the lens if given.

    Half a dozen or more corners; the least-squares fit leaves what the detector errs.
    """
    known = np.isfinite(board.points_px).all(-1)
    if lens is None or not lens.is_distorted:
        homography, _ = cv2.findHomography(board.places[known], board.points_px[known], 0)
        return cv2.perspectiveTransform(board.places.reshape(1, -1, 2), homography).reshape(board.points_px.shape)
    rays = lens.rays(board.points_px[known])
    homography, _ = cv2.findHomography(board.places[known], rays[:, :2] / rays[:, 2:], 0)
    flat = cv2.perspectiveTransform(board.places.reshape(1, -1, 2), homography)[0]
    return lens.project(np.column_stack([flat, np.ones(len(flat))])).reshape(board.points_px.shape)


def _refined(grey: Grey, lattice: Array, window_px: int) -> Array:
    """Saddles to parts of a pixel (Förstner); corners whose window leaves the picture are dropped."""
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
    """The lattice turned so that columns run to the right and rows down; the first two values are pixels."""
    across, down = (np.nanmean(np.diff(lattice[..., :2], axis=axis), axis=(0, 1)) for axis in (1, 0))
    if abs(across[0]) < abs(down[0]):
        lattice, across, down = lattice.swapaxes(0, 1), down, across
    return lattice[:: 1 if down[1] > 0 else -1, :: 1 if across[0] > 0 else -1]


def _unit_places(rows: int, columns: int) -> Array:
    return np.stack(np.meshgrid(np.arange(columns, dtype=float), np.arange(rows, dtype=float)), axis=-1)


def _grid_columns(centres_px: Array, number: NDArray[np.intp]) -> tuple[int, Array] | None:
    """How many columns of tags make the numbers, row by row, a plane's picture; and picture from grid (3, 3)."""
    best: tuple[float, int, Array] | None = None
    for columns in range(2, MAX_GRID_COLUMNS + 1):
        grid = np.stack([number % columns, number // columns], axis=-1).astype(float)
        if len(np.unique(grid[:, 0])) < 2 or len(np.unique(grid[:, 1])) < 2:
            continue
        homography, _ = cv2.findHomography(grid, centres_px, 0)
        if homography is None:
            continue
        shown = cv2.perspectiveTransform(grid[None], homography)[0]
        error = float(np.sqrt(np.mean((shown - centres_px) ** 2)))
        if best is None or error < best[0]:
            best = error, columns, homography
    side = float(np.median(np.linalg.norm(np.diff(centres_px, axis=0), axis=-1)))
    return None if best is None or best[0] > 0.2 * side else best[1:]


def _tag_lattice(tags: Array, number: NDArray[np.intp], columns: int, grid_from_picture: Array) -> Array:
    """Corners of tags (n, 4, 2) as a lattice (2 rows, 2 columns, 2), each by the side of its tag's middle it is on."""
    flat = cv2.perspectiveTransform(tags.reshape(1, -1, 2), grid_from_picture).reshape(tags.shape)
    grid = np.stack([number % columns, number // columns], axis=-1)
    away = flat - grid[:, None]
    rows = int(grid[:, 1].max()) + 1
    lattice = np.full((2 * rows, 2 * columns, 2), np.nan)
    row, column = (2 * grid[:, None, k] + (away[..., k] > 0) for k in (1, 0))
    lattice[row, column] = tags
    return lattice


def _tag_places(lattice: Array, grid_from_picture: Array) -> Array:
    """Where a lattice's corners lie on the board, in units of the tags' distance; half a tag's side is measured."""
    flat = cv2.perspectiveTransform(np.nan_to_num(lattice).reshape(1, -1, 2), grid_from_picture).reshape(lattice.shape)
    known = np.isfinite(lattice).all(-1)
    rows, columns = lattice.shape[0] // 2, lattice.shape[1] // 2
    middles = np.repeat(np.repeat(_unit_places(rows, columns), 2, axis=0), 2, axis=1)
    half = float(np.median(np.abs(flat - middles)[known]))
    x, y = (np.repeat(np.arange(n), 2) + np.tile([-half, half], n) for n in (columns, rows))
    return np.stack(np.meshgrid(x, y), axis=-1)


def _at_places(board: Board, truth: Board) -> Array:
    """A numbered board's corners at the truth's places."""
    result = np.full_like(truth.points_px, np.nan)
    step = np.linalg.norm(board.places[:, :, None, None] - truth.places[None, None], axis=-1)
    nearest = step.reshape(*step.shape[:2], -1).argmin(-1)
    close = step.reshape(*step.shape[:2], -1).min(-1) < 0.1
    result.reshape(-1, 2)[nearest[close]] = board.points_px[close]
    return result


def _laid(points: Array, empty: Array, row: int, column: int) -> Array:
    """The points laid into an empty lattice, their first one at a row and column; what falls beside it is lost."""
    result = empty.copy()
    rows, columns = empty.shape[:2]
    height, width = points.shape[:2]
    into = slice(max(row, 0), min(row + height, rows)), slice(max(column, 0), min(column + width, columns))
    result[into] = points[into[0].start - row : into[0].stop - row, into[1].start - column : into[1].stop - column]
    return result
