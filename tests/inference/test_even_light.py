"""Points of frames whose brightness changes between them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from inference.test_tracking import texture, view

from virest.arrays import Picture
from virest.camera.response import ResponseCurve
from virest.inference.even_light import SAME_LEVELS, level_change
from virest.inference.tracking import TrackPair, track_pairs

SHIFT_PX = (7.4, -3.6)
CURVE = ResponseCurve("srgb")


def under(light: float, picture: Picture) -> Picture:
    """A picture that another exposure or gain makes brighter or darker, in linear light."""
    return np.rint(255 * CURVE.encode(np.minimum(light * CURVE.linear_table()[picture], 1.0))).astype(np.uint8)


def tracked(light: float, seed: int = 0) -> TrackPair:
    """Points between a view and a shifted one under another light."""
    scene = (0.6 * texture(700, 800, seed)).astype(np.uint8)
    (pair,) = track_pairs([(0, view(scene, (0, 0))), (1, under(light, view(scene, SHIFT_PX)))])
    return pair


def error_px(pair: TrackPair) -> float:
    """Root mean square of the points' errors."""
    return float(np.sqrt(np.mean((pair.points_second_px - pair.points_first_px - SHIFT_PX) ** 2)))


@pytest.mark.parametrize("light", [0.43, 0.75, 0.93, 1.08, 1.35, 2.3])
def test_a_change_of_light_moves_and_loses_few_points(light: float) -> None:
    """From 7 % to more than a factor of 2; the change itself is measured to 5 %."""
    same, changed = tracked(1.0), tracked(light)
    assert len(changed) > 0.85 * len(same)
    assert error_px(changed) < 1.2 * error_px(same) + 0.02
    assert changed.levels.log_light(CURVE) == pytest.approx(np.log(light), abs=0.05)


def test_pictures_of_equal_light_are_matched_as_they_are() -> None:
    """No level is replaced, and noise and coding are no change of light."""
    scene = texture(700, 800)
    pictures = view(scene, (0, 0)), view(scene, SHIFT_PX)
    first, second = (cv2.add(p, np.random.default_rng(k).normal(0, 3, p.shape).astype(np.int8), dtype=0)
                     for k, p in enumerate(pictures))  # fmt: skip
    (pair,) = track_pairs([(0, first), (1, second)])
    assert pair.levels.is_near(SAME_LEVELS, first)
    assert SAME_LEVELS.evened(first, second) == (first, second)


def test_clipped_pixels_do_not_count() -> None:
    """Half of the picture saturates; the change is that of the other half."""
    first = (20 + 0.4 * texture(360, 480)).astype(np.uint8)
    first[:, :240] += 100
    second = under(2.5, first)
    assert (second == 255).mean() > 0.25
    points = np.stack(np.meshgrid(np.arange(20.0, 470, 12), np.arange(20.0, 350, 12)), axis=-1).reshape(-1, 2)
    assert level_change(first, second, points, points).log_light(CURVE) == pytest.approx(np.log(2.5), abs=0.08)


def test_few_points_leave_the_means() -> None:
    """So frames whose light changes too much for a first match are still tracked."""
    first = texture(360, 480)
    none = np.zeros((0, 2))
    assert level_change(first, first, none, none).slope == pytest.approx(1.0)
    assert level_change(first, under(2.0, first), none, none).slope == pytest.approx(1.35, abs=0.05)
