"""Movies that keep the inertial samples inside (GoPro, Sony, Insta360, …), by the `telemetry-parser` package.

The package gives milliseconds from the first frame, deg/s and m/s², in Gyroflow's axes (see `gyroflow`).
"""

from __future__ import annotations

import logging
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from virest.capture.files import label
from virest.capture.gyroflow import film_profile, note_unknown_exposure
from virest.capture.marslogger_android import GYRO
from virest.capture.phone_tables import movie_stamps
from virest.capture.records import Note
from virest.capture.source import ORIGIN_NS, FileNames, Source, find_movie
from virest.capture.tables import Float64, GyroTable, keep_rising, make_gyro_table
from virest.capture.video import probe_movie
from virest.errors import ImuError, one_line

log = logging.getLogger(__name__)

INSTALL = "pip install 'virest[telemetry]'"


def read_telemetry(folder: Path, notes: list[Note]) -> Source:
    """Read a movie and the samples inside it.

    Raises VideoError, and ImuError if the movie holds no samples or the package is not installed.
    """
    path = find_movie(folder)
    movie = probe_movie(path)
    camera, rows = _parse(path)
    gyro = gyro_table(path, rows)
    stamps = movie_stamps(movie)
    note_unknown_exposure(path.name, notes)
    names = FileNames(path.name, f"the PTS of {path.name}", path.name, path.name)
    profile = film_profile(movie, camera, None, "top_to_bottom")
    kind = f"telemetry ({camera})"
    return Source(kind, path, movie, gyro, stamps, names=names, profile=profile, inputs=(path,))


def _parse(path: Path) -> tuple[str, list[dict[str, Any]]]:
    """(camera, samples) of a movie, as the package gives them."""
    try:
        import telemetry_parser
    except ImportError:
        text = f"{label(path.parent)}: no {GYRO}, and reading samples from inside {path.name} needs telemetry-parser"
        raise ImuError(text, hint=f"{INSTALL}; or copy {GYRO}") from None
    try:
        parser = telemetry_parser.Parser(str(path.absolute()))
        camera = " ".join(part for part in (parser.camera, parser.model) if part)
        return camera, parser.normalized_imu()
    # the package is Rust: it raises OSError or ValueError for bad input, and a panic on internal errors
    except BaseException as fault:
        if isinstance(fault, KeyboardInterrupt | SystemExit | MemoryError):
            raise
        log.debug("%s: telemetry-parser: %s", path.name, fault)
        why = one_line(fault, 60).lower() or type(fault).__name__
        text = f"{label(path)}: holds no inertial samples that telemetry-parser can read ({why})"
        raise ImuError(
            text, hint=f"copy {GYRO} or a .gcsv into the folder; a copied movie loses its telemetry"
        ) from None


def gyro_table(path: Path, samples: list[dict[str, Any]]) -> GyroTable:
    """The package's samples as a table; rows without gyroscope are dropped, a missing acceleration is NaN."""
    time_ms = np.array([row.get("timestamp_ms", np.nan) for row in samples], float).reshape(-1)
    gyro = np.deg2rad(_vectors(samples, "gyro"))
    accel = _vectors(samples, "accl")
    known = np.isfinite(time_ms) & (np.abs(time_ms) < 1e12)
    time_ns = np.rint(time_ms[known] * 1e6).astype(np.int64) + ORIGIN_NS
    dropped: Counter[str] = Counter({"no time": int((~known).sum())})
    keep = keep_rising(time_ns, path, dropped)
    values = np.hstack([gyro, accel])[known][keep]
    hint = "the movie's telemetry has no gyroscope; is it a copy, or a mode that does not record it?"
    return make_gyro_table(path, time_ns[keep], values, len(samples), dict(+dropped), hint)


def _vectors(samples: list[dict[str, Any]], key: str) -> Float64:
    """(n, 3), NaN where missing."""
    nothing = (np.nan, np.nan, np.nan)
    return np.array([row.get(key) or nothing for row in samples], float).reshape(-1, 3)
