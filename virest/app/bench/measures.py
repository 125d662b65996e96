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
    """How far the whole picture lies beside its truth, (x, y): the peak of phase correlation."""
    inside = _inside(valid_px, margin_px)
    planes = [cv2.cvtColor(p, cv2.COLOR_RGB2GRAY)[inside].astype(np.float32) for p in (truth, picture)]
    window = cv2.createHanningWindow(planes[0].shape[::-1], cv2.CV_32F)
    return np.array(cv2.phaseCorrelate(planes[0], planes[1], window)[0])


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
