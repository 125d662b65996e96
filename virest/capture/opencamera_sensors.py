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

from virest.arrays import Mask
from virest.capture.files import label, scan_text
from virest.capture.phone_tables import at_times, note_exposures, without_accelerometer
from virest.capture.pictures import MOVIE_SUFFIXES
from virest.capture.profile_source import phone_profile
from virest.capture.records import Note
from virest.capture.source import FileNames, Source, find_movie, list_names
from virest.capture.tables import (
    Float64,
    Int64,
    Rows,
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
HINT, FOREIGN = "copy the app's whole folder", "is it the app's file?"


def is_opencamera_sensors(names: set[str]) -> bool:
    """Whether the folder holds this app's gyroscope and time files, by their names."""
    return _find(names, GYRO_ENDINGS) is not None and _find(names, STAMP_ENDINGS) is not None


def read_opencamera_sensors(folder: Path, notes: list[Note]) -> Source:
    """Read a recording.  Raises CaptureError for missing or unusable files."""
    names = set(list_names(folder))
    gyro_name, stamps_name = _find(names, GYRO_ENDINGS), _find(names, STAMP_ENDINGS)
    if gyro_name is None or stamps_name is None:
        raise ImuError(f"{label(folder)}: holds no *_gyro.csv with *_timestamps.csv", hint=HINT)
    path = _movie(folder, gyro_name)
    movie = probe_movie(path)
    sensor = _read_sensor(folder / gyro_name)
    accel_name = _find(names, ACCEL_ENDINGS)
    if accel_name is None:
        without_accelerometer(folder, "there is no *_accel.csv", notes)
        accel = np.full_like(sensor.values, np.nan)
    else:
        force = _read_sensor(folder / accel_name)
        accel = at_times(sensor.time_ns, force.time_ns, force.values)
    samples = np.hstack([sensor.values, accel])
    gyro = make_gyro_table(folder / gyro_name, sensor.time_ns, samples, sensor.rows, sensor.dropped)
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


def _read_sensor(path: Path) -> Rows:
    """Times and values (n, 3) of a file X, Y, Z, time (ns)."""
    time_ns, values, rows, dropped = _read_numbers(path, 4, ImuError)
    if len(time_ns) < 2:
        raise ImuError(f"{label(path)}: {len(time_ns)} usable of {rows} rows X, Y, Z, time (ns)", hint=FOREIGN)
    keep = keep_rising(time_ns, path, dropped)
    return Rows(time_ns[keep], values[keep], rows, dict(+dropped))


def _read_stamps(path: Path) -> StampTable:
    """Read one time in nanoseconds per line."""
    time_ns, _, rows, dropped = _read_numbers(path, 1, CaptureError)
    if not len(time_ns):
        raise CaptureError(f"{label(path)}: holds no time in nanoseconds", hint="record with the app's IMU switch on")
    return StampTable(time_ns[keep_rising(time_ns, path, dropped)], None, rows, dict(+dropped))


def _read_numbers(path: Path, fields: int, error: type[CaptureError]) -> tuple[Int64, Float64, int, Counter[str]]:
    """(times of the last field, values of the others, rows, dropped) of the usable rows, in the file's order."""
    scan_text(path, error, HINT)
    times, values = [np.zeros(0, np.int64)], [np.zeros((0, fields - 1))]
    spoilt: list[Mask] = [np.zeros(0, bool)]
    for chunk in text_chunks(path, fields=fields):
        time_ns = whole_numbers(chunk[fields - 1])
        table = np.stack([numbers(chunk[column]) for column in range(fields)], axis=1)
        good = (time_ns > 0) & np.isfinite(table).all(axis=1)
        blank = (chunk[0].str.strip() == "").to_numpy()
        spoilt.append(~good[~blank])
        times.append(time_ns[good])
        values.append(table[good, :-1])
    bad = np.concatenate(spoilt)
    header = int(np.argmin(bad)) if not bad.all() else 0
    dropped = Counter({"cut or unreadable row": int(bad[header:].sum())})
    return np.concatenate(times), np.concatenate(values), len(bad) - header, dropped
