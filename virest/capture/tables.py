"""Text tables of any recorder, read by rows into columns; dropped rows are counted by reason.

Times are integer nanoseconds and stay int64: decimal seconds are split at the point, never converted through a float.
"""

from __future__ import annotations

import re
import warnings
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Mask
from virest.capture.files import label, scan_text
from virest.errors import CaptureError, ClockError, ImuError, one_line

if TYPE_CHECKING:
    import pandas as pd

ROWS_AT_ONCE = 100_000
"""Rows read at a time.  Reading a log of 300 000 rows then takes 110 MB; with half or twice as many 80 or
164 MB, in the same time to 10 %."""
QUOTES_SEEN = 8
"""Rows of a chunk that show whether its fields are quoted."""
MAX_FIELDS, MANY_FIELDS = 16, 64
"""Most columns of a log, which has up to 12, and of a table of another app."""
MAX_RATE_RAD_S = 200.0
"""The full scale of phone gyroscopes is 35 rad/s (2000 °/s); a row above this limit is damaged."""

EQUAL, FALLS = "time equals its predecessor's", "time falls or leaps"
"""Reasons for dropping a row."""

Int64 = NDArray[np.int64]
Float64 = Array

INTEGER = re.compile(r"[+-]?(?:\d{1,18}|[0-8]\d{18}|9[01]\d{17})")
"""An integer that fits in 64 bits; Unix nanoseconds have 19 digits."""
DAMAGED_TIME = r"[+-]?(?:\d+[.,]\d*(?:[eE][+-]?\d+)?|\d+[eE][+-]?\d+)"
SPOILT_TIME = r"[+-]?(?:\d+(?:[.,]\d*)?[eE][+-]?\d+|\d{14,}\.\d*)"
"""A number of nanoseconds that went through a float; seconds have at most ten digits before the point."""
EXCEL_HINT = "a spreadsheet has re-saved the file and lost the nanoseconds; copy the original from the phone again"
ORDER_HINT = "the rows are out of order, or were written twice; sort them by time, or copy the original again"


@dataclass(frozen=True, slots=True)
class GyroTable:
    """Inertial samples as a recorder wrote them (gyro_accel.csv, imu0/data.csv, …), strictly rising."""

    time_ns: Int64
    """(n,) IMU clock."""
    gyro_rad_s: Float64
    """(n, 3), no NaN."""
    accel_m_s2: Float64
    """(n, 3), NaN where missing."""
    rows: int
    """Data rows read, dropped ones included."""
    dropped: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class MetadataTable:
    """What was logged for each frame (movie_metadata.csv), strictly rising; NaN: ``null``, absent or implausible."""

    time_ns: Int64
    """(n,) camera clock."""
    fx_px: Float64
    """(n,) along the sensor's long axis; NaN for the logger's 1.0 = unknown."""
    fy_px: Float64
    exposure_s: Float64
    readout_time_s: Float64
    iso: Float64
    focal_length_mm: Float64
    focus_dioptres: Float64
    unix_ns: Int64 | None
    """(n,) time of the capture result, 0 if unreadable; None: no such column."""
    rows: int
    dropped: dict[str, int] = field(default_factory=dict)
    odd_exposure_s: float | None = None
    """The first logged exposure that no camera has, such as one in other units; None: there is none."""


@dataclass(frozen=True, slots=True)
class StampTable:
    """Times of the frames (frame_timestamps.txt), strictly rising."""

    time_ns: Int64
    """(n,) camera clock; MARSLogger's are whole microseconds."""
    unix_ns: Int64 | None
    """(n,) time of the encoder's output, 0 if unreadable; None: no such column."""
    rows: int
    dropped: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class EdgeEpochs:
    """The camera's clock against the IMU's (edge_epochs.txt)."""

    source: str
    """``REALTIME``, ``UNKNOWN`` or ``not logged``; ``one clock`` if the format has only one."""
    differences_ns: tuple[int, ...]
    """IMU clock − camera clock, one per row."""

    @property
    def mean_difference_ns(self) -> int | None:
        """Mean over the rows, None without rows."""
        return round(sum(self.differences_ns) / len(self.differences_ns)) if self.differences_ns else None


