"""From light to grey levels, against values computed by hand."""

from dataclasses import replace

import numpy as np
import pytest

from virest.camera.profile import Extensions
from virest.camera.response import ResponseCurve
from virest.simulation.sensor import eight_bit, grey_of_light, sensor_light
from virest.simulation.session import nominal_camera

FIVE = ResponseCurve("five_segment", b=(0.2, 0.1), c=(0.6, 0.7), y_max=0.9)


@pytest.mark.parametrize(
    ("light", "grey"),
    [
        (0.05, 0.0),  # below A: slope 1.5, x_a = 0.2 − 2·0.1/1.5 = 0.0667
        (0.2, 0.1),
        (0.4, 0.4),
        (0.6, 0.7),
        (0.1333333, 0.025),  # half way up the toe: a quarter of y_b
        (0.7333333, 0.85),  # half way along the shoulder, x_d = 0.8667: y_d − (y_d − y_c)/4
        (2.0, 0.9),
    ],
)
def test_the_five_segments_pass_through_hand_computed_points(light, grey):
    """The points are A, B, C, D and the middles of toe and shoulder."""
    assert grey_of_light(np.array([light], np.float32), FIVE)[0] == pytest.approx(grey, abs=1e-5)


def test_gamma_and_black_level_apply_after_the_curve():
    """Grey = black + (1 − black) curve^gamma: 0.1 + 0.9 · 0.25² = 0.15625."""
    curve = ResponseCurve("linear", extra_gamma=2.0, black_level=0.1)
    assert grey_of_light(np.array([0.25, 0.0], np.float32), curve) == pytest.approx([0.15625, 0.1], abs=1e-6)


def test_srgb_of_middle_grey():
    """In IEC 61966-2-1, linear 0.18 is 0.4614 and 0.002 is 0.02584."""
    grey = grey_of_light(np.array([0.18, 0.002], np.float32), ResponseCurve("srgb"))
    assert grey == pytest.approx([0.46136, 0.02584], abs=1e-4)


def test_vignetting_grows_from_the_middle_to_the_corner():
    """The factor is 1 − loss (r / r_corner)², with r_corner half the diagonal, times the gain."""
    profile = replace(nominal_camera(40, 60), extensions=Extensions(vignetting_corner_loss=0.4))
    light = sensor_light(np.ones((60, 40, 3), np.float32), profile, 1.5, defocus=True)
    assert light[30, 20] == pytest.approx(1.5, abs=1e-3)
    r2 = (19.5**2 + 29.5**2) / (20**2 + 30**2)
    assert light[0, 0] == pytest.approx(1.5 * (1 - 0.4 * r2), abs=1e-5)


def test_defocus_spreads_a_point_by_its_sigma():
    """The second moment of a point's light is sigma²."""
    profile = replace(nominal_camera(60, 80), extensions=Extensions(defocus_sigma_px=1.7))
    light = np.zeros((80, 60, 3), np.float32)
    light[40, 30] = 1.0
    spread = sensor_light(light, profile, 1.0, defocus=True)[..., 0]
    assert spread.sum() == pytest.approx(1.0, abs=1e-4)
    assert (spread.sum(axis=0) * (np.arange(60) - 30) ** 2).sum() == pytest.approx(1.7**2, rel=0.02)


def test_noise_has_the_given_size_and_no_bias(rng):
    """A grey of 100.5 levels has noise of 2 levels plus rounding."""
    picture = eight_bit(np.full((300, 300, 3), 100.5 / 255, np.float32), 2.0, rng).astype(float)
    assert picture.mean() == pytest.approx(100.5, abs=0.05)
    assert picture.std() == pytest.approx(np.hypot(2.0, np.sqrt(1 / 12)), rel=0.03)
