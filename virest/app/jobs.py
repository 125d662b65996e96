"""A run as a list of segments: small, picklable, idempotent pieces of work for any concurrent.futures.Executor.

The cuts depend on the movie and on the chosen frames only, never on the number of jobs; so the bytes do not either.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from dataclasses import dataclass, replace
from itertools import chain, islice
from multiprocessing.connection import wait as wait_for_handles
from pathlib import Path
from typing import Any, Generic, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.app.cluster import ClusterExecutor
from virest.app.memory import keep_freed_memory
from virest.app.outputs import RunFolder, json_line, write_picture, write_whole
from virest.capture.folder import Capture, Frame
from virest.capture.imu import ImuSamples
from virest.capture.location import is_unreachable
from virest.capture.video import MovieIndex, read_frames
from virest.errors import OutputError, RestorationError, VirestError
from virest.motion.optics import settling_time_s
from virest.restoration.capture import RestorationPlan, at_true_times, restore_frames
from virest.restoration.frame import RestoredFrame

log = logging.getLogger(__name__)

LOOK_S = 5.0
"""How often to look after the workers while nothing comes back."""
MIN_SEGMENT_FRAMES, USUAL_SEGMENT_FRAMES, MAX_SEGMENT_FRAMES = 5, 10, 30
IMU_MARGIN_S = 1.0
MOST_AHEAD = 8
"""Calls begun before their results are wanted: enough to keep many workers in work, few enough to keep memory flat."""
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

EDGE_PX = 0.5
"""A pixel reaches this far around its centre: as `valid_px` counts."""

Picture = NDArray[np.uint8]
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class PictureWishes:
    """Which pictures a run writes beside the restored frames, and which it leaves out."""

    masks: bool = False
    """Where a restored frame holds recorded data."""
    skip_copied: bool = False
    """No picture of frames that are only copied."""


@dataclass(frozen=True, slots=True)
class Segment:
    """A few neighbouring frames and everything that a worker needs for them."""

    capture_name: str
    movie: Path
    index: MovieIndex
    frames: tuple[Frame, ...]
    imu: ImuSamples
    """The samples that cover the frames, with a margin."""
    plan: RestorationPlan
    run: RunFolder
    around: tuple[Frame, ...] = ()
    """Neighbours in the movie that are decoded for these frames' sake and not restored here."""
    pictures: PictureWishes = PictureWishes()

    @property
    def log_path(self) -> Path:
        """Where the lines of this segment go."""
        return self.run.segment_log(self.frames[0].index, self.frames[-1].index)


# ── cutting ──────────────────────────────────────────────────────────────────────────────────────────────────────


