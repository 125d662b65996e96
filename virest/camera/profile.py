"""The camera profile: everything known about one phone, as records.

``None`` means unknown: the value is then estimated from the capture where possible.  Read and written by
:mod:`virest.camera.profile_file`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from virest.arrays import Array
from virest.camera.field import Field as ModelField
from virest.camera.intrinsics import Intrinsics
from virest.camera.response import ResponseCurve
from virest.camera.shutter import Shutter
from virest.errors import SettingsError

BRIDGE_SLACK_S = 1e-3
"""Largest distance between the ends of a bridge and its stretch, which are rounded separately."""
ANDROID_R_CAM_IMU = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
"""Rotation from the device axes to the stored portrait picture of an Android phone's rear camera."""
LANDSCAPE_R_CAM_IMU = ((0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0))
"""The same for a stored landscape picture, whose rows are those of the sensor."""
OPEN_IMU = {"clock_skew": 0.0, "gyro_bias_rad_s": (0.0, 0.0, 0.0), "gyro_scale": (1.0, 1.0, 1.0)}
"""Values of the imu block that have a default and that tracked points determine, with that default."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """An estimated value with its standard deviation and source."""

    value: float | list[float] | str
    std: float | list[float] | None
    source: str


RUNS_ON, STOPS = "runs_on", "stops"
"""At the end of its travel a lens waits until the filter, which runs on, has come back; or the filter stops too, and
the lens follows as soon as the camera turns back."""


@dataclass(frozen=True, slots=True)
class Extensions:
    """Effects that a diagnosis added to the nominal model (contract, section 4); off by default."""

    focal_drift_per_s: float = 0.0
    stabilisation_fraction: float = 0.0
    stabilisation_cutoff_hz: float = 1.0
    frame_lag_s: float = 0.0
    frame_lag_frames: int = 0
    vignetting_corner_loss: float = 0.0
    flicker_amplitude: float = 0.0
    flicker_frequency_hz: float = 100.0
    flicker_phase_rad: float = 0.0
    gain: tuple[float, ...] = ()
    defocus_sigma_px: float = 0.0
    gyro_lowpass_hz: float = 0.0
    """Cutoff of the gyroscope's own low pass (:mod:`virest.camera.gyro_filter`); 0: none."""
    gyro_averaging_s: float = 0.0
    """Standard deviation of the time over which the gyroscope averages, beyond the low pass; 0: none."""
    gyro_misalignment_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """xy, xz, yz: part of an axis's rate that the other axis of the pair reads too; 0 where they are perpendicular."""
    exposures_late_frames: int = 0
    """Rows by which exposure times and ISO values are logged late: frame k's are in row k + this many."""
    exposure_gain: tuple[float, ...] = ()
    """Factors on the logged exposure times of frames, by movie index; 1 where the list has none."""
    stabilisation_travel_rad: float | None = None
    """Largest shift of the lens along each axis, as an angle; None: it never reaches an end."""
    stabilisation_at_end: str = RUNS_ON
    """Whether the stabiliser's filter runs on beyond the ends, or stops there."""
    stabilisation_lean_rad: tuple[float, float] = (0.0, 0.0)
    """θ about x and y at the start of the inertial log; fitted but not stored in files: its effect decays soon."""
    field: tuple[ModelField, ...] = ()
    """Fields other than those that the shutter and the lens hold."""

    def gain_of(self, frames: ArrayLike) -> Array:
        """Factors on the light of frames, by movie index; 1 where the list has none."""
        return _by_frame(self.gain, frames)

    def exposure_gain_of(self, frames: ArrayLike) -> Array:
        """Factors on the logged exposure times of frames, by movie index."""
        return _by_frame(self.exposure_gain, frames)


def _by_frame(values: tuple[float, ...], frames: ArrayLike) -> Array:
    """Values of frames, by movie index; 1 beyond the list."""
    return np.append(values, 1.0)[np.minimum(frames, len(values))]


