"""Probabilities from ``scipy.special`` equal those of ``scipy.stats``, which the program does not load."""

import subprocess
import sys

import numpy as np
import pytest
from scipy import stats

from virest.inference import chance


def test_tails_and_quantiles_are_those_of_the_distributions(rng: np.random.Generator) -> None:
    """SciPy gives the same figures, also for a group with a single value."""
    assert chance.chi2_below(0.1, 15) == pytest.approx(stats.chi2.ppf(0.1, 15), rel=1e-12)
    assert chance.gamma_tail(7.0, 1.3, 2.5) == pytest.approx(stats.gamma.sf(7.0, 1.3, scale=2.5), rel=1e-12)
    assert chance.student_tail(2.2, 9) == pytest.approx(stats.t.sf(2.2, 9), rel=1e-12)
    for count in (1, 2, 12):
        first, second = rng.normal(0.5, 1.0, count), rng.normal(0.0, 1.0, 9)
        expected = stats.ttest_ind(first, second, alternative="greater").pvalue
        assert chance.chance_of_larger(first, second) == pytest.approx(expected, rel=1e-9)


def test_an_empty_group_has_no_larger_mean() -> None:
    """The probability is NaN if either group is empty."""
    assert np.isnan(chance.chance_of_larger(np.zeros(0), np.ones(4)))
    assert np.isnan(chance.chance_of_larger(np.ones(4), np.zeros(0)))


def test_no_command_loads_scipy_stats() -> None:
    """Loading it takes about 0.3 s."""
    modules = ", ".join(f"virest.app.{name}" for name in ("process", "diagnose", "calibrate", "simulate", "report"))
    code = f"import sys, {modules}; sys.exit('scipy.stats' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
