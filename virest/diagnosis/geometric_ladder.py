"""The ladder for what moves points: rung by rung the cause that best predicts stretches of time it was not fitted to.

On each rung every cause is fitted together with those already in; the most promising are then fitted on half of the
blocks of time and judged on the other half, both ways.  The best enters if the gain holds in the blocks (a t test) and
its value is significant against a deviation that includes tracking's own bias.  Then all are fitted together again, and
what is no longer significant leaves.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from virest.calibration.start_up import Schedule
from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.diagnosis.findings import GEOMETRY, Finding, HeldOutGain, ParameterChange, Rival, Rung
from virest.diagnosis.geometric_effects import GEOMETRIC_EFFECTS, GeometricEffect
from virest.diagnosis.geometric_evidence import (
    KNOWN_DEPTH_STD,
    Evidence,
    Model,
    base_scene,
    capped_rms,
    depth_of,
    distances,
    fit_model,
    free_scene,
    loss,
    relief_loss,
)
from virest.motion.scene_motion import InertialMotion
from virest.motion.shared_out import Each, one_by_one
from virest.motion.track_fit import Term, TrackFit
from virest.motion.track_model import TrackTable, ground, predict
from virest.motion.tracking_bias import bias_std

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
SCREEN_POINTS, JUDGE_POINTS, FINAL_POINTS = 1500, 3500, 7000
PROMISING = 4
MIN_T = 3.0
"""Least ratio of the blocks' mean gain to its standard error."""
MAX_P = 1e-5
"""Of the value being nought, for each of some twenty causes tried."""
SURE = 1e-12
MIN_GAIN = 0.004
"""Least part of the loss that a cause must take away on held-out blocks."""
LARGE_GAIN, LARGE_MIN_T = 0.05, 1.7
"""So large a gain need not be so even (one-sided 5 %): stretches of time tell more or less of a cause."""
RIVAL_T = 2.0
"""A cause rivals the best if the blocks do not prefer the best by this many standard errors."""
MAX_RUNGS = 5
CLOCKS = ("time_offset", "clock_skew")
PLAUSIBLE = {
    "time_offset": 2.0,
    "clock_skew": 0.03,
    "readout_time": 0.06,
    "gyro_bias": 0.5,
    "gyro_scale": 0.4,
    "imu_rotation": 1.0,
    "focal_length": 0.5,
    "focal_drift": 0.3,
    "radial_distortion": 0.8,
    "principal_point": 300.0,
    "exposure_time": 1.5,
}
"""Largest believable changes, in the units of the terms."""
CONSTANT_EXPOSURE = 0.03
"""Exposures within this part of their median are one."""
STABILISER_CUTOFF_HZ = (0.03, 15.0)


@dataclass(frozen=True, slots=True)
class FarClock:
    """Changes of a profile's clocks, beyond a fit's reach, at which the turns of pictures and gyroscope agree."""

    offset_s: float = 0.0
    """At the profile's own clock rate; 0: none."""
    skewed_offset_s: float = 0.0
    """At the rate changed by ``skew``."""
    skew: float = 0.0

    def start(self, name: str, profile: CameraProfile, offset_free: bool) -> CameraProfile | None:
        """Where a fit of this effect might begin; a skew moves the offset along if that is fitted too."""
        offset_s = profile.time_offset_s or 0.0
        if name == "time_offset" and self.offset_s:
            return replace(profile, time_offset_s=offset_s + self.offset_s)
        if name == "clock_skew" and self.skew:
            skewed_s = offset_s + self.skewed_offset_s if offset_free else offset_s
            return replace(profile, time_offset_s=skewed_s, clock_skew=profile.clock_skew + self.skew)
        return None


@dataclass(frozen=True, slots=True)
class Candidate:
    """One cause at one starting point: the model to begin from and the terms it adds."""

    name: str
    model: Model
    added: tuple[Term, ...]
    effect: GeometricEffect | None
    word: str = ""
    terms_with: int = 0


@dataclass(frozen=True, slots=True)
class Accepted:
    """A cause that is in the model."""

    name: str
    effect: GeometricEffect | None
    word: str
    before: float
    after: float
    p_value: float
    rivals: tuple[Rival, ...]


