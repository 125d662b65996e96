"""Tracked points against the gyroscope, each point at its own row's mid-exposure: a robust fit of clock and bias.

Model: a point at rays x1 in one frame is seen in the next at p2 = project(R_cam(t2)ᵀ R_cam(t1) x1) + parallax, with
t = first_row_start + s(p) readout + exposure/2 on the camera's clock, brought to the IMU's.  Parallax moves the points
of a pair along the directions that one translation gives, by amounts that depend on unknown depths.  So a difference
r = tracked − predicted is split into a part across that direction (noise only) and a part along it (noise and parallax,
whose spread τ is measured and lowers its weight).  Without a translation this is the rotation-only fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.image_formation.row_clock import ROW_MIDDLE, RowClock, row_time_s
from virest.inference.tracking import TrackPair
from virest.motion.trajectory import Trajectory, rotation_from_vector

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
PARAMETERS = (
    "offset",
    "bias_x",
    "bias_y",
    "bias_z",
    "readout",
    "log_focal",
    "drift",
    "tilt_x",
    "tilt_y",
    "tilt_z",
    "flow_x",
    "flow_y",
    "flow_z",
)
"""offset (s); bias: used minus true rate, camera axes (rad/s); readout (s); log of the focal scale; drift of the offset
(s/s); tilt: rotation vector on the left of R_cam_imu (rad); flow: minus the mean velocity over the typical depth (1/s),
without which a steady parallax would be taken for bias."""
QUOTIENT_STEP = np.array([2e-4, 1e-3, 1e-3, 1e-3, 5e-4, 2e-3, 1e-4, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3])
PRIOR_STD = np.array([np.inf, 0.02, 0.02, 0.02, 0.002, 0.05, 0.005, 0.03, 0.03, 0.03, 0.3, 0.3, 0.3])
"""About zero, and about the profile's readout; an unknown readout or focal length has its own."""
LARGEST_STEP = np.array([0.01, 0.05, 0.05, 0.05, 0.01, 0.2, 0.005, 0.05, 0.05, 0.05, 0.3, 0.3, 0.3])
READOUT_RANGE_S = (0.0, 1 / 30)
"""Of an unknown readout: evenly spread, so its prior is the middle with the standard deviation of a flat one."""
UNKNOWN_FOCAL_STD = 0.35
MODELS = ("rotation", "common", "pairwise")
"""Translation: none; one direction in camera axes for the whole capture (a vehicle); one for each pair."""
CAUCHY = 2.4
"""A point this many standard deviations away has half its weight."""
QUANTILE = 0.4
NORMAL_QUANTILE, RAYLEIGH_QUANTILE = 0.5244, 1.0108
"""What 40 % of |x| and of √(x² + y²) stay below at unit variance; 40 % bears more outliers than the median."""
INDEPENDENT_DEPTHS = 5
DIRECTION_PASSES = 4
MAX_ITERATIONS = 15
CONVERGED_S = 1e-6
SMALLEST_NOISE_PX = 1e-3


@dataclass(frozen=True, slots=True)
class PointTable:
    """All tracked points of all pairs, in one table."""

    pair: NDArray[np.intp]
    """(n,) number of the pair, rising from 0."""
    first_px: Array
    """(n, 2)."""
    second_px: Array
    """(n, 2)."""
    first_s: Array
    """(n,) mid-exposure of the first row of the point's first frame, camera clock."""
    second_s: Array
    """(n,)."""
    first_fraction: Array
    """(n,) of the readout at which the point's row is read."""
    second_fraction: Array
    """(n,)."""
    middle_s: float
    """Where the offset's drift counts as zero, camera clock."""

    @property
    def n_pairs(self) -> int:
        """Number of pairs."""
        return int(self.pair[-1]) + 1 if len(self.pair) else 0


