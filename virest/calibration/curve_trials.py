"""Fit families of curves to a bracket by variable projection, and choose the simplest that predicts held-out sites."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from virest.arrays import Array, Mask
from virest.calibration.bracket_samples import BracketSamples
from virest.calibration.curve_certainty import CurvePosterior, curve_posterior, derivatives, inner_steps
from virest.calibration.curve_families import Family, LogLookup, log_lookup, make_family
from virest.calibration.exposure_check import CONTRADICTS_EV, LN2, FirstCurve, outlying
from virest.calibration.grey_levels import RELIABLE_SIGMA
from virest.camera.response import KINDS, ResponseCurve
from virest.errors import CalibrationError
from virest.inference.robust import robust_std

TRUSTED_EV = 0.02
"""Prior standard deviation of a trusted listed exposure."""
FREE_EV = 4.0
"""Prior standard deviation of a suspect listed exposure."""
OUTLIER_LEVELS = 20.0
"""Residuals are capped at this, grey levels, before kinds are compared; half or twice it changed no simulated fit."""
WIDEST_EV = 20.0
"""Bound on exposure corrections; a camera's shutter range is smaller."""
SMOOTH_WEIGHT = 5.0
"""Weight of a table's roughness in the fit, which treats sample errors as independent."""
SCORE_CAP = 16.0
"""Maximum squared normalised residual of one grey in a score."""
SIGNIFICANT_Z = 3.0
"""Standard deviations above which a difference is none by chance (1 in 370)."""
DISTINCT_LEVELS = 0.25
"""Systematic differences between two kinds below this are attributed to rounding and compression."""
STRUCTURE_LEVELS = 0.3
"""Residual structure above this is reported."""


def project(lookup: LogLookup, samples: BracketSamples, log_t: Array, rounds: int = 2) -> Array:
    """Log light (samples,): weighted mean of the linearised greys, refined by Gauss–Newton steps in grey levels."""
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
    """Measured minus predicted grey levels (samples, pictures); censored greys count only if contradicted."""
    return _residual(lookup.level(_log_exposure(lookup, samples, correction_ev)), samples)


def _log_exposure(lookup: LogLookup, samples: BracketSamples, correction_ev: Array) -> Array:
    """Log of light × exposure time (samples, pictures), the input of the curve."""
    log_t = np.log(samples.exposure) + LN2 * correction_ev
    return np.asarray((project(lookup, samples, log_t) + log_t[:, None]).T)


def _residual(level: Array, samples: BracketSamples) -> Array:
    """Measured minus predicted levels (samples, pictures), one-sided for censored greys, 0 for unreliable ones."""
    difference = samples.grey - level
    lowest, highest = samples.limits
    slack = 0.0 if samples.reliable is None else RELIABLE_SIGMA * samples.sigma
    high = np.where(samples.grey >= highest, np.maximum(highest - slack - level, 0.0), difference)
    both = np.where(samples.grey <= lowest, np.minimum(lowest + slack - level, 0.0), high)
    inside = (samples.grey > lowest) & (samples.grey < highest)
    return np.where(inside & ~samples.measured, 0.0, both)


def slopes_of(family: Family, parameters: Array, correction_ev: Array, samples: BracketSamples) -> Array:
    """Derivatives (pictures, samples, k) of :func:`residual_of` by curve parameter, then by exposure correction.

    Each sample's light adapts as the weighted mean of the light its greys imply (Kaufman's approximation for variable
    projection, 1975, doi:10.1007/BF01932995), so only the curve is evaluated again for each parameter.
    """
    lookup, shape = log_lookup(family.build(parameters)), len(parameters)
    at = _log_exposure(lookup, samples, correction_ev)
    level, slope = lookup.level(at), lookup.rise(at)
    pull = np.where(samples.measured, slope / samples.sigma**2, 0.0)
    share = pull / np.maximum((pull * slope).sum(axis=1), 1e-9)[:, None]
    moves = samples.measured | (_residual(level, samples) != 0)
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
    """A fitted kind of curve and its score."""

    family: Family
    curve: ResponseCurve
    parameters: Array
    correction_ev: Array
    suspect: Mask
    score: Array
    """(held-out samples,) sum of capped squared normalised residuals."""
    site: NDArray[np.int64]
    held_out_rms: float
    trend_row: Array
    """(pictures,) unit vector of a trend over log exposure."""

    @property
    def needs_trend(self) -> bool:
        """Whether the trusted exposures need a significant trend, which shows that the curve needs another exponent."""
        trusted = self.correction_ev[~self.suspect]
        trend = float(self.trend_row[~self.suspect] @ trusted) ** 2
        scatter = max(float(trusted @ trusted) - trend, 0.0) / max(len(trusted) - 2, 1)
        return trend > SIGNIFICANT_Z**2 * max(scatter, TRUSTED_EV**2)


