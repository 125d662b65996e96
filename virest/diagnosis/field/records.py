"""Results of the search for fields."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from virest.camera.field import Field
from virest.diagnosis.field.forms import FieldForm
from virest.inference.doubtful_log import CLIPPED, Stretch
from virest.inference.track_fit import TrackFit


@dataclass(frozen=True, slots=True)
class FittedField:
    """A form that is in the model."""

    form: FieldForm
    rivals: tuple[str, ...]
    """Forms that this capture cannot distinguish from it."""
    p_value: float
    """For the whole set of forms."""
    stability: float | None
    """Fraction of block resamples in which it, or a rival, is the best; None where it was not chosen among forms."""
    before_px: float
    """Held-out rms."""
    after_px: float
    fit: TrackFit
    """Joint fit of all terms."""

    @property
    def fields(self) -> tuple[Field, ...]:
        """With values and standard deviations."""
        part = self.fit.slices[self.form.name]
        deviations = self.form.filled(np.zeros(part.stop - part.start), self.fit.covariance[part, part])
        held = [self.form.held_in(self.fit.profile, field) for field in self.form.fields]
        return tuple(replace(own, std=field.std) for own, field in zip(held, deviations, strict=True))


@dataclass(frozen=True, slots=True)
class Distrusted:
    """Intervals of the inertial log that do not follow the frames."""

    stretches: tuple[Stretch, ...]
    bridges: tuple[Field, ...]
    """Rates there, estimated from the points, with standard deviations."""
    usable: tuple[bool, ...]
    """Whether these rates explain the points."""
    p_value: float | None
    """For the hypothesis that residuals there are no larger than elsewhere; None: no points tell."""
    before_px: float
    """Residual rms of the points of affected pairs."""
    after_px: float
    """The same with rates estimated from the other points of these pairs."""
    noise_px: float
    """The same due to tracking noise alone."""

    @property
    def withheld(self) -> tuple[Field, ...]:
        """Bridges that join the motion on both sides of their interval, but do not explain the points inside."""
        return tuple(field for field, usable in zip(self.bridges, self.usable, strict=True) if not usable)

    @property
    def better_than_none(self) -> tuple[tuple[float, float], ...]:
        """Intervals at the limit without a usable bridge: readings too small, but nearer to the truth than 0."""
        pairs = zip(self.stretches, self.usable, strict=True)
        return tuple((s.from_s, s.to_s) for s, usable in pairs if s.kind == CLIPPED and not usable)
