"""Robust statistics: scatter that outliers do not affect, and weights that suppress them."""

from __future__ import annotations

import numpy as np

from virest.arrays import Array

CAUCHY = 2.4
"""Standard deviations at which the weight is 0.5: 95 % efficient for normal errors (Holland & Welsch 1977,
doi:10.1080/03610927708827533)."""
NORMAL_MEDIAN, RAYLEIGH_MEDIAN = 0.6745, 1.1774
"""Medians of |x| and of √(x² + y²) for normal x and y of unit variance."""
MEDIAN_TO_STD = 1.4826
"""1 / NORMAL_MEDIAN."""


def robust_std(values: Array) -> float:
    """Standard deviation of values about zero, from the median of their magnitudes; 0 without values."""
    return MEDIAN_TO_STD * float(np.median(np.abs(values))) if len(values) else 0.0


def cauchy_weight(squared: Array, width: float | Array) -> Array:
    """Cauchy weights, 0 to 1, of values given by their squares: 0.5 at ``width``."""
    return np.asarray(1.0 / (1.0 + squared / width**2))
