"""What all commands share: options and their types, parsers, printing of results and progress."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
import typer.core

from virest import __version__
from virest.app import console
from virest.restoration.settings import MOST_NEIGHBOURS

log = logging.getLogger(__name__)

ARGUMENTS, OPTIONS = "Arguments", "Options"
"""Titles of a command's help without groups of its own."""


def show_version(wanted: bool) -> None:
    """Print the version and exit: `--version`."""
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
        for title, records in option_groups(self, ctx).items():
            with formatter.section(title):
                formatter.write_dl(records)


def option_groups(command: Any, ctx: Any) -> dict[str, list[tuple[str, str]]]:
    """Help records (names, meaning) by title: ARGUMENTS, OPTIONS, then each group as first declared; none is empty."""
    groups: dict[str, list[tuple[str, str]]] = {ARGUMENTS: [], OPTIONS: []}
    for parameter in command.get_params(ctx):
        record = parameter.get_help_record(ctx)
        if record is not None:
            usual = ARGUMENTS if parameter.param_type_name == "argument" else OPTIONS
            groups.setdefault(getattr(parameter, "rich_help_panel", None) or usual, []).append(record)
    return {title: records for title, records in groups.items() if records}


OneCapture = Annotated[str, typer.Argument(metavar="CAPTURE", help="Capture folder; - reads its path from stdin.")]
Captures = Annotated[
    list[str],
    typer.Argument(metavar="CAPTURE", help="Capture folders, or the movies in them; - reads their paths from stdin."),
]
Json = Annotated[bool, typer.Option("--json", help="Print results as JSON on standard output, and nothing else there.")]
Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="Print errors only.")]
Verbose = Annotated[bool, typer.Option("-v", "--verbose", help="Print more detail, and tracebacks for errors.")]
Version = Annotated[
    bool, typer.Option("--version", help="Print the version and exit.", is_eager=True, callback=show_version)
]
Config = Annotated[Path | None, typer.Option("--config", metavar="FILE", help="Camera profile, or a Kalibr camchain.")]


Frames = Annotated[
    str | None,
    typer.Option(metavar="A:B[:STEP]", help="Only these frames: a Python slice of the movie's frame indices."),
]


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
    """Paths of captures, with `-` replaced by those on standard input."""
    paths = console.expand_dash(captures)
    if not paths:
        log.warning("no capture: standard input is empty")
    return paths


def one_capture(capture: str, command: str) -> str:
    """The path of the one capture a command takes, read from standard input for `-`."""
    paths = console.expand_dash([capture])
    if len(paths) != 1:
        raise typer.BadParameter(f"standard input lists {len(paths)} captures; {command} takes one")
    return paths[0]


def parse_neighbours(text: str | None) -> int | None:
    """Number of neighbouring frames on each side; None for ``auto``: the preset decides."""
    if text is None or text.strip() == "auto":
        return None
    if not re.fullmatch(r"\s*\d{1,2}\s*", text, re.ASCII) or int(text) > MOST_NEIGHBOURS:
        raise typer.BadParameter(f"--neighbours {text!r}: write auto, or 0 to {MOST_NEIGHBOURS}")
    return int(text)


def parse_shard(text: str | None) -> tuple[int, int]:
    """The i-th of N parts, written ``i/N`` with i from 1 to N."""
    if text is None:
        return 1, 1
    found = re.fullmatch(r"\s*(\d{1,9})\s*/\s*(\d{1,9})\s*", text, re.ASCII)
    part, parts = (int(found[1]), int(found[2])) if found else (0, 0)
    if not 1 <= part <= parts:
        raise typer.BadParameter(f"{text!r} is not a shard; write i/N with i from 1 to N, such as 3/16")
    return part, parts


def emit_facts(facts: dict[str, Any], text: str, *, as_json: bool, quiet: bool = False) -> None:
    """Print a command's result: as text (not with ``quiet``), or as one JSON object."""
    from virest.app.outputs import json_line

    if as_json or not quiet:
        console.emit(json_line(facts) if as_json else text)


def on_bar(bar: Any) -> Callable[[str, float], None] | None:
    """Show the stage and the finished fraction on a bar of 100 steps."""
    if bar is None:
        return None

    command = bar.desc.removesuffix(": ")

    def show(stage: str, part: float) -> None:
        bar.set_description(f"{command}: {stage}", refresh=False)
        bar.update(max(round(100 * part) - bar.n, 0))

    bar.unit = "%"
    return show