def require_possible(first: FirstCurve, samples: BracketSamples) -> None:
    """Raise CalibrationError if the exposures fit a curve only with implausibly large corrections.

    This happens if most pictures were taken at one exposure, whatever the list says: any curve is then flat.
    """
    worst = float(np.abs(first.correction_ev).max())
    if worst >= WIDEST_EV:
        listed = np.log2(samples.exposure)
        raise CalibrationError(
            f"the listed exposures, {np.ptp(listed):.1f} EV apart, would need corrections of up to {worst:.0f} EV: "
            "they are not those of the pictures",
            hint="check the list against the pictures; several may have been taken at one exposure",
        )


def optimise(family: Family, start: Array, samples: BracketSamples, suspect: Mask,
              evaluations: int = 30) -> tuple[Array, Array]:  # fmt: skip
    """Curve parameters and exposure corrections (EV) of least cost, with a soft-L1 loss on the residuals."""
    samples, shape = samples.by_light(), len(family.start)
    prior_ev = np.where(suspect, FREE_EV, TRUSTED_EV)
    rows = _trend_rows(samples.exposure, suspect)[: 1 + family.bends]
    no_trend = np.eye(len(suspect)) - rows.T @ rows

    def miss(q: Array) -> Array:
        residual = residual_of(log_lookup(family.build(q[:shape])), samples, no_trend @ q[shape:])
        parts = [(residual / samples.sigma).T.ravel() / 2.0, q[shape:] / prior_ev]
        if family.smoothness:
            parts.append(SMOOTH_WEIGHT * family.smoothness(q[:shape]))
        return np.concatenate(parts)

    def jacobian(q: Array) -> Array:
        slopes = slopes_of(family, q[:shape], no_trend @ q[shape:], samples) / (2.0 * samples.sigma.T[..., None])
        slopes[..., shape:] = slopes[..., shape:] @ no_trend
        parts = [slopes.reshape(-1, len(q)), np.eye(len(q))[shape:] / prior_ev[:, None]]
        if family.smoothness:
            rough = derivatives(family.smoothness, q[:shape], family.upper)
            parts.append(SMOOTH_WEIGHT * np.pad(rough, ((0, 0), (0, len(suspect)))))
        return np.concatenate(parts)

    wide = np.full(len(suspect), WIDEST_EV)
    bounds = (np.concatenate([family.lower, -wide]), np.concatenate([family.upper, wide]))
    found = least_squares(miss, start, jac=jacobian, bounds=bounds, loss="soft_l1", max_nfev=evaluations,
                          ftol=1e-6, xtol=1e-7, gtol=1e-8)  # fmt: skip
    return found.x[:shape], no_trend @ found.x[shape:]


def _trend_rows(exposure: Array, suspect: Mask) -> Array:
    """Orthonormal rows (2, pictures): level and trend over log exposure of the corrections of trusted pictures.

    The level only sets the unit of light and is projected out.  So is the trend if the curve has a free exponent, since
    the two are equivalent; otherwise the prior on the listed exposures constrains the trend.
    """
    trusted = (~suspect).astype(float)
    level = trusted / np.sqrt(trusted.sum())
    log_t = np.log(exposure)
    trend = trusted * (log_t - (trusted @ log_t) / trusted.sum())
    return np.stack([level, trend / max(float(np.linalg.norm(trend)), 1e-12)])


def fit_kinds(kind: str, fit: BracketSamples, held_out: BracketSamples, first: FirstCurve) -> dict[str, Trial]:
    """Fit the requested kind and a table, or all kinds for ``auto``, and score each on held-out samples."""
    names = ("linear", "srgb", "gamma", "five_segment", "table") if kind == "auto" else (kind, "table")
    trials = {}
    for name in dict.fromkeys(names):
        family = make_family(name, first, fit.low, fit.high, fit.top)
        trials[name] = scored_trial(family, *_from_best_start(family, fit, first), first.suspect, held_out)
    return trials


