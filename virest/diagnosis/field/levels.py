"""The level of a field: its constant part, which a named cause would describe as well.

A profile's focal length holds at some focus distance, its readout time at some exposure, and its bias at some time that
nobody recorded.  Where they change, the given value is therefore no error as long as the camera takes it somewhere in
its range: the field keeps its own level.  The cause is named beside the field only if the given value lies outside.
Delays of single frames are not a range that something moves through, but errors about a level, which is their mean.
"""

from __future__ import annotations

import numpy as np

from virest.arrays import Array
from virest.camera.field import Field, cardinal_weights
from virest.camera.profile import CameraProfile
from virest.diagnosis.field.forms import EXPOSURE, OVER, TIME, FieldForm
from virest.diagnosis.geometric_effects import GeometricEffect
from virest.inference.chance import chi2_tail
from virest.inference.track_fit import TrackFit
from virest.inference.tracking_bias import bias_std

LEVELS = {
    f"scale{OVER}focus": ("focal_length", 1.0),
    f"rate{OVER}{TIME}": ("gyro_bias", -1.0),
    f"delay{OVER}{TIME}": ("time_offset", 1.0),
    f"delay{OVER}row, {TIME}": ("readout_time", 1.0),
    f"delay{OVER}row, {EXPOSURE}": ("readout_time", 1.0),
}
"""By family of forms: the cause that describes its constant part, and the sign of a field's values in that cause's.
A rate is the true one minus the gyroscope's, so that it lowers the bias; the last row's delay lengthens the readout."""
FROM_ZERO = ("focus", EXPOSURE)
"""Covariates whose range begins at 0, where values are specified: a lens at infinity, a readout without an exposure.
Both laws are nearly linear: the image distance in the dioptres, and a line's time in its exposure."""
SAMPLES = 101
"""Steps of 1 % of the range."""


def level_cause(form: FieldForm) -> str | None:
    """Name of the cause that describes the constant part of a form; None: there is none."""
    return LEVELS[form.family][0] if form.family in LEVELS else None


def given_value_p(
    fitted: TrackFit, form: FieldForm, effect: GeometricEffect, given: CameraProfile, noise_px: float
) -> float:
    """p value of the hypothesis that a field's range includes the given value of the cause of its level.

    The value may differ from the given one by the cause, if that is fitted, and by the field.  noise_px: of a tracked
    step, per coordinate.
    """
    sign = LEVELS[form.family][1]
    field = form.held_in(fitted.profile, form.fields[0])
    weights = np.full((1, len(field.values)), 1 / len(field.values)) if form.by_frame else _range_weights(field)
    changes = effect.total_change(given, fitted.profile) + sign * (weights @ np.array(field.values))
    nearest = np.argmin(np.abs(changes), axis=0)
    gap = np.take_along_axis(changes, nearest[None], axis=0)[0]
    gap[(changes.min(axis=0) < 0) & (changes.max(axis=0) > 0)] = 0.0
    of_numbers = sign * np.einsum("ck,kcn->cn", weights[nearest], form.basis.reshape(len(field.values), len(gap), -1))
    covariance = _covariance(fitted, effect.name, form.name, of_numbers)
    bias = bias_std(fitted, effect.name, noise_px)
    return chi2_tail(gap @ np.linalg.solve(covariance + np.diag(bias**2), gap), len(gap))


def _covariance(fitted: TrackFit, cause: str, form: str, of_numbers: Array) -> Array:
    """Covariance (k, k) of a cause's values plus linear combinations (k, n) of a form's numbers."""
    slope = np.zeros((len(of_numbers), len(fitted.change)))
    slope[:, fitted.slices[form]] = of_numbers
    if cause in fitted.slices:
        slope[:, fitted.slices[cause]] = np.eye(len(of_numbers))
    count = len(fitted.change)
    return np.asarray(slope @ fitted.covariance[:count, :count] @ slope.T)


def _range_weights(field: Field) -> Array:
    """Weights (m, knots) of the knot values over the range that a camera takes; of two covariates, in the last row.

    The straight line through the values is continued to 0 where the range begins there.
    """
    knots = field.knots[-1]
    weights = cardinal_weights(knots, np.linspace(knots[0], knots[-1], SAMPLES))
    if field.covariates[-1] in FROM_ZERO:
        line = np.linalg.pinv(np.stack([np.ones(len(knots)), np.array(knots)], axis=-1))
        weights = np.concatenate([weights, line[:1]])
    if len(field.knots) == 1:
        return weights
    return np.asarray(np.kron(np.eye(len(field.knots[0]))[-1:], weights))
