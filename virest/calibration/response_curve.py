"""Fit the response curve to an exposure bracket and assess the fit (forward_model, section 4).

Model: the grey of sample p in picture n is ``E(L_p · t_n · 2^c_n)`` plus noise.  Unknown are the curve E, the light L_p
of every sample and a correction c_n of each listed exposure, as in Debevec & Malik 1997, doi:10.1145/258734.258884, but
with E of a named kind and residuals in grey levels, where the noise arises.  Variable projection leaves only the curve
parameters and the c_n to be searched; the light follows sample by sample.  Residuals are weighted by the noise under a
robust loss.  Clipped greys are censored: they bound the light from one side only.

The c_n are sparse and have no trend (see ``exposure_check``): a listed exposure is trusted to 0.02 EV unless it
contradicts the others, in which case it is free.  One curve is fitted to all three channels, since the camera profile
has one.  The channels of a site are separate samples in the fit but one site in the tests.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from virest.arrays import Array, Mask
from virest.calibration.bracket_samples import MIN_SHARED, BracketPicture, BracketSamples, sample_bracket
from virest.calibration.curve_certainty import CurvePosterior
from virest.calibration.curve_families import LogLookup, log_lookup
from virest.calibration.curve_trials import (
    SIGNIFICANT_Z,
    STRUCTURE_LEVELS,
    Trial,
    choose_kind,
    fit_kinds,
    posterior_of,
    project,
    refit,
    require_possible,
    residual_of,
    rms_levels,
    significantly_worse,
)
from virest.calibration.exposure_check import CONTRADICTS_EV, LN2, MIN_PICTURES, FirstCurve, fit_first_curve
from virest.calibration.grey_levels import reliably_inside, scatter_by_grey
from virest.camera.response import KINDS, ResponseCurve
from virest.errors import CalibrationError, SettingsError

MIN_RATIO, FEW_RATIO = 2**0.25, 2**1.5
"""Ratios of the largest to the smallest exposure: below 0.25 EV a bracket is refused, below 1.5 EV called weak."""
MOVED_LEVELS, MAX_MOVED = 8.0, 0.2
"""A sample that deviates by more, rms over the exposures, has moved; a scene is still if at most this part has."""
WORST_OF_MEDIAN = 3.0
"""A sample is excluded if its largest residual exceeds this multiple of the median over samples."""
SCATTER_EV = 0.06
"""Scatter of the listed exposures that is reported: three times their prior standard deviation."""
OPEN_LEVELS = 2.0
"""Standard deviation of the curve above which it is reported as loosely determined."""
UNDETERMINED_LEVELS = 25.0
"""Standard deviation above which the fit is refused: a tenth of the grey range."""
STRUCTURE_BINS = 16
"""Bins of equal counts by grey whose mean residuals show the systematic part: 16 levels each."""
COMPARED_GREYS = 400
"""Greys at which curves are compared: two per grey level of a usual range."""


@dataclass(frozen=True, slots=True)
class PictureFit:
    """Result of the fit for one picture."""

    file: str
    exposure: float
    """Listed exposure."""
    exposure_error_ev: float | None
    """log2(listed / true): +1 if the listed exposure is twice the true one; None: the picture was excluded."""
    contradicts: bool
    """Whether the listed exposure contradicts the others; its error is then free instead of held near 0."""

    @property
    def likely_exposure(self) -> float:
        """Estimated true exposure, in the unit of the list."""
        return float(self.exposure / 2.0 ** (self.exposure_error_ev or 0.0))


@dataclass(frozen=True, slots=True)
class DataCloud:
    """Samples for plotting: each measured grey with its fitted exposure."""

    light: Array
    """(m,) exposure (light × time) on the curve's axis."""
    grey: Array
    """(m,) levels."""
    residual: Array
    """(m,) levels, measured − curve."""
    picture: NDArray[np.int64]
    """(m,) index of the picture."""


