"""Forms of fields, screened on whitened residuals."""

from __future__ import annotations

import numpy as np
import pytest

from virest.diagnosis.field.screening import MAX_P, Design, score_forms

BLOCKS, POINTS, NUMBERS, FORMS = 22, 40, 4, 30


def screened(rng: np.random.Generator, size: float) -> float:
    """p-value of a form that has one parameter hidden with this size; time blocks are unequally informative."""
    block = np.repeat(np.arange(BLOCKS), POINTS)
    strength = np.repeat(rng.uniform(0.3, 1.7, BLOCKS), POINTS)
    effect = rng.normal(size=(len(block), 2, NUMBERS)) * strength[:, None, None]
    left = rng.normal(size=(len(block), 2)) + size * effect[..., 0]
    designs = [Design("hidden", effect, over_time=False)]
    (scored,) = score_forms(left, np.ones(len(block)), np.zeros((len(block), 2, 0)), designs, block, forms_tested=FORMS)
    return scored.p_value


@pytest.mark.parametrize("size", [0.3, 1.0, 10.0])
def test_an_effect_in_all_blocks_is_significant_however_large(rng: np.random.Generator, size: float) -> None:
    """The effect also enlarges the sign-flipped scores."""
    assert screened(rng, size) < MAX_P


def test_noise_alone_is_not_significant(rng: np.random.Generator) -> None:
    """p-values of noise are at least as large as by chance."""
    found = np.array([screened(rng, 0.0) for _ in range(200)])
    assert np.mean(found < 0.1) < 0.1 + 3 * np.sqrt(0.1 * 0.9 / 200)
    assert found.min() > MAX_P / 10
