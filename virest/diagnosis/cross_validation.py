"""Cross-validation of candidates: screen with few points, then fit to half of the time blocks and judge on the rest."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from virest.arrays import Array, Mask
from virest.capture.imu import ImuSamples
from virest.diagnosis.candidates import SCREEN_POINTS, Candidate
from virest.diagnosis.geometric_evidence import ITERATIONS, Evidence, Model, capped_rms, fit_model, relief_loss
from virest.image_formation.point_model import TrackTable
from virest.inference.descent import Slopes
from virest.inference.fit_start import FitStart
from virest.inference.hold_out import distances, group_means, loss
from virest.inference.parallel import ParallelMap
from virest.inference.time_blocks import halves
from virest.inference.track_fit import Term, fit_from, for_table, unfitted
from virest.motion.scene_motion import PLANE_STD_PER_M, InertialMotion, Motion

JUDGE_POINTS = 3500
"""Points used to judge a cause; half of them fit it."""
LAGGING_BLOCK = 2
"""Pairs per block among those that a start-up lag moves: only neighbouring pairs share a frame and its errors."""

FIRST_ITERATIONS, SURVIVORS, SURVIVING_STARTS = 2, 3, 2
"""Iterations of all candidates in the first round; causes that continue, as a multiple of the count wanted; and
starting points kept per cause."""

SCENE_ROUNDS, NEAR_LOSS, LEAST_GAIN = 3, 1.5, 0.01
"""Rounds in which judged causes are fitted from the best one's scene; they end when none gains LEAST_GAIN of its loss.
A cause is not fitted if its loss with that scene is more than NEAR_LOSS times its own.  In four
captures with a wrong offset and no travel, the offset's held-out residual exceeds that of a filter of equal delay by
1.6 to 5.2 % without these rounds, by 0 to 2.5 % with them."""

FOLDS = (0, 1)
"""A fit of fold k uses every other time block, from block k on; the others judge it."""


@dataclass(frozen=True, slots=True)
class Judged:
    """A candidate, or a rule for choosing one, judged on held-out blocks."""

    candidate: Candidate
    distance: Array
    """(n,) whitened held-out distances of the points."""
    block_loss: Array
    """(blocks,) mean held-out loss per point."""
    pair_loss: Array
    """(pairs,) the same."""
    rms: float
    """Held-out, in units of the typical noise."""


@dataclass(frozen=True, slots=True)
class Screened:
    """A candidate with its model fitted to each fold's blocks, with few points."""

    candidate: Candidate
    models: tuple[Model, Model]
    """Fitted, by fold."""
    losses: tuple[float, float]
    """On the blocks that they were fitted to."""
    scale: float
    depth_spread_per_m: float

    @property
    def loss(self) -> float:
        """Mean of both folds."""
        return 0.5 * sum(self.losses)


def screen(evidence: Evidence, candidates: Sequence[Candidate], each: ParallelMap) -> list[Screened]:
    """Fit each candidate to the blocks of each fold."""
    return _descended(evidence, [(c, (c.model, c.model)) for c in candidates], ITERATIONS, each)


def race(evidence: Evidence, candidates: Sequence[Candidate], count: int, each: ParallelMap) -> list[Screened]:
    """Screen many candidates: after a few iterations of all, only the best of either fold are fitted to the end.

    Successive halving (Jamieson & Talwalkar 2016, arXiv:1502.07943).  SURVIVORS × count causes continue, each with at
    most SURVIVING_STARTS starting points.
    """
    started = _descended(evidence, [(c, (c.model, c.model)) for c in candidates], FIRST_ITERATIONS, each)
    surviving: set[int] = set()
    for fold in FOLDS:
        starts: dict[str, list[int]] = {}
        for k in sorted(range(len(started)), key=lambda k, f=fold: started[k].losses[f]):  # type: ignore[misc]
            starts.setdefault(started[k].candidate.name, []).append(k)
        surviving |= {k for own in list(starts.values())[: SURVIVORS * count] for k in own[:SURVIVING_STARTS]}
    remaining = [(candidates[k], started[k].models) for k in sorted(surviving)]
    return _descended(evidence, remaining, ITERATIONS - FIRST_ITERATIONS, each)


