"""The tracking bias of Lucas-Kanade for a point that two frames blur differently, relative to its mean blur path.

A frame shows a feature T convolved with its blur path p(τ), of transfer K(f) = mean exp(-i f . p(τ)).  The tracker
matches the two pictures K₁ T and K₂ T; to first order it converges to the shift e where

    Σ f |T|² Im(K₁* K₂ exp(i f . e)) = 0,   e = -(Σ f fᵀ |T|² Re K₁* K₂)⁻¹ Σ f |T|² Im K₁* K₂,

with K about the mean of each path.  Paths of constant speed have real K and e = 0.  An accelerated path is denser at
its slow end, and frequencies near its length respond to that end.  Hand motion is fastest between reversals, so tracked
steps are too short: by 0.1 % at 5 px of blur and 0.3 % at 9 px, which a fit would absorb in focal length and
distortion.

A guide blurs the sharper picture by a Gaussian of covariance C before matching, which multiplies K₁* K₂ by
exp(-fᵀ C f / 2): high frequencies count less, and e is about half as large.

A corner in a window of w px has the power |T|² = 1 / (f² + (2π/w)²)².  Letters, leaves and a board, blurred by hand
motion, give 0.76 to 1.57 times the predicted e: ``RELATIVE_STD``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from virest.arrays import Array, Index, Mask
from virest.camera.profile import CameraProfile
from virest.image_formation.point_model import IntegratedMotion, TrackTable, seen_s
from virest.inference.guidance import applied_blur
from virest.inference.tracking import TrackingSettings, shrink_factor
from virest.motion.trajectory import turned

RELATIVE_STD = 0.35
"""Relative standard deviation of e, because textures differ."""
LEFT_BY_EVEN_BLUR = 0.3
"""Standard deviation of the part of e that :mod:`virest.inference.even_blur` leaves.  In 45 captures drawn by
``virest.app.bench.calibration.drawn_capture`` (seeds 1 to 18 and 2500 to 2526) 0.1 is the most likely for all values,
but then the median error of an exposure scale, which depends on blur most, is 1.1 deviations, and 0.8 with 0.3.
``python -m virest.app.bench --only calibration`` prints the most likely for its captures."""
DIRECTIONS, RADII, HIGHEST = 8, 10, 0.4
"""Samples of the frequency plane; HIGHEST in cycles per pixel: the pixel aperture suppresses higher frequencies."""
NODES = 15
"""Quadrature nodes along a path: e is exact to 1 % up to 8 px of blur in both directions, and to 25 % up to 12 px."""
MOST_SHIFT_PX = 0.3
"""Larger e are clipped to this: the first order holds for shifts that are small relative to a corner's detail."""
LEAST_BLUR_PX = 0.3
"""Points with less blur in both frames together have no bias."""
SHORTEST_S = 1e-6
"""Guard against a division by zero: a half exposure, where it is unknown."""
LEAST_COMMON = 0.5
"""If a smaller fraction of the detail has the same sign in both frames, |Re| replaces Re, so that e stays finite."""
POINTS_AT_ONCE = 2000
"""Limits the memory: 80 frequencies and 15 nodes for each point take 10 kB."""


