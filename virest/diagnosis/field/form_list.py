"""The field forms that are tested: their covariates, their knots, and the values that are left to the named causes.

Constraints on the values exclude what a named cause already models.  A delay over rows is 0 at the first and last row
(offset and readout time).  A displacement has no value, scale or rotation at the principal point and no cubic part
(principal point, focal length, k1).  A rate is 0 and flat at rest (bias and scale).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag, null_space

from virest.arrays import Array
from virest.camera.field import FORCES, KINDS, RATES, TIMED_BY_IMU, Field, cardinal_weights
from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.capture.profile_source import focus_log
from virest.capture.records import Capture
from virest.diagnosis.candidates import varies
from virest.diagnosis.field.forms import EXPOSURE, FORCE_REACH_M_S2, OVER, STEP_EDGE_S, TIME, FieldForm, Recipe
from virest.image_formation.row_clock import RowClock

ROW_KNOTS, PLACE_KNOTS, RATE_KNOTS, FOCUS_KNOTS = 6, 4, 7, 5
"""Knots of the coarse forms.  The fewer, the weaker an effect they detect: a cubic spline through 4, 5, 6 or 7 knots
follows 0.7, 1.0, 1.4 or 1.7 periods over its range to 10 % (rms)."""
FINE_ROW_KNOTS, FINE_PLACE_KNOTS, FINE_RATE_KNOTS = 21, 7, 13
"""Knots of the fine forms, which follow 6.5, 1.7 and 3.6 periods: jumps of the row, dents of a window, a dead zone."""
MOST_KNOTS, MOST_RATE_KNOTS = 2 * FINE_ROW_KNOTS - 1, 2 * FINE_RATE_KNOTS - 1
"""Knots after one refinement of the fine forms."""
MOST_PLACE_KNOTS = FINE_PLACE_KNOTS + PLACE_KNOTS - 1
"""The same for maps."""
PAIR_KNOTS = 3
"""Knots over the row or the radius in a pair: a parabola, and 0 at the first knot."""
MOST_PAIR_KNOTS = {TIME: MOST_KNOTS, EXPOSURE: 4 * PAIR_KNOTS - 3}
"""Knots over the second covariate of a pair after refinement.  A readout that changes above some exposure does so
within an eighth of the range."""
LEAST_TIMES, TIME_STEPS = 4, ((0.4, 12), (0.1, MOST_KNOTS))
"""(knot spacing in s, maximum number of knots) over time, coarse and fine.  0.1 s is 3 frames; a hunting focus has a
period of 0.5 s."""
FINE_RATE_QUANTILE = 0.97
"""Fine knots over a rate cover this quantile of the readings; too few rows lie beyond."""
SINH_SPACING = 3.0
"""Fine knots over a rate are spaced by sinh: 1/20 of the range apart near rest, where a hand is most of the time."""
MOST_FRAMES = 450
"""Frames whose stamps may each be late by their own time: those of a capture that is tracked in every frame."""
FRAMES_PER_STEP, MOST_STEPS = 2, 100
"""Frames between the instants at which a sudden change is searched for, and the maximum number of instants."""
LEAST_REACH_RAD_S = 0.1
"""Least range of the knots over a rate: a phone that is held still turns more slowly."""
LEAST_FOCUS_CHANGE = 0.05
"""Dioptres; a smaller focus change shifts no point by 1 px."""
READOUTS = frozenset({"readout_time", f"delay{OVER}row"})
LENSES = frozenset({"radial_distortion", f"displacement{OVER}x, y"})
GYROS = frozenset({"gyro_scale", "gyro_axes", f"rate{OVER}rate"})
"""Terms that already model the constant part of a pair."""


def possible_forms(
    capture: Capture, profile: CameraProfile, span_s: tuple[float, float], known: frozenset[str] = frozenset()
) -> list[FieldForm]:
    """All forms that a capture's log allows; span_s: first and last time with observed points, IMU clock.

    known: causes in the model; the forms leave their effect to them.
    """
    knots, fine = (_times(span_s, step_s, most) for step_s, most in TIME_STEPS)
    stamp = capture.stamp_0_ns
    stamps, fine_stamps = (np.asarray(profile.camera_time_s(times)) for times in (knots, fine))
    drifts = [_drift_form(kind, knots, stamp, known) for kind in ("scale", "rate")]
    drifts += [_drift_form("delay", stamps, stamp, known), _drift_form("scale", fine, stamp, known, local=True)]
    drifts.append(_drift_form("delay", fine_stamps, stamp, known, local=True))
    drifts.append(_drift_form("rate", knots[[0, -1]], stamp, known))
    places = [*(_place_form(profile, count) for count in (PLACE_KNOTS, FINE_PLACE_KNOTS)), _off_centre_form(profile)]
    forms = [*places, *drifts]
    forms += step_forms(capture, candidate_steps_s(span_s, capture))
    if profile.shutter.readout_time_s > 0:
        forms += [_row_form(count) for count in (ROW_KNOTS, FINE_ROW_KNOTS)]
    if (focus := _focus_form(capture, known)) is not None:
        forms.append(focus)
    forms += [_rate_form(capture.imu, profile), _fine_rate_form(capture.imu, profile, known)]
    if capture.imu.has_accelerometer:
        forms.append(_force_form(known))
    return forms


def forms_of_pairs(
    capture: Capture, profile: CameraProfile, span_s: tuple[float, float], known: frozenset[str] = frozenset()
) -> list[FieldForm]:
    """Interactions of two covariates: tensor products of a curve along each.

    They are 0 at the first row, at the principal point and at rest, where the effect depends on the other covariate
    alone.  They include the part constant over that one, unless a cause or a field in the model (known) models it.
    """
    times = _rounded(_times(span_s, *TIME_STEPS[0]))
    stamp = capture.stamp_0_ns
    forms: list[FieldForm] = []
    if profile.shutter.readout_time_s > 0:
        rows, later = np.linspace(0, 1, PAIR_KNOTS), [np.eye(PAIR_KNOTS)[:, 1:]]
        late = _zero("delay", ("row", TIME), [rows, np.asarray(profile.camera_time_s(times))], stamp)
        forms.append(_product((late,), later, None, READOUTS, known))
        logged_s = np.array([frame.exposure_s for frame in capture.frames if frame.exposure_s])
        if len(logged_s) and varies(logged_s):
            knots = np.linspace(logged_s.min(), logged_s.max(), min(PAIR_KNOTS, len(np.unique(logged_s))))
            late = _zero("delay", ("row", EXPOSURE), [rows, knots])
            forms.append(_product((late,), later, logged_s, READOUTS, known))
    radii = np.linspace(0, 0.5 * np.hypot(profile.width, profile.height), PAIR_KNOTS)
    outwards = [np.eye(len(radii))[:, 1:]]
    drawn = _zero("scale", ("radius", TIME), [radii, times], stamp)
    forms.append(_product((drawn,), outwards, None, LENSES, known))
    if (focus := _focus_form(capture, known)) is not None:
        ((dioptres,), log) = focus.fields[0].knots, focus.fields[0].log
        assert log is not None
        drawn = _zero("scale", ("radius", "focus"), [radii, np.array(dioptres)], None, log)
        forms.append(_product((drawn,), outwards, np.array(log[1]), LENSES, known))
    rates = _over_rates_and_time(capture, profile, times)
    odd = [np.array([[-1.0], [1.0]]) / np.sqrt(2)] * 3
    made = _product(rates, odd, None, GYROS, known), _turn_form(rates, known)
    families = {form.family for form in made}
    return forms + [form for form in made if not families - {form.family} & known]  # they share their knots


def _product(
    fields: tuple[Field, ...], first: list[Array], logged: Array | None, steady: frozenset[str], known: frozenset[str]
) -> FieldForm:
    """first: basis along the first covariate of each field; steady: terms that model the constant part.

    If one of these terms is known, the mean over the second covariate is 0.  logged: its values; None: it is the time,
    evenly spread.  Each of the 3 rate fields acts on its own axis.
    """
    second, knots = fields[0].covariates[1], fields[0].knots[1]
    weights = np.ones((1, len(knots))) if logged is None else cardinal_weights(knots, logged)
    changing = null_space(weights.mean(axis=0, keepdims=True)) if known & steady else np.eye(len(knots))
    more = 2 * len(knots) - 1
    refine: Recipe | None = None
    if second in MOST_PAIR_KNOTS and more <= MOST_PAIR_KNOTS[second]:
        finer = tuple(_with_knots(field, more) for field in fields)
        refine = lambda _profile, now: _product(finer, first, logged, steady, now)  # noqa: E731
    axes = np.eye(len(fields))
    bases = [np.kron(np.kron(along, changing), axes[:, k : k + 1]) for k, along in enumerate(first)]
    again: Recipe = lambda _profile, now: _product(fields, first, logged, steady, now)  # noqa: E731
    return FieldForm(fields, np.asarray(block_diag(*bases)), build=again, refine=refine)


def _over_rates_and_time(capture: Capture, profile: CameraProfile, times: Array) -> tuple[Field, ...]:
    """Fields of value 0 over each axis's rate, up to the highest, and the time."""
    reaches = _reaches(profile.true_rate_rad_s(capture.imu.gyro_rad_s))
    ends = [np.array([-reach, reach]) for reach in reaches]
    return tuple(
        _zero("rate", (name, TIME), [end, times], capture.stamp_0_ns) for name, end in zip(RATES, ends, strict=True)
    )


