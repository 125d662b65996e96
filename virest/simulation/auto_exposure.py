"""How the phone exposes each picture: exposure time, ISO, and how much light they let the picture have.

As logged, light is exposure × ISO.  Without auto-exposure every picture gets the same: where the exposure changes, the
ISO compensates for it.  With it the product moves, in one of two ways: a smooth walk, as when a phone follows a
scene, or
a staircase from dark to bright, as when somebody brackets one.  Exposure and ISO share the change half and half, as far
as the frame's duration and the lowest ISO let them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from virest.errors import SettingsError

Array = NDArray[np.float64]
NOMINAL_ISO = 144
LOWEST_ISO = 50
MAX_RANGE_EV = 12.0
WALK_WAVES = 4
"""Waves of 0.6, 1.2, 1.8 and 2.4 periods over the capture, ever weaker: no two frames in a row differ by much."""


@dataclass(frozen=True, slots=True)
class AutoExposure:
    """By how much exposure × ISO changes over a capture."""

    range_ev: float
    """From the darkest picture to the brightest; the nominal exposure lies in the middle."""
    steps: int | None = None
    """A staircase of exposures, dark to bright, each held equally long; None: a smooth walk."""

    def __post_init__(self) -> None:
        if not 0 < self.range_ev <= MAX_RANGE_EV:
            text = f"auto-exposure over {self.range_ev:g} EV"
            raise SettingsError(f"simulation: {text}", hint=f"use more than 0, at most {MAX_RANGE_EV:g}")
        if self.steps is not None and self.steps < 2:
            raise SettingsError(f"simulation: a bracket of {self.steps} exposures", hint="use at least 2")


@dataclass(frozen=True, slots=True)
class Exposures:
    """Of every capture, by its number."""

    logged_s: Array
    """(n,) exposure time that the log gives."""
    iso: NDArray[np.int64]
    """(n,)."""
    light: Array
    """(n,) factor on the light against the nominal exposure; 1 without auto-exposure."""


def plan_exposures(
    nominal_s: tuple[float, ...], auto: AutoExposure | None, count: int, fps: float, rng: np.random.Generator
) -> Exposures:
    """Lay out the exposures of ``count`` captures; nominal_s: what they take in turn, at constant exposure × ISO."""
    logged_s = np.array([nominal_s[k % len(nominal_s)] for k in range(count)])
    iso = np.array([round(NOMINAL_ISO * nominal_s[0] / s) for s in logged_s.tolist()], np.int64)
    if auto is None:
        return Exposures(logged_s, iso, np.ones(count))
    light = 2.0 ** light_path_ev(auto, count, rng)
    iso = np.maximum(np.rint(NOMINAL_ISO * nominal_s[0] / logged_s * np.sqrt(light)), LOWEST_ISO)
    wanted = NOMINAL_ISO * nominal_s[0] * light
    longest_s = np.maximum(logged_s, 1 / fps)
    iso = np.maximum(iso, np.ceil(wanted / longest_s)).astype(np.int64)
    # the light follows the whole ISO and nanoseconds that the log can hold, so the log says the truth
    logged_s = np.rint(1e9 * wanted / iso) * 1e-9
    return Exposures(logged_s, iso, logged_s * iso / (NOMINAL_ISO * nominal_s[0]))


def light_path_ev(auto: AutoExposure, count: int, rng: np.random.Generator) -> Array:
    """(count,) log2 of the light, from −range_ev / 2 to range_ev / 2, both of which occur."""
    if auto.steps is not None:
        step = np.arange(count) * auto.steps // count
        return auto.range_ev * (step / max(int(step[-1]), 1) - 0.5)
    phase = rng.uniform(0, 2 * np.pi, WALK_WAVES)
    periods = 0.6 * np.arange(1, WALK_WAVES + 1)
    along = np.arange(count) / max(count - 1, 1)
    walk = np.sum(np.cos(2 * np.pi * np.multiply.outer(along, periods) + phase) / periods, axis=-1)
    middle, extent = 0.5 * (walk.max() + walk.min()), np.ptp(walk)
    return auto.range_ev * (walk - middle) / extent if extent > 0 else np.zeros(count)
