"""Phones with effects outside the catalogue: synthetic tracks with their own physics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from motion.synthetic_tracks import Recording, Setup
from numpy.typing import NDArray

from virest.capture.imu import ImuSamples
from virest.capture.records import Capture, CaptureMetadata, Frame

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Strange:
    """The unusual effects of a phone; times are on its inertial clock."""

    late_s: Callable[[Array], Array] | None = None
    """Delay of a row's start relative to an even readout, by the fraction of the readout."""
    longer: Callable[[Array], Array] | None = None
    """Relative increase of the focal length, by time."""
    tangential: tuple[float, float] = (0.0, 0.0)
    """p1 and p2 of the lens."""
    gyro: Callable[[Array, Array, Array], Array] | None = None
    """The logged rate, by time, reading and specific force."""
    focus_dioptres: Callable[[Array], Array] | None = None
    late_in_frame_s: Callable[[Array, Array], Array] | None = None
    """Delay of a row's start, by the fraction of the readout and the frame's timestamp."""
    shifted_px: Callable[[Array, Array], Array] | None = None
    """Shift of a point in px, by its position relative to the principal point and by time."""


class StrangePhone(Recording):
    """A recording by an unusual phone, of a distant scene."""

    def __init__(self, setup: Setup, strange: Strange) -> None:
        super().__init__(setup)
        self.strange = strange

    @cached_property
    def imu(self) -> ImuSamples:
        """The log, including the gyroscope's unusual effects."""
        whole = Recording.imu.func(self)  # type: ignore[attr-defined]
        if self.strange.gyro is None:
            return whole
        return replace(whole, gyro_rad_s=self.strange.gyro(whole.time_s, whole.gyro_rad_s, whole.accel_m_s2))

    def seen_s(self, points_px: Array, frame: NDArray[np.intp]) -> Array:
        """Points in delayed rows are seen later."""
        even_s = super().seen_s(points_px, frame)
        fraction = points_px[:, 1] / self.setup.height
        if self.strange.late_in_frame_s is not None:
            even_s = even_s + self.strange.late_in_frame_s(fraction, self.stamp_s[frame])
        return even_s if self.strange.late_s is None else even_s + self.strange.late_s(fraction)

    def _project(self, way: Array, start: Array, inverse: Array, time_s: Array) -> Array:
        setup, (p1, p2) = self.setup, self.strange.tangential
        points_px = super()._project(way, start, inverse, time_s)
        x, y = ((points_px - setup.centre_px) / setup.focal_px).T
        r2 = x * x + y * y
        x, y = x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        longer = 0.0 if self.strange.longer is None else self.strange.longer(time_s)
        arm_px = np.stack([x, y], axis=-1) * setup.focal_px * (1 + np.atleast_1d(longer)[:, None])
        shift = 0.0 if self.strange.shifted_px is None else self.strange.shifted_px(arm_px, time_s)
        return arm_px + shift + setup.centre_px

    @property
    def capture(self) -> Capture:
        """The log as a capture without a movie."""
        focus = self.strange.focus_dioptres
        frames = tuple(
            Frame(k, 0, float(t), float(e), focus_dioptres=None if focus is None else float(focus(np.array(t))))
            for k, (t, e) in enumerate(zip(self.stamp_s, self.exposure_s, strict=True))
        )
        setup = self.setup
        nowhere = Path("nowhere")
        return Capture(
            "strange", nowhere, nowhere, setup.width, setup.height, frames, self.imu, CaptureMetadata(), "REALTIME", 0
        )  # fmt: skip
