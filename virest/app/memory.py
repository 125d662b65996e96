"""Memory allocation: keep freed memory in the process, since each frame allocates and frees dozens of pictures.

By default the C library returns each freed picture to the system, which must clear every page again for the next one:
1/6 of a frame's time.  Kept memory is reused at once.
"""

from __future__ import annotations

import ctypes
import sys

MAPPED_FROM_BYTES, KEPT_BYTES = 64 << 20, 128 << 20
"""Allocations below the first come from the kept heap; at most the second may be free in it."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
"""Names in glibc's malloc.h."""


def keep_freed_memory() -> bool:
    """Keep freed memory in this process, up to KEPT_BYTES; False if the C library has no such setting (not glibc)."""
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, MAPPED_FROM_BYTES) and mallopt(_M_TRIM_THRESHOLD, KEPT_BYTES))
