"""The ladders for brightness and blur, climbed once the geometric causes are in the profile.

Brightness of patches seen in many frames gives curve, black level, vignetting, flicker and gain.  At constant
exposure × ISO the curve shows only in how blur mixes light.  Blur of edges and spectra gives exposure and defocus.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from virest.arrays import Array, Picture
from virest.camera.profile import CameraProfile
from virest.capture.records import Capture, Frame
from virest.diagnosis import local_blur, local_blur_fit
from virest.diagnosis.curve_from_blur import (
    MixingEstimate,
    MixingEvidence,
    estimate_mixing,
    judge_mixing,
    observe_mixing,
)
from virest.diagnosis.field.focus import FocusOverTime, moving_focus
from virest.diagnosis.findings import BLUR, PHOTOMETRY, Finding, HeldOutGain, ParameterChange, Rival, Rung
from virest.diagnosis.isolated_steps import IsolatedSteps
from virest.diagnosis.photometry import PhotometricObservations, normalised_rms
from virest.diagnosis.photometry_effects import (
    BLACK_LEVEL,
    RESPONSE_GAMMA,
    GainDrift,
    PhotometricEffect,
    photometric_effects,
)
from virest.diagnosis.photometry_fit import PhotometricFit, fit_photometry, judge, significance
from virest.diagnosis.photometry_patches import observe_photometry
from virest.diagnosis.selection import BLUR_LEVELS, FRAME_LEVELS, LIGHT_LEVELS, MIXING_LEVELS
from virest.effects.table import EFFECTS
from virest.inference.chance import student_tail
from virest.inference.parallel import ParallelMap, one_by_one
from virest.motion.trajectory import Trajectory

log = logging.getLogger(__name__)

Reader = Callable[[Sequence[int]], Iterator[tuple[int, Picture | None]]]
MAX_RUNGS = 3
"""Causes of brightness that may enter, one a rung."""
WHOLE_LIGHT_FRAMES, MAX_LIGHT_FRAMES = 240, 130
"""Captures of up to the first number of frames are measured in every frame, longer ones in one run of the second number
of frames, because patches are tracked from frame to frame."""
MAX_GAIN_FRAMES = 3000
"""Gains are fitted to all frames in captures of up to this many frames, otherwise only in the run."""
EQUAL_RANGE = 0.05
"""Runs whose 5 to 95 % ranges of log exposure × ISO agree to this determine the curve equally well."""
MIN_OBSERVATIONS = 300
"""Fewest observations of patches, each channel of each frame one, from which a cause is sought."""
CURVE: dict[str, PhotometricEffect] = {"response_curve": RESPONSE_GAMMA, "black_level": BLACK_LEVEL}
MAX_CURVE_MEMORY = 0.45
"""Do not fit the curve if the encoder keeps more than this fraction of the last frame: it then keeps more of dark
patches than of bright ones under any curve, and a black level would only absorb that."""
VARIED_LIGHT = 0.25
"""Minimum 5 to 95 % range of log exposure × ISO for estimating the curve from brightness; below it, the curve is
estimated from how blur mixes light."""
UNEVEN = (
    "brightness changes from frame to frame, unevenly across the frame: a moving shadow "
    "or light from one side; no cause was named for it"
)
SURE = 2.0
"""Standard deviations by which a defocus must exceed what the frames' spectra allow, to be refused."""
SOFT_Z = 5.0
"""Above this many σ, note a possible defocus; as a cause it must be more significant, since lenses vary."""

SENTENCES = {name: effect.sentence for name, effect in EFFECTS.items() if effect.seen_in in (PHOTOMETRY, BLUR)}


Mixed = tuple[MixingEstimate, HeldOutGain]
"""A change of the curve estimated from blur, and its held-out gain."""


