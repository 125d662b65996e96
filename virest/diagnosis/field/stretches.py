"""Intervals of the inertial log that do not follow the camera: the frames they affect, and bridges across them.

They are excluded from the ladder, tested with the points inside them, and bridged by rates estimated from these
points.  A bridge is 0 at both ends and smooth in between.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from scipy.linalg import block_diag

from virest.camera.field import AXES
from virest.capture.imu import ImuSamples
from virest.diagnosis.field.forms import FieldForm
from virest.inference.doubtful_log import Stretch
from virest.inference.log_bridges import expected_bridge


def bridging_form(stretches: Sequence[Stretch], stamp_0_ns: int, imu: ImuSamples) -> FieldForm:
    """Rates over time within the intervals, 0 at their ends, on the untrusted axes; their prior is the expected one."""
    bridges = [expected_bridge(imu, stretch, stretches, stamp_0_ns) for stretch in stretches]
    fields = tuple(replace(bridge.field, std=()) for bridge in bridges)
    return FieldForm(fields, block_diag(*(bridge.root.reshape(-1, bridge.root.shape[-1]) for bridge in bridges)))


def axis_names(stretches: Iterable[Stretch]) -> str:
    """Readable names of the axes of some intervals."""
    axes = sorted({axis for stretch in stretches for axis in stretch.axes})
    return ", ".join(AXES[axis] for axis in axes)