@dataclass(frozen=True, slots=True)
class PointModel:
    """What predicts the points: the table, the gyroscope's trajectory, the lens and the clock."""

    points: PointTable
    trajectory: Trajectory
    lens: Intrinsics
    clock_skew: float
    prior_mean: Array
    """(13,) PARAMETERS before the pictures were seen, and where the fit of what is held stays."""
    prior_std: Array
    """(13,)."""

    def lens_at(self, values: Array) -> Intrinsics:
        """Return the lens with the fitted focal scale."""
        return self.lens.scaled_focal(float(np.exp(values[5])))

    def predict(self, values: Array) -> tuple[Array, Array]:
        """Where rotation alone puts the points in the second frames, (n, 2), and their rays there, (n, 3)."""
        points, bias, tilt = self.points, values[1:4], rotation_from_vector(values[7:10])
        first = row_time_s(points.first_s, values[4], points.first_fraction)
        second = row_time_s(points.second_s, values[4], points.second_fraction)
        before, after = (self.trajectory.orientation(self._imu_time(time, values)) for time in (first, second))
        lens = self.lens_at(values)
        # A bias b turns R_2ᵀ R_1 by b Δt; half before and half after leaves an error of third order.
        half = rotation_from_vector(0.5 * (second - first)[:, None] * bias)
        rays = _turned(half, lens.rays(points.first_px) @ tilt)
        rays = _turned(half, _turned(np.swapaxes(after, -1, -2), _turned(before, rays))) @ tilt.T
        rays = rays + (second - first)[:, None] * values[10:13]
        rays[:, 2] = np.maximum(rays[:, 2], 0.05)
        return lens.project(rays), rays

    def difference(self, values: Array) -> Array:
        """Tracked minus predicted, (n, 2) px."""
        return self.points.second_px - self.predict(values)[0]

    def _imu_time(self, time_s: Array, values: Array) -> Array:
        return time_s * (1 + self.clock_skew) + values[0] + values[6] * (time_s - self.points.middle_s)


@dataclass(frozen=True, slots=True)
class PointFit:
    """A fit, and its normal equations over all PARAMETERS for further questions."""

    model: str
    values: Array
    """(13,) PARAMETERS."""
    active: Mask
    """(13,) which were fitted; the others were held."""
    noise_px: float
    """Robust standard deviation of the differences per coordinate; across the parallax where that is modelled."""
    along_px: float
    """The same along the parallax."""
    hessian: Array
    """(b, 13, 13) one summand for each block of consecutive pairs, in units of the noise."""
    gradient: Array
    """(b, 13)."""
    prior_mean: Array
    """(13,)."""
    prior_information: Array
    """(13,) 1 / variance."""
    overdispersion: float
    """How much more the blocks disagree than independent points would; at least 1."""

    def step(self, active: Mask, without: int | None = None) -> Array:
        """Solve for the Gauss-Newton step from here (13,), with these parameters active, perhaps without one block."""
        hessian, gradient = self.hessian.sum(axis=0), self.gradient.sum(axis=0)
        if without is not None:
            hessian, gradient = hessian - self.hessian[without], gradient - self.gradient[without]
        matrix, right = hessian / self.overdispersion, gradient / self.overdispersion
        matrix = matrix + np.diag(self.prior_information)
        right = right + self.prior_information * (self.values - self.prior_mean)
        step = np.zeros(len(PARAMETERS))
        step[active] = -np.linalg.lstsq(matrix[np.ix_(active, active)], right[active], rcond=1e-13)[0]
        return step

    def covariance(self, active: Mask) -> Array:
        """Covariance (13, 13), zero for what is held: from the curvature with the priors, raised to the jackknife's."""
        matrix = self.hessian.sum(axis=0) / self.overdispersion + np.diag(self.prior_information)
        full = np.zeros_like(matrix)
        full[np.ix_(active, active)] = np.linalg.pinv(matrix[np.ix_(active, active)], rcond=1e-13, hermitian=True)
        blocks = len(self.hessian)
        if blocks < 3:
            return full
        left_out = np.array([self.step(active, block) for block in range(blocks)])
        jackknife = (blocks - 1) / blocks * ((left_out - left_out.mean(axis=0)) ** 2).sum(axis=0)
        raised = np.sqrt(np.maximum(jackknife / np.maximum(np.diag(full), 1e-30), 1.0))
        return full * np.outer(raised, raised)


