"""A term of a fit: one possible error of a profile."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.image_formation.point_model import TrackTable


@dataclass(frozen=True, slots=True)
class Term:
    """One possible error of a profile, changed by a vector of steps."""

    name: str
    change: Callable[[CameraProfile, Array], CameraProfile]
    """The profile with these values (k,) added to its own."""
    quotient: tuple[float, ...]
    """(k,) step of the difference quotient; its length is the number of values."""
    limit: tuple[float, ...]
    """(k,) largest change in one iteration."""
    prior_std: tuple[float, ...]
    """(k,) prior standard deviation of the total change from the starting profile; inf: no prior."""
    slopes: Callable[[CameraProfile, TrackTable, Callable[[CameraProfile], Array]], Array] | None = None
    """All slopes (n, 2, k) at once, if that is faster, from a profile, the points, and a function that gives their
    displacement (n, 2) for another profile; None: by difference quotients."""

    def __len__(self) -> int:
        return len(self.quotient)


def slopes_of(
    term: Term, profile: CameraProfile, table: TrackTable, moved_by: Callable[[CameraProfile], Array]
) -> Array:
    """Change (n, 2, k) of predicted points per unit of a term's values; moved_by: displacement for another profile."""
    if term.slopes is not None:
        return term.slopes(profile, table, moved_by)
    columns = []
    for k, quotient in enumerate(term.quotient):
        step = np.zeros(len(term))
        step[k] = quotient
        columns.append(moved_by(term.change(profile, step)) / quotient)
    return np.stack(columns, axis=-1) if columns else np.zeros((len(table), 2, 0))
