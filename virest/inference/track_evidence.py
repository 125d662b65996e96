"""Tracked points as evidence: their prediction from a profile's terms and the scene's motion, and their uncertainty.

The points' slopes change little during a descent: they are re-evaluated only after the points have moved far, and once
more where the descent ends.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from virest.arrays import Array
from virest.capture.imu import ImuSamples
from virest.image_formation.point_changes import PointChanges
from virest.image_formation.point_model import IntegratedMotion, Prediction, TrackTable, predict, with_profile
from virest.inference.descent import Slopes, System, slices
from virest.inference.fit_start import FitStart
from virest.inference.robust import CAUCHY, NORMAL_MEDIAN, RAYLEIGH_MEDIAN, cauchy_weight
from virest.inference.term import Term, slopes_of
from virest.inference.travel_direction import find_directions, without_directions
from virest.motion.scene_motion import DirectedMotion, InertialMotion, Motion

SMALLEST_SCALE = 0.03
"""Least factor on the tracking noise: points without noise, as in tests, fit better than any that are tracked."""
STALE = {Slopes.ON_THE_WAY: (1.5, 0.5), Slopes.AT_THE_END: (0.1, 0.05), Slopes.HERE: (0.0, 0.0)}
"""Reuse the Jacobian until points move this far (median, px) or the scene changes by this fraction."""
ANY_DEPTH = 1e6
"""Spread of inverse depths that allows any position along the parallax."""


@dataclass(frozen=True, slots=True)
class State:
    """State of a descent."""

    known: IntegratedMotion
    scene: Motion | None
    change: Array
    """(k,) change of the terms' values from the starting profile."""
    depth_spread: float
    """Standard deviation of points' inverse depths about the plane, 1/m."""


@dataclass(frozen=True, slots=True)
class Linearisation:
    """The points predicted at a state, with slopes evaluated there or nearby."""

    scene: Motion | None
    prediction: Prediction
    slope: Array
    """(n, 2, k) change of the predicted points per unit of each term's values and of the motion's entries, px."""
    taken_px: Array
    """(n, 2) predicted points where the slopes were evaluated."""
    taken_scene: Motion | None

    def is_stale(self, limit: Slopes) -> bool:
        """Whether points or scene have changed by more than STALE since the slopes were evaluated."""
        if self.prediction.second_px is self.taken_px:
            return False
        moved_px = float(np.median(np.abs(self.prediction.second_px - self.taken_px)))
        most_px, most_part = STALE[limit]
        return moved_px > most_px or _part_moved(self.taken_scene, self.scene) > most_part


def _part_moved(before: Motion | None, after: Motion | None) -> float:
    """Largest relative change of the planes and velocities of an inertial motion."""
    if not isinstance(before, InertialMotion) or not isinstance(after, InertialMotion):
        return 0.0
    parts = (
        np.linalg.norm(new - old) / max(float(np.linalg.norm(old)), 1e-9)
        for new, old in ((after.plane_per_m, before.plane_per_m), (after.velocity_m_s, before.velocity_m_s))
    )
    return float(max(parts))


TrackSystem = System[State, Linearisation]


