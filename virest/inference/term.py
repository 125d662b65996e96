"""A term: one thing that may be wrong with a profile, as fits change it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile

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

    def __len__(self) -> int:
        return len(self.quotient)