@dataclass(slots=True)
class PictureVerdict:
    """Result of the ladder for brightness, blur, curve or edges."""

    profile: CameraProfile
    """With the causes found."""
    findings: list[Finding] = field(default_factory=list)
    rungs: list[Rung] = field(default_factory=list)
    observations: PhotometricObservations | None = None
    fitted: PhotometricFit | None = None
    """Joint fit of all accepted causes of brightness."""
    nominal: CameraProfile | None = None
    """The profile without them; None: not judged."""
    mixed: dict[str, Mixed] = field(default_factory=dict)
    """By cause: change of the curve estimated from blur, reported or not."""
    photometric_rms: float | None = None
    blur_rms_px: float | None = None
    edges: local_blur.BlurObservations | None = None
    """The measured local blur."""
    focus: FocusOverTime | None = None
    """Blur over time that spectra show."""
    steps: IsolatedSteps | None = None
    """Isolated steps of the frames in which blur was measured; None: not measured."""
    notes: list[str] = field(default_factory=list)


# ── brightness ───────────────────────────────────────────────────────────────────────────────────────────────────


def light_stretch(frames: Sequence[Frame]) -> list[Frame]:
    """Frames for the brightness ladder: all of a short capture, else the run over which exposure × ISO varies most.

    Among equal runs, the one nearest the middle is taken.
    """
    if len(frames) <= WHOLE_LIGHT_FRAMES:
        return list(frames)
    light = np.log([(frame.exposure_s or 1.0) * (frame.iso or 1.0) for frame in frames])
    starts = np.unique(np.linspace(0, len(frames) - MAX_LIGHT_FRAMES, 33).round().astype(int))
    spread = np.array([np.ptp(np.quantile(light[k : k + MAX_LIGHT_FRAMES], [0.05, 0.95])) for k in starts])
    equal = starts[spread >= spread.max() - EQUAL_RANGE]
    begin = int(equal[np.argmin(np.abs(equal - (len(frames) - MAX_LIGHT_FRAMES) / 2))])
    return list(frames[begin : begin + MAX_LIGHT_FRAMES])


def climb_light(
    capture: Capture,
    frames: Sequence[Frame],
    profile: CameraProfile,
    trajectory: Trajectory,
    rgb: Reader,
    each: ParallelMap = one_by_one,
) -> PictureVerdict:
    """Find the causes of brightness changes; in a long capture on a run, and per-frame gains then on all frames."""
    run = light_stretch(frames)
    found = climb_photometry(capture, run, profile, trajectory, rgb, each)
    if len(run) == len(frames):
        return found
    gains = any(finding.name == "gain_drift" for finding in found.findings)
    if gains and len(frames) <= MAX_GAIN_FRAMES:
        return climb_photometry(capture, frames, profile, trajectory, rgb, each)
    span = f"frames {run[0].index} to {run[-1].index}"
    note = f"brightness was judged in {len(run)} of {len(frames)} frames, {span}"
    found.notes.append(f"{note}; the other frames use the gain of the nearest judged frame" if gains else note)
    return found


def climb_photometry(
    capture: Capture,
    frames: Sequence[Frame],
    profile: CameraProfile,
    trajectory: Trajectory,
    rgb: Reader,
    each: ParallelMap = one_by_one,
) -> PictureVerdict:
    """Find what changes the brightness of patches; the frames have their true timestamps."""
    verdict = PictureVerdict(profile)
    if not frames:
        verdict.notes.append("no frame at a known time: brightness was not tested")
        return verdict
    if all(frame.exposure_s is None for frame in frames):
        verdict.notes.append(
            "exposures unknown: brightness changes between frames cannot be attributed and were not tested"
        )
        return verdict
    by_index = {frame.index: frame for frame in frames}
    pictures = ((by_index[k], picture) for k, picture in rgb([frame.index for frame in frames]))
    observations = observe_photometry(pictures, trajectory, profile, intra_frames=capture.keyframes)
    if len(observations) < MIN_OBSERVATIONS:
        verdict.notes.append("too few flat patches are seen again: brightness was not tested")
    else:
        climb_observations(verdict, observations, len(capture.frames), each)
    return verdict