def _turn_form(fields: tuple[Field, ...], known: frozenset[str]) -> FieldForm:
    """A gyroscope that turns on the camera, by an angle over the time, in the fields of :func:`_over_rates_and_time`.

    If a rotation of the IMU is in the model, the angle has no mean.
    """
    count = len(fields[0].knots[1])
    free = null_space(np.ones((1, count))) if "imu_rotation" in known else np.eye(count)
    refine: Recipe | None = None
    if (more := 2 * count - 1) <= MOST_PAIR_KNOTS[TIME]:
        finer = tuple(_with_knots(field, more) for field in fields)
        refine = lambda _profile, now: _turn_form(finer, now)  # noqa: E731
    again: Recipe = lambda _profile, now: _turn_form(fields, now)  # noqa: E731
    return FieldForm(fields, _turned(fields, free), build=again, refine=refine, is_turn=True)


def _turned(fields: tuple[Field, ...], free: Array) -> Array:
    """Basis of the rates θ × ω that a gyroscope turned by an angle θ misreads, to first order.

    free: (knots over the time, n) values of each component of θ per free number.
    """
    across = np.cross(np.eye(3)[None, :], np.eye(3)[:, None])  # (axis of the rate, axis of the turn, components)
    ends = (np.array(field.knots[0])[:, None] for field in fields)
    basis = np.concatenate([np.kron(np.kron(end, free), own.T) for end, own in zip(ends, across, strict=True)])
    return np.asarray(basis / np.linalg.norm(basis, axis=0))


