"""The local blur that the pictures show: widths of isolated edges, in pixels (forward_model, section 9 (c)).

A straight step of light is spread across its normal by everything that blurs: the lens, defocus, and the part of the
motion path that lies along the normal.  Variances of blurs that follow each other add up, so the width of an edge is

    s² ≈ lens² + defocus² + n' Σ n,      Σ the covariance of the blur path, length²/12 along a straight one.

An edge is measured in linear light, where blurs act, by fitting a step spread by a Gaussian, a + b erf((u − u0)/√2 s),
to its profile.  It counts only if both plateaus reach ISOLATION widths from its middle and nothing else disturbs the
profile: textures, thin lines and shading fail that test, whereas steps pass it however blurred they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from virest.camera.response import ResponseCurve
from virest.capture.records import Frame
from virest.inference.edges import TANGENT_PX, EdgeSettings, find_edges, sampled

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

STEP_PX = 0.5
"""Between two samples of a profile."""
REACHES_PX = (4.0, 5.5, 7.5, 10.0, 14.0, 19.0)
"""Half lengths of the profiles that are tried, shortest first."""
ISOLATION = 4.0
"""Plateaus must reach this many widths, and a pixel, from the edge's middle."""
_FIT_STEPS = 12


@dataclass(frozen=True, slots=True)
class EdgeWidths:
    """Widths of isolated edges, one row an edge, and where, when and under which conditions they were seen."""

    frame: NDArray[np.intp]
    """(n,) movie index."""
    stamp_s: Array
    """(n,) the frame's stamp, camera clock."""
    exposure_s: Array
    """(n,) as logged."""
    points_px: Array
    """(n, 2) middle of the edge."""
    normal: Array
    """(n, 2) unit normal, from dark to bright."""
    width_px: Array
    """(n,) standard deviation of the Gaussian that spreads the step."""
    noise_px: Array
    """(n,) standard deviation of width_px, from the profile's own misfit."""
    step_levels: Array
    """(n,) height, grey levels."""
    brightness: Array
    """(n,) mean grey of the profile, 0 to 1."""
    candidates: int = 0
    """Slopes strong enough to be tried."""

    def __len__(self) -> int:
        return len(self.frame)

    def select(self, keep: NDArray[Any]) -> EdgeWidths:
        """The rows of a mask or index."""
        rows = {f.name: getattr(self, f.name)[keep] for f in fields(self) if f.name != "candidates"}
        return replace(self, **rows)


def join_edges(parts: Sequence[EdgeWidths]) -> EdgeWidths:
    """Rows of several pictures, one after another."""
    if not parts:
        return _no_edges()
    names = [f.name for f in fields(EdgeWidths) if f.name != "candidates"]
    rows = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return EdgeWidths(**rows, candidates=sum(part.candidates for part in parts))


def observe_picture(
    picture: Picture,
    frame: Frame,
    curve: ResponseCurve,
    settings: EdgeSettings,
    found: tuple[Array, Array] | None = None,
) -> EdgeWidths:
    """Widths of the isolated edges of one picture; found: its edges, where :func:`find_edges` has given them."""
    points, normals = find_edges(picture, settings) if found is None else found
    grey = _profiles(picture.astype(np.float32), points, normals)
    light = _profiles(curve.linear_table()[picture], points, normals)
    fit = measure_widths(light, settings.max_misfit)
    step_levels, brightest, brightness = _levels_of(grey, fit.reach_px)
    clipped = brightest > float(np.flatnonzero(~curve.clipped_table(1.5)).max(initial=0))
    keep = (fit.width_px > 0) & (step_levels > settings.min_step_levels) & ~clipped
    moved = points + fit.centre_px[:, None] * normals
    full = np.ones(int(keep.sum()))
    return EdgeWidths(
        frame=np.full(len(full), frame.index, np.intp),
        stamp_s=frame.time_s * full,
        exposure_s=(frame.exposure_s or 0.0) * full,
        points_px=moved[keep],
        normal=normals[keep],
        width_px=fit.width_px[keep],
        noise_px=fit.noise_px[keep],
        step_levels=step_levels[keep],
        brightness=brightness[keep] / 255.0,
        candidates=len(points),
    )


def _profiles(plane: Any, points: Array, normals: Array) -> Array:
    """Mean of parallel profiles across each edge, (n, 2 reach / STEP_PX + 1), dark to bright; NaN outside."""
    along = np.arange(-REACHES_PX[-1], REACHES_PX[-1] + 1e-9, STEP_PX)
    tangents = np.stack([-normals[:, 1], normals[:, 0]], -1)
    total = np.zeros((len(points), len(along)))
    for across in TANGENT_PX:
        where = (points + across * tangents)[:, None] + along[:, None] * normals[:, None]
        total += sampled(plane, where)
    return total / len(TANGENT_PX)


def _levels_of(grey: Array, reach_px: Array) -> tuple[Array, Array, Array]:
    """Step between the profile's ends, its brightest sample, and its mean, over each edge's own reach."""
    middle = grey.shape[1] // 2
    away = np.abs(np.arange(grey.shape[1]) - middle) * STEP_PX
    inside = np.where(away <= reach_px[:, None], grey, np.nan)
    half = np.round(np.maximum(reach_px, 1.0) / STEP_PX).astype(np.intp)
    rows = np.arange(len(grey))
    step = grey[rows, middle + half] - grey[rows, middle - half]
    filled = np.where(np.isfinite(inside), inside, -1.0)
    count = np.maximum((filled >= 0).sum(axis=1), 1)
    return step, filled.max(axis=1, initial=-1.0), np.where(filled >= 0, filled, 0.0).sum(axis=1) / count


