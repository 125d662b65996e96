"""From light to grey levels, in the contract's order: defocus, vignetting, gain, curve, gamma, black level, noise.

The response curve is implemented here a second time, from equations 21 and 22 of the paper, so that the simulator is
independent of restoration.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile
from virest.camera.response import ResponseCurve

Image = NDArray[Any]


def sensor_light(light: Image, profile: CameraProfile, slot_gain: float, *, defocus: bool) -> Image:
    """Light at the response curve's input (h, w, 3): defocus (if requested), vignetting, gain fields, slot gain."""
    ext = profile.extensions
    if defocus and ext.defocus_sigma_px:
        light = cv2.GaussianBlur(light, (0, 0), ext.defocus_sigma_px, borderType=cv2.BORDER_REFLECT)
    if ext.vignetting_corner_loss:
        light = light * _vignetting(profile.width, profile.height, ext.vignetting_corner_loss)
    for field in ext.field:
        if field.kind == "gain":
            x, y = np.arange(profile.width)[None, :], np.arange(profile.height)[:, None]
            light = light * (1 + field.at(x, y)).astype(np.float32)
    return light if slot_gain == 1.0 else light * np.float32(slot_gain)


def grey_of_light(light: Image, curve: ResponseCurve) -> Image:
    """Grey in [0, 1]: black + (1 − black) · curve(light)^gamma."""
    grey = _plain_curve(np.maximum(light, 0.0), curve)
    if curve.extra_gamma != 1.0:
        grey = grey**curve.extra_gamma
    return (curve.black_level + (1 - curve.black_level) * grey).astype(np.float32)


def eight_bit(grey: Image, noise_levels: float, rng: np.random.Generator | None) -> NDArray[np.uint8]:
    """Grey levels rounded to 0–255, with Gaussian noise of standard deviation ``noise_levels`` (none without rng)."""
    return round_levels(noisy_levels(grey, noise_levels, rng))


def noisy_levels(grey: Image, noise_levels: float, rng: np.random.Generator | None) -> Image:
    """Grey levels with Gaussian noise (none without rng), neither clipped nor rounded."""
    levels = 255.0 * grey
    if rng is not None and noise_levels > 0:
        levels = levels + np.float32(noise_levels) * rng.standard_normal(levels.shape, dtype=np.float32)
    return levels


def round_levels(levels: Image) -> NDArray[np.uint8]:
    """Round and clip to grey levels 0–255."""
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def _vignetting(width: int, height: int, corner_loss: float) -> Image:
    x = np.arange(width) - (width - 1) / 2
    y = np.arange(height) - (height - 1) / 2
    corner_squared = (width**2 + height**2) / 4
    return (1 - corner_loss * (x[None, :] ** 2 + y[:, None] ** 2) / corner_squared)[..., None].astype(np.float32)


def _plain_curve(light: Image, curve: ResponseCurve) -> Image:
    if curve.kind == "five_segment":
        return _five_segments(light, curve.b, curve.c, curve.y_max)
    if curve.kind == "table":
        return np.interp(light, curve.x, curve.y)
    light = np.minimum(light, 1.0)
    if curve.kind == "gamma":
        return light ** (1 / curve.gamma)
    if curve.kind == "srgb":
        return np.where(light > 0.0031308, 1.055 * np.power(light, 1 / 2.4) - 0.055, light * 12.92)
    return light


def _five_segments(light: Image, b: tuple[float, float], c: tuple[float, float], top: float) -> Image:
    """Zero, toe, line, shoulder, top; the toe and shoulder parabolas meet the line with matching slope."""
    slope = (c[1] - b[1]) / (c[0] - b[0])
    foot, head = b[0] - 2 * b[1] / slope, c[0] + 2 * (top - c[1]) / slope
    grey = b[1] + slope * (light - b[0])
    toe, shoulder = light < b[0], light > c[0]
    if b[1] > 0:
        grey[toe] = b[1] * ((np.maximum(light[toe], foot) - foot) / (b[0] - foot)) ** 2
    else:
        grey[toe] = 0.0
    if top > c[1]:
        grey[shoulder] = top - (top - c[1]) * ((head - np.minimum(light[shoulder], head)) / (head - c[0])) ** 2
    else:
        grey[shoulder] = top
    return grey