def climb_observations(
    verdict: PictureVerdict, observations: PhotometricObservations, movie_frames: int, each: ParallelMap = one_by_one
) -> None:
    """Add to the verdict the causes that the brightness of patches shows."""
    nominal = verdict.nominal = verdict.profile
    verdict.photometric_rms = normalised_rms(observations, nominal)[0]
    effects = photometric_effects(observations, movie_frames)
    if not light_varies(observations):
        effects = tuple(e for e in effects if e.name not in CURVE)
    accepted: list[PhotometricEffect] = []
    plain = fit_photometry(observations, nominal, ())
    notes: list[str] = []
    for _ in range(MAX_RUNGS):
        notes.clear()
        rung = _rung(observations, nominal, plain, effects, accepted, each, notes)
        verdict.rungs.append(rung[0])
        if rung[1] is None:
            break
        accepted, plain = _still_needed(observations, nominal, [*accepted, rung[1]], rung[2])
    verdict.notes += notes
    if not accepted:
        verdict.observations = observations.with_memory(plain.memory)
        return
    verdict.profile, verdict.observations = plain.profile, observations.with_memory(plain.memory)
    verdict.fitted = plain
    held = judge(observations, nominal, accepted, each)
    for effect in accepted:
        verdict.findings.append(_finding(observations, nominal, plain, effect, held))


def light_varies(observations: PhotometricObservations) -> bool:
    """Whether exposure × ISO varies enough to estimate the curve from brightness."""
    spread = np.quantile(observations.log_product, [0.05, 0.95])
    return bool(spread[1] - spread[0] >= VARIED_LIGHT)


def _rung(
    observations: PhotometricObservations,
    nominal: CameraProfile,
    plain: PhotometricFit,
    effects: Sequence[PhotometricEffect],
    accepted: list[PhotometricEffect],
    each: ParallelMap,
    notes: list[str] | None = None,
) -> tuple[Rung, PhotometricEffect | None, PhotometricFit]:
    """Fit every cause beside the accepted ones, and judge the two with the lowest penalised loss on held-out data.

    Returns (rung, cause that enters or None, its fit).  notes: receives a note if brightness changes from frame to
    frame, but not by one gain for the whole frame.
    """
    others = [e for e in effects if e not in accepted]
    found = each(fit_photometry, [(observations, nominal, [*accepted, e]) for e in others])
    fits = {e.name: fitted for e, fitted in zip(others, found, strict=True)}
    size = np.log(max(len(observations), 2))
    order = sorted(fits, key=lambda name: fits[name].cost + 0.5 * size * len(fits[name].of(name)[0]))
    judged: dict[str, HeldOutGain] = {}
    for name in order[:2]:
        effect = next(e for e in effects if e.name == name)
        p_value = significance(fits[name], name, observations, nominal)[1]
        low_memory = name not in CURVE or fits[name].memory <= MAX_CURVE_MEMORY
        if fits[name].cost >= plain.cost or not LIGHT_LEVELS.significant(p_value) or not low_memory:
            continue
        judged[name], holds = _judged(observations, nominal, accepted, effect, each)
        if holds:
            return _record(judged, name, plain), effect, fits[name]
        if effect.per_frame and notes is not None:
            notes.append(UNEVEN)
    return _record(judged, None, plain), None, plain


def _record(judged: dict[str, HeldOutGain], entered: str | None, plain: PhotometricFit) -> Rung:
    """The rung: the causes that were judged on the same held-out halves as the one that enters, or as the first."""
    if not judged:
        return Rung(entered, {}, plain.rms, PHOTOMETRY)
    chosen = judged[entered or next(iter(judged))]
    tried = {name: gain.after for name, gain in judged.items() if np.isclose(gain.before, chosen.before)}
    return Rung(entered, tried, chosen.before, PHOTOMETRY)


