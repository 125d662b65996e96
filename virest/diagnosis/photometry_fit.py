"""Fits of photometric effects, their covariances, and their gains on held-out observations.

Residuals are in noise σ, with each patch's light eliminated.  They are not independent: those of one time block
share their frames' registration and coding, those of one patch its texture.  Covariances cluster by both (Cameron,
Gelbach & Miller 2011, doi:10.1198/jbes.2010.07136).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice, product

import numpy as np

from virest.arrays import Array, Index, Mask
from virest.camera.profile import CameraProfile
from virest.diagnosis.findings import PHOTOMETRY, HeldOutGain
from virest.diagnosis.photometry import PhotometricObservations, Prediction, normalised_rms, predict
from virest.diagnosis.photometry_effects import (
    SEARCH_HZ,
    FollowedGain,
    GainDrift,
    PhotometricEffect,
    flicker_change,
)
from virest.effects.table import EFFECTS
from virest.inference.chance import chi2_tail, normal_deviate
from virest.inference.clustered import raised, scatter
from virest.inference.descent import Residuals, Slopes, System, descend, slices, slopes_by_steps
from virest.inference.parallel import ParallelMap, one_by_one
from virest.inference.robust import CAUCHY, cauchy_weight
from virest.inference.time_blocks import halves, varied_blocks

_MAX_STARTS = 8
"""Most combinations of the effects' starting values that are tried; flicker alone has up to five."""
_FIRST_MEMORY, _MEMORY_SPREAD, _MOST_MEMORY = 0.2, 0.2, 0.6
"""The encoder's memory: start and prior mean, prior standard deviation, and upper bound.  Half or twice of them changes
a simulated fit by 0.02 σ at most."""
_PRIOR_SCALES = 10.0
"""Standard deviation of a weak prior, in typical changes; it holds values that the data do not determine."""
_SMALL_STEP, _MEMORY_STEP = 1e-3, 0.01
"""Finite-difference steps: of an effect's value, in typical changes, and of the memory; half or twice changes values by
less than 0.01 σ, and the memory by 0.001."""
_TRIAL_OBSERVATIONS = 6_000
"""Observations from which the best start is chosen."""
_PER_FRAME = 100
"""Observations per frame to which its own value is fitted; more add cost and little precision."""
MEMORY_ERROR = 0.25
"""Fraction of the encoder-memory correction treated as uncertainty: one memory per movie is a rough model."""
LAG_ERROR = 0.2
"""Fraction of a sudden change in a whole frame's brightness that an encoder at 0.25 bit per pixel may omit."""
SHARED_ERRORS = 3.0
"""Patches of one frame share registration and coding errors, which their scatter does not show: on movies of 1 to
0.25 bit per pixel, gains of frames with equal gain differed 1.3 to 3 times as much as their scatter predicts."""
DELAY_FRAMES, CURVE_ERROR = 0.5, 0.02
"""Errors in gains caused by changes of log exposure × ISO: the encoder's delay beyond its memory, in frames, and the
error of the curve's slope and curvature."""
CORRELATED_CHANGES = 3.0
"""Number of frame-to-frame changes that count as one independent change: each shares a frame with the next."""
BLOCKS_S = 0.3
"""Typical length of a block of frames: longer than the correlation time of hand shake and the encoder's memory of a
moving image."""
BLOCK_LENGTHS = (1.0, 0.7, 1.25, 0.85, 1.4)
"""Lengths of successive blocks in units of BLOCKS_S, repeated in this order."""
RESOLUTION = {"vignetting": 0.006, "flicker": 0.004, "response_curve": 0.01, "black_level": 0.002, "gain_drift": 0.003}
"""Component of every standard deviation: smaller values cannot be distinguished from effects of encoders and slightly
textured patches, however small the statistical error."""


