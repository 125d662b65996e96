"""Open untrusted files: regular files only, bounded reads, so that no pipe hangs and no file fills the memory."""

from __future__ import annotations

import stat
from dataclasses import dataclass
from pathlib import Path

from virest.errors import CaptureError

CHUNK_BYTES = 1 << 20
"""Read at once, so that the memory does not grow with the file."""
MAX_LINE_BYTES = 1 << 16
"""Real rows have up to about 200 bytes; a line above this limit is damage, or an attack on the memory."""
MAX_TEXT_BYTES = 1 << 20
"""The same of a small text file: real ones have a few kB."""
MAX_TABLE_BYTES = 4 << 30
"""Four days of 500 Hz samples."""


@dataclass(frozen=True, slots=True)
class TextScan:
    """Result of a bounded scan of a text file."""

    lines: int
    """Line ends, plus one for an unterminated last line."""
    head: str
    """The first lines, at most MAX_LINE_BYTES, undecodable bytes replaced."""
    ends_with_newline: bool

    @property
    def first_line(self) -> str:
        """The first line that is not blank; empty if there is none."""
        return next((line for line in self.head.splitlines() if line.strip()), "")


def label(path: Path) -> str:
    """Name a file in messages: its folder and its name."""
    folder = path.parent.name
    return f"{folder}/{path.name}" if folder else path.name


def require_regular_file(path: Path, error: type[CaptureError] = CaptureError, hint: str = "") -> int:
    """Size in bytes of a regular file. Raises ``error`` for a missing file, a folder, a pipe or a loop of links."""
    name = label(path)
    try:
        status = path.stat()
    except FileNotFoundError:
        raise error(f"{name}: no such file", hint=hint or "copy it from the phone") from None
    except (OSError, ValueError) as fault:
        reason = getattr(fault, "strerror", None) or str(fault)
        raise error(f"{name}: {reason}", hint="check the path, its links and its permissions") from None
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "not a regular file"
        raise error(f"{name}: is {kind}", hint="a capture consists of plain files")
    return status.st_size


def is_present(path: Path) -> bool:
    """Whether anything of this name exists, usable or not."""
    try:
        path.lstat()
    except (OSError, ValueError):
        return False
    return True


def scan_text(path: Path, error: type[CaptureError] = CaptureError, hint: str = "") -> TextScan:
    """Scan a text file in bounded chunks before anything reads it line by line.

    Raises ``error`` if it is not a regular file, has too many bytes or a line above MAX_LINE_BYTES, or is not text.
    """
    size = require_regular_file(path, error, hint)
    name = label(path)
    if size > MAX_TABLE_BYTES:
        raise error(f"{name}: {size} bytes, more than {MAX_TABLE_BYTES}", hint="is it the logger's file?")
    head, lines, run, last = b"", 0, 0, b""
    try:
        with path.open("rb") as stream:
            while chunk := stream.read(CHUNK_BYTES):
                head = head or chunk[:MAX_LINE_BYTES]
                run = _check_chunk(chunk, run, name, error)
                lines += chunk.count(b"\n")
                last = chunk[-1:]
    except OSError as fault:
        raise error(f"{name}: {fault.strerror}", hint="check its permissions and the disk") from None
    text = head.decode("utf-8-sig", errors="replace")
    return TextScan(lines + (last not in (b"\n", b"")), text, last == b"\n")


def _check_chunk(chunk: bytes, run: int, name: str, error: type[CaptureError]) -> int:
    """Length of the unfinished line at the chunk's end; refuses NUL bytes and endless lines."""
    if b"\0" in chunk:
        raise error(f"{name}: has NUL bytes, so it is not plain text", hint="copy the original from the phone again")
    start = 0
    while (end := chunk.find(b"\n", start)) >= 0:
        if run + end - start > MAX_LINE_BYTES:
            break
        run, start = 0, end + 1
        if len(chunk) - start <= MAX_LINE_BYTES:
            cut = chunk.rfind(b"\n")
            return len(chunk) - cut - 1
        start = max(start, chunk.rfind(b"\n", start, start + MAX_LINE_BYTES) + 1)
    run += len(chunk) - start if end < 0 else end - start
    if run > MAX_LINE_BYTES:
        raise error(f"{name}: a line has more than {MAX_LINE_BYTES} bytes", hint="copy the logger's file again")
    return run


def read_small_text(path: Path) -> str:
    """Content of a small text file, undecodable bytes replaced. Raises CaptureError if it is irregular or too large."""
    size = require_regular_file(path, CaptureError)
    if size > MAX_TEXT_BYTES:
        raise CaptureError(f"{label(path)}: {size} bytes, more than {MAX_TEXT_BYTES}", hint="is it the logger's file?")
    try:
        return path.read_bytes().decode("utf-8-sig", errors="replace")
    except OSError as fault:
        raise CaptureError(f"{label(path)}: {fault.strerror}", hint="check its permissions") from None