# ── the width of a profile ─────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class WidthFit:
    """Steps fitted to profiles; rows that are no isolated step have width 0."""

    width_px: Array
    noise_px: Array
    centre_px: Array
    reach_px: Array


def measure_widths(profiles: Array, max_misfit: float) -> WidthFit:
    """Fit each profile (n, m) over the shortest reach that holds ISOLATION widths on both sides of its step.

    The reach follows from the profile alone, never from a predicted blur, so the model cannot choose its own evidence.
    """
    count, middle = len(profiles), profiles.shape[1] // 2
    found = WidthFit(*(np.zeros(count) for _ in range(4)))
    open_rows = np.arange(count)
    for reach in REACHES_PX:
        half = round(reach / STEP_PX)
        part = profiles[open_rows, middle - half : middle + half + 1]
        whole = np.isfinite(part).all(axis=1) & (np.ptp(np.nan_to_num(part), axis=1) > 0)
        open_rows, part = open_rows[whole], part[whole]
        if not len(open_rows):
            break
        centre, width, noise, misfit = fit_steps(part, reach)
        ends = (ISOLATION * width + 1.0 <= reach - np.abs(centre)) & (np.abs(centre) < 0.5 * reach)
        good = ends & (misfit < max_misfit) & np.isfinite(noise) & (width > 0.05)
        rows = open_rows[good]
        found.width_px[rows], found.noise_px[rows] = width[good], noise[good]
        found.centre_px[rows], found.reach_px[rows] = centre[good], reach
        open_rows = open_rows[~ends & np.isfinite(width)]
    return found


def fit_steps(profiles: Array, reach_px: float) -> tuple[Array, Array, Array, Array]:
    """Least squares of a + b erf((u − u0)/√2 s) to profiles (n, m) over ± reach: u0, s, its deviation, misfit.

    a and b follow linearly from u0 and s; these by damped Gauss-Newton steps.  misfit: rms as part of the step 2 b.
    """
    u = np.linspace(-reach_px, reach_px, profiles.shape[1])
    centre, width = np.zeros(len(profiles)), np.full(len(profiles), 0.25 * reach_px)
    for _ in range(_FIT_STEPS):
        _, jacobian, residual = _step_model(u, profiles, centre, width)
        normal = np.einsum("nim,njm->nij", jacobian, jacobian)
        normal[:, range(4), range(4)] *= 1.0 + 1e-3
        normal[:, range(4), range(4)] += 1e-12
        move = np.linalg.solve(normal, np.einsum("nim,nm->ni", jacobian, residual)[..., None])[..., 0]
        centre = np.clip(centre + np.clip(move[:, 2], -1.0, 1.0), -reach_px, reach_px)
        width = np.clip(width * np.exp(np.clip(move[:, 3] / width, -0.5, 0.5)), 0.05, 2 * reach_px)
    level, jacobian, residual = _step_model(u, profiles, centre, width)
    # Samples are closer than a pixel, so neighbours share their noise: 1/STEP_PX of them count as one.
    free = max(len(u) * STEP_PX - 4.0, 1.0)
    variance = (residual**2).sum(axis=1) * STEP_PX / free
    normal = np.einsum("nim,njm->nij", jacobian, jacobian) * STEP_PX
    normal[:, range(4), range(4)] += 1e-12
    noise = np.sqrt(np.maximum(np.linalg.inv(normal)[:, 3, 3], 0) * variance)
    with np.errstate(divide="ignore", invalid="ignore"):
        misfit = np.where(level > 0, np.sqrt(np.mean(residual**2, axis=1)) / (2 * level), np.inf)
    return centre, width, noise, misfit


def _step_model(u: Array, profiles: Array, centre: Array, width: Array) -> tuple[Array, Array, Array]:
    """Best b, derivatives (n, 4, m) by a, b, u0 and s, and what is left of the profiles."""
    z = (u - centre[:, None]) / width[:, None]
    shape = erf(z / np.sqrt(2.0))
    mean_shape, mean_profile = shape.mean(axis=1, keepdims=True), profiles.mean(axis=1, keepdims=True)
    spread = ((shape - mean_shape) ** 2).sum(axis=1)
    b = ((shape - mean_shape) * (profiles - mean_profile)).sum(axis=1) / np.maximum(spread, 1e-12)
    residual = profiles - mean_profile - b[:, None] * (shape - mean_shape)
    bell = np.sqrt(2 / np.pi) * np.exp(-0.5 * z**2) * (b / width)[:, None]
    return b, np.stack([np.ones_like(shape), shape, -bell, -bell * z], axis=1), residual


def _no_edges() -> EdgeWidths:
    empty = np.zeros(0)
    return EdgeWidths(
        np.zeros(0, np.intp), empty, empty, np.zeros((0, 2)), np.zeros((0, 2)), empty, empty, empty, empty
    )
