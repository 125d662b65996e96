"""Brute-force exposure: sharp instants averaged row by row in linear light (forward_model, sections 1 and 8).

A row (or column) read at fraction s of the readout gathers light during [t, t + exposure], t = t_frame + s · readout.
At each instant of a common time grid only the rows being exposed are rendered.  Light is taken as linear in time
between instants, so each row is integrated over its exact interval.

Row order, lens and stabiliser are derived here from the profile's numbers alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.errors import SettingsError
from virest.simulation.hand_motion import FINE_STEP_S, HandMotion
from virest.simulation.hidden import NOTHING, Hidden, focal_changes, focal_scale, late_rows_s, seen_radius_px
from virest.simulation.scenes import Scene

Image = NDArray[Any]

STEP_PX = 0.4
"""Maximum image motion between two instants."""
FINEST_STEP_PX = 0.1
"""An exposure spans at least four steps, unless they would be shorter than this motion."""
_CONVERGED = 1e-12
"""Residual in x/z and y/z at which Newton's method stops; below it lies rounding error."""


@dataclass(frozen=True, slots=True)
class View:
    """Rays of a profile's pixels at any time."""

    profile: CameraProfile
    x: Image
    """x/z of each pixel's ray: (h, w), or (1, w) without distortion."""
    y: Image
    """y/z of each pixel's ray: (h, w), or (h, 1) without distortion."""
    x_rate: Image | None
    """Derivative of x with respect to s for a focal length f / (1 − s); None if the focal length is constant."""
    y_rate: Image | None
    """The same for y."""
    lens_s: Array
    """Times of the stabiliser's angles; empty without a stabiliser."""
    lens_rad: Array
    """(n, 2) pitch and yaw that it cancels, camera axes x and y."""
    hidden: Hidden = NOTHING

    def rays(self, time_s: float, rows: slice, columns: slice) -> tuple[Image, Image]:
        """x/z and y/z of the rays of an image region at one time; the two arrays broadcast."""
        x, y = _part(self.x, rows, columns), _part(self.y, rows, columns)
        if self.x_rate is not None and self.y_rate is not None:
            y_px, x_px = np.ogrid[: self.profile.height, : self.profile.width]
            radius_px = seen_radius_px(self.profile, x_px[:, columns], y_px[rows])
            shrinking = np.float32(1 - 1 / focal_scale(self.profile, self.hidden, time_s, radius_px))
            x = x + shrinking * _part(self.x_rate, rows, columns)
            y = y + shrinking * _part(self.y_rate, rows, columns)
        if len(self.lens_s):
            pitch, yaw = (np.interp(time_s, self.lens_s, self.lens_rad[:, i]) for i in (0, 1))
            x, y = x - np.float32(yaw), y + np.float32(pitch)
        return x, y


def make_view(
    profile: CameraProfile, motion: HandMotion, *, rest_s: float | None = None, hidden: Hidden = NOTHING
) -> View:
    """Compute a profile's pixel rays and its stabiliser angles along a motion, the stabiliser at rest at ``rest_s``."""
    lens = _require_lens(profile)
    x, y = pixel_rays(lens)
    x_rate = y_rate = None
    if focal_changes(profile, hidden):
        x_rate, y_rate = _focal_rate(lens)
        x, y = (np.broadcast_to(a, (lens.height, lens.width)) for a in (x, y))
    lens_s, lens_rad, held = np.empty(0), np.empty((0, 2)), profile.extensions
    if held.stabilisation_fraction:
        end = np.inf if held.stabilisation_travel_rad is None else held.stabilisation_travel_rad
        stop = end / abs(held.stabilisation_fraction) if held.stabilisation_at_end == "stops" else np.inf
        lens_s, angles = high_passed_angles(
            motion, held.stabilisation_cutoff_hz, motion.start_s if rest_s is None else rest_s, stop
        )
        lens_rad = np.clip(held.stabilisation_fraction * angles, -end, end)
    return View(profile, x, y, x_rate, y_rate, lens_s, lens_rad, hidden)


def start_fractions(direction: str, width: int, height: int) -> Array:
    """Fraction of the readout at which each row (or column) starts, by its index in the stored frame."""
    count = height if direction in ("top_to_bottom", "bottom_to_top") else width
    order = np.arange(count)
    if direction in ("bottom_to_top", "right_to_left"):
        order = order[::-1]
    return order / count


