"""Readers for MARSLogger on iOS: the Objective-C app, and the newer one on ARKit.

Objective-C app   movie_metadata.csv  Timestamp, fx, fy, cx, cy, exposure duration; a row for each frame of the movie
                  gyro_accel.csv      as on Android, ", " between fields; once raw_accel_gyro.csv, in seconds
                  the movie           copied from the Photos album by hand: any name
ARKit app         frames.csv          seconds of nine significant digits, intrinsics, image size
                  imu.csv             gravity and user acceleration in g, pointing down at rest; bias-free rates

All times are the phone's host time (seconds since boot), so there is one clock.  Times printed too coarsely are
refined by the movie's PTS, which begin at the first row.  Pictures are stored as the sensor reads them, in landscape,
and the movie's display rotation is not applied, so that the intrinsics hold.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.capture.files import is_present, label, scan_text
from virest.capture.join import COARSEST_TICK_NS, align_frames, match_times, pts_tolerance_ns
from virest.capture.marslogger_android import GYRO, METADATA, normalised_columns, read_gyro_accel
from virest.capture.phone_tables import G_M_S2
from virest.capture.profile_source import phone_profile
from virest.capture.records import Note
from virest.capture.source import FileNames, Source, find_movie
from virest.capture.tables import (
    Float64,
    GyroTable,
    Int64,
    MetadataTable,
    Rows,
    StampTable,
    exact_times_ns,
    make_gyro_table,
    make_metadata_table,
    read_rows,
)
from virest.capture.video import MovieIndex, probe_movie
from virest.errors import CaptureError, ImuError

RAW_GYRO, ARKIT_FRAMES, ARKIT_IMU = "raw_accel_gyro.csv", "frames.csv", "imu.csv"
APP_G_M_S2 = 9.80
"""The value of g in the Objective-C app."""
KNOWN_FOCAL_PX = 1.5
"""Smallest known focal length: the app writes 1.00 for an unknown one, and 0.50 for an unknown principal point."""
FLOAT32_STEP = 2.0**-23
PRINTED_DIGITS = 9
"""Relative step of a 32-bit float, and the significant digits with which it is printed."""
COARSE_NS = 1e5
"""Note times on a coarser grid than this."""


@dataclass(frozen=True, slots=True)
class _Lens:
    """Intrinsics of each frame, pixels of the sensor's picture; NaN: unknown."""

    fx_px: Float64
    fy_px: Float64
    cx_px: Float64
    cy_px: Float64


# ── the Objective-C app ──────────────────────────────────────────────────────────────────────────────────────────


def read_ios_marslogger(folder: Path, notes: list[Note]) -> Source:
    """Read a folder of the Objective-C app. Raises CaptureError for what is missing or cannot be used."""
    old = not is_present(folder / GYRO) and is_present(folder / RAW_GYRO)
    samples = folder / (RAW_GYRO if old else GYRO)
    gyro = _read_gyro(samples)
    path = find_movie(folder)
    movie = probe_movie(path)
    rows, lens, exposure_s, in_seconds = _read_metadata(folder / METADATA)
    stamps = StampTable(rows.time_ns, None, rows.rows, rows.dropped)
    time_ns = rows.time_ns
    if in_seconds:
        grid_ns = float(rows.time_ns[-1]) * FLOAT32_STEP
        stamps = stamps_from_movie(movie, rows, grid_ns, label(folder / METADATA), notes)
        time_ns = _refined(rows.time_ns, stamps.time_ns, grid_ns)
    metadata = make_metadata_table(
        time_ns, rows.rows, rows.dropped, fx_px=lens.fx_px, fy_px=lens.fy_px, exposure_s=exposure_s
    )
    profile = _profile(movie, lens, "iPhone, MARSLogger for iOS")
    names = FileNames(path.name, METADATA, METADATA, samples.name)
    inputs = (path, folder / METADATA, samples)
    return Source(
        "MARSLogger for iOS", path, movie, gyro, stamps, metadata, names=names, profile=profile, inputs=inputs
    )


def _read_gyro(path: Path) -> GyroTable:
    """Read samples in m/s², rescaled from the app's g of 9.80 to the standard one; times in nanoseconds or seconds."""
    scan = scan_text(path, ImuError, "copy it from the app's folder")
    if "timestamp[sec]" not in scan.head[:400].lower().replace(" ", ""):
        table = read_gyro_accel(path)
    else:
        rows = read_rows(path, range(1, 7), times=_seconds)
        table = make_gyro_table(path, rows.time_ns, rows.values, rows.rows, rows.dropped)
    return replace(table, accel_m_s2=table.accel_m_s2 * (G_M_S2 / APP_G_M_S2))