@dataclass(frozen=True, slots=True)
class CurveFit:
    """A response curve and its uncertainty."""

    curve: ResponseCurve
    rms_grey_levels: float
    """RMS residual of the samples (means over small squares), without outliers."""
    curve_std_grey_levels: float
    """RMS standard deviation of the curve over the exposures covered: the posterior uncertainty among smooth curves of
    any kind (``curve_certainty``), the misfit of this kind, and the differences between the channels."""
    covered_exposure: tuple[float, float]
    """Range of exposures covered by data, on the curve's axis."""
    pictures: tuple[PictureFit, ...]
    notes: tuple[str, ...]
    held_out: dict[str, float]
    """Held-out RMS in grey levels of each kind tried."""
    cloud: DataCloud


def fit_response(pictures: Sequence[BracketPicture], kind: str = "auto") -> CurveFit:
    """Fit a curve of one kind, or of the simplest kind that held-out sites do not reject (``auto``).

    Raises CalibrationError for fewer than two pictures, a single exposure, no overlap, pictures clipped throughout,
    misalignment that is too large or not rigid, a scene that is not still, exposures that are not those of the
    pictures, and a curve that the pictures do not determine.
    """
    if kind not in ("auto", *KINDS):
        raise SettingsError(f"kind '{kind}' is no curve", hint=f"use auto, {', '.join(KINDS)}")
    _require_bracket(pictures)
    samples = sample_bracket(pictures, np.random.default_rng(0))
    return _fit_samples(pictures, samples, kind)


def _fit_samples(pictures: Sequence[BracketPicture], samples: BracketSamples, kind: str) -> CurveFit:
    notes = [f"{p.file} was shifted by {np.hypot(*s):.1f} px and aligned" for p, s in
             zip(pictures, samples.shifts_px - np.median(samples.shifts_px, axis=0), strict=True)
             if np.hypot(*s) > 0.5]  # fmt: skip
    notes += [samples.ends.describe()] * samples.ends.differ
    seen, samples = _keep_connected(pictures, np.ones(len(pictures), bool), samples)
    first = fit_first_curve(samples)
    require_possible(first, samples)
    samples = _with_reliability(_with_scatter(samples, first), first)
    seen, samples = _keep_connected(pictures, seen, samples)
    notes += [
        f"{p.file} is clipped or too dark throughout and was left out"
        for p, s in zip(pictures, seen, strict=True)
        if not s
    ]
    first = fit_first_curve(samples)
    still = _still_rows(samples, first)
    samples = samples.take(still)
    verdict = _choose_curve(kind, samples, first, np.ones(len(first.suspect), bool))
    # an exposure that only the chosen kind finds wrong may show an error of the kind instead
    wrong_for_any = np.abs(first.correction_ev) > 0.5 * CONTRADICTS_EV
    doubtful = verdict.final.suspect & ~(verdict.established & wrong_for_any)
    if doubtful.any():
        first = replace(first, suspect=first.suspect & ~doubtful)
        verdict = _choose_curve(kind, samples, first, ~doubtful)
    _require_determined(verdict)
    return _result(pictures, seen, verdict, samples, [*notes, *_criticise(verdict, samples)])


@dataclass(frozen=True, slots=True)
class _Verdict:
    """All fitted kinds, and the chosen one."""

    trials: dict[str, Trial]
    chosen: str
    final: Trial
    """The chosen kind, fitted to all samples."""
    posterior: CurvePosterior
    """Posterior of the table: the uncertainty from the data alone."""
    structure_levels: float
    """RMS of the systematic residual by grey level."""
    misfit_levels: float
    """The same; for a requested kind at least its distance from the table."""
    scatter_ev: float
    """Scatter of the trusted exposures about the table."""

    @property
    def std_levels(self) -> float:
        """Standard deviation of the curve: posterior uncertainty and misfit of the kind."""
        return float(np.hypot(self.posterior.rms_levels, self.misfit_levels))

    @property
    def established(self) -> Mask:
        """(pictures,): whether an exposure error is significant given the posterior uncertainty of the table."""
        return np.abs(self.final.correction_ev) > SIGNIFICANT_Z * self.posterior.exposure_std_ev


