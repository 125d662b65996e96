"""Variance that a covariance misses while residuals exceed the noise: causes that did not enter.

A fit's covariance holds if the model is right.  Where residuals stay far above the tracking noise, it is not.  Each
value then depends on which further cause is assumed, and on where the descent began, since robust losses of points that
follow no model have many minima.  Each cause that a phone can have is therefore fitted beside those in the model, and
the model is fitted again from either side.  The shift of the values, beyond what the cause's own freedom explains,
enters their variance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.diagnosis.candidates import SCREEN_POINTS, Candidate
from virest.diagnosis.geometric_effects import GeometricEffect
from virest.diagnosis.geometric_evidence import Evidence, Model, fit_model
from virest.inference.parallel import ParallelMap
from virest.inference.track_fit import TrackFit

RESTART_SIGMA = 3.0
"""Repeat the model's own fit from this many standard deviations on either side."""
Plausible = Callable[[Evidence, GeometricEffect, CameraProfile, Array], bool]


def variance_left_open(
    evidence: Evidence,
    model: Model,
    effects: Sequence[GeometricEffect],
    further: Sequence[Candidate],
    plausible: Plausible,
    each: ParallelMap,
) -> dict[str, Array]:
    """By effect: variance (k,) of its values due to causes outside the model.

    further: causes that may be added, at all their starting points.  plausible: whether a phone can have such a value.
    """
    table = evidence.table(model, SCREEN_POINTS)
    base = fit_model(evidence.imu, model, model.terms, table)
    restarts = _restarts(model, effects, base)
    calls = [(evidence.imu, start, model.terms, table) for start in restarts]
    calls += [(evidence.imu, c.model, (*c.model.terms, *c.added), table) for c in further]
    fits = each(fit_model, calls)
    others = [fitted for fitted in fits[: len(restarts)] if fitted.cost <= base.cost]
    best: dict[str, TrackFit] = {}
    for candidate, fitted in zip(further, fits[len(restarts) :], strict=True):
        effect, name = candidate.effect, candidate.name
        if effect is None or fitted.cost >= best.get(name, base).cost:
            continue
        if plausible(evidence, effect, fitted.profile, effect.total_change(model.profile, fitted.profile)):
            best[name] = fitted
    return {effect.name: _added_variance(base, others, list(best.values()), effect) for effect in effects}


def _restarts(model: Model, effects: Sequence[GeometricEffect], fitted: TrackFit) -> list[Model]:
    """Models with one value of a cause moved to either side; the other values follow by their covariance."""
    starts = []
    for effect in effects:
        assert effect.term is not None
        part = fitted.slices[effect.term.name]
        for k in range(part.start, part.stop):
            step = fitted.covariance[k] / np.sqrt(max(fitted.covariance[k, k], np.finfo(float).tiny))
            starts += [_moved(model, fitted, side * RESTART_SIGMA * step) for side in (1.0, -1.0)]
    return starts


def _moved(model: Model, fitted: TrackFit, step: Array) -> Model:
    profile = model.profile
    for term in model.terms:
        profile = term.change(profile, step[fitted.slices[term.name]])
    return replace(model, profile=profile)


def _added_variance(
    base: TrackFit, others: Sequence[TrackFit], wider: Sequence[TrackFit], effect: GeometricEffect
) -> Array:
    """Variance (k,): the largest squared shift among the model's own refits, plus the excess of each further cause."""
    own = [effect.total_change(base.profile, other.profile) ** 2 for other in others]
    freedom = [np.maximum(_variance(other, effect) - _variance(base, effect), 0.0) for other in wider]
    moved = [effect.total_change(base.profile, other.profile) ** 2 for other in wider]
    excess = [np.maximum(shift - free, 0.0) for shift, free in zip(moved, freedom, strict=True)]
    nothing = np.zeros(len(_variance(base, effect)))
    return np.asarray(np.max([nothing, *own], axis=0) + np.sum([nothing, *excess], axis=0))


def _variance(fitted: TrackFit, effect: GeometricEffect) -> Array:
    assert effect.term is not None
    part = fitted.slices[effect.term.name]
    return np.asarray(np.diag(fitted.covariance)[part])
