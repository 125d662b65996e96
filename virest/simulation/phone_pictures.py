"""A phone's pipeline from the sensor's noisy grey to the 8-bit picture that its encoder gets.

Pictures are (h, w, 3) float32 RGB, grey in [0, 1] behind the sensor's curve; the strengths are those of
:class:`~virest.simulation.phone_isp.PhoneIsp`.  Luma and chroma are those of BT.601.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.simulation.phone_isp import PhoneIsp

Image = NDArray[Any]

SPACE_SIGMA_PX, SPACE_WINDOW_PX = 2.0, 9
"""Spatial Gaussian of the bilateral filter, and its window."""
CHROMA_RADIUS_PX = 4
CHROMA_TIMES_LUMA = 2.0
MOTION_BOX_PX = 5
"""Differences in time are judged by their mean over this box."""
STILL_SIGMAS = 3.0
"""A mean difference of this many standard deviations of its noise is motion: half of the history is dropped."""
BASE_OF_LONG_SIDE = 1 / 16
"""Radius of the coarse brightness."""
BASE_REDUCTION = 4
BASE_EDGE = 0.1
"""Contrast, in grey, of the edges that the coarse brightness keeps."""
MIDDLE_GREY, DARKEST = 0.46, 0.02


class PhonePictures:
    """One phone's pipeline; the temporal filter remembers the picture before, so pictures come in their order."""

    def __init__(self, isp: PhoneIsp, noise: float) -> None:
        """noise: standard deviation of the sensor's noise, grey of 1."""
        self._isp, self._noise = isp, noise
        self._before: Image | None = None

    def develop(self, grey: Image) -> Image:
        """Denoise, map the tones, sharpen: grey in [0, 1], not yet rounded."""
        isp = self._isp
        picture = np.clip(grey, 0.0, 1.0).astype(np.float32)
        if isp.temporal_denoise and self._noise:
            if self._before is not None:
                picture = denoise_in_time(picture, self._before, isp.temporal_denoise, self._noise)
            self._before = picture
        if isp.denoise and self._noise:
            picture = denoise_in_space(picture, isp.denoise * self._noise)
        picture = tone_curve(picture, isp.tone)
        if isp.local_tone:
            picture = map_local_tones(picture, isp.local_tone)
        if isp.sharpen:
            picture = sharpen(picture, isp.sharpen, isp.sharpen_radius_px)
        return np.clip(picture, 0.0, 1.0)


def roll_off_highlights(light: Image, share: float) -> Image:
    """Light that bends towards 1 in the top ``share`` of its range: ``k + s (1 − exp(−(l − k)/s))`` above k = 1 − s.

    A film's shoulder, smooth at the knee; light of any height stays below white (Reinhard et al. 2002, "Photographic
    tone reproduction for digital images", doi:10.1145/566654.566575, in its exponential form).
    """
    if not share:
        return light
    knee = np.float32(1 - share)
    over = np.maximum(light - knee, 0.0)
    return np.minimum(light, knee) + np.float32(share) * (1 - np.exp(-over / np.float32(share)))


def tone_curve(grey: Image, strength: float) -> Image:
    """``(1 − s) g + s g² (3 − 2 g)``: contrast up in the middle, down at both ends, black and white kept.

    The S-shaped global curve of camera pipelines (Hasinoff et al. 2016, section 6, step 9; sigmoids as in Braun &
    Fairchild 1999, doi:10.1117/1.482706).
    """
    if not strength:
        return grey
    inside = np.clip(grey, 0.0, 1.0)
    return (1 - strength) * inside + strength * inside * inside * (3 - 2 * inside)


