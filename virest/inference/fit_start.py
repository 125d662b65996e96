"""Where several fits of the same points begin, with what they have in common computed once.

A search fits many causes from one profile and motion: the integrated motion, the points predicted there, the slopes of
the terms that several fits share and the linear start of the motion are the same for all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.image_formation.point_model import (
    IntegratedMotion,
    Prediction,
    TrackTable,
    integrate_motion,
    with_profile,
)
from virest.inference.term import Term
from virest.motion.scene_motion import InertialMotion, Motion

Seen = tuple[Prediction, Motion | None]
"""Points predicted for a motion, and the motion with its directions estimated."""


@dataclass(frozen=True, eq=False)
class FitStart:
    """Points, and the profile and motion at which fits of them begin; results are kept by the objects' identity."""

    imu: ImuSamples
    table: TrackTable
    profile: CameraProfile
    scene: Motion | None = None
    integrated: IntegratedMotion | None = None
    """Of a similar profile, if known."""
    _seen: dict[int, tuple[Motion | None, Seen]] = field(default_factory=dict, init=False, repr=False)
    _slopes: dict[tuple[int, int], tuple[Term, Motion | None, Array]] = field(
        default_factory=dict, init=False, repr=False
    )
    _moving: list[InertialMotion] = field(default_factory=list, init=False, repr=False)

    def __reduce__(self) -> tuple[type[FitStart], tuple[Any, ...]]:
        """Without the results: in another process the objects have other identities."""
        return FitStart, (self.imu, self.table, self.profile, self.scene, self.integrated)

    @cached_property
    def known(self) -> IntegratedMotion:
        """The inertial samples integrated with the profile."""
        inertial, known = isinstance(self.scene, InertialMotion), self.integrated
        if known is None or (inertial and known.displacement is None):
            known = integrate_motion(self.imu, self.profile, translation=inertial)
        return with_profile(known, self.imu, self.profile)

    def seen(self, scene: Motion | None, compute: Callable[[], Seen]) -> Seen:
        """The points as predicted for a motion."""
        if id(scene) not in self._seen:
            self._seen[id(scene)] = scene, compute()
        return self._seen[id(scene)][1]

    def slopes(self, term: Term, scene: Motion | None, compute: Callable[[], Array]) -> Array:
        """(n, 2, k) change of the points predicted for a motion per unit of a term's values."""
        key = id(term), id(scene)
        if key not in self._slopes:
            self._slopes[key] = term, scene, compute()
        return self._slopes[key][2]

    def moving(self, compute: Callable[[], InertialMotion]) -> InertialMotion:
        """The linear start of the motion."""
        if not self._moving:
            self._moving.append(compute())
        return self._moving[0]
