"""What the table of effects says of each: names, values, steps of a fit, and the words for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile

Array = NDArray[np.float64]
GEOMETRY, PHOTOMETRY, BLUR, EDGES = "geometry_rms_px", "photometric_rms", "blur_rms_px", "edge_profile_rms"
"""The evidence: tracked points, brightness along them, blur of image regions, profiles of edges."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One value of an effect, as findings and ``simulate`` name it."""

    name: str
    """Its ending tells its unit: _s, _px, _hz, _rad, _rad_s, _per_s, _m; without one it is a ratio or a word."""
    get: Callable[[CameraProfile, CameraProfile], Any]
    """Its value in a profile, the first; of values that count from the profile as given, that is the second."""
    spread: Callable[[Any, Array], Any]
    """Its deviation, from its value and the deviations (k,) of the effect's steps."""


@dataclass(frozen=True, slots=True)
class Steps:
    """How a fit of tracked points moves an effect's values: by a vector of k steps, additive or in logarithms."""

    change: Callable[[CameraProfile, Array], CameraProfile]
    """The profile with steps (k,) added."""
    between: Callable[[CameraProfile, CameraProfile], Array]
    """The steps (k,) that lead from one profile to another."""
    quotient: tuple[float, ...]
    """(k,) step of the difference quotient."""
    limit: tuple[float, ...]
    """(k,) largest step in one iteration."""
    prior_std: tuple[float, ...]
    """(k,) of all steps together; inf: none."""
    believable: float
    """No phone is off by more: such steps stand in for something else."""
    starts: tuple[tuple[float, ...], ...] = ()
    """Steps to begin from, besides none."""


@dataclass(frozen=True, slots=True)
class Choice:
    """An effect whose value is a word."""

    words: tuple[str, ...]
    choose: Callable[[CameraProfile, str], CameraProfile]
    """The profile with this word."""


@dataclass(frozen=True, slots=True)
class Calibrated:
    """How ``virest calibrate`` prints, keeps and judges the value that an effect's steps are fitted to."""

    name: str
    """Of the value, as in ``estimates``."""
    read: Callable[[CameraProfile], float | list[float] | None]
    """None: not known, or counted from where it began."""
    keep: Callable[[CameraProfile, CameraProfile], CameraProfile]
    """The first profile with this value of the second."""
    max_std: float
    """Of the steps; a value known no better is not determined and stays where it was."""
    option: str = ""
    """Of ``--with``; empty: it is always fitted."""
    believable: float = np.inf
    """Held fixed: a larger change absorbs something else, such as a stabiliser or stamps of another meaning."""
    is_factor: bool = False
    """Steps are natural logarithms of a factor."""


@dataclass(frozen=True, slots=True)
class Effect:
    """One way in which a camera differs from its profile."""

    name: str
    """Of ``simulate --effect``, ``diagnose`` and ``extended.yaml``."""
    seen_in: str
    """The evidence that it is judged by."""
    parameters: tuple[Parameter, ...]
    place: str
    """Keys of the profile's file; empty: none, for restoring does not undo it."""
    in_words: str
    """What it is, for people."""
    sentence: str
    """What was found; {} is filled with the parameters."""
    steps: Steps | None = None
    """None: not fitted to points, or not by steps of a profile."""
    choice: Choice | None = None
    calibrated: Calibrated | None = None
    """None: no value of ``virest calibrate``."""
    applied: Callable[[CameraProfile], str] = lambda profile: ""
    """What restoring makes of it; empty: the profile does not have it, or states it as one of its plain values."""

    @property
    def in_points(self) -> bool:
        """Whether tracked points are fitted by steps or words of it."""
        return self.steps is not None or self.choice is not None

    def read(self, profile: CameraProfile, given: CameraProfile) -> dict[str, Any]:
        """Its parameters in a profile, counted from the one given."""
        return {parameter.name: parameter.get(profile, given) for parameter in self.parameters}

    def spread(self, values: dict[str, Any], std: Array) -> dict[str, Any]:
        """Deviations of its parameters from those of its steps (k,)."""
        return {parameter.name: parameter.spread(values[parameter.name], std) for parameter in self.parameters}
