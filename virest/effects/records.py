"""The records of the table of effects: names, values, steps of a fit, and texts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from virest.arrays import Array
from virest.camera.profile import CameraProfile

GEOMETRY, PHOTOMETRY, BLUR, EDGES = "geometry_rms_px", "photometric_rms", "blur_rms_px", "edge_profile_rms"
"""The evidence: tracked points, brightness along them, blur of image regions, profiles of edges."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One value of an effect, as findings and ``simulate`` name it."""

    name: str
    """Its ending gives the unit: _s, _px, _hz, _rad, _rad_s, _per_s, _m; without one it is a ratio or a word."""
    get: Callable[[CameraProfile, CameraProfile], Any]
    """Its value in a profile (first argument), relative to the given profile (second) where it is a change."""
    spread: Callable[[Any, Array], Any]
    """Its standard deviation, from its value and the standard deviations (k,) of the effect's steps."""


@dataclass(frozen=True, slots=True)
class Steps:
    """How a fit of tracked points changes an effect's values: by a vector of k steps, additive or logarithmic."""

    change: Callable[[CameraProfile, Array], CameraProfile]
    """The profile with steps (k,) added."""
    between: Callable[[CameraProfile, CameraProfile], Array]
    """The steps (k,) that lead from one profile to another."""
    quotient: tuple[float, ...]
    """(k,) step of the difference quotient."""
    limit: tuple[float, ...]
    """(k,) largest step in one iteration."""
    prior_std: tuple[float, ...]
    """(k,) prior standard deviation of the total change; inf: no prior."""
    believable: float
    """No phone is off by more: larger steps absorb another effect."""
    starts: tuple[tuple[float, ...], ...] = ()
    """Further starting points of the fit, besides zero."""


@dataclass(frozen=True, slots=True)
class Choice:
    """An effect whose value is a word."""

    words: tuple[str, ...]
    choose: Callable[[CameraProfile, str], CameraProfile]
    """The profile with this word."""


@dataclass(frozen=True, slots=True)
class Calibrated:
    """How ``virest calibrate`` prints, keeps and checks the value that an effect's steps change."""

    name: str
    """Name of the value in ``estimates``."""
    read: Callable[[CameraProfile], float | list[float] | None]
    """The value; None: unknown, or a change relative to the starting profile."""
    keep: Callable[[CameraProfile, CameraProfile], CameraProfile]
    """The first profile with this value taken from the second."""
    max_std: float
    """Standard deviation of the steps above which the value is not determined and keeps its starting value."""
    option: str = ""
    """Its word for ``--with``; empty: always fitted."""
    believable: float = np.inf
    """A larger change absorbs another effect, such as a stabiliser or another timestamp reference: hold it fixed."""
    is_factor: bool = False
    """Steps are natural logarithms of a factor."""


@dataclass(frozen=True, slots=True)
class Effect:
    """One way in which a camera differs from its profile."""

    name: str
    """Name in ``simulate --effect``, ``diagnose`` and ``extended.yaml``."""
    seen_in: str
    """The evidence that decides on it."""
    parameters: tuple[Parameter, ...]
    place: str
    """Keys in the profile's file; empty: none, because restoration does not undo the effect."""
    in_words: str
    """Short description for users."""
    sentence: str
    """The finding as a sentence; {} is filled with the parameters."""
    steps: Steps | None = None
    """None: not fitted to points, or not by steps of a profile."""
    choice: Choice | None = None
    calibrated: Calibrated | None = None
    """None: not a value of ``virest calibrate``."""
    beside: str = ""
    """The effect that it refines, see :func:`virest.effects.table.is_sought`; empty: it stands alone."""
    addition: str = ""
    """Added to the sentence where all parameters have a value."""
    applied: Callable[[CameraProfile], str] = lambda profile: ""
    """Log line on how restoration handles it; empty: the profile lacks it, or states it as one of its plain values."""

    @property
    def in_points(self) -> bool:
        """Whether a fit of tracked points can change it, by steps or by its word."""
        return self.steps is not None or self.choice is not None

    def read(self, profile: CameraProfile, given: CameraProfile) -> dict[str, Any]:
        """Its parameters in a profile, relative to the given one."""
        return {parameter.name: parameter.get(profile, given) for parameter in self.parameters}

    def spread(self, values: dict[str, Any], std: Array) -> dict[str, Any]:
        """Standard deviations of its parameters, from those of its steps (k,)."""
        return {parameter.name: parameter.spread(values[parameter.name], std) for parameter in self.parameters}
