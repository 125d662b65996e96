"""Join movie frames, timestamps, metadata and inertial samples by time, never by index."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.capture.records import IMU_GAP, NO_IMU
from virest.capture.tables import EdgeEpochs
from virest.errors import ClockError

TICKS_PER_S = 90_000
"""Movie clock of Android's recorder: the 90 kHz of MPEG timestamps (ISO/IEC 13818-1, 2.4.3.7)."""
STAMP_STEP_NS = 1000
"""Timestamps are truncated to whole microseconds."""
COARSEST_TICK_NS = 1e6
"""A movie clock coarser than this cannot identify a timestamp."""
MOST_DRIFT = 1e-3
"""Largest relative difference of a movie's nominal frame rate from the sensor's; crystals differ by 1/20 of it."""
MIN_MATCHED_FRACTION = 0.8
"""If fewer of the frames match a timestamp, movie and timestamps come from different recordings."""
MAX_CANDIDATES, SCORED_FRAMES = 20_000, 500
"""Limits on the work for long recordings: 11 min at 30 frames/s to align with, of which 500 frames are scored first."""
GAP_PERIODS = 5.0
"""A gap is longer than this many median periods; the gyroscope's spline is then interrupted."""
GAP_FLOOR_S = 0.030
"""Hand motion has little power above 10 Hz, so interpolation still follows it over 30 ms, a third of that period."""

Int64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Alignment:
    """Which timestamp belongs to which frame."""

    rows: Int64
    """(n,) row of the timestamps for each movie frame, −1 for none."""
    offset_ns: int
    """Timestamp of the movie's PTS 0."""
    slid: bool
    """False: row i is frame i, as the logger writes it."""
    rivals: int = 0
    """Number of other offsets that fit equally well."""
    drift_ns: float = 0.0
    """Slow drift between PTS and timestamps from the first to the last frame; 0: none."""


def pts_tolerance_ns(tick_ns: float) -> float:
    """Largest difference of PTS and timestamps: a tick of 90 kHz, or of a coarser movie clock, plus 1 µs."""
    return max(1e9 / TICKS_PER_S, min(tick_ns, COARSEST_TICK_NS)) + STAMP_STEP_NS


def match_times(wanted_ns: Int64, rows_ns: Int64, tolerance_ns: float) -> Int64:
    """Row of the nearest of the rising ``rows_ns`` for each wanted time, −1 where none lies within the tolerance."""
    if not len(rows_ns):
        return np.full(len(wanted_ns), -1, np.int64)
    after = np.clip(np.searchsorted(rows_ns, wanted_ns), 0, len(rows_ns) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(rows_ns[before] - wanted_ns) <= np.abs(rows_ns[after] - wanted_ns), before, after)
    return np.where(np.abs(rows_ns[nearest] - wanted_ns) <= tolerance_ns, nearest, -1)


def floor_us(times_ns: Int64) -> Int64:
    """Nanoseconds truncated to whole microseconds, like the encoder's timestamps."""
    return times_ns // STAMP_STEP_NS * STAMP_STEP_NS


def join_metadata(stamps_ns: Int64, metadata_ns: Int64) -> Int64:
    """Metadata row of each stamp, −1 for none: floored microseconds agree within one."""
    return match_times(floor_us(stamps_ns), floor_us(metadata_ns), STAMP_STEP_NS)


