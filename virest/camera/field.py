"""Fields: smooth corrections of the model along recorded covariates, for effects without a name of their own.

A field has values at knots, interpolated by a cubic spline (of lower degree below four knots; linearly for a blur,
which must not fall below 0) and constant beyond the first and last knot.  Two covariates form a tensor product.  Six
kinds:

- ``delay`` (s): delay of a row relative to an even readout, or of a frame relative to its timestamp (camera clock);
  with row and time, the time is that of the frame's first row; with row and exposure, the exposure is the logged one.
- ``displacement`` (px): displacement of a point from where the lens model puts it.
- ``scale`` (1): relative increase of the focal length; over the radius, for points seen there.
- ``gain`` (1): relative increase of the light at a position of the sensor.
- ``blur`` (px): standard deviation of a Gaussian on the light, in addition to a uniform defocus.
- ``rate`` (rad/s, IMU axes): true rate minus the gyroscope's, after correction for bias and scale.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from math import prod
from typing import Any

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from virest.arrays import Array
from virest.errors import SettingsError

AXES = ("x", "y", "z")
RATES, FORCES = tuple(f"rate_{a}" for a in AXES), tuple(f"accel_{a}" for a in AXES)
KINDS: dict[str, tuple[str, int, tuple[tuple[str, ...], ...]]] = {
    "delay": ("s", 1, (("row",), ("time",), ("row", "time"), ("row", "exposure"))),
    "displacement": ("px", 2, (("x", "y"),)),
    "scale": ("1", 1, (("time",), ("focus",), ("focal",), ("radius", "time"), ("radius", "focus"))),
    "gain": ("1", 1, (("x", "y"),)),
    "blur": ("px", 1, (("time",), ("focus",), ("radius",))),
    "rate": ("rad/s", 3, (("time",), *((name,) for name in (*RATES, *FORCES)), *((name, "time") for name in RATES))),
}
"""Unit, number of components and possible covariates of each kind."""
UNITS = {"row": "1", "radius": "px", "x": "px", "y": "px", "time": "s", "exposure": "s", "focus": "1/m", "focal": "1"}
"""Units of the covariates; rates are in rad/s, accelerations in m/s².  ``row``: fraction of the readout; ``radius``:
from the principal point; ``focal``: logged focal length over its median."""
UNIT_SCALES = {
    "delay": (1e3, "ms"),
    "displacement": (1.0, "px"),
    "scale": (100.0, "%"),
    "blur": (1.0, "px"),
    "rate": (1.0, "rad/s"),
}
"""Factor and unit in which people read the values of each kind."""
TIMED_BY_IMU = ("scale", "rate")
"""Kinds whose times are on the IMU clock; those of the others are on the camera clock."""
_FIXED_POINT_STEPS = 5
"""A displacement's slope is a few percent: each step of its inversion reduces the error by that factor."""


