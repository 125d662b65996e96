"""Causes of moving points at the places where their fits may begin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile
from virest.diagnosis.geometric_effects import GEOMETRIC_EFFECTS, GeometricEffect
from virest.diagnosis.geometric_evidence import Evidence, Model, free_scene
from virest.image_formation.point_model import TrackTable, ground, predict
from virest.inference.recorder_lag import Schedule
from virest.inference.track_fit import Term
from virest.motion.scene_motion import InertialMotion

Array = NDArray[np.float64]
SCREEN_POINTS = 1500
"""Points that a first look at a cause is fitted to."""
CLOCKS = ("time_offset", "clock_skew")
FURTHER_OFF = 1.1
"""A far start of the clocks is tried unless points are off there by more than this factor."""
CONSTANT_EXPOSURE = 0.03
"""Exposures within this part of their median are one."""


@dataclass(frozen=True, slots=True)
class FarStart:
    """Changes of a profile, beyond a fit's reach, at which the turns of pictures and gyroscope agree."""

    offset_s: float = 0.0
    """At the profile's own clock rate; 0: none."""
    skewed_offset_s: float = 0.0
    """At the rate changed by ``skew``."""
    skew: float = 0.0
    axes: tuple[tuple[float, ...], ...] | None = None
    """Rotation of the sensor; None: the profile's own will do."""

    def start(self, name: str, profile: CameraProfile, model: CameraProfile, offset_free: bool) -> CameraProfile | None:
        """A model's profile where a fit of this effect might begin, counted from the given one.

        A skew moves the offset along if that is fitted too.
        """
        if name == "imu_rotation" and self.axes is not None:
            return replace(model, r_cam_imu=self.axes)
        offset_s = profile.time_offset_s or 0.0
        if name == "time_offset" and self.offset_s:
            return replace(model, time_offset_s=offset_s + self.offset_s, clock_skew=profile.clock_skew)
        if name == "clock_skew" and self.skew:
            skewed_s = offset_s + self.skewed_offset_s if offset_free else offset_s
            return replace(model, time_offset_s=skewed_s, clock_skew=profile.clock_skew + self.skew)
        return None


@dataclass(frozen=True, slots=True)
class Candidate:
    """One cause at one starting point: the model to begin from and the terms it adds."""

    name: str
    model: Model
    added: tuple[Term, ...]
    effect: GeometricEffect | None
    word: str = ""


def worth_beginning(evidence: Evidence, model: Model, candidates: list[Candidate]) -> list[Candidate]:
    """Without far starts of the clocks that are well further off than where the model stands: a fit would come back.

    Those a little further off stay, for all else that is fitted was settled where the model stands.
    """
    table = evidence.table(model, SCREEN_POINTS)
    here = _off_px(evidence, model, table)
    return [
        candidate
        for candidate in candidates
        if candidate.name not in CLOCKS
        or candidate.model.profile == model.profile
        or _off_px(evidence, candidate.model, table) < FURTHER_OFF * here
    ]


def _off_px(evidence: Evidence, model: Model, table: TrackTable) -> float:
    """Median distance of the points from where a model puts them."""
    known = ground(evidence.imu, model.profile, translation=isinstance(model.scene, InertialMotion))
    off = table.second_px - predict(known, table, model.scene).second_px
    return float(np.median(np.linalg.norm(off, axis=-1)))


def candidates_of(
    evidence: Evidence,
    nominal: CameraProfile,
    model: Model,
    tried: set[str],
    lags: Sequence[Schedule],
    far: FarStart,
) -> list[Candidate]:
    """All causes that are not in a model yet, each at all places where its fit may begin.

    lags: the start-up schedules to try.  far: changes at which turns were seen to agree.
    """
    in_terms = {term.name for term in model.terms}
    found: list[Candidate] = []
    for effect in GEOMETRIC_EFFECTS:
        if effect.name in tried or effect.name in in_terms or not _tells(evidence, effect):
            continue
        if effect.term is None:
            found += _words(effect, model)
            continue
        for values in (None, *effect.starts):
            profile = model.profile if values is None else effect.term.change(model.profile, np.array(values))
            found.append(Candidate(effect.name, replace(model, profile=profile), (effect.term,), effect))
        begun = far.start(effect.name, nominal, model.profile, "time_offset" in in_terms)
        if begun is not None:
            found.append(Candidate(effect.name, replace(model, profile=begun), (effect.term,), effect))
    found += _depths(evidence, model, tried)
    if "frame_lag" not in tried:
        found += [_lagging(model, *lag) for lag in lags]
    return found


def _tells(evidence: Evidence, effect: GeometricEffect) -> bool:
    """Whether points can tell this cause: an exposure's length only by its changes, otherwise it is an offset."""
    return effect.name != "exposure_time" or varies(evidence.observed.exposure_s)


def varies(exposure_s: Array) -> bool:
    """Whether logged exposures (n,) differ enough to move rows by different times."""
    middle = float(np.median(exposure_s))
    return middle > 0 and float(np.ptp(exposure_s)) >= CONSTANT_EXPOSURE * middle


def _words(effect: GeometricEffect, model: Model) -> list[Candidate]:
    choice, profile = effect.effect.choice, model.profile
    assert choice is not None
    now = next(iter(effect.effect.read(profile, profile).values()))
    return [
        Candidate(effect.name, replace(model, profile=choice.choose(profile, word)), (), effect, word)
        for word in choice.words
        if word != now
    ]


def _depths(evidence: Evidence, model: Model, tried: set[str]) -> list[Candidate]:
    depth_m = model.profile.depth_m
    if "scene_depth" in tried or depth_m is None:
        return []
    scene = free_scene(evidence, model.profile, evidence.table(model, SCREEN_POINTS))
    if scene is None:
        return []
    return [Candidate("scene_depth", replace(model, scene=scene), (), None)]


def _lagging(model: Model, lag_s: float, frames: int, by_frame: tuple[float, ...]) -> Candidate:
    extensions = replace(model.profile.extensions, frame_lag_s=lag_s, frame_lag_frames=frames)
    return Candidate(
        "frame_lag", replace(model, profile=replace(model.profile, extensions=extensions), lag=by_frame), (), None
    )