def cut_frames(frames: Sequence[Frame], keyframes: Iterable[int]) -> list[tuple[Frame, ...]]:
    """Cut frames into runs of about ten, at frames that the decoder can start from where there are some.

    Far from a key frame runs are longer, since a worker decodes everything from the key frame on.
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
    """The samples that cover these frames' exposures, with a second to spare on both sides.

    A stabiliser's place depends on the motion before; its samples begin early enough for the cut not to matter.
    """
    profile = plan.profile
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
    pictures: PictureWishes = PictureWishes(),
) -> Segment:
    """One segment as a worker takes it."""
    place, movie = RunFolder(run.path.absolute()), capture.movie.absolute()  # a worker may stand in another folder
    around = _around(frames, capture, plan)
    every = sorted((*frames, *around), key=lambda frame: frame.index)
    imu = cut_imu(capture.imu, every, plan)
    return Segment(name, movie, index, frames, imu, plan.of(every), place, around, pictures)


def _around(frames: tuple[Frame, ...], capture: Capture, plan: RestorationPlan) -> tuple[Frame, ...]:
    """The usable neighbours in the movie of frames that are restored, as far as the plan looks."""
    own = {frame.index for frame in frames}
    restored = [frame.index for frame in frames if frame.skip_reason is None]
    wanted = {n + k for n in restored for k in range(-plan.reach, plan.reach + 1)} - own
    if not wanted:
        return ()
    every = at_true_times(capture.frames, plan.profile, capture.repeats)
    return tuple(frame for frame in every if frame.index in wanted and frame.skip_reason is None)


# ── the work on one segment ──────────────────────────────────────────────────────────────────────────────────────


def run_segment(segment: Segment) -> dict[str, int]:
    """Restore a segment's frames, write their pictures and, last, the segment's log. Returns counts by status.

    Doing it again gives the same files. A frame that fails gets its line, and the others go on. Raises OutputError.
    """
    prepare_worker()
    lines: dict[int, dict[str, Any]] = {}
    decode_s: dict[int, float] = {}
    for restored in chain(_skipped(segment), _restored(segment, decode_s)):
        lines[restored.frame.index] = _write_frame(segment, restored, decode_s.get(restored.frame.index, 0.0))
    return _write_log(segment, lines)


def fail_segment(segment: Segment, reason: str) -> dict[str, int]:
    """Write the log of a segment that could not be worked on: its frames failed, those left out stay left out."""
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
    return RestoredFrame(frame, status, None, warnings=(reason,), valid_px=(0, 0, 0, 0), parameters={}, seconds={})


def _decoded(
    segment: Segment, seconds: dict[int, float], steps: dict[int, float]
) -> Iterator[tuple[Frame, Picture | None]]:
    """The segment's usable frames and their neighbours in order, each with its picture, or None where it has none."""
    usable = [frame for frame in segment.frames if frame.skip_reason is None]
    wanted = deque(sorted((*usable, *segment.around), key=lambda frame: frame.index))
    if not usable:
        return
    source = read_frames(segment.movie, segment.index, wanted[0].index, wanted[-1].index, steps)
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
    steps: dict[int, float] = {}

    def feed(source: Iterable[tuple[Frame, Picture | None]]) -> Iterator[tuple[Frame, Picture | None]]:
        for frame, picture in source:
            if picture is not None:
                fed.append((frame, picture))
                yield frame, picture
            elif frame.index in due:
                undecodable.append(frame)

    source: Iterator[tuple[Frame, Picture | None]] = _decoded(segment, decode_s, steps)
    while True:
        try:
            for restored in restore_frames(feed(source), segment.imu, segment.plan, due.copy(), steps):
                due.discard(restored.frame.index)
                while fed and fed[0][0].index < restored.frame.index - segment.plan.reach:
                    fed.popleft()
                yield restored
            break
        except OutputError:
            raise
        except Exception as error:  # one frame's fault must not take the others along
            failed = next((frame for frame, _ in fed if frame.index in due), None)
            if failed is None or is_unreachable(error):
                raise
            log.debug("frame %d", failed.index, exc_info=True)
            due.discard(failed.index)
            yield _without_picture(failed, "failed", _reason(error))
            source = chain([one for one in fed if one[0] is not failed], source)
            fed.clear()
    lost = [frame for frame, _ in fed if frame.index in due]
    yield from (_without_picture(frame, "failed", "no result came from the restoration") for frame in lost)
    yield from (_without_picture(frame, "failed", "the frame cannot be decoded") for frame in undecodable)


def _reason(error: Exception) -> str:
    return str(error) if isinstance(error, VirestError) else f"{type(error).__name__}: {error} (a fault of virest)"


def _write_frame(segment: Segment, restored: RestoredFrame, decode_s: float) -> dict[str, Any]:
    """Write the frame's picture, if there is one, and give its line."""
    if segment.pictures.skip_copied and restored.status == "copied":
        restored = replace(restored, picture=None)
    path = segment.run.picture(restored.frame.index)
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
    return frame_line(segment, restored, seconds)


def recorded_mask(picture: Picture, source_px: NDArray[np.float32] | None) -> Picture:
    """(height, width): 255 where a pixel was read inside the recorded picture, 0 where its edge is repeated."""
    height, width = picture.shape[:2]
    if source_px is None:
        return np.full((height, width), 255, np.uint8)
    return np.asarray(
        cv2.inRange(source_px, (-EDGE_PX, -EDGE_PX), (width - 1 + EDGE_PX, height - 1 + EDGE_PX)), np.uint8
    )


