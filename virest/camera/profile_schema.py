"""The schema of a profile file: its keys, their types and limits."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from virest.camera.intrinsics import COEFFICIENT_NAMES

MAX_SIDE_PX = 20_000
"""More than the side of any sensor."""
LARGEST = 1e12
"""Upper bound of any value of a profile: clocks of different epochs differ by 2e9 s.  Far larger products overflow."""


def _number(value: Any) -> Any:
    """Accept 1e-3, which YAML 1.1 reads as text; refuse what is not a finite number (inf only where allowed)."""
    if isinstance(value, bool):
        raise ValueError("is true or false, not a number")
    if isinstance(value, str):
        try:
            value = float(value)
        except ValueError:
            raise ValueError("is not a number") from None
    if isinstance(value, int | float) and LARGEST < abs(value) < math.inf:
        raise ValueError("is too large")
    return value


Number = Annotated[float, BeforeValidator(_number), Field(allow_inf_nan=False)]
Depth = Annotated[float, BeforeValidator(_number), Field(gt=0)]
Positive = Annotated[Number, Field(gt=0, lt=1e9)]
Triple = Annotated[list[Number], Field(min_length=3, max_length=3)]
Pair = Annotated[list[Number], Field(min_length=2, max_length=2)]
Misalignment = Annotated[list[Annotated[Number, Field(gt=-0.5, lt=0.5)]], Field(min_length=3, max_length=3)]
"""From 0.5 on, three axes may lie in one plane."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _unknown_is_as_absent(cls, values: Any) -> Any:
        """``null`` under a known key, of a block or a value, means unknown, as if the key were absent."""
        if not isinstance(values, dict):
            return values
        return {key: value for key, value in values.items() if value is not None or key not in cls.model_fields}


class _Image(_Strict):
    width: Annotated[int, Field(ge=16, le=MAX_SIDE_PX)]
    height: Annotated[int, Field(ge=16, le=MAX_SIDE_PX)]


class _Distortion(_Strict):
    model: Literal["none", "radtan", "fisheye"]
    k1: Number = 0.0
    k2: Number = 0.0
    p1: Number = 0.0
    p2: Number = 0.0
    k3: Number = 0.0
    k4: Number = 0.0

    @model_validator(mode="after")
    def _only_own(self) -> _Distortion:
        foreign = {n for n in self.model_fields_set - {"model"} if getattr(self, n)} - set(
            COEFFICIENT_NAMES[self.model]
        )
        if foreign:
            raise ValueError(f"model '{self.model}' has no {', '.join(sorted(foreign))}")
        return self


class _Intrinsics(_Strict):
    fx_px: Positive | None = None
    fy_px: Positive | None = None
    cx_px: Number | None = None
    cy_px: Number | None = None
    distortion: _Distortion | Literal["none"] | None = None


class _Shutter(_Strict):
    readout_time_s: Annotated[Number, Field(ge=0, le=1)] | None = None
    readout_direction: Literal["top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left"] = "right_to_left"
    timestamp: Literal["exposure_start", "exposure_middle", "exposure_end"] = "exposure_start"
    exposure_scale: Annotated[Number, Field(gt=0, le=100)] = 1.0


class _Imu(_Strict):
    T_cam_imu: list[list[Number]] | None = None
    time_offset_s: Annotated[Number, Field(ge=-1e6, le=1e6)] | None = None
    clock_skew: Annotated[Number, Field(gt=-0.5, lt=0.5)] = 0.0
    gyro_bias_rad_s: Triple = [0.0, 0.0, 0.0]
    gyro_scale: Triple = [1.0, 1.0, 1.0]

    @model_validator(mode="after")
    def _rigid(self) -> _Imu:
        if any(s <= 0 for s in self.gyro_scale):
            raise ValueError("gyro_scale must be positive")
        if self.T_cam_imu is None:
            return self
        if len(self.T_cam_imu) not in (3, 4) or any(len(row) != 4 for row in self.T_cam_imu):
            raise ValueError("T_cam_imu must be 4 rows of 4 numbers")
        rotation = np.array(self.T_cam_imu)[:3, :3]
        with np.errstate(over="ignore", invalid="ignore"):  # products of huge entries overflow
            error, determinant = np.abs(rotation @ rotation.T - np.eye(3)).max(), np.linalg.det(rotation)
        if not error <= 1e-2 or determinant < 0:
            raise ValueError(f"T_cam_imu is not a rotation: R Rᵀ is off by {error:.2g}, determinant {determinant:.3g}")
        if len(self.T_cam_imu) == 4 and self.T_cam_imu[3] != [0, 0, 0, 1]:
            raise ValueError("the last row of T_cam_imu must be 0, 0, 0, 1")
        return self