def _seconds(text: object, path: Path) -> tuple[Int64, np.ndarray]:
    return exact_times_ns(text, path, whole_are_seconds=True)


def _read_metadata(path: Path) -> tuple[Rows, _Lens, Float64, bool]:
    """(rows, intrinsics, exposures in s, whether times are in seconds) of movie_metadata.csv."""
    scan = scan_text(path, CaptureError, "the app writes it beside the samples; copy it from the app's folder")
    columns = normalised_columns(next((line for line in scan.head.splitlines() if line.count(",") > 3), ""))
    if columns[:5] != (columns[0], "fx[px]", "fy[px]", "cx[px]", "cy[px]") or len(columns) < 6:
        raise CaptureError(f"{label(path)}: columns are {', '.join(columns)[:100]}", hint="is it the app's file?")
    in_seconds = columns[0] == "timestamp[sec]"
    rows = read_rows(path, range(1, 6), times=_seconds if in_seconds else exact_times_ns, error=CaptureError)
    if not len(rows.time_ns):
        raise CaptureError(f"{label(path)}: has no rows", hint="the recording was not stopped, or the copy was cut")
    exposure_s = rows.values[:, 4] * (1.0 if "[sec]" in columns[5] else 1e-9)
    return rows, _known_lens(*rows.values[:, :4].T), exposure_s, in_seconds


def _known_lens(fx_px: Float64, fy_px: Float64, cx_px: Float64, cy_px: Float64) -> _Lens:
    known = fx_px > KNOWN_FOCAL_PX
    return _Lens(*(np.where(known, column, np.nan) for column in (fx_px, fy_px, cx_px, cy_px)))


# ── the ARKit app ────────────────────────────────────────────────────────────────────────────────────────────────

_IMU_COLUMNS = (
    *(f"rotation_rate_{axis}_rad_s" for axis in "xyz"),
    *(f"user_acceleration_{axis}_g" for axis in "xyz"),
    *(f"gravity_{axis}_g" for axis in "xyz"),
)


def read_ios_arkit(folder: Path, notes: list[Note]) -> Source:
    """Read a folder of the ARKit app. Raises CaptureError for what is missing or cannot be used."""
    gyro = _read_motion(folder / ARKIT_IMU)
    path = find_movie(folder, "camera")
    movie = probe_movie(path)
    rows, lens = _read_arkit_frames(folder / ARKIT_FRAMES, movie)
    grid_ns = printed_grid_ns(float(rows.time_ns[-1]))
    stamps = stamps_from_movie(movie, rows, grid_ns, label(folder / ARKIT_FRAMES), notes)
    if grid_ns > COARSE_NS:
        text = f"{ARKIT_IMU}: times have steps of {grid_ns / 1e6:.1f} ms, because the phone has been up for a long time"
        notes.append(Note("info", "coarse-times", text))
    time_ns = _refined(rows.time_ns, stamps.time_ns, grid_ns)
    metadata: MetadataTable = make_metadata_table(time_ns, rows.rows, rows.dropped, fx_px=lens.fx_px, fy_px=lens.fy_px)
    profile = _profile(movie, lens, "iPhone, MARSLogger for ARKit")
    names = FileNames(path.name, ARKIT_FRAMES, ARKIT_FRAMES, ARKIT_IMU)
    inputs = (path, folder / ARKIT_FRAMES, folder / ARKIT_IMU)
    return Source(
        "MARSLogger for iOS (ARKit)", path, movie, gyro, stamps, metadata, names=names, profile=profile, inputs=inputs
    )


def printed_grid_ns(time_ns: float) -> float:
    """Step of a time in seconds printed with nine significant digits."""
    return 1e9 * 10.0 ** (np.floor(np.log10(max(time_ns / 1e9, 1.0))) + 1 - PRINTED_DIGITS)


def _read_motion(path: Path) -> GyroTable:
    """Read rates, and specific force = −(user acceleration + gravity): +9.8 upwards at rest."""
    columns = _header(path, "motion_timestamp_s", ImuError)
    rows = read_rows(path, [_require(columns, name, path, ImuError) for name in _IMU_COLUMNS], times=_seconds)
    force = -(rows.values[:, 3:6] + rows.values[:, 6:9]) * G_M_S2
    return make_gyro_table(path, rows.time_ns, np.hstack([rows.values[:, :3], force]), rows.rows, rows.dropped)


