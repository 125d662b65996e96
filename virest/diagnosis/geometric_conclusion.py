"""End of the ladder: joint refit without causes that are no longer significant or useful."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from virest.camera.profile import CameraProfile
from virest.diagnosis.candidates import SCREEN_POINTS, Candidate
from virest.diagnosis.cross_validation import Screened, judge
from virest.diagnosis.findings import JOINED, Rung
from virest.diagnosis.geometric_evidence import Evidence, Model, capped_rms
from virest.diagnosis.geometric_significance import depth_p, p_if_plausible, refitted
from virest.diagnosis.geometric_verdict import FINAL_POINTS, Accepted, GeometricVerdict
from virest.diagnosis.selection import POINT_LEVELS
from virest.image_formation.point_model import TrackTable
from virest.inference import profile_terms as terms_of
from virest.inference.parallel import one_by_one
from virest.inference.track_fit import TrackFit
from virest.inference.tracking_bias import bias_std

log = logging.getLogger(__name__)


def conclude(
    evidence: Evidence,
    nominal_model: Model,
    model: Model,
    accepted: list[Accepted],
    rungs: list[Rung],
    nominal: CameraProfile,
) -> GeometricVerdict:
    """Refit everything jointly, and remove causes that are no longer significant.

    Causes that no longer improve held-out points are removed too: one of a pair may have absorbed a cause found later.
    """
    entered = len(accepted)
    paired = any(JOINED in (rung.entered or "") for rung in rungs)
    while True:
        model, fitted = refitted(evidence, model, FINAL_POINTS)
        table = evidence.table(model, FINAL_POINTS)
        leaving = [
            entry
            for entry in accepted
            if not POINT_LEVELS.significant(
                _p_value_of(evidence, fitted, table, entry, model.profile, nominal_model.profile)
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
        lag_std_s=lag_std_s(evidence, model, table) if model.lag else None,
    )  # fmt: skip


def lag_std_s(evidence: Evidence, model: Model, table: TrackTable) -> float:
    """Standard deviation of a start-up lag, from a time offset fitted to the lagging pairs alone.

    Schedules have discrete lags; the error between two steps appears as such an offset, whose value is included.
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
    """The cause with its held-out gain beside the remaining causes.

    Its gain on its rung differs if a cause was removed since, or if it entered as one of a pair.
    """
    if not _has_term(entry):
        return entry
    less, _ = refitted(evidence, _without(model, nominal, entry), SCREEN_POINTS)
    without_and_with = [
        Screened(Candidate("", m, (), None), (m, m), (0.0, 0.0), fitted.scale, fitted.depth_spread_per_m)
        for m in (less, model)
    ]
    before, after = judge(evidence, without_and_with, fitted.scale, fitted.depth_spread_per_m, one_by_one)
    return replace(entry, before=before.rms * evidence.typical_px, after=after.rms * evidence.typical_px, rivals=())


def _has_term(entry: Accepted) -> bool:
    return entry.effect is not None and entry.effect.term is not None


def _p_value_of(
    evidence: Evidence, fitted: TrackFit, table: TrackTable, entry: Accepted, found: CameraProfile, given: CameraProfile
) -> float:
    """p value of an accepted cause beside all others; 0 for a cause with a word as value."""
    if entry.name == "scene_depth":
        return depth_p(fitted, table, given.depth_m)
    if entry.effect is None or entry.effect.term is None:
        return 0.0
    return p_if_plausible(evidence, fitted, entry.effect, found, given)


def _without(model: Model, nominal: Model, leaving: Accepted) -> Model:
    """The model without one cause, whose parameters return to nominal; the other causes are kept for a refit."""
    if leaving.name == "scene_depth":
        return replace(model, scene=nominal.scene)
    assert leaving.effect is not None
    assert leaving.effect.term is not None
    name = leaving.effect.term.name
    terms = tuple(term for term in model.terms if term.name != name)
    back = leaving.effect.total_change(nominal.profile, model.profile)
    profile = leaving.effect.term.change(model.profile, -back)
    return replace(model, profile=profile, terms=terms)
