"""Describe fields in words: the shape along their covariate, likely reasons, and the next measurement.

A pattern is kind × covariates × shape.  Shapes come from least-squares fits to the field itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from virest.arrays import Array
from virest.camera.field import FORCES, KINDS, RATES, UNIT_SCALES, Field, interpolated
from virest.diagnosis.field.forms import FORCE_REACH_M_S2, SENSORS, STEP_EDGE_S, TURN
from virest.diagnosis.field.records import Distrusted, FittedField
from virest.diagnosis.field.stretches import axis_names
from virest.diagnosis.findings import GEOMETRY, FieldFinding, HeldOutGain
from virest.inference.doubtful_log import CLIPPED, STRAIGHT

MIN_EXPLAINED = 0.95
"""Part of a field's variance that a shape must explain to name it."""
STEP_SPAN, STEP_PART = 0.25, 0.8
"""A curve is a step if more than STEP_PART of its total change lies within STEP_SPAN of its range."""
MAX_REVERSAL = 0.1
"""A curve that levels off reverses by less than this fraction of its total change."""
JUMP_WIDTH = 0.1
"""As a fraction of half the range: a spline with 40 knots cannot jump faster."""
MIN_EXPLAINED_OVER_FRAME = 0.9
"""The same for a displacement over the frame."""
MIN_JITTER, JITTER = 0.5, "jitter"
"""Half of what independent values have, and the shape's name."""
OFF_CENTRE, LINEAR, RADIAL = "growing with its square", "linear", "radial"
SAMPLES = 101
"""Steps of 1 % of the range."""
STICKING_FRACTION = 0.5
"""Part of the largest error that must be reached near rest for a gyroscope to stick there."""
INERTIAL = "inertial_rows"


@dataclass(frozen=True, slots=True)
class Pattern:
    """Texts for one pattern."""

    sentence: str
    reasons: str
    next: str
    """The measurement that would distinguish the reasons."""


