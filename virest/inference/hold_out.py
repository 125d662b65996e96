"""Cross-validation of tracked points: residuals from fits that did not use their time block."""

from __future__ import annotations

import numpy as np

from virest.arrays import Array, Index
from virest.capture.imu import ImuSamples
from virest.image_formation.point_model import TrackTable
from virest.inference.fit_start import FitStart
from virest.inference.robust import CAUCHY
from virest.inference.track_fit import TrackFit, for_table, unfitted


def distances(imu: ImuSamples, fitted: TrackFit, table: TrackTable, depth_spread_per_m: float) -> Array:
    """Whitened residual lengths (n,) of all points of a table for a fit that may have used only some of them."""
    start = FitStart(imu, table, fitted.profile, for_table(fitted.scene, table), fitted.integrated)
    return unfitted(start, depth_spread_per_m)


def loss(distance: Array, scale: float) -> Array:
    """Cauchy loss of whitened residual lengths at a scale."""
    return np.asarray(np.log1p((distance / (CAUCHY * scale)) ** 2))


def group_means(values: Array, group: Index) -> Array:
    """(groups,) means of values (n,) by group number."""
    return np.asarray(np.bincount(group, values) / np.maximum(np.bincount(group), 1))
