"""The moving lens: focal length and stabiliser at every instant.

``focal_drift``: f(t) = f (1 + drift t) at every instant, t on the IMU's clock from stamp_0; fields of kind ``scale``
add to the factor.  ``stabilisation``: the picture is shifted by f(t) · fraction · θ, with θ the camera's integrated
rates about x and y through a continuous first-order high-pass from rest, θ' = ω − 2π cutoff θ.  The shift comes before
the distortion: x += fraction θ_y, y −= fraction θ_x in units of the focal length, each between ± the travel where the
lens has ends; roll stays.  There the filter runs on, or it stops, so that fraction θ stays between them too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from virest.arrays import Array
from virest.camera.field import Field
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import STOPS, CameraProfile
from virest.motion.trajectory import Trajectory

SHIFT_STEP_S = 5e-4
"""Step of the stabiliser's path: at 50 rad/s² linear interpolation errs by 1.6e-6 rad."""
NO_END_RAD = 1e6
"""Travel of a lens without ends: finite, so that a decay to 0 times it is 0."""
SETTLED = 16.0
"""After this many time constants 1 / (2π cutoff) the high-pass filter's initial state has decayed to 1e-7."""
RADIUS_STEPS = 5
"""A scale over the radius changes by a few percent: each step of its inversion reduces the error by that factor."""
MOST_GROWTH = 300.0
"""Decays are summed in parts whose inverse grows to at most exp of twice this: 1e261 can be represented."""
_SMALL = 1e-4
"""Below it the series, which errs by x³/24, is closer than the closed form, which loses 2e-16 / x to cancellation."""


@dataclass(frozen=True, slots=True)
class MovingLens:
    """A lens with a drifting focal length, shifted by a stabiliser."""

    lens: Intrinsics
    """At stamp_0, with the stabiliser at rest."""
    focal_drift_per_s: float = 0.0
    shift_time_s: Array | None = None
    """(m,) increasing, IMU clock from stamp_0; None: no stabiliser."""
    shift: Array | None = None
    """(m, 2) at those times, units of the focal length, added before distortion; linear between, constant beyond."""
    path: tuple[Array, Array] | None = None
    """All times (k,) of the motion and the camera's rates (k, 3), from which the shift was computed."""
    swing: tuple[float, Array] | None = None
    """Cutoff (Hz) of the stabiliser and the shift (k, 2), from rest, if it cancelled everything above the cutoff."""
    zoom: tuple[Field, ...] = ()
    """Relative changes of the focal length, over time or a logged covariate."""

    def rays(self, points_px: Array, time_s: Any, exposure_s: Any = 0.0) -> Array:
        """Rays (..., 3) with z = 1 through pixels (..., 2) seen at times (...): the inverse of :meth:`project`."""
        return self.from_rest(self.rays_at_rest(points_px, time_s), time_s, exposure_s)

    def rays_at_rest(self, points_px: Array, time_s: Any) -> Array:
        """Rays (..., 3) as if the stabiliser were at rest."""
        if self.focal_drift_per_s or self.zoom:
            points_px = self._about_centre(points_px, 1.0 / self._focal_scale(time_s, points_px))
        return self.lens.rays(points_px)

    def from_rest(self, rays: Array, time_s: Any, exposure_s: Any = 0.0) -> Array:
        """The rays (..., 3) of :meth:`rays_at_rest`, corrected for the stabiliser's shift at times (...).

        exposure_s: (...) around those times, over which the shift is averaged.
        """
        if self.shift is None:
            return rays
        plane = rays[..., :2] - self.shift_at(time_s, exposure_s)
        return np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1)

    def project(self, rays: Array, time_s: Any, exposure_s: Any = 0.0) -> Array:
        """Pixels (..., 2) of rays (..., 3) in camera axes at times (...), or over exposures around them.

        exposure_s: (...), over which the stabiliser's shift is averaged.
        """
        if self.shift is not None:
            plane = rays[..., :2] / rays[..., 2:] + self.shift_at(time_s, exposure_s)
            rays = np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1)
        points_px = self.lens.project(rays)
        if self.focal_drift_per_s or self.zoom:
            seen_px = points_px
            for _ in range(RADIUS_STEPS if self._over_radius else 1):
                seen_px = self._about_centre(points_px, self._focal_scale(time_s, seen_px))
            points_px = seen_px
        return points_px

    def shift_at(self, time_s: Any, exposure_s: Any = 0.0) -> Array:
        """The stabiliser's mean shift (..., 2) over exposures (...) around times (...), units of the focal length.

        Two-point Gauss quadrature: exact for paths that are cubic polynomials.
        """
        if self.shift is None or self.shift_time_s is None:
            return np.zeros((*np.shape(time_s), 2))
        if np.any(exposure_s):
            aside_s = np.asarray(exposure_s) / np.sqrt(12)
            return 0.5 * (self.shift_at(time_s - aside_s) + self.shift_at(time_s + aside_s))
        return np.stack([np.interp(time_s, self.shift_time_s, self.shift[:, i]) for i in (0, 1)], axis=-1)

    def between(self, start_s: float, end_s: float) -> MovingLens:
        """The same lens with the stabiliser's path restricted to [start_s, end_s]."""
        if self.shift_time_s is None or self.shift is None:
            return self
        first = max(int(np.searchsorted(self.shift_time_s, start_s, side="right")) - 1, 0)
        last = int(np.searchsorted(self.shift_time_s, end_s)) + 1
        cut = slice(first, last)
        return replace(self, shift_time_s=self.shift_time_s[cut], shift=self.shift[cut], path=None, swing=None)

    @property
    def _over_radius(self) -> bool:
        return any("radius" in field.covariates for field in self.zoom)

    def _focal_scale(self, time_s: Any, seen_px: Array) -> Array:
        """Factor (..., 1) on the focal length at times (...), for points seen at pixels (..., 2)."""
        total = 1.0 + self.focal_drift_per_s * np.asarray(time_s, float)[..., None]
        first = (self.lens.radius_px(seen_px),) if self._over_radius else ()
        for field in self.zoom:
            total = total + field.at_time(time_s, *(first if "radius" in field.covariates else ()))
        return np.asarray(total)

    def _about_centre(self, points_px: Array, scale: Array) -> Array:
        centre = np.array([self.lens.cx_px, self.lens.cy_px])
        return centre + (np.asarray(points_px, float) - centre) * scale


