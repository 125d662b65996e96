"""`virest preview`: one frame before and after."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from virest.app import console
from virest.app.cli.options import Config, Json, Quiet, Verbose, Version, emit_facts, one_of
from virest.app.machine import prepare_process
from virest.restoration.settings import PRESETS


def preview(
    capture: Annotated[str, typer.Argument(metavar="CAPTURE", help="Capture folder, or the movie in it.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE", help="Write the picture (PNG) here. [CAPTURE-preview.png]"),
    ] = None,
    config: Config = None,
    frame: Annotated[int | None, typer.Option(metavar="N", help="Frame to show. [the most blurred]")] = None,
    preset: Annotated[
        str, typer.Option(metavar="|".join(PRESETS), callback=one_of(tuple(PRESETS)), help="Quality or speed.")
    ] = "balanced",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Show one frame as recorded, as restored, and with arrows along its blur, in seconds.

    \b
    $ virest preview sample_data/text
    text: frame 5 restored, blur 17.1 px at the centre, ...
    wrote text-preview.png
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    if out is not None and out.suffix.lower() != ".png":
        raise typer.BadParameter(f"--out {out.name}: a PNG is written; the name must end in .png")
    prepare_process()
    from virest.app.preview import PreviewOptions, run_preview

    options = PreviewOptions(out, config, frame, preset, overwrite)
    facts, text = run_preview(console.folder_of(capture), options)
    emit_facts(facts, text, as_json=json, quiet=quiet)
    return 0
