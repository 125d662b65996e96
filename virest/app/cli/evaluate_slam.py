"""`virest evaluate slam`: what restored frames bring to SLAM."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from virest.app import console
from virest.app.cli.options import Json, Quiet, Verbose, Version, emit_facts, on_bar, one_of
from virest.app.machine import prepare_process
from virest.restoration.settings import PRESETS


def slam(
    captures: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="CAPTURE", help="Capture folders with truth/; - reads their paths from stdin. [simulated]"
        ),
    ] = None,
    command: Annotated[
        str | None,
        typer.Option(
            metavar="CMD",
            help="Run this SLAM instead of COLMAP; needs {sequence} {trajectory}, may use {settings} {times} {seed}.",
        ),
    ] = None,
    seeds: Annotated[int | None, typer.Option(metavar="N", min=1, help="Runs per sequence. [3]")] = None,
    devices: Annotated[bool, typer.Option("--devices", help="Also evaluate eight simulated devices.")] = False,
    preset: Annotated[
        str, typer.Option(metavar="|".join(PRESETS), callback=one_of(tuple(PRESETS)), help="Preset of the restoration.")
    ] = "balanced",
    timeout_s: Annotated[
        float, typer.Option("--timeout", metavar="S", min=0.1, help="Time limit of one run of CMD, in seconds.")
    ] = 600.0,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="DIR", help="Keep sequences, trajectories and results here.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="One short sequence, one seed, two devices.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Compare trajectories from global-shutter, rolling-shutter and restored frames with the true one.

    \b
    $ virest evaluate slam --devices
    sequence  readout ms  exposure ms ...
    relief            25            8 ...
    print           29.5            6 ...
    shaken        20.733           12 ...
    ...
    restored frames remove 99.7 % (median; minimum 90.2 %) of the error that the rolling shutter adds
    ...
    $ virest evaluate slam walk --command 'mono_euroc_tum ORBvoc.txt {settings} {sequence} {times} {trajectory}'
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    paths = [Path(path) for path in console.expand_dash(captures or [])]
    if captures and not paths:
        return 0
    if paths and devices:
        raise typer.BadParameter("--devices simulates its captures; give no CAPTURE with it")
    prepare_process()
    from virest.app.evaluate_slam import SlamOptions, run_slam

    options = SlamOptions(command, seeds, devices, quick, out, preset, timeout_s)
    with console.progress_bar(100, "evaluate slam", quiet=quiet) as bar:
        facts, text, code = run_slam(paths, options, on_bar(bar))
    emit_facts(facts, text, as_json=json, quiet=quiet)
    return code
