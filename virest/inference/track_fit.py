"""Fit a camera profile to tracked points: named terms of the profile, with the scene's motion beside them.

Each term changes a profile by a small step.  The camera's velocity, gravity, the accelerometer's bias and delay and the
scene's plane are fitted along where the accelerometer tells a displacement.  Differences are whitened by the noise of
their pair and, along the parallax, by the spread of depths about the plane; Cauchy weights bear moving objects.
Covariances come from the scatter between blocks of time, since points of one frame are not independent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.errors import ImuError
from virest.image_formation.point_model import IntegratedMotion, TrackTable, ground, with_profile
from virest.inference.clustered import CovarianceModel, Index, scatter
from virest.inference.coded_motion import drawn_px, step_slopes
from virest.inference.descent import MAX_ITERATIONS, descend, slices
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
from virest.motion.scene_motion import DirectedMotion, InertialMotion, Motion

__all__ = [
    "Term",
    "TrackFit",
    "fit_directed",
    "fit_tracks",
    "for_table",
    "many_directions",
    "one_direction",
    "start_scene",
]

Array = NDArray[np.float64]
GRAVITY_M_S2 = 9.81
MIN_BLOCKS = 4
REGIONS = 5
"""The picture is divided into this many parts each way: a wall or a ceiling fills some of them."""
ONE_DIRECTION = 1.15
"""One direction of travel for the whole capture stays if it leaves less than this many times what one a pair leaves."""
SPREAD_PASSES, SPREAD_TOLERANCE = 3, 0.2
"""The spread of depths is measured anew after each descent until it changes by less than this part."""


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
    by_coding: Array
    """(k + scene,) deviations of the values where coding draws points to their neighbours' motion; 0 where covariances
    were not asked for."""
    slices: dict[str, slice] = field(default_factory=dict)

    def distance_at(self, depth_spread_per_m: float) -> Array:
        """Whitened distances (n,) as if points' inverse depths spread by this deviation about the plane.

        Fits are comparable at one spread only: a wrong plane calls for a wide one, and is then no further off.
        """
        left = self.difference_px / self.noise_px[:, None]
        if self.along_px is None:
            return self.distance
        length, way = lengths_and_ways(self.along_px)
        variance = 1 + (depth_spread_per_m * length / self.noise_px) ** 2
        along = (left * way).sum(axis=-1)
        return np.asarray(np.sqrt(np.maximum((left**2).sum(axis=-1) - along**2 * (1 - 1 / variance), 0.0)))

    def across_relief_px(self) -> Array:
        """Differences (n, 2) in px, along the parallax only what the points' spread of depths does not explain."""
        if self.along_px is None:
            return self.difference_px
        length, way = lengths_and_ways(self.along_px)
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
    state = State(known, scene, np.zeros(sum(map(len, terms))), ANY_DEPTH if directed else 0.0)
    evidence = TrackEvidence(imu, table, terms, scene)
    look: Linearisation | None = None
    for _ in range(SPREAD_PASSES if inertial else 1):
        system = descend(evidence, state, max_iterations, look, covariances)
        spread, look = evidence.depth_spread(system), system.look
        if not inertial or abs(spread - state.depth_spread) <= SPREAD_TOLERANCE * spread:
            break
        state = replace(system.state, depth_spread=spread)
    by_coding = _by_coding(evidence, system) if covariances else np.zeros(len(system.prior))
    return _conclude(table, terms, system, spread, blocks, by_coding)


def _conclude(
    table: TrackTable,
    terms: tuple[Term, ...],
    system: TrackSystem,
    depth_spread: float,
    blocks: int,
    by_coding: Array,
) -> TrackFit:
    inverse, state, prediction = system.inverse(), system.state, system.look.prediction
    relief = _relief(table, system, inverse, depth_spread)
    doubt = replace(_doubt(table, system, inverse, blocks), relief=relief)
    stretches = _stretches(table, system, inverse, blocks)[: len(state.change)]
    noise_px, directed = table.noise_px[table.pair], isinstance(state.scene, DirectedMotion)
    difference = system.left * noise_px[:, None] if directed else table.second_px - prediction.second_px
    parts = zip((term.name for term in terms), slices(map(len, terms)), strict=True)
    return TrackFit(
        state.known.profile, state.scene, terms, state.change, doubt.of(np.eye(len(inverse))), doubt,
        float(system.scale), depth_spread,
        difference, system.weight, np.sqrt(system.squared), stretches,
        system.cost(1.0), state.known, prediction.second_s, noise_px,
        None if directed else prediction.along_px, by_coding, dict(parts),
    )  # fmt: skip


