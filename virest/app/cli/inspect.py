"""`virest inspect`: what a capture holds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from virest.app import console
from virest.app.cli.options import Captures, Json, Quiet, Verbose, Version, capture_paths
from virest.errors import VirestError


def inspect(
    captures: Captures,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """List what a capture holds and what is wrong with it, before any processing.

    \b
    $ virest inspect sample_data/text
    text: usable
      kind          MARSLogger
      movie         720x1280, 12 frames, 1 key frame
    ...
    $ virest inspect sample_data/text --json | jq .frames
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    paths = capture_paths(captures)
    from virest.app.inspect import inspect_capture

    codes = []
    for path in paths:
        try:
            facts, text, code = inspect_capture(Path(path))
            if json:
                from virest.app.outputs import json_line

                console.emit(json_line(facts))
            else:
                console.emit(text)
            if code:
                console.CONSOLE.line(f"error: {_first_error(facts)}")
        except VirestError as error:
            code = console.report_error(error)
        codes.append(code)
    return console.batch_code(codes)


def _first_error(facts: dict[str, Any]) -> str:
    """The first note that makes a capture unusable."""
    errors = [note["text"] for note in facts["notes"] if note["severity"] == "error"]
    return errors[0] if errors else f"{facts['capture']}: cannot be used"
