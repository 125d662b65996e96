"""`virest diagnose`: what the camera model gets wrong on a capture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from virest.app import console
from virest.app.cli.options import Config, Json, Quiet, Verbose, Version, emit_facts, on_bar
from virest.app.machine import cores, prepare_process


def diagnose(
    capture: Annotated[str, typer.Argument(metavar="CAPTURE", help="Capture folder.")],
    config: Config = None,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Write the results to DIR/<capture>.")] = Path(
        "virest-out"
    ),
    check: Annotated[bool, typer.Option("--check", help="Exit with 10 unless the verdict is consistent.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing diagnosis.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Find what the camera model gets wrong on a capture, name the causes, and measure what fixing them gains.

    \b
    $ virest diagnose trip
    trip: 5661 tracks in 30 frames, residual 0.795 px (tracking noise 0.0946 px)
    cause              parameter  given    found          ±  before   after  gain ...
    readout_time  readout_time_s  0.022  0.01493  4.749e-05  0.7985  0.1026  100% ...
    readout_time: the readout takes 0.01493 s
    ...
    wrote virest-out/trip/diagnosis.json, extended.yaml and figures
    verdict: explained
    $ virest process trip --config virest-out/trip/extended.yaml --out better
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    prepare_process()
    from virest.app.diagnose import DiagnosisOptions, run_diagnosis
    from virest.app.process_map import process_map

    with process_map(cores()) as each, console.progress_bar(100, "diagnose", quiet=quiet) as bar:
        outcome = run_diagnosis(console.folder_of(capture), DiagnosisOptions(out, config, overwrite), on_bar(bar), each)
    emit_facts(outcome.facts, outcome.text, as_json=json, quiet=quiet)
    return outcome.check_code if check else 0