# ── covariance ───────────────────────────────────────────────────────────────────────────────────────────────────


def _doubt(table: TrackTable, system: TrackSystem, inverse: Array, blocks: int) -> CovarianceModel:
    """Scatter of the points' pull on the values, by blocks of time and by parts of the picture.

    Points of one moment share its errors, and points of one part of the picture share the relief that stands there as
    long as the camera travels on: S counts both (Cameron, Gelbach & Miller 2011, doi:10.1198/jbes.2010.07136).
    """
    count = min(blocks, table.n_pairs)
    if count < MIN_BLOCKS or not inverse.size:
        return CovarianceModel(inverse)
    block = even_blocks(table.pair, table.n_pairs, count)
    moved = system.score @ inverse / _true_curvature(system)
    place = _regions(table.first_px)
    by_region = scatter(moved, place, about_mean=True) - scatter(moved, block * REGIONS**2 + place, about_mean=True)
    return CovarianceModel(
        inverse, scatter(moved, block, about_mean=True), by_region, inverse @ (system.prior[:, None] * inverse)
    )


def _by_coding(evidence: TrackEvidence, system: TrackSystem) -> Array:
    """What steps that are drawn to the left and upwards do to the values (k,), together."""
    table, state, at = evidence.table, system.state, system.look.prediction
    if not system.prior.size:
        return np.zeros(0)
    drawn = drawn_px(step_slopes(state.known, table, state.scene, at), table.noise_px[table.pair])
    pulled = system.pull(evidence.whitened(state, at, np.moveaxis(drawn, 0, -1)))
    return np.asarray(np.linalg.norm(system.inverse() @ pulled, axis=-1))


def _relief(table: TrackTable, system: TrackSystem, inverse: Array, depth_spread: float) -> Array | None:
    """What depths that are off by their spread in each part of the picture do to the values (places, k)."""
    along_px = system.look.prediction.along_px
    if along_px is None or not inverse.size or depth_spread == ANY_DEPTH:
        return None
    length, way = lengths_and_ways(along_px)
    ratio = length / table.noise_px[table.pair]
    pull = system.weight / system.scale**2 * ratio / np.sqrt(1 + (depth_spread * ratio) ** 2)
    moved = np.einsum("ni,nik->nk", way, system.rows) @ inverse * pull[:, None]
    place = _regions(table.first_px)
    points = np.maximum(np.bincount(place), 1)[:, None]
    together = np.stack([np.bincount(place, column) for column in moved.T], axis=-1)
    return np.asarray(depth_spread * np.sqrt(len(table)) * together / np.sqrt(points))


def _regions(points_px: Array) -> Index:
    """Number of the part of the picture (n,) that each point lies in: REGIONS by REGIONS of them."""
    low, high = points_px.min(axis=0), points_px.max(axis=0)
    cell = ((points_px - low) / np.maximum(high - low, 1.0) * REGIONS).astype(np.intp).clip(0, REGIONS - 1)
    return np.asarray(cell[:, 0] * REGIONS + cell[:, 1])


def _true_curvature(system: TrackSystem) -> float:
    """Curvature of the Cauchy loss over that of its weights, which the normal equations take for it."""
    ways = 2 if isinstance(system.state.scene, DirectedMotion) else 1
    bent = ways * system.weight**2 * system.squared / (CAUCHY * system.scale) ** 2
    return max(float((system.weight - bent).sum() / max(system.weight.sum(), 1e-12)), 0.3)


def _stretches(table: TrackTable, system: TrackSystem, inverse: Array, blocks: int) -> Array:
    """Effective number of blocks that inform each parameter, (k,): about one where a single moment decides."""
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
