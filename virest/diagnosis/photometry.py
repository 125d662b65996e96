"""Brightness of scene patches in many frames, measured and as a profile predicts it (forward_model, section 9).

Model of one observation of a patch with unknown light L, in grey levels of 255:
``grey = E(L · product · vignetting(r) · flicker(t) · gain)``, E the profile's curve with its gamma and black level,
``product`` the logged exposure × ISO.  L is a nuisance: each evaluation profiles it out, patch by patch, in grey
levels, where the noise is uniform.  In linear light, a steeper curve would shrink the residuals and explain anything.

A video encoder at a low bit rate delays small changes of brightness: in a flat moving patch it repeats its last frame
and corrects part of the difference.  Decoded grey: ``y[k] = x[k] + memory (y[k−1] − x[k])``, y = x in intra-coded
frames.  At 0.25 bits a pixel memory is about 0.25, and flicker of 100 Hz at 30 frames a second appears a third weaker
and 0.2 rad late.  The memory is a property of the movie; fits estimate it with the other values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from virest.arrays import Array, Index, Mask
from virest.camera.profile import CameraProfile
from virest.camera.response import ResponseCurve
from virest.image_formation.light import LEAST_LIGHT, flicker, light_maps, vignetting_at_radius
from virest.image_formation.row_clock import ROW_MIDDLE, ROW_START, RowClock

_LOG_LIGHT = np.arange(-9.5, 0.75, 0.002)
"""Grid of the tabulated curve, natural logarithm of light."""
_LIGHT_STEPS = 3
"""Steps of a patch's light; 2 or 6 give the same values to 0.001 σ (simulated vignetting and flicker)."""
_GREY_STEP = 1 / 64
"""Grid of the inverse, grey levels: the steps of a patch's light begin there."""
_LEAST_SLOPE = 0.02
"""Grey levels per unit of log light below which an observation does not determine its light."""


@dataclass(frozen=True, slots=True)
class PhotometricObservations:
    """Mean grey of patches, one entry for each patch, channel and frame that shows it; all arrays (n,)."""

    patch: Index
    """Patch and channel: 3 · place + channel.  Entries with the same number share one unknown light."""
    frame: Index
    """Movie index."""
    stamp_s: Array
    """The frame's timestamp, camera clock from stamp_0."""
    row_fraction: Array
    """Fraction s of the readout at the patch's centre, under the profile used to find the patches."""
    x_px: Array
    y_px: Array
    radius: Array
    """Distance from the frame centre, 1 at the corners."""
    grey: Array
    """Mean of the patch, grey levels of 255."""
    noise: Array
    """Standard deviation of ``grey``, measured without the camera model (photometry_noise)."""
    exposure_s: Array
    """As logged; 0 where unknown."""
    log_product: Array
    """Logarithm of logged exposure × ISO relative to the median frame; 0 where ISO or exposure are not logged."""
    log_product_std: Array
    """Its standard deviation due to rounding of the logged ISO."""
    intra: Mask
    """Whether the frame is intra-coded, without memory of earlier ones."""
    product_known: bool
    """Whether exposure and ISO are logged for every frame; without them no gain can be called unexplained."""
    width: int
    height: int
    memory: float = 0.0
    """Fraction of the last decoded brightness that the encoder keeps; a nuisance, fitted with the effects."""

    def __len__(self) -> int:
        return len(self.grey)

    @property
    def place(self) -> Index:
        """(n,) number of the patch without its channel."""
        return self.patch // 3

    @property
    def frames(self) -> Index:
        """(k,) movie indices that occur, ascending."""
        return np.unique(self.frame)

    def row_time_s(self, profile: CameraProfile, exposure_share: float = ROW_START) -> Array:
        """(n,) time at which each observation's row reaches a fraction of its exposure, IMU clock from stamp_0."""
        return np.asarray(RowClock(profile).time_s(self.stamp_s, self.exposure_s, self.row_fraction, exposure_share))

    def subset(self, use: Mask) -> PhotometricObservations:
        """The observations at a mask."""
        fields = {name: getattr(self, name) for name in self.__slots__}
        chosen: dict[str, Any] = {name: v[use] for name, v in fields.items() if isinstance(v, np.ndarray)}
        return replace(self, **chosen)

    def with_memory(self, memory: float) -> PhotometricObservations:
        """The same with another encoder memory."""
        return replace(self, memory=memory)


