"""First estimate of the curve, and exposures that contradict the others, by linear least squares.

Debevec & Malik 1997, "Recovering high dynamic range radiance maps from photographs", doi:10.1145/258734.258884:
``g(z) = ln light + ln exposure``, with g, the logarithm of the inverse curve, and the light of every pixel unknown.
Here g is piecewise linear over KNOTS greys, and each picture also has a correction c of its log exposure:

    g(z_pn) = l_p + ln t_n + c_n

Corrections of the form a + β ln t are indistinguishable from an exponent of the curve: scaling (g, l, ln t) leaves the
fit unchanged.  The problem is therefore solved with such a trend excluded; the trend is then chosen so that most
pictures need no correction, by a robust line through the corrections (lines through pairs of pictures are tried).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from virest.arrays import Array, Mask
from virest.calibration.bracket_samples import BracketSamples
from virest.inference.robust import robust_std

KNOTS = 18
"""Knots of the first curve; half or twice as many change three simulated fits by 0.01 levels."""
SMOOTHNESS = 0.03
"""Weight of the curve's roughness relative to all data.

Noise pulls g towards a staircase wherever the exposures do not constrain it; equal exposure steps, for example, allow
any function with the period of the steps to be added to g.  The pull grows with the number of samples, so the roughness
weight is proportional to it.  For closely spaced exposures the data outweigh it by far.
"""
PASSES = 4
"""Reweightings; twice as many change none of these."""
CONTRADICTS_EV = 0.1
"""Smallest error of a listed exposure that is named: five times the standard deviation to which a list is trusted."""
MIN_PICTURES = 4
"""With fewer pictures, any exposures are consistent with some curve."""
ROBUST_Z = 4.0
"""With CONTRADICTS_EV, what counts as an outlier among few pictures; half or twice it named the same pictures."""
LN2 = float(np.log(2.0))


@dataclass(frozen=True, slots=True)
class FirstCurve:
    """Inverse curve at KNOTS greys, and the corrections of the exposures."""

    grey: Array
    """(k,) levels."""
    log_light: Array
    """(k,) natural logarithm of the exposure at these greys, 0 at the brightest."""
    correction_ev: Array
    """(pictures,) correction to add to log2 of each listed exposure."""
    suspect: Mask
    """(pictures,) whether the listed exposure contradicts the others."""


def fit_first_curve(samples: BracketSamples) -> FirstCurve:
    """Solve for the curve and the corrections, and mark outlying corrections as suspect."""
    measured = samples.measured & (samples.measured.sum(axis=1, keepdims=True) >= 2)
    greys = samples.low + (samples.high - samples.low) * np.linspace(0, 1, KNOTS) ** 1.5
    basis = _hats(samples.grey, greys)
    g = 2.2 * np.log(greys)
    log_t = np.log(samples.exposure)
    robust = np.ones(samples.grey.shape)
    correction = np.zeros(len(log_t))
    for _ in range(PASSES):
        slope = np.interp(samples.grey, 0.5 * (greys[1:] + greys[:-1]), _smooth_slopes(g, greys))
        weight = np.where(measured, 1.0 / (slope * samples.sigma) ** 2, 0.0) * robust
        g, correction, residual = _solve(basis, weight, log_t, greys)
        g = np.maximum.accumulate(g) + 1e-5 * np.arange(KNOTS)
        normal = np.abs(residual) / (slope * samples.sigma)
        scale = max(robust_std(normal[measured]), 0.5)
        robust = 1.0 / np.maximum(1.0, normal / (2.0 * scale))
    return _untrended(greys, g, correction, log_t)


def _smooth_slopes(g: Array, greys: Array) -> Array:
    """Slopes (k − 1,) of g between the knots, smoothed over five neighbours.

    Weights depend on the slope.  Without smoothing, a flat piece gains weight and becomes flatter, and the curve
    degenerates into a staircase that follows equal exposure steps.
    """
    slopes = np.log(np.maximum(np.diff(g) / np.diff(greys), 1e-4))
    return np.exp(np.convolve(np.pad(slopes, 2, "edge"), np.full(5, 0.2), "valid"))


def _hats(values: Array, knots: Array) -> Array:
    """Piecewise linear (hat) basis at values: (*values.shape, k)."""
    interval = np.clip(np.searchsorted(knots, values) - 1, 0, len(knots) - 2)
    part = np.clip((values - knots[interval]) / (knots[interval + 1] - knots[interval]), 0.0, 1.0)
    out = np.zeros((*values.shape, len(knots)))
    np.put_along_axis(out, interval[..., None], (1.0 - part)[..., None], -1)
    np.put_along_axis(out, interval[..., None] + 1, part[..., None], -1)
    return out


def _solve(basis: Array, weight: Array, log_t: Array, greys: Array) -> tuple[Array, Array, Array]:
    """Solve for (g, c, residual) with each pixel's light eliminated as its weighted mean of g − ln t − c."""
    count = len(log_t)
    design = np.concatenate([basis, np.broadcast_to(-np.eye(count), (*basis.shape[:2], count))], axis=-1)
    share = weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-300)
    design = design - np.einsum("pn,pnk->pk", share, design)[:, None, :]
    target = np.broadcast_to(log_t, weight.shape)
    target = target - (share * target).sum(axis=1, keepdims=True)
    rows, weights = design.reshape(-1, design.shape[-1]), weight.ravel()
    normal = rows.T @ (rows * weights[:, None])
    right = rows.T @ (weights * target.ravel())
    strength = float(np.trace(normal)) / len(normal)
    for row, factor in _side_conditions(greys, log_t, weight.sum(axis=0)):
        normal += factor * strength * np.outer(row, row)
    solution = np.linalg.solve(normal + 1e-12 * strength * np.eye(len(normal)), right)
    return solution[: len(greys)], solution[len(greys) :], design @ solution - target