def _descended(
    evidence: Evidence, starts: Sequence[tuple[Candidate, tuple[Model, Model]]], iterations: int, each: ParallelMap
) -> list[Screened]:
    """Fit each candidate to the blocks of each fold, from the model of that fold."""
    tables = {
        lag: evidence.table(model, SCREEN_POINTS)
        for lag, model in {c.model.lag: c.model for c, _ in starts}.items()
    }  # fmt: skip
    use = halves(evidence.block)
    parts = {(lag, fold): table.chosen(use[fold][table.pair]) for lag, table in tables.items() for fold in FOLDS}
    shared: dict[tuple[Hashable, ...], FitStart] = {}

    def start(model: Model, fold: int) -> FitStart:
        key = id(model.profile), id(model.scene), model.lag, fold
        if key not in shared:
            shared[key] = FitStart(evidence.imu, parts[model.lag, fold], model.profile, model.scene)
        return shared[key]

    calls = [
        (start(models[fold], fold), models[fold], (*c.model.terms, *c.added), iterations)
        for c, models in starts
        for fold in FOLDS
    ]
    found = each(_screen, calls)
    return [_screened(c, *halves) for (c, _), *halves in zip(starts, found[::2], found[1::2], strict=True)]


Half = tuple[float, Model, float, float]
"""Loss, fitted model, scale and spread of depths of a candidate on the blocks of one fold."""


def _screen(start: FitStart, model: Model, terms: Sequence[Term], iterations: int) -> Half:
    fitted = fit_from(start, terms, max_iterations=iterations, covariances=False, settled=Slopes.ON_THE_WAY)
    found = replace(model, profile=fitted.profile, scene=fitted.scene)
    return relief_loss(fitted), found, fitted.scale, fitted.depth_spread_per_m


def _screened(candidate: Candidate, first: Half, second: Half) -> Screened:
    spread = 0.5 * (first[3] + second[3])
    models, losses = (first[1], second[1]), (first[0], second[0])
    return Screened(replace(candidate, model=first[1]), models, losses, min(first[2], second[2]), spread)


def best_of_each(screened: list[Screened]) -> list[Screened]:
    """The best starting point of each cause, chosen per fold on its own blocks; best causes first."""
    by_name: dict[str, list[Screened]] = {}
    for entry in screened:
        by_name.setdefault(entry.candidate.name, []).append(entry)
    best = []
    for entries in by_name.values():
        first, second = (min(entries, key=lambda entry, k=fold: entry.losses[k]) for fold in FOLDS)  # type: ignore[misc]
        better = min(first, second, key=lambda entry: entry.loss)
        if first.candidate.word == second.candidate.word and first.candidate.model.lag == second.candidate.model.lag:
            models, losses = (first.models[0], second.models[1]), (first.losses[0], second.losses[1])
            better = replace(better, models=models, losses=losses)
        best.append(better)
    return sorted(best, key=lambda entry: entry.loss)


def promising(base: Screened, better: Sequence[Screened], count: int) -> tuple[frozenset[str], frozenset[str]]:
    """Names of the most promising causes of each fold, judged only on its fitted blocks."""
    first, second = (
        frozenset(
            entry.candidate.name
            for entry in sorted(better, key=lambda entry, k=fold: entry.losses[k])[:count]  # type: ignore[misc]
            if entry.losses[fold] < base.losses[fold]
        )
        for fold in FOLDS
    )
    return first, second


def judge(
    evidence: Evidence, screened: Sequence[Screened], scale: float, depth_spread_per_m: float, each: ParallelMap
) -> list[Judged]:
    """Fit on every other block, judge on the rest, and vice versa.

    Where the camera hardly travels, the scene's values trade against each other, and how far a fit follows them depends
    on its start.  Each cause is therefore also fitted from the scene of the best fit.
    """
    tables = [evidence.table(entry.candidate.model, JUDGE_POINTS) for entry in screened]
    use = halves(evidence.block)
    calls = [
        (evidence.imu, table, model, (*model.terms, *entry.candidate.added), use[fold], depth_spread_per_m, scale)
        for entry, table in zip(screened, tables, strict=True)
        for fold, model in enumerate(entry.models)
    ]  # fmt: skip
    found = each(_held_out, calls)
    for _ in range(SCENE_ROUNDS):
        again = []
        for k, (call, own) in enumerate(zip(calls, found, strict=True)):
            best = min((f for f in found[k % 2 :: 2] if f.model.lag == own.model.lag), key=lambda f: f.loss)
            if best is not own and _is_free(own.model.scene) and _is_free(best.model.scene):
                again.append((k, (*call[:2], replace(own.model, scene=best.model.scene), *call[3:], own)))
        before = [own.loss for own in found]
        for (k, _), better in zip(again, each(_held_out_if_better, [call for _, call in again]), strict=True):
            found[k] = better
        if all(now.loss > (1 - LEAST_GAIN) * own for now, own in zip(found, before, strict=True)):
            break
    judged = []
    for entry, table, first, second in zip(screened, tables, found[::2], found[1::2], strict=True):
        distance = np.where(use[0][table.pair], second.distance, first.distance)
        judged.append(_judged(evidence, entry.candidate, table, distance, scale))
    return judged


