"""Search for fields after the ladder: screen, fit with the forward model, judge, and remove redundant causes.

Each step adds the form that best explains the residuals and fits it together with the causes in the model.  The form
stays if it improves held-out time blocks.  Causes that it makes redundant are then removed.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from virest.arrays import Array, Index
from virest.capture.records import Capture
from virest.diagnosis.field.design import PointResiduals, point_residuals
from virest.diagnosis.field.form_list import FRAMES_PER_STEP, form_of_late_frames, forms_of_pairs, possible_forms
from virest.diagnosis.field.forms import OVER, STD, FieldForm
from virest.diagnosis.field.levels import given_value_p, level_cause
from virest.diagnosis.field.records import FittedField
from virest.diagnosis.field.screening import (
    MAX_P,
    MIN_BLOCKS,
    MIN_LOCAL_T,
    MIN_T,
    RIVAL_T,
    Design,
    Scored,
    Selection,
    score_forms,
    select,
)
from virest.diagnosis.field.sudden import SuddenChange, best_instant, lasting_change, lasting_step, sudden_change
from virest.diagnosis.geometric_effects import GeometricEffect, geometric_effect
from virest.diagnosis.geometric_evidence import ITERATIONS, Evidence, Model, capped_rms, distances, fit_model, loss
from virest.diagnosis.geometric_ladder import (
    EXCESS_SCALE,
    FINAL_POINTS,
    LARGE_GAIN,
    MIN_GAIN,
    Accepted,
    GeometricVerdict,
    climb_on,
    p_of,
)
from virest.diagnosis.selection import POINT_LEVELS
from virest.diagnosis.structure import STRUCTURE_NOISES
from virest.inference.chance import beyond_noise, t_ratio
from virest.inference.frame_delays import fit_frame_delays, unexplained_turns
from virest.inference.track_fit import Term, TrackFit, fit_from

log = logging.getLogger(__name__)

MAX_FIELDS = 3
"""Each round may add a false field at a rate of MAX_P: 0.3 % together."""
SEARCH_POINTS, JUDGE_POINTS = 6000, 4000
"""Points to screen forms and to judge one.  Twice as many of the former find a decentred lens that adds 0.03 px (rms)
and that 6000 miss; half or twice as many of the latter change a field's held-out residual by less than 2 %."""
PAIRS_IN_BLOCK = 3
"""Neighbouring pairs share a frame and its tracking errors; blocks of 3 pairs share them only at their ends."""
MIN_SIZE_PX = 0.025
"""A form with a smaller gain enters only if it replaces a named cause: tracking bias reaches 0.02 px."""
DEPTH = "scene_depth"
"""Translation in front of a near plane is confounded with gyroscope errors."""
SCALE_OVER_TIME = f"scale{OVER}time"
"""Once a form of this family is in the model, no further sudden change is searched for."""
RATE_OVER_TIME, DELAY_OVER_TIME = f"rate{OVER}time", f"delay{OVER}time"
"""A bias that changes smoothly is tried beside one that changes at an instant."""
MIN_DELAY_PART = 2 / 3
"""Least part of the excess residual that delays of single frames, or of a few, remove: of the gyroscope's noise, which
turns frames about three axes, they remove about a third, and of stamps that jitter all."""
MAX_RUNGS_BESIDE_FORMS = 3
"""Most rungs that are climbed beside a form."""
MIN_EXCESS_REMOVED = 0.5
"""Minimum fraction of the excess loss at a sudden change that a fit to the other blocks must remove."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Losses of a model on held-out time blocks or points."""

    losses: Array
    """(n,) of the points."""
    block: Index | None
    """(n,) number of the time block, whose errors are correlated; None: points were held out individually."""
    rms: float
    """In units of the typical noise."""

    @property
    def block_loss(self) -> Array:
        """(blocks,) mean loss per point, or (n,) the losses of the points."""
        if self.block is None:
            return self.losses
        return np.bincount(self.block, self.losses) / np.maximum(np.bincount(self.block), 1)