def turn_steps(capture: Capture, profile: CameraProfile, at_s: Array) -> list[FieldForm]:
    """A gyroscope that turns on the camera all at once.  One form per instant (n,), IMU clock."""
    forms = []
    for time_s in at_s:
        fields = _over_rates_and_time(capture, profile, _rounded(time_s + STEP_EDGE_S * np.array([-0.5, 0.5])))
        forms.append(FieldForm(fields, _turned(fields, np.array([[0.0], [1.0]])), float(time_s), is_turn=True))
    return forms


def _with_knots(field: Field, count: int) -> Field:
    """The same field with this many even knots over its second covariate and value 0 everywhere."""
    first, second = field.knots
    return _zero(
        field.kind, field.covariates, [np.array(first), np.linspace(second[0], second[-1], count)], field.stamp_0_ns
    )


def _reaches(rate_rad_s: Array, part: float = 1.0) -> list[float]:
    """Quantile ``part`` of the absolute rates (n, 3) on the 3 axes, rad/s."""
    return [max(float(most), LEAST_REACH_RAD_S) for most in np.quantile(np.abs(rate_rad_s), part, axis=0)]


def _times(span_s: tuple[float, float], step_s: float, most: int) -> Array:
    return np.linspace(*span_s, int(np.clip(round((span_s[1] - span_s[0]) / step_s) + 1, LEAST_TIMES, most)))


def _rounded(knots: Array) -> Array:
    return np.asarray(np.round(knots, 6))


