"""Test the points in untrusted log intervals, and bridge those intervals with rates estimated from the points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from virest.camera.field import Field
from virest.camera.profile import CameraProfile
from virest.capture.records import Capture
from virest.diagnosis.field.records import Distrusted
from virest.diagnosis.field.stretches import bridging_form, rate_walk, touching
from virest.diagnosis.geometric_evidence import Evidence, Model, capped_rms, distances, fit_model, make_evidence
from virest.diagnosis.geometric_ladder import FINAL_POINTS, GeometricVerdict
from virest.image_formation.point_model import TrackTable, integrate_motion
from virest.inference.doubtful_log import Stretch, doubtful_stretches
from virest.inference.observed_tracks import ObservedTracks
from virest.inference.track_fit import start_scene
from virest.motion.scene_motion import InertialMotion

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
LEAST_PAIRS_LEFT = 20
"""Minimum number of frame pairs without a doubtful interval that the ladder needs."""
MAX_P = 1e-3
"""One-sided p value of the hypothesis that residuals in doubtful intervals are no larger than elsewhere."""
MAX_EXCESS_LEFT, MAX_RMS_RATIO = 0.2, 1.5
"""Accept a bridge if less than MAX_EXCESS_LEFT of the excess squared residual remains, or if the residual rms is below
MAX_RMS_RATIO times the noise."""
MAX_BLUR_STD_PX = 0.5
"""Reject a bridge whose rate uncertainty exceeds this in blur-path length; its frames are then not corrected."""


@dataclass(frozen=True, slots=True)
class Doubtful:
    """Doubtful log intervals and the frame pairs that they affect."""

    stretches: tuple[Stretch, ...]
    hit: Mask
    """(pairs,)."""

    @property
    def sets_aside(self) -> bool:
        """Whether enough unaffected pairs remain for the ladder."""
        return bool(self.hit.any() and (~self.hit).sum() >= LEAST_PAIRS_LEFT)


def doubtful_pairs(observed: ObservedTracks, capture: Capture, profile: CameraProfile) -> Doubtful:
    """Find the pairs that overlap log intervals which do not look like gyroscope data."""
    to_imu = (1 + profile.clock_skew, profile.time_offset_s or 0.0)
    found = doubtful_stretches(capture.imu)
    seen = [stretch for stretch in found if touching(observed, [stretch], to_imu).any()]
    return Doubtful(tuple(seen), touching(observed, seen, to_imu))


def with_bridges(found: GeometricVerdict, observed: ObservedTracks, doubtful: Doubtful, capture: Capture) -> None:
    """Test the excluded pairs, and add to the verdict what their points show about the doubtful intervals."""
    evidence = make_evidence(capture.imu, observed)
    model = replace(found.model, terms=())
    table = evidence.table(model, FINAL_POINTS)
    model = _with_scene(evidence, model, table)
    spread = found.fit.depth_spread_per_m
    before = distances(capture.imu, fit_model(capture.imu, model, (), table), table, spread)
    hit = doubtful.hit[table.pair]
    p_value = _larger_residual_p(before, table, doubtful.hit)
    if p_value > MAX_P:
        found.notes.append(
            f"{len(doubtful.stretches)} stretches of the inertial log look {doubtful.stretches[0].kind}; "
            "tracked points do not confirm it, and their frames were excluded from the fits"
        )
        return
    half = np.arange(len(table)) % 2 == 0
    held_out = np.zeros(len(table))
    for part in (half, ~half):
        bridged = _bridged(evidence, model, table.chosen(part & hit), doubtful.stretches, capture)
        held_out[~part] = distances(
            capture.imu, fit_model(capture.imu, bridged, (), table.chosen(part)), table, spread
        )[~part]
    typical = evidence.typical_px
    rest = capped_rms(before[~hit])
    to_imu = (1 + model.profile.clock_skew, model.profile.time_offset_s or 0.0)
    good = [
        s for s in doubtful.stretches if _holds(before, held_out, rest, touching(observed, [s], to_imu)[table.pair])
    ]
    bad = [s for s in doubtful.stretches if s not in good]
    trusted = ~touching(observed, bad, to_imu) if bad else np.ones(len(doubtful.hit), bool)
    if good:
        good = _take_over(found, evidence.observed.chosen(trusted), good, model, capture)
    untrusted = tuple((s.from_s, s.to_s) for s in doubtful.stretches)
    profile = replace(found.model.profile, imu_untrusted_s=untrusted, imu_untrusted_stamp_0_ns=capture.stamp_0_ns)
    found.model = replace(found.model, profile=profile)
    found.fields.append(
        Distrusted(
            doubtful.stretches,
            tuple(s in good for s in doubtful.stretches),
            p_value,
            _rms(before[hit]) * typical,
            _rms(held_out[hit]) * typical,
            rest * typical,
            profile,
        )
    )


def with_description(found: GeometricVerdict, evidence: Evidence, doubtful: Doubtful, capture: Capture) -> None:
    """Describe doubtful intervals that affect too many pairs to be excluded from the fits."""
    hit = doubtful.hit[found.table.pair]
    p_value = _larger_residual_p(found.fit.distance, found.table, doubtful.hit) if not hit.all() else None
    if p_value is not None and p_value > MAX_P:
        return
    untrusted = tuple((s.from_s, s.to_s) for s in doubtful.stretches)
    profile = replace(found.model.profile, imu_untrusted_s=untrusted, imu_untrusted_stamp_0_ns=capture.stamp_0_ns)
    found.model = replace(found.model, profile=profile)
    off_px, rest_px = (_rms(found.fit.distance[part]) * evidence.typical_px for part in (hit, ~hit))
    found.fields.append(
        Distrusted(doubtful.stretches, (False,) * len(doubtful.stretches), p_value, off_px, off_px, rest_px, profile)
    )


def _with_scene(evidence: Evidence, model: Model, table: TrackTable) -> Model:
    """The model with a scene for this table's windows."""
    scene = model.scene
    if not isinstance(scene, InertialMotion) or scene.windows == table.n_windows:
        return model
    known = integrate_motion(evidence.imu, model.profile, translation=True)
    depth = float(np.median(np.linalg.norm(scene.plane_per_m, axis=1)))
    return replace(model, scene=start_scene(evidence.imu, known, table, depth))