def _choose_curve(kind: str, samples: BracketSamples, first: FirstCurve, may_be_wrong: Mask) -> _Verdict:
    """Fit the kinds on even sites, choose one on odd sites, refit it to all, and assess its uncertainty."""
    odd = samples.site % 2 == 1
    trials = fit_kinds(kind, samples.take(~odd), samples.take(odd), first)
    chosen = kind if kind != "auto" else choose_kind(trials)
    final = refit(trials[chosen], samples, may_be_wrong)
    table = replace(trials["table"], suspect=final.suspect)
    residual = residual_of(log_lookup(final.curve), samples, final.correction_ev)
    use = samples.measured & (np.abs(residual) < 6.0 * max(rms_levels(residual[samples.measured]), 0.3))
    misfit = structure = residual_structure(samples.grey[use], residual[use])
    if kind not in ("auto", "table"):
        misfit = max(misfit, curve_distance_levels(table.curve, final.curve, (table.curve.x[1], 1.0)))
    scatter_ev = _scatter_ev(table)
    return _Verdict(trials, chosen, final, posterior_of(table, samples, scatter_ev), structure, misfit, scatter_ev)


def _scatter_ev(trial: Trial) -> float:
    """Standard deviation of the trusted corrections, with two degrees of freedom less for level and trend."""
    trusted = trial.correction_ev[~trial.suspect]
    return float(np.sqrt((trusted**2).sum() / max(len(trusted) - 2, 1)))


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
    pictures: Sequence[BracketPicture], kept: Mask, samples: BracketSamples
) -> tuple[Mask, BracketSamples]:
    """Drop pictures that are clipped throughout: mask over all pictures, and the samples of those kept."""
    seen = _connected([p for p, k in zip(pictures, kept, strict=True) if k], samples)
    kept = kept.copy()
    kept[kept] = seen
    samples = samples.keep_pictures(seen)
    return kept, samples.take(samples.measured.sum(axis=1) >= 2)


def _connected(pictures: Sequence[BracketPicture], samples: BracketSamples) -> Mask:
    """Mask of pictures not clipped throughout.  Raises CalibrationError if these do not overlap in one chain."""
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
    """Raise CalibrationError for a kind with free parameters if the data do not determine the curve.

    A kind without parameters is allowed, since it is fixed before any measurement.
    """
    open_levels = verdict.posterior.rms_levels
    if len(verdict.final.parameters) and open_levels > UNDETERMINED_LEVELS:
        text = f"the pictures do not determine the curve: it could differ by {open_levels:.0f} grey levels rms"
        raise CalibrationError(text, hint="take more exposures, closer together, of a scene with many brightnesses")


def _still_rows(samples: BracketSamples, first: FirstCurve) -> Mask:
    """Mask of samples explained by one light at every exposure.  Raises CalibrationError if too many are not.

    A moving scene is wrong at most exposures; a codec error at one exposure affects all sites.  So a scene is refused
    by the RMS over exposures, and single residuals are compared with the median over samples.
    """
    residual = np.where(samples.measured, np.abs(_first_residual(samples, first)), 0.0)
    limit = max(MOVED_LEVELS, 8.0 * float(samples.sigma.max()))
    rms = np.sqrt((residual**2).sum(axis=1) / np.maximum(samples.measured.sum(axis=1), 1))
    moved = rms > limit
    if moved.mean() > MAX_MOVED:
        text = (
            f"the scene is not still, or the exposures are wrong throughout: {moved.mean():.0%} of the samples deviate"
        )
        raise CalibrationError(
            f"{text} by more than {MOVED_LEVELS:g} grey levels from any curve",
            hint="take a still scene in steady light from a tripod",
        )
    worst = residual.max(axis=1)
    return worst <= max(limit, WORST_OF_MEDIAN * float(np.median(worst)))


def _first_residual(samples: BracketSamples, first: FirstCurve) -> Array:
    """Measured grey levels minus those of the first curve, (samples, pictures)."""
    lookup = LogLookup(first.log_light, first.grey, np.gradient(first.grey, first.log_light))
    log_t = np.log(samples.exposure) + LN2 * first.correction_ev
    return samples.grey - lookup.level(project(lookup, samples, log_t)[:, None] + log_t)


