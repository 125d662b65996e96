"""A folder of MARSLogger on Android: which of its files exist, and what replaces missing ones."""

from __future__ import annotations

from pathlib import Path

from virest.capture.files import is_present, require_regular_file
from virest.capture.marslogger_android import (
    GYRO,
    METADATA,
    STAMPS,
    read_edge_epochs,
    read_frame_timestamps,
    read_gyro_accel,
    read_movie_metadata,
)
from virest.capture.records import Note
from virest.capture.source import EPOCHS, MOVIE, UNFINISHED, Source, present
from virest.capture.tables import EdgeEpochs, MetadataTable, StampTable
from virest.capture.video import probe_movie
from virest.errors import ClockError


def read_marslogger(folder: Path, notes: list[Note]) -> Source:
    """Read the files; metadata, stamps and clocks may be missing, each with a note. Raises CaptureError."""
    if is_present(folder / UNFINISHED):
        notes.append(Note("warning", "unfinished", f"{UNFINISHED} is there: the recording was not stopped cleanly"))
    gyro = read_gyro_accel(folder / GYRO)
    movie = probe_movie(folder / MOVIE)
    metadata = _read_metadata(folder, notes)
    stamps = _read_stamps(folder, metadata, notes)
    epochs = read_edge_epochs(folder / EPOCHS) if is_present(folder / EPOCHS) else EdgeEpochs("not logged", ())
    inputs = present(folder, MOVIE, STAMPS, METADATA, GYRO, EPOCHS)
    return Source("MARSLogger", folder / MOVIE, movie, gyro, stamps, metadata, epochs, inputs=inputs)


def _read_metadata(folder: Path, notes: list[Note]) -> MetadataTable | None:
    if not is_present(folder / METADATA):
        text = f"{METADATA} is missing: exposure, focal length and readout are unknown unless a profile has them"
        notes.append(Note("warning", "no-metadata", text))
        return None
    if require_regular_file(folder / METADATA) == 0:
        notes.append(Note("warning", "no-metadata", f"{METADATA} is empty: exposure, focal length, readout unknown"))
        return None
    table = read_movie_metadata(folder / METADATA)
    if not len(table.time_ns):
        notes.append(Note("warning", "no-metadata", f"{METADATA} has no rows: exposure, focal length, readout unknown"))
        return None
    return table


def _read_stamps(folder: Path, metadata: MetadataTable | None, notes: list[Note]) -> StampTable | None:
    """The timestamps; None, with a note, if they were never written and the metadata can replace them."""
    path, why = folder / STAMPS, ""
    if not is_present(path):
        why = "is missing"
    elif require_regular_file(path) == 0:
        why = "is empty"
    else:
        table = read_frame_timestamps(path)
        if len(table.time_ns):
            return table
        why = "has no rows"
    if metadata is None:
        text = f"{folder.name}/{STAMPS}: {why}, and there is no {METADATA}"
        raise ClockError(text, hint="frames have no times without either")
    text = f"{STAMPS} {why} (written only at a clean Stop): PTS were aligned with the rows of {METADATA} instead"
    notes.append(Note("warning", "no-stamps", text))
    return None
