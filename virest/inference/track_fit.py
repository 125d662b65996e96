"""Fit a camera profile to tracked points: robust Gauss-Newton over named terms, with the scene's motion beside them.

Each term changes a profile by a small step.  The camera's velocity, gravity, the accelerometer's bias and delay and the
scene's plane are fitted along where the accelerometer tells a displacement.  Differences are whitened by the noise of
their pair and, along the parallax, by the spread of depths about the plane; Cauchy weights bear moving objects.
Covariances come from the scatter between blocks of time, since points of one frame are not independent.

How the points depend on the values changes little on the way: slopes are taken anew only where the points have moved
far since, and once more where the fit ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.errors import ImuError
from virest.image_formation.point_model import (
    Index,
    IntegratedMotion,
    Prediction,
    TrackTable,
    ground,
    predict,
    with_profile,
)
from virest.inference.robust import CAUCHY, NORMAL_MEDIAN, RAYLEIGH_MEDIAN
from virest.inference.travel_direction import find_directions, without_directions
from virest.motion.scene_motion import DirectedMotion, InertialMotion, Motion

Array = NDArray[np.float64]
MAX_ITERATIONS = 15
CONVERGED = 0.02
"""A step below this part of every standard deviation ends the fit."""
GRAVITY_M_S2 = 9.81
MIN_BLOCKS = 4
MAX_DAMPING = 1e3
SMALLEST_SCALE = 0.03
PLACES = 5
"""The picture is divided into this many parts each way: a wall or a ceiling fills some of them."""
ON_THE_WAY, AT_THE_END = (1.5, 0.5), (0.1, 0.05)
"""Reuse the Jacobian until points move this far (median, px) or the scene changes by this fraction."""
NOT_AT_ALL = (0.0, 0.0)
ALMOST_NOTHING = 1e-9
ANY_DEPTH = 1e6
"""Spread of inverse depths that leaves a point free to lie anywhere along its parallax."""
ONE_DIRECTION = 1.15
"""One direction of travel for the whole capture stays if it leaves less than this many times what one a pair leaves."""
SPREAD_PASSES, SPREAD_TOLERANCE = 3, 0.2
"""The spread of depths is measured anew after each descent until it changes by less than this part."""


@dataclass(frozen=True, slots=True)
class Term:
    """One thing that may be wrong with a profile: how a vector of steps changes it."""

    name: str
    change: Callable[[CameraProfile, Array], CameraProfile]
    """The profile with these values (k,) added to its own."""
    quotient: tuple[float, ...]
    """(k,) step of the difference quotient; also tells how many values there are."""
    limit: tuple[float, ...]
    """(k,) largest change in one iteration."""
    prior_std: tuple[float, ...]
    """(k,) of the whole change about the starting profile; inf: none."""
    slopes: Callable[[CameraProfile, TrackTable, Callable[[CameraProfile], Array]], Array] | None = None
    """Of a profile, the points, and by how much (n, 2) another profile moves them: (n, 2, k) all slopes at once, where
    that is quicker; None: quotient by quotient."""

    def __len__(self) -> int:
        return len(self.quotient)


def slopes_of(
    term: Term, profile: CameraProfile, table: TrackTable, moved_by: Callable[[CameraProfile], Array]
) -> Array:
    """Change (n, 2, k) of the predicted points per unit of a term's values; moved_by: of another profile."""
    if term.slopes is not None:
        return term.slopes(profile, table, moved_by)
    columns = []
    for k, quotient in enumerate(term.quotient):
        step = np.zeros(len(term))
        step[k] = quotient
        columns.append(moved_by(term.change(profile, step)) / quotient)
    return np.stack(columns, axis=-1) if columns else np.zeros((len(table), 2, 0))