def with_fields(found: GeometricVerdict, evidence: Evidence, capture: Capture) -> GeometricVerdict:
    """Add the fields that the residuals support to the ladder's verdict; unchanged where they support none."""
    # keep the bridges of the log fixed: they have hundreds of parameters that no field shares
    terms = tuple(term for term in found.model.terms if OVER not in term.name)
    state, fitted = _SearchState(replace(found.model, terms=terms), tuple(found.accepted), ()), found.fit
    fields: list[FittedField] = []
    for _ in range(MAX_FIELDS):
        proposals = _proposals(evidence, capture, state.model, fitted)
        judged = _Judged(evidence, state.model, fitted)
        steps = (_best_step(judged, found, state, alternatives) for alternatives in proposals)
        if (step := next((step for step in steps if step is not None), None)) is None:
            break
        chosen, entered, after = step
        before, last = entered.before, entered.after
        if after.accepted != state.accepted:
            less = _without_form(after.model, after.forms[-1])
            before, last = (_held_out(evidence, m, fitted, entered.form.local) for m in (less, after.model))
        model = after.model
        fitted = evidence.fit(model, model.terms, evidence.table(model, FINAL_POINTS))
        state = replace(after, model=replace(model, profile=fitted.profile, scene=fitted.scene))
        typical, form = evidence.typical_px, after.forms[-1]
        left_px, noise_px = capped_rms(fitted.distance) * typical, evidence.noise_px(fitted)
        if not is_believable(form.kind, form.values(fitted.value(form.name)), left_px, noise_px):
            log.debug("no phone has it, and it leaves %.3g px: %s", left_px, form.name)
            break
        stability = chosen.selection.stability if chosen.selection else None
        before_px, after_px = before.rms * typical, last.rms * typical
        fields = [entry for entry in fields if entry.form.name in {form.name for form in after.forms}]
        fields.append(FittedField(entered.form, chosen.rivals, chosen.p_value, stability, before_px, after_px, fitted))
        log.debug("field: %s, p %.2g, beside %s", entered.form.name, chosen.p_value, chosen.rivals)
    if not fields:
        return found
    table = evidence.table(state.model, FINAL_POINTS)
    fields = [replace(entry, form=form, fit=fitted) for entry, form in zip(fields, state.forms, strict=True)]
    return replace(
        found,
        model=state.model,
        fit=fitted,
        table=table,
        accepted=list(state.accepted),
        final_rms_px=capped_rms(fitted.distance) * evidence.typical_px,
        noise_px=evidence.noise_px(fitted),
        fields=[*found.fields, *fields],
    )


def is_believable(kind: str, values: Iterable[Array], left_px: float, noise_px: float) -> bool:
    """Whether a field's values are below 10 times the usual in phones, or leave the points nothing but their noise.

    A model that does not follow the points at all is best improved by a field that no phone has.
    """
    usual = max(float(np.abs(part).max(initial=0.0)) for part in values) < STD[kind]
    return usual or left_px < EXCESS_SCALE * noise_px