def mask(*names: str) -> Mask:
    """(13,) true for the named PARAMETERS; ``bias``, ``tilt`` and ``flow`` name all three axes."""
    return np.array([name in names or name.rsplit("_", 1)[0] in names for name in PARAMETERS])


def priors(profile: CameraProfile) -> tuple[Array, Array]:
    """Mean and standard deviation (13,) of the PARAMETERS for a profile."""
    mean, std = np.zeros(len(PARAMETERS)), PRIOR_STD.copy()
    mean[4] = profile.shutter.readout_time_s
    if not profile.readout_known:
        mean[4], std[4] = np.mean(READOUT_RANGE_S), np.ptp(READOUT_RANGE_S) / np.sqrt(12)
    if profile.intrinsics is None:
        std[5] = UNKNOWN_FOCAL_STD
    return mean, std


def point_table(
    pairs: Sequence[TrackPair], frame_time_s: Array, exposure_s: Array, profile: CameraProfile
) -> PointTable:
    """Lay out the pairs; frame_time_s, exposure_s (frames,) by movie index, logged exposure 0 where unknown."""
    clock, sizes = RowClock(profile), [len(pair) for pair in pairs]
    middle_s = clock.camera_time_s(clock.time_s(frame_time_s, exposure_s, exposure_share=ROW_MIDDLE))
    first_px = np.concatenate([pair.points_first_px for pair in pairs])
    second_px = np.concatenate([pair.points_second_px for pair in pairs])
    first_s = np.repeat(middle_s[[pair.first for pair in pairs]], sizes)
    second_s = np.repeat(middle_s[[pair.second for pair in pairs]], sizes)
    return PointTable(
        np.repeat(np.arange(len(pairs)), sizes),
        first_px,
        second_px,
        first_s,
        second_s,
        clock.readout_fraction(first_px),
        clock.readout_fraction(second_px),
        float(np.mean(0.5 * (first_s + second_s))),
    )


def fit_points(
    model: PointModel,
    start: Array,
    active: Mask,
    translation: str = "rotation",
    blocks: int = 10,
    overdispersion: float = 1.0,
) -> PointFit:
    """Gauss-Newton with Cauchy weights at the noise as measured in each iteration.

    start: (13,) PARAMETERS to begin from.  translation: one of MODELS; its directions are fitted with the rest.
    overdispersion: from an earlier fit, so that the priors weigh as they should against the data.
    """
    values, directions = start.copy(), None
    for _ in range(MAX_ITERATIONS):
        fit, directions = _linearised(model, values, active, active, translation, blocks, overdispersion, directions)
        step = fit.step(active)
        step *= min(1.0, 1.0 / max(float(np.max(np.abs(step) / LARGEST_STEP)), 1e-12))
        values = values + step
        if active[4]:
            values[4] = np.clip(values[4], *READOUT_RANGE_S)
        if abs(step[0]) < CONVERGED_S:
            break
    everything = np.ones_like(active)
    return _linearised(model, values, active, everything, translation, blocks, overdispersion, directions)[0]


def block_disagreement(fit: PointFit) -> float:
    """How much more the blocks' gradients scatter than the curvature says, mean over the active parameters; >= 1."""
    blocks = len(fit.gradient)
    if blocks < 3:
        return 1.0
    active = fit.active
    scatter = fit.gradient[:, active] - fit.gradient[:, active].mean(axis=0)
    hessian = fit.hessian.sum(axis=0)[np.ix_(active, active)]
    ratio = (
        np.trace(np.linalg.pinv(hessian, rcond=1e-10, hermitian=True) @ (scatter.T @ scatter)) * blocks / (blocks - 1)
    )
    return max(float(ratio) / active.sum(), 1.0)


# ── one linearisation ────────────────────────────────────────────────────────────────────────────────────────────


