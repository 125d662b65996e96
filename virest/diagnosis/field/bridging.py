"""Bridge untrusted log intervals with rates estimated from the points, and test the points inside them.

An interval turns everything after it against everything before: gravity, which is subtracted from the accelerations,
then seems to change its direction.  The ladder therefore climbs with bridges from its first rung, even though the pairs
that overlap an interval are excluded from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from virest.arrays import Array, Mask
from virest.camera.profile import CameraProfile
from virest.capture.records import Capture
from virest.diagnosis.cross_validation import JUDGE_POINTS
from virest.diagnosis.field.forms import FieldForm
from virest.diagnosis.field.records import Distrusted
from virest.diagnosis.field.stretches import bridging_form
from virest.diagnosis.geometric_evidence import Evidence, Model, capped_rms, fit_model, make_evidence
from virest.diagnosis.geometric_ladder import FINAL_POINTS, GeometricVerdict
from virest.image_formation.point_model import TrackTable, integrate_motion
from virest.inference.chance import chance_of_larger
from virest.inference.comparable_noise import noise_distances
from virest.inference.doubtful_log import CONTRADICTED, Stretch, doubtful_stretches
from virest.inference.log_bridges import touching
from virest.inference.observed_tracks import ObservedTracks
from virest.inference.track_fit import Term, TrackFit, for_table, start_scene
from virest.motion.scene_motion import InertialMotion

LEAST_PAIRS_LEFT = 20
"""Minimum number of frame pairs without a doubtful interval that the ladder needs."""
MAX_P = 1e-3
"""One-sided p value of the hypothesis that residuals in doubtful intervals are no larger than elsewhere."""
MAX_EXCESS_LEFT, MAX_RMS_RATIO = 0.2, 1.5
"""Accept a bridge if less than MAX_EXCESS_LEFT of the excess squared residual remains, or if the residual rms is below
MAX_RMS_RATIO times the noise."""


@dataclass(frozen=True, slots=True)
class Doubtful:
    """Doubtful log intervals and the frame pairs that they affect."""

    stretches: tuple[Stretch, ...]
    hit: Mask
    """(pairs,)."""

    def for_ladder(self, observed: ObservedTracks) -> ObservedTracks:
        """The unaffected pairs for the ladder; all pairs if fewer than LEAST_PAIRS_LEFT are unaffected."""
        return observed.chosen(~self.hit) if (~self.hit).sum() >= LEAST_PAIRS_LEFT else observed

    @staticmethod
    def over(stretches: Sequence[Stretch], observed: ObservedTracks, profile: CameraProfile) -> Doubtful:
        """Some intervals with the pairs that overlap them, by a profile's clocks."""
        return Doubtful(tuple(stretches), touching(observed, stretches, _to_imu(profile)))


def doubtful_pairs(observed: ObservedTracks, capture: Capture, profile: CameraProfile) -> Doubtful:
    """Find the pairs that overlap log intervals that do not look like gyroscope data and that no field bridges."""
    found = (s for s in doubtful_stretches(capture.imu) if not profile.bridges(s.from_s, s.to_s))
    seen = [stretch for stretch in found if touching(observed, [stretch], _to_imu(profile)).any()]
    return Doubtful.over(seen, observed, profile)