@dataclass(frozen=True, slots=True)
class _SearchState:
    """A model with its accepted causes and field forms."""

    model: Model
    accepted: tuple[Accepted, ...]
    forms: tuple[FieldForm, ...]

    def is_dense(self, period_s: float) -> bool:
        """Whether any form has knots as dense as the blocks at this frame period."""
        return any(form.is_dense(2 * PAIRS_IN_BLOCK * period_s) for form in self.forms)

    def without(
        self, found: GeometricVerdict, leaving: Sequence[Accepted], known: frozenset[str] = frozenset()
    ) -> _SearchState:
        """The same without some causes, whose parameters return to their nominal values.

        known: names of causes to which forms leave their level even without them in the model.
        Forms that depend on these causes restart from 0 if they cannot hold their values: a displacement about another
        principal point.
        """
        model = self.model
        for entry in leaving:
            if entry.name == DEPTH:
                model = replace(model, scene=found.nominal.scene)
                continue
            assert entry.effect is not None
            assert entry.effect.term is not None
            name = entry.effect.term.name
            back = -entry.effect.total_change(found.nominal.profile, model.profile)
            terms: Sequence[Term] = [term for term in model.terms if term.name != name]
            model = replace(model, profile=entry.effect.term.change(model.profile, back), terms=tuple(terms))
        names = known | {term.name for term in model.terms}
        forms = tuple(form.about(model.profile, names) for form in self.forms)
        model = _restarted(model, self.forms, forms)
        return _SearchState(model, tuple(entry for entry in self.accepted if entry not in leaving), forms)

    def frees_level(self, form: FieldForm, cause: str) -> bool:
        """Whether a form takes over the level if a cause leaves."""
        names = frozenset(term.name for term in self.model.terms if term.name != cause)
        return form.about(self.model.profile, names).basis.shape[1] > form.basis.shape[1]

    def level_left_to(self, cause: str) -> _SearchState:
        """The same with forms that leave their level to a cause; these restart from 0."""
        model = self.model
        names = frozenset({cause, *(term.name for term in model.terms)})
        forms = tuple(form.about(model.profile, names) for form in self.forms)
        return _SearchState(_restarted(model, self.forms, forms), self.accepted, forms)


@dataclass(frozen=True, slots=True)
class _Judged:
    """Held-out losses of a model on blocks and on points, each computed once on demand."""

    evidence: Evidence
    model: Model
    fitted: TrackFit
    _known: dict[bool, HeldOut] = field(default_factory=dict, repr=False)

    def held_out(self, by_point: bool) -> HeldOut:
        """Losses on held-out points, or on held-out blocks."""
        if by_point not in self._known:
            self._known[by_point] = _held_out(self.evidence, self.model, self.fitted, by_point)
        return self._known[by_point]


def _best_step(
    judged: _Judged, found: GeometricVerdict, state: _SearchState, alternatives: Sequence[_Proposal]
) -> tuple[_Proposal, _Entered, _SearchState] | None:
    """Add the simplest form, or one with more numbers that predicts held-out points better; None where none gains.

    Each is judged beside the causes that the points need with it: a curve takes some of what a cause left out does.
    Where finer knots gain, the coarse ones with further causes, or pairs of them, are an alternative.
    """
    steps: list[tuple[_Proposal, _Entered, _SearchState]] = []
    for proposal in alternatives:
        entries = _entered(judged, proposal)
        for entered in entries:
            after = _step(judged, found, state, proposal, entered)
            if after is not None:
                coarse = entered is not entries[-1]
                told = (_climbed if coarse else _with_other_causes)(judged.evidence, found, after)
                if not coarse or len(told.accepted) > len(after.accepted):
                    steps.append((proposal, entered, told))
    if len(steps) < 2:
        return next(iter(steps), None)
    steps.sort(key=lambda step: step[1].form.basis.shape[1])
    losses = [_held_out(judged.evidence, step[2].model, judged.fitted, by_point=True).losses for step in steps]
    best = 0
    for k in range(1, len(steps)):
        gain = losses[best] - losses[k]
        if gain.mean() > MIN_GAIN * losses[best].mean() and t_ratio(gain) > MIN_T:
            best = k
    return steps[best]


def _step(
    judged: _Judged, found: GeometricVerdict, state: _SearchState, proposal: _Proposal, entered: _Entered
) -> _SearchState | None:
    """Keep a form that entered and remove what it makes redundant; None where it gains too little.

    A form that replaces a cause needs a lower significance than one that is added to all causes.
    """
    evidence = judged.evidence
    more = _SearchState(entered.model, state.accepted, (*state.forms, entered.form))
    after = _without_redundant_causes(evidence, found, more)
    typical, left = evidence.typical_px, entered.after.rms
    gained_px = np.sqrt(max(entered.before.rms**2 - left**2, 0.0)) * typical
    shared_px = STRUCTURE_NOISES * left * typical if entered.form.local else 0.0
    if entered.form.local and entered.form.kind == "delay":
        excess = max(entered.before.rms**2 - 1.0, 0.0)  # rms is in units of the noise
        shared_px = max(shared_px, typical * np.sqrt(MIN_DELAY_PART * excess))
    small = gained_px < max(0.0 if proposal.sudden else MIN_SIZE_PX, shared_px)
    if small or proposal.instead:
        replaces = len(after.accepted) < len(state.accepted)
        if not replaces or not _is_better(judged, after.model, entered.form):
            return None
    return after


