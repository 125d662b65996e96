"""Significance of a cause that moves points, given the causes already in the model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from virest.arrays import Array
from virest.calibration.physical_limits import is_depth
from virest.camera.profile import CameraProfile
from virest.diagnosis.candidates import Candidate
from virest.diagnosis.cross_validation import JUDGE_POINTS
from virest.diagnosis.geometric_effects import GeometricEffect
from virest.diagnosis.geometric_evidence import KNOWN_DEPTH_STD, Evidence, Model, depth_of
from virest.diagnosis.selection import POINT_LEVELS, WORD_LEVELS
from virest.effects.table import STABILISED_OFF
from virest.image_formation.point_model import TrackTable
from virest.image_formation.row_clock import right_way_round
from virest.inference.chance import chance_of, chi2_tail
from virest.inference.stabiliser_fit import without_idle_ends
from virest.inference.track_fit import TrackFit
from virest.inference.tracking_bias import bias_std

STABILISER_CUTOFF_HZ = (0.03, 15.0)
"""Range of an estimated cutoff; beyond it the fit has run to an end of its own range (changes.CUTOFFS_HZ)."""


def refitted(evidence: Evidence, model: Model, points: int) -> tuple[Model, TrackFit]:
    """Refit a model's terms and scene to at most this many points.

    A negative readout becomes a positive one, and ends that a stabiliser's lens does not reach are dropped.
    """
    table = evidence.table(model, points)
    fitted = evidence.fit(model, model.terms, table)
    endless = without_idle_ends(fitted)
    if endless is not None:
        fitted = evidence.fit(replace(model, profile=endless), model.terms, table)
    return replace(model, profile=right_way_round(fitted.profile), scene=fitted.scene), fitted


def fitted_with(evidence: Evidence, candidate: Candidate) -> tuple[Model, TrackFit]:
    """Refit the model with the candidate added."""
    return refitted(evidence, replace(candidate.model, terms=(*candidate.model.terms, *candidate.added)), JUDGE_POINTS)


def significant(
    evidence: Evidence, candidate: Candidate, before: CameraProfile, gain: Array
) -> tuple[Model | None, float]:
    """(model with the candidate if its value is significant, else None; p value of no change).

    A cause with a word as value has no number to test: its p value is that of such a consistent gain (blocks,).
    """
    model, fitted = fitted_with(evidence, candidate)
    if candidate.name != "scene_depth" and (candidate.effect is None or candidate.effect.term is None):
        p_value = chance_of(gain)
        return (model if WORD_LEVELS.significant(p_value) else None), p_value
    if candidate.name == "scene_depth":
        p_value = depth_p(fitted, evidence.table(model, JUDGE_POINTS), before.depth_m)
    else:
        p_value = p_value_of(evidence, fitted, candidate, model.profile, before)
    return (model if POINT_LEVELS.significant(p_value) else None), p_value


def p_value_of(
    evidence: Evidence, fitted: TrackFit, candidate: Candidate, found: CameraProfile, before: CameraProfile
) -> float:
    """p value of a candidate's value against zero; 1 if no phone has such a value."""
    assert candidate.effect is not None
    return p_if_plausible(evidence, fitted, candidate.effect, found, before)


def p_if_plausible(
    evidence: Evidence, fitted: TrackFit, effect: GeometricEffect, found: CameraProfile, before: CameraProfile
) -> float:
    """p value of an effect's value against zero; 1 if it ends at or beyond the bounds of real phones."""
    if not is_plausible(evidence, effect, found, effect.total_change(before, found)):
        return 1.0
    return p_of(fitted, effect, found, before, evidence.typical_px)


def depth_p(fitted: TrackFit, table: TrackTable, given_m: float | None) -> float:
    """p value of the change in inverse depth; 1 if the depth ends at its limits."""
    depth_m, std = depth_of(fitted, table)
    if not is_depth(depth_m):
        return 1.0
    given_m = given_m or np.inf
    nearer = 1 / depth_m - 1 / given_m
    inverse_std = std / depth_m**2 if np.isinf(given_m) else np.hypot(std / depth_m**2, KNOWN_DEPTH_STD / given_m)
    return chi2_tail((nearer / max(inverse_std, 1e-9)) ** 2, 1)


def is_plausible(evidence: Evidence, effect: GeometricEffect, found: CameraProfile, change: Array) -> bool:
    """Whether a phone can have such a value; a cause at or beyond these bounds compensates for another."""
    if effect.name in evidence.impossible(found):
        return False
    if effect.name == "stabilisation":
        low, high = STABILISER_CUTOFF_HZ
        extensions = found.extensions
        return (
            0 < extensions.stabilisation_fraction <= STABILISED_OFF and low < extensions.stabilisation_cutoff_hz < high
        )
    assert effect.effect.steps is not None
    return bool(np.all(np.abs(change) < effect.effect.steps.believable))


def p_of(
    fitted: TrackFit, effect: GeometricEffect, found: CameraProfile, before: CameraProfile, noise_px: float
) -> float:
    """p value of an effect's total change: a chi-square test whose covariance includes the tracker's bias."""
    change = effect.total_change(before, found)
    bias = bias_std(fitted, effect.name, noise_px)
    part = fitted.slices[effect.name]
    covariance = fitted.covariance[part, part] + np.diag(bias**2)
    if effect.name == "stabilisation":
        return chi2_tail(change[0] ** 2 / covariance[0, 0], 1)
    return chi2_tail(change @ np.linalg.solve(covariance, change), len(change))
