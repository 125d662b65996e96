"""Kinds of response curve that a fit can choose from, each with a few independent parameters.

The exposure axis has no absolute scale, so each family fixes its own: full grey at 1 for ``linear``, ``srgb`` and
``gamma``; unit slope of the line for ``five_segment``; 1 at the brightest grey covered for ``table``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.optimize import least_squares

from virest.arrays import Array
from virest.calibration.exposure_check import FirstCurve
from virest.camera.response import ResponseCurve

TABLE_KNOTS = 14
"""Knots of a table.  With 7, the table of a dark bracket is off by 1.0 grey levels instead of 0.7; with 28 by 0.8, and
standard deviations grow 1.3 to 3 times."""
TABLE_LEVELS, FIT_LEVELS = 96, 384
"""Entries of a table, and of a curve while it is fitted; twice as many change three simulated fits by 0.01 levels."""
SMALLEST_LIGHT = 1e-7
"""Keeps logarithms finite: below any grey of 8 bits."""
FULL_LEVEL = 253.8
"""A brightest grey above this is the end of the 8-bit range, not the curve's plateau."""


@dataclass(frozen=True, slots=True)
class Family:
    """One kind of curve with free parameters."""

    kind: str
    start: Array
    """Start parameters."""
    lower: Array
    upper: Array
    build: Callable[[Array], ResponseCurve]
    smoothness: Callable[[Array], Array] | None = None
    """Changes of the local exponent from knot to knot, penalised by the fit."""
    bends: bool = False
    """Whether the parameters can raise the curve to a power, which a trend of the exposure errors would also do."""
    others: tuple[Array, ...] = ()
    """Alternative start parameters; the fit continues from the best after a few iterations."""


def make_family(kind: str, first: FirstCurve, low: float, high: float, top: float) -> Family:
    """A family with start parameters from a first curve.

    low, high: censoring limits in grey levels; top: brightest grey seen.
    """
    match kind:
        case "gamma":
            slope = np.polyfit(np.log(first.grey[3:] / 255), first.log_light[3:], 1)[0]
            start = np.array([np.log(np.clip(slope, 0.3, 6.0))])
            bounds = np.log([[0.11], [9.0]])
            return Family(kind, start, bounds[0], bounds[1], _gamma_curve, bends=True)
        case "five_segment":
            return _five_segment(first, high, top)
        case "table":
            return _table(first, low, high, top)
    none = np.zeros(0)
    return Family(kind, none, none, none, lambda _p: ResponseCurve(kind))


def _gamma_curve(p: Array) -> ResponseCurve:
    return ResponseCurve("gamma", gamma=float(np.exp(p[0])))


# ── five segments ────────────────────────────────────────────────────────────────────────────────────────────────


def five_segment_curve(p: Array) -> ResponseCurve:
    """p = (x_b, y_b, fraction of the range y_b to y_d at which the line ends, y_d); the line has slope 1."""
    xb, yb, share, top = (float(v) for v in p)
    top = min(max(top, yb + 0.02), 1.0)
    yc = min(yb + (top - yb) * share, top)
    return ResponseCurve("five_segment", b=(xb, yb), c=(xb + yc - yb, yc), y_max=top)


