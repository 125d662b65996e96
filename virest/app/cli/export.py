"""`virest export`: a capture in the formats that SLAM and reconstruction tools read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from virest.app import console
from virest.app.cli.options import (
    Config,
    Frames,
    Json,
    OneCapture,
    Quiet,
    Verbose,
    Version,
    emit_facts,
    one_capture,
    one_of,
    parse_frames,
)

FORMATS, STAMPS = ("euroc", "tum", "nerfstudio", "colmap", "gyroflow"), ("logged", "instant")


def export(
    capture: OneCapture,
    format: Annotated[
        str, typer.Option("--format", metavar="NAME", callback=one_of(FORMATS), help=f"Format: {', '.join(FORMATS)}.")
    ] = "euroc",
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Write the export to DIR/<capture>.")] = Path(
        "virest-export"
    ),
    restored: Annotated[
        Path | None,
        typer.Option("--restored", metavar="RUN_DIR", help="Export the frames of this finished process run."),
    ] = None,
    config: Config = None,
    frames: Frames = None,
    stamps: Annotated[
        str,
        typer.Option(
            "--stamps",
            metavar="NAME",
            callback=one_of(STAMPS),
            help="Timestamps: logged, or instant (when the frame's content was captured).",
        ),
    ] = "logged",
    poses: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Camera trajectory (TUM format) for nerfstudio and colmap.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing export.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Write frames (recorded or restored), IMU and calibration in the formats of SLAM tools; ROS is not needed.

    \b
    $ virest export sample_data/text --format euroc --restored virest-out/text
    text: 4 restored frames over 0.10 s and 320 IMU samples in euroc format
    a frame shows the instant 0.00 ms after its timestamp
    wrote virest-export/text
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    chosen = parse_frames(frames)
    path = one_capture(capture, "export")
    from virest.app.export import ExportOptions, plan_export, run_export

    options = ExportOptions(out, format, restored, config, chosen, stamps, overwrite, poses)
    plan = plan_export(path, options)
    with console.progress_bar(len(plan.frames), plan.capture.name, quiet=quiet) as bar:
        facts, text = run_export(plan, bar.update if bar else None)
    emit_facts(facts, text, as_json=json, quiet=quiet)
    return 0