def text_chunks(path: Path, separator: str = ",", fields: int = MAX_FIELDS) -> Iterator[pd.DataFrame]:
    r"""The file's fields as text in ``fields`` columns, in chunks of ROWS_AT_ONCE rows; missing fields are ''.

    separator: a comma, or ``\s+`` for any white space.
    """
    import pandas as pd  # imported here because it takes a quarter of a worker's start, and workers read no tables

    options: dict[str, Any] = {
        "header": None,
        "sep": separator,
        "names": list(range(fields)),
        "index_col": False,
        "dtype": str,
        "keep_default_na": False,
        "na_filter": False,
        "quoting": 3,
        "skipinitialspace": True,
        "skip_blank_lines": False,
        "encoding": "utf-8-sig",
        "encoding_errors": "replace",
        "on_bad_lines": "skip",
        "chunksize": ROWS_AT_ONCE,
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pd.errors.ParserWarning)
        try:
            with pd.read_csv(path, **options) as reader:
                for chunk in reader:
                    yield _unquoted(chunk.fillna(""))
        except pd.errors.EmptyDataError:
            return
        except (pd.errors.ParserError, OSError) as fault:
            raise CaptureError(f"{label(path)}: {one_line(fault)}", hint="copy the logger's file again") from None


def _unquoted(chunk: pd.DataFrame) -> pd.DataFrame:
    """The fields without the quotes that R, csv writers and spreadsheets put around them."""
    if not any('"' in field for field in chunk.head(QUOTES_SEEN).to_numpy().ravel()):
        return chunk
    return chunk.apply(lambda column: column.str.strip().str.strip('"'))


def numbers(column: Any) -> Float64:
    """Text to float64; ``null``, text and infinities become NaN."""
    import pandas as pd

    values = pd.to_numeric(column.str.strip(), errors="coerce").to_numpy(dtype=np.float64, na_value=np.nan)
    return np.where(np.isfinite(values), values, np.nan)


def whole_numbers(column: Any) -> Int64:
    """Text to int64, exactly; 0 where it is not an integer."""
    text = column.str.strip()
    whole = text.str.fullmatch(INTEGER).to_numpy()
    values = np.zeros(len(text), np.int64)
    values[whole] = text[whole].astype("int64").to_numpy()
    return values


def strictly_rising(times: Int64) -> tuple[Mask, dict[str, int]]:
    """Mask of the rows to keep so that times rise strictly, and the number of dropped rows by reason.

    Of equal times the first is kept.  A single time far ahead of its successors is dropped alone: if dropping all later
    smaller times would cost more rows, the longest rising subsequence is kept instead.
    """
    keep = np.ones(len(times), bool)
    if len(times) < 2:
        return keep, {}
    keep[1:] = np.diff(times) != 0
    equal = int((~keep).sum())
    rows = np.flatnonzero(keep)
    fresh = times[rows]
    rising = np.concatenate([[True], fresh[1:] > np.maximum.accumulate(fresh)[:-1]])
    if not rising.all():
        longest = _longest_rising(fresh)
        if longest.sum() > rising.sum():
            rising = longest
    keep[rows] = rising
    counts = {EQUAL: equal, FALLS: int((~rising).sum())}
    return keep, {reason: count for reason, count in counts.items() if count}


def _longest_rising(values: Int64) -> Mask:
    """Mask of a longest strictly rising subsequence (patience sorting)."""
    tails: list[int] = []
    tail_rows: list[int] = []
    parent = np.full(len(values), -1, np.int64)
    for row, value in enumerate(values.tolist()):
        place = bisect_left(tails, value)
        if place:
            parent[row] = tail_rows[place - 1]
        if place == len(tails):
            tails.append(value)
            tail_rows.append(row)
        else:
            tails[place], tail_rows[place] = value, row
    mask = np.zeros(len(values), bool)
    row = tail_rows[-1] if tail_rows else -1
    while row >= 0:
        mask[row] = True
        row = int(parent[row])
    return mask


