"""Gyroflow's text log beside a movie: a header of ``key,value`` lines, then rows of integer counts to be scaled.

    GYROFLOW IMU LOG          or CAMERA IMU LOG
    orientation,YxZ           which column is Gyroflow's X, Y, Z; lower case: sign reversed
    tscale,0.001              seconds per count; gscale: rad/s; ascale: g
    frame_readout_time,15.23  ms; frame_readout_direction 0 … 3: down, up, right, left
    t,gx,gy,gz[,ax,ay,az[,mx,my,mz]]

Gyroflow's axes are X up, Y left, Z back, as seen from the camera: the device axes of a phone held in landscape.
The log's clock starts with the movie only to within the recorder's start-up time, so the time offset is unknown.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from virest.arrays import Array
from virest.camera.profile import LANDSCAPE_R_CAM_IMU, CameraProfile
from virest.camera.shutter import Shutter
from virest.capture.files import label, scan_text
from virest.capture.phone_tables import G_M_S2, movie_stamps
from virest.capture.records import Note
from virest.capture.source import ORIGIN_NS, FileNames, Source, find_movie, list_names
from virest.capture.tables import GyroTable, make_gyro_table, read_rows, scaled_times_ns
from virest.capture.video import MovieIndex, probe_movie
from virest.errors import CaptureError, ImuError

GCSV = ".gcsv"
FIRST_LINES = ("GYROFLOW IMU LOG", "CAMERA IMU LOG")
SCALES = {"tscale": 0.001, "gscale": 1.0, "ascale": 1.0}
"""Scales by key, with Gyroflow's defaults."""
DIRECTIONS = {
    **dict.fromkeys(("0", "toptobottom"), "top_to_bottom"),
    **dict.fromkeys(("1", "180", "bottomtotop"), "bottom_to_top"),
    **dict.fromkeys(("2", "270", "lefttoright"), "left_to_right"),
    **dict.fromkeys(("3", "90", "righttoleft"), "right_to_left"),
}


def read_gyroflow(folder: Path, notes: list[Note]) -> Source:
    """Read a .gcsv and the movie that it belongs to. Raises CaptureError for missing or unusable files."""
    path = _find_log(folder)
    header = read_header(path)
    gyro = read_log(path, header)
    movie_path = find_movie(folder, path.stem)
    movie = probe_movie(movie_path)
    stamps = movie_stamps(movie)
    note_unknown_exposure(path.name, notes)
    _note_mirror(header, path, notes)
    names = FileNames(movie_path.name, f"the PTS of {movie_path.name}", path.name, path.name)
    profile = film_profile(movie, header.get("vendor", ""), _readout_s(header, path), _direction(header))
    inputs = (movie_path, path)
    return Source("Gyroflow", movie_path, movie, gyro, stamps, names=names, profile=profile, inputs=inputs)


def film_profile(movie: MovieIndex, device: str, readout_s: float | None, direction: str) -> CameraProfile:
    """A camera with samples in Gyroflow's axes: x_cam = (−Y, −X, −Z); lens and time offset unknown."""
    return CameraProfile(
        width=movie.width,
        height=movie.height,
        device=device,
        shutter=Shutter(readout_s or 0.0, direction),
        readout_known=readout_s is not None,
        r_cam_imu=LANDSCAPE_R_CAM_IMU,
    )


def note_unknown_exposure(name: str, notes: list[Note]) -> None:
    """Note that such a recording never holds exposure times or a focal length."""
    text = f"{name} holds no exposure times and no focal length: no deblurring unless a profile and stamps give them"
    notes.append(Note("warning", "exposure-unknown", text))


def _note_mirror(header: dict[str, str], path: Path, notes: list[Note]) -> None:
    letters = header.get("orientation", "XYZ")
    if np.linalg.det(orientation_matrix(letters, label(path))) < 0:
        text = f"{path.name}: orientation {letters} is a reflection: right only for a logger with left-handed axes"
        notes.append(Note("warning", "mirrored-axes", text))


