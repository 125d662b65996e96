"""A phone's image pipeline from noisy sensor grey levels to the encoder's input, before 8-bit rounding.

Images are (h, w, 3) float32 RGB, grey in [0, 1] after the response curve.  Strengths are those of
:class:`~virest.simulation.phone_isp.PhoneIsp`.  Luma and chroma follow BT.601.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.capture.pixels import BT601_LUMA
from virest.simulation.phone_isp import PhoneIsp

Image = NDArray[Any]

SPACE_SIGMA_PX, SPACE_WINDOW_PX = 2.0, 9
"""Spatial sigma of the bilateral filter, and its window width."""
CHROMA_TIMES_LUMA = 2.0
"""Colour is smoothed more strongly than luma, by boxes of the whole window: the eye resolves it less."""
MOTION_BOX_PX = 5
"""Width of the box over which frame differences are averaged for motion detection."""
STILL_SIGMAS = 3.0
"""Mean frame difference, in noise standard deviations, at which motion halves the weight of the previous frame."""
BASE_OF_LONG_SIDE = 1 / 16
"""Radius of the guided filter for the base layer, as a fraction of the long side."""
BASE_REDUCTION = 4
"""Downsampling factor of the base layer."""
BASE_EDGE = 0.1
"""Grey-level contrast above which the base layer preserves an edge."""
MIDDLE_GREY, DARKEST = 0.46, 0.02
"""An 18 % grey card in sRGB, which local tone mapping leaves as it is; darker pixels are lifted no further."""


class PhonePictures:
    """A phone's pipeline; frames must come in order, since the temporal filter keeps the previous one."""

    def __init__(self, isp: PhoneIsp, noise: float) -> None:
        """noise: standard deviation of the sensor noise, white = 1."""
        self._isp, self._noise = isp, noise
        self._previous: Image | None = None

    def develop(self, grey: Image) -> Image:
        """Denoise, tone-map and sharpen: grey in [0, 1], not yet rounded."""
        isp = self._isp
        picture = np.clip(grey, 0.0, 1.0).astype(np.float32)
        if isp.temporal_denoise and self._noise:
            if self._previous is not None:
                picture = denoise_in_time(picture, self._previous, isp.temporal_denoise, self._noise)
            self._previous = picture
        if isp.denoise and self._noise:
            picture = denoise_in_space(picture, isp.denoise * self._noise)
        picture = tone_curve(picture, isp.tone)
        if isp.local_tone:
            picture = map_local_tones(picture, isp.local_tone)
        if isp.sharpen:
            picture = sharpen(picture, isp.sharpen, isp.sharpen_radius_px)
        return np.clip(picture, 0.0, 1.0)


def roll_off_highlights(light: Image, share: float) -> Image:
    """Compress the top ``share`` s of the light range towards 1: ``k + s (1 − exp(−(l − k)/s))`` above k = 1 − s.

    A film-like shoulder with a continuous slope at the knee; all light maps below white (Reinhard et al. 2002,
    "Photographic tone reproduction for digital images", doi:10.1145/566654.566575, in its exponential form).
    """
    if not share:
        return light
    knee = np.float32(1 - share)
    over = np.maximum(light - knee, 0.0)
    return np.minimum(light, knee) + np.float32(share) * (1 - np.exp(-over / np.float32(share)))


def tone_curve(grey: Image, strength: float) -> Image:
    """``(1 − s) g + s g² (3 − 2 g)``: more contrast in the mid-tones, less at both ends, black and white fixed.

    The S-shaped global tone curve of camera pipelines (Hasinoff et al. 2016, section 6, step 9; sigmoids as in Braun &
    Fairchild 1999, doi:10.1117/1.482706).
    """
    if not strength:
        return grey
    inside = np.clip(grey, 0.0, 1.0)
    return (1 - strength) * inside + strength * inside * inside * (3 - 2 * inside)


