"""Fit the exposure characteristic curve to a bracket, and say what is wrong with the fit (forward_model, section 4).

Model: the grey of place p in picture n is ``E(L_p · t_n · 2^c_n)`` plus noise, with the curve E, the light L_p of every
place and a correction c_n of each listed exposure unknown, as in Debevec & Malik 1997, doi:10.1145/258734.258884, but
with E of a named kind and residuals in grey levels, where the noise is.  By variable projection only the curve's few
parameters and the c_n are searched; for each trial the light follows place by place.  Residuals are weighted by the
noise and held down where they are large; clipped greys are censored: they only say "at least" or "at most".

The c_n are sparse, not a trend (see ``exposure_check``): a picture's listed exposure is believed to within 0.02 EV,
unless it contradicts the others, in which case it is free.  One curve is fitted to the three channels together, as the
camera profile has one; a place's channels are separate places to the fit, but one to the tests.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize_scalar

from virest.calibration.bracket_samples import MIN_SHARED, BracketPicture, BracketSamples, sample_bracket
from virest.calibration.curve_certainty import CurvePosterior, curve_posterior
from virest.calibration.curve_families import Family, LogLookup, log_lookup, make_family
from virest.calibration.exposure_check import CONTRADICTS_EV, MIN_PICTURES, FirstCurve, fit_first_curve, outlying
from virest.calibration.grey_levels import FAIR_SIGMA, fairly_inside, scatter_by_grey
from virest.camera.response import KINDS, ResponseCurve
from virest.errors import CalibrationError, SettingsError

Array = NDArray[np.float64]
TRUSTED_EV = 0.02
"""Standard deviation of a listed exposure that is believed."""
FREE_EV = 4.0
MIN_RATIO = 2**0.25
FEW_RATIO = 2**1.5
STEP = 1e-4
SMOOTH_WEIGHT = 5.0
"""Of a table's roughness in the fit, against samples that count as if their errors were independent."""
MOVED_LEVELS = 8.0
MAX_MOVED = 0.2
USUAL_MISSES = 3.0
"""A place whose worst miss exceeds the usual worst miss by this factor is left out."""
OUTLIER_LEVELS = 20.0
WIDEST_EV = 20.0
"""Corrections of listed exposures are sought up to this; cameras' shutters span less."""
SCORE_CAP = 16.0
"""The most that one grey, in units of its variance, counts against a curve."""
Z_REJECTED = 3.0
DISTINCT_LEVELS = 0.25
"""Smaller systematic differences between two kinds are left to rounding and compression."""
STRUCTURE_LEVELS = 0.3
ESTABLISHED_Z = 3.0
SCATTER_EV = 0.06
"""Three times what a listed exposure is believed to deviate by."""
OPEN_LEVELS = 2.0
"""A curve that the data hold no better is said to be held loosely."""
UNDETERMINED_LEVELS = 25.0
"""A tenth of the greys: no measurement of a curve."""
LN2 = float(np.log(2.0))


@dataclass(frozen=True, slots=True)
class PictureFit:
    """What the fit says of one picture."""

    file: str
    exposure: float
    """As listed."""
    exposure_error_ev: float | None
    """log2(listed / true): +1 where the listed exposure is twice the true one; None: the picture was left out."""
    contradicts: bool
    """Whether the listed exposure contradicts the others'; its error then is measured, not held near 0."""

    @property
    def likely_exposure(self) -> float:
        """What the exposure was, in the unit of the list."""
        return float(self.exposure / 2.0 ** (self.exposure_error_ev or 0.0))


@dataclass(frozen=True, slots=True)
class DataCloud:
    """The samples as a plot shows them: each measured grey with the light that the fit gives it."""

    light: Array
    """(m,)"""
    grey: Array
    """(m,) levels."""
    residual: Array
    """(m,) levels, measured − curve."""
    picture: NDArray[np.int64]
    """(m,) index of the picture."""


