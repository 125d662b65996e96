"""Segments: a few consecutive frames as one task; how a run is cut into segments, and how a segment is processed.

The cuts depend only on the movie and the selected frames, so the output bytes do not depend on the number of jobs.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.app.frame_log import frame_line
from virest.app.outputs import json_line, write_picture, write_whole
from virest.app.run_folder import RunFolder
from virest.app.worker_processes import prepare_worker
from virest.arrays import Picture
from virest.capture.folder import Capture, Frame
from virest.capture.frame_coding import FrameCoding
from virest.capture.imu import ImuSamples
from virest.capture.location import is_remote, is_unreachable
from virest.capture.video import MovieIndex, read_frames
from virest.errors import OutputError, VirestError
from virest.motion.optics import settling_time_s
from virest.restoration.capture import RestorationPlan, at_true_times, restore_frames
from virest.restoration.frame import RestoredFrame

log = logging.getLogger(__name__)

MIN_SEGMENT_FRAMES, USUAL_SEGMENT_FRAMES, MAX_SEGMENT_FRAMES = 5, 10, 30
"""Few enough to spread over the processes, with enough frames to pay for decoding from the key frame on."""
IMU_MARGIN_S = 1.0
"""Many samples beyond the exposures, so that the spline through them does not depend on the cut."""

EDGE_PX = 0.5
"""Half-width of a pixel around its centre, as for `valid_px`."""


@dataclass(frozen=True, slots=True)
class PictureOptions:
    """Which pictures a run writes in addition to the restored frames, and which it omits."""

    masks: bool = False
    """Write masks of the recorded data in restored frames."""
    skip_copied: bool = False
    """Write no picture of frames that are only copied."""


@dataclass(frozen=True, slots=True)
class Segment:
    """A few consecutive frames and everything that a worker needs to restore them."""

    capture_name: str
    movie: Path
    index: MovieIndex
    frames: tuple[Frame, ...]
    imu: ImuSamples
    """The samples that cover the frames, with a margin."""
    plan: RestorationPlan
    run: RunFolder
    neighbours: tuple[Frame, ...] = ()
    """Neighbouring frames that are decoded for joint restoration but not restored in this segment."""
    pictures: PictureOptions = PictureOptions()

    @property
    def log_path(self) -> Path:
        """Path of this segment's log."""
        return self.run.segment_log(self.frames[0].index, self.frames[-1].index)