def moving_lens(
    trajectory: Trajectory, profile: CameraProfile, step_s: float = SHIFT_STEP_S, like: MovingLens | None = None
) -> MovingLens:
    """The profile's lens along a motion; the stabiliser is at rest at the trajectory's first knot.

    step_s: step of the stabiliser's path; a fit of tracked points tolerates a wider one than a restored picture.  like:
    a lens along the same motion on the same grid.  The trajectory should start :func:`settling_time_s` before the first
    time of interest, or with the log.  Raises ValueError without a focal length.
    """
    if profile.intrinsics is None:
        raise ValueError("the geometry needs intrinsics; frames without a focal length are copied")
    extensions = profile.extensions
    zoom = tuple(_on_imu_clock(field, profile) for field in extensions.field if field.kind == "scale")
    if not extensions.stabilisation_fraction:
        return MovingLens(profile.intrinsics, extensions.focal_drift_per_s, zoom=zoom)
    path = None if like is None else like.path
    if path is None:
        grid_s = _shift_grid(*trajectory.span_s, step_s)
        path = grid_s, trajectory.rate_rad_s(grid_s)
    time_s, fraction, cutoff_hz = path[0], extensions.stabilisation_fraction, extensions.stabilisation_cutoff_hz
    travel_rad, lean_rad = extensions.stabilisation_travel_rad, np.array(extensions.stabilisation_lean_rad)
    if travel_rad is not None and extensions.stabilisation_at_end == STOPS:
        shift = stabiliser_shift(*path, fraction, cutoff_hz, lean_rad, travel_rad)
        return MovingLens(profile.intrinsics, extensions.focal_drift_per_s, time_s, shift, path, None, zoom)
    swing = None if like is None else like.swing
    if swing is None or swing[0] != cutoff_hz or like is None or like.path is not path:
        swing = cutoff_hz, stabiliser_shift(*path, 1.0, cutoff_hz)
    shift = fraction * swing[1]
    if lean_rad.any():
        forgotten = np.exp(-2 * np.pi * cutoff_hz * (time_s - time_s[0]))
        shift = shift + fraction * forgotten[:, None] * np.array([lean_rad[1], -lean_rad[0]])
    if travel_rad is not None:
        shift = np.clip(shift, -travel_rad, travel_rad)
    return MovingLens(profile.intrinsics, extensions.focal_drift_per_s, time_s, shift, path, swing, zoom)


def _on_imu_clock(field: Field, profile: CameraProfile) -> Field:
    """A field over a logged covariate with its times converted to the IMU clock; other fields are unchanged."""
    if field.log is None:
        return field
    time_s, values = field.log
    return replace(field, log=(tuple(np.asarray(profile.imu_time_s(np.array(time_s)), float).tolist()), values))


def _shift_grid(start_s: float, end_s: float, step_s: float) -> Array:
    """Multiples of the step, and both ends: parts of a log share the grid, so results are identical to the last bit."""
    first, last = int(np.floor(start_s / step_s)) + 1, int(np.ceil(end_s / step_s))
    return np.concatenate([[start_s], step_s * np.arange(first, last), [end_s]])


def settling_time_s(profile: CameraProfile) -> float:
    """Time before a picture at which the inertial data must start for the stabiliser's state not to depend on it."""
    extensions = profile.extensions
    if not extensions.stabilisation_fraction:
        return 0.0
    return SETTLED / (2 * np.pi * max(extensions.stabilisation_cutoff_hz, 1e-9))


