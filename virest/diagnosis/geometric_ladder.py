"""The ladder for what moves points: rung by rung the cause that best predicts stretches of time it was not fitted to.

On each rung every cause is fitted together with those already in; the most promising are then fitted on half of the
blocks of time and judged on the other half, both ways.  The best enters if the gain holds in the blocks (a t test) and
its value is significant against a deviation that includes tracking's own bias.  Then all are fitted together again, and
what is no longer significant leaves.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile
from virest.diagnosis.candidates import SCREEN_POINTS, Candidate, FarStart, candidates_of, worth_beginning
from virest.diagnosis.cross_validation import (
    JUDGE_POINTS,
    Judged,
    Screened,
    best_of_each,
    choose,
    judge,
    lagging_gain,
    promising,
    race,
    screen,
)
from virest.diagnosis.findings import GEOMETRY, JOINED, Rival, Rung
from virest.diagnosis.geometric_conclusion import conclude
from virest.diagnosis.geometric_evidence import Evidence, Model, base_scene
from virest.diagnosis.geometric_significance import fitted_with, is_plausible, p_of, p_value_of, refitted, significant
from virest.diagnosis.geometric_verdict import FINAL_POINTS, Accepted, GeometricVerdict
from virest.diagnosis.left_open import variance_left_open
from virest.diagnosis.selection import POINT_LEVELS
from virest.inference.chance import chance_of, t_ratio
from virest.inference.parallel import ParallelMap, one_by_one
from virest.inference.recorder_lag import Schedule
from virest.inference.track_fit import Term

__all__ = ["FINAL_POINTS", "MAX_RUNGS", "Accepted", "GeometricVerdict", "Trial", "climb", "p_of"]

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
PROMISING = 3
"""Causes that each fold chooses from."""
MAX_P, MIN_GAIN, LARGE_GAIN = POINT_LEVELS.max_p, POINT_LEVELS.least_gain, POINT_LEVELS.evenness[-1][0]
"""Fields are searched for by the levels of named causes."""
FEEBLE_GAIN, ASTRAY_SCALE = 0.1, 1.25
"""A cause that takes less than this part away, while points are this many times their noise from where the model puts
them, is not what is wrong: two that gain little alone are then tried together."""
PAIR_FIRSTS, PAIRS_JUDGED = 8, 4
"""The best causes alone, each beside all others, which it may hide; pairs that each fold chooses from."""
RIVAL_T = 2.0
"""A cause rivals the best if the blocks do not prefer the best by this many standard errors."""
EVEN_T = 0.25
"""Of two rivals neither is the better one below this many standard errors."""
PLAINER = {"gyro_lowpass": "time_offset", "pixel_aspect": "focal_length"}
"""A low pass is a delay but for fast turns, and pixels that are not square another focal length but for one of two
directions: where points do not tell, the plainer cause is said, with the other as its rival."""
MAX_RUNGS = 5


def climb(
    evidence: Evidence,
    nominal: CameraProfile,
    null_terms: Sequence[Term],
    lags: Sequence[Schedule],
    far: FarStart | None = None,
    progress: Callable[[float], None] | None = None,
    max_rungs: int = MAX_RUNGS,
    each: ParallelMap = one_by_one,
) -> GeometricVerdict:
    """Climb from a profile; null_terms: unknown values, fitted on every rung and no cause.

    lags: the start-up schedules to try.  far: changes at which turns were seen to agree.
    Where a rival might have entered first, the ladder is climbed once more from there, with the causes of the first
    climb alone: whatever else the rival needs makes it the less simple explanation.
    """
    say = progress or (lambda _: None)
    start = Model(nominal, None, tuple(null_terms))
    start = replace(start, scene=base_scene(evidence, nominal, evidence.table(start, SCREEN_POINTS)))
    model, notes = _with_unknowns(evidence, start)
    nominal_model = model
    course = SearchContext(evidence, nominal, lags, far or FarStart(), each)
    say(0.1)
    path, fork = _ascended(course, _Path(model, (), ()), max_rungs)
    say(0.6)
    verdict = conclude(evidence, nominal_model, path.model, list(path.accepted), list(path.rungs), nominal)
    if fork is not None:
        among = frozenset(entry.name for entry in path.accepted)
        other, _ = _ascended(replace(course, among=among), fork, max_rungs)
        say(0.9)
        rival = conclude(evidence, nominal_model, other.model, list(other.accepted), list(other.rungs), nominal)
        verdict = _either(evidence, verdict, rival)
    verdict.left_open = _left_open(course, verdict)
    verdict.notes += notes
    return verdict


def _left_open(course: SearchContext, verdict: GeometricVerdict) -> dict[str, Array]:
    """What further causes leave open in the values of those that entered, where points stay astray."""
    effects = [entry.effect for entry in verdict.accepted if entry.effect is not None and entry.effect.term is not None]
    if not effects or verdict.fit.scale < ASTRAY_SCALE:
        return {}
    tried = {entry.name for entry in verdict.accepted}
    further = [candidate for candidate in course.candidates(verdict.model, tried) if candidate.added]
    return variance_left_open(course.evidence, verdict.model, effects, further, is_plausible, course.each)


@dataclass(frozen=True, slots=True)
class _Path:
    """A way up the ladder so far."""

    model: Model
    accepted: tuple[Accepted, ...]
    rungs: tuple[Rung, ...]

    def further(self, evidence: Evidence, step: _Step, rung: Rung) -> _Path:
        """With what enters on the next rung."""
        model, _ = refitted(evidence, step.model, JUDGE_POINTS)
        log.debug("rung %d: %s", len(self.rungs) + 1, _names(step))
        entered = replace(rung, entered=_names(step))
        return _Path(model, (*self.accepted, *step.accepted), (*self.rungs, entered))


def _ascended(course: SearchContext, path: _Path, max_rungs: int) -> tuple[_Path, _Path | None]:
    """The path to its end, and the one that leaves it where it first might as well have gone another way."""
    fork: tuple[_Path, _Step, Rung] | None = None
    while len(path.rungs) < max_rungs:
        step, rival, rung = _rung(course, path.model, list(path.accepted))
        if step is None:
            path = replace(path, rungs=(*path.rungs, rung))
            break
        if rival is not None and fork is None:
            fork = (path, rival, rung)
        path = path.further(course.evidence, step, rung)
    return path, None if fork is None else fork[0].further(course.evidence, *fork[1:])


def _either(evidence: Evidence, first: GeometricVerdict, second: GeometricVerdict) -> GeometricVerdict:
    """The better of two ends of the ladder by held-out blocks; where those do not tell, one with the other as a rival.

    Which of the two was reached first may depend on rounding; which is told must not.  Where the blocks do not tell, it
    is the end with fewer causes; of equally many, the one with the lower held-out loss; where that differs by less than
    EVEN_T standard errors, so that rounding may change the order, the names decide.  Of two with the same causes, which
    differ by where their fits ended, it is the first.
    """
    if {entry.name for entry in first.accepted} == {entry.name for entry in second.accepted}:
        return first
    ends = [
        Screened(Candidate("", end.model, (), None), (end.model, end.model), (0.0, 0.0), end.fit.scale, 0.0)
        for end in (first, second)
    ]
    spread = max(first.fit.depth_spread_per_m, second.fit.depth_spread_per_m)
    one, other = judge(evidence, ends, min(first.fit.scale, second.fit.scale), spread, one_by_one)
    worse = t_ratio(other.block_loss - one.block_loss)
    if abs(worse) >= RIVAL_T:
        return first if worse > 0 else second
    better = first if worse > 0 else second
    chosen, rival = sorted(
        (first, second),
        key=lambda end: (
            len(end.accepted),
            sum(PLAINER.get(entry.name) is not None for entry in end.accepted),
            abs(worse) >= EVEN_T and end is not better,
            sorted(e.name for e in end.accepted),
        ),
    )
    rms = (other if rival is second else one).rms * evidence.typical_px
    names = {entry.name for entry in chosen.accepted}
    instead = [Rival(entry.name, rms) for entry in rival.accepted if entry.name not in names]
    shared = names & {entry.name for entry in rival.accepted}
    chosen.accepted = [
        entry if entry.name in shared else replace(entry, rivals=_joined(entry.rivals, instead))
        for entry in chosen.accepted
    ]
    if instead:
        chosen.notes.append(
            f"{' and '.join(r.name for r in instead)} in place of others would explain the points equally well"
        )
    chosen.rival = rival
    return chosen


def _joined(rivals: Sequence[Rival], more: Sequence[Rival]) -> tuple[Rival, ...]:
    known = {rival.name for rival in rivals}
    return (*rivals, *(rival for rival in more if rival.name not in known))


def _with_unknowns(evidence: Evidence, start: Model) -> tuple[Model, list[str]]:
    """The model with its unknown values fitted; those that end where no camera is stay where they began."""
    model, notes = refitted(evidence, start, SCREEN_POINTS)[0], []
    at_ends = evidence.impossible(model.profile) - evidence.impossible(start.profile)
    if "readout_time" in evidence.impossible(model.profile):
        at_ends |= {"readout_time"}
    ended = [term.name for term in start.terms if term.name in at_ends]
    if ended:
        known = tuple(term for term in start.terms if term.name not in ended)
        model = refitted(evidence, replace(start, terms=known), SCREEN_POINTS)[0]
        notes = [f"{name} is unknown and cannot be told from the points" for name in ended]
    return model, notes


# ── one rung ─────────────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class SearchContext:
    """What is the same on all rungs."""

    evidence: Evidence
    nominal: CameraProfile
    lags: Sequence[Schedule]
    far: FarStart
    each: ParallelMap
    among: frozenset[str] | None = None
    """Names of the causes that may enter; None: all."""

    def candidates(self, model: Model, tried: set[str]) -> list[Candidate]:
        """All causes not yet in a model."""
        found = candidates_of(self.evidence, self.nominal, model, tried, self.lags, self.far)
        found = [entry for entry in found if self.among is None or entry.name in self.among]
        return worth_beginning(self.evidence, model, found)

    def judged(self, base: Screened, better: Sequence[Screened], count: int) -> Trial:
        """The model without and with each promising cause; losses by the smallest scale, that all can be compared."""
        allowed = promising(base, better, count)
        kept = [entry for entry in better if entry.candidate.name in allowed[0] | allowed[1]]
        scale = min(entry.scale for entry in (base, *kept))
        spread = (kept[0] if kept else base).depth_spread_per_m
        before, *judged = judge(self.evidence, [base, *kept], scale, spread, self.each)
        return Trial(self.evidence, before, judged, allowed, scale)


@dataclass(frozen=True, slots=True)
class Trial:
    """The model without and with each promising cause, on blocks that took no part in the fits."""

    evidence: Evidence
    before: Judged
    judged: list[Judged]
    allowed: tuple[frozenset[str], frozenset[str]]
    """Names that each fold may choose from."""
    scale: float

    def rounds(self) -> Iterator[tuple[Judged, Judged, Array]]:
        """(cause, what choosing one gains, gain by block), best first, each time without those before it.

        The cause is the best over all blocks; what it is judged by was chosen for each block by others.  A lag shows in
        one block, of which others tell nothing: it is judged as it is.
        """
        left = sorted(self.judged, key=lambda entry: float(entry.block_loss.mean()))
        while left:
            after = choose(self.evidence, [self.before, *left], self.allowed, self.scale)
            gain = self.before.block_loss - after.block_loss
            if left[0].candidate.name == "frame_lag":
                after, gain = left[0], lagging_gain(self.evidence, self.before, left[0])
            yield left[0], after, gain
            left = left[1:]


@dataclass(frozen=True, slots=True)
class _Step:
    """What enters on a rung."""

    model: Model
    accepted: tuple[Accepted, ...]
    part: float
    """Of the held-out loss that it takes away."""


def _rung(course: SearchContext, model: Model, accepted: list[Accepted]) -> tuple[_Step | None, _Step | None, Rung]:
    """What enters, what might have entered as well, and the rung."""
    tried = {entry.name for entry in accepted}
    nothing = Candidate("", model, (), None)
    base, *others = screen(course.evidence, [nothing, *course.candidates(model, tried)], course.each)
    better = [entry for entry in best_of_each(others) if min(np.subtract(entry.losses, base.losses)) < 0]
    trial = course.judged(base, better, PROMISING)
    typical = course.evidence.typical_px
    rung = Rung(None, {j.candidate.name: j.rms * typical for j in trial.judged}, trial.before.rms * typical, GEOMETRY)
    step, rival = _best_single(model, trial)
    feeble = step is None or step.part < FEEBLE_GAIN
    if feeble and better and min(entry.scale for entry in (base, *better)) > ASTRAY_SCALE:
        pair, other = _best_pair(course, model, tried, base, better)
        if pair is not None:
            step, rival = pair, other
            rung = replace(rung, tried={**rung.tried, _names(pair): pair.accepted[0].after})
    return step, rival, rung


def _names(step: _Step) -> str:
    return JOINED.join(entry.name for entry in step.accepted)


def _best_single(model: Model, trial: Trial) -> tuple[_Step | None, _Step | None]:
    """The cause that takes most away where it was neither fitted nor chosen, if that holds, and its strongest rival."""
    evidence, before, judged = trial.evidence, trial.before, trial.judged
    typical = evidence.typical_px
    for best, after, gain in trial.rounds():
        part = float(gain.mean() / before.block_loss.mean())
        if not POINT_LEVELS.holds(part, chance_of(gain)):
            continue
        entered, p_value = significant(evidence, best.candidate, model.profile, gain)
        if entered is None:
            continue
        others = [other for other in judged if other is not best and _rivals(before, best, other, gain)]
        plainer = [other for other in others if other.candidate.name == PLAINER.get(best.candidate.name)]
        if plainer:
            into, p_plainer = significant(evidence, plainer[0].candidate, model.profile, gain)
            if into is not None:
                others = [best, *(other for other in others if other is not plainer[0])]
                best, after, entered, p_value = plainer[0], plainer[0], into, p_plainer
        rivals = tuple(Rival(other.candidate.name, other.rms * typical) for other in others)
        cause = Accepted(
            best.candidate.name, best.candidate.effect, best.candidate.word,
            before.rms * typical, after.rms * typical, p_value, rivals,
        )  # fmt: skip
        return _Step(entered, (cause,), part), _rival_step(model, trial, others, part)
    return None, None


def _rivals(before: Judged, best: Judged, other: Judged, gain: Array) -> bool:
    """Whether the blocks do not prefer the best to another that gains at least half as much."""
    apart = t_ratio(other.block_loss - best.block_loss)
    return apart < RIVAL_T and (before.block_loss - other.block_loss).mean() > 0.5 * gain.mean()


def _rival_step(model: Model, trial: Trial, others: Sequence[Judged], part: float) -> _Step | None:
    """The strongest of the rivals that is significant too."""
    typical = trial.evidence.typical_px
    for other in sorted(others, key=lambda entry: float(entry.block_loss.mean())):
        gain = trial.before.block_loss - other.block_loss
        entered, p_value = significant(trial.evidence, other.candidate, model.profile, gain)
        if entered is not None:
            kind = other.candidate
            cause = Accepted(
                kind.name, kind.effect, kind.word, trial.before.rms * typical, other.rms * typical, p_value, ()
            )
            return _Step(entered, (cause,), part)
    return None


def _best_pair(
    course: SearchContext, model: Model, tried: set[str], base: Screened, better: Sequence[Screened]
) -> tuple[_Step | None, _Step | None]:
    """Two causes that gain together what neither does alone, while points are far from where the model puts them.

    A stabiliser hides the clocks' drift, and the drift blurs what the stabiliser does.
    """
    pairs: list[Candidate] = []
    members_of: dict[str, tuple[Candidate, Candidate]] = {}
    done: set[str] = set()
    for first in [entry.candidate for entry in better if entry.candidate.added][:PAIR_FIRSTS]:
        with_it = replace(first.model, terms=(*first.model.terms, *first.added))
        done |= {first.name}  # A beside B is B beside A
        for second in course.candidates(with_it, {*tried, *done}):
            if second.added:
                name = f"{first.name}{JOINED}{second.name}"
                members_of[name] = first, second
                pairs.append(replace(second, name=name))
    if not pairs:
        return None, None
    found = best_of_each(race(course.evidence, pairs, PAIRS_JUDGED, course.each))
    trial = course.judged(base, found, PAIRS_JUDGED)
    before = trial.before
    for pair, after, gain in trial.rounds():
        part = float(gain.mean() / before.block_loss.mean())
        if part < FEEBLE_GAIN or not POINT_LEVELS.holds(part, chance_of(gain)):
            continue
        step = _pair_step(model, trial, members_of[pair.candidate.name], pair, after)
        if step is not None:
            others = [other for other in trial.judged if other is not pair and _rivals(before, pair, other, gain)]
            steps = (_pair_step(model, trial, members_of[o.candidate.name], o, o) for o in sorted(others, key=_by_loss))
            return step, next((other for other in steps if other is not None), None)
    return None, None


def _by_loss(entry: Judged) -> float:
    return float(entry.block_loss.mean())


def _pair_step(
    model: Model, trial: Trial, members: tuple[Candidate, Candidate], pair: Judged, after: Judged
) -> _Step | None:
    """Two causes that enter together, if both are significant beside each other."""
    evidence, before, typical = trial.evidence, trial.before, trial.evidence.typical_px
    entered, fitted = fitted_with(evidence, pair.candidate)
    p_values = [p_value_of(evidence, fitted, member, entered.profile, model.profile) for member in members]
    if not all(map(POINT_LEVELS.significant, p_values)):
        return None
    causes = tuple(
        Accepted(member.name, member.effect, "", before.rms * typical, after.rms * typical, p_value, ())
        for member, p_value in zip(members, p_values, strict=True)
    )
    return _Step(entered, causes, float((before.block_loss - after.block_loss).mean() / before.block_loss.mean()))


# ── conclusions ──────────────────────────────────────────────────────────────────────────────────────────────────
