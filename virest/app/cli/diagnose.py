"""`virest diagnose`: what the model gets wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from virest.app import console
from virest.app.cli.options import Config, Json, Quiet, Verbose, Version, cores, emit_facts, on_bar, one_thread_each


def diagnose(
    capture: Annotated[str, typer.Argument(metavar="CAPTURE", help="Capture folder.")],
    config: Config = None,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="The capture's folder in here takes the results.")
    ] = Path("virest-out"),
    check: Annotated[bool, typer.Option("--check", help="Exit with 10 unless the verdict is consistent.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing diagnosis.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Say what the camera model gets wrong on a capture, why, what to add, and what that gains.

    \b
    $ virest diagnose shaken
    shaken: 13774 tracks in 60 frames, residual 1.336 px (tracking noise 0.1759 px)
    cause              parameter  given    found          ±  before   after  gain  held out         rivals
    readout_time  readout_time_s  0.022  0.01493  5.607e-05   1.339  0.1836  100%  geometry_rms_px  -
    readout_time: the rows are read within 0.01493 s
    restored: sharpness 7.018 recorded, 7.575 as given, 7.72 extended; neighbours disagree by 1.657 -> 0.1961 px
    unexplained: no significant residual; 0.02081 px along time
    wrote virest-out/shaken/diagnosis.json, extended.yaml and figures
    verdict: explained
    $ virest process shaken --config virest-out/shaken/extended.yaml --out better
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    one_thread_each()
    from virest.app.diagnose import DiagnosisOptions, run_diagnosis
    from virest.app.process_map import process_map

    with process_map(cores()) as each, console.progress_bar(100, "diagnose", quiet=quiet) as bar:
        outcome = run_diagnosis(console.folder_of(capture), DiagnosisOptions(out, config, overwrite), on_bar(bar), each)
    emit_facts(outcome.facts, outcome.text, as_json=json, quiet=quiet)
    return outcome.check_code if check else 0