PATTERNS: dict[tuple[str, tuple[str, ...]], Pattern] = {
    ("delay", ("row",)): Pattern(
        "points are {lateness} by up to {size} {where} of the readout, {shape} of the row: lines are not read evenly",
        "the sensor reads its lines in blocks or pauses between them, or the picture was cropped and scaled by lines",
        "film a light that flickers at a known rate, without other light: its bands show each line's time",
    ),
    ("delay", ("time",)): Pattern(
        "frames are {lateness} by up to {size} {where} of the capture, {shape} of time: the stamps' clock wanders",
        "stamps that are taken in software, a queue that fills, or a clock that is corrected while it runs",
        "film a display that counts milliseconds, and compare the steps of the stamps with the steps shown",
    ),
    ("delay", ("step",)): Pattern(
        "frames from {at} s on are {lateness} by {size}: the stamps' clock was set",
        "a clock that is corrected while it runs, or a queue that lost a frame",
        "film a display that counts milliseconds, and compare the steps of the stamps with the steps shown",
    ),
    ("delay", ("frame",)): Pattern(
        "the frames' stamps jitter: from frame to frame they are off by {size} (rms)",
        "stamps that are taken in software when a frame arrives, not by the sensor, or that were rounded or averaged",
        "film a display that counts milliseconds, and compare the steps of the stamps with the steps shown",
    ),
    ("displacement", ("x", "y")): Pattern(
        "shifts of up to {size} depend on the position in the frame, {shape}, and are the same in all frames: {lens}",
        "a lens element off centre or tilted, a window or waterproof case in front, or a correction by the phone that "
        "the profile does not hold",
        "calibrate the lens with a board in all corners, once with the phone upside down: an error "
        "that rotates with the phone belongs to the lens",
    ),
    ("scale", ("time",)): Pattern(
        "the focal length changes by {size} over the capture, {shape} of time",
        "the lens warms up, refocuses without logging it, or the phone switches its zoom or lens",
        "film a still board for a minute from a cold start with the focus locked, and once more warm",
    ),
    ("scale", ("focus",)): Pattern(
        "the focal length changes by {size} with the logged focus distance, {shape}: the lens breathes as it focuses",
        "focusing moves lens elements, which changes the picture's scale; a drift in time is the rival",
        "film a still board while focusing to and fro: a breathing lens comes back, a warm one does not",
    ),
    ("rate", ("rate",)): Pattern(
        "the gyroscope's error depends on its rate, {shape}: up to {size} are missing {rates}",
        "a sensor that saturates softly or sticks near rest, or a filter in the phone that limits "
        "fast or small rotations",
        "turn the phone on a table at several speeds and compare the log with the angle turned",
    ),
    ("rate", ("acceleration",)): Pattern(
        "the gyroscope reads a rate in proportion to the acceleration, {size} per m/s²: it is sensitive to g",
        "a micromechanical gyroscope's mass moves under gravity and shocks",
        "log the phone at rest on each of its six sides: the rates differ by 2 g times the sensitivity",
    ),
    ("delay", ("row", "time")): Pattern(
        "rows are {lateness} by up to {size} in some frames and not in others, {shape}: the readout changes as it runs",
        "a sensor that changes its mode or clock while it films, or a picture that is cropped and scaled as it goes",
        "film a light that flickers at a known rate: its bands grow closer where the readout takes longer",
    ),
    ("delay", ("row", "exposure")): Pattern(
        "rows are {lateness} by up to {size} at some exposures and not at others, {shape}: "
        "the readout changes with the exposure",
        "a sensor that lengthens its lines for long exposures, or combines several exposures to one frame",
        "film a light that flickers at a known rate at several fixed exposures: its bands grow closer where the "
        "readout takes longer",
    ),
    ("scale", ("radius", "time")): Pattern(
        "the magnification towards the edges changes by up to {size} over time, {shape}: its distortion changes",
        "a lens that warms up or refocuses without logging it, or a phone that corrects distortion frame by frame",
        "film a still board for a minute, once with the focus locked: a distortion that then stays is the focus's",
    ),
    ("scale", ("radius", "focus")): Pattern(
        "the magnification towards the edges changes by up to {size} as the lens focuses, {shape}: "
        "its distortion changes with the focus",
        "focusing moves lens elements, and distortion moves along",
        "calibrate the lens with a board at several focus distances",
    ),
    ("rate", ("rate", "time")): Pattern(
        "the gyroscope's scale changes over the capture, {shape}: up to {size} are missing at its highest rates",
        "a sensor that warms up or changes its range, or a phone that corrects its scale while it logs",
        "turn the phone on a table by a known angle, again and again from a cold start",
    ),
    (TURN, ("rate", "time")): Pattern(
        "the gyroscope turns on the camera by {size} over the capture, {shape} of time",
        "a lens or sensor that its stabiliser tilts, a mount that slips, or a hinge between camera and gyroscope",
        "film a board at rest before and after a shake, and calibrate the rotation of the IMU from each half",
    ),
    (TURN, ("step",)): Pattern(
        "from {at} s on the gyroscope is turned by {size} on the camera",
        "a mount that slips, a hinge between camera and gyroscope, or a knock",
        "film a board before and after, and calibrate the rotation of the IMU from each part",
    ),
    ("rate", ("time",)): Pattern(
        "the gyroscope's bias changes by up to {size} over the capture, {shape} of time",
        "the sensor warms up, or the phone corrects its bias while it logs",
        "log the phone at rest for ten minutes from a cold start",
    ),
}