def _with_scatter(samples: BracketSamples, first: FirstCurve) -> BracketSamples:
    """Raise the samples' noise to their scatter about the first curve where that is larger."""
    scatter = scatter_by_grey(_first_residual(samples, first), samples.grey, samples.channel, samples.measured)
    missing = np.full((len(samples.noise.variance) - len(scatter), scatter.shape[1]), np.nan)
    return replace(samples, noise=samples.noise.at_least(np.concatenate([scatter, missing])))


def _with_reliability(samples: BracketSamples, first: FirstCurve) -> BracketSamples:
    """Mark the greys whose position between the censoring limits is not decided by noise."""
    lookup = LogLookup(first.log_light, first.grey, np.gradient(first.grey, first.log_light))
    log_t = np.log(samples.exposure) + LN2 * first.correction_ev
    reliable = np.zeros(samples.grey.shape, bool)
    for channel in np.unique(samples.channel):
        rows = samples.channel == channel
        of_channel = samples.take(rows)
        limits, sigma = of_channel.limits, of_channel.sigma
        light = np.stack([project(lookup, of_channel.without(n), log_t) for n in range(len(log_t))], axis=1)
        reliable[rows] = reliably_inside(of_channel.grey, light, limits, sigma)
    return replace(samples, reliable=reliable)


# ── assessment and result ────────────────────────────────────────────────────────────────────────────────────────


def residual_structure(grey: Array, residual: Array) -> float:
    """RMS of the systematic residual in grey levels: of the mean residuals by grey, contribution of noise removed."""
    grey_bin = np.digitize(grey, np.quantile(grey, np.linspace(0, 1, STRUCTURE_BINS + 1)[1:-1]))
    number = np.bincount(grey_bin, minlength=STRUCTURE_BINS)
    good = number > 20
    mean = np.bincount(grey_bin, residual, minlength=STRUCTURE_BINS)[good] / number[good]
    square = np.bincount(grey_bin, residual**2, minlength=STRUCTURE_BINS)[good] / number[good]
    excess = mean**2 - (square - mean**2) / number[good]
    return float(np.sqrt(max(float(excess.mean()), 0.0))) if good.any() else 0.0


def _criticise(verdict: _Verdict, samples: BracketSamples) -> list[str]:
    notes = []
    chosen, trials, final, structure = verdict.chosen, verdict.trials, verdict.final, verdict.structure_levels
    tabulated = trials["table"]
    if chosen != "table" and significantly_worse(trials[chosen], tabulated):
        before = trials[chosen].held_out_rms
        gain = 1.0 - tabulated.held_out_rms / max(before, 1e-9)
        notes.append(
            f"{chosen} does not fit the data: systematic residual of {structure:.2f} grey levels; a table "
            f"lowers the held-out rms from {before:.2f} to {tabulated.held_out_rms:.2f} ({gain:.0%}): "
            "--kind table"
        )
    elif structure > STRUCTURE_LEVELS:
        notes.append(f"systematic residual of {structure:.2f} grey levels that no kind explains")
    if chosen == "table" and "five_segment" in trials:
        five = trials["five_segment"].held_out_rms
        table = tabulated.held_out_rms
        notes.append(f"no simpler kind fits: held-out rms {five:.2f} with five_segment, {table:.2f} with table")
    if verdict.scatter_ev > SCATTER_EV:
        notes.append(
            f"the listed exposures agree to {verdict.scatter_ev:.2f} EV only: flicker, or several are wrong "
            "(is ISO included?) and too few are right to tell which"
        )
    if len(samples.exposure) < MIN_PICTURES:
        notes.append(f"{len(samples.exposure)} pictures are too few to find wrong exposures")
    if samples.exposure.max() / samples.exposure.min() < FEW_RATIO:
        span = np.log2(samples.exposure.max() / samples.exposure.min())
        notes.append(f"exposures span only {span:.1f} EV: the curve is weakly determined")
    open_levels = verdict.posterior.rms_levels
    if open_levels > OPEN_LEVELS:
        notes.append(
            f"the pictures determine the curve to {open_levels:.1f} grey levels rms only"
            f"{', the kind determines the rest' * (chosen != 'table')}: take more exposures, closer together"
        )
    if (final.curve.encode(np.array([1.0])) * 255)[0] - samples.top > 25:
        notes.append(f"no grey above {samples.top:.0f} was seen: the curve is extrapolated there")
    return notes


