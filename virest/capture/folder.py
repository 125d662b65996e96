"""Read a capture folder of any kind: join its files by time, note what is missing, and return one `Capture`.

`detect` finds the kind from the files and their headers; the rest is the same for all kinds.  Frames are joined by
time, and everything skipped is counted and explained.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Index, Mask
from virest.capture import startup as start
from virest.capture.detect import read_source
from virest.capture.imu import ImuSamples, without_held_readings
from virest.capture.join import (
    Alignment,
    align_frames,
    clock_shift_ns,
    find_gaps,
    floor_us,
    join_metadata,
    median_period_s,
    outside_reason,
    pts_tolerance_ns,
)
from virest.capture.location import locate
from virest.capture.logged_focal import focal_scales
from virest.capture.marslogger_android import GYRO, METADATA, STAMPS
from virest.capture.profile_source import default_profile, resolve_profile
from virest.capture.recorder_metadata import summarise
from virest.capture.records import IMU_GAP, NO_IMU, NO_STAMP, STALL, STARTUP, Capture, CaptureMetadata, Frame, Note
from virest.capture.rosbag import ENDINGS as BAG_ENDINGS
from virest.capture.source import EPOCHS, MOVIE, Source
from virest.capture.tables import GyroTable, MetadataTable, StampTable
from virest.capture.video import read_gray
from virest.errors import CaptureError, ClockError, ImuError

__all__ = [
    "EPOCHS",
    "GYRO",
    "METADATA",
    "MOVIE",
    "STAMPS",
    "Capture",
    "CaptureMetadata",
    "Frame",
    "Note",
    "default_profile",
    "read_capture",
    "resolve_profile",
]

GUESSED_FOCAL = 0.8
"""Of the long side, as phones have: enough to decide whether the picture moves by more than half a pixel."""
MOST_UNIX_LAG_S = 60.0
"""A larger difference of the two Unix columns is a damaged number, such as the cut last one of a file."""
MOST_LISTED = 12
"""Frames that a note lists; ``virest inspect --json`` has them all."""
LARGE_RATE_RAD_S = 35.0
"""2000 °/s, the full scale of phone gyroscopes."""
PLAUSIBLE_ACCEL_M_S2 = (5.0, 20.0)
"""Median magnitude of the specific force: accelerometers are off by a few percent, and hand shake averages out."""


@dataclass(frozen=True, slots=True)
class _Joined:
    """Movie frames with their stamps and metadata rows, camera clock."""

    stamps_ns: NDArray[np.int64]
    """(n,) stamp of each frame; from PTS where the row is missing."""
    has_stamp: Mask
    stamp_0_ns: int
    metadata_rows: NDArray[np.int64]
    """(n,) −1 for none."""
    unix_lag_s: Array | None


@dataclass(frozen=True, slots=True)
class _Recording:
    """A capture's files on one time axis, before its frames are judged."""

    files: Source
    joined: _Joined
    shift_ns: int
    """Added to the camera's stamps, for the IMU's clock."""
    time_s: Array
    """(n,) times of the frames from stamp_0."""
    imu: ImuSamples
    gaps: tuple[tuple[float, float], ...]
    metadata: CaptureMetadata
    notes: list[Note]
    """Every step may add to them."""