@dataclass(frozen=True, slots=True)
class Field:
    """One field."""

    kind: str
    """A key of KINDS."""
    covariates: tuple[str, ...]
    knots: tuple[tuple[float, ...], ...]
    """Rising, one list per covariate, in its unit."""
    values: tuple[tuple[float, ...], ...]
    """(knots, components); with two covariates the second varies fastest."""
    std: tuple[tuple[float, ...], ...] = ()
    """Standard deviations of the values; empty: unknown."""
    stamp_0_ns: int | None = None
    """First timestamp of the only capture to which the field applies; None: it belongs to the phone."""
    log: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    """Times (camera clock) and values of a logged covariate in the current capture; not stored in files."""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise SettingsError(f"unknown field kind '{self.kind}'", hint=f"use one of {', '.join(KINDS)}")
        _, parts, allowed = KINDS[self.kind]
        if self.covariates not in allowed:
            known = " or ".join("(" + ", ".join(names) + ")" for names in allowed)
            raise SettingsError(f"field {self.kind}: covariates must be {known}, not {', '.join(self.covariates)}")
        rising = all(len(k) > 1 and not any(b <= a for a, b in pairwise(k)) for k in self.knots)
        if len(self.knots) != len(self.covariates) or not rising:
            raise SettingsError(f"field {self.kind}: needs two or more rising knots for each covariate")
        for name, rows in (("values", self.values), ("std", self.std or self.values)):
            if self.kind == "blur" and any(value < 0 for row in rows for value in row):
                raise SettingsError(f"field blur: {name} must be 0 or more")
            if len(rows) != prod(map(len, self.knots)) or any(len(row) != parts for row in rows):
                raise SettingsError(f"field {self.kind}: {name} must have {parts} numbers for each knot")

    @property
    def unit(self) -> str:
        """Unit of the values."""
        return KINDS[self.kind][0]

    @property
    def belongs_to_one_capture(self) -> bool:
        """Whether it applies only to the capture in which it was found."""
        return self.stamp_0_ns is not None

    def at(self, *covariates: Any) -> Array:
        """Values (..., components) at covariates of shape (...) each."""
        table = np.array(self.values)
        if len(self.knots) == 1:
            return interpolated(self.knots[0], table, covariates[0], 1 if self.kind == "blur" else 3)
        first, second = np.broadcast_arrays(*covariates)
        by_first = np.moveaxis(table.reshape(len(self.knots[0]), len(self.knots[1]), -1), 0, 1)
        weights = cardinal_weights(self.knots[0], first)
        return np.asarray((weights[..., None] * interpolated(self.knots[1], by_first, second)).sum(axis=-2))

    def at_time(self, time_s: Any, *first: Any) -> Array:
        """Values (..., components) of a field over time, or over a logged covariate, at times (...) on its own clock.

        first: the first of two covariates.
        """
        time_s = np.asarray(time_s, float)
        return self.at(*first, time_s if self.log is None else np.interp(time_s, *self.log))

    def std_over_time(self, time_s: Array) -> Array:
        """Standard deviations (n, components) of a field over time, linear between its knots and 0 beyond them."""
        return np.stack([np.interp(time_s, self.knots[0], std, 0.0, 0.0) for std in np.array(self.std).T], -1)

    def undisplaced(self, points_px: Array) -> Array:
        """Positions without displacement of points seen at pixels (..., 2): q + u(q) = p."""
        points_px = np.asarray(points_px, float)
        found = points_px
        for _ in range(_FIXED_POINT_STEPS):
            found = points_px - self.at(found[..., 0], found[..., 1])
        return found

    def moved(self, across_px: float, down_px: float) -> Field:
        """A field over the picture for a crop that starts this much further right and down."""
        x, y = (tuple(k - by for k in knots) for knots, by in zip(self.knots, (across_px, down_px), strict=True))
        return replace(self, knots=(x, y))

    @property
    def is_pair(self) -> bool:
        """Whether it has two covariates other than x and y: version 2 of the file's entries."""
        return len(self.covariates) > 1 and self.covariates != ("x", "y")

    @property
    def is_single(self) -> bool:
        """Whether a profile may hold at most one such field."""
        return self.kind == "displacement" or (self.kind, self.covariates) == ("delay", ("row",))

    def with_times(self, clock: Callable[[float], float]) -> Field:
        """The field with its knots over time on another clock."""
        knots = (
            tuple(map(clock, k)) if name == "time" else k for name, k in zip(self.covariates, self.knots, strict=True)
        )
        return replace(self, knots=tuple(knots))

    def with_values(self, values: Array, std: Array | None = None) -> Field:
        """The field with other values (knots, components)."""
        rows = tuple(map(tuple, np.asarray(values).tolist()))
        return replace(self, values=rows, std=() if std is None else tuple(map(tuple, np.asarray(std).tolist())))

    def rounded(self, digits: int = 5) -> Field:
        """The field rounded to a number of significant digits, as in files."""
        rows = (tuple(tuple(float(f"{v:.{digits}g}") for v in row) for row in part) for part in (self.values, self.std))
        values, std = rows
        return replace(self, values=values, std=std)

    def is_in_place_of(self, other: Field) -> bool:
        """Whether two fields differ only in their values."""
        return (self.kind, self.covariates, self.knots) == (other.kind, other.covariates, other.knots)

    def later(self, seconds: float) -> Field:
        """The field with its times counted from a later origin."""
        if self.log is None:
            return self.with_times(lambda time_s: time_s - seconds)
        return replace(self, log=(tuple(t - seconds for t in self.log[0]), self.log[1]))


def interpolated(knots: tuple[float, ...], values: Array, covariate: Any, degree: int = 3) -> Array:
    """Spline through values (knots, ...) at a covariate of shape (...); constant beyond its ends."""
    held = np.minimum(np.maximum(np.asarray(covariate, float), knots[0]), knots[-1])
    cardinal = _cardinal(knots, degree)
    along = cardinal.c @ values if values.ndim == 2 else np.tensordot(cardinal.c, values, axes=1)
    return np.asarray(BSpline.construct_fast(cardinal.t, along, cardinal.k)(held))


def cardinal_weights(knots: tuple[float, ...], covariate: Any, degree: int = 3) -> Array:
    """Weights (..., knots) of the knots' values in the interpolating spline at a covariate of shape (...)."""
    held = np.clip(np.asarray(covariate, float), knots[0], knots[-1])
    return np.asarray(_cardinal(knots, degree)(held))


@lru_cache(maxsize=256)
def _cardinal(knots: tuple[float, ...], degree: int) -> BSpline:
    return make_interp_spline(knots, np.eye(len(knots)), k=min(degree, len(knots) - 1))
