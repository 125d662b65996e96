"""One robust Gauss-Newton descent for all evidence: tracked points, brightness of patches, local blur.

What was measured, how values predict it, how far off a residual may be and what is eliminated beside the values
(directions of travel, patches' light, an encoder's memory of earlier frames) is the :class:`Evidence`.  How values are
found is the same for all: Cauchy weights, priors, steps within limits and bounds, Marquardt's damping where a step does
not lower the loss, and an end where a step is small in the values' own standard deviations.

What differs between kinds of evidence is physics: deviations of points and of blur are known but for a factor, which
what is left tells, those of brightness are measured beforehand; points' slopes are dear and judged in pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from virest.inference.robust import CAUCHY, cauchy_weight, robust_std

Array = NDArray[np.float64]
MAX_ITERATIONS = 15
CONVERGED = 0.02
"""A step whose root mean square over the values, in their standard deviations, is below this ends the fit."""
FIRST_DAMPING, MAX_DAMPING = 1e-3, 1e3


class Slopes(Enum):
    """How near the values slopes have to have been taken."""

    ON_THE_WAY = "for a step"
    AT_THE_END = "for values and their covariance"
    HERE = "at the very values"


STALE = {Slopes.ON_THE_WAY: 0.5, Slopes.AT_THE_END: 0.02, Slopes.HERE: 0.0}
"""Reuse slopes until what they predict moves by this part of what is left (robust standard deviations of both)."""


class Look(Protocol):
    """What values predict, with slopes that were taken there or not far away."""

    def is_stale(self, limit: Slopes) -> bool:
        """Whether the slopes were taken too far away."""
        ...


@dataclass(frozen=True, slots=True)
class Residuals:
    """What values leave, with slopes that were taken where they left ``taken``."""

    left: Array
    """(n,) measured minus predicted."""
    slope: Array
    """(n, k) change of the prediction per unit of each value."""
    taken: Array
    """(n,) what was left where the slopes were taken."""

    def is_stale(self, limit: Slopes) -> bool:
        """Whether the prediction has moved by more than STALE since."""
        return robust_std(self.left - self.taken) > STALE[limit] * robust_std(self.taken)


S = TypeVar("S")
L = TypeVar("L", bound=Look)


@dataclass(frozen=True, eq=False)
class System(Generic[S, L]):
    """Evidence at one state of the values: weighed rows, and their normal equations with the priors."""

    state: S
    look: L
    rows: Array
    """(n, m, k) change of the prediction per unit of each value, in standard deviations, nuisances eliminated."""
    left: Array
    """(n, m) measured minus predicted, likewise."""
    squared: Array
    """(n,) squared lengths of the residuals, by which they are weighed."""
    scale: float | Array
    """(n,) or one for all: by what factor the standard deviations are wrong."""
    prior: Array
    """(k,) information."""
    off: Array
    """(k,) how far the values are from where the priors have them."""
    limit: float | Array = np.inf
    """(k,) largest change in one step."""
    room: tuple[float | Array, float | Array] = (-np.inf, np.inf)
    """(k,) each: how far the values can change, down and up, before they reach a bound."""

    @cached_property
    def weight(self) -> Array:
        """(n,) Cauchy weights, 0 to 1."""
        return cauchy_weight(self.squared, CAUCHY * self.scale)

    @cached_property
    def score(self) -> Array:
        """(n, k) what each residual pulls the values by, before the priors."""
        return np.asarray(np.einsum("nmk,nm->nk", self.rows, self.left * self._precision[:, None]))

    @cached_property
    def normal(self) -> Array:
        """(k, k) curvature of the loss, as Gauss and Newton take it, with the priors'."""
        points, ways, values = self.rows.shape
        flat = self.rows.reshape(points * ways, values)
        weighted = flat * np.repeat(self._precision, ways)[:, None]
        return np.asarray(weighted.T @ flat + np.diag(self.prior))

    def pull(self, left: Array) -> Array:
        """(k, ...) what residuals (n, m, ...) in standard deviations would pull the values by, at these weights."""
        return np.asarray(np.einsum("nmk,nm...->k...", self.rows * self._precision[:, None, None], left))

    @property
    def _precision(self) -> Array:
        return np.asarray(self.weight / self.scale**2)

    def cost(self, scale: float | Array) -> float:
        """Cauchy loss at a scale, with the priors."""
        width = (CAUCHY * scale) ** 2
        loss = 0.5 * (width * np.log1p(self.squared / width) / scale**2).sum()
        return float(loss + 0.5 * (self.prior * self.off**2).sum())

    def step(self, damping: float) -> Array:
        """The step (k,), the normal equations' diagonal raised by this part; values at a bound stay within."""
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
        """Covariance (k, k) where the scores of what errs together have this scatter (k, k), with the priors'."""
        inverse = self.inverse()
        return np.asarray(inverse @ (scatter + np.diag(self.prior)) @ inverse)


class Evidence(Protocol[S, L]):
    """What was measured, and how values predict it."""

    def look(self, state: S, before: L | None, limit: Slopes) -> L:
        """Predict at a state; slopes of an earlier look serve while they are not stale."""
        ...

    def weighed(self, state: S, look: L) -> System[S, L]:
        """Put residuals in their standard deviations and eliminate nuisances."""
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
) -> System[S, L]:
    """Levenberg-Marquardt; the scale of the residuals follows each accepted step.

    look: at this state, from an earlier descent.  fresh: slopes are taken anew where it ends, if they are stale there.
    """
    system = evidence.weighed(state, look or evidence.look(state, None, Slopes.HERE))
    if not system.prior.size:
        return system

    def taken_anew(limit: Slopes) -> System[S, L]:
        return evidence.weighed(system.state, evidence.look(system.state, system.look, limit))

    damping = 0.0
    for _ in range(max_iterations):
        step = system.step(damping)
        moved = evidence.moved(system.state, step)
        after = evidence.weighed(moved, evidence.look(moved, system.look, Slopes.ON_THE_WAY))
        small = damping < 1 and step @ system.normal @ step < CONVERGED**2 * len(step)
        if after.cost(system.scale) > system.cost(system.scale) * (1 + 1e-9):
            if system.look.is_stale(Slopes.HERE):
                system = taken_anew(Slopes.HERE)
                continue
            damping = max(10 * damping, FIRST_DAMPING)
            if small or damping > MAX_DAMPING:
                break
            continue
        system, damping = after, damping / 10 if damping > 0.1 * FIRST_DAMPING else 0.0
        if small and not system.look.is_stale(Slopes.AT_THE_END):
            break
        if small:
            system = taken_anew(Slopes.AT_THE_END)
    if fresh and system.look.is_stale(Slopes.AT_THE_END):
        system = taken_anew(Slopes.AT_THE_END)
    return system


def slopes_by_steps(predict: Callable[[Array], Array], here: Array, values: Array, steps: Array, high: Array) -> Array:
    """Change (n, k) of what is predicted per unit of each value; backwards where a step would pass its upper bound.

    here: (n,) what is predicted for the values (k,).
    """
    changes = np.diag(np.where(values + steps > high, -steps, steps))
    columns = [(predict(values + change) - here) / change.sum() for change in changes]
    return np.stack(columns, axis=-1)


def slices(lengths: Iterable[int]) -> list[slice]:
    """Where each of some groups of values, one after another, lies in all of them."""
    return [slice(*ends) for ends in pairwise(accumulate(lengths, initial=0))]


def _solved(matrix: Array, right: Array) -> Array:
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    return np.asarray(np.linalg.lstsq(matrix / np.outer(size, size), right / size, rcond=1e-12)[0]) / size
