"""Kalibr's ``camchain-imucam.yaml`` and ``imu.yaml``, read and written.

The conventions agree: ``x_cam = T_cam_imu x_imu`` and ``t_imu = t_cam + timeshift_cam_imu``.  What Kalibr lacks
(response curve, sideways readout, bias, clock rate) stays unknown when read, and becomes a comment when written;
``line_delay_nanoseconds`` of its rolling-shutter calibration is the readout time of one row, top to bottom.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import yaml

from virest.camera.lens_fit import standard_lens
from virest.camera.profile import CameraProfile, Extensions
from virest.camera.profile_file import parse_profile
from virest.camera.yaml_mapping import commented
from virest.errors import SettingsError

_DISTORTIONS = {
    "radtan": ("radtan", ("k1", "k2", "p1", "p2")),
    "equidistant": ("fisheye", ("k1", "k2", "k3", "k4")),
    "none": ("none", ()),
}
DEFAULT_TOPIC = "/imu0"
USUAL_GYRO_WALK, USUAL_ACCEL_WALK = 2.2e-6, 8.6e-5
"""Random walks of a phone's inertial sensor (BMI160, Schubert et al., IROS 2018), rad/s²/√Hz and m/s³/√Hz."""
WALK_COMMENT = "not measured (that takes hours at rest): typical for phones"


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """The content of ``imu.yaml``: continuous-time noise of an inertial sensor. None: unknown."""

    update_rate_hz: float
    gyro_density: float | None
    """rad/s/√Hz."""
    accel_density: float | None
    """m/s²/√Hz."""
    gyro_walk: float | None = None
    """rad/s²/√Hz."""
    accel_walk: float | None = None
    """m/s³/√Hz."""
    topic: str = DEFAULT_TOPIC


def is_kalibr(content: dict[str, Any]) -> bool:
    """Whether a YAML mapping is a Kalibr camera chain: it has ``cam0`` and no ``virest_profile``."""
    return "cam0" in content and "virest_profile" not in content


# ── read ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def parse_camchain(content: dict[str, Any], name: str = "camchain", which: str = "cam0") -> CameraProfile:
    """A camera of the chain, by default the first, as a profile; ``name`` is used in messages.

    Raises SettingsError with the missing or unusable key.
    """
    camera = content.get(which)
    if not isinstance(camera, dict):
        raise SettingsError(f"{name}: {which} has no keys", hint="is it a Kalibr camchain?")
    if camera.get("camera_model", "pinhole") != "pinhole":
        model = str(camera["camera_model"])[:40]
        raise SettingsError(f"{name}: camera_model {model!r}", hint="only pinhole is supported")
    width, height = _numbers(camera, "resolution", 2, name)
    fx, fy, cx, cy = _numbers(camera, "intrinsics", 4, name)
    line_delay_ns = camera.get("line_delay_nanoseconds")
    shutter: dict[str, Any] = {"readout_direction": "top_to_bottom"}
    if isinstance(line_delay_ns, int | float):
        shutter["readout_time_s"] = line_delay_ns * 1e-9 * height
    return parse_profile(
        {
            "virest_profile": 1,
            "device": f"{name}, {which}",
            "image": {"width": int(width), "height": int(height)},
            "intrinsics": {
                "fx_px": fx,
                "fy_px": fy,
                "cx_px": cx,
                "cy_px": cy,
                "distortion": _distortion(camera, name),
            },
            "shutter": shutter,
            "imu": {"T_cam_imu": camera.get("T_cam_imu"), "time_offset_s": camera.get("timeshift_cam_imu")},
        },
        name,
    )


def parse_imu(content: dict[str, Any], name: str = "imu.yaml") -> ImuNoise:
    """Read the noise of ``imu.yaml``, in Kalibr's input form (flat) or output form (below ``imu0``).

    Raises SettingsError with the missing or unusable key.
    """
    block = content.get("imu0", content)
    if not isinstance(block, dict):
        raise SettingsError(f"{name}: imu0 has no keys", hint="is it a Kalibr imu.yaml?")
    rate_hz = _positive(block, "update_rate", name)
    if rate_hz is None:
        raise SettingsError(f"{name}: update_rate is missing", hint="is it a Kalibr imu.yaml?")
    return ImuNoise(
        rate_hz,
        _positive(block, "gyroscope_noise_density", name),
        _positive(block, "accelerometer_noise_density", name),
        _positive(block, "gyroscope_random_walk", name),
        _positive(block, "accelerometer_random_walk", name),
        str(block.get("rostopic", DEFAULT_TOPIC)),
    )


