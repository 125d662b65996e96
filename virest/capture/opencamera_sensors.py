"""OpenCamera-Sensors (Android): a movie, and beside it or in a folder of its date the sensors and the frames' stamps.

    VID_<date>.mp4                  in DCIM/OpenCamera
    <date>/VID_<date>_gyro.csv      X, Y, Z (rad/s), time (ns); no header; older: VID_<date>gyro.csv
    <date>/VID_<date>_accel.csv     X, Y, Z (m/s²), time (ns)
    <date>/VID_<date>_timestamps.csv   time (ns) of each frame, on the sensors' clock

Axes are Android's device axes; pictures are stored in landscape, as the sensor reads them.  Source: the app's README.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from virest.capture.files import label
from virest.capture.phone_tables import at_times, note_exposures, without_accelerometer
from virest.capture.pictures import MOVIE_SUFFIXES
from virest.capture.profile_source import phone_profile
from virest.capture.records import Note
from virest.capture.source import FileNames, Source, find_movie, list_names
from virest.capture.tables import (
    Float64,
    Int64,
    StampTable,
    keep_rising,
    make_gyro_table,
    numbers,
    text_chunks,
    whole_numbers,
)
from virest.capture.video import probe_movie
from virest.errors import CaptureError, ImuError, VideoError

GYRO_ENDINGS, ACCEL_ENDINGS = ("_gyro.csv", "gyro.csv"), ("_accel.csv", "accel.csv")
STAMP_ENDINGS = ("_timestamps.csv", "_imu_timestamps.csv", "timestamps.csv")
PREFIX = "vid_"


def is_opencamera_sensors(names: set[str]) -> bool:
    """Whether the folder holds this app's gyroscope and time files, by their names."""
    return _find(names, GYRO_ENDINGS) is not None and _find(names, STAMP_ENDINGS) is not None


def read_opencamera_sensors(folder: Path, notes: list[Note]) -> Source:
    """Read a recording.  Raises CaptureError for missing or unusable files."""
    names = set(list_names(folder))
    gyro_name, stamps_name = _find(names, GYRO_ENDINGS), _find(names, STAMP_ENDINGS)
    if gyro_name is None or stamps_name is None:
        raise ImuError(
            f"{label(folder)}: holds no *_gyro.csv with *_timestamps.csv", hint="copy the app's whole folder"
        )
    path = _movie(folder, gyro_name)
    movie = probe_movie(path)
    time_ns, rates, rows = _read_sensor(folder / gyro_name)
    accel_name = _find(names, ACCEL_ENDINGS)
    if accel_name is None:
        without_accelerometer(folder, "there is no *_accel.csv", notes)
        accel = np.full_like(rates, np.nan)
    else:
        accel_ns, values, _ = _read_sensor(folder / accel_name)
        accel = at_times(time_ns, accel_ns, values)
    gyro = make_gyro_table(folder / gyro_name, time_ns, np.hstack([rates, accel]), rows, {})
    note_exposures(notes)
    files = FileNames(path.name, stamps_name, stamps_name, gyro_name)
    inputs = (path, *(folder / name for name in (gyro_name, accel_name, stamps_name) if name))
    profile = phone_profile(movie.width, movie.height, "OpenCamera-Sensors")
    stamps = _read_stamps(folder / stamps_name)
    return Source("OpenCamera-Sensors", path, movie, gyro, stamps, names=files, profile=profile, inputs=inputs)


def _find(names: set[str], endings: tuple[str, ...]) -> str | None:
    """The app's file with one of these endings."""
    found = [n for n in sorted(names) for end in endings if n.lower().startswith(PREFIX) and n.lower().endswith(end)]
    return found[0] if found else None


def _movie(folder: Path, gyro_name: str) -> Path:
    """The movie in the folder, or in its parent under the sensors' name."""
    if any(Path(name).suffix.lower() in MOVIE_SUFFIXES for name in list_names(folder)):
        return find_movie(folder)
    stem = gyro_name[: -len("gyro.csv")].rstrip("_").lower()
    above = folder.resolve().parent
    for name in list_names(above):
        if Path(name).stem.lower() == stem and Path(name).suffix.lower() in MOVIE_SUFFIXES:
            return above / name
    raise VideoError(f"{label(folder)}: no movie here, and no {stem}.mp4 above", hint="copy the movie into the folder")


def _read_sensor(path: Path) -> tuple[Int64, Float64, int]:
    """Times (n,), values (n, 3) and the number of rows of a file X, Y, Z, ns."""
    times: list[Int64] = [np.zeros(0, np.int64)]
    values: list[Float64] = [np.zeros((0, 3))]
    rows = 0
    for chunk in text_chunks(path, fields=4):
        rows += len(chunk)
        time_ns = whole_numbers(chunk[3])
        table = np.stack([numbers(chunk[column]) for column in range(3)], axis=1)
        good = (time_ns > 0) & np.isfinite(table).all(axis=1)
        times.append(time_ns[good])
        values.append(table[good])
    time_ns, table = np.concatenate(times), np.concatenate(values)
    if len(time_ns) < 2:
        raise ImuError(
            f"{label(path)}: {len(time_ns)} usable of {rows} rows X, Y, Z, time (ns)", hint="is it the app's file?"
        )
    keep = keep_rising(time_ns, path, Counter())
    return time_ns[keep], table[keep], rows


def _read_stamps(path: Path) -> StampTable:
    """Read one time in nanoseconds per line."""
    times = [whole_numbers(chunk[0]) for chunk in text_chunks(path, fields=1)]
    time_ns = np.concatenate([np.zeros(0, np.int64), *times])
    known = time_ns[time_ns > 0]
    if not len(known):
        raise CaptureError(f"{label(path)}: holds no time in nanoseconds", hint="record with the app's IMU switch on")
    return StampTable(known, None, len(time_ns), {})
