"""Refit of the photometric values under the final profile, with the uncertainty of curve and exposure included.

The ladder fits vignetting, flicker and gains before blur gives the exposure and, at constant exposure × ISO, the curve.
A curve with gamma g shows a factor v on the light about as one without shows v^g: at constant exposure the brightness
of patches fits equally well, and where g is 1.3, a corner that keeps 0.5 of the light is taken for one that keeps 0.41.
All these values are therefore fitted again under the final profile.  Their covariance gets ``P S Pᵀ``, P their change
with the curve and the exposure (photometry_fit.pulls), S the uncertainty of those: they are consider parameters in the
sense of Schmidt 1966.

A change of the curve that was not found significant is not excluded: S is then its second moment about the profile's
value, from the measurement and from how far a curve may be off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.camera.response import ResponseCurve
from virest.diagnosis.findings import Finding
from virest.diagnosis.photometry import PhotometricObservations
from virest.diagnosis.photometry_effects import BLACK_LEVEL, RESPONSE_GAMMA, PhotometricEffect
from virest.diagnosis.photometry_fit import PhotometricFit, fit_photometry, pulls, significance
from virest.diagnosis.picture_ladder import PictureVerdict, changes_of, frames_of, light_varies, sentence_of, values_of

STATED_STD = np.array([0.15, 0.02])
"""Prior standard deviation of a curve that a profile states: logarithm of gamma, black level."""
UNKNOWN_STD = np.array([0.3, 0.04])
"""The same for an unknown curve, for which the default is used."""
_STEP = 1e-3
"""Finite-difference step of the logarithms of gamma and exposure, and of the black level."""
_GAMMA, _BLACK = 0, 1
"""Places in these vectors."""


@dataclass(frozen=True, slots=True)
class CurveUncertainty:
    """Uncertainty of the curve and the exposure that brightness depends on."""

    spread: Array
    """(3, 3) second moments of true − profile: logarithm of gamma, black level, logarithm of the exposure scale."""
    rivals: tuple[ResponseCurve, ...] = ()
    """Curves that explain the light mixing equally well."""


def settle_light(
    light: PictureVerdict, curve: PictureVerdict, given: CameraProfile, causes: Sequence[Finding]
) -> tuple[PictureVerdict, CameraProfile]:
    """Refit the photometric values under the final profile; returns (photometric verdict, profile).

    light: verdict of the brightness ladder; curve: verdict after light mixing, with the final profile.  given: profile
    with the prior knowledge of the curve.  causes: those of points and blur.
    """
    fitted, observations, profile = light.fitted, light.observations, curve.profile
    if fitted is None or observations is None or not fitted.effects:
        return light, profile
    if not _same_photometry(observations, light.profile, profile):
        fitted = fit_photometry(observations, profile, fitted.effects)
    prior = _prior(given)
    if light_varies(observations):
        uncertainty = CurveUncertainty(_curve_by_brightness(observations, fitted, prior))
    else:
        uncertainty = _curve_by_mixing(curve, prior)
    uncertainty.spread[2, 2] = _exposure_variance(causes)
    widened = replace(fitted, covariance=fitted.covariance + _added_covariance(observations, fitted, uncertainty))
    nominal = light.nominal or given
    findings = [_refreshed(finding, fitted, widened, observations, nominal) for finding in light.findings]
    notes = [*light.notes, *_notes(light, curve)]
    found = replace(light, profile=fitted.profile, findings=findings, fitted=fitted, notes=notes)
    return found, fitted.profile


def _same_photometry(observations: PhotometricObservations, one: CameraProfile, other: CameraProfile) -> bool:
    """Whether two profiles have the same curve, row times and exposures."""
    scales = one.shutter.exposure_scale, other.shutter.exposure_scale
    times = observations.row_time_s(one), observations.row_time_s(other)
    return one.response == other.response and scales[0] == scales[1] and np.allclose(*times, rtol=0, atol=1e-6)


def _refreshed(
    finding: Finding,
    fitted: PhotometricFit,
    widened: PhotometricFit,
    observations: PhotometricObservations,
    nominal: CameraProfile,
) -> Finding:
    """A finding with its refitted values; whether the effect exists does not depend on the curve's uncertainty."""
    effect = next(e for e in fitted.effects if e.name == finding.name)
    before = {name: change.nominal for name, change in finding.parameters.items()}
    std = np.sqrt(np.diag(widened.of(effect.name)[1]))
    changes = changes_of(before, values_of(effect, fitted.profile), std, frames_of(fitted))
    p_value = significance(fitted, effect.name, observations, nominal)[1]
    return replace(finding, parameters=changes, p_value=p_value, sentence=sentence_of(effect.name, changes))


def _notes(light: PictureVerdict, curve: PictureVerdict) -> list[str]:
    if curve.mixed or light.observations is None or light_varies(light.observations):
        return []
    names = " and ".join(finding.name for finding in light.findings)
    return [
        f"the response curve could not be estimated at constant exposure: the profile's was used for {names}, and the "
        "standard deviations include its uncertainty"
    ]


# ── uncertainty of curve and exposure ──────────────────────────────────────────────────────────────────────────────