@dataclass(frozen=True, slots=True)
class CovarianceModel:
    """What the covariance of values, or of anything linear in them, is made of: sandwich H⁻¹ S H⁻¹ and prior.

    A correction along a value must not be carried over to combinations in which values' errors cancel, such as the
    velocity at an instant (from velocity, gravity and bias): it is asked for anew there.
    """

    curvature: Array
    """(k, k) H⁻¹: as if points were independent."""
    by_moment: Array | None = None
    """(k, k) scatter of what the blocks of time move the values by; None: too few of them."""
    by_place: Array | None = None
    """(k, k) what parts of the picture share beyond moments."""
    prior: Array | None = None
    """(k, k) the priors' part."""
    relief: Array | None = None
    """(places, k) what each part of the picture moves the values by if it lies off the plane by the spread of depths;
    None: no relief is allowed for."""

    def by_relief(self, slope: Array) -> Array:
        """Covariance (..., m, m), of what changes by slope (..., m, k), from relief that stands in its place.

        A camera that travels to and fro sees the same relief pull one way and the other; one that walks on does not.
        """
        if self.relief is None:
            return np.zeros((*slope.shape[:-1], slope.shape[-2]))
        pulled = slope @ self.relief.T
        return np.asarray(pulled @ np.swapaxes(pulled, -1, -2))

    def of(self, slope: Array) -> Array:
        """Covariance (..., m, m) of what changes by slope (..., m, k) per unit of the values.

        Parts of the picture widen it; along nothing is it below the curvature's.
        """
        back = np.swapaxes(slope, -1, -2)
        least = slope @ self.curvature @ back
        if self.by_moment is None or self.by_place is None or self.prior is None:
            return np.asarray(least)
        sandwich = slope @ self.by_moment @ back
        # a difference of two may come out negative: places then share nothing
        places = np.maximum(_diagonal(slope @ self.by_place @ back), 0.0)
        share = np.sqrt(1 + places / np.maximum(_diagonal(sandwich), 1e-300))
        total = sandwich * share[..., :, None] * share[..., None, :] + slope @ self.prior @ back
        total = total + ALMOST_NOTHING * least  # where all cancels there is still something to raise
        raised = np.sqrt(np.maximum(_diagonal(least) / np.maximum(_diagonal(total), 1e-300), 1.0))
        return np.asarray(total * raised[..., :, None] * raised[..., None, :])


def _diagonal(matrix: Array) -> Array:
    return np.diagonal(matrix, axis1=-2, axis2=-1)


