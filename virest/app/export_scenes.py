"""Files for reconstruction tools: ``transforms.json`` (nerfstudio), a COLMAP model, a Gyroflow lens profile.

Poses come from a trajectory file, if given.  Otherwise only orientations are known, from the gyroscope: COLMAP gets
zero positions, a starting point and not a reconstruction, and nerfstudio gets no poses.

nerfstudio's camera axes are OpenGL's: x right, y up, z back.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from virest.app.export_plan import ExportFrame, ExportPlan
from virest.app.outputs import json_text
from virest.arrays import Array
from virest.camera.colmap import HALF_PX, colmap_camera
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.capture.folder import Frame
from virest.errors import CaptureError, SettingsError
from virest.image_formation.kernels import angle_and_length, blur_chords
from virest.image_formation.row_motion import RowMotion, row_motion
from virest.motion.integration import integrate_gyro
from virest.motion.optics import moving_lens
from virest.motion.trajectory import Trajectory

Json = dict[str, Any]
OPENGL = np.diag([1.0, -1.0, -1.0])
"""Rotation between OpenGL's camera axes and ours, in both directions."""
FIT_ANGLES = 400
"""100 for each of the four coefficients."""


@dataclass(frozen=True, slots=True)
class FramePose:
    """Camera pose and motion for one exported frame."""

    frame: ExportFrame
    name: str
    rotation_world_cam: Array
    """(3, 3) at the instant that the frame shows."""
    position_m: Array | None
    """(3,) in the world; None: unknown."""
    rate_rad_s: Array
    """(3,) camera axes."""
    blur_px: float
    start: tuple[Array, Array | None]
    """Rotation and position at the start of the first row."""
    end: tuple[Array, Array | None]
    """The same at the end of the last row."""


class GivenPoses:
    """A trajectory ``time x y z qx qy qz qw`` (TUM: camera to world, seconds or nanoseconds), interpolated."""

    def __init__(self, text: str, name: str) -> None:
        rows = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
        try:
            self._times_ns = np.array([_time_ns(row[0]) for row in rows], np.int64)
            values = np.array([[float(v) for v in row[1:8]] for row in rows])
            turns = Rotation.from_quat(values[:, 3:])
            if len(rows) < 2 or values.shape[1] != 7 or (np.diff(self._times_ns) <= 0).any():
                raise ValueError
        except (ValueError, IndexError):
            raise SettingsError(f"{name}: is not a trajectory", hint="lines: time x y z qx qy qz qw, rising") from None
        self._seconds = (self._times_ns - self._times_ns[0]) * 1e-9
        self._positions, self._turns = values[:, :3], Slerp(self._seconds, turns)

    def at(self, time_ns: int) -> tuple[Array, Array] | None:
        """Rotation camera to world and position at a time; None outside the trajectory."""
        second = (time_ns - int(self._times_ns[0])) * 1e-9
        if not 0.0 <= second <= self._seconds[-1]:
            return None
        position = np.array([np.interp(second, self._seconds, self._positions[:, k]) for k in range(3)])
        return np.asarray(self._turns(second).as_matrix()), position


def _time_ns(text: str) -> int:
    """Nanoseconds of a time in seconds (with decimals) or whole nanoseconds."""
    whole, _, part = text.partition(".")
    return int(whole) if not part and len(whole) > 12 else int(whole) * 10**9 + int((part + "0" * 9)[:9])


def frame_poses(plan: ExportPlan, frames: list[ExportFrame], names: list[str]) -> list[FramePose]:
    """Poses and motion of the exported frames, from the gyroscope and, if given, a trajectory."""
    camera = plan.camera
    if camera.intrinsics is None:
        raise CaptureError(
            f"{plan.capture.name}: the focal length is unknown, so {plan.options.format} cannot be written",
            hint="give --config, or fit it with virest calibrate --with focal",
        )
    trajectory = integrate_gyro(plan.capture.imu, camera)
    lens = moving_lens(trajectory, camera)
    poses = plan.poses
    found = []
    for frame, name in zip(frames, names, strict=True):
        source = plan.capture.frames[frame.index]
        motion = row_motion(trajectory, camera, source.time_s, source.exposure_s, "exposure-start", None, lens)
        found.append(_pose(plan, frame, name, source, motion, trajectory, poses))
    return found