def _distortion(camera: dict[str, Any], name: str) -> dict[str, Any]:
    kind = camera.get("distortion_model", "none")
    if not isinstance(kind, str) or kind not in _DISTORTIONS:
        known = ", ".join(_DISTORTIONS)
        raise SettingsError(f"{name}: distortion_model {str(kind)[:40]!r}", hint=f"supported are {known}")
    model, names = _DISTORTIONS[kind]
    values = _numbers(camera, "distortion_coeffs", len(names), name) if names else []
    return {"model": model, **dict(zip(names, values, strict=True))}


def _numbers(camera: dict[str, Any], key: str, count: int, name: str) -> list[float]:
    values = camera.get(key)
    if not isinstance(values, list) or len(values) != count or not all(map(_is_finite, values)):
        raise SettingsError(f"{name}: cam0.{key} must be {count} numbers", hint="is it a Kalibr camchain?")
    return [float(v) for v in values]


def _is_finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _positive(block: dict[str, Any], key: str, name: str) -> float | None:
    value = block.get(key)
    if value is None:
        return None
    try:
        # YAML 1.1 reads 1e-3 as text
        number = float(value)
    except (TypeError, ValueError):
        number = 0.0
    if isinstance(value, bool) or not 0 < number < float("inf"):
        raise SettingsError(f"{name}: {key} must be a positive number, got {str(value)[:40]!r}")
    return number


# ── write ────────────────────────────────────────────────────────────────────────────────────────────────────────


def format_camchain(
    profile: CameraProfile,
    exposure_s: float | None = None,
    *,
    command: str = "calibrate",
    instant_s: float | None = None,
) -> str:
    """Write a profile as a camera chain of one camera; comments list what Kalibr cannot hold.

    exposure_s: typical logged exposure, for timestamps that do not mark its start.  Kalibr knows only readouts from top
    to bottom: for others the time shift is that of the picture's middle row, as for a global shutter.  instant_s: for
    tools that treat every picture as instantaneous, the seconds from its timestamp to that instant; without a line
    delay.  Raises SettingsError if the focal length is unknown.
    """
    lens = profile.intrinsics
    if lens is None:
        raise SettingsError("Kalibr's camchain needs a focal length", hint="calibrate with --with focal")
    lens, off_px = standard_lens(lens)
    model, names = next((kalibr, own) for kalibr, (ours, own) in _DISTORTIONS.items() if ours == lens.model)
    coefficients = lens.named_coefficients
    camera: dict[str, Any] = {
        "T_cam_imu": profile.pose_cam_imu.tolist(),
        "cam_overlaps": [],
        "camera_model": "pinhole",
        "distortion_coeffs": [coefficients[name] for name in names],
        "distortion_model": model,
        "intrinsics": [lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px],
        "resolution": [profile.width, profile.height],
        "rostopic": "/cam0/image_raw",
    }
    if instant_s is None and _has_line_delay(profile):
        camera["line_delay_nanoseconds"] = 1e9 * profile.shutter.readout_time_s / profile.height
    if profile.time_offset_s is not None:
        shift_s = _shift_for_kalibr_s(profile, exposure_s) if instant_s is None else instant_s
        camera["timeshift_cam_imu"] = profile.time_offset_s + shift_s
    lost = _not_held(profile, coefficients, names, exposure_s) if instant_s is None else _one_instant(profile)
    comments = [f"Kalibr camera chain, written by virest {command}", *lost, *field_notes(profile, off_px)]
    return commented(comments) + yaml.safe_dump({"cam0": camera}, default_flow_style=None, width=110)


def field_notes(profile: CameraProfile, off_px: float) -> list[str]:
    """Notes on fields that other tools' files cannot hold; off_px: largest error of the written lens."""
    notes = []
    lens, uneven = profile.intrinsics, profile.shutter.uneven
    if lens is not None and lens.displaced is not None:
        notes.append(f"the displacement over the picture is written as distortion, within {off_px:.2g} px")
    if uneven is not None:
        late_ms = 1e3 * float(np.abs(uneven.values).max())
        notes.append(f"the rows' uneven start of up to {late_ms:.2g} ms (a field over the row) is left out")
    kinds = {f"{field.kind} over {', '.join(field.covariates)}": 1 for field in profile.extensions.field}
    return [*notes, *(f"the field of {name} is left out" for name in kinds)]