def blur_bias_px(known: IntegratedMotion, table: TrackTable, guided: Mask) -> Array:
    """Tracked minus true second points (n, 2), px, from the camera's rotation during both exposures.

    guided: (pairs,) whether a guide made the pair's pictures equally blurred.
    """
    profile = known.profile
    factor = shrink_factor(profile.width, profile.height)
    paths = []
    for points_px, stamp_s, exposure_s in (
        (table.first_px, table.first_stamp_s, table.first_exposure_s),
        (table.second_px, table.second_stamp_s, table.second_exposure_s),
    ):
        time_s = seen_s(profile, points_px, stamp_s, exposure_s)
        half_s = 0.5 * np.asarray(profile.shutter.true_exposure_s(exposure_s))
        paths.append(_path(known, points_px, time_s, half_s) / factor)
    added = _added_blur(paths[0][0], paths[1][0], table.pair, guided)
    found = np.zeros((len(table), 2))
    blurred = np.flatnonzero(
        np.linalg.norm(paths[0][0], axis=-1) + np.linalg.norm(paths[1][0], axis=-1) > LEAST_BLUR_PX
    )
    for part in np.array_split(blurred, max(len(blurred) // POINTS_AT_ONCE, 1)):
        first, second = ((speed[part], bend[part]) for speed, bend in paths)
        found[part] = factor * matched_shift_px(first, second, added[part])
    return found


def rolling_shift_px(known: IntegratedMotion, points_px: Array, stamp_s: Array, exposure_s: Array) -> Array:
    """Shift (n, 2), px, of blurred points from the mean of the forward model, because rows are read while they move.

    A point that moves with the velocity v, and v_a along the readout, is exposed for 1 / (1 - v_a ρ) times its row's
    exposure E, ρ being the time from row to row, and differently long before and after the middle if it accelerates.
    To first order in v_a ρ, its mean then lies ρ E² / 12 d/dt (v v_a) further: 0.1 px at 24 px of blur, a readout of
    20 ms and 30000 px/s².
    """
    profile = known.profile
    half_s = np.maximum(0.5 * profile.shutter.true_exposure_s(exposure_s), SHORTEST_S)
    speed, bend = _path(known, points_px, seen_s(profile, points_px, stamp_s, exposure_s), half_s)
    late = late_per_exposure(profile, points_px, stamp_s, half_s)
    crossed, bent = ((vector * late).sum(axis=-1, keepdims=True) for vector in (speed, bend))
    return np.asarray(np.clip(2 / 3 * (speed * bent + bend * crossed), -MOST_SHIFT_PX, MOST_SHIFT_PX))


def late_per_exposure(profile: CameraProfile, points_px: Array, stamp_s: Array, half_s: Array) -> Array:
    """Time (n, 2) by which the next pixels to the right and below are read later, in half exposures (n,)."""
    at_s = seen_s(profile, points_px, stamp_s, 2 * half_s)
    later_s = [seen_s(profile, points_px + way, stamp_s, 2 * half_s) - at_s for way in np.eye(2)]
    return np.stack(later_s, axis=-1) / half_s[:, None]


def matched_shift_px(first: tuple[Any, Any], second: tuple[Any, Any], added: Array | None = None) -> Array:
    """Shift e (n, 2), px, between features with the blur paths p(u) = speed u + bend u², u from -1 to 1.

    first, second: speed (n, 2) and bend (n, 2) of both exposures, px.  added (n, 2, 2): covariance of the Gaussian blur
    added to either picture before matching, px².
    """
    f, power = _corner_spectrum()
    both = np.conj(_transfer(*first, f)) * _transfer(*second, f)
    if added is not None:
        both = both * np.exp(-0.5 * np.einsum("ki,nij,kj->nk", f, added, f))
    pull = (power * both.imag) @ f
    stiffness, firm = (np.einsum("nk,ki,kj->nij", power * real, f, f) for real in (both.real, np.abs(both.real)))
    loose = np.trace(stiffness, axis1=1, axis2=2) < LEAST_COMMON * np.trace(firm, axis1=1, axis2=2)
    stiffness[loose] = firm[loose]
    found = -np.linalg.solve(stiffness, pull[..., None])[..., 0]
    length = np.linalg.norm(found, axis=-1, keepdims=True)
    return np.asarray(found * np.minimum(1.0, MOST_SHIFT_PX / np.maximum(length, MOST_SHIFT_PX)))


def _added_blur(first_speed: Array, second_speed: Array, pair: Index, guided: Mask) -> Array:
    """Covariances (n, 2, 2), px², of the blur that a guide adds to the pictures of each point's pair."""
    count = np.maximum(np.bincount(pair, minlength=len(guided)), 1)[:, None]
    first, second = (
        np.stack([np.bincount(pair, column, len(guided)) for column in products.T], axis=-1) / count
        for products in ((v[:, :, None] * v[:, None, :] / 3).reshape(-1, 4) for v in (first_speed, second_speed))
    )
    added = applied_blur((second - first).reshape(-1, 2, 2)) + applied_blur((first - second).reshape(-1, 2, 2))
    return np.asarray(added * guided[:, None, None])[pair]


def _path(known: IntegratedMotion, points_px: Array, time_s: Array, half_s: Array) -> Array:
    """Speed and bend (2, n, 2) of the blur paths of points over exposures of ± half_s (n,) around times (n,)."""
    world = turned(known.trajectory.orientation(time_s), known.lens.rays(points_px, time_s))
    ends = []
    for side in (-half_s, half_s):
        back = np.swapaxes(known.trajectory.orientation(time_s + side), -1, -2)
        ends.append(known.lens.project(turned(back, world), time_s + side) - points_px)
    return np.stack([0.5 * (ends[1] - ends[0]), 0.5 * (ends[1] + ends[0])])


def _transfer(speed: Array, bend: Array, f: Array) -> Array:
    """K (n, k) of paths about their mean at frequencies (k, 2), rad/px."""
    u, weight = np.polynomial.legendre.leggauss(NODES)
    along, across = np.asarray(speed) @ f.T, np.asarray(bend) @ f.T
    phase = (along[..., None] * u + across[..., None] * (u**2 - 1 / 3)).astype(np.float32)
    half = (0.5 * weight).astype(np.float32)
    return np.asarray((np.cos(phase) @ half).astype(float) - 1j * (np.sin(phase) @ half).astype(float))


def _corner_spectrum() -> tuple[Array, Array]:
    """Frequencies (k, 2), rad/px, of a half plane, and the power (k,) of a corner in the tracker's window there."""
    radius = 2 * np.pi * HIGHEST * (np.arange(RADII) + 0.5) / RADII
    angle = np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    f = (radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)).reshape(-1, 2)
    window = 2 * np.pi / TrackingSettings().window_px
    return f, np.repeat(radius / (radius**2 + window**2) ** 2, DIRECTIONS)