def _pose(
    plan: ExportPlan,
    frame: ExportFrame,
    name: str,
    source: Frame,
    motion: RowMotion,
    trajectory: Trajectory,
    poses: GivenPoses | None,
) -> FramePose:
    camera = plan.camera
    first_s, last_s = motion.start_s, motion.end_s
    instant_s = motion.start_s if plan.restored_start else motion.middle_s

    def at(time_s: float) -> tuple[Array, Array | None]:
        if poses is not None:
            given = poses.at(source.timestamp_ns + round((camera.camera_time_s(time_s) - source.time_s) * 1e9))
            if given is not None:
                return given
        return np.asarray(trajectory.orientation(time_s)), None

    rotation, position = at(instant_s)
    centre = np.array([[(camera.width - 1) / 2, (camera.height - 1) / 2]])
    _, length = angle_and_length(blur_chords(motion, centre))
    turning = np.asarray(trajectory.rate_rad_s(instant_s), float)
    blur_px = 0.0 if plan.options.restored else float(length[0])
    return FramePose(frame, name, rotation, position, turning, blur_px, at(first_s), at(last_s))


# ── nerfstudio ───────────────────────────────────────────────────────────────────────────────────────────────────────


def transforms_json(plan: ExportPlan, poses: list[FramePose]) -> str:
    """``transforms.json``: intrinsics, and the known time, motion and pose of each frame."""
    lens = plan.standard.intrinsics
    assert lens is not None
    content: Json = {
        "w": lens.width,
        "h": lens.height,
        "fl_x": lens.fx_px,
        "fl_y": lens.fy_px,
        "cx": lens.cx_px + HALF_PX,
        "cy": lens.cy_px + HALF_PX,
        **_nerfstudio_distortion(lens),
        "frames": [_nerfstudio_frame(plan, pose) for pose in poses],
    }
    return json_text(content, indent=1)


def _nerfstudio_distortion(lens: Intrinsics) -> Json:
    model = "OPENCV_FISHEYE" if lens.model == "fisheye" else "OPENCV"
    return {"camera_model": model, **(lens.named_coefficients if lens.is_distorted else {})}


def _nerfstudio_frame(plan: ExportPlan, pose: FramePose) -> Json:
    exposure_s = plan.capture.frames[pose.frame.index].exposure_s
    true_s = None if exposure_s is None else plan.camera.shutter.true_exposure_s(exposure_s)
    facts: Json = {
        "file_path": f"images/{pose.name}",
        "timestamp_ns": pose.frame.time_ns,
        "exposure_time": 0.0 if plan.options.restored else true_s,
        "rolling_shutter_time": plan.profile.shutter.readout_time_s,
        "camera_angular_velocity": (OPENGL @ pose.rate_rad_s).tolist(),
        "motion_blur_score": pose.blur_px,
    }
    velocity = plan.velocities.get(pose.frame.index)
    if velocity is not None:
        facts["camera_linear_velocity"] = (OPENGL @ np.asarray(velocity)).tolist()
    if pose.position_m is not None:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = pose.rotation_world_cam @ OPENGL, pose.position_m
        facts["transform_matrix"] = matrix.tolist()
    return {key: value for key, value in facts.items() if value is not None}


# ── COLMAP ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def colmap_files(plan: ExportPlan, poses: list[FramePose]) -> dict[str, str]:
    """The text model ``sparse/0``, and the poses at both ends of the rolling shutter."""
    lens = plan.standard.intrinsics
    assert lens is not None
    model, parameters = colmap_camera(lens)
    camera = f"1 {model} {lens.width} {lens.height} {' '.join(f'{value:.12g}' for value in parameters)}"
    images = []
    for number, pose in enumerate(poses, start=1):
        quaternion, translation = _world_to_camera(pose.rotation_world_cam, pose.position_m)
        values = " ".join(f"{value:.12g}" for value in (*quaternion, *translation))
        images += [f"{number} {values} 1 {pose.name}", ""]
    head = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    return {
        "sparse/0/cameras.txt": f"{head}{camera}\n",
        "sparse/0/images.txt": "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; POINTS2D[]\n"
        + "\n".join(images)
        + "\n",
        "sparse/0/points3D.txt": "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n",
        "rolling_shutter.json": _shutter_json(plan, poses),
    }


def _world_to_camera(rotation_world_cam: Array, position_m: Array | None) -> tuple[list[float], list[float]]:
    """Quaternion w x y z and translation that take world points to the camera."""
    turn = rotation_world_cam.T
    place = np.zeros(3) if position_m is None else np.asarray(position_m, float)
    return Rotation.from_matrix(turn).as_quat(scalar_first=True).tolist(), (-turn @ place).tolist()


