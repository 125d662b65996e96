"""Causes that move points, from the table of effects, each with its fit term.

A cause with a word as value (a direction, a timestamp reference) is tried for each word.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.diagnosis.findings import ParameterChange
from virest.effects.records import Effect
from virest.effects.table import EFFECTS
from virest.inference.profile_terms import PLAIN_READOUT, TERMS
from virest.inference.track_fit import Term

__all__ = ["GEOMETRIC_EFFECTS", "PLAIN_READOUT", "GeometricEffect"]


@dataclass(frozen=True, slots=True)
class GeometricEffect:
    """One cause."""

    effect: Effect
    term: Term | None
    """None: no continuous parameter (a word)."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle by name, since every process has the table."""
        return geometric_effect, (self.name,)

    @property
    def name(self) -> str:
        """Name in the table."""
        return self.effect.name

    @property
    def starts(self) -> tuple[tuple[float, ...], ...]:
        """Starting changes of the term's values, besides 0."""
        return () if self.effect.steps is None else self.effect.steps.starts

    def total_change(self, nominal: CameraProfile, found: CameraProfile) -> Array:
        """Change (k,) of the term's values between two profiles."""
        assert self.effect.steps is not None
        return self.effect.steps.between(nominal, found)

    def changes(self, nominal: CameraProfile, found: CameraProfile, std: Array | None) -> dict[str, ParameterChange]:
        """The parameters before and after, without those that have no value; deviations from those (k,) of the term."""
        before, after = (self.effect.read(profile, nominal) for profile in (nominal, found))
        spread = {} if std is None else self.effect.spread(after, std)
        held = [name for name in after if before[name] is not None or after[name] is not None]
        return {name: ParameterChange(before[name], after[name], spread.get(name)) for name in held}


GEOMETRIC_EFFECTS = tuple(
    GeometricEffect(effect, TERMS.get(effect.name)) for effect in EFFECTS.values() if effect.in_points
)


def geometric_effect(name: str) -> GeometricEffect:
    """The cause with this name; KeyError if there is none."""
    return _BY_NAME[name]


_BY_NAME = {effect.name: effect for effect in GEOMETRIC_EFFECTS}
