"""The camera profile: everything known about one phone, read from and written to YAML (contract, section 3).

Strict: an unknown key is an error that names its nearest neighbour.  ``null`` means unknown; what can be estimated
from a capture then is.  Records inside are frozen; the pydantic models stand only at the edge.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from virest.camera.field import Field as ModelField
from virest.camera.intrinsics import COEFFICIENT_NAMES, Intrinsics
from virest.camera.response import ResponseCurve
from virest.camera.shutter import Shutter
from virest.errors import SettingsError

MAX_PROFILE_BYTES = 1_000_000
MAX_SIDE_PX = 20_000
MAX_DEPTH = 20
BRIDGE_SLACK_S = 1e-3
"""A bridge may end this far from its stretch, as either is rounded."""
LARGEST = 1e12
"""No value of a profile is larger: between clocks of different epochs lie 2e9 s.  Far beyond, products overflow."""
OPENCV_HEAD = re.compile(r"\A\ufeff?%YAML:1\.0[^\n]*")
"""First line of OpenCV's files, which is no YAML directive."""
MAX_DIGITS = 250
"""No number of this many digits, be it hexadecimal or of base 60, is beyond a float or what Python writes out."""
NUMERIC = re.compile(r"[-+]?[\d.][\dA-Fa-fxXoO_:.+-]*")
ANDROID_R_CAM_IMU = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
"""Stored portrait picture of an Android phone's rear camera against the device axes."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value that was found in data, with what it is worth."""

    value: float | list[float] | str
    std: float | list[float] | None
    source: str


@dataclass(frozen=True, slots=True)
class Extensions:
    """What a diagnosis added to the nominal model (contract, section 4); the defaults are off."""

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
    stabilisation_lean_rad: tuple[float, float] = (0.0, 0.0)
    """θ about x and y with which the inertial log begins; fitted on the way, and in no file: it is soon forgotten."""
    field: tuple[ModelField, ...] = ()
    """Fields of kind ``scale`` and ``rate``; the shutter and the lens hold theirs."""


