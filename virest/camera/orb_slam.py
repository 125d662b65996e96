"""Settings of ORB-SLAM3 (Campos et al., IEEE T-RO 2021) for one camera, with or without an inertial sensor.

Its reader infers the type of each number: reals need a decimal point, integers must have none.
"""

from __future__ import annotations

import numpy as np

from virest.camera.intrinsics import COEFFICIENT_NAMES
from virest.camera.kalibr import USUAL_ACCEL_WALK, USUAL_GYRO_WALK, ImuNoise
from virest.camera.profile import CameraProfile
from virest.errors import SettingsError

CAMERAS = {"none": "PinHole", "radtan": "PinHole", "fisheye": "KannalaBrandt8"}
PINHOLE = ("k1", "k2", "p1", "p2")
EXTRACTOR = {
    "nFeatures": "1000",
    "scaleFactor": "1.2",
    "nLevels": "8",
    "iniThFAST": "20",
    "minThFAST": "7",
}
VIEWER = {
    "KeyFrameSize": "0.05",
    "KeyFrameLineWidth": "1.0",
    "GraphLineWidth": "0.9",
    "PointSize": "2.0",
    "CameraSize": "0.08",
    "CameraLineWidth": "3.0",
    "ViewpointX": "0.0",
    "ViewpointY": "-0.7",
    "ViewpointZ": "-3.5",
    "ViewpointF": "500.0",
}


def format_orb_slam(
    profile: CameraProfile, rate_hz: float, noise: ImuNoise | None, comments: list[str], command: str = "export"
) -> str:
    """Write settings; without noise or one of its densities there is no inertial block, only the camera.

    Raises SettingsError if the focal length is unknown.
    """
    lens = profile.intrinsics
    if lens is None:
        raise SettingsError("ORB-SLAM3 needs a focal length", hint="give --config, or calibrate with --with focal")
    lines = ["%YAML:1.0", f"# ORB-SLAM3 settings, written by virest {command}", *(f"# {line}" for line in comments)]
    lines += ['File.version: "1.0"', f'Camera.type: "{CAMERAS[lens.model]}"']
    held = lens.named_coefficients
    names = COEFFICIENT_NAMES["fisheye"] if lens.model == "fisheye" else PINHOLE
    names += ("k3",) if lens.model == "radtan" and held["k3"] else ()
    numbers = {"fx": lens.fx_px, "fy": lens.fy_px, "cx": lens.cx_px, "cy": lens.cy_px}
    numbers |= {name: held.get(name, 0.0) for name in names}
    lines += [f"Camera1.{name}: {real(value)}" for name, value in numbers.items()]
    lines += [f"Camera.width: {profile.width}", f"Camera.height: {profile.height}"]
    lines += [f"Camera.fps: {max(round(rate_hz), 1)}", "Camera.RGB: 1"]
    lines += _inertial(profile, noise)
    lines += [f"ORBextractor.{key}: {value}" for key, value in EXTRACTOR.items()]
    lines += [f"Viewer.{key}: {value}" for key, value in VIEWER.items()]
    return "\n".join(lines) + "\n"


def _inertial(profile: CameraProfile, noise: ImuNoise | None) -> list[str]:
    """The IMU block: the camera's pose on the inertial sensor, and the sensor's noise."""
    if noise is None or not noise.gyro_density or not noise.accel_density:
        return ["# no inertial block: too few samples, or no accelerometer"]
    rows = [", ".join(real(value) for value in row) for row in np.linalg.inv(profile.pose_cam_imu).tolist()]
    return [
        "IMU.T_b_c1: !!opencv-matrix",
        "   rows: 4",
        "   cols: 4",
        "   dt: f",
        "   data: [" + ",\n          ".join(rows) + "]",
        "IMU.InsertKFsWhenLost: 0",
        f"IMU.NoiseGyro: {real(noise.gyro_density)}",
        f"IMU.NoiseAcc: {real(noise.accel_density)}",
        f"IMU.GyroWalk: {real(noise.gyro_walk or USUAL_GYRO_WALK)}",
        f"IMU.AccWalk: {real(noise.accel_walk or USUAL_ACCEL_WALK)}",
        f"IMU.Frequency: {real(noise.update_rate_hz)}",
    ]


def real(value: float) -> str:
    """A number with a decimal point and ten significant digits."""
    text = f"{value + 0.0:.10g}"
    mantissa, mark, exponent = text.partition("e")
    return (mantissa if "." in mantissa else f"{mantissa}.0") + mark + exponent