def _linearised(
    model: PointModel,
    values: Array,
    active: Mask,
    columns: Mask,
    translation: str,
    blocks: int,
    overdispersion: float,
    directions: Array | None,
) -> tuple[PointFit, Array | None]:
    points = model.points
    expected_px, rays = model.predict(values)
    difference = points.second_px - expected_px
    slope = np.zeros((len(difference), 2, len(PARAMETERS)))
    for k in np.flatnonzero(columns):
        moved = values.copy()
        moved[k] += QUOTIENT_STEP[k]
        slope[..., k] = (model.difference(moved) - difference) / QUOTIENT_STEP[k]
    if translation == "rotation":
        noise = _noise(np.linalg.norm(difference, axis=-1), RAYLEIGH_QUANTILE)
        weight = 1.0 / (1.0 + (difference**2).sum(axis=-1) / (CAUCHY * noise) ** 2)
        rows, left, weights = slope, difference, np.stack([weight, weight], axis=-1) / noise**2
        along = noise
    else:
        group = np.zeros_like(points.pair) if translation == "common" else points.pair
        flow = _translation_flow(model.lens_at(values), rays, expected_px)
        directions = _find_directions(difference, flow, group, directions)
        rows, left, weights, noise, along = _split(difference, slope, flow, directions, group, points.pair)
    block = points.pair * min(blocks, points.n_pairs) // max(points.n_pairs, 1)
    count = int(block[-1]) + 1
    weighted = rows * weights[..., None]
    hessian = np.array([np.einsum("nki,nkj->ij", weighted[block == b], rows[block == b]) for b in range(count)])
    gradient = np.array([np.einsum("nki,nk->i", weighted[block == b], left[block == b]) for b in range(count)])
    prior = model.prior_mean, model.prior_std**-2.0
    return PointFit(translation, values, active, noise, along, hessian, gradient, *prior, overdispersion), directions


def _split(
    difference: Array, slope: Array, flow: Array, directions: Array, group: NDArray[np.intp], pair: NDArray[np.intp]
) -> tuple[Array, Array, Array, float, float]:
    """Rows (n, 2, 13), differences (n, 2) and weights (n, 2): across and along the parallax, directions eliminated."""
    way = np.einsum("nij,nj->ni", flow, directions[group])
    way /= np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-12)
    normal = np.stack([-way[:, 1], way[:, 0]], axis=-1)
    frame = np.stack([normal, way], axis=1)
    left = np.einsum("nij,nj->ni", frame, difference)
    rows = np.einsum("nij,njk->nik", frame, slope)
    noise = _noise(np.abs(left[:, 0]), NORMAL_QUANTILE)
    spread = _pair_spread(left[:, 1], pair, noise)
    weight = 1.0 / (1.0 + ((left[:, 0] / noise) ** 2 + (left[:, 1] / spread) ** 2) / CAUCHY**2)
    weights = np.stack([weight / noise**2, weight / spread**2], axis=-1)
    turning = _direction_columns(left[:, 1], flow, directions, group)
    rows[:, 0], left[:, 0] = _without_directions(rows[:, 0], left[:, 0], turning, weights[:, 0], group)
    return rows, left, weights, noise, float(np.median(spread))


def _pair_spread(along: Array, pair: NDArray[np.intp], noise: float) -> Array:
    """(n,) standard deviation along the parallax that gives the point's pair its due weight.

    Depth is shared by neighbours: a pair's points tell along the parallax as much as INDEPENDENT_DEPTHS points do.
    """
    spread = np.full(len(along), noise)
    for number in range(int(pair[-1]) + 1):
        own = pair == number
        if own.any():
            parallax = max(_noise(np.abs(along[own]), NORMAL_QUANTILE) ** 2 - noise**2, 0.0)
            spread[own] = np.sqrt(noise**2 + parallax * max(own.sum() / INDEPENDENT_DEPTHS, 1.0))
    return spread


