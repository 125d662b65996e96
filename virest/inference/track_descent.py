"""Robust Gauss-Newton over named terms of a profile and the scene's motion, on tracked points.

How the points depend on the values changes little on the way: slopes are taken anew only where the points have moved
far since, and once more where the descent ends.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.image_formation.point_model import IntegratedMotion, Prediction, TrackTable, predict, with_profile
from virest.inference.robust import CAUCHY, NORMAL_MEDIAN, RAYLEIGH_MEDIAN, cauchy_weight
from virest.inference.term import Term, slopes_of
from virest.inference.travel_direction import find_directions, without_directions
from virest.motion.scene_motion import DirectedMotion, InertialMotion, Motion

Array = NDArray[np.float64]
CONVERGED = 0.02
"""A step below this part of every standard deviation ends the fit."""
MAX_DAMPING = 1e3
SMALLEST_SCALE = 0.03
ON_THE_WAY, AT_THE_END = (1.5, 0.5), (0.1, 0.05)
"""Reuse the Jacobian until points move this far (median, px) or the scene changes by this fraction."""
NOT_AT_ALL = (0.0, 0.0)
ANY_DEPTH = 1e6
"""Spread of inverse depths that leaves a point free to lie anywhere along its parallax."""


@dataclass(frozen=True, slots=True)
class State:
    """Where a descent stands."""

    known: IntegratedMotion
    scene: Motion | None
    change: Array
    """(k,) of the terms' values from the starting profile."""
    depth_spread: float
    """Standard deviation of points' inverse depths about the plane, 1/m."""


@dataclass(frozen=True, slots=True)
class Linearisation:
    """The points as a state predicts them, with slopes that were taken there or not far away."""

    scene: Motion | None
    prediction: Prediction
    slope: Array
    """(n, 2, k) change of the predicted points per unit of each term's values and of the motion's entries, px."""
    taken_px: Array
    """(n, 2) where the points were predicted when the slopes were taken."""
    taken_scene: Motion | None

    def is_stale(self, limit: tuple[float, float]) -> bool:
        """Whether points or scene have moved further than (px, part) since the slopes were taken."""
        if self.prediction.second_px is self.taken_px:
            return False
        moved_px = float(np.median(np.abs(self.prediction.second_px - self.taken_px)))
        return moved_px > limit[0] or _part_moved(self.taken_scene, self.scene) > limit[1]


def _part_moved(before: Motion | None, after: Motion | None) -> float:
    """By what part the planes and velocities of an inertial motion have changed."""
    if not isinstance(before, InertialMotion) or not isinstance(after, InertialMotion):
        return 0.0
    parts = (
        np.linalg.norm(new - old) / max(float(np.linalg.norm(old)), 1e-9)
        for new, old in ((after.plane_per_m, before.plane_per_m), (after.velocity_m_s, before.velocity_m_s))
    )
    return float(max(parts))


@dataclass(frozen=True, slots=True)
class System:
    """Weighted rows at one point, and their normal equations with the priors."""

    look: Linearisation
    difference: Array
    squared: Array
    """(n,) squared whitened differences."""
    weight: Array
    scale: float
    depth_spread: float
    rows: Array
    """(n, 2, k) whitened."""
    left: Array
    """(n, 2) whitened differences."""
    hessian: Array
    gradient: Array
    prior: Array
    """(k,) information."""
    pulled: Array
    """(k,) gradient of the priors."""
    limit: Array

    def solve(self, damping: float) -> Array:
        """The step (k,), the normal equations' diagonal raised by this part."""
        matrix = self.hessian + np.diag(self.prior)
        matrix = matrix + damping * np.diag(np.diag(matrix))
        return np.asarray(_solved(matrix, self.gradient - self.pulled))

    def inverse(self) -> Array:
        """(k, k) covariance as if points were independent."""
        return _inverse(self.hessian + np.diag(self.prior))

    @property
    def scene(self) -> Motion | None:
        """As it was found anew, for a directed motion."""
        return self.look.scene

    @property
    def prediction(self) -> Prediction:
        """Where the points should be."""
        return self.look.prediction