@dataclass(frozen=True, slots=True)
class CurveFit:
    """A response curve and how far to trust it."""

    curve: ResponseCurve
    rms_grey_levels: float
    """Of the samples' residuals (means over small squares), outliers left out."""
    curve_std_grey_levels: float
    """Standard deviation of the curve over the exposures covered, rms: what the data leave open among smooth curves of
    any kind (``curve_certainty``), and what this kind is seen not to follow."""
    covered_exposure: tuple[float, float]
    """Exposures on the curve's axis between which there are data."""
    pictures: tuple[PictureFit, ...]
    notes: tuple[str, ...]
    held_out: dict[str, float]
    """Held-out rms in grey levels of every kind that was tried."""
    cloud: DataCloud


def fit_response(
    pictures: Sequence[BracketPicture], kind: str = "auto", rng: np.random.Generator | None = None
) -> CurveFit:
    """Fit a curve of one kind, or of the simplest kind that held-out places do not reject (``auto``).

    Raises CalibrationError for fewer than two pictures, one exposure, no overlap, pictures clipped throughout,
    misalignment that is too large or not rigid, and a scene that is not still.
    """
    if kind not in ("auto", *KINDS):
        raise SettingsError(f"kind '{kind}' is no curve", hint=f"use auto, {', '.join(KINDS)}")
    rng = np.random.default_rng(0) if rng is None else rng
    _require_bracket(pictures)
    samples = sample_bracket(pictures, rng)
    return _fit_samples(pictures, samples, kind)


def _fit_samples(pictures: Sequence[BracketPicture], samples: BracketSamples, kind: str) -> CurveFit:
    notes = [f"{p.file} was shifted by {np.hypot(*s):.1f} px and aligned" for p, s in
             zip(pictures, samples.shifts_px - np.median(samples.shifts_px, axis=0), strict=True)
             if np.hypot(*s) > 0.5]  # fmt: skip
    notes += [samples.ends.describe()] * samples.ends.apart
    seen, samples = _keep_connected(pictures, np.ones(len(pictures), bool), samples)
    first = fit_first_curve(samples)
    _require_possible(first, samples)
    samples = _fairly_seen(_with_scatter(samples, first), first)
    seen, samples = _keep_connected(pictures, seen, samples)
    notes += [
        f"{p.file} is clipped or too dark throughout and was left out"
        for p, s in zip(pictures, seen, strict=True)
        if not s
    ]
    first = fit_first_curve(samples)
    still = _still_rows(samples, first)
    samples = samples.take(still)
    verdict = _fit_kinds(kind, samples, first, np.ones(len(first.suspect), bool))
    # a picture that only the chosen kind finds wrong may as well show where the kind is
    wrong_for_any = np.abs(first.correction_ev) > 0.5 * CONTRADICTS_EV
    doubtful = verdict.final.suspect & ~(verdict.established & wrong_for_any)
    if doubtful.any():
        first = replace(first, suspect=first.suspect & ~doubtful)
        verdict = _fit_kinds(kind, samples, first, ~doubtful)
    _require_determined(verdict)
    return _result(pictures, seen, verdict, samples, [*notes, *_criticise(verdict, samples)])


@dataclass(frozen=True, slots=True)
class _Verdict:
    """The kinds that were fitted, and the one that was chosen."""

    trials: dict[str, _Trial]
    chosen: str
    final: _Trial
    """The chosen kind, fitted to all samples."""
    posterior: CurvePosterior
    """Of the table: what the data alone leave open."""
    structure_levels: float
    """What residuals at one grey share."""
    misfit_levels: float
    """The same; where a kind was asked for, at least its distance from the table."""
    scatter_ev: float
    """Of the believed exposures about the table."""

    @property
    def std_levels(self) -> float:
        """The curve's deviation: what the data leave open, and what the kind is seen not to follow."""
        return float(np.hypot(self.posterior.rms_levels, self.misfit_levels))

    @property
    def established(self) -> NDArray[np.bool_]:
        """(pictures,): whether a wrong exposure is told from another curve, by what a table leaves open."""
        return np.abs(self.final.correction_ev) > ESTABLISHED_Z * self.posterior.exposure_std_ev