@dataclass(frozen=True, slots=True)
class CameraProfile:
    """One phone. ``None`` stands for unknown."""

    width: int
    height: int
    device: str = ""
    intrinsics: Intrinsics | None = None
    """None while the focal length is unknown."""
    shutter: Shutter = field(default_factory=Shutter)
    readout_known: bool = True
    """False where the profile says ``readout_time_s: null``; the shutter then holds 0."""
    r_cam_imu: tuple[tuple[float, ...], ...] = ANDROID_R_CAM_IMU
    """Rotation, x_cam = r_cam_imu @ x_imu."""
    p_cam_imu_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Last column of T_cam_imu: the IMU's origin in camera axes, metres."""
    time_offset_s: float | None = None
    clock_skew: float = 0.0
    gyro_bias_rad_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gyro_scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """measured = scale x true + bias."""
    response: ResponseCurve | None = None
    """None while unknown; sRGB then stands in, with a warning. Holds the extensions response_gamma, black_level."""
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
    """Principal point and distortion where these are known and the focal length is not: its focal length is nominal."""

    @property
    def fields(self) -> tuple[ModelField, ...]:
        """All fields: the shutter's, the lens's and the extensions'."""
        lens = self.intrinsics
        own = (self.shutter.uneven, None if lens is None else lens.displaced)
        return (*(f for f in own if f is not None), *self.extensions.field)

    @property
    def unbridged_s(self) -> tuple[tuple[float, float], ...]:
        """Untrusted stretches of the inertial log that no field of the rate over their time bridges."""
        return tuple(span for span in self.imu_untrusted_s if not self.bridges(*span))

    def bridges(self, from_s: float, to_s: float) -> bool:
        """Whether a field of the rate over time bridges just this stretch of the inertial log."""
        knots = [f.knots[0] for f in self.extensions.field if f.kind == "rate" and f.covariates == ("time",)]
        return any(max(abs(k[0] - from_s), abs(k[-1] - to_s)) < BRIDGE_SLACK_S for k in knots)

    def with_fields(self, fields: Sequence[ModelField]) -> CameraProfile:
        """The profile with these fields and no others. Raises SettingsError for two of a kind of which one is held."""
        held: dict[str, list[ModelField]] = {"delay": [], "displacement": [], "": []}
        for entry in fields:
            held[entry.kind if entry.is_single else ""].append(entry)
        if max(len(held["delay"]), len(held["displacement"])) > 1:
            raise SettingsError(
                "extensions.field: one delay over the row and one displacement at most", hint="add their values up"
            )
        if any((f.kind, f.covariates) == ("blur", ("radius",)) for f in fields):
            raise SettingsError("extensions.field: blur over the radius is not followed", hint="leave the entry out")
        uneven, displaced = (next(iter(held[kind]), None) for kind in ("delay", "displacement"))
        lens = self.intrinsics
        if lens is None and displaced is not None:
            raise SettingsError("extensions.field: a displacement needs a focal length", hint="set intrinsics.fx_px")
        return replace(
            self,
            shutter=replace(self.shutter, uneven=uneven),
            intrinsics=None if lens is None else replace(lens, displaced=displaced),
            extensions=replace(self.extensions, field=tuple(held[""])),
        )

    @property
    def rotation_cam_imu(self) -> NDArray[np.float64]:
        """R_cam_imu, (3, 3)."""
        return np.array(self.r_cam_imu)

    def imu_time_s(self, camera_time_s: Any) -> Any:
        """IMU clock of a camera time, both in seconds from stamp_0: t_cam (1 + clock_skew) + time_offset_s.

        Fields of delay over time are added.  An unknown offset counts as 0.
        """
        even_s = camera_time_s * (1.0 + self.clock_skew) + (self.time_offset_s or 0.0)
        return even_s + self._late_s(camera_time_s)

    def camera_time_s(self, imu_time_s: Any) -> Any:
        """Camera clock of an IMU time: the inverse of :meth:`imu_time_s`."""
        found = even_s = (imu_time_s - (self.time_offset_s or 0.0)) / (1.0 + self.clock_skew)
        for _ in range(3 if self._wanders else 0):
            found = even_s - self._late_s(found) / (1.0 + self.clock_skew)
        return found

    @property
    def _wanders(self) -> list[ModelField]:
        """Delays over time alone: of whole frames."""
        return [f for f in self.extensions.field if (f.kind, f.covariates) == ("delay", ("time",))]

    def _late_s(self, camera_time_s: Any) -> Any:
        late = [f.at_time(camera_time_s)[..., 0] for f in self._wanders]
        return sum(late) if late else 0.0

    def with_estimate(self, name: str, value: Any, std: Any, source: str, **changes: Any) -> CameraProfile:
        """The profile with fields changed and the change's origin noted."""
        return replace(self, estimates={**self.estimates, name: Estimate(value, std, source)}, **changes)

    def with_focal(self, focal_px: float, std_px: float, source: str) -> CameraProfile:
        """The profile with an estimated focal length and square pixels."""
        return self.with_estimate("fx_px", focal_px, std_px, source, intrinsics=self.lens_of(focal_px))

    def lens_of(self, fx_px: float, fy_px: float | None = None) -> Intrinsics:
        """A lens of this focal length; principal point and distortion as known, or the middle and none."""
        fy_px = fx_px if fy_px is None else fy_px
        if self.lens_shape is not None:
            return replace(self.lens_shape, fx_px=fx_px, fy_px=fy_px)
        return Intrinsics(self.width, self.height, fx_px, fy_px, (self.width - 1) / 2, (self.height - 1) / 2)


# ── the YAML edge ────────────────────────────────────────────────────────────────────────────────────────────────


def _number(value: Any) -> Any:
    """YAML 1.1 reads 1e-3 as text; accept it, and refuse what is no finite number (inf only where asked for)."""
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


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _unknown_is_as_absent(cls, values: Any) -> Any:
        """``null`` under a known key, a block's or a value's, means unknown, as if the key were not there."""
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
        with np.errstate(over="ignore", invalid="ignore"):  # rows so long that their products are no numbers
            error, determinant = np.abs(rotation @ rotation.T - np.eye(3)).max(), np.linalg.det(rotation)
        if not error <= 1e-2 or determinant < 0:
            raise ValueError(f"T_cam_imu is no rotation: R Rᵀ is off by {error:.2g}, determinant {determinant:.3g}")
        if len(self.T_cam_imu) == 4 and self.T_cam_imu[3] != [0, 0, 0, 1]:
            raise ValueError("the last row of T_cam_imu must be 0, 0, 0, 1")
        return self