def read_capture(path: Path, *, look_at_pictures: bool = True) -> Capture:
    """Read, join and check a capture folder.

    ``look_at_pictures``: decode the first two seconds to find repeated pictures (recorder lag).
    Raises VideoError, ImuError, ClockError or CaptureError if the capture cannot be used; a partly usable capture is
    returned with notes, counts and a reason on each skipped frame.
    """
    folder = require_folder(path)
    notes: list[Note] = []
    files = read_source(folder, notes)
    _note_movie(files, notes)
    joined = _join(files, notes)
    camera_ns = np.array([joined.stamps_ns[0], joined.stamps_ns[-1]])
    shift_ns, remark = clock_shift_ns(camera_ns, files.gyro.time_ns, files.epochs, files.names.gyro)
    if remark:
        notes.append(Note("warning", "clock-shift", remark))
    zero_ns = joined.stamp_0_ns + shift_ns
    imu = ImuSamples((files.gyro.time_ns - zero_ns) / 1e9, files.gyro.gyro_rad_s, files.gyro.accel_m_s2)
    imu, held_rows = without_held_readings(imu)
    if held_rows > 1:
        text = (
            f"{files.names.gyro} repeats each gyroscope reading in about {held_rows} rows: only its first row is used"
        )
        notes.append(Note("info", "gyro-held", text))
    gaps = find_gaps(imu.time_s)
    metadata = summarise(files, notes)
    time_s = (joined.stamps_ns + shift_ns - zero_ns) / 1e9
    recording = _Recording(files, joined, shift_ns, time_s, imu, gaps, metadata, notes)
    began = _startup(recording, look_at_pictures)
    frames = _frames(recording, began)
    _note_imu(imu, gaps, notes)
    _note_frames(frames, notes)
    return Capture(
        name=folder.name,
        folder=folder,
        movie=files.movie_path,
        width=files.movie.width,
        height=files.movie.height,
        frames=frames,
        imu=imu,
        metadata=metadata,
        clock_source=files.epochs.source,
        clock_shift_ns=shift_ns,
        clock_difference_ns=files.epochs.mean_difference_ns,
        imu_gaps_s=gaps,
        keyframes=files.movie.keyframes,
        bits_per_px=files.movie.bits_per_px,
        notes=tuple(notes),
        counts=_counts(files, joined, frames),
        stamp_0_ns=zero_ns,
        repeats=began.repeats,
        startup_lag_s=began.lag_s,
        stalls=began.stalls,
        kind=files.kind,
        metadata_file=files.names.metadata,
        recorded_profile=files.profile,
        inputs=files.inputs,
    )


def unpack_hint(path: str | Path) -> str:
    """Hint for a bag given in place of a capture; empty for anything else."""
    return "unpack it first: virest import BAG FOLDER" if str(path).lower().endswith(BAG_ENDINGS) else ""


def require_folder(path: Path) -> Path:
    """The folder, resolved, so that `.` has a name. Raises CaptureError if it is missing or not a folder."""
    try:
        folder = locate(path).resolve(strict=True)
        if folder.is_dir():
            return folder
    except FileNotFoundError:
        raise CaptureError(f"{path}: no such folder", hint="pass the folder that holds movie.mp4") from None
    except (OSError, RuntimeError, ValueError) as fault:
        reason = getattr(fault, "strerror", None) or str(fault)
        raise CaptureError(f"{path}: {reason}", hint="check the path and its links") from None
    raise CaptureError(f"{path}: is not a folder", hint=unpack_hint(path) or "pass the folder that holds movie.mp4")


def _note_movie(files: Source, notes: list[Note]) -> None:
    found, promised = len(files.movie), files.movie.declared_frames
    if 0 < found < promised:
        text = f"{files.names.movie}: its index lists {promised} frames but it holds {found}: the copy is incomplete"
        notes.append(Note("warning", "movie-cut", text))


# ── joining ──────────────────────────────────────────────────────────────────────────────────────────────────────


def _join(files: Source, notes: list[Note]) -> _Joined:
    movie, metadata = files.movie, files.metadata
    pts_ns = movie.pts_ns
    tolerance = pts_tolerance_ns(float(movie.time_base) * 1e9)
    meta_ns = metadata.time_ns if metadata else np.zeros(0, np.int64)
    rows_ns = files.stamps.time_ns if files.stamps else floor_us(meta_ns)
    what = files.names.stamps if files.stamps else files.names.metadata
    alignment = align_frames(pts_ns, rows_ns, tolerance, meta_ns if files.stamps else None, what)
    _note_alignment(alignment, len(pts_ns), len(rows_ns), files.names.movie, what, notes)
    found = alignment.rows >= 0
    stamps_ns = np.where(found, rows_ns[alignment.rows], pts_ns + alignment.offset_ns)
    stamp_0_ns = int(files.stamps.time_ns[0]) if files.stamps else int(stamps_ns[0])
    joined = join_metadata(stamps_ns, meta_ns)
    if metadata is not None:
        _note_metadata(joined, stamps_ns, meta_ns, files.names.metadata, notes)
    lag = _unix_lag_s(files, alignment, joined)
    return _Joined(stamps_ns, found, stamp_0_ns, joined, lag)


def _note_alignment(alignment: Alignment, frames: int, rows: int, movie: str, what: str, notes: list[Note]) -> None:
    if alignment.slid:
        matched = int((alignment.rows >= 0).sum())
        text = f"{movie} has {frames} frames, {what} {rows} rows: {matched} frames joined by a common shift of PTS"
        notes.append(Note("warning" if matched < frames or rows != frames else "info", "stamps-slid", text))
    if alignment.drift_ns:
        text = (
            f"PTS of {movie} and {what} drift apart by {alignment.drift_ns / 1e6:+.3f} ms over {frames} frames: "
            f"joined row by row, with the times of {what}"
        )
        notes.append(Note("warning", "stamps-drift", text))
    if alignment.rivals:
        text = (
            f"{alignment.rivals} other alignments of the movie with the rows of {what} fit as well (even spacing): "
            "frame times may be off by whole frames; estimate the time offset before trusting them"
        )
        notes.append(Note("warning", "stamps-ambiguous", text))


