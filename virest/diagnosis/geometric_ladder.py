"""The geometric ladder: stepwise selection of causes that move points, judged on held-out blocks of time.

On each rung every cause is fitted together with those already accepted.  The most promising are then fitted on half of
the time blocks and judged on the other half, both ways.  The best enters if its gain is consistent over the blocks (a
t test) and its value is significant; its standard deviation includes the tracker's bias.  At the end, all accepted
causes are refitted together, and those no longer significant are removed.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from virest.arrays import Array
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
from virest.diagnosis.structure import STRUCTURE_NOISES
from virest.inference.chance import chance_of, t_ratio
from virest.inference.parallel import ParallelMap, one_by_one
from virest.inference.recorder_lag import Schedule
from virest.inference.track_fit import Term

__all__ = ["FINAL_POINTS", "MAX_RUNGS", "Accepted", "GeometricVerdict", "Trial", "climb", "p_of"]

log = logging.getLogger(__name__)

PROMISING = 3
"""Number of causes that each fold may choose from."""
MIN_GAIN, LARGE_GAIN = POINT_LEVELS.least_gain, POINT_LEVELS.evenness[-1][0]
"""Levels of the named causes; the search for fields uses them too."""
SMALL_GAIN, EXCESS_SCALE = 0.1, 1.25
"""Try pairs of causes if the best single cause removes less than this fraction of the loss while the residuals exceed
the noise by this factor."""
PAIR_FIRSTS, PAIRS_JUDGED = 8, 4
"""Number of best single causes that are each paired with all others, which they may hide; and number of pairs that each
fold may choose from."""
RIVAL_T = 2.0
"""A cause is a rival if the blocks prefer the best one by less than this many standard errors."""
EQUAL_T = 0.25
"""Two ends of the ladder are equally good below this many standard errors."""
SIMPLER = {"gyro_lowpass": "time_offset", "pixel_aspect": "focal_length", "gyro_averaging": "gyro_scale"}
"""For slow rotations a low-pass filter is a delay; along one image direction a pixel aspect is a focal length; for
rotations of one frequency averaging is a scale.  Where the points cannot distinguish the two, the simpler cause is
reported, with the other as its rival."""
MOST_GAIN = 0.9
"""Fraction of the best cause's gain that a simpler one must reach to be reported in its place."""
MAX_RUNGS = 5
"""Causes, or pairs of them, that may enter: a limit on time.  A rung with six of them to try takes 0.3 s."""


def climb(
    evidence: Evidence,
    nominal: CameraProfile,
    null_terms: Sequence[Term],
    lags: Sequence[Schedule],
    far: FarStart | None = None,
    progress: Callable[[float], None] | None = None,
    max_rungs: int = MAX_RUNGS,
    each: ParallelMap = one_by_one,
    bridged: Callable[[Model], Model] | None = None,
) -> GeometricVerdict:
    """Climb from a profile.

    null_terms: unknown values; they are fitted on every rung and are not causes.  lags: start-up schedules to try.
    far: changes of clocks and axes at which frame rotations and gyroscope agree.  bridged: estimates the rates in
    doubtful intervals of the log beside a model's causes; called once before the first rung, and after each rung.

    Where a rival could have entered instead, the ladder is climbed once more from there, with only the causes of the
    first climb: a rival that needs any other cause is the less simple explanation.
    """
    report = progress or (lambda _: None)
    start = Model(nominal, None, tuple(null_terms))
    start = replace(start, scene=base_scene(evidence, nominal, evidence.table(start, SCREEN_POINTS)))
    model, notes = _with_unknowns(evidence, start)
    nominal_model = model
    context = SearchContext(evidence, nominal, lags, far or FarStart(), each, bridged=bridged)
    model = context.with_bridges(model)
    report(0.1)
    path, fork = _climbed_to_end(context, _Path(model, (), ()), max_rungs)
    report(0.6)
    verdict = conclude(evidence, nominal_model, path.model, list(path.accepted), list(path.rungs), nominal)
    if fork is not None:
        among = frozenset(entry.name for entry in path.accepted)
        other, _ = _climbed_to_end(replace(context, among=among), fork, max_rungs)
        report(0.9)
        rival = conclude(evidence, nominal_model, other.model, list(other.accepted), list(other.rungs), nominal)
        verdict = _better_end(evidence, verdict, rival)
    verdict.left_open = _left_open(context, verdict)
    verdict.notes += notes
    return verdict