def _one_instant(profile: CameraProfile) -> list[str]:
    """Notes on pictures that are treated as instantaneous."""
    notes = ["timeshift_cam_imu refers to a single instant of each frame, for tools without a rolling-shutter model"]
    if profile.time_offset_s is None:
        notes = ["the time offset is unknown: no timeshift_cam_imu"]
    if profile.readout_known and profile.shutter.readout_time_s:
        shutter = profile.shutter
        rows = f"rows are read {shutter.readout_direction} in {shutter.readout_time_s:.6g} s"
        notes.append(f"the instant is the middle of the picture: {rows}")
    return notes


def format_imu(noise: ImuNoise, command: str = "calibrate") -> str:
    """Write noise as Kalibr's ``imu.yaml``, which needs every value: a typical random walk replaces an unknown one.

    An unknown density is left out, with a comment, so that Kalibr asks for it.
    """
    entries: list[tuple[str, float | None, str]] = [
        ("accelerometer_noise_density", noise.accel_density, "m/s^2/sqrt(Hz)"),
        ("accelerometer_random_walk", noise.accel_walk or USUAL_ACCEL_WALK, _walk("m/s^3/sqrt(Hz)", noise.accel_walk)),
        ("gyroscope_noise_density", noise.gyro_density, "rad/s/sqrt(Hz)"),
        ("gyroscope_random_walk", noise.gyro_walk or USUAL_GYRO_WALK, _walk("rad/s^2/sqrt(Hz)", noise.gyro_walk)),
        ("update_rate", noise.update_rate_hz, "Hz"),
    ]
    lines = [
        f"# Kalibr inertial sensor, written by virest {command}. The densities are measured in the quarter of the",
        "# capture with the least motion, above the band of hand motion: a lower bound if the phone filters its data.",
    ]
    for key, value, remark in entries:
        lines.append(f"# {key}: unknown" if value is None else f"{key}: {_digits(value)}  # {remark}")
    return "\n".join([*lines, yaml.safe_dump({"rostopic": noise.topic}).strip()]) + "\n"


def _walk(unit: str, value: float | None) -> str:
    return unit if value else f"{unit}; {WALK_COMMENT}"


def _digits(value: float) -> str:
    return str(yaml.safe_dump(float(f"{value:.6g}"))).splitlines()[0]


def _has_line_delay(profile: CameraProfile) -> bool:
    return profile.readout_known and profile.shutter.readout_direction == "top_to_bottom"


def _shift_for_kalibr_s(profile: CameraProfile, exposure_s: float | None) -> float:
    """Seconds from the instant that the profile's timestamps mark to the one that a camera chain's are read to mark."""
    shutter = profile.shutter
    to_start_s = float(shutter.first_row_start_s(np.zeros(1), np.array([exposure_s or 0.0]))[0])
    return to_start_s if _has_line_delay(profile) else to_start_s + 0.5 * shutter.readout_time_s


def _not_held(
    profile: CameraProfile, coefficients: dict[str, float], names: tuple[str, ...], exposure_s: float | None
) -> list[str]:
    """Notes on what is lost."""
    shutter = profile.shutter
    notes = []
    if not profile.readout_known:
        notes.append("the readout time is unknown: no line_delay_nanoseconds")
    elif not _has_line_delay(profile):
        notes.append(
            f"the rows are read {shutter.readout_direction} in {1e3 * shutter.readout_time_s:.4g} ms, which Kalibr "
            "cannot hold: timeshift_cam_imu is that of the picture's middle, as for a global shutter"
        )
    if profile.time_offset_s is None:
        notes.append("the time offset is unknown: no timeshift_cam_imu")
    elif exposure_s is not None:
        middle_ms = 5e2 * float(shutter.true_exposure_s(np.array([exposure_s]))[0])
        notes.append(f"timeshift_cam_imu refers to the start of the exposure; its middle is {middle_ms:.4g} ms later")
    elif shutter.timestamp != "exposure_start":
        notes.append(f"timeshift_cam_imu refers to the timestamps, which mark {shutter.timestamp}; exposure unknown")
    notes += [f"{key}: {value:.6g} is left out" for key, value in coefficients.items() if value and key not in names]
    lost = {
        "clock_skew": (profile.clock_skew, 0.0),
        "gyro_bias_rad_s": (list(profile.gyro_bias_rad_s), [0.0] * 3),
        "gyro_scale": (list(profile.gyro_scale), [1.0] * 3),
        "exposure_scale": (shutter.exposure_scale, 1.0),
    }
    notes += [f"Kalibr has no {key}: {value}" for key, (value, plain) in lost.items() if value != plain]
    if profile.response is not None:
        notes.append(f"Kalibr has no response curve: {profile.response.kind}")
    if replace(profile.extensions, field=()) != Extensions():
        notes.append("Kalibr has none of the profile's extensions")
    return notes