@dataclass(frozen=True, slots=True)
class TrackFit:
    """A fitted profile with what it leaves."""

    profile: CameraProfile
    scene: Motion | None
    terms: tuple[Term, ...]
    change: Array
    """(k,) total change of the terms' values from the starting profile."""
    covariance: Array
    """(k + scene, k + scene): the terms first."""
    doubt: CovarianceModel
    """What the covariance is made of, for what is linear in the values."""
    scale: float
    """Robust standard deviation of the whitened differences; 1 where the model explains all."""
    depth_spread_per_m: float
    """Standard deviation of points' inverse depths about the plane."""
    difference_px: Array
    """(n, 2) tracked minus predicted; of a directed motion the part across its parallax."""
    weight: Array
    """(n,) Cauchy weights, 0 to 1."""
    distance: Array
    """(n,) whitened length of each difference, in standard deviations."""
    stretches: Array
    """(k,) on how many blocks of time each value of the terms rests: (Σ share)² / Σ share² of its information."""
    cost: float
    """Σ of the robust loss over the points, whitened: comparable between fits of one table."""
    ground: IntegratedMotion
    seconds: Array
    """(n,) when the second points were seen, IMU clock."""
    noise_px: Array
    """(n,) of each point's step, per coordinate."""
    along_px: Array | None
    """(n, 2) change of the second points per unit of inverse depth; None where no relief is allowed for."""
    slices: dict[str, slice] = field(default_factory=dict)

    def distance_at(self, depth_spread_per_m: float) -> Array:
        """Whitened distances (n,) as if points' inverse depths spread by this deviation about the plane.

        Fits are comparable at one spread only: a wrong plane calls for a wide one, and is then no further off.
        """
        left = self.difference_px / self.noise_px[:, None]
        if self.along_px is None:
            return self.distance
        length = np.linalg.norm(self.along_px, axis=-1)
        way = self.along_px / np.maximum(length, 1e-12)[:, None]
        variance = 1 + (depth_spread_per_m * length / self.noise_px) ** 2
        along = (left * way).sum(axis=-1)
        return np.asarray(np.sqrt(np.maximum((left**2).sum(axis=-1) - along**2 * (1 - 1 / variance), 0.0)))

    def across_relief_px(self) -> Array:
        """Differences (n, 2) in px, along the parallax only what the points' spread of depths does not explain."""
        if self.along_px is None:
            return self.difference_px
        length = np.linalg.norm(self.along_px, axis=-1)
        way = self.along_px / np.maximum(length, 1e-12)[:, None]
        shrink = 1 - 1 / np.sqrt(1 + (self.depth_spread_per_m * length / self.noise_px) ** 2)
        return self.difference_px - (shrink * (self.difference_px * way).sum(axis=-1))[:, None] * way

    def relief_cost(self) -> Array:
        """What the points' spread of depths costs in the likelihood (n,): the logarithm of their standard deviation."""
        if self.along_px is None:
            return np.zeros(len(self.distance))
        ratio = np.linalg.norm(self.along_px, axis=-1) / self.noise_px
        return np.asarray(0.5 * np.log1p((self.depth_spread_per_m * ratio) ** 2))

    @property
    def curvature(self) -> Array:
        """The covariance from the curvature alone, as if points were independent."""
        return self.doubt.curvature

    @property
    def by_relief(self) -> Array:
        """By how much values err (k + scene,) where the picture's parts lie off the plane by the spread of depths."""
        each = np.eye(len(self.covariance))[:, None, :]
        return np.asarray(np.sqrt(self.doubt.by_relief(each)[:, 0, 0]))

    def std(self, name: str) -> Array:
        """Standard deviations (k,) of a term's values."""
        part = self.slices[name]
        return np.sqrt(np.maximum(np.diag(self.covariance)[part], 0.0))

    def value(self, name: str) -> Array:
        """Total change (k,) of a term's values."""
        return self.change[self.slices[name]]


def start_scene(
    imu: ImuSamples, known: IntegratedMotion, table: TrackTable, inverse_depth_per_m: float
) -> InertialMotion:
    """Begin at rest before a plane across the first sight, with gravity as the mean specific force says."""
    origin = np.asarray(known.profile.imu_time_s(table.origin_s))
    axis = known.trajectory.orientation(origin)[:, :, 2]
    gravity = np.zeros(3)
    if known.displacement is not None:
        start_s, end_s = known.profile.imu_time_s(np.array([table.first_stamp_s.min(), table.second_stamp_s.max()]))
        inside = (imu.time_s >= start_s) & (imu.time_s <= end_s)
        force = known.displacement.acceleration(imu.time_s[inside] if inside.any() else imu.time_s).mean(axis=0)
        gravity = -force * GRAVITY_M_S2 / max(float(np.linalg.norm(force)), 1e-6)
    return InertialMotion(np.zeros((table.n_windows, 3)), gravity, np.zeros(3), 0.0, axis * inverse_depth_per_m)


