"""Feature matches between an image and its truth: what feature matching gains from a restoration.

SIFT (Lowe 2004, doi:10.1023/B:VISI.0000029664.99615.94) with OpenCV's defaults, brute-force L2 matching and Lowe's
ratio test, all on the luma.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Picture
from virest.capture.pixels import luma_of

RATIO = 0.75
"""Of the distances to the best and second-best match; Lowe gives 0.8, OpenCV's tutorials 0.75."""
IN_PLACE_PX = 2.0
"""Tolerance of a correct match, small against the spacing of features."""
METHOD = f"SIFT (OpenCV's defaults), brute force L2, ratio {RATIO:g}; correct: within {IN_PLACE_PX:g} px"


@dataclass(frozen=True, slots=True)
class Matches:
    """Feature matches between two aligned images."""

    good: int
    """Matches that pass the ratio test."""
    in_place: int
    """Those of them that are within IN_PLACE_PX of the correct position."""


def count_matches(picture: Picture, truth: Picture) -> Matches:
    """Match the features of a picture to its truth's; both RGB or grey, of equal size and aligned."""
    (points, descriptors), (true_points, true_descriptors) = (_described(p) for p in (picture, truth))
    if len(points) == 0 or len(true_points) < 2:
        return Matches(0, 0)
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(descriptors, true_descriptors, k=2)
    good = [best for best, second in pairs if best.distance < RATIO * second.distance]
    if not good:
        return Matches(0, 0)
    here, there = points[[m.queryIdx for m in good]], true_points[[m.trainIdx for m in good]]
    apart_px = np.linalg.norm(here - there, axis=-1)
    return Matches(len(good), int((apart_px < IN_PLACE_PX).sum()))


def _described(picture: Picture) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Positions (n, 2) and descriptors (n, 128) of an image's features."""
    detector = cv2.SIFT_create()  # type: ignore[attr-defined]
    points, descriptors = detector.detectAndCompute(luma_of(picture), None)
    if descriptors is None:
        return np.empty((0, 2), np.float32), np.empty((0, 128), np.float32)
    return np.array([p.pt for p in points], np.float32), descriptors