@dataclass(slots=True)
class GeometricVerdict:
    """Where the ladder ended."""

    model: Model
    fit: TrackFit
    table: TrackTable
    accepted: list[Accepted]
    rungs: list[Rung]
    nominal: Model
    nominal_fit: TrackFit
    nominal_table: TrackTable
    nominal_rms_px: float
    final_rms_px: float
    noise_px: float
    """What tracking alone makes, as an rms like the two above."""
    step_noise_px: float
    """Typical standard deviation of a tracked step, per coordinate."""
    astray: float = 0.0
    """Part of the points that lie in parts of the picture that move together on their own, and were left out."""
    notes: list[str] = field(default_factory=list)


def climb(
    evidence: Evidence,
    nominal: CameraProfile,
    null_terms: Sequence[Term],
    lags: Sequence[Schedule],
    far: FarClock | None = None,
    progress: Callable[[float], None] | None = None,
    max_rungs: int = MAX_RUNGS,
    each: Each = one_by_one,
) -> GeometricVerdict:
    """Climb from a profile; null_terms: unknown values, fitted on every rung and no cause.

    lags: the start-up schedules to try.  far: changes of the clocks at which turns were seen to agree.
    """
    say = progress or (lambda _: None)
    start = Model(nominal, None, tuple(null_terms))
    start = replace(start, scene=base_scene(evidence, nominal, evidence.table(start, SCREEN_POINTS)))
    model = _refitted(evidence, start, SCREEN_POINTS)[0]
    nominal_model = model
    accepted: list[Accepted] = []
    rungs: list[Rung] = []
    say(0.1)
    for number in range(max_rungs):
        best, rung = _rung(evidence, nominal, model, accepted, lags, far or FarClock(), each)
        rungs.append(rung)
        say(0.1 + 0.8 * (number + 1) / MAX_RUNGS)
        if best is None:
            break
        model, entered = best
        accepted.append(entered)
        model, _ = _refitted(evidence, model, JUDGE_POINTS)
        log.debug("rung %d: %s", number + 1, entered.name)
    return _conclude(evidence, nominal_model, model, accepted, rungs, nominal)


def _refitted(evidence: Evidence, model: Model, points: int) -> tuple[Model, TrackFit]:
    table = evidence.table(model, points)
    fitted = evidence.fit(model, model.terms, table)
    return replace(model, profile=fitted.profile, scene=fitted.scene), fitted


# ── one rung ─────────────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class _Judged:
    candidate: Candidate
    block_loss: Array
    """(blocks,) mean held-out loss a point."""
    pair_loss: Array
    """(pairs,) the same."""
    rms: float
    """Held-out, in units of the typical noise."""


def _rung(
    evidence: Evidence,
    nominal: CameraProfile,
    model: Model,
    accepted: list[Accepted],
    lags: Sequence[Schedule],
    far: FarClock,
    each: Each,
) -> tuple[tuple[Model, Accepted] | None, Rung]:
    tried = {entry.name for entry in accepted}
    candidates = _candidates(evidence, nominal, model, tried, lags, far)
    candidates = _worth_beginning(evidence, model, candidates)
    base, *others = _screened(evidence, [Candidate("", model, (), None), *candidates], each)
    screened = _best_of_each(others)
    promising = sorted(screened, key=lambda s: s.loss)[:PROMISING]
    promising = [entry for entry in promising if entry.loss < base.loss]
    scale = min([base.scale, *(entry.scale for entry in promising)])
    spread = (promising[0] if promising else base).depth_spread_per_m
    before, *judged = _judge(evidence, [base.candidate, *(p.candidate for p in promising)], scale, spread, each)
    table = {j.candidate.name: j.rms * evidence.typical_px for j in judged}
    nothing = Rung(None, table, before.rms * evidence.typical_px, GEOMETRY)
    for best in sorted(judged, key=lambda j: float(j.block_loss.mean())):
        gain = before.block_loss - best.block_loss
        if best.candidate.name == "frame_lag":
            gain = _lagging_gain(evidence, before, best)
        part = float(gain.mean() / before.block_loss.mean())
        if part < MIN_GAIN or _t(gain) < (MIN_T if part < LARGE_GAIN else LARGE_MIN_T):
            continue
        entered, p_value = _significant(evidence, best.candidate, model.profile)
        if entered is None:
            continue
        rivals = tuple(
            Rival(other.candidate.name, other.rms * evidence.typical_px)
            for other in judged
            if other is not best and _t(other.block_loss - best.block_loss) < RIVAL_T
            and (before.block_loss - other.block_loss).mean() > 0.5 * gain.mean()
        )  # fmt: skip
        done = Accepted(
            best.candidate.name, best.candidate.effect, best.candidate.word,
            before.rms * evidence.typical_px, best.rms * evidence.typical_px, p_value, rivals,
        )  # fmt: skip
        return (entered, done), replace(nothing, entered=best.candidate.name)
    return None, nothing