def fit_tracks(
    imu: ImuSamples,
    table: TrackTable,
    profile: CameraProfile,
    terms: Sequence[Term],
    scene: Motion | None = None,
    *,
    known: IntegratedMotion | None = None,
    blocks: int = 12,
    max_iterations: int = MAX_ITERATIONS,
    covariances: bool = True,
) -> TrackFit:
    """Gauss-Newton from a profile; scene None: rotation only. Raises ImuError for too few inertial samples.

    covariances: False leaves the last slopes where they were taken: values and differences are the same, covariances
    are coarse.
    """
    terms = tuple(terms)
    inertial = isinstance(scene, InertialMotion)
    if known is None or (inertial and known.displacement is None):
        known = ground(imu, profile, translation=inertial)
    known = with_profile(known, imu, profile)
    if inertial and known.displacement is None:
        raise ImuError("no accelerometer to tell the camera's path", hint="fit a free motion")
    directed = isinstance(scene, DirectedMotion)
    state = _State(known, scene, np.zeros(sum(map(len, terms))), ANY_DEPTH if directed else 0.0)
    look: _Look | None = None
    for _ in range(SPREAD_PASSES if inertial else 1):
        state, system = _descend(imu, table, terms, scene, state, max_iterations, look, covariances)
        if inertial and abs(system.depth_spread - state.depth_spread) <= SPREAD_TOLERANCE * system.depth_spread:
            break
        state = replace(state, depth_spread=system.depth_spread if inertial else state.depth_spread)
        look = system.look
    return _conclude(table, terms, state, system, blocks)


def _descend(
    imu: ImuSamples,
    table: TrackTable,
    terms: tuple[Term, ...],
    start: Motion | None,
    state: _State,
    max_iterations: int,
    look: _Look | None,
    fresh: bool,
) -> tuple[_State, _System]:
    """Levenberg-Marquardt at one spread of depths; the robust scale follows each accepted step.

    look: at this state, from an earlier descent.  fresh: slopes are taken anew where it ends.
    """
    problem = _Problem(imu, table, terms, start)
    system, damping = problem.weighed(state, look or problem.look(state, None)), 0.0
    if not system.hessian.size:
        return replace(state, scene=system.scene), system
    for _ in range(max_iterations):
        step = system.solve(damping)
        step *= min(1.0, 1.0 / max(float(np.max(np.abs(step) / system.limit, initial=0.0)), 1e-12))
        moved = _moved(imu, terms, state, step)
        after = problem.weighed(moved, problem.look(moved, system.look, ON_THE_WAY))
        if _cost(after, system.scale) > _cost(system, system.scale) * (1 + 1e-9):
            if system.look.is_stale(NOT_AT_ALL):
                system = problem.weighed(state, problem.look(state, system.look, NOT_AT_ALL))
                continue
            damping = max(10 * damping, 1e-3)
            if damping > MAX_DAMPING:
                break
            continue
        small = bool(np.all(np.abs(step) < CONVERGED * np.sqrt(np.diag(system.inverse()))))
        state, system, damping = replace(moved, scene=after.scene), after, damping / 10 if damping > 1e-4 else 0.0
        if small and not system.look.is_stale(AT_THE_END):
            break
        if small:
            system = problem.weighed(state, problem.look(state, system.look, AT_THE_END))
    if fresh and system.look.is_stale(AT_THE_END):
        system = problem.weighed(state, problem.look(state, system.look, AT_THE_END))
    return state, system


# ── one linearisation ────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class _State:
    known: IntegratedMotion
    scene: Motion | None
    change: Array
    depth_spread: float


@dataclass(frozen=True, slots=True)
class _Look:
    """The points as a state predicts them, with slopes that were taken there or not far away."""

    scene: Motion | None
    prediction: Prediction
    slope: Array
    """(n, 2, k) change of the predicted points per unit of each term's values and of the motion's entries, px."""
    taken_px: Array
    """(n, 2) where the points were predicted when the slopes were taken."""
    taken_scene: Motion | None

    def is_stale(self, limit: tuple[float, float]) -> bool:
        """Whether points or scene have moved further than (px, part) since the slopes were taken."""
        if self.prediction.second_px is self.taken_px:
            return False
        moved_px = float(np.median(np.abs(self.prediction.second_px - self.taken_px)))
        return moved_px > limit[0] or _part_moved(self.taken_scene, self.scene) > limit[1]


