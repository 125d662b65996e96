"""Small fits within the searches: sines with unequal weights, growth beside a shift, missing causes."""

from __future__ import annotations

import numpy as np
import pytest

from virest.diagnosis.field.sudden import _growth, _moderated
from virest.diagnosis.photometry_effects import _sines
from virest.diagnosis.refit_photometry import _exposure_variance
from virest.inference.chance import student_tail


def test_a_sine_with_unequal_weights_is_found_with_its_phase(rng: np.random.Generator) -> None:
    """Patches have individual levels and few, crowded instants, so sine and cosine are not orthogonal."""
    patch = np.repeat(np.arange(40), 12)
    time_s = rng.uniform(0, 0.013, patch.size)
    stiffness = rng.uniform(0.1, 10.0, patch.size)
    level = rng.normal(0, 0.3, 40)[patch]
    frequency = np.arange(90.0, 110.0, 2.0)
    angle = 2 * np.pi * 100.0 * time_s
    values = level + 0.2 * np.sin(angle) - 0.1 * np.cos(angle)
    fit, power = _sines(patch, values, stiffness, time_s, np.zeros(patch.size), frequency)
    assert frequency[np.argmax(power)] == 100.0
    np.testing.assert_allclose(fit[5], (0.2, -0.1), atol=1e-6)


@pytest.mark.parametrize("growth", [0.02, -0.01])
def test_growth_is_separated_from_a_shift_and_outliers(rng: np.random.Generator, growth: float) -> None:
    """A tenth of the points are outliers."""
    arm = rng.uniform(-300, 300, (200, 2))
    off = growth * arm + (3.0, -2.0) + rng.normal(0, 0.1, arm.shape)
    off[:20] += rng.normal(0, 30, (20, 2))
    found, scale_px, per_px, _ = _growth(arm, off)
    std = scale_px * per_px
    assert found == pytest.approx(growth, abs=2e-4)
    assert std == pytest.approx(0.1 / np.sqrt((arm[20:] ** 2).sum()), rel=0.3)
    assert abs(found - growth) < 3 * std


def test_the_growth_of_few_points_is_not_overrated(rng: np.random.Generator) -> None:
    """Eight points determine their own accuracy badly: 1 % of their growths lie beyond 1 % of the distribution."""
    rare = 0
    for _ in range(1000):
        found, scale_px, per_px, freedom = _growth(rng.uniform(-300, 300, (8, 2)), rng.normal(0, 0.2, (8, 2)))
        rare += student_tail(abs(found) / (scale_px * per_px), freedom) < 0.005
    assert rare <= 20


def test_points_in_one_place_show_no_growth(rng: np.random.Generator) -> None:
    """They determine the shift alone."""
    found, scale_px, per_px, _ = _growth(np.full((8, 2), 100.0), rng.normal(0, 0.2, (8, 2)))
    assert abs(found) < scale_px * per_px


@pytest.mark.parametrize(("spread", "degrees"), [(0.0, (30, np.inf)), (0.7, (1, 4))])
def test_scales_support_each_other_as_far_as_they_agree(rng: np.random.Generator, spread: float, degrees) -> None:
    """Equal scales are averaged; scales that differ by factors of 2 keep their own values."""
    freedom = np.full(60, 6.0)
    true = np.exp(rng.normal(0, spread, 60))
    own = true * np.sqrt(rng.chisquare(freedom) / freedom)
    found, total = _moderated(own, freedom)
    assert degrees[0] < total[0] - 6 <= degrees[1]
    assert np.std(np.log(found / true)) < np.std(np.log(own / true))


def test_without_an_exposure_cause_there_is_no_exposure_variance() -> None:
    """An empty list of findings adds no variance."""
    assert _exposure_variance([]) == 0.0