def _result(
    pictures: Sequence[BracketPicture], seen: Mask, verdict: _Verdict, samples: BracketSamples, notes: list[str]
) -> CurveFit:
    final = verdict.final
    log_t = np.log(samples.exposure) + LN2 * final.correction_ev
    lookup = log_lookup(final.curve)
    residual = residual_of(lookup, samples, final.correction_ev)
    log_light = project(lookup, samples, log_t)[:, None] + log_t
    use = samples.measured
    ends = lookup.light(np.quantile(samples.grey[use], [0.001, 0.999]))
    scale = float(np.exp(ends[1])) if final.family.kind in ("five_segment", "table") else 1.0
    cloud = DataCloud(np.exp(log_light[use]) / scale, samples.grey[use], residual[use], np.nonzero(use)[1])
    picture_fits = _picture_fits(pictures, seen, final)
    for picture in picture_fits:
        if picture.contradicts:
            notes.append(
                f"{picture.file}: its listed exposure {picture.exposure:.6g} contradicts the others by "
                f"{picture.exposure_error_ev:+.2f} EV; likely {picture.likely_exposure:.6g}"
            )
    return CurveFit(
        scale_exposure(final.curve, scale),
        rms_levels(residual[use]),
        float(np.hypot(verdict.std_levels, samples.ends.rms_difference_levels if samples.ends.differ else 0.0)),
        (float(np.exp(ends[0]) / scale), float(np.exp(ends[1]) / scale)),
        picture_fits,
        tuple(notes),
        {name: trial.held_out_rms for name, trial in verdict.trials.items()},
        cloud,
    )


def _picture_fits(pictures: Sequence[BracketPicture], seen: Mask, final: Trial) -> tuple[PictureFit, ...]:
    trusted = final.correction_ev[~final.suspect]
    error = np.full(len(pictures), np.nan)
    error[seen] = (np.median(trusted) if len(trusted) else 0.0) - final.correction_ev
    contradicts = np.zeros(len(pictures), bool)
    contradicts[seen] = final.suspect
    return tuple(
        PictureFit(p.file, p.exposure, None if np.isnan(e) else float(e), bool(c))
        for p, e, c in zip(pictures, error, contradicts, strict=True)
    )


def scale_exposure(curve: ResponseCurve, unit: float) -> ResponseCurve:
    """The curve with its exposure axis in units of ``unit``; only kinds with an axis of their own change."""
    if curve.kind == "five_segment":
        return replace(curve, b=(curve.b[0] / unit, curve.b[1]), c=(curve.c[0] / unit, curve.c[1]))
    if curve.kind == "table":
        return replace(curve, x=tuple(x / unit for x in curve.x))
    return curve


def curve_distance_levels(curve: ResponseCurve, truth: ResponseCurve, exposure: tuple[float, float]) -> float:
    """RMS difference of two curves in grey levels over a range of ``curve``'s exposures, at the best relative scale.

    The exposure axis has no absolute scale, so the factor between the two axes with the least difference is used.
    Points are spaced evenly in the grey of ``curve``.
    """
    ends = curve.encode(np.array(exposure))
    light = np.unique(curve.linearise(np.linspace(float(ends[0]), float(ends[1]), COMPARED_GREYS)))
    grey = 255.0 * curve.encode(light)

    def miss(log_scale: float) -> float:
        return float(np.sqrt(np.mean((255.0 * truth.encode(light * np.exp(log_scale)) - grey) ** 2)))

    trials = np.linspace(-6, 6, 481)
    best = float(trials[int(np.argmin([miss(t) for t in trials]))])
    return float(minimize_scalar(miss, bounds=(best - 0.05, best + 0.05), method="bounded").fun)