def _part_moved(before: Motion | None, after: Motion | None) -> float:
    """By what part the planes and velocities of an inertial motion have changed."""
    if not isinstance(before, InertialMotion) or not isinstance(after, InertialMotion):
        return 0.0
    parts = (
        np.linalg.norm(new - old) / max(float(np.linalg.norm(old)), 1e-9)
        for new, old in ((after.plane_per_m, before.plane_per_m), (after.velocity_m_s, before.velocity_m_s))
    )
    return float(max(parts))


@dataclass(frozen=True, slots=True)
class _System:
    """Weighted rows at one point, and their normal equations with the priors."""

    look: _Look
    difference: Array
    squared: Array
    """(n,) squared whitened differences."""
    weight: Array
    scale: float
    depth_spread: float
    rows: Array
    """(n, 2, k) whitened."""
    left: Array
    """(n, 2) whitened differences."""
    hessian: Array
    gradient: Array
    prior: Array
    """(k,) information."""
    pulled: Array
    """(k,) gradient of the priors."""
    limit: Array

    def solve(self, damping: float) -> Array:
        matrix = self.hessian + np.diag(self.prior)
        matrix = matrix + damping * np.diag(np.diag(matrix))
        return np.asarray(_solved(matrix, self.gradient - self.pulled))

    def inverse(self) -> Array:
        return _inverse(self.hessian + np.diag(self.prior))

    @property
    def scene(self) -> Motion | None:
        """As it was found anew, for a directed motion."""
        return self.look.scene

    @property
    def prediction(self) -> Prediction:
        """Where the points should be."""
        return self.look.prediction


@dataclass(frozen=True, slots=True)
class _Problem:
    """What stays the same through a descent."""

    imu: ImuSamples
    table: TrackTable
    terms: tuple[Term, ...]
    start: Motion | None

    def look(self, state: _State, before: _Look | None, limit: tuple[float, float] = NOT_AT_ALL) -> _Look:
        """Predict the points of a state; slopes of an earlier look serve while they are not stale."""
        table, scene = self.table, state.scene
        like = None if before is None else before.prediction
        directed = isinstance(scene, DirectedMotion)
        if before is not None or directed:
            prediction = predict(state.known, table, scene, like=like)
            if isinstance(scene, DirectedMotion):
                prediction, scene = _directed(table, prediction, scene)
            if before is not None:
                kept = _Look(scene, prediction, before.slope, before.taken_px, before.taken_scene)
                if not kept.is_stale(limit):
                    return kept
            like = prediction
        if directed:  # whose points do not depend on which way it goes
            slope = self._term_slopes(replace(state, scene=None), prediction)
            return _Look(scene, prediction, slope, prediction.second_px, scene)
        prediction = predict(state.known, table, scene, slopes=scene is not None, like=like)
        slopes = [self._term_slopes(state, prediction)]
        slopes += [] if prediction.slopes is None or self.start is None else [prediction.slopes]
        prediction = replace(prediction, slopes=None)
        return _Look(scene, prediction, np.concatenate(slopes, axis=-1), prediction.second_px, scene)

    def _term_slopes(self, state: _State, at: Prediction) -> Array:
        """(n, 2, k) change of the predicted points per unit of each term's values."""

        def moved_by(profile: CameraProfile) -> Array:
            moved = with_profile(state.known, self.imu, profile)
            return predict(moved, self.table, state.scene, like=at).second_px - at.second_px

        found = [slopes_of(term, state.known.profile, self.table, moved_by) for term in self.terms]
        return np.concatenate(found, axis=-1) if found else np.zeros((len(self.table), 2, 0))

    def weighed(self, state: _State, look: _Look) -> _System:
        """Whiten a look's rows by noise and spread of depths, weigh them, and sum the normal equations up."""
        table, scene = self.table, look.scene
        difference = table.second_px - look.prediction.second_px
        limit = [value for term in self.terms for value in term.limit]
        prior = [std**-2.0 for term in self.terms for std in term.prior_std]
        pulled = list(np.array(prior) * state.change)
        if scene is not None and self.start is not None:
            information = scene.prior_std() ** -2.0
            limit += list(scene.limits())
            prior += list(information)
            pulled += list(information * (scene.vector() - self.start.vector()))
        rows, left, spread = _whitened(look.slope, difference, look.prediction, table, state.depth_spread)
        squared = (left**2).sum(axis=-1)
        typical = NORMAL_MEDIAN if state.depth_spread == ANY_DEPTH else RAYLEIGH_MEDIAN
        scale = max(float(np.median(np.sqrt(squared))) / typical, SMALLEST_SCALE)
        weight = 1.0 / (1.0 + squared / (CAUCHY * scale) ** 2)
        if isinstance(scene, DirectedMotion):
            noise, flow = table.noise_px[table.pair], np.asarray(look.prediction.per_step)
            rows, left = without_directions(
                rows, left, weight, difference / noise[:, None], flow / noise[:, None, None], scene.direction,
                scene.group(table.pair),
            )  # fmt: skip
        flat = rows.reshape(2 * len(table), rows.shape[-1])
        weighted = flat * np.repeat(weight / scale**2, 2)[:, None]
        return _System(
            look, difference, squared, weight, scale, spread, rows, left,
            weighted.T @ flat, weighted.T @ left.ravel(), np.array(prior), np.array(pulled), np.array(limit),
        )  # fmt: skip


