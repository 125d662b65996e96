"""Run the commands that README and documentation show, and write into the pages what they print: ``make readme``.

$ python -m virest.app.pages                       # all but the blocks that want a quiet machine or real captures
$ python -m virest.app.pages --list                # the blocks, and how long each took
$ python -m virest.app.pages --only "evaluate shutter" docs/results.md
$ python -m virest.app.pages --quiet-machine       # those with speeds too
$ python -m virest.app.pages --check --at-most 1   # compare, write nothing; exit 1 where a page is out of date

A block of a page is a session between two comments, run from an empty folder that holds ``sample_data`` and
``examples``.  What goes to standard error is not shown:

    <!-- figures: 12 s, quiet machine -->
    ```console
    $ virest process sample_data/text
    ...
    ```
    <!-- end: virest 0.2.0 -->

The first comment holds the CPU time that the block took when it was last run, and what it needs: ``quiet machine``
(speeds are printed: the processor is named below the block) or ``real captures`` (the folder named by VIREST_REALDATA).
"""

from __future__ import annotations

import argparse
import math
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from virest import __version__
from virest.app import console
from virest.app.machine import cores, processor
from virest.app.outputs import write_whole
from virest.errors import SettingsError, VirestError

ROOT = Path(__file__).resolve().parents[2]
OFFERED = ("sample_data", "examples")
"""Folders of the repository that the commands may read."""
QUIET_MACHINE, REAL_CAPTURES = "quiet machine", "real captures"
BLOCK = re.compile(
    r"^<!-- figures: (?P<head>[^\n]*?) -->\n```console\n(?P<session>.*?)^```\n(?P<below>[^\n]*\n)?"
    r"<!-- end: virest (?P<version>\S+) -->$",
    re.MULTILINE | re.DOTALL,
)
NUMBER = re.compile(r"(?<![\w.])[-+−]?\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?(?![\w])")
CLOCK = re.compile(r"\s*(?:s|ms|µs|frames/s)\b")
CLOCK_HEADS = ("frames/s", "time s")
"""Units and columns of timings, which no run repeats."""
ROUNDING, RELATIVE, DEVIATIONS = 1.5, 0.05, 3.0 * math.sqrt(2.0)
"""Tolerance of a repeated figure, in units of its last digit, of itself or of the standard deviation beside it.

Processors round differently, and one grey level in a simulated movie changes every track that is found in it: two
processors printed tracking noises that are 3.6 % apart. Two estimates differ by √2 deviations; three of these are
allowed.
"""
DEVIATION_HEAD = "±"
INSIGNIFICANT = re.compile(r"no significant residual: \S+")
"""A residual below its noise has no digit that another processor repeats."""


@dataclass(frozen=True, slots=True)
class Block:
    """One session of a page with its output."""

    page: Path
    start: int
    """Start and end of the block in the page's text."""
    end: int
    took_s: float | None
    """CPU time of the last run; None: it was never run."""
    needs: tuple[str, ...]
    session: str
    """Commands behind ``$``, each with its output below."""
    version: str
    """Version of virest that printed it."""

    @property
    def commands(self) -> list[str]:
        """The typed commands, with their line breaks."""
        return [command for command, _ in steps(self.session)]

    @property
    def output(self) -> str:
        """The printed output, without the commands."""
        return "".join(output for _, output in steps(self.session))


def pages(root: Path = ROOT) -> list[Path]:
    """The README and all pages of the documentation."""
    return [root / "README.md", *sorted((root / "docs").rglob("*.md"))]


def blocks(page: Path) -> Iterator[Block]:
    """Marked blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    for found in BLOCK.finditer(text):
        took, *needs = [word.strip() for word in found["head"].split(",")]
        yield Block(page, found.start(), found.end(), _seconds(took), tuple(needs), found["session"], found["version"])


def steps(session: str) -> list[tuple[str, str]]:
    """Each command of a session, including continuation lines, and its output."""
    found: list[tuple[str, str]] = []
    going_on = False
    for line in session.splitlines(keepends=True):
        if line.startswith("$ "):
            found.append((line[2:].rstrip("\n"), ""))
        elif going_on:
            found[-1] = (f"{found[-1][0]}\n{line.rstrip()}", "")
        elif found:
            found[-1] = (found[-1][0], found[-1][1] + line)
        going_on = line.endswith("\\\n") and (going_on or line.startswith("$ "))
    return found


# ── running ──────────────────────────────────────────────────────────────────────────────────────────────────────


def rerun(block: Block) -> tuple[str, float]:
    """Run a block's commands from an empty folder; the session with what they print now, and the CPU time it took."""
    began_s = _cpu_s()
    with tempfile.TemporaryDirectory() as work:
        for folder in OFFERED:
            (Path(work) / folder).symlink_to(ROOT / folder)
        told = "".join(f"$ {command}\n{_run(command, Path(work))}" for command in block.commands)
    return told, _cpu_s() - began_s


