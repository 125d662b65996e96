"""Back from light to the grey levels of a stored picture."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.camera.response import ResponseCurve
from virest.image_formation.blur import Image
from virest.restoration.row_chunks import bands

_STEPS = 65535
"""Steps of the root of light in the tables: the root is about as steep as a curve, so all of them are much alike."""


def encode_picture(light: list[Image], curve: ResponseCurve) -> NDArray[np.uint8]:
    """Linear light of the channels (height, width) to a stored picture (height, width, 3)."""
    table = np.clip(np.rint(_table(curve)), 0, 255).astype(np.uint8)
    pictures = (cv2.merge([plane[rows] for plane in light]) for rows in bands(len(light[0])))
    return np.concatenate([cv2.LUT(_steps(picture, curve), table) for picture in pictures])


def grey_levels(light: Image, curve: ResponseCurve) -> Image:
    """Grey levels of light (height, width), of 255 and not rounded."""
    return np.concatenate([cv2.LUT(_steps(light[rows], curve), _table(curve)) for rows in bands(len(light))])


def _steps(light: Image, curve: ResponseCurve) -> NDArray[np.uint16]:
    """Place of light in the table."""
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
