"""Readers for the files of MARSLogger on Android; variants are distinguished by the header, never by the version.

gyro_accel.csv        7, 8 or 11 columns, or the build that adds the position (8 fields before a fix, 12 after)
movie_metadata.csv    11 or 12 columns, two pre-release spellings, the fork with OIS for AF mode
frame_timestamps.txt  1 or 2 columns; pre-release: no header, microseconds
edge_epochs.txt       the camera's clock against the IMU's

Times are integer nanoseconds and stay int64.  Each reader returns its table and counts the dropped rows by reason.
"""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from virest.arrays import Mask
from virest.capture.files import TextScan, label, read_small_text, scan_text
from virest.capture.tables import (
    DAMAGED_TIME,
    EXCEL_HINT,
    INTEGER,
    MAX_FIELDS,
    EdgeEpochs,
    Float64,
    GyroTable,
    Int64,
    MetadataTable,
    StampTable,
    cut_field,
    keep_rising,
    make_gyro_table,
    make_metadata_table,
    numbers,
    text_chunks,
    whole_numbers,
)
from virest.errors import CaptureError, ClockError, ImuError

if TYPE_CHECKING:
    import pandas as pd

MICROSECOND_GAP_LIMIT = 1_000_000
"""Timestamps without a header are in microseconds if their median step is below this (1000 frames/s in ns)."""

CLOCK_STEP_NS = 1_000_000_000
"""A clock that passes through zero has its next positive time within this."""

GYRO, METADATA, STAMPS, POSITION, IOS_METADATA, IOS_ARKIT, NO_SENSOR, BARE_STAMPS, UNKNOWN = (
    "gyro_accel.csv",
    "movie_metadata.csv",
    "frame_timestamps.txt",
    "gps.csv",
    "movie_metadata.csv of the iOS app",
    "frames.csv or imu.csv of the ARKit app",
    "no gyroscope",
    "stamps without a header",
    "unknown",
)


# ── what a file is ───────────────────────────────────────────────────────────────────────────────────────────────


def normalised_columns(line: str) -> tuple[str, ...]:
    """Column names in lower case without spaces, units in one spelling."""
    names = (re.sub(r"\s+", "", name).strip('"').lower() for name in line.strip().split(","))
    return tuple(name.replace("[ns]", "[nanosec]") for name in names)


def identify(head: str) -> str:
    """Which of the loggers' files begins with this head."""
    line = next((text for text in head.splitlines() if text.strip()), "")
    names = set(normalised_columns(line))
    if "may not have a gyroscope" in head[:400] or "has gyroscope?" in head[:400].lower():
        return GYRO if "gx[rad/s]" in head else NO_SENSOR
    if "gx[rad/s]" in names:
        return GYRO
    if names & {"exposuretime[nanosec]", "aftmode"}:
        return METADATA
    if "exposureduration[nanosec]" in names or "exposureduration[sec]" in names:
        return IOS_METADATA
    if names & {"frame_timestamp_s", "motion_timestamp_s"}:
        return IOS_ARKIT
    if "frametimestamp[nanosec]" in names:
        return STAMPS
    if "lat[deg]" in names:
        return POSITION
    return BARE_STAMPS if INTEGER.fullmatch(line.strip()) else UNKNOWN


def _require_kind(scan: TextScan, path: Path, expected: str, error: type[CaptureError]) -> None:
    """Raise ``error`` unless the file is what its name says."""
    name = label(path)
    if not scan.head.strip():
        raise error(f"{name}: is empty", hint="was the recording stopped with Stop? copy it from the phone again")
    kind = identify(scan.head)
    if kind == expected or (expected == STAMPS and kind == BARE_STAMPS):
        return
    line = scan.first_line
    separated = [mark for mark in ("\t", ";") if mark in line and identify(scan.head.replace(mark, ",")) == expected]
    if separated:
        mark = "tabs" if separated[0] == "\t" else "semicolons"
        raise ClockError(f"{name}: columns are separated by {mark}, not commas", hint=EXCEL_HINT)
    if kind == NO_SENSOR:
        raise ImuError(
            f"{name}: the logger reports that the phone has no gyroscope or no accelerometer",
            hint="nothing can be estimated without a gyroscope; record with another phone",
        )
    shown = line.strip()[:60]
    if kind == UNKNOWN:
        raise error(f"{name}: its first line '{shown}' is not a header of {expected}", hint="is it the logger's file?")
    raise error(f"{name}: holds the columns of {kind}, not of {expected}", hint="were two files swapped?")


