"""EuRoC / ASL folders, read and written; TUM-VI and TUM-RSVI come in them too.

    mav0/cam0/data.csv      #timestamp [ns],filename        mav0/cam0/data/<ns>.png
    mav0/cam0/sensor.yaml   T_BS (p_body = T_BS p_sensor), intrinsics, distortion, rate_hz
    mav0/imu0/data.csv      #timestamp [ns],gyroscope x y z [rad/s],accelerometer x y z [m/s^2]
    dso/cam0/times.txt      name, time in s, exposure in ms (TUM-VI), where it is there

A path to the sequence or to its mav0 means its first camera, a path to mav0/cam1 that camera.  The format lacks the
rolling shutter; two more keys are read and written: ``line_delay_nanoseconds`` (as in Kalibr), or ``readout_time_s``
with ``readout_direction``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from virest.arrays import Array
from virest.camera.intrinsics import COEFFICIENT_NAMES
from virest.camera.kalibr import ImuNoise, parse_camchain
from virest.camera.profile import CameraProfile
from virest.camera.profile_file import parse_profile
from virest.camera.yaml_mapping import commented, load_yaml_mapping
from virest.capture.files import is_present, label, scan_text
from virest.capture.pictures import read_picture_list
from virest.capture.records import Note
from virest.capture.source import FileNames, Source
from virest.capture.tables import (
    GyroTable,
    MetadataTable,
    StampTable,
    make_gyro_table,
    make_metadata_table,
    read_rows,
)
from virest.capture.video import MovieIndex, index_pictures
from virest.errors import CaptureError, ImuError, SettingsError

SENSOR, LIST, TIMES = "sensor.yaml", "data.csv", "times.txt"
CHAINS = ("camchain-imucam.yaml", "camchain.yaml", "dso/camchain.yaml")
DISTORTIONS = {"radial-tangential": "radtan", "radtan": "radtan", "equidistant": "fisheye", "none": "none"}
IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
"""Rotation of a camera whose pose is not given."""


@dataclass(frozen=True, slots=True)
class EurocPlace:
    """Which camera and which inertial sensor of a sequence."""

    root: Path
    """The sequence."""
    camera: Path
    """Such as mav0/cam0."""
    imu: Path

    @property
    def pictures(self) -> Path:
        """The list of the camera's pictures, or their folder if there is no list."""
        return self.camera / LIST if is_present(self.camera / LIST) else self.camera / "data"


def find_euroc(folder: Path) -> EurocPlace | None:
    """The sequence that a folder is or belongs to; None if there is none."""
    try:
        if (folder / "mav0").is_dir():
            return _first_camera(folder, folder / "mav0")
        if (folder / "imu0").is_dir():
            return _first_camera(folder if folder.name != "mav0" else folder.parent, folder)
        if _is_camera(folder) and (folder.parent / "imu0").is_dir():
            root = folder.parent.parent if folder.parent.name == "mav0" else folder.parent
            return EurocPlace(root, folder, folder.parent / "imu0")
    except (OSError, ValueError):
        return None
    return None


def _first_camera(root: Path, body: Path) -> EurocPlace | None:
    cameras = sorted(entry for entry in body.iterdir() if entry.name.startswith("cam") and _is_camera(entry))
    if not cameras:
        return EurocPlace(root, body / "cam0", body / "imu0") if (body / "cam0").is_dir() else None
    return EurocPlace(root, cameras[0], body / "imu0")


def _is_camera(folder: Path) -> bool:
    return (folder / "data").is_dir()


# ── read ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def read_euroc(folder: Path, notes: list[Note]) -> Source:
    """Read a sequence, or one camera of it. Raises CaptureError for what is missing or cannot be used."""
    place = find_euroc(folder)
    if place is None:
        raise CaptureError(f"{label(folder)}: is not a EuRoC sequence", hint="pass the folder that holds mav0")
    listed = read_picture_list(place.pictures)
    gyro = read_imu_rows(place.imu / LIST)
    movie = index_pictures(place.pictures, listed)
    note_missing_pictures(listed.dropped, label(place.pictures), notes)
    stamps = StampTable(listed.time_ns, None, listed.rows, listed.dropped)
    times = place.root / "dso" / place.camera.name / TIMES
    metadata = read_exposure_times(times) if is_present(times) else None
    if metadata is None:
        notes.append(Note("warning", "exposure-unknown", f"no dso/{place.camera.name}/{TIMES}: no deblurring"))
    profile, described = _profile(place, movie, notes)
    files = (place.pictures, place.imu / LIST, *([times] if metadata else []), *described)
    pictures, exposures = label(place.pictures), f"dso/{place.camera.name}/{TIMES}"
    names = FileNames(pictures, pictures, exposures, label(place.imu / LIST))
    inputs = tuple(file for file in files if file.is_file())
    return Source("EuRoC", place.pictures, movie, gyro, stamps, metadata, names=names, profile=profile, inputs=inputs)


