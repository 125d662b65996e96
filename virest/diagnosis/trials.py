"""Candidates tried: fitted to all blocks of time with few points, or to half of them and judged on the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from virest.capture.imu import ImuSamples
from virest.diagnosis.candidates import SCREEN_POINTS, Candidate
from virest.diagnosis.geometric_evidence import Evidence, Model, capped_rms, distances, fit_model, loss, relief_loss
from virest.motion.shared_out import Each
from virest.motion.track_fit import Term
from virest.motion.track_model import TrackTable

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
JUDGE_POINTS = 3500
LAGGING_BLOCK, MOST_LAGGING_BLOCKS = 3, 8
"""Pairs in a block of those that a start-up moves, at least, and blocks at most."""


@dataclass(frozen=True, slots=True)
class Judged:
    """A candidate on blocks that it was not fitted to."""

    candidate: Candidate
    block_loss: Array
    """(blocks,) mean held-out loss a point."""
    pair_loss: Array
    """(pairs,) the same."""
    rms: float
    """Held-out, in units of the typical noise."""


@dataclass(frozen=True, slots=True)
class Screened:
    """A candidate with its model fitted to all blocks, with few points."""

    loss: float
    candidate: Candidate
    scale: float
    depth_spread_per_m: float


def screen(evidence: Evidence, candidates: Sequence[Candidate], each: Each) -> list[Screened]:
    """Fit each candidate to all blocks."""
    tables = {
        lag: evidence.table(model, SCREEN_POINTS) for lag, model in {c.model.lag: c.model for c in candidates}.items()
    }
    calls = [(evidence.imu, tables[c.model.lag], c.model, (*c.model.terms, *c.added)) for c in candidates]
    found = each(_screen, calls)
    return [Screened(s[0], replace(c, model=s[1]), s[2], s[3]) for c, s in zip(candidates, found, strict=True)]


def _screen(
    imu: ImuSamples, table: TrackTable, model: Model, terms: Sequence[Term]
) -> tuple[float, Model, float, float]:
    """Loss, fitted model, scale and spread of depths of one candidate."""
    fitted = fit_model(imu, model, terms, table)
    found = replace(model, profile=fitted.profile, scene=fitted.scene)
    return relief_loss(fitted), found, fitted.scale, fitted.depth_spread_per_m


def best_of_each(screened: list[Screened]) -> list[Screened]:
    """For each cause the starting point that fits best; best causes first."""
    best: dict[str, Screened] = {}
    for entry in screened:
        name = entry.candidate.name
        if name not in best or entry.loss < best[name].loss:
            best[name] = entry
    return sorted(best.values(), key=lambda entry: entry.loss)


def judge(
    evidence: Evidence, candidates: Sequence[Candidate], scale: float, depth_spread_per_m: float, each: Each
) -> list[Judged]:
    """Fit on every other block, judge on those between, and the other way round."""
    tables = [evidence.table(candidate.model, JUDGE_POINTS) for candidate in candidates]
    calls = [
        (evidence.imu, table, c.model, (*c.model.terms, *c.added), evidence.block % 2 == fold, depth_spread_per_m)
        for c, table in zip(candidates, tables, strict=True)
        for fold in (0, 1)
    ]
    halves = each(_held_out, calls)
    judged = []
    for candidate, table, first, second in zip(candidates, tables, halves[::2], halves[1::2], strict=True):
        distance = np.where(evidence.block[table.pair] % 2 == 0, second, first)
        block = evidence.block[table.pair]
        mean = loss(distance, scale)
        by_pair = np.bincount(table.pair, mean) / np.maximum(np.bincount(table.pair), 1)
        by_block = np.bincount(block, mean) / np.maximum(np.bincount(block), 1)
        judged.append(Judged(candidate, by_block, by_pair, capped_rms(distance)))
    return judged


def _held_out(
    imu: ImuSamples, table: TrackTable, model: Model, terms: Sequence[Term], use: Mask, depth_spread_per_m: float
) -> Array:
    """Distances (n,) of all points from a fit on the pairs in ``use`` (pairs,)."""
    fitted = fit_model(imu, model, terms, table.chosen(use[table.pair]))
    return distances(imu, fitted, table, depth_spread_per_m)


def lagging_gain(evidence: Evidence, before: Judged, after: Judged) -> Array:
    """Gain (blocks,) of the pairs that a start-up schedule moves, by blocks of neighbours that share errors."""
    last = after.candidate.model.profile.extensions.frame_lag_frames
    moved = np.array([pair.first <= last for pair in evidence.observed.pairs])
    both = min(len(before.pair_loss), len(after.pair_loss), len(moved))
    gain = (before.pair_loss[:both] - after.pair_loss[:both])[moved[:both]]
    parts = np.array_split(gain, max(min(len(gain) // LAGGING_BLOCK, MOST_LAGGING_BLOCKS), 3))
    return np.array([part.mean() for part in parts if len(part)])


def chance_of(gain: Array) -> float:
    """Probability (one-sided t test) of so even a gain (blocks,) where there is none."""
    return float(stats.t.sf(t_ratio(gain), max(len(gain) - 1, 1)))


def t_ratio(values: Array) -> float:
    """Mean over its standard error."""
    if len(values) < 3:
        return 0.0
    return float(values.mean() / max(values.std(ddof=1) / np.sqrt(len(values)), 1e-12))