def _judged(
    observations: PhotometricObservations,
    nominal: CameraProfile,
    accepted: Sequence[PhotometricEffect],
    effect: PhotometricEffect,
    each: ParallelMap,
) -> tuple[HeldOutGain, bool]:
    """(held-out gain, whether an added effect gains on held-out sides, and on held-out times).

    Sides are the only test where an effect has values per frame.
    """
    effects, gains = [*accepted, effect], []
    for by_side in (False, True)[any(e.per_frame for e in effects) :]:
        gains.append(judge(observations, nominal, effects, each, beside=accepted, by_side=by_side))
        log.debug("%s, by side %s: %.3f -> %.3f", effect.name, by_side, gains[-1].before, gains[-1].after)
        if not (FRAME_LEVELS if effect.per_frame else LIGHT_LEVELS).gains(gains[-1]):
            return gains[0], False
    return gains[0], True


def _still_needed(
    observations: PhotometricObservations,
    nominal: CameraProfile,
    accepted: list[PhotometricEffect],
    fitted: PhotometricFit,
) -> tuple[list[PhotometricEffect], PhotometricFit]:
    """Drop causes that the newest one makes superfluous: free gains absorb any change of brightness."""
    for effect in accepted[:-1]:
        if not LIGHT_LEVELS.significant(significance(fitted, effect.name, observations, nominal)[1]):
            accepted = [other for other in accepted if other is not effect]
            fitted = fit_photometry(observations, nominal, accepted)
    return accepted, fitted


def _finding(
    observations: PhotometricObservations,
    nominal: CameraProfile,
    fitted: PhotometricFit,
    effect: PhotometricEffect,
    held: HeldOutGain,
) -> Finding:
    std = np.sqrt(np.diag(fitted.of(effect.name)[1]))
    changes = changes_of(values_of(effect, nominal), values_of(effect, fitted.profile), std, frames_of(fitted))
    p_value = significance(fitted, effect.name, observations, nominal)[1]
    return Finding(effect.name, changes, held, (), p_value, sentence_of(effect.name, changes))


def values_of(effect: PhotometricEffect, profile: CameraProfile) -> dict[str, Any]:
    """An effect's values in a profile, named as in the table of effects."""
    return EFFECTS[effect.name].read(profile, profile)


def frames_of(fitted: PhotometricFit) -> Sequence[int]:
    """Movie indices of the frames whose gains were fitted; empty without gains."""
    return next((effect.frames for effect in fitted.effects if isinstance(effect, GainDrift)), ())


def changes_of(
    before: dict[str, Any], now: dict[str, Any], std: Array, frames: Sequence[int] = ()
) -> dict[str, ParameterChange]:
    """Values before and after, with standard deviations; a gain is 1 in frames that the profile does not list.

    frames: movie indices to which the deviations of a gain belong; those of other frames, which take the gain of their
    neighbours, are unknown (NaN).
    """
    if "gain" in now:
        gain = now["gain"]
        spread = np.full(len(gain), np.nan)
        spread[np.asarray(frames, np.intp)] = std
        given = [*before["gain"], *[1.0] * len(gain)][: len(gain)]
        return {"gain": ParameterChange(given, gain, spread.tolist())}
    return {name: ParameterChange(before[name], now[name], float(s)) for name, s in zip(now, std, strict=True)}


def sentence_of(name: str, changes: dict[str, ParameterChange]) -> str:
    """What a cause means, for readers."""
    values = {key: change.estimate for key, change in changes.items()}
    return SENTENCES[name].format(**{k: f"{v:.3g}" if isinstance(v, float) else str(v) for k, v in values.items()})


def judge_curve(
    profile: CameraProfile,
    observations: PhotometricObservations | None,
    frames: Sequence[Frame],
    trajectory: Trajectory,
    pictures: Reader,
    each: ParallelMap = one_by_one,
) -> PictureVerdict:
    """Gamma or black level from how blur mixes light, where nothing else determines them; needs accurate blur paths."""
    verdict = PictureVerdict(profile)
    if observations is None or not light_varies(observations):
        usable = [frame for frame in frames if frame.exposure_s]
        name_curve(verdict, observe_mixing(pictures, usable, trajectory, profile, each=each))
    return verdict