def finding_of(entry: FittedField | Distrusted, noise_px: float) -> FieldFinding:
    """A field as a finding of the diagnosis."""
    if isinstance(entry, Distrusted):
        return _distrusted(entry)
    fields, form = entry.fields, entry.form
    shape = shape_of(fields[0]) if len(fields) == 1 else _common_shape(fields)
    size, std = _size(fields)
    pattern = PATTERNS[TURN if form.is_turn else form.kind, form.covariates]
    factor, unit = UNIT_SCALES[form.kind]
    if form.is_turn:
        shape, size, std = _turn(fields)
        factor, unit = 1e3, "mrad"
    if form.by_frame and is_jitter(late_s := np.array(fields[0].values)[:, 0]):
        shape, pattern = JITTER, PATTERNS[form.kind, ("frame",)]
        size, std = _rms_of(late_s, np.array(fields[0].std)[:, 0])
    sudden = TURN if form.is_turn else form.kind, ("step",)
    if form.step_s is not None and sudden in PATTERNS:
        pattern = PATTERNS[sudden]
    amount = f"{size * factor:.3g} {unit}"
    sentence = pattern.sentence.format(
        size=amount,
        shape=shape,
        where=_where(fields[0]),
        lateness=_lateness(fields[0]),
        lens=lens_words(shape),
        rates=_at_rates(fields[0]),
        at=f"{fields[0].knots[-1][0]:.2f}",
    )
    rms = f" (points {entry.before_px:.3g} px → {entry.after_px:.3g} px, held out)"
    beside = f"; in this capture {' and '.join(entry.rivals)} would explain it equally well" if entry.rivals else ""
    return FieldFinding(
        form.covariates,
        form.kind,
        shape,
        sentence + rms + beside,
        size,
        "rad" if form.is_turn else _unit(form.kind, form.covariates),
        std,
        HeldOutGain(GEOMETRY, entry.before_px, entry.after_px, noise_px),
        entry.p_value,
        entry.rivals,
        entry.stability,
        pattern.reasons,
        pattern.next,
        fields,
    )


def _distrusted(entry: Distrusted) -> FieldFinding:
    """Describe untrusted log intervals: their kind, the point residuals there, and whether they are bridged."""
    first = entry.stretches[0]
    total_s = sum(stretch.to_s - stretch.from_s for stretch in entry.stretches)
    several = len(entry.stretches) > 1
    if first.kind == CLIPPED:
        sentence = (
            f"beyond {first.limit_rad_s:.3g} rad/s the gyroscope reads too little: it clips, "
            f"{len(entry.stretches)} times for {total_s * 1e3:.0f} ms in all, on axis {axis_names(entry.stretches)}"
        )
        reasons = "the rotation was faster than the sensor's range"
        following = "set the sensor to a wider range, or move more slowly"
    else:
        where = (
            f"in {len(entry.stretches)} stretches, {total_s * 1e3:.0f} ms in all, the first from {first.from_s:.2f} s"
            if several
            else f"for {total_s * 1e3:.0f} ms from {first.from_s:.2f} s"
        )
        sentence = f"{where} the log does not follow the frames"
        if first.kind == STRAIGHT:
            sentence += ": inertial rows there lie on a straight line"
            reasons = "rows were lost and a program interpolated the gap, or the sensor's queue stalled"
            following = "look at the raw log for rows with equal steps, and record with less load on the phone"
        elif first.limit_rad_s is not None:
            sentence += f"; in each, the rate reaches its largest reading, from {first.limit_rad_s:.3g} rad/s"
            reasons = "the sensor clips: the rotation was faster than its range"
            following = "set the sensor to a wider range, or move more slowly"
        else:
            reasons = (
                "rows were lost and a program filled the gap, the sensor was knocked or left its range, "
                "or these frames were stored under wrong timestamps"
            )
            following = "compare the log's raw rows there with those around it, and record the motion again"
    usable = sum(entry.usable)
    bridged = "bridged from the points" if all(entry.usable) else "not corrected by process"
    if 0 < usable < len(entry.usable):
        bridged = f"{usable} of {len(entry.usable)} bridged from the points, the others {bridged}"
    description = f"{sentence} (points {entry.before_px:.3g} px → {entry.after_px:.3g} px, held out; {bridged})"
    bridges = tuple(field for field, usable in zip(entry.bridges, entry.usable, strict=True) if usable)
    size = max((float(np.abs(f.values).max()) for f in bridges), default=None)
    return FieldFinding(
        ("rate",) if first.kind == CLIPPED else ("time",),
        INERTIAL,
        first.kind,
        description,
        size,
        "rad/s",
        None,
        HeldOutGain(GEOMETRY, entry.before_px, entry.after_px, entry.noise_px),
        entry.p_value,
        (),
        None,
        reasons,
        following,
        bridges,
        tuple((s.from_s, s.to_s) for s in entry.stretches),
    )


