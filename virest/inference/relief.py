"""Relief on the plane: a surface of inverse depth over one frame's picture, from points of many frames.

Scenes consist of patches with depth edges between them, so the inverse depths of points at distance h differ by
½ E(Δ²) = nugget² + sill² (1 − exp(−h / length)): the variogram of a random mosaic (Matheron 1963; Lee, Mumford &
Huang 2001).  It is measured on the points of each window.  A frame's surface is bilinear between the nodes of a coarse
grid.  The variogram sets how strongly neighbouring nodes are coupled, and away from points the surface returns to the
plane over ``length``: a Gaussian Markov field (Rue & Held 2005), whose information matrix is banded.  A window uses
surfaces only if they predict held-out points better than its planes do.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from virest.arrays import Array, Index, Mask
from virest.image_formation.point_model import SMALLEST_DEPTH
from virest.inference.depth import NEAR_S, OUTSIDE, SightedPoints
from virest.inference.robust import CAUCHY
from virest.inference.time_blocks import evenly_chosen
from virest.motion.optics import MovingLens
from virest.motion.relief_surface import Relief, angles

log = logging.getLogger(__name__)
LONG_CELLS, SHORT_CELLS = 24, 18
"""Cells along the picture's longer and shorter side."""
ENOUGH_POINTS, MOST_POINTS, NEARBY = 500, 1500, 1 / 32
"""A frame uses the points of the nearest pairs: ENOUGH_POINTS, or up to MOST_POINTS while the parallax stays below
NEARBY of the picture's longer side."""
MIN_POINTS = 60
"""With fewer points a frame keeps its plane."""
COMPARED_PAIRS, MOST_STD_RATIO = 8, 2.0
"""Number of pairs of frames whose points are compared with each other; points whose standard deviation exceeds
MOST_STD_RATIO times the typical one are ignored."""
LAGS, FINEST_LAG, WIDEST_LAG, MIN_DIFFERENCES = 9, 0.02, 0.6, 200
"""Number of edges of the distance classes, smallest and largest edge relative to the picture's longer side, and the
fewest differences in a usable class."""
LENGTHS, SHORTEST, LONGEST = 8, 0.04, 0.6
"""Correlation lengths to try: number, and range relative to the picture's longer side."""
FAR_QUANTILE, FAR_REACH = 0.02, 1.5
"""Inverse depths are clipped to these outer quantiles, widened by this factor, before they are compared."""
WITHIN_CELL = 0.38
"""Mean distance of a square's points from its centre, in sides."""
MATCHED_CELLS, MATCHED_GROWTH = 2.0, 0.18
"""Nodes MATCHED_CELLS apart differ as the variogram predicts: on a wide membrane by 0.73 times the variance of a free
edge (Spitzer 1976), taken four times looser, because depth changes in steps rather than smoothly."""
STIFFNESSES = (0.25, 1.0, 4.0)
"""Factors on that stiffness; the one that predicts held-out points best is used."""
REWEIGHTINGS = 1
"""Passes against outliers: with 5 % of them among 700 points of a mosaic, one pass lowers a surface's median error by
33 %, two by 40 %, four by 42 %."""
STD_STEP = 6
"""Standard deviations are computed at every such node."""
JUDGED_INSTANTS, MIN_JUDGED_CELLS = 4, 12
"""Frames at which a surface is judged, and fewest cells with points in them."""
LEAST_SIGMA, LEAST_GAIN = 3.0, 0.1
"""A surface must reduce the residuals of held-out points by this many standard errors and by this fraction."""


@dataclass(frozen=True, slots=True)
class Roughness:
    """Variogram of inverse depths about the plane."""

    sill_per_m: float
    """Standard deviation of the correlated part."""
    length_rad: float
    """Correlation length, an angle."""
    nugget_per_m: float
    """Standard deviation of the uncorrelated part beyond the tracking noise."""

    def lost(self, distance_rad: Array | float) -> Array:
        """Variance of the difference between positions at this distance, without the nugget."""
        return np.asarray(2 * self.sill_per_m**2 * -np.expm1(-np.asarray(distance_rad) / self.length_rad))