# ── rows ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def _split_rows(
    chunk: pd.DataFrame, first_column: str, min_fields: int, path: Path, dropped: Counter[str]
) -> tuple[pd.DataFrame, Int64]:
    """Rows that begin with an integer time, and those times. Raises ClockError for times that lost their precision."""
    text = chunk[0].str.strip()
    lowered = text.str.lower().str.replace(r"\s+", "", regex=True).str.replace("[ns]", "[nanosec]", regex=False)
    is_header = (lowered == first_column).to_numpy()
    is_comment = (text == "").to_numpy() | text.str.startswith("#").to_numpy()
    is_comment |= text.str.contains("gyroscope|accelerometer|IMU data").to_numpy()
    whole = text.str.fullmatch(INTEGER).to_numpy()
    damaged = text.str.fullmatch(DAMAGED_TIME).to_numpy() | text.str.contains("\t", regex=False).to_numpy()
    if damaged.any():
        shown = "<tab>".join(" ".join(part.split()) for part in text[damaged].iloc[0][:40].split("\t"))
        raise ClockError(f"{label(path)}: time '{shown}' is not a whole number of nanoseconds", hint=EXCEL_HINT)
    enough = (chunk[min_fields - 1] != "").to_numpy()
    times = np.zeros(len(chunk), np.int64)
    times[whole] = text[whole].astype("int64").to_numpy()
    dropped["cut or unreadable row"] += int((~is_header & ~is_comment & ~(whole & enough)).sum())
    dropped["header repeated"] += int(is_header.sum())
    good = whole & enough
    return chunk[good], times[good]


def _count_rows(times: Int64, dropped: Counter[str]) -> int:
    """Number of data rows, read and dropped, without the header."""
    dropped["header repeated"] = max(dropped["header repeated"] - 1, 0)
    return len(times) + sum(dropped.values())


def _keep_times(times: Int64, path: Path, dropped: Counter[str]) -> Mask:
    """Mask of times that rise strictly.

    Times of zero or below are invalid first samples, unless the clock passes through zero: the next positive time is
    then near.  Raises ClockError if most rows would be dropped.
    """
    low = times <= 0
    if low.any() and not low.all() and times[~low].min() - times[low].max() <= CLOCK_STEP_NS:
        low = np.zeros(len(times), bool)
    dropped["time is zero or negative"] += int(low.sum())
    keep = ~low
    keep[keep] = keep_rising(times[keep], path, dropped)
    return keep


# ── the files ────────────────────────────────────────────────────────────────────────────────────────────────────


def read_gyro_accel(path: Path) -> GyroTable:
    """Read gyro_accel.csv in any variant: the first seven fields are the same in all.

    Raises ImuError (missing, empty, foreign, no gyroscope, no rows), ClockError (times without their nanoseconds).
    """
    scan = scan_text(path, ImuError, "a capture needs its gyro_accel.csv")
    _require_kind(scan, path, GYRO, ImuError)
    lines = map(normalised_columns, scan.head.splitlines())
    columns = next((names for names in lines if any("gx[rad/s]" in name for name in names)), ("",))
    _check_gyro_header(columns, path)
    dropped: Counter[str] = Counter()
    times: list[Int64] = [np.zeros(0, np.int64)]
    values: list[Float64] = [np.zeros((0, 6))]
    seen, last_is_good = 0, False
    for chunk in text_chunks(path):
        table, time_ns = _split_rows(chunk, columns[0], 7, path, dropped)
        seen += len(chunk)
        last_is_good = len(table) > 0 and table.index[-1] == chunk.index[-1]
        times.append(time_ns)
        values.append(np.stack([numbers(table[column]) for column in range(1, 7)], axis=1))
    dropped["cut or unreadable row"] += max(scan.lines - seen, 0)  # pandas skips rows with too many fields
    time_ns, samples = np.concatenate(times), np.concatenate(values)
    rows = _count_rows(time_ns, dropped)
    twice = _written_twice(time_ns, samples)
    dropped["row written twice"] += int(twice.sum())
    time_ns, samples = time_ns[~twice], samples[~twice]
    keep = _keep_times(time_ns, path, dropped)
    if last_is_good and not scan.ends_with_newline and len(keep) and keep[-1]:
        keep[-1] = False  # a truncated last number may still parse
        dropped["last line without its end"] += 1
    time_ns, samples = time_ns[keep], samples[keep]
    return make_gyro_table(path, time_ns, samples, rows, dict(+dropped))


def _written_twice(time_ns: Int64, samples: Float64) -> Mask:
    """Rows that repeat their predecessor, time included; equal times alone would be lost precision."""
    again = np.zeros(len(time_ns), bool)
    same = (samples[1:] == samples[:-1]) | (np.isnan(samples[1:]) & np.isnan(samples[:-1]))
    again[1:] = (np.diff(time_ns) == 0) & same.all(axis=1)
    return again


def _check_gyro_header(columns: tuple[str, ...], path: Path) -> None:
    expected = ("gx[rad/s]", "gy[rad/s]", "gz[rad/s]", "ax[m/s^2]", "ay[m/s^2]", "az[m/s^2]")
    name = label(path)
    if columns[0] == "timestamp[sec]":
        raise ImuError(f"{name}: times in seconds, as early iOS apps wrote", hint="not readable as an Android capture")
    if columns[0] != "timestamp[nanosec]" or columns[1:7] != expected:
        raise ImuError(
            f"{name}: columns are {', '.join(columns)[:120]}",
            hint=f"expected Timestamp[nanosec], {', '.join(expected)}; without an accelerometer, write null for it",
        )