def frame_line(segment: Segment, restored: RestoredFrame, seconds: dict[str, float]) -> dict[str, Any]:
    """One line of parameters.jsonl."""
    frame, profile = restored.frame, segment.plan.profile
    scale = profile.shutter.exposure_scale
    curve = profile.response.kind if profile.response else "srgb"
    line: dict[str, Any] = {
        "capture": segment.capture_name,
        "frame": frame.index,
        "timestamp_ns": frame.timestamp_ns,
        "exposure_s": None if frame.exposure_s is None else frame.exposure_s * scale,
        "status": restored.status,
        "done": [],
        "output": None if restored.picture is None else f"frames/{segment.run.picture(frame.index).name}",
        "warnings": list(restored.warnings),
        "valid_px": list(restored.valid_px),
        "motion": None,
        "depth_m": None,
        "depth_source": "none",
        "blur": None,
        "shutter": None,
        "response": curve,
        "deblur": {"method": "none"},
    }
    line |= restored.parameters
    line["done"] = [*steps_done(line), *(["undistorted"] if restored.undistorted and line["output"] else [])]
    return {**line, "seconds": {name: round(s, 4) for name, s in seconds.items()}}


def steps_done(line: dict[str, Any]) -> list[str]:
    """What was done to a frame: ``deblurred``, ``straightened``."""
    if line["status"] != "restored":
        return []
    steps = (("deblurred", line["deblur"]), ("straightened", line["shutter"]))
    return [name for name, step in steps if step and step["method"] != "none"]


# ── workers ──────────────────────────────────────────────────────────────────────────────────────────────────────

Running = dict[Future[dict[str, int]], Segment]

_prepared: list[int] = []


def prepare_worker() -> None:
    """One thread a process: the pool is the parallelism, and sums do not depend on the number of cores."""
    if os.getpid() not in _prepared:
        cv2.setNumThreads(1)
        keep_freed_memory()
        _prepared.append(os.getpid())


def process_pool(jobs: int, *, verbose: bool = False) -> ProcessPoolExecutor:
    """Worker processes, which start when they are first needed."""
    for variable in THREAD_VARIABLES:
        os.environ[variable] = "1"
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(jobs, context, initializer=_start_worker, initargs=(verbose,))


def submit_uninterrupted(pool: ProcessPoolExecutor, function: Callable[..., Result], *arguments: Any) -> Future[Result]:
    """Hand a call to a pool; processes that this starts never see the Ctrl-C meant for the parent."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows, where workers ignore Ctrl-C once they run
        return pool.submit(function, *arguments)
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # inherited by processes started here
    try:
        return pool.submit(function, *arguments)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def _start_worker(verbose: bool) -> None:
    """Set up a worker process: no Ctrl-C of its own (the parent decides), and no life after the parent's."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    logger = logging.getLogger("virest")
    logger.setLevel(logging.DEBUG if verbose else logging.CRITICAL)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_die_with, args=(parent.sentinel,), daemon=True).start()
    prepare_worker()


def _die_with(sentinel: int) -> None:
    wait_for_handles([sentinel])
    os._exit(1)