def climb_on(
    evidence: Evidence,
    nominal: CameraProfile,
    model: Model,
    accepted: tuple[Accepted, ...],
    among: frozenset[str] | None = None,
) -> tuple[Model, tuple[Accepted, ...]]:
    """One more rung from a model that holds fields: (model, causes), the same where none enters.

    among: names of the causes that may enter; None: all.
    """
    context = SearchContext(evidence, nominal, (), FarStart(), one_by_one, among)
    step, _, rung = _rung(context, model, list(accepted))
    if step is None:
        return model, accepted
    path = _Path(model, accepted, ()).further(context, step, rung)
    return path.model, path.accepted


def _left_open(context: SearchContext, verdict: GeometricVerdict) -> dict[str, Array]:
    """Variance that further causes would add to the accepted values; empty unless residuals exceed the noise."""
    effects = [entry.effect for entry in verdict.accepted if entry.effect is not None and entry.effect.term is not None]
    if not effects or verdict.fit.scale < EXCESS_SCALE:
        return {}
    tried = {entry.name for entry in verdict.accepted}
    further = [candidate for candidate in context.candidates(verdict.model, tried) if candidate.added]
    return variance_left_open(context.evidence, verdict.model, effects, further, is_plausible, context.each)


@dataclass(frozen=True, slots=True)
class _Path:
    """The rungs climbed so far, and the resulting model."""

    model: Model
    accepted: tuple[Accepted, ...]
    rungs: tuple[Rung, ...]

    def further(self, context: SearchContext, step: _Step, rung: Rung) -> _Path:
        """The path extended by a rung and the causes that enter on it."""
        model, _ = refitted(context.evidence, step.model, JUDGE_POINTS)
        model = context.with_bridges(model)
        log.debug("rung %d: %s", len(self.rungs) + 1, _names(step))
        entered = replace(rung, entered=_names(step))
        return _Path(model, (*self.accepted, *step.accepted), (*self.rungs, entered))


def _climbed_to_end(context: SearchContext, path: _Path, max_rungs: int) -> tuple[_Path, _Path | None]:
    """Climb to the end; returns (path, path that takes the rival at the first rung that had one, else None)."""
    fork: tuple[_Path, _Step, Rung] | None = None
    while len(path.rungs) < max_rungs:
        step, rival, rung = _rung(context, path.model, list(path.accepted))
        if step is None:
            path = replace(path, rungs=(*path.rungs, rung))
            break
        if rival is not None and fork is None:
            fork = (path, rival, rung)
        path = path.further(context, step, rung)
    return path, None if fork is None else fork[0].further(context, *fork[1:])