def name_curve(verdict: PictureVerdict, evidence: MixingEvidence) -> None:
    """Add to the verdict what light mixing by blur shows about its profile's curve."""
    tried = {name: _mixed(evidence, verdict.profile, name) for name in evidence.steps}
    found = verdict.mixed = {name: one for name, one in tried.items() if one}
    if not found:
        verdict.notes.append(
            "no blurred frames beside sharp ones: the exposure curve could not be tested at constant exposure"
        )
        return
    log.debug("mixing: %s", found)
    supported = {name: one for name, one in found.items() if _is_supported(one, name, verdict.profile)}
    if not supported:
        return
    name = min(supported, key=lambda k: supported[k][1].after)
    estimate, held = supported[name]
    rivals = tuple(Rival(other, supported[other][1].after) for other in supported if other != name)
    ((parameter, before),) = values_of(CURVE[name], verdict.profile).items()
    changes = {parameter: ParameterChange(before, estimate.value, estimate.std)}
    verdict.findings.append(Finding(name, changes, held, rivals, estimate.p_value, sentence_of(name, changes)))
    verdict.profile = CURVE[name].apply(verdict.profile, np.array([estimate.value]))
    verdict.rungs.append(Rung(name, {k: one[1].after for k, one in found.items()}, held.before, PHOTOMETRY))


def _mixed(evidence: MixingEvidence, profile: CameraProfile, name: str) -> Mixed | None:
    estimate, held = estimate_mixing(evidence, profile, name), judge_mixing(evidence, name)
    return (estimate, held) if estimate is not None and held is not None else None


def _is_supported(found: Mixed, name: str, profile: CameraProfile) -> bool:
    """Whether a change of the curve is significant, large enough, and gains on held-out pairs."""
    estimate, held = found
    (now,) = values_of(CURVE[name], profile).values()
    size = abs(estimate.value - now if name == "black_level" else np.log(estimate.value / now))
    levels = MIXING_LEVELS
    return levels.significant(estimate.p_value) and levels.matters(name, float(size)) and levels.gains(held)


# ── blur ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def climb_blur(
    capture: Capture,
    profile: CameraProfile,
    trajectory: Trajectory,
    gray: Reader,
    exposure_hypothesis: float | None,
    each: ParallelMap = one_by_one,
) -> tuple[PictureVerdict, bool]:
    """Find a wrong exposure and defocus from local blur, and whether a time offset is really a wrong exposure.

    exposure_hypothesis: the exposure scale that would explain an offset found at constant exposure.
    """
    verdict = PictureVerdict(profile)
    if not local_blur.frames_to_read(capture):
        verdict.notes.append("no two frames with known exposures to compare: blur was not tested")
        return verdict, False
    observations = local_blur.look_for_blur(gray, capture, profile, trajectory, each)
    verdict.steps = observations.steps
    if len(observations) < local_blur.MIN_EDGES:
        verdict.notes.append("too little texture to measure local blur")
        return verdict, False
    verdict.edges = observations
    effects: tuple[Any, ...] = (local_blur_fit.ExposureTime(), local_blur_fit.Defocus())
    fitted, plain = each(local_blur_fit.fit, [(observations, profile, trajectory, some) for some in (effects, ())])
    log.debug("blur: %s ± %s", fitted.values, fitted.std)
    everything = np.ones(len(observations), bool)
    verdict.blur_rms_px = local_blur_fit.judge(observations, plain, trajectory, everything)
    is_exposure = _exposure_holds(fitted, profile.shutter.exposure_scale, exposure_hypothesis)
    found = _blur_changes(fitted, profile)
    named = [
        k
        for k, effect in enumerate(effects)
        if fitted.determined[k] and ((k == 0 and is_exposure) or found[k].is_named(effect.name))
    ]
    defocus = found[1].parameter
    refused = 1 in named and not observations.allow(defocus.estimate - SURE * defocus.std)
    if refused:
        named.remove(1)
    if named:
        gains = local_blur_fit.held_out(observations, profile, trajectory, tuple(effects[k] for k in named))
        for k, held in zip(named, gains, strict=True):
            name, change = effects[k].name, found[k].parameter
            changes = {effects[k].parameters[0]: change}
            p_value = _blur_p_value(name, found[k].deviations)
            verdict.findings.append(Finding(name, changes, held, (), p_value, sentence_of(name, changes)))
            verdict.rungs.append(Rung(name, {name: held.after}, held.before, BLUR))
            verdict.profile = effects[k].apply(verdict.profile, np.array([change.estimate]))
    verdict.focus = moving_focus(gray, observations, verdict.profile, trajectory, capture)
    moves = verdict.focus is not None and verdict.focus.finding is not None
    if not moves and 1 not in named and fitted.determined[1]:
        verdict.notes += _softness(defocus, float(fitted.nuisance[0]), refused)
    return verdict, is_exposure