def align_frames(
    pts_ns: Int64, stamps_ns: Int64, tolerance_ns: float, witness_ns: Int64 | None = None, what: str = "stamps"
) -> Alignment:
    """Find the timestamp of each movie frame: row by row if all agree, else by the PTS shift that matches most frames.

    pts_ns (n,) from 0, stamps_ns (m,), both rising.  ``witness_ns``: further times (metadata rows) that break ties
    between shifts.  Raises ClockError if no shift matches MIN_MATCHED_FRACTION of the frames.
    """
    if len(pts_ns) == len(stamps_ns):
        difference = stamps_ns - stamps_ns[0] - pts_ns
        if np.abs(difference).max() <= tolerance_ns:
            return Alignment(np.arange(len(pts_ns)), int(stamps_ns[0]), False)
        if _drifts_slowly(difference, pts_ns, tolerance_ns):
            return Alignment(np.arange(len(pts_ns)), int(stamps_ns[0]), False, drift_ns=float(difference[-1]))
    offsets, scores = _best_offsets(pts_ns, stamps_ns, tolerance_ns)
    if not len(offsets) or scores[0] < max(1, MIN_MATCHED_FRACTION * len(pts_ns)):
        raise _misfit(pts_ns, stamps_ns, tolerance_ns, int(scores[0]) if len(scores) else 0, what)
    if len(offsets) > 1 and witness_ns is not None and len(witness_ns):
        seen = np.array([np.sum(match_times(pts_ns + o, floor_us(witness_ns), tolerance_ns) >= 0) for o in offsets])
        offsets = offsets[seen == seen.max()]
    direct = np.abs(offsets - stamps_ns[0]) <= tolerance_ns
    offset = int(offsets[direct][0] if direct.any() else offsets[0])
    rows = match_times(pts_ns + offset, stamps_ns, tolerance_ns)
    return Alignment(rows, offset, True, len(offsets) - 1)


def _drifts_slowly(difference_ns: Int64, pts_ns: Int64, tolerance_ns: float) -> bool:
    """Whether timestamps and PTS drift apart smoothly: no step, and no faster than MOST_DRIFT.

    They do if the recorder writes its nominal frame rate into the movie; a lost frame is a step of one period.
    """
    if len(pts_ns) < 3:
        return False
    steps, rate = np.abs(np.diff(difference_ns)), np.abs(difference_ns) / np.maximum(pts_ns, 1)
    period = float(np.median(np.diff(pts_ns)))
    settled = pts_ns > 10 * period
    smooth = bool((steps <= tolerance_ns + MOST_DRIFT * period).all())
    return smooth and bool((rate[settled] <= MOST_DRIFT + tolerance_ns / np.maximum(pts_ns[settled], 1)).all())


