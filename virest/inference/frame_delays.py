"""Delays of single frames: timestamps that jitter, from the rotations between successive frames.

Between frames i and j the points turn by e more than the gyroscope says, a rotation vector (3,):

    e = a_j d_j − a_i d_i + s + n,

d the delays of the two frames, a the camera's rate at each, s what other errors of the model add, which changes slowly
from frame to frame (a parallax, a bias), and n noise.  An offset and a drift of the clock are open.  The delays beyond
them are independent and normal, s is a random walk, and n has the shape that the points' own noise gives it; the three
sizes are those of the greatest likelihood (Kalman's state space, solved as one banded system).

Without delays, twice the gain in log likelihood by them is 0 or more with probability 1/2, and then a chi-square of 1
degree of freedom (Self & Liang 1987, doi:10.1080/01621459.1987.10478472).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.optimize import minimize

from virest.arrays import Array, Index, Mask
from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.image_formation.point_model import TrackTable, integrate_motion, predict
from virest.inference.chance import chi2_tail
from virest.inference.robust import CAUCHY, cauchy_weight

REWEIGHTINGS = 4
"""Passes against points that move by themselves."""
SLOPE_STEP_S = 1e-4
"""Step of the difference quotients over a delay."""
TURN_STEP_RAD = 1e-5
"""Step of the difference quotients over a rotation."""
WIDE = 1e3
"""Prior standard deviation of what is open: slow errors at the start, in units of the noise, and the clock's, ms."""
LEAST_INFORMATION = 1e-9
"""Least information about a rotation, of that about all: points in a small part of the picture do not show one."""
MOST_GAP = 2
"""Most frames from one of a pair to the other."""
MIN_PAIRS = 8
"""Fewest pairs: three sizes are estimated from them."""
UNIT_S = 1e-3
"""Unit of the delays within the fit."""
START = np.array([0.0, -1.0, 0.0])
"""Logarithms of the sizes to start from: noise as the points', a third of it per step, delays of UNIT_S."""
LEAST, LEAST_NOISE, MOST = -7.0, float(np.log(0.5)), 7.0
"""Logarithms of sizes that are taken for 0 (a thousandth of the noise, a microsecond), of the least noise, and of the
largest size.  The points' noise is measured pair by pair without a model; where slow errors are large, these would
replace it.  Double precision solves systems of all sizes between: with e⁻¹² for 0, one lost its definiteness."""
LOWER, COLUMNS = 4 * MOST_GAP + 3, 256
"""Diagonals below the main one; columns of the inverse that are computed at a time."""


@dataclass(frozen=True, slots=True)
class Turns:
    """Rotations of pairs of frames that the gyroscope does not explain, and what delays of the frames would add."""

    first: Index
    """(pairs,) movie index of the first frame."""
    second: Index
    left_rad: Array
    """(pairs, 3) rotation vectors, camera axes of the second frame."""
    per_first_s: Array
    """(pairs, 3) change of the predicted rotation per second of delay of the first frame."""
    per_second_s: Array
    information: Array
    """(pairs, 3, 3) of the rotations, from the points' noise."""

    @property
    def rate_rad_s(self) -> float:
        """Rms of the camera's rate, by how far a delay turns the second frames."""
        return float(np.sqrt(np.mean((self.per_second_s**2).sum(axis=1))))


@dataclass(frozen=True, slots=True)
class FrameDelays:
    """Delays of single frames."""

    frame: Index
    """(frames,) movie index."""
    late_s: Array
    """(frames,) delay of each, s, the clock's offset and drift included; positive: it was taken later than stamped."""
    std_s: Array
    """(frames,) standard deviation of each."""
    jitter_s: float
    """Standard deviation of the delays beyond those of the clock."""
    p: float
    """Probability of such a gain in likelihood without any delays."""
    cost: float
    """Negative logarithm of the likelihood, up to a constant that pairs and points determine."""


def unexplained_turns(imu: ImuSamples, table: TrackTable, profile: CameraProfile) -> Turns:
    """The rotation that is left of each pair's points, by weighted least squares; rows have their own times."""
    assert profile.intrinsics is not None
    known = integrate_motion(imu, profile, translation=False)
    seen = predict(known, table, None)
    left = table.second_px - seen.second_px
    slopes = []
    for before_s, after_s in ((SLOPE_STEP_S, 0.0), (0.0, SLOPE_STEP_S)):
        later = _delayed(table, before_s, after_s)
        slopes.append((predict(known, later, None).second_px - seen.second_px) / SLOPE_STEP_S)
    lens = profile.intrinsics
    rays = lens.rays(table.second_px)
    turned = [lens.project(rays + np.cross(TURN_STEP_RAD * axis, rays)) for axis in np.eye(3)]
    per_turn = np.stack([(one - table.second_px) / TURN_STEP_RAD for one in turned], axis=-1)
    noise_px = table.noise_px[table.pair]
    weight = np.ones(len(table))
    for _ in range(REWEIGHTINGS):
        turns, information = _turns_of(table, per_turn, left, weight / noise_px**2)
        rest = left - np.einsum("nij,nj->ni", per_turn, turns[table.pair])
        weight = cauchy_weight((rest**2).sum(axis=-1), CAUCHY * noise_px)
    first, second = (_turns_of(table, per_turn, slope, weight / noise_px**2)[0] for slope in slopes)
    at = np.searchsorted(table.pair, np.arange(table.n_pairs))
    return Turns(table.first[at], table.second[at], turns, first, second, information)


