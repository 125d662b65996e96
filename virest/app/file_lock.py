"""A file that one process holds: by what the system has for it."""

from __future__ import annotations

try:
    import fcntl
except ImportError:  # Windows
    import msvcrt

    def lock_file(handle: int) -> None:
        """Take the lock of an open file until it is closed. Raises OSError where another process has it."""
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]

else:

    def lock_file(handle: int) -> None:
        """Take the lock of an open file until it is closed. Raises OSError where another process has it."""
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
