"""Stretches of the inertial log that do not follow the camera: which frames they reach into, and bridges across them.

They are kept out of the ladder, judged by the points that fall into them, and bridged by rates that the points tell:
nought at both ends, smooth between.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from virest.camera.field import AXES, Field
from virest.capture.imu import ImuSamples
from virest.diagnosis.field.forms import FieldForm
from virest.inference.doubtful_log import Stretch
from virest.inference.observed_tracks import ObservedTracks

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
KNOT_STEP_S = 0.03
"""Of a bridge: about a frame, for a frame's points tell little more than its turn."""


def touching(observed: ObservedTracks, stretches: Iterable[Stretch], to_imu: tuple[float, float]) -> Mask:
    """Which pairs (pairs,) reach into a stretch; to_imu: clock rate and offset from the camera's stamps to the log."""
    rate, offset_s = to_imu
    span = 0.05 + float(observed.exposure_s.max(initial=0.0))
    begin = np.array([observed.stamp_s[pair.first] for pair in observed.pairs]) * rate + offset_s
    end = np.array([observed.stamp_s[pair.second] for pair in observed.pairs]) * rate + offset_s + span
    hit = np.zeros(len(observed.pairs), bool)
    for stretch in stretches:
        hit |= (begin < stretch.to_s) & (end > stretch.from_s)
    return hit


def bridging_form(stretches: Iterable[Stretch], stamp_0_ns: int, walk: Array) -> FieldForm:
    """Rates over time within the stretches, nought at their ends, on the axes that are not trusted.

    walk: (3,) rad/s/√s, :func:`rate_walk`.  Beforehand a rate is a Brownian bridge between the ends: what no row sees
    goes straight between what rows see, with the deviation of a hand's turns.
    """
    fields, bases = [], []
    for stretch in stretches:
        lasting_s = stretch.to_s - stretch.from_s
        inner = max(round(lasting_s / KNOT_STEP_S), 1)
        time_s = np.linspace(0.0, lasting_s, inner + 2)[1:-1]
        bridge = np.minimum.outer(time_s, time_s) - np.outer(time_s, time_s) / lasting_s
        axes = list(stretch.axes)
        knots = tuple(float(t) for t in np.round(np.linspace(stretch.from_s, stretch.to_s, inner + 2), 6))
        fields.append(Field("rate", ("time",), (knots,), ((0.0,) * 3,) * len(knots), (), stamp_0_ns))
        at_knots = np.eye(len(knots))[:, 1:-1] @ np.linalg.cholesky(bridge)
        bases.append(np.kron(at_knots, np.diag(walk)[:, axes]))
    return FieldForm(tuple(fields), block_diag(*bases))


def rate_walk(imu: ImuSamples) -> Array:
    """How far each axis' rate (3,) walks in a bridge's step, rad/s/√s: root mean square over the whole log."""
    time_s = imu.time_s[imu.time_s <= imu.time_s[-1] - KNOT_STEP_S]
    later = np.stack([np.interp(time_s + KNOT_STEP_S, imu.time_s, rate) for rate in imu.gyro_rad_s.T], axis=-1)
    return np.asarray(np.sqrt(np.mean((later - imu.gyro_rad_s[: len(time_s)]) ** 2, axis=0) / KNOT_STEP_S))


def axis_names(stretches: Iterable[Stretch]) -> str:
    """The axes of some stretches, as people read them."""
    axes = sorted({axis for stretch in stretches for axis in stretch.axes})
    return ", ".join(AXES[axis] for axis in axes)
