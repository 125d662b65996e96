"""`virest evaluate shutter|deblur|slam`: the paper's Cases A, B and C."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from virest.app import console
from virest.app.cli.evaluate_slam import slam
from virest.app.cli.options import (
    Config,
    Json,
    Quiet,
    Verbose,
    Version,
    emit_facts,
    on_bar,
    one_of,
    parse_frames,
)
from virest.app.machine import prepare_process

BOARDS = ("auto", "chessboard", "aprilgrid")

evaluate = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    help="Measure quality against ground truth, and against other methods given the same inputs.",
)
TrueCaptures = Annotated[
    list[str] | None,
    typer.Argument(metavar="CAPTURE", help="Captures with truth/; - reads their paths from stdin. [simulated]"),
]
Frames = Annotated[str | None, typer.Option("--frames", metavar="A:B[:STEP]", help="Evaluate only these frames. [all]")]
Maps = Annotated[Path | None, typer.Option("--out", "-o", metavar="DIR", help="Write difference maps to DIR.")]


@evaluate.command(short_help="Case A: corner angles and images of straightened boards.")
def shutter(
    captures: TrueCaptures = None,
    config: Config = None,
    frames: Frames = None,
    board: Annotated[
        str, typer.Option(metavar="KIND", callback=one_of(BOARDS), help="Board: auto, chessboard or aprilgrid.")
    ] = "auto",
    out: Maps = None,
    quick: Annotated[bool, typer.Option("--quick", help="Two simulated captures, four frames each.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Straighten boards by several methods; compare corner angles and images with ground truth (Case A).

    \b
    $ virest evaluate shutter
    CASE A, rolling shutter: 50 frames of 5 captures, ...
    method                 mean     std     max  relative %  angles
    none                 1.6641  1.9543  3.9687      1.8514     200
    schubert2018         0.3409  0.4457  1.7406      0.3798     200
    perspective          0.5059  0.6177  1.2699      0.5605     200
    rowwise-rotation     0.2372  0.3979  1.0131      0.2637     200
    rowwise              0.0091  0.0114  0.0348      0.0101     200
    ...
    $ virest simulate wall --scene board --rate 2 --exposure-ms 1
    $ virest evaluate shutter wall --json | jq .all.methods.rowwise.outer
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    paths = console.expand_dash(captures or [])
    if captures and not paths:
        return 0
    _require_captures(paths, {"--config": config, "--frames": frames})
    chosen = parse_frames(frames)
    prepare_process()
    from virest.app.evaluate_shutter import ShutterOptions, run_shutter

    options = ShutterOptions(tuple(paths), config, chosen, board, out, quick)
    with console.progress_bar(100, "evaluate shutter", quiet=quiet) as bar:
        facts, text = run_shutter(options, on_bar(bar))
    emit_facts(facts, text, as_json=json, quiet=quiet)
    return 0


@evaluate.command(short_help="Case B: fidelity and feature matches of deblurred frames.")
def deblur(
    captures: TrueCaptures = None,
    config: Config = None,
    frames: Frames = None,
    restored: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Evaluate these pictures against --reference.")
    ] = None,
    reference: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Reference pictures with the same names.")
    ] = None,
    out: Maps = None,
    over_time: Annotated[
        bool,
        typer.Option(
            "--over-time", help="Compare joint restoration with neighbouring frames to merging aligned frames."
        ),
    ] = False,
    quick: Annotated[bool, typer.Option("--quick", help="Two simulated captures, two or three frames each.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Deblur by several methods; compare MSE, PSNR, SSIM and feature matches with ground truth (Case B).

    \b
    $ virest evaluate deblur
    CASE B, motion blur: 12 frames, ...
    method                          MSE  PSNR dB    SSIM  matches  correct
    blurred                       606.2    20.30  0.7464      196      170
    skimage richardson_lucy       359.0    22.58  0.7595      307      277
    virest balanced                88.6    28.65  0.9198      719      673
    ...
    $ virest evaluate deblur --over-time
    $ virest evaluate deblur --restored virest-out/leaves/frames --reference leaves/truth/frames
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    paths = console.expand_dash(captures or [])
    if captures and not paths:
        return 0
    if (restored is None) != (reference is None):
        raise typer.BadParameter("--restored and --reference need each other; give both")
    if restored is not None and paths:
        raise typer.BadParameter("give captures, or --restored and --reference, not both")
    _require_captures(paths, {"--config": config, "--frames": frames})
    chosen = parse_frames(frames)
    prepare_process()
    from virest.app.evaluate_deblur import DeblurOptions, run_deblur

    options = DeblurOptions(tuple(paths), config, chosen, restored, reference, out, quick, over_time)
    with console.progress_bar(100, "evaluate deblur", quiet=quiet) as bar:
        facts, text = run_deblur(options, on_bar(bar))
    emit_facts(facts, text, as_json=json, quiet=quiet)
    return 0


evaluate.command("slam", short_help="Case C: trajectories from restored frames.")(slam)


def _require_captures(paths: list[str], given: dict[str, Any]) -> None:
    """Refuse options that would have no effect."""
    for name, value in given.items():
        if value is not None and not paths:
            raise typer.BadParameter(f"{name} needs a CAPTURE")
