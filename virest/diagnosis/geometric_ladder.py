"""The ladder for what moves points: rung by rung the cause that best predicts stretches of time it was not fitted to.

On each rung every cause is fitted together with those already in; the most promising are then fitted on half of the
blocks of time and judged on the other half, both ways.  The best enters if the gain holds in the blocks (a t test) and
its value is significant against a deviation that includes tracking's own bias.  Then all are fitted together again, and
what is no longer significant leaves.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest.calibration.physical_limits import is_depth
from virest.camera.profile import CameraProfile
from virest.diagnosis.candidates import SCREEN_POINTS, Candidate, FarClock, candidates_of, worth_beginning
from virest.diagnosis.cross_validation import (
    JUDGE_POINTS,
    Judged,
    Screened,
    best_of_each,
    chance_of,
    choose,
    judge,
    lagging_gain,
    promising,
    race,
    screen,
    t_ratio,
)
from virest.diagnosis.findings import GEOMETRY, JOINED, Finding, HeldOutGain, ParameterChange, Rival, Rung
from virest.diagnosis.geometric_effects import GeometricEffect
from virest.diagnosis.geometric_evidence import (
    KNOWN_DEPTH_STD,
    Evidence,
    Model,
    base_scene,
    capped_rms,
    depth_of,
)
from virest.diagnosis.left_open import variance_left_open
from virest.diagnosis.selection import POINT_LEVELS, WORD_LEVELS
from virest.effects.table import EFFECTS
from virest.image_formation.point_model import TrackTable
from virest.image_formation.row_clock import right_way_round
from virest.inference import profile_terms as terms_of
from virest.inference.chance import chi2_tail
from virest.inference.parallel import ParallelMap, one_by_one
from virest.inference.recorder_lag import Schedule
from virest.inference.track_fit import Term, TrackFit
from virest.inference.tracking_bias import bias_std

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
FINAL_POINTS = 7000
PROMISING = 3
"""Causes that each fold chooses from."""
MAX_P, MIN_GAIN = POINT_LEVELS.max_p, POINT_LEVELS.least_gain
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
STABILISER_CUTOFF_HZ = (0.03, 15.0)


@dataclass(frozen=True, slots=True)
class Accepted:
    """A cause that is in the model."""

    name: str
    effect: GeometricEffect | None
    word: str
    before: float
    after: float
    p_value: float
    rivals: tuple[Rival, ...]


@dataclass(slots=True)
class GeometricVerdict:
    """Where the ladder ended."""

    model: Model
    fit: TrackFit
    table: TrackTable
    accepted: list[Accepted]
    rungs: list[Rung]
    nominal: Model
    nominal_fit: TrackFit
    nominal_table: TrackTable
    nominal_rms_px: float
    final_rms_px: float
    noise_px: float
    """What tracking alone makes, as an rms like the two above."""
    step_noise_px: float
    """Typical standard deviation of a tracked step, per coordinate."""
    rival: GeometricVerdict | None = None
    """Another end of the ladder that held-out points do not tell from this one; None: there is none."""
    lag_std_s: float | None = None
    """Of a start-up lag; None without one."""
    astray: float = 0.0
    """Part of the points that lie in parts of the picture that move together on their own, and were left out."""
    notes: list[str] = field(default_factory=list)
    fields: list[Any] = field(default_factory=list)
    """Unknown effects that were found beyond the causes: :class:`virest.diagnosis.field.records.FittedField`."""
    evidence: Evidence | None = None
    """The pairs that the model was fitted to."""
    left_open: dict[str, Array] = field(default_factory=dict)
    """Variance (k,) of causes' values, by name, from further causes that points which stay astray leave open."""