def _note_metadata(
    joined: NDArray[np.int64], stamps_ns: NDArray[np.int64], meta_ns: NDArray[np.int64], name: str, notes: list[Note]
) -> None:
    lost = int((joined < 0).sum())
    if lost == len(joined):
        raise ClockError(
            f"{name} covers {meta_ns[0] / 1e9:.3f}–{meta_ns[-1] / 1e9:.3f} s, the frames "
            f"{stamps_ns[0] / 1e9:.3f}–{stamps_ns[-1] / 1e9:.3f} s: no row joins",
            hint="the files come from different sessions; remove the metadata to continue without exposures",
        )
    if lost:
        text = f"{lost} of {len(joined)} frames have no row in {name}"
        notes.append(Note("warning", "metadata-missing", text))
    spare = len(meta_ns) - len(np.unique(joined[joined >= 0]))
    if spare:
        notes.append(Note("info", "metadata-spare", f"{spare} rows of {name} belong to no frame of the movie"))


def _unix_lag_s(files: Source, alignment: Alignment, joined: NDArray[np.int64]) -> Array | None:
    """Encoder output − capture result of each frame, from the two Unix columns; None if either is missing."""
    if files.stamps is None or files.metadata is None:
        return None
    out_ns, in_ns = files.stamps.unix_ns, files.metadata.unix_ns
    if out_ns is None or in_ns is None:
        return None
    left, right = out_ns[alignment.rows], in_ns[joined]
    lag_s = (left - right) / 1e9
    known = (alignment.rows >= 0) & (joined >= 0) & (left > 0) & (right > 0) & (np.abs(lag_s) <= MOST_UNIX_LAG_S)
    return np.where(known, lag_s, np.nan)


# ── start-up, frames, report ─────────────────────────────────────────────────────────────────────────────────────


def _startup(recording: _Recording, look_at_pictures: bool) -> start.Startup:
    files, joined, time_s, imu = recording.files, recording.joined, recording.time_s, recording.imu
    period = median_period_s(time_s)
    repeats: tuple[int, ...] = ()
    later: tuple[int, ...] = ()
    if look_at_pictures and len(time_s) > 2:
        look = int(np.searchsorted(time_s, time_s[0] + start.LOOK_S))
        focal = recording.metadata.fx_px or GUESSED_FOCAL * max(files.movie.width, files.movie.height)
        motion = start.expected_motion_px(time_s, imu.time_s, imu.gyro_rad_s, focal, period)
        if (motion[:look] > start.MIN_MOTION_PX).any():
            repeats = start.find_repeats(_differences(files, range(look), look), motion[:look])
        later = _later_repeats(files, look, motion)
    began = start.judge_startup(joined.unix_lag_s, repeats, len(time_s), period)
    if began.frames:
        recording.notes.append(_startup_note(began))
    stalls = start.find_stalls(later, joined.unix_lag_s, max(began.frames, 1), period)
    if stalls:
        recording.notes.append(_stall_note(stalls, later))
    return replace(began, stalls=stalls)


def _differences(files: Source, frames: Iterable[int], count: int) -> Array:
    """(count,) difference of each picture to its predecessor, where both are among the frames (rising); else NaN."""
    pictures: list[NDArray[np.uint8] | None] = [None] * count
    for number, picture in read_gray(files.movie_path, files.movie, frames):
        pictures[number] = None if picture is None else picture[::2, ::2].copy()
    return start.picture_differences(pictures)


def _later_repeats(files: Source, look: int, motion_px: Array) -> tuple[int, ...]:
    """Frames after the start-up that repeat their predecessor; only frames of few bytes are decoded."""
    size = files.movie.packet_bytes
    if size is None or len(size) != len(motion_px):
        return ()
    wanted = [k for k in start.suspects(size, files.movie.keyframes, look) if motion_px[k] > start.MIN_MOTION_PX]
    found: tuple[int, ...] = ()
    # a repeated key frame is as large as any other, so search the neighbourhood of small frames
    for reach in (1, 2 * start.REPEATS_APART):
        around = sorted({n for k in wanted for n in range(max(k - reach, look - 1), k + reach + 1) if n < len(size)})
        found = start.find_repeats(_differences(files, around, len(size)), motion_px) if around else ()
        wanted = list(found)
    return found


