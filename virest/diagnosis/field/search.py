"""The search for fields after the ladder: screen, fit by the one forward model, judge, and let go of stand-ins.

Field by field: the form that the residuals ask for enters the model and is fitted together with the causes that are
in; it stays if blocks of time that the fit did not see gain.  Then causes that only stood in for it leave.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from virest.capture.records import Capture
from virest.diagnosis.field.design import point_residuals
from virest.diagnosis.field.forms import OVER, FieldForm, possible_forms
from virest.diagnosis.field.records import FittedField
from virest.diagnosis.field.screening import MIN_T, Selection, score_forms, select, t_ratio
from virest.diagnosis.geometric_evidence import Evidence, Model, capped_rms, distances, fit_model, loss
from virest.diagnosis.geometric_ladder import (
    FINAL_POINTS,
    MAX_P,
    MIN_GAIN,
    Accepted,
    GeometricVerdict,
    p_of,
    total_change,
)
from virest.inference.track_fit import Term, TrackFit

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
MAX_FIELDS = 3
SEARCH_POINTS, JUDGE_POINTS = 6000, 4000
PAIRS_IN_BLOCK = 3
"""Neighbouring pairs share a frame, and so its tracking errors: blocks of three share them at their ends only."""
MIN_SIZE_PX = 0.025
"""Structure below 0.02 px may be tracking's own bias."""
MIN_BLOCKS = 8


@dataclass(frozen=True, slots=True)
class HeldOut:
    """A model on blocks of time that it was not fitted to."""

    block_loss: Array
    """(blocks,) mean loss of a point."""
    rms: float
    """In units of the typical noise."""


def with_fields(found: GeometricVerdict, evidence: Evidence, capture: Capture) -> GeometricVerdict:
    """The ladder's end with the fields that its residuals ask for; the same where they ask for none."""
    # bridges of the log stay as they are: hundreds of numbers that no field shares
    terms = tuple(term for term in found.model.terms if OVER not in term.name)
    model, fitted, accepted = replace(found.model, terms=terms), found.fit, list(found.accepted)
    fields: list[FittedField] = []
    for _ in range(MAX_FIELDS):
        chosen = _asked_for(evidence, capture, model, fitted)
        if chosen is None:
            break
        form, selection = chosen
        entered = _entered(evidence, model, form, fitted)
        if entered is None:
            break
        after_model, before, after = entered
        model, accepted = _without_stand_ins(evidence, found, after_model, accepted)
        fitted = evidence.fit(model, model.terms, evidence.table(model, FINAL_POINTS))
        model = replace(model, profile=fitted.profile, scene=fitted.scene)
        typical = evidence.typical_px
        fields.append(
            FittedField(
                form,
                selection.rivals,
                selection.best.p_value,
                selection.stability,
                before.rms * typical,
                after.rms * typical,
                fitted,
            )
        )
        log.debug("field: %s, p %.2g, beside %s", form.name, selection.best.p_value, selection.rivals)
    if not fields:
        return found
    table = evidence.table(model, FINAL_POINTS)
    return replace(
        found,
        model=model,
        fit=fitted,
        table=table,
        accepted=accepted,
        final_rms_px=capped_rms(fitted.distance) * evidence.typical_px,
        noise_px=evidence.noise_px(fitted),
        fields=[*found.fields, *(replace(entry, fit=fitted) for entry in fields)],
    )


def _asked_for(
    evidence: Evidence, capture: Capture, model: Model, fitted: TrackFit
) -> tuple[FieldForm, Selection] | None:
    """The form that the residuals of a model ask for, and how sure that is."""
    table = evidence.table(model, SEARCH_POINTS)
    fitted = fit_model(evidence.imu, model, model.terms, table)
    in_model = {term.name for term in model.terms}
    seconds = fitted.seconds
    forms = possible_forms(capture, fitted.profile, (float(seconds.min()), float(seconds.max())))
    forms = [form for form in forms if form.name not in in_model]
    seen = point_residuals(evidence.imu, fitted, table)
    block = table.pair // PAIRS_IN_BLOCK
    if len(np.unique(block)) < MIN_BLOCKS:
        return None
    tangent = seen.tangent()
    if model.terms:
        tangent = np.concatenate([tangent, seen.effect(model.terms)], axis=-1)
    designs = [(form.name, seen.effect((form.term,)), form.over_time) for form in forms]
    scored = score_forms(seen.left, seen.weight, tangent, designs, block, table.pair)
    for entry in scored:
        log.debug(
            "%s: p %.2g, gain %.4g (t %.1f), parts t %s",
            entry.name,
            entry.p_value,
            entry.gain.sum() / (seen.weight * (seen.left**2).sum(axis=-1)).sum(),
            t_ratio(entry.gain),
            None if entry.parts_gain is None else round(t_ratio(entry.parts_gain), 1),
        )
    selection = select(scored, float(seen.weight.sum()))
    if selection is None or selection.size * evidence.typical_px < MIN_SIZE_PX:
        return None
    return next(form for form in forms if form.name == selection.best.name), selection