def expose(scene: Scene, motion: HandMotion, view: View, first_row_start_s: float, exposure_s: float) -> Image:
    """Mean linear light at each pixel over its row's exposure, with flicker: (h, w, 3).

    first_row_start_s: start of the first row's exposure on the clock of ``motion``.  exposure_s: true exposure time.
    """
    shutter = view.profile.shutter
    by_column = shutter.readout_direction in ("left_to_right", "right_to_left")
    width, height = view.profile.width, view.profile.height
    fraction = start_fractions(shutter.readout_direction, width, height)
    start_s = (
        first_row_start_s
        + shutter.readout_time_s * fraction
        + late_rows_s(view.profile, view.hidden, fraction, first_row_start_s, exposure_s / shutter.exposure_scale)
    )
    instants_s = _instants(scene, motion, view, start_s, exposure_s)
    weights = hat_weights(instants_s, start_s, exposure_s) * flicker(view.profile, instants_s)[:, None]
    homographies = _homographies(scene, motion, instants_s)
    light = np.zeros((height, width, 3), np.float32)
    for time_s, homography, weight in zip(instants_s.tolist(), homographies, weights, strict=True):
        exposing = np.flatnonzero(weight)
        if not len(exposing):
            continue
        band = slice(int(exposing[0]), int(exposing[-1]) + 1)
        rows, columns = (slice(None), band) if by_column else (band, slice(None))
        part = scene.sample(homography, *view.rays(time_s, rows, columns))
        share = weight[band].astype(np.float32)
        part *= share[None, :, None] if by_column else share[:, None, None]
        light[rows, columns] += part
    return light


def instant(scene: Scene, motion: HandMotion, view: View, time_s: float) -> Image:
    """Light of the whole frame at one time, as seen by a global shutter, without flicker: (h, w, 3)."""
    homography = _homographies(scene, motion, np.array([time_s]))[0]
    return scene.sample(homography, *view.rays(time_s, slice(None), slice(None)))


def hat_weights(instants_s: Array, start_s: Array, exposure_s: float) -> Array:
    """Weights (instants, rows) that average light over [start, start + exposure], linear between instants.

    instants_s: equally spaced and covering all exposures.  Each column sums to 1.
    """
    step = instants_s[1] - instants_s[0]
    begin = (start_s[None, :] - instants_s[:, None]) / step
    return (_hat_integral(begin + exposure_s / step) - _hat_integral(begin)) * (step / exposure_s)


def flicker(profile: CameraProfile, time_s: Array) -> Array:
    """Flicker factor on the light at each time."""
    ext = profile.extensions
    if not ext.flicker_amplitude:
        return np.ones(np.shape(time_s))
    return 1 + ext.flicker_amplitude * np.sin(2 * np.pi * ext.flicker_frequency_hz * time_s + ext.flicker_phase_rad)


def pixel_rays(lens: Intrinsics) -> tuple[Image, Image]:
    """x/z and y/z of each pixel's ray: (1, w) and (h, 1) without distortion, else (h, w) each."""
    x = (np.arange(lens.width) - lens.cx_px) / lens.fx_px
    y = (np.arange(lens.height) - lens.cy_px) / lens.fy_px
    if lens.displaced is not None:
        pixels = np.stack(np.meshgrid(np.arange(lens.width, dtype=float), np.arange(lens.height, dtype=float)), -1)
        seen = lens.displaced.undisplaced(pixels)
        x, y = (seen[..., 0] - lens.cx_px) / lens.fx_px, (seen[..., 1] - lens.cy_px) / lens.fy_px
        if lens.model == "none":
            return x.astype(np.float32), y.astype(np.float32)
    elif lens.model == "none" or (lens.model == "radtan" and not any(lens.coefficients)):
        return x[None, :].astype(np.float32), y[:, None].astype(np.float32)
    else:
        x, y = np.meshgrid(x, y)
    undistorted = _undo_fisheye(x, y, lens.coefficients) if lens.model == "fisheye" else _undo_radtan(x, y, lens)
    return undistorted[0].astype(np.float32), undistorted[1].astype(np.float32)


def high_passed_angles(
    motion: HandMotion, cutoff_hz: float, rest_s: float, stop_rad: float = np.inf
) -> tuple[Array, Array]:
    """High-pass the integrated rates about camera x and y, at rest at ``rest_s``: times (n,), angles (n, 2).

    First-order filter ``θ' = ω − 2π cutoff θ``, solved exactly for a rate linear within each step; it stops at
    ± ``stop_rad``.
    """
    time_s = np.arange(rest_s, motion.end_s, FINE_STEP_S)
    rate = motion.rate_rad_s(time_s)[:, :2]
    corner = 2 * np.pi * cutoff_hz
    decay = np.exp(-corner * FINE_STEP_S)
    mean = (1 - decay) / corner
    ramp = (1 - mean / FINE_STEP_S) / corner
    drive = (mean - ramp) * rate[:-1] + ramp * rate[1:]
    angle = np.zeros_like(rate)
    for i, step in enumerate(drive):
        angle[i + 1] = np.clip(decay * angle[i] + step, -stop_rad, stop_rad)
    return time_s, angle


# ── parts ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def _require_lens(profile: CameraProfile) -> Intrinsics:
    if profile.intrinsics is None:
        raise SettingsError("a simulated camera needs a focal length", hint="set intrinsics.fx_px")
    return profile.intrinsics