class _Response(_Strict):
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


class _Field(_Strict):
    version: Literal[1, 2] = 1
    kind: Literal["delay", "displacement", "scale", "rate", "gain", "blur"]
    covariates: Annotated[list[str], Field(min_length=1, max_length=2)]
    knots: Annotated[list[Annotated[list[Number], Field(max_length=200)]], Field(min_length=1, max_length=2)]
    values: Annotated[list[Annotated[list[Number], Field(max_length=3)]], Field(max_length=4096)]
    std: Annotated[list[Annotated[list[Number], Field(max_length=3)]], Field(max_length=4096)] = []
    stamp_0_ns: int | None = None


class _Extensions(_Strict):
    focal_drift: _FocalDrift = _FocalDrift()
    stabilisation: _Stabilisation = _Stabilisation()
    frame_lag: _FrameLag = _FrameLag()
    response_gamma: Positive = 1.0
    black_level: Annotated[Number, Field(ge=0, lt=0.9)] = 0.0
    vignetting: _Vignetting = _Vignetting()
    flicker: _Flicker = _Flicker()
    gain: list[Positive] = []
    defocus: _Defocus = _Defocus()
    gyro_lowpass_hz: Annotated[Number, Field(ge=0, lt=1e6)] = 0.0
    field: Annotated[list[_Field], Field(max_length=500)] = []


class _Estimate(_Strict):
    value: Any = None
    std: Any = None
    source: str = ""


class _Profile(_Strict):
    virest_profile: Literal[1]
    device: str = ""
    image: _Image
    intrinsics: _Intrinsics = _Intrinsics()
    shutter: _Shutter = _Shutter()
    imu: _Imu = _Imu()
    response: _Response | None = None
    sensor: _Sensor = _Sensor()
    scene: _Scene = _Scene()
    estimates: dict[str, _Estimate] | None = None
    extensions: _Extensions | None = None
    imu_untrusted_s: Annotated[list[Pair], Field(max_length=10_000)] = []
    imu_untrusted_stamp_0_ns: int | None = None

    @model_validator(mode="after")
    def _stretches_end_later(self) -> _Profile:
        if any(start >= end for start, end in self.imu_untrusted_s):
            raise ValueError("imu_untrusted_s: each stretch must end after it starts")
        return self


def read_profile(path: Path) -> CameraProfile:
    """Read a profile file. Raises SettingsError with the file, the key, and the nearest known key."""
    return parse_profile(load_yaml_mapping(path), path.name)


def load_yaml_mapping(path: Path) -> dict[str, Any]:
    """A YAML file whose top level is a mapping, by ``safe_load``, aliases refused. Raises SettingsError."""
    try:
        if not path.is_file():
            what = "is not a regular file" if path.exists() else "no such file"
            raise SettingsError(f"{path}: {what}", hint="pass a YAML file")
        size = path.stat().st_size
        if size > MAX_PROFILE_BYTES:
            raise SettingsError(f"{path.name}: {size} bytes, more than {MAX_PROFILE_BYTES}", hint="is it a profile?")
        text = OPENCV_HEAD.sub("", path.read_text(encoding="utf-8"), count=1)
        _require_plain(text, path.name)
        _require_keys_once(yaml.compose(text, Loader=yaml.SafeLoader), path.name)
        content = yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "cannot be read"
        raise SettingsError(f"{path.name}:{where} is not plain YAML: {problem}", hint="see docs/profile.md") from None
    except (UnicodeDecodeError, RecursionError):
        raise SettingsError(f"{path.name}: is not YAML text", hint="is it a profile?") from None
    except (ValueError, LookupError, AttributeError, OverflowError):  # of the library, for dates and tagged values
        text = f"{path.name}: a value is not of the kind that it is written as, such as a date that is none"
        raise SettingsError(text, hint="write plain numbers and words, see docs/profile.md") from None
    except OSError as error:
        raise SettingsError(f"{path}: {error.strerror}", hint="check the path and its permissions") from None
    if not isinstance(content, dict):
        raise SettingsError(f"{path.name}: no keys at the top level", hint="see docs/profile.md")
    return content


