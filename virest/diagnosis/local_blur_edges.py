"""Local blur measured as widths of isolated edges, in pixels (forward_model, section 9 (c)).

A straight step of light is spread across its normal by everything that blurs: the lens, defocus, and the part of the
motion path that lies along the normal.  Variances of blurs that follow each other add up, so the width of an edge is

    s² ≈ lens² + defocus² + n' Σ n,      Σ the covariance of the blur path, length²/12 along a straight one.

An edge is measured in linear light, where blurs act, by fitting a step spread by a Gaussian, a + b erf((u − u0)/√2 s),
to its profile.  It counts only if both plateaus reach ISOLATION widths from its middle and nothing else disturbs the
profile: textures, thin lines and shading fail that test, whereas steps pass it however blurred they are.

Few steps are isolated over a long reach, so taking for each edge the shortest reach that holds its own width would
favour edges that seem narrow.  All edges of a capture are therefore measured over one reach, WIDTH_MARGIN times
what their median width needs (:func:`evenly_isolated`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from virest.arrays import Array, Index, Picture
from virest.camera.response import ResponseCurve
from virest.capture.records import Frame
from virest.inference.edges import TANGENT_PX, sampled
from virest.inference.unsharp_mask import MIN_STEP_LEVELS

STEP_PX = 0.5
"""Sample spacing of a profile."""
REACHES_PX = (4.0, 5.5, 7.5, 10.0, 14.0, 16.5, 19.0)
"""Half lengths of the profiles that are fitted, shortest first."""
ISOLATION = 4.0
"""Plateaus must reach this many widths plus 1 px from the middle of the edge."""
WIDTH_MARGIN = 1.2
"""Edges up to this many times as wide as the median are measured over the reach that all edges of a capture share.
Widths in one capture scatter by 4 to 14 % (16 simulated captures of four scenes, defocus of 1.2 to 3.5 px)."""
MAX_SOFTNESS_RATIO = 2.0
"""Other frames of a capture may be up to this many times as soft, so reaches are fitted up to that width."""
MAX_MISFIT = 0.02
"""Largest rms of a profile about its fitted step, relative to the step's height; half or twice moves a simulated
defocus by 0.7 and 0.3 σ."""
LEAST_WIDTH_PX = 0.05
"""Bound of the fit: a step of this width is sharp within one pixel; edges that end here are left out."""
_FIT_STEPS, _FURTHER_STEPS = 12, 3
"""Iterations of the fit from a guess, and from the fit of the same step over a shorter reach."""


@dataclass(frozen=True, slots=True)
class EdgeWidths:
    """Widths of edges with their positions, times and conditions.

    Before :func:`isolated_edges`, one row for each edge and reach that holds it; afterwards, one row per isolated edge.
    """

    frame: Index
    """(n,) movie index."""
    stamp_s: Array
    """(n,) the frame's timestamp, camera clock."""
    exposure_s: Array
    """(n,) as logged."""
    points_px: Array
    """(n, 2) middle of the edge."""
    normal: Array
    """(n, 2) unit normal, from dark to bright."""
    number: Index
    """(n,) index of the edge in its frame."""
    reach_px: Array
    """(n,) half length of the profile."""
    width_px: Array
    """(n,) standard deviation of the Gaussian that blurs the step; 0 where the profile is not a step."""
    step_levels: Array
    """(n,) step height, grey levels."""
    brightness: Array
    """(n,) mean grey of the profile, 0 to 1."""
    candidates: int = 0
    """Number of gradients strong enough to be tested."""

    def __len__(self) -> int:
        return len(self.frame)

    def select(self, keep: NDArray[Any]) -> EdgeWidths:
        """The rows at a mask or index."""
        rows = {f.name: getattr(self, f.name)[keep] for f in fields(self) if f.name != "candidates"}
        return replace(self, **rows)


def join_edges(parts: Sequence[EdgeWidths]) -> EdgeWidths:
    """Concatenate the rows of several frames."""
    if not parts:
        none, points, number = np.zeros(0), np.zeros((0, 2)), np.zeros(0, np.intp)
        return EdgeWidths(number, none, none, points, points, number, none, none, none, none)
    names = [f.name for f in fields(EdgeWidths) if f.name != "candidates"]
    rows = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return EdgeWidths(**rows, candidates=sum(part.candidates for part in parts))