def note_missing_pictures(dropped: dict[str, int], name: str, notes: list[Note]) -> None:
    """Note how many listed pictures are missing."""
    if missing := dropped.get("picture is missing"):
        notes.append(Note("warning", "pictures-missing", f"{name}: {missing} listed pictures are missing"))


def read_imu_rows(path: Path) -> GyroTable:
    """Read inertial rows: time, gyroscope x y z (rad/s), accelerometer x y z (m/s²), by commas or by spaces.

    Raises ImuError (missing, no rows), ClockError (times).
    """
    hint = "inertial samples are needed: time, gx, gy, gz, ax, ay, az"
    scan = scan_text(path, ImuError, hint)
    separator = "," if "," in scan.head else r"\s+"
    rows = read_rows(path, range(1, 7), separator=separator, hint=hint)
    return make_gyro_table(path, rows.time_ns, rows.values, rows.rows, rows.dropped, hint)


def read_exposure_times(path: Path) -> MetadataTable | None:
    """Read TUM-VI's times.txt: name, time in seconds, exposure in milliseconds; None without exposures."""
    table = read_rows(path, (1, 2), separator=r"\s+", error=CaptureError)
    if not len(table.time_ns) or not np.isfinite(table.values[:, 1]).any():
        return None
    # in TUM-VI the first column is the picture's name, which is its time in ns; otherwise use the seconds in the second
    named = len(str(int(table.time_ns[0]))) < 15
    time_ns = np.rint(table.values[:, 0] * 1e9).astype(np.int64) if named else table.time_ns
    return make_metadata_table(time_ns, table.rows, table.dropped, exposure_s=table.values[:, 1] * 1e-3)


def _profile(place: EurocPlace, movie: MovieIndex, notes: list[Note]) -> tuple[CameraProfile | None, list[Path]]:
    """The camera of sensor.yaml, else of a Kalibr camera chain beside the sequence, and the files read for it."""
    path = place.camera / SENSOR
    found: CameraProfile | None = None
    files: list[Path] = []
    if is_present(path):
        found, files = parse_sensor(_mapping(path), _imu_from_body(place), label(path), movie, notes), [path]
    chain = next((place.root / name for name in CHAINS if is_present(place.root / name)), None)
    if (found is None or found.intrinsics is None) and chain is not None:
        found, files = _from_chain(chain, place.camera.name, movie, notes), [chain]
    if found is None:
        found = CameraProfile(movie.width, movie.height, readout_known=False, r_cam_imu=IDENTITY)
        text = f"no {SENSOR}: assuming that camera and IMU axes agree; give camera.yaml"
        notes.append(Note("warning", "axes-unknown", text))
    return found, files


def _mapping(path: Path) -> dict[str, Any]:
    try:
        return load_yaml_mapping(path)
    except SettingsError as fault:
        raise CaptureError(f"{label(path)}: {fault.message}", hint="repair or remove it") from None


def _from_chain(chain: Path, camera: str, movie: MovieIndex, notes: list[Note]) -> CameraProfile | None:
    try:
        profile = parse_camchain(_mapping(chain), label(chain), camera)
    except SettingsError as fault:
        raise CaptureError(str(fault), hint="repair or remove it") from None
    return _of_size(profile, movie, label(chain), notes)


def _imu_from_body(place: EurocPlace) -> Array:
    """T_imu_body of imu0/sensor.yaml; the identity if it has none."""
    path = place.imu / SENSOR
    pose = _pose(_mapping(path).get("T_BS"), label(path)) if is_present(path) else None
    return np.eye(4) if pose is None else _inverse(pose)