@dataclass(frozen=True, slots=True)
class Bridges:
    """Doubtful intervals with all pairs that see them, and the form of the rates there."""

    evidence: Evidence
    """All pairs."""
    doubtful: Doubtful
    form: FieldForm

    @staticmethod
    def over(doubtful: Doubtful, observed: ObservedTracks, capture: Capture, profile: CameraProfile) -> Bridges:
        """The bridges over some intervals; profile: its clocks are those of the intervals' pairs."""
        form = bridging_form(doubtful.stretches, capture.stamp_0_ns, capture.imu)
        return Bridges(make_evidence(capture.imu, observed, profile), doubtful, form)

    def without(self, model: Model) -> Model:
        """The model without bridges."""
        return replace(model, profile=self.form.removed_from(model.profile))

    def expected(self, model: Model) -> Model:
        """The model with bridges as expected from the log alone."""
        bare = self.without(model).profile
        return replace(model, profile=bare.with_fields([*bare.fields, *self.form.fields]))

    def fitted(self, model: Model, table: TrackTable) -> TrackFit:
        """Fit bridges, from the expected ones, beside a model's terms and scene; without covariances."""
        begun = self.expected(model)
        return fit_model(self.evidence.imu, begun, (*begun.terms, self.form.term), table, covariances=False)

    def refitted(self, model: Model) -> Model:
        """The model with bridges fitted to all pairs beside its terms and scene."""
        table = self.evidence.table(model, JUDGE_POINTS)
        return replace(model, profile=self.fitted(_with_scene(self.evidence, model, table), table).profile)

    def held_out(self, found: GeometricVerdict) -> HeldOutBridges:
        """Residuals with the bridges beside a verdict's model, on points that the bridges were not fitted to."""
        evidence, observed = self.evidence, self.evidence.observed
        table, spread = evidence.table(found.model, FINAL_POINTS), found.fit.depth_spread_per_m
        bare = self.without(_with_scene(evidence, replace(found.model, terms=()), table))
        before = evidence.distances(evidence.fit(bare, (), table), table, spread)
        half: Mask = np.asarray(np.arange(len(table)) % 2 == 0)
        after = np.zeros(len(table))
        for part in (half, ~half):
            fitted = self.fitted(bare, table.chosen(part))
            after[~part] = evidence.distances(fitted, table, spread)[~part]
        noise = noise_distances(observed, fitted)
        near = [touching(observed, [stretch], _to_imu(bare.profile)) for stretch in self.doubtful.stretches]
        return HeldOutBridges(self, bare, table, before, after, noise, np.array(near))

    def trimmed(self, model: Model, least_chi2: float) -> list[Stretch]:
        """The intervals, each from the second knot before those whose rates differ from 0 to the second after them.

        An error that begins at 0 between two knots is still too small to differ at the second of them.  least_chi2: of
        a knot's rates on the three axes, in their standard deviations.  Without a knot that differs an interval is
        dropped.
        """
        table = self.evidence.table(model, FINAL_POINTS)
        bare = self.without(_with_scene(self.evidence, replace(model, terms=()), table))
        fitted = fit_model(self.evidence.imu, bare, (self.form.term,), table)
        part = fitted.slices[self.form.name]
        found = []
        for stretch, field in zip(
            self.doubtful.stretches, self.form.filled(fitted.change[part], fitted.covariance[part, part]), strict=True
        ):
            rate, std = np.array(field.values)[1:-1], np.array(field.std)[1:-1]
            differing = 1 + np.flatnonzero(((rate / np.maximum(std, 1e-12)) ** 2).sum(axis=-1) > least_chi2)
            if len(differing):
                first, last = max(differing[0] - 2, 0), min(differing[-1] + 2, len(field.knots[0]) - 1)
                found.append(replace(stretch, from_s=field.knots[0][first], to_s=field.knots[0][last]))
        return found


def with_bridges(found: GeometricVerdict, bridges: Bridges, capture: Capture) -> None:
    """Test the pairs in the intervals, and add to the verdict what their points show about the intervals."""
    evidence, stretches = bridges.evidence, bridges.doubtful.stretches
    terms, tested = found.model.terms, bridges.held_out(found)
    bare = tested.bare
    confirmed = {kind: tested.p_value(kind) for kind in dict.fromkeys(stretch.kind for stretch in stretches)}
    denied = [kind for kind, p_value in confirmed.items() if p_value is not None and p_value > MAX_P]
    if denied:
        others = [stretch for stretch in stretches if stretch.kind not in denied]
        found.notes += [
            f"{sum(stretch.kind == kind for stretch in stretches)} stretches of the inertial log look {kind}; "
            "tracked points do not confirm it, and their frames were excluded from the fits"
            for kind in denied
        ]
        found.model = bridges.without(found.model)
        if others:
            doubtful = Doubtful.over(others, evidence.observed, bare.profile)
            with_bridges(found, Bridges.over(doubtful, evidence.observed, capture, bare.profile), capture)
            return
        rest = make_evidence(evidence.imu, bridges.doubtful.for_ladder(evidence.observed), bare.profile)
        _refit(found, rest, found.model, terms)
        return
    trusted: Mask = np.asarray(~tested.near[~tested.holds].any(axis=0))
    kept = evidence.observed.chosen(trusted) if trusted.sum() >= LEAST_PAIRS_LEFT else evidence.observed
    begun = bridges.expected(bare)
    _refit(found, make_evidence(evidence.imu, kept, bare.profile), begun, (*terms, bridges.form.term))
    profile, form = found.model.profile, bridges.form
    part_of = found.fit.slices[form.name]
    covariance = found.fit.covariance[part_of, part_of]
    std = form.filled(np.zeros(len(covariance)), covariance)
    fields = [replace(form.held_in(profile, own), std=own.std) for own in std]
    untrusted = tuple((s.from_s, s.to_s) for s in stretches)
    profile = replace(profile, imu_untrusted_s=untrusted, imu_untrusted_stamp_0_ns=capture.stamp_0_ns)
    found.model = replace(found.model, profile=profile)
    for kind, p_value in confirmed.items():
        of_kind = [k for k, stretch in enumerate(stretches) if stretch.kind == kind]
        found.fields.append(
            Distrusted(
                tuple(stretches[k] for k in of_kind),
                tuple(fields[k] for k in of_kind),
                tuple(bool(tested.holds[k]) for k in of_kind),
                p_value,
                *map(float, tested.rms_px(np.asarray(tested.near[of_kind].any(axis=0)))),
            )
        )


