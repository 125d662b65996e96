"""Covariances of fitted values if residuals share errors within time blocks and within image regions.

A sandwich H⁻¹ S H⁻¹: S sums the outer products of the groups' summed scores for both kinds of groups, minus those of
their intersections (Cameron, Gelbach & Miller 2011, doi:10.1198/jbes.2010.07136).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from virest.arrays import Array, Index

RELATIVE_FLOOR = 1e-9
"""Part of the curvature's variance that stays if all errors cancel: 3e-5 of a standard deviation."""
ABSORBED_FLOOR = 1e-12
"""Relative eigenvalue below which a direction is rounding error."""
LEAST_LEFT = 0.05
"""Smallest part of a group's scatter that a fit leaves; a value with less comes from one group alone."""


def scatter(pull: Array, group: Index, *, about_mean: bool = False) -> Array:
    """Σ g gᵀ (k, k) of the groups' sums g of the residuals' scores ``pull`` (n, k), corrected for few groups.

    group: (n,) number of each residual's group.  about_mean: subtract the mean of g first, if no prior acts on the
    values and the scores sum to zero except for rounding and reused slopes.
    """
    dense = np.unique(group, return_inverse=True)[1]
    sums = np.stack([np.bincount(dense, column) for column in pull.T], axis=-1)
    if about_mean:
        sums -= sums.mean(axis=0)
    return np.asarray(sums.T @ sums * len(sums) / max(len(sums) - 1, 1))


def adjusted_sums(pull: Array, normal: Array, group: Index) -> Array:
    """Sums (groups, k) of scores ``pull`` (n, k) by group, corrected for what the fit has absorbed of each group.

    normal (groups, k, k): each group's part of the curvature, whose sum the priors may exceed.  A group that determines
    a value nearly alone leaves no residual of it.  The correction (I − H⁻½ H_g H⁻½)^−½ makes the scatter unbiased for
    independent residuals (Bell & McCaffrey 2002, "CR2").
    """
    sums = np.stack([np.bincount(group, column, len(normal)) for column in pull.T], axis=-1)
    sums -= sums.mean(axis=0)
    total = normal.sum(axis=0)
    size = np.sqrt(np.maximum(np.diag(total), 1e-300))
    values, axes = np.linalg.eigh(total / np.outer(size, size))
    known = values > ABSORBED_FLOOR * values[-1]
    down = axes[:, known] / np.sqrt(values[known]) / size[:, None]
    up = axes[:, known] * np.sqrt(values[known]) * size[:, None]
    left, ways = np.linalg.eigh(np.eye(known.sum()) - down.T @ normal @ down)
    scaled = np.einsum("gji,gj->gi", ways, sums @ down) / np.sqrt(np.maximum(left, LEAST_LEFT))
    return np.asarray(np.einsum("gij,gj->gi", ways, scaled) @ up.T)


def raised(covariance: Array, least: Array) -> Array:
    """A covariance (..., k, k) with variances raised to at least those of ``least``; correlations are kept.

    If a variance is not positive, as differences of sums may be, the result is ``least``.
    """
    have, need = _diagonal(covariance), _diagonal(least)
    grow = np.sqrt(np.maximum(need / np.maximum(have, 1e-300), 1.0))
    total = covariance * grow[..., :, None] * grow[..., None, :]
    fine = np.all((have > 0) | (need <= 0), axis=-1, keepdims=True)
    return np.asarray(np.where(fine[..., None], total, least))


@dataclass(frozen=True, slots=True)
class CovarianceModel:
    """The parts of the covariance of fitted values: sandwich H⁻¹ S H⁻¹ and prior.

    Evaluate it separately for each linear combination: in some, such as the velocity at an instant (from velocity,
    gravity and bias), errors cancel, so that the variance inflation of single values does not apply.
    """

    curvature: Array
    """(k, k) H⁻¹: as if residuals were independent."""
    by_block: Array | None = None
    """(k, k) scatter of the values' changes by time block; None: too few blocks."""
    by_region: Array | None = None
    """(k, k) scatter shared by image regions beyond that of time blocks."""
    prior: Array | None = None
    """(k, k) contribution of the priors."""
    relief: Array | None = None
    """(regions, k) change of the values if an image region lies off the plane by the spread of depths; None: no relief
    is modelled."""

    def propagate_relief(self, slope: Array) -> Array:
        """Covariance (..., m, m), from fixed relief, of what changes by slope (..., m, k) per unit of the values.

        The error cancels for a camera that moves to and fro, but not for one that keeps moving in one direction.
        """
        if self.relief is None:
            return np.zeros((*slope.shape[:-1], slope.shape[-2]))
        pulled = slope @ self.relief.T
        return np.asarray(pulled @ np.swapaxes(pulled, -1, -2))

    def propagate(self, slope: Array) -> Array:
        """Covariance (..., m, m) of quantities that change by slope (..., m, k) per unit of the values.

        Errors shared by image regions widen it; no variance is below that of the curvature.
        """
        back = np.swapaxes(slope, -1, -2)
        least = slope @ self.curvature @ back
        if self.by_block is None or self.by_region is None or self.prior is None:
            return np.asarray(least)
        sandwich = slope @ self.by_block @ back
        # a difference of two scatters may be negative: regions then share no error
        places = np.maximum(_diagonal(slope @ self.by_region @ back), 0.0)
        share = np.sqrt(1 + places / np.maximum(_diagonal(sandwich), 1e-300))
        total = sandwich * share[..., :, None] * share[..., None, :] + slope @ self.prior @ back
        return raised(total + RELATIVE_FLOOR * least, least)


def _diagonal(matrix: Array) -> Array:
    return np.diagonal(matrix, axis1=-2, axis2=-1)
