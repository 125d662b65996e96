"""Conversion of light to grey levels."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from virest.camera.response import ResponseCurve
from virest.restoration.encoding import encode_picture, grey_levels

CURVES = {
    "linear": ResponseCurve("linear"),
    "srgb": ResponseCurve("srgb"),
    "gamma": ResponseCurve("gamma", gamma=2.2),
    "five_segment": ResponseCurve("five_segment", b=(0.12, 0.08), c=(0.62, 0.80), y_max=0.93),
    "table": ResponseCurve("table", x=(0.0, 0.02, 0.1, 0.35, 0.7, 1.0), y=(0.0, 0.11, 0.33, 0.66, 0.9, 1.0)),
    "wide table": ResponseCurve("table", x=(0.01, 0.5, 4.0), y=(0.02, 0.6, 0.98)),
    "extended": ResponseCurve("srgb", extra_gamma=1.2, black_level=0.06),
    "extended five_segment": ResponseCurve(
        "five_segment", b=(0.1, 0.1), c=(0.7, 0.9), extra_gamma=0.8, black_level=0.03
    ),
}


@pytest.mark.parametrize("curve", [pytest.param(c, id=n) for n, c in CURVES.items()])
def test_encoding_inverts_the_table_at_every_level(curve: ResponseCurve) -> None:
    """All 256 levels are reproduced through light, limited to the curve's black and top."""
    levels = np.arange(256, dtype=np.uint8).reshape(16, 16)
    picture = np.stack([levels, levels.T, levels[::-1]], -1)
    low, high = np.rint(255 * curve.encode(np.array(curve.light_range)))
    light = list(cv2.split(cv2.LUT(picture, curve.linear_table())))
    np.testing.assert_array_equal(encode_picture(light, curve), np.clip(picture, low, high))


def test_encoding_clips_light_outside_the_curve() -> None:
    """Light below zero or above the maximum becomes black or white, never a wrapped-around level."""
    light = [np.array([[-5.0, -1e-3, 1.001, 40.0]], np.float32)] * 3
    np.testing.assert_array_equal(encode_picture(light, ResponseCurve("srgb"))[..., 0], [[0, 0, 255, 255]])


@pytest.mark.parametrize("curve", [pytest.param(c, id=n) for n, c in CURVES.items()])
def test_grey_levels_are_those_of_the_curve(curve: ResponseCurve) -> None:
    """Light within the curve's range and beyond is encoded within 0.01 levels."""
    low, high = curve.light_range
    light = np.linspace(low, high + 0.2 * (high - low), 70 * 50).reshape(70, 50).astype(np.float32)
    np.testing.assert_allclose(grey_levels(light, curve), 255 * curve.encode(np.clip(light, low, high)), atol=0.01)