@dataclass(frozen=True, slots=True)
class HeldOutBridges:
    """Residuals of the points of all pairs without bridges, and with bridges fitted to the other half of the points."""

    bridges: Bridges
    bare: Model
    """The model without bridges or terms."""
    table: TrackTable
    before: Array
    """(n,) whitened distances without bridges."""
    after: Array
    """(n,) with bridges that these points took no part in."""
    noise: Array
    """(points,) of all tracked points, from a smooth flow."""
    near: Mask
    """(intervals, pairs): which pairs overlap an interval."""

    def rms_px(self, pairs: Mask) -> Array:
        """Rms (3,) over some pairs' points without bridges, with bridges, and of tracking noise."""
        observed = self.bridges.evidence.observed
        pair = np.repeat(np.arange(len(pairs)), [len(pair) for pair in observed.pairs])
        inside = pairs[self.table.pair]
        parts = self.before[inside], self.after[inside], self.noise[pairs[pair]]
        return self.bridges.evidence.typical_px * np.array([capped_rms(part) for part in parts])

    @property
    def holds(self) -> Mask:
        """Whether a bridge explains the points of its pairs, (intervals,)."""
        return np.array([_holds(*self.rms_px(pairs)) for pairs in self.near])

    @property
    def convicted(self) -> Mask:
        """Whether points (intervals,) differ more than those of all other pairs, and bridges remove this difference.

        A bridge does not move badly tracked points to where others of their pair are.
        """
        usual_px = self.rms_px(~self.bridges.doubtful.hit)[0]
        found = (self.rms_px(pairs) for pairs in self.near)
        return np.array([_convicted(before, after, usual_px) for before, after, _ in found])

    def p_value(self, kind: str) -> float | None:
        """Of residuals near the intervals of a kind being no larger than elsewhere; None without such points.

        If fewer than LEAST_PAIRS_LEFT pairs lie elsewhere, the residuals with bridges take their place.
        """
        stretches, elsewhere = self.bridges.doubtful.stretches, ~self.bridges.doubtful.hit
        if kind == CONTRADICTED:
            return min(stretch.p_value for stretch in stretches if stretch.p_value is not None)
        before, after = (pair_medians(d, self.table, self.near.shape[1]) for d in (self.before, self.after))
        near = np.asarray(self.near[[stretch.kind == kind for stretch in stretches]].any(axis=0))
        enough = (elsewhere & np.isfinite(before)).sum() >= LEAST_PAIRS_LEFT
        p_value = _larger_p(before[near], before[elsewhere] if enough else after[near])
        return p_value if np.isfinite(p_value) else None


def _to_imu(profile: CameraProfile) -> tuple[float, float]:
    return 1 + profile.clock_skew, profile.time_offset_s or 0.0


def _with_scene(evidence: Evidence, model: Model, table: TrackTable) -> Model:
    """The model with a scene for this table's pairs and windows."""
    scene = for_table(model.scene, table)
    if not isinstance(scene, InertialMotion) or scene.windows == table.n_windows:
        return replace(model, scene=scene)
    known = integrate_motion(evidence.imu, model.profile, translation=True)
    depth = float(np.median(np.linalg.norm(scene.plane_per_m, axis=1)))
    return replace(model, scene=start_scene(evidence.imu, known, table, depth))


def _refit(found: GeometricVerdict, evidence: Evidence, start: Model, terms: Sequence[Term]) -> None:
    """Refit a verdict from a model, with these terms, to other pairs."""
    table = evidence.table(start, FINAL_POINTS)
    start = replace(_with_scene(evidence, start, table), terms=tuple(terms))
    fitted = evidence.fit(start, start.terms, table)
    found.model = replace(start, profile=fitted.profile, scene=fitted.scene)
    found.fit, found.table, found.evidence = fitted, table, evidence
    found.final_rms_px = capped_rms(fitted.distance) * evidence.typical_px
    found.noise_px = evidence.noise_px(fitted)


def _holds(before: float, after: float, noise: float) -> bool:
    """Whether bridging leaves the points in an interval their noise, or removes most of their excess residual."""
    return after < MAX_RMS_RATIO * noise or removes_excess(before, after, noise)


def _convicted(before: float, after: float, usual: float) -> bool:
    """A log that is wrong leaves nothing but noise once the rate is free: anything more has another cause."""
    return before > MAX_RMS_RATIO * usual > after and removes_excess(before, after, usual)


def removes_excess(before: float, after: float, noise: float) -> bool:
    """Whether less than MAX_EXCESS_LEFT of an excess squared residual over the noise remains."""
    return after**2 - noise**2 < MAX_EXCESS_LEFT * (before**2 - noise**2)


def pair_medians(distance: Array, table: TrackTable, pairs: int) -> Array:
    """Median (pairs,) of the points' distances in each pair; nan without points."""
    medians = np.full(pairs, np.nan)
    for number in np.unique(table.pair):
        medians[number] = np.median(distance[table.pair == number])
    return medians


def _larger_p(medians: Array, others: Array) -> float:
    """p value of pairs' median residuals being no larger than other pairs': t test on their logarithms.

    A rank test would ignore how far a few outlying pairs deviate.  nan: a pair without points.
    """
    first, second = (np.log(np.maximum(m[np.isfinite(m)], np.finfo(float).tiny)) for m in (medians, others))
    return chance_of_larger(first, second)