def _from_best_start(family: Family, fit: BracketSamples, first: FirstCurve) -> tuple[Array, Array]:
    """Optimise from the best of the family's starts, chosen on a subset of the samples."""
    correction = np.where(first.suspect, first.correction_ev, 0.0)
    starts = [np.concatenate([p, correction]) for p in (family.start, *family.others)]
    if len(starts) > 1:
        thin = fit.take(np.arange(len(fit.grey))[:: max(len(fit.grey) // 300, 1)])
        tried = [optimise(family, start, thin, first.suspect, 12) for start in starts]
        costs = [float(np.abs(residual_of(log_lookup(family.build(p)), thin, c) / thin.sigma).sum()) for p, c in tried]
        starts = [np.concatenate(tried[int(np.argmin(costs))])]
    return optimise(family, starts[0], fit, first.suspect)


def scored_trial(
    family: Family, parameters: Array, correction_ev: Array, suspect: Mask, samples: BracketSamples
) -> Trial:
    """Score a fitted curve on samples, usually held out."""
    curve = family.build(parameters)
    residual = residual_of(log_lookup(curve), samples, correction_ev)
    score = np.minimum((residual / samples.sigma) ** 2, SCORE_CAP).sum(axis=1)
    rms, trend_row = capped_rms(residual[samples.measured]), _trend_rows(samples.exposure, suspect)[1]
    return Trial(family, curve, parameters, correction_ev, suspect, score, samples.site, rms, trend_row)


def rms_levels(residual: Array) -> float:
    """RMS without outliers beyond six robust standard deviations."""
    if not residual.size:
        return 0.0
    limit = 6.0 * robust_std(residual) + 1e-9
    inside = residual[np.abs(residual) <= limit]
    return float(np.sqrt(np.mean(inside**2)))


def capped_rms(residual: Array) -> float:
    """RMS with residuals capped at OUTLIER_LEVELS, so that it is comparable between kinds with different outliers."""
    return float(np.sqrt(np.mean(np.minimum(np.abs(residual), OUTLIER_LEVELS) ** 2))) if residual.size else 0.0


def choose_kind(trials: dict[str, Trial]) -> str:
    """The simplest kind that needs no trend of the exposures and is not significantly worse at held-out sites."""
    for name in KINDS:
        if (
            name in trials
            and not trials[name].needs_trend
            and not any(significantly_worse(trials[name], other) for n, other in trials.items() if n != name)
        ):
            return name
    return "table"


def significantly_worse(one: Trial, other: Trial) -> bool:
    """Whether the other predicts held-out sites better, by a paired test over sites and by DISTINCT_LEVELS or more."""
    _, index = np.unique(one.site, return_inverse=True)
    gain = np.bincount(index, one.score - other.score)
    if one.held_out_rms**2 - other.held_out_rms**2 < DISTINCT_LEVELS**2:
        return False
    return bool(gain.mean() > SIGNIFICANT_Z * gain.std() / np.sqrt(len(gain)))


def refit(trial: Trial, samples: BracketSamples, may_be_wrong: Mask) -> Trial:
    """Fit again to all samples; pictures of ``may_be_wrong`` whose correction is now an outlier become suspect too."""
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
    return scored_trial(trial.family, parameters, correction, suspect, samples)


def posterior_of(trial: Trial, samples: BracketSamples, scatter_ev: float) -> CurvePosterior:
    """Posterior of a fit; the prior on trusted exposures is widened to their observed scatter."""
    residual = residual_of(log_lookup(trial.curve), samples, trial.correction_ev)
    used = samples.measured & (
        np.abs(residual) < 6.0 * np.maximum(samples.sigma, rms_levels(residual[samples.measured]))
    )
    prior = np.where(trial.suspect, FREE_EV, max(TRUSTED_EV, scatter_ev))
    slopes = slopes_of(trial.family, trial.parameters, trial.correction_ev, samples)
    return curve_posterior(trial.family, trial.parameters, residual, slopes, samples.sigma, samples.grey, used, prior)