def _fit_kinds(kind: str, samples: BracketSamples, first: FirstCurve, may_be_wrong: NDArray[np.bool_]) -> _Verdict:
    """Fit the kinds, choose one, and judge how far the data hold it."""
    odd = samples.site % 2 == 1
    trials = _try_kinds(kind, samples.take(~odd), samples.take(odd), first)
    chosen = kind if kind != "auto" else choose_kind(trials)
    final = _refine(trials[chosen], samples, may_be_wrong)
    table = replace(trials["table"], suspect=final.suspect)
    left = _residual(log_lookup(final.curve), samples, final.correction_ev)
    use = samples.measured & (np.abs(left) < 6.0 * max(_rms(left[samples.measured]), 0.3))
    misfit = structure = residual_structure(samples.grey[use], left[use])
    if kind not in ("auto", "table"):
        misfit = max(misfit, curve_distance_levels(table.curve, final.curve, (table.curve.x[1], 1.0)))
    scatter_ev = _scatter_ev(table)
    return _Verdict(trials, chosen, final, _posterior(table, samples, scatter_ev), structure, misfit, scatter_ev)


def _scatter_ev(trial: _Trial) -> float:
    """Standard deviation of the believed corrections; two numbers are taken off them, level and trend."""
    believed = trial.correction_ev[~trial.suspect]
    return float(np.sqrt((believed**2).sum() / max(len(believed) - 2, 1)))


# ── refusals ─────────────────────────────────────────────────────────────────────────────────────────────────────


def _require_bracket(pictures: Sequence[BracketPicture]) -> None:
    if len(pictures) < 2:
        text = f"{len(pictures)} picture{'s' * (len(pictures) != 1)}: a curve needs the scene at several exposures"
        raise CalibrationError(text, hint="take five or more, 1 EV apart")
    listed = [p.exposure for p in pictures]
    if max(listed) / min(listed) < MIN_RATIO:
        text = f"all {len(pictures)} pictures have one exposure (largest/smallest {max(listed) / min(listed):.3f})"
        raise CalibrationError(text, hint="take the scene at exposures from dark to bright, 1 EV apart")


def _keep_connected(
    pictures: Sequence[BracketPicture], kept: NDArray[np.bool_], samples: BracketSamples
) -> tuple[NDArray[np.bool_], BracketSamples]:
    """Which of all pictures are kept, of those kept already, and their samples."""
    seen = _connected([p for p, k in zip(pictures, kept, strict=True) if k], samples)
    kept = kept.copy()
    kept[kept] = seen
    samples = samples.keep_pictures(seen)
    return kept, samples.take(samples.measured.sum(axis=1) >= 2)


def _connected(pictures: Sequence[BracketPicture], samples: BracketSamples) -> NDArray[np.bool_]:
    """Which pictures are not clipped throughout. Raises CalibrationError where the rest fall into unrelated parts."""
    measured = samples.measured.astype(np.int64)
    shared = measured.T @ measured
    seen = np.diag(shared) >= MIN_SHARED
    numbers = np.flatnonzero(seen)
    if len(numbers) < 2:
        text = f"{len(numbers)} of {len(pictures)} pictures are not clipped throughout"
        raise CalibrationError(text, hint="take exposures closer together")
    reached = {int(numbers[0])}
    while True:
        more = {int(n) for n in numbers if any(shared[n, m] >= MIN_SHARED for m in reached)} - reached
        if not more:
            break
        reached |= more
    lost = sorted(set(numbers.tolist()) - reached)
    if lost:
        text = f"the usable greys of {pictures[lost[0]].file} do not overlap with those of {pictures[numbers[0]].file}"
        raise CalibrationError(f"no overlap: {text}", hint="take exposures closer together, at most 3 EV apart")
    return seen


def _require_determined(verdict: _Verdict) -> None:
    """Raises CalibrationError where a kind with free parameters is chosen among curves that the data do not tell apart.

    A kind without any is another matter: it says before all measurement what every picture must show.
    """
    open_levels = verdict.posterior.rms_levels
    if len(verdict.final.parameters) and open_levels > UNDETERMINED_LEVELS:
        text = f"the pictures do not determine the curve: it could differ by {open_levels:.0f} grey levels rms"
        raise CalibrationError(text, hint="take more exposures, closer together, of a scene with many brightnesses")


