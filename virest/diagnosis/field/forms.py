"""A field form: knot values that are linear in a vector of free numbers, usable as a term of a fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from virest.arrays import Array, Index
from virest.camera.field import FORCES, RATES, Field, cardinal_weights
from virest.camera.profile import CameraProfile
from virest.image_formation.point_changes import Moved
from virest.image_formation.point_model import TrackTable
from virest.inference.track_fit import Term

Recipe = Callable[[CameraProfile, frozenset[str]], "FieldForm"]
"""Builds a form from a profile and the names of the terms in the model."""
SENSORS = {**dict.fromkeys(RATES, "rate"), **dict.fromkeys(FORCES, "acceleration")}
"""Common name of the axes of a sensor."""
STEP_EDGE_S = 1e-3
"""Width of a sudden change."""
FORCE_REACH_M_S2 = 80.0
"""8 g, the range of phones' accelerometers: beyond its knots a field is constant, and a shaken phone feels 3 g."""
STD = {"delay": 0.01, "displacement": 30.0, "scale": 0.2, "rate": 1.0}
"""Prior σ of a free number, 10 times the usual size in phones: it only regularises undetermined numbers."""
QUOTIENT = {"delay": 1e-4, "displacement": 0.1, "scale": 1e-4, "rate": 2e-3}
"""Step of the difference quotients, in the unit of the values."""
TIME, EXPOSURE, TURN, OVER = "time", "exposure", "turn", " over "


