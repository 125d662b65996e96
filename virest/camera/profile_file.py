"""Read (strictly) and write the profile as a YAML file (contract, section 3)."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import ValidationError

from virest.arrays import Array
from virest.camera.field import Field as ModelField
from virest.camera.intrinsics import COEFFICIENT_NAMES, Intrinsics
from virest.camera.profile import ANDROID_R_CAM_IMU, OPEN_IMU, CameraProfile, Estimate, Extensions
from virest.camera.profile_schema import ExtensionsBlock, FieldBlock, ProfileFile, ResponseBlock
from virest.camera.response import ResponseCurve
from virest.camera.shutter import Shutter
from virest.camera.yaml_mapping import explain_validation, load_yaml_mapping
from virest.errors import SettingsError

MOST_FOCAL_LENGTHS = 100
"""Largest distance of a pixel from the principal point: 89.4° from the axis."""


def read_profile(path: Path) -> CameraProfile:
    """Read a profile file. Raises SettingsError with the file, the key, and the nearest known key."""
    return parse_profile(load_yaml_mapping(path), path.name)


def parse_profile(content: dict[str, Any], name: str = "profile") -> CameraProfile:
    """Build a profile from the YAML's mapping; ``name`` is used in messages."""
    try:
        model = ProfileFile.model_validate(content)
    except ValidationError as error:
        raise explain_validation(error, ProfileFile, name) from None
    try:
        imu = content.get("imu") or {}
        return replace(_from_model(model), open_imu=tuple(key for key in OPEN_IMU if imu.get(key, ...) is None))
    except SettingsError as error:
        raise SettingsError(f"{name}: {error.message}", hint=error.hint) from None


def require_usable(profile: CameraProfile, name: str = "profile") -> None:
    """Check that a profile built in memory satisfies the limits of a file. Raises SettingsError with the key."""
    parse_profile(profile_mapping(profile), name)


def _from_model(model: ProfileFile) -> CameraProfile:
    width, height = model.image.width, model.image.height
    extensions = model.extensions or ExtensionsBlock()
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
            stabilisation_travel_rad=extensions.stabilisation.travel_rad,
            stabilisation_at_end=extensions.stabilisation.at_end,
            frame_lag_s=extensions.frame_lag.lag_s,
            frame_lag_frames=extensions.frame_lag.frames,
            exposures_late_frames=extensions.exposures_late_frames,
            exposure_gain=tuple(extensions.exposure_gain),
            vignetting_corner_loss=extensions.vignetting.corner_loss,
            flicker_amplitude=extensions.flicker.amplitude,
            flicker_frequency_hz=extensions.flicker.frequency_hz,
            flicker_phase_rad=extensions.flicker.phase_rad,
            gain=tuple(extensions.gain),
            defocus_sigma_px=extensions.defocus.sigma_px,
            gyro_lowpass_hz=extensions.gyro_lowpass_hz,
            gyro_averaging_s=extensions.gyro_averaging_s,
            gyro_misalignment_rad=_triple(extensions.gyro_misalignment_rad),
        ),
        imu_untrusted_s=tuple(map(_pair, model.imu_untrusted_s)),
        imu_untrusted_stamp_0_ns=model.imu_untrusted_stamp_0_ns,
    )
    return profile.with_fields([_field(block) for block in extensions.field]) if extensions.field else profile


def _field(block: FieldBlock) -> ModelField:
    knots, values, std = (tuple(map(tuple, rows)) for rows in (block.knots, block.values, block.std))
    return ModelField(block.kind, tuple(block.covariates), knots, values, std, block.stamp_0_ns)


def _triple(values: list[float]) -> tuple[float, float, float]:
    return values[0], values[1], values[2]


def _pair(values: list[float]) -> tuple[float, float]:
    return values[0], values[1]


def _nearest_rotation(matrix: Array) -> Array:
    u, _, vt = np.linalg.svd(matrix)
    rotation = u @ vt
    return np.where(np.abs(rotation - np.round(rotation)) < 1e-12, np.round(rotation), rotation)


def _intrinsics(model: ProfileFile, width: int, height: int) -> Intrinsics | None:
    sensor, lens = model.sensor, model.intrinsics
    fx, fy = lens.fx_px, lens.fy_px
    if fx is None and fy is None and sensor.focal_length_mm and (sensor.width_mm or sensor.height_mm):
        # eq 17: pixels per millimetre from whichever side is known, square pixels otherwise
        per_mm_x = width / sensor.width_mm if sensor.width_mm else height / sensor.height_mm  # type: ignore[operator]
        per_mm_y = height / sensor.height_mm if sensor.height_mm else per_mm_x
        fx, fy = sensor.focal_length_mm * per_mm_x, sensor.focal_length_mm * per_mm_y
    return None if fx is None and fy is None else _lens(model, fx or fy, fy or fx)  # type: ignore[arg-type]


