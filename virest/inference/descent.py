"""One robust Gauss-Newton solver for all evidence: tracked points, brightness of patches, local blur.

:class:`Evidence` provides the measurements, their prediction, the residuals' standard deviations, and the nuisance
parameters to eliminate (directions of travel, patches' light, the encoder's memory of earlier frames).  The solver is
the same for all: Cauchy weights, priors, limited and bounded steps, Marquardt damping if a step does not reduce the
loss, and convergence when a step is small relative to the values' own standard deviations.

Kinds of evidence differ in their physics: the standard deviations of points and blur are known up to a factor, which
the residuals determine, while those of brightness are measured beforehand; slopes of points are expensive, and their
staleness is judged in pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Generic, Protocol, TypeVar

import numpy as np

from virest.arrays import Array
from virest.inference.robust import CAUCHY, cauchy_weight, robust_std

MAX_ITERATIONS = 15
"""A descent ends here if it has not converged."""
CONVERGED = 0.02
"""The fit ends when the rms of a step, in the values' standard deviations, is below this."""
FIRST_DAMPING, MAX_DAMPING = 1e-3, 1e3
"""Damping after the first step that raises the loss, and where a descent gives up; half or twice changed no fit."""


class Slopes(Enum):
    """How close to the current values the slopes must have been evaluated."""

    ON_THE_WAY = "for a step"
    AT_THE_END = "for values and their covariance"
    HERE = "at the very values"


STALE = {Slopes.ON_THE_WAY: 0.5, Slopes.AT_THE_END: 0.02, Slopes.HERE: 0.0}
"""Reuse slopes until predictions move by this fraction of the residuals (robust standard deviations of both)."""


class Look(Protocol):
    """The prediction at some values, with slopes evaluated there or nearby."""

    def is_stale(self, limit: Slopes) -> bool:
        """Whether the slopes were evaluated too far away."""
        ...


@dataclass(frozen=True, slots=True)
class Residuals:
    """Residuals at some values, with slopes evaluated where the residuals were ``taken``."""

    left: Array
    """(n,) measured minus predicted."""
    slope: Array
    """(n, k) change of the prediction per unit of each value."""
    taken: Array
    """(n,) residuals where the slopes were evaluated."""

    def is_stale(self, limit: Slopes) -> bool:
        """Whether the prediction has moved by more than STALE since."""
        return robust_std(self.left - self.taken) > STALE[limit] * robust_std(self.taken)


S = TypeVar("S")
L = TypeVar("L", bound=Look)


@dataclass(frozen=True, eq=False)
class System(Generic[S, L]):
    """Evidence linearised at one state: weighted rows, and their normal equations with the priors."""

    state: S
    look: L
    rows: Array
    """(n, m, k) change of the prediction per unit of each value, in standard deviations, nuisances eliminated."""
    left: Array
    """(n, m) measured minus predicted, likewise."""
    squared: Array
    """(n,) squared lengths of the residuals, which determine their weights."""
    scale: float | Array
    """(n,) or scalar: factor on the standard deviations."""
    prior: Array
    """(k,) information."""
    off: Array
    """(k,) deviation of the values from the priors' means."""
    limit: float | Array = np.inf
    """(k,) largest change in one step."""
    room: tuple[float | Array, float | Array] = (-np.inf, np.inf)
    """(k,) each: possible change of the values, down and up, before they reach a bound."""

    @cached_property
    def weight(self) -> Array:
        """(n,) Cauchy weights, 0 to 1."""
        return cauchy_weight(self.squared, CAUCHY * self.scale)

    @cached_property
    def score(self) -> Array:
        """(n, k) score of each residual, without the priors."""
        return np.asarray(np.einsum("nmk,nm->nk", self.rows, self.left * self._precision[:, None]))

    @cached_property
    def normal(self) -> Array:
        """(k, k) Gauss-Newton curvature of the loss, priors included."""
        points, ways, values = self.rows.shape
        flat = self.rows.reshape(points * ways, values)
        weighted = flat * np.repeat(self._precision, ways)[:, None]
        return np.asarray(weighted.T @ flat + np.diag(self.prior))

    def pull(self, left: Array) -> Array:
        """(k, ...) total score of residuals (n, m, ...), given in standard deviations, at these weights."""
        return np.asarray(np.einsum("nmk,nm...->k...", self.rows * self._precision[:, None, None], left))

    @property
    def _precision(self) -> Array:
        return np.asarray(self.weight / self.scale**2)

    def cost(self, scale: float | Array) -> float:
        """Cauchy loss at a scale, priors included."""
        width = (CAUCHY * scale) ** 2
        loss = 0.5 * (width * np.log1p(self.squared / width) / scale**2).sum()
        return float(loss + 0.5 * (self.prior * self.off**2).sum())

    def step(self, damping: float) -> Array:
        """The step (k,) with the diagonal of the normal equations increased by this fraction; bounds are respected."""
        matrix = self.normal + damping * np.diag(np.diag(self.normal))
        right, (down, up) = self.score.sum(axis=0) - self.prior * self.off, self.room
        step, free = np.zeros(len(right)), np.ones(len(right), bool)
        while free.any():
            step[free] = _solved(matrix[np.ix_(free, free)], right[free])
            out = free & (((step < 0) & (down >= 0)) | ((step > 0) & (up <= 0)))
            if not out.any():
                break
            step[out], free = 0.0, free & ~out
        step *= min(1.0, 1.0 / max(float(np.max(np.abs(step) / self.limit, initial=0.0)), 1e-12))
        return np.asarray(np.clip(step, down, up))

    def inverse(self) -> Array:
        """(k, k) covariance as if residuals were independent."""
        size = np.sqrt(np.maximum(np.diag(self.normal), 1e-30))
        whole = np.outer(size, size)
        return np.asarray(np.linalg.pinv(self.normal / whole, rcond=1e-12, hermitian=True)) / whole

    def sandwich(self, scatter: Array) -> Array:
        """Covariance (k, k) for grouped scores of this scatter (k, k), priors included."""
        inverse = self.inverse()
        return np.asarray(inverse @ (scatter + np.diag(self.prior)) @ inverse)