def _worth_beginning(evidence: Evidence, model: Model, candidates: list[Candidate]) -> list[Candidate]:
    """Without far starts of the clocks that are further off than where the model stands: a fit would only come back."""
    table = evidence.table(model, SCREEN_POINTS)
    here = _off_px(evidence, model, table)
    return [
        candidate
        for candidate in candidates
        if candidate.name not in CLOCKS
        or candidate.model.profile == model.profile
        or _off_px(evidence, candidate.model, table) < here
    ]


def _off_px(evidence: Evidence, model: Model, table: TrackTable) -> float:
    """Median distance of the points from where a model puts them."""
    known = ground(evidence.imu, model.profile, translation=isinstance(model.scene, InertialMotion))
    off = table.second_px - predict(known, table, model.scene).second_px
    return float(np.median(np.linalg.norm(off, axis=-1)))


def _candidates(
    evidence: Evidence,
    nominal: CameraProfile,
    model: Model,
    tried: set[str],
    lags: Sequence[Schedule],
    far: FarClock,
) -> list[Candidate]:
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
        if (far_off := far.start(effect.name, nominal, "time_offset" in in_terms)) is not None:
            clocks = replace(model.profile, time_offset_s=far_off.time_offset_s, clock_skew=far_off.clock_skew)
            found.append(Candidate(effect.name, replace(model, profile=clocks), (effect.term,), effect))
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
    assert effect.with_word is not None
    now = next(iter(effect.read(model.profile).values()))
    return [
        Candidate(effect.name, replace(model, profile=effect.with_word(model.profile, word)), (), effect, word)
        for word in effect.words
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


@dataclass(frozen=True, slots=True)
class _Screened:
    """A candidate with its model fitted to all blocks, with few points."""

    loss: float
    candidate: Candidate
    scale: float
    depth_spread_per_m: float


def _screened(evidence: Evidence, candidates: Sequence[Candidate], each: Each) -> list[_Screened]:
    tables = {
        lag: evidence.table(model, SCREEN_POINTS) for lag, model in {c.model.lag: c.model for c in candidates}.items()
    }
    calls = [(evidence.imu, tables[c.model.lag], c.model, (*c.model.terms, *c.added)) for c in candidates]
    found = each(_screen, calls)
    return [_Screened(s[0], replace(c, model=s[1]), s[2], s[3]) for c, s in zip(candidates, found, strict=True)]


def _screen(
    imu: ImuSamples, table: TrackTable, model: Model, terms: Sequence[Term]
) -> tuple[float, Model, float, float]:
    """Loss, fitted model, scale and spread of depths of one candidate."""
    fitted = fit_model(imu, model, terms, table)
    found = replace(model, profile=fitted.profile, scene=fitted.scene)
    return relief_loss(fitted), found, fitted.scale, fitted.depth_spread_per_m


def _best_of_each(screened: list[_Screened]) -> list[_Screened]:
    best: dict[str, _Screened] = {}
    for entry in screened:
        name = entry.candidate.name
        if name not in best or entry.loss < best[name].loss:
            best[name] = entry
    return list(best.values())


def _judge(
    evidence: Evidence, candidates: Sequence[Candidate], scale: float, depth_spread_per_m: float, each: Each
) -> list[_Judged]:
    """Fit on every other block, judge on those between, and the other way round."""
    tables = [evidence.table(candidate.model, JUDGE_POINTS) for candidate in candidates]
    calls = [
        (evidence.imu, table, c.model, (*c.model.terms, *c.added), evidence.block % 2 == fold, depth_spread_per_m)
        for c, table in zip(candidates, tables, strict=True)
        for fold in (0, 1)
    ]
    halves = each(_held_out, calls)
    judged = []
    for candidate, table, first, second in zip(candidates, tables, halves[::2], halves[1::2], strict=True):
        distance = np.where(evidence.block[table.pair] % 2 == 0, second, first)
        block = evidence.block[table.pair]
        mean = loss(distance, scale)
        by_pair = np.bincount(table.pair, mean) / np.maximum(np.bincount(table.pair), 1)
        by_block = np.bincount(block, mean) / np.maximum(np.bincount(block), 1)
        judged.append(_Judged(candidate, by_block, by_pair, capped_rms(distance)))
    return judged


def _held_out(
    imu: ImuSamples, table: TrackTable, model: Model, terms: Sequence[Term], use: Mask, depth_spread_per_m: float
) -> Array:
    """Distances (n,) of all points from a fit on the pairs in ``use`` (pairs,)."""
    fitted = fit_model(imu, model, terms, table.chosen(use[table.pair]))
    return distances(imu, fitted, table, depth_spread_per_m)


def _lagging_gain(evidence: Evidence, before: _Judged, after: _Judged) -> Array:
    """Gain of the pairs that a start-up schedule moves; nothing of it was fitted, so each pair is a judge."""
    last = after.candidate.model.profile.extensions.frame_lag_frames
    moved = np.array([pair.first <= last for pair in evidence.observed.pairs])
    both = min(len(before.pair_loss), len(after.pair_loss), len(moved))
    gain: Array = (before.pair_loss[:both] - after.pair_loss[:both])[moved[:both]]
    return gain


def _t(values: Array) -> float:
    """Mean over its standard error."""
    if len(values) < 3:
        return 0.0
    return float(values.mean() / max(values.std(ddof=1) / np.sqrt(len(values)), 1e-12))


def _significant(evidence: Evidence, candidate: Candidate, before: CameraProfile) -> tuple[Model | None, float]:
    """The model with the candidate in it, if its value is, and the probability that it is nought."""
    model = replace(candidate.model, terms=(*candidate.model.terms, *candidate.added))
    model, fitted = _refitted(evidence, model, JUDGE_POINTS)
    if candidate.name == "scene_depth":
        p_value = depth_p(fitted, evidence.table(model, JUDGE_POINTS), before.depth_m)
    elif candidate.effect is None or candidate.effect.term is None:
        p_value = SURE
    elif not is_plausible(candidate.effect, model.profile, total_change(candidate.effect, before, model.profile)):
        return None, 1.0
    else:
        p_value = p_of(fitted, candidate.effect, model.profile, before, evidence.typical_px)
    return (model if p_value < MAX_P else None), p_value


def depth_p(fitted: TrackFit, table: TrackTable, given_m: float | None) -> float:
    """Probability of so large a change of the inverse depth by chance."""
    depth_m, std = depth_of(fitted, table)
    given_m = given_m or np.inf
    nearer = 1 / depth_m - 1 / given_m
    certain = std / depth_m**2 if np.isinf(given_m) else np.hypot(std / depth_m**2, KNOWN_DEPTH_STD / given_m)
    return float(stats.chi2.sf((nearer / max(certain, 1e-9)) ** 2, 1))


def is_plausible(effect: GeometricEffect, found: CameraProfile, change: Array) -> bool:
    """Whether a phone can be like that: a cause beyond these bounds only stands in for another."""
    if effect.name == "stabilisation":
        low, high = STABILISER_CUTOFF_HZ
        extensions = found.extensions
        return 0 < extensions.stabilisation_fraction <= 1.1 and low < extensions.stabilisation_cutoff_hz < high
    return bool(np.all(np.abs(change) <= PLAUSIBLE[effect.name]))


def p_of(
    fitted: TrackFit, effect: GeometricEffect, found: CameraProfile, before: CameraProfile, noise_px: float
) -> float:
    """Probability of so large a change by chance: a chi-square of the change, deviations with tracking's own bias."""
    change = total_change(effect, before, found)
    floor = bias_std(fitted, effect.name, noise_px)
    part = fitted.slices[effect.name]
    covariance = fitted.covariance[part, part] + np.diag(floor**2)
    if effect.name == "stabilisation":
        return float(stats.chi2.sf(change[0] ** 2 / covariance[0, 0], 1))
    return float(stats.chi2.sf(change @ np.linalg.solve(covariance, change), len(change)))


# ── conclusions ──────────────────────────────────────────────────────────────────────────────────────────────────


def _conclude(
    evidence: Evidence,
    nominal_model: Model,
    model: Model,
    accepted: list[Accepted],
    rungs: list[Rung],
    nominal: CameraProfile,
) -> GeometricVerdict:
    """Fit everything together from the nominal profile on, and let go of what is no longer significant."""
    entered = len(accepted)
    while True:
        model, fitted = _refitted(evidence, model, FINAL_POINTS)
        table = evidence.table(model, FINAL_POINTS)
        weak = [
            entry
            for entry in accepted
            if _doubt(evidence, fitted, table, entry, model.profile, nominal_model.profile) > MAX_P
        ]
        if not weak:
            break
        log.debug("no longer significant: %s", [entry.name for entry in weak])
        accepted = [entry for entry in accepted if entry is not weak[0]]
        model = _without(model, nominal_model, weak[0])
    if len(accepted) < entered:
        accepted = [_rejudged(evidence, model, nominal_model, entry, fitted) for entry in accepted]
    nominal_table = evidence.table(nominal_model, FINAL_POINTS)
    nominal_fit = evidence.fit(nominal_model, nominal_model.terms, nominal_table)
    typical = evidence.typical_px
    before = capped_rms(nominal_fit.distance_at(fitted.depth_spread_per_m)) * typical
    return GeometricVerdict(
        model, fitted, table, accepted, rungs, nominal_model, nominal_fit, nominal_table,
        before, capped_rms(fitted.distance) * typical, evidence.noise_px(fitted), typical,
    )  # fmt: skip


def _rejudged(evidence: Evidence, model: Model, nominal: Model, entry: Accepted, fitted: TrackFit) -> Accepted:
    """The cause with what it gains held out beside those that stayed: rungs with a departed one told otherwise."""
    if entry.effect is None or entry.effect.term is None:
        return entry
    less, _ = _refitted(evidence, _without(model, nominal, entry), SCREEN_POINTS)
    without_and_with = [Candidate("", m, (), None) for m in (less, model)]
    before, after = _judge(evidence, without_and_with, fitted.scale, fitted.depth_spread_per_m, one_by_one)
    return replace(entry, before=before.rms * evidence.typical_px, after=after.rms * evidence.typical_px, rivals=())


def _doubt(
    evidence: Evidence, fitted: TrackFit, table: TrackTable, entry: Accepted, found: CameraProfile, given: CameraProfile
) -> float:
    """Probability that an accepted cause is nothing, now that the others are in; 0 for a word."""
    if entry.name == "scene_depth":
        return depth_p(fitted, table, given.depth_m)
    if entry.effect is None or entry.effect.term is None:
        return 0.0
    return p_of(fitted, entry.effect, found, given, evidence.typical_px)


def total_change(effect: GeometricEffect, nominal: CameraProfile, found: CameraProfile) -> Array:
    """Change (k,) of a term's values between two profiles."""
    lens, before = found.intrinsics, nominal.intrinsics
    assert lens is not None
    assert before is not None
    match effect.name:
        case "time_offset":
            return np.array([(found.time_offset_s or 0.0) - (nominal.time_offset_s or 0.0)])
        case "clock_skew":
            return np.array([found.clock_skew - nominal.clock_skew])
        case "readout_time":
            return np.array([found.shutter.readout_time_s - nominal.shutter.readout_time_s])
        case "gyro_bias":
            return np.array(found.gyro_bias_rad_s) - np.array(nominal.gyro_bias_rad_s)
        case "gyro_scale":
            return np.array([np.log(found.gyro_scale[0] / nominal.gyro_scale[0])])
        case "imu_rotation":
            return rotation_between(nominal, found)
        case "exposure_time":
            return np.array([np.log(found.shutter.exposure_scale / nominal.shutter.exposure_scale)])
        case "focal_length":
            return np.array([np.log(lens.fx_px / before.fx_px)])
        case "focal_drift":
            return np.array([found.extensions.focal_drift_per_s - nominal.extensions.focal_drift_per_s])
        case "radial_distortion":
            return np.array([effect.read(found)["k1"] - effect.read(nominal)["k1"]])
        case "principal_point":
            return np.array([lens.cx_px - before.cx_px, lens.cy_px - before.cy_px])
        case _:
            return np.array(
                [found.extensions.stabilisation_fraction - nominal.extensions.stabilisation_fraction, 0.0, 0.0, 0.0]
            )


def rotation_between(nominal: CameraProfile, found: CameraProfile) -> Array:
    """Rotation vector (3,) of R_found R_nominalᵀ."""
    matrix = found.rotation_cam_imu @ nominal.rotation_cam_imu.T
    skew = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]) / 2
    sine = float(np.linalg.norm(skew))
    return skew * (np.arcsin(min(sine, 1.0)) / sine if sine > 1e-12 else 1.0)


