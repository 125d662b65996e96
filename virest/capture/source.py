"""The result of every reader of recordings: the same tables for every kind, and the names of their files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from virest.camera.profile import CameraProfile
from virest.capture.files import is_present, label
from virest.capture.marslogger_android import GYRO, METADATA, STAMPS
from virest.capture.pictures import MOVIE_SUFFIXES
from virest.capture.tables import EdgeEpochs, GyroTable, MetadataTable, StampTable
from virest.capture.video import MovieIndex
from virest.errors import CaptureError, VideoError

MOVIE, EPOCHS, UNFINISHED = "movie.mp4", "edge_epochs.txt", ".marslogger_recording_in_progress"
ONE_CLOCK = EdgeEpochs("one clock", ())
"""Of a recording whose stamps and samples share one clock by its format."""
ORIGIN_NS = 1_000_000_000_000
"""Timestamp of the first frame if a recording's clock starts with it: 1000 s, so that no time is negative."""


@dataclass(frozen=True, slots=True)
class FileNames:
    """Names of the files in messages."""

    movie: str = MOVIE
    stamps: str = STAMPS
    metadata: str = METADATA
    gyro: str = GYRO


@dataclass(frozen=True, slots=True)
class Source:
    """A recording that has been read but not yet joined."""

    kind: str
    """Such as ``MARSLogger`` or ``EuRoC``."""
    movie_path: Path
    """The movie, the list of pictures, or the folder of pictures."""
    movie: MovieIndex
    gyro: GyroTable
    stamps: StampTable | None
    metadata: MetadataTable | None = None
    epochs: EdgeEpochs = ONE_CLOCK
    names: FileNames = FileNames()
    profile: CameraProfile | None = None
    """The recorder's description of camera and axes; None: nothing beyond the metadata."""
    inputs: tuple[Path, ...] = ()
    """Files that were read."""


def list_names(folder: Path) -> list[str]:
    """Names in a folder, sorted. Raises CaptureError if it cannot be listed."""
    try:
        return sorted(entry.name for entry in folder.iterdir())
    except OSError as fault:
        raise CaptureError(f"{folder.name}: {fault.strerror}", hint="check the folder's permissions") from None


def find_movie(folder: Path, stem: str | None = None) -> Path:
    """The folder's movie: movie.mp4, else the one named ``stem``, else the only one. Raises VideoError."""
    names = [name for name in list_names(folder) if Path(name).suffix.lower() in MOVIE_SUFFIXES]
    for name in names:
        if (stem is None and name == MOVIE) or (stem is not None and Path(name).stem.lower() == stem.lower()):
            return folder / name
    if len(names) == 1:
        return folder / names[0]
    shown = ", ".join(names[:4]) if names else "no movie"
    hint = "leave one movie in the folder" if names else "copy the movie into the capture's folder"
    raise VideoError(f"{label(folder)}: holds {shown}; a capture needs one movie", hint=hint)


def present(folder: Path, *names: str) -> tuple[Path, ...]:
    """Paths of those names that exist in the folder."""
    return tuple(folder / name for name in names if is_present(folder / name))
