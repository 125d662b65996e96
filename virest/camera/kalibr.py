"""Kalibr's ``camchain-imucam.yaml`` as a camera profile.

Kalibr's conventions are ours where it speaks: ``x_cam = T_cam_imu x_imu`` and ``t_imu = t_cam + timeshift_cam_imu``.
What it does not know (readout, curve) stays unknown; ``line_delay_nanoseconds`` of its rolling-shutter calibration
gives the readout.
"""

from __future__ import annotations

from typing import Any

from virest.camera.profile import CameraProfile, parse_profile
from virest.errors import SettingsError

_DISTORTIONS = {
    "radtan": ("radtan", ("k1", "k2", "p1", "p2")),
    "equidistant": ("fisheye", ("k1", "k2", "k3", "k4")),
    "none": ("none", ()),
}


def is_kalibr(content: dict[str, Any]) -> bool:
    """Whether a YAML mapping is a Kalibr camera chain: it has ``cam0`` and no ``virest_profile``."""
    return "cam0" in content and "virest_profile" not in content


def parse_camchain(content: dict[str, Any], name: str = "camchain") -> CameraProfile:
    """The chain's first camera as a profile; ``name`` is used in messages.

    Raises SettingsError with the key that is missing or not usable.
    """
    camera = content["cam0"]
    if not isinstance(camera, dict):
        raise SettingsError(f"{name}: cam0 has no keys", hint="is it a Kalibr camchain?")
    if camera.get("camera_model", "pinhole") != "pinhole":
        raise SettingsError(f"{name}: camera_model '{camera['camera_model']}'", hint="only pinhole can be read")
    width, height = _numbers(camera, "resolution", 2, name)
    fx, fy, cx, cy = _numbers(camera, "intrinsics", 4, name)
    line_delay_ns = camera.get("line_delay_nanoseconds")
    shutter: dict[str, Any] = {"readout_direction": "top_to_bottom"}
    if isinstance(line_delay_ns, int | float):
        shutter["readout_time_s"] = line_delay_ns * 1e-9 * height
    return parse_profile(
        {
            "virest_profile": 1,
            "device": f"{name}, cam0",
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


def _distortion(camera: dict[str, Any], name: str) -> dict[str, Any]:
    kind = camera.get("distortion_model", "none")
    if kind not in _DISTORTIONS:
        raise SettingsError(f"{name}: distortion_model '{kind}'", hint=f"one of {', '.join(_DISTORTIONS)} can be read")
    model, names = _DISTORTIONS[kind]
    values = _numbers(camera, "distortion_coeffs", len(names), name) if names else []
    return {"model": model, **dict(zip(names, values, strict=True))}


def _numbers(camera: dict[str, Any], key: str, count: int, name: str) -> list[float]:
    values = camera.get(key)
    usable = isinstance(values, list) and len(values) == count and all(isinstance(v, int | float) for v in values)
    if not usable:
        raise SettingsError(f"{name}: cam0.{key} must be {count} numbers", hint="is it a Kalibr camchain?")
    return [float(v) for v in values]  # type: ignore[union-attr]