def _shutter_json(plan: ExportPlan, poses: list[FramePose]) -> str:
    """World-to-camera poses at the start of the first row and the end of the last, w x y z and metres."""
    frames = []
    for pose in poses:
        ends = {"start": pose.start, "end": pose.end}
        if plan.options.restored:
            ends = dict.fromkeys(ends, (pose.rotation_world_cam, pose.position_m))
        entry: Json = {"name": pose.name}
        for key, (rotation, position) in ends.items():
            quaternion, translation = _world_to_camera(rotation, position)
            entry[key] = {"q_cam_world_wxyz": quaternion, "t_cam_world_m": None if position is None else translation}
        frames.append(entry)
    facts = {
        "readout_direction": plan.camera.shutter.readout_direction,
        "readout_time_s": plan.profile.shutter.readout_time_s,
        "frames": frames,
    }
    return json_text(facts, indent=1)


# ── Gyroflow ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def gyroflow_profile(profile: CameraProfile, fps: float) -> tuple[str, float]:
    """A lens profile for Gyroflow, and the largest error of its fisheye model in pixels."""
    lens = profile.intrinsics
    assert lens is not None
    coefficients, error_px = fisheye_coefficients(lens)
    size = {"w": lens.width, "h": lens.height}
    device = profile.device or "phone"
    content = {
        "name": f"{device}_virest_{lens.width}x{lens.height}-{fps:.2f}fps",
        "note": "written by virest export",
        "calibrated_by": "virest",
        "camera_brand": device.partition(" ")[0],
        "camera_model": device.partition(" ")[2] or device,
        "lens_model": "",
        "camera_setting": "",
        "calib_dimension": size,
        "orig_dimension": size,
        "output_dimension": size,
        "frame_readout_time": 1e3 * profile.shutter.readout_time_s if profile.readout_known else None,
        "frame_readout_direction": _DIRECTIONS[profile.shutter.readout_direction],
        "gyro_lpf": None,
        "input_horizontal_stretch": 1.0,
        "input_vertical_stretch": 1.0,
        "num_images": 0,
        "fps": fps,
        "official": False,
        "asymmetrical": False,
        "fisheye_params": {
            "RMS_error": error_px,
            "camera_matrix": lens.matrix.tolist(),
            "distortion_coeffs": list(coefficients),
            "radial_distortion_limit": None,
        },
        "identifier": "",
        "calibrator_version": "virest",
    }
    return json_text(content), error_px


_DIRECTIONS = {
    "top_to_bottom": "TopToBottom",
    "bottom_to_top": "BottomToTop",
    "left_to_right": "LeftToRight",
    "right_to_left": "RightToLeft",
}


def fisheye_coefficients(lens: Intrinsics) -> tuple[tuple[float, ...], float]:
    """k1 to k4 of the equidistant model closest to the lens over the frame, and the largest error in pixels.

    Model: θ_d = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸); along a ray at angle θ the lens has the radius r_d.  Least
    squares over angles from the centre to the farthest corner; tangential terms are ignored.
    """
    if lens.model == "fisheye":
        return lens.coefficients, 0.0
    corners = np.array([[0.0, 0.0], [lens.width - 1.0, 0.0], [0.0, lens.height - 1.0]])
    corners = np.vstack([corners, [lens.width - 1.0, lens.height - 1.0]])
    rays = lens.rays(corners)
    most = float(np.arctan(np.linalg.norm(rays[:, :2] / rays[:, 2:], axis=1)).max())
    theta = np.linspace(most / FIT_ANGLES, most, FIT_ANGLES)
    radial = lens.coefficients if lens.model == "none" else (*lens.coefficients[:2], 0.0, 0.0, lens.coefficients[4])
    plain_lens = Intrinsics(lens.width, lens.height, lens.fx_px, lens.fx_px, 0.0, 0.0, lens.model, radial)
    rays = np.stack([np.tan(theta), np.zeros_like(theta), np.ones_like(theta)], axis=1)
    distorted = plain_lens.project(rays)[:, 0] / lens.fx_px
    powers = theta[:, None] ** np.array([3, 5, 7, 9])
    found, *_ = np.linalg.lstsq(powers, distorted - theta, rcond=None)
    error_px = lens.fx_px * float(np.abs(theta + powers @ found - distorted).max())
    return tuple(found.tolist()), error_px