@dataclass(frozen=True, slots=True)
class PhotometricFit:
    """Values of effects and their covariance."""

    effects: tuple[PhotometricEffect, ...]
    values: Array
    """(k,) of all effects, in their order."""
    covariance: Array
    """(k, k); that of gains is relative to the mean over their frames, which is not observable."""
    profile: CameraProfile
    """The profile with the values in it."""
    rms: float
    """Robust rms of the residuals, grey levels."""
    cost: float
    """Sum of the robust losses, in squared noise σ."""
    memory: float
    """Encoder memory, fitted with the values; its uncertainty is in their covariance."""
    memory_error: Array
    """(k,) the part of each value's standard deviation that the uncertainty of the memory makes, with its sign."""

    @property
    def std(self) -> Array:
        """(k,) standard deviations."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    def place(self, effect_name: str) -> slice:
        """Where the values of one effect are."""
        return next(own for effect, own in _parts(self.effects) if effect.name == effect_name)

    def of(self, effect_name: str) -> tuple[Array, Array]:
        """(values, covariance) of one effect."""
        own = self.place(effect_name)
        return self.values[own], self.covariance[own, own]


def time_blocks(observations: PhotometricObservations) -> Index:
    """Block of each observation, (n,): contiguous frames, about BLOCKS_S long."""
    frames = observations.frames
    stamp = np.array([observations.stamp_s[np.argmax(observations.frame == k)] for k in frames])
    block = varied_blocks(stamp, BLOCKS_S * np.array(BLOCK_LENGTHS))
    return block[np.searchsorted(frames, observations.frame)]


def fit_photometry(
    observations: PhotometricObservations,
    profile: CameraProfile,
    effects: Sequence[PhotometricEffect],
    use: Mask | None = None,
) -> PhotometricFit:
    """Fit all values of the effects together, from the combinations of the effects' starts, and keep the best fit."""
    chosen = _fitted_part(observations if use is None else observations.subset(use), effects)
    effects = tuple(e.seen_in(chosen) if isinstance(e, GainDrift) else e for e in effects)
    all_starts = product(*(effect.starts(chosen, profile) for effect in effects))
    starts = [np.concatenate([*start, [_FIRST_MEMORY]]) for start in islice(all_starts, _MAX_STARTS)]
    start = _best_start(chosen, profile, effects, starts)
    evidence = _Brightness(chosen, profile, effects, start)
    found = descend(evidence, start)
    by_memory = MEMORY_ERROR * found.state[-1] * _memory_sensitivity(found.normal)
    covariance = _covariance(evidence, found, by_memory)[:-1, :-1]
    final, memory = evidence.applied(found.state), float(found.state[-1])
    rms = normalised_rms(chosen.with_memory(memory), final)[0]
    cost = 2 * found.cost(1.0)
    return PhotometricFit(effects, found.state[:-1], covariance, final, rms, cost, memory, by_memory[:-1])


def pulls(
    observations: PhotometricObservations,
    profile: CameraProfile,
    fitted: PhotometricFit,
    changed: Sequence[tuple[CameraProfile, float]],
) -> Array:
    """First-order sensitivity (k, m) of the fitted values to m other values of the profile.

    changed: for each of the m values, the fitted profile with that value increased by a step, and the step.
    The common part of all values per frame is not observable and is removed.
    """
    values = np.append(fitted.values, fitted.memory)
    evidence = _Brightness(_fitted_part(observations, fitted.effects), profile, fitted.effects, values)
    here = evidence.weighed(values, evidence.look(values))
    left = evidence.left(values, here.weight)
    moved = [(replace(evidence, profile=base).left(values, here.weight) - left) / step for base, step in changed]
    pulled = here.pull(np.stack(moved, axis=-1)[:, None])
    return np.asarray((_centring(fitted.effects) @ np.linalg.solve(here.normal, pulled))[:-1])


