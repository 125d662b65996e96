"""The noise of tracked steps, measured without any camera model, against noise that was put in."""

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
def test_noise_under_a_hands_motion_is_measured_to_a_tenth(noise_px: float, direction: str) -> None:
    """Turning, readout and the lens are a smooth flow; what is left is the noise put in."""
    setup = replace(HAND, noise_px=noise_px, readout_direction=direction, k1=0.03)
    found = step_noise_px(recorded(setup).pairs)
    assert found.shape == (24,)
    assert np.median(found) == pytest.approx(noise_px, rel=0.1)
    assert (np.abs(found / noise_px - 1) < 0.35).all()


def test_a_walls_parallax_is_no_noise() -> None:
    """Swaying before a tilted wall leaves the measure alone."""
    setup = replace(HAND, sway_m=0.06, plane_per_m=(0.15, -0.1, 0.6))
    assert np.median(step_noise_px(recorded(setup).pairs)) == pytest.approx(0.2, rel=0.1)


def test_each_pair_has_its_own_noise() -> None:
    """Pairs five times noisier are told as such, in their order."""
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


def test_lost_points_raise_the_measure_little() -> None:
    """A seventh of the points tens of pixels off: still within a quarter, and they stand out of the residual."""
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
def test_few_points_take_a_flow_of_lower_order(points: int) -> None:
    """Under a flow that is linear in the place, noise is found on average however few the points, never as nought."""
    rng = np.random.default_rng(9)
    shear = np.array([[1.004, -0.011], [0.006, 0.993]])
    pairs = []
    for k in range(60):
        first = rng.uniform((0, 0), (640, 480), (points, 2))
        pairs.append(TrackPair(k, k + 1, first, first @ shear.T + (4.0, -9.0) + rng.normal(0, 0.3, first.shape)))
    assert np.mean(step_noise_px(pairs)) == pytest.approx(0.3, rel=0.1)


def test_perfect_tracks_have_a_least_noise() -> None:
    """Points that follow a flow exactly are still not trusted without end."""
    first = np.random.default_rng(3).uniform(0, 400, (60, 2))
    assert step_noise_px([TrackPair(0, 1, first, first + np.array([3.0, -2.0]))]) == pytest.approx(0.01)
