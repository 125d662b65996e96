"""The response curve E: exposure -> grey, and its inverse E' (eqs 1, 19-22).

Both axes run over [0, 1]: grey 1 is level 255; exposure is in the curve's own unit.  Kinds:

- ``linear``, ``srgb`` (IEC 61966-2-1), ``gamma`` (grey = light^(1/gamma));
- ``five_segment``: the paper's curve A B C D without kinks: zero below x_a, a quadratic toe, a line, a quadratic
  shoulder, constant y_d above x_d;
- ``table``: monotone samples, interpolated linearly.

Two extensions of the contract apply to any kind: ``grey = black + (1 - black) * curve(light)^gamma``.
Below A and above D the curve has no inverse: those pixels are *censored* (:meth:`ResponseCurve.censored_table`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Mask
from virest.errors import SettingsError

KINDS = ("linear", "srgb", "gamma", "five_segment", "table")
_LEVELS = np.arange(256) / 255.0
"""All grey levels of 8 bits, 0 to 1."""


@dataclass(frozen=True, slots=True)
class ResponseCurve:
    """A monotone response curve."""

    kind: str = "srgb"
    gamma: float = 2.2
    """Of ``gamma`` only: grey = light^(1/gamma)."""
    b: tuple[float, float] = (0.0, 0.0)
    """Of ``five_segment``: start of the line, (x_b, y_b)."""
    c: tuple[float, float] = (1.0, 1.0)
    """Of ``five_segment``: end of the line, (x_c, y_c)."""
    y_max: float = 1.0
    """Of ``five_segment``: y_d, the maximal grey."""
    x: tuple[float, ...] = ()
    """Of ``table``: exposures, rising."""
    y: tuple[float, ...] = ()
    """Of ``table``: greys, rising."""
    extra_gamma: float = 1.0
    """Extension ``response_gamma``: the curve's output raised to this power."""
    black_level: float = 0.0
    """Extension ``black_level``: grey without light."""

    def __post_init__(self) -> None:
        _require_curve(self)

    @property
    def knots(self) -> tuple[float, float]:
        """(x_a, x_d) of the five-segment curve: ends of toe and shoulder, from continuous slopes at B and C."""
        slope = (self.c[1] - self.b[1]) / (self.c[0] - self.b[0])
        return self.b[0] - 2 * self.b[1] / slope, self.c[0] + 2 * (self.y_max - self.c[1]) / slope

    @property
    def light_range(self) -> tuple[float, float]:
        """Exposures between which the curve can be inverted: (x_a, x_d)."""
        if self.kind == "five_segment":
            return self.knots
        if self.kind == "table":
            return self.x[0], self.x[-1]
        return 0.0, 1.0

    def encode(self, light: NDArray[Any]) -> NDArray[Any]:
        """E: grey in [0, 1] of exposure ``light``; clips outside the curve's range. Keeps float32 as float32."""
        grey = _curve(self, np.asarray(light))
        if self.extra_gamma != 1.0:
            grey = grey**self.extra_gamma
        return self.black_level + (1.0 - self.black_level) * grey if self.black_level else grey

    def linearise(self, grey: NDArray[Any]) -> NDArray[Any]:
        """E': exposure of ``grey`` in [0, 1]; greys outside the curve's range give the range's ends."""
        grey = np.asarray(grey)
        if self.black_level:
            grey = np.clip((grey - self.black_level) / (1.0 - self.black_level), 0.0, None)
        if self.extra_gamma != 1.0:
            grey = np.clip(grey, 0.0, None) ** (1.0 / self.extra_gamma)
        return _inverse(self, grey)

    def linear_table(self) -> NDArray[np.float32]:
        """Exposure of each of the 256 grey levels, (256,)."""
        return _linear_table(self).copy()

    def slope_table(self) -> NDArray[np.float32]:
        """dE/dx in grey levels (of 255) per unit of exposure, at each of the 256 grey levels, (256,).

        A central difference over one grey level on both sides, hence finite at kinks and ends.
        """
        return _slope_table(self).copy()

    def censored_table(self, margin_levels: float = 0.5) -> Mask:
        """Mask (256,) of the grey levels without measured light: at or beyond A and D."""
        clipped = self.clipped_table(margin_levels)
        if self.light_range[0] <= 1e-3:
            return clipped
        return (np.arange(256) <= _end_levels(self)[0] + margin_levels) | clipped

    def clipped_table(self, margin_levels: float = 0.5) -> Mask:
        """Mask (256,) of the clipped grey levels, at or beyond D, where the light may have any strength."""
        return np.arange(256) >= min(_end_levels(self)[1], 255.0) - margin_levels

    def describe(self) -> str:
        """A short name for tables and logs."""
        name = f"gamma {self.gamma:g}" if self.kind == "gamma" else self.kind
        if self.extra_gamma != 1.0:
            name += f" ^{self.extra_gamma:g}"
        return name + (f" black {self.black_level:g}" if self.black_level else "")