def _five_segment(first: FirstCurve, high: float, top: float) -> Family:
    clipped = top > FULL_LEVEL
    lower = np.array([-2.0, 0.0, 0.05, 1.0 - 1e-6 if clipped else high / 255])
    upper = np.array([2.0, 0.6, 1.0, 1.0])
    grey, light = first.grey / 255, np.exp(first.log_light)
    rise = np.polyfit(light[len(light) // 3 :], grey[len(light) // 3 :], 1)[0]
    starts = []
    for yb, share in ((0.05, 0.9), (0.1, 0.6), (0.2, 0.2)):
        guess = np.array([0.12, yb, share, 1.0 - 5e-7 if clipped else top / 255])

        def miss(q: Array) -> Array:
            return five_segment_curve(q[:4]).encode(light * np.exp(q[4])) - grey

        lo, hi = np.append(lower, -6.0), np.append(upper, 6.0)
        begin = np.clip(np.append(guess, np.log(max(rise, 0.01))), lo + 1e-7, hi - 1e-7)
        found = least_squares(miss, begin, bounds=(lo, hi), max_nfev=25).x[:4]
        # away from the bounds, where a trust-region solver converges slowly
        inside = np.array([1e-7, 0.01, 0.02, 1e-7])
        starts.append(np.clip(found, lower + inside, upper - inside))
    return Family("five_segment", starts[0], lower, upper, five_segment_curve, others=tuple(starts[1:]))


# ── a table ──────────────────────────────────────────────────────────────────────────────────────────────────────


def _table(first: FirstCurve, low: float, high: float, top: float) -> Family:
    greys = low + (high - low) * np.linspace(0, 1, TABLE_KNOTS) ** 1.4
    start = np.log(np.maximum(np.diff(np.interp(greys, first.grey, first.log_light)), 1e-3))
    along = np.log(greys + 8.0)
    middle = 0.5 * (along[1:] + along[:-1])

    def smooth(p: Array) -> Array:
        return np.diff(np.exp(p) / np.diff(along)) / np.diff(middle) * np.diff(along)[1:]

    bounds = np.full(TABLE_KNOTS - 1, 8.0)
    return Family("table", start, -bounds, bounds, lambda p: table_curve(p, greys, top), smooth, bends=True)


def table_curve(p: Array, greys: Array, top: float) -> ResponseCurve:
    """Monotone table through greys (levels) with log-exposure increments exp(p); 1 at the last, ends extrapolated."""
    log_light = np.concatenate([[0.0], np.cumsum(np.exp(p))])
    log_light -= log_light[-1]
    levels = greys[0] + (greys[-1] - greys[0]) * np.linspace(0, 1, TABLE_LEVELS) ** 1.4
    light = np.exp(PchipInterpolator(greys, log_light)(levels))
    foot = light[0] - levels[0] * (light[1] - light[0]) / (levels[1] - levels[0])
    foot = min(max(foot, 0.0), 0.9 * light[0])
    end = 255.0 if top > FULL_LEVEL else max(top, levels[-1] + 0.5)
    head = light[-1] + (end - levels[-1]) * (light[-1] - light[-2]) / (levels[-1] - levels[-2])
    x = np.maximum.accumulate(np.concatenate([[foot], light, [head]]) + 1e-12 * np.arange(TABLE_LEVELS + 2))
    y = np.concatenate([[0.0], levels, [end]]) / 255
    return ResponseCurve("table", x=tuple(x.tolist()), y=tuple(y.tolist()))


# ── a curve as two look-ups over log light ───────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class LogLookup:
    """Look-up tables between log light and grey level, for tens of thousands of pixels at a time.

    Values (samples, pictures) are looked up picture by picture; samples sorted by light are fastest.
    """

    log_light: Array
    """(m,) increasing."""
    grey: Array
    """(m,) levels."""
    slope: Array
    """(m,) levels per unit of log light."""

    def level(self, log_light: Array) -> Array:
        """Grey level of light."""
        return np.interp(log_light.T, self.log_light, self.grey).T

    def rise(self, log_light: Array) -> Array:
        """Levels per unit of log light."""
        return np.interp(log_light.T, self.log_light, self.slope, left=0.0, right=0.0).T

    def light(self, grey: Array) -> Array:
        """Log light of a grey level."""
        return np.interp(grey.T, self.grey, self.log_light).T


def log_lookup(curve: ResponseCurve) -> LogLookup:
    """Tabulate a curve, more densely at its dark and bright ends."""
    low, high = (float(v) for v in curve.encode(np.array(curve.light_range)))
    grey = low + (high - low) * (0.5 - 0.5 * np.cos(np.pi * np.linspace(0, 1, FIT_LEVELS)))
    light = np.log(np.maximum(curve.linearise(grey), SMALLEST_LIGHT))
    light = light + 1e-9 * np.arange(FIT_LEVELS)
    slope = np.gradient(255 * grey, light)
    return LogLookup(light, 255 * grey, np.maximum(slope, 0.0))