def _is_better(judged: _Judged, model: Model, form: FieldForm) -> bool:
    """Whether a model with a form predicts held-out data better than the judged one by RIVAL_T standard errors."""
    after = _held_out(judged.evidence, model, judged.fitted, form.local)
    gain = judged.held_out(form.local).block_loss - after.block_loss
    return _holds_over_time(gain) if form.over_time and not form.local else t_ratio(gain) > RIVAL_T


@dataclass(frozen=True, slots=True)
class _Proposal:
    """A form proposed because all residuals together, or those between two frames, support it."""

    form: FieldForm
    selection: Selection | None = None
    sudden: SuddenChange | None = None
    jitter_p: float | None = None
    """P value of delays of single frames; None: the form is another."""
    instead: bool = False
    """Whether it may enter only if it replaces a cause."""

    @property
    def p_value(self) -> float:
        """For the whole set of forms, or for all pairs."""
        if self.jitter_p is not None:
            return self.jitter_p
        return self.selection.best.p_value if self.selection else self.sudden.p_value if self.sudden else 1.0

    @property
    def rivals(self) -> tuple[str, ...]:
        """Forms that explain the residuals as well."""
        return self.selection.rivals if self.selection else ()


def _proposals(evidence: Evidence, capture: Capture, model: Model, fitted: TrackFit) -> Iterator[tuple[_Proposal, ...]]:
    """Yield the forms that a model's residuals support, as groups of alternatives, with their significance.

    A fast-settling focal length and a sudden change look alike, so both are tried.  Covariate pairs and curves over a
    few frames come last and are tested beside everything that the plain forms can explain.
    """
    table = evidence.table(model, SEARCH_POINTS)
    fitted = fit_model(evidence.imu, model, model.terms, table)
    in_model = {term.name for term in model.terms}
    span_s = float(fitted.seconds.min()), float(fitted.seconds.max())
    alone = possible_forms(capture, fitted.profile, span_s, frozenset(in_model))
    pairs = forms_of_pairs(capture, fitted.profile, span_s, frozenset(in_model))
    block = table.pair // PAIRS_IN_BLOCK
    if len(np.unique(block)) < MIN_BLOCKS:
        return
    seen = point_residuals(evidence.imu, fitted, table)
    tangent = seen.tangent()
    if model.terms:
        tangent = np.concatenate([tangent, seen.effect(model.terms)], axis=-1)
    blind_s = FRAMES_PER_STEP * evidence.period_s
    search = _Search(seen, block, blind_s, len(alone) + len(pairs) + 1)
    forms = [form for form in alone if form.family not in in_model]
    plain: list[_Proposal] = []
    sudden = None if any(name.startswith(SCALE_OVER_TIME) for name in in_model) else sudden_change(seen)
    if sudden is not None:
        form = best_instant(seen, capture, sudden.at_s, sudden.scale, evidence.period_s)
        plain.append(_Proposal(form, sudden=sudden))
    smooth = [form for form in forms if not form.local]
    scored = search.scored(tangent, smooth)
    selection = search.best(scored)
    instead = selection is None and any(OVER not in name for name in in_model)
    if (selection := search.best(scored, RIVAL_T) if instead else selection) is not None:
        form = smooth[selection.best.index]
        if form.step_s is not None:
            scale = lasting_change(seen, tangent, search.effect(form))
            form = best_instant(seen, capture, form.step_s, scale, evidence.period_s)
        plain.append(_Proposal(form, selection, instead=instead))
        if form.family in (RATE_OVER_TIME, DELAY_OVER_TIME):
            stepped = lasting_step(seen, tangent, capture, span_s, evidence.period_s, form)
            plain.append(_Proposal(stepped, selection, instead=instead))
    yield tuple(plain)
    forms = [form for form in (*forms, *pairs) if form.local or (form.is_pair and form.family not in in_model)]
    smooth = list({form.family: form for form in reversed(alone) if not form.local and form.step_s is None}.values())
    tangent = np.concatenate([tangent, *map(search.effect, smooth)], axis=-1)
    selection = search.best(search.scored(tangent, forms))
    close = [] if selection is None else [_Proposal(forms[selection.best.index], selection)]
    if selection is not None and close[0].form.is_turn:
        stepped = lasting_step(seen, tangent, capture, span_s, evidence.period_s, close[0].form)
        close.append(_Proposal(stepped, selection))
    seen_s = np.concatenate([table.first_stamp_s, table.second_stamp_s])
    late = form_of_late_frames(capture, fitted.profile, span_s, seen_s, frozenset(in_model))
    if late is not None and late.family not in in_model:
        found = fit_frame_delays(unexplained_turns(seen.imu, seen.table, seen.fit.profile))
        p_value = 1.0 if found is None else min(found.p * search.forms_tested, 1.0)
        log.debug("%s by frame: p %.2g", late.name, p_value)
        close += [_Proposal(late, jitter_p=p_value)] if p_value < MAX_P else []
    if close:
        yield tuple(close)
    if selection is None and sudden is not None:
        # a temporary change covers too few frames for the sign-flip test
        yield from ((_Proposal(form, sudden=sudden),) for form in forms if form.local and form.kind == "scale")