def parse_sensor(
    content: dict[str, Any], imu_from_body: Array, name: str, movie: MovieIndex, notes: list[Note]
) -> CameraProfile | None:
    """Turn a camera's sensor.yaml into a profile; the time offset and everything that the file lacks stay unknown.

    imu_from_body: (4, 4).  Raises CaptureError for unusable values.
    """
    pose = _pose(content.get("T_BS"), name)
    if pose is None:
        notes.append(Note("warning", "axes-unknown", f"{name}: no T_BS: assuming that camera and IMU axes agree"))
        pose = _inverse(imu_from_body)
    size = content.get("resolution", [movie.width, movie.height])
    if not isinstance(size, list) or len(size) != 2:
        raise CaptureError(f"{name}: resolution must be width and height", hint="repair it, or give camera.yaml")
    shutter: dict[str, Any] = {"readout_direction": content.get("readout_direction", "top_to_bottom")}
    if content.get("line_delay_nanoseconds") is not None:
        lines = movie.width if shutter["readout_direction"] in ("left_to_right", "right_to_left") else movie.height
        shutter["readout_time_s"] = _number(content["line_delay_nanoseconds"], name) * 1e-9 * lines
    elif content.get("readout_time_s") is not None:
        shutter["readout_time_s"] = content["readout_time_s"]
    cam_imu = _inverse(pose) @ _inverse(imu_from_body)
    mapping = {
        "virest_profile": 1,
        "device": str(content.get("comment") or ""),
        "image": {"width": size[0], "height": size[1]},
        "intrinsics": _lens(content, name, notes),
        "shutter": shutter,
        "imu": {"T_cam_imu": [*cam_imu[:3].tolist(), [0, 0, 0, 1]], "time_offset_s": None},
    }
    try:
        return _of_size(parse_profile(mapping, name), movie, name, notes)
    except SettingsError as fault:
        raise CaptureError(str(fault), hint="repair it, or give camera.yaml") from None


def _of_size(profile: CameraProfile, movie: MovieIndex, name: str, notes: list[Note]) -> CameraProfile:
    """The profile if its picture size matches the movie's; else without its lens, and with a note."""
    if (profile.width, profile.height) == (movie.width, movie.height):
        return profile
    text = (
        f"{name}: describes {profile.width}x{profile.height} pictures, but these are {movie.width}x{movie.height}: its "
        "lens is ignored; give camera.yaml"
    )
    notes.append(Note("warning", "sensor-size", text))
    return replace(profile, width=movie.width, height=movie.height, intrinsics=None)


def _lens(content: dict[str, Any], name: str, notes: list[Note]) -> dict[str, Any]:
    """The ``intrinsics`` of a profile; empty, with a note, for unsupported camera models."""
    values = content.get("intrinsics")
    if values is None:
        notes.append(Note("warning", "fx-unknown", f"{name}: no intrinsics"))
        return {}
    model, kind = str(content.get("camera_model", "pinhole")), str(content.get("distortion_model", "none")).lower()
    if model != "pinhole" or kind not in DISTORTIONS or not isinstance(values, list) or len(values) != 4:
        text = f"{name}: {model} camera with {kind} distortion and {_shown(values)}: not used; give camera.yaml"
        notes.append(Note("warning", "lens-model", text))
        return {}
    given = content.get("distortion_coefficients") or []
    names = COEFFICIENT_NAMES[DISTORTIONS[kind]]  # radial-tangential may lack the last
    if not isinstance(given, list) or (names and not 4 <= len(given) <= len(names)):
        raise CaptureError(f"{name}: distortion_coefficients must be {len(names)} numbers", hint="repair it")
    distortion = {"model": DISTORTIONS[kind], **dict(zip(names, given, strict=False))}
    return {**dict(zip(("fx_px", "fy_px", "cx_px", "cy_px"), values, strict=True)), "distortion": distortion}


def _shown(values: Any) -> str:
    return f"{len(values)} intrinsics" if isinstance(values, list) else "no list of intrinsics"


def _number(value: Any, name: str) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise CaptureError(f"{name}: {str(value)[:40]!r} is not a number", hint="repair it") from None