def _zero(
    kind: str, covariates: tuple[str, ...], knots: Sequence[Array], stamp_0_ns: int | None = None, log: object = None
) -> Field:
    count = int(np.prod([len(k) for k in knots]))
    rows = tuple(tuple(float(v) for v in _rounded(k)) for k in knots)
    return Field(kind, covariates, rows, ((0.0,) * KINDS[kind][1],) * count, (), stamp_0_ns, log)  # type: ignore[arg-type]


def _row_form(count: int) -> FieldForm:
    field, more = _zero("delay", ("row",), [np.linspace(0, 1, count)]), 2 * count - 1
    refine = (lambda _profile, _known: _row_form(more)) if more <= MOST_KNOTS else None
    return FieldForm((field,), np.eye(count)[:, 1:-1], refine=refine)


def _place_form(profile: CameraProfile, count: int) -> FieldForm:
    """0 at the principal point, without scale or rotation there, and orthogonal to a cubic radial part."""
    lens = profile.intrinsics
    assert lens is not None
    knots = [np.linspace(0, side - 1, count) for side in (profile.width, profile.height)]
    field = _zero("displacement", ("x", "y"), knots)
    half = 0.5 * max(profile.width, profile.height)
    x, y = (a.ravel() for a in np.meshgrid(*knots, indexing="ij"))
    u, v = (x - lens.cx_px) / half, (y - lens.cy_px) / half

    def weights(px: float, py: float) -> Array:
        one, two = cardinal_weights(field.knots[0], px), cardinal_weights(field.knots[1], py)
        return np.outer(one, two).ravel()

    middle = weights(lens.cx_px, lens.cy_px)
    per_x = weights(lens.cx_px + 1, lens.cy_px) - weights(lens.cx_px - 1, lens.cy_px)
    per_y = weights(lens.cx_px, lens.cy_px + 1) - weights(lens.cx_px, lens.cy_px - 1)
    nothing = np.zeros_like(middle)
    cubic = u**2 + v**2
    conditions = [(middle, nothing), (nothing, middle), (per_x, per_y), (per_y, -per_x), (cubic * u, cubic * v)]
    rows = np.array([np.stack(pair, axis=-1).ravel() for pair in conditions])
    free, more = null_space(rows / np.linalg.norm(rows, axis=1, keepdims=True)), count + PLACE_KNOTS - 1
    refine = (lambda profile, _known: _place_form(profile, more)) if more <= MOST_PLACE_KNOTS else None
    return FieldForm((field,), free, build=lambda profile, _known: _place_form(profile, count), refine=refine)


def _off_centre_form(profile: CameraProfile) -> FieldForm:
    """A decentred lens in 2 numbers, which detect a weaker effect than a map with many.

    Tangential distortion (Brown 1966) about the principal point; cubic splines represent squares exactly.
    """
    lens = profile.intrinsics
    assert lens is not None
    knots = [np.linspace(0, side - 1, PLACE_KNOTS) for side in (profile.width, profile.height)]
    half = 0.5 * max(profile.width, profile.height)
    x, y = (a.ravel() for a in np.meshgrid(*knots, indexing="ij"))
    u, v = (x - lens.cx_px) / half, (y - lens.cy_px) / half
    r2 = u**2 + v**2
    patterns = [np.stack(pair, axis=-1).ravel() for pair in ((2 * u * v, r2 + 2 * v**2), (r2 + 2 * u**2, 2 * u * v))]
    return FieldForm(
        (_zero("displacement", ("x", "y"), knots),),
        np.linalg.qr(np.stack(patterns, axis=-1))[0],
        build=lambda profile, _known: _off_centre_form(profile),
        refine=lambda profile, _known: _place_form(profile, PLACE_KNOTS),
    )


