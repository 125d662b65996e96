"""Results of a diagnosis: causes with their sizes, their gains on held-out frames, and what remains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import field as default
from typing import Any

import numpy as np

from virest.camera.field import Field
from virest.camera.profile import CameraProfile
from virest.effects import records

CONSISTENT, EXPLAINED, UNEXPLAINED = "consistent", "explained", "unexplained"
GEOMETRY, PHOTOMETRY, BLUR, EDGES = records.GEOMETRY, records.PHOTOMETRY, records.BLUR, records.EDGES
"""Held-out quantities; EDGES is the rms of the mean edge profile, as a fraction of the step."""
JOINED = " + "
"""Separator between the names of two causes that enter together."""


@dataclass(frozen=True, slots=True)
class ParameterChange:
    """One profile value: nominal and estimated."""

    nominal: Any
    estimate: Any
    """A number, a list of numbers, or a word."""
    std: Any
    """Standard deviation(s); None for a word or a count, and where it is unknown."""


@dataclass(frozen=True, slots=True)
class HeldOutGain:
    """How well frames that took no part in the fit are predicted, without and with a cause."""

    quantity: str
    """``geometry_rms_px``, ``photometric_rms``, ``blur_rms_px`` or ``edge_profile_rms``."""
    before: float
    after: float
    noise: float | None
    """Measured without the model and its fit; None: unknown."""

    @classmethod
    def of_folds(cls, quantity: str, folds: Sequence[tuple[float, float, float]]) -> HeldOutGain:
        """Combine folds, each with its held-out rms (before, after, noise)."""
        before, after, noise = np.sqrt(np.mean(np.square(folds), axis=0)).tolist() if len(folds) else (0.0,) * 3
        return cls(quantity, before, after, noise)

    @property
    def gain(self) -> float | None:
        """1 − (after² − noise²) / (before² − noise²), in [0, 1]; with unknown noise a lower bound (noise = 0).

        None where ``before`` does not exceed the measured noise.
        """
        floor = (self.noise or 0.0) ** 2
        excess_before = self.before**2 - floor
        if excess_before <= 0:
            return None
        return min(max(1.0 - (self.after**2 - floor) / excess_before, 0.0), 1.0)


@dataclass(frozen=True, slots=True)
class Rival:
    """Another cause that explains the data equally well."""

    name: str
    held_out_after: float


@dataclass(frozen=True, slots=True)
class Finding:
    """One cause."""

    name: str
    """As in the contract's list of effects."""
    parameters: dict[str, ParameterChange]
    held_out: HeldOutGain
    rivals: tuple[Rival, ...]
    p_value: float | None
    """Probability of such a value, or such a consistent gain, by chance; None: not computed."""
    sentence: str
    """What it means, for people."""


@dataclass(frozen=True, slots=True)
class FieldFinding:
    """An unnamed effect, described along recorded covariates."""

    covariates: tuple[str, ...]
    kind: str
    """As of :mod:`virest.camera.field`, ``inertial_rows``, ``exposure_rows`` or ``exposure_gain``."""
    shape: str
    sentence: str
    """What it does, for people."""
    size: float | None
    """Largest value, in ``unit``; None: it has none."""
    unit: str
    std: float | None
    held_out: HeldOutGain
    p_value: float | None
    """For the whole set of tested forms; None: not available."""
    confounded: tuple[str, ...]
    """Forms over other covariates that this capture cannot distinguish from it."""
    stability: float | None
    """Fraction of resamples in which it, or one of these, is chosen again."""
    reasons: str
    """Likely reasons."""
    next: str
    """The measurement that would distinguish the reasons."""
    fields: tuple[Field, ...] = ()
    """As the extended profile holds them."""
    stretches_s: tuple[tuple[float, float], ...] = ()
    """(from, to) on the inertial clock where the log is not trusted."""


@dataclass(frozen=True, slots=True)
class Nominal:
    """How well the profile as given predicts the capture."""

    geometry_rms_px: float
    geometry_noise_px: float
    photometric_rms: float | None
    blur_rms_px: float | None
    tracks: int
    frames: int


@dataclass(frozen=True, slots=True)
class Remaining:
    """Residual structure that no named cause explains."""

    p_value: float | None
    """For the hypothesis of no structure; None: not computed (excluded image regions that move together)."""
    strongest_along: str
    """``row``, ``time``, ``radius``, ``rate``, ``brightness`` ..."""
    size: float
    """rms of the structure, in ``unit``."""
    limit: float
    """Smaller structure is not held against the model, however small ``p_value`` is: trackers and encoders leave it."""
    quantity: str
    significant: bool
    sentence: str = ""
    only_strays: bool = False
    """Whether only points that move on their own are left: the model holds for the rest of the scene."""

    @property
    def unit(self) -> str:
        """Of ``size`` and ``limit``."""
        return "px" if self.quantity.endswith("_px") else "grey levels"


@dataclass(frozen=True, slots=True)
class Rung:
    """One step of the ladder: what was tried and what entered."""

    entered: str | None
    """A cause, or two that gain only together; None: no candidate gained enough."""
    tried: dict[str, float]
    """Held-out rms with each candidate added."""
    before: float
    quantity: str

    def has(self, name: str) -> bool:
        """Whether a cause entered on this rung."""
        return self.entered is not None and name in self.entered.split(JOINED)


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The whole verdict on one capture."""

    verdict: str
    """``consistent``, ``explained`` or ``unexplained``."""
    nominal: Nominal
    causes: tuple[Finding, ...]
    """Strongest first."""
    unexplained: Remaining
    nominal_profile: CameraProfile
    """The given profile, with null values estimated."""
    extended_profile: CameraProfile
    """The profile with all causes applied."""
    ladder: tuple[Rung, ...] = ()
    residuals: dict[str, Any] = default(default_factory=dict)
    """For figures: ``before`` and ``after``, each a mapping of covariate names, ``x_px`` and ``y_px`` to arrays."""
    notes: tuple[str, ...] = ()
    """What was excluded or could not be judged, and why."""
    fields: tuple[FieldFinding, ...] = ()
    """Effects that no cause names, strongest first."""