def observe_picture(picture: Picture, frame: Frame, curve: ResponseCurve, points: Array, normals: Array) -> EdgeWidths:
    """Widths of the edges in one frame, over every reach; points, normals: of :func:`find_edges`."""
    grey = _profiles(picture.astype(np.float32), points, normals)
    light = _profiles(curve.linear_table()[picture], points, normals)
    fit = measure_widths(light)
    step_levels, brightest, brightness = _levels_of(grey[fit.row], fit.reach_px)
    clipped = brightest > float(np.flatnonzero(~curve.clipped_table(1.5)).max(initial=0))
    full = np.ones(len(fit.row))
    return EdgeWidths(
        frame=np.full(len(full), frame.index, np.intp),
        stamp_s=frame.time_s * full,
        exposure_s=(frame.exposure_s or 0.0) * full,
        points_px=points[fit.row] + fit.centre_px[:, None] * normals[fit.row],
        normal=normals[fit.row],
        number=fit.row,
        reach_px=fit.reach_px,
        width_px=np.where((step_levels > MIN_STEP_LEVELS) & ~clipped, fit.width_px, 0.0),
        step_levels=step_levels,
        brightness=brightness / 255.0,
        candidates=len(points),
    )


def shared_reach_px(width_px: Array) -> float:
    """The common reach over which edges of these widths (n,) are measured."""
    return ISOLATION * WIDTH_MARGIN * float(np.median(width_px)) + 1.0 if len(width_px) else 0.0


def share_a_reach(edges: EdgeWidths) -> bool:
    """Whether all isolated edges were measured over at least one common reach (:func:`evenly_isolated`)."""
    return bool(np.all(edges.reach_px >= min(shared_reach_px(edges.width_px), REACHES_PX[-1])))


def isolated_edges(seen: EdgeWidths, least_reach_px: float = 0.0) -> EdgeWidths:
    """Each edge over its shortest reach of at least least_reach_px, if its profile there is a step."""
    far = seen.select(seen.reach_px >= least_reach_px)
    order = np.lexsort((far.reach_px, far.number, far.frame))
    edge = np.stack([far.frame, far.number], axis=-1)[order]
    first = order[np.r_[True, (np.diff(edge, axis=0) != 0).any(axis=1)]] if len(order) else order
    return far.select(first[far.width_px[first] > 0])


def evenly_isolated(seen: EdgeWidths, least: int) -> EdgeWidths:
    """The isolated edges over one common reach, WIDTH_MARGIN times what the median width needs; wider ones over theirs.

    Whether an edge of about the median width counts then depends on its surroundings, not on its own width.  If fewer
    than ``least`` edges are isolated over that reach, each is measured over its own.
    """
    found, reach_px = isolated_edges(seen), 0.0
    while len(found) >= max(least, 1):
        asked_px = shared_reach_px(found.width_px)
        longer_px = next((reach for reach in REACHES_PX if reach >= asked_px), REACHES_PX[-1])
        further = isolated_edges(seen, longer_px)
        if longer_px <= reach_px or len(further) < least:
            break
        found, reach_px = further, longer_px
    return found


def _profiles(plane: Any, points: Array, normals: Array) -> Array:
    """Mean of parallel profiles across each edge, (n, 2 reach / STEP_PX + 1), dark to bright; NaN outside the frame."""
    along = np.arange(-REACHES_PX[-1], REACHES_PX[-1] + 1e-9, STEP_PX)
    tangents = np.stack([-normals[:, 1], normals[:, 0]], -1)
    total = np.zeros((len(points), len(along)))
    for across in TANGENT_PX:
        where = (points + across * tangents)[:, None] + along[:, None] * normals[:, None]
        total += sampled(plane, where)
    return total / len(TANGENT_PX)


def _levels_of(grey: Array, reach_px: Array) -> tuple[Array, Array, Array]:
    """(step between the profile's ends, brightest sample, mean) over each edge's own reach."""
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
    """Steps fitted to profiles over every reach that holds them; width 0: the profile is not a step."""

    row: Index
    """(n,) index of the profile."""
    width_px: Array
    centre_px: Array
    reach_px: Array


