"""``virest --man``: the manual page ``virest.1`` (roff), generated from the text of ``--help``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from virest import __version__
from virest.app.cli.options import ARGUMENTS, OPTIONS, option_groups

EXIT_CODES = (
    (0, "done"),
    (1, "a bug in virest; please report it"),
    (2, "usage"),
    (3, "settings or profile"),
    (4, "capture unusable: video, IMU, clock"),
    (6, "calibration not determined by the data"),
    (7, "restoration failed"),
    (8, "output: exists, disk full, locked"),
    (9, "some captures or frames failed, the rest is done"),
    (10, "only with virest diagnose --check: the verdict is not consistent"),
    (130, "interrupted; --resume continues"),
)
"""The same texts as in docs/exit-codes.md."""
VERBATIM = "\b"
"""Marks a help paragraph whose line breaks are kept."""


def man_page(program: Any) -> str:
    """The page of a program: its commands with their options, each group of options under its title."""
    lines = [f'.TH VIREST 1 "" "virest {__version__}" "User Commands"']
    lines += [".SH NAME", f"virest \\- {_text(program.help.rstrip('.'))}"]
    with program.make_context("virest", [], resilient_parsing=True) as context:
        lines += [".SH SYNOPSIS", ".B virest", _text(" ".join(program.collect_usage_pieces(context)))]
        lines += [".SH OPTIONS", *_options(program, context), ".SH COMMANDS"]
        for name, command in program.commands.items():
            lines += _command(command, name, context)
    lines.append(".SH EXIT STATUS")
    for code, meaning in EXIT_CODES:
        lines += [".TP", f".B {code}", _text(meaning)]
    return "\n".join(lines) + "\n"


def _command(command: Any, name: str, parent: Any) -> Iterator[str]:
    """The section of a command, and those of its own commands."""
    with command.make_context(name, [], parent=parent, resilient_parsing=True) as context:
        yield f".SS {_text(context.command_path)}"
        yield f".B {_text(context.command_path)}"
        yield _text(" ".join(command.collect_usage_pieces(context)))
        yield from _paragraphs(command.help or "")
        if not hasattr(command, "commands"):
            yield from _options(command, context)
        for inner, own in getattr(command, "commands", {}).items():
            yield from _command(own, inner, context)


def _paragraphs(text: str) -> Iterator[str]:
    for paragraph in text.split("\n\n"):
        lines = [line for line in paragraph.split("\n") if line != VERBATIM]
        if VERBATIM in paragraph:
            yield from (".PP", ".RS 4", ".nf", *map(_text, lines), ".fi", ".RE")
        elif any(lines):
            yield from (".PP", *map(_text, lines))


def _options(command: Any, context: Any) -> Iterator[str]:
    """Arguments and options, then each group in the order of ``--help`` under its title."""
    for title, records in option_groups(command, context).items():
        yield from (".PP", f".I {_text(title)}") if title not in (ARGUMENTS, OPTIONS) else ()
        for names, meaning in records:
            yield from (".TP", f".B {_text(names)}", _text(meaning))


def _text(text: str) -> str:
    """Text escaped for roff: hyphens that can be copied, no line that begins like a request."""
    escaped = text.replace("\\", "\\e").replace("-", "\\-")
    return f"\\&{escaped}" if escaped[:1] in (".", "'") or not escaped else escaped