@dataclass(frozen=True, slots=True)
class Prediction:
    """A profile's prediction of the observations, with the patches' light profiled out."""

    residual: Array
    """(n,) measured − predicted, grey levels of 255."""
    slope: Array
    """(n,) derivative of the predicted grey with respect to log light, grey levels."""
    share: Array
    """(n,) weight of the observation in its patch's light; sums to 1 over a patch."""
    observations: PhotometricObservations

    def respond(self, columns: Array) -> Array:
        """Change of the residuals (n, k) when log light factors change by ``columns`` (n, k) and L is refitted."""
        change = remembered(self.observations, self.slope[:, None] * columns)
        patch, slope = self.observations.patch, self.slope[:, None]
        mean = np.stack([np.bincount(patch, self.share * c) for c in (change / slope).T], axis=-1)
        return -(change - slope * mean[patch])


def log_light_factor(observations: PhotometricObservations, profile: CameraProfile) -> Array:
    """(n,) logarithm of all factors on a patch's light: product, vignetting, brightness fields, flicker, gain."""
    ext = profile.extensions
    total = observations.log_product.copy()
    if ext.vignetting_corner_loss:
        total += np.log(vignetting_at_radius(profile, observations.radius))
    for field in light_maps(profile):
        gain = field.at(observations.x_px, observations.y_px)[..., 0]
        total += np.log(np.maximum(1.0 + gain, LEAST_LIGHT))
    if ext.flicker_amplitude:
        middle_s = observations.row_time_s(profile, ROW_MIDDLE)
        exposure_s = profile.shutter.true_exposure_s(observations.exposure_s)
        total += np.log(np.maximum(flicker(profile, middle_s, exposure_s), 1e-3))
    if ext.gain:
        total += np.log(ext.gain_of(observations.frame))
    return total


def predict(observations: PhotometricObservations, profile: CameraProfile, weight: Array | None = None) -> Prediction:
    """Fit each patch's light to its observations under the profile, and predict their grey.

    weight: (n,) weights in that fit; 1 / noise² unless given.
    """
    weight = 1.0 / observations.noise**2 if weight is None else weight
    table = _table(profile.curve)
    factor, kept = log_light_factor(observations, profile), _kept(observations)
    patch = observations.patch
    seen = table.log_light_of(observations.grey)
    slope = table.at(seen)[1]
    stiffness = weight * slope**2
    light = _patch_sum(patch, stiffness * (seen - factor)) / _stiffness_sum(patch, stiffness)
    for left in reversed(range(_LIGHT_STEPS + 1)):
        grey, slope = table.at(light[patch] + factor)
        residual = observations.grey - _remembered(kept, grey)
        pull = weight * slope
        stiffness = pull * slope
        whole = _stiffness_sum(patch, stiffness)
        if left:
            light = light + np.clip(_patch_sum(patch, pull * residual) / whole, -1.0, 1.0)
    return Prediction(residual, slope, stiffness / whole[patch], observations)


def remembered(observations: PhotometricObservations, grey: Array) -> Array:
    """Decoded brightness for true brightness (n,) or (n, k): each patch lags with the encoder's memory.

    Linear in ``grey``.  The memory of a patch fades over frames that do not show it; its first observation is exact.
    """
    return _remembered(_kept(observations), grey)