@dataclass(frozen=True, slots=True)
class _Search:
    """Residuals, and the settings with which forms are scored."""

    seen: PointResiduals
    block: Index
    blind_s: float
    """Ignore points closer in time to a sudden change than this.  The change moves them by many times their noise, so
    the most informative points would reject an instant that is wrong by one frame."""
    forms_tested: int
    """Total number of forms tested."""
    _effects: dict[int, tuple[FieldForm, Array]] = field(default_factory=dict, repr=False)
    """Keyed by id(form); the form is stored too, so that its id is not reused."""

    def best(self, scored: Sequence[Scored], least_t: float = MIN_T) -> Selection | None:
        """The form that the residuals support, if any."""
        return select(scored, float(self.seen.weight.sum()), least_t=least_t)

    def scored(self, tangent: Array, forms: Sequence[FieldForm]) -> list[Scored]:
        """Scores of forms beside a tangent space (n, 2, m), best gain first; only the best form of each family."""
        designs = [Design(form.name, self.effect(form), form.over_time, form.local) for form in forms]
        best: dict[str, Scored] = {}

        def worth(entry: Scored) -> tuple[bool, float]:
            return entry.significant, float(entry.gain.sum())

        seen = self.seen
        for entry in score_forms(
            seen.left, seen.weight, tangent, designs, self.block, seen.table.pair, forms_tested=self.forms_tested
        ):
            family = forms[entry.index].family
            if family not in best or worth(entry) > worth(best[family]):
                best[family] = entry
        whole = seen.weight * (seen.left**2).sum(axis=-1)
        for entry in best.values():
            log.debug(
                "%s, %d numbers: p %.2g, gain %.4g (t %.1f), parts t %s",
                entry.name,
                entry.numbers,
                entry.p_value,
                entry.gain.sum() / whole.sum(),
                t_ratio(entry.gain),
                None if entry.parts_gain is None else round(t_ratio(entry.parts_gain), 1),
            )
        return sorted(best.values(), key=lambda entry: -float(entry.gain.sum()))

    def effect(self, form: FieldForm) -> Array:
        """Whitened change (n, 2, k) of the points per free number of a form; computed once."""
        if id(form) not in self._effects:
            self._effects[id(form)] = form, self._effect(form)
        return self._effects[id(form)][1]

    def _effect(self, form: FieldForm) -> Array:
        seen = self.seen
        effect = seen.effect((form.term,))
        if form.step_s is not None and self.blind_s:
            profile, table = seen.fit.profile, seen.table
            lasting_s = profile.shutter.readout_time_s + table.second_exposure_s
            begin_s, end_s = (np.asarray(profile.imu_time_s(t)) for t in (table.first_stamp_s, table.second_stamp_s))
            near = (begin_s - self.blind_s < form.step_s) & (form.step_s < end_s + lasting_s + self.blind_s)
            effect[near] = 0.0
        return effect


