"""Effects of field forms and named causes on tracked points: difference quotients of the point model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from virest.arrays import Array
from virest.capture.imu import ImuSamples
from virest.diagnosis.candidates import varies
from virest.diagnosis.geometric_effects import PLAIN_READOUT
from virest.image_formation.point_changes import PointChanges
from virest.image_formation.point_model import Prediction, TrackTable, predict
from virest.inference import profile_terms as terms_of
from virest.inference.term import Term, slopes_of
from virest.inference.track_fit import TrackFit
from virest.motion.scene_motion import DirectedMotion

STABILISER_CUTOFFS_HZ = (0.3, 1.0, 4.0)
"""From slow drift to hand shake, a factor of about 3 apart: a first-order filter's response changes over a decade."""
NAMED = (
    terms_of.TIME_OFFSET,
    terms_of.CLOCK_SKEW,
    PLAIN_READOUT,
    terms_of.GYRO_BIAS,
    terms_of.GYRO_SCALE,
    terms_of.IMU_ROTATION,
    terms_of.FOCAL,
    terms_of.FOCAL_DRIFT,
    terms_of.K1,
    terms_of.PRINCIPAL_POINT,
)
"""Named causes that move points; exposure time and stabiliser are added where they are identifiable."""


@dataclass(frozen=True, slots=True)
class Whitening:
    """Conversion of point differences from px to standard deviations."""

    noise_px: Array
    """(n,)."""
    way: Array | None
    """(n, 2) unit vectors along the parallax; None: no relief is allowed for."""
    shrink: Array | None
    """(n,) fraction removed along it."""

    def of(self, px: Array) -> Array:
        """Whitened (n, 2, k) of (n, 2, k)."""
        rows = px / self.noise_px[:, None, None]
        if self.way is None or self.shrink is None:
            return rows
        along = self.shrink[:, None] * np.einsum("ni,nik->nk", self.way, rows)
        return np.asarray(rows - self.way[:, :, None] * along[:, None, :])


@dataclass(frozen=True)
class PointResiduals:
    """Point residuals of a fit, ready for a regression."""

    imu: ImuSamples
    fit: TrackFit
    table: TrackTable
    prediction: Prediction
    whitening: Whitening
    left: Array
    """(n, 2) in standard deviations."""
    weight: Array
    """(n,) robust weights over the squared scale."""

    def effect(self, terms: Sequence[Term]) -> Array:
        """Whitened change (n, 2, k) of the predicted points per free number of terms."""
        return self.whitening.of(slopes_of(terms, self.changes))

    @cached_property
    def changes(self) -> PointChanges:
        """Displacements of the predicted points under other profiles."""
        return PointChanges(self.imu, self.fit.integrated, self.table, self.fit.scene, self.prediction)

    def tangent(self) -> Array:
        """Whitened effect (n, 2, m) of all named causes and of the scene."""
        parts = [self.effect(NAMED), *(self._stabiliser(hz) for hz in STABILISER_CUTOFFS_HZ)]
        if varies(self.table.first_exposure_s):
            parts.append(self.effect((terms_of.EXPOSURE_SCALE,)))
        if self.prediction.slopes is not None:
            parts.append(self.whitening.of(self.prediction.slopes))
        return np.concatenate(parts, axis=-1)

    def _stabiliser(self, cutoff_hz: float) -> Array:
        """Effect of an additional stabiliser; at the profile's own cutoff where it has one already."""
        profile = self.fit.profile
        if profile.extensions.stabilisation_fraction:
            return self.effect((terms_of.STABILISATION,))
        extensions = replace(profile.extensions, stabilisation_fraction=0.02, stabilisation_cutoff_hz=cutoff_hz)
        return self.whitening.of(self.changes.by(replace(profile, extensions=extensions))[..., None] / 0.02)


def point_residuals(imu: ImuSamples, fit: TrackFit, table: TrackTable) -> PointResiduals:
    """The residuals of a fit, down-weighted along the parallax according to the spread of depths."""
    directed = isinstance(fit.scene, DirectedMotion)
    at = predict(fit.integrated, table, fit.scene, slopes=fit.scene is not None and not directed)
    way = shrink = None
    if at.along_px is not None:
        length = np.linalg.norm(at.along_px, axis=-1)
        way = at.along_px / np.maximum(length, 1e-12)[:, None]
        shrink = 1 - 1 / np.sqrt(1 + (fit.depth_spread_per_m * length / fit.noise_px) ** 2)
        shrink = np.ones_like(shrink) if directed else shrink
    whitening = Whitening(fit.noise_px, way, shrink)
    left = whitening.of((table.second_px - at.second_px)[..., None])[..., 0]
    return PointResiduals(imu, fit, table, at, whitening, left, fit.weight / fit.scale**2)
