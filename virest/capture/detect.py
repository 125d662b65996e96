"""The kind of recording in a folder, detected from its files and their headers, never from a name or a version.

EuRoC / ASL       mav0/ with cam*/data.csv and imu0/data.csv; the sequence, its mav0, or one camera of it
ARKit app         frames.csv, imu.csv and the movie
MARSLogger, iOS   movie_metadata.csv with `exposure duration`, or raw_accel_gyro.csv, and the movie
Gyroflow          a .gcsv beside the movie
Sensor Logger     Gyroscope.csv with `time, seconds_elapsed`, and a movie below Camera/
OpenCamera-Sensors  VID_*gyro.csv and VID_*timestamps.csv
Stray Scanner     camera_matrix.csv, odometry.csv, imu.csv and rgb.mp4
MARSLogger        movie.mp4, gyro_accel.csv, …
pictures          pictures with stamps, gyro_accel.csv or imu.csv
telemetry         only a movie: GoPro, Sony and Insta360 keep the samples inside
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from virest.capture.euroc import LIST, find_euroc, read_euroc, read_imu_rows
from virest.capture.gyroflow import GCSV, read_gyroflow
from virest.capture.marslogger_android import (
    GYRO,
    IOS_ARKIT,
    IOS_METADATA,
    METADATA,
    STAMPS,
    identify,
    read_edge_epochs,
    read_frame_timestamps,
    read_gyro_accel,
    read_movie_metadata,
)
from virest.capture.marslogger_folder import read_marslogger
from virest.capture.marslogger_ios import ARKIT_FRAMES, ARKIT_IMU, RAW_GYRO, read_ios_arkit, read_ios_marslogger
from virest.capture.opencamera_sensors import is_opencamera_sensors, read_opencamera_sensors
from virest.capture.picture_folder import IMU_FILES, read_picture_folder
from virest.capture.pictures import MOVIE_SUFFIXES, find_picture_source
from virest.capture.records import Note
from virest.capture.rosbag import is_bag
from virest.capture.sensor_logger import is_sensor_logger, read_sensor_logger
from virest.capture.source import EPOCHS, MOVIE, Source, list_names
from virest.capture.stray_scanner import is_stray_scanner, read_stray_scanner
from virest.capture.telemetry import read_telemetry
from virest.capture.video import probe_movie
from virest.errors import CaptureError

Reader = Callable[[Path, list[Note]], Source]
HEAD_BYTES = 4096
"""The first lines of a log, with the header that identifies it."""
LISTED = 6
"""Number of names of a folder that an error lists."""
HINT = "pass a capture folder: MARSLogger, EuRoC, images with timestamps, or a movie with .gcsv or embedded telemetry"


def read_source(folder: Path, notes: list[Note]) -> Source:
    """Read a folder with the reader of its kind. Raises CaptureError where no kind fits or a file cannot be used."""
    return choose_reader(folder)(folder, notes)


def choose_reader(folder: Path) -> Reader:
    """The reader of the folder's kind. Raises CaptureError with the folder's content if no kind fits."""
    names = list_names(folder)
    reader = _choose(folder, set(names))
    if reader is not None:
        return reader
    if is_bag(folder):
        raise CaptureError(f"{folder.name}: is a ROS 2 bag", hint="unpack it first: virest import BAG FOLDER")
    more = ", …" if len(names) > LISTED else ""
    instead = f" (it holds {', '.join(names[:LISTED])}{more})" if names else "; it is empty"
    text = f"{folder.name}: holds no {MOVIE} and no {GYRO}{instead}"
    raise CaptureError(text, hint=HINT)


def is_capture(folder: Path) -> bool:
    """Whether a folder looks like a capture of any kind."""
    try:
        return folder.is_dir() and _choose(folder, set(list_names(folder))) is not None
    except (CaptureError, OSError, ValueError):
        return False


def partial_readers(folder: Path) -> dict[Path, Callable[[Path], Any]]:
    """Readers of the single files of a folder that cannot be used as a whole, to report what is there."""
    try:
        reader = _choose(folder, set(list_names(folder)))
    except CaptureError:
        reader = None
    place = find_euroc(folder)
    if reader is read_euroc and place is not None:
        return {place.pictures: probe_movie, place.imu / LIST: read_imu_rows}
    loggers = (read_sensor_logger, read_opencamera_sensors, read_stray_scanner)
    if reader in (read_gyroflow, read_telemetry, read_picture_folder, read_ios_marslogger, read_ios_arkit, *loggers):
        movies = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in MOVIE_SUFFIXES]
        return dict.fromkeys(movies, probe_movie)
    tables = {MOVIE: probe_movie, STAMPS: read_frame_timestamps, METADATA: read_movie_metadata, GYRO: read_gyro_accel}
    return {folder / name: read for name, read in (tables | {EPOCHS: read_edge_epochs}).items()}


def _choose(folder: Path, names: set[str]) -> Reader | None:
    if find_euroc(folder) is not None:
        return read_euroc
    if {ARKIT_FRAMES, ARKIT_IMU} & names and IOS_ARKIT in (_kind(folder, ARKIT_FRAMES), _kind(folder, ARKIT_IMU)):
        return read_ios_arkit
    if RAW_GYRO in names or (METADATA in names and _kind(folder, METADATA) == IOS_METADATA):
        return read_ios_marslogger
    movies = [name for name in names if Path(name).suffix.lower() in MOVIE_SUFFIXES]
    if any(name.lower().endswith(GCSV) for name in names) and GYRO not in names:
        return read_gyroflow
    if is_sensor_logger(folder, names):
        return read_sensor_logger
    if is_opencamera_sensors(names):
        return read_opencamera_sensors
    if is_stray_scanner(names):
        return read_stray_scanner
    if MOVIE not in names and set(IMU_FILES) & names and find_picture_source(folder) is not None:
        return read_picture_folder
    if len(movies) == 1 and not {GYRO, STAMPS, METADATA, EPOCHS} & names:
        return read_telemetry
    return read_marslogger if {MOVIE, GYRO} & names else None


def _kind(folder: Path, name: str) -> str:
    """The kind of a file by its first lines, '' if they cannot be read."""
    path = folder / name
    try:
        if not path.is_file():
            return ""
        with path.open("rb") as stream:
            return identify(stream.read(HEAD_BYTES).decode("utf-8-sig", errors="replace"))
    except (OSError, ValueError):
        return ""
