"""Which form do the residuals ask for?  Scores of all forms at once, beside everything that the named causes can do.

Whitened residuals are regressed on each form's effect on the points, after the tangent space of all named causes and
of the scene has been projected out of both ("orthogonal discrepancy": Plumlee 2017, doi:10.1080/01621459.2016.1211016;
Kennedy & O'Hagan 2001, doi:10.1111/1467-9868.00294).  A form's score is tested by flipping the signs of whole blocks of
time (Hemerik, Goeman & Finos 2020, doi:10.1111/rssb.12369), times the number of forms, so that the false-alarm rate is
that of the whole set.  What a form gains is measured on blocks of time and on parts of the capture that it was not
fitted to, and whether it is chosen again when blocks are drawn anew is counted (Meinshausen & Bühlmann 2010,
doi:10.1111/j.1467-9868.2010.00740.x).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from virest.inference.chance import t_ratio

Array = NDArray[np.float64]
Index = NDArray[np.intp]
FLIPS, DRAWS = 500, 60
FOLDS, PARTS = 5, 4
OWN_PART = 1e-3
"""A direction of which less than this part is not in the named causes' tangent space is theirs."""
RIDGE = 1e-3
"""Of the largest curvature: holds directions that nothing tells."""
MAX_P = 1e-3
"""False-alarm rate of the whole set of forms."""
MIN_T, MIN_LOCAL_T = 3.0, 2.0
"""Least ratio of the held-out gain to its standard error; of a form over time, whose gain may lie in a few blocks: one
in seven of 30 blocks makes no more than 2.2, however large it is there."""
HALVES_VARIANCE = 12.0
"""Of the gain of either half of the points by a fit of k numbers to the other, per number, where there is nothing to
gain: 2 (e'Xv)·2 and v'X'Xv, v and e'X of unit variance, have 4 k + 2 k each time; their mean is −2 k."""
RIVAL_T = 2.0
"""Forms whose gains differ by less than this many standard errors cannot be told apart."""
ALIKE_PART = 0.9
"""Nor can one that gains this part of the best's gain be ruled out: its covariate goes together with the best's."""
MIN_STABLE = 0.7
"""Least part of the draws in which the form, or one that cannot be told from it, is the best."""


@dataclass(frozen=True, slots=True)
class Design:
    """What a form does to the residuals."""

    name: str
    effect: Array
    """(n, d, k) per free number, in standard deviations."""
    over_time: bool
    """Whether it runs over time, so that no part of the capture tells of another."""
    local: bool = False
    """Whether its knots lie as close as blocks, so that no block tells of another either: other points of them do."""


@dataclass(frozen=True, slots=True)
class Scored:
    """One form's scores."""

    place: int
    """Of its design among those given."""
    name: str
    numbers: int
    p_value: float
    """For the whole set of forms."""
    gain: Array
    """(blocks,) squared whitened residual taken away in blocks that were not fitted."""
    parts_gain: Array | None
    """(blocks,) the same, with whole parts of the capture left out; None where that cannot be asked."""
    local: bool = False
    """Whether the gain is that of other points of the blocks that were fitted."""

    @property
    def significant(self) -> bool:
        """Whether chance is ruled out and the gain holds wherever it was asked for."""
        return self.holds(MIN_T)

    def holds(self, least_t: float) -> bool:
        """Whether chance is ruled out and every gain that was asked for exceeds least_t standard errors."""
        if self.local:
            return self.p_value < MAX_P and float(self.gain.sum()) > least_t * np.sqrt(HALVES_VARIANCE * self.numbers)
        if self.parts_gain is None:
            return self.p_value < MAX_P and t_ratio(self.gain) > MIN_LOCAL_T
        return self.p_value < MAX_P and all(t_ratio(gain) > least_t for gain in (self.gain, self.parts_gain))


@dataclass(frozen=True, slots=True)
class Selection:
    """The best form, if any, and what cannot be told from it."""

    best: Scored
    rivals: tuple[str, ...]
    stability: float
    size: float
    """Rms of what it explains, in units of the residuals."""


@dataclass(frozen=True, slots=True)
class _Block:
    """Sums of one form over blocks."""

    place: int
    name: str
    pull: Array
    """(blocks, k) X'e; of moments of time for both halves of their points in turn."""
    curvature: Array
    """(blocks, k, k) X'X."""
    over_time: bool
    local: bool


def score_forms(
    left: Array,
    weight: Array,
    tangent: Array,
    designs: Sequence[Design],
    block: Index,
    moment: Index | None = None,
    seed: int = 0,
    asked: int | None = None,
) -> list[Scored]:
    """Score forms, best gain first.

    left: (n, d) residuals in standard deviations; weight (n,); tangent (n, d, m); block (n,) number of
    the block of time, rising; moment (n,) the same of shorter stretches within blocks, by which forms over time are
    tested: a few blocks hold each knot.  asked: how many forms are asked for in all; None: these.
    """
    root = np.repeat(np.sqrt(weight), left.shape[1])[:, None]
    frame = _orthonormal(tangent.reshape(len(root), -1) * root)
    error = left.reshape(-1, 1) * root
    error = (error - frame @ (frame.T @ error))[:, 0]
    moments, fine = np.unique(block if moment is None else moment, return_inverse=True)
    coarse = np.zeros(len(moments), np.intp)
    coarse[fine] = np.unique(block, return_inverse=True)[1]
    half = np.arange(len(left)) % 2
    of_row = np.repeat(2 * fine + half, left.shape[1])
    summed = (_summed(k, form, root, frame, error, of_row, 2 * len(moments)) for k, form in enumerate(designs))
    blocks = [entry for entry in summed if entry is not None]
    signs = np.random.default_rng(seed).choice((-1.0, 1.0), (FLIPS, len(moments)))
    scored = [_scored(entry, coarse, signs, asked or len(blocks)) for entry in blocks]
    return sorted(scored, key=lambda s: -float(s.gain.sum()))