def _best_offsets(pts_ns: Int64, stamps_ns: Int64, tolerance_ns: float) -> tuple[Int64, Int64]:
    """Distinct shifts, smallest first, that match the most frames, and the number of matches (the same for all)."""
    if not len(stamps_ns) or not len(pts_ns):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    anchors = sorted({0, len(pts_ns) // 2, len(pts_ns) - 1})
    candidates = np.unique(np.concatenate([stamps_ns[:MAX_CANDIDATES] - pts_ns[anchor] for anchor in anchors]))
    candidates = candidates[np.concatenate([[True], np.diff(candidates) > tolerance_ns])]
    sample = pts_ns[np.unique(np.linspace(0, len(pts_ns) - 1, min(SCORED_FRAMES, len(pts_ns))).astype(int))]
    rough = np.array([np.sum(match_times(sample + c, stamps_ns, tolerance_ns) >= 0) for c in candidates])
    candidates = candidates[rough >= rough.max() - 1]
    scores = np.array([np.sum(match_times(pts_ns + c, stamps_ns, tolerance_ns) >= 0) for c in candidates])
    best = scores == scores.max()
    return candidates[best], scores[best]


def _misfit(pts_ns: Int64, stamps_ns: Int64, tolerance_ns: float, matched: int, what: str) -> ClockError:
    common = min(len(pts_ns), len(stamps_ns))
    text = f"movie has {len(pts_ns)} frames, {what} {len(stamps_ns)} rows; no shift matches more than {matched} of them"
    difference = np.abs(stamps_ns[:common] - stamps_ns[:1] - pts_ns[:common])
    if (difference > tolerance_ns).any():
        first = int(np.argmax(difference > tolerance_ns))
        text += (
            f"; PTS and {what} first differ at frame {first}, by {difference[first] / 1e3:.1f} µs"
            f" (tolerance {tolerance_ns / 1e3:.1f} µs), at most by {difference.max() / 1e6:.3f} ms"
        )
    hint = "movie and timestamps come from different recordings, or the movie was re-encoded"
    if 1 < matched == len(stamps_ns):
        hint = f"{what} lacks most of its rows: copy it again"
    return ClockError(text, hint=hint, matched=matched)


# ── clocks ───────────────────────────────────────────────────────────────────────────────────────────────────────


def overlap_s(camera_ns: Int64, imu_ns: Int64, shift_ns: int = 0) -> float:
    """Overlap of both clocks' spans, s, once ``shift_ns`` is added to the camera's; negative: the gap between them."""
    start = max(int(camera_ns[0]) + shift_ns, int(imu_ns[0]))
    return (min(int(camera_ns[-1]) + shift_ns, int(imu_ns[-1])) - start) / 1e9


def clock_shift_ns(
    camera_ns: Int64, imu_ns: Int64, epochs: EdgeEpochs, name: str = "gyro_accel.csv"
) -> tuple[int, str]:
    """Shift, ns, that brings camera timestamps to the IMU's clock, and a remark ('' if there is nothing to remark).

    REALTIME: 0.  UNKNOWN: the mean difference of edge_epochs.  No difference known: 0 if the spans overlap.
    Raises ClockError with both spans if they do not overlap.
    """
    known = epochs.mean_difference_ns if epochs.source == "UNKNOWN" else None
    shift, remark = known or 0, ""
    if known is None and epochs.source == "UNKNOWN":
        remark = "edge_epochs.txt lists no clock difference; the clocks overlap, so timestamps are not shifted"
    if overlap_s(camera_ns, imu_ns, shift) >= 0:
        return shift, remark
    if known is not None and overlap_s(camera_ns, imu_ns) >= 0:
        return 0, f"edge_epochs.txt gives {shift / 1e9:.3f} s, but only unshifted timestamps meet the IMU; not applied"
    camera = f"{(int(camera_ns[0]) + shift) / 1e9:.3f}–{(int(camera_ns[-1]) + shift) / 1e9:.3f} s"
    imu = f"{int(imu_ns[0]) / 1e9:.3f}–{int(imu_ns[-1]) / 1e9:.3f} s"
    raise ClockError(
        f"{name} covers {imu}, the frames {camera}: {-overlap_s(camera_ns, imu_ns, shift):.3f} s apart",
        hint="the files come from different sessions, or edge_epochs.txt is missing or wrong",
        source=epochs.source,
    )


def consecutive_runs(numbers: Iterable[int] | Int64) -> list[tuple[int, int]]:
    """First and last of each run of consecutive numbers, ascending."""
    ascending = np.array(sorted(set(numbers)), np.int64)
    parts = np.split(ascending, np.flatnonzero(np.diff(ascending) > 1) + 1) if len(ascending) else []
    return [(int(part[0]), int(part[-1])) for part in parts]


# ── coverage ─────────────────────────────────────────────────────────────────────────────────────────────────────


def median_period_s(time_s: Array) -> float:
    """Median step, 0 for fewer than two."""
    return float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0


def find_gaps(time_s: Array) -> tuple[tuple[float, float], ...]:
    """(start, end) of each step longer than GAP_PERIODS median steps and than GAP_FLOOR_S."""
    steps = np.diff(time_s)
    limit = max(GAP_PERIODS * median_period_s(time_s), GAP_FLOOR_S)
    return tuple((float(time_s[i]), float(time_s[i + 1])) for i in np.flatnonzero(steps > limit))


def outside_reason(
    start_s: float,
    end_s: float,
    time_s: Array,
    gaps_s: tuple[tuple[float, float], ...],
    period_s: float | None = None,
) -> tuple[str, str] | None:
    """(code, text) of the reason why the IMU data do not cover [start_s, end_s], None if they do.

    One period beyond either end counts as covered: the last rate is held that long.  period_s: the median sampling
    period, if already known.
    """
    period = median_period_s(time_s) if period_s is None else period_s
    if start_s < time_s[0] - period:
        return NO_IMU, f"begins {(time_s[0] - start_s) * 1e3:.1f} ms before the first IMU row"
    if end_s > time_s[-1] + period:
        return NO_IMU, f"ends {(end_s - time_s[-1]) * 1e3:.1f} ms after the last IMU row"
    for gap_start, gap_end in gaps_s:
        if start_s < gap_end and end_s > gap_start:
            length = (gap_end - gap_start) * 1e3
            return IMU_GAP, f"falls into the IMU gap {gap_start:.3f}–{gap_end:.3f} s ({length:.0f} ms)"
    return None
