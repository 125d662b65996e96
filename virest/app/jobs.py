"""A run as a list of segments: small, picklable, idempotent tasks for any concurrent.futures.Executor."""

from __future__ import annotations

import logging
import multiprocessing
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
from itertools import islice
from pathlib import Path
from typing import Any, Generic

from virest.app.cluster import ClusterExecutor
from virest.app.segments import Segment, fail_segment, run_or_fail_segment
from virest.app.worker_processes import Result, SerialExecutor, process_pool, submit_uninterrupted
from virest.capture.location import is_unreachable
from virest.errors import OutputError, RestorationError, VirestError

log = logging.getLogger(__name__)

LOOK_S = 5.0
"""How often to check the workers while no result arrives."""
MOST_AHEAD = 8
"""Calls started before their results are needed: enough to keep many workers busy, few enough to limit memory."""

Running = dict[Future[dict[str, int]], Segment]


class Workers:
    """An executor that can be restarted, and the number of segments that may be in flight."""

    def __init__(self, jobs: int, scheduler: str | None = None, *, verbose: bool = False) -> None:
        self.jobs = jobs
        self.scheduler = scheduler
        self.verbose = verbose
        self._executor: Executor | None = None

    @property
    def slots(self) -> int:
        """Segments in flight at once: enough to keep every worker busy, few enough to limit memory."""
        if isinstance(self._executor, ClusterExecutor):
            return self._executor.slots
        return 1 if self.here else self.jobs + 1

    def start(self, *paths: Path) -> None:
        """Start workers that can read these paths. Raises SettingsError if a cluster's workers cannot."""
        if self._executor is None:
            self._executor = self._start()
        if isinstance(self._executor, ClusterExecutor):
            self._executor.require_paths(list(paths))

    def submit(self, segment: Segment) -> Future[dict[str, int]]:
        """Submit a segment to the executor."""
        return self.call(run_or_fail_segment, segment)

    def call(self, function: Callable[..., Result], *arguments: Any) -> Future[Result]:
        """Submit a function call to a worker."""
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
        """The current executor; a different one after a restart, when work submitted to the last one is lost."""
        return self._executor

    def _start(self) -> Executor:
        if self.scheduler is not None:
            return ClusterExecutor(self.scheduler, verbose=self.verbose)
        if self.jobs == 1:
            return SerialExecutor()
        return process_pool(self.jobs, verbose=self.verbose)

    def check(self) -> None:
        """Check that workers are still alive; called while no result arrives. Raises RestorationError."""
        if isinstance(self._executor, ClusterExecutor):
            self._executor.check()

    def lost(self) -> VirestError:
        """The error for work that was cancelled from outside."""
        if isinstance(self._executor, ClusterExecutor):
            return self._executor.lost()
        return RestorationError("the job was cancelled", hint="continue with --resume")

    def renew(self) -> None:
        """After a worker's death: a pool is broken and is restarted, a cluster has other workers."""
        if not isinstance(self._executor, ClusterExecutor):
            self.kill()

    def kill(self) -> None:
        """Stop all work now; the next submit restarts the workers."""
        executor, self._executor = self._executor, None
        if executor is None:
            return
        if isinstance(executor, ProcessPoolExecutor):
            for process in multiprocessing.active_children():
                process.kill()
                process.join()
        executor.shutdown(wait=False, cancel_futures=True)

    def close(self) -> None:
        """Shut the workers down once they are idle."""
        if self._executor is not None:
            self._executor.shutdown()
            self._executor = None


def run_segments(segments: Iterable[Segment], workers: Workers) -> Iterator[tuple[Segment, dict[str, int]]]:
    """Run segments, a bounded number at a time; yields each when finished, with its counts by status.

    A segment lost with its worker is retried once, alone; if it is lost again, its frames fail.
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
    """Submit until the slots are full; returns the segment that a broken pool refused, if any."""
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
    """The counts of a finished segment; None if its worker died or a cluster lost the result."""
    try:
        return future.result()
    except OutputError:
        raise
    except CancelledError:
        raise workers.lost() from None
    except Exception as error:  # not of the segment, which catches its own
        if is_unreachable(error):
            raise
        log.debug("segment %s", segment.log_path.stem, exc_info=True)
        return None


def _rescue(lost: list[Segment], running: Running, workers: Workers) -> Iterator[tuple[Segment, dict[str, int]]]:
    """Collect the finished segments of a broken pool, then retry each lost segment alone in a new one."""
    for future, segment in list(running.items()):
        counts = _collect(future, segment, workers)
        if counts is None:
            lost.append(segment)
        else:
            yield segment, counts
    running.clear()
    for segment in sorted(lost, key=lambda s: s.frames[0].index):
        frames = f"frames {segment.frames[0].index}-{segment.frames[-1].index}"
        log.warning("%s: a worker died on %s or its neighbours; retrying", segment.capture_name, frames)
        workers.renew()
        counts = _collect(workers.submit(segment), segment, workers)
        yield (
            segment,
            fail_segment(segment, "the worker process died twice on this segment") if counts is None else counts,
        )
    workers.renew()


def _is_killed(error: Exception) -> bool:
    """Whether an error means that a worker died: a broken pool, or a call that Dask has given up."""
    return isinstance(error, BrokenExecutor) or type(error).__name__ == "KilledWorker"


class PrefetchedCalls(Generic[Result]):
    """Calls whose results are needed in order; workers start some of them ahead of time.

    A call lost with its worker is retried once, alone; if it is lost again, it raises RestorationError.
    """

    def __init__(self, function: Callable[..., Result], calls: Sequence[tuple[Any, ...]], workers: Workers) -> None:
        self._function = function
        self._calls = calls
        self._workers = workers
        self._begun: dict[int, tuple[Future[Result], Executor | None]] = {}

    def result(self, number: int, name: str) -> Result:
        """The result of a call; raises what the call raised.  ``name`` is for the log."""
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
        log.warning("%s: a worker died while planning this capture or the next; retrying", name)
        return self._alone(number)

    def begin(self, number: int) -> None:
        """Start the call and some after it; best called when workers will soon be idle.

        A lost call waits for its turn: it may be the one that kills its worker.
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
        """The call's future; None if the workers that ran it are gone."""
        future, executor = self._begun.pop(number, (None, None))
        return future if executor is self._workers.started else None

    def _awaited(self, future: Future[Result]) -> Result:
        _await_first([future], self._workers)
        try:
            return future.result()
        except CancelledError:
            raise self._workers.lost() from None

    def _alone(self, number: int) -> Result:
        """Retry the call in new workers that have no other work."""
        self._begun.clear()
        self._workers.renew()
        try:
            return self._awaited(self._workers.call(self._function, *self._calls[number]))
        except Exception as error:
            if not _is_killed(error):
                raise
            self._workers.renew()
            text = "the worker process died twice while reading and planning this capture"
            raise RestorationError(text, hint="--resume retries; fewer --jobs need less memory") from None