def judge(
    observations: PhotometricObservations,
    profile: CameraProfile,
    effects: Sequence[PhotometricEffect],
    each: ParallelMap = one_by_one,
    *,
    beside: Sequence[PhotometricEffect] = (),
    by_side: bool | None = None,
) -> HeldOutGain:
    """Fit on one half, judge on the other, and vice versa.  beside: effects already accepted.

    by_side: the halves are sides of the frame instead of time blocks: an effect that a shadow mimics on one side fails
    on the other.  None: by side for effects with a value per frame, which no other frame determines.
    """
    by_side = any(effect.per_frame for effect in effects) if by_side is None else by_side
    both = _sides(observations) if by_side else halves(time_blocks(observations))
    folds = [fitted for fitted in both if fitted.any() and not fitted.all()]
    calls = [(observations, profile, some, fitted) for fitted in folds for some in (effects, beside)]
    fits = each(fit_photometry, calls)
    judged = []
    for fitted, fit, without in zip(folds, fits[::2], fits[1::2], strict=True):
        held = observations.subset(~fitted)
        held = held.subset(np.bincount(held.patch)[held.patch] >= 2)  # a single observation has no residual
        before, noise = normalised_rms(held.with_memory(without.memory), without.profile)
        judged.append((before, normalised_rms(held.with_memory(fit.memory), fit.profile)[0], noise))
    return HeldOutGain.of_folds(PHOTOMETRY, judged)


def _sides(observations: PhotometricObservations) -> list[Mask]:
    """Masks (n,) of the right, left, lower and upper half of the observations."""
    lower = [at > np.median(at) for at in (observations.x_px, observations.y_px)]
    return [side for half in lower for side in (half, ~half)]


def significance(
    fit: PhotometricFit, effect_name: str, observations: PhotometricObservations, given: CameraProfile
) -> tuple[float, float]:
    """(normal deviate equivalent to the p value, p value of no change); includes RESOLUTION and frequency search.

    An error of the encoder's memory scales a flicker's amplitude, so it makes none where there is none: it does not
    count against the presence of flicker.  given: the profile that the change is counted from.
    """
    values, covariance = fit.of(effect_name)
    if effect_name == "flicker" and given.extensions.flicker_amplitude:
        change = flicker_change(given, values)
        p = chi2_tail(float(change @ np.linalg.solve(covariance, change)), len(change))
    elif effect_name == "flicker":
        z2 = values[0] ** 2 / (covariance[0, 0] - fit.memory_error[fit.place("flicker")][0] ** 2)
        span_s = float(np.ptp(observations.stamp_s))
        trials = max(np.ptp(SEARCH_HZ) * span_s, 1.0)
        p = float(-np.expm1(trials * np.log1p(-min(np.exp(-0.5 * z2), 1 - 1e-12))))
    elif effect_name == "gain_drift":
        (gains,) = (effect for effect in fit.effects if isinstance(effect, GainDrift))
        (before,) = gains.starts(observations, given)
        seen = observations.subset(np.isin(observations.frame, gains.frames))
        p = _p_of_gains(seen, values, before, covariance)
    else:
        (before,) = EFFECTS[effect_name].read(given, given).values()
        p = chi2_tail((values[0] - before) ** 2 / covariance[0, 0], 1)
    return normal_deviate(max(p, 1e-300) / 2), p