@dataclass(frozen=True, slots=True)
class CameraProfile:
    """One phone's camera and IMU. ``None``: unknown."""

    width: int
    height: int
    device: str = ""
    intrinsics: Intrinsics | None = None
    """None while the focal length is unknown."""
    shutter: Shutter = field(default_factory=Shutter)
    readout_known: bool = True
    """False if the profile has ``readout_time_s: null``; the shutter then holds 0."""
    r_cam_imu: tuple[tuple[float, ...], ...] = ANDROID_R_CAM_IMU
    """Rotation, x_cam = r_cam_imu @ x_imu."""
    axes_known: bool = True
    """False if the rotation is a default that nothing states."""
    p_cam_imu_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Last column of T_cam_imu: the IMU's origin in camera axes, metres."""
    time_offset_s: float | None = None
    clock_skew: float = 0.0
    gyro_bias_rad_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gyro_scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """measured = scale x true + bias."""
    open_imu: tuple[str, ...] = ()
    """Those of OPEN_IMU that the profile gives as ``null``: they hold the default, and ``diagnose`` fits them."""
    response: ResponseCurve | None = None
    """None: unknown; sRGB is then used, with a warning. Holds the extensions response_gamma and black_level."""
    sensor_width_mm: float | None = None
    sensor_height_mm: float | None = None
    focal_length_mm: float | None = None
    depth_m: float | None = None
    """None: to be triangulated; inf: rotation only."""
    estimates: dict[str, Estimate] = field(default_factory=dict)
    extensions: Extensions = field(default_factory=Extensions)
    imu_untrusted_s: tuple[tuple[float, float], ...] = ()
    """Stretches (from, to) of the inertial log, from stamp_0, that do not follow the camera."""
    imu_untrusted_stamp_0_ns: int | None = None
    """First stamp of the only capture that these stretches belong to; None: any."""
    lens_shape: Intrinsics | None = None
    """Principal point and distortion if known without the focal length; its own focal length is nominal."""

    @property
    def curve(self) -> ResponseCurve:
        """The response curve; sRGB if it is unknown."""
        return self.response or ResponseCurve("srgb")

    def with_curve(self, **changes: Any) -> CameraProfile:
        """The profile with values of its curve replaced."""
        return replace(self, response=replace(self.curve, **changes))

    def with_shutter(self, **changes: Any) -> CameraProfile:
        """The profile with values of its shutter replaced."""
        return replace(self, shutter=replace(self.shutter, **changes))

    def with_extensions(self, **changes: Any) -> CameraProfile:
        """The profile with values of its extensions replaced."""
        return replace(self, extensions=replace(self.extensions, **changes))

    @property
    def fields(self) -> tuple[ModelField, ...]:
        """All fields: the shutter's, the lens's and the extensions'."""
        lens = self.intrinsics
        own = (self.shutter.uneven, None if lens is None else lens.displaced)
        return (*(f for f in own if f is not None), *self.extensions.field)

    @property
    def unbridged_s(self) -> tuple[tuple[float, float], ...]:
        """Untrusted stretches of the inertial log that no field of the rate over time bridges."""
        return tuple(span for span in self.imu_untrusted_s if not self.bridges(*span))

    def bridges(self, from_s: float, to_s: float) -> bool:
        """Whether a field of the rate over time bridges exactly this stretch of the inertial log."""
        knots = (field.knots[0] for field in self.over_time("rate"))
        return any(max(abs(k[0] - from_s), abs(k[-1] - to_s)) < BRIDGE_SLACK_S for k in knots)

    def over_time(self, kind: str) -> tuple[ModelField, ...]:
        """Fields of a kind over time alone: ``delay`` of whole frames; ``rate``, a bridge or a bias that drifts."""
        return tuple(f for f in self.extensions.field if (f.kind, f.covariates) == (kind, ("time",)))

    def with_fields(self, fields: Sequence[ModelField]) -> CameraProfile:
        """The profile with exactly these fields. Raises SettingsError for two fields of a kind that must be unique."""
        held: dict[str, list[ModelField]] = {"delay": [], "displacement": [], "": []}
        for entry in fields:
            held[entry.kind if entry.is_single else ""].append(entry)
        if max(len(held["delay"]), len(held["displacement"])) > 1:
            raise SettingsError(
                "extensions.field: at most one delay over the row and one displacement", hint="add up their values"
            )
        uneven, displaced = (next(iter(held[kind]), None) for kind in ("delay", "displacement"))
        lens = self.intrinsics
        if lens is None and displaced is not None:
            raise SettingsError("extensions.field: a displacement needs a focal length", hint="set intrinsics.fx_px")
        return (
            replace(
                self,
                intrinsics=None if lens is None else replace(lens, displaced=displaced),
            )
            .with_shutter(uneven=uneven)
            .with_extensions(field=tuple(held[""]))
        )

    @property
    def rotation_cam_imu(self) -> Array:
        """R_cam_imu, (3, 3)."""
        return np.array(self.r_cam_imu)

    @property
    def gyro_correction(self) -> Array:
        """(3, 3) true rates per reading less bias: the inverse of S (I + Γ), S the scales and Γ the misalignment."""
        xy, xz, yz = self.extensions.gyro_misalignment_rad
        axes = np.array([[1.0, xy, xz], [xy, 1.0, yz], [xz, yz, 1.0]])
        return np.asarray(np.linalg.inv(np.array(self.gyro_scale)[:, None] * axes))

    def true_rate_rad_s(self, reading_rad_s: Array) -> Array:
        """Rates (n, 3) of readings (n, 3), IMU axes, corrected for bias, scale and misalignment."""
        return np.asarray((reading_rad_s - np.array(self.gyro_bias_rad_s)) @ self.gyro_correction.T)

    @property
    def pose_cam_imu(self) -> Array:
        """T_cam_imu, (4, 4): x_cam = T_cam_imu x_imu, metres."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.r_cam_imu, self.p_cam_imu_m
        return pose

    def imu_time_s(self, camera_time_s: Any) -> Any:
        """IMU clock of a camera time, both in seconds from stamp_0: t_cam (1 + clock_skew) + time_offset_s.

        Fields of delay over time are added.  An unknown offset counts as 0.
        """
        even_s = camera_time_s * (1.0 + self.clock_skew) + (self.time_offset_s or 0.0)
        return even_s + self._late_s(camera_time_s)

    def camera_time_s(self, imu_time_s: Any) -> Any:
        """Camera clock of an IMU time: the inverse of :meth:`imu_time_s`."""
        found = even_s = (imu_time_s - (self.time_offset_s or 0.0)) / (1.0 + self.clock_skew)
        for _ in range(3 if self.over_time("delay") else 0):
            found = even_s - self._late_s(found) / (1.0 + self.clock_skew)
        return found

    def _late_s(self, camera_time_s: Any) -> Any:
        late = [f.at_time(camera_time_s)[..., 0] for f in self.over_time("delay")]
        return sum(late) if late else 0.0

    def with_estimate(self, name: str, value: Any, std: Any, source: str, **changes: Any) -> CameraProfile:
        """The profile with changes, recorded as an estimate with its source."""
        estimates = {**self.estimates, name: Estimate(value, std, source)}
        still_open = tuple(key for key in self.open_imu if key != name)
        return replace(self, estimates=estimates, open_imu=still_open, **changes)

    def with_focal(self, focal_px: float, std_px: float, source: str) -> CameraProfile:
        """The profile with an estimated focal length and square pixels."""
        return self.with_estimate("fx_px", focal_px, std_px, source, intrinsics=self.lens_of(focal_px))

    def lens_of(self, fx_px: float, fy_px: float | None = None) -> Intrinsics:
        """A lens of this focal length, with the known principal point and distortion, or the centre and none."""
        fy_px = fx_px if fy_px is None else fy_px
        if self.lens_shape is not None:
            return replace(self.lens_shape, fx_px=fx_px, fy_px=fy_px)
        return Intrinsics(self.width, self.height, fx_px, fy_px, (self.width - 1) / 2, (self.height - 1) / 2)
