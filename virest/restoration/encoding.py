"""Encode linear light to the grey levels of a stored picture."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.camera.response import ResponseCurve
from virest.image_formation.blur import Image
from virest.restoration.row_chunks import bands

_STEPS = 65535
"""Table steps in the square root of light, which is nearly as steep as a tone curve, so that steps are about equal."""


def encode_picture(light: list[Image], curve: ResponseCurve) -> NDArray[np.uint8]:
    """Encode the channels' linear light, (height, width) each, to a stored picture (height, width, 3)."""
    table = np.clip(np.rint(_table(curve)), 0, 255).astype(np.uint8)
    pictures = (cv2.merge([plane[rows] for plane in light]) for rows in bands(len(light[0])))
    return np.concatenate([cv2.LUT(_steps(picture, curve), table) for picture in pictures])


def grey_levels(light: Image, curve: ResponseCurve) -> Image:
    """Grey levels, 0 to 255 and not rounded, of light (height, width)."""
    return np.concatenate([cv2.LUT(_steps(light[rows], curve), _table(curve)) for rows in bands(len(light))])


def _steps(light: Image, curve: ResponseCurve) -> NDArray[np.uint16]:
    """Table index of light."""
    low, high = curve.light_range
    if (low, high) != (0.0, 1.0):
        light = cv2.addWeighted(light, 1.0 / (high - low), light, 0.0, -low / (high - low))
    root = cv2.sqrt(cv2.threshold(light, 0.0, 0.0, cv2.THRESH_TOZERO)[1])
    return cv2.addWeighted(root, _STEPS, root, 0.0, 0.0, dtype=cv2.CV_16U)


@lru_cache(maxsize=8)
def _table(curve: ResponseCurve) -> NDArray[np.float32]:
    """Grey level of each step; (_STEPS + 1,)."""
    low, high = curve.light_range
    light = low + (high - low) * np.linspace(0.0, 1.0, _STEPS + 1) ** 2
    return (255.0 * curve.encode(light)).astype(np.float32)
