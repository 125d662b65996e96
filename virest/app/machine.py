"""The machine that the program runs on: cores, processor, installed packages, threads, and the use of memory."""

from __future__ import annotations

import ctypes
import os
import platform
import sys
from contextlib import suppress
from pathlib import Path

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
MAPPED_FROM_BYTES, KEPT_BYTES = 64 << 20, 128 << 20
"""Allocations below the first come from the kept heap; at most the second may be free in it."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
"""Names in glibc's malloc.h."""


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def processor() -> str | None:
    """The processor's name as Linux, or else Python, reports it; None if neither does."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
        if names:
            return names[0]
    return platform.processor() or None


def installed_version(package: str) -> str | None:
    """The version of an installed package; None if it is not installed."""
    from importlib.metadata import PackageNotFoundError, version  # a tenth of the time of --help

    try:
        return version(package)
    except PackageNotFoundError:
        return None


def one_thread_each() -> None:
    """Limit linear algebra to one thread per process: sums do not depend on the machine, threads never exceed cores."""
    for variable in THREAD_VARIABLES:
        os.environ[variable] = "1"


def prepare_process() -> None:
    """Set up a process that computes: one thread, and freed memory is kept."""
    one_thread_each()
    keep_freed_memory()


def keep_freed_memory() -> bool:
    """Keep freed memory in this process, up to KEPT_BYTES; False if the C library has no such setting (not glibc).

    Each frame allocates and frees dozens of pictures.  By default the C library returns each of them to the system,
    which must clear every page again for the next one: 1/6 of a frame's time.  Kept memory is reused at once.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, MAPPED_FROM_BYTES) and mallopt(_M_TRIM_THRESHOLD, KEPT_BYTES))