def measure_widths(profiles: Array) -> WidthFit:
    """Fit profiles (n, m) of a frame over all reaches that may be shared; keep those that hold ISOLATION widths.

    The reaches follow from the profiles alone, not from a predicted blur, so no model chooses its own evidence.
    """
    count, middle = len(profiles), profiles.shape[1] // 2
    centre, width, ended = np.zeros(count), np.zeros(count), np.zeros(count, bool)
    parts = [(np.zeros(0, np.intp), *[np.zeros(0)] * 3)]
    for reach in REACHES_PX:
        half = round(reach / STEP_PX)
        part = profiles[:, middle - half : middle + half + 1]
        whole = np.isfinite(part).all(axis=1) & (np.ptp(np.nan_to_num(part), axis=1) > 0)
        misfit = np.full(count, np.inf)
        further = ended & (reach <= MAX_SOFTNESS_RATIO * shared_reach_px(width[ended]))
        for rows, steps in ((whole & ~ended, _FIT_STEPS), (whole & further, _FURTHER_STEPS)):
            width[rows & ~ended] = 0.25 * reach
            centre[rows & ~ended] = 0.0
            centre[rows], width[rows], misfit[rows] = fit_steps(part[rows], reach, (centre[rows], width[rows]), steps)
        ends = (
            whole
            & (further | ~ended)
            & (ISOLATION * width + 1.0 <= reach - np.abs(centre))
            & (np.abs(centre) < 0.5 * reach)
        )
        good = (misfit < MAX_MISFIT) & (width > LEAST_WIDTH_PX)
        ended |= ends & good
        parts.append((*np.nonzero(ends), np.where(good, width, 0.0)[ends], centre[ends], np.full(ends.sum(), reach)))
    return WidthFit(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def fit_steps(
    profiles: Array, reach_px: float, start: tuple[Array, Array] | None = None, steps: int = _FIT_STEPS
) -> tuple[Array, Array, Array]:
    """Least squares of a + b erf((u − u0)/√2 s) to profiles (n, m) over ± reach: u0, s, misfit.

    a and b follow linearly from u0 and s; these by damped Gauss-Newton steps.  misfit: rms as a fraction of the step
    2 b.  start: u0 and s (n,); None: a step in the middle, a quarter of the reach wide.
    """
    u = np.linspace(-reach_px, reach_px, profiles.shape[1])
    centre, width = start or (np.zeros(len(profiles)), np.full(len(profiles), 0.25 * reach_px))
    centred, jacobian = profiles - profiles.mean(axis=1, keepdims=True), np.ones((len(profiles), 4, len(u)))
    for _ in range(steps):
        _, residual = _step_model(u, centred, centre, width, jacobian)
        normal = jacobian @ jacobian.transpose(0, 2, 1)
        normal[:, range(4), range(4)] *= 1.0 + 1e-3
        normal[:, range(4), range(4)] += 1e-12
        move = np.linalg.solve(normal, jacobian @ residual[..., None])[..., 0]
        centre = np.clip(centre + np.clip(move[:, 2], -1.0, 1.0), -reach_px, reach_px)
        width = np.clip(width * np.exp(np.clip(move[:, 3] / width, -0.5, 0.5)), LEAST_WIDTH_PX, 2 * reach_px)
    level, residual = _step_model(u, centred, centre, width)
    with np.errstate(divide="ignore", invalid="ignore"):
        misfit = np.where(level > 0, np.sqrt(np.mean(residual**2, axis=1)) / (2 * level), np.inf)
    return centre, width, misfit


def _step_model(
    u: Array, centred: Array, centre: Array, width: Array, jacobian: Array | None = None
) -> tuple[Array, Array]:
    """(best b, residuals of the profiles), profiles without their means.

    jacobian: (n, 4, m) is filled with the derivatives with respect to a, b, u0 and s; that of a is 1 already.
    """
    z = (u - centre[:, None]) / width[:, None]
    shape = erf(z / np.sqrt(2.0))
    away = shape - shape.mean(axis=1, keepdims=True)
    b = np.einsum("nm,nm->n", away, centred) / np.maximum(np.einsum("nm,nm->n", away, away), 1e-12)
    if jacobian is not None:
        jacobian[:, 1] = shape
        np.multiply(np.exp(-0.5 * z**2), (-np.sqrt(2 / np.pi) * b / width)[:, None], out=jacobian[:, 2])
        np.multiply(jacobian[:, 2], z, out=jacobian[:, 3])
    return b, centred - b[:, None] * away