def _find_log(folder: Path) -> Path:
    logs = [name for name in list_names(folder) if name.lower().endswith(GCSV)]
    if len(logs) != 1:
        text = f"{label(folder)}: holds {len(logs)} {GCSV} files ({', '.join(logs[:4])})"
        raise ImuError(text, hint="one log and its movie make a capture")
    return folder / logs[0]


def read_header(path: Path) -> dict[str, str]:
    """The header's values by lower-case key. Raises ImuError if it is not such a log."""
    scan = scan_text(path, ImuError, "copy the log that lies beside the movie")
    lines = [line.strip() for line in scan.head.splitlines()]
    if not lines or lines[0] not in FIRST_LINES:
        text = f"{label(path)}: begins with {lines[0][:40] if lines else ''!r}, not {FIRST_LINES[0]}"
        raise ImuError(text, hint="is it a Gyroflow log?")
    header: dict[str, str] = {}
    for line in lines[1:]:
        key, _, value = line.partition(",")
        if key.strip().lower() in ("t", "time"):
            return header
        header[key.strip().lower()] = value.strip()
    raise ImuError(f"{label(path)}: has no line t,gx,gy,gz", hint="the log is truncated; copy it again")


def read_log(path: Path, header: dict[str, str]) -> GyroTable:
    """Samples in Gyroflow's axes, rad/s and m/s², on a clock that reads ORIGIN_NS at the first frame."""
    step_s, per_rad_s, per_g = (_scale(header, key, usual, path) for key, usual in SCALES.items())
    rows = read_rows(path, range(1, 7), times=scaled_times_ns(step_s), required=3)
    turn = orientation_matrix(header.get("orientation", "XYZ"), label(path))
    gyro, accel = rows.values[:, :3] * per_rad_s @ turn.T, rows.values[:, 3:] * (per_g * G_M_S2) @ turn.T
    samples = np.hstack([gyro, np.where(np.isfinite(accel).all(axis=1, keepdims=True), accel, np.nan)])
    table = make_gyro_table(path, rows.time_ns, samples, rows.rows, rows.dropped, "was the logger's gyroscope on?")
    return replace(table, time_ns=table.time_ns + ORIGIN_NS)


def orientation_matrix(letters: str, name: str = "orientation") -> Array:
    """(3, 3) that takes logged columns to Gyroflow's X, Y, Z: letter i names the column that is axis i.

    A reflection is accepted, as in Gyroflow: some loggers have left-handed axes.  Raises ImuError for letters that do
    not name the three axes.
    """
    text = letters.strip()
    matrix = np.zeros((3, 3))
    if sorted(text.upper()) == ["X", "Y", "Z"]:
        for row, letter in enumerate(text):
            matrix[row, "XYZ".index(letter.upper())] = 1.0 if letter.isupper() else -1.0
    if np.linalg.det(matrix) == 0.0:
        raise ImuError(f"{name}: orientation {text[:20]!r} names no three axes", hint="write three of XYZxyz, as YxZ")
    return matrix


def _scale(header: dict[str, str], key: str, usual: float, path: Path) -> float:
    try:
        value = float(header.get(key) or usual)
    except ValueError:
        value = 0.0
    if not 0.0 < value < 1e6:
        raise ImuError(f"{label(path)}: {key} is {header.get(key, '')[:40]!r}", hint="it must be a positive number")
    return value


def _readout_s(header: dict[str, str], path: Path) -> float | None:
    text = header.get("frame_readout_time")
    if text is None:
        return None
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < 1000.0:
        raise CaptureError(f"{label(path)}: frame_readout_time is {text[:40]!r}", hint="it must be milliseconds")
    return value * 1e-3


def _direction(header: dict[str, str]) -> str:
    word = header.get("frame_readout_direction", "0").lower().replace("_", "").replace(" ", "")
    return DIRECTIONS.get(word, "top_to_bottom")
