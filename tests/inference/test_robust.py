"""Robust weights and deviations, and averages of held-out points."""

from __future__ import annotations

import numpy as np
import pytest

from virest.inference.chance import beyond_noise, chance_of, t_ratio
from virest.inference.hold_out import group_means, loss
from virest.inference.robust import CAUCHY, cauchy_weight, robust_std


def test_a_tenth_of_outliers_hardly_widens_a_robust_deviation(rng: np.random.Generator) -> None:
    """For normal values it is their deviation; for no values it is 0."""
    values = rng.normal(0, 2.0, 20_000)
    assert robust_std(values) == pytest.approx(2.0, rel=0.03)
    values[:2000] = 1e3
    assert robust_std(values) < 2.5
    assert robust_std(np.zeros(0)) == 0


def test_weights_fall_to_a_half_at_their_width() -> None:
    """They are the derivative of the loss: weight = d loss / d r², times the squared width."""
    assert cauchy_weight(np.array([0.0, 4.0, 400.0]), 2.0) == pytest.approx([1.0, 0.5, 1 / 101])
    squared, scale, step = np.array([0.3, 2.0, 50.0]), 1.7, 1e-6
    slope = (loss(np.sqrt(squared + step), scale) - loss(np.sqrt(squared), scale)) / step
    assert slope * (CAUCHY * scale) ** 2 == pytest.approx(cauchy_weight(squared, CAUCHY * scale), rel=1e-4)


def test_an_even_gain_is_significant_with_at_least_three_blocks() -> None:
    """Means by group count each point once; a group without points is 0."""
    assert group_means(np.array([1.0, 3.0, 5.0]), np.array([0, 0, 2])).tolist() == [2.0, 0.0, 5.0]
    assert t_ratio(np.array([1.0, 1.1])) == 0
    assert chance_of(np.array([1.0, 1.1])) == 0.5
    assert chance_of(np.array([1.0, 1.1, 0.9, 1.0])) < 1e-3 < chance_of(np.array([1.0, -1.1, 0.9, 0.0]))


def test_a_gain_in_few_blocks_exceeds_the_scatter_of_the_others(rng: np.random.Generator) -> None:
    """By the scatter of all blocks, 3 of 30 reach no t of 2 for any gain; without a gain both measures agree."""
    gain = rng.normal(0, 1, 30)
    gain[:3] += 40
    assert t_ratio(gain) < 2
    assert beyond_noise(gain) > 10
    nothing = np.array([beyond_noise(rng.normal(0, 1, 30)) for _ in range(2000)])
    assert 0.9 < nothing.std() < 1.25
    assert np.mean(nothing > 3) < 0.01