def _drift_form(
    kind: str, knots: Array, stamp_0_ns: int | None, known: frozenset[str], local: bool = False
) -> FieldForm:
    """Over time: a focal length relative to its start, rates, or a delay.

    If a bias is in the model, the rates have no mean.  If a clock offset or skew is, the delay has no mean or slope,
    respectively.
    """
    count, field = len(knots), _zero(kind, (TIME,), [knots], stamp_0_ns)

    def again(knots: Array) -> Recipe:
        return lambda _profile, now: _drift_form(kind, knots, stamp_0_ns, now, local)

    free = np.eye(count)
    if kind == "scale":
        free = free[:, 1:]
    elif kind == "rate":
        free = np.kron(null_space(np.ones((1, count))) if "gyro_bias" in known else free, np.eye(3))
    else:
        line = {"time_offset": np.ones(count), "clock_skew": np.linspace(-1, 1, count)}
        held = [row for name, row in line.items() if name in known]
        free = null_space(np.stack(held)) if held else free
    more = np.linspace(knots[0], knots[-1], 2 * count - 1)
    refine = again(more) if len(more) <= (MOST_RATE_KNOTS if kind == "rate" else MOST_KNOTS) else None
    return FieldForm((field,), free, local=local, build=again(knots), refine=refine)


def _frame_starts_s(capture: Capture, profile: CameraProfile, span_s: tuple[float, float]) -> Array:
    """Starts of the first row of the frames in a span of IMU time and next to it, camera clock."""
    clock = RowClock(profile)
    found = [clock.start_on_camera_s(frame.time_s, frame.exposure_s or 0.0) for frame in capture.frames]
    starts = np.unique(_rounded(np.array(found)))
    begin_s, end_s = (float(profile.camera_time_s(t)) for t in span_s)
    period_s = float(np.median(np.diff(starts)))
    return starts[(starts > begin_s - period_s) & (starts < end_s + period_s)]


def form_of_late_frames(
    capture: Capture,
    profile: CameraProfile,
    span_s: tuple[float, float],
    seen_s: Array,
    known: frozenset[str] = frozenset(),
) -> FieldForm | None:
    """A delay of its own for each frame: stamps that jitter.  None for too many frames.

    seen_s: stamps of frames with points.  Others have no delay of their own, which would take up the mean.
    """
    starts_s = _frame_starts_s(capture, profile, span_s)
    starts_s = starts_s[np.unique(np.argmin(np.abs(starts_s - np.unique(seen_s)[:, None]), axis=1))]
    return _late_frames_form(starts_s, capture.stamp_0_ns, known) if len(starts_s) <= MOST_FRAMES else None


def _late_frames_form(starts_s: Array, stamp_0_ns: int, known: frozenset[str]) -> FieldForm:
    made = _drift_form("delay", starts_s, stamp_0_ns, known, local=True)
    return replace(
        made, build=lambda _profile, now: _late_frames_form(starts_s, stamp_0_ns, now), refine=None, by_frame=True
    )


def step_forms(
    capture: Capture, at_s: Array, kind: str = "scale", profile: CameraProfile | None = None
) -> list[FieldForm]:
    """A sudden change of the focal length, of the gyroscope's bias (``rate``) or of the stamps (``delay``).

    One form per instant (n,), IMU clock; profile: its clocks give a delay's instant on the camera's.
    """
    own_s = at_s if profile is None or kind in TIMED_BY_IMU else np.asarray(profile.camera_time_s(at_s))
    edges = [np.array([t - STEP_EDGE_S / 2, t + STEP_EDGE_S / 2]) for t in own_s]
    fields = [_zero(kind, (TIME,), [edge], capture.stamp_0_ns) for edge in edges]
    later = np.kron(np.array([[0.0], [1.0]]), np.eye(KINDS[kind][1]))
    return [FieldForm((f,), later, float(t)) for f, t in zip(fields, at_s, strict=True)]