_METADATA_COLUMNS = {
    "fx_px": ("fx[px]",),
    "fy_px": ("fy[px]",),
    "exposure_s": ("exposuretime[nanosec]",),
    "readout_time_s": ("framereadouttime[nanosec]",),
    "iso": ("iso",),
    "focal_length_mm": ("focallength",),
    "focus_dioptres": ("focusdistance",),
}


def read_movie_metadata(path: Path) -> MetadataTable:
    """Read movie_metadata.csv in any variant, columns found by name.

    Raises CaptureError (missing, empty, foreign), ClockError (times without their nanoseconds).
    """
    scan = scan_text(path)
    _require_kind(scan, path, METADATA, CaptureError)
    columns = normalised_columns(scan.first_line)
    if columns[0] != "timestamp[nanosec]":
        raise CaptureError(f"{label(path)}: first column is '{columns[0][:40]}'", hint="expected Timestamp[nanosec]")
    places = {name: _place(columns, spellings) for name, spellings in _METADATA_COLUMNS.items()}
    unix_place = _place(columns, ("unixtime[nanosec]",))
    dropped: Counter[str] = Counter()
    times, unix = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    values: dict[str, list[Float64]] = {name: [np.zeros(0)] for name in places}
    for chunk in text_chunks(path):
        table, time_ns = _split_rows(chunk, columns[0], 2, path, dropped)
        times.append(time_ns)
        unix.append(np.zeros(len(table), np.int64) if unix_place is None else whole_numbers(table[unix_place]))
        for name, place in places.items():
            values[name].append(np.full(len(table), np.nan) if place is None else numbers(table[place]))
    time_ns = np.concatenate(times)
    rows = _count_rows(time_ns, dropped)
    keep = _keep_times(time_ns, path, dropped)
    found = {name: np.concatenate(parts) for name, parts in values.items()}
    cut = None if scan.ends_with_newline else cut_field(path)
    for name, place in places.items():
        if len(time_ns) and place is not None and place == cut:
            found[name][-1] = np.nan  # a part of a number may still parse
    found = {name: column[keep] for name, column in found.items()}
    for name in ("exposure_s", "readout_time_s"):
        found[name] = found[name] * 1e-9
    unix_ns = None if unix_place is None else np.concatenate(unix)[keep]
    return make_metadata_table(time_ns[keep], rows, dict(+dropped), unix_ns=unix_ns, **found)


def _place(columns: tuple[str, ...], spellings: tuple[str, ...]) -> int | None:
    places = (columns.index(name) for name in spellings if name in columns)
    return next((place for place in places if place < MAX_FIELDS), None)


def read_frame_timestamps(path: Path) -> StampTable:
    """Read frame_timestamps.txt: one row for each frame of the movie, in order.

    Without a header the numbers are microseconds (pre-release builds) if their steps say so, else nanoseconds.
    Raises CaptureError (missing, empty, foreign), ClockError (times without their nanoseconds).
    """
    scan = scan_text(path)
    _require_kind(scan, path, STAMPS, CaptureError)
    columns = normalised_columns(scan.first_line)
    bare = identify(scan.head) == BARE_STAMPS
    has_unix = "unixtime[nanosec]" in columns[1:2]
    dropped: Counter[str] = Counter()
    times, unix = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for chunk in text_chunks(path):
        table, time_ns = _split_rows(chunk, "frametimestamp[nanosec]", 1, path, dropped)
        times.append(time_ns)
        unix.append(whole_numbers(table[1]) if has_unix else np.zeros(len(table), np.int64))
    time_ns = np.concatenate(times)
    rows = _count_rows(time_ns, dropped)
    keep = _keep_times(time_ns, path, dropped)
    time_ns = time_ns[keep]
    if bare and len(time_ns) > 1 and np.median(np.diff(time_ns)) < MICROSECOND_GAP_LIMIT:
        time_ns = time_ns * 1000
    return StampTable(time_ns, np.concatenate(unix)[keep] if has_unix else None, rows, dict(+dropped))


def read_edge_epochs(path: Path) -> EdgeEpochs:
    """Read edge_epochs.txt; the file may have been appended to. Raises CaptureError for no regular file."""
    source, differences = "not logged", []
    for line in read_small_text(path).splitlines():
        if named := re.search(r"SENSOR_INFO_TIMESTAMP_SOURCE is SENSOR_INFO_TIMESTAMP_SOURCE_(REALTIME|UNKNOWN)", line):
            source = named.group(1)
        fields = line.split()
        if line.startswith("#") or len(fields) < 2 or not all(INTEGER.fullmatch(item) for item in fields):
            continue
        differences.append(int(fields[2]) if len(fields) > 2 else int(fields[0]) - int(fields[1]))
    return EdgeEpochs(source, tuple(differences))
