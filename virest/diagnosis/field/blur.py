"""Blur fields: edges wider in some image regions or at some times than blur path, lens and uniform defocus predict.

Variances of successive blurs add up.  The residual widths of isolated edges are therefore regressed on an added
variance over the distance from the principal point, time, and the logged focus distance.  Nuisances are a uniform
defocus, a longer path, and the effect of contrast and brightness on a measured width.  Over the radius r, third-order
aberrations make spots proportional to r (coma) and to r² (field curvature, astigmatism; Welford, Aberrations of Optical
Systems, 1986, chapter 7), so the variance is a r² + b r⁴.  Over time and focus it is piecewise linear.  To separate
scene and lens, errors over the radius are treated as correlated within image cells and whole quarters are held out;
over time each cell has its own width.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from virest.arrays import Array, Index
from virest.camera.field import Field, cardinal_weights
from virest.camera.profile import CameraProfile
from virest.capture.records import Capture
from virest.diagnosis.field.form_list import LEAST_FOCUS_CHANGE
from virest.diagnosis.field.screening import Design, Scored, score_forms
from virest.diagnosis.field.words import SAMPLES, curve_shape
from virest.diagnosis.findings import BLUR, FieldFinding, HeldOutGain
from virest.diagnosis.local_blur import LENS_SIGMA_PX, LENS_STD_PX, BlurObservations, predicted_blur
from virest.diagnosis.local_blur_model import fitted_width
from virest.image_formation.light import defocus_px
from virest.inference.chance import student_tail, t_ratio
from virest.inference.clustered import scatter
from virest.inference.descent import Residuals, Slopes, System, descend
from virest.inference.robust import CAUCHY, cauchy_weight, robust_std
from virest.motion.trajectory import Trajectory

log = logging.getLogger(__name__)

CELLS_ROUND, CELLS_OUT, CELLS = 12, 3, 5
"""Cells with correlated errors: sectors and rings about the centre.  CELLS: cells along each side, whose widths are
compared over time."""
RADIUS_KNOTS, FOCUS_KNOTS = 9, 4
"""Knots, linear in between: 9 err by 0.4 % of the largest value of r²; 4 follow 0.7 periods to 10 % (rms)."""
TIME_STEP_S, LEAST_TIMES, MOST_TIMES = 0.2, 5, 24
"""Spacing of knots over time, which follow periods above 0.9 s to 10 % (rms), and limits of their number."""
MIN_SIZE_PX = float(np.sqrt((LENS_SIGMA_PX + 3 * LENS_STD_PX) ** 2 - LENS_SIGMA_PX**2))
"""Standard deviation (0.83 px) of the added Gaussian, which widens edges by 3 σ of the width variation due to coding.
On 41 simulated captures without such a blur the largest was 0.50 px."""
LEAST_SCALE_PX, BEATEN_T = 1e-6, 2.0
"""Guard against a division by zero; standard errors by which a form with more numbers must beat a simpler one."""
MIN_GAIN = 0.02
"""Least relative gain on held-out edges.  Among widths with 12 % scatter a blur of 0.9 px gains 38 %; half or
twice the limit changes none of 22 results."""
CAP, BOUND, LEAST_WIDTH_PX = 10.0, 3.0, 0.2
"""Residual cap, in σ; influence bound of one edge, in σ; and minimum edge width."""
ABERRATIONS = (4,), (2,), (2, 4)
"""Powers of the radius in the variance: field curvature and astigmatism; coma; all of them."""
SENTENCES = {
    "radius": "pictures are softer by up to {size} px away from the principal point, {shape} of the distance",
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
    table: Array
    """(knots, m) added variance per fitted number."""
    weights: Array
    """(n, m) the same at each edge."""
    block: Index
    """(n,) group with correlated errors, numbered in the order in which parts are cut."""
    nuisance: Array
    """(n, m) nuisances besides those common to all forms."""
    logged: tuple[tuple[float, ...], tuple[float, ...]] | None = None


@dataclass(frozen=True, slots=True)
class _AddedVariance:
    """Edge widths as data for numbers that each add their column's variance."""

    width_px: Array
    even_px: Array
    columns: Array
    """(n, k) px² per unit of each number."""

    def look(self, numbers: Array, before: Residuals | None = None, limit: Slopes = Slopes.HERE) -> Residuals:
        """Width residuals and their Jacobian, which is cheap enough to recompute every time."""
        width = np.sqrt(np.maximum(self.even_px**2 + self.columns @ numbers, LEAST_WIDTH_PX**2))
        left = self.width_px - width
        return Residuals(left, self.columns * (0.5 / width)[:, None], left)

    def weighed(self, numbers: Array, look: Residuals) -> System[Array, Residuals]:
        """Scale by the residuals; the prior keeps an undetermined number below the smallest reported blur.

        Undetermined are a knot without nearby edges, and a cell's width next to a uniform defocus.
        """
        scale = max(robust_std(look.left), LEAST_SCALE_PX)
        prior = (np.abs(self.columns).max(axis=0) / MIN_SIZE_PX**2) ** 2
        rows, left = look.slope[:, None], look.left[:, None]
        return System(numbers, look, rows, left, look.left**2, scale, prior, numbers)

    def moved(self, numbers: Array, step: Array) -> Array:
        """After a step."""
        return numbers + step