def climb(
    evidence: Evidence,
    nominal: CameraProfile,
    null_terms: Sequence[Term],
    lags: Sequence[Schedule],
    far: FarClock | None = None,
    progress: Callable[[float], None] | None = None,
    max_rungs: int = MAX_RUNGS,
    each: ParallelMap = one_by_one,
) -> GeometricVerdict:
    """Climb from a profile; null_terms: unknown values, fitted on every rung and no cause.

    lags: the start-up schedules to try.  far: changes of the clocks at which turns were seen to agree.
    Where a rival might have entered first, the ladder is climbed once more from there, with the causes of the first
    climb alone: whatever else the rival needs makes it the less simple explanation.
    """
    say = progress or (lambda _: None)
    start = Model(nominal, None, tuple(null_terms))
    start = replace(start, scene=base_scene(evidence, nominal, evidence.table(start, SCREEN_POINTS)))
    model, notes = _with_unknowns(evidence, start)
    nominal_model = model
    course = SearchContext(evidence, nominal, lags, far or FarClock(), each)
    say(0.1)
    path, fork = _ascended(course, _Path(model, (), ()), max_rungs)
    say(0.6)
    verdict = _conclude(evidence, nominal_model, path.model, list(path.accepted), list(path.rungs), nominal)
    if fork is not None:
        among = frozenset(entry.name for entry in path.accepted)
        other, _ = _ascended(replace(course, among=among), fork, max_rungs)
        say(0.9)
        rival = _conclude(evidence, nominal_model, other.model, list(other.accepted), list(other.rungs), nominal)
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
        model, _ = _refitted(evidence, step.model, JUDGE_POINTS)
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
    EVEN_T standard errors, so that rounding may change the order, the names decide.
    """
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
        chosen.notes.append(f"{' and '.join(r.name for r in instead)} in place of others explains the points as well")
    chosen.rival = rival
    return chosen


def _joined(rivals: Sequence[Rival], more: Sequence[Rival]) -> tuple[Rival, ...]:
    known = {rival.name for rival in rivals}
    return (*rivals, *(rival for rival in more if rival.name not in known))


def _with_unknowns(evidence: Evidence, start: Model) -> tuple[Model, list[str]]:
    """The model with its unknown values fitted; those that end where no camera is stay where they began."""
    model, notes = _refitted(evidence, start, SCREEN_POINTS)[0], []
    at_ends = evidence.impossible(model.profile) - evidence.impossible(start.profile)
    if "readout_time" in evidence.impossible(model.profile):
        at_ends |= {"readout_time"}
    ended = [term.name for term in start.terms if term.name in at_ends]
    if ended:
        known = tuple(term for term in start.terms if term.name not in ended)
        model = _refitted(evidence, replace(start, terms=known), SCREEN_POINTS)[0]
        notes = [f"{name} is unknown and cannot be told from the points" for name in ended]
    return model, notes


def _refitted(evidence: Evidence, model: Model, points: int) -> tuple[Model, TrackFit]:
    table = evidence.table(model, points)
    fitted = evidence.fit(model, model.terms, table)
    return replace(model, profile=right_way_round(fitted.profile), scene=fitted.scene), fitted


# ── one rung ─────────────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class SearchContext:
    """What is the same on all rungs."""

    evidence: Evidence
    nominal: CameraProfile
    lags: Sequence[Schedule]
    far: FarClock
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

        The cause is the best over all blocks; what it is judged by was chosen for each block by others.
        """
        left = sorted(self.judged, key=lambda entry: float(entry.block_loss.mean()))
        while left:
            after = choose(self.evidence, [self.before, *left], self.allowed, self.scale)
            gain = self.before.block_loss - after.block_loss
            if left[0].candidate.name == "frame_lag":
                gain = lagging_gain(self.evidence, self.before, left[0])
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
        entered, p_value = _significant(evidence, best.candidate, model.profile, gain)
        if entered is None:
            continue
        others = [other for other in judged if other is not best and _rivals(before, best, other, gain)]
        plainer = [other for other in others if other.candidate.name == PLAINER.get(best.candidate.name)]
        if plainer:
            into, p_plainer = _significant(evidence, plainer[0].candidate, model.profile, gain)
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
        entered, p_value = _significant(trial.evidence, other.candidate, model.profile, gain)
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
    entered, fitted = _with(evidence, pair.candidate)
    p_values = [_p_value(evidence, fitted, member, entered.profile, model.profile) for member in members]
    if not all(map(POINT_LEVELS.significant, p_values)):
        return None
    causes = tuple(
        Accepted(member.name, member.effect, "", before.rms * typical, after.rms * typical, p_value, ())
        for member, p_value in zip(members, p_values, strict=True)
    )
    return _Step(entered, causes, float((before.block_loss - after.block_loss).mean() / before.block_loss.mean()))


