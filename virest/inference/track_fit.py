"""Fit a camera profile to tracked points: named terms of the profile together with the scene's motion.

Each term changes a profile by a small step.  With an accelerometer, the camera's velocity, gravity, the accelerometer's
bias and delay and the scene's plane are fitted too.  Residuals are whitened by the noise of their pair and, along the
parallax, by the spread of depths about the plane; Cauchy weights tolerate moving objects.  Covariances come from the
scatter between time blocks, since points of one frame are not independent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.errors import ImuError
from virest.image_formation.point_model import IntegratedMotion, TrackTable
from virest.inference.clustered import CovarianceModel, Index, adjusted_sums, scatter
from virest.inference.coded_motion import DEVIATION, USUAL, drawn_px, step_slopes
from virest.inference.descent import MAX_ITERATIONS, Slopes, descend, slices
from virest.inference.fit_start import FitStart
from virest.inference.profile_curvature import at_profile_minimum
from virest.inference.robust import CAUCHY
from virest.inference.term import Term
from virest.inference.time_blocks import even_blocks
from virest.inference.track_evidence import (
    ANY_DEPTH,
    Linearisation,
    State,
    TrackEvidence,
    TrackSystem,
    lengths_and_ways,
)
from virest.inference.travel_start import linear_start
from virest.motion.scene_motion import DirectedMotion, InertialMotion, Motion

GRAVITY_M_S2 = 9.81
"""Rounded; on Earth it lies between 9.78 and 9.83 m/s² (WGS 84)."""
MIN_BLOCKS = 4
"""Fewest time blocks for a variance.  That of n blocks has a relative deviation of √(2 / (n − 1)): 0.8 for four."""
REGIONS = 5
"""Image regions along each side; a wall or a ceiling fills some of them."""
ONE_DIRECTION = 1.15
"""Use one direction of travel for the whole capture if its residual is below this times that of one per pair."""
SPREAD_PASSES, SPREAD_TOLERANCE = 3, 0.2
"""The spread of depths is measured again after each descent until its relative change is below this."""


@dataclass(frozen=True, slots=True)
class TrackFit:
    """A fitted profile with its residuals and covariances."""

    profile: CameraProfile
    scene: Motion | None
    terms: tuple[Term, ...]
    change: Array
    """(k,) total change of the terms' values from the starting profile."""
    covariance: Array
    """(k + scene, k + scene): the terms first."""
    covariance_model: CovarianceModel
    """Parts of the covariance, for linear combinations of the values."""
    scale: float
    """Robust standard deviation of the whitened residuals; 1 if the model is complete."""
    depth_spread_per_m: float
    """Standard deviation of points' inverse depths about the plane."""
    difference_px: Array
    """(n, 2) tracked minus predicted; for a directed motion only the part across its parallax."""
    weight: Array
    """(n,) Cauchy weights, 0 to 1."""
    distance: Array
    """(n,) whitened length of each difference, in standard deviations."""
    stretches: Array
    """(k,) effective number of time blocks that inform each value: (Σ share)² / Σ share² of its information."""
    cost: float
    """Σ of the robust loss over the whitened points: comparable between fits of one table."""
    integrated: IntegratedMotion
    seconds: Array
    """(n,) times of the second points, IMU clock."""
    noise_px: Array
    """(n,) noise of each point's step, per coordinate."""
    along_px: Array | None
    """(n, 2) change of the second points per unit of inverse depth; None if no relief is modelled."""
    by_coding_pattern: Array
    """(k + scene, patterns) errors of the values from block motion prediction of the usual size (`coded_motion`); 0
    without covariances."""
    by_error: Array
    """(k + scene,) standard deviation of the values due to the points' errors passed to :func:`fit_tracks`."""
    slices: dict[str, slice] = field(default_factory=dict)

    def distance_at(self, depth_spread_per_m: float) -> Array:
        """Whitened residual lengths (n,) for this standard deviation of points' inverse depths about the plane.

        Fits are comparable only at the same spread: a wrong plane gets a wide spread, which hides its residuals.
        """
        if self.along_px is None:
            return self.distance
        return _across_relief(self.difference_px, self.noise_px, self.along_px, depth_spread_per_m)

    def across_relief_px(self, bias_px: Array | None = None) -> Array:
        """Residuals (n, 2), px, reduced along the parallax by the points' spread of depths.

        bias_px: (n, 2) of the tracked points, subtracted first.
        """
        left_px = self.difference_px if bias_px is None else self.difference_px - bias_px
        if self.along_px is None:
            return left_px
        length, way = lengths_and_ways(self.along_px)
        shrink = 1 - 1 / np.sqrt(1 + (self.depth_spread_per_m * length / self.noise_px) ** 2)
        return left_px - (shrink * (left_px * way).sum(axis=-1))[:, None] * way

    def relief_cost(self) -> Array:
        """Log-likelihood penalty (n,) of the points' spread of depths: the logarithm of their standard deviation."""
        if self.along_px is None:
            return np.zeros(len(self.distance))
        ratio = np.linalg.norm(self.along_px, axis=-1) / self.noise_px
        return np.asarray(0.5 * np.log1p((self.depth_spread_per_m * ratio) ** 2))

    @property
    def by_coding(self) -> Array:
        """Standard deviations (k + scene,) of values from points as tracked, because of block motion prediction."""
        return np.asarray(np.linalg.norm(self.by_coding_pattern, axis=-1))

    @property
    def by_coding_left(self) -> Array:
        """The same for points without the mean error."""
        return np.asarray(np.linalg.norm(self.by_coding_pattern * (DEVIATION / USUAL), axis=-1))

    @property
    def curvature(self) -> Array:
        """The covariance from the curvature alone, as if points were independent."""
        return self.covariance_model.curvature

    @property
    def by_relief(self) -> Array:
        """Errors of the values (k + scene,) if image regions lie off the plane by the spread of depths."""
        each = np.eye(len(self.covariance))[:, None, :]
        return np.asarray(np.sqrt(self.covariance_model.propagate_relief(each)[:, 0, 0]))

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
    """Start at rest in front of a plane across the optical axis, with gravity from the mean specific force."""
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
    errors_px: Array | None = None,
) -> TrackFit:
    """Gauss-Newton from a profile; scene None: rotation only. Raises ImuError for too few inertial samples.

    covariances: False skips re-evaluating the final slopes: values and residuals are the same, covariances are coarse.
    errors_px (m, n, 2): errors common to all points, independent of each other, of one standard deviation each.
    """
    start = FitStart(imu, table, profile, scene, known)
    return fit_from(start, terms, blocks, max_iterations, covariances, errors_px)