def is_jitter(values: Array) -> bool:
    """Whether successive values (n,) are about as different as any two.

    Half the mean square of their steps over their variance (von Neumann 1941, doi:10.1214/aoms/1177731677) is 1 for
    independent values and near 0 for a curve.
    """
    return float(np.mean(np.diff(values) ** 2)) > MIN_JITTER * 2 * float(np.var(values))


def _rms_of(values: Array, std: Array) -> tuple[float, float]:
    """Rms of those of values (n,) that are determined, less what their deviations (n,) add, and its own deviation."""
    known = std < np.std(values)
    if not known.any():
        return 0.0, float(np.median(std))
    rms = np.sqrt(max(float(np.var(values[known]) - np.mean(std[known] ** 2)), 0.0))
    return float(rms), float(rms / np.sqrt(2 * np.count_nonzero(known)))


def shape_of(field: Field) -> str:
    """Name the shape of the values along one covariate, or over the frame."""
    if field.covariates == ("x", "y"):
        return _shape_over_picture(field)
    if len(field.covariates) > 1:
        first, second = (np.linspace(k[0], k[-1], SAMPLES) for k in field.knots)
        return shape_of_pair(field.at(first[:, None], second[None, :]), field.covariates)
    if is_sudden(field):
        return "a step"
    along = np.linspace(field.knots[0][0], field.knots[0][-1], SAMPLES)
    values = field.at(along)
    return curve_shape(values[:, int(np.argmax(np.ptp(values, axis=0)))], field.covariates[0])


def shape_of_pair(values: Array, names: tuple[str, ...]) -> str:
    """Name the shape of values (SAMPLES, SAMPLES, components), at even steps of two covariates, along each covariate.

    The shape is that of the nearest product of two curves.
    """
    part = values[..., int(np.argmax(np.ptp(values, axis=(0, 1))))]
    along, sizes, over = np.linalg.svd(part, full_matrices=False)
    if sizes[0] ** 2 < MIN_EXPLAINED * float((sizes**2).sum()):
        return f"no product of curves of the {' and the '.join(SENSORS.get(n, n) for n in names)}"
    curves = zip((along[:, 0], over[0]), names, strict=True)
    each = (f"{curve_shape(c, n)} of the {SENSORS.get(n, n)}" for c, n in curves)
    return " times ".join(each)


def is_sudden(field: Field) -> bool:
    """Whether a field over time changes at one instant."""
    return field.covariates == ("time",) and field.knots[0][-1] - field.knots[0][0] < 2 * STEP_EDGE_S