@dataclass(frozen=True, slots=True)
class Grid:
    """Nodes over the picture."""

    low: Array
    """(2,)."""
    cell: Array
    """(2,)."""
    columns: int
    rows: int

    @property
    def extent(self) -> float:
        """Angle along the longer side."""
        return float(max(self.cell[0] * (self.columns - 1), self.cell[1] * (self.rows - 1)))


def picture_grid(lens: MovingLens, time_s: float) -> Grid:
    """The grid over the lens's field of view at a time."""
    size = np.array([lens.lens.width, lens.lens.height], float)
    part = np.linspace(0.0, 1.0, 5)
    points_px = np.stack(np.meshgrid(part, part), axis=-1).reshape(-1, 2) * (size - 1)
    seen = angles(lens.rays(points_px, np.full(len(points_px), time_s)))
    beyond = OUTSIDE * np.ptp(seen, axis=0)
    low, high = seen.min(axis=0) - beyond, seen.max(axis=0) + beyond
    cells = np.array([LONG_CELLS, SHORT_CELLS] if size[0] >= size[1] else [SHORT_CELLS, LONG_CELLS])
    return Grid(low, (high - low) / cells, int(cells[0]) + 1, int(cells[1]) + 1)


# ── roughness ────────────────────────────────────────────────────────────────────────────────────────────────────


def measure_roughness(sights: SightedPoints, grid: Grid) -> Roughness | None:
    """Fit the variogram of a window's points to differences between points of the same frame; None: too few.

    ½ Δ² minus the two points' own variances is averaged over distance classes; sill and nugget are fitted by least
    squares for each length tried.
    """
    values, variance, place = _clipped(sights.above_per_m), sights.points.std_per_m**2, angles(sights.rays)
    precise = variance < MOST_STD_RATIO**2 * np.median(variance)
    edges = grid.extent * np.geomspace(FINEST_LAG, WIDEST_LAG, LAGS)
    total, count = np.zeros((2, LAGS - 1)), np.zeros(LAGS - 1)
    for pair in evenly_chosen(np.unique(sights.pair), COMPARED_PAIRS):
        mine = np.flatnonzero(precise & (sights.pair == pair))
        first, second = (mine[k] for k in np.triu_indices(len(mine), 1))
        lag = np.searchsorted(edges, np.linalg.norm(place[first] - place[second], axis=-1)) - 1
        inside = (lag >= 0) & (lag < LAGS - 1)
        first, second, lag = first[inside], second[inside], lag[inside]
        half = 0.5 * ((values[first] - values[second]) ** 2 - variance[first] - variance[second])
        total[0] += np.bincount(lag, half, LAGS - 1)
        count += np.bincount(lag, minlength=LAGS - 1)
    used = count > MIN_DIFFERENCES
    if used.sum() < 3:
        return None
    middle = np.sqrt(edges[1:] * edges[:-1])
    return _fitted(middle[used], total[0][used] / count[used], grid.extent)


def _clipped(values: Array) -> Array:
    """Values clipped to their outer quantiles, so that mismatches do not count as depths."""
    low, middle, high = np.quantile(values, [FAR_QUANTILE, 0.5, 1 - FAR_QUANTILE])
    return np.clip(values, middle + FAR_REACH * (low - middle), middle + FAR_REACH * (high - middle))


def _fitted(lag: Array, half: Array, extent: float) -> Roughness:
    """Least squares on relative differences, because a variogram's error grows with its value."""
    level = max(float(half.max()), 1e-18)
    weight = 1 / np.maximum(half, 0.1 * level)
    best, least = Roughness(0.0, extent, float(np.sqrt(max(half.mean(), 0.0)))), np.inf
    for length in extent * np.geomspace(SHORTEST, LONGEST, LENGTHS):
        rise = -np.expm1(-lag / length)
        sill, nugget = _both_positive(rise, half, weight)
        left = float(((half - sill * rise - nugget) ** 2 * weight**2).sum())
        if left < least:
            best, least = Roughness(float(np.sqrt(sill)), float(length), float(np.sqrt(nugget))), left
    return best