@dataclass(frozen=True, slots=True)
class FieldForm:
    """One or several fields that are fitted together."""

    fields: tuple[Field, ...]
    """With the values to which the numbers add: 0, or those that are expected before a fit."""
    basis: Array
    """(values of all fields, numbers): values at the knots per free number; columns are orthonormal."""
    step_s: float | None = None
    """Time of a sudden change; None: the form is smooth."""
    local: bool = False
    """Whether its knots are as dense in time as blocks, so that frames cannot predict others."""
    build: Recipe | None = None
    """Builds the form for another profile and other terms in the model; None: it depends on neither."""
    refine: Recipe | None = None
    """Builds the same with more knots; None: the maximum is reached."""
    by_frame: bool = False
    """Whether it has a knot at the start of each frame, so that no frame says anything about another."""
    is_turn: bool = False
    """Whether it is a gyroscope that turns on the camera by an angle θ, and so misreads its rates ω by θ × ω."""

    @property
    def kind(self) -> str:
        """Kind of its fields."""
        return self.fields[0].kind

    @property
    def name(self) -> str:
        """Kind, covariates and, if sudden, the instant."""
        sudden = "" if self.step_s is None else f", a step at {self.step_s:.2f} s"
        return self.family + sudden

    @property
    def family(self) -> str:
        """Kind and covariates."""
        return f"{TURN if self.is_turn else self.kind}{OVER}{', '.join(self.covariates)}"

    @property
    def covariates(self) -> tuple[str, ...]:
        """Covariates of its fields; the 3 axes of a sensor share one name."""
        return tuple(dict.fromkeys(SENSORS.get(name, name) for name in self.fields[0].covariates))

    @property
    def over_time(self) -> bool:
        """Whether it has one value per frame, known only where it was fitted."""
        return bool(set(self.covariates) & {TIME, "focus", EXPOSURE})

    def is_dense(self, step_s: float) -> bool:
        """Whether its knots over time are closer than this, so that frames hardly predict those between them."""
        knots = self.fields[0].knots[-1]
        return TIME in self.covariates and self.step_s is None and (knots[-1] - knots[0]) / (len(knots) - 1) < step_s

    @property
    def is_pair(self) -> bool:
        """Whether it is the interaction of two covariates beyond the effect of each."""
        return self.fields[0].is_pair

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
        """The profile with these numbers added to its fields."""
        held = list(profile.fields)
        for field, values in zip(self.fields, self.values(numbers), strict=True):
            if not values.any():
                continue
            place = next((k for k, known in enumerate(held) if _adds_to(field, known)), None)
            if place is None:
                held.append(field.with_values(values))
            else:
                before = held.pop(place)
                held.insert(place, field.with_values(values + _at_knots(before, field)))
        return profile.with_fields(held)

    def removed_from(self, profile: CameraProfile) -> CameraProfile:
        """The profile without these fields."""
        return profile.with_fields([f for f in profile.fields if not any(map(f.is_in_place_of, self.fields))])

    def can_hold(self, profile: CameraProfile) -> bool:
        """Whether the values that a profile has for its fields are values of this form."""
        values = np.concatenate([np.ravel(self.held_in(profile, field).values) for field in self.fields])
        if len(values) != len(self.basis):
            return False
        beyond = values - self.basis @ (self.basis.T @ values)
        return float(np.abs(beyond).max(initial=0.0)) < 1e-9 * max(float(np.abs(values).max(initial=0.0)), 1e-12)

    @staticmethod
    def held_in(profile: CameraProfile, field: Field) -> Field:
        """The profile's counterpart of a field; the field itself where there is none."""
        return next((known for known in profile.fields if _adds_to(field, known)), field)

    def finer(self, profile: CameraProfile, known: frozenset[str]) -> FieldForm | None:
        """The same with about twice the knots, or PLACE_KNOTS − 1 more along each side; None at the maximum."""
        return None if self.refine is None else self.refine(profile, known)

    def about(self, profile: CameraProfile, known: frozenset[str]) -> FieldForm:
        """The same form built for another profile's lens and other terms in the model."""
        if self.build is None:
            return self
        made = self.build(profile, known)
        same = made.basis.shape == self.basis.shape and np.array_equal(made.basis, self.basis)
        return self if same else made

    @property
    def term(self) -> Term:
        """The form as a term of the fit of tracked points."""
        count = self.basis.shape[1]
        step, std = QUOTIENT[self.kind], STD[self.kind]
        slopes = self._displaced if self.kind == "displacement" else self._late_frames if self.by_frame else None
        return Term(self.name, self.change, (step,) * count, (std,) * count, (std,) * count, slopes)

    def _late_frames(self, profile: CameraProfile, table: TrackTable, moved_by: Moved) -> Array:
        """Slopes (n, 2, k) of a delay of each frame: a point moves with the delays of its two frames alone."""
        per_value = np.zeros((len(table), 2, len(self.fields[0].values)))
        rows = np.arange(len(table))
        for end, moved in self._moved_by_ends(profile, table, moved_by):
            per_value[rows, :, end] = moved
        return np.asarray(per_value @ self.basis)

    def _moved_by_ends(self, profile: CameraProfile, table: TrackTable, moved_by: Moved) -> list[tuple[Index, Array]]:
        """For the first and the second frames of the points: their knots (n,), and the slopes (n, 2) per delay of each.

        Frames of one colour are delayed at once; no pair has both of its frames in one colour.
        """
        knots = np.array(self.fields[0].knots[0])
        ends = [np.argmin(np.abs(knots - s[:, None]), axis=1) for s in (table.first_stamp_s, table.second_stamp_s)]
        colours = int(np.abs(ends[1] - ends[0]).max()) + 1
        field, step = self.held_in(profile, self.fields[0]), QUOTIENT[self.kind]
        others = [f for f in profile.fields if not _adds_to(field, f)]
        slopes = np.zeros((2, len(table), 2))
        for colour in range(colours):
            late = np.array(field.values) + step * (np.arange(len(knots)) % colours == colour)[:, None]
            moved = moved_by(profile.with_fields([*others, field.with_values(late)])) / step
            for slope, end in zip(slopes, ends, strict=True):
                slope[end % colours == colour] = moved[end % colours == colour]
        return list(zip(ends, slopes, strict=True))

    def _displaced(self, profile: CameraProfile, table: TrackTable, moved_by: Moved) -> Array:
        """Slopes (n, 2, k) of a displacement u: u(p₂) − J u(p₁); J follows from shifting both points equally."""
        held = self.held_in(profile, self.fields[0])
        shifts = np.eye(2) * QUOTIENT[self.kind]
        others = [f for f in profile.fields if f.kind != self.kind]
        both = [profile.with_fields([*others, held.with_values(np.array(held.values) + shift)]) for shift in shifts]
        jacobian = np.eye(2) - np.stack([moved_by(shifted) for shifted in both], axis=-1) / QUOTIENT[self.kind]
        before, after = (_weights(self.fields[0], held.undisplaced(p)) for p in (table.first_px, table.second_px))
        per_value = np.einsum("nk,ij->nikj", after, np.eye(2)) - np.einsum("nk,nij->nikj", before, jacobian)
        return np.asarray(per_value.reshape(len(before), 2, -1) @ self.basis)


def _weights(field: Field, points_px: Array) -> Array:
    """Interpolation weights (n, knots) of the knot values at pixels (n, 2)."""
    across, down = (cardinal_weights(k, c) for k, c in zip(field.knots, points_px.T, strict=True))
    return np.asarray(across[:, :, None] * down[:, None, :]).reshape(len(points_px), -1)


def _adds_to(field: Field, known: Field) -> bool:
    """Whether two fields are the same, or a profile can hold only one of their kind."""
    alike = (known.kind, known.covariates) == (field.kind, field.covariates)
    return alike and (field.is_single or known.knots == field.knots)


def _at_knots(before: Field, field: Field) -> Array:
    """Values (knots, components) of a field at another's knots."""
    if before.knots == field.knots:
        return np.array(before.values)
    grid = np.meshgrid(*field.knots, indexing="ij")
    return before.at(*(axis.ravel() for axis in grid))