def _direction_columns(along: Array, flow: Array, directions: Array, group: NDArray[np.intp]) -> Array:
    """(n, 2) change of the part across when the group's direction turns about its two tangents."""
    tangents = np.linalg.svd(directions[:, None, :])[2][:, 1:]
    size = np.maximum(np.linalg.norm(np.einsum("nij,nj->ni", flow, directions[group]), axis=-1), 1e-12)
    way = np.einsum("nij,nj->ni", flow, directions[group]) / size[:, None]
    sideways = np.stack([-way[:, 1], way[:, 0]], axis=-1)
    turned = np.einsum("ni,nij,nkj->nk", sideways, flow, tangents[group])
    return -turned * (along / size)[:, None]


def _without_directions(
    rows: Array, left: Array, turning: Array, weight: Array, group: NDArray[np.intp]
) -> tuple[Array, Array]:
    """Rows (n, 13) and differences (n,) less what turning the group's direction explains (Schur complement)."""
    both = np.concatenate([rows, left[:, None]], axis=1)
    groups = int(group.max()) + 1
    square = _group_sum(turning[:, :, None] * (turning * weight[:, None])[:, None, :], group, groups) + np.eye(2)
    cross = _group_sum(turning[:, :, None] * (both * weight[:, None])[:, None, :], group, groups)
    both = both - np.einsum("nk,nkj->nj", turning, np.linalg.solve(square, cross)[group])
    return both[:, :-1], both[:, -1]


def _translation_flow(lens: Intrinsics, rays: Array, expected_px: Array) -> Array:
    """(n, 2, 3) pixels per unit of translation at unit depth: d project(ray + t) / dt."""
    step = 1e-5
    return np.stack([(lens.project(rays + step * axis) - expected_px) / step for axis in np.eye(3)], axis=-1)


def _find_directions(difference: Array, flow: Array, group: NDArray[np.intp], start: Array | None) -> Array:
    """Find unit translations (groups, 3) whose flow the differences follow best.

    Across the flow F t, a difference r measures t · (r × F) / |F t|: linear in t but for the length, which each pass
    takes from the one before; Cauchy weights at the noise across.  Without a start, all differences weigh alike.
    """
    across = difference[:, :1] * flow[:, 1] - difference[:, 1:] * flow[:, 0]
    groups = int(group.max()) + 1
    if start is None:
        size = np.maximum(np.linalg.norm(difference, axis=-1), np.quantile(np.abs(difference), 0.2) + 1e-9)
        start = _least_directions(
            across / np.maximum(size * np.linalg.norm(flow, axis=(1, 2)), 1e-12)[:, None], group, groups
        )
    directions = start
    for _ in range(DIRECTION_PASSES):
        length = np.maximum(np.linalg.norm(np.einsum("nij,nj->ni", flow, directions[group]), axis=-1), 1e-12)
        unit = across / length[:, None]
        distance = np.abs(np.einsum("ni,ni->n", unit, directions[group]))
        noise = _noise(distance, NORMAL_QUANTILE)
        weight = 1.0 / (1.0 + (distance / (CAUCHY * noise)) ** 2)
        directions = _least_directions(unit * np.sqrt(weight)[:, None], group, groups)
    return directions


def _least_directions(rows: Array, group: NDArray[np.intp], groups: int) -> Array:
    """Find unit vectors (groups, 3) with the least Σ (row · t)²."""
    return np.linalg.eigh(_group_sum(rows[:, :, None] * rows[:, None, :], group, groups))[1][..., 0]


def _group_sum(values: Array, group: NDArray[np.intp], groups: int) -> Array:
    flat = values.reshape(len(values), -1)
    total: Array = np.stack([np.bincount(group, flat[:, k], groups) for k in range(flat.shape[1])], axis=-1)
    return total.reshape(groups, *values.shape[1:])


def _turned(rotation: Array, rays: Array) -> Array:
    return np.einsum("nij,nj->ni", rotation, rays)


def _noise(distance: Array, quantile_of_unit: float) -> float:
    return max(float(np.quantile(distance, QUANTILE)) / quantile_of_unit, SMALLEST_NOISE_PX)