def _require_plain(text: str, name: str) -> None:
    """Refuse aliases, deep nesting and endless numbers before anything is built of them."""
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            raise SettingsError(f"{name}: YAML aliases are not accepted", hint="write the values out")
        if isinstance(event, yaml.ScalarEvent) and len(event.value) > MAX_DIGITS and NUMERIC.fullmatch(event.value):
            shown = f"{event.value[:20]}…"
            raise SettingsError(f"{name}: {shown} has {len(event.value)} digits", hint=f"at most {MAX_DIGITS} are read")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH:
            raise SettingsError(f"{name}: nested more than {MAX_DEPTH} deep", hint="is it a profile?")


def _require_keys_once(node: yaml.Node | None, name: str) -> None:
    """Refuse a key that stands twice in one block: the last would hold, and nobody would know."""
    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _require_keys_once(item, name)
    if not isinstance(node, yaml.MappingNode):
        return
    seen: set[str] = set()
    for key, value in node.value:
        if isinstance(key, yaml.ScalarNode):
            if key.value in seen:
                shown = _printable(key.value[:60])
                line = key.start_mark.line + 1
                raise SettingsError(f"{name}: line {line}: '{shown}' is written a second time", hint="keep one of them")
            seen.add(key.value)
        _require_keys_once(value, name)


def parse_profile(content: dict[str, Any], name: str = "profile") -> CameraProfile:
    """Build a profile from the YAML's mapping; ``name`` is used in messages."""
    try:
        model = _Profile.model_validate(content)
    except ValidationError as error:
        raise explain_validation(error, _Profile, name) from None
    try:
        return _from_model(model)
    except SettingsError as error:
        raise SettingsError(f"{name}: {error.message}", hint=error.hint) from None


def require_usable(profile: CameraProfile, name: str = "profile") -> None:
    """Hold a profile that was built in memory to what a file must keep. Raises SettingsError with the key."""
    parse_profile(profile_mapping(profile), name)


def explain_validation(error: ValidationError, model: type[BaseModel], name: str) -> SettingsError:
    """One line for the first fault of a pydantic validation, with the nearest known key for an unknown one."""
    first = next((e for e in error.errors() if e["type"] == "extra_forbidden"), error.errors()[0])
    path = _key_path(first)
    where = _printable(".".join(path))
    if first["type"] == "extra_forbidden":
        known = _keys_at(model, path[:-1])
        near = _nearest(path[-1], known)
        hint = f"did you mean '{near}'?" if near else f"known keys: {', '.join(known)}"
        return SettingsError(f"{name}: unknown key '{where[:80]}', {hint}")
    found = first.get("input")
    value = "" if isinstance(found, dict) else ", got null" if found is None else f", got {str(found)[:60]!r}"
    message = _printable(first["msg"].removeprefix("Value error, ").split(" or instance of")[0])[:200]
    return SettingsError(f"{name}: {where or 'top level'}: {message}{value}", hint="see docs/profile.md")


def _key_path(fault: Any) -> list[str]:
    """Where a fault of pydantic lies: its keys, without the names of the forms that pydantic tried between them."""
    *above, last = map(str, fault["loc"] or ("",))
    forms = ("_", "literal", "function-", "constrained")
    is_key = last and not last.startswith(forms)
    keys = [part for part in above if not part.startswith(forms)]
    return [*keys, last] if is_key or fault["type"] == "extra_forbidden" else keys  # an unknown key has any name


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else "?" for c in text)


def _nearest(key: str, known: list[str]) -> str | None:
    """The known key that is meant: one that begins alike before one that only looks alike."""
    alike = [k for k in known if k.startswith(key) or key.startswith(k)]
    return next(iter(alike or difflib.get_close_matches(key, known, n=1, cutoff=0.5)), None)