def _better_end(evidence: Evidence, first: GeometricVerdict, second: GeometricVerdict) -> GeometricVerdict:
    """The end that predicts held-out blocks better; of two equal ends, one with the other as its rival.

    Rounding may decide which end is reached first, but must not decide which is reported.  Of two equal ends, take the
    one with fewer causes; then the one with fewer causes that have a simpler alternative; then the one with the lower
    held-out loss.  If the losses differ by less than EQUAL_T standard errors, rounding may change their
    order, so the names decide.  Two ends with the same causes differ only in where their fits stopped: take the first.
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
    better = first if worse > 0 else second
    nyquist_hz = 0.5 / float(np.median(np.diff(evidence.imu.time_s)))
    if abs(worse) >= RIVAL_T and not differ_by_delay(first, second, nyquist_hz):
        return better
    chosen, rival = sorted(
        (first, second),
        key=lambda end: (
            len(end.accepted),
            _less_simple({entry.name for entry in end.accepted}),
            abs(worse) >= EQUAL_T and end is not better,
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


def differ_by_delay(first: GeometricVerdict, second: GeometricVerdict, nyquist_hz: float) -> bool:
    """Whether two ends differ by a low-pass filter above a log's Nyquist frequency: in the log it is a delay alone.

    Blocks share errors of the tracker, and their statistics would tell such a filter from a time offset.
    """
    simple = [{SIMPLER.get(entry.name, entry.name) for entry in end.accepted} for end in (first, second)]
    cutoff_hz = max(end.model.profile.extensions.gyro_lowpass_hz for end in (first, second))
    return simple[0] == simple[1] and cutoff_hz > nyquist_hz


def _less_simple(names: set[str]) -> int:
    """Number of causes that have a simpler alternative.

    A filter delays and averages: where the averaging is known, the delay is simpler as the filter's than as a clock's.
    """
    needless = set(SIMPLER)
    if "gyro_averaging" in names:
        needless = needless - {"gyro_lowpass"} | {"time_offset"}
    return len(names & needless)


def _joined(rivals: Sequence[Rival], more: Sequence[Rival]) -> tuple[Rival, ...]:
    known = {rival.name for rival in rivals}
    return (*rivals, *(rival for rival in more if rival.name not in known))


def _with_unknowns(evidence: Evidence, start: Model) -> tuple[Model, list[str]]:
    """(model with its unknown values fitted, notes); values with an impossible result keep their initial guess."""
    model, notes = refitted(evidence, start, SCREEN_POINTS)[0], []
    at_ends = evidence.impossible(model.profile) - evidence.impossible(start.profile)
    if "readout_time" in evidence.impossible(model.profile):
        at_ends |= {"readout_time"}
    ended = [term.name for term in start.terms if term.name in at_ends]
    if ended:
        known = tuple(term for term in start.terms if term.name not in ended)
        model = refitted(evidence, replace(start, terms=known), SCREEN_POINTS)[0]
        notes = [f"{name} is unknown and could not be estimated from the points" for name in ended]
    return model, notes


# ── one rung ─────────────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class SearchContext:
    """The inputs that all rungs share."""

    evidence: Evidence
    nominal: CameraProfile
    lags: Sequence[Schedule]
    far: FarStart
    each: ParallelMap
    among: frozenset[str] | None = None
    """Names of the causes that may enter; None: all."""
    bridged: Callable[[Model], Model] | None = None
    """Estimates the rates in doubtful intervals of the log beside a model's causes; None: there are none."""

    def with_bridges(self, model: Model) -> Model:
        """The model with rates in the doubtful intervals of the log; its scene is refitted to the ladder's pairs."""
        return model if self.bridged is None else refitted(self.evidence, self.bridged(model), JUDGE_POINTS)[0]

    def candidates(self, model: Model, tried: set[str]) -> list[Candidate]:
        """All causes that are not in a model yet.

        Beyond a bridge the direction of gravity is uncertain, so the path from the accelerometer tells no depth.
        """
        if self.bridged is not None or model.profile.imu_untrusted_s:
            tried = tried | {"scene_depth"}
        found = candidates_of(self.evidence, self.nominal, model, tried, self.lags, self.far)
        found = [entry for entry in found if self.among is None or entry.name in self.among]
        return worth_beginning(self.evidence, model, found)

    def judged(self, base: Screened, better: Sequence[Screened], count: int) -> Trial:
        """Judge the model without and with each promising cause, all at the smallest scale so that losses compare."""
        allowed = promising(base, better, count)
        kept = [entry for entry in better if entry.candidate.name in allowed[0] | allowed[1]]
        scale = min(entry.scale for entry in (base, *kept))
        spread = (kept[0] if kept else base).depth_spread_per_m
        before, *judged = judge(self.evidence, [base, *kept], scale, spread, self.each)
        return Trial(self.evidence, before, judged, allowed, scale)