@dataclass(frozen=True, slots=True)
class Problem:
    """What stays the same through a descent."""

    imu: ImuSamples
    table: TrackTable
    terms: tuple[Term, ...]
    start: Motion | None

    def look(
        self, state: State, before: Linearisation | None, limit: tuple[float, float] = NOT_AT_ALL
    ) -> Linearisation:
        """Predict the points of a state; slopes of an earlier look serve while they are not stale."""
        table, scene = self.table, state.scene
        like = None if before is None else before.prediction
        directed = isinstance(scene, DirectedMotion)
        if before is not None or directed:
            prediction = predict(state.known, table, scene, like=like)
            if isinstance(scene, DirectedMotion):
                prediction, scene = _directed(table, prediction, scene)
            if before is not None:
                kept = Linearisation(scene, prediction, before.slope, before.taken_px, before.taken_scene)
                if not kept.is_stale(limit):
                    return kept
            like = prediction
        if directed:  # whose points do not depend on which way it goes
            slope = self._term_slopes(replace(state, scene=None), prediction)
            return Linearisation(scene, prediction, slope, prediction.second_px, scene)
        prediction = predict(state.known, table, scene, slopes=scene is not None, like=like)
        slopes = [self._term_slopes(state, prediction)]
        slopes += [] if prediction.slopes is None or self.start is None else [prediction.slopes]
        prediction = replace(prediction, slopes=None)
        return Linearisation(scene, prediction, np.concatenate(slopes, axis=-1), prediction.second_px, scene)

    def _term_slopes(self, state: State, at: Prediction) -> Array:
        """(n, 2, k) change of the predicted points per unit of each term's values."""

        def moved_by(profile: CameraProfile) -> Array:
            moved = with_profile(state.known, self.imu, profile)
            return predict(moved, self.table, state.scene, like=at).second_px - at.second_px

        found = [slopes_of(term, state.known.profile, self.table, moved_by) for term in self.terms]
        return np.concatenate(found, axis=-1) if found else np.zeros((len(self.table), 2, 0))

    def weighed(self, state: State, look: Linearisation) -> System:
        """Whiten a look's rows by noise and spread of depths, weigh them, and sum the normal equations up."""
        table, scene = self.table, look.scene
        difference = table.second_px - look.prediction.second_px
        limit = [value for term in self.terms for value in term.limit]
        prior = [std**-2.0 for term in self.terms for std in term.prior_std]
        pulled = list(np.array(prior) * state.change)
        if scene is not None and self.start is not None:
            information = scene.prior_std() ** -2.0
            limit += list(scene.limits())
            prior += list(information)
            pulled += list(information * (scene.vector() - self.start.vector()))
        rows, left, spread = _whitened(look.slope, difference, look.prediction, table, state.depth_spread)
        squared = (left**2).sum(axis=-1)
        typical = NORMAL_MEDIAN if state.depth_spread == ANY_DEPTH else RAYLEIGH_MEDIAN
        scale = max(float(np.median(np.sqrt(squared))) / typical, SMALLEST_SCALE)
        weight = cauchy_weight(squared, CAUCHY * scale)
        if isinstance(scene, DirectedMotion):
            noise, flow = table.noise_px[table.pair], np.asarray(look.prediction.per_step)
            rows, left = without_directions(
                rows, left, weight, difference / noise[:, None], flow / noise[:, None, None], scene.direction,
                scene.group(table.pair),
            )  # fmt: skip
        flat = rows.reshape(2 * len(table), rows.shape[-1])
        weighted = flat * np.repeat(weight / scale**2, 2)[:, None]
        return System(
            look, difference, squared, weight, scale, spread, rows, left,
            weighted.T @ flat, weighted.T @ left.ravel(), np.array(prior), np.array(pulled), np.array(limit),
        )  # fmt: skip


def descend(
    imu: ImuSamples,
    table: TrackTable,
    terms: tuple[Term, ...],
    start: Motion | None,
    state: State,
    max_iterations: int,
    look: Linearisation | None,
    fresh: bool,
) -> tuple[State, System]:
    """Levenberg-Marquardt at one spread of depths; the robust scale follows each accepted step.

    look: at this state, from an earlier descent.  fresh: slopes are taken anew where it ends.
    """
    problem = Problem(imu, table, terms, start)
    system, damping = problem.weighed(state, look or problem.look(state, None)), 0.0
    if not system.hessian.size:
        return replace(state, scene=system.scene), system
    for _ in range(max_iterations):
        step = system.solve(damping)
        step *= min(1.0, 1.0 / max(float(np.max(np.abs(step) / system.limit, initial=0.0)), 1e-12))
        moved = _moved(imu, terms, state, step)
        after = problem.weighed(moved, problem.look(moved, system.look, ON_THE_WAY))
        if cost(after, system.scale) > cost(system, system.scale) * (1 + 1e-9):
            if system.look.is_stale(NOT_AT_ALL):
                system = problem.weighed(state, problem.look(state, system.look, NOT_AT_ALL))
                continue
            damping = max(10 * damping, 1e-3)
            if damping > MAX_DAMPING:
                break
            continue
        small = bool(np.all(np.abs(step) < CONVERGED * np.sqrt(np.diag(system.inverse()))))
        state, system, damping = replace(moved, scene=after.scene), after, damping / 10 if damping > 1e-4 else 0.0
        if small and not system.look.is_stale(AT_THE_END):
            break
        if small:
            system = problem.weighed(state, problem.look(state, system.look, AT_THE_END))
    if fresh and system.look.is_stale(AT_THE_END):
        system = problem.weighed(state, problem.look(state, system.look, AT_THE_END))
    return state, system


