"""The geometric ladder's end: the accepted causes, the model with them, and its fits."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from virest.arrays import Array
from virest.diagnosis.findings import Rival, Rung
from virest.diagnosis.geometric_effects import GeometricEffect
from virest.diagnosis.geometric_evidence import Evidence, Model
from virest.image_formation.point_model import TrackTable
from virest.inference.track_fit import TrackFit

FINAL_POINTS = 7000
"""Points of the last fit, which reports the values: as many as `calibrate` uses."""


@dataclass(frozen=True, slots=True)
class Accepted:
    """A cause that is in the model."""

    name: str
    effect: GeometricEffect | None
    word: str
    before: float
    after: float
    p_value: float
    rivals: tuple[Rival, ...]


@dataclass(slots=True)
class GeometricVerdict:
    """The geometric ladder's end."""

    model: Model
    fit: TrackFit
    table: TrackTable
    accepted: list[Accepted]
    rungs: list[Rung]
    nominal: Model
    nominal_fit: TrackFit
    nominal_table: TrackTable
    nominal_rms_px: float
    final_rms_px: float
    noise_px: float
    """Residual rms due to tracking noise alone, comparable to the two above."""
    step_noise_px: float
    """Typical standard deviation of a tracked step, per coordinate."""
    rival: GeometricVerdict | None = None
    """Another end of the ladder that held-out points cannot distinguish from this one; None: there is none."""
    undoubted: GeometricVerdict | None = None
    """The ladder's end before it bridged intervals that only the points contradict; None: it bridges none."""
    lag_std_s: float | None = None
    """Standard deviation of a start-up lag; None without one."""
    independent_share: float = 0.0
    """Fraction of the points in image regions that move independently; these points were excluded."""
    notes: list[str] = field(default_factory=list)
    fields: list[Any] = field(default_factory=list)
    """Unknown effects found in addition to the causes: :class:`virest.diagnosis.field.records.FittedField`."""
    evidence: Evidence | None = None
    """The pairs that the model was fitted to."""
    left_open: dict[str, Array] = field(default_factory=dict)
    """By cause: variance (k,) of its values due to further causes, where residuals exceed the noise."""