@dataclass(frozen=True, slots=True)
class TrackEvidence:
    """Tracked points, and everything that stays constant during a descent."""

    imu: ImuSamples
    table: TrackTable
    terms: tuple[Term, ...]
    start: Motion | None
    shared: FitStart | None = None
    """Keeps what other fits of these points need too."""

    def look(self, state: State, before: Linearisation | None, limit: Slopes) -> Linearisation:
        """Predict the points of a state, reusing the slopes of an earlier look while they are not stale."""
        table, scene = self.table, state.scene
        if limit is Slopes.HERE and self.shared is not None and state.known is self.shared.known:
            return self._shared_look(self.shared, state, None if before is None else before.prediction)
        like = None if before is None else before.prediction
        directed = isinstance(scene, DirectedMotion)
        if before is not None or directed:
            prediction = predict(state.known, table, scene, like=like)
            if isinstance(scene, DirectedMotion):
                prediction, scene = _directed(table, prediction, scene)
            if before is not None:
                kept = Linearisation(scene, prediction, before.slope, before.taken_px, before.taken_scene)
                if not kept.is_stale(limit):
                    return kept
            like = prediction
        if directed:  # slopes do not depend on the direction, which is eliminated
            slope = self._term_slopes(replace(state, scene=None), prediction)
            return Linearisation(scene, prediction, slope, prediction.second_px, scene)
        prediction = predict(state.known, table, scene, slopes=scene is not None, like=like)
        slopes = [self._term_slopes(state, prediction)]
        slopes += [] if prediction.slopes is None or self.start is None else [prediction.slopes]
        prediction = replace(prediction, slopes=None)
        return Linearisation(scene, prediction, np.concatenate(slopes, axis=-1), prediction.second_px, scene)

    def _shared_look(self, shared: FitStart, state: State, like: Prediction | None) -> Linearisation:
        """Predict the points where several fits begin; the prediction and each term's slopes are computed once."""
        table, begun = self.table, state.scene
        directed = isinstance(begun, DirectedMotion)

        def seen() -> tuple[Prediction, Motion | None]:
            moves = begun is not None and not directed
            prediction = predict(state.known, table, begun, slopes=moves, like=like)
            return _directed(table, prediction, begun) if isinstance(begun, DirectedMotion) else (prediction, begun)

        prediction, scene = shared.seen(begun, seen)
        base = replace(state, scene=None) if directed else state
        slopes = [
            shared.slopes(term, begun, lambda term=term: self._term_slopes(base, prediction, (term,)))  # type: ignore[misc]
            for term in self.terms
        ]
        slopes += [] if prediction.slopes is None or self.start is None else [prediction.slopes]
        slope = np.concatenate(slopes, axis=-1) if slopes else np.zeros((len(table), 2, 0))
        prediction = replace(prediction, slopes=None)
        return Linearisation(scene, prediction, slope, prediction.second_px, scene)

    def _term_slopes(self, state: State, at: Prediction, terms: tuple[Term, ...] | None = None) -> Array:
        """(n, 2, k) change of the predicted points per unit of each term's values; terms: None for all."""
        return slopes_of(terms or self.terms, PointChanges(self.imu, state.known, self.table, state.scene, at))

    def weighed(self, state: State, look: Linearisation) -> TrackSystem:
        """Whiten a look's rows by noise and spread of depths, and eliminate the directions of travel."""
        table, scene = self.table, look.scene
        difference = table.second_px - look.prediction.second_px
        limit = [value for term in self.terms for value in term.limit]
        prior = [std**-2.0 for term in self.terms for std in term.prior_std]
        off = list(state.change)
        if scene is not None and self.start is not None:
            limit += list(scene.limits())
            prior += list(scene.prior_std() ** -2.0)
            off += list(scene.vector() - self.start.vector())
        whiten = self.whitening(state, look.prediction)
        rows, left = whiten @ look.slope, np.einsum("nij,nj->ni", whiten, difference)
        squared = (left**2).sum(axis=-1)
        typical = NORMAL_MEDIAN if state.depth_spread == ANY_DEPTH else RAYLEIGH_MEDIAN
        scale = max(float(np.median(np.sqrt(squared))) / typical, SMALLEST_SCALE)
        if isinstance(scene, DirectedMotion):
            noise, flow = table.noise_px[table.pair], np.asarray(look.prediction.per_step)
            rows, left = without_directions(
                rows, left, cauchy_weight(squared, CAUCHY * scale), difference / noise[:, None],
                flow / noise[:, None, None], scene.direction, scene.group(table.pair),
            )  # fmt: skip
        found = replace(state, scene=scene)
        return System(found, look, rows, left, squared, scale, np.array(prior), np.array(off), np.array(limit))

    def whitening(self, state: State, at: Prediction) -> Array:
        """Matrices (n, 2, 2), 1/px, that divide by the standard deviations of the predicted points."""
        noise = self.table.noise_px[self.table.pair]
        whole = np.eye(2) / noise[:, None, None]
        if at.along_px is None:
            return np.asarray(whole)
        length, way = lengths_and_ways(at.along_px)
        shrink = 1 - 1 / np.sqrt(1 + (state.depth_spread * length / noise) ** 2)
        return np.asarray(whole - ((shrink / noise)[:, None] * way)[:, :, None] * way[:, None, :])

    def moved(self, state: State, step: Array) -> State:
        """The state after a step: of the terms' values, then of the scene's."""
        profile, count = state.known.profile, len(state.change)
        for term, part in zip(self.terms, slices(map(len, self.terms)), strict=True):
            profile = term.change(profile, step[part])
        scene = None if state.scene is None else state.scene.with_vector(state.scene.vector() + step[count:])
        known = with_profile(state.known, self.imu, profile)
        return State(known, scene, state.change + step[:count], state.depth_spread)

    def depth_spread(self, system: TrackSystem) -> float:
        """Standard deviation of inverse depths, from the excess of residuals along the parallax over those across."""
        along_px = system.look.prediction.along_px
        if along_px is None or system.state.depth_spread == ANY_DEPTH:
            return 0.0 if along_px is None else ANY_DEPTH
        noise = self.table.noise_px[self.table.pair]
        length, way = lengths_and_ways(along_px)
        sensitive = (ratio := length / noise) > np.quantile(ratio, 0.5)
        if sensitive.sum() < 50 or np.median(ratio[sensitive]) < 1e-3:
            return 0.0
        off = ((self.table.second_px - system.look.prediction.second_px) / noise[:, None])[sensitive]
        way, ratio = way[sensitive], ratio[sensitive]
        along, across = (off * way).sum(axis=-1), off[:, 1] * way[:, 0] - off[:, 0] * way[:, 1]
        base = (np.median(np.abs(across)) / NORMAL_MEDIAN) ** 2
        more = along**2 - base * NORMAL_MEDIAN**2
        return float(np.sqrt(max(np.median(more / ratio**2), 0.0))) / NORMAL_MEDIAN


# ── one linearisation ────────────────────────────────────────────────────────────────────────────────────────────


def lengths_and_ways(vectors: Array) -> tuple[Array, Array]:
    """Lengths (n,) of vectors (n, 2), and the unit vectors (n, 2) along them."""
    length = np.linalg.norm(vectors, axis=-1)
    return length, vectors / np.maximum(length, 1e-12)[:, None]


def _directed(table: TrackTable, at: Prediction, motion: DirectedMotion) -> tuple[Prediction, DirectedMotion]:
    """Directions re-estimated from the residuals, and the prediction with the parallax along them."""
    assert at.per_step is not None
    noise, group = table.noise_px[table.pair], motion.group(table.pair)
    start = motion.direction if motion.direction.any() else None
    found = find_directions(
        at.per_step / noise[:, None, None], (table.second_px - at.second_px) / noise[:, None], group,
        len(motion.direction), start,
    )  # fmt: skip
    along = np.squeeze(at.per_step @ found[group][..., None], -1)
    return replace(at, along_px=along), DirectedMotion(found)
