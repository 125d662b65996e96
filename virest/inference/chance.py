"""Tails of the distributions used in significance tests, from `scipy.special` (`scipy.stats` loads too slowly)."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import special

from virest.arrays import Array
from virest.inference.robust import robust_std


def chi2_tail(value: Any, freedom: Any) -> float:
    """Probability of a larger chi-square."""
    return float(special.chdtrc(freedom, value))


def chi2_median(freedom: int) -> float:
    """Median of a chi-square."""
    return float(special.chdtri(freedom, 0.5))


def chi2_below(probability: float, freedom: int) -> float:
    """Value below which a chi-square lies with this probability."""
    return 2.0 * float(special.gammaincinv(freedom / 2, probability))


def ratio_tail(value: Any, freedom: Any, freedom_below: Any) -> float:
    """Probability of a larger ratio of two mean squares (Fisher's F)."""
    return float(special.fdtrc(freedom, freedom_below, value))


def gamma_tail(value: float, shape: float, scale: float) -> float:
    """Probability of a larger value of a gamma distribution."""
    return float(special.gammaincc(shape, value / scale))


def student_tail(value: Any, freedom: Any) -> float:
    """Probability of a larger Student's t."""
    return float(special.stdtr(freedom, -np.asarray(value, float)))


def student_deviation(freedom: float) -> float:
    """Student's t of the same tail probability as a normal deviate of 1: 1.84 at 1 degree of freedom, 1.11 at 5."""
    return float(special.stdtrit(freedom, special.ndtr(1.0)))


def normal_tail(value: Any) -> float:
    """Probability of a larger normal deviate."""
    return float(special.ndtr(-np.asarray(value, float)))


def normal_deviate(tail: Any) -> float:
    """Normal deviate with this upper tail probability: the inverse of :func:`normal_tail`."""
    return float(-special.ndtri(tail))


def t_ratio(values: Array) -> float:
    """Mean of values (n,) over its standard error; 0 for fewer than three."""
    if len(values) < 3:
        return 0.0
    return float(values.mean() / max(values.std(ddof=1) / np.sqrt(len(values)), 1e-12))


def chance_of(values: Array) -> float:
    """One-sided p value of a t test that the mean of values (n,) is positive; 0.5 for fewer than three."""
    return student_tail(t_ratio(values), max(len(values) - 1, 1))


def chance_of_larger(first: Array, second: Array) -> float:
    """One-sided p value of Student's t test that the first values (n,) have the larger mean than the second (m,).

    The variances are taken to be equal; nan if either is empty.
    """
    freedom = len(first) + len(second) - 2
    if not len(first) or not len(second) or freedom < 1:
        return float("nan")
    squares = sum(float(((values - values.mean()) ** 2).sum()) for values in (first, second))
    error = np.sqrt(squares / freedom * (1 / len(first) + 1 / len(second)))
    return student_tail((first.mean() - second.mean()) / max(error, np.finfo(float).tiny), freedom)


def beyond_noise(gain: Array) -> float:
    """Sum of gains (blocks,) over its standard deviation without any gain, from the robust scatter of the blocks.

    An effect on a few blocks, such as a lens that settles within the first 0.5 s, gains only there.  A t test over all
    blocks would limit m of n gaining blocks to a t of √m, however large their gain.
    """
    noise = robust_std(gain - np.median(gain)) * len(gain) ** 0.5
    return float(gain.sum() / max(noise, np.finfo(float).tiny))