def _judged(evidence: Evidence, candidate: Candidate, table: TrackTable, distance: Array, scale: float) -> Judged:
    mean, block = loss(distance, scale), evidence.block[table.pair]
    by_pair, by_block = (group_means(mean, k) for k in (table.pair, block))
    return Judged(candidate, distance, by_block, by_pair, capped_rms(distance))


def choose(
    evidence: Evidence, judged: Sequence[Judged], allowed: tuple[frozenset[str], frozenset[str]], scale: float
) -> Judged:
    """Gain of the best cause without selection bias: the cause is chosen for each block by other blocks only.

    A block is judged by fits to the other fold.  Its cause is chosen on the remaining blocks of its own fold, which
    these fits did not use either.  Only causes promising on the fitted blocks are eligible; if there are none, the
    first of ``judged`` is used, which is the model without an added cause.
    """
    table = evidence.table(judged[0].candidate.model, JUDGE_POINTS)
    block = evidence.block[table.pair]
    losses = np.stack([entry.block_loss for entry in judged])
    distance, chosen = judged[0].distance.copy(), np.zeros(losses.shape[1], np.intp)
    for number in range(losses.shape[1]):
        fitted_to = 1 - number % 2
        free = [k for k, entry in enumerate(judged) if k and entry.candidate.name in allowed[fitted_to]]
        others = np.arange(number % 2, losses.shape[1], 2)
        others = others[others != number]
        if free:
            by = losses[free][:, others].mean(axis=1) if len(others) else np.arange(len(free), dtype=float)
            chosen[number] = free[int(np.argmin(by))]
        distance[block == number] = judged[chosen[number]].distance[block == number]
    best = judged[int(np.bincount(chosen).argmax())]
    return _judged(evidence, best.candidate, table, distance, scale)


@dataclass(frozen=True, slots=True)
class _HeldOut:
    """A fit to the blocks of one fold."""

    model: Model
    distance: Array
    """(n,) of all points."""
    loss: float
    """On the points that it was fitted to."""


def _held_out(
    imu: ImuSamples, table: TrackTable, model: Model, terms: Sequence[Term], use: Mask, depth_spread_per_m: float,
    scale: float,
) -> _HeldOut:  # fmt: skip
    """Fit the pairs in ``use`` (pairs,)."""
    used = use[table.pair]
    fitted = fit_model(imu, model, terms, table.chosen(used), covariances=False)
    distance = distances(imu, fitted, table, depth_spread_per_m)
    found = replace(model, profile=fitted.profile, scene=fitted.scene)
    return _HeldOut(found, distance, float(loss(distance[used], scale).mean()))


def _is_free(scene: Motion | None) -> bool:
    """Whether a scene's plane is unknown: a given depth must not follow another cause's."""
    return isinstance(scene, InertialMotion) and min(scene.plane_std_per_m) >= PLANE_STD_PER_M


def _held_out_if_better(
    imu: ImuSamples, table: TrackTable, model: Model, terms: Sequence[Term], use: Mask, depth_spread_per_m: float,
    scale: float, own: _HeldOut,
) -> _HeldOut:  # fmt: skip
    """Fit from a model; the own fit if its loss is lower."""
    part = table.chosen(use[table.pair])
    start = FitStart(imu, part, model.profile, for_table(model.scene, part))
    if float(loss(unfitted(start, depth_spread_per_m), scale).mean()) > NEAR_LOSS * own.loss:
        return own
    again = _held_out(imu, table, model, terms, use, depth_spread_per_m, scale)
    return min(own, again, key=lambda fit: fit.loss)


def lagging_gain(evidence: Evidence, before: Judged, after: Judged) -> Array:
    """Gain (blocks,) of the pairs that a start-up lag moves, in blocks of neighbours with shared errors."""
    last = after.candidate.model.profile.extensions.frame_lag_frames
    moved = np.array([pair.first <= last for pair in evidence.observed.pairs])
    both = min(len(before.pair_loss), len(after.pair_loss), len(moved))
    gain = (before.pair_loss[:both] - after.pair_loss[:both])[moved[:both]]
    parts = np.array_split(gain, max(len(gain) // LAGGING_BLOCK, 1))
    return np.array([part.mean() for part in parts if len(part)])
