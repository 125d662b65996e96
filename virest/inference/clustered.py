"""Covariances of fitted values where residuals share their errors: within time blocks, within parts of the picture.

A sandwich H⁻¹ S H⁻¹: S sums the outer products of the groups' summed pulls, of either kind of group, less what both
count (Cameron, Gelbach & Miller 2011, doi:10.1198/jbes.2010.07136).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]
ALMOST_NOTHING = 1e-9


def scatter(pull: Array, group: Index, *, about_mean: bool = False) -> Array:
    """Σ g gᵀ (k, k) of the groups' sums g of what each residual pulls the values by (n, k), as if groups were many.

    group: (n,) number of each residual's group.  about_mean: of g about its mean, where no prior holds the values and
    the pulls add up to nothing but for rounding and stale slopes.
    """
    dense = np.unique(group, return_inverse=True)[1]
    sums = np.stack([np.bincount(dense, column) for column in pull.T], axis=-1)
    if about_mean:
        sums -= sums.mean(axis=0)
    return np.asarray(sums.T @ sums * len(sums) / max(len(sums) - 1, 1))


def raised(covariance: Array, least: Array) -> Array:
    """A covariance (..., k, k) with variances below ``least``'s raised to those; correlations stay.

    Where it has no positive variance, which differences of sums may come to, it is ``least``.
    """
    have, need = _diagonal(covariance), _diagonal(least)
    grow = np.sqrt(np.maximum(need / np.maximum(have, 1e-300), 1.0))
    total = covariance * grow[..., :, None] * grow[..., None, :]
    fine = np.all((have > 0) | (need <= 0), axis=-1, keepdims=True)
    return np.asarray(np.where(fine[..., None], total, least))


@dataclass(frozen=True, slots=True)
class CovarianceModel:
    """What the covariance of values, or of anything linear in them, is made of: sandwich H⁻¹ S H⁻¹ and prior.

    A correction along a value must not be carried over to combinations in which values' errors cancel, such as the
    velocity at an instant (from velocity, gravity and bias): it is asked for anew there.
    """

    curvature: Array
    """(k, k) H⁻¹: as if residuals were independent."""
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
        return raised(total + ALMOST_NOTHING * least, least)  # where all cancels there is still something to raise


def _diagonal(matrix: Array) -> Array:
    return np.diagonal(matrix, axis1=-2, axis2=-1)
