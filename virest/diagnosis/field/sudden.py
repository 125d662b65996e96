"""A focal length that is another from one instant on: a phone that switches its lens.

Between the two frames on either side the picture grows or shrinks by many times what tracking errs, more than in any
other pair of frames; a robust fit takes these points for outliers.  What comes after shows whether it stays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from virest.capture.records import Capture
from virest.diagnosis.field.design import PointResiduals
from virest.diagnosis.field.form_list import FRAMES_PER_STEP, step_forms
from virest.diagnosis.field.forms import FieldForm
from virest.image_formation.point_model import seen_s

Array = NDArray[np.float64]
CHANCE = 1e-4
"""Family-wise false-alarm rate: of any pair of a capture growing this much by chance."""
LEAST_POINTS, LEAST_PAIRS = 8, 15
INSTANTS, REACH = 97, FRAMES_PER_STEP + 1.0
"""Instants that are tried, over this many frames before and after: a first look passes over as many about a change,
and lies half as many off itself."""
CAUCHY = 2.5
"""In standard deviations."""
_ITERATIONS = 8


@dataclass(frozen=True, slots=True)
class SuddenChange:
    """A pair of frames between which the picture grew."""

    pair: int
    at_s: float
    """Between the two, IMU clock from stamp_0."""
    scale: float
    """Part by which the focal length is longer afterwards."""
    p_value: float


def sudden_change(seen: PointResiduals) -> SuddenChange | None:
    """The pair that grew most, where that is no chance."""
    lens, table = seen.fit.profile.intrinsics, seen.table
    assert lens is not None
    arm = seen.prediction.second_px - np.array([lens.cx_px, lens.cy_px])
    off = table.second_px - seen.prediction.second_px
    pairs = [k for k, count in enumerate(np.bincount(table.pair)) if count >= LEAST_POINTS]
    if len(pairs) < LEAST_PAIRS:
        return None
    growth = np.array([_growth(arm[table.pair == k], off[table.pair == k]) for k in pairs])
    middle = float(np.median(growth))
    spread = 1.4826 * float(np.median(np.abs(growth - middle)))
    most = int(np.argmax(np.abs(growth - middle)))
    ratio = abs(growth[most] - middle) / max(spread, 1e-12)
    p_value = min(2 * len(pairs) * float(stats.t.sf(ratio, len(pairs) - 1)), 1.0)
    if p_value > CHANCE:
        return None
    inside = table.pair == pairs[most]
    profile = seen.fit.profile
    first_s = seen_s(profile, table.first_px, table.first_stamp_s, table.first_exposure_s)[inside]
    second_s = seen_s(profile, table.second_px, table.second_stamp_s, table.second_exposure_s)[inside]
    at_s = 0.5 * float(first_s.max() + second_s.min())
    return SuddenChange(pairs[most], at_s, float(growth[most]), p_value)


def _growth(arm: Array, off: Array) -> float:
    """Part (robust) by which points (n, 2) at arms (n, 2) from the centre went outwards, beside a common shift."""
    design = np.concatenate([np.concatenate([arm[:, :1], arm[:, 1:]]), np.repeat(np.eye(2), len(arm), axis=0)], axis=1)
    flat = np.concatenate([off[:, 0], off[:, 1]])
    weight = np.ones(len(flat))
    found = np.zeros(3)
    for _ in range(_ITERATIONS):
        root = np.sqrt(weight)
        found = np.linalg.lstsq(design * root[:, None], flat * root, rcond=None)[0]
        left = flat - design @ found
        scale = max(1.4826 * float(np.median(np.abs(left))), 1e-9)
        weight = 1 / (1 + (left / (CAUCHY * scale)) ** 2)
    return float(found[0])


def lasting_change(seen: PointResiduals, tangent: Array, effect: Array) -> float:
    """The value of a form of one number that the points ask for, beside all that the tangent space can do."""
    root = np.repeat(np.sqrt(seen.weight), 2)
    design = np.concatenate([effect, tangent], axis=-1).reshape(len(root), -1) * root[:, None]
    return float(np.linalg.lstsq(design, seen.left.ravel() * root, rcond=None)[0][0])


def best_instant(seen: PointResiduals, capture: Capture, at_s: float, scale: float, period_s: float) -> FieldForm:
    """The form of a sudden change of a given size at the instant that the points about it suit best."""
    forms = step_forms(capture, at_s + np.linspace(-1, 1, INSTANTS) * REACH * period_s)
    step = scale / float(forms[0].basis[-1, 0])
    whole = [seen.left - step * seen.effect((form.term,))[..., 0] for form in forms]
    losses = np.array([np.log1p((left**2).sum(axis=-1) / CAUCHY**2).sum() for left in whole])
    alike = np.flatnonzero(losses <= losses.min() + 1.0)  # any instant between two frames is as good
    return forms[int(alike[len(alike) // 2])]