# ── one linearisation ────────────────────────────────────────────────────────────────────────────────────────────


def _whitened(
    slope: Array, difference: Array, at: Prediction, table: TrackTable, depth_spread: float
) -> tuple[Array, Array, float]:
    """Rows and differences over their standard deviations, and the spread of depths that the differences show."""
    noise = table.noise_px[table.pair][:, None]
    rows, left = slope / noise[..., None], difference / noise
    if at.along_px is None:
        return rows, left, 0.0
    length = np.linalg.norm(at.along_px, axis=-1)
    way = at.along_px / np.maximum(length, 1e-12)[:, None]
    ratio = length / noise[:, 0]
    along = (left * way).sum(axis=-1)
    shrink = 1 - 1 / np.sqrt(1 + (depth_spread * ratio) ** 2)
    left = left - (shrink * along)[:, None] * way
    rows = rows - way[:, :, None] * (shrink[:, None] * np.einsum("ni,nik->nk", way, rows))[:, None, :]
    if depth_spread == ANY_DEPTH:
        return rows, left, depth_spread
    return rows, left, _depth_spread(along, difference, way, noise[:, 0], ratio)


def _depth_spread(along: Array, difference: Array, way: Array, noise: Array, ratio: Array) -> float:
    """Standard deviation of inverse depths: what the differences along the parallax have more than those across."""
    telling = ratio > np.quantile(ratio, 0.5)
    if telling.sum() < 50 or np.median(ratio[telling]) < 1e-3:
        return 0.0
    across = (difference[telling] * np.stack([-way[telling, 1], way[telling, 0]], axis=-1)).sum(axis=-1)
    base = (np.median(np.abs(across / noise[telling])) / NORMAL_MEDIAN) ** 2
    more = along[telling] ** 2 - base * NORMAL_MEDIAN**2
    spread = np.median(more / ratio[telling] ** 2) / NORMAL_MEDIAN**2
    return float(np.sqrt(max(spread, 0.0)))


def _moved(imu: ImuSamples, terms: tuple[Term, ...], state: State, step: Array) -> State:
    profile, place = state.known.profile, 0
    for term in terms:
        profile = term.change(profile, step[place : place + len(term)])
        place += len(term)
    scene = state.scene
    if scene is not None:
        scene = scene.with_vector(scene.vector() + step[place:])
    return State(with_profile(state.known, imu, profile), scene, state.change + step[:place], state.depth_spread)


def cost(system: System, scale: float) -> float:
    """Cauchy loss at a common scale, with the priors."""
    width = (CAUCHY * scale) ** 2
    prior = float((system.pulled**2 / np.where(system.prior > 0, system.prior, 1.0)).sum())
    return float(0.5 * width * np.log1p(system.squared / width).sum()) / scale**2 + 0.5 * prior


def _directed(table: TrackTable, at: Prediction, motion: DirectedMotion) -> tuple[Prediction, DirectedMotion]:
    """Directions found anew from the differences, and the prediction with what lies along them."""
    assert at.per_step is not None
    noise, group = table.noise_px[table.pair], motion.group(table.pair)
    start = motion.direction if motion.direction.any() else None
    found = find_directions(
        at.per_step / noise[:, None, None], (table.second_px - at.second_px) / noise[:, None], group,
        len(motion.direction), start,
    )  # fmt: skip
    along = np.squeeze(at.per_step @ found[group][..., None], -1)
    return replace(at, along_px=along), DirectedMotion(found)


def _solved(matrix: Array, right: Array) -> Array:
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    return np.asarray(np.linalg.lstsq(matrix / np.outer(size, size), right / size, rcond=1e-12)[0]) / size


def _inverse(matrix: Array) -> Array:
    if not matrix.size:
        return matrix
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    return np.asarray(np.linalg.pinv(matrix / np.outer(size, size), rcond=1e-12, hermitian=True)) / np.outer(size, size)