def _whitened(
    slope: Array, difference: Array, at: Prediction, table: TrackTable, depth_spread: float
) -> tuple[Array, Array, float]:
    """Rows and differences over their standard deviations, and the spread of depths that the differences show."""
    noise = table.noise_px[table.pair][:, None]
    rows, left = slope / noise[..., None], difference / noise
    if at.along_px is None:
        return rows, left, 0.0
    length = np.linalg.norm(at.along_px, axis=-1)
    way = at.along_px / np.maximum(length, 1e-12)[:, None]
    ratio = length / noise[:, 0]
    along = (left * way).sum(axis=-1)
    shrink = 1 - 1 / np.sqrt(1 + (depth_spread * ratio) ** 2)
    left = left - (shrink * along)[:, None] * way
    rows = rows - way[:, :, None] * (shrink[:, None] * np.einsum("ni,nik->nk", way, rows))[:, None, :]
    if depth_spread == ANY_DEPTH:
        return rows, left, depth_spread
    return rows, left, _depth_spread(along, difference, way, noise[:, 0], ratio)


def _depth_spread(along: Array, difference: Array, way: Array, noise: Array, ratio: Array) -> float:
    """Standard deviation of inverse depths: what the differences along the parallax have more than those across."""
    telling = ratio > np.quantile(ratio, 0.5)
    if telling.sum() < 50 or np.median(ratio[telling]) < 1e-3:
        return 0.0
    across = (difference[telling] * np.stack([-way[telling, 1], way[telling, 0]], axis=-1)).sum(axis=-1)
    base = (np.median(np.abs(across / noise[telling])) / NORMAL_MEDIAN) ** 2
    more = along[telling] ** 2 - base * NORMAL_MEDIAN**2
    spread = np.median(more / ratio[telling] ** 2) / NORMAL_MEDIAN**2
    return float(np.sqrt(max(spread, 0.0)))


def _moved(imu: ImuSamples, terms: tuple[Term, ...], state: _State, step: Array) -> _State:
    profile, place = state.known.profile, 0
    for term in terms:
        profile = term.change(profile, step[place : place + len(term)])
        place += len(term)
    scene = state.scene
    if scene is not None:
        scene = scene.with_vector(scene.vector() + step[place:])
    return _State(with_profile(state.known, imu, profile), scene, state.change + step[:place], state.depth_spread)