def _cpu_s() -> float:
    """CPU time of all commands so far."""
    spent = os.times()
    return spent.children_user + spent.children_system


def _run(command: str, folder: Path) -> str:
    """A command's output, with paths as a reader sees them. Raises SettingsError if it fails."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    environment = {**os.environ, "PATH": path, "COLUMNS": "120", "PYTHONUNBUFFERED": "1"}
    line = ["bash", "-o", "pipefail", "-c", command]
    done = subprocess.run(line, cwd=folder, env=environment, text=True, check=False, capture_output=True)
    if done.returncode:
        raise SettingsError(f"{command}: exit code {done.returncode}: {done.stderr[-400:]}")
    text = done.stdout
    for prefix in (folder, folder.resolve(), ROOT):
        text = text.replace(f"{prefix}/", "")
    return "".join(f"{line.rstrip()}\n" for line in text.splitlines())


def block_text(block: Block, session: str, took_s: float) -> str:
    """A block as written in the page; if it shows speeds, with the machine below."""
    head = ", ".join([_duration(took_s), *block.needs])
    machine = f"*{processor() or 'unknown processor'}, {_count(cores(), 'core')}*\n" if has_speeds(session) else ""
    return f"<!-- figures: {head} -->\n```console\n{session}```\n{machine}<!-- end: virest {__version__} -->"


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' if number != 1 else ''}"


def has_speeds(session: str) -> bool:
    """Whether a session's output depends on the speed of the machine."""
    return any(head in session for head in (*CLOCK_HEADS, "CPU ms"))


def rewrite(block: Block, session: str, took_s: float) -> None:
    """Write a block's new session into the current text of its page."""
    text = block.page.read_text(encoding="utf-8")
    now = next(found for found in blocks(block.page) if found.commands == block.commands)
    write_whole(block.page, (text[: now.start] + block_text(block, session, took_s) + text[now.end :]).encode())


# ── comparing ────────────────────────────────────────────────────────────────────────────────────────────────────


def differences(shown: str, now: str) -> list[str]:
    """Lines of a session whose output has changed; timings and last digits may differ."""
    old, new = _readings(shown), _readings(now)
    if len(old) != len(new):
        return [f"{len(old)} lines shown, {len(new)} printed"]
    return [f"{a.text!r} shown, {b.text!r} printed" for a, b in zip(old, new, strict=True) if not a.same(b)]


@dataclass(frozen=True, slots=True)
class _Reading:
    """One line: its words, and its numbers except timings."""

    text: str
    words: str
    numbers: tuple[str, ...]
    deviation: float
    """The standard deviation that the line gives for its value; zero where it gives none."""

    def same(self, other: _Reading) -> bool:
        """Whether the other line has the same content."""
        pairs = zip(self.numbers, other.numbers, strict=False)
        alike = len(self.numbers) == len(other.numbers) and all(_close(a, b, self.deviation) for a, b in pairs)
        return alike and self.words == other.words


def _readings(session: str) -> list[_Reading]:
    found: list[_Reading] = []
    timing = deviation = None  # where these columns end
    for line in session.splitlines():
        if "$" not in line:
            timing = _column(line, CLOCK_HEADS) or timing
            deviation = _column(line, (DEVIATION_HEAD,)) or deviation
        noise = INSIGNIFICANT.match(line)
        numbers = list(NUMBER.finditer(line, noise.end() if noise else 0))
        shown = [number[0] for number in numbers if not CLOCK.match(line, number.end()) and number.end() != timing]
        beside = [value(number[0]) for number in numbers if number.end() == deviation]
        words = " ".join(NUMBER.sub("#", line).split())
        found.append(_Reading(line, re.sub("-{2,}", "--", words), tuple(shown), beside[0] if beside else 0.0))
    return found


