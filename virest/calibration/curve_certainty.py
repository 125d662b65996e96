"""How far a fitted curve can be trusted: its standard deviation in grey levels over the light that the data cover.

The fit's residuals say nothing of it.  A curve whose logarithm of light differs by a function with the period of the
exposures' steps follows equal steps as well, however small its residuals: between two steps only what is believed of
curves and of listed exposures holds it.  So the deviation is that of the Gaussian posterior at the fit, from the
residuals' derivatives by the curve's parameters and by the exposures:

- a grey deviates by noise, and in common with the others of its picture and brightness: what rounding, compression and
  the kind of curve get wrong there is no better known from more places.  How much that is, the means of the residuals
  say, SHARED_LEVELS at least;
- a listed exposure is believed to within its deviation, a table's local exponent to change by EXPONENT_CHANGE from
  knot to knot.

A scale of the light axis is no error: the curve's difference is taken at the best scale.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from virest.calibration.curve_families import Family

Array = NDArray[np.float64]
SHARED_LEVELS = 0.25
EXPONENT_CHANGE = 0.4
GREY_BINS = 16
FEW = 8
POINTS = 64
STEP = 1e-4
PRIOR_SPREAD = 10.0
"""Standard deviation of a parameter of which nothing else is known."""


@dataclass(frozen=True, slots=True)
class CurvePosterior:
    """What the data leave open about a curve and the exposures."""

    curve_std_levels: Array
    """(POINTS,) grey levels, at lights whose greys lie evenly over the range covered."""
    exposure_std_ev: Array
    """(pictures,) of each correction, the trend over all pictures left out."""

    @property
    def rms_levels(self) -> float:
        """One figure for the curve."""
        return float(np.sqrt(np.mean(self.curve_std_levels**2)))


def curve_posterior(
    family: Family,
    parameters: Array,
    left: Array,
    slopes: Array,
    sigma: Array,
    grey: Array,
    used: NDArray[np.bool_],
    belief_ev: Array,
) -> CurvePosterior:
    """The posterior at a fit.

    left (samples, pictures): the fit's residuals, grey levels; slopes (pictures, samples, k): their change per
    parameter and per correction.  sigma, grey, used (samples, pictures): each grey's deviation by noise, its level, and
    whether it is neither censored nor an outlier; belief_ev: (pictures,).
    """
    shape = len(parameters)
    shared, sharing = _shared_variance(grey, left, used)
    weight = np.where(used, 1.0 / np.sqrt(sigma**2 + sharing * shared), 0.0)
    data = (slopes * weight.T[..., None]).reshape(-1, slopes.shape[-1])
    precision = data.T @ data + np.diag(np.concatenate([np.full(shape, PRIOR_SPREAD**-2.0), belief_ev**-2.0]))
    if family.smoothness:
        rough = derivatives(family.smoothness, parameters, family.upper) / EXPONENT_CHANGE
        precision[:shape, :shape] += rough.T @ rough
    covariance = np.linalg.inv(precision)
    change = _curve_derivatives(family, parameters, grey[used])
    std = np.sqrt(np.maximum(np.einsum("mi,ij,mj->m", change, covariance[:shape, :shape], change), 0.0))
    return CurvePosterior(std, np.sqrt(np.diag(covariance)[shape:]))


def _shared_variance(grey: Array, left: Array, used: NDArray[np.bool_]) -> tuple[float, Array]:
    """Variance of the error that greys of one picture and brightness share, and how many share each's.

    The first is the mean square of their mean residuals, less what noise gives those.
    """
    place = np.clip(grey / 256 * GREY_BINS, 0, GREY_BINS - 1).astype(np.int64)
    cell = place + GREY_BINS * np.arange(grey.shape[1])
    cells = GREY_BINS * grey.shape[1]
    count = np.bincount(cell[used], minlength=cells)
    many = count >= FEW
    mean = np.bincount(cell[used], left[used], cells)[many] / count[many]
    square = np.bincount(cell[used], left[used] ** 2, cells)[many] / count[many]
    excess = mean**2 - (square - mean**2) / (count[many] - 1)
    return max(float(excess.mean()) if many.any() else 0.0, SHARED_LEVELS**2), count[cell].astype(np.float64)


def derivatives(rows: Callable[[Array], Array], at: Array, upper: Array) -> Array:
    """(rows, parameters), by differences taken inside the upper bounds."""
    base = rows(at)
    columns = np.empty((len(base), len(at)))
    for i, h in enumerate(inner_steps(at, upper)):
        columns[:, i] = (rows(at + h * np.eye(1, len(at), i)[0]) - base) / h
    return columns


def inner_steps(at: Array, upper: Array) -> Array:
    """Steps (k,) of difference quotients that stay below upper bounds (k,)."""
    return np.where(at + STEP > upper, -STEP, STEP)


def _curve_derivatives(family: Family, parameters: Array, grey: Array) -> Array:
    """(POINTS, parameters): levels by parameter at fixed light, without what a scale of the light axis does."""
    curve = family.build(parameters)
    low, high = np.quantile(grey, [0.001, 0.999]) / 255
    light = curve.linearise(np.linspace(low, high, POINTS))

    def levels(q: Array) -> Array:
        return 255.0 * family.build(q).encode(light)

    change = derivatives(levels, parameters, family.upper)
    slope = (255.0 * curve.encode(light * (1 + STEP)) - levels(parameters)) / STEP
    return change - np.outer(slope, slope @ change) / max(float(slope @ slope), 1e-12)