def keep_rising(times: Int64, path: Path, dropped: Counter[str]) -> Mask:
    """The mask of :func:`strictly_rising`, dropped rows counted. Raises ClockError if most rows would be dropped."""
    keep, lost = strictly_rising(times)
    if len(times) > 2 and keep.sum() * 2 <= len(times):
        raise ClockError(
            f"{label(path)}: only {int(keep.sum())} of {len(times)} times rise "
            f"({', '.join(f'{n} {reason}' for reason, n in lost.items())})",
            hint=EXCEL_HINT if lost.get(EQUAL, 0) > lost.get(FALLS, 0) else ORDER_HINT,
        )
    dropped.update(lost)
    return keep


# ── any table of numbers ─────────────────────────────────────────────────────────────────────────────────────────

Times = Callable[[Any, Path], tuple[Int64, Mask]]
"""Text of the first column to (integer nanoseconds, mask of the rows that have a time)."""


@dataclass(frozen=True, slots=True)
class Rows:
    """A table of numbers with the time in its first column."""

    time_ns: Int64
    """(n,) strictly rising."""
    values: Float64
    """(n, columns), NaN where a field is empty or not a number."""
    rows: int
    dropped: dict[str, int]


def exact_times_ns(text: Any, path: Path, *, whole_are_seconds: bool = False) -> tuple[Int64, Mask]:
    """Integer nanoseconds of times written as such or as decimal seconds, truncated below 1 ns.

    Raises ClockError for exponents and for fractions of nanoseconds, which are written once the digits are lost.
    """
    text = text.str.strip()
    spoilt = text.str.fullmatch(SPOILT_TIME).to_numpy()
    if spoilt.any():
        raise ClockError(f"{label(path)}: time '{text[spoilt].iloc[0][:40]}' has lost its digits", hint=EXCEL_HINT)
    whole = text.str.fullmatch(INTEGER).to_numpy()
    decimal = text.str.fullmatch(r"\d{1,9}\.\d*|1\d{9}\.\d*").to_numpy()
    times = np.zeros(len(text), np.int64)
    if whole_are_seconds:
        decimal, whole = decimal | text.str.fullmatch(r"\d{1,9}|1\d{9}").to_numpy(), np.zeros(len(text), bool)
    times[whole] = text[whole].astype("int64").to_numpy()
    if decimal.any():
        parts = text[decimal].str.partition(".")
        times[decimal] = parts[0].astype("int64").to_numpy() * 10**9
        times[decimal] += (parts[2] + "0" * 9).str[:9].astype("int64").to_numpy()
    return times, whole | decimal


def scaled_times_ns(scale_s: float) -> Times:
    """A reader of times counted in units of ``scale_s`` seconds."""

    def read(text: Any, _path: Path) -> tuple[Int64, Mask]:
        values = numbers(text) * (scale_s * 1e9)
        known = np.isfinite(values) & (np.abs(values) < 2.0**62)
        return np.rint(np.where(known, values, 0.0)).astype(np.int64), known

    return read


def read_rows(
    path: Path,
    columns: Sequence[int],
    *,
    separator: str = ",",
    times: Times = exact_times_ns,
    required: int = 0,
    error: type[CaptureError] = ImuError,
    hint: str = "",
) -> Rows:
    """Read the numbers of ``columns``; column 0 is the time.  Comments and headers (text for a time) are skipped.

    required: number of leading columns that a row must have.  Raises ``error`` (missing, not text), ClockError (times).
    """
    scan = scan_text(path, error, hint)
    dropped: Counter[str] = Counter()
    found_ns, found = [np.zeros(0, np.int64)], [np.zeros((0, len(columns)))]
    last_is_good, begun = False, False
    for chunk in text_chunks(path, separator, MANY_FIELDS):
        time_ns, good = times(chunk[0], path)
        table = np.stack([numbers(chunk[column]) for column in columns], axis=1)
        enough = np.isfinite(table[:, :required]).all(axis=1)
        time_text = chunk[0].str.strip()
        is_text = ((time_text == "") | time_text.str.startswith("#")).to_numpy()
        first = int(np.argmax(good)) if good.any() else len(good)
        head = ~good & (np.arange(len(good)) < (0 if begun else first))
        begun = begun or bool(good.any())
        dropped["cut or unreadable row"] += int((~(good & enough) & ~is_text & ~head).sum())
        good &= enough
        last_is_good = bool(good[-1]) if len(good) else last_is_good
        found_ns.append(time_ns[good])
        found.append(table[good])
    time_ns, values = np.concatenate(found_ns), np.concatenate(found)
    rows = len(time_ns) + sum(dropped.values())
    keep = keep_rising(time_ns, path, dropped)
    unended = last_is_good and not scan.ends_with_newline and len(keep) > 1
    if unended and keep[-1] and cut_field(path, separator) is not None:
        keep[-1] = False  # a truncated last number may still parse
        dropped["last line without its end"] += 1
    return Rows(time_ns[keep], values[keep], rows, dict(+dropped))


