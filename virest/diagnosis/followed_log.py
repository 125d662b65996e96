"""Whether brightness changes follow what the phone logged: ISO, exposure, time, or another frame's exposure × ISO.

The brightness ladder names one gain per frame (``gain_drift``) or a curve where patches and logged exposure × ISO
disagree.  If a few numbers over a logged quantity explain the patches as well, two readings remain, and brightness
alone cannot decide between them: the light changed and the phone adapted, or the sensor does not do what the log says.
A curve with another gamma changes the brightness of all patches alike when exposure × ISO changes, as a gain over ISO
does.  The finding then names these readings as rivals and says what would tell them apart.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import null_space

from virest.arrays import Array, Index
from virest.camera.field import cardinal_weights
from virest.camera.profile import CameraProfile
from virest.capture.records import Frame
from virest.diagnosis.field.forms import TIME
from virest.diagnosis.field.screening import RIVAL_GAIN_FRACTION
from virest.diagnosis.field.words import SAMPLES, curve_shape
from virest.diagnosis.findings import Finding, HeldOutGain, Rival
from virest.diagnosis.own_exposures import FROM_ONE
from virest.diagnosis.photometry import PhotometricObservations, normalised_rms
from virest.diagnosis.photometry_effects import FollowedGain
from virest.diagnosis.photometry_fit import fit_photometry, judge
from virest.diagnosis.picture_ladder import PictureVerdict
from virest.inference.parallel import ParallelMap, one_by_one
from virest.restoration.frame_time_plan import ROWS_LATE, rows_apart

KNOTS = 5
"""Most knots of a curve over a logged quantity: a cubic spline through 5 follows one period to 10 % (rms)."""
FOLLOWED = ("gain_drift", "response_curve", "black_level")
"""Causes that brightness shows where exposure × ISO varies."""
NEXT = {
    "iso": "film a still wall in constant light at one exposure time and several ISO values",
    "exposure": "film a still wall in constant light at one ISO and several exposure times",
}
"""By covariate: the measurement that tells a sensor that does not follow its log from light that changes."""
LOGGED = {"iso": "ISO", "exposure": "exposure time", TIME: "time"}
"""What the text calls the covariates."""


@dataclass(frozen=True, slots=True)
class Form:
    """Gains of frames as a function of something logged."""

    name: str
    basis: Array
    """(frames, k) log gains per number, by movie index."""
    along: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """(SAMPLES, k) log gains at even steps of the covariate."""
    frames_off: int = 0
    """Rows by which the log is off; 0: not of this kind."""

    @property
    def rival(self) -> str:
        """Its name among the rivals."""
        if self.frames_off:
            return f"exposure and ISO logged {rows_apart(self.frames_off)}"
        return f"gain over {LOGGED[self.name]}"


@dataclass(frozen=True, slots=True)
class _Followed:
    """A form that explains the patches, its shape, and the held-out residual."""

    form: Form
    shape: str
    held_out: HeldOutGain


def with_followed_log(light: PictureVerdict, frames: Sequence[Frame], each: ParallelMap = one_by_one) -> PictureVerdict:
    """The verdict on brightness, its causes with the logged quantities that explain the patches as well.

    frames: all of the movie, by index.
    """
    names = [finding.name for finding in light.findings if finding.name in FOLLOWED]
    if len(names) != 1 or light.observations is None or not light.observations.product_known:
        return light
    found = _followed(light.observations, light.profile, light.nominal or light.profile, names[0], frames, each)
    if not found:
        return light
    findings = [_told(finding, found) if finding.name == names[0] else finding for finding in light.findings]
    return replace(light, findings=findings)


def _followed(
    seen: PhotometricObservations,
    profile: CameraProfile,
    given: CameraProfile,
    cause: str,
    frames: Sequence[Frame],
    each: ParallelMap,
) -> list[_Followed]:
    """The forms that remove nearly as much as the cause does, best first."""
    without = _without(profile, given, cause)
    before, after = (normalised_rms(seen, one)[0] for one in (without, profile))
    most_left = after**2 + (1 - RIVAL_GAIN_FRACTION) * (before**2 - after**2)
    own, known = (np.log(one.extensions.gain_of(range(len(frames)))) for one in (profile, without))
    found = []
    for form in possible_forms(frames, seen.frames):
        if cause != "gain_drift" and form.name == TIME:  # a slow drift beside a changing exposure is no curve
            continue
        start = np.asarray(np.linalg.lstsq(form.basis[seen.frames], (own - known)[seen.frames])[0])
        effect = FollowedGain(known, form.basis, start)
        fit = fit_photometry(seen, without, [effect])
        if fit.rms**2 > most_left:
            continue
        if form.frames_off and abs(float(fit.values[0]) - 1) > FROM_ONE:
            continue
        held = judge(seen, without, [effect], each, by_side=True)
        if held.after**2 > most_left:
            continue
        shape = curve_shape(form.along @ fit.values, form.name) if len(form.along) else ""
        found.append(_Followed(form, shape, held))
    return sorted(found, key=lambda one: one.held_out.after)


def _without(profile: CameraProfile, given: CameraProfile, cause: str) -> CameraProfile:
    """A profile without a cause: with the given profile's gains, gamma or black level."""
    if cause == "gain_drift":
        return profile.with_extensions(gain=given.extensions.gain)
    if cause == "response_curve":
        return profile.with_curve(extra_gamma=given.curve.extra_gamma)
    return profile.with_curve(black_level=given.curve.black_level)


