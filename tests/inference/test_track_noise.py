"""The noise of tracked points, measured without a camera model, compared with the noise put in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from motion.synthetic_tracks import Setup, recorded

from virest.inference.track_noise import smooth_flow_residual, step_noise_px
from virest.inference.tracking import TrackPair

HAND = Setup(seed=31, frames=25, points=110, noise_px=0.2)


@pytest.mark.parametrize("noise_px", [0.05, 0.2, 0.6])
@pytest.mark.parametrize("direction", ["right_to_left", "bottom_to_top"])
def test_noise_during_hand_motion_is_measured_within_a_tenth(noise_px: float, direction: str) -> None:
    """Rotation, readout and lens give a smooth flow; the rest is noise."""
    setup = replace(HAND, noise_px=noise_px, readout_direction=direction, k1=0.03)
    found = step_noise_px(recorded(setup).pairs)
    assert found.shape == (24,)
    assert np.median(found) == pytest.approx(noise_px, rel=0.1)
    assert (np.abs(found / noise_px - 1) < 0.35).all()


def test_parallax_of_a_wall_is_not_noise() -> None:
    """Sway in front of a tilted wall does not change the measured noise."""
    setup = replace(HAND, sway_m=0.06, plane_per_m=(0.15, -0.1, 0.6))
    assert np.median(step_noise_px(recorded(setup).pairs)) == pytest.approx(0.2, rel=0.1)


def test_each_pair_has_its_own_noise() -> None:
    """Pairs with five times the noise are identified, in their order."""
    rng = np.random.default_rng(7)
    pairs = [
        replace(
            pair, points_second_px=pair.points_second_px + rng.normal(0, 1.0 if k % 3 == 0 else 0.0, (len(pair), 2))
        )
        for k, pair in enumerate(recorded(HAND).pairs)
    ]
    found = step_noise_px(pairs)
    noisy = np.arange(24) % 3 == 0
    assert found[noisy] == pytest.approx(1.02, rel=0.35)
    assert found[~noisy] == pytest.approx(0.2, rel=0.35)


def test_outliers_hardly_raise_the_noise() -> None:
    """With a seventh of the points tens of pixels off, the noise is right within 25 %; the residual shows them."""
    rng = np.random.default_rng(8)
    pairs = []
    for pair in recorded(HAND).pairs:
        lost = rng.random(len(pair)) < 1 / 7
        far = np.where(lost[:, None], rng.uniform(-40, 40, (len(pair), 2)), 0.0)
        pairs.append(replace(pair, points_second_px=pair.points_second_px + far))
    assert np.median(step_noise_px(pairs)) == pytest.approx(0.2, rel=0.25)
    left = np.linalg.norm(smooth_flow_residual(pairs[3]), axis=1)
    steps = np.linalg.norm(pairs[3].points_second_px - recorded(HAND).pairs[3].points_second_px, axis=1)
    np.testing.assert_allclose(left[steps > 10], steps[steps > 10], atol=3.0)


@pytest.mark.parametrize("points", [13, 30, 50])
def test_few_points_use_a_flow_of_lower_order(points: int) -> None:
    """For a linear flow, the noise is right on average for any number of points and never zero."""
    rng = np.random.default_rng(9)
    shear = np.array([[1.004, -0.011], [0.006, 0.993]])
    pairs = []
    for k in range(60):
        first = rng.uniform((0, 0), (640, 480), (points, 2))
        pairs.append(TrackPair(k, k + 1, first, first @ shear.T + (4.0, -9.0) + rng.normal(0, 0.3, first.shape)))
    assert np.mean(step_noise_px(pairs)) == pytest.approx(0.3, rel=0.1)


def test_perfect_tracks_have_a_minimum_noise() -> None:
    """Points that follow a flow exactly are not trusted without limit."""
    first = np.random.default_rng(3).uniform(0, 400, (60, 2))
    assert step_noise_px([TrackPair(0, 1, first, first + np.array([3.0, -2.0]))]) == pytest.approx(0.01)
