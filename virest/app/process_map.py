"""Run independent calls of one command in parallel processes (`process` uses segments instead).

Results are in the order of the calls, so they do not depend on the number of processes.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Future, ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import Any

from virest.app.worker_processes import process_pool, submit_uninterrupted
from virest.inference.parallel import ParallelMap, one_by_one

log = logging.getLogger(__name__)


@contextmanager
def process_map(jobs: int) -> Iterator[ParallelMap]:
    """Map calls over ``jobs`` processes, started on first use; one job runs in this process."""
    shared = _ProcessPool(jobs)
    try:
        yield shared if jobs > 1 else one_by_one
    except BaseException:
        shared.kill()  # Ctrl-C does not wait for workers
        raise
    finally:
        shared.close()


class _ProcessPool:
    """A pool of processes that outlives its calls."""

    def __init__(self, jobs: int) -> None:
        self.jobs = jobs
        self._pool: ProcessPoolExecutor | None = None

    def __call__(
        self,
        function: Callable[..., Any],
        arguments: Iterable[tuple[Any, ...]],
        done: Callable[[int], None] | None = None,
    ) -> list[Any]:
        """See `ParallelMap`; calls lost with a dying worker are repeated here."""
        calls = list(arguments)
        if len(calls) < 2 or self.jobs == 1:
            return one_by_one(function, calls, done)
        try:
            futures = [self._submit(function, parts) for parts in calls]
            return [_result_of(future, place, done) for place, future in enumerate(futures)]
        except BrokenExecutor:
            self._give_up()
            return one_by_one(function, calls, done)

    def begin(self, function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
        """See `Background`."""
        here = partial(function, *arguments)
        if self.jobs == 1:
            return here
        try:
            future = self._submit(function, arguments)
        except BrokenExecutor:
            self._give_up()
            return here

        def result() -> Any:
            try:
                return future.result()
            except (BrokenExecutor, CancelledError):
                self._give_up()
                return here()

        return result

    def _give_up(self) -> None:
        """Run all further calls in this process, after a worker has died."""
        if self.jobs > 1:
            log.warning("a worker process died; its work is repeated in the main process")
        self.close()
        self.jobs, self._pool = 1, None

    def _submit(self, function: Callable[..., Any], parts: tuple[Any, ...]) -> Future[Any]:
        if self._pool is None:
            self._pool = process_pool(self.jobs)
        return submit_uninterrupted(self._pool, function, *parts)

    def close(self) -> None:
        """Shut the processes down, once the calls in progress have ended; calls not yet started are cancelled.

        Waiting costs nothing, since Python waits for them at its exit at the latest.  There its own clean-up and the
        pool's manager thread may close the same pipe, and a traceback follows the command's result.
        """
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)

    def kill(self) -> None:
        """Kill the processes without waiting for their calls."""
        if self._pool is not None:
            for process in list((self._pool._processes or {}).values()):
                process.kill()


def _result_of(future: Future[Any], place: int, done: Callable[[int], None] | None) -> Any:
    result = future.result()
    if done is not None:
        done(place)
    return result