@dataclass(frozen=True, slots=True)
class Trial:
    """Held-out losses of the model without and with each promising cause."""

    evidence: Evidence
    before: Judged
    judged: list[Judged]
    allowed: tuple[frozenset[str], frozenset[str]]
    """Names that each fold may choose from."""
    scale: float

    def rounds(self) -> Iterator[tuple[Judged, Judged, Array]]:
        """Yield (cause, result of choosing, gain (blocks,)), best cause first; each round drops the previous causes.

        The cause is the best over all blocks.  The gain is that of choosing a cause for each block by the other blocks.
        A start-up lag shows in one block only, so its gain is measured without such a choice.
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
    """The causes that enter on a rung."""

    model: Model
    accepted: tuple[Accepted, ...]
    part: float
    """Fraction of the held-out loss that they remove."""


def _rung(context: SearchContext, model: Model, accepted: list[Accepted]) -> tuple[_Step | None, _Step | None, Rung]:
    """Climb one rung; returns (step that enters, step of its rival, record of the rung)."""
    tried = {entry.name for entry in accepted}
    nothing = Candidate("", model, (), None)
    (base,) = screen(context.evidence, [nothing], context.each)
    others = race(context.evidence, context.candidates(model, tried), PROMISING, context.each)
    better = [entry for entry in best_of_each(others) if min(np.subtract(entry.losses, base.losses)) < 0]
    trial = context.judged(base, better, PROMISING)
    typical = context.evidence.typical_px
    rung = Rung(None, {j.candidate.name: j.rms * typical for j in trial.judged}, trial.before.rms * typical, GEOMETRY)
    step, rival = _best_single(model, trial)
    small = step is None or step.part < SMALL_GAIN
    scale = base.scale if step is None else min(entry.scale for entry in (base, *better))
    if small and better and scale > EXCESS_SCALE:
        pair, other = _best_pair(context, model, tried, base, better)
        if pair is not None:
            step, rival = pair, other
            rung = replace(rung, tried={**rung.tried, _names(pair): pair.accepted[0].after})
    return step, rival, rung


def _names(step: _Step) -> str:
    return JOINED.join(entry.name for entry in step.accepted)


def _best_single(model: Model, trial: Trial) -> tuple[_Step | None, _Step | None]:
    """The best cause with a significant gain and value, and its strongest rival."""
    evidence, before, judged = trial.evidence, trial.before, trial.judged
    typical = evidence.typical_px
    for best, after, gain in trial.rounds():
        part = float(gain.mean() / before.block_loss.mean())
        if not POINT_LEVELS.holds(part, chance_of(gain)):
            continue
        entered, p_value = significant(evidence, best.candidate, model.profile, gain)
        if entered is None:
            continue
        others = [
            other
            for other in judged
            if other is not best and (_is_rival(before, best, other, gain) or _is_simpler(before, best, other, gain))
        ]
        simpler = [other for other in others if other.candidate.name == SIMPLER.get(best.candidate.name)]
        if simpler:
            into, p_simpler = significant(evidence, simpler[0].candidate, model.profile, gain)
            if into is not None:
                others = [best, *(other for other in others if other is not simpler[0])]
                best, after, entered, p_value = simpler[0], simpler[0], into, p_simpler
        rivals = tuple(Rival(other.candidate.name, other.rms * typical) for other in others)
        cause = Accepted(
            best.candidate.name, best.candidate.effect, best.candidate.word,
            before.rms * typical, after.rms * typical, p_value, rivals,
        )  # fmt: skip
        return _Step(entered, (cause,), part), _rival_step(model, trial, others, part)
    return None, None


def _is_rival(before: Judged, best: Judged, other: Judged, gain: Array) -> bool:
    """Whether another cause gains more than half as much as the best, and the blocks do not clearly prefer the best."""
    apart = t_ratio(other.block_loss - best.block_loss)
    return apart < RIVAL_T and (before.block_loss - other.block_loss).mean() > 0.5 * gain.mean()


def _is_simpler(before: Judged, best: Judged, other: Judged, gain: Array) -> bool:
    """Whether a simpler cause gains nearly as much, and leaves no more beyond the best one than tracking errors do.

    Blocks share these errors: their statistics alone would tell two causes apart by 0.03 px of a tracker's own bias.
    """
    beyond = float(np.sqrt(max(other.rms**2 - best.rms**2, 0.0)))
    part = float((before.block_loss - other.block_loss).mean() / gain.mean())
    return other.candidate.name == SIMPLER.get(best.candidate.name) and part > MOST_GAIN and beyond < STRUCTURE_NOISES


def _rival_step(model: Model, trial: Trial, others: Sequence[Judged], part: float) -> _Step | None:
    """The strongest rival that is itself significant."""
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
    context: SearchContext, model: Model, tried: set[str], base: Screened, better: Sequence[Screened]
) -> tuple[_Step | None, _Step | None]:
    """The best pair of causes that gain only together, and its strongest rival pair.

    For example, a stabiliser and a clock drift hide each other.
    """
    pairs: list[Candidate] = []
    members_of: dict[str, tuple[Candidate, Candidate]] = {}
    done: set[str] = set()
    for first in [entry.candidate for entry in better if entry.candidate.added][:PAIR_FIRSTS]:
        with_it = replace(first.model, terms=(*first.model.terms, *first.added))
        done |= {first.name}  # (A, B) and (B, A) are the same pair
        for second in context.candidates(with_it, {*tried, *done}):
            if second.added:
                name = f"{first.name}{JOINED}{second.name}"
                members_of[name] = first, second
                pairs.append(replace(second, name=name))
    if not pairs:
        return None, None
    found = best_of_each(race(context.evidence, pairs, PAIRS_JUDGED, context.each))
    trial = context.judged(base, found, PAIRS_JUDGED)
    before = trial.before
    for pair, after, gain in trial.rounds():
        part = float(gain.mean() / before.block_loss.mean())
        if part < SMALL_GAIN or not POINT_LEVELS.holds(part, chance_of(gain)):
            continue
        step = _pair_step(model, trial, members_of[pair.candidate.name], pair, after)
        if step is not None:
            others = [other for other in trial.judged if other is not pair and _is_rival(before, pair, other, gain)]
            steps = (_pair_step(model, trial, members_of[o.candidate.name], o, o) for o in sorted(others, key=_by_loss))
            return step, next((other for other in steps if other is not None), None)
    return None, None


def _by_loss(entry: Judged) -> float:
    return float(entry.block_loss.mean())


def _pair_step(
    model: Model, trial: Trial, members: tuple[Candidate, Candidate], pair: Judged, after: Judged
) -> _Step | None:
    """The step for a pair of causes, if each is significant beside the other."""
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
