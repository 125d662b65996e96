"""The process's own memory: pictures come and go by the dozen a frame, and are not handed back to the system between.

The C library returns every freed picture to the system, which clears it, page by page, when the next one asks: a sixth
of a frame's time.  Kept, it is used again at once.
"""

from __future__ import annotations

import ctypes
import sys

MAPPED_FROM_BYTES, KEPT_BYTES = 64 << 20, 128 << 20
"""Pieces below the first come from memory that is kept; at most the second of it may lie free."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
"""Names in glibc's malloc.h."""


def keep_freed_memory() -> bool:
    """Have this process keep what it frees, up to KEPT_BYTES; False where the C library cannot be told (not glibc)."""
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, MAPPED_FROM_BYTES) and mallopt(_M_TRIM_THRESHOLD, KEPT_BYTES))
