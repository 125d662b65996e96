"""Deconvolution solvers.  They take callables, so any linear operator can be used.

Data model: ``observed = apply(sharp) + noise``, with a weight per observed pixel: 0 where censored or outside.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.restoration.row_chunks import bands

Image = NDArray[np.float32]
Operator = Callable[[Image], Image]
ALPHA = 2.0 / 3.0
"""Exponent of the hyper-Laplacian gradient prior (Krishnan & Fergus 2009)."""
_UNSEEN = 1e-3
"""Added to numerator and denominator of the Richardson–Lucy update, so that pixels without data stay unchanged."""
_LEAST_CHANGE = 0.2
"""Lower bound on the factor of an over-relaxed Richardson–Lucy step."""
_TABLE_SIZE = 2048
"""Entries of :func:`shrinkage_table`."""
_TABLE_END = 8.0
"""Largest |v| in :func:`shrinkage_table`."""
LEVELS_PER_UNIT = 32.0
"""Entries of :func:`shrinkage_levels` per unit of |v|."""


def richardson_lucy(
    observed: Image,
    apply: Operator,
    adjoint: Operator,
    start: Image,
    weight: Image,
    iterations: int,
    relaxation: float = 1.0,
) -> Image:
    """Multiplicative updates for Poisson noise (Richardson 1972, Lucy 1974), with weights (Whyte et al. 2014).

    f ← f · Aᵀ(w g / A f) / Aᵀ w.  Pixels of weight 0 have no influence.  relaxation: step length over the plain one;
    an over-relaxed step multiplies no pixel by less than _LEAST_CHANGE.
    """
    sharp: Image = cv2.max(start, 1e-4)
    seen, weighted = cv2.add(adjoint(weight), _UNSEEN), cv2.multiply(weight, observed)
    for _ in range(iterations):
        ratio = cv2.divide(weighted, cv2.max(apply(sharp), 1e-4))
        change = cv2.divide(cv2.max(cv2.add(adjoint(ratio), _UNSEEN), 0.0), seen)
        if relaxation != 1.0:
            change = cv2.max(cv2.addWeighted(change, relaxation, change, 0.0, 1 - relaxation), _LEAST_CHANGE)
        sharp = cv2.max(cv2.multiply(sharp, change), 1e-5)
    return sharp


@lru_cache(maxsize=64)
def shrinkage_levels(beta: float) -> Image:
    """The factor w / v at |v| = level / LEVELS_PER_UNIT, (256,): a look-up table over 8-bit levels."""
    level = np.minimum((np.arange(256) + 0.0) * (_TABLE_SIZE / _TABLE_END / LEVELS_PER_UNIT), _TABLE_SIZE - 1)
    return shrinkage_table(beta)[level.astype(int)]


def shrinkage_table(beta: float, exponent: float = ALPHA) -> Image:
    """argmin over w of |w|^exponent + β/2 (w − v)², tabulated over |v| in [0, _TABLE_END), as the factor w / v.

    Krishnan & Fergus 2009 (NIPS): the minimum is 0 or the outer root, found by Newton's method.
    """
    v = (np.arange(_TABLE_SIZE) + 0.5) * (_TABLE_END / _TABLE_SIZE)
    w = v.copy()
    for _ in range(20):
        slope = exponent * np.maximum(w, 1e-9) ** (exponent - 1) + beta * (w - v)
        curvature = exponent * (exponent - 1) * np.maximum(w, 1e-9) ** (exponent - 2) + beta
        w = np.clip(w - slope / np.where(curvature > 1e-6, curvature, np.inf), 1e-6, v)
    better = w**exponent + beta / 2 * (w - v) ** 2 < beta / 2 * v**2
    return np.where(better, w / v, 0.0).astype(np.float32)


def shrink(gradient: Image, table: Image) -> Image:
    """Shrink signed values by a :func:`shrinkage_table`."""
    index = np.minimum(np.abs(gradient) * np.float32(_TABLE_SIZE / _TABLE_END), _TABLE_SIZE - 1).astype(np.int32)
    return gradient * np.take(table, index)


def difference(picture: Image, axis: int) -> Image:
    """Forward difference along an axis; 0 in the last row or column."""
    result = np.zeros_like(picture)
    if axis == 0:
        np.subtract(picture[1:], picture[:-1], out=result[:-1])
    else:
        np.subtract(picture[:, 1:], picture[:, :-1], out=result[:, :-1])
    return result


def difference_adjoint(gradient: Image, axis: int) -> Image:
    """The transpose of :func:`difference`."""
    result = np.zeros_like(gradient)
    if axis == 0:
        np.negative(gradient[:-1], out=result[:-1])
        result[1:] += gradient[:-1]
    else:
        np.negative(gradient[:, :-1], out=result[:, :-1])
        result[:, 1:] += gradient[:, :-1]
    return result


def add_roughness(result: Image, picture: Image, weight: Image) -> None:
    """Add Dᵀ w D picture to ``result``, in place; D: forward differences along both axes."""
    for rows in bands(len(picture)):
        x, w, total = (plane[rows.start : rows.stop + 1] for plane in (picture, weight, result))
        steps = (x[1:] - x[:-1]) * w[:-1]
        total[:-1] -= steps
        total[1:] += steps
        x, w, total = (plane[rows] for plane in (picture, weight, result))
        steps = (x[:, 1:] - x[:, :-1]) * w[:, :-1]
        total[:, :-1] -= steps
        total[:, 1:] += steps


def conjugate_gradients(normal: Operator, right: Image, start: Image, precondition: Image, iterations: int) -> Image:
    """Solve normal(x) = right for a symmetric positive operator; precondition: its approximate inverse diagonal."""
    x = start.copy()
    residual = right - normal(x)
    conjugate = precondition * residual
    energy = float(np.vdot(residual, conjugate))
    for _ in range(iterations):
        if energy <= 0:
            break
        product = normal(conjugate)
        step = np.float32(energy / max(float(np.vdot(conjugate, product)), 1e-20))
        before, energy = energy, 0.0
        for rows in bands(len(x)):
            x[rows] += step * conjugate[rows]
            residual[rows] -= step * product[rows]
            product[rows] = precondition[rows] * residual[rows]
            energy += float(np.vdot(residual[rows], product[rows]))
        kept = np.float32(energy / before)
        for rows in bands(len(x)):
            conjugate[rows] *= kept
            conjugate[rows] += product[rows]
    return x


def hyper_laplacian(
    observed: Image,
    apply: Operator,
    adjoint: Operator,
    start: Image,
    weight: Image,
    slope: Image,
    data_weight: float,
    gradient_unit: float,
    betas: tuple[float, ...],
    inner: int,
) -> Image:
    """min over f of data_weight/2 Σ weight² (A f − g)² + Σ |s ∇f / u|^⅔, by half-quadratic splitting.

    Krishnan & Fergus 2009, for any linear operator A, with weights.  observed, weight: shape of A f; start, slope
    s: shape of f.  s is the tone curve's slope (grey levels per unit of light), so that gradients and noise count in
    grey levels; u = gradient_unit: grey levels per unit of gradient.  betas: increasing penalties; inner:
    conjugate-gradient steps per penalty.
    """
    unit_slope = slope / np.float32(gradient_unit)
    squared = unit_slope * unit_slope
    sharp = start
    typical = float(np.median(weight)) ** 2 / max(float(np.median(slope)) ** 2, 1e-12)
    for beta in betas:
        table = shrinkage_table(beta)
        data = np.float32(data_weight / beta) * weight * weight
        right = adjoint(data * observed)
        for axis in (0, 1):
            target = shrink(unit_slope * difference(sharp, axis), table)
            right += difference_adjoint(unit_slope * target, axis)

        def normal(x: Image, data: Image = data) -> Image:
            blurred = apply(x)
            blurred *= data
            result = adjoint(blurred)
            add_roughness(result, x, squared)
            return result

        precondition = 1.0 / (slope * slope * np.float32(data_weight / beta * typical) + 4 * squared)
        sharp = conjugate_gradients(normal, right, sharp, precondition, inner)
    return sharp