class SerialExecutor(Executor):
    """Does the work at once, in this process."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Call the function and hand back its result as a finished future."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # handed over with the future, as an executor does
            future.set_exception(error)
        return future


class Workers:
    """An executor that can be started again, and the number of segments that may be in flight."""

    def __init__(self, jobs: int, scheduler: str | None = None, *, verbose: bool = False) -> None:
        self.jobs = jobs
        self.scheduler = scheduler
        self.verbose = verbose
        self._executor: Executor | None = None

    @property
    def slots(self) -> int:
        """Segments in flight at once: enough to keep every worker busy, few enough to keep memory flat."""
        if isinstance(self._executor, ClusterExecutor):
            return self._executor.slots
        return 1 if self.here else self.jobs + 1

    def start(self, *places: Path) -> None:
        """Have workers at hand that see these places. Raises SettingsError where a cluster's do not."""
        if self._executor is None:
            self._executor = self._start()
        if isinstance(self._executor, ClusterExecutor):
            self._executor.require_places(list(places))

    def submit(self, segment: Segment) -> Future[dict[str, int]]:
        """Hand a segment to the executor."""
        return self.call(run_segment, segment)

    def call(self, function: Callable[..., Result], *arguments: Any) -> Future[Result]:
        """Have a function called by a worker."""
        if self._executor is None:
            self._executor = self._start()
        if not isinstance(self._executor, ProcessPoolExecutor):
            return self._executor.submit(function, *arguments)
        return submit_uninterrupted(self._executor, function, *arguments)

    @property
    def here(self) -> bool:
        """Whether this process is the only worker."""
        return self.jobs == 1 and self.scheduler is None

    @property
    def started(self) -> Executor | None:
        """The executor at hand, another one after a restart: then what was given to the last one is lost."""
        return self._executor

    def _start(self) -> Executor:
        if self.scheduler is not None:
            return ClusterExecutor(self.scheduler, verbose=self.verbose)
        if self.jobs == 1:
            return SerialExecutor()
        return process_pool(self.jobs, verbose=self.verbose)

    def check(self) -> None:
        """Look whether anybody is still at work; called while nothing comes back. Raises RestorationError."""
        if isinstance(self._executor, ClusterExecutor):
            self._executor.check()

    def lost(self) -> VirestError:
        """The error of work that was called off from outside."""
        if isinstance(self._executor, ClusterExecutor):
            return self._executor.lost()
        return RestorationError("the job was cancelled", hint="continue with --resume")

    def renew(self) -> None:
        """After a worker's death: a pool is broken and begins anew, a cluster has others."""
        if not isinstance(self._executor, ClusterExecutor):
            self.kill()

    def kill(self) -> None:
        """Stop all work now; the next submit starts anew."""
        executor, self._executor = self._executor, None
        if executor is None:
            return
        if isinstance(executor, ProcessPoolExecutor):
            for process in multiprocessing.active_children():
                process.kill()
                process.join()
        executor.shutdown(wait=False, cancel_futures=True)

    def close(self) -> None:
        """Let the workers go, once they are idle."""
        if self._executor is not None:
            self._executor.shutdown()
            self._executor = None


def run_segments(segments: Iterable[Segment], workers: Workers) -> Iterator[tuple[Segment, dict[str, int]]]:
    """Run segments, a bounded number at a time; yields each as it is done, with its counts by status.

    A segment that was lost with its worker is tried once more, alone; lost again, its frames fail.
    """
    waiting = iter(segments)
    running: Running = {}
    while True:
        lost = _fill(running, waiting, workers)
        if not running and not lost:
            return
        for future in _await_first(running, workers) if running else ():
            segment = running.pop(future)
            counts = _collect(future, segment, workers)
            if counts is None:
                lost.append(segment)
            else:
                yield segment, counts
        if lost:
            yield from _rescue(lost, running, workers)


def _fill(
    running: dict[Future[dict[str, int]], Segment], waiting: Iterator[Segment], workers: Workers
) -> list[Segment]:
    """Submit until the slots are full; gives back the segment that a broken pool would not take."""
    for segment in islice(waiting, max(workers.slots - len(running), 0)):
        try:
            running[workers.submit(segment)] = segment
        except BrokenExecutor:
            return [segment]
    return []


def _await_first(futures: Iterable[Future[Result]], workers: Workers) -> set[Future[Result]]:
    while True:
        done = wait(futures, timeout=LOOK_S, return_when=FIRST_COMPLETED).done
        if done:
            return done
        workers.check()