def curve_shape(curve: Array, covariate: str = "") -> str:
    """Name the shape of a curve (SAMPLES,) sampled at even steps of its covariate."""
    u, over_time = np.linspace(-1, 1, SAMPLES), covariate == "time"
    if not float(np.var(curve)):
        return "nothing"
    if _unexplained(curve, [u]) < 1 - MIN_EXPLAINED:
        return "a straight line"
    if not over_time and _is_step(curve):
        return "a step"
    if covariate == "row" and _is_sawtooth(curve, u):
        return "even blocks with a jump between them"
    if _unexplained(curve, [u, u**2]) < 1 - MIN_EXPLAINED:
        rises, falls = (float(np.clip(way * np.diff(curve), 0, None).sum()) for way in (1, -1))
        return "levelling off" if over_time and min(rises, falls) < MAX_REVERSAL * np.ptp(curve) else "a parabola"
    slope = np.abs(np.diff(curve))
    if over_time and slope[: SAMPLES // 4].sum() > 2 * slope[-SAMPLES // 4 :].sum():
        return "levelling off"
    if _unexplained(curve, [u, u**3]) < 1 - MIN_EXPLAINED:
        return "an S"
    return "a curve"


def _common_shape(fields: tuple[Field, ...]) -> str:
    if fields[0].covariates[0] in FORCES:
        return "a straight line"
    shapes = [shape_of(f) for f in fields if np.abs(f.values).max() > 0.5 * max(np.abs(g.values).max() for g in fields)]
    return max(shapes, key=shapes.count)


def _unexplained(curve: Array, columns: list[Array]) -> float:
    design = np.stack([np.ones_like(curve), *columns], axis=-1)
    left = curve - design @ np.linalg.lstsq(design, curve, rcond=None)[0]
    return float(np.var(left) / max(float(np.var(curve)), 1e-300))


def _is_sawtooth(curve: Array, u: Array) -> bool:
    """Whether the curve is a single slope with one jump."""
    jumps = (np.clip((u - at) / JUMP_WIDTH, 0, 1) for at in u[SAMPLES // 10 : -SAMPLES // 10])
    return min(_unexplained(curve, [u, jump]) for jump in jumps) < 1 - MIN_EXPLAINED


def _is_step(curve: Array) -> bool:
    width = int(STEP_SPAN * SAMPLES)
    total = float(np.ptp(curve))
    jump = float(np.max(np.abs(curve[width:] - curve[:-width])))
    ends = abs(float(curve[-1] - curve[0]))
    return jump > STEP_PART * total and ends > STEP_PART * total


def _shape_over_picture(field: Field) -> str:
    """Name the simple lens error that explains a displacement: decentring, linear, radial, or none of these."""
    x, y = np.meshgrid(*(np.linspace(k[0], k[-1], 21) for k in field.knots), indexing="ij")
    middle = [0.5 * (k[0] + k[-1]) for k in field.knots]
    half = 0.5 * (field.knots[0][-1] - field.knots[0][0])
    u, v = (x - middle[0]) / half, (y - middle[1]) / half
    values = field.at(x, y)
    values = (values - values.mean(axis=(0, 1))).ravel()

    def explained(columns: list[tuple[Array, Array]]) -> bool:
        one, nothing = np.ones_like(u), np.zeros_like(u)
        columns = [(one, nothing), (nothing, one), *columns]
        design = np.stack([np.stack(pair, -1).ravel() for pair in columns], axis=-1)
        left = values - design @ np.linalg.lstsq(design, values, rcond=None)[0]
        return bool((left**2).sum() < (1 - MIN_EXPLAINED_OVER_FRAME) * (values**2).sum())

    r2, nothing = u * u + v * v, np.zeros_like(u)
    off_centre = [(2 * u * v, r2 + 2 * v * v), (r2 + 2 * u * u, 2 * u * v)]
    linear = [(u, nothing), (v, nothing), (nothing, u), (nothing, v)]
    radial = [(r2 * u, r2 * v), (r2**2 * u, r2**2 * v), (u, v)]
    if explained(linear):
        return LINEAR
    if explained(off_centre) or explained([*off_centre, *linear]):
        return OFF_CENTRE
    return RADIAL if explained(radial) else "a smooth map"


def lens_words(shape: str) -> str:
    """The lens error that a displacement of this shape indicates."""
    return {
        OFF_CENTRE: "a lens that is not centred (tangential distortion)",
        LINEAR: "the picture is scaled, turned, stretched or sheared",
        RADIAL: "the radial distortion differs from the profile's",
    }.get(shape, "a lens that the model's distortion does not describe")


def _size(fields: tuple[Field, ...]) -> tuple[float, float | None]:
    """Largest value and the deviation at the knot next to it.

    Displacements and rates: vector length; focal length: range; acceleration sensitivity: slope per m/s².
    """
    best, std = 0.0, None
    for field in fields:
        values = np.array(field.values)
        if field.covariates[0] in FORCES:
            field = field.with_values(values - values.mean(axis=0), np.array(field.std) if field.std else None)
            values = np.array(field.values)
        length = np.linalg.norm(values, axis=1)
        row, largest = int(np.argmax(length)), float(length.max())
        if field.kind == "scale":
            largest = float(np.ptp(values))
        elif len(field.knots) == 1:
            along = np.linspace(field.knots[0][0], field.knots[0][-1], SAMPLES)
            largest = float(np.linalg.norm(field.at(along), axis=1).max())
        if largest > best:
            best = largest
            std = float(np.linalg.norm(field.std[row])) if field.std else None
    if fields[0].covariates[0] in FORCES:
        return best / FORCE_REACH_M_S2, None if std is None else std / FORCE_REACH_M_S2
    return best, std


def _turn(fields: tuple[Field, ...]) -> tuple[str, float, float | None]:
    """Of the angle θ whose rates θ × ω the fields hold: shape over time, largest change in rad, its deviation."""

    def components(tables: Sequence[tuple[tuple[float, ...], ...]]) -> Array:
        """(times, 3) from the fields' values, or deviations, at the highest rate of each axis."""
        ends = zip(tables, fields, strict=True)
        x, y, z = (np.array(table).reshape(2, -1, 3)[-1] / field.knots[0][-1] for table, field in ends)
        return np.stack([y[:, 2], z[:, 0], x[:, 1]], axis=-1)

    angle = components([field.values for field in fields])
    apart = angle[:, None] - angle[None, :]
    size = np.linalg.norm(apart, axis=-1)
    first, last = np.unravel_index(np.argmax(size), size.shape)
    axis = int(np.argmax(np.ptp(angle, axis=0)))
    along = np.linspace(fields[0].knots[1][0], fields[0].knots[1][-1], SAMPLES)
    curve = interpolated(fields[0].knots[1], angle, along)[:, axis]
    std = None
    if fields[0].std:
        deviation = components([field.std for field in fields])
        way = apart[first, last] / max(float(size[first, last]), 1e-12)
        std = float(np.linalg.norm(way * np.hypot(deviation[first], deviation[last])))
    shape = "a step" if fields[0].knots[1][-1] - fields[0].knots[1][0] < 2 * STEP_EDGE_S else curve_shape(curve, "time")
    return shape, float(size[first, last]), std


def _unit(kind: str, covariates: tuple[str, ...]) -> str:
    if covariates == ("acceleration",):
        return "rad/s per m/s²"
    return KINDS[kind][0]


def _where(field: Field) -> str:
    """Where along the covariate the largest value lies."""
    along = np.linspace(field.knots[0][0], field.knots[0][-1], SAMPLES)
    if len(field.knots) > 1:
        return ""
    position = float(np.argmax(np.abs(field.at(along)).max(axis=-1))) / (SAMPLES - 1)
    return (
        "in the middle"
        if 1 / 3 <= position <= 2 / 3
        else "in the first third"
        if position < 1 / 3
        else "in the last third"
    )


def _at_rates(field: Field) -> str:
    """Where an error over a rate begins: one that grows with the rate is negligible below a quarter of the range."""
    if field.covariates[0] not in RATES or len(field.covariates) > 1:
        return ""
    along = np.linspace(field.knots[0][0], field.knots[0][-1], SAMPLES)
    size = np.linalg.norm(field.at(along), axis=1)
    early = float(size[np.abs(along) < 0.25 * along[-1]].max())
    return "already near rest: it sticks there" if early > STICKING_FRACTION * float(size.max()) else "at high rates"


def _lateness(field: Field) -> str:
    values = np.array(field.values)[:, 0]
    return "late" if values[np.argmax(np.abs(values))] > 0 else "early"