def _both_positive(rise: Array, half: Array, weight: Array) -> tuple[float, float]:
    """Sill and nugget (squared), neither below 0, of half ≈ sill · rise + nugget."""
    design = np.stack([rise, np.ones_like(rise)], axis=-1) * weight[:, None]
    sill, nugget = np.linalg.lstsq(design, half * weight, rcond=None)[0]
    if nugget < 0:
        sill, nugget = (design[:, 0] @ (half * weight)) / (design[:, 0] @ design[:, 0]), 0.0
    if sill < 0:
        sill, nugget = 0.0, max(float((half * weight**2).sum() / (weight**2).sum()), 0.0)
    return max(float(sill), 0.0), float(nugget)


# ── one frame's surface ──────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class View:
    """A camera's pose, with the plane in front of it."""

    time_s: float
    """IMU clock."""
    rotation_world_cam: Array
    """(3, 3)."""
    centre_m: Array
    """(3,) world axes, relative to its position at the window's middle."""
    plane_per_m: Array
    """(3,) camera axes."""


@dataclass(frozen=True, slots=True)
class PointsInFrame:
    """Points in the axes of one frame."""

    place: Array
    """(n, 2) angles."""
    above_per_m: Array
    """(n,) inverse depth above the frame's plane."""
    variance: Array
    """(n,) from tracking noise, and from possible occlusion of points seen from another position."""

    def chosen(self, use: Mask) -> PointsInFrame:
        """Some of the points."""
        return PointsInFrame(self.place[use], self.above_per_m[use], self.variance[use])


def points_in_frame(sights: SightedPoints, view: View, prior: ReliefPrior) -> PointsInFrame:
    """Transform the window's points into a frame's camera axes.

    A point seen from another position may be occluded in this frame.  The surface visible instead has moved relative to
    it by up to the parallax of the sill, and differs from it by the variogram at that distance.
    """
    points, grid, rough = sights.points, prior.grid, prior.rough
    near = _seen_nearby(sights, view, prior)
    local = (points.place_m[near] - view.centre_m) @ view.rotation_world_cam
    ahead = local[:, 2] > SMALLEST_DEPTH / max(float(np.linalg.norm(view.plane_per_m)), 1e-6)
    local, near = local[ahead], near[ahead]
    inverse = 1.0 / local[:, 2]
    rays = local * inverse[:, None]
    place = angles(rays)
    inside = ((place >= grid.low) & (place <= grid.low + grid.cell * [grid.columns - 1, grid.rows - 1])).all(axis=-1)
    rays, inverse, near, place = rays[inside], inverse[inside], near[inside], place[inside]
    apart = (sights.from_m[near] - view.centre_m) @ view.rotation_world_cam
    parallax = np.linalg.norm(apart[:, :2] - rays[:, :2] * apart[:, 2:], axis=-1) * rough.sill_per_m
    std = points.std_per_m[near] * (inverse / points.inverse_depth_per_m[near]) ** 2
    return PointsInFrame(place, inverse - rays @ view.plane_per_m, std**2 + rough.lost(parallax))


def _seen_nearby(sights: SightedPoints, view: View, prior: ReliefPrior) -> Index:
    """Index of the points seen from nearby, chosen by pairs of frames, nearest first.

    Takes pairs until there are ENOUGH_POINTS, and further ones whose parallax of the sill is below NEARBY.
    """
    pairs, start, count = np.unique(sights.pair, return_index=True, return_counts=True)
    parallax = np.linalg.norm(sights.from_m[start] - view.centre_m, axis=-1) * prior.rough.sill_per_m
    late = np.abs(sights.points.time_s[start] - view.time_s) > NEAR_S
    order = np.lexsort((start, np.abs(sights.points.time_s[start] - view.time_s), parallax, late))
    before = np.cumsum(count[order]) - count[order]
    taken = (before < ENOUGH_POINTS) | ((before < MOST_POINTS) & (parallax[order] < NEARBY * prior.grid.extent))
    taken &= ~late[order]
    chosen = np.zeros(len(pairs), bool)
    chosen[order[taken]] = True
    return np.flatnonzero(np.repeat(chosen, count))