def _collect(future: Future[dict[str, int]], segment: Segment, workers: Workers) -> dict[str, int] | None:
    """The counts of a finished segment; None where its worker died."""
    try:
        return future.result()
    except OutputError:
        raise
    except CancelledError:
        raise workers.lost() from None
    except BrokenExecutor:
        return None
    except Exception as error:  # explained in the frames' lines; the other segments go on
        if is_unreachable(error):
            raise
        if _is_killed(error):
            return None
        log.debug("segment %s", segment.log_path.stem, exc_info=True)
        return fail_segment(segment, _reason(error))


def _rescue(lost: list[Segment], running: Running, workers: Workers) -> Iterator[tuple[Segment, dict[str, int]]]:
    """Collect what a broken pool still holds, then try each lost segment alone in a new one."""
    for future, segment in list(running.items()):
        counts = _collect(future, segment, workers)
        if counts is None:
            lost.append(segment)
        else:
            yield segment, counts
    running.clear()
    for segment in sorted(lost, key=lambda s: s.frames[0].index):
        frames = f"frames {segment.frames[0].index}-{segment.frames[-1].index}"
        log.warning("%s: a worker died on %s or its neighbours; trying again", segment.capture_name, frames)
        workers.renew()
        counts = _collect(workers.submit(segment), segment, workers)
        yield (
            segment,
            fail_segment(segment, "the worker process died twice on this segment") if counts is None else counts,
        )
    workers.renew()


def _is_killed(error: Exception) -> bool:
    """Whether an error says that a call's workers died: a pool's, or Dask's once it gives a call up."""
    return isinstance(error, BrokenExecutor) or type(error).__name__ == "KilledWorker"


class PrefetchedCalls(Generic[Result]):
    """Calls whose results are wanted one after the other; workers begin some of them before it is their turn.

    A call that was lost with its worker is tried once more, alone; lost again, it raises RestorationError.
    """

    def __init__(self, function: Callable[..., Result], calls: Sequence[tuple[Any, ...]], workers: Workers) -> None:
        self._function = function
        self._calls = calls
        self._workers = workers
        self._begun: dict[int, tuple[Future[Result], Executor | None]] = {}

    def result(self, number: int, name: str) -> Result:
        """The result of a call, or what it raised; ``name`` is for the log."""
        if number not in self._begun or self._begun[number][1] is not self._workers.started:
            self._begun.pop(number, None)
            self.begin(number)
        future = self._taken(number)
        if future is not None:
            try:
                return self._awaited(future)
            except Exception as error:
                if not _is_killed(error):
                    raise
        log.warning("%s: a worker died while this capture or a neighbour was planned; trying again", name)
        return self._alone(number)

    def begin(self, number: int) -> None:
        """Have the call and some after it begun: best done where workers will soon have nothing else to do.

        One that was lost waits for its turn: it may be the one that kills its worker.
        """
        last = number + min(self._workers.slots, MOST_AHEAD)
        for following in range(number, min(last, len(self._calls))):
            if following in self._begun:
                continue
            try:
                future = self._workers.call(self._function, *self._calls[following])
            except BrokenExecutor:
                return
            self._begun[following] = (future, self._workers.started)

    def _taken(self, number: int) -> Future[Result] | None:
        """The call's future; None where the workers that had it are gone."""
        future, executor = self._begun.pop(number, (None, None))
        return future if executor is self._workers.started else None

    def _awaited(self, future: Future[Result]) -> Result:
        _await_first([future], self._workers)
        try:
            return future.result()
        except CancelledError:
            raise self._workers.lost() from None

    def _alone(self, number: int) -> Result:
        """The call once more in fresh workers that have nothing else to do."""
        self._begun.clear()
        self._workers.renew()
        try:
            return self._awaited(self._workers.call(self._function, *self._calls[number]))
        except Exception as error:
            if not _is_killed(error):
                raise
            self._workers.renew()
            text = "the worker process died twice while this capture was read and planned"
            raise RestorationError(text, hint="--resume tries again; fewer --jobs take less memory") from None