def _still_rows(samples: BracketSamples, first: FirstCurve) -> NDArray[np.bool_]:
    """Samples that one light explains at every exposure. Raises CalibrationError where too many do not.

    A scene that moves is wrong at most exposures; what a movie's codec gets wrong at one exposure, it does at all
    places: so the refusal goes by the rms over the exposures, and single misses are judged by what is usual.
    """
    miss = np.where(samples.measured, np.abs(_first_residual(samples, first)), 0.0)
    limit = max(MOVED_LEVELS, 8.0 * float(samples.sigma.max()))
    rms = np.sqrt((miss**2).sum(axis=1) / np.maximum(samples.measured.sum(axis=1), 1))
    moved = rms > limit
    if moved.mean() > MAX_MOVED:
        text = f"the scene is not still, or the exposures are wrong throughout: {moved.mean():.0%} of the places change"
        raise CalibrationError(
            f"{text} by more than {MOVED_LEVELS:g} grey levels against any curve",
            hint="take a still scene in steady light from a tripod",
        )
    worst = miss.max(axis=1)
    return worst <= max(limit, USUAL_MISSES * float(np.median(worst)))


def _first_residual(samples: BracketSamples, first: FirstCurve) -> Array:
    """Grey levels by which measurement and first curve differ, (samples, pictures)."""
    lookup = LogLookup(first.log_light, first.grey, np.gradient(first.grey, first.log_light))
    log_t = np.log(samples.exposure) + LN2 * first.correction_ev
    return samples.grey - lookup.level(_project(lookup, samples, log_t)[:, None] + log_t)


def _with_scatter(samples: BracketSamples, first: FirstCurve) -> BracketSamples:
    """The samples with the noise that their scatter about a first curve shows, where that is more than squares do."""
    scatter = scatter_by_grey(_first_residual(samples, first), samples.grey, samples.channel, samples.measured)
    missing = np.full((len(samples.noise.variance) - len(scatter), scatter.shape[1]), np.nan)
    return replace(samples, noise=samples.noise.at_least(np.concatenate([scatter, missing])))


def _fairly_seen(samples: BracketSamples, first: FirstCurve) -> BracketSamples:
    """The samples with those greys told that only noise puts between the limits, or beyond them."""
    lookup = LogLookup(first.log_light, first.grey, np.gradient(first.grey, first.log_light))
    log_t = np.log(samples.exposure) + LN2 * first.correction_ev
    fair = np.zeros(samples.grey.shape, bool)
    for channel in np.unique(samples.channel):
        rows = samples.channel == channel
        of_channel = samples.take(rows)
        limits, sigma = of_channel.limits, of_channel.sigma
        light = np.stack([_project(lookup, of_channel.without(n), log_t) for n in range(len(log_t))], axis=1)
        fair[rows] = fairly_inside(of_channel.grey, light, limits, sigma)
    return replace(samples, fair=fair)


# ── variable projection ──────────────────────────────────────────────────────────────────────────────────────────


def _project(lookup: LogLookup, samples: BracketSamples, log_t: Array, rounds: int = 2) -> Array:
    """Log light of each sample: weighted mean of its linearised greys, then Gauss–Newton in grey levels, (samples,)."""
    linear = lookup.light(samples.grey)
    weight = np.where(samples.measured, (lookup.rise(linear) / samples.sigma) ** 2, 0.0) + 1e-12
    log_light = (weight * (linear - log_t)).sum(axis=1) / weight.sum(axis=1)
    inverse = np.where(samples.measured, 1.0 / samples.sigma**2, 0.0)
    for _ in range(rounds):
        at = (log_light + log_t[:, None]).T
        slope = lookup.rise(at)
        pull = (inverse * slope * (samples.grey - lookup.level(at))).sum(axis=1)
        step = pull / np.maximum((inverse * slope**2).sum(axis=1), 1e-9)
        log_light = log_light + np.clip(step, -0.5, 0.5)
    return log_light


