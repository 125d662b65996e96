"""Forms of fields that may be fitted: which covariates, which knots, and which values are left to the named causes.

Each form is a vector of free numbers; its values at the knots are linear in them.  What a named cause says already is
kept out by conditions on the values: a delay over rows is nought at the first and last row (offset and readout time),
a displacement has neither value, scale nor turn at the principal point, and no cubic part (principal point, focal
length, k1), a rate is nought and flat at rest (bias and scale).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, null_space

from virest.camera.field import FORCES, KINDS, RATES, Field, cardinal_weights
from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.capture.records import Capture
from virest.inference.track_fit import Term

Array = NDArray[np.float64]
ROW_KNOTS, PLACE_KNOTS, RATE_KNOTS, FOCUS_KNOTS = 6, 4, 7, 5
MOST_KNOTS = 40
TIME_STEP_S, TIME_KNOTS = 0.4, (4, 12)
STEP_EDGE_S, FRAMES_PER_STEP, MOST_STEPS = 1e-3, 2, 100
"""Width of a sudden change, and how densely in time one is looked for."""
FORCE_REACH_M_S2 = 20.0
"""Two g: what a phone in a hand stays below."""
LEAST_FOCUS_CHANGE = 0.05
"""In dioptres: less moves no lens by a pixel."""
STD = {"delay": 0.01, "displacement": 30.0, "scale": 0.2, "rate": 1.0}
"""Prior of a free number: ten times what a phone would show.  It only holds numbers that nothing tells."""
QUOTIENT = {"delay": 1e-4, "displacement": 0.1, "scale": 1e-4, "rate": 2e-3}
"""Step of the difference quotients, in the unit of the values."""
TIME, OVER = "time", " over "


@dataclass(frozen=True, slots=True)
class FieldForm:
    """One or several fields that are fitted together."""

    fields: tuple[Field, ...]
    """With the value nought everywhere."""
    basis: Array
    """(values of all fields, numbers): values at the knots per free number; columns are orthonormal."""
    step_s: float | None = None
    """Time of a sudden change; None: the form is smooth."""
    known: frozenset[str] = frozenset()
    """Causes that say part of what the form could."""

    @property
    def kind(self) -> str:
        """As of its fields."""
        return self.fields[0].kind

    @property
    def name(self) -> str:
        """What it is called: kind and covariates, and where it changes suddenly."""
        sudden = "" if self.step_s is None else f", a step at {self.step_s:.2f} s"
        return self.family + sudden

    @property
    def family(self) -> str:
        """Kind and covariates."""
        return f"{self.kind}{OVER}{', '.join(self.covariates)}"

    @property
    def covariates(self) -> tuple[str, ...]:
        """Of its fields; the three axes of a sensor under one name."""
        names = self.fields[0].covariates
        return ("rate",) if names[0] in RATES else ("acceleration",) if names[0] in FORCES else names

    @property
    def over_time(self) -> bool:
        """Whether it is one value a frame, known only where it was fitted."""
        return self.covariates in ((TIME,), ("focus",))

    def values(self, numbers: Array) -> list[Array]:
        """Values (knots, components) of each field."""
        flat = self.basis @ numbers
        ends = np.cumsum([np.size(field.values) for field in self.fields])
        return [
            part.reshape(np.shape(f.values)) for part, f in zip(np.split(flat, ends[:-1]), self.fields, strict=True)
        ]

    def filled(self, numbers: Array, covariance: Array | None = None) -> tuple[Field, ...]:
        """The fields with their values, and deviations from the numbers' covariance."""
        std = None
        if covariance is not None:
            variance = np.einsum("vk,kl,vl->v", self.basis, covariance, self.basis)
            ends = np.cumsum([np.size(field.values) for field in self.fields])
            std = np.split(np.sqrt(np.maximum(variance, 0.0)), ends[:-1])
        return tuple(
            field.with_values(values, None if std is None else std[k].reshape(values.shape))
            for k, (field, values) in enumerate(zip(self.fields, self.values(numbers), strict=True))
        )

    def change(self, profile: CameraProfile, numbers: Array) -> CameraProfile:
        """The profile with these numbers added to what its fields say."""
        held = list(profile.fields)
        for field, values in zip(self.fields, self.values(numbers), strict=True):
            place = next((k for k, known in enumerate(held) if _adds_to(field, known)), None)
            if place is None:
                held.append(field.with_values(values))
            else:
                before = held.pop(place)
                held.insert(place, field.with_values(values + _at_knots(before, field)))
        return profile.with_fields(held)

    @staticmethod
    def held_in(profile: CameraProfile, field: Field) -> Field:
        """What a profile holds in a field's place; the field itself where that is nothing."""
        return next((known for known in profile.fields if _adds_to(field, known)), field)

    @property
    def finer(self) -> FieldForm | None:
        """The same with about twice the knots; None where there is no such form."""
        field = self.fields[0]
        count = 2 * len(field.knots[0]) - 1
        if self.covariates == ("row",) and count <= MOST_KNOTS:
            return _row_form(count)
        if self.covariates == (TIME,) and self.step_s is None and count <= MOST_KNOTS:
            knots = np.linspace(field.knots[0][0], field.knots[0][-1], count)
            return _drift_form(self.kind, knots, field.stamp_0_ns, self.known)
        return None

    def about(self, profile: CameraProfile) -> FieldForm:
        """The same kept apart from another profile's lens: a displacement is nought at its principal point."""
        return _place_form(profile) if self.kind == "displacement" else self

    @property
    def term(self) -> Term:
        """The form as a term of the fit of tracked points."""
        count = self.basis.shape[1]
        step, std = QUOTIENT[self.kind], STD[self.kind]
        return Term(self.name, self.change, (step,) * count, (std,) * count, (std,) * count)