def fit_from(
    start: FitStart,
    terms: Sequence[Term],
    blocks: int = 12,
    max_iterations: int = MAX_ITERATIONS,
    covariances: bool = True,
    errors_px: Array | None = None,
    settled: Slopes = Slopes.AT_THE_END,
) -> TrackFit:
    """:func:`fit_tracks` from a start that several fits may share.

    settled: Slopes.ON_THE_WAY accepts the slopes of the last steps: quicker, with a slightly higher loss.
    """
    terms, table, scene, known = tuple(terms), start.table, start.scene, start.known
    inertial, directed = isinstance(scene, InertialMotion), isinstance(scene, DirectedMotion)
    if inertial and known.displacement is None:
        raise ImuError("no accelerometer to determine the camera's path", hint="fit a free motion")
    state = State(known, scene, np.zeros(sum(map(len, terms))), ANY_DEPTH if directed else 0.0)
    evidence = TrackEvidence(start.imu, table, terms, scene, start)
    look: Linearisation | None = None
    if isinstance(scene, InertialMotion) and max_iterations and not scene.velocity_m_s.any():
        state, look = _started(evidence, start, state, scene)
    for _ in range(SPREAD_PASSES if inertial else 1):
        system = descend(evidence, state, max_iterations, look, covariances, settled)
        spread, look = evidence.depth_spread(system), system.look
        if not inertial or abs(spread - state.depth_spread) <= SPREAD_TOLERANCE * spread:
            break
        state = replace(system.state, depth_spread=spread)
    inverse, bend = system.inverse(), 1.0
    if covariances and directed and inverse.size:
        system, inverse = at_profile_minimum(evidence, system)
    else:
        bend = _true_curvature(system)
    coded = np.zeros((len(USUAL), 0, 2))
    if covariances and inverse.size:
        at = system.look.prediction
        slopes = step_slopes(system.state.known, table, system.state.scene, at)
        coded = drawn_px(slopes, table.noise_px[table.pair], table.bits_per_px)
    moved = [_moved_by(evidence, system, inverse, errors) for errors in (coded, errors_px)]
    return _conclude(table, terms, system, inverse, bend, spread, blocks, (moved[0], np.linalg.norm(moved[1], axis=-1)))