def _read_arkit_frames(path: Path, movie: MovieIndex) -> tuple[Rows, _Lens]:
    """Read times and intrinsics, scaled to the movie's size if it differs from ARKit's picture."""
    columns = _header(path, "frame_timestamp_s", CaptureError)
    entries = [f"intrinsics_m{place}" for place in ("00", "11", "20", "02", "21", "12")]
    places = [_require(columns, name, path, CaptureError) for name in (*entries, "image_width", "image_height")]
    rows = read_rows(path, places, times=_seconds, error=CaptureError)
    if not len(rows.time_ns):
        raise CaptureError(f"{label(path)}: has no rows", hint="the recording was not stopped, or the copy was cut")
    *lens_px, width, height = rows.values.T
    fx, fy, cx_a, cx_b, cy_a, cy_b = lens_px
    width, height = (np.where(side > 0, side, np.nan) for side in (width, height))
    # K's last column in either index order of the header: the other entries are zero
    cx, cy = np.where(np.abs(cx_a) > np.abs(cx_b), cx_a, cx_b), np.where(np.abs(cy_a) > np.abs(cy_b), cy_a, cy_b)
    scale_x, scale_y = movie.width / width, movie.height / height
    lens = _Lens(fx * scale_x, fy * scale_y, (cx + 0.5) * scale_x - 0.5, (cy + 0.5) * scale_y - 0.5)
    same_shape = np.abs(scale_x / scale_y - 1) < 0.02
    return rows, _Lens(*(np.where(same_shape, c, np.nan) for c in (lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px)))


def _header(path: Path, first: str, error: type[CaptureError]) -> tuple[str, ...]:
    scan = scan_text(path, error, "copy it from the app's folder")
    columns = normalised_columns(scan.first_line)
    if first not in columns[:1]:
        raise error(f"{label(path)}: first column is '{columns[0][:40]}', not {first}", hint="is it the app's file?")
    return columns


def _require(columns: tuple[str, ...], name: str, path: Path, error: type[CaptureError]) -> int:
    if name not in columns:
        raise error(f"{label(path)}: has no column {name}", hint="is it the app's file?")
    return columns.index(name)


# ── times and lens ───────────────────────────────────────────────────────────────────────────────────────────────


def stamps_from_movie(movie: MovieIndex, rows: Rows, grid_ns: float, what: str, notes: list[Note]) -> StampTable:
    """Timestamps with the movie's exact steps, brought to the rows' clock by their mean difference.

    grid_ns: step of the rows' times; a row may belong to no frame.  Raises ClockError if movie and rows disagree.
    """
    tick_ns = min(float(movie.time_base) * 1e9, COARSEST_TICK_NS)
    tolerance_ns = max(pts_tolerance_ns(tick_ns), grid_ns + tick_ns)
    alignment = align_frames(movie.pts_ns, rows.time_ns, tolerance_ns, None, what)
    found = alignment.rows >= 0
    offset_ns = float(np.mean(rows.time_ns[alignment.rows[found]] - movie.pts_ns[found]))
    if alignment.rivals:
        text = f"{alignment.rivals} other alignments of the movie with the rows of {what} fit as well: times may be off"
        notes.append(Note("warning", "stamps-ambiguous", text))
    spare = len(rows.time_ns) - int(found.sum())
    if spare:
        notes.append(Note("info", "stamps-slid", f"{spare} rows of {what} belong to no frame of the movie"))
    return StampTable(movie.pts_ns + round(offset_ns), None, rows.rows, rows.dropped)


def _refined(rows_ns: Int64, stamps_ns: Int64, grid_ns: float) -> Int64:
    """Row times replaced by the timestamp that they were printed from; rows of no frame stay as they are."""
    nearest = match_times(rows_ns, stamps_ns, grid_ns + COARSEST_TICK_NS)
    return np.asarray(np.where(nearest >= 0, stamps_ns[nearest], rows_ns), np.int64)


def _profile(movie: MovieIndex, lens: _Lens, device: str) -> CameraProfile:
    """A phone's axes, and the logged intrinsics if the picture is stored as the sensor reads it."""
    profile = phone_profile(movie.width, movie.height, device)
    known = np.isfinite([lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px]).all(axis=0)
    if not known.any() or movie.height > movie.width:
        return profile
    fx, fy, cx, cy = (float(np.median(c[known])) for c in (lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px))
    plausible = 0.4 <= fx / movie.width <= 1.6 and 0.5 * fx <= fy <= 2.0 * fx
    plausible = plausible and 0 < cx < movie.width and 0 < cy < movie.height
    if not plausible:
        return profile
    optics = Intrinsics(movie.width, movie.height, fx, fy, cx, cy)
    return profile.with_estimate("fx_px", fx, None, "logged for each frame, median", intrinsics=optics)