def _adds_to(field: Field, known: Field) -> bool:
    """Whether two fields are one, or only one of their kind may be held."""
    alike = (known.kind, known.covariates) == (field.kind, field.covariates)
    return alike and (field.is_single or known.knots == field.knots)


def _at_knots(before: Field, field: Field) -> Array:
    """Values (knots, components) of a field at another's knots."""
    grid = np.meshgrid(*field.knots, indexing="ij")
    return before.at(*(axis.ravel() for axis in grid))


def possible_forms(
    capture: Capture, profile: CameraProfile, span_s: tuple[float, float], known: frozenset[str] = frozenset()
) -> list[FieldForm]:
    """All forms that a capture's log allows; span_s: first and last time at which points were seen, IMU clock.

    known: causes that are in the model and say what the forms need not.
    """
    count = int(np.clip(round((span_s[1] - span_s[0]) / TIME_STEP_S) + 1, *TIME_KNOTS))
    knots = np.linspace(*span_s, count)
    drifts = [_drift_form(kind, knots, capture.stamp_0_ns, known) for kind in ("scale", "rate", "delay")]
    forms = [_place_form(profile), *drifts]
    forms += step_forms(capture, coarse_steps_s(span_s, capture))
    if profile.shutter.readout_time_s > 0:
        forms.append(_row_form())
    if (focus := _focus_form(capture)) is not None:
        forms.append(focus)
    forms.append(_rate_form(capture.imu, profile))
    if capture.imu.has_accelerometer:
        forms.append(_force_form())
    return forms


def _zero(
    kind: str, covariates: tuple[str, ...], knots: Sequence[Array], stamp_0_ns: int | None = None, log: object = None
) -> Field:
    count = int(np.prod([len(k) for k in knots]))
    rows = tuple(tuple(float(v) for v in np.round(k, 6)) for k in knots)
    return Field(kind, covariates, rows, ((0.0,) * KINDS[kind][1],) * count, (), stamp_0_ns, log)  # type: ignore[arg-type]


def _row_form(count: int = ROW_KNOTS) -> FieldForm:
    return FieldForm((_zero("delay", ("row",), [np.linspace(0, 1, count)]),), np.eye(count)[:, 1:-1])


def _place_form(profile: CameraProfile) -> FieldForm:
    """Nought at the principal point, with neither scale nor turn there, and orthogonal to a cubic radial part."""
    lens = profile.intrinsics
    assert lens is not None
    knots = [np.linspace(0, side - 1, PLACE_KNOTS) for side in (profile.width, profile.height)]
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
    return FieldForm((field,), null_space(rows / np.linalg.norm(rows, axis=1, keepdims=True)))