def _lens_shape(model: ProfileFile) -> Intrinsics | None:
    """The stated principal point and distortion, with a nominal focal length; None if none is stated."""
    lens, size = model.intrinsics, float(max(model.image.width, model.image.height))
    shape = _lens(model, size, size)
    return shape if lens.cx_px is not None or lens.cy_px is not None or any(shape.coefficients) else None


def _lens(model: ProfileFile, fx_px: float, fy_px: float) -> Intrinsics:
    lens, width, height = model.intrinsics, model.image.width, model.image.height
    distortion = lens.distortion
    kind = "none" if distortion in (None, "none") else distortion.model  # type: ignore[union-attr]
    cx_px = (width - 1) / 2 if lens.cx_px is None else lens.cx_px
    cy_px = (height - 1) / 2 if lens.cy_px is None else lens.cy_px
    _require_angles((width, height), (fx_px, fy_px), (cx_px, cy_px))
    coefficients = tuple(getattr(distortion, name) for name in COEFFICIENT_NAMES[kind])
    return Intrinsics(width, height, fx_px, fy_px, cx_px, cy_px, kind, coefficients)


def _require_angles(size: tuple[int, int], focal_px: tuple[float, float], centre_px: tuple[float, float]) -> None:
    """Refuse a picture that the lens sees at impossible angles: blur paths there have millions of pixels."""
    for axis, side, focal, centre in zip("xy", size, focal_px, centre_px, strict=True):
        far = max(abs(centre), abs(side - 1 - centre))
        if far > MOST_FOCAL_LENGTHS * focal:
            raise SettingsError(
                f"intrinsics: with f{axis}_px {focal:g} and c{axis}_px {centre:g}, the picture of {side} px reaches "
                f"{far / focal:.4g} focal lengths from the principal point, at most {MOST_FOCAL_LENGTHS} are possible",
                hint="is a decimal point missing? see docs/profile.md",
            )


def _response(block: ResponseBlock | None, extensions: ExtensionsBlock) -> ResponseCurve | None:
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
    """The profile as a plain mapping for YAML and JSON; infinity becomes the text ``inf``."""
    lens, ext = profile.intrinsics, profile.extensions
    distortion: Any = "none"
    shape = lens or profile.lens_shape
    if shape and shape.model != "none":
        distortion = {"model": shape.model, **shape.named_coefficients}
    depth = profile.depth_m
    extensions: dict[str, Any] = {}
    if ext.focal_drift_per_s:
        extensions["focal_drift"] = {"focal_drift_per_s": ext.focal_drift_per_s}
    if ext.stabilisation_fraction:
        extensions["stabilisation"] = {
            "fraction": ext.stabilisation_fraction,
            "cutoff_hz": ext.stabilisation_cutoff_hz,
        }
        if ext.stabilisation_travel_rad is not None:
            extensions["stabilisation"]["travel_rad"] = ext.stabilisation_travel_rad
            extensions["stabilisation"]["at_end"] = ext.stabilisation_at_end
    if ext.frame_lag_frames:
        extensions["frame_lag"] = {"lag_s": ext.frame_lag_s, "frames": ext.frame_lag_frames}
    if ext.exposures_late_frames:
        extensions["exposures_late_frames"] = ext.exposures_late_frames
    if ext.exposure_gain:
        extensions["exposure_gain"] = list(ext.exposure_gain)
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
    if ext.gyro_averaging_s:
        extensions["gyro_averaging_s"] = ext.gyro_averaging_s
    if any(ext.gyro_misalignment_rad):
        extensions["gyro_misalignment_rad"] = list(ext.gyro_misalignment_rad)
    # a field over the logged focal length belongs to the capture, not to the file
    if own := [entry for entry in profile.fields if entry.covariates != ("focal",)]:
        extensions["field"] = [_field_block(entry) for entry in own]
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
            "T_cam_imu": profile.pose_cam_imu.tolist(),
            "time_offset_s": profile.time_offset_s,
            **{name: _or_null(profile, name) for name in OPEN_IMU},
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


def _or_null(profile: CameraProfile, name: str) -> Any:
    """A value of OPEN_IMU; None: it is open, and holds its default."""
    value = getattr(profile, name)
    if name in profile.open_imu and value == OPEN_IMU[name]:
        return None
    return list(value) if isinstance(value, tuple) else value


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