class Evidence(Protocol[S, L]):
    """The measurements, and their prediction from values."""

    def look(self, state: S, before: L | None, limit: Slopes) -> L:
        """Predict at a state, reusing the slopes of an earlier look while they are not stale."""
        ...

    def weighed(self, state: S, look: L) -> System[S, L]:
        """Express residuals in standard deviations and eliminate nuisance parameters."""
        ...

    def moved(self, state: S, step: Array) -> S:
        """The state after a step (k,)."""
        ...


def descend(
    evidence: Evidence[S, L],
    state: S,
    max_iterations: int = MAX_ITERATIONS,
    look: L | None = None,
    fresh: bool = True,
    settled: Slopes = Slopes.AT_THE_END,
) -> System[S, L]:
    """Levenberg-Marquardt; the scale of the residuals is updated after each accepted step.

    look: at this state, from an earlier descent.  fresh: re-evaluate the final slopes if they are stale.  settled:
    slopes at which a small step ends the descent.
    """
    system = evidence.weighed(state, look or evidence.look(state, None, Slopes.HERE))
    if not system.prior.size:
        return system

    def reevaluated(limit: Slopes) -> System[S, L]:
        return evidence.weighed(system.state, evidence.look(system.state, system.look, limit))

    damping = 0.0
    for _ in range(max_iterations):
        step = system.step(damping)
        moved = evidence.moved(system.state, step)
        after = evidence.weighed(moved, evidence.look(moved, system.look, Slopes.ON_THE_WAY))
        small = damping < 1 and step @ system.normal @ step < CONVERGED**2 * len(step)
        if after.cost(system.scale) > system.cost(system.scale) * (1 + 1e-9):
            if small and not system.look.is_stale(settled):
                break
            if system.look.is_stale(Slopes.HERE):
                system = reevaluated(Slopes.HERE)
                continue
            damping = max(10 * damping, FIRST_DAMPING)
            if small or damping > MAX_DAMPING:
                break
            continue
        system, damping = after, damping / 10 if damping > 0.1 * FIRST_DAMPING else 0.0
        if small and not system.look.is_stale(settled):
            break
        if small:
            system = reevaluated(settled)
    if fresh and system.look.is_stale(Slopes.AT_THE_END):
        system = reevaluated(Slopes.AT_THE_END)
    return system


def slopes_by_steps(predict: Callable[[Array], Array], here: Array, values: Array, steps: Array, high: Array) -> Array:
    """Change (n, k) of the prediction per unit of each value; backward differences where a step would pass ``high``.

    here: (n,) the prediction at the values (k,).
    """
    changes = np.diag(np.where(values + steps > high, -steps, steps))
    columns = [(predict(values + change) - here) / change.sum() for change in changes]
    return np.stack(columns, axis=-1)


def slices(lengths: Iterable[int]) -> list[slice]:
    """Slices of consecutive groups of these lengths."""
    return [slice(*ends) for ends in pairwise(accumulate(lengths, initial=0))]


def _solved(matrix: Array, right: Array) -> Array:
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    return np.asarray(np.linalg.lstsq(matrix / np.outer(size, size), right / size, rcond=1e-12)[0]) / size
