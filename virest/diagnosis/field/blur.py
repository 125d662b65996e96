"""Fields of blur: edges that are wider in some places or at some times than path, lens and an even defocus make them.

Variances of blurs that follow each other add up, so what the widths of isolated edges leave over is regressed on an
added variance along the distance from the principal point, time, and the logged focus distance, beside an even defocus,
a longer path, and what contrast and brightness do to a measured width.  What lies in the scene is not the lens's: over
the radius the pictures' cells err together and whole quarters are left out; over time each cell has its own width.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from virest.camera.field import Field, cardinal_weights
from virest.camera.profile import CameraProfile
from virest.capture.records import Capture
from virest.diagnosis.field.screening import Design, Scored, score_forms
from virest.diagnosis.field.words import SAMPLES, curve_shape
from virest.diagnosis.findings import BLUR, FieldFinding, HeldOutGain
from virest.diagnosis.local_blur import LENS_SIGMA_PX, BlurObservations, predicted_blur
from virest.diagnosis.local_blur_model import fitted_width
from virest.inference.robust import CAUCHY
from virest.motion.trajectory import Trajectory

Array = NDArray[np.float64]
Index = NDArray[np.intp]
CELLS_ROUND, CELLS_OUT, CELLS = 12, 3, 5
"""Cells that err together: sectors and rings about the middle; and squares each way, whose widths are compared."""
RADIUS_KNOTS, FOCUS_KNOTS, TIME_STEP_S, LEAST_TIMES, MOST_TIMES = 4, 4, 0.2, 5, 24
MIN_SIZE_PX = 0.5
"""Standard deviation of the added Gaussian: coding alone widens edges from 0.70 to 0.85 px, by one of 0.48 px."""
LEAST_EDGES, LEAST_CHANGE = 300, 0.05
RIDGE = 1e-3
FOLLOWED = ("time", "focus")
"""Along which `process` can follow a blur: one width a frame."""
SENTENCES = {
    "radius": "pictures are softer by up to {size} px away from the principal point, {shape} of the distance; process "
    "does not follow it",
    "time": "pictures are softer by up to {size} px at some times, {shape} of time: the focus moves",
    "focus": "pictures are softer by up to {size} px at some logged focus distances, {shape}: the focus misses",
}
REASONS = {
    "radius": "field curvature or a lens that is soft towards its edges, a lens element that is tilted, or dirt",
    "time": "an autofocus that hunts, or things that come nearer than the focus",
    "focus": "an autofocus that moves on its way to the distance, or a log that is late",
}
NEXT = {
    "radius": "film a page of print that fills the frame, in focus in the middle, then in a corner",
    "time": "film the same with the focus locked",
    "focus": "film a page of print while the focus is moved by hand from stop to stop",
}


@dataclass(frozen=True, slots=True)
class _Form:
    covariate: str
    knots: Array
    weights: Array
    """(n, knots) of each edge."""
    block: Index
    """(n,) what errs together, rising in the order that parts are cut in."""
    nuisance: Array
    """(n, m) beside what all forms allow for."""
    log: tuple[tuple[float, ...], tuple[float, ...]] | None = None


def blur_field(
    seen: BlurObservations, profile: CameraProfile, trajectory: Trajectory, capture: Capture
) -> tuple[FieldFinding, CameraProfile] | None:
    """The field of blur that edges ask for, and the profile with it; None where they ask for none."""
    edges = seen.edges
    if len(edges) < LEAST_EDGES or not seen.edges_determined or profile.intrinsics is None:
        return None
    motion_px = predicted_blur(seen, profile, trajectory).motion_px
    widths = fitted_width(motion_px, profile.extensions.defocus_sigma_px, LENS_SIGMA_PX)
    left = edges.width_px - widths
    scale = max(1.4826 * float(np.median(np.abs(left - np.median(left)))), 1e-6)
    left = left / scale
    weight = 1 / (1 + ((left - np.median(left)) / CAUCHY) ** 2)
    per_variance = 0.5 / widths / scale
    common = np.stack(
        [per_variance, per_variance * motion_px**2, per_variance / edges.step_levels, per_variance * edges.brightness],
        -1,
    )
    forms = list(_forms(seen, profile, capture))
    found: list[tuple[Scored, _Form]] = []
    for form in forms:
        order = np.argsort(form.block, kind="stable")
        tangent = np.concatenate([common, form.nuisance * per_variance[:, None]], axis=1)
        design = Design(form.covariate, (form.weights * per_variance[:, None])[order, None], form.covariate == "time")
        found += [
            (scored, form)
            for scored in score_forms(
                left[order, None], weight[order], tangent[order, None], [design], form.block[order], asked=len(forms)
            )
            if scored.significant
        ]
    if not found:
        return None
    scored, form = max(found, key=lambda pair: float(pair[0].gain.sum()))
    variance, covariance = _fitted(form, left, weight, common, per_variance)
    lowest = float(variance.min())
    added = variance - lowest
    size = float(np.sqrt(added.max()))
    if size < MIN_SIZE_PX:
        return None
    sigma = np.sqrt(np.maximum(added, 0.0))
    std = np.sqrt(np.diag(covariance)) / (2 * np.maximum(sigma, MIN_SIZE_PX))
    stamp = capture.stamp_0_ns if form.covariate == "time" else None
    rows = [tuple((float(value),) for value in column) for column in (sigma, std)]
    field = Field("blur", (form.covariate,), (tuple(form.knots.tolist()),), rows[0], rows[1], stamp, form.log)
    rivals = tuple(f"blur over {other.covariate}" for one, other in found if _alike(scored, one) and other is not form)
    return _said(field, form, scored, rivals, left * scale, weight), _with(profile, field, lowest)


def _alike(best: Scored, other: Scored) -> bool:
    return float(other.gain.sum()) > 0.9 * float(best.gain.sum())


def _forms(seen: BlurObservations, profile: CameraProfile, capture: Capture) -> Iterator[_Form]:
    edges, lens = seen.edges, profile.intrinsics
    assert lens is not None
    arm = edges.points_px - np.array([lens.cx_px, lens.cy_px])
    radius = np.linalg.norm(arm, axis=-1)
    knots = np.linspace(0, float(np.quantile(radius, 0.995)), RADIUS_KNOTS)
    sector = ((np.arctan2(arm[:, 1], arm[:, 0]) / (2 * np.pi) + 0.5) * CELLS_ROUND).astype(np.intp) % CELLS_ROUND
    ring = np.minimum((radius / knots[-1] * CELLS_OUT).astype(np.intp), CELLS_OUT - 1)
    none = np.zeros((len(edges), 0))
    yield _Form("radius", knots, cardinal_weights(tuple(knots), radius), sector * CELLS_OUT + ring, none)
    frame = np.unique(edges.frame, return_inverse=True)[1]
    size = np.array([profile.width, profile.height])
    cell = (np.clip(edges.points_px / size, 0, 0.999) * CELLS).astype(np.intp) @ np.array([CELLS, 1])
    own = (cell[:, None] == np.unique(cell)[None, :]).astype(float)
    first, last = float(edges.stamp_s.min()), float(edges.stamp_s.max())
    count = int(np.clip(round((last - first) / TIME_STEP_S) + 1, LEAST_TIMES, MOST_TIMES))
    knots = np.linspace(first, last, count)
    yield _Form("time", knots, cardinal_weights(tuple(knots), edges.stamp_s), frame, own)
    log = [(f.time_s, f.focus_dioptres) for f in capture.frames if f.focus_dioptres is not None]
    values = np.array([value for _, value in log], float)
    if len(log) > 0.5 * len(capture.frames) and np.ptp(values) > LEAST_CHANGE:
        times = np.array([time_s for time_s, _ in log])
        knots = np.linspace(values.min(), values.max(), FOCUS_KNOTS)
        weights = cardinal_weights(tuple(knots), np.interp(edges.stamp_s, times, values))
        yield _Form("focus", knots, weights, frame, own, (tuple(times.tolist()), tuple(values.tolist())))


def _fitted(form: _Form, left: Array, weight: Array, common: Array, per_variance: Array) -> tuple[Array, Array]:
    """Added variance (knots,), px², about its mean, and its covariance with blocks as what errs together."""
    own = form.weights - form.weights.mean(axis=0)
    columns = np.concatenate([own * per_variance[:, None], common, form.nuisance * per_variance[:, None]], axis=1)
    normal = (columns * weight[:, None]).T @ columns
    inverse = np.linalg.inv(normal + RIDGE * np.diag(np.maximum(np.diag(normal), 1e-9)))
    numbers = inverse @ (columns.T @ (weight * left))
    pull = columns * (weight * (left - columns @ numbers))[:, None]
    sums = np.stack([np.bincount(form.block, column) for column in pull.T], axis=-1)
    count = own.shape[1]
    return numbers[:count], (inverse @ (sums.T @ sums) @ inverse)[:count, :count]


def _with(profile: CameraProfile, field: Field, lowest: float) -> CameraProfile:
    """The profile with a field that can be followed; the even defocus is that of the sharpest frames then."""
    if field.covariates[0] not in FOLLOWED:
        return profile
    even = float(np.sqrt(max(profile.extensions.defocus_sigma_px**2 + lowest, 0.0)))
    even = even if profile.extensions.defocus_sigma_px else 0.0
    return replace(profile, extensions=replace(profile.extensions, defocus_sigma_px=even)).with_fields(
        [*profile.fields, field]
    )


def _said(
    field: Field, form: _Form, scored: Scored, rivals: tuple[str, ...], left_px: Array, weight: Array
) -> FieldFinding:
    """In words; held out: weighted rms of edges' widths."""
    name = form.covariate
    along = np.linspace(field.knots[0][0], field.knots[0][-1], SAMPLES)
    shape = curve_shape(field.at(along)[:, 0], "time" if name == "time" else name)
    place = int(np.argmax(np.array(field.values)[:, 0]))
    size, std = field.values[place][0], field.std[place][0]
    centred = left_px - np.median(left_px)
    whole = float((weight * centred**2).sum() / weight.sum())
    unit = float(np.median(np.abs(centred))) * 1.4826
    after = float(np.sqrt(max(whole - unit**2 * float(scored.gain.sum()) / float(weight.sum()), 0.0)))
    before = float(np.sqrt(whole))
    said = (
        f"{SENTENCES[name].format(size=f'{size:.2g}', shape=shape)} (edges {before:.3g} px → {after:.3g} px, held out)"
    )
    return FieldFinding(
        (name,), "blur", shape, said, size, "px", std, HeldOutGain(BLUR, before, after, None), scored.p_value, rivals,
        None, REASONS[name], NEXT[name], (field,),
    )  # fmt: skip