@dataclass(frozen=True, slots=True)
class _Edges:
    """Edge widths, and their prediction under uniform blur."""

    width_px: Array
    """(n,) as measured."""
    even_px: Array
    """(n,) predicted from path, lens and uniform defocus."""
    common: Array
    """(n, m) added variance per unit of the nuisances common to all forms."""
    scale_px: float
    """Robust standard deviation of the residuals."""

    def fitted(self, form: _Form, rows: Index | None = None, free: bool = True) -> tuple[Array, Array, Array]:
        """Fit to some edges: the form's numbers (m,), px², their covariance, and the residuals of all edges (n,), px.

        free: False keeps the form at 0.
        """
        rows = np.arange(len(self.width_px)) if rows is None else rows
        own = (form.weights - form.weights.mean(axis=0))[:, : None if free else 0]
        columns = np.concatenate([own, self.common, form.nuisance], axis=1)
        start, count = np.zeros(columns.shape[1]), own.shape[1]
        found = descend(_AddedVariance(self.width_px[rows], self.even_px[rows], columns[rows]), start)
        covariance = found.sandwich(scatter(found.score, form.block[rows]))[:count, :count]
        left = _AddedVariance(self.width_px, self.even_px, columns).look(found.state).left
        return found.state[:count], covariance, left

    def held_out_squares(self, form: _Form, free: bool = True) -> Array:
        """Capped squared residual (n,) of each width after a fit to the other blocks, px²."""
        left = np.zeros(len(self.width_px))
        for fold in (0, 1):
            inside = np.flatnonzero(form.block % 2 == fold)
            left[form.block % 2 != fold] = self.fitted(form, inside, free)[2][form.block % 2 != fold]
        return np.asarray(np.minimum(np.abs(left), CAP * self.scale_px) ** 2)

    def simplest(self, forms: Sequence[_Form]) -> _Form:
        """The first form that the best one does not beat by more than BEATEN_T standard errors on held-out blocks."""
        held_out_squares = [self.held_out_squares(form) for form in forms]
        best = min(held_out_squares, key=lambda one: float(one.mean()))
        block = np.unique(forms[0].block, return_inverse=True)[1]
        more = [np.bincount(block, one - best) for one in held_out_squares]  # the best one's is 0
        beaten = [one.sum() > BEATEN_T * np.sqrt(np.sum((one - one.mean()) ** 2)) for one in more]
        return forms[beaten.index(False)]