def _cost(system: _System, scale: float) -> float:
    """Cauchy loss at a common scale, with the priors."""
    width = (CAUCHY * scale) ** 2
    prior = float((system.pulled**2 / np.where(system.prior > 0, system.prior, 1.0)).sum())
    return float(0.5 * width * np.log1p(system.squared / width).sum()) / scale**2 + 0.5 * prior


def _conclude(table: TrackTable, terms: tuple[Term, ...], state: _State, system: _System, blocks: int) -> TrackFit:
    inverse = system.inverse()
    doubt = replace(_doubt(table, system, inverse, blocks), relief=_relief(table, system, inverse))
    stretches = _stretches(table, system, inverse, blocks)[: len(state.change)]
    difference = system.difference
    if isinstance(state.scene, DirectedMotion):
        difference = system.left * table.noise_px[table.pair][:, None]
    place, slices = 0, {}
    for term in terms:
        slices[term.name] = slice(place, place + len(term))
        place += len(term)
    return TrackFit(
        state.known.profile, state.scene, terms, state.change, doubt.of(np.eye(len(inverse))), doubt,
        system.scale, system.depth_spread,
        difference, system.weight, np.sqrt(system.squared), stretches,
        _cost(system, 1.0), state.known,
        system.prediction.second_s, table.noise_px[table.pair],
        None if isinstance(state.scene, DirectedMotion) else system.prediction.along_px, slices,
    )  # fmt: skip


def _doubt(table: TrackTable, system: _System, inverse: Array, blocks: int) -> CovarianceModel:
    """Scatter of the points' pull on the values, by blocks of time and by parts of the picture.

    Points of one moment share its errors, and points of one part of the picture share the relief that stands there as
    long as the camera travels on: S counts both (Cameron, Gelbach & Miller 2011, doi:10.1198/jbes.2010.07136).
    """
    count = min(blocks, table.n_pairs)
    if count < MIN_BLOCKS or not inverse.size:
        return CovarianceModel(inverse)
    block = table.pair * count // table.n_pairs
    weighted = system.left * (system.weight / system.scale**2)[:, None]
    moved = np.einsum("nki,nk->ni", system.rows, weighted) @ inverse / _true_curvature(system)
    place = _parts_of_picture(table.first_px)
    by_place = _scatter(moved, place) - _scatter(moved, block * PLACES**2 + place)
    return CovarianceModel(inverse, _scatter(moved, block), by_place, inverse @ (system.prior[:, None] * inverse))


def _scatter(moved: Array, group: Index) -> Array:
    """Σ g gᵀ (k, k) of the groups' sums of what each point moves the values by (n, k), about the groups' mean."""
    dense = np.unique(group, return_inverse=True)[1]
    sums = np.stack([np.bincount(dense, column) for column in moved.T], axis=-1)
    sums -= sums.mean(axis=0)
    return np.asarray(sums.T @ sums * len(sums) / max(len(sums) - 1, 1))


def _relief(table: TrackTable, system: _System, inverse: Array) -> Array | None:
    """What depths that are off by their spread in each part of the picture do to the values (places, k)."""
    along_px = system.prediction.along_px
    if along_px is None or not inverse.size or system.depth_spread == ANY_DEPTH:
        return None
    length = np.linalg.norm(along_px, axis=-1)
    way = along_px / np.maximum(length, 1e-12)[:, None]
    ratio = length / table.noise_px[table.pair]
    pull = system.weight / system.scale**2 * ratio / np.sqrt(1 + (system.depth_spread * ratio) ** 2)
    moved = np.einsum("ni,nik->nk", way, system.rows) @ inverse * pull[:, None]
    place = _parts_of_picture(table.first_px)
    points = np.maximum(np.bincount(place), 1)[:, None]
    together = np.stack([np.bincount(place, column) for column in moved.T], axis=-1)
    return np.asarray(system.depth_spread * np.sqrt(len(table)) * together / np.sqrt(points))