@dataclass(frozen=True, slots=True)
class _Entered:
    """A model with a form added, and the held-out losses without and with it."""

    model: Model
    form: FieldForm
    before: HeldOut
    after: HeldOut


def _entered(judged: _Judged, proposal: _Proposal) -> tuple[_Entered, ...]:
    """Add a form, and where they improve held-out data finer knots too; empty where held-out blocks do not gain."""
    evidence, model, fitted, form = judged.evidence, judged.model, judged.fitted, proposal.form
    extended = replace(model, terms=(*model.terms, form.term))
    before, after = judged.held_out(form.local), _held_out(evidence, extended, fitted, form.local)
    gain = before.block_loss - after.block_loss
    log.debug("%s held out: %.4f to %.4f, t %.1f", form.name, before.rms, after.rms, t_ratio(gain))
    least_t = RIVAL_T if proposal.instead else MIN_T
    holds = _holds_over_time(gain) if form.over_time and not form.local else t_ratio(gain) > least_t
    if proposal.sudden is not None and not form.local:
        # the fit to the other blocks determines the change, and must remove the excess in the block that contains it
        there = proposal.sudden.pair // PAIRS_IN_BLOCK
        excess = max(before.block_loss[there] - float(np.median(before.block_loss)), 0.0)
        holds = bool(gain[there] > MIN_EXCESS_REMOVED * excess)
    least_gain = 0.0 if proposal.instead else MIN_GAIN
    if gain.mean() < least_gain * before.block_loss.mean() or after.rms > before.rms or not holds:
        return ()
    coarse = _Entered(extended, form, before, after)
    refined = _refined(evidence, model, coarse, fitted)
    return (coarse,) if refined is coarse else (coarse, refined)


def _holds_over_time(gain: Array) -> bool:
    """Whether the gain (blocks,) of a form over time is significant: over all blocks, or strongly in a few."""
    return t_ratio(gain) > MIN_LOCAL_T or beyond_noise(gain) > MIN_T


def _refined(evidence: Evidence, model: Model, entered: _Entered, fitted: TrackFit) -> _Entered:
    """Double the knots repeatedly while held-out points gain.

    A form over time is judged on held-out points of the fitted frames, since fine knots are as dense as blocks.  If
    doubling gains nothing over time or rows, quadrupling is tried too: an oscillation between two knots needs it.
    """
    by_point = entered.form.over_time
    judged_so = by_point == entered.form.local
    last = entered.after if judged_so else _held_out(evidence, entered.model, fitted, by_point)
    names = frozenset(term.name for term in model.terms)
    finer, failed = entered.form.finer(model.profile, names), False
    while finer is not None:
        extended = replace(model, terms=(*model.terms, finer.term))
        after = _held_out(evidence, extended, fitted, by_point)
        gain = last.block_loss - after.block_loss
        log.debug("%d knots: %.4f to %.4f, t %.1f", len(finer.basis), last.rms, after.rms, t_ratio(gain))
        gains = gain.mean() > MIN_GAIN * last.block_loss.mean() and t_ratio(gain) > MIN_T
        if gains:
            entered, last = _Entered(extended, finer, entered.before, after), after
        elif failed or finer.kind == "displacement":
            break
        finer, failed = finer.finer(model.profile, names), not gains
    return entered


