"""How close a picture is to its truth: PSNR, where points lie, by how much the whole is shifted."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.motion.tracking import TrackingSettings, find_corners

Picture = NDArray[np.uint8]
Array = NDArray[np.float64]
MARGIN_PX = 16
TRACKING = TrackingSettings(grid=(16, 16), points_per_cell=4)
WINDOW_PX, LEVELS = 31, 4
MAX_FORWARD_BACKWARD_PX = 0.5
SHIFT_SMOOTHING_PX, SHIFT_STEPS = 1.5, 6


def psnr_db(picture: Picture, truth: Picture, valid_px: Sequence[int], margin_px: int = MARGIN_PX) -> float:
    """PSNR in dB over all channels, inside ``valid_px`` (x0, y0, x1, y1) shrunk by a margin."""
    inside = _inside(valid_px, margin_px)
    error = picture[inside].astype(np.float64) - truth[inside].astype(np.float64)
    return float(10 * np.log10(255.0**2 / np.mean(error**2)))


def point_distances_px(picture: Picture, truth: Picture, valid_px: Sequence[int]) -> Array:
    """How far corners of the truth lie from where the picture shows them, (n,): Lucas-Kanade, forwards and back."""
    grey_truth, grey = (np.asarray(cv2.cvtColor(p, cv2.COLOR_RGB2GRAY), np.uint8) for p in (truth, picture))
    points = find_corners(grey_truth, TRACKING)
    found, ahead = _follow(grey_truth, grey, points)
    returned, back = _follow(grey, grey_truth, ahead)
    x0, y0, x1, y1 = valid_px
    inside = [(p[:, 0] >= x0) & (p[:, 0] < x1) & (p[:, 1] >= y0) & (p[:, 1] < y1) for p in (points, ahead)]
    good = found & returned & inside[0] & inside[1]
    good &= np.linalg.norm(back - points, axis=-1) < MAX_FORWARD_BACKWARD_PX
    return np.linalg.norm(ahead - points, axis=-1)[good].astype(float)


def shift_px(picture: Picture, truth: Picture, valid_px: Sequence[int], margin_px: int = MARGIN_PX) -> Array:
    """How far the whole picture lies beside its truth, (x, y): least squares of the smoothed pictures.

    Phase correlation is no help here: blur turns the phases that it averages, and its peak jumps by whole pixels.
    """
    inside = _inside(valid_px, margin_px)
    truth_grey, grey = (_smooth_grey(p) for p in (truth, picture))
    slopes = np.stack([cv2.Sobel(truth_grey, cv2.CV_32F, *d)[inside].ravel() / 8 for d in ((1, 0), (0, 1))], axis=-1)
    square = slopes.T.astype(float) @ slopes.astype(float)
    shift = np.zeros(2)
    for _ in range(SHIFT_STEPS):
        back = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32)
        moved = cv2.warpAffine(grey, back, grey.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        shift -= np.linalg.solve(square, slopes.T.astype(float) @ (moved - truth_grey)[inside].ravel())
    return shift


def _smooth_grey(picture: Picture) -> NDArray[np.float32]:
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), SHIFT_SMOOTHING_PX), np.float32)


def _inside(valid_px: Sequence[int], margin_px: int) -> tuple[slice, slice]:
    x0, y0, x1, y1 = valid_px
    return slice(y0 + margin_px, y1 - margin_px), slice(x0 + margin_px, x1 - margin_px)


def _follow(
    first: NDArray[np.uint8], second: NDArray[np.uint8], points: NDArray[np.float32]
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 0.003)
    moved, status, _ = cv2.calcOpticalFlowPyrLK(  # type: ignore[call-overload]
        first, second, points[:, None], None, winSize=(WINDOW_PX, WINDOW_PX), maxLevel=LEVELS, criteria=criteria
    )
    return status.ravel() == 1, moved[:, 0]