def candidate_steps_s(span_s: tuple[float, float], capture: Capture) -> Array:
    """Instants at which a sudden change is searched for."""
    frames = sum(span_s[0] <= frame.time_s <= span_s[1] for frame in capture.frames)
    return np.linspace(*span_s, min(frames // FRAMES_PER_STEP, MOST_STEPS) + 2)[1:-1]


def _focus_form(capture: Capture, known: frozenset[str]) -> FieldForm | None:
    """Over the logged focus distance; relative to the start of the capture if the focal length is in the model.

    The given focal length holds at an unknown focus distance, so the level is the field's.
    """
    log = focus_log(capture)
    if log is None or len(log[0]) < 0.5 * len(capture.frames):
        return None
    values = np.array(log[1])
    if np.ptp(values) < LEAST_FOCUS_CHANGE:
        return None
    knots: Array = np.unique(np.round(np.linspace(values.min(), values.max(), FOCUS_KNOTS), 6))
    field = _zero("scale", ("focus",), [knots], None, log)
    return _breathing_form(field, float(values[0]), known)


def _breathing_form(field: Field, start: float, known: frozenset[str]) -> FieldForm:
    at_start = cardinal_weights(field.knots[0], start)[None]
    free = null_space(at_start) if "focal_length" in known else np.eye(at_start.shape[1])
    return FieldForm((field,), free, build=lambda _profile, now: _breathing_form(field, start, now))


def _rate_form(imu: ImuSamples, profile: CameraProfile) -> FieldForm:
    """Each axis over its own reading: 0 and flat at rest."""

    def conditions(knots: tuple[float, ...], reading: Array) -> Array:
        least = 0.01 * knots[-1]
        at, before, after = (cardinal_weights(knots, r) for r in (0.0, -least, least))
        return np.stack([at, 50 * (after - before)])

    return _over_rates(imu, profile, np.linspace(-1.0, 1.0, RATE_KNOTS), conditions)


def _fine_rate_form(
    imu: ImuSamples, profile: CameraProfile, known: frozenset[str], count: int = FINE_RATE_KNOTS
) -> FieldForm:
    """The same with more knots near rest, where a gyroscope may stick, and without the flatness constraint.

    If scales of the gyroscope are in the model, the part proportional to the readings is left to them.
    """

    def conditions(knots: tuple[float, ...], reading: Array) -> Array:
        at = cardinal_weights(knots, 0.0)
        mean = reading @ cardinal_weights(knots, reading) / float(reading @ reading)
        return np.stack([at, mean] if {"gyro_scale", "gyro_axes"} & known else [at])

    def again(count: int) -> Recipe:
        return lambda _profile, now: _fine_rate_form(imu, profile, now, count)

    steps = np.sinh(SINH_SPACING * np.linspace(-1.0, 1.0, count)) / np.sinh(SINH_SPACING)
    more = 2 * count - 1
    made = _over_rates(imu, profile, steps, conditions, FINE_RATE_QUANTILE)
    return replace(made, build=again(count), refine=again(more) if more <= MOST_RATE_KNOTS else None)


def _over_rates(
    imu: ImuSamples, profile: CameraProfile, steps: Array, conditions: Callable[[tuple[float, ...], Array], Array],
    part: float = 1.0,
) -> FieldForm:  # fmt: skip
    """Each axis over its own reading; steps: knots as fractions of the quantile ``part`` of the readings.

    conditions: rows of linear constraints on the knot values.
    """
    fields, bases, readings = [], [], profile.true_rate_rad_s(imu.gyro_rad_s)
    for axis, (name, reach) in enumerate(zip(RATES, _reaches(readings, part), strict=True)):
        field = _zero("rate", (name,), [steps * reach])
        own = np.zeros((3, 1))
        own[axis] = 1.0
        fields.append(field)
        bases.append(np.kron(null_space(conditions(field.knots[0], readings[:, axis])), own))
    return FieldForm(tuple(fields), block_diag(*bases))


def _force_form(known: frozenset[str]) -> FieldForm:
    """Rates linear in the specific force: 3 × 3 numbers, as values at FORCE_REACH_M_S2, and 3 at no force.

    A bias measured at rest includes what gravity adds in that pose, so the rates at no force are the field's, unless
    the bias is in the model.
    """
    fields = tuple(_zero("rate", (name,), [np.array([-FORCE_REACH_M_S2, FORCE_REACH_M_S2])]) for name in FORCES)
    odd, even = np.array([[-1.0], [1.0]]) / np.sqrt(2), np.ones((2, 1)) / np.sqrt(2)
    basis = np.asarray(block_diag(*[np.kron(odd, np.eye(3))] * 3))
    if "gyro_bias" not in known:
        at_no_force = np.zeros((len(basis), 3))
        at_no_force[:6] = np.kron(even, np.eye(3))
        basis = np.concatenate([basis, at_no_force], axis=1)
    return FieldForm(fields, basis, build=lambda _profile, now: _force_form(now))
