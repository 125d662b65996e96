"""Sensor Logger (Android and iOS): one CSV file per sensor, and a movie in ``Camera/`` or beside them.

    Gyroscope.csv           time (ns since 1970), seconds_elapsed, z, y, x (rad/s); columns are found by name
    TotalAcceleration.csv   the same, m/s², with gravity; else Accelerometer.csv (without gravity) + Gravity.csv
    Metadata.csv            `platform` is android or ios; on iOS accelerations have the opposite sign
    Camera/<epoch ms>.mp4   named by the start of the session, a few hundred milliseconds before its first frame

Axes are the device's: x right, y up, z out of the screen.  Source: the app's published reference pages on coordinates,
units and video synchronisation.  The movie's start is known to 1 s at best, so the time offset is unknown.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from virest.capture.files import is_present, label, scan_text
from virest.capture.phone_tables import at_times, movie_stamps, note_exposures, without_accelerometer
from virest.capture.profile_source import phone_profile
from virest.capture.records import Note
from virest.capture.source import FileNames, Source, find_movie, present
from virest.capture.tables import Float64, GyroTable, Rows, make_gyro_table, read_rows
from virest.capture.video import probe_movie
from virest.errors import ImuError

GYROSCOPE, TOTAL, LINEAR, GRAVITY = "Gyroscope.csv", "TotalAcceleration.csv", "Accelerometer.csv", "Gravity.csv"
METADATA_CSV, CAMERA = "Metadata.csv", "Camera"
HEAD = ("time", "seconds_elapsed")
AXES = ("x", "y", "z")
STEPS_PER_S = {10: 1, 13: 10**3, 16: 10**6, 19: 10**9}
"""Digits of a time since 1970 in seconds, milliseconds, microseconds, nanoseconds."""
HINT = "copy the whole folder that the app exports"


def is_sensor_logger(folder: Path, names: set[str]) -> bool:
    """Whether the folder holds this app's gyroscope file, by its header."""
    if GYROSCOPE not in names or not (folder / GYROSCOPE).is_file():
        return False
    try:
        return columns_of(folder / GYROSCOPE)[:2] == HEAD
    except ImuError:
        return False


def read_sensor_logger(folder: Path, notes: list[Note]) -> Source:
    """Read an exported recording.  Raises CaptureError for missing or unusable files."""
    sensor = _read_sensor(folder / GYROSCOPE)
    place = folder / CAMERA if (folder / CAMERA).is_dir() else folder
    path = find_movie(place)
    movie = probe_movie(path)
    accel = _specific_force(folder, sensor, notes)
    gyro: GyroTable = make_gyro_table(
        folder / GYROSCOPE, sensor.time_ns, np.hstack([sensor.values, accel]), sensor.rows, sensor.dropped
    )
    start_ns = named_start_ns(path)
    if start_ns is None or not gyro.time_ns[0] - 10**10 <= start_ns <= gyro.time_ns[-1]:
        start_ns = int(gyro.time_ns[0])
        text = f"{label(path)}: its name gives no start time within the recording; that of {GYROSCOPE} is used"
        notes.append(Note("warning", "stamps-ambiguous", text))
    note_exposures(notes)
    names = FileNames(path.name, f"the PTS of {path.name}", path.name, GYROSCOPE)
    inputs = (path, *present(folder, GYROSCOPE, TOTAL, LINEAR, GRAVITY, METADATA_CSV))
    profile = phone_profile(movie.width, movie.height, "Sensor Logger")
    stamps = movie_stamps(movie, start_ns)
    return Source("Sensor Logger", path, movie, gyro, stamps, names=names, profile=profile, inputs=inputs)


def columns_of(path: Path) -> tuple[str, ...]:
    """Names in a CSV file's first line, in lower case.  Raises ImuError if it is not text."""
    head = scan_text(path, ImuError, HINT).head.lstrip("\ufeff").splitlines()
    return tuple(name.strip().strip('"').lower() for name in head[0].split(",")) if head else ()


def named_start_ns(movie: Path) -> int | None:
    """The start time in a movie's name, nanoseconds since 1970; None if the name is not such a number."""
    digits = re.fullmatch(r"\d{10}(?:\d{3}){0,3}", movie.stem)
    if digits is None:
        return None
    return int(movie.stem) * (10**9 // STEPS_PER_S[len(movie.stem)])


def _read_sensor(path: Path) -> Rows:
    """Time and x, y, z of a sensor's file, with columns in any order."""
    columns = columns_of(path)
    missing = [axis for axis in AXES if axis not in columns]
    if missing or columns[:1] != ("time",):
        text = f"{label(path)}: columns are {', '.join(columns)[:80] or 'none'}"
        raise ImuError(text, hint="expected time, seconds_elapsed, z, y, x")
    return read_rows(path, [columns.index(axis) for axis in AXES], required=3, hint=HINT)


def _specific_force(folder: Path, gyro: Rows, notes: list[Note]) -> Float64:
    """Specific force, m/s², +9.8 upwards at rest, at the gyroscope's times; NaN where unknown."""
    files = [name for name in (TOTAL,) if is_present(folder / name)]
    files = files or [name for name in (LINEAR, GRAVITY) if is_present(folder / name)]
    if files == [LINEAR] or files == [GRAVITY] or not files:
        without_accelerometer(folder, f"it needs {TOTAL}, or {LINEAR} and {GRAVITY}", notes)
        return np.full((len(gyro.time_ns), 3), np.nan)
    parts = [_read_sensor(folder / name) for name in files]
    total = np.sum([at_times(gyro.time_ns, part.time_ns, part.values) for part in parts], axis=0)
    return -total if _is_ios(folder) else total


def _is_ios(folder: Path) -> bool:
    """Whether Metadata.csv names iOS, where accelerations have the opposite sign."""
    path = folder / METADATA_CSV
    if not path.is_file():
        return False
    lines = scan_text(path, ImuError, HINT).head.lstrip("\ufeff").splitlines()
    if len(lines) < 2:
        return False
    names, values = ([field.strip().strip('"').lower() for field in line.split(",")] for line in lines[:2])
    return dict(zip(names, values, strict=False)).get("platform") == "ios"