def _kept(observations: PhotometricObservations) -> list[Array]:
    """Fraction of a lag left after 1, 2, 4 … observations of its patch, (n,) each; empty without memory."""
    memory, patch, frame = observations.memory, observations.patch, observations.frame
    if memory == 0.0 or len(patch) == 0:
        return []
    follows = np.append(False, (patch[1:] == patch[:-1]) & (frame[1:] > frame[:-1])) & ~observations.intra
    kept = [np.where(follows, memory ** np.append(1, np.maximum(np.diff(frame), 1)), 0.0)]
    while (reach := 2 ** len(kept)) < 64 and memory**reach > 1e-4:
        half = reach // 2
        kept.append(np.concatenate([np.zeros(half), kept[-1][half:] * kept[-1][:-half]]))
    return kept


def _remembered(kept: Sequence[Array], grey: Array) -> Array:
    """Brightness (n,) or (n, k) plus its lag; lag[i] += kept[i] lag[i − 1], by doubling."""
    if not kept:
        return grey
    columns = (-1, *(1,) * (grey.ndim - 1))
    lag = kept[0].reshape(columns) * (np.roll(grey, 1, axis=0) - grey)
    for power, factor in enumerate(kept):
        reach = 2**power
        lag[reach:] = lag[reach:] + factor[reach:].reshape(columns) * lag[:-reach]
    return grey + lag


def residuals(observations: PhotometricObservations, profile: CameraProfile) -> Array:
    """Measured − predicted mean grey of the patches, grey levels of 255, (n,), with each patch's light profiled out."""
    return predict(observations, profile).residual


def normalised_rms(observations: PhotometricObservations, profile: CameraProfile) -> tuple[float, float]:
    """(rms of the residuals, rms of their noise), grey levels; residuals are capped at 5 noise σ.

    The first is corrected for the degree of freedom that each patch's light takes.
    """
    limit = 5 * observations.noise
    left = np.clip(residuals(observations, profile), -limit, limit)
    spent = np.bincount(observations.patch)[observations.patch]
    free = np.maximum(1 - 1 / spent, 1e-9)
    return float(np.sqrt(np.sum(left**2) / free.sum())), float(np.sqrt(np.mean(observations.noise**2)))


def _patch_sum(patch: Index, values: Array) -> Array:
    return np.asarray(np.bincount(patch, values), np.float64)


def _stiffness_sum(patch: Index, stiffness: Array) -> Array:
    """Sums of what is not negative, kept above 0."""
    return np.maximum(_patch_sum(patch, stiffness), 1e-12)


@dataclass(frozen=True, slots=True)
class _Table:
    """A curve on a uniform grid of log light, and its inverse on a uniform grid of grey levels."""

    pieces: Array
    """(m - 1, 4) grey of 255, its change to the next grid point, its slope per log light, the slope's change."""
    inverse: Array
    """Log light of grey levels _GREY_STEP apart."""

    def at(self, log_light: Array) -> tuple[Array, Array]:
        """Grey and its slope by linear interpolation, constant beyond the grid's ends."""
        position = (log_light - _LOG_LIGHT[0]) / (_LOG_LIGHT[1] - _LOG_LIGHT[0])
        position = np.minimum(np.maximum(position, 0.0), len(self.pieces) - 0.001)
        index = position.astype(np.intp)
        part = position - index
        piece = self.pieces.take(index, axis=0)
        return piece[:, 0] + part * piece[:, 1], piece[:, 2] + part * piece[:, 3]

    def log_light_of(self, grey: Array) -> Array:
        """Log light of the nearest grey level on the grid."""
        return self.inverse.take((grey / _GREY_STEP + 0.5).astype(np.intp), mode="clip")


@lru_cache(maxsize=16)
def _table(curve: ResponseCurve) -> _Table:
    grey = 255.0 * np.asarray(curve.encode(np.exp(_LOG_LIGHT)), float)
    slope = np.maximum(np.gradient(grey, _LOG_LIGHT), _LEAST_SLOPE)
    increasing = grey + 1e-9 * np.arange(len(grey))  # strictly, for the inverse
    pieces = np.stack([grey[:-1], np.diff(grey), slope[:-1], np.diff(slope)], axis=-1)
    return _Table(pieces, np.interp(np.arange(0.0, 255.0 + _GREY_STEP, _GREY_STEP), increasing, _LOG_LIGHT))