@dataclass(frozen=True, slots=True)
class ReliefPrior:
    """Prior of the nodes: a membrane on the grid that couples neighbours and pulls towards the plane."""

    rough: Roughness
    grid: Grid
    edge_variance: float
    """Variance of the difference between two neighbouring nodes without other couplings."""
    within_variance: float
    """Variance of a point about its cell's bilinear surface."""

    def information(self) -> Array:
        """Band (rows + 2, nodes) of the nodes' information matrix: band[k, j] = Q[j + k, j]."""
        columns, rows = self.grid.columns, self.grid.rows
        band = np.zeros((rows + 2, columns * rows))
        down = np.ones((columns, rows))
        down[:, -1] = 0.0
        right = np.ones((columns, rows))
        right[-1] = 0.0
        degree = down + right
        degree[:, 1:] += down[:, :-1]
        degree[1:] += right[:-1]
        cell = float(self.grid.cell.mean()) / self.rough.length_rad
        band[0] = degree.ravel() + cell**2
        band[1], band[rows] = -down.ravel(), -right.ravel()
        return np.asarray(band / self.edge_variance)


def relief_prior(rough: Roughness, grid: Grid, stiffness: float = 1.0) -> ReliefPrior:
    """Couple neighbours so that nodes MATCHED_CELLS apart differ as the variogram predicts."""
    cell = float(grid.cell.mean())
    within = float(rough.lost(WITHIN_CELL * cell))
    edge = float(rough.lost(MATCHED_CELLS * cell)) / MATCHED_GROWTH / stiffness
    return ReliefPrior(rough, grid, edge, within + rough.nugget_per_m**2)


def fit_surface(seen: PointsInFrame, prior: ReliefPrior, *, deviations: bool = True) -> Relief:
    """Posterior mean and standard deviation of the nodes, with Cauchy weights about the surface."""
    grid, information = prior.grid, prior.information()
    node, part = _corners(seen.place, grid)
    variance = seen.variance + prior.within_variance
    weight = 1 / variance
    for passing in range(REWEIGHTINGS + 1):
        factor, values = _posterior(seen.above_per_m, weight, node, part, information, grid.rows)
        if passing < REWEIGHTINGS:
            left = seen.above_per_m - (values[node] * part).sum(axis=-1)
            weight = 1 / (variance + (left / CAUCHY) ** 2)
    std = _deviations(factor, grid) if deviations else np.zeros((2, 2))
    above = values.reshape(grid.columns, grid.rows).T
    return Relief(
        grid.low, grid.cell * [grid.columns - 1, grid.rows - 1], above.astype(np.float32), std.astype(np.float32)
    )


def _corners(place: Array, grid: Grid) -> tuple[Index, Array]:
    """The four nodes around each position (n, 4), numbered down the columns, and their bilinear weights (n, 4)."""
    position = np.clip((place - grid.low) / grid.cell, 0.0, np.array([grid.columns, grid.rows]) - 1.000001)
    first = position.astype(np.intp)
    x, y = (position - first).T
    start = first[:, 0] * grid.rows + first[:, 1]
    node = start[:, None] + np.array([0, 1, grid.rows, grid.rows + 1])
    return node, np.stack([(1 - x) * (1 - y), (1 - x) * y, x * (1 - y), x * y], axis=-1)


def _posterior(
    above: Array, weight: Array, node: Index, part: Array, information: Array, rows: int
) -> tuple[Array, Array]:
    """Banded Cholesky factor and mean (nodes,): each point couples the four nodes around it."""
    count = information.shape[1]
    weighted = part * weight[:, None]
    band = information.copy()
    band[0] += np.bincount(node.ravel(), (weighted * part).ravel(), count)
    for apart, pairs in ((1, ((0, 1), (2, 3))), (rows - 1, ((1, 2),)), (rows, ((0, 2), (1, 3))), (rows + 1, ((0, 3),))):
        for one, other in pairs:
            band[apart] += np.bincount(node[:, one], weighted[:, one] * part[:, other], count)
    right = np.bincount(node.ravel(), (weighted * above[:, None]).ravel(), count)
    factor = cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False)
    return factor, np.asarray(cho_solve_banded((factor, True), right, check_finite=False))


