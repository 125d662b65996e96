"""Colours of plain surfaces: what a coder leaves there is neither amplified nor taken for detail."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from virest.camera.response import ResponseCurve
from virest.image_formation.kernels import KernelField
from virest.restoration.blurred import blurred_picture
from virest.restoration.deblur import deblur
from virest.restoration.settings import PRESETS
from virest.restoration.statistics.records import PictureStatistics, PlaceStatistics
from virest.restoration.statistics.rings import RINGS, SIDE

LENGTH_PX = 1.5
"""So short that the light is not corrected along the paths afterwards."""


def _field(centres_px: NDArray[np.float64]) -> KernelField:
    along = LENGTH_PX * np.linspace(-0.5, 0.5, 31) * np.ones((len(centres_px), 1))
    return KernelField(centres_px, np.stack([along, 0 * along], -1), 0.5)


def _statistics(unevenness: float) -> tuple[PictureStatistics, PictureStatistics]:
    """Of luma and colour of a picture that is mostly ground, whose colours vary by 5 grey levels."""
    frequency = (np.arange(RINGS) + 0.5) / (2 * RINGS)
    even = np.ones((SIDE, SIDE // 2 - 1), np.float32)
    places = PlaceStatistics(unevenness, even, even) if unevenness else None
    luma = PictureStatistics(frequency, 0.05 * frequency**-3.0, np.full(RINGS, 0.3), np.ones(RINGS), 0.6)
    chroma = PictureStatistics(
        frequency, 0.01 * frequency**-3.0, np.full(RINGS, 0.1), np.ones(RINGS), 0.3, places=places, signal_variance=25.0
    )
    return luma, chroma


@pytest.mark.parametrize("unevenness", [0.0, 0.4])
@pytest.mark.parametrize("preset", ["fast", "balanced"])
def test_a_plain_sky_keeps_its_colour(preset: str, unevenness: float, rng: np.random.Generator) -> None:
    """A sky coded in patches of one grey level of luma and Cb has no stronger patches after deblurring."""
    patches = cv2.GaussianBlur(rng.normal(size=(240, 320)), (0, 0), 12)
    brighter = np.digitize(patches, np.quantile(patches, [0.2, 0.8])).astype(np.float32)
    stored = cv2.merge([185 + brighter, np.full_like(brighter, 115), 141 - brighter])
    picture = np.round(cv2.cvtColor(stored / 255, cv2.COLOR_YCrCb2RGB) * 255).astype(np.uint8)
    blurred = blurred_picture(picture, ResponseCurve("srgb"), _statistics(unevenness), _field, LENGTH_PX)
    sharp = deblur(blurred, PRESETS[preset])(slice(0, 240))
    inside = np.s_[30:-30, 30:-30]
    np.testing.assert_array_less(sharp[inside].std((0, 1)), 1.1 * picture[inside].std((0, 1)) + 0.1)
    np.testing.assert_allclose(sharp[inside].mean((0, 1)), picture[inside].mean((0, 1)), atol=0.5)