def _keys_at(model: Any, path: list[str]) -> list[str]:
    for part in path:
        found = model.model_fields.get(part)
        if found is None:
            continue
        candidates = [found.annotation, *getattr(found.annotation, "__args__", ())]
        candidates += [inner for c in candidates for inner in getattr(c, "__args__", ())]
        model = next((c for c in candidates if isinstance(c, type) and issubclass(c, BaseModel)), model)
    return sorted(model.model_fields)


def _from_model(model: _Profile) -> CameraProfile:
    width, height = model.image.width, model.image.height
    extensions = model.extensions or _Extensions()
    transform = model.imu.T_cam_imu
    pose = np.array(transform) if transform is not None else np.hstack([ANDROID_R_CAM_IMU, np.zeros((3, 1))])
    response = _response(model.response, extensions)
    if response is None and (extensions.response_gamma != 1.0 or extensions.black_level):
        response = ResponseCurve("srgb", extra_gamma=extensions.response_gamma, black_level=extensions.black_level)
    profile = CameraProfile(
        width=width,
        height=height,
        device=model.device,
        intrinsics=(known := _intrinsics(model, width, height)),
        lens_shape=_lens_shape(model) if known is None else None,
        shutter=Shutter(
            model.shutter.readout_time_s or 0.0,
            model.shutter.readout_direction,
            model.shutter.timestamp,
            model.shutter.exposure_scale,
        ),
        readout_known=model.shutter.readout_time_s is not None,
        r_cam_imu=tuple(map(tuple, _nearest_rotation(pose[:3, :3]).tolist())),
        p_cam_imu_m=tuple(pose[:3, 3].tolist()),
        time_offset_s=model.imu.time_offset_s,
        clock_skew=model.imu.clock_skew,
        gyro_bias_rad_s=_triple(model.imu.gyro_bias_rad_s),
        gyro_scale=_triple(model.imu.gyro_scale),
        response=response,
        sensor_width_mm=model.sensor.width_mm,
        sensor_height_mm=model.sensor.height_mm,
        focal_length_mm=model.sensor.focal_length_mm,
        depth_m=model.scene.depth_m,
        estimates={n: Estimate(e.value, e.std, e.source) for n, e in (model.estimates or {}).items()},
        extensions=Extensions(
            focal_drift_per_s=extensions.focal_drift.focal_drift_per_s,
            stabilisation_fraction=extensions.stabilisation.fraction,
            stabilisation_cutoff_hz=extensions.stabilisation.cutoff_hz,
            frame_lag_s=extensions.frame_lag.lag_s,
            frame_lag_frames=extensions.frame_lag.frames,
            vignetting_corner_loss=extensions.vignetting.corner_loss,
            flicker_amplitude=extensions.flicker.amplitude,
            flicker_frequency_hz=extensions.flicker.frequency_hz,
            flicker_phase_rad=extensions.flicker.phase_rad,
            gain=tuple(extensions.gain),
            defocus_sigma_px=extensions.defocus.sigma_px,
            gyro_lowpass_hz=extensions.gyro_lowpass_hz,
        ),
        imu_untrusted_s=tuple(map(_pair, model.imu_untrusted_s)),
        imu_untrusted_stamp_0_ns=model.imu_untrusted_stamp_0_ns,
    )
    return profile.with_fields([_field(block) for block in extensions.field]) if extensions.field else profile


def _field(block: _Field) -> ModelField:
    knots, values, std = (tuple(map(tuple, rows)) for rows in (block.knots, block.values, block.std))
    return ModelField(block.kind, tuple(block.covariates), knots, values, std, block.stamp_0_ns)


def _triple(values: list[float]) -> tuple[float, float, float]:
    return values[0], values[1], values[2]


def _pair(values: list[float]) -> tuple[float, float]:
    return values[0], values[1]


