"""Geometric causes as findings: values with standard deviations, gains, and sentences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from virest.camera.profile import CameraProfile
from virest.diagnosis.findings import GEOMETRY, Finding, HeldOutGain, ParameterChange
from virest.diagnosis.geometric_evidence import depth_of
from virest.diagnosis.geometric_verdict import Accepted, GeometricVerdict
from virest.effects.table import EFFECTS
from virest.inference.tracking_bias import bias_std

UNKNOWN_FITTED = "virest diagnose, unknown before"
"""Source of values that the given profile leaves open."""


def findings_of(verdict: GeometricVerdict) -> list[Finding]:
    """The accepted causes as findings, strongest first."""
    found = []
    for entry in verdict.accepted:
        changes = changes_of(verdict, entry)
        held_out = HeldOutGain(GEOMETRY, entry.before, entry.after, verdict.noise_px)
        sentence = _sentence(entry, changes)
        found.append(Finding(entry.name, changes, held_out, entry.rivals, entry.p_value, sentence))
    return sorted(found, key=lambda f: f.held_out.after**2 - f.held_out.before**2)


def with_depth_of(findings: Sequence[Finding], profile: CameraProfile) -> CameraProfile:
    """The profile with the depth found; during the fits, the scene is held beside the profile."""
    for finding in findings:
        if finding.name == "scene_depth":
            return replace(profile, depth_m=float(finding.parameters["depth_m"].estimate))
    return profile


def with_unknowns_of(verdict: GeometricVerdict, profile: CameraProfile) -> CameraProfile:
    """The profile with the given profile's unknown values that the fit determined, each with its deviation."""
    for term in verdict.nominal.terms:
        value = EFFECTS[term.name].calibrated
        if value is None or term.name not in verdict.fit.slices:
            continue
        floor = bias_std(verdict.fit, term.name, verdict.step_noise_px)
        std = np.hypot(verdict.fit.std(term.name), floor)
        found = value.read(replace(profile, readout_known=True))
        if std.max() < value.max_std and found is not None:
            known = profile.readout_known or term.name == "readout_time"
            std = std * (np.abs(found) if value.is_factor else 1.0)
            std_of = std.tolist() if isinstance(found, list) else float(std[0])
            profile = profile.with_estimate(value.name, found, std_of, UNKNOWN_FITTED, readout_known=known)
    return profile


def changes_of(verdict: GeometricVerdict, entry: Accepted) -> dict[str, ParameterChange]:
    """Parameters of one cause, before and after; if the ladder has a rival end, its difference widens the deviation.

    Both ends are equally likely, so the variance about the reported value grows by half the squared difference.
    """
    changes = _changes_at(verdict, entry)
    twin = next((e for e in verdict.rival.accepted if e.name == entry.name), None) if verdict.rival else None
    if verdict.rival is None or twin is None:
        return changes
    at_rival = _changes_at(verdict.rival, twin)
    return {name: _widened(change, at_rival.get(name)) for name, change in changes.items()}


def _widened(change: ParameterChange, at_rival: ParameterChange | None) -> ParameterChange:
    if change.std is None or at_rival is None or at_rival.std is None:
        return change
    difference = np.subtract(change.estimate, at_rival.estimate) / np.sqrt(2)
    return replace(change, std=np.hypot(change.std, difference).tolist())


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
    effect = EFFECTS[entry.name]
    values = {name: shown(change.estimate) for name, change in changes.items() if change.estimate is not None}
    return (effect.sentence + effect.addition * (len(values) == len(effect.parameters))).format(**values)


def shown(value: Any) -> str:
    """Format a value for readers."""
    if isinstance(value, list):
        return "(" + ", ".join(shown(v) for v in value) + ")"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