def _with(evidence: Evidence, candidate: Candidate) -> tuple[Model, TrackFit]:
    """The model with the candidate in it, fitted anew."""
    return _refitted(evidence, replace(candidate.model, terms=(*candidate.model.terms, *candidate.added)), JUDGE_POINTS)


def _significant(
    evidence: Evidence, candidate: Candidate, before: CameraProfile, gain: Array
) -> tuple[Model | None, float]:
    """The model with the candidate in it, if its value is significant, and the probability that it is nought.

    A word has no value: its probability is that of so even a gain (blocks,) by chance.
    """
    model, fitted = _with(evidence, candidate)
    if candidate.name != "scene_depth" and (candidate.effect is None or candidate.effect.term is None):
        p_value = chance_of(gain)
        return (model if WORD_LEVELS.significant(p_value) else None), p_value
    if candidate.name == "scene_depth":
        p_value = depth_p(fitted, evidence.table(model, JUDGE_POINTS), before.depth_m)
    else:
        p_value = _p_value(evidence, fitted, candidate, model.profile, before)
    return (model if POINT_LEVELS.significant(p_value) else None), p_value


def _p_value(
    evidence: Evidence, fitted: TrackFit, candidate: Candidate, found: CameraProfile, before: CameraProfile
) -> float:
    """Probability that a candidate's value is nought; 1 where no phone is like that."""
    assert candidate.effect is not None
    return _p_if_plausible(evidence, fitted, candidate.effect, found, before)


def _p_if_plausible(
    evidence: Evidence, fitted: TrackFit, effect: GeometricEffect, found: CameraProfile, before: CameraProfile
) -> float:
    """Probability that an effect's value is nought; 1 where it ends at, or beyond, what a phone can be."""
    if not is_plausible(evidence, effect, found, effect.total_change(before, found)):
        return 1.0
    return p_of(fitted, effect, found, before, evidence.typical_px)


def depth_p(fitted: TrackFit, table: TrackTable, given_m: float | None) -> float:
    """Probability of so large a change of the inverse depth by chance; 1 where the depth ends at its limits."""
    depth_m, std = depth_of(fitted, table)
    if not is_depth(depth_m):
        return 1.0
    given_m = given_m or np.inf
    nearer = 1 / depth_m - 1 / given_m
    certain = std / depth_m**2 if np.isinf(given_m) else np.hypot(std / depth_m**2, KNOWN_DEPTH_STD / given_m)
    return chi2_tail((nearer / max(certain, 1e-9)) ** 2, 1)


def is_plausible(evidence: Evidence, effect: GeometricEffect, found: CameraProfile, change: Array) -> bool:
    """Whether a phone can be like that: a cause at or beyond these bounds compensates for another."""
    if effect.name in evidence.impossible(found):
        return False
    if effect.name == "stabilisation":
        low, high = STABILISER_CUTOFF_HZ
        extensions = found.extensions
        return 0 < extensions.stabilisation_fraction <= 1.1 and low < extensions.stabilisation_cutoff_hz < high
    assert effect.effect.steps is not None
    return bool(np.all(np.abs(change) < effect.effect.steps.believable))


def p_of(
    fitted: TrackFit, effect: GeometricEffect, found: CameraProfile, before: CameraProfile, noise_px: float
) -> float:
    """Probability of so large a change by chance: a chi-square of the change, deviations with tracking's own bias."""
    change = effect.total_change(before, found)
    floor = bias_std(fitted, effect.name, noise_px)
    part = fitted.slices[effect.name]
    covariance = fitted.covariance[part, part] + np.diag(floor**2)
    if effect.name == "stabilisation":
        return chi2_tail(change[0] ** 2 / covariance[0, 0], 1)
    return chi2_tail(change @ np.linalg.solve(covariance, change), len(change))


