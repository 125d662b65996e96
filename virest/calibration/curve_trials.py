"""Families of curves tried on a bracket: light projected out, each fitted from its best start, the simplest kept."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from virest.calibration.bracket_samples import BracketSamples
from virest.calibration.curve_certainty import CurvePosterior, curve_posterior, derivatives, inner_steps
from virest.calibration.curve_families import Family, LogLookup, log_lookup, make_family
from virest.calibration.exposure_check import CONTRADICTS_EV, LN2, FirstCurve, outlying
from virest.calibration.grey_levels import FAIR_SIGMA
from virest.camera.response import KINDS, ResponseCurve
from virest.errors import CalibrationError
from virest.inference.robust import robust_std

Array = NDArray[np.float64]
TRUSTED_EV = 0.02
"""Standard deviation of a listed exposure that is believed."""
FREE_EV = 4.0
OUTLIER_LEVELS = 20.0
WIDEST_EV = 20.0
"""Corrections of listed exposures are sought up to this; cameras' shutters span less."""
SMOOTH_WEIGHT = 5.0
"""Of a table's roughness in the fit, against samples that count as if their errors were independent."""
SCORE_CAP = 16.0
"""The most that one grey, in units of its variance, counts against a curve."""
Z_REJECTED = 3.0
DISTINCT_LEVELS = 0.25
"""Smaller systematic differences between two kinds are left to rounding and compression."""
STRUCTURE_LEVELS = 0.3


def project(lookup: LogLookup, samples: BracketSamples, log_t: Array, rounds: int = 2) -> Array:
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


def residual_of(lookup: LogLookup, samples: BracketSamples, correction_ev: Array) -> Array:
    """Grey levels by which measurement and model differ, (samples, pictures); censored ones where they contradict."""
    return _left(lookup.level(_seen_light(lookup, samples, correction_ev)), samples)


def _seen_light(lookup: LogLookup, samples: BracketSamples, correction_ev: Array) -> Array:
    """Log light (samples, pictures) that reaches the curve."""
    log_t = np.log(samples.exposure) + LN2 * correction_ev
    return np.asarray((project(lookup, samples, log_t) + log_t[:, None]).T)


def _left(level: Array, samples: BracketSamples) -> Array:
    """What a curve's levels (samples, pictures) leave of the measured ones."""
    left = samples.grey - level
    lowest, highest = samples.limits
    slack = 0.0 if samples.fair is None else FAIR_SIGMA * samples.sigma
    high = np.where(samples.grey >= highest, np.maximum(highest - slack - level, 0.0), left)
    both = np.where(samples.grey <= lowest, np.minimum(lowest + slack - level, 0.0), high)
    inside = (samples.grey > lowest) & (samples.grey < highest)
    return np.where(inside & ~samples.measured, 0.0, both)


def slopes_of(family: Family, parameters: Array, correction_ev: Array, samples: BracketSamples) -> Array:
    """Change (pictures, samples, k) of :func:`residual_of` per parameter of the curve, then per correction.

    Each place's light follows: it stays the weighted mean of what its greys ask for (Kaufman 1975,
    doi:10.1007/BF01932995, for variable projection), so that only the curve is looked up anew for each parameter.
    """
    here, shape = log_lookup(family.build(parameters)), len(parameters)
    at = _seen_light(here, samples, correction_ev)
    level, slope = here.level(at), here.rise(at)
    pull = np.where(samples.measured, slope / samples.sigma**2, 0.0)
    share = pull / np.maximum((pull * slope).sum(axis=1), 1e-9)[:, None]
    moves = samples.measured | (_left(level, samples) != 0)
    slopes = np.empty((samples.grey.shape[1], len(samples.grey), shape + samples.grey.shape[1]))
    for i, h in enumerate(inner_steps(parameters, family.upper)):
        raised = (log_lookup(family.build(parameters + h * np.eye(1, shape, i)[0])).level(at) - level) / h
        slopes[..., i] = ((slope * (share * raised).sum(axis=1)[:, None] - raised) * moves).T
    for n in range(samples.grey.shape[1]):
        raised = LN2 * slope[:, n]
        slopes[..., shape + n] = (slope * (share[:, n] * raised)[:, None] * moves).T
        slopes[n, :, shape + n] -= raised * moves[:, n]
    return slopes


@dataclass(frozen=True, slots=True)
class Trial:
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


def require_possible(first: FirstCurve, samples: BracketSamples) -> None:
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


def optimise(family: Family, start: Array, samples: BracketSamples, suspect: NDArray[np.bool_],
              evaluations: int = 30) -> tuple[Array, Array]:  # fmt: skip
    """(curve parameters, corrections in EV) of least cost, the sizes of the residuals held down (soft L1)."""
    samples, shape = samples.by_light(), len(family.start)
    belief = np.where(suspect, FREE_EV, TRUSTED_EV)
    rows = _trend_rows(samples.exposure, suspect)[: 1 + family.bends]
    no_trend = np.eye(len(suspect)) - rows.T @ rows

    def miss(q: Array) -> Array:
        left = residual_of(log_lookup(family.build(q[:shape])), samples, no_trend @ q[shape:])
        parts = [(left / samples.sigma).T.ravel() / 2.0, q[shape:] / belief]
        if family.smoothness:
            parts.append(SMOOTH_WEIGHT * family.smoothness(q[:shape]))
        return np.concatenate(parts)

    def jacobian(q: Array) -> Array:
        slopes = slopes_of(family, q[:shape], no_trend @ q[shape:], samples) / (2.0 * samples.sigma.T[..., None])
        slopes[..., shape:] = slopes[..., shape:] @ no_trend
        parts = [slopes.reshape(-1, len(q)), np.eye(len(q))[shape:] / belief[:, None]]
        if family.smoothness:
            rough = derivatives(family.smoothness, q[:shape], family.upper)
            parts.append(SMOOTH_WEIGHT * np.pad(rough, ((0, 0), (0, len(suspect)))))
        return np.concatenate(parts)

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