def possible_forms(frames: Sequence[Frame], seen: Index) -> Iterator[Form]:
    """Curves over ISO, exposure and time, where these vary over the frames in ``seen``, and shifts of the log."""
    exposure_s = np.array([frame.exposure_s or np.nan for frame in frames])
    iso = np.array([frame.iso or np.nan for frame in frames])
    time_s = np.array([frame.time_s for frame in frames])
    for name, values in (("iso", np.log(iso)), ("exposure", np.log(exposure_s)), (TIME, time_s)):
        distinct = np.unique(values[seen])
        if not np.isfinite(distinct).all() or len(distinct) < 2:
            continue
        knots = tuple(np.linspace(distinct[0], distinct[-1], min(KNOTS, len(distinct))).tolist())
        held = np.nan_to_num(values, nan=float(distinct[0]))
        weights = cardinal_weights(knots, held)
        changing = null_space(weights[seen].mean(axis=0, keepdims=True))
        along = cardinal_weights(knots, np.linspace(knots[0], knots[-1], SAMPLES)) @ changing
        yield Form(name, weights @ changing, along)
    light = np.log(exposure_s * iso)
    if not np.isfinite(light).all() or not np.ptp(light):
        return
    for rows in ROWS_LATE:
        moved = np.clip(np.arange(len(light)) + rows, 0, len(light) - 1)
        yield Form("", (light[moved] - light)[:, None], frames_off=rows)


def _told(finding: Finding, found: Sequence[_Followed]) -> Finding:
    """The finding with its rivals, and what they mean."""
    rivals = (*finding.rivals, *(Rival(one.form.rival, one.held_out.after) for one in found if one.form.name != TIME))
    best = found[0]
    names = [one.form.name for one in found if not one.form.frames_off]
    logged = [name for name in names if name in NEXT]
    doubted = " or ".join(LOGGED[name] for name in logged)
    apart = f"; to tell them apart, {NEXT[logged[0]]}" if logged else ""
    if best.form.frames_off:
        said = f"{best.form.rival} would explain it: compare the table with the movie where the light jumps"
    elif not logged:
        said = f"the gains follow time, {best.shape}"
    elif finding.name == "gain_drift":
        over = f"over the logarithm of the {LOGGED[best.form.name]}" if best.form.name in NEXT else "over time"
        said = (
            f"the gains follow the {' or the '.join(LOGGED[name] for name in names)} ({best.shape} {over}): "
            f"the light changed as the phone adapted, or {doubted} does not act as logged{apart}"
        )
    else:
        said = f"a gain over {doubted} would explain it equally well: it may not act as logged{apart}"
    return replace(finding, rivals=rivals, sentence=f"{finding.sentence}; {said}")