# ── conclusions ──────────────────────────────────────────────────────────────────────────────────────────────────


def _conclude(
    evidence: Evidence,
    nominal_model: Model,
    model: Model,
    accepted: list[Accepted],
    rungs: list[Rung],
    nominal: CameraProfile,
) -> GeometricVerdict:
    """Fit everything together from the nominal profile on, and let go of what is no longer significant.

    So too of what held-out points are better off without: one of a pair may have stood in for a cause found later.
    """
    entered = len(accepted)
    paired = any(JOINED in (rung.entered or "") for rung in rungs)
    while True:
        model, fitted = _refitted(evidence, model, FINAL_POINTS)
        table = evidence.table(model, FINAL_POINTS)
        leaving = [
            entry
            for entry in accepted
            if not POINT_LEVELS.significant(
                _doubt(evidence, fitted, table, entry, model.profile, nominal_model.profile)
            )
        ]
        if not leaving and (paired or len(accepted) < entered):
            judged = [_rejudged(evidence, model, nominal_model, entry, fitted) for entry in accepted]
            idle = [k for k, entry in enumerate(judged) if _has_term(entry) and entry.after >= entry.before]
            leaving = [accepted[k] for k in sorted(idle, key=lambda k: judged[k].before - judged[k].after)]
            accepted = accepted if leaving else judged
        if not leaving:
            break
        log.debug("no longer significant, or of no use: %s", [entry.name for entry in leaving])
        accepted = [entry for entry in accepted if entry is not leaving[0]]
        model = _without(model, nominal_model, leaving[0])
    nominal_table = evidence.table(nominal_model, FINAL_POINTS)
    nominal_fit = evidence.fit(nominal_model, nominal_model.terms, nominal_table)
    typical = evidence.typical_px
    before = capped_rms(nominal_fit.distance_at(fitted.depth_spread_per_m)) * typical
    return GeometricVerdict(
        model, fitted, table, accepted, rungs, nominal_model, nominal_fit, nominal_table,
        before, capped_rms(fitted.distance) * typical, evidence.noise_px(fitted), typical,
        lag_std_s=_lag_std_s(evidence, model, table) if model.lag else None,
    )  # fmt: skip


def _lag_std_s(evidence: Evidence, model: Model, table: TrackTable) -> float:
    """Deviation of a start-up lag: of an offset of the lagging pairs alone, with how far they want one.

    A schedule allows for lags in steps; what lies between two steps shows as such an offset.
    """
    lagging = np.array([pair.first <= model.profile.extensions.frame_lag_frames for pair in evidence.observed.pairs])
    fitted = evidence.fit(model, (terms_of.TIME_OFFSET,), table, lagging)
    parts = (
        fitted.value("time_offset"),
        fitted.std("time_offset"),
        bias_std(fitted, "time_offset", evidence.typical_px),
    )
    return float(np.linalg.norm(np.concatenate(parts)))


def _rejudged(evidence: Evidence, model: Model, nominal: Model, entry: Accepted, fitted: TrackFit) -> Accepted:
    """The cause with what it gains held out beside those that stayed.

    With one that left, or as one of a pair, it gained something else on its rung.
    """
    if not _has_term(entry):
        return entry
    less, _ = _refitted(evidence, _without(model, nominal, entry), SCREEN_POINTS)
    without_and_with = [
        Screened(Candidate("", m, (), None), (m, m), (0.0, 0.0), fitted.scale, fitted.depth_spread_per_m)
        for m in (less, model)
    ]
    before, after = judge(evidence, without_and_with, fitted.scale, fitted.depth_spread_per_m, one_by_one)
    return replace(entry, before=before.rms * evidence.typical_px, after=after.rms * evidence.typical_px, rivals=())


def _has_term(entry: Accepted) -> bool:
    return entry.effect is not None and entry.effect.term is not None