def select(scored: Sequence[Scored], total_weight: float, seed: int = 1, least_t: float = MIN_T) -> Selection | None:
    """The simplest of the forms that cannot be told from the best; None where none is significant or stable.

    least_t: of what a form gains where it was not fitted; RIVAL_T where it is to take another explanation's place.
    """
    good = [entry for entry in scored if entry.holds(least_t)]
    if not good:
        return None
    least = ALIKE_PART * float(good[0].gain.sum())
    alike = [e for e in good if t_ratio(good[0].gain - e.gain) < RIVAL_T or float(e.gain.sum()) > least]
    best = min(alike, key=lambda s: (s.numbers, -float(s.gain.sum())))
    draws = np.random.default_rng(seed).integers(0, len(best.gain), (DRAWS, len(best.gain)))
    totals = np.stack([entry.gain[draws].sum(axis=1) for entry in scored])
    family = [k for k, entry in enumerate(scored) if entry in alike]
    stability = float(np.mean(np.isin(np.argmax(totals, axis=0), family)))
    if stability < MIN_STABLE:
        return None
    size = float(np.sqrt(max(best.gain.sum(), 0.0) / (2 * total_weight)))
    return Selection(best, tuple(entry.name for entry in alike if entry is not best), stability, size)


def _orthonormal(columns: Array) -> Array:
    """Orthonormal columns that span the given ones."""
    if not columns.shape[1]:
        return columns
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
    u, singular, _ = np.linalg.svd(columns / size, full_matrices=False)
    return np.asarray(u[:, singular > 1e-6 * singular[0]])


def _summed(
    place: int, form: Design, root: Array, frame: Array, error: Array, of_row: Index, count: int
) -> _Block | None:
    """Sums over groups of rows, in the directions of the form that are its own; None where it has none."""
    design = form.effect.reshape(len(root), -1) * root
    own = design - frame @ (frame.T @ design)
    full, kept = design.T @ design, own.T @ own
    # directions by the part of them that the tangent space does not hold
    values, vectors = np.linalg.eigh(full)
    rank = values > 1e-10 * max(float(values.max()), 1e-12)
    whiten = vectors[:, rank] / np.sqrt(values[rank])
    share, turn = np.linalg.eigh(whiten.T @ kept @ whiten)
    basis = (whiten @ turn)[:, share > OWN_PART]
    if not basis.shape[1]:
        return None
    own = own @ basis
    pull: Array = np.stack([np.bincount(of_row, column * error, count) for column in own.T], axis=-1).astype(float)
    order = np.argsort(of_row, kind="stable")
    edges = np.searchsorted(of_row[order], np.arange(count + 1))
    curvature: Array = np.stack([own[order[a:b]].T @ own[order[a:b]] for a, b in pairwise(edges)])
    return _Block(place, form.name, pull, curvature, form.over_time, form.local)


def _scored(entry: _Block, coarse: Index, signs: Array, forms: int) -> Scored:
    halves = np.arange(len(entry.pull))
    moments = _grouped(entry, halves // 2)
    whole = _grouped(moments, coarse)
    tested = moments if entry.over_time else whole
    count, numbers = tested.pull.shape
    total, inverse = tested.pull.sum(axis=0), _solver(tested.curvature.sum(axis=0))
    flipped = signs[:, :count] @ tested.pull
    drawn = np.einsum("fk,kl,fl->f", flipped, inverse, flipped)
    seen = float(total @ inverse @ total)
    scale = max(float(drawn.var() / max(drawn.mean(), 1e-300)), 1e-300)
    p_value = float(stats.gamma.sf(seen, max(float(drawn.mean()) / scale, 1e-3), scale=scale))
    block = np.arange(len(whole.pull))
    gain = _added(_held_out(entry, halves % 2), coarse[halves // 2]) if entry.local else _held_out(whole, block % FOLDS)
    parts = None if entry.over_time else _held_out(whole, block * PARTS // len(block))
    return Scored(entry.place, entry.name, numbers, min(p_value * forms, 1.0), gain, parts, entry.local)


def _grouped(entry: _Block, group: Index) -> _Block:
    return replace(entry, pull=_added(entry.pull, group), curvature=_added(entry.curvature, group))


def _added(sums: Array, group: Index) -> Array:
    """Sums (groups, ...) of entries (n, ...)."""
    total = np.zeros((int(group.max()) + 1, *sums.shape[1:]))
    np.add.at(total, group, sums)
    return total


def _held_out(entry: _Block, fold: Index) -> Array:
    """Squared residual (blocks,) taken away in blocks by a fit to the other folds."""
    gain = np.zeros(len(entry.pull))
    for number in np.unique(fold):
        out = fold == number
        value = _solver(entry.curvature[~out].sum(axis=0)) @ entry.pull[~out].sum(axis=0)
        gain[out] = 2 * entry.pull[out] @ value - np.einsum("k,bkl,l->b", value, entry.curvature[out], value)
    return gain


def _solver(curvature: Array) -> Array:
    ridge = RIDGE * max(float(np.diag(curvature).max(initial=0.0)), 1e-12)
    return np.asarray(np.linalg.inv(curvature + ridge * np.eye(len(curvature))))