def _part(plane: Image, rows: slice, columns: slice) -> Image:
    """Slice an array whose single row or column may be broadcast."""
    return plane[rows if plane.shape[0] > 1 else slice(None), columns if plane.shape[1] > 1 else slice(None)]


def _instants(scene: Scene, motion: HandMotion, view: View, start_s: Array, exposure_s: float) -> Array:
    """Equally spaced times over all rows' exposures, at most STEP_PX of image motion apart."""
    begin, end = float(start_s.min()), float(start_s.max()) + exposure_s
    fastest = max(_picture_speed(scene, motion, view, begin, end), 1e-6)
    step = min(STEP_PX / fastest, max(exposure_s / 4, FINEST_STEP_PX / fastest), end - begin)
    if view.profile.extensions.flicker_amplitude:
        step = min(step, 1 / (24 * view.profile.extensions.flicker_frequency_hz))
    return np.linspace(begin, end, int(np.ceil((end - begin) / step)) + 1)


def _picture_speed(scene: Scene, motion: HandMotion, view: View, begin: float, end: float) -> float:
    """Maximum image speed, px/s: pitch and yaw at the centre, roll half way to a corner, sway and scene motion."""
    lens = _require_lens(view.profile)
    times = np.linspace(begin, end, 9)
    rate = motion.rate_rad_s(times)
    speed = lens.fx_px * np.hypot(rate[:, 0], rate[:, 1]) + 0.25 * np.hypot(lens.width, lens.height) * np.abs(
        rate[:, 2]
    )
    if np.isfinite(scene.depth_m):
        speed = speed + lens.fx_px * np.linalg.norm(motion.sway.at(times, 1), axis=1) / scene.depth_m
    return float(speed.max()) + lens.fx_px * scene.fastest_per_s


def _homographies(scene: Scene, motion: HandMotion, times_s: Array) -> Array:
    return scene.chart_from_ray(motion.rotation(times_s).as_matrix(), motion.position_m(times_s), times_s)


def _hat_integral(u: Array) -> Array:
    """Integral of the unit hat function from −∞ to u."""
    u = np.clip(u, -1.0, 1.0)
    return np.where(u < 0, 0.5 * (u + 1) ** 2, 1 - 0.5 * (1 - u) ** 2)


def _focal_rate(lens: Intrinsics) -> tuple[Image, Image]:
    """Derivatives of x/z and y/z with respect to s for a focal length f / (1 − s): (h, w) each."""
    small = 1e-3
    before, after = (
        [np.broadcast_to(a, (lens.height, lens.width)).astype(np.float64) for a in pixel_rays(shrunk)]
        for shrunk in (replace(lens, fx_px=lens.fx_px / (1 - s), fy_px=lens.fy_px / (1 - s)) for s in (-small, small))
    )
    x_rate, y_rate = ((b - a) / (2 * small) for a, b in zip(before, after, strict=True))
    return x_rate.astype(np.float32), y_rate.astype(np.float32)


def _undo_radtan(x: Array, y: Array, lens: Intrinsics) -> tuple[Array, Array]:
    """Invert Brown–Conrady distortion by Newton's method with a numerical Jacobian."""
    k1, k2, p1, p2, k3 = lens.coefficients

    def distort(u: Array, v: Array) -> tuple[Array, Array]:
        r2 = u**2 + v**2
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        return u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u**2), v * radial + p1 * (r2 + 2 * v**2) + 2 * p2 * u * v

    u, v, small = x.copy(), y.copy(), 1e-6
    for _ in range(8):
        fu, fv = distort(u, v)
        if max(np.abs(fu - x).max(), np.abs(fv - y).max()) < _CONVERGED:
            break
        gu, gv = distort(u + small, v)
        hu, hv = distort(u, v + small)
        a, b, c, d = (gu - fu) / small, (hu - fu) / small, (gv - fv) / small, (hv - fv) / small
        det = a * d - b * c
        eu, ev = fu - x, fv - y
        u, v = u - (d * eu - b * ev) / det, v - (a * ev - c * eu) / det
    return u, v


def _undo_fisheye(x: Array, y: Array, coefficients: tuple[float, ...]) -> tuple[Array, Array]:
    """Invert the Kannala–Brandt polynomial by interpolation in a fine table of angles."""
    theta = np.linspace(0, 1.5, 30_001)
    bent = theta + sum(k * theta ** (3 + 2 * i) for i, k in enumerate(coefficients))
    rising = int(np.argmax(np.diff(bent) <= 0)) or len(bent)
    radius = np.hypot(x, y)
    angle = np.interp(radius, bent[:rising], theta[:rising])
    scale = np.where(radius > 1e-9, np.tan(angle) / np.maximum(radius, 1e-12), 1.0)
    return x * scale, y * scale