def _column(line: str, heads: Sequence[str]) -> int | None:
    """Where the right-aligned column under one of these heads ends."""
    return next((line.index(head) + len(head) for head in heads if head in line), None)


def value(number: str) -> float:
    """The value of a number in the notation of the pages."""
    return float(number.replace(",", "").replace("−", "-"))


def last_digit(number: str) -> float:
    """The value of one unit of a number's last digit."""
    mantissa, _, power = number.partition("e")
    return float(10.0 ** (int(power or 0) - len(mantissa.partition(".")[2])))


def _close(shown: str, now: str, deviation: float) -> bool:
    rounding = ROUNDING * last_digit(shown) if re.search("[.e]", shown) else 0.0  # counts are exact
    allowed = max(rounding, RELATIVE * abs(value(shown)), DEVIATIONS * deviation)
    return abs(value(shown) - value(now)) <= allowed


# ── the command ──────────────────────────────────────────────────────────────────────────────────────────────────


def _seconds(took: str) -> float | None:
    """A duration as :func:`_duration` writes it; None for anything else."""
    found = re.fullmatch(r"(\d+) (s|min)", took)
    return int(found[1]) * (60.0 if found[2] == "min" else 1.0) if found else None


def _duration(seconds: float) -> str:
    return f"{max(seconds, 1):.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"


def _chosen(options: argparse.Namespace) -> list[Block]:
    every = [block for page in options.pages or pages() for block in blocks(page.resolve())]
    most_s = 60 * options.at_most if options.at_most is not None else float("inf")
    return [block for block in every
            if (options.quiet_machine or QUIET_MACHINE not in block.needs)
            and (REAL_CAPTURES not in block.needs or os.environ.get("VIREST_REALDATA"))
            and (options.only is None or any(options.only in command for command in block.commands))
            and (block.took_s or 0.0) <= most_s]  # fmt: skip


def _listing(found: list[Block]) -> str:
    rows = [[block.page.relative_to(ROOT).as_posix(), "-" if block.took_s is None else _duration(block.took_s),
             ", ".join(block.needs) or "-", block.version, block.commands[-1].splitlines()[0][:80]]
            for block in found]  # fmt: skip
    return console.table(["page", "took", "needs", "virest", "command"], rows, words=3)


def main(arguments: Sequence[str] | None = None) -> int:
    """``python -m virest.app.pages``."""
    parser = argparse.ArgumentParser(prog="python -m virest.app.pages", description=__doc__.splitlines()[0])
    parser.add_argument("pages", nargs="*", type=Path, help="these pages [README.md and all of docs/]")
    parser.add_argument("--only", metavar="TEXT", help="blocks with this text in a command")
    parser.add_argument("--at-most", type=float, metavar="MIN", help="blocks that took no longer when last run")
    parser.add_argument("--quiet-machine", action="store_true", help="blocks with speeds too: nothing else runs here")
    parser.add_argument("--check", action="store_true", help="compare and write nothing; exit 1 where a page differs")
    parser.add_argument("--list", action="store_true", help="list the blocks and run nothing")
    options = parser.parse_args(arguments)
    for page in options.pages:
        if not page.is_file():
            parser.error(f"no such page: {page}")
    if options.list:
        console.emit(_listing([block for page in options.pages or pages() for block in blocks(page.resolve())]))
        return 0
    kept = [_brought_up_to_date(block, options.check) for block in _chosen(options)]
    return int(not all(kept))


def _brought_up_to_date(block: Block, only_check: bool) -> bool:
    """Run one block and write it, or with ``only_check`` compare it. False if it differs or a command fails."""
    about = f"{block.page.name}: {block.commands[-1]}"
    try:
        session, took_s = rerun(block)
    except VirestError as error:
        console.report_error(error, about)
        return False
    other = differences(block.session, session)
    console.emit(f"{about}: {_duration(took_s)}, " + ("; ".join(other) or "the same"))
    if not only_check:
        rewrite(block, session, took_s)
    return not (only_check and other)


if __name__ == "__main__":
    sys.exit(main())