def _softness(defocus: ParameterChange, lens_px: float, refused: bool) -> list[str]:
    """A note about soft edges for which no defocus is named; refused: since frames show finer detail."""
    if not refused and defocus.estimate - defocus.nominal <= SOFT_Z * defocus.std:
        return []
    soft = f"edges are blurred by {np.hypot(defocus.estimate, lens_px):.2f} px"
    if refused:
        return [f"{soft}, but frames show finer detail than such a blur leaves: the scene has soft edges"]
    return [f"{soft}: a soft lens, or a defocus of about {defocus.estimate:.1f} px; not reported as a cause"]


@dataclass(frozen=True, slots=True)
class _BlurChange:
    """A value that the blur shows, beside the profile's."""

    parameter: ParameterChange
    size: float
    """Absolute change: of the logarithm of the exposure, of the defocus in px."""
    deviations: float
    """The change in standard deviations."""

    def is_named(self, name: str) -> bool:
        """Whether the change is large enough, and significant by the reported p value."""
        significant = BLUR_LEVELS.significant(_blur_p_value(name, self.deviations))
        return BLUR_LEVELS.matters(name, self.size) and significant


def _blur_changes(fitted: local_blur_fit.BlurFit, given: CameraProfile) -> tuple[_BlurChange, _BlurChange]:
    """The changes of exposure and defocus; NaN where the capture does not determine a value.

    A small defocus hardly widens edges, so a defocus below the given one is tested by its variance in px².  The square
    of a normal value σ ± s has the variance 4 σ² s² + 2 s⁴, at σ = 0 too.
    """
    (scale, sigma), (scale_std, sigma_std) = np.concatenate(fitted.values).tolist(), fitted.std.tolist()
    before, sharp = given.shutter.exposure_scale, given.extensions.defocus_sigma_px
    longer = abs(float(np.log(scale / before)))
    square_std = sigma_std * float(np.sqrt(4 * sigma**2 + 2 * sigma_std**2))
    wider = (sharp**2 - sigma**2) / square_std if sigma < sharp else (sigma - sharp) / sigma_std
    return (
        _BlurChange(ParameterChange(before, scale, scale_std), longer, longer * scale / scale_std),
        _BlurChange(ParameterChange(sharp, sigma, sigma_std), abs(sigma - sharp), wider),
    )


def _blur_p_value(name: str, deviations: float) -> float:
    """p value of a value whose deviation comes from the scatter of a few blocks; one-sided for defocus."""
    return (2 if name == "exposure_time" else 1) * student_tail(deviations, local_blur.BLOCKS - 1)


def _exposure_holds(fitted: local_blur_fit.BlurFit, given: float, hypothesis: float | None) -> bool:
    """Whether the blur requires another exposure scale than the given, and one that agrees with the time offset."""
    if hypothesis is None or not fitted.determined[0] or not 0.3 < hypothesis / given < 3.0:
        return False
    longer, std = float(fitted.values[0][0]) / given, max(float(fitted.std[0]) / given, 0.03)
    off = abs(longer - hypothesis / given)
    return off < 2.5 * std and abs(longer - 1) > 1.5 * std and abs(longer - 1) > 2 * off
