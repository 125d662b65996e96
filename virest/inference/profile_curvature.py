"""Curvature of the loss across the parallax, with the directions of travel following the values.

Gauss-Newton takes the whole residual along the parallax for parallax, although part of it is noise.  Where parallax is
not much longer than the noise, it overestimates what the points tell of the directions: its steps are too short, and
standard deviations come out two to four times too small.  The change of the scores between values on both sides of the
minimum, with the directions estimated again at each, contains no such error.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from virest.arrays import Array
from virest.inference.descent import Slopes
from virest.inference.track_evidence import TrackEvidence, TrackSystem

STEP = 2.0
"""Half the distance of the two values, in Gauss-Newton standard deviations: about one true one."""
LEAST_CURVATURE = 0.02
"""Smallest curvature in any direction, relative to Gauss-Newton's: what is known to 1/7 of it is not known."""
SHORTENED = (1.0, 0.5, 0.25, 0.1)
"""Fractions of a step that are tried until one lowers the loss."""
NEWTON_STEPS, CONVERGED = 6, 0.05
"""The steps end when one is shorter than this, rms in standard deviations."""


def at_profile_minimum(evidence: TrackEvidence, system: TrackSystem) -> tuple[TrackSystem, Array]:
    """Newton steps to the minimum of the loss over values and directions: the system there, and the inverse curvature.

    The curvature is that of the loss itself, not of its weights.
    """
    start, inverse = system, _inverse_curvature(evidence, system)
    spread = np.sqrt(np.diag(inverse))
    for _ in range(NEWTON_STEPS):
        step = inverse @ (system.score.sum(axis=0) - system.prior * system.off)
        step *= min(1.0, 1.0 / max(float(np.max(np.abs(step) / system.limit)), 1e-12))
        lower = _lower(evidence, system, step)
        if lower is None:
            break
        system = lower
        if np.sqrt(np.mean((step / spread) ** 2)) < CONVERGED:
            break
    return system, inverse if system is start else _inverse_curvature(evidence, system)


def _lower(evidence: TrackEvidence, system: TrackSystem, step: Array) -> TrackSystem | None:
    """The system after the longest of some fractions of a step that lowers the loss; None: none does.

    Away from the minimum the curvature may be too small in some direction, and the step too long.
    """
    after = (_moved(evidence, system, part * step) for part in SHORTENED)
    return next((found for found in after if found.cost(system.scale) <= system.cost(system.scale)), None)


def _inverse_curvature(evidence: TrackEvidence, system: TrackSystem) -> Array:
    size = np.sqrt(np.diag(system.normal))
    columns = []
    for change in np.diag(STEP * np.sqrt(np.diag(system.inverse()))):
        scores = []
        for step in (change, -change):
            after = _moved(evidence, system, step)
            scores.append(after.score.sum(axis=0) * (float(after.scale) / float(system.scale)) ** 2)
        columns.append((scores[1] - scores[0]) / (2 * change.sum()))
    curvature = np.stack(columns, axis=-1) + np.diag(system.prior)
    values, axes = np.linalg.eigh(0.5 * (curvature + curvature.T) / np.outer(size, size))
    return np.asarray((axes / np.maximum(values, LEAST_CURVATURE)) @ axes.T) / np.outer(size, size)


def _moved(evidence: TrackEvidence, system: TrackSystem, step: Array) -> TrackSystem:
    state = evidence.moved(system.state, step)
    state = replace(state, scene=system.state.scene)
    return evidence.weighed(state, evidence.look(state, system.look, Slopes.ON_THE_WAY))