def _stall_note(stalls: tuple[tuple[int, int], ...], repeats: tuple[int, ...]) -> Note:
    runs = ", ".join(f"{first}–{last}" for first, last in stalls[:8]) + (" …" if len(stalls) > 8 else "")
    seen = f"; frames {', '.join(map(str, repeats))} repeat their predecessor" if repeats else ""
    text = (
        f"the encoder stalled: frames {runs} may show another instant than their timestamps and are skipped, unless "
        f"tracked points determine when they were taken{seen}"
    )
    return Note("warning", "encoder-stall", text)


def _startup_note(began: start.Startup) -> Note:
    seen, verb = [], "may show"
    if began.unix_lag_s and began.unix_lag_s[0] > began.unix_lag_s[1]:
        (first, steady), verb = began.unix_lag_s, "show"
        seen.append(f"capture-to-encoder delay (Unix columns) falls from {first * 1e3:.0f} to {steady * 1e3:.0f} ms")
    if began.repeats:
        seen.append(f"frames {', '.join(map(str, began.repeats))} repeat their predecessor while the phone rotates")
    text = (
        f"the first {began.frames} frames {verb} later content than their timestamps, frame 0 by at least "
        f"{began.lag_s or 0.0:.2f} s: {'; '.join(seen)}"
    )
    return Note("warning", "content-lag", text)


def _frames(recording: _Recording, began: start.Startup) -> tuple[Frame, ...]:
    files, joined, imu, metadata = recording.files, recording.joined, recording.imu, recording.metadata
    readout_s = metadata.readout_time_s or 0.0
    exposures_s = _exposures_s(recording)
    scales = _focal_scales(recording)
    imu_period_s = median_period_s(imu.time_s)
    frames = []
    for i, row in enumerate(joined.metadata_rows.tolist()):
        exposure_s = exposures_s[i]
        reasons: list[tuple[str, str]] = []
        if i < began.frames:
            late = f"(at frame 0 by {began.lag_s or 0.0:.2f} s)"
            reasons.append((STARTUP, f"start-up: content later than its stamp {late}"))
        if any(first <= i <= last for first, last in began.stalls):
            reasons.append((STALL, "encoder stall: content may be later than its stamp"))
        if not joined.has_stamp[i]:
            reasons.append((NO_STAMP, f"no row in {files.names.stamps if files.stamps else files.names.metadata}"))
        start_s = float(recording.time_s[i])
        end_s = start_s + (exposure_s or metadata.exposure_s or 0.0) + readout_s
        if outside := outside_reason(start_s, end_s, imu.time_s, recording.gaps, imu_period_s):
            reasons.append(outside)
        frames.append(
            Frame(
                index=i,
                timestamp_ns=int(joined.stamps_ns[i]) + recording.shift_ns,
                time_s=start_s,
                exposure_s=exposure_s,
                iso=_value(files.metadata.iso, row) if files.metadata else None,
                focus_dioptres=_value(files.metadata.focus_dioptres, row) if files.metadata else None,
                focal_scale=None if scales is None else float(scales[i]),
                skip_reason="; ".join(text for _, text in reasons) or None,
                skip_codes=tuple(code for code, _ in reasons),
            )
        )
    return tuple(frames)


def _exposures_s(recording: _Recording) -> list[float | None]:
    """Exposure of each frame; missing ones are interpolated, since automatic exposure changes gradually."""
    time_s, table = recording.time_s, recording.files.metadata
    if table is None:
        return [None] * len(time_s)
    rows = recording.joined.metadata_rows
    logged = np.where(rows >= 0, table.exposure_s[rows], np.nan)
    known = np.isfinite(logged)
    if not known.any():
        return [None] * len(time_s)
    missing = np.flatnonzero(~known)
    if len(missing):
        text = f"{len(missing)} of {len(known)} frames have no exposure time; it is interpolated: {_listed(missing)}"
        recording.notes.append(Note("warning", "exposure-interpolated", text))
    return [float(value) for value in np.interp(time_s, time_s[known], logged[known])]