def _bridged(
    evidence: Evidence, model: Model, table: TrackTable, stretches: Sequence[Stretch], capture: Capture
) -> Model:
    """The model with rates in the intervals, fitted to the points of a table."""
    form = bridging_form(stretches, capture.stamp_0_ns, rate_walk(capture.imu))
    fitted = fit_model(evidence.imu, model, (form.term,), table)
    return replace(model, profile=fitted.profile)


def _take_over(
    found: GeometricVerdict, observed: ObservedTracks, stretches: Sequence[Stretch], model: Model, capture: Capture
) -> list[Stretch]:
    """Refit everything with the bridges to all pairs trusted then; return the intervals whose bridges are accurate."""
    evidence = make_evidence(capture.imu, observed)
    to_imu = (1 + model.profile.clock_skew, model.profile.time_offset_s or 0.0)
    table = evidence.table(model, FINAL_POINTS)
    bridged = _bridged(
        evidence, model, table.chosen(touching(observed, stretches, to_imu)[table.pair]), stretches, capture
    )
    form = bridging_form(stretches, capture.stamp_0_ns, rate_walk(capture.imu))
    whole = replace(_with_scene(evidence, bridged, table), terms=(*found.model.terms, form.term))
    fitted = fit_model(capture.imu, whole, whole.terms, table)
    part = fitted.slices[form.name]
    deviations = form.filled(np.zeros(part.stop - part.start), fitted.covariance[part, part])
    accurate = [_blur_std_px(fitted.profile, field, evidence.exposure_s) < MAX_BLUR_STD_PX for field in deviations]
    bridges = {field.knots: field for field in deviations}
    inaccurate = {field.knots for field, holds in zip(deviations, accurate, strict=True) if not holds}
    held = [
        replace(field, std=bridges[field.knots].std) if field.knots in bridges else field
        for field in fitted.profile.fields
        if field.knots not in inaccurate
    ]
    found.model = replace(whole, profile=fitted.profile.with_fields(held), scene=fitted.scene)
    found.fit, found.table, found.evidence = fitted, table, evidence
    found.final_rms_px = capped_rms(fitted.distance) * evidence.typical_px
    found.noise_px = evidence.noise_px(fitted)
    return [stretch for stretch, holds in zip(stretches, accurate, strict=True) if holds]


def _blur_std_px(profile: CameraProfile, bridge: Field, exposure_s: float) -> float:
    """Largest standard deviation of the blur-path length caused by a bridge, px."""
    lens = profile.intrinsics
    assert lens is not None
    std_rad_s = float(np.linalg.norm(bridge.std, axis=1).max())
    return std_rad_s * float(profile.shutter.true_exposure_s(exposure_s)) * lens.fx_px


def _holds(before: Array, after: Array, rest: float, inside: Mask) -> bool:
    """Whether bridging removes most of the excess residual of the points in an interval."""
    was, now = _rms(before[inside]), _rms(after[inside])
    return bool(now < MAX_RMS_RATIO * rest or now**2 - rest**2 < MAX_EXCESS_LEFT * (was**2 - rest**2))


def _rms(distance: Array) -> float:
    return float(np.sqrt(np.mean(distance**2) / 2)) if len(distance) else 0.0


def _larger_residual_p(distance: Array, table: TrackTable, hit: Mask) -> float:
    """p value of the affected pairs' residuals being no larger than the others': t test on log medians per pair.

    A rank test would ignore how far a few outlying pairs deviate.
    """
    numbers = np.unique(table.pair)
    medians = np.array([np.median(distance[table.pair == number]) for number in numbers])
    inside, size = hit[numbers], np.log(np.maximum(medians, np.finfo(float).tiny))
    return float(stats.ttest_ind(size[inside], size[~inside], alternative="greater").pvalue)
