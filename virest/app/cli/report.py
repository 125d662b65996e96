"""`virest report`: a run or a diagnosis as one HTML page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from virest.app import console
from virest.app.cli.options import Json, Quiet, Verbose, Version, emit_facts
from virest.app.machine import prepare_process


def report(
    run_dir: Annotated[
        Path,
        typer.Argument(
            metavar="RUN_DIR", help="OUT/<capture> of a run or diagnosis, or OUT itself for all its captures."
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="FILE", help="Write the page here. [RUN_DIR/report.html]")
    ] = None,
    frames: Annotated[
        int | None, typer.Option(metavar="N", min=1, max=200, help="Frames to show per capture. [6]")
    ] = None,
    capture: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Where the capture is now, or the folder that contains the captures."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing page.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Show a run or a diagnosis as one self-contained HTML page: before and after, plots, verdict.

    \b
    $ virest process sample_data/text --frames 0:4 --preset fast --quiet
    $ virest report virest-out/text
    text: restored (4 deblurred)
    wrote virest-out/text/report.html, ...

    \b
    $ virest report virest-out --json | jq -r '.captures[] | select(.counts.failed > 0) | .capture'
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    prepare_process()
    from virest.app.report import ReportOptions, write_report

    outcome = write_report(run_dir, ReportOptions(out, frames, capture, overwrite))
    emit_facts(outcome.facts, outcome.text, as_json=json, quiet=quiet)
    return outcome.exit_code