def _pose(block: Any, name: str) -> Array | None:
    """(4, 4) pose from EuRoC's matrix or from four rows; None if there is none."""
    if block is None:
        return None
    values = block.get("data") if isinstance(block, dict) else block
    try:
        matrix = np.array(values, float).reshape(4, 4)
    except (TypeError, ValueError, OverflowError):
        matrix = np.full((4, 4), np.nan)
    rotation = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):  # products of huge entries overflow
        is_rigid = np.abs(rotation @ rotation.T - np.eye(3)).max() <= 1e-2
    if not (is_rigid and np.isfinite(matrix).all() and np.allclose(matrix[3], (0, 0, 0, 1))):
        raise CaptureError(f"{name}: T_BS is not a 4x4 rigid transform", hint="repair it")
    return matrix


# ── write ────────────────────────────────────────────────────────────────────────────────────────────────────────


def format_picture_list(time_ns: list[int]) -> str:
    """EuRoC's cam0/data.csv; pictures are named by their time."""
    return "#timestamp [ns],filename\n" + "".join(f"{time},{time}.png\n" for time in time_ns)


def format_imu_rows(time_ns: NDArray[np.int64], gyro_rad_s: Array, accel_m_s2: Array) -> str:
    """EuRoC's imu0/data.csv, with digits enough to read back the same numbers."""
    values = np.hstack([gyro_rad_s, accel_m_s2]).tolist()
    rows = (f"{time},{','.join(map(repr, row))}\n" for time, row in zip(time_ns.tolist(), values, strict=True))
    return IMU_HEADER + "\n" + "".join(rows)


def format_exposure_times(time_ns: list[int], exposures_s: list[float]) -> str:
    """TUM-VI's dso/cam0/times.txt."""
    rows = (f"{t} {seconds(t)} {1e3 * e!r}\n" for t, e in zip(time_ns, exposures_s, strict=True))
    return "# name timestamp[s] exposure[ms]\n" + "".join(rows)


def seconds(time_ns: int) -> str:
    """Seconds with nine decimals, exactly."""
    whole, rest = divmod(time_ns, 10**9)
    return f"{whole}.{rest:09d}"


def format_camera_sensor(profile: CameraProfile, rate_hz: float, comments: list[str]) -> str:
    """A camera's sensor.yaml; the body is the inertial sensor. Raises SettingsError without a focal length."""
    lens = profile.intrinsics
    if lens is None:
        raise SettingsError("sensor.yaml needs a focal length", hint="give --config, or calibrate with --with focal")
    kind, names = ("equidistant", "k1 k2 k3 k4") if lens.model == "fisheye" else ("radial-tangential", "k1 k2 p1 p2")
    held = lens.named_coefficients
    names += " k3" if lens.model == "radtan" and held["k3"] else ""
    body_from_cam = _inverse(profile.pose_cam_imu)
    content: dict[str, Any] = {
        "sensor_type": "camera",
        "comment": profile.device or "camera",
        "T_BS": {"cols": 4, "rows": 4, "data": [float(v) for v in body_from_cam.ravel()]},
        "rate_hz": rate_hz,
        "resolution": [profile.width, profile.height],
        "camera_model": "pinhole",
        "intrinsics": [lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px],
        "distortion_model": kind,
        "distortion_coefficients": [held.get(name, 0.0) for name in names.split()],
    }
    shutter = profile.shutter
    if profile.readout_known and shutter.readout_direction == "top_to_bottom":
        content["line_delay_nanoseconds"] = 1e9 * shutter.readout_time_s / profile.height
    elif profile.readout_known:
        content |= {"readout_time_s": shutter.readout_time_s, "readout_direction": shutter.readout_direction}
    return commented(comments) + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110)


def format_imu_sensor(noise: ImuNoise, comments: list[str]) -> str:
    """The inertial sensor's sensor.yaml, without densities that are unknown."""
    content: dict[str, Any] = {
        "sensor_type": "imu",
        "comment": "phone",
        "T_BS": {"cols": 4, "rows": 4, "data": [float(v) for v in np.eye(4).ravel()]},
        "rate_hz": noise.update_rate_hz,
    }
    densities = {
        "gyroscope_noise_density": noise.gyro_density,
        "gyroscope_random_walk": noise.gyro_walk,
        "accelerometer_noise_density": noise.accel_density,
        "accelerometer_random_walk": noise.accel_walk,
    }
    content |= {key: float(f"{value:.6g}") for key, value in densities.items() if value}
    return commented(comments) + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110)


def _inverse(pose: Array) -> Array:
    return np.asarray(np.linalg.inv(pose), np.float64) + 0.0  # no −0