def blur_field(
    seen: BlurObservations, profile: CameraProfile, trajectory: Trajectory, capture: Capture
) -> tuple[FieldFinding, CameraProfile] | None:
    """The blur field that the edges support, and the profile with it; None where they support none."""
    widths = seen.edges
    if not seen.edges_determined or profile.intrinsics is None:
        return None
    motion_px = predicted_blur(seen, profile, trajectory).motion_px
    even_px = fitted_width(motion_px, defocus_px(profile, widths.points_px), LENS_SIGMA_PX)
    left = widths.width_px - even_px
    scale = max(robust_std(left - np.median(left)), LEAST_SCALE_PX)
    common = np.stack([np.ones_like(left), motion_px**2, 1 / widths.step_levels, widths.brightness], axis=-1)
    edges = _Edges(widths.width_px, even_px, common, scale)
    outwards = _outwards(seen, profile)
    forms = [*outwards, *_forms(seen, profile, capture)]
    found = [(scored, form) for form in forms if (scored := _significant_score(edges, form, len(forms))) is not None]
    if not found:
        return None
    scored, form = max(found, key=lambda pair: float(pair[0].gain.sum()))
    form = edges.simplest(outwards) if form.covariate == "radius" else form
    numbers, covariance, _ = edges.fitted(form)
    sharpest = form.table[np.argmin(form.table @ numbers)]
    above = form.table - sharpest
    sigma, covariance = np.sqrt(np.maximum(above @ numbers, 0.0)), above @ covariance @ above.T
    lowest = float((sharpest - form.weights.mean(axis=0)) @ numbers)
    before, after = (float(np.sqrt(edges.held_out_squares(form, free).mean())) for free in (False, True))
    held = HeldOutGain(BLUR, before, after, None)
    if sigma.max() < MIN_SIZE_PX or held.after > (1 - MIN_GAIN) * held.before:
        return None
    coded = 2 * np.hypot(LENS_SIGMA_PX, sigma) * LENS_STD_PX * (sigma > 0)  # px², width variation due to coding
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0) + coded**2) / (2 * np.maximum(sigma, MIN_SIZE_PX))
    stamp = capture.stamp_0_ns if form.covariate == "time" else None
    rows = [tuple((float(value),) for value in column) for column in (sigma, std)]
    field = Field("blur", (form.covariate,), (tuple(form.knots.tolist()),), rows[0], rows[1], stamp, form.logged)
    others = {other.covariate for one, other in found if _indistinguishable(scored, one)} - {form.covariate}
    rivals = tuple(f"blur over {name}" for name in sorted(others))
    return blur_finding(field, held, scored.p_value, rivals), _with_field(profile, field, lowest)


def _significant_score(edges: _Edges, form: _Form, forms: int) -> Scored | None:
    """Score of a form on the edges; None where it is not significant on held-out blocks."""
    order = np.argsort(form.block, kind="stable")
    slope = 0.5 / edges.even_px / edges.scale_px
    left = (edges.width_px - edges.even_px) / edges.scale_px
    left = left - np.median(left)
    weight = cauchy_weight(left**2, CAUCHY)
    tangent = np.concatenate([edges.common, form.nuisance], axis=1) * slope[:, None]
    over_time = form.covariate != "radius"
    design = Design(form.covariate, (form.weights * slope[:, None])[order, None], over_time)
    (scored, *_) = score_forms(
        left[order, None], weight[order], tangent[order, None], [design], form.block[order], forms_tested=forms
    ) or (None,)
    if scored is None:
        return None
    if over_time:
        scored = replace(scored, p_value=min(1.0, 2 * scored.p_value, 2 * forms * _outlier_frame_p(left, form.block)))
    log.debug("blur over %s: p %.2g, t %.1f", form.covariate, scored.p_value, t_ratio(scored.gain))
    return scored if scored.significant else None


def _outlier_frame_p(left: Array, block: Index) -> float:
    """Probability that any frame is such an outlier by chance; a few frames have too few signs for the flip test."""
    bounded = np.clip(left, -BOUND, BOUND)
    count = np.maximum(np.bincount(block), 1)
    mean = np.bincount(block, bounded - np.median(bounded)) / np.sqrt(count)
    spread = max(robust_std(mean - np.median(mean)), float(bounded.std()))
    most = float(np.abs(mean - np.median(mean)).max()) / max(spread, 1e-9)
    return min(1.0, 2 * len(count) * student_tail(most, len(count) - 1))


def _indistinguishable(best: Scored, other: Scored) -> bool:
    return float(other.gain.sum()) > 0.9 * float(best.gain.sum())


