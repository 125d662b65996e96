"""A term of a fit: one possible error of a profile."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.image_formation.point_changes import Moved, PointChanges
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
    slopes: Callable[[CameraProfile, TrackTable, Moved], Array] | None = None
    """All slopes (n, 2, k) at once, if that is faster, from a profile, the points, and a function that gives their
    displacement (n, 2) for another profile; None: by difference quotients."""

    def __len__(self) -> int:
        return len(self.quotient)


def slopes_of(terms: Sequence[Term], at: PointChanges) -> Array:
    """Change (n, 2, k) of predicted points per unit of each term's values."""
    profile, table = at.known.profile, at.table
    changed = [
        term.change(profile, quotient * np.eye(len(term))[k])
        for term in terms
        if term.slopes is None
        for k, quotient in enumerate(term.quotient)
    ]
    moved = iter(np.moveaxis(at.by_each(changed), -1, 0))
    found = [np.zeros((len(table), 2, 0))]
    for term in terms:
        if term.slopes is None:
            found += [(next(moved) / quotient)[..., None] for quotient in term.quotient]
        else:
            found.append(term.slopes(profile, table, at.by))
    return np.concatenate(found, axis=-1)