def _side_conditions(greys: Array, log_t: Array, known: Array) -> list[tuple[Array, float]]:
    """Side conditions (row, strength): zero sum and trend of the corrections, g zero at the top, g smooth over ln grey.

    Sum and trend weight each picture by its total data weight ``known``.  With equal weights a picture with hardly any
    usable grey could take a huge correction at no cost, and with it the trend that makes g vanish.
    """
    count, knots = len(log_t), len(greys)
    share = known / known.sum()
    conditions: list[tuple[Array, float]] = []
    for pattern in (share, share * (log_t - share @ log_t)):
        row = np.concatenate([np.zeros(knots), pattern / max(float(np.linalg.norm(pattern)), 1e-12)])
        conditions.append((row, 1e3))
    conditions.append((np.eye(knots + count)[knots - 1], 1.0))
    along = np.log(greys + 8.0)
    for i in range(1, knots - 1):
        row = np.zeros(knots + count)
        left, right = along[i] - along[i - 1], along[i + 1] - along[i]
        row[i - 1 : i + 2] = np.array([1 / left, -1 / left - 1 / right, 1 / right]) * 0.1
        conditions.append((row, SMOOTHNESS))
    return conditions


def _untrended(greys: Array, g: Array, correction: Array, log_t: Array) -> FirstCurve:
    level, trend = robust_line(log_t, correction)
    left = correction - level - trend * log_t
    power = max(1.0 + trend, 0.2)
    ev = left / power / LN2
    log_light = (g - g[-1]) / power
    return FirstCurve(greys, log_light, ev, outlying(ev))


def robust_line(x: Array, y: Array) -> tuple[float, float]:
    """Robust line (level, trend): the line through two points with the least sum of capped deviations.

    Pairs closer than a quarter of the range are skipped.  The line is refitted to its inliers by least squares.  With
    fewer than MIN_PICTURES points the trend is 0 and the level the median.
    """
    if len(x) < MIN_PICTURES:
        return float(np.median(y)), 0.0
    best, found = np.inf, (0.0, 0.0)
    for i in range(len(x)):
        for j in range(i):
            if abs(x[i] - x[j]) < 0.25 * float(np.ptp(x)):
                continue
            trend = (y[i] - y[j]) / (x[i] - x[j])
            level = y[i] - trend * x[i]
            cost = float(np.minimum(np.abs(y - level - trend * x), 0.15).sum())
            if cost < best:
                best, found = cost, (float(level), float(trend))
    inside = np.abs(y - found[0] - found[1] * x) < 0.5 * CONTRADICTS_EV * LN2
    if inside.sum() >= MIN_PICTURES - 1 and np.ptp(x[inside]) > 0:
        trend, level = np.polyfit(x[inside], y[inside], 1)
        return float(level), float(trend)
    return found


def outlying(ev: Array) -> Mask:
    """Corrections more than CONTRADICTS_EV and ROBUST_Z robust standard deviations from the median.

    None with fewer than MIN_PICTURES pictures, or if half of the pictures or more would be outliers.
    """
    if len(ev) < MIN_PICTURES:
        return np.zeros(len(ev), bool)
    deviation = np.abs(ev - np.median(ev))
    std_ev = robust_std(deviation)
    suspect = (deviation > CONTRADICTS_EV) & (deviation > ROBUST_Z * std_ev)
    return suspect if suspect.sum() < 0.5 * len(ev) else np.zeros(len(ev), bool)