def _nearest_rotation(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    u, _, vt = np.linalg.svd(matrix)
    rotation = u @ vt
    return np.where(np.abs(rotation - np.round(rotation)) < 1e-12, np.round(rotation), rotation)


def _intrinsics(model: _Profile, width: int, height: int) -> Intrinsics | None:
    sensor, lens = model.sensor, model.intrinsics
    fx, fy = lens.fx_px, lens.fy_px
    if fx is None and fy is None and sensor.focal_length_mm and (sensor.width_mm or sensor.height_mm):
        # eq 17: pixels per millimetre from whichever side is known, square pixels otherwise
        per_mm_x = width / sensor.width_mm if sensor.width_mm else height / sensor.height_mm  # type: ignore[operator]
        per_mm_y = height / sensor.height_mm if sensor.height_mm else per_mm_x
        fx, fy = sensor.focal_length_mm * per_mm_x, sensor.focal_length_mm * per_mm_y
    return None if fx is None and fy is None else _lens(model, fx or fy, fy or fx)  # type: ignore[arg-type]


def _lens_shape(model: _Profile) -> Intrinsics | None:
    """Principal point and distortion as stated, of a nominal focal length; None where nothing is."""
    lens, size = model.intrinsics, float(max(model.image.width, model.image.height))
    shape = _lens(model, size, size)
    return shape if lens.cx_px is not None or lens.cy_px is not None or any(shape.coefficients) else None


def _lens(model: _Profile, fx_px: float, fy_px: float) -> Intrinsics:
    lens, width, height = model.intrinsics, model.image.width, model.image.height
    distortion = lens.distortion
    kind = "none" if distortion in (None, "none") else distortion.model  # type: ignore[union-attr]
    return Intrinsics(
        width,
        height,
        fx_px,
        fy_px,
        (width - 1) / 2 if lens.cx_px is None else lens.cx_px,
        (height - 1) / 2 if lens.cy_px is None else lens.cy_px,
        kind,
        tuple(getattr(distortion, name) for name in COEFFICIENT_NAMES[kind]),
    )


def _response(block: _Response | None, extensions: _Extensions) -> ResponseCurve | None:
    if block is None:
        return None
    if block.kind == "five_segment" and (block.b is None or block.c is None):
        raise SettingsError("response: five_segment needs b and c", hint="see docs/profile.md")
    if block.kind == "table" and (block.x is None or block.y is None):
        raise SettingsError("response: table needs x and y", hint="see docs/profile.md")
    return ResponseCurve(
        block.kind,
        block.gamma,
        _pair(block.b or [0.0, 0.0]),
        _pair(block.c or [1.0, 1.0]),
        block.y_max,
        tuple(block.x or ()),
        tuple(block.y or ()),
        extensions.response_gamma,
        extensions.black_level,
    )


def response_block(curve: ResponseCurve) -> dict[str, Any]:
    """The ``response:`` block of a curve, without the extensions."""
    match curve.kind:
        case "gamma":
            return {"kind": "gamma", "gamma": curve.gamma}
        case "five_segment":
            return {"kind": curve.kind, "b": list(curve.b), "c": list(curve.c), "y_max": curve.y_max}
        case "table":
            return {"kind": "table", "x": list(curve.x), "y": list(curve.y)}
        case _:
            return {"kind": curve.kind}


def profile_mapping(profile: CameraProfile) -> dict[str, Any]:
    """The profile as the plain mapping that YAML and JSON take; infinity becomes the text ``inf``."""
    lens, ext = profile.intrinsics, profile.extensions
    distortion: Any = "none"
    shape = lens or profile.lens_shape
    if shape and shape.model != "none":
        names = COEFFICIENT_NAMES[shape.model]
        distortion = {"model": shape.model, **dict(zip(names, shape.coefficients, strict=True))}
    pose = [[*row, shift] for row, shift in zip(profile.r_cam_imu, profile.p_cam_imu_m, strict=True)]
    depth = profile.depth_m
    extensions: dict[str, Any] = {}
    if ext.focal_drift_per_s:
        extensions["focal_drift"] = {"focal_drift_per_s": ext.focal_drift_per_s}
    if ext.stabilisation_fraction:
        extensions["stabilisation"] = {
            "fraction": ext.stabilisation_fraction,
            "cutoff_hz": ext.stabilisation_cutoff_hz,
        }
    if ext.frame_lag_frames:
        extensions["frame_lag"] = {"lag_s": ext.frame_lag_s, "frames": ext.frame_lag_frames}
    if profile.response and profile.response.extra_gamma != 1.0:
        extensions["response_gamma"] = profile.response.extra_gamma
    if profile.response and profile.response.black_level:
        extensions["black_level"] = profile.response.black_level
    if ext.vignetting_corner_loss:
        extensions["vignetting"] = {"corner_loss": ext.vignetting_corner_loss}
    if ext.flicker_amplitude:
        extensions["flicker"] = {
            "amplitude": ext.flicker_amplitude,
            "frequency_hz": ext.flicker_frequency_hz,
            "phase_rad": ext.flicker_phase_rad,
        }
    if ext.gain:
        extensions["gain"] = list(ext.gain)
    if ext.defocus_sigma_px:
        extensions["defocus"] = {"sigma_px": ext.defocus_sigma_px}
    if ext.gyro_lowpass_hz:
        extensions["gyro_lowpass_hz"] = ext.gyro_lowpass_hz
    if own := [entry for entry in profile.fields if entry.covariates != ("focal",)]:
        extensions["field"] = [_field_block(entry) for entry in own]  # what the capture's log says stays there
    stretches: dict[str, Any] = {}
    if profile.imu_untrusted_s:
        stretches["imu_untrusted_s"] = [list(stretch) for stretch in profile.imu_untrusted_s]
        if profile.imu_untrusted_stamp_0_ns is not None:
            stretches["imu_untrusted_stamp_0_ns"] = profile.imu_untrusted_stamp_0_ns
    return {
        "virest_profile": 1,
        "device": profile.device,
        "image": {"width": profile.width, "height": profile.height},
        "intrinsics": {
            "fx_px": lens.fx_px if lens else None,
            "fy_px": lens.fy_px if lens else None,
            "cx_px": shape.cx_px if shape else None,
            "cy_px": shape.cy_px if shape else None,
            "distortion": distortion,
        },
        "shutter": {
            "readout_time_s": profile.shutter.readout_time_s if profile.readout_known else None,
            "readout_direction": profile.shutter.readout_direction,
            "timestamp": profile.shutter.timestamp,
            "exposure_scale": profile.shutter.exposure_scale,
        },
        "imu": {
            "T_cam_imu": [*pose, [0.0, 0.0, 0.0, 1.0]],
            "time_offset_s": profile.time_offset_s,
            "clock_skew": profile.clock_skew,
            "gyro_bias_rad_s": list(profile.gyro_bias_rad_s),
            "gyro_scale": list(profile.gyro_scale),
        },
        "response": response_block(profile.response) if profile.response else None,
        "sensor": {
            "width_mm": profile.sensor_width_mm,
            "height_mm": profile.sensor_height_mm,
            "focal_length_mm": profile.focal_length_mm,
        },
        "scene": {"depth_m": "inf" if depth == math.inf else depth},
        "estimates": {n: {"value": e.value, "std": e.std, "source": e.source} for n, e in profile.estimates.items()},
        "extensions": extensions,
        **stretches,
    }


def _field_block(entry: ModelField) -> dict[str, Any]:
    block: dict[str, Any] = {
        "version": 2 if entry.is_pair else 1,
        "kind": entry.kind,
        "covariates": list(entry.covariates),
    }
    for name in ("knots", "values", "std"):
        if rows := getattr(entry, name):
            block[name] = [list(row) for row in rows]
    return block if entry.stamp_0_ns is None else {**block, "stamp_0_ns": entry.stamp_0_ns}


def format_profile(profile: CameraProfile) -> str:
    """The profile as YAML text; reading it back gives the same profile."""
    return yaml.safe_dump(
        profile_mapping(profile), sort_keys=False, default_flow_style=None, width=110, allow_unicode=True
    )


def write_profile(profile: CameraProfile, path: Path) -> None:
    """Write the profile as YAML; the file appears whole or not at all."""
    part = path.with_name(path.name + ".part")
    part.write_text(format_profile(profile), encoding="utf-8")
    part.replace(path)