def _focal_scales(recording: _Recording) -> Array | None:
    """Focal length of each frame over the median; None if it is not logged or does not change."""
    files, rows = recording.files, recording.joined.metadata_rows
    if files.metadata is None:
        return None
    half_diagonal = 0.5 * float(np.hypot(files.movie.width, files.movie.height))
    scales = focal_scales(np.where(rows >= 0, files.metadata.fx_px[rows], np.nan), recording.time_s, half_diagonal)
    if scales is not None:
        text = (
            f"the focal length in {files.names.metadata} changes from {scales.min() - 1:+.2%} to "
            f"{scales.max() - 1:+.2%} of its median (the lens refocuses): it is followed frame by frame"
        )
        recording.notes.append(Note("info", "focal-varies", text))
    return scales


def _listed(numbers: Sequence[int] | Index) -> str:
    """The first numbers of the frames that a note is about."""
    return ", ".join(map(str, numbers[:MOST_LISTED])) + (" …" if len(numbers) > MOST_LISTED else "")


def _value(column: Array, row: int) -> float | None:
    return float(column[row]) if row >= 0 and np.isfinite(column[row]) else None


def _note_imu(imu: ImuSamples, gaps: tuple[tuple[float, float], ...], notes: list[Note]) -> None:
    for gap_start, gap_end in gaps[:20]:
        text = f"no IMU rows from {gap_start:.3f} to {gap_end:.3f} s ({(gap_end - gap_start) * 1e3:.0f} ms)"
        notes.append(Note("warning", IMU_GAP, text))
    if len(gaps) > 20:
        notes.append(Note("warning", IMU_GAP, f"{len(gaps) - 20} more gaps in the IMU rows"))
    if imu.has_accelerometer:
        _note_accelerometer(imu, notes)
    else:
        notes.append(Note("info", "no-accelerometer", "no accelerometer values: camera velocity cannot be estimated"))
    peak = float(np.abs(imu.gyro_rad_s).max())
    if peak > LARGE_RATE_RAD_S:
        text = f"angular rates of up to {peak:.0f} rad/s exceed the range of phone gyroscopes: are they in degrees?"
        notes.append(Note("warning", "gyro-large", text))


def _note_accelerometer(imu: ImuSamples, notes: list[Note]) -> None:
    """Check the size of gravity, most of what a phone's accelerometer reads, to detect another quantity or unit."""
    typical = float(np.nanmedian(np.linalg.norm(imu.accel_m_s2, axis=1)))
    if not PLAUSIBLE_ACCEL_M_S2[0] <= typical <= PLAUSIBLE_ACCEL_M_S2[1]:
        text = (
            f"the accelerometer's median magnitude is {typical:.2g} m/s^2, but gravity alone is 9.8: is it in g, "
            "without gravity, or are its columns swapped with the gyroscope's?"
        )
        notes.append(Note("warning", "accel-implausible", text))


def _note_frames(frames: tuple[Frame, ...], notes: list[Note]) -> None:
    """Note the frames that the IMU data do not cover. Raises ImuError if they cover none."""
    outside = [frame.index for frame in frames if {NO_IMU, IMU_GAP} & set(frame.skip_codes)]
    if len(outside) == len(frames):
        raise ImuError(
            f"none of the {len(frames)} frames is covered by IMU data: frame {outside[0]} {frames[0].skip_reason}",
            hint="the gyroscope was not logged while the camera ran; see `virest inspect`",
        )
    if outside:
        text = f"{len(outside)} of {len(frames)} frames are not covered by IMU data and are skipped: {_listed(outside)}"
        notes.append(Note("warning", "frames-without-imu", text))


def _counts(files: Source, joined: _Joined, frames: tuple[Frame, ...]) -> dict[str, int]:
    counts = {
        "movie_frames": len(files.movie),
        "movie_repeated_pts": files.movie.repeated_pts,
        "stamp_rows": files.stamps.rows if files.stamps else 0,
        "metadata_rows": files.metadata.rows if files.metadata else 0,
        "metadata_joined": int((joined.metadata_rows >= 0).sum()),
        "gyro_rows": files.gyro.rows,
        "gyro_rows_used": len(files.gyro.time_ns),
        "frames_usable": sum(frame.skip_reason is None for frame in frames),
    }
    for code in sorted({code for frame in frames for code in frame.skip_codes}):
        counts[f"frames_skipped: {code}"] = sum(code in frame.skip_codes for frame in frames)
    tables: tuple[tuple[str, StampTable | MetadataTable | GyroTable | None], ...] = (
        (files.names.stamps, files.stamps),
        (files.names.metadata, files.metadata),  # of some recorders the same file
        (files.names.gyro, files.gyro),
    )
    for name, table in tables:
        for reason, number in (table.dropped if table else {}).items():
            counts[f"{name} dropped: {reason}"] = number
    return counts
