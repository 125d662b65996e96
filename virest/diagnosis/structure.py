"""Test whether residuals have structure along a covariate once no named cause gains any more.

Residuals are averaged in bins of each covariate.  A mean that the scatter between time blocks does not explain is
structure: the model is wrong in a way that no cause names.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from virest.arrays import Array, Index
from virest.inference.chance import chi2_tail, normal_deviate, student_tail

STRUCTURE_NOISES = 0.4
"""Points of one frame share errors of tracking, which grow with the blur: up to a third of the noise, rms, in captures
of 20 ms exposures without any effect.  Structure in single frames must exceed this fraction of the noise."""
BINS = 10
"""Bins of a covariate, with equally many residuals."""
LEAST_IN_CELL = 4
"""Minimum number of residuals for a mean of one bin in one time block."""


@dataclass(frozen=True, slots=True)
class Structure:
    """Structure of the residuals along one covariate."""

    along: str
    size: float
    """Rms of the bin means in excess of their scatter, in the residuals' unit."""
    p_value: float
    """For the hypothesis of no structure, given the scatter between time blocks."""


def structures(
    values: Array, weight: Array, covariates: dict[str, Array], block: Index, floor: float
) -> list[Structure]:
    """Test each covariate (n,), none of them time, which the blocks divide; strongest structure first.

    values: (n, k) residuals; weight: (n,); block: (n,) number of the time block.  floor: means this small, in the
    residuals' unit, are bias of the tracker or the codec.
    """
    found = [_along(name, values, weight, c, block, floor) for name, c in covariates.items()]
    return sorted(found, key=lambda s: -s.size)


def _along(name: str, values: Array, weight: Array, covariate: Array, block: Index, floor: float) -> Structure:
    edges = np.unique(np.quantile(covariate, np.linspace(0, 1, BINS + 1)[1:-1]))
    number = np.searchsorted(edges, covariate, side="right")
    excess, chi2, freedom, bins = 0.0, 0.0, 0, 0
    for b in range(len(edges) + 1):
        inside = number == b
        for column in values.T:
            mean, error, count = _mean_of_blocks(column[inside], weight[inside], block[inside])
            if count < 2:
                continue
            spread = error**2 + floor**2
            excess += max(mean**2 - spread, 0.0)
            tail = student_tail(abs(mean) / np.sqrt(spread), count - 1)
            chi2 += normal_deviate(max(tail, 1e-300)) ** 2
            freedom, bins = freedom + 1, bins + 1
    if not freedom:
        return Structure(name, 0.0, 1.0)
    return Structure(name, float(np.sqrt(excess / bins)), chi2_tail(chi2, freedom))


def _mean_of_blocks(values: Array, weight: Array, block: Index) -> tuple[float, float, int]:
    """(weighted mean, its standard error from the scatter between blocks, number of blocks)."""
    if not len(values):
        return 0.0, 0.0, 0
    count = np.bincount(block)
    total = np.bincount(block, weight)
    usable = (count >= LEAST_IN_CELL) & (total > 0)
    means = np.bincount(block, weight * values)[usable] / total[usable]
    if len(means) < 2:
        return 0.0, 0.0, len(means)
    share = total[usable] / total[usable].sum()
    mean = float(share @ means)
    error = np.sqrt(np.sum(share**2 * (means - mean) ** 2) * len(means) / (len(means) - 1))
    return mean, float(error), len(means)
