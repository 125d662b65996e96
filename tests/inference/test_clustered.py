"""Correlated errors: deviations are right for groups with common errors, and time blocks count each error once."""

from __future__ import annotations

import numpy as np

from virest.inference.clustered import adjusted_sums, raised, scatter
from virest.inference.time_blocks import even_blocks, halves, varied_blocks


def test_the_deviation_of_a_mean_includes_common_errors_of_groups() -> None:
    """Twenty groups of ten with half of the variance in common have 2.3 times the deviation of independent values."""
    rng = np.random.default_rng(5)
    group = np.repeat(np.arange(20), 10)
    drawn = rng.normal(size=(400, 20))[:, group] + rng.normal(size=(400, 200))
    means = drawn.mean(axis=1)
    told = [float(np.sqrt(scatter((x - x.mean())[:, None] / 200, group)[0, 0])) for x in drawn]
    assert abs(np.mean(told) / means.std() - 1) < 0.1
    alone = drawn.std() / np.sqrt(200)
    assert np.mean(told) > 2 * alone


def test_scatter_about_the_mean_excludes_a_common_part() -> None:
    """Groups with equal contributions have no scatter about their mean."""
    pull = np.ones((12, 2)) * (1.0, -2.0)
    group = np.repeat(np.arange(4), 3)
    np.testing.assert_allclose(scatter(pull, group, about_mean=True), 0.0, atol=1e-12)
    assert scatter(pull, group)[0, 0] > 1


def test_variances_are_raised_to_a_minimum_and_correlations_kept() -> None:
    """A stack of matrices is handled like each matrix, and negative variances rise to the minimum."""
    small = np.array([[1.0, 0.5], [0.5, 4.0]])
    least = np.diag([4.0, 1.0])
    np.testing.assert_allclose(raised(small, least), [[4.0, 1.0], [1.0, 4.0]])
    both = raised(np.stack([small, -small]), np.stack([least, least]))
    np.testing.assert_allclose(both[0], raised(small, least))
    np.testing.assert_allclose(both[1], least)


def test_blocks_are_contiguous_and_halves_are_disjoint() -> None:
    """Even blocks hold about equal counts; varied blocks have the given lengths."""
    assert even_blocks(np.arange(10), 10, 4).tolist() == [0, 0, 0, 1, 1, 2, 2, 2, 3, 3]
    block = varied_blocks(np.arange(12), (3, 5, 2))
    assert np.bincount(block).tolist() == [3, 5, 2, 2]
    assert varied_blocks(np.array([2.0, 2.1, 2.35, 2.5]), (0.3, 0.2)).tolist() == [0, 0, 1, 2]
    assert not len(varied_blocks(np.zeros(0), (1.0,)))
    first, second = halves(block)
    assert first.sum() == 5
    assert np.array_equal(first, ~second)


def test_a_dominant_group_does_not_reduce_the_variance() -> None:
    """One of six groups holds most of the information on a value; the plain scatter misses much of the variance."""
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
