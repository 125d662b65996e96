"""A term: one thing that may be wrong with a profile, as fits change it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile
from virest.image_formation.point_model import TrackTable

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Term:
    """One thing that may be wrong with a profile: how a vector of steps changes it."""

    name: str
    change: Callable[[CameraProfile, Array], CameraProfile]
    """The profile with these values (k,) added to its own."""
    quotient: tuple[float, ...]
    """(k,) step of the difference quotient; also tells how many values there are."""
    limit: tuple[float, ...]
    """(k,) largest change in one iteration."""
    prior_std: tuple[float, ...]
    """(k,) of the whole change about the starting profile; inf: none."""
    slopes: Callable[[CameraProfile, TrackTable, Callable[[CameraProfile], Array]], Array] | None = None
    """Of a profile, the points, and by how much (n, 2) another profile moves them: (n, 2, k) all slopes at once, where
    that is quicker; None: quotient by quotient."""

    def __len__(self) -> int:
        return len(self.quotient)


def slopes_of(
    term: Term, profile: CameraProfile, table: TrackTable, moved_by: Callable[[CameraProfile], Array]
) -> Array:
    """Change (n, 2, k) of the predicted points per unit of a term's values; moved_by: of another profile."""
    if term.slopes is not None:
        return term.slopes(profile, table, moved_by)
    columns = []
    for k, quotient in enumerate(term.quotient):
        step = np.zeros(len(term))
        step[k] = quotient
        columns.append(moved_by(term.change(profile, step)) / quotient)
    return np.stack(columns, axis=-1) if columns else np.zeros((len(table), 2, 0))