def try_kinds(kind: str, fit: BracketSamples, held: BracketSamples, first: FirstCurve) -> dict[str, Trial]:
    """The kind that was asked for and a table, or all: each fitted to samples and judged on those held back."""
    names = ("linear", "srgb", "gamma", "five_segment", "table") if kind == "auto" else (kind, "table")
    trials = {}
    for name in dict.fromkeys(names):
        family = make_family(name, first, fit.low, fit.high, fit.top)
        trials[name] = judged(family, *_from_best_start(family, fit, first), first.suspect, held)
    return trials


def _from_best_start(family: Family, fit: BracketSamples, first: FirstCurve) -> tuple[Array, Array]:
    """Follow the best of the family's starts; which is best, a thinned sample decides."""
    correction = np.where(first.suspect, first.correction_ev, 0.0)
    starts = [np.concatenate([p, correction]) for p in (family.start, *family.others)]
    if len(starts) > 1:
        thin = fit.take(np.arange(len(fit.grey))[:: max(len(fit.grey) // 300, 1)])
        tried = [optimise(family, start, thin, first.suspect, 12) for start in starts]
        costs = [float(np.abs(residual_of(log_lookup(family.build(p)), thin, c) / thin.sigma).sum()) for p, c in tried]
        starts = [np.concatenate(tried[int(np.argmin(costs))])]
    return optimise(family, starts[0], fit, first.suspect)


def judged(
    family: Family, parameters: Array, correction_ev: Array, suspect: NDArray[np.bool_], held: BracketSamples
) -> Trial:
    """A fitted curve, judged on samples that took no part."""
    curve = family.build(parameters)
    left = residual_of(log_lookup(curve), held, correction_ev)
    score = np.minimum((left / held.sigma) ** 2, SCORE_CAP).sum(axis=1)
    rms, trend_row = capped_rms(left[held.measured]), _trend_rows(held.exposure, suspect)[1]
    return Trial(family, curve, parameters, correction_ev, suspect, score, held.site, rms, trend_row)


def rms_levels(residual: Array) -> float:
    """Root mean square without outliers (beyond six robust deviations)."""
    if not residual.size:
        return 0.0
    limit = 6.0 * robust_std(residual) + 1e-9
    inside = residual[np.abs(residual) <= limit]
    return float(np.sqrt(np.mean(inside**2)))


def capped_rms(residual: Array) -> float:
    """Root mean square, no residual counted beyond OUTLIER_LEVELS: comparable between kinds that miss differently."""
    return float(np.sqrt(np.mean(np.minimum(np.abs(residual), OUTLIER_LEVELS) ** 2))) if residual.size else 0.0


def choose_kind(trials: dict[str, Trial]) -> str:
    """The simplest kind that needs no trend of the exposures, and is not significantly worse at held-out places."""
    for name in KINDS:
        if (
            name in trials
            and not trials[name].bent
            and not any(_beaten(trials[name], other) for n, other in trials.items() if n != name)
        ):
            return name
    return "table"


def _beaten(one: Trial, other: Trial) -> bool:
    """Whether the other predicts held-out places better: a paired test by place, and by more than a trifle."""
    _, index = np.unique(one.site, return_inverse=True)
    gain = np.bincount(index, one.score - other.score)
    if one.held_out_rms**2 - other.held_out_rms**2 < DISTINCT_LEVELS**2:
        return False
    return bool(gain.mean() > Z_REJECTED * gain.std() / np.sqrt(len(gain)))


def refined(trial: Trial, samples: BracketSamples, may_be_wrong: NDArray[np.bool_]) -> Trial:
    """Fit again with all samples; a picture whose correction now stands out is set free too, where it may be."""
    start = np.concatenate([trial.parameters, trial.correction_ev])
    suspect = trial.suspect
    for _ in range(2):
        parameters, correction = optimise(trial.family, start, samples, suspect, 10)
        wide = suspect | (outlying(correction) & (np.abs(correction) > 0.6 * CONTRADICTS_EV) & may_be_wrong)
        start = np.concatenate([parameters, correction])
        if (wide == suspect).all():
            break
        suspect = wide
    suspect = suspect & (np.abs(correction - np.median(correction)) > CONTRADICTS_EV)
    return judged(trial.family, parameters, correction, suspect, samples)


def posterior_of(trial: Trial, samples: BracketSamples, scatter_ev: float) -> CurvePosterior:
    """What the samples leave open of a fit; exposures are believed no better than they agree."""
    left = residual_of(log_lookup(trial.curve), samples, trial.correction_ev)
    used = samples.measured & (np.abs(left) < 6.0 * np.maximum(samples.sigma, rms_levels(left[samples.measured])))
    belief = np.where(trial.suspect, FREE_EV, max(TRUSTED_EV, scatter_ev))
    slopes = slopes_of(trial.family, trial.parameters, trial.correction_ev, samples)
    return curve_posterior(trial.family, trial.parameters, left, slopes, samples.sigma, samples.grey, used, belief)