def _p_of_gains(observations: PhotometricObservations, log_gain: Array, before: Array, covariance: Array) -> float:
    """p value of gains that changed alike, given their errors, and those of curve and encoder under changing exposure.

    before: logarithms (k,) of the gains that the change is counted from.  Frames of one time block share errors, so
    each block counts once.  Shared errors cancel from one frame to the next, so fast changes are tested separately;
    neighbouring changes share a frame, so one third of them count.
    """
    product = _per_frame(observations, observations.log_product)
    rounding = _per_frame(observations, observations.log_product_std)
    late = _since_frame_before(product)
    followed = np.stack([CURVE_ERROR * product, CURVE_ERROR * product**2, DELAY_FRAMES * late], axis=-1)
    spread = covariance + followed @ followed.T + np.diag(rounding**2)
    change = log_gain - before
    off = change - np.mean(change)
    freedom = max(len(off) - 1, 1)
    blocks = min(len(np.unique(time_blocks(observations))), freedom)
    slow = float(off @ np.linalg.solve(spread, off)) / freedom
    unchanged = spread - _lag_of_gains(log_gain, np.abs(late)) + _lag_of_gains(before, np.abs(late))
    quick = _quick_changes(change, unchanged)
    tests = ((slow, blocks), (quick, max(freedom / CORRELATED_CHANGES, 1.0)))
    return float(min(1.0, 2 * min(chi2_tail(ratio * count, count) for ratio, count in tests)))


def _quick_changes(log_gain: Array, spread: Array) -> float:
    """Mean squared change between neighbouring frames, in units of its variance."""
    if len(log_gain) < 2:
        return 0.0
    variance = spread.diagonal()[1:] + spread.diagonal()[:-1] - 2 * spread.diagonal(1)
    return float(np.mean(np.diff(log_gain) ** 2 / np.maximum(variance, RESOLUTION["gain_drift"] ** 2)))


def _lag_of_gains(log_gain: Array, exposed: Array) -> Array:
    """Covariance added by the encoder's lag behind changes of the gains themselves; zero without gains."""
    own = np.abs(_since_frame_before(log_gain))
    centre = np.eye(len(own)) - 1 / len(own)
    return np.asarray(centre @ np.diag(LAG_ERROR**2 * ((own + exposed) ** 2 - exposed**2)) @ centre)


def _since_frame_before(values: Array) -> Array:
    """Changes (n,) of values per frame since the frame before; 0 for the first."""
    return np.diff(values, prepend=values[:1])


def _per_frame(observations: PhotometricObservations, values: Array) -> Array:
    return np.array([values[np.argmax(observations.frame == k)] for k in observations.frames])


def _fitted_part(
    observations: PhotometricObservations, effects: Sequence[PhotometricEffect]
) -> PhotometricObservations:
    """The observations used by a fit: all, or enough of each frame if an effect has a value per frame."""
    if any(effect.per_frame for effect in effects):
        return _thinned(observations, _PER_FRAME * len(observations.frames))
    return observations


