"""Fidelity of an image to its truth: MSE, PSNR, SSIM, difference map, point displacement, global shift.

Images are 8-bit, (height, width) or (height, width, channels).  PSNR is always 10 log10(255² / MSE), so a table that
gives both is consistent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Mask, Picture
from virest.capture.pixels import luma_of
from virest.inference.tracking import TrackingSettings, find_corners

MARGIN_PX = 16
"""Excludes pixels that blur mixes with the replicated edge."""
PEAK = 255.0
"""Largest grey level of 8 bits."""
SSIM_SIGMA_PX, SSIM_RADIUS_PX = 1.5, 5
SSIM_K1, SSIM_K2 = 0.01, 0.03
"""The values of Wang et al. 2004."""
TRACKING = TrackingSettings(grid=(16, 16), points_per_cell=4)
"""Up to 1024 corners, spread over the frame."""
WINDOW_PX, LEVELS = 31, 4
"""Window and pyramid of Lucas-Kanade: wide, since the recorded frame is blurred and displaced by tens of pixels."""
MAX_FORWARD_BACKWARD_PX = 0.5
"""A point that does not return to its start was lost."""
SHIFT_SMOOTHING_PX, SHIFT_STEPS = 1.5, 6
"""Smoothing that makes the images nearly linear over a pixel, and Gauss-Newton steps."""


@dataclass(frozen=True, slots=True)
class Fidelity:
    """Fidelity of one image to its truth."""

    mse: float
    """Mean squared error over all pixels and channels, grey levels²."""
    ssim: float
    """Mean structural similarity, at most 1."""

    @property
    def psnr_db(self) -> float:
        """PSNR for this MSE; infinite for identical images."""
        return psnr_of(self.mse)


def fidelity(picture: Picture, truth: Picture) -> Fidelity:
    """Compare two images of equal size, already cropped to the region of interest."""
    return Fidelity(mean_squared_error(picture, truth), structural_similarity(picture, truth))


def mean_squared_error(picture: Picture, truth: Picture) -> float:
    """Mean squared error over all pixels and channels, grey levels²."""
    return float(np.mean((picture.astype(np.float64) - truth.astype(np.float64)) ** 2))


def psnr_of(mse: float) -> float:
    """Peak signal-to-noise ratio in dB for a mean squared error in grey levels²."""
    return float(10 * np.log10(PEAK**2 / mse)) if mse > 0 else float("inf")


def structural_similarity(picture: Picture, truth: Picture) -> float:
    """Mean SSIM over pixels and channels (Wang et al. 2004, doi:10.1109/TIP.2003.819861).

    Means, variances and covariance use an 11 × 11 Gaussian window of σ = 1.5 px.  Pixels whose window leaves the image
    are excluded.
    """
    first, second = (p.reshape(*p.shape[:2], -1).astype(np.float64) for p in (picture, truth))
    near = [_windowed(p) for p in (first, second, first * first, second * second, first * second)]
    mean_1, mean_2, square_1, square_2, product = near
    c1, c2 = (SSIM_K1 * PEAK) ** 2, (SSIM_K2 * PEAK) ** 2
    numerator = (2 * mean_1 * mean_2 + c1) * (2 * (product - mean_1 * mean_2) + c2)
    denominator = (mean_1**2 + mean_2**2 + c1) * (square_1 - mean_1**2 + square_2 - mean_2**2 + c2)
    return float(np.mean(numerator / denominator))


def difference_map(picture: Picture, truth: Picture) -> Picture:
    """|picture − truth| of the luma (height, width); black where they agree (the paper's Figure 19)."""
    return np.asarray(cv2.absdiff(luma_of(picture), luma_of(truth)), np.uint8)


def psnr_db(picture: Picture, truth: Picture, valid_px: Sequence[int], margin_px: int = MARGIN_PX) -> float:
    """PSNR in dB over all channels, inside ``valid_px`` (x0, y0, x1, y1) shrunk by a margin."""
    inside = inner_part(valid_px, margin_px)
    return psnr_of(mean_squared_error(picture[inside], truth[inside]))


def inner_part(valid_px: Sequence[int], margin_px: int = MARGIN_PX) -> tuple[slice, slice]:
    """Row and column slices of a rectangle (x0, y0, x1, y1), end exclusive, shrunk by a margin."""
    x0, y0, x1, y1 = valid_px
    return slice(y0 + margin_px, y1 - margin_px), slice(x0 + margin_px, x1 - margin_px)


def point_distances_px(picture: Picture, truth: Picture, valid_px: Sequence[int]) -> Array:
    """Displacements (n,) of the truth's corners in the picture, by Lucas–Kanade with a forward–backward check."""
    grey_truth, grey = (luma_of(p) for p in (truth, picture))
    points = find_corners(grey_truth, TRACKING)
    found, forward = _follow(grey_truth, grey, points)
    returned, backward = _follow(grey, grey_truth, forward)
    x0, y0, x1, y1 = valid_px
    inside = [(p[:, 0] >= x0) & (p[:, 0] < x1) & (p[:, 1] >= y0) & (p[:, 1] < y1) for p in (points, forward)]
    good = found & returned & inside[0] & inside[1]
    good &= np.linalg.norm(backward - points, axis=-1) < MAX_FORWARD_BACKWARD_PX
    return np.linalg.norm(forward - points, axis=-1)[good].astype(float)


def shift_px(picture: Picture, truth: Picture, valid_px: Sequence[int], margin_px: int = MARGIN_PX) -> Array:
    """Global shift (x, y) of the picture against its truth: least squares on the smoothed images.

    Phase correlation is unsuitable: blur alters the phases that it averages, and its peak jumps by whole pixels.
    """
    inside = inner_part(valid_px, margin_px)
    truth_grey, grey = (_smooth_grey(p) for p in (truth, picture))
    slopes = np.stack([cv2.Sobel(truth_grey, cv2.CV_32F, *d)[inside].ravel() / 8 for d in ((1, 0), (0, 1))], axis=-1)
    square = slopes.T.astype(float) @ slopes.astype(float)
    shift = np.zeros(2)
    for _ in range(SHIFT_STEPS):
        back = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32)
        moved = cv2.warpAffine(grey, back, grey.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        shift -= np.linalg.solve(square, slopes.T.astype(float) @ (moved - truth_grey)[inside].ravel())
    return shift


def _windowed(plane: Array) -> Array:
    side = 2 * SSIM_RADIUS_PX + 1
    near = cv2.GaussianBlur(plane, (side, side), SSIM_SIGMA_PX, borderType=cv2.BORDER_REFLECT)
    return np.asarray(near[SSIM_RADIUS_PX:-SSIM_RADIUS_PX, SSIM_RADIUS_PX:-SSIM_RADIUS_PX])


def _smooth_grey(picture: Picture) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(luma_of(picture).astype(np.float32), (0, 0), SHIFT_SMOOTHING_PX), np.float32)


def _follow(first: Picture, second: Picture, points: NDArray[np.float32]) -> tuple[Mask, NDArray[np.float32]]:
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 0.003)
    moved, status, _ = cv2.calcOpticalFlowPyrLK(  # type: ignore[call-overload]
        first, second, points[:, None], None, winSize=(WINDOW_PX, WINDOW_PX), maxLevel=LEVELS, criteria=criteria
    )
    return status.ravel() == 1, moved[:, 0]
