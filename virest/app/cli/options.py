"""What commands share: options and their types, parsers, one way to print results and to show progress."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
import typer.core

from virest import __version__
from virest.app import console

log = logging.getLogger(__name__)

PARTLY_FAILED = 9
MOST_NEIGHBOURS = 8
"""Frames on each side: beyond that even 30 frames/s show another picture."""


def show_version(wanted: bool) -> None:
    """Print the version and leave: `--version`."""
    if wanted:
        console.emit(f"virest {__version__}")
        raise typer.Exit


def one_of(names: tuple[str, ...]) -> Callable[[str | None], str | None]:
    """Make a check that an option's value is one of these names."""

    def check(value: str | None) -> str | None:
        if value is not None and value not in names:
            raise typer.BadParameter(f"{value!r} is not one of {', '.join(names)}")
        return value

    return check


class GroupedCommand(typer.core.TyperCommand):
    """A command whose ``--help`` lists the options of each ``rich_help_panel`` under that title."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Arguments, options, then each group in the order in which its first option is declared."""
        groups: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is None:
                continue
            usual = "Arguments" if parameter.param_type_name == "argument" else "Options"
            groups.setdefault(getattr(parameter, "rich_help_panel", None) or usual, []).append(record)
        for title, records in groups.items():
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)


Captures = Annotated[
    list[str],
    typer.Argument(metavar="CAPTURE", help="Capture folders, or the movies in them; - reads names from stdin."),
]
Json = Annotated[bool, typer.Option("--json", help="Machine-readable results on standard output, nothing else.")]
Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="Errors only.")]
Verbose = Annotated[bool, typer.Option("-v", "--verbose", help="Say more; tracebacks for errors.")]
Version = Annotated[
    bool, typer.Option("--version", help="Print the version and leave.", is_eager=True, callback=show_version)
]
Config = Annotated[Path | None, typer.Option("--config", metavar="FILE", help="Camera profile, or a Kalibr camchain.")]


def parse_frames(text: str | None) -> slice:
    """A Python slice of frame indices, ``A:B`` or ``A:B:STEP``; a single number is that frame."""
    if text is None:
        return slice(None)
    if re.fullmatch(r"\s*[+-]?\d{1,18}\s*", text, re.ASCII):
        return slice(int(text), int(text) + 1 or None)
    parts = text.split(":")
    if len(parts) not in (2, 3) or not all(re.fullmatch(r"\s*([+-]?\d{1,18})?\s*", part, re.ASCII) for part in parts):
        raise typer.BadParameter(
            f"{text!r} is not a slice; write A:B or A:B:STEP, such as 10:50, :100 or ::5, or one number"
        )
    bounds = [int(part) if part.strip() else None for part in parts]
    if len(bounds) == 3 and bounds[2] == 0:
        raise typer.BadParameter(f"{text!r}: the step cannot be 0")
    return slice(*bounds)


def capture_paths(captures: list[str]) -> list[str]:
    """Names of captures, with those of standard input in the place of `-`."""
    paths = console.expand_dash(captures)
    if not paths:
        log.warning("no capture: standard input names none")
    return paths


def parse_neighbours(text: str | None) -> int | None:
    """How many neighbours on each side; None for ``auto``, which is the preset's number."""
    if text is None or text.strip() == "auto":
        return None
    if not re.fullmatch(r"\s*\d{1,2}\s*", text, re.ASCII) or int(text) > MOST_NEIGHBOURS:
        raise typer.BadParameter(f"--neighbours {text!r}: write auto, or 0 to {MOST_NEIGHBOURS}")
    return int(text)


def parse_shard(text: str | None) -> tuple[int, int]:
    """The i-th of N parts, ``i/N`` with i from 1 to N."""
    if text is None:
        return 1, 1
    found = re.fullmatch(r"\s*(\d{1,9})\s*/\s*(\d{1,9})\s*", text, re.ASCII)
    part, parts = (int(found[1]), int(found[2])) if found else (0, 0)
    if not 1 <= part <= parts:
        raise typer.BadParameter(f"{text!r} is not a shard; write i/N with i from 1 to N, such as 3/16")
    return part, parts


def batch_code(codes: list[int]) -> int:
    """One capture gives its own code; a batch with any failure PARTLY_FAILED."""
    failures = [code for code in codes if code]
    return 0 if not failures else failures[0] if len(codes) == 1 else PARTLY_FAILED


def emit_facts(facts: dict[str, Any], text: str, *, as_json: bool, quiet: bool = False) -> None:
    """Print a command's result: text for people (none with ``quiet``), one JSON object for machines."""
    from virest.app.outputs import json_line

    if as_json or not quiet:
        console.emit(json_line(facts) if as_json else text)


def on_bar(bar: Any) -> Callable[[str, float], None] | None:
    """Show the part that is done and the stage on a bar of 100."""
    if bar is None:
        return None

    command = bar.desc.removesuffix(": ")

    def show(stage: str, part: float) -> None:
        bar.set_description(f"{command}: {stage}", refresh=False)
        bar.update(max(round(100 * part) - bar.n, 0))

    bar.unit = "%"
    return show


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def one_thread_each() -> None:
    """One thread in each process's linear algebra: the same sums on every machine, and no more threads than cores."""
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = "1"