def _doubt(
    evidence: Evidence, fitted: TrackFit, table: TrackTable, entry: Accepted, found: CameraProfile, given: CameraProfile
) -> float:
    """Probability that an accepted cause is nothing, now that the others are in; 0 for a word."""
    if entry.name == "scene_depth":
        return depth_p(fitted, table, given.depth_m)
    if entry.effect is None or entry.effect.term is None:
        return 0.0
    return _p_if_plausible(evidence, fitted, entry.effect, found, given)


def _without(model: Model, nominal: Model, leaving: Accepted) -> Model:
    """The nominal model with the kept causes' terms, to be fitted anew from where they stand."""
    if leaving.name == "scene_depth":
        return replace(model, scene=nominal.scene)
    assert leaving.effect is not None
    assert leaving.effect.term is not None
    name = leaving.effect.term.name
    terms = tuple(term for term in model.terms if term.name != name)
    back = leaving.effect.total_change(nominal.profile, model.profile)
    profile = leaving.effect.term.change(model.profile, -back)
    return replace(model, profile=profile, terms=terms)


def findings_of(verdict: GeometricVerdict) -> list[Finding]:
    """The accepted causes as findings, strongest first."""
    found = []
    for entry in verdict.accepted:
        changes = changes_of(verdict, entry)
        held_out = HeldOutGain(GEOMETRY, entry.before, entry.after, verdict.noise_px)
        sentence = _sentence(entry, changes)
        found.append(Finding(entry.name, changes, held_out, entry.rivals, entry.p_value, sentence))
    return sorted(found, key=lambda f: f.held_out.after**2 - f.held_out.before**2)


def changes_of(verdict: GeometricVerdict, entry: Accepted) -> dict[str, ParameterChange]:
    """Parameters of one cause, before and after; where the ladder has two ends, with how far those are apart.

    Either end is as likely: the second moment about the value told grows by half the squared difference.
    """
    changes = _changes_at(verdict, entry)
    twin = next((e for e in verdict.rival.accepted if e.name == entry.name), None) if verdict.rival else None
    if verdict.rival is None or twin is None:
        return changes
    there = _changes_at(verdict.rival, twin)
    return {name: _apart(change, there[name]) for name, change in changes.items()}


def _apart(change: ParameterChange, there: ParameterChange) -> ParameterChange:
    if change.std is None or isinstance(change.estimate, str):
        return change
    off = np.subtract(change.estimate, there.estimate) / np.sqrt(2)
    return replace(change, std=np.hypot(change.std, off).tolist())


def _changes_at(verdict: GeometricVerdict, entry: Accepted) -> dict[str, ParameterChange]:
    nominal, found = verdict.nominal.profile, verdict.model.profile
    if entry.name == "scene_depth":
        depth_m, std = depth_of(verdict.fit, verdict.table)
        std = float(np.hypot(std, depth_m * bias_std(verdict.fit, "scene_depth", verdict.step_noise_px)[0]))
        return {"depth_m": ParameterChange(nominal.depth_m, depth_m, std)}
    if entry.name == "frame_lag":
        extensions = found.extensions
        return {
            "lag_s": ParameterChange(0.0, extensions.frame_lag_s, verdict.lag_std_s),
            "frames": ParameterChange(0, extensions.frame_lag_frames, None),
        }
    effect = entry.effect
    assert effect is not None
    if effect.term is None:
        return effect.changes(nominal, found, None)
    part = verdict.fit.slices[effect.term.name]
    floor = bias_std(verdict.fit, effect.name, verdict.step_noise_px)
    left_open = verdict.left_open.get(effect.name, np.zeros(1))
    stds = np.sqrt(np.diag(verdict.fit.covariance)[part] + floor**2 + left_open)
    return effect.changes(nominal, found, stds)


def _sentence(entry: Accepted, changes: dict[str, ParameterChange]) -> str:
    values = {name: shown(change.estimate) for name, change in changes.items()}
    return EFFECTS[entry.name].sentence.format(**values)


def shown(value: Any) -> str:
    """A value as people read it."""
    if isinstance(value, list):
        return "(" + ", ".join(shown(v) for v in value) + ")"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
