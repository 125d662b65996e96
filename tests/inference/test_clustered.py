"""Errors that residuals share: deviations hold where groups of them err together, and blocks count each once."""

from __future__ import annotations

import numpy as np

from virest.inference.clustered import adjusted_sums, raised, scatter
from virest.inference.time_blocks import even_blocks, halves, varied_blocks


def test_the_deviation_of_a_mean_holds_where_groups_err_together() -> None:
    """Twenty groups of ten that share half of their variance: 2.3 times the deviation of independent ones."""
    rng = np.random.default_rng(5)
    group = np.repeat(np.arange(20), 10)
    drawn = rng.normal(size=(400, 20))[:, group] + rng.normal(size=(400, 200))
    means = drawn.mean(axis=1)
    told = [float(np.sqrt(scatter((x - x.mean())[:, None] / 200, group)[0, 0])) for x in drawn]
    assert abs(np.mean(told) / means.std() - 1) < 0.1
    alone = drawn.std() / np.sqrt(200)
    assert np.mean(told) > 2 * alone


def test_a_sum_about_its_mean_does_not_see_what_all_groups_share() -> None:
    """Groups that all pull alike scatter by nothing."""
    pull = np.ones((12, 2)) * (1.0, -2.0)
    group = np.repeat(np.arange(4), 3)
    np.testing.assert_allclose(scatter(pull, group, about_mean=True), 0.0, atol=1e-12)
    assert scatter(pull, group)[0, 0] > 1


def test_variances_are_raised_to_the_least_and_correlations_stay() -> None:
    """Also of many matrices at once, and where a difference of sums has no variance."""
    small = np.array([[1.0, 0.5], [0.5, 4.0]])
    least = np.diag([4.0, 1.0])
    np.testing.assert_allclose(raised(small, least), [[4.0, 1.0], [1.0, 4.0]])
    both = raised(np.stack([small, -small]), np.stack([least, least]))
    np.testing.assert_allclose(both[0], raised(small, least))
    np.testing.assert_allclose(both[1], least)


def test_blocks_are_contiguous_and_halves_share_none() -> None:
    """Even ones hold about as many numbers each, varied ones are as long as they say."""
    assert even_blocks(np.arange(10), 10, 4).tolist() == [0, 0, 0, 1, 1, 2, 2, 2, 3, 3]
    block = varied_blocks(np.arange(12), (3, 5, 2))
    assert np.bincount(block).tolist() == [3, 5, 2, 2]
    assert varied_blocks(np.array([2.0, 2.1, 2.35, 2.5]), (0.3, 0.2)).tolist() == [0, 0, 1, 2]
    assert not len(varied_blocks(np.zeros(0), (1.0,)))
    first, second = halves(block)
    assert first.sum() == 5
    assert np.array_equal(first, ~second)


def test_a_group_that_determines_a_value_is_not_the_more_certain_for_it() -> None:
    """One of six groups holds most of the information on a value; the plain scatter misses half of the variance."""
    rng = np.random.default_rng(7)
    group = np.repeat(np.arange(6), 20)
    rows = rng.normal(0, 1, (120, 2)) * np.stack([np.where(group == 2, 6.0, 1.0), np.ones(120)], axis=-1)
    parts = np.stack([rows[group == g].T @ rows[group == g] for g in range(6)])
    inverse = np.linalg.inv(parts.sum(axis=0))
    found = []
    for _ in range(2000):
        noise = rng.normal(0, 1, 120)
        pull = rows * (noise - rows @ (inverse @ rows.T @ noise))[:, None]
        sums = adjusted_sums(pull, parts, group)
        found.append([np.diag(inverse @ s @ inverse) for s in (sums.T @ sums, scatter(pull, group, about_mean=True))])
    adjusted, plain = np.mean(found, axis=0)
    np.testing.assert_allclose(adjusted, np.diag(inverse), rtol=0.1)
    assert plain[0] < 0.6 * inverse[0, 0]
