"""Score all field forms on the residuals at once, after removing everything that the named causes can explain.

Whitened residuals are regressed on each form's effect on the points, after the tangent space of all named causes and
of the scene has been projected out of both ("orthogonal discrepancy": Plumlee 2017, doi:10.1080/01621459.2016.1211016;
Kennedy & O'Hagan 2001, doi:10.1111/1467-9868.00294).  A form's score is tested by flipping the signs of whole blocks of
time (Hemerik, Goeman & Finos 2020, doi:10.1111/rssb.12369).  The p value is multiplied by the number of forms, so that
the false-alarm rate is that of the whole set.  A form's gain is measured on time blocks and on parts of the capture
that it was not fitted to.  Its stability is the fraction of resampled block sets in which it is selected again
(Meinshausen & Bühlmann 2010, doi:10.1111/j.1467-9868.2010.00740.x).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from virest.arrays import Array, Index
from virest.inference.chance import gamma_tail, t_ratio

FLIPS, DRAWS = 500, 60
"""Random flips of the blocks' signs: of a chi-square of one degree of freedom, the mean comes out to 6 % and the
variance to 17 %.  Bootstrap draws for the stability of a choice, which comes out to 0.06."""
CLOSE_P, MANY_FLIPS, FLIPS_AT_ONCE = 0.1, 200_000, 20_000
"""A p value between MAX_P and CLOSE_P is counted over MANY_FLIPS flips: an effect in all blocks makes the flipped
scores large but bounded, and the gamma distribution with their moments has a longer tail."""
FOLDS, PARTS = 5, 4
"""Interleaved folds for the held-out gain; consecutive parts of the capture for what must not depend on time."""
MIN_BLOCKS = 8
"""Fewest time blocks: two in each of the PARTS.  Their gain exceeds MIN_T by chance in 1 % of cases (Student's t)."""
MIN_OUTSIDE_FRACTION = 1e-3
"""Drop a direction when less than this fraction of it lies outside the tangent space of the named causes."""
RIDGE = 1e-3
"""As a fraction of the largest curvature; regularises undetermined directions."""
MAX_P = 1e-3
"""False-alarm rate of the whole set of forms."""
MIN_T, MIN_LOCAL_T = 3.0, 2.0
"""Minimum ratio of the held-out gain to its standard error, in general and for a form over time.  A gain over time may
lie in a few blocks: if it lies in one seventh of 30 blocks, the ratio is at most 2.2, however large the gain is."""
HALVES_VARIANCE = 12.0
"""Variance, per free number, of the summed gains of both halves of the points, each fitted to the other half, without
an effect: 2 (e'Xv)·2 and v'X'Xv, v and e'X of unit variance, have 4 k + 2 k per half; their mean is −2 k."""
RIVAL_T = 2.0
"""Forms whose gains differ by less than this many standard errors are indistinguishable."""
RIVAL_GAIN_FRACTION = 0.9
"""A form with more than this fraction of the best gain is also a rival: its covariate is correlated with the best's."""
MIN_STABILITY = 0.7
"""Minimum fraction of resamples in which the form, or one indistinguishable from it, is the best."""


@dataclass(frozen=True, slots=True)
class Design:
    """What a form does to the residuals."""

    name: str
    effect: Array
    """(n, d, k) per free number, in standard deviations."""
    over_time: bool
    """Whether it runs over time, so that one part of the capture cannot predict another."""
    local: bool = False
    """Whether its knots are as dense as the blocks.  Then one block cannot predict another; held-out points of the same
    block are used instead."""


@dataclass(frozen=True, slots=True)
class Scored:
    """One form's scores."""

    index: int
    """Index of its design among those given."""
    name: str
    numbers: int
    p_value: float
    """For the whole set of forms."""
    gain: Array
    """(blocks,) reduction of the squared whitened residual in held-out blocks."""
    parts_gain: Array | None
    """(blocks,) the same with whole parts of the capture held out; None for forms over time."""
    local: bool = False
    """Whether the gain is measured on held-out points of the fitted blocks."""

    @property
    def significant(self) -> bool:
        """Whether the p value and every held-out gain pass their limits."""
        return self.holds(MIN_T)

    def holds(self, least_t: float) -> bool:
        """Whether the p value passes and every measured gain exceeds least_t standard errors."""
        if self.local:
            return self.p_value < MAX_P and float(self.gain.sum()) > least_t * np.sqrt(HALVES_VARIANCE * self.numbers)
        if self.parts_gain is None:
            return self.p_value < MAX_P and t_ratio(self.gain) > MIN_LOCAL_T
        return self.p_value < MAX_P and all(t_ratio(gain) > least_t for gain in (self.gain, self.parts_gain))


@dataclass(frozen=True, slots=True)
class Selection:
    """The best form and those indistinguishable from it."""

    best: Scored
    rivals: tuple[str, ...]
    stability: float
    size: float
    """Rms of what it explains, in units of the residuals."""


@dataclass(frozen=True, slots=True)
class _Block:
    """Sums of one form over blocks."""

    index: int
    name: str
    pull: Array
    """(blocks, k) X'e; for time blocks, both halves of their points alternate."""
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
    time_block: Index | None = None,
    seed: int = 0,
    forms_tested: int | None = None,
) -> list[Scored]:
    """Score forms, best gain first.

    left: (n, d) residuals in standard deviations; weight (n,); tangent (n, d, m); block (n,) number of
    the block of time, ascending; time_block (n,) the same for shorter intervals within blocks, on which forms over time
    are tested, because only a few blocks cover each knot.  forms_tested: total number of forms tested; None: these.
    """
    root = np.repeat(np.sqrt(weight), left.shape[1])[:, None]
    frame = _orthonormal(tangent.reshape(len(root), -1) * root)
    error = left.reshape(-1, 1) * root
    error = (error - frame @ (frame.T @ error))[:, 0]
    time_blocks, fine = np.unique(block if time_block is None else time_block, return_inverse=True)
    coarse = np.zeros(len(time_blocks), np.intp)
    coarse[fine] = np.unique(block, return_inverse=True)[1]
    half = np.arange(len(left)) % 2
    of_row = np.repeat(2 * fine + half, left.shape[1])
    summed = (_summed(k, form, root, frame, error, of_row, 2 * len(time_blocks)) for k, form in enumerate(designs))
    blocks = [entry for entry in summed if entry is not None]
    signs = np.random.default_rng(seed).choice((-1.0, 1.0), (FLIPS, len(time_blocks)))
    scored = [_scored(entry, coarse, signs, forms_tested or len(blocks)) for entry in blocks]
    return sorted(scored, key=lambda s: -float(s.gain.sum()))