def _residual(lookup: LogLookup, samples: BracketSamples, correction_ev: Array) -> Array:
    """Grey levels by which measurement and model differ, (samples, pictures); censored ones where they contradict."""
    log_t = np.log(samples.exposure) + LN2 * correction_ev
    level = lookup.level((_project(lookup, samples, log_t) + log_t[:, None]).T)
    left = samples.grey - level
    lowest, highest = samples.limits
    slack = 0.0 if samples.fair is None else FAIR_SIGMA * samples.sigma
    high = np.where(samples.grey >= highest, np.maximum(highest - slack - level, 0.0), left)
    both = np.where(samples.grey <= lowest, np.minimum(lowest + slack - level, 0.0), high)
    inside = (samples.grey > lowest) & (samples.grey < highest)
    return np.where(inside & ~samples.measured, 0.0, both)


@dataclass(frozen=True, slots=True)
class _Trial:
    """One kind, fitted."""

    family: Family
    curve: ResponseCurve
    parameters: Array
    correction_ev: Array
    suspect: NDArray[np.bool_]
    score: Array
    """(held-out samples,) capped sum of squared normalised residuals."""
    site: NDArray[np.int64]
    held_out_rms: float
    trend_row: Array
    """(pictures,) unit pattern of a trend over log exposure."""

    @property
    def bent(self) -> bool:
        """Whether the believed exposures need a trend, as they do where the curve wants another power."""
        believed = self.correction_ev[~self.suspect]
        trend = float(self.trend_row[~self.suspect] @ believed) ** 2
        scatter = max(float(believed @ believed) - trend, 0.0) / max(len(believed) - 2, 1)
        return trend > Z_REJECTED**2 * max(scatter, TRUSTED_EV**2)


def _require_possible(first: FirstCurve, samples: BracketSamples) -> None:
    """Raise CalibrationError where the exposures fit no curve but by corrections that no list of them needs.

    So it is where most pictures were taken at one exposure whatever the list says: any curve is then flat.
    """
    worst = float(np.abs(first.correction_ev).max())
    if worst >= WIDEST_EV:
        listed = np.log2(samples.exposure)
        raise CalibrationError(
            f"the listed exposures, {np.ptp(listed):.1f} EV apart, would need corrections of up to {worst:.0f} EV: "
            "they are not those of the pictures",
            hint="check the list against the pictures; several may have been taken at one exposure",
        )


def _optimise(family: Family, start: Array, samples: BracketSamples, suspect: NDArray[np.bool_],
              evaluations: int = 30) -> tuple[Array, Array]:  # fmt: skip
    """(curve parameters, corrections in EV) of least cost, the sizes of the residuals held down (soft L1)."""
    samples, shape = samples.by_light(), len(family.start)
    belief = np.where(suspect, FREE_EV, TRUSTED_EV)
    rows = _trend_rows(samples.exposure, suspect)[: 1 + family.bends]
    no_trend = np.eye(len(suspect)) - rows.T @ rows

    def miss(q: Array) -> Array:
        lookup = log_lookup(family.build(q[:shape]))
        correction = no_trend @ q[shape:]
        parts = [(_residual(lookup, samples, correction) / samples.sigma).ravel() / 2.0, q[shape:] / belief]
        if family.smoothness:
            parts.append(SMOOTH_WEIGHT * family.smoothness(q[:shape]))
        return np.concatenate(parts)

    def jacobian(q: Array) -> Array:
        base = miss(q)
        columns = np.empty((len(base), len(q)))
        for i in range(len(q)):
            h = -STEP if i < shape and q[i] + STEP > family.upper[i] else STEP
            columns[:, i] = (miss(q + h * np.eye(1, len(q), i)[0]) - base) / h
        return columns

    wide = np.full(len(suspect), WIDEST_EV)
    bounds = (np.concatenate([family.lower, -wide]), np.concatenate([family.upper, wide]))
    found = least_squares(miss, start, jac=jacobian, bounds=bounds, loss="soft_l1", max_nfev=evaluations,
                          ftol=1e-6, xtol=1e-7, gtol=1e-8)  # fmt: skip
    return found.x[:shape], no_trend @ found.x[shape:]


