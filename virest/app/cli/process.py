"""`virest process`: the main job."""

from __future__ import annotations

import shlex
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from virest.app import console
from virest.app.cli.options import (
    Captures,
    Config,
    Json,
    Quiet,
    Verbose,
    Version,
    capture_paths,
    cores,
    one_of,
    one_thread_each,
    parse_frames,
)
from virest.restoration.settings import DEBLUR_METHODS, PRESETS, REFERENCES, SHUTTER_METHODS


def process(
    captures: Captures,
    out: Annotated[
        str, typer.Option("--out", metavar="DIR", help="One folder a capture goes in here; an s3:// address too.")
    ] = "virest-out",
    config: Config = None,
    settings: Annotated[Path | None, typer.Option(metavar="FILE", help="Settings, as configs/balanced.yaml.")] = None,
    frames: Annotated[
        str | None, typer.Option(metavar="A:B[:STEP]", help="Only these frames: a Python slice of the movie's indices.")
    ] = None,
    preset: Annotated[
        str | None, typer.Option(metavar="|".join(PRESETS), callback=one_of(tuple(PRESETS)), help="[balanced]")
    ] = None,
    deblur: Annotated[
        str | None,
        typer.Option(metavar="METHOD", callback=one_of(DEBLUR_METHODS), help=f"One of {', '.join(DEBLUR_METHODS)}."),
    ] = None,
    shutter: Annotated[
        str | None,
        typer.Option(metavar="|".join(SHUTTER_METHODS), callback=one_of(SHUTTER_METHODS), help="[rowwise]"),
    ] = None,
    reference: Annotated[
        str | None,
        typer.Option(
            metavar="|".join(REFERENCES), callback=one_of(REFERENCES), help="Time of the picture. [exposure-start]"
        ),
    ] = None,
    jobs: Annotated[int | None, typer.Option(metavar="N", min=1, help="Processes. [the cores]")] = None,
    scheduler: Annotated[str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler does the work.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue what was interrupted or failed.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing run.")] = False,
    keep_start_up: Annotated[
        bool, typer.Option("--keep-start-up", help="Process the frames of the recorder's start-up too.")
    ] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Deblur and straighten captures: PNGs, parameters.jsonl and run.json in OUT/<capture>.

    \b
    $ virest process 2022_03_09_15_21_07 --frames 30:90
    virest: 2022_03_09_15_21_07: camera profile from the capture's metadata
    capture              restored  copied  skipped  failed  frames/s  verdict   output
    2022_03_09_15_21_07        58       2        0       0       4.3  restored  virest-out/2022_03_09_15_21_07

    \b
    $ find /data -name movie.mp4 -printf '%h\\n' | virest process - --json | jq .blur.length_px
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    if resume and overwrite:
        raise typer.BadParameter("choose one of --resume and --overwrite")
    if scheduler is not None and find_spec("distributed") is None:
        raise typer.BadParameter("--scheduler needs the extra [cluster]: pip install 'virest[cluster]'")
    chosen = parse_frames(frames)
    paths = capture_paths(captures)
    if not paths:
        return 0
    one_thread_each()
    from virest.app.process import ProcessOptions, process_captures
    from virest.app.settings import compose_settings
    from virest.capture.location import locate

    composed = compose_settings(
        settings,
        preset=preset,
        deblur=deblur,
        shutter=shutter,
        reference=reference,
        keep_start_up=keep_start_up or None,
    )
    options = ProcessOptions(
        locate(out),
        composed,
        config,
        chosen,
        jobs or cores(),
        scheduler,
        "resume" if resume else "overwrite" if overwrite else "new",
        shlex.join(["virest", *sys.argv[1:]]),
        json,
        quiet,
        verbose,
    )
    return process_captures(paths, options)