def _entered(
    evidence: Evidence, model: Model, form: FieldForm, fitted: TrackFit
) -> tuple[Model, HeldOut, HeldOut] | None:
    """The model with a form in it, and both on blocks that they were not fitted to; None where these do not gain."""
    extended = replace(model, terms=(*model.terms, form.term))
    before, after = (_held_out(evidence, m, fitted) for m in (model, extended))
    gain = before.block_loss - after.block_loss
    log.debug("%s held out: %.4f to %.4f, t %.1f", form.name, before.rms, after.rms, t_ratio(gain))
    if gain.mean() < MIN_GAIN * before.block_loss.mean() or t_ratio(gain) < MIN_T:
        return None
    return extended, before, after


def _held_out(evidence: Evidence, model: Model, scaled: TrackFit) -> HeldOut:
    """Fit on every other block of a few pairs, judge on those between, and the other way round."""
    table = evidence.table(model, JUDGE_POINTS)
    block = table.pair // PAIRS_IN_BLOCK
    left = np.zeros(len(table))
    for fold in (0, 1):
        part = fit_model(evidence.imu, model, model.terms, table.chosen(block % 2 == fold))
        left[block % 2 != fold] = distances(evidence.imu, part, table, scaled.depth_spread_per_m)[block % 2 != fold]
    counts = np.maximum(np.bincount(block), 1)
    return HeldOut(np.bincount(block, loss(left, 1.0)) / counts, capped_rms(left))


def _without_stand_ins(
    evidence: Evidence, found: GeometricVerdict, model: Model, accepted: list[Accepted]
) -> tuple[Model, list[Accepted]]:
    """Let go of causes that are no longer significant, or of no use on held-out blocks, now that a field is in."""
    while True:
        fitted = evidence.fit(model, model.terms, evidence.table(model, JUDGE_POINTS))
        model = replace(model, profile=fitted.profile, scene=fitted.scene)
        fitting = [entry for entry in accepted if entry.effect is not None and entry.effect.term is not None]
        if not fitting:
            return model, accepted
        doubts = {entry.name: _doubt(evidence, found, fitted, entry) for entry in fitting}
        weakest = max(fitting, key=lambda entry: doubts[entry.name])
        less = _less(found, model, weakest)
        if doubts[weakest.name] < MAX_P and _useful(evidence, less, model, fitted):
            return model, accepted
        log.debug("stood in for a field: %s", weakest.name)
        model, accepted = less, [entry for entry in accepted if entry is not weakest]


def _doubt(evidence: Evidence, found: GeometricVerdict, fitted: TrackFit, entry: Accepted) -> float:
    assert entry.effect is not None
    return p_of(fitted, entry.effect, fitted.profile, found.nominal.profile, evidence.typical_px)


def _useful(evidence: Evidence, less: Model, more: Model, fitted: TrackFit) -> bool:
    """Whether held-out blocks are better off with a cause."""
    before, after = (_held_out(evidence, m, fitted) for m in (less, more))
    gain = before.block_loss - after.block_loss
    return bool(gain.mean() > MIN_GAIN * before.block_loss.mean() and t_ratio(gain) > MIN_T)


def _less(found: GeometricVerdict, model: Model, leaving: Accepted) -> Model:
    """The model without a cause, its values back where the profile had them."""
    assert leaving.effect is not None
    assert leaving.effect.term is not None
    name = leaving.effect.term.name
    back = -total_change(leaving.effect, found.nominal.profile, model.profile)
    terms: Sequence[Term] = [term for term in model.terms if term.name != name]
    return replace(model, profile=leaving.effect.term.change(model.profile, back), terms=tuple(terms))