def _without(model: Model, nominal: Model, leaving: Accepted) -> Model:
    """The nominal model with the kept causes' terms, to be fitted anew from where they stand."""
    if leaving.name == "scene_depth":
        return replace(model, scene=nominal.scene)
    assert leaving.effect is not None
    assert leaving.effect.term is not None
    name = leaving.effect.term.name
    terms = tuple(term for term in model.terms if term.name != name)
    back = total_change(leaving.effect, nominal.profile, model.profile)
    profile = leaving.effect.term.change(model.profile, -back)
    return replace(model, profile=profile, terms=terms)


def findings_of(verdict: GeometricVerdict) -> list[Finding]:
    """The accepted causes as findings, strongest first."""
    found = []
    for entry in verdict.accepted:
        changes = changes_of(verdict, entry)
        held_out = HeldOutGain(GEOMETRY, entry.before, entry.after, min(verdict.noise_px, verdict.final_rms_px))
        sentence = _sentence(entry, changes)
        found.append(Finding(entry.name, changes, held_out, entry.rivals, entry.p_value, sentence))
    return sorted(found, key=lambda f: f.held_out.after**2 - f.held_out.before**2)


def changes_of(verdict: GeometricVerdict, entry: Accepted) -> dict[str, ParameterChange]:
    """Parameters of one cause, before and after."""
    nominal, found = verdict.nominal.profile, verdict.model.profile
    if entry.name == "scene_depth":
        depth_m, std = depth_of(verdict.fit, verdict.table)
        std = float(np.hypot(std, depth_m * bias_std(verdict.fit, "scene_depth", verdict.step_noise_px)[0]))
        return {"depth_m": ParameterChange(nominal.depth_m, depth_m, std)}
    if entry.name == "frame_lag":
        extensions = found.extensions
        return {
            "lag_s": ParameterChange(0.0, extensions.frame_lag_s, 0.3 * _period(verdict)),
            "frames": ParameterChange(0, extensions.frame_lag_frames, 0),
        }
    effect = entry.effect
    assert effect is not None
    if effect.term is None:
        return effect.changes(nominal, found, None)
    part = verdict.fit.slices[effect.term.name]
    floor = bias_std(verdict.fit, effect.name, verdict.step_noise_px)
    stds = np.sqrt(np.diag(verdict.fit.covariance)[part] + floor**2)
    changes = effect.changes(nominal, found, stds)
    match effect.name:
        case "imu_rotation":
            changes = {
                "rotation_rad": replace(changes["rotation_rad"], estimate=rotation_between(nominal, found).tolist())
            }
        case "focal_length":
            scale = float(np.exp(total_change(effect, nominal, found)[0]))
            changes = {"focal_scale": ParameterChange(1.0, scale, float(stds[0]) * scale)}
        case "principal_point":
            moved = total_change(effect, nominal, found).tolist()
            changes = {"offset_px": replace(changes["offset_px"], estimate=moved)}
    return changes


def _period(verdict: GeometricVerdict) -> float:
    stamps = np.unique(verdict.table.first_stamp_s)
    return float(np.median(np.diff(stamps))) if len(stamps) > 1 else 1 / 30


def _sentence(entry: Accepted, changes: dict[str, ParameterChange]) -> str:
    values = {name: shown(change.estimate) for name, change in changes.items()}
    if entry.name == "scene_depth":
        return f"the camera travels before a scene {values['depth_m']} m away, so points move by parallax"
    if entry.name == "frame_lag":
        return f"the first {values['frames']} frames show pictures up to {values['lag_s']} s later than their stamps"
    assert entry.effect is not None
    return entry.effect.sentence.format(**values)


def shown(value: Any) -> str:
    """A value as people read it."""
    if isinstance(value, list):
        return "(" + ", ".join(shown(v) for v in value) + ")"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