def _trend_rows(exposure: Array, suspect: NDArray[np.bool_]) -> Array:
    """(2, pictures), orthonormal: level and trend over log exposure of the corrections of believed pictures.

    A level is a unit of light and forbidden.  So is a trend where the curve has a power of its own, for it would be
    that in disguise; where it has none, the belief in the listed exposures holds the trend.
    """
    believed = (~suspect).astype(float)
    level = believed / np.sqrt(believed.sum())
    log_t = np.log(exposure)
    trend = believed * (log_t - (believed @ log_t) / believed.sum())
    return np.stack([level, trend / max(float(np.linalg.norm(trend)), 1e-12)])


def _try_kinds(kind: str, fit: BracketSamples, held: BracketSamples, first: FirstCurve) -> dict[str, _Trial]:
    names = ("linear", "srgb", "gamma", "five_segment", "table") if kind == "auto" else (kind, "table")
    trials = {}
    for name in dict.fromkeys(names):
        family = make_family(name, first, fit.low, fit.high, fit.top)
        trials[name] = _judge(family, *_from_best_start(family, fit, first), first.suspect, held)
    return trials


def _from_best_start(family: Family, fit: BracketSamples, first: FirstCurve) -> tuple[Array, Array]:
    """Follow the best of the family's starts; which is best, a thinned sample decides."""
    correction = np.where(first.suspect, first.correction_ev, 0.0)
    starts = [np.concatenate([p, correction]) for p in (family.start, *family.others)]
    if len(starts) > 1:
        thin = fit.take(np.arange(len(fit.grey))[:: max(len(fit.grey) // 300, 1)])
        tried = [_optimise(family, start, thin, first.suspect, 12) for start in starts]
        costs = [float(np.abs(_residual(log_lookup(family.build(p)), thin, c) / thin.sigma).sum()) for p, c in tried]
        starts = [np.concatenate(tried[int(np.argmin(costs))])]
    return _optimise(family, starts[0], fit, first.suspect)


def _judge(
    family: Family, parameters: Array, correction_ev: Array, suspect: NDArray[np.bool_], held: BracketSamples
) -> _Trial:
    curve = family.build(parameters)
    left = _residual(log_lookup(curve), held, correction_ev)
    score = np.minimum((left / held.sigma) ** 2, SCORE_CAP).sum(axis=1)
    rms, trend_row = _capped_rms(left[held.measured]), _trend_rows(held.exposure, suspect)[1]
    return _Trial(family, curve, parameters, correction_ev, suspect, score, held.site, rms, trend_row)


def _rms(residual: Array) -> float:
    """Root mean square without outliers (beyond six robust deviations)."""
    if not residual.size:
        return 0.0
    limit = 6.0 * 1.4826 * float(np.median(np.abs(residual))) + 1e-9
    inside = residual[np.abs(residual) <= limit]
    return float(np.sqrt(np.mean(inside**2)))


def _capped_rms(residual: Array) -> float:
    """Root mean square, no residual counted beyond OUTLIER_LEVELS: comparable between kinds that miss differently."""
    return float(np.sqrt(np.mean(np.minimum(np.abs(residual), OUTLIER_LEVELS) ** 2))) if residual.size else 0.0


def choose_kind(trials: dict[str, _Trial]) -> str:
    """The simplest kind that needs no trend of the exposures, and is not significantly worse at held-out places."""
    for name in KINDS:
        if (
            name in trials
            and not trials[name].bent
            and not any(_beaten(trials[name], other) for n, other in trials.items() if n != name)
        ):
            return name
    return "table"


def _beaten(one: _Trial, other: _Trial) -> bool:
    """Whether the other predicts held-out places better: a paired test by place, and by more than a trifle."""
    _, index = np.unique(one.site, return_inverse=True)
    gain = np.bincount(index, one.score - other.score)
    if one.held_out_rms**2 - other.held_out_rms**2 < DISTINCT_LEVELS**2:
        return False
    return bool(gain.mean() > Z_REJECTED * gain.std() / np.sqrt(len(gain)))


def _refine(trial: _Trial, samples: BracketSamples, may_be_wrong: NDArray[np.bool_]) -> _Trial:
    """Fit again with all samples; a picture whose correction now stands out is set free too, where it may be."""
    start = np.concatenate([trial.parameters, trial.correction_ev])
    suspect = trial.suspect
    for _ in range(2):
        parameters, correction = _optimise(trial.family, start, samples, suspect, 10)
        wide = suspect | (outlying(correction) & (np.abs(correction) > 0.6 * CONTRADICTS_EV) & may_be_wrong)
        start = np.concatenate([parameters, correction])
        if (wide == suspect).all():
            break
        suspect = wide
    suspect = suspect & (np.abs(correction - np.median(correction)) > CONTRADICTS_EV)
    return _judge(trial.family, parameters, correction, suspect, samples)


def _posterior(trial: _Trial, samples: BracketSamples, scatter_ev: float) -> CurvePosterior:
    """What the samples leave open of a fit; exposures are believed no better than they agree."""

    def residual(curve: ResponseCurve, correction_ev: Array) -> Array:
        return _residual(log_lookup(curve), samples, correction_ev)

    left = residual(trial.curve, trial.correction_ev)
    used = samples.measured & (np.abs(left) < 6.0 * np.maximum(samples.sigma, _rms(left[samples.measured])))
    belief = np.where(trial.suspect, FREE_EV, max(TRUSTED_EV, scatter_ev))
    return curve_posterior(trial.family, trial.parameters, trial.correction_ev, residual, samples.sigma, samples.grey,
                           used, belief)  # fmt: skip


# ── what the fit says of itself ──────────────────────────────────────────────────────────────────────────────────


def residual_structure(grey: Array, residual: Array, bins: int = 16) -> float:
    """Size in grey levels of what the residuals share at one grey: rms of their means by grey, noise taken off."""
    place = np.digitize(grey, np.quantile(grey, np.linspace(0, 1, bins + 1)[1:-1]))
    number = np.bincount(place, minlength=bins)
    good = number > 20
    mean = np.bincount(place, residual, minlength=bins)[good] / number[good]
    square = np.bincount(place, residual**2, minlength=bins)[good] / number[good]
    excess = mean**2 - (square - mean**2) / number[good]
    return float(np.sqrt(max(float(excess.mean()), 0.0))) if good.any() else 0.0


def _criticise(verdict: _Verdict, samples: BracketSamples) -> list[str]:
    notes = []
    chosen, trials, final, structure = verdict.chosen, verdict.trials, verdict.final, verdict.structure_levels
    tabulated = trials["table"]
    if chosen != "table" and _beaten(trials[chosen], tabulated):
        before = trials[chosen].held_out_rms
        gain = 1.0 - tabulated.held_out_rms / max(before, 1e-9)
        notes.append(
            f"{chosen} does not follow the data: residuals share {structure:.2f} grey levels at one grey; a table "
            f"lowers the held-out rms from {before:.2f} to {tabulated.held_out_rms:.2f} ({gain:.0%}): "
            "--kind table"
        )
    elif structure > STRUCTURE_LEVELS:
        notes.append(f"structure in the residuals over grey level: {structure:.2f} levels that no kind explains")
    if chosen == "table" and "five_segment" in trials:
        five = trials["five_segment"].held_out_rms
        table = tabulated.held_out_rms
        notes.append(f"no simpler kind follows: held-out rms {five:.2f} with five_segment, {table:.2f} with table")
    if verdict.scatter_ev > SCATTER_EV:
        notes.append(
            f"the listed exposures agree to {verdict.scatter_ev:.2f} EV only: flicker, or several are wrong "
            "(is ISO counted?) and too few right to tell which"
        )
    if len(samples.exposure) < MIN_PICTURES:
        notes.append(f"{len(samples.exposure)} pictures are too few to find wrong exposures")
    if samples.exposure.max() / samples.exposure.min() < FEW_RATIO:
        span = np.log2(samples.exposure.max() / samples.exposure.min())
        notes.append(f"exposures span only {span:.1f} EV: the curve is weakly determined")
    open_levels = verdict.posterior.rms_levels
    if open_levels > OPEN_LEVELS:
        notes.append(
            f"the pictures hold the curve to {open_levels:.1f} grey levels rms only"
            f"{', the rest is the kind' * (chosen != 'table')}: more exposures, closer together, hold it better"
        )
    if (final.curve.encode(np.array([1.0])) * 255)[0] - samples.top > 25:
        notes.append(f"no grey above {samples.top:.0f} was seen: the curve is extrapolated there")
    return notes


def _result(
    pictures: Sequence[BracketPicture],
    seen: NDArray[np.bool_],
    verdict: _Verdict,
    samples: BracketSamples,
    notes: list[str],
) -> CurveFit:
    final = verdict.final
    log_t = np.log(samples.exposure) + LN2 * final.correction_ev
    lookup = log_lookup(final.curve)
    left = _residual(lookup, samples, final.correction_ev)
    log_light = _project(lookup, samples, log_t)[:, None] + log_t
    use = samples.measured
    ends = lookup.light(np.quantile(samples.grey[use], [0.001, 0.999]))
    scale = float(np.exp(ends[1])) if final.family.kind in ("five_segment", "table") else 1.0
    cloud = DataCloud(np.exp(log_light[use]) / scale, samples.grey[use], left[use], np.nonzero(use)[1])
    verdicts = _verdicts(pictures, seen, final)
    for picture in verdicts:
        if picture.contradicts:
            notes.append(
                f"{picture.file}: its listed exposure {picture.exposure:.6g} contradicts the others by "
                f"{picture.exposure_error_ev:+.2f} EV; likely {picture.likely_exposure:.6g}"
            )
    return CurveFit(
        scale_exposure(final.curve, scale),
        _rms(left[use]),
        float(np.hypot(verdict.std_levels, samples.ends.spread_levels if samples.ends.apart else 0.0)),
        (float(np.exp(ends[0]) / scale), float(np.exp(ends[1]) / scale)),
        verdicts,
        tuple(notes),
        {name: trial.held_out_rms for name, trial in verdict.trials.items()},
        cloud,
    )


def _verdicts(pictures: Sequence[BracketPicture], seen: NDArray[np.bool_], final: _Trial) -> tuple[PictureFit, ...]:
    believed = final.correction_ev[~final.suspect]
    error = np.full(len(pictures), np.nan)
    error[seen] = (np.median(believed) if len(believed) else 0.0) - final.correction_ev
    contradicts = np.zeros(len(pictures), bool)
    contradicts[seen] = final.suspect
    return tuple(
        PictureFit(p.file, p.exposure, None if np.isnan(e) else float(e), bool(c))
        for p, e, c in zip(pictures, error, contradicts, strict=True)
    )


def scale_exposure(curve: ResponseCurve, unit: float) -> ResponseCurve:
    """The same curve over exposures counted in ``unit``; only kinds that carry their own axis change."""
    if curve.kind == "five_segment":
        return replace(curve, b=(curve.b[0] / unit, curve.b[1]), c=(curve.c[0] / unit, curve.c[1]))
    if curve.kind == "table":
        return replace(curve, x=tuple(x / unit for x in curve.x))
    return curve


def curve_distance_levels(
    curve: ResponseCurve, truth: ResponseCurve, exposure: tuple[float, float], points: int = 400
) -> float:
    """Rms difference of two curves in grey levels over a range of ``curve``'s exposures, at the best common scale.

    The exposure axis has no absolute scale, so the factor between the two axes that makes them most alike is taken.
    The points lie evenly in the grey of ``curve``.
    """
    ends = curve.encode(np.array(exposure))
    light = np.unique(curve.linearise(np.linspace(float(ends[0]), float(ends[1]), points)))
    grey = 255.0 * curve.encode(light)

    def miss(log_scale: float) -> float:
        return float(np.sqrt(np.mean((255.0 * truth.encode(light * np.exp(log_scale)) - grey) ** 2)))

    trials = np.linspace(-6, 6, 481)
    best = float(trials[int(np.argmin([miss(t) for t in trials]))])
    return float(minimize_scalar(miss, bounds=(best - 0.05, best + 0.05), method="bounded").fun)