def stabiliser_shift(
    time_s: Array,
    rate_cam_rad_s: Array,
    fraction: float,
    cutoff_hz: Array | float,
    lean_rad: Array | tuple[float, float] = (0.0, 0.0),
    travel_rad: Array | float = NO_END_RAD,
) -> Array:
    """Shift (..., n, 2) in units of the focal length: x += fraction θ_y, y −= fraction θ_x.

    θ' = ω − 2π cutoff θ, solved exactly for a rate (n, 3), camera axes, that is linear between the times (n,); the
    filter stops where fraction θ reaches ± travel_rad.  lean_rad: θ at the first time.  cutoff_hz, travel_rad (...).
    """
    step_s = np.diff(time_s)
    decayed = 2 * np.pi * np.multiply.outer(cutoff_hz, step_s)[..., None, :]
    mean, ramp = _exponential_means(decayed)
    rate = np.ascontiguousarray(rate_cam_rad_s[:, :2].T)
    drive = step_s * ((mean - ramp) * rate[:, :-1] + ramp * rate[:, 1:])
    end = np.minimum(travel_rad, NO_END_RAD)[..., None, None] / max(abs(fraction), _SMALL)
    start = np.clip(np.asarray(lean_rad)[:, None], -end, end)
    shape = np.broadcast_shapes(drive[..., :1].shape, start.shape)
    start, drive = np.broadcast_to(start, shape), np.broadcast_to(drive, (*shape[:-1], len(step_s)))
    if np.all(travel_rad >= NO_END_RAD):
        theta = _free_response(decayed, drive, start)
    else:
        theta = _limited_response(np.exp(-decayed), drive, start, np.broadcast_to(end, drive.shape))
    theta = np.concatenate([start, theta], axis=-1)
    return fraction * np.swapaxes(np.stack([theta[..., 1, :], -theta[..., 0, :]], axis=-2), -1, -2)


def _exponential_means(x: Array) -> tuple[Array, Array]:
    """∫₀¹ e^(−x (1 − u)) du and ∫₀¹ u e^(−x (1 − u)) du: response to a constant and a rising rate after a step."""
    safe = np.where(x > _SMALL, x, 1.0)
    mean = np.where(x > _SMALL, -np.expm1(-safe) / safe, 1 - x / 2 + x * x / 6)
    ramp = np.where(x > _SMALL, (1 + np.expm1(-safe) / safe) / safe, 0.5 - x / 6 + x * x / 24)
    return mean, ramp


def _free_response(decayed: Array, drive: Array, start: Array) -> Array:
    """θ[1:] for θ[k + 1] = exp(−decayed[k]) θ[k] + drive[k], from θ[0] = start; time is the last axis."""
    decayed = np.minimum(decayed, MOST_GROWTH)
    total = np.cumsum(decayed.reshape(-1, decayed.shape[-1]).max(axis=0)) // MOST_GROWTH
    limits = [0, *(np.flatnonzero(np.diff(total)) + 1).tolist(), len(total)]
    found = np.empty_like(drive)
    for part in map(slice, limits[:-1], limits[1:]):
        growth = np.exp(np.cumsum(decayed[..., part], axis=-1))
        found[..., part] = (start + np.cumsum(drive[..., part] * growth, axis=-1)) / growth
        start = found[..., part][..., -1:]
    return found


def _limited_response(decay: Array, drive: Array, start: Array, end: Array) -> Array:
    """θ[1:] for θ[k + 1] = decay[k] θ[k] + drive[k], between ± end, from θ[0] = start; time is the last axis."""
    drive = drive.copy()
    drive[..., :1] += decay[..., :1] * start
    return _responses(decay, drive, -end, end)


def _responses(decay: Array, drive: Array, low: Array, high: Array) -> Array:
    """θ[1:], recursively: two steps θ → clip(decay θ + drive, low, high) combine into one of the same form.

    log2(n) vectorised passes, 2 n steps in all.
    """
    if drive.shape[-1] < 2:
        return np.clip(drive, low, high)
    found = np.empty_like(drive)
    found[..., :1] = np.clip(drive[..., :1], low[..., :1], high[..., :1])
    odd, even, later = np.s_[..., 1::2], np.s_[..., :-1:2], np.s_[..., 2::2]
    both = (_step(part[even], decay[odd], drive[odd], low[odd], high[odd]) for part in (low, high))
    found[odd] = _responses(decay[even] * decay[odd], decay[odd] * drive[even] + drive[odd], *both)
    found[later] = _step(found[..., 1:-1:2], decay[later], drive[later], low[later], high[later])
    return found


def _step(theta: Array, decay: Array, drive: Array, low: Array, high: Array) -> Array:
    return np.minimum(np.maximum(decay * theta + drive, low), high)
