"""Tracking noise, measured without a camera model: the residual of a smooth flow fitted to each pair."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from virest.arrays import Array
from virest.inference.robust import CAUCHY, RAYLEIGH_MEDIAN, cauchy_weight
from virest.inference.tracking import TrackPair

REWEIGHTINGS = 6
"""Half as many change the noise of `sample_data/text` by up to 1.3 %, twice as many by 0.2 %."""
POINTS_PER_TERM = 4
"""Points needed per term of the flow (a cubic has 10 per axis); otherwise a lower order is used."""
ENOUGH_POINTS = 36
"""With fewer points, a flow of low order cannot follow a rotating camera, so the pair takes the others' noise."""
ORDERS = (3, 2, 1)
"""Orders of the flow, highest first.  Of noise of 0.05 px before a lens with k1 = 0.03, order 3 finds 0.050 px, order 2
0.110 px, and order 4 0.048 px."""
SMALLEST_NOISE_PX = 0.01
"""Two of the steps, 0.005 px, at which the tracker ends."""


def step_noise_px(pairs: Sequence[TrackPair]) -> Array:
    """Standard deviation (pairs,) of a tracked step per coordinate, from a cubic flow over each picture.

    Rotation, readout and a plane's parallax are smooth over a picture; tracking errors are not.  Depth steps and moving
    objects raise it only slightly, because the scale is a median.
    """
    noise = np.array([_pair_noise(pair) for pair in pairs])
    enough = np.array([len(pair) >= ENOUGH_POINTS for pair in pairs], bool)
    return np.where(enough, noise, np.median(noise[enough])) if enough.any() else noise


def smooth_flow_residual(pair: TrackPair) -> Array:
    """Tracked steps (n, 2) minus their pair's smooth flow."""
    return _residual(pair)[0]


def _pair_noise(pair: TrackPair) -> float:
    residual, terms = _residual(pair)
    freedom = max(1 - terms / max(len(pair), 1), 0.25)
    return max(float(np.median(np.linalg.norm(residual, axis=-1))) / RAYLEIGH_MEDIAN / freedom**0.5, SMALLEST_NOISE_PX)


def _residual(pair: TrackPair) -> tuple[Array, int]:
    order = next((o for o in ORDERS if len(pair) >= POINTS_PER_TERM * (o + 1) * (o + 2) // 2), 0)
    basis = flow_basis(pair.points_first_px, order)
    step = pair.points_second_px - pair.points_first_px
    weight = np.ones(len(pair))
    residual = step
    for _ in range(REWEIGHTINGS):
        root = np.sqrt(weight)[:, None]
        residual = step - basis @ np.linalg.lstsq(basis * root, step * root, rcond=None)[0]
        squared = (residual**2).sum(axis=-1)
        scale = max(float(np.sqrt(np.median(squared))) / RAYLEIGH_MEDIAN, 1e-3)
        weight = cauchy_weight(squared, CAUCHY * scale)
    return residual, basis.shape[1]


def flow_basis(points_px: Array, order: int) -> Array:
    """Monomials (n, k) of positions up to an order, about their mean."""
    centred = points_px - points_px.mean(axis=0)
    x, y = (centred / max(float(np.abs(centred).max()), 1.0)).T
    return np.stack([x**i * y**j for i in range(order + 1) for j in range(order + 1 - i)], axis=-1)
