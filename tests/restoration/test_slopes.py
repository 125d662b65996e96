"""The curve's slope where light and dark meet, from the noise of grey levels in light."""

from __future__ import annotations

import numpy as np
import pytest
from blurred_scene import camera

from virest.camera.response import ResponseCurve
from virest.image_formation.kernels import kernel_field
from virest.restoration.blurred import BlurredPicture, blurred_picture
from virest.restoration.statistics.measure import measure_picture

NOISE_LEVELS = 1.5
SIDE_PX = 40


def _blurred(curve: ResponseCurve, grey: np.ndarray) -> BlurredPicture:
    picture = np.repeat(grey[..., None], 3, axis=-1)
    field = kernel_field(camera().motion, np.array([[150.0, 100.0]]))
    return blurred_picture(picture, curve, measure_picture(picture, field, curve), lambda _: field, 8.0)


def _squares(dark: int, bright: int) -> np.ndarray:
    rows, columns = np.indices((203, 311))
    return np.where((rows // 10 + columns // 10) % 2, bright, dark).astype(float)


@pytest.mark.parametrize(("dark", "bright"), [(20, 230), (60, 90), (128, 128)])
def test_noise_over_slopes_is_the_noise_in_light(dark: int, bright: int, rng: np.random.Generator) -> None:
    """Grey levels with a known noise, converted to light, have the noise that their slopes predict."""
    curve, clean = ResponseCurve("srgb"), _squares(dark, bright)
    grey = np.clip(np.rint(clean + rng.normal(0, NOISE_LEVELS, clean.shape)), 0, 255).astype(np.uint8)
    slopes = _blurred(curve, grey).slopes(1, SIDE_PX, (311, 203))
    in_light = (curve.linear_table()[grey] - curve.linearise(clean / 255.0)).std()
    assert slopes.shape == grey.shape
    assert NOISE_LEVELS / slopes[60:-60, 60:-60] == pytest.approx(in_light, rel=0.12)


def test_a_pixel_s_slope_is_that_of_its_level() -> None:
    """In the middle of a square the neighbourhood has only one level."""
    curve, grey = ResponseCurve("srgb"), _squares(30, 200).astype(np.uint8)
    slopes = _blurred(curve, grey).slopes(1, 5, (311, 203))
    for row, column in ((104, 104), (104, 114)):
        assert slopes[row, column] == pytest.approx(curve.slope_table()[grey[row, column]], rel=1e-3)


@pytest.mark.parametrize("level", [0, 255])
def test_censored_levels_have_their_neighbours_slope(level: int) -> None:
    """Below A and above D the curve is flat, and 1 / s² would be nearly infinite."""
    curve = ResponseCurve("five_segment", b=(0.12, 0.08), c=(0.62, 0.80), y_max=0.93)
    slopes = _blurred(curve, np.full((203, 311), level, np.uint8)).slopes(1, SIDE_PX, (311, 203))
    assert np.isfinite(slopes).all()
    assert curve.slope_table()[~curve.censored_table()].min() <= slopes.min() <= slopes.max()
    assert slopes.max() <= curve.slope_table().max()


def test_a_tile_has_one_slope(rng: np.random.Generator) -> None:
    """Noise of bright squares must not be treated as detail of dark ones."""
    grey = np.clip(_squares(20, 230) + rng.normal(0, NOISE_LEVELS, (203, 311)), 0, 255).astype(np.uint8)
    even = _blurred(ResponseCurve("srgb"), grey).slopes(1, 104, (311, 203))
    assert even.max() < 1.1 * even.min()
