"""Brackets with known truth: a scene of soft patches over many brightnesses, taken at several exposures."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.calibration.bracket_samples import BracketPicture
from virest.camera.response import ResponseCurve

FIVE = ResponseCurve("five_segment", b=(0.12, 0.08), c=(0.62, 0.80), y_max=1.0)
FIVE_LOW_TOP = ResponseCurve("five_segment", b=(0.2, 0.1), c=(0.5, 0.6), y_max=0.93)
GAMMA = ResponseCurve("gamma", gamma=2.2)
GAMMA_WEAK = ResponseCurve("gamma", gamma=1.7)
SRGB = ResponseCurve("srgb")
LINEAR = ResponseCurve("linear")


def make_scene(width: int, height: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Light (h, w, 3) over some 5 EV: patches of many sizes, a slope, a little colour; its median is about 0.18."""
    log_light = np.zeros((height, width, 3), np.float32)
    for cells, size in ((7, 1.0), (23, 0.8), (60, 0.3)):
        shape = (max(cells * height // width, 2), cells)
        patch = size * rng.standard_normal((*shape, 1)) + 0.25 * size * rng.standard_normal((*shape, 3))
        log_light += cv2.resize(patch.astype(np.float32), (width, height), interpolation=cv2.INTER_NEAREST)
    log_light += np.linspace(-0.8, 0.7, width, dtype=np.float32)[None, :, None]
    log_light = cv2.GaussianBlur(log_light, (0, 0), 0.8)
    return 0.18 * np.exp(log_light - np.median(log_light))


def take(light: NDArray[np.float32], exposure: float, curve: ResponseCurve, rng: np.random.Generator,
         noise: float = 1.5) -> NDArray[np.uint8]:  # fmt: skip
    """One picture, 8 bit."""
    levels = 255 * curve.encode(light * np.float32(exposure))
    levels = levels + noise * rng.standard_normal(levels.shape, dtype=np.float32)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def make_bracket(curve: ResponseCurve, rng: np.random.Generator, *, width: int = 420, height: int = 310,
                 count: int = 8, span_ev: float = 6.0, noise: float = 1.5) -> list[BracketPicture]:  # fmt: skip
    """``count`` pictures over ``span_ev``, listed as they were taken, in seconds about 1/60."""
    light = make_scene(width, height, rng)
    factors = 2.0 ** np.linspace(-span_ev / 2, span_ev / 2, count)
    return [BracketPicture(f"{i:02d}.png", take(light, f, curve, rng, noise), float(f / 60))
            for i, f in enumerate(factors)]  # fmt: skip
