"""Uncertainty of a fitted curve: its standard deviation in grey levels over the range of light covered by the data.

Residuals do not show it.  With equal exposure steps, adding to the curve's log light a function with the period of the
steps changes no residual; between steps only the priors on curves and listed exposures constrain the curve.  The
standard deviation is therefore that of the Gaussian posterior at the fit, from the derivatives of the residuals with
respect to curve parameters and exposures:

- a grey has independent noise and an error shared with the other greys of the same picture and brightness, caused by
  rounding, compression and the kind of curve; more sites do not reduce it.  It is estimated from the mean residuals,
  with a minimum of SHARED_LEVELS;
- a listed exposure has a prior standard deviation; a table's local exponent changes by EXPONENT_CHANGE (1 σ) between
  knots.

The scale of the light axis is arbitrary, so curves are compared at the best scale.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from virest.arrays import Array, Mask
from virest.calibration.curve_families import Family

SHARED_LEVELS, EXPONENT_CHANGE, GREY_BINS = 0.25, 0.4, 16
"""They set standard deviations only: on three simulated brackets, half or twice any of them changes the curve's by a
factor of 0.7 to 1.5; its error was at most 0.2 of it."""
MIN_CELL_GREYS = 8
"""Minimum greys in a cell of picture and brightness for its mean residual to be used."""
POINTS = 64
"""Lights at which the curve's deviation is evaluated; half or twice as many change its mean by 1 %."""
STEP = 1e-4
"""Finite-difference step of curve parameters."""
PRIOR_STD = 10.0
"""Standard deviation of the weak prior on curve parameters."""


@dataclass(frozen=True, slots=True)
class CurvePosterior:
    """Posterior uncertainty of a curve and the exposures."""

    curve_std_levels: Array
    """(POINTS,) standard deviation in grey levels, at lights spaced evenly in grey over the range covered."""
    exposure_std_ev: Array
    """(pictures,) standard deviation of each exposure correction."""

    @property
    def rms_levels(self) -> float:
        """RMS of the curve's standard deviation."""
        return float(np.sqrt(np.mean(self.curve_std_levels**2)))


def curve_posterior(
    family: Family,
    parameters: Array,
    residual: Array,
    slopes: Array,
    sigma: Array,
    grey: Array,
    used: Mask,
    exposure_prior_ev: Array,
) -> CurvePosterior:
    """Gaussian posterior at a fit.

    residual (samples, pictures): grey levels.  slopes (pictures, samples, k): derivatives of the residuals by
    parameter, then by exposure correction.  sigma, grey, used (samples, pictures): noise standard deviation, grey
    level, and whether the grey is neither censored nor an outlier.  exposure_prior_ev (pictures,): prior standard
    deviations.
    """
    shape = len(parameters)
    shared, sharing = _shared_variance(grey, residual, used)
    weight = np.where(used, 1.0 / np.sqrt(sigma**2 + sharing * shared), 0.0)
    data = (slopes * weight.T[..., None]).reshape(-1, slopes.shape[-1])
    precision = data.T @ data + np.diag(np.concatenate([np.full(shape, PRIOR_STD**-2.0), exposure_prior_ev**-2.0]))
    if family.smoothness:
        rough = derivatives(family.smoothness, parameters, family.upper) / EXPONENT_CHANGE
        precision[:shape, :shape] += rough.T @ rough
    covariance = np.linalg.inv(precision)
    change = _curve_derivatives(family, parameters, grey[used])
    std = np.sqrt(np.maximum(np.einsum("mi,ij,mj->m", change, covariance[:shape, :shape], change), 0.0))
    return CurvePosterior(std, np.sqrt(np.diag(covariance)[shape:]))


def _shared_variance(grey: Array, residual: Array, used: Mask) -> tuple[float, Array]:
    """Variance of the error shared by greys of one picture and brightness, and the number of greys that share it.

    The variance is the mean square of the cells' mean residuals, minus the contribution of noise.
    """
    brightness = np.clip(grey / 256 * GREY_BINS, 0, GREY_BINS - 1).astype(np.int64)
    cell = brightness + GREY_BINS * np.arange(grey.shape[1])
    cells = GREY_BINS * grey.shape[1]
    count = np.bincount(cell[used], minlength=cells)
    enough = count >= MIN_CELL_GREYS
    mean = np.bincount(cell[used], residual[used], cells)[enough] / count[enough]
    square = np.bincount(cell[used], residual[used] ** 2, cells)[enough] / count[enough]
    excess = mean**2 - (square - mean**2) / (count[enough] - 1)
    return max(float(excess.mean()) if enough.any() else 0.0, SHARED_LEVELS**2), count[cell].astype(np.float64)


def derivatives(rows: Callable[[Array], Array], at: Array, upper: Array) -> Array:
    """Numerical Jacobian (rows, parameters), with steps that stay below the upper bounds."""
    base = rows(at)
    columns = np.empty((len(base), len(at)))
    for i, h in enumerate(inner_steps(at, upper)):
        columns[:, i] = (rows(at + h * np.eye(1, len(at), i)[0]) - base) / h
    return columns


def inner_steps(at: Array, upper: Array) -> Array:
    """Finite-difference steps (k,) that stay below upper bounds (k,)."""
    return np.where(at + STEP > upper, -STEP, STEP)


def _curve_derivatives(family: Family, parameters: Array, grey: Array) -> Array:
    """Derivatives (POINTS, parameters) of grey levels at fixed light, scaling of the light axis projected out."""
    curve = family.build(parameters)
    low, high = np.quantile(grey, [0.001, 0.999]) / 255
    light = curve.linearise(np.linspace(low, high, POINTS))

    def levels(q: Array) -> Array:
        return 255.0 * family.build(q).encode(light)

    change = derivatives(levels, parameters, family.upper)
    slope = (255.0 * curve.encode(light * (1 + STEP)) - levels(parameters)) / STEP
    return change - np.outer(slope, slope @ change) / max(float(slope @ slope), 1e-12)