def cut_field(path: Path, separator: str = ",") -> int | None:
    """Place of the last field of a file that lacks its last line end, if it looks truncated there; else None.

    Truncated: the last line has fewer fields, or a shorter last field, than the line before.
    """
    with path.open("rb") as stream:
        stream.seek(max(path.stat().st_size - 4096, 0))
        lines = stream.read().decode("utf-8", errors="replace").splitlines()
    if len(lines) < 2:
        return None
    split = re.compile(r"\s+" if separator != "," else ",")
    last, before = (split.split(line.strip()) for line in (lines[-1], lines[-2]))
    whole = len(last) == len(before) and len(last[-1]) >= len(before[-1])
    return None if whole else len(last) - 1


def make_gyro_table(
    path: Path, time_ns: Int64, samples: Float64, rows: int, dropped: dict[str, int], hint: str = ""
) -> GyroTable:
    """Inertial samples (n, 6), rad/s and m/s², without missing or impossible rates. Raises ImuError."""
    counts = Counter(dropped)
    known = np.isfinite(samples[:, :3]).all(axis=1)
    plausible = (np.abs(np.where(np.isfinite(samples[:, :3]), samples[:, :3], 0.0)) <= MAX_RATE_RAD_S).all(axis=1)
    counts["gyroscope null or NaN"] += int((~known).sum())
    counts[f"rate above {MAX_RATE_RAD_S:.0f} rad/s"] += int((known & ~plausible).sum())
    good = known & plausible
    if good.sum() < 2:
        raise ImuError(
            f"{label(path)}: {int(good.sum())} usable of {rows} rows",
            hint=hint or "the logger wrote no gyroscope data; see the counts of `virest inspect`",
            dropped=dict(+counts),
        )
    return GyroTable(time_ns[good], samples[good, :3], samples[good, 3:], rows, dict(+counts))


PLAUSIBLE = {
    "fx_px": (1.5, 1e6),  # 1.0 is the logger's "unknown"
    "fy_px": (1.5, 1e6),
    "exposure_s": (1e-7, 10.0),
    "readout_time_s": (1e-6, 0.5),  # phones write 0 for unknown
    "iso": (1e-3, 1e7),
    "focal_length_mm": (0.1, 1000.0),
    "focus_dioptres": (0.0, 100.0),
}


def make_metadata_table(
    time_ns: Int64, rows: int, dropped: dict[str, int], unix_ns: Int64 | None = None, **columns: Float64
) -> MetadataTable:
    """The metadata of each frame; NaN for missing columns and implausible values."""
    values = {}
    for name, (low, high) in PLAUSIBLE.items():
        given = columns.get(name, np.full(len(time_ns), np.nan))
        values[name] = np.where((given >= low) & (given <= high), given, np.nan)
    logged = columns.get("exposure_s", np.zeros(0))
    odd = logged[(logged > 0) & ~np.isfinite(values["exposure_s"])] if len(logged) else logged
    odd_s = float(odd[0]) if len(odd) else None
    return MetadataTable(time_ns, **values, unix_ns=unix_ns, rows=rows, dropped=dropped, odd_exposure_s=odd_s)
