"""The widest Gaussian blur that a frame's spectrum allows."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from virest.camera.response import ResponseCurve
from virest.inference.spectral_limit import widest_gaussian_px

LENS_SIGMA_PX = 0.7
CURVE = ResponseCurve("srgb")


def frame(
    rng: np.random.Generator, sigma_px: float, noise_levels: float = 1.0, slope: float = 1.0
) -> NDArray[np.uint8]:
    """Texture whose amplitude falls with frequency as f^−slope, blurred in linear light by a lens and a defocus."""
    height, width = 240, 320
    radius = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width))
    spectrum = np.fft.rfft2(rng.normal(size=(height, width))) / np.maximum(radius, 1 / width) ** slope
    texture = np.fft.irfft2(spectrum, (height, width))
    light = 0.25 * np.exp(0.5 * (texture - texture.mean()) / texture.std())
    light = cv2.GaussianBlur(light, (0, 0), float(np.hypot(LENS_SIGMA_PX, sigma_px)))
    grey = 255 * CURVE.encode(light) + rng.normal(0, noise_levels, light.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("slope", [0.7, 1.0, 1.3])
@pytest.mark.parametrize("sigma_px", [1.0, 1.5, 2.0])
def test_the_limit_lies_above_a_blur_and_not_far(rng: np.random.Generator, sigma_px: float, slope: float) -> None:
    """Natural pictures fall with frequency themselves, so the limit is wider than the blur."""
    limit_px = widest_gaussian_px(frame(rng, sigma_px, slope=slope), CURVE)
    assert sigma_px < limit_px < sigma_px + 1.2 or (
        limit_px == np.inf and sigma_px == 2.0
    )  # little is left above noise


def test_a_sharp_frame_allows_little_blur(rng: np.random.Generator) -> None:
    """Less than the smallest defocus that is told, and noise allows any."""
    assert widest_gaussian_px(frame(rng, 0.0), CURVE) < 1.3
    noise = np.clip(rng.normal(120, 20, (240, 320)), 0, 255).astype(np.uint8)
    assert widest_gaussian_px(noise, CURVE) == np.inf
    assert widest_gaussian_px(np.full((48, 40), 90, np.uint8), CURVE) == np.inf
