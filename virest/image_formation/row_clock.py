"""The row clock: when a row of a frame is exposed (forward_model, section 1).

A row that starts at the fraction s of the readout, 0 for the first row read, reaches the fraction h of its exposure
at t = t_first_row + s · readout + h · exposure.  t_first_row follows from the frame's timestamp by the clock offset and
skew; readout and true exposure are the profile's, in seconds of the IMU clock.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.camera.field import Field
from virest.camera.profile import CameraProfile

ROW_START, ROW_MIDDLE, ROW_END = 0.0, 0.5, 1.0
"""Fractions of an exposure."""
ROWS = np.linspace(0.0, 1.0, 41)
"""Fractions of the readout at which one frame's delays are tabulated: the most knots of a field over rows."""


def row_time_s(
    first_row_s: Any, readout_time_s: Any, readout_fraction: Any, exposure_s: Any = 0.0, exposure_share: Any = 0.0
) -> Any:
    """Time at which rows that start at a fraction of the readout reach a share of their exposure; shapes broadcast.

    first_row_s: start of the first row's exposure.  exposure_s: true, not logged.
    """
    return first_row_s + readout_fraction * readout_time_s + exposure_share * exposure_s


def of_frame(profile: CameraProfile, stamp_s: float, logged_exposure_s: float) -> CameraProfile:
    """The profile with the readout and defocus of one frame, if these change from frame to frame."""
    blurs = [f for f in profile.extensions.field if f.kind == "blur" and f.covariates != ("radius",)]
    if blurs:
        even = profile.extensions.defocus_sigma_px
        sigma_px = float(np.hypot.reduce([even, *(float(field.at_time(stamp_s)[0]) for field in blurs)]))
        profile = profile.with_extensions(defocus_sigma_px=sigma_px)
        profile = profile.with_fields([field for field in profile.fields if field not in blurs])
    changing, shutter = _changing_rows(profile), profile.shutter
    if not changing:
        return profile
    begin_s = shutter.first_row_start_s(stamp_s, logged_exposure_s)
    late = np.zeros((len(ROWS), 1)) if shutter.uneven is None else shutter.uneven.at(ROWS)
    fraction = ROWS + late[:, 0] / (shutter.readout_time_s or 1.0)
    late = late + sum(field.at(fraction, _per_frame(field, begin_s, logged_exposure_s)) for field in changing)
    rows = Field("delay", ("row",), (tuple(ROWS.tolist()),), tuple(map(tuple, late.tolist())))
    others = [field for field in profile.fields if field not in changing and field != shutter.uneven]
    return profile.with_fields([*others, rows])


def _changing_rows(profile: CameraProfile) -> list[Field]:
    return [f for f in profile.extensions.field if f.kind == "delay" and f.is_pair]


def _per_frame(field: Field, begin_s: Any, logged_exposure_s: Any) -> Any:
    """A frame's value of the second covariate of rows whose delay changes."""
    return begin_s if field.covariates[1] == "time" else logged_exposure_s


@dataclass(frozen=True, slots=True)
class RowClock:
    """The row clock of a profile; an unknown offset counts as 0, an unknown exposure is passed as 0.

    All methods take arrays and floats that broadcast.  Timestamps are on the camera's clock, from stamp_0.
    """

    profile: CameraProfile

    def readout_fraction(self, points_px: NDArray[Any]) -> Array:
        """Fraction (...) of the readout at which the rows through pixels (..., 2) start; the readout may be uneven."""
        return self.profile.shutter.readout_fraction(points_px, self.profile.width, self.profile.height)

    def time_s(
        self, stamp_s: Any, logged_exposure_s: Any, readout_fraction: Any = 0.0, exposure_share: Any = ROW_START
    ) -> Any:
        """IMU time at which rows that start at a fraction of the readout reach a share of their exposure."""
        shutter = self.profile.shutter
        begin_s = shutter.first_row_start_s(stamp_s, logged_exposure_s)
        first_row_s = self.profile.imu_time_s(begin_s)
        for field in _changing_rows(self.profile):
            second = _per_frame(field, begin_s, logged_exposure_s)
            first_row_s = first_row_s + field.at(readout_fraction, second)[..., 0]
        exposure_s = shutter.true_exposure_s(logged_exposure_s)
        return row_time_s(first_row_s, shutter.readout_time_s, readout_fraction, exposure_s, exposure_share)

    def start_on_camera_s(self, stamp_s: Any, logged_exposure_s: Any) -> Any:
        """Start of a frame's first row, camera clock: the time at which fields of delay over time apply."""
        return self.profile.shutter.first_row_start_s(stamp_s, logged_exposure_s)

    def seen_s(
        self, points_px: NDArray[Any], stamp_s: Any, logged_exposure_s: Any, exposure_share: Any = ROW_MIDDLE
    ) -> Array:
        """IMU time (...) at which frames see pixels (..., 2): at a share of the exposure of the pixels' rows."""
        fraction = self.readout_fraction(points_px)
        return np.asarray(self.time_s(stamp_s, logged_exposure_s, fraction, exposure_share), float)

    def middle_s(self, stamp_s: Any, logged_exposure_s: Any) -> Any:
        """IMU time in the middle of a frame: of the exposure of the row halfway through the readout."""
        return self.time_s(stamp_s, logged_exposure_s, 0.5, ROW_MIDDLE)

    def end_s(self, stamp_s: Any, logged_exposure_s: Any) -> Any:
        """IMU time at which the row after the last one would end its exposure."""
        return self.time_s(stamp_s, logged_exposure_s, 1.0, ROW_END)

    def camera_time_s(self, imu_time_s: Any) -> Any:
        """Camera clock of an IMU time: the inverse of :meth:`CameraProfile.imu_time_s`."""
        return self.profile.camera_time_s(imu_time_s)


def right_way_round(profile: CameraProfile) -> CameraProfile:
    """Convert a negative readout to a positive one in the opposite direction: t₀' = t₀ + r (1 − 1 / rows)."""
    shutter = profile.shutter
    if shutter.readout_time_s >= 0:
        return profile
    opposite = {
        "top_to_bottom": "bottom_to_top",
        "bottom_to_top": "top_to_bottom",
        "left_to_right": "right_to_left",
        "right_to_left": "left_to_right",
    }[shutter.readout_direction]
    rows = profile.width if shutter.reads_columns else profile.height
    moved = row_time_s(0.0, shutter.readout_time_s, 1 - 1 / rows)
    other = profile.with_shutter(readout_time_s=-shutter.readout_time_s, readout_direction=opposite)
    return replace(other, time_offset_s=(profile.time_offset_s or 0.0) + moved)


def as_global_shutter(profile: CameraProfile, direction: str) -> CameraProfile:
    """A global shutter at the time of the middle row: the start of a fit for a readout of either sign."""
    middle_s = (profile.time_offset_s or 0.0) + row_time_s(0.0, profile.shutter.readout_time_s, 0.5)
    bare = profile.with_shutter(readout_time_s=0.0, readout_direction=direction, uneven=None)
    return replace(bare, time_offset_s=middle_s)