def map_local_tones(grey: Image, strength: float) -> Image:
    """Compress the coarse brightness b about middle grey and keep what is fine: grey × (b / middle)^−strength.

    Base and detail after Durand & Dorsey 2002 (doi:10.1145/566654.566574), the base by a guided filter, which keeps
    edges (He, Sun & Tang 2013, doi:10.1109/TPAMI.2012.213), at a quarter of the size (He & Sun 2015, arXiv:1505.00996).
    """
    luma = cv2.transform(grey, _TO_YCC)[..., 0]
    height, width = luma.shape
    size = (max(width // BASE_REDUCTION, 1), max(height // BASE_REDUCTION, 1))
    small = cv2.resize(luma, size, interpolation=cv2.INTER_AREA)
    radius = max(round(BASE_OF_LONG_SIDE * max(size)), 1)
    slope, level = _guided(small, small, radius, BASE_EDGE**2)
    slope, level = (cv2.resize(part, (width, height), interpolation=cv2.INTER_LINEAR) for part in (slope, level))
    base = np.maximum(slope * luma + level, DARKEST)
    return grey * ((base / MIDDLE_GREY) ** -strength)[..., None].astype(np.float32)


def denoise_in_space(grey: Image, range_sigma: float) -> Image:
    """Luma: a bilateral filter (Tomasi & Manduchi 1998, doi:10.1109/ICCV.1998.710815); chroma: guided by that luma.

    range_sigma: differences of luma well below it are averaged away, well above it kept; chroma takes twice as much,
    for the eye sees its detail less (Hasinoff et al. 2016, section 6, step 7).
    """
    parts = cv2.split(cv2.transform(grey, _TO_YCC))
    luma = cv2.bilateralFilter(parts[0], SPACE_WINDOW_PX, range_sigma, SPACE_SIGMA_PX, borderType=cv2.BORDER_REFLECT)
    planes = [luma]
    for chroma in parts[1:]:
        slope, level = _guided(luma, chroma, CHROMA_RADIUS_PX, (CHROMA_TIMES_LUMA * range_sigma) ** 2)
        planes.append(slope * luma + level)
    return cv2.transform(cv2.merge(planes), _FROM_YCC)


def denoise_in_time(grey: Image, before: Image, share: float, noise: float) -> Image:
    """Recursive and motion-adaptive: ``x + w (y_before − x)``, w = share where nothing moves, 0 where something does.

    Motion is the mean difference of luma over a box against its noise (the switched recursive filter of television;
    Brailean et al. 1995, "Noise reduction filters for dynamic image sequences: a review", doi:10.1109/5.406412).
    """
    difference = cv2.transform(grey - before, _TO_YCC)[..., 0]
    mean = np.abs(cv2.blur(difference, (MOTION_BOX_PX, MOTION_BOX_PX), borderType=cv2.BORDER_REFLECT))
    still_px = noise * np.linalg.norm(_TO_YCC[0]) * np.sqrt(1 + (1 - share) / (1 + share)) / MOTION_BOX_PX
    keep = share * np.exp2(-((mean / (STILL_SIGMAS * still_px)) ** 2))
    return grey + keep[..., None].astype(np.float32) * (before - grey)


def sharpen(grey: Image, amount: float, radius_px: float) -> Image:
    """Unsharp mask on the luma: ``y + amount (y − G ∗ y)``, the same change on all three channels.

    Overshoot beside an edge is in proportion to it (Polesel, Ramponi & Mathews 2000, doi:10.1109/83.826787, the linear
    form); phones sum several Gaussians (Hasinoff et al. 2016, section 6, step 11), of which this is one.
    """
    luma = cv2.transform(grey, _TO_YCC)[..., 0]
    soft = cv2.GaussianBlur(luma, (0, 0), radius_px, borderType=cv2.BORDER_REFLECT)
    return grey + np.float32(amount) * (luma - soft)[..., None]


# ── parts ──────────────────────────────────────────────────────────────────────────────────────────────────────────


_TO_YCC = np.array([[0.299, 0.587, 0.114], [-0.168736, -0.331264, 0.5], [0.5, -0.418688, -0.081312]], np.float32)
_FROM_YCC = np.linalg.inv(_TO_YCC.astype(np.float64)).astype(np.float32)


def _guided(guide: Image, plane: Image, radius_px: int, eps: float) -> tuple[Image, Image]:
    """Guided filter's coefficients: plane ≈ slope · guide + level near each pixel, slopes held down by eps."""

    def mean(values: Image) -> Image:
        return cv2.blur(values, (2 * radius_px + 1,) * 2, borderType=cv2.BORDER_REFLECT)

    mean_guide, mean_plane = mean(guide), mean(plane)
    variance = mean(guide * guide) - mean_guide**2
    slope = (mean(guide * plane) - mean_guide * mean_plane) / (np.maximum(variance, 0.0) + eps)
    return mean(slope), mean(mean_plane - slope * mean_guide)
