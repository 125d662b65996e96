"""A folder of pictures with stamps, and inertial samples beside them.

pictures    listed in data.csv, rgb.txt, timestamps.csv, … ; or in order, one stamp each, in frame_timestamps.txt;
or named by their time in nanoseconds; here, or in data/, rgb/, images/, frames/, color/
samples     gyro_accel.csv as MARSLogger writes it, or imu.csv / imu.txt as EuRoC and TUM-VI do
metadata    movie_metadata.csv as MARSLogger writes it, optional
"""

from __future__ import annotations

from pathlib import Path

from virest.capture.euroc import note_missing_pictures, read_imu_rows
from virest.capture.files import is_present, label
from virest.capture.marslogger_android import GYRO, METADATA, read_edge_epochs, read_gyro_accel, read_movie_metadata
from virest.capture.pictures import find_picture_source, read_picture_list
from virest.capture.records import Note
from virest.capture.source import EPOCHS, ONE_CLOCK, FileNames, Source, present
from virest.capture.tables import MetadataTable, StampTable
from virest.capture.video import index_pictures
from virest.errors import VideoError

IMU_FILES = (GYRO, "imu.csv", "imu.txt")


def read_picture_folder(folder: Path, notes: list[Note]) -> Source:
    """Read pictures, their timestamps and the samples. Raises CaptureError for missing or unusable files."""
    path = find_picture_source(folder)
    if path is None:
        raise VideoError(f"{label(folder)}: no pictures with times", hint="list them in data.csv: time in ns, name")
    listed = read_picture_list(path)
    samples = next(iter(present(folder, *IMU_FILES)), folder / GYRO)
    gyro = read_gyro_accel(samples) if samples.name == GYRO else read_imu_rows(samples)
    movie = index_pictures(path, listed)
    note_missing_pictures(listed.dropped, label(path), notes)
    metadata: MetadataTable | None = None
    if is_present(folder / METADATA):
        metadata = read_movie_metadata(folder / METADATA)
    else:
        notes.append(Note("warning", "exposure-unknown", f"no {METADATA}: no exposure times, no deblurring"))
    epochs = read_edge_epochs(folder / EPOCHS) if is_present(folder / EPOCHS) else ONE_CLOCK
    stamps = StampTable(listed.time_ns, None, listed.rows, listed.dropped)
    names = FileNames(path.name, f"{path.name} (pictures)", METADATA, samples.name)
    inputs = (*([path] if path.is_file() else []), samples, *present(folder, METADATA, EPOCHS))
    return Source("pictures", path, movie, gyro, stamps, metadata, epochs, names, inputs=inputs)