def select(scored: Sequence[Scored], total_weight: float, seed: int = 1, least_t: float = MIN_T) -> Selection | None:
    """The simplest form indistinguishable from the best; None where none is significant or stable.

    least_t: minimum ratio of the held-out gain to its standard error; RIVAL_T for a form that is to replace another
    explanation.
    """
    good = [entry for entry in scored if entry.holds(least_t)]
    if not good:
        return None
    least = RIVAL_GAIN_FRACTION * float(good[0].gain.sum())
    alike = [e for e in good if t_ratio(good[0].gain - e.gain) < RIVAL_T or float(e.gain.sum()) > least]
    best = min(alike, key=lambda s: (s.numbers, -float(s.gain.sum())))
    draws = np.random.default_rng(seed).integers(0, len(best.gain), (DRAWS, len(best.gain)))
    totals = np.stack([entry.gain[draws].sum(axis=1) for entry in scored])
    family = [k for k, entry in enumerate(scored) if entry in alike]
    stability = float(np.mean(np.isin(np.argmax(totals, axis=0), family)))
    if stability < MIN_STABILITY:
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
    index: int, form: Design, root: Array, frame: Array, error: Array, of_row: Index, count: int
) -> _Block | None:
    """Sums over groups of rows, in the form's directions outside the tangent space; None where it has none."""
    design = form.effect.reshape(len(root), -1) * root
    own = design - frame @ (frame.T @ design)
    full, kept = design.T @ design, own.T @ own
    # sort directions by the fraction that lies outside the tangent space
    values, vectors = np.linalg.eigh(full)
    rank = values > 1e-10 * max(float(values.max()), 1e-12)
    whiten = vectors[:, rank] / np.sqrt(values[rank])
    share, turn = np.linalg.eigh(whiten.T @ kept @ whiten)
    basis = (whiten @ turn)[:, share > MIN_OUTSIDE_FRACTION]
    if not basis.shape[1]:
        return None
    own = own @ basis
    pull: Array = np.stack([np.bincount(of_row, column * error, count) for column in own.T], axis=-1).astype(float)
    order = np.argsort(of_row, kind="stable")
    edges = np.searchsorted(of_row[order], np.arange(count + 1))
    curvature: Array = np.stack([own[order[a:b]].T @ own[order[a:b]] for a, b in pairwise(edges)])
    return _Block(index, form.name, pull, curvature, form.over_time, form.local)


