"""The shared descent: outliers, priors, bounds, limits, damping, and reused derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

import virest
from virest.inference.descent import Residuals, Slopes, System, descend, slices, slopes_by_steps
from virest.inference.robust import CAUCHY

Array = NDArray[np.float64]
ABSCISSA = np.linspace(0.0, 3.0, 90)
TRUE = np.array([2.0, 0.8, 0.5])
ANY = np.full(3, np.inf)


def decay(values: Array) -> Array:
    """A decaying exponential with a base."""
    return np.asarray(values[0] * np.exp(-values[1] * ABSCISSA) + values[2])


@dataclass(frozen=True)
class Look:
    """A prediction with derivatives taken at other values."""

    seen: Array
    slope: Array
    values: Array
    taken: Array

    def is_stale(self, limit: Slopes) -> bool:
        """Derivatives may be 0.1 off on the way."""
        far = {Slopes.ON_THE_WAY: 0.1, Slopes.AT_THE_END: 0.01, Slopes.HERE: 0.0}[limit]
        return bool(np.abs(self.values - self.taken).max() > far)


@dataclass(frozen=True)
class Curve:
    """Points of a curve as evidence."""

    measured: Array
    predict: Callable[[Array], Array] = decay
    std: float = 0.05
    prior: Array = field(default_factory=lambda: np.zeros(3))
    start: Array = field(default_factory=lambda: np.ones(3))
    bounds: tuple[Array, Array] = (-ANY, ANY)
    limit: float = np.inf
    taken: list[Array] = field(default_factory=list)
    seen: list[Array] = field(default_factory=list)

    def look(self, state: Array, before: Look | None, limit: Slopes) -> Look:
        """Reuse the derivatives of an earlier look while they are close enough."""
        self.seen.append(state)
        here = self.predict(state)
        if before is not None and not (kept := Look(here, before.slope, state, before.taken)).is_stale(limit):
            return kept
        self.taken.append(state)
        slope = slopes_by_steps(self.predict, here, state, np.full(len(state), 1e-6), self.bounds[1])
        return Look(here, slope, state, state)

    def weighed(self, state: Array, look: Look) -> System[Array, Look]:
        """Weight by one known deviation."""
        rows, left = look.slope[:, None] / self.std, (self.measured - look.seen)[:, None] / self.std
        low, high = self.bounds
        return System(
            state, look, rows, left, left[:, 0] ** 2, 1.0, self.prior, state - self.start, self.limit,
            (low - state, high - state),
        )  # fmt: skip

    def moved(self, state: Array, step: Array) -> Array:
        """The state after a step."""
        return state + step


@pytest.fixture
def curve(rng: np.random.Generator) -> Curve:
    """A decay with noise and 10 % outliers."""
    measured = decay(TRUE) + 0.05 * rng.normal(size=len(ABSCISSA))
    measured[::10] += rng.uniform(1, 4, len(measured[::10]))
    return Curve(measured)


def test_the_minimum_is_found_despite_outliers(curve: Curve) -> None:
    """The values equal those of a general minimiser for the same loss, and the truth lies within their deviations."""
    found = descend(curve, curve.start)
    soft = least_squares(
        lambda v: (curve.measured - decay(v)) / curve.std, TRUE, loss="cauchy", f_scale=CAUCHY, xtol=1e-12, ftol=1e-12
    )
    std = np.sqrt(np.diag(found.inverse()))
    np.testing.assert_array_less(np.abs(found.state - soft.x), 0.1 * std)
    np.testing.assert_array_less(np.abs(found.state - TRUE), 4 * std)
    assert found.cost(1.0) == pytest.approx(soft.cost, rel=1e-4)


def test_nearby_derivatives_are_reused(curve: Curve) -> None:
    """There are fewer derivatives than looks, and the last ones are taken near the end."""
    found = descend(curve, curve.start)
    assert len(curve.taken) < len(curve.seen)
    assert not found.look.is_stale(Slopes.AT_THE_END)


def test_derivatives_are_stale_once_the_prediction_has_moved(rng: np.random.Generator) -> None:
    """The limit is a part of the residual, whatever its unit; derivatives at the same point are never stale."""
    for unit in (1.0, 1e-3):
        left = unit * rng.normal(size=500)
        slope = np.ones((500, 1))
        here = Residuals(left, slope, left)
        near, far = (Residuals(left + part * unit * rng.normal(size=500), slope, left) for part in (0.1, 1.0))
        assert [one.is_stale(Slopes.HERE) for one in (here, near, far)] == [False, True, True]
        assert [one.is_stale(Slopes.AT_THE_END) for one in (here, near, far)] == [False, True, True]
        assert [one.is_stale(Slopes.ON_THE_WAY) for one in (here, near, far)] == [False, False, True]


def test_a_step_that_does_not_lower_the_loss_is_damped() -> None:
    """A full Newton step for an arc tangent diverges from a distant start."""
    bent = Curve(np.zeros(1), lambda values: np.arctan(values[:1]), start=np.array([3.0]), prior=np.zeros(1))
    found = descend(replace(bent, bounds=(-ANY[:1], ANY[:1])), np.array([3.0]))
    assert abs(found.state[0]) < 1e-3


def test_a_value_at_its_bound_stays_while_others_are_fitted(curve: Curve) -> None:
    """With the base limited to 0.3, the other values are optimal; derivatives are one-sided at the bound."""
    bounded = replace(curve, bounds=(-ANY, np.array([np.inf, np.inf, 0.3])))
    found = descend(bounded, np.array([1.0, 1.0, 0.3]))
    assert found.state[2] == 0.3
    fixed = least_squares(
        lambda v: (curve.measured - decay(np.array([*v, 0.3]))) / curve.std, TRUE[:2], loss="cauchy", f_scale=CAUCHY
    )
    np.testing.assert_allclose(found.state[:2], fixed.x, atol=2e-3)
    np.testing.assert_allclose(found.look.slope[:, 2], 1.0, rtol=1e-6)
    assert all((values <= bounded.bounds[1]).all() for values in bounded.seen)


def test_priors_and_step_limits_apply(curve: Curve) -> None:
    """A strong prior keeps a value at its start; no step exceeds its limit."""
    held = replace(curve, prior=np.array([0.0, 0.0, 1e8]))
    assert descend(held, curve.start).state[2] == pytest.approx(1.0, abs=1e-3)
    short = replace(curve, limit=0.1, seen=[])
    descend(short, curve.start)
    assert np.abs(np.diff(short.seen, axis=0)).max() <= 0.1 + 1e-12


def test_a_system_without_values_is_valid(curve: Curve) -> None:
    """The residuals are returned unchanged."""
    fixed = Curve(
        curve.measured, lambda _: decay(TRUE), prior=np.zeros(0), start=np.zeros(0), bounds=(ANY[:0], ANY[:0])
    )
    weighed = fixed.weighed(np.zeros(0), Look(decay(TRUE), np.zeros((90, 0)), np.zeros(0), np.zeros(0)))
    assert weighed.inverse().shape == (0, 0)
    np.testing.assert_allclose(descend(fixed, np.zeros(0), look=weighed.look).left, weighed.left)


def test_the_score_is_the_gradient_of_the_loss(curve: Curve) -> None:
    """Its sum over the residuals equals the difference quotient."""
    found = descend(curve, curve.start, 1)
    np.testing.assert_allclose(found.pull(found.left), found.score.sum(axis=0), rtol=1e-9)
    fresh, step = curve.weighed(found.state, curve.look(found.state, None, Slopes.HERE)), 1e-6
    for k, change in enumerate(step * np.eye(3)):
        ahead, behind = (
            curve.weighed(at, curve.look(at, None, Slopes.HERE)).cost(1.0)
            for at in (found.state + change, found.state - change)
        )
        assert (behind - ahead) / (2 * step) == pytest.approx(fresh.score.sum(axis=0)[k], rel=1e-4, abs=1e-3)


def test_slices_follow_the_lengths() -> None:
    """Zero lengths and empty lists are allowed."""
    assert slices([2, 0, 3]) == [slice(0, 2), slice(2, 2), slice(2, 5)]
    assert slices([]) == []


def test_there_is_one_descent() -> None:
    """Marquardt's damping appears in one file only."""
    root = Path(virest.__file__).parent
    damped = {
        path.name
        for room in ("inference", "diagnosis", "calibration")
        for path in (root / room).rglob("*.py")
        if "damping *" in path.read_text(encoding="utf-8") and "np.diag" in path.read_text(encoding="utf-8")
    }
    assert damped == {"descent.py"}