def map_local_tones(grey: Image, strength: float) -> Image:
    """Compress the base layer b about middle grey and keep the detail: grey × (b / middle)^−strength.

    Base and detail after Durand & Dorsey 2002 (doi:10.1145/566654.566574).  The base comes from an edge-preserving
    guided filter (He, Sun & Tang 2013, doi:10.1109/TPAMI.2012.213) at a quarter of the resolution (He & Sun 2015,
    arXiv:1505.00996).
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
    """Bilateral filter on luma (Tomasi & Manduchi 1998, doi:10.1109/ICCV.1998.710815), guided filter on chroma.

    range_sigma: luma differences well below it are averaged, those well above it kept.  Chroma, guided by the filtered
    luma, takes twice the value, since the eye resolves less detail in it (Hasinoff et al. 2016, section 6, step 7).
    """
    parts = cv2.split(cv2.transform(grey, _TO_YCC))
    luma = cv2.bilateralFilter(parts[0], SPACE_WINDOW_PX, range_sigma, SPACE_SIGMA_PX, borderType=cv2.BORDER_REFLECT)
    planes = [luma]
    for chroma in parts[1:]:
        slope, level = _guided(luma, chroma, SPACE_WINDOW_PX // 2, (CHROMA_TIMES_LUMA * range_sigma) ** 2)
        planes.append(slope * luma + level)
    return cv2.transform(cv2.merge(planes), _FROM_YCC)


def denoise_in_time(grey: Image, previous: Image, share: float, noise: float) -> Image:
    """Motion-adaptive recursive filter ``x + w (y_previous − x)``: w = share in static regions, → 0 with motion.

    Motion is judged by the mean luma difference over a box relative to its noise (the switched recursive filter of
    television; Brailean et al. 1995, "Noise reduction filters for dynamic image sequences: a review",
    doi:10.1109/5.406412).
    """
    difference = cv2.transform(grey - previous, _TO_YCC)[..., 0]
    mean = np.abs(cv2.blur(difference, (MOTION_BOX_PX, MOTION_BOX_PX), borderType=cv2.BORDER_REFLECT))
    mean_noise = noise * np.linalg.norm(_TO_YCC[0]) * np.sqrt(1 + (1 - share) / (1 + share)) / MOTION_BOX_PX
    weight = share * np.exp2(-((mean / (STILL_SIGMAS * mean_noise)) ** 2))
    return grey + weight[..., None].astype(np.float32) * (previous - grey)


def sharpen(grey: Image, amount: float, radius_px: float) -> Image:
    """Unsharp mask on luma, ``y + amount (y − G ∗ y)``, with the same change added to all three channels.

    Overshoot is proportional to the edge (linear form of Polesel, Ramponi & Mathews 2000, doi:10.1109/83.826787).
    Phones sum several Gaussians (Hasinoff et al. 2016, section 6, step 11); this uses one.
    """
    luma = cv2.transform(grey, _TO_YCC)[..., 0]
    soft = cv2.GaussianBlur(luma, (0, 0), radius_px, borderType=cv2.BORDER_REFLECT)
    return grey + np.float32(amount) * (luma - soft)[..., None]


# ── parts ──────────────────────────────────────────────────────────────────────────────────────────────────────────


_TO_YCC = np.array([BT601_LUMA, [-0.168736, -0.331264, 0.5], [0.5, -0.418688, -0.081312]], np.float32)
"""Luma and colour differences of JPEG (JFIF 1.02, from BT.601)."""
_FROM_YCC = np.linalg.inv(_TO_YCC.astype(np.float64)).astype(np.float32)


def _guided(guide: Image, plane: Image, radius_px: int, eps: float) -> tuple[Image, Image]:
    """Guided-filter coefficients: plane ≈ slope · guide + level around each pixel, slopes regularised by eps."""

    def mean(values: Image) -> Image:
        return cv2.blur(values, (2 * radius_px + 1,) * 2, borderType=cv2.BORDER_REFLECT)

    mean_guide, mean_plane = mean(guide), mean(plane)
    variance = mean(guide * guide) - mean_guide**2
    slope = (mean(guide * plane) - mean_guide * mean_plane) / (np.maximum(variance, 0.0) + eps)
    return mean(slope), mean(mean_plane - slope * mean_guide)