def _scored(entry: _Block, coarse: Index, signs: Array, forms: int) -> Scored:
    halves = np.arange(len(entry.pull))
    time_blocks = _grouped(entry, halves // 2)
    by_block = _grouped(time_blocks, coarse)
    tested = time_blocks if entry.over_time else by_block
    count, numbers = tested.pull.shape
    total, inverse = tested.pull.sum(axis=0), _solver(tested.curvature.sum(axis=0))
    flipped = signs[:, :count] @ tested.pull
    drawn = np.einsum("fk,kl,fl->f", flipped, inverse, flipped)
    observed = float(total @ inverse @ total)
    scale = max(float(drawn.var() / max(drawn.mean(), 1e-300)), 1e-300)
    p_value = gamma_tail(observed, max(float(drawn.mean()) / scale, 1e-3), scale)
    if MAX_P <= p_value * forms < CLOSE_P:
        p_value = (1 + _flips_that_reach(observed, tested.pull, inverse)) / (1 + MANY_FLIPS)
    block = np.arange(len(by_block.pull))
    gain = (
        _added(_held_out(entry, halves % 2), coarse[halves // 2]) if entry.local else _held_out(by_block, block % FOLDS)
    )
    parts = None if entry.over_time else _held_out(by_block, block * PARTS // len(block))
    return Scored(entry.index, entry.name, numbers, min(p_value * forms, 1.0), gain, parts, entry.local)


def _flips_that_reach(observed: float, pull: Array, inverse: Array) -> int:
    """Number of MANY_FLIPS random flips of the blocks' signs whose score reaches the observed one."""
    rng, reached, total = np.random.default_rng(len(pull)), 0, pull.sum(axis=0)
    for _ in range(MANY_FLIPS // FLIPS_AT_ONCE):
        drawn = rng.integers(0, 256, (FLIPS_AT_ONCE, -(-len(pull) // 8)), np.uint8)
        kept = np.unpackbits(drawn, axis=1, count=len(pull)).astype(float)
        flipped = 2.0 * (kept @ pull) - total
        reached += int(np.sum(np.einsum("fk,fk->f", flipped @ inverse, flipped) >= observed))
    return reached


def _grouped(entry: _Block, group: Index) -> _Block:
    return replace(entry, pull=_added(entry.pull, group), curvature=_added(entry.curvature, group))


def _added(sums: Array, group: Index) -> Array:
    """Sums (groups, ...) of entries (n, ...)."""
    total = np.zeros((int(group.max()) + 1, *sums.shape[1:]))
    np.add.at(total, group, sums)
    return total


def _held_out(entry: _Block, fold: Index) -> Array:
    """Reduction (blocks,) of the squared residual in each block by a fit to the other folds."""
    gain = np.zeros(len(entry.pull))
    for number in np.unique(fold):
        out = fold == number
        value = _solver(entry.curvature[~out].sum(axis=0)) @ entry.pull[~out].sum(axis=0)
        gain[out] = 2 * entry.pull[out] @ value - np.einsum("k,bkl,l->b", value, entry.curvature[out], value)
    return gain


def _solver(curvature: Array) -> Array:
    ridge = RIDGE * max(float(np.diag(curvature).max(initial=0.0)), 1e-12)
    return np.asarray(np.linalg.inv(curvature + ridge * np.eye(len(curvature))))