def _deviations(factor: Array, grid: Grid) -> Array:
    """Standard deviations of every STD_STEP-th node, (rows, columns)."""
    column, row = np.arange(0, grid.columns, STD_STEP), np.arange(0, grid.rows, STD_STEP)
    number = (column[:, None] * grid.rows + row).ravel()
    unit = np.zeros((factor.shape[1], len(number)))
    unit[number, np.arange(len(number))] = 1.0
    solved = cho_solve_banded((factor, True), unit, check_finite=False)
    return np.asarray(np.sqrt(solved[number, np.arange(len(number))]).reshape(len(column), len(row)).T)


# ── surface or plane ─────────────────────────────────────────────────────────────────────────────────────────────


def surface_gain(frames: list[PointsInFrame], prior: ReliefPrior) -> tuple[float, float]:
    """Relative reduction of held-out residuals by surfaces compared with planes, and its ratio to the standard error.

    Two-fold cross-validation on a chessboard of cells: a surface must predict depths one cell away.
    """
    grid = prior.grid
    gain, before = np.zeros((2, (grid.rows - 1) * (grid.columns - 1)))
    seen = np.zeros_like(gain)
    for points in frames:
        cell, colour = _cells(points.place, grid)
        for odd in (False, True):
            held = colour == odd
            if held.sum() < MIN_POINTS or (~held).sum() < MIN_POINTS:
                continue
            surface = fit_surface(points.chosen(~held), prior, deviations=False)
            node, part = _corners(points.place[held], grid)
            predicted = (surface.above_per_m.T.ravel()[node] * part).sum(axis=-1)
            above = points.above_per_m[held]
            near = 1 / (points.variance[held] + prior.within_variance)
            plane, left = np.abs(above), np.abs(above - predicted)
            gain += np.bincount(cell[held], near * (plane - left), len(gain))
            before += np.bincount(cell[held], near * plane, len(gain))
            seen += np.bincount(cell[held], minlength=len(gain))
    used = seen > 0
    if used.sum() < MIN_JUDGED_CELLS:
        return 0.0, 0.0
    error = float(gain[used].std()) * np.sqrt(used.sum())
    return float(gain.sum() / max(before.sum(), 1e-30)), float(gain.sum()) / max(error, 1e-30)


def _cells(place: Array, grid: Grid) -> tuple[Index, Mask]:
    """Number of each position's cell, and its colour on a chessboard."""
    position = np.clip((place - grid.low) / grid.cell, 0.0, np.array([grid.columns, grid.rows]) - 1.000001)
    x, y = position.astype(np.intp).T
    return y * (grid.columns - 1) + x, (x + y) % 2 == 1


@dataclass(frozen=True, slots=True)
class WindowRelief:
    """Relief on the planes of a window."""

    sights: SightedPoints
    """All tracked points of the window."""
    prior: ReliefPrior

    def surface(self, view: View) -> Relief | None:
        """The surface in front of a camera; None if it has too few points."""
        seen = points_in_frame(self.sights, view, self.prior)
        return fit_surface(seen, self.prior) if len(seen.place) >= MIN_POINTS else None


def find_relief(sights: SightedPoints, grid: Grid, view: Callable[[float], View]) -> WindowRelief | None:
    """Measure the roughness of a window's scene, and keep surfaces if they predict held-out points better than planes.

    view: the camera's pose at a time, with its frame's plane.
    """
    if len(sights) < 2 * MIN_POINTS:
        return None
    rough = measure_roughness(sights, grid)
    if rough is None or not rough.sill_per_m > 0:
        return None
    priors = [relief_prior(rough, grid, stiffness) for stiffness in STIFFNESSES]
    chosen = evenly_chosen(np.unique(sights.pair), JUDGED_INSTANTS)
    instants = [float(np.median(sights.points.time_s[sights.pair == pair])) for pair in chosen]
    frames = [points_in_frame(sights, view(instant), priors[0]) for instant in instants]
    gains = [surface_gain(frames, prior) for prior in priors]
    best = int(np.argmax([gain for gain, _ in gains]))
    gain, sigma = gains[best]
    text = "relief %s, stiffness %s: held-out residuals %.0f %% smaller, %.1f standard errors"
    log.debug(text, rough, STIFFNESSES[best], 100 * gain, sigma)
    return WindowRelief(sights, priors[best]) if gain > LEAST_GAIN and sigma > LEAST_SIGMA else None
