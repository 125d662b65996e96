"""Auto-exposure: exposure time, ISO and resulting brightness of each frame.

Brightness is logged exposure × ISO.  Without auto-exposure it is constant: ISO compensates for changes of exposure
time.  With auto-exposure it varies in one of two ways: a smooth walk, as when a phone adapts to a scene, or a staircase
from dark to bright, as in exposure bracketing.  Exposure time and ISO each take half of the change in log units, within
the limits set by the frame duration and the lowest ISO.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.errors import SettingsError

NOMINAL_ISO, LOWEST_ISO = 144, 50
"""ISO without auto-exposure, and the lowest of a phone's sensor, 1.5 EV below."""
MAX_RANGE_EV = 12.0
"""A factor of 4096: from full sun (EV 15) to a floodlit building at night (EV 3)."""
WALK_WAVES = 4
"""Cosines of 0.6, 1.2, 1.8 and 2.4 periods per capture, amplitude ∝ 1 / periods, so adjacent frames differ little."""


@dataclass(frozen=True, slots=True)
class AutoExposure:
    """Variation of exposure × ISO over a capture."""

    range_ev: float
    """From the darkest frame to the brightest, centred on the nominal exposure."""
    steps: int | None = None
    """Number of bracketed exposures, dark to bright, each held equally long; None: a smooth walk."""

    def __post_init__(self) -> None:
        if not 0 < self.range_ev <= MAX_RANGE_EV:
            text = f"auto-exposure over {self.range_ev:g} EV"
            raise SettingsError(f"simulation: {text}", hint=f"use more than 0, at most {MAX_RANGE_EV:g}")
        if self.steps is not None and self.steps < 2:
            raise SettingsError(f"simulation: a bracket of {self.steps} exposures", hint="use at least 2")


@dataclass(frozen=True, slots=True)
class Exposures:
    """Exposure of each capture, indexed by capture number."""

    logged_s: Array
    """(n,) logged exposure time."""
    iso: NDArray[np.int64]
    """(n,) logged ISO."""
    light: Array
    """(n,) exposure × ISO relative to nominal; 1 without auto-exposure."""


def plan_exposures(
    nominal_s: tuple[float, ...], auto: AutoExposure | None, count: int, fps: float, rng: np.random.Generator
) -> Exposures:
    """Plan the exposures of ``count`` captures.

    nominal_s: exposure times without auto-exposure, used cyclically at constant exposure × ISO.
    """
    logged_s = np.array([nominal_s[k % len(nominal_s)] for k in range(count)])
    iso = np.array([round(NOMINAL_ISO * nominal_s[0] / s) for s in logged_s.tolist()], np.int64)
    if auto is None:
        return Exposures(logged_s, iso, np.ones(count))
    light = 2.0 ** light_path_ev(auto, count, rng)
    iso = np.maximum(np.rint(NOMINAL_ISO * nominal_s[0] / logged_s * np.sqrt(light)), LOWEST_ISO)
    wanted = NOMINAL_ISO * nominal_s[0] * light
    longest_s = np.maximum(logged_s, 1 / fps)
    iso = np.maximum(iso, np.ceil(wanted / longest_s)).astype(np.int64)
    # brightness follows the rounded ISO and nanoseconds that the log stores, so the log is exact
    logged_s = np.rint(1e9 * wanted / iso) * 1e-9
    return Exposures(logged_s, iso, logged_s * iso / (NOMINAL_ISO * nominal_s[0]))


def light_path_ev(auto: AutoExposure, count: int, rng: np.random.Generator) -> Array:
    """Log2 of the relative brightness (count,), spanning −range_ev / 2 to range_ev / 2; 0 for a single frame."""
    if auto.steps is not None:
        step = np.arange(count) * auto.steps // count
        last = int(step[-1])
        return auto.range_ev * (step / last - 0.5) if last else np.zeros(count)
    phase = rng.uniform(0, 2 * np.pi, WALK_WAVES)
    periods = 0.6 * np.arange(1, WALK_WAVES + 1)
    along = np.arange(count) / max(count - 1, 1)
    walk = np.sum(np.cos(2 * np.pi * np.multiply.outer(along, periods) + phase) / periods, axis=-1)
    middle, extent = 0.5 * (walk.max() + walk.min()), np.ptp(walk)
    return auto.range_ev * (walk - middle) / extent if extent > 0 else np.zeros(count)