def _without_form(model: Model, form: FieldForm) -> Model:
    """The model without a form, whose values return to 0."""
    terms = tuple(term for term in model.terms if term.name != form.name)
    return replace(model, profile=form.removed_from(model.profile), terms=terms)


def _restarted(model: Model, old: Sequence[FieldForm], new: Sequence[FieldForm]) -> Model:
    """The model with new forms in place of old ones; those that cannot hold their values restart from 0."""
    for before, after in zip(old, new, strict=True):
        if before is not after:
            less = _without_form(model, before)
            profile = model.profile if after.can_hold(model.profile) else less.profile
            model = replace(less, profile=profile, terms=(*less.terms, after.term))
    return model


def _held_out(evidence: Evidence, model: Model, scaled: TrackFit, by_point: bool = False) -> HeldOut:
    """Fit on every other block of a few pairs, judge on the remaining blocks, and vice versa.

    by_point: on every other point of all pairs instead.
    """
    table = evidence.table(model, JUDGE_POINTS)
    block = table.pair // PAIRS_IN_BLOCK
    fold = (np.arange(len(table)) if by_point else block) % 2
    left = np.zeros(len(table))
    for number in (0, 1):
        half = (JUDGE_POINTS, by_point, number)
        start = evidence.start(model, half, lambda number=number: table.chosen(fold == number))  # type: ignore[misc]
        part = fit_from(start, model.terms, max_iterations=ITERATIONS, covariances=False)
        left[fold != number] = distances(evidence.imu, part, table, scaled.depth_spread_per_m)[fold != number]
    return HeldOut(np.asarray(loss(left, 1.0)), None if by_point else block, capped_rms(left))


def _without_redundant_causes(evidence: Evidence, found: GeometricVerdict, state: _SearchState) -> _SearchState:
    """Remove causes that no longer improve held-out blocks once a field has been added.

    Two causes that compensate for each other, such as a rotation and a principal point, must be removed together.
    """
    while True:
        model = state.model
        fitted = evidence.fit(model, model.terms, evidence.table(model, JUDGE_POINTS))
        state = replace(state, model=replace(model, profile=fitted.profile, scene=fitted.scene))
        judged = _Judged(evidence, state.model, fitted)
        if (form := _redundant_form(judged, state)) is not None:
            log.debug("stood in for another form: %s", form.name)
            kept = tuple(known for known in state.forms if known is not form)
            state = replace(state, model=_without_form(state.model, form), forms=kept)
            continue
        leaving = _redundant_causes(judged, found, state)
        if not leaving:
            return state
        log.debug("stood in for a field: %s", [entry.name for entry in leaving])
        state = state.without(found, leaving)


def _climbed(evidence: Evidence, found: GeometricVerdict, state: _SearchState) -> _SearchState:
    """Add causes, or pairs of them, beside forms as on the ladder, and remove those that become redundant."""
    end = state
    for _ in range(MAX_RUNGS_BESIDE_FORMS):
        model, accepted = climb_on(evidence, found.nominal.profile, end.model, end.accepted)
        if len(accepted) == len(end.accepted):
            break
        end = replace(end, model=model, accepted=accepted)
    return end if end is state else _without_redundant_causes(evidence, found, end)


def _with_other_causes(evidence: Evidence, found: GeometricVerdict, state: _SearchState) -> _SearchState:
    """Add the causes that the points need beside a new field, and remove what they make redundant.

    Before the field, another cause may have compensated for both: a focal drift for a wrong focal length beside a
    gyroscope that feels gravity.  Nothing is sought where the residuals are noise.
    """
    fitted = evidence.fit(state.model, state.model.terms, evidence.table(state.model, JUDGE_POINTS))
    state = _with_level_cause(evidence, found, state, fitted)
    if fitted.scale < EXCESS_SCALE:
        return state
    return _climbed(evidence, found, state)


