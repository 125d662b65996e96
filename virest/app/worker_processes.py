"""Worker processes: one thread each, ignoring Ctrl-C, ending with the parent."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from multiprocessing.connection import wait as wait_for_handles
from typing import Any, TypeVar

import cv2

from virest.app.machine import keep_freed_memory, one_thread_each

Result = TypeVar("Result")
_prepared: list[int] = []


def prepare_worker() -> None:
    """Use one thread per process: the pool is parallel, and sums do not depend on the number of cores."""
    if os.getpid() not in _prepared:
        cv2.setNumThreads(1)
        keep_freed_memory()
        _prepared.append(os.getpid())


def process_pool(jobs: int, *, verbose: bool = False) -> ProcessPoolExecutor:
    """Worker processes, started on first use."""
    one_thread_each()
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(jobs, context, initializer=_start_worker, initargs=(verbose,))


def submit_uninterrupted(pool: ProcessPoolExecutor, function: Callable[..., Result], *arguments: Any) -> Future[Result]:
    """Submit a call to a pool; processes started here ignore the Ctrl-C meant for the parent."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows, where workers ignore Ctrl-C once they run
        return pool.submit(function, *arguments)
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # inherited by processes started here
    try:
        return pool.submit(function, *arguments)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def _start_worker(verbose: bool) -> None:
    """Set up a worker process: ignore Ctrl-C (the parent decides), and end with the parent."""
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
    """Runs each call immediately in this process."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Call the function and return its result as a finished future."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # passed on in the future, as executors do
            future.set_exception(error)
        return future