def _outwards(seen: BlurObservations, profile: CameraProfile) -> list[_Form]:
    """Blur over the distance from the principal point, for each kind of aberration and for all together."""
    edges, lens = seen.edges, profile.intrinsics
    assert lens is not None
    arm = edges.points_px - np.array([lens.cx_px, lens.cy_px])
    radius = np.linalg.norm(arm, axis=-1)
    knots = np.linspace(0, float(np.quantile(radius, 0.995)), RADIUS_KNOTS)
    sector = ((np.arctan2(arm[:, 1], arm[:, 0]) / (2 * np.pi) + 0.5) * CELLS_ROUND).astype(np.intp) % CELLS_ROUND
    ring = np.minimum((radius / knots[-1] * CELLS_OUT).astype(np.intp), CELLS_OUT - 1)
    none = np.zeros((len(edges), 0))
    out, block = radius[:, None] / knots[-1], sector * CELLS_OUT + ring
    return [
        _Form("radius", knots, (knots[:, None] / knots[-1]) ** powers, out**powers, block, none)
        for powers in ABERRATIONS
    ]


def _forms(seen: BlurObservations, profile: CameraProfile, capture: Capture) -> Iterator[_Form]:
    """Blur over time and over the logged focus distance."""
    edges = seen.edges
    frame = np.unique(edges.frame, return_inverse=True)[1]
    size = np.array([profile.width, profile.height])
    cell = (np.clip(edges.points_px / size, 0, 0.999) * CELLS).astype(np.intp) @ np.array([CELLS, 1])
    own = (cell[:, None] == np.unique(cell)[None, :]).astype(float)
    first, last = float(edges.stamp_s.min()), float(edges.stamp_s.max())
    count = int(np.clip(round((last - first) / TIME_STEP_S) + 1, LEAST_TIMES, MOST_TIMES))
    knots = np.linspace(first, last, count)
    yield _Form("time", knots, np.eye(count), cardinal_weights(tuple(knots), edges.stamp_s, 1), frame, own)
    log = [(f.time_s, f.focus_dioptres) for f in capture.frames if f.focus_dioptres is not None]
    values = np.array([value for _, value in log], float)
    if len(log) > 0.5 * len(capture.frames) and np.ptp(values) > LEAST_FOCUS_CHANGE:
        times = np.array([time_s for time_s, _ in log])
        knots = np.linspace(values.min(), values.max(), FOCUS_KNOTS)
        weights = cardinal_weights(tuple(knots), np.interp(edges.stamp_s, times, values), 1)
        logged = tuple(times.tolist()), tuple(values.tolist())
        yield _Form("focus", knots, np.eye(FOCUS_KNOTS), weights, frame, own, logged)


def _with_field(profile: CameraProfile, field: Field, lowest: float) -> CameraProfile:
    """The profile with the field; its uniform defocus becomes that of the sharpest frames or image regions."""
    even = float(np.sqrt(max(profile.extensions.defocus_sigma_px**2 + lowest, 0.0)))
    even = even if profile.extensions.defocus_sigma_px else 0.0
    return replace(profile, extensions=replace(profile.extensions, defocus_sigma_px=even)).with_fields(
        [*profile.fields, field]
    )


def blur_finding(
    field: Field, held: HeldOutGain, p_value: float, rivals: tuple[str, ...], of: str = "edges"
) -> FieldFinding:
    """The finding in words."""
    (name,), values = field.covariates, np.array(field.values)[:, 0]
    along = np.linspace(field.knots[0][0], field.knots[0][-1], SAMPLES)
    shape = curve_shape(field.at(along)[:, 0], name)
    largest = int(np.argmax(values))
    size = float(values[largest])
    rms = f"{of} {held.before:.3g} px → {held.after:.3g} px, held out"
    return FieldFinding(
        (name,), "blur", shape, f"{SENTENCES[name].format(size=f'{size:.2g}', shape=shape)} ({rms})", size, "px",
        field.std[largest][0], held, p_value, rivals, None, REASONS[name], NEXT[name], (field,),
    )  # fmt: skip
