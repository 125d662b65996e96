"""Geometric causes and the starting points of their fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.diagnosis.geometric_effects import GEOMETRIC_EFFECTS, GeometricEffect
from virest.diagnosis.geometric_evidence import Evidence, Model, base_scene, free_scene
from virest.effects.table import is_sought
from virest.image_formation.point_model import TrackTable, integrate_motion, predict
from virest.inference.profile_terms import STABILISATION
from virest.inference.recorder_lag import Schedule
from virest.inference.stabiliser_fit import stabiliser_starts
from virest.inference.track_fit import Term
from virest.motion.scene_motion import InertialMotion

SCREEN_POINTS = 1500
"""Points used to screen a cause."""
CLOCKS = ("time_offset", "clock_skew")
MAX_START_RESIDUAL_RATIO = 1.1
"""Skip a far clock start when its median residual exceeds the current one by this factor."""
CONSTANT_EXPOSURE = 0.03
"""Exposures whose range is below this fraction of their median are constant."""


@dataclass(frozen=True, slots=True)
class FarStart:
    """Profile changes beyond the reach of a fit at which frame rotations and gyroscope agree."""

    offset_s: float = 0.0
    """At the profile's own clock rate; 0: none."""
    skewed_offset_s: float = 0.0
    """At the rate changed by ``skew``."""
    skew: float = 0.0
    axes: tuple[tuple[float, ...], ...] | None = None
    """Rotation of the sensor; None: keep the profile's."""

    def start(self, name: str, profile: CameraProfile, model: CameraProfile, offset_free: bool) -> CameraProfile | None:
        """A model's profile at the far start of an effect's fit, relative to ``profile``.

        A skew also changes the offset if that is fitted too.
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
    """One cause at one starting point: the initial model and the terms it adds."""

    name: str
    model: Model
    added: tuple[Term, ...]
    effect: GeometricEffect | None
    word: str = ""


def worth_beginning(evidence: Evidence, model: Model, candidates: list[Candidate]) -> list[Candidate]:
    """Drop far clock starts with clearly larger residuals than the current model, to which a fit would return.

    Slightly worse starts are kept, because the other parameters were fitted at the current model.
    """
    table = evidence.table(model, SCREEN_POINTS)
    here = _median_residual_px(evidence, model, table)
    return [
        candidate
        for candidate in candidates
        if candidate.name not in CLOCKS
        or candidate.model.profile == model.profile
        or _median_residual_px(evidence, candidate.model, table) < MAX_START_RESIDUAL_RATIO * here
    ]


def _median_residual_px(evidence: Evidence, model: Model, table: TrackTable) -> float:
    """Median residual of the points under a model, px."""
    known = integrate_motion(evidence.imu, model.profile, translation=isinstance(model.scene, InertialMotion))
    residual_px = table.second_px - predict(known, table, model.scene).second_px
    return float(np.median(np.linalg.norm(residual_px, axis=-1)))


def candidates_of(
    evidence: Evidence, nominal: CameraProfile, model: Model, tried: set[str], lags: Sequence[Schedule], far: FarStart
) -> list[Candidate]:
    """All causes that are not in the model yet, each at all its starting points.

    lags: the start-up schedules to try.  far: changes at which the rotations agree.
    """
    in_terms = {term.name for term in model.terms}
    found: list[Candidate] = []
    for effect in GEOMETRIC_EFFECTS:
        # a constant exposure is indistinguishable from an offset
        unknowable = effect.name == "exposure_time" and not varies(evidence.observed.exposure_s)
        if effect.name in tried or effect.name in in_terms or unknowable:
            continue
        if not is_sought(effect.name, tried | in_terms, nominal):
            continue
        if effect.term is None:
            found += _word_candidates(effect, model)
            continue
        for profile in (model.profile, *_starts(evidence, model, effect, effect.term)):
            found.append(Candidate(effect.name, replace(model, profile=profile), (effect.term,), effect))
        far_start = far.start(effect.name, nominal, model.profile, "time_offset" in in_terms)
        if far_start is not None:
            started = replace(model, profile=far_start)
            if far_start.r_cam_imu != model.profile.r_cam_imu and model.scene is not None:
                # a scene in front of the camera with the other axes: a fit would not turn the old one that far
                table = evidence.table(started, SCREEN_POINTS)
                started = replace(started, scene=base_scene(evidence, far_start, table))
            found.append(Candidate(effect.name, started, (effect.term,), effect))
    found += _depth_candidates(evidence, model, tried)
    if "frame_lag" not in tried:
        found += [_lag_candidate(model, *lag) for lag in lags]
    return found


def _starts(evidence: Evidence, model: Model, effect: GeometricEffect, term: Term) -> list[CameraProfile]:
    """Profiles at which fits of an effect begin, besides the model's."""
    if term is not STABILISATION:
        return [term.change(model.profile, np.array(values)) for values in effect.starts]
    return stabiliser_starts(evidence.start(model, SCREEN_POINTS, lambda: evidence.table(model, SCREEN_POINTS)))


def varies(exposure_s: Array) -> bool:
    """Whether logged exposures (n,) differ enough to move rows by different times."""
    middle = float(np.median(exposure_s))
    return middle > 0 and float(np.ptp(exposure_s)) >= CONSTANT_EXPOSURE * middle


def _word_candidates(effect: GeometricEffect, model: Model) -> list[Candidate]:
    choice, profile = effect.effect.choice, model.profile
    assert choice is not None
    now = next(iter(effect.effect.read(profile, profile).values()))
    return [
        Candidate(effect.name, replace(model, profile=choice.choose(profile, word)), (), effect, word)
        for word in choice.words
        if word != now
    ]


def _depth_candidates(evidence: Evidence, model: Model, tried: set[str]) -> list[Candidate]:
    depth_m = model.profile.depth_m
    if "scene_depth" in tried or depth_m is None:
        return []
    scene = free_scene(evidence, model.profile, evidence.table(model, SCREEN_POINTS))
    if scene is None:
        return []
    return [Candidate("scene_depth", replace(model, scene=scene), (), None)]


def _lag_candidate(model: Model, lag_s: float, frames: int, by_frame: tuple[float, ...]) -> Candidate:
    profile = model.profile.with_extensions(frame_lag_s=lag_s, frame_lag_frames=frames)
    return Candidate("frame_lag", replace(model, profile=profile, lag=by_frame), (), None)