def _drift_form(kind: str, knots: Array, stamp_0_ns: int | None, known: frozenset[str]) -> FieldForm:
    """Over time: a focal length from where it begins, rates about their mean (bias), a delay.

    Where an offset or a skew of the clocks is in the model the delay has no mean or slope.
    """
    count, field = len(knots), _zero(kind, (TIME,), [knots], stamp_0_ns)
    if kind == "scale":
        return FieldForm((field,), np.eye(count)[:, 1:])
    if kind == "delay":
        line = {"time_offset": np.ones(count), "clock_skew": np.linspace(-1, 1, count)}
        held = [row for name, row in line.items() if name in known]
        return FieldForm((field,), null_space(np.stack(held)) if held else np.eye(count), known=known)
    return FieldForm((field,), np.kron(null_space(np.ones((1, count))), np.eye(3)))


def step_forms(capture: Capture, at_s: Array) -> list[FieldForm]:
    """A focal length that is another from one instant on, for each of some instants (n,)."""
    edges = [np.array([t - STEP_EDGE_S / 2, t + STEP_EDGE_S / 2]) for t in at_s]
    fields = [_zero("scale", (TIME,), [edge], capture.stamp_0_ns) for edge in edges]
    return [FieldForm((f,), np.array([[0.0], [1.0]]), float(t)) for f, t in zip(fields, at_s, strict=True)]


def coarse_steps_s(span_s: tuple[float, float], capture: Capture) -> Array:
    """Instants at which a sudden change is looked for."""
    frames = sum(span_s[0] <= frame.time_s <= span_s[1] for frame in capture.frames)
    return np.linspace(*span_s, min(frames // FRAMES_PER_STEP, MOST_STEPS) + 2)[1:-1]


def _focus_form(capture: Capture) -> FieldForm | None:
    """Over the logged focus distance, from where the capture begins."""
    log = [(f.time_s, f.focus_dioptres) for f in capture.frames if f.focus_dioptres is not None]
    values = np.array([value for _, value in log])
    if len(log) < 0.5 * len(capture.frames) or np.ptp(values) < LEAST_FOCUS_CHANGE:
        return None
    knots: Array = np.unique(np.round(np.linspace(values.min(), values.max(), FOCUS_KNOTS), 6))
    times = tuple(float(time_s) for time_s, _ in log)
    field = _zero("scale", ("focus",), [knots], None, (times, tuple(values.tolist())))
    return FieldForm((field,), null_space(cardinal_weights(field.knots[0], values[0])[None]))


def _rate_form(imu: ImuSamples, profile: CameraProfile) -> FieldForm:
    """Each axis over its own reading: nought and flat at rest."""
    fields, bases = [], []
    for axis, name in enumerate(RATES):
        reading = (imu.gyro_rad_s[:, axis] - profile.gyro_bias_rad_s[axis]) / profile.gyro_scale[axis]
        reach = max(float(np.abs(reading).max()), 0.1)
        knots = np.linspace(-1.0, 1.0, RATE_KNOTS) * reach
        field = _zero("rate", (name,), [knots])
        at, before, after = (cardinal_weights(field.knots[0], r) for r in (0.0, -0.01 * reach, 0.01 * reach))
        own = np.zeros((3, 1))
        own[axis] = 1.0
        fields.append(field)
        bases.append(np.kron(null_space(np.stack([at, 50 * (after - before)])), own))
    return FieldForm(tuple(fields), block_diag(*bases))


def _force_form() -> FieldForm:
    """Rates in proportion to the specific force: three by three numbers, by the value at FORCE_REACH_M_S2."""
    fields = tuple(_zero("rate", (name,), [np.array([-FORCE_REACH_M_S2, FORCE_REACH_M_S2])]) for name in FORCES)
    odd = np.array([[-1.0], [1.0]]) / np.sqrt(2)
    return FieldForm(fields, block_diag(*[np.kron(odd, np.eye(3))] * 3))