def unfitted(start: FitStart, depth_spread_per_m: float) -> Array:
    """:meth:`TrackFit.distance_at` where nothing is fitted but the directions of travel: without covariances."""
    evidence = TrackEvidence(start.imu, start.table, (), start.scene, start)
    directed = isinstance(start.scene, DirectedMotion)
    state = State(start.known, start.scene, np.zeros(0), ANY_DEPTH if directed else 0.0)
    look = evidence.look(state, None, Slopes.HERE)
    if directed or look.prediction.along_px is None:
        return np.asarray(np.sqrt(evidence.weighed(state, look).squared))
    difference_px = start.table.second_px - look.prediction.second_px
    noise_px = start.table.noise_px[start.table.pair]
    return _across_relief(difference_px, noise_px, look.prediction.along_px, depth_spread_per_m)


def _across_relief(difference_px: Array, noise_px: Array, along_px: Array, depth_spread_per_m: float) -> Array:
    """Whitened lengths (n,) of differences (n, 2), reduced along the parallax by the points' spread of depths."""
    left = difference_px / noise_px[:, None]
    length, way = lengths_and_ways(along_px)
    variance = 1 + (depth_spread_per_m * length / noise_px) ** 2
    along = (left * way).sum(axis=-1)
    return np.asarray(np.sqrt(np.maximum((left**2).sum(axis=-1) - along**2 * (1 - 1 / variance), 0.0)))


def _started(
    evidence: TrackEvidence, start: FitStart, rest: State, scene: InertialMotion
) -> tuple[State, Linearisation]:
    """The linear start of a scene at rest, or rest where that fits better; and its linearisation."""
    look = evidence.look(rest, None, Slopes.HERE)
    way = start.moving(lambda: linear_start(rest.known, evidence.table, look.prediction, scene))
    moving = replace(rest, scene=way)
    ahead = evidence.look(moving, look, Slopes.HERE)
    at_rest, travelling = evidence.weighed(rest, look), evidence.weighed(moving, ahead)
    better = travelling.cost(at_rest.scale) < at_rest.cost(at_rest.scale)
    return (moving, ahead) if better else (rest, look)


def _conclude(
    table: TrackTable,
    terms: tuple[Term, ...],
    system: TrackSystem,
    inverse: Array,
    bend: float,
    depth_spread: float,
    blocks: int,
    moved_by: tuple[Array, Array],
) -> TrackFit:
    state, prediction = system.state, system.look.prediction
    relief = _relief(table, system, inverse, depth_spread)
    model = replace(_covariance_model(table, system, inverse, bend, blocks), relief=relief)
    stretches = _stretches(table, system, inverse, blocks)[: len(state.change)]
    noise_px, directed = table.noise_px[table.pair], isinstance(state.scene, DirectedMotion)
    difference = system.left * noise_px[:, None] if directed else table.second_px - prediction.second_px
    parts = zip((term.name for term in terms), slices(map(len, terms)), strict=True)
    return TrackFit(
        state.known.profile, state.scene, terms, state.change, model.propagate(np.eye(len(inverse))), model,
        float(system.scale), depth_spread,
        difference, system.weight, np.sqrt(system.squared), stretches,
        system.cost(1.0), state.known, prediction.second_s, noise_px,
        None if directed else prediction.along_px, *moved_by, dict(parts),
    )  # fmt: skip


# ── covariance ───────────────────────────────────────────────────────────────────────────────────────────────────


def _covariance_model(
    table: TrackTable, system: TrackSystem, inverse: Array, bend: float, blocks: int
) -> CovarianceModel:
    """Scatter of the points' scores by time blocks and by image regions.

    Points of one time block share errors, and points of one image region share relief while the camera keeps moving in
    one direction: S includes both (Cameron, Gelbach & Miller 2011, doi:10.1198/jbes.2010.07136).
    """
    count = min(blocks, table.n_pairs)
    if count < MIN_BLOCKS or not inverse.size:
        return CovarianceModel(inverse)
    block = even_blocks(table.pair, table.n_pairs, count)
    moved = system.score @ inverse / bend
    region = _regions(table.first_px)
    by_region = scatter(moved, region, about_mean=True) - scatter(moved, block * REGIONS**2 + region, about_mean=True)
    sums = adjusted_sums(system.score, _normal_by_block(system, block, count), block) @ inverse / bend
    return CovarianceModel(inverse, sums.T @ sums, by_region, inverse @ (system.prior[:, None] * inverse))


