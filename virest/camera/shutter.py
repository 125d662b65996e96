"""The shutter: when each row (or column) of the stored picture gathers light (forward_model, section 1; eq 2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.camera.field import Field
from virest.errors import SettingsError

READOUT_DIRECTIONS = ("top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left")
STAMP_FRACTION = {"exposure_start": 0.0, "exposure_middle": 0.5, "exposure_end": 1.0}
"""Fraction of the first row's exposure at which a frame's timestamp lies."""


@dataclass(frozen=True, slots=True)
class Shutter:
    """A rolling shutter."""

    readout_time_s: float = 0.0
    """Start of the first row -> start of one past the last row; 0 is a global shutter."""
    readout_direction: str = "top_to_bottom"
    """In the stored picture; one of READOUT_DIRECTIONS."""
    timestamp: str = "exposure_start"
    """The instant of the first row's exposure that a timestamp marks; a key of STAMP_FRACTION."""
    exposure_scale: float = 1.0
    """True exposure = logged exposure x this."""
    uneven: Field | None = None
    """Delay of the rows' start relative to an even readout; None: the readout is even."""

    def __post_init__(self) -> None:
        if self.readout_direction not in READOUT_DIRECTIONS:
            raise SettingsError(f"readout_direction '{self.readout_direction}' is not one of {READOUT_DIRECTIONS}")
        if self.timestamp not in STAMP_FRACTION:
            raise SettingsError(f"timestamp '{self.timestamp}' is not one of {tuple(STAMP_FRACTION)}")

    @property
    def reads_columns(self) -> bool:
        """Whether the readout runs along x of the stored picture."""
        return self.readout_direction in ("left_to_right", "right_to_left")

    def readout_fraction(self, points_px: NDArray[Any], width: int, height: int) -> Array:
        """Fraction s of the readout time at which pixels (..., 2) start, 0 for the first row read.

        Not clipped, so it is also valid slightly outside the picture.
        """
        even = self.row_fraction(points_px, width, height)
        if self.uneven is None or not self.readout_time_s:
            return even
        return even + self.uneven.at(even)[..., 0] / self.readout_time_s

    def row_fraction(self, points_px: NDArray[Any], width: int, height: int) -> Array:
        """Position of pixels (..., 2) among the rows as a fraction, linear, 0 for the first row read."""
        points = np.asarray(points_px, float)
        match self.readout_direction:
            case "top_to_bottom":
                return points[..., 1] / height
            case "bottom_to_top":
                return 1.0 - (points[..., 1] + 1.0) / height
            case "left_to_right":
                return points[..., 0] / width
            case _:
                return 1.0 - (points[..., 0] + 1.0) / width

    def true_exposure_s(self, logged_exposure_s: Any) -> Any:
        """The sensor's true exposure."""
        return logged_exposure_s * self.exposure_scale

    def first_row_start_s(self, stamp_s: Any, logged_exposure_s: Any) -> Any:
        """Start of the first row's exposure, on the timestamps' clock."""
        fraction = STAMP_FRACTION[self.timestamp]
        return stamp_s if fraction == 0.0 else stamp_s - fraction * self.true_exposure_s(logged_exposure_s)