def _parts_of_picture(points_px: Array) -> Index:
    """Number of the part of the picture (n,) that each point lies in: PLACES by PLACES of them."""
    low, high = points_px.min(axis=0), points_px.max(axis=0)
    cell = ((points_px - low) / np.maximum(high - low, 1.0) * PLACES).astype(np.intp).clip(0, PLACES - 1)
    return np.asarray(cell[:, 0] * PLACES + cell[:, 1])


def _true_curvature(system: _System) -> float:
    """Curvature of the Cauchy loss over that of its weights, which the normal equations take for it."""
    ways = 2 if (system.scene is not None and isinstance(system.scene, DirectedMotion)) else 1
    bent = ways * system.weight**2 * system.squared / (CAUCHY * system.scale) ** 2
    return max(float((system.weight - bent).sum() / max(system.weight.sum(), 1e-12)), 0.3)


def _stretches(table: TrackTable, system: _System, inverse: Array, blocks: int) -> Array:
    """Effective number of blocks that inform each parameter, (k,): about one where a single moment decides."""
    count = min(blocks, table.n_pairs)
    if not inverse.size:
        return np.zeros(0)
    block = table.pair * count // max(table.n_pairs, 1)
    seen = system.rows @ inverse
    information = (seen**2).sum(axis=1) * system.weight[:, None]
    share = np.stack([np.bincount(block, column, count) for column in information.T], axis=-1)
    return np.asarray(share.sum(axis=0) ** 2 / np.maximum((share**2).sum(axis=0), 1e-300))


def _solved(matrix: Array, right: Array) -> Array:
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    return np.asarray(np.linalg.lstsq(matrix / np.outer(size, size), right / size, rcond=1e-12)[0]) / size


def _inverse(matrix: Array) -> Array:
    if not matrix.size:
        return matrix
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    return np.asarray(np.linalg.pinv(matrix / np.outer(size, size), rcond=1e-12, hermitian=True)) / np.outer(size, size)


# ── directions of travel ─────────────────────────────────────────────────────────────────────────────────────────


def one_direction() -> DirectedMotion:
    """A vehicle: one direction for the whole capture, to be found."""
    return DirectedMotion(np.zeros((1, 3)))


def many_directions(table: TrackTable) -> DirectedMotion:
    """A direction for each pair, to be found."""
    return DirectedMotion(np.zeros((table.n_pairs, 3)))


def for_table(scene: Motion | None, table: TrackTable) -> Motion | None:
    """The motion for a table whose pairs may be others."""
    if isinstance(scene, DirectedMotion) and len(scene.direction) > 1:
        return many_directions(table)
    return scene


def fit_directed(
    imu: ImuSamples, table: TrackTable, profile: CameraProfile, terms: Sequence[Term], many: TrackFit | None = None
) -> TrackFit:
    """Fit across the parallax of one direction of travel where that explains the points, else of one for each pair.

    many: the latter fit, where it is known already.
    """
    many = many or fit_tracks(imu, table, profile, terms, many_directions(table))
    one = fit_tracks(imu, table, profile, terms, one_direction())
    return one if one.scale < ONE_DIRECTION * many.scale else many


def _directed(table: TrackTable, at: Prediction, motion: DirectedMotion) -> tuple[Prediction, DirectedMotion]:
    """Directions found anew from the differences, and the prediction with what lies along them."""
    assert at.per_step is not None
    noise, group = table.noise_px[table.pair], motion.group(table.pair)
    start = motion.direction if motion.direction.any() else None
    found = find_directions(
        at.per_step / noise[:, None, None], (table.second_px - at.second_px) / noise[:, None], group,
        len(motion.direction), start,
    )  # fmt: skip
    along = np.squeeze(at.per_step @ found[group][..., None], -1)
    return replace(at, along_px=along), DirectedMotion(found)