def cut_frames(frames: Sequence[Frame], keyframes: Iterable[int]) -> list[tuple[Frame, ...]]:
    """Cut frames into runs of about ten, at key frames if possible.

    Far from a key frame runs are longer, since a worker must decode everything from the key frame on.
    """
    starts = np.array(sorted({0, *keyframes}))
    parts: list[list[Frame]] = []
    limit = 0
    for frame in frames:
        key = int(starts[np.searchsorted(starts, frame.index, side="right") - 1])
        if not parts or len(parts[-1]) >= limit or (len(parts[-1]) >= MIN_SEGMENT_FRAMES and key > parts[-1][-1].index):
            parts.append([])
            limit = min(max(USUAL_SEGMENT_FRAMES, (frame.index - key) // 2), MAX_SEGMENT_FRAMES)
        parts[-1].append(frame)
    return [tuple(part) for part in parts]


def cut_imu(imu: ImuSamples, frames: Sequence[Frame], plan: RestorationPlan) -> ImuSamples:
    """The samples that cover these frames' exposures, with a margin of 1 s on both sides.

    The state of a stabiliser depends on earlier motion; its samples start early enough for the cut not to matter.  To
    undo a gyroscope's filter, its noise is measured on the whole log, which is then not cut.
    """
    profile = plan.profile
    if profile.extensions.gyro_lowpass_hz or profile.extensions.gyro_averaging_s:
        return imu
    rate, offset_s = 1.0 + profile.clock_skew, profile.time_offset_s or 0.0
    longest_s = max((frame.exposure_s or 0.0) for frame in frames) * profile.shutter.exposure_scale
    spare_s = IMU_MARGIN_S + longest_s + profile.shutter.readout_time_s + profile.extensions.frame_lag_s
    start_s, end_s = (frames[i].time_s * rate + offset_s for i in (0, -1))
    return imu.between(start_s - spare_s - settling_time_s(profile), end_s + spare_s)


def make_segment(
    frames: tuple[Frame, ...],
    capture: Capture,
    name: str,
    index: MovieIndex,
    plan: RestorationPlan,
    run: RunFolder,
    pictures: PictureOptions = PictureOptions(),
) -> Segment:
    """One segment, ready for a worker."""
    place, movie = RunFolder(run.path.absolute()), capture.movie.absolute()  # a worker's current folder may differ
    neighbours = _neighbours(frames, capture, plan)
    every = sorted((*frames, *neighbours), key=lambda frame: frame.index)
    imu = cut_imu(capture.imu, every, plan)
    return Segment(name, movie, index, frames, imu, plan.of(every), place, neighbours, pictures)


def _neighbours(frames: tuple[Frame, ...], capture: Capture, plan: RestorationPlan) -> tuple[Frame, ...]:
    """The usable neighbours, within the plan's reach, of the frames to restore."""
    own = {frame.index for frame in frames}
    restored = [frame.index for frame in frames if frame.skip_reason is None]
    wanted = {n + k for n in restored for k in range(-plan.reach, plan.reach + 1)} - own
    if not wanted:
        return ()
    every = at_true_times(capture.frames, plan.profile, capture.repeats)
    return tuple(frame for frame in every if frame.index in wanted and frame.skip_reason is None)


def run_segment(segment: Segment) -> dict[str, int]:
    """Restore a segment's frames, write their pictures and then the segment's log. Returns counts by status.

    Repeating it gives the same files. A failed frame gets a line too, and the others continue. Raises OutputError.
    """
    prepare_worker()
    lines: dict[int, dict[str, Any]] = {}
    decode_s: dict[int, float] = {}
    for restored in chain(_skipped(segment), _restored(segment, decode_s)):
        lines[restored.frame.index] = _write_frame(segment, restored, decode_s.get(restored.frame.index, 0.0))
    return _write_log(segment, lines)


def run_or_fail_segment(segment: Segment) -> dict[str, int]:
    """As :func:`run_segment`; whatever else goes wrong in it is written into its frames' lines: they failed.

    So what a caller on another machine catches besides OutputError and an unreachable input is the cluster's fault.
    """
    try:
        return run_segment(segment)
    except Exception as error:  # the other segments continue
        if isinstance(error, OutputError) or is_unreachable(error):
            raise
        log.debug("segment %s", segment.log_path.stem, exc_info=True)
        return fail_segment(segment, reason_of(error))


def fail_segment(segment: Segment, reason: str) -> dict[str, int]:
    """Write the log of a segment that could not be processed: its frames failed, skipped ones stay skipped."""
    failed = (_without_picture(f, "failed", reason) for f in segment.frames if f.skip_reason is None)
    lines = {r.frame.index: _write_frame(segment, r, 0.0) for r in chain(_skipped(segment), failed)}
    return _write_log(segment, lines)


def _write_log(segment: Segment, lines: dict[int, dict[str, Any]]) -> dict[str, int]:
    ordered = [lines[frame.index] for frame in segment.frames]
    write_whole(segment.log_path, "".join(json_line(line) + "\n" for line in ordered).encode())
    counts: dict[str, int] = {}
    for line in ordered:
        counts[line["status"]] = counts.get(line["status"], 0) + 1
    return counts


def _skipped(segment: Segment) -> Iterator[RestoredFrame]:
    for frame in segment.frames:
        if frame.skip_reason is not None:
            yield _without_picture(frame, "skipped", frame.skip_reason)


def _without_picture(frame: Frame, status: str, reason: str) -> RestoredFrame:
    return RestoredFrame(frame, status, None, warnings=(reason,), valid_px=(0, 0, 0, 0), seconds={})


def _decoded(
    segment: Segment, seconds: dict[int, float], coding: dict[int, FrameCoding]
) -> Iterator[tuple[Frame, Picture | None]]:
    """The segment's usable frames and their neighbours in order, each with its picture, or None if undecodable."""
    usable = [frame for frame in segment.frames if frame.skip_reason is None]
    wanted = deque(sorted((*usable, *segment.neighbours), key=lambda frame: frame.index))
    if not usable:
        return
    source = read_frames(segment.movie, segment.index, wanted[0].index, wanted[-1].index, coding)
    began = time.perf_counter()
    try:
        for index, picture in source:
            while wanted and wanted[0].index < index:
                yield wanted.popleft(), None
            if wanted and wanted[0].index == index:
                seconds[index] = time.perf_counter() - began
                yield wanted.popleft(), picture
                began = time.perf_counter()
    except VirestError as error:
        if is_unreachable(error):
            raise
        log.warning("%s: %s", segment.capture_name, error)
    while wanted:
        yield wanted.popleft(), None


def _restored(segment: Segment, decode_s: dict[int, float]) -> Iterator[RestoredFrame]:
    """Restored frames, and a failed one for each frame that cannot be decoded or restored."""
    fed: deque[tuple[Frame, Picture]] = deque()
    due = {frame.index for frame in segment.frames if frame.skip_reason is None}
    undecodable: list[Frame] = []
    coding: dict[int, FrameCoding] = {}

    def feed(source: Iterable[tuple[Frame, Picture | None]]) -> Iterator[tuple[Frame, Picture | None]]:
        for frame, picture in source:
            if picture is not None:
                fed.append((frame, picture))
                yield frame, picture
            elif frame.index in due:
                undecodable.append(frame)

    source: Iterator[tuple[Frame, Picture | None]] = _decoded(segment, decode_s, coding)
    while True:
        try:
            for restored in restore_frames(feed(source), segment.imu, segment.plan, due.copy(), coding):
                due.discard(restored.frame.index)
                while fed and fed[0][0].index < restored.frame.index - segment.plan.reach:
                    fed.popleft()
                yield restored
            break
        except OutputError:
            raise
        except Exception as error:  # an error in one frame must not affect the others
            failed = next((frame for frame, _ in fed if frame.index in due), None)
            if failed is None or is_unreachable(error):
                raise
            log.debug("frame %d", failed.index, exc_info=True)
            due.discard(failed.index)
            yield _without_picture(failed, "failed", reason_of(error))
            source = chain([one for one in fed if one[0] is not failed], source)
            fed.clear()
    lost = [frame for frame, _ in fed if frame.index in due]
    yield from (_without_picture(frame, "failed", "the restoration returned no result") for frame in lost)
    yield from (_without_picture(frame, "failed", "the frame cannot be decoded") for frame in undecodable)


def reason_of(error: Exception) -> str:
    """The text of a failure in a frame's line."""
    return str(error) if isinstance(error, VirestError) else f"{type(error).__name__}: {error} (a bug in virest)"


def _write_frame(segment: Segment, restored: RestoredFrame, decode_s: float) -> dict[str, Any]:
    """Write the frame's picture, if any, and return its line."""
    if segment.pictures.skip_copied and restored.status == "copied":
        restored = replace(restored, picture=None)
    path = segment.run.picture(restored.frame.index)
    _require_unfinished(segment.run)
    began = time.perf_counter()
    if restored.picture is None:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(f"{path}: {error.strerror}", hint="check the output folder") from error
    else:
        if segment.pictures.masks:
            write_picture(segment.run.mask(restored.frame.index), recorded_mask(restored.picture, restored.source_px))
        write_picture(path, restored.picture)
    write_s = time.perf_counter() - began if restored.picture is not None else 0.0
    seconds = {"decode": decode_s, "estimate": 0.0, "deblur": 0.0, "shutter": 0.0, "write": write_s, **restored.seconds}
    return frame_line(segment.capture_name, segment.plan.profile, restored, path, seconds)


def _require_unfinished(run: RunFolder) -> None:
    """Raise OutputError if the run has ended, so that a worker that outlived its cluster leaves the folder alone."""
    if not is_remote(run.path) and not run.segments.is_dir():
        raise OutputError(
            f"{run.path}: the unfinished run is no longer there: it has ended elsewhere, or was removed",
            hint="if it was removed, start it again",
        )


def recorded_mask(picture: Picture, source_px: NDArray[np.float32] | None) -> Picture:
    """(height, width): 255 for pixels read inside the recorded frame, 0 where its edge is replicated."""
    height, width = picture.shape[:2]
    if source_px is None:
        return np.full((height, width), 255, np.uint8)
    return np.asarray(
        cv2.inRange(source_px, (-EDGE_PX, -EDGE_PX), (width - 1 + EDGE_PX, height - 1 + EDGE_PX)), np.uint8
    )