def _thinned(observations: PhotometricObservations, limit: int) -> PhotometricObservations:
    """Thin the observations to about ``limit``, by places, odd and even ones alike."""
    thin = max(1, len(observations) // limit)
    return observations if thin == 1 else observations.subset((observations.place // 2) % thin == 0)


def _best_start(
    observations: PhotometricObservations,
    profile: CameraProfile,
    effects: Sequence[PhotometricEffect],
    starts: list[Array],
) -> Array:
    """The state reached by the best of the descents from each start, on a part of the places."""
    if len(starts) == 1:
        return starts[0]
    part = _thinned(observations, _TRIAL_OBSERVATIONS)
    tried = [descend(_Brightness(part, profile, effects, start), start, fresh=False) for start in starts]
    return min(tried, key=lambda found: found.cost(1.0)).state


# ── brightness as evidence ─────────────────────────────────────────────────────────────────────────────────────────


def _parts(effects: Sequence[PhotometricEffect]) -> Iterator[tuple[PhotometricEffect, slice]]:
    """Each effect with the slice of its values."""
    return zip(effects, slices(len(effect.parameters) for effect in effects), strict=True)


@dataclass(frozen=True, slots=True)
class _Brightness:
    """Observations and constants of a fit; values (k + 1,): the effects', then the encoder memory."""

    observations: PhotometricObservations
    profile: CameraProfile
    effects: Sequence[PhotometricEffect]
    start: Array

    def applied(self, values: Array) -> CameraProfile:
        """The profile with the effects' values."""
        profile = self.profile
        for effect, own in _parts(self.effects):
            profile = effect.apply(profile, values[own])
        return profile

    def predicted(self, values: Array, weight: Array) -> Prediction:
        """Prediction under some values; weight (n,) multiplies 1 / noise² in the fit of each patch's light."""
        seen = self.observations.with_memory(float(values[-1]))
        return predict(seen, self.applied(values), weight / seen.noise**2)

    def left(self, values: Array, weight: Array) -> Array:
        """Measured − predicted (n,), in noise σ."""
        return self.predicted(values, weight).residual / self.observations.noise

    def look(self, values: Array, before: Residuals | None = None, limit: Slopes = Slopes.HERE) -> Residuals:
        """Residuals; the patches' light is fitted with the same robust weights."""
        weight = np.ones(len(self.observations))
        for _ in range(2):
            left = self.left(values, weight)
            weight = cauchy_weight(left**2, CAUCHY)
        if before is not None and not (kept := replace(before, left=left)).is_stale(limit):
            return kept
        return Residuals(left, self._slope(values, weight), left)

    def _slope(self, values: Array, weight: Array) -> Array:
        """Derivative (n, k) of the prediction with respect to each value, in noise σ; exact for gains."""
        slope, noise = np.zeros((len(weight), len(values))), self.observations.noise
        steps = np.append(np.zeros(len(values) - 1), _MEMORY_STEP)
        for effect, own in _parts(self.effects):
            if isinstance(effect, GainDrift | FollowedGain):
                columns = effect.columns(self.observations)
                slope[:, own] = -self.predicted(values, weight).respond(columns) / noise[:, None]
            else:
                steps[own] = effect.scale * _SMALL_STEP
        which = np.flatnonzero(steps)

        def at(some: Array) -> Array:
            changed = values.copy()
            changed[which] = some
            return -self.left(changed, weight)

        slope[:, which] = slopes_by_steps(at, at(values[which]), values[which], steps[which], self._bounds[1][which])
        return slope

    def weighed(self, values: Array, look: Residuals) -> System[Array, Residuals]:
        """Unit scale, since the noise is known; a weak prior holds each value, and the memory, to its start."""
        spread = [_PRIOR_SCALES * effect.scale for effect in self.effects]
        prior = 1 / np.concatenate([*spread, [_MEMORY_SPREAD]]) ** 2
        low, high = self._bounds
        rows, left = look.slope[:, None], look.left[:, None]
        room = low - values, high - values
        return System(values, look, rows, left, look.left**2, 1.0, prior, values - self.start, room=room)

    def moved(self, values: Array, step: Array) -> Array:
        """After a step."""
        return values + step

    @property
    def _bounds(self) -> tuple[Array, Array]:
        low, high = ([end for effect in self.effects for end in effect.bounds[side]] for side in (0, 1))
        return np.array([*low, 0.0]), np.array([*high, _MOST_MEMORY])


# ── covariance ─────────────────────────────────────────────────────────────────────────────────────────────────────


def _covariance(evidence: _Brightness, found: System[Array, Residuals], by_memory: Array) -> Array:
    """Sandwich covariance with scores clustered by time block and by place; never below that of white noise.

    Values per frame make the score sums of a block vanish, so with them only places are clusters.  by_memory: errors
    (k + 1,) of the values by the memory's.
    """
    observations, effects, values = evidence.observations, evidence.effects, found.state
    score, by_frame = found.score, any(effect.per_frame for effect in effects)
    spread = scatter(score, observations.place)
    if not by_frame:
        spread = spread + scatter(score, time_blocks(observations)) - score.T @ score
    white: Array = found.inverse() * max(float(np.sum(found.weight * found.squared) / np.sum(found.weight)), 1.0)
    sandwich = found.sandwich(spread)
    lag = LAG_ERROR * _changes(observations, effects, values)
    model = (
        np.outer(by_memory, by_memory) + np.diag(lag**2) + _resolution(observations, evidence.profile, effects, values)
    )
    if not by_frame:
        return raised(sandwich, white) + model
    shared, frames = np.ones(len(values)), _centring(effects)
    shared[:-1][np.diag(frames)[:-1] < 1] = SHARED_ERRORS
    return frames @ (raised(white * np.outer(shared, shared), sandwich) + model) @ frames.T


def _resolution(
    observations: PhotometricObservations, profile: CameraProfile, effects: Sequence[PhotometricEffect], values: Array
) -> Array:
    """Covariance (k + 1, k + 1) that RESOLUTION adds to the values and the memory."""
    added = np.zeros((len(values), len(values)))
    for effect, own in _parts(effects):
        square = RESOLUTION[effect.name] ** 2
        if effect.name == "flicker":
            added[own, own] = square * _flicker_resolution(observations, profile, values[own])
        else:
            added[own, own] = np.diag(np.full(len(effect.parameters), square))
    return added


def _flicker_resolution(observations: PhotometricObservations, profile: CameraProfile, values: Array) -> Array:
    """Covariance (3, 3) of (amplitude, frequency, phase), over ε², from an error ε of a flicker's visible amplitude.

    An exposure of nearly whole periods leaves little of the lamp's amplitude visible.  A component across the amplitude
    changes the phase at the middle of the capture by ε over the visible one.  If it varies over the capture with the
    same mean, as an encoder's error does, it changes the frequency by √12 / (2π duration) times that, and with it the
    phase at time 0.
    """
    time_s = observations.row_time_s(profile)
    middle, duration = float(time_s.mean()), max(float(np.ptp(time_s)), 0.1)
    exposure_s = profile.shutter.true_exposure_s(observations.exposure_s)
    share = max(float(np.sqrt(np.mean(np.sinc(values[1] * exposure_s) ** 2))), RESOLUTION["flicker"])
    at_middle = 1 / max(abs(float(values[0])) * share, RESOLUTION["flicker"])
    drift = at_middle * np.sqrt(12) / (2 * np.pi * duration) * np.array([0.0, 1.0, -2 * np.pi * middle])
    return np.diag([share**-2, 0.0, at_middle**2]) + np.outer(drift, drift)


def _changes(observations: PhotometricObservations, effects: Sequence[PhotometricEffect], values: Array) -> Array:
    """Absolute change of each frame's log brightness since the frame before, by its own value and by exposure × ISO.

    0 for all other values and the memory.
    """
    changes = np.zeros(len(values))
    for effect, own in _parts(effects):
        if isinstance(effect, GainDrift):
            exposed = _exposure_steps(observations, effect.frames)
            changes[own] = np.abs(_since_frame_before(values[own])) + exposed
    return changes


def _exposure_steps(observations: PhotometricObservations, frames: Sequence[int]) -> Array:
    """Absolute change (k,) of log exposure × ISO at each of some observed frames since the last; 0 for the first."""
    seen = observations.subset(np.isin(observations.frame, frames))
    product = _per_frame(seen, seen.log_product)
    return np.abs(_since_frame_before(product))


def _centring(effects: Sequence[PhotometricEffect]) -> Array:
    """Matrix (k + 1, k + 1) that subtracts the mean from the values per frame and keeps the others."""
    matrix = np.eye(sum(len(effect.parameters) for effect in effects) + 1)
    for effect, own in _parts(effects):
        if effect.per_frame:
            matrix[own, own] -= 1 / len(effect.parameters)
    return matrix


def _memory_sensitivity(normal: Array) -> Array:
    """First-order sensitivity (k + 1,) of the values to the memory; 0 for the memory itself."""
    pull: Array = np.zeros(len(normal))
    if len(normal) > 1:
        pull[:-1] = -np.linalg.solve(normal[:-1, :-1], normal[:-1, -1])
    return pull
