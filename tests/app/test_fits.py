"""The bench's fits recover known constants from synthetic gains."""

import numpy as np
import pytest

from virest.app.bench.fits import best_value, fit_left_over, fit_workloads
from virest.app.bench.workload import Scale, honesty_workloads


def test_known_coefficients_are_recovered():
    """Gains that follow a law, with a little noise, give its coefficients."""
    rng, law = np.random.default_rng(3), np.array([1.0, 0.5, 0.2, 0.3, 0.6])
    rows = []
    for k in range(240):
        of_colour = np.exp(rng.normal(3.0, 1.0))
        means, scatter = (-2.5, 4.0, -4.0, -3.0, 1.0, 6.0), (0.8, 1.0, 1.0, 1.0, 1.0, 1.0)
        ideal, removed, left, coded, misplaced, power = np.exp(rng.normal(means, scatter))
        logarithms = np.log([np.e, ideal, left, coded])
        off, left = np.array([0.0, misplaced]), power * np.exp(logarithms @ law[:4]) + law[4] * of_colour
        gain_db = np.mean(10 * np.log10((left + removed + off) / (left + 2 * off))) + rng.normal(0, 0.05)
        row = {"capture": f"c{k % 8}", "removed": removed, "misplaced": (off, 2 * off, (0.5, 0.5))}
        rows.append({**row, "regressors": [*logarithms, of_colour, power], "gain_db": gain_db})
    found = fit_left_over(rows)
    assert found["coefficients"] == pytest.approx(law, abs=0.08)
    assert np.all(np.array(found["std"]) < 0.1)
    assert found["off_db"] < 0.1


def test_the_best_value_lies_between_those_tried():
    """A maximum over the logarithm is found between its samples, and differing captures give a standard deviation."""
    values, shift = (0.03, 0.06, 0.1, 0.15, 0.25), np.linspace(-0.1, 0.1, 5)[:, None]
    found = best_value(values, -((np.log(values) - np.log(0.08) - shift) ** 2))
    assert found["best"] == pytest.approx(0.08, rel=0.05)
    assert 0 < found["std"] < 0.02


def test_fitted_and_judged_captures_are_disjoint():
    """No fitted capture shares a seed with a capture of the honesty bench."""
    judged = {w.name: w.options["seed"] for w in honesty_workloads(Scale())}
    assert not {w.options["seed"] for w in fit_workloads(Scale())} & set(judged.values())