def _normal_by_block(system: TrackSystem, block: Index, blocks: int) -> Array:
    """Each block's part (blocks, k, k) of the curvature."""
    rows = system.rows * np.sqrt(system.weight / np.square(system.scale))[:, None, None]
    parts = (rows[block == number].reshape(-1, rows.shape[-1]) for number in range(blocks))
    return np.stack([part.T @ part for part in parts])


def _moved_by(evidence: TrackEvidence, system: TrackSystem, inverse: Array, errors_px: Array | None) -> Array:
    """Changes (k, m) of the values by errors (m, n, 2) of the points; 0 for errors of no points."""
    if errors_px is None or not errors_px.shape[1]:
        return np.zeros((len(system.prior), 0 if errors_px is None else len(errors_px)))
    errors = evidence.whitening(system.state, system.look.prediction) @ np.moveaxis(errors_px, 0, -1)
    return np.asarray(inverse @ system.pull(errors))


def _relief(table: TrackTable, system: TrackSystem, inverse: Array, depth_spread: float) -> Array | None:
    """Errors of the values (regions, k) from depths that are off by their spread in each image region."""
    along_px = system.look.prediction.along_px
    if along_px is None or not inverse.size or depth_spread == ANY_DEPTH:
        return None
    length, way = lengths_and_ways(along_px)
    ratio = length / table.noise_px[table.pair]
    pull = system.weight / system.scale**2 * ratio / np.sqrt(1 + (depth_spread * ratio) ** 2)
    moved = np.einsum("ni,nik->nk", way, system.rows) @ inverse * pull[:, None]
    region = _regions(table.first_px)
    points = np.maximum(np.bincount(region), 1)[:, None]
    together = np.stack([np.bincount(region, column) for column in moved.T], axis=-1)
    return np.asarray(depth_spread * np.sqrt(len(table)) * together / np.sqrt(points))


def _regions(points_px: Array) -> Index:
    """Number of each point's image region (n,), of REGIONS by REGIONS."""
    low, high = points_px.min(axis=0), points_px.max(axis=0)
    cell = ((points_px - low) / np.maximum(high - low, 1.0) * REGIONS).astype(np.intp).clip(0, REGIONS - 1)
    return np.asarray(cell[:, 0] * REGIONS + cell[:, 1])


def _true_curvature(system: TrackSystem) -> float:
    """Curvature of the Cauchy loss over that of its weights, which the normal equations use instead."""
    bent = system.weight**2 * system.squared / (CAUCHY * system.scale) ** 2
    return max(float((system.weight - bent).sum() / max(system.weight.sum(), 1e-12)), 0.3)


def _stretches(table: TrackTable, system: TrackSystem, inverse: Array, blocks: int) -> Array:
    """Effective number of blocks that inform each parameter, (k,): about 1 if a single block dominates."""
    count = min(blocks, table.n_pairs)
    if not inverse.size:
        return np.zeros(0)
    block = even_blocks(table.pair, table.n_pairs, count)
    seen = system.rows @ inverse
    information = (seen**2).sum(axis=1) * system.weight[:, None]
    share = np.stack([np.bincount(block, column, count) for column in information.T], axis=-1)
    return np.asarray(share.sum(axis=0) ** 2 / np.maximum((share**2).sum(axis=0), 1e-300))


# ── directions of travel ─────────────────────────────────────────────────────────────────────────────────────────


def one_direction() -> DirectedMotion:
    """One unknown direction for the whole capture, as for a vehicle."""
    return DirectedMotion(np.zeros((1, 3)))


def many_directions(table: TrackTable) -> DirectedMotion:
    """An unknown direction for each pair."""
    return DirectedMotion(np.zeros((table.n_pairs, 3)))


def for_table(scene: Motion | None, table: TrackTable) -> Motion | None:
    """The motion for a table with possibly different pairs."""
    if isinstance(scene, DirectedMotion) and len(scene.direction) > 1:
        return many_directions(table)
    return scene


def fit_directed(
    imu: ImuSamples, table: TrackTable, profile: CameraProfile, terms: Sequence[Term], many: TrackFit | None = None
) -> TrackFit:
    """Fit across the parallax of one direction of travel if that explains the points, else of one for each pair.

    many: the latter fit, if already known.
    """
    many = many or fit_tracks(imu, table, profile, terms, many_directions(table))
    one = fit_tracks(imu, table, profile, terms, one_direction())
    return one if one.scale < ONE_DIRECTION * many.scale else many