@lru_cache(maxsize=32)
def _linear_table(curve: ResponseCurve) -> NDArray[np.float32]:
    return curve.linearise(_LEVELS).astype(np.float32)


@lru_cache(maxsize=32)
def _slope_table(curve: ResponseCurve) -> NDArray[np.float32]:
    light = curve.linearise(np.clip(np.stack([_LEVELS - 1 / 255, _LEVELS + 1 / 255]), 0.0, 1.0))
    grey = curve.encode(light)
    rise = np.maximum(grey[1] - grey[0], 1e-6)
    return (255.0 * rise / np.maximum(light[1] - light[0], 1e-6)).astype(np.float32)


@lru_cache(maxsize=32)
def _end_levels(curve: ResponseCurve) -> tuple[float, float]:
    """Grey levels at both ends of the invertible range."""
    low, high = (255.0 * float(curve.encode(np.array(end))) for end in curve.light_range)
    return low, high


def _curve(curve: ResponseCurve, light: NDArray[Any]) -> NDArray[Any]:
    match curve.kind:
        case "linear":
            return np.clip(light, 0.0, 1.0)
        case "srgb":
            light = np.clip(light, 0.0, 1.0)
            return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
        case "gamma":
            return np.clip(light, 0.0, 1.0) ** (1.0 / curve.gamma)
        case "table":
            return np.interp(light, curve.x, curve.y).astype(np.result_type(light, np.float32), copy=False)
    (xb, yb), (xc, yc), yd = curve.b, curve.c, curve.y_max
    xa, xd = curve.knots
    light = np.clip(light, xa, xd)
    toe = yb * ((light - xa) / (xb - xa)) ** 2 if xb > xa else np.zeros_like(light)
    line = yb + (yc - yb) / (xc - xb) * (light - xb)
    shoulder = yd - (yd - yc) * ((xd - light) / (xd - xc)) ** 2 if xd > xc else np.full_like(light, yd)
    return np.where(light < xb, toe, np.where(light > xc, shoulder, line))


def _inverse(curve: ResponseCurve, grey: NDArray[Any]) -> NDArray[Any]:
    match curve.kind:
        case "linear":
            return np.clip(grey, 0.0, 1.0)
        case "srgb":
            grey = np.clip(grey, 0.0, 1.0)
            return np.where(grey <= 12.92 * 0.0031308, grey / 12.92, ((grey + 0.055) / 1.055) ** 2.4)
        case "gamma":
            return np.clip(grey, 0.0, 1.0) ** curve.gamma
        case "table":
            return np.interp(grey, curve.y, curve.x).astype(np.result_type(grey, np.float32), copy=False)
    (xb, yb), (xc, yc), yd = curve.b, curve.c, curve.y_max
    xa, xd = curve.knots
    grey = np.clip(grey, 0.0, yd)
    toe = xa + (xb - xa) * np.sqrt(np.minimum(grey, yb) / yb) if yb > 0 else np.full_like(grey, xa)
    line = xb + (xc - xb) / (yc - yb) * (grey - yb)
    shoulder = xd - (xd - xc) * np.sqrt((yd - np.maximum(grey, yc)) / (yd - yc)) if yd > yc else np.full_like(grey, xd)
    return np.where(grey < yb, toe, np.where(grey > yc, shoulder, line))


def _require_curve(curve: ResponseCurve) -> None:
    def refuse(what: str) -> None:
        raise SettingsError(f"response: {what}", hint="the curve must rise and be finite")

    if curve.kind not in KINDS:
        refuse(f"kind '{curve.kind}' is not one of {', '.join(KINDS)}")
    if curve.kind == "gamma" and not 0.1 <= curve.gamma <= 10.0:
        refuse(f"gamma is {curve.gamma:g}, outside 0.1 to 10")
    if not 0.1 <= curve.extra_gamma <= 10.0:
        refuse(f"response_gamma is {curve.extra_gamma:g}, outside 0.1 to 10")
    if not 0.0 <= curve.black_level < 0.9:
        refuse(f"black_level is {curve.black_level:g}, outside 0 to 0.9")
    if curve.kind == "five_segment":
        (xb, yb), (xc, yc), yd = curve.b, curve.c, curve.y_max
        if not (np.all(np.isfinite([xb, yb, xc, yc, yd])) and xb < xc and 0 <= yb < yc <= yd <= 1):
            refuse(f"five_segment needs x_b < x_c and 0 <= y_b < y_c <= y_max <= 1, got b {curve.b}, c {curve.c}, {yd}")
    if curve.kind == "table":
        x, y = np.asarray(curve.x), np.asarray(curve.y)
        if x.size < 2 or x.size != y.size or not (np.all(np.diff(x) > 0) and np.all(np.diff(y) > 0)):
            refuse("table needs lists x and y of equal length, with at least two values, both strictly rising")
        if y[0] < 0 or y[-1] > 1:
            refuse(f"table: y runs from {y[0]:g} to {y[-1]:g}, outside 0 to 1")
