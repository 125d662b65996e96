"""Output to the user: results on standard output, everything else on standard error, one line per error."""

from __future__ import annotations

import logging
import os
import sys
import traceback
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

from virest.errors import PARTLY_FAILED, OutputError, VirestError

OUR_FAULT = "this is a bug in virest, not in your input; please report it with the lines above"
MOVIE_ENDINGS = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".insv", ".360")


class Bar(Protocol):
    """The part of a progress bar's interface that the program uses."""

    def update(self, count: int) -> Any:
        """Move the bar on."""

    def clear(self) -> Any:
        """Remove the bar from the screen."""

    def refresh(self) -> Any:
        """Draw the bar again."""


class _Console(logging.Handler):
    """Log lines on standard error, above the progress bar if there is one."""

    def __init__(self) -> None:
        super().__init__()
        self.bar: Bar | None = None
        self.verbose = False

    def emit(self, record: logging.LogRecord) -> None:
        """Write one record as one line; a traceback only with -v."""
        self.line(
            f"{record.levelname.lower()}: {record.getMessage()}"
            if record.levelno != logging.INFO
            else record.getMessage()
        )
        if record.exc_info and self.verbose:
            self.block("".join(traceback.format_exception(*record.exc_info)))

    def line(self, text: str) -> None:
        """Write the text as one line; line breaks in it become blanks."""
        self.block("virest: " + " ".join(text.split()) + "\n")

    def block(self, text: str) -> None:
        """Write text unchanged; a closed standard error is ignored."""
        if sys.stderr is None:
            return
        if self.bar is not None:
            self.bar.clear()
        try:
            sys.stderr.write(text.encode(sys.stderr.encoding or "utf-8", "backslashreplace").decode("utf-8", "replace"))
            sys.stderr.flush()
        except (OSError, ValueError):
            return
        if self.bar is not None:
            self.bar.refresh()


CONSOLE = _Console()


def configure(*, quiet: bool, verbose: bool) -> None:
    """Show information and warnings; with ``quiet`` errors only, with ``verbose`` all messages and tracebacks."""
    root = logging.getLogger("virest")
    root.handlers = [CONSOLE]
    root.propagate = False
    root.setLevel(logging.DEBUG if verbose else logging.ERROR if quiet else logging.INFO)
    CONSOLE.verbose = verbose


def report_error(error: BaseException, about: str = "") -> int:
    """Print one line for a known error, a traceback for a bug of virest (or with -v). Returns the exit code."""
    known = isinstance(error, VirestError)
    if CONSOLE.verbose or not known:
        CONSOLE.block("".join(traceback.format_exception(error)))
    text = str(error) if known else f"{type(error).__name__}: {error}; {OUR_FAULT}"
    CONSOLE.line(f"error: {about}: {text}" if about and about not in text else f"error: {text}")
    return error.exit_code if isinstance(error, VirestError) else 1


def batch_code(codes: Sequence[int]) -> int:
    """The exit code of a batch: the capture's own for one capture, PARTLY_FAILED if any of several failed."""
    failures = [code for code in codes if code]
    return 0 if not failures else failures[0] if len(codes) == 1 else PARTLY_FAILED


def emit(text: str) -> None:
    """Write a result to standard output and flush. A closed pipe raises BrokenPipeError, a full disk OutputError."""
    if sys.stdout is None:
        return
    try:
        sys.stdout.buffer.write((text + "\n").encode("utf-8", "backslashreplace"))
        sys.stdout.buffer.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        silence_stdout()
        raise OutputError(f"standard output: {error.strerror}", hint="free space there, or write elsewhere") from error


def silence_stdout() -> None:
    """Redirect standard output to the null device, so that the interpreter's last flush cannot fail."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, sys.__stdout__.fileno() if sys.__stdout__ else 1)
    os.close(null)


@contextmanager
def progress_bar(total: int | None, label: str, *, quiet: bool, done: int = 0) -> Iterator[Bar | None]:
    """A bar on standard error; None unless standard error is a terminal.

    total: None if the work has no steps to count.  done: steps finished by an earlier run, which speeds exclude.
    """
    if quiet or sys.stderr is None or not sys.stderr.isatty():
        yield None
        return
    from tqdm import tqdm

    shape = "{desc} …" if total is None else None
    with tqdm(
        total=total, desc=label, unit="frame", file=sys.stderr, leave=False, initial=done, smoothing=0, bar_format=shape
    ) as bar:
        CONSOLE.bar = bar
        try:
            yield bar
        finally:
            CONSOLE.bar = None


def expand_dash(captures: Iterable[str]) -> list[str]:
    """Replace ``-`` by the paths on standard input, one per line, and a movie by its folder."""
    names: list[str] = []
    for capture in captures:
        if capture != "-":
            names.append(capture)
        elif sys.stdin is not None:
            lines = sys.stdin.buffer.read().split(b"\n")
            names += [os.fsdecode(line.removesuffix(b"\r")) for line in lines if line.strip()]
    return [folder_of(name) for name in names]


def folder_of(capture: str) -> str:
    """The capture's folder, also if the movie inside it was given."""
    if capture.lower().endswith(MOVIE_ENDINGS) and os.path.isfile(capture):
        return os.path.dirname(capture) or "."
    return capture


def table(header: list[str], rows: list[list[str]], words: int = 2) -> str:
    """Columns under their heads: the first and the last ``words`` columns left-aligned, the others right-aligned."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    left = {0, *range(len(header) - words, len(header))}

    def line(row: list[str]) -> str:
        cells = [c.ljust(w) if i in left else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))]
        return "  ".join(cells).rstrip()

    return "\n".join(line(row) for row in [header, *rows])


def numeric_table(header: list[str], rows: list[list[str]]) -> str:
    """Columns under their heads: the first left-aligned, the others, which hold numbers, right-aligned."""
    return table(header, rows, words=0)


def cell(value: float | None, form: str = ".2f") -> str:
    """A number as a cell of a table, ``-`` for None; form: a format specification."""
    return "-" if value is None else format(value, form)
