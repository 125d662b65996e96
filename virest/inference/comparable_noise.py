"""Tracking noise measured like a fit's residual, so that the two can be compared.

The residual of a smooth flow fitted to each pair contains tracking noise and the scene's relief.  A fit discounts
relief along the parallax; the noise here is discounted in the same way.
"""

from __future__ import annotations

import numpy as np

from virest.arrays import Array
from virest.image_formation.point_model import predict
from virest.inference.observed_tracks import ObservedTracks
from virest.inference.robust import CAUCHY, NORMAL_MEDIAN, RAYLEIGH_MEDIAN, cauchy_weight
from virest.inference.track_fit import ANY_DEPTH, TrackFit
from virest.inference.track_noise import ORDERS, POINTS_PER_TERM, REWEIGHTINGS, flow_basis, smooth_flow_residual
from virest.inference.tracking import TrackPair
from virest.motion.scene_motion import DirectedMotion


def noise_distances(observed: ObservedTracks, fitted: TrackFit) -> Array:
    """Whitened residuals (n,) of all points from smooth flows, relief along the parallax discounted as in the fit."""
    if fitted.scene is None:
        pairs = zip(observed.pairs, observed.noise_px, strict=True)
        residual = np.concatenate([smooth_flow_residual(pair) / noise for pair, noise in pairs])
        return np.asarray(np.linalg.norm(residual, axis=-1))
    table = observed.table(observed.tracks)
    along_px = predict(fitted.integrated, table, fitted.scene).along_px
    assert along_px is not None
    length = np.linalg.norm(along_px, axis=-1)
    way = along_px / np.maximum(length, 1e-12)[:, None]
    spread = ANY_DEPTH if isinstance(fitted.scene, DirectedMotion) else fitted.depth_spread_per_m
    kept = 1 / np.sqrt(1 + (spread * length / table.noise_px[table.pair]) ** 2)
    ends = np.cumsum([len(pair) for pair in observed.pairs])[:-1]
    parts = zip(observed.pairs, np.split(way, ends), np.split(kept, ends), observed.noise_px, strict=True)
    return np.concatenate([_flow_beside_relief(pair, w, k) / noise for pair, w, k, noise in parts])


def _flow_beside_relief(pair: TrackPair, way: Array, kept: Array) -> Array:
    """Residual lengths (n,) of a pair's steps from a smooth flow, components along ways (n, 2) weighted by kept (n,).

    The flow is fitted with the same weights; otherwise relief would leak across where directions vary between points.
    """
    step = pair.points_second_px - pair.points_first_px
    sides = np.stack([way * kept[:, None], np.stack([-way[:, 1], way[:, 0]], axis=-1)], axis=1)
    effective = len(pair) + float((kept**2).sum())
    order = next((k for k in ORDERS if effective >= POINTS_PER_TERM * (k + 1) * (k + 2)), 0)
    basis = flow_basis(pair.points_first_px, order)
    rows = (sides[..., None] * basis[:, None, None, :]).reshape(len(pair), 2, -1)
    wanted = (sides * step[:, None, :]).sum(axis=-1)
    freedom = max(1 - rows.shape[-1] / effective, 0.25)
    left, weight = wanted, np.ones(len(pair))
    for _ in range(REWEIGHTINGS):
        root = np.sqrt(weight)[:, None]
        matrix = (rows * root[..., None]).reshape(-1, rows.shape[-1])
        left = wanted - rows @ np.linalg.lstsq(matrix, (wanted * root).ravel(), rcond=None)[0]
        squared = (left**2).sum(axis=-1)
        scale = max(float(np.sqrt(np.median(squared))) / NORMAL_MEDIAN / freedom**0.5, 1e-3)
        weight = cauchy_weight(squared, CAUCHY * scale)
    return np.asarray(np.linalg.norm(left, axis=-1) / np.sqrt(freedom))


def robust_std(lengths: Array, fitted: TrackFit) -> float:
    """Standard deviation per coordinate of differences of these lengths (n,), by their median.

    Across a direction of travel only one of two coordinates remains.
    """
    one_way = isinstance(fitted.scene, DirectedMotion)
    return float(np.median(lengths)) / (NORMAL_MEDIAN if one_way else RAYLEIGH_MEDIAN)


def tracking_noise_px(observed: ObservedTracks, fitted: TrackFit) -> float:
    """Tracking noise, px per coordinate, comparable with :func:`residual_px`."""
    return robust_std(noise_distances(observed, fitted), fitted) * float(np.median(observed.noise_px))


def residual_px(fitted: TrackFit) -> float:
    """Residual of a fit, px per coordinate, with relief along the parallax discounted."""
    return robust_std(np.linalg.norm(fitted.across_relief_px(), axis=-1), fitted)
