"""Sudden changes of the focal length (a phone that switches its lens), of the gyroscope's bias, and of the clocks.

Between the two frames around the change, the scale changes by many times the tracking noise, more than between any
other pair; a robust fit rejects these points as outliers.  Later frames show whether the change lasts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import digamma, polygamma

from virest.arrays import Array
from virest.capture.records import Capture
from virest.diagnosis.field.design import PointResiduals
from virest.diagnosis.field.form_list import FRAMES_PER_STEP, candidate_steps_s, step_forms, turn_steps
from virest.diagnosis.field.forms import FieldForm
from virest.image_formation.point_model import seen_s
from virest.inference.chance import student_tail
from virest.inference.robust import CAUCHY, cauchy_weight, robust_std

FALSE_ALARM_RATE = 1e-4
"""Family-wise false-alarm rate over all pairs of a capture."""
LEAST_POINTS, LEAST_PAIRS = 8, 15
"""Points of a pair whose growth is measured, and pairs among which one may be an outlier."""
INSTANTS, REACH = 97, FRAMES_PER_STEP + 1.0
"""Number of instants tried, and the search range in frames before and after: the coarse search ignores FRAMES_PER_STEP
frames around a change, and its instants are off by up to half of that."""
LASTING_INSTANTS = 2 * 4 * FRAMES_PER_STEP + 1
"""Instants of a lasting change within FRAMES_PER_STEP frames of the coarse one, 8 ms apart at 30 frames/s: the error in
between, of a bias that changes by 0.05 rad/s at 600 px, is 0.1 px in one pair of frames."""
MAD_EFFICIENCY = 0.37
"""A standard deviation from the median of magnitudes is as accurate as the usual one from this part of the values
(Rousseeuw & Croux 1993, doi:10.1080/01621459.1993.10476408)."""
LEAST_EXCESS = 1e-3
"""Scatter of the logarithms of variances below which they count as equal: more than 2000 degrees of freedom."""
LEAST_SCALE = 1e-9
"""Guard against a division by zero."""
_ITERATIONS = 8
"""Passes against outliers: of 20 points, 15 % of them outliers, half as many passes change the growth by 0.5 of its
standard deviation (rms), twice as many by 0.1."""


@dataclass(frozen=True, slots=True)
class SuddenChange:
    """A pair of frames between which the scale changed."""

    pair: int
    at_s: float
    """Between the two, IMU clock from stamp_0."""
    scale: float
    """Relative increase of the focal length."""
    p_value: float


def sudden_change(seen: PointResiduals) -> SuddenChange | None:
    """The pair with the most significant change of scale; None where no pair's is significant.

    Each pair counts in its own standard deviations: blurred frames have few and inaccurate points.
    """
    lens, table = seen.fit.profile.intrinsics, seen.table
    assert lens is not None
    arm = seen.prediction.second_px - np.array([lens.cx_px, lens.cy_px])
    off = table.second_px - seen.prediction.second_px
    pairs = [k for k, count in enumerate(np.bincount(table.pair)) if count >= LEAST_POINTS]
    if len(pairs) < LEAST_PAIRS:
        return None
    found = [_growth(arm[table.pair == k], off[table.pair == k]) for k in pairs]
    growth, scale_px, per_px, freedom = np.transpose(found)
    noise_px = table.noise_px[pairs]
    scale, freedom = _moderated(scale_px / noise_px, freedom)
    beyond = np.abs(growth - np.median(growth)) / (scale * noise_px * per_px)
    ratios = beyond / max(robust_std(beyond), 1.0)
    tails = [student_tail(*one) for one in zip(ratios, np.minimum(freedom, len(pairs) - 1), strict=True)]
    most = int(np.argmin(tails))
    p_value = min(2 * len(pairs) * tails[most], 1.0)
    if p_value > FALSE_ALARM_RATE:
        return None
    inside = table.pair == pairs[most]
    profile = seen.fit.profile
    first_s = seen_s(profile, table.first_px, table.first_stamp_s, table.first_exposure_s)[inside]
    second_s = seen_s(profile, table.second_px, table.second_stamp_s, table.second_exposure_s)[inside]
    at_s = 0.5 * float(first_s.max() + second_s.min())
    return SuddenChange(pairs[most], at_s, float(growth[most]), p_value)


def _growth(arm: Array, off: Array) -> tuple[float, float, float, float]:
    """Robust relative expansion of points with residuals off (n, 2) at arm (n, 2) from the centre, beside a shift.

    Returns also the points' standard deviation, that of the expansion per unit of it, and its degrees of freedom.
    """
    design = np.concatenate([np.concatenate([arm[:, :1], arm[:, 1:]]), np.repeat(np.eye(2), len(arm), axis=0)], axis=1)
    flat = np.concatenate([off[:, 0], off[:, 1]])
    weight = np.ones(len(flat))
    found, scale = np.zeros(3), LEAST_SCALE
    for _ in range(_ITERATIONS):
        root = np.sqrt(weight)
        found = np.linalg.lstsq(design * root[:, None], flat * root, rcond=None)[0]
        left = flat - design @ found
        scale = max(robust_std(left), LEAST_SCALE)
        weight = cauchy_weight(left**2, CAUCHY * scale)
    weights = weight.reshape(2, -1).T
    spread = arm - np.average(arm, axis=0, weights=weights)
    per_px = 1 / float(np.sqrt(max((weights * spread**2).sum(), LEAST_SCALE)))
    return float(found[0]), scale, per_px, MAD_EFFICIENCY * (design.shape[0] - design.shape[1])


def _moderated(scale: Array, freedom: Array) -> tuple[Array, Array]:
    """Scales (n,) with these degrees of freedom, each moved towards all others' as far as these agree; new degrees.

    Variances are taken for draws from a scaled inverse chi-square law (Smyth 2004, doi:10.2202/1544-6115.1027),
    whose degrees of freedom follow from the scatter of their logarithms beyond that of estimates.
    """
    level = 2 * np.log(np.maximum(scale, LEAST_SCALE)) - digamma(freedom / 2) + np.log(freedom / 2)
    excess = float(np.var(level, ddof=1) - polygamma(1, freedom / 2).mean())
    if excess <= LEAST_EXCESS:
        return np.full(len(scale), np.exp(level.mean() / 2)), np.full(len(scale), np.inf)
    half = 0.5 + 1 / excess
    for _ in range(_ITERATIONS):  # Newton: trigamma(half) = excess
        slope = polygamma(1, half)
        half += slope * (1 - slope / excess) / polygamma(2, half)
    typical = np.exp(level.mean() + digamma(half) - np.log(half))
    total = 2 * half + freedom
    return np.sqrt((2 * half * typical + freedom * scale**2) / total), total


def lasting_change(seen: PointResiduals, tangent: Array, effect: Array) -> float:
    """Least-squares value of a form with one free number, fitted together with the tangent space."""
    root = np.repeat(np.sqrt(seen.weight), 2)
    design = np.concatenate([effect, tangent], axis=-1).reshape(len(root), -1) * root[:, None]
    return float(np.linalg.lstsq(design, seen.left.ravel() * root, rcond=None)[0][0])


def best_instant(seen: PointResiduals, capture: Capture, at_s: float, scale: float, period_s: float) -> FieldForm:
    """The form of a sudden change of a given size at the best-fitting instant near at_s."""
    forms = step_forms(capture, at_s + np.linspace(-1, 1, INSTANTS) * REACH * period_s)
    step = scale / float(forms[0].basis[-1, 0])
    whole = [seen.left - step * seen.effect((form.term,))[..., 0] for form in forms]
    losses = np.array([np.log1p((left**2).sum(axis=-1) / CAUCHY**2).sum() for left in whole])
    equally_good = np.flatnonzero(losses <= losses.min() + 1.0)  # all instants between two frames fit equally well
    return forms[int(equally_good[len(equally_good) // 2])]


def lasting_step(
    seen: PointResiduals,
    tangent: Array,
    capture: Capture,
    span_s: tuple[float, float],
    period_s: float,
    like: FieldForm,
) -> FieldForm:
    """A sudden change of what a form changes, at the instant that explains most beside the tangent space (n, 2, m).

    A bias that a phone corrects while it logs, or a clock that it sets, changes between two readings, which a curve
    through knots follows only with overshoots.
    """
    root = np.repeat(np.sqrt(seen.weight), 2)[:, None]
    frame = np.linalg.qr(tangent.reshape(len(root), -1) * root)[0]
    error = seen.left.reshape(-1, 1) * root
    error = error - frame @ (frame.T @ error)

    def explained(form: FieldForm) -> float:
        own = seen.effect((form.term,)).reshape(len(root), -1) * root
        own = own - frame @ (frame.T @ own)
        return float(np.sum((np.linalg.qr(own)[0].T @ error) ** 2))

    def forms(at_s: Array) -> list[FieldForm]:
        profile = seen.fit.profile
        return turn_steps(capture, profile, at_s) if like.is_turn else step_forms(capture, at_s, like.kind, profile)

    if like.kind == "delay":  # the pair of frames around it moves most, so that no other instant is near the best
        seen_s = np.unique(np.concatenate([seen.table.first_stamp_s, seen.table.second_stamp_s]))
        return max(forms(np.asarray(seen.fit.profile.imu_time_s((seen_s[1:] + seen_s[:-1]) / 2))), key=explained)
    near_s = max(forms(candidate_steps_s(span_s, capture)), key=explained).step_s
    assert near_s is not None
    return max(forms(near_s + np.linspace(-1, 1, LASTING_INSTANTS) * FRAMES_PER_STEP * period_s), key=explained)