def _prior(given: CameraProfile) -> Array:
    """Prior standard deviations (2,) of the given curve, from its estimates where it has them."""
    curve = given.response
    if curve is None:
        return UNKNOWN_STD
    std = STATED_STD.copy()
    for index, name, value in ((_GAMMA, "gamma", curve.extra_gamma), (_BLACK, "black_level", curve.black_level)):
        known = given.estimates.get(name)
        if known is None or not isinstance(known.std, int | float) or not isinstance(known.value, int | float):
            continue
        if np.isclose(known.value, value, atol=1e-3):
            std[index] = max(known.std / (value if index == _GAMMA else 1.0), 1e-4)
    return std


def _added_covariance(
    observations: PhotometricObservations, fitted: PhotometricFit, uncertainty: CurveUncertainty
) -> Array:
    """Covariance (k, k) to add; a rival curve is as likely as the reported one."""
    changed = [(_shifted(fitted.profile, change), _STEP) for change in _STEP * np.eye(3)]
    pull = pulls(observations, fitted.profile, fitted, changed)
    added = pull @ uncertainty.spread @ pull.T
    for curve in uncertainty.rivals:
        away = fit_photometry(observations, replace(fitted.profile, response=curve), fitted.effects)
        off = away.values - fitted.values
        added += 0.5 * np.outer(off, off)
    return np.asarray(added)


def _shifted(profile: CameraProfile, change: Array) -> CameraProfile:
    """The profile with (log gamma, black level, log exposure scale) changed."""
    gamma = profile.curve.extra_gamma * float(np.exp(change[0]))
    black_level = profile.curve.black_level + float(change[1])
    scale = profile.shutter.exposure_scale * float(np.exp(change[2]))
    return profile.with_curve(extra_gamma=gamma, black_level=black_level).with_shutter(exposure_scale=scale)


def _exposure_variance(causes: Sequence[Finding]) -> float:
    """Variance of the log exposure scale if that is among the causes; otherwise 0."""
    for finding in causes:
        if finding.name == "exposure_time":
            change = finding.parameters["exposure_scale"]
            return float((change.std / change.estimate) ** 2)
    return 0.0


def _curve_by_brightness(observations: PhotometricObservations, fitted: PhotometricFit, prior: Array) -> Array:
    """Second moments (3, 3) of the curve changes that the ladder did not report, from a joint fit with the rest."""
    names = [effect.name for effect in fitted.effects]
    curves: tuple[PhotometricEffect, ...] = (RESPONSE_GAMMA, BLACK_LEVEL)
    free = [k for k, effect in enumerate(curves) if effect.name not in names]
    spread = np.zeros((3, 3))
    if not free:
        return spread
    beside = fit_photometry(observations, fitted.profile, [*fitted.effects, *(curves[k] for k in free)])
    now = fitted.profile.curve
    inner = slice(len(fitted.values), None)
    estimate, covariance = beside.values[inner].copy(), beside.covariance[inner, inner].copy()
    if _GAMMA in free:
        slope = 1 / max(float(estimate[0]), 0.1)
        covariance[0] *= slope
        covariance[:, 0] *= slope
        estimate[0] = np.log(max(float(estimate[0]), 0.1) / now.extra_gamma)
    if _BLACK in free:
        estimate[-1] -= now.black_level
    spread[np.ix_(free, free)] = _second_moment(estimate, covariance, prior[free])
    return spread


def _curve_by_mixing(curve: PictureVerdict, prior: Array) -> CurveUncertainty:
    """Uncertainty after light mixing: of the reported change, else of an unreported gamma, else the prior's."""
    spread = np.zeros((3, 3))
    now = curve.profile.curve
    named = {finding.name: finding for finding in curve.findings}
    if "response_curve" in named:
        change = named["response_curve"].parameters["gamma"]
        spread[_GAMMA, _GAMMA] = (change.std / change.estimate) ** 2
    elif "black_level" in named:
        spread[_BLACK, _BLACK] = named["black_level"].parameters["black_level"].std ** 2
    elif "response_curve" in curve.mixed:
        found = curve.mixed["response_curve"][0]
        estimate, std = np.log(found.value / now.extra_gamma), found.std / found.value
        moment = _second_moment(np.array([estimate]), np.array([[std**2]]), prior[:1])
        spread[_GAMMA, _GAMMA] = moment[0, 0]
    else:
        spread[_GAMMA, _GAMMA] = prior[_GAMMA] ** 2
    rivals = (_rival(finding, rival.name, curve) for finding in curve.findings for rival in finding.rivals)
    return CurveUncertainty(spread, tuple(rivals))


def _rival(named: Finding, rival: str, curve: PictureVerdict) -> ResponseCurve:
    """The curve with its rival's change instead of the reported one."""
    fields = {"response_curve": "extra_gamma", "black_level": "black_level"}
    (change,) = named.parameters.values()
    now = curve.profile.curve
    return replace(now, **{fields[named.name]: change.nominal, fields[rival]: curve.mixed[rival][0].value})


def _second_moment(estimate: Array, covariance: Array, prior: Array) -> Array:
    """E[c cᵀ] of a measured change c, with a prior of mean 0 and standard deviation ``prior``."""
    precision = np.linalg.inv(covariance)
    posterior = np.linalg.inv(precision + np.diag(1 / prior**2))
    mean = posterior @ precision @ estimate
    return np.asarray(posterior + np.outer(mean, mean))