class ResponseBlock(_Strict):
    """The response curve."""

    kind: Literal["linear", "srgb", "gamma", "five_segment", "table"]
    gamma: Positive = 2.2
    b: Pair | None = None
    c: Pair | None = None
    y_max: Number = 1.0
    x: Annotated[list[Number], Field(max_length=4096)] | None = None
    y: Annotated[list[Number], Field(max_length=4096)] | None = None


class _Sensor(_Strict):
    width_mm: Positive | None = None
    height_mm: Positive | None = None
    focal_length_mm: Positive | None = None


class _Scene(_Strict):
    depth_m: Depth | None = None


class _FocalDrift(_Strict):
    focal_drift_per_s: Annotated[Number, Field(ge=-10, le=10)] = 0.0


class _Stabilisation(_Strict):
    fraction: Annotated[Number, Field(ge=-2, le=2)] = 0.0
    cutoff_hz: Positive = 1.0
    travel_rad: Positive | None = None
    at_end: Literal["runs_on", "stops"] = "runs_on"


class _FrameLag(_Strict):
    lag_s: Annotated[Number, Field(ge=0, le=10)] = 0.0
    frames: Annotated[int, Field(ge=0, le=100_000)] = 0


class _Vignetting(_Strict):
    corner_loss: Annotated[Number, Field(gt=-1, lt=1)] = 0.0


class _Flicker(_Strict):
    amplitude: Annotated[Number, Field(ge=0, lt=1)] = 0.0
    frequency_hz: Positive = 100.0
    phase_rad: Number = 0.0


class _Defocus(_Strict):
    sigma_px: Annotated[Number, Field(ge=0, le=100)] = 0.0


class FieldBlock(_Strict):
    """A field of an unknown effect."""

    version: Literal[1, 2] = 1
    kind: Literal["delay", "displacement", "scale", "rate", "gain", "blur"]
    covariates: Annotated[list[str], Field(min_length=1, max_length=2)]
    knots: Annotated[list[Annotated[list[Number], Field(max_length=4096)]], Field(min_length=1, max_length=2)]
    values: Annotated[list[Annotated[list[Number], Field(max_length=3)]], Field(max_length=4096)]
    std: Annotated[list[Annotated[list[Number], Field(max_length=3)]], Field(max_length=4096)] = []
    stamp_0_ns: int | None = None


class ExtensionsBlock(_Strict):
    """Effects that a diagnosis added."""

    focal_drift: _FocalDrift = _FocalDrift()
    stabilisation: _Stabilisation = _Stabilisation()
    frame_lag: _FrameLag = _FrameLag()
    exposures_late_frames: Annotated[int, Field(ge=-10, le=10)] = 0
    exposure_gain: list[Positive] = []
    response_gamma: Positive = 1.0
    black_level: Annotated[Number, Field(ge=0, lt=0.9)] = 0.0
    vignetting: _Vignetting = _Vignetting()
    flicker: _Flicker = _Flicker()
    gain: list[Positive] = []
    defocus: _Defocus = _Defocus()
    gyro_lowpass_hz: Annotated[Number, Field(ge=0, lt=1e6)] = 0.0
    gyro_averaging_s: Annotated[Number, Field(ge=0, lt=1)] = 0.0
    gyro_misalignment_rad: Misalignment = [0.0, 0.0, 0.0]
    field: Annotated[list[FieldBlock], Field(max_length=500)] = []


class _Estimate(_Strict):
    value: Any = None
    std: Any = None
    source: str = ""


class ProfileFile(_Strict):
    """The whole file."""

    virest_profile: Literal[1]
    device: str = ""
    image: _Image
    intrinsics: _Intrinsics = _Intrinsics()
    shutter: _Shutter = _Shutter()
    imu: _Imu = _Imu()
    response: ResponseBlock | None = None
    sensor: _Sensor = _Sensor()
    scene: _Scene = _Scene()
    estimates: dict[str, _Estimate] | None = None
    extensions: ExtensionsBlock | None = None
    imu_untrusted_s: Annotated[list[Pair], Field(max_length=10_000)] = []
    imu_untrusted_stamp_0_ns: int | None = None

    @model_validator(mode="after")
    def _stretches_end_later(self) -> ProfileFile:
        if any(start >= end for start, end in self.imu_untrusted_s):
            raise ValueError("imu_untrusted_s: each stretch must end after it starts")
        return self
