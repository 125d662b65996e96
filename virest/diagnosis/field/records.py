"""What a search for fields hands on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from virest.camera.field import Field
from virest.camera.profile import CameraProfile
from virest.diagnosis.field.forms import FieldForm
from virest.inference.doubtful_log import Stretch
from virest.inference.track_fit import TrackFit


@dataclass(frozen=True, slots=True)
class FittedField:
    """A form that is in the model."""

    form: FieldForm
    rivals: tuple[str, ...]
    """Forms that this capture cannot tell from it."""
    p_value: float
    """For the whole set of forms."""
    stability: float | None
    """Part of the draws of blocks in which it, or a rival, is the best; None where it was not chosen among forms."""
    before_px: float
    """Held-out rms."""
    after_px: float
    fit: TrackFit
    """Of everything together."""

    @property
    def fields(self) -> tuple[Field, ...]:
        """With values and standard deviations."""
        part = self.fit.slices[self.form.name]
        deviations = self.form.filled(np.zeros(part.stop - part.start), self.fit.covariance[part, part])
        held = [self.form.held_in(self.fit.profile, field) for field in self.form.fields]
        return tuple(replace(own, std=field.std) for own, field in zip(held, deviations, strict=True))


@dataclass(frozen=True, slots=True)
class Distrusted:
    """Stretches of the inertial log that do not follow the pictures."""

    stretches: tuple[Stretch, ...]
    bridged: tuple[bool, ...]
    """Whether the points tell the rates there."""
    p_value: float | None
    """That points there lie no further off than elsewhere; None: there is no elsewhere."""
    before_px: float
    """Rms of the points of frames that reach into a stretch."""
    after_px: float
    """The same with rates told by other points of these frames."""
    noise_px: float
    """Rms of the points elsewhere."""
    profile: CameraProfile
    """With the bridges."""