def fit_frame_delays(turns: Turns) -> FrameDelays | None:
    """The delays of the frames of these pairs; None for too few pairs."""
    usable = turns.second - turns.first <= MOST_GAP
    if np.count_nonzero(usable) < MIN_PAIRS:
        return None
    system = _System.of(turns, usable)
    sizes, cost = system.best(START[:2])
    with_delays, cost_with = system.best(np.array([*sizes, START[2]]))
    late_s, std_s = system.delays(with_delays)
    p = 0.5 * chi2_tail(2 * max(cost - cost_with, 0.0), 1)
    return FrameDelays(system.frame, late_s, std_s, float(np.exp(with_delays[2])) * UNIT_S, p, cost_with)


@dataclass(frozen=True, slots=True)
class _System:
    """Normal equations of delays and slow errors, four unknowns per frame, as bands: lower form, (LOWER + 1, 4 n).

    Their sum, weighted by the sizes, is the information of all unknowns.  Slow errors are in units of the noise.
    """

    frame: Index
    """(n,) movie index of each frame."""
    turns: Array
    """Information that the turns give at unit noise."""
    pull: Array
    """(4 n,) right-hand side of the normal equations at unit noise."""
    delays_alone: Array
    """Prior information of delays of unit size."""
    walk: Array
    """Prior information of slow errors whose steps have unit size."""
    opened: Array
    """Prior information of the slow errors at the start of each run of frames."""
    common: Array
    """(4 n, 2) products of all unknowns with a delay of all frames, constant and growing, which are open."""
    of_common: Array
    """(2, 3) the products of these with each other, and with the turns."""
    squares: float
    """Sum of the squared turns, in units of their noise."""
    counts: tuple[int, int]
    """Number of turns' components and of steps' components."""

    @classmethod
    def of(cls, turns: Turns, usable: Mask) -> _System:
        """The system of the usable pairs."""
        ends = np.stack([turns.first[usable], turns.second[usable]])
        frame, place = np.unique(ends, return_inverse=True)
        first, second = place.reshape(2, -1)
        half = np.linalg.cholesky(turns.information[usable]).swapaxes(1, 2)
        left = np.einsum("pij,pj->pi", half, turns.left_rad[usable])
        unit_rad = 1 / np.sqrt(np.mean(turns.information[usable].trace(axis1=1, axis2=2)) / 3)
        per_first, per_second = (
            UNIT_S * np.einsum("pij,pj->pi", half, slope[usable]) for slope in (turns.per_first_s, turns.per_second_s)
        )
        size = 4 * len(frame)
        columns = np.concatenate([[4 * first], [4 * second], [4 * second + k for k in (1, 2, 3)]]).T
        slopes = np.concatenate([per_first[..., None], per_second[..., None], unit_rad * half], axis=-1)
        bands, pull = np.zeros((LOWER + 1, size)), np.zeros(size)
        _add(bands, columns, np.einsum("pia,pib->pab", slopes, slopes))
        np.add.at(pull, columns, np.einsum("pia,pi->pa", slopes, left))
        clocks = per_first[..., None] * _clock(first, len(frame)) + per_second[..., None] * _clock(second, len(frame))
        common = np.zeros((size, 2))
        np.add.at(common, columns, np.einsum("pia,pic->pac", slopes, clocks))
        of_common = np.einsum("pic,pid->cd", clocks, np.concatenate([clocks, left[..., None]], axis=-1))
        alone, walk, opened = (np.zeros((LOWER + 1, size)) for _ in range(3))
        alone[0, ::4] = 1.0
        gap = np.diff(frame)
        joined = np.flatnonzero(gap <= MOST_GAP)
        step = np.array([[1.0, -1.0], [-1.0, 1.0]])
        for k in (1, 2, 3):
            _add(walk, np.stack([4 * joined + k, 4 * joined + 4 + k], axis=1), step / gap[joined, None, None])
        starts = np.concatenate([[0], np.flatnonzero(gap > MOST_GAP) + 1])
        for k in (1, 2, 3):
            opened[0, 4 * starts + k] = WIDE**-2
        squares, counts = float((left**2).sum()), (left.size, 3 * len(joined))
        return cls(frame, bands, pull, alone, walk, opened, common, of_common, squares, counts)

    def best(self, start: Array) -> tuple[Array, float]:
        """The logarithms of noise, steps and, if started, delays of the greatest likelihood, and its negative log."""
        simplex = start + np.eye(len(start) + 1, len(start))
        options = {"initial_simplex": simplex, "xatol": 0.02, "fatol": 0.01}
        found = minimize(self._cost, start, method="Nelder-Mead", options=options)
        return _bounded(found.x)[: len(start)], float(found.fun)

    def _information(self, sizes: Array) -> Array:
        noise, step, delay = np.exp(2 * sizes)
        return np.asarray(self.turns / noise + self.delays_alone / delay + self.walk / step + self.opened)

    def _solved(self, sizes: Array) -> tuple[tuple[Array, bool], Array, Array, Array]:
        """The factored information, all unknowns per clock error (4 n, 2), the clock errors' information and value."""
        factor, noise = (cholesky_banded(self._information(sizes), lower=True), True), np.exp(2 * sizes[0])
        both = np.column_stack([self.common, self.pull]) / noise
        solved = cho_solve_banded(factor, both)
        left = self.of_common / noise - both[:, :2].T @ solved
        left[:, :2] += WIDE**-2 * np.eye(2)  # a camera at rest says nothing about its clock
        return factor, solved, left[:, :2], np.linalg.solve(left[:, :2], left[:, 2])

    def _cost(self, sizes: Array) -> float:
        """Negative logarithm of the likelihood, up to a constant."""
        noise, step, delay = sizes = _bounded(sizes)
        (factor, _), solved, information, clock = self._solved(sizes)
        explained = float(self.pull @ solved[:, 2]) / np.exp(2 * noise) + float(clock @ information @ clock)
        spread = 2 * (self.counts[0] * noise + self.counts[1] * step + len(self.frame) * delay)
        spread += 2 * float(np.log(factor[0]).sum()) + float(np.linalg.slogdet(information)[1])
        return 0.5 * (self.squares / np.exp(2 * noise) - explained + spread)

    def delays(self, sizes: Array) -> tuple[Array, Array]:
        """Delays (n,) of the frames, those of the clock included, and their standard deviations, s."""
        factor, solved, information, clock = self._solved(sizes)
        per_clock = _clock(np.arange(len(self.frame)), len(self.frame))[:, 0] - solved[::4, :2]
        late = solved[::4, 2] + per_clock @ clock
        variance = np.einsum("na,ab,nb->n", per_clock, np.linalg.inv(information), per_clock)
        for part in np.array_split(np.arange(len(variance)), -(-len(variance) // COLUMNS)):
            unit = np.zeros((len(self.pull), len(part)))
            unit[4 * part, np.arange(len(part))] = 1.0
            variance[part] += cho_solve_banded(factor, unit)[4 * part, np.arange(len(part))]
        return np.asarray(UNIT_S * late, float), np.asarray(UNIT_S * np.sqrt(variance), float)


def _bounded(sizes: Array) -> Array:
    """The logarithms (3,) of the sizes within their bounds; missing delays have none."""
    return np.clip([*sizes, LEAST][:3], (LEAST_NOISE, LEAST, LEAST), MOST)


def _clock(place: Index, count: int) -> Array:
    """Delays (n, 1, 2) of frames by an offset and by a drift of the clock, of UNIT_S at most."""
    return np.stack([np.ones(len(place)), 2 * place / max(count - 1, 1) - 1], axis=-1)[:, None]


def _add(bands: Array, columns: Index, blocks: Array) -> None:
    """Add symmetric blocks (n, k, k) of rows and columns (n, k) to a matrix in lower banded form."""
    row, column = np.broadcast_arrays(columns[:, :, None], columns[:, None, :])
    below = row >= column
    np.add.at(bands, ((row - column)[below], column[below]), blocks[below])


def _turns_of(table: TrackTable, per_turn: Array, moved: Array, weight: Array) -> tuple[Array, Array]:
    """Rotation (pairs, 3) of each pair's points that comes closest to displacements (n, 2), and its information."""
    information, pull = np.zeros((table.n_pairs, 3, 3)), np.zeros((table.n_pairs, 3))
    np.add.at(information, table.pair, np.einsum("nij,nik,n->njk", per_turn, per_turn, weight))
    np.add.at(pull, table.pair, np.einsum("nij,ni,n->nj", per_turn, moved, weight))
    size = information.trace(axis1=1, axis2=2)[:, None, None]
    information += LEAST_INFORMATION * np.maximum(size, np.finfo(float).tiny) * np.eye(3)
    return np.asarray(np.linalg.solve(information, pull[..., None])[..., 0], float), information


def _delayed(table: TrackTable, first_s: float, second_s: float) -> TrackTable:
    """The table with the first and the second frames' timestamps later by some seconds."""
    return replace(table, first_stamp_s=table.first_stamp_s + first_s, second_stamp_s=table.second_stamp_s + second_s)
