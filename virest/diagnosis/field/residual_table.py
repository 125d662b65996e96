"""Criticise the residuals of any calibration: find significant structure and the covariates it follows.

Residuals are decomposed into a sum of curves over the recorded covariates.  Forms are added one by one while they gain
on held-out blocks (group-sparse forward selection; Lozano, Swirszcz & Abe 2009).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from itertools import combinations

import numpy as np

from virest.arrays import Array, Index
from virest.camera.field import Field, cardinal_weights
from virest.diagnosis.field.screening import MAX_P, MIN_BLOCKS, Design, score_forms, select
from virest.diagnosis.field.words import PATTERNS, SAMPLES, curve_shape, lens_words, shape_of, shape_of_pair
from virest.errors import CaptureError
from virest.inference.robust import CAUCHY, cauchy_weight, robust_std

NEEDED = ("x", "y", "dx", "dy")
VELOCITY = ("vx", "vy")
ORDER = ("frame", "time")
MOST_ROWS, LEAST_ROWS = 20_000, 100
"""Most and fewest rows.  Twice as many rows take twice the time (1 s) and lower deviations by 18 %; of 100 rows a
shift by twice the noise over the row is found, and one by 0.7 times the noise is not."""
KNOTS, PLACE_KNOTS, PAIR_KNOTS = 6, 4, 4
"""Knots over a column, along each side of the picture, and along each column of a pair: a cubic spline through 6 or 4
follows 1.4 or 0.7 periods over its range to 10 % (rms).  Of nine weak simulated effects 5 are found; with half as many
KNOTS 3, with twice as many 4."""
MOST_PAIRS = 10
"""All pairs of five columns; every further form raises the p values of all."""
MIN_VARIATION = 1e-6
"""A column that varies less is constant, but for rounding."""
BLOCKS = 40
"""Time blocks: half or twice as many find 14 of 18 simulated effects too; deviations differ by up to 20 %."""
MAX_FINDINGS = 6
"""Each round may add a false form at a rate of MAX_P: 0.6 % together."""
MAX_PX = 1e6
"""No frame is this large; larger values are an error of units."""
MIN_SIZE_PX = 0.01
"""Smaller structure does not affect a calibration."""
LEAST_SCALE_PX = 1e-9
"""Guard against a division by zero."""
SHIFT = "points are shifted by up to {size} {shape} of {name}, the same everywhere in the frame"
QUANTITY = "residual_rms_px"


@dataclass(frozen=True, slots=True)
class TableFinding:
    """One effect in a table of residuals."""

    kind: str
    """``displacement``, ``shift``, ``scale`` or ``delay``."""
    covariates: tuple[str, ...]
    shape: str
    sentence: str
    size: float
    """Largest value, in ``unit``."""
    unit: str
    std: float | None
    before: float
    """Held-out rms of the residuals, px per coordinate."""
    after: float
    noise: float
    """Rms after all findings."""
    p_value: float
    confounded: tuple[str, ...]
    knots: tuple[tuple[float, ...], ...]
    values: tuple[tuple[float, ...], ...]
    reasons: str
    next: str


@dataclass(frozen=True, slots=True)
class Criticism:
    """All effects found in a table of residuals."""

    rows: int
    used: int
    rms_px: float
    """Robust rms per coordinate."""
    left_px: float
    """What remains after all findings."""
    findings: tuple[TableFinding, ...]
    forms: tuple[str, ...]
    """All forms that were tested."""
    false_alarm_rate: float = MAX_P
    """Of the whole set of forms."""


@dataclass(frozen=True, slots=True)
class _Form:
    kind: str
    covariates: tuple[str, ...]
    knots: tuple[tuple[float, ...], ...]
    design: Array
    """(n, 2, numbers): change of the residual per value at a knot."""
    parts: int

    @property
    def name(self) -> str:
        return f"{self.kind} over {', '.join(self.covariates)}"

    @property
    def over_time(self) -> bool:
        return bool(set(self.covariates) & set(ORDER))


def criticise(columns: Mapping[str, Array]) -> Criticism:
    """Criticise residuals: x, y (px), dx, dy (px), and any further numeric columns, (n,) each.

    vx, vy (px/s), where given, are the image velocity of the point; they make a delay over the row identifiable.  frame
    and time order the rows, and blocks are intervals of them; without both, the file order is used.
    Raises CaptureError for too few rows.
    """
    columns, rows = _cleaned(columns)
    left = np.stack([columns["dx"], columns["dy"]], axis=-1)
    left = left - np.median(left, axis=0)
    block = _blocks(columns, len(left))
    forms = _forms(columns)
    pairs = _pairs(columns)
    forms_tested = len(forms) + len(pairs)
    tangent = np.broadcast_to(np.eye(2), (len(left), 2, 2)).copy()
    rms_px = _scale(left)
    found: list[tuple[_Form, float, tuple[str, ...], float, float]] = []
    current = left
    for _ in range(MAX_FINDINGS):
        scale = _scale(current)
        weight = cauchy_weight((current**2).sum(axis=-1), CAUCHY * scale)
        taken = {known[0].name for known in found}
        for group, beside in ((forms, []), (pairs, [form.design for form in forms])):
            open_forms = [form for form in group if form.name not in taken]
            designs = [Design(form.name, form.design / scale, form.over_time) for form in open_forms]
            everything = np.concatenate([tangent, *beside], axis=-1)
            scored = score_forms(current / scale, weight, everything, designs, block, forms_tested=forms_tested)
            selection = select(scored, float(weight.sum()))
            if selection is not None and selection.size * scale >= MIN_SIZE_PX:
                break
        else:
            break
        form = open_forms[selection.best.index]
        tangent = np.concatenate([tangent, form.design], axis=-1)
        after = float(np.sqrt(max(scale**2 - (selection.size * scale) ** 2, 0.0)))
        found.append((form, selection.best.p_value, selection.rivals, scale, after))
        current = left - tangent @ _solved(tangent, left, weight)
    left_px = _scale(current)
    weight = cauchy_weight((current**2).sum(axis=-1), CAUCHY * left_px)
    numbers, covariance = _fitted(tangent, left, weight, block)
    findings, start = [], 2
    for form, p_value, rivals, before, after in found:
        part = slice(start, start + form.design.shape[2])
        start = part.stop
        findings.append(_finding(form, numbers[part], covariance[part, part], p_value, rivals, before, after, left_px))
    return Criticism(rows, len(left), rms_px, left_px, tuple(findings), tuple(form.name for form in (*forms, *pairs)))


def _cleaned(columns: Mapping[str, Array]) -> tuple[dict[str, Array], int]:
    """Finite rows in order of frame and time, evenly thinned; and how many rows there were."""
    missing = [name for name in NEEDED if name not in columns]
    if missing:
        raise CaptureError(f"no column {', '.join(missing)}", hint=f"needed are {', '.join(NEEDED)}, in pixels")
    table = {name: np.asarray(values, float) for name, values in columns.items()}
    table = {name: values for name, values in table.items() if name in NEEDED or np.isfinite(values).mean() > 0.5}
    for name in NEEDED:
        if (largest := float(np.nanmax(np.abs(table[name]), initial=0.0, where=np.isfinite(table[name])))) > MAX_PX:
            raise CaptureError(f"a value of {largest:.3g} px in column {name}", hint="all values are in pixels")
    keep = np.all([np.isfinite(values) for values in table.values()], axis=0)
    if keep.sum() < LEAST_ROWS:
        raise CaptureError(
            f"{int(keep.sum())} complete rows, {LEAST_ROWS} are needed", hint="supply more residual rows"
        )
    if not any(table[name][keep].any() for name in ("dx", "dy")):
        raise CaptureError("all residuals are 0", hint="dx and dy are measured minus predicted, in pixels")
    rows = np.flatnonzero(keep)
    keys = [table[name][rows] for name in ORDER if name in table]
    rows = rows[np.lexsort(keys[::-1])] if keys else rows
    rows = rows[:: max(-(-len(rows) // MOST_ROWS), 1)]
    return {name: values[rows] for name, values in table.items()}, len(keep)


def _blocks(columns: Mapping[str, Array], count: int) -> Index:
    """Block number (n,) of each row: intervals of frames, of time, or of the file."""
    key = next((columns[name] for name in ORDER if name in columns), np.arange(count, dtype=float))
    rank = np.unique(key, return_inverse=True)[1]
    total = int(rank.max()) + 1
    if total < MIN_BLOCKS:
        rank, total = np.arange(count), count
    return np.asarray(rank * min(BLOCKS, total) // total)


def _forms(columns: Mapping[str, Array]) -> list[_Form]:
    x, y = columns["x"], columns["y"]
    middle = [0.5 * (a.min() + a.max()) for a in (x, y)]
    arm = np.stack([x - middle[0], y - middle[1]], axis=-1)
    forms = [_over_picture(x, y)] if np.ptp(x) > 0 and np.ptp(y) > 0 else []
    names = [name for name in columns if name not in (*NEEDED, *VELOCITY)]
    for name in names:
        if (curve := _curve(columns[name], KNOTS)) is None:
            continue
        knots, weights = (curve[0],), curve[1]
        forms.append(_shift((name,), knots, weights))
        if name != "row":
            forms.append(_along("scale", (name,), knots, weights, arm))
        elif all(v in columns for v in VELOCITY):
            forms.append(_along("delay", (name,), knots, weights, np.stack([columns[v] for v in VELOCITY], axis=-1)))
    return forms


def _pairs(columns: Mapping[str, Array]) -> list[_Form]:
    """Interactions of two covariates; the distance from the centre is paired with each covariate as a scale.

    Pairs that are both constant within a frame are skipped: any per-frame value is a function of both.
    """
    x, y = columns["x"], columns["y"]
    arm = np.stack([a - 0.5 * (a.min() + a.max()) for a in (x, y)], axis=-1)
    recorded = {name: values for name, values in columns.items() if name not in (*NEEDED, *VELOCITY)}
    curves = {name: curve for name in recorded if (curve := _curve(recorded[name], PAIR_KNOTS)) is not None}
    forms = []
    key = next((columns[name] for name in ORDER if name in columns), np.arange(len(x)))
    frame = np.unique(key, return_inverse=True)[1]
    within = {name for name in curves if _varies_within(recorded[name], frame)}
    for one, two in [pair for pair in combinations(curves, 2) if within & set(pair)][:MOST_PAIRS]:
        knots, weights = _product(curves[one], curves[two])
        forms.append(_shift((one, two), knots, weights))
        if "row" in (one, two) and all(v in columns for v in VELOCITY):
            speed = np.stack([columns[v] for v in VELOCITY], axis=-1)
            forms.append(_along("delay", (one, two), knots, weights, speed))
    if (outwards := _curve(np.linalg.norm(arm, axis=-1), PAIR_KNOTS)) is not None:
        for name in [name for name in curves if name != "row"][:MOST_PAIRS]:
            forms.append(_along("scale", ("radius", name), *_product(outwards, curves[name]), arm))
    return forms


def _varies_within(values: Array, group: Index) -> bool:
    """Whether a column varies within groups of rows."""
    mean = np.bincount(group, values) / np.maximum(np.bincount(group), 1)
    return bool(np.ptp(values - mean[group]) > MIN_VARIATION * np.ptp(values))


def _curve(values: Array, count: int) -> tuple[tuple[float, ...], Array] | None:
    """Knots over a column and their interpolation weights (n, knots); None where it hardly varies."""
    knots = tuple(np.unique(np.linspace(values.min(), values.max(), count)).tolist())
    return None if len(knots) < count else (knots, cardinal_weights(knots, values))


def _product(
    one: tuple[tuple[float, ...], Array], two: tuple[tuple[float, ...], Array]
) -> tuple[tuple[tuple[float, ...], ...], Array]:
    return (one[0], two[0]), np.asarray(one[1][:, :, None] * two[1][:, None, :]).reshape(len(one[1]), -1)


def _shift(names: tuple[str, ...], knots: tuple[tuple[float, ...], ...], weights: Array) -> _Form:
    return _Form("shift", names, knots, np.einsum("nk,ij->nikj", weights, np.eye(2)).reshape(len(weights), 2, -1), 2)


def _along(
    kind: str, names: tuple[str, ...], knots: tuple[tuple[float, ...], ...], weights: Array, way: Array
) -> _Form:
    """Shifts along directions ``way`` (n, 2), one number per knot."""
    return _Form(kind, names, knots, way[:, :, None] * weights[:, None, :], 1)


def _over_picture(x: Array, y: Array) -> _Form:
    knots = tuple(tuple(float(k) for k in np.linspace(a.min(), a.max(), PLACE_KNOTS)) for a in (x, y))
    weights = np.einsum("ni,nj->nij", *(cardinal_weights(k, a) for k, a in zip(knots, (x, y), strict=True)))
    design = np.einsum("nk,ij->nikj", weights.reshape(len(x), -1), np.eye(2)).reshape(len(x), 2, -1)
    return _Form("displacement", ("x", "y"), knots, design, 2)


def _scale(left: Array) -> float:
    """Robust standard deviation per coordinate."""
    return max(robust_std(left - np.median(left, axis=0)), LEAST_SCALE_PX)


def _solved(design: Array, left: Array, weight: Array) -> Array:
    return _normal(design, weight)[1] @ np.einsum("nik,ni,n->k", design, left, weight)


def _normal(design: Array, weight: Array) -> tuple[Array, Array]:
    hessian = np.einsum("nik,nil,n->kl", design, design, weight, optimize=True)
    size = np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    inverse = np.linalg.pinv(hessian / np.outer(size, size), rcond=1e-9, hermitian=True) / np.outer(size, size)
    return hessian, np.asarray(inverse)


def _fitted(design: Array, left: Array, weight: Array, block: Index) -> tuple[Array, Array]:
    """All numbers together, and their covariance from the scatter between blocks."""
    _, inverse = _normal(design, weight)
    numbers = inverse @ np.einsum("nik,ni,n->k", design, left, weight)
    pull = np.einsum("nik,ni,n->nk", design, left - design @ numbers, weight)
    sums = np.stack([np.bincount(block, column) for column in pull.T], axis=-1)
    count = len(sums)
    return numbers, inverse @ (sums.T @ sums) @ inverse * count / max(count - 1, 1)


def _finding(
    form: _Form, numbers: Array, covariance: Array, p_value: float, rivals: tuple[str, ...], before: float,
    after: float, noise: float,
) -> TableFinding:  # fmt: skip
    values = numbers.reshape(-1, form.parts)
    centre = np.eye(len(values))
    if form.kind != "displacement":
        # for two covariates, keep only the interaction
        centre = reduce(
            lambda one, two: np.asarray(np.kron(one, two)), [np.eye(len(k)) - 1 / len(k) for k in form.knots]
        )
    values = centre @ values
    turn = np.kron(centre, np.eye(form.parts))
    std = np.sqrt(np.maximum(np.diag(turn @ covariance @ turn.T), 0.0)).reshape(-1, form.parts)
    length = np.linalg.norm(values, axis=1)
    row = int(np.argmax(length))
    size, unit = float(length[row]), {"scale": "1", "delay": "s"}.get(form.kind, "px")
    if form.kind == "displacement":
        shape = shape_of(Field("displacement", ("x", "y"), form.knots, tuple(map(tuple, values.tolist()))))
    elif len(form.knots) > 1:
        one, two = (cardinal_weights(k, np.linspace(k[0], k[-1], SAMPLES)) for k in form.knots)
        table = values.reshape(len(form.knots[0]), len(form.knots[1]), -1)
        shape = shape_of_pair(np.einsum("ai,bj,ijc->abc", one, two, table), form.covariates)
    else:
        along = np.linspace(form.knots[0][0], form.knots[0][-1], SAMPLES)
        curve = cardinal_weights(form.knots[0], along) @ values
        shape = curve_shape(
            curve[:, int(np.argmax(np.ptp(curve, axis=0)))], "time" if form.over_time else form.covariates[0]
        )
    sentence, reasons, following = _texts(form, shape, size)
    beside = f"; {' and '.join(rivals)} would explain it equally well" if rivals else ""
    return TableFinding(
        form.kind, form.covariates, shape, f"{sentence} (residuals {before:.3g} px → {after:.3g} px, held out){beside}",
        size, unit, float(np.linalg.norm(std[row])), before, after, min(noise, after), p_value, rivals, form.knots,
        tuple(map(tuple, np.round(values, 8).tolist())), reasons, following,
    )  # fmt: skip


def _texts(form: _Form, shape: str, size: float) -> tuple[str, str, str]:
    """Sentence, likely reasons and the next measurement."""
    name = " and the ".join(form.covariates)
    if len(form.knots) > 1 and form.kind != "displacement":
        unit = {"scale": f"{100 * size:.3g} % of the focal length", "delay": f"{1e3 * size:.3g} ms"}
        said = f"{form.kind}s of up to {unit.get(form.kind, f'{size:.3g} px')} from the interaction of {name}: {shape}"
        known = PATTERNS.get((form.kind, form.covariates), PATTERNS["scale", ("radius", "time")])
        reasons = known.reasons if form.kind != "shift" else "something that acts through both at once"
        return said, reasons, f"record again with the {name} moving independently of each other"
    match form.kind:
        case "displacement":
            pattern = PATTERNS["displacement", ("x", "y")]
            said = pattern.sentence.format(size=f"{size:.3g} px", shape=shape, lens=lens_words(shape))
            return said, pattern.reasons, pattern.next
        case "delay":
            pattern = PATTERNS["delay", ("row",)]
            said = (
                f"points are early or late by up to {size * 1e3:.3g} ms, {shape} of the row: lines are not read evenly"
            )
            return said, pattern.reasons, pattern.next
        case "scale":
            said = f"the focal length changes by up to {size * 100:.3g} % about its mean, {shape} of {name}"
            known = PATTERNS["scale", ("time",)]
            return said, known.reasons, known.next
        case _:
            said = SHIFT.format(size=f"{size:.3g} px", shape=f"({shape})" + " as a function", name=name)
            reasons = "a pose or a clock that changes with it, or row times that differ from those assumed"
            return said, reasons, f"record again with {name} moving independently of everything else"