def _with_level_cause(
    evidence: Evidence, found: GeometricVerdict, state: _SearchState, fitted: TrackFit
) -> _SearchState:
    """Add the cause of a field's level where the given value lies outside the field's range; else unchanged."""
    form = state.forms[-1]
    name = level_cause(form)
    if name is None or name in {term.name for term in state.model.terms}:
        return state
    if not _is_outside(evidence, found, fitted, form, geometric_effect(name)):
        return state
    left = state.level_left_to(name)
    model, accepted = climb_on(evidence, found.nominal.profile, left.model, left.accepted, frozenset({name}))
    return state if len(accepted) == len(state.accepted) else replace(left, model=model, accepted=accepted)


def _is_outside(
    evidence: Evidence, found: GeometricVerdict, fitted: TrackFit, form: FieldForm, effect: GeometricEffect
) -> bool:
    """Whether the given value of the cause of a field's level lies outside the field's range."""
    given = found.nominal.profile
    return POINT_LEVELS.significant(given_value_p(fitted, form, effect, given, evidence.typical_px))


def _loses_without(judged: _Judged, by_point: bool, less: Model) -> bool:
    """Whether the cause or form that a smaller model lacks improves held-out blocks, or points."""
    before, after = _held_out(judged.evidence, less, judged.fitted, by_point), judged.held_out(by_point)
    gain = before.block_loss - after.block_loss
    part = float(gain.mean() / before.block_loss.mean())
    if part > LARGE_GAIN:
        # as much as entered the model may lie in a few blocks
        return t_ratio(gain) > MIN_LOCAL_T if by_point else _holds_over_time(gain)
    return part > MIN_GAIN and t_ratio(gain) > MIN_T


def _redundant_form(judged: _Judged, state: _SearchState) -> FieldForm | None:
    """An older form that the newest one makes redundant, if any."""
    by_point = state.is_dense(judged.evidence.period_s)
    less = ((form, _without_form(state.model, form)) for form in state.forms[:-1])
    return next((form for form, model in less if not _loses_without(judged, by_point, model)), None)


def _redundant_causes(judged: _Judged, found: GeometricVerdict, state: _SearchState) -> tuple[Accepted, ...]:
    """The cause, or pair of causes, that the model does not need; empty where it needs all."""
    fitting = [entry for entry in state.accepted if entry.effect is not None and entry.effect.term is not None]
    depth = [(entry,) for entry in state.accepted if entry.name == DEPTH]
    weakest: list[tuple[Accepted, ...]] = []
    if fitting:
        p_values = {entry.name: _p_value_of(judged.evidence, found, judged.fitted, entry) for entry in fitting}
        weakest = [(max(fitting, key=lambda entry: p_values[entry.name]),)]
    outside, inside = _level_causes(judged, found, state, fitting)
    if inside:
        return inside[:1]
    for leaving in (*depth, *weakest, *combinations(fitting, 2)):
        less = state.without(found, leaving, outside).model
        if not _loses_without(judged, state.is_dense(judged.evidence.period_s), less):
            return leaving
    return ()


def _level_causes(
    judged: _Judged, found: GeometricVerdict, state: _SearchState, causes: Sequence[Accepted]
) -> tuple[frozenset[str], tuple[Accepted, ...]]:
    """Among causes of the levels of fields: (names of those with given values outside the range, those inside).

    A cause inside needs no test: the field describes the same with its own level.
    """
    outside: set[str] = set()
    inside: list[Accepted] = []
    for entry in causes:
        assert entry.effect is not None
        forms = [form for form in state.forms if level_cause(form) == entry.name]
        forms = [form for form in forms if state.frees_level(form, entry.name)]
        if any(_is_outside(judged.evidence, found, judged.fitted, form, entry.effect) for form in forms):
            outside.add(entry.name)
        elif forms:
            inside.append(entry)
    return frozenset(outside), tuple(inside)


def _p_value_of(evidence: Evidence, found: GeometricVerdict, fitted: TrackFit, entry: Accepted) -> float:
    assert entry.effect is not None
    return p_of(fitted, entry.effect, fitted.profile, found.nominal.profile, evidence.typical_px)
