"""Shared by the readers of phone loggers: separate gyroscope and accelerometer files, the movie's own timestamps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from virest.capture.records import Note
from virest.capture.source import ORIGIN_NS
from virest.capture.tables import Float64, Int64, StampTable
from virest.capture.video import MovieIndex

G_M_S2 = 9.80665
"""Standard gravity, exact by definition (3rd CGPM, 1901): the unit of accelerations that are logged in g."""
NO_EXPOSURES = "the recorder logs no exposure times: frames are straightened, not deblurred, until they are known"


def at_times(time_ns: Int64, other_ns: Int64, values: Float64) -> Float64:
    """Samples (n, 3) of another sensor, interpolated linearly at these times; NaN outside its span."""
    if len(other_ns) < 2:
        return np.full((len(time_ns), 3), np.nan)
    zero = int(other_ns[0])
    at, known = (time_ns - zero) * 1e-9, (other_ns - zero) * 1e-9
    return np.stack([np.interp(at, known, values[:, k], np.nan, np.nan) for k in range(3)], axis=1)


def movie_stamps(movie: MovieIndex, start_ns: int = ORIGIN_NS) -> StampTable:
    """The movie's own timestamps, from a start on the inertial clock."""
    return StampTable(movie.pts_ns + start_ns, None, len(movie), {})


def note_exposures(notes: list[Note]) -> None:
    """Note that deblurring needs exposure times, which these recorders do not write."""
    notes.append(Note("warning", "exposure-unknown", NO_EXPOSURES))


def without_accelerometer(folder: Path, what: str, notes: list[Note]) -> None:
    """Note that the accelerometer cannot be used, and why."""
    notes.append(Note("warning", "accel-implausible", f"{folder.name}: {what}: the accelerometer is not used"))
