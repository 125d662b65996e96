"""`virest process`: the main command."""

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
    Frames,
    Json,
    Quiet,
    Verbose,
    Version,
    capture_paths,
    one_of,
    parse_frames,
    parse_neighbours,
    parse_shard,
)
from virest.app.machine import cores, prepare_process
from virest.restoration.settings import DEBLUR_METHODS, PRESETS, REFERENCES, SHUTTER_METHODS

FILM_ENDINGS = (".mp4", ".m4v", ".mov")


def process(
    captures: Captures,
    out: Annotated[
        str, typer.Option("--out", "-o", metavar="DIR", help="Write one folder per capture here; s3:// works too.")
    ] = "virest-out",
    config: Config = None,
    settings: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Settings file, such as configs/balanced.yaml.")
    ] = None,
    frames: Frames = None,
    preset: Annotated[
        str | None,
        typer.Option(metavar="|".join(PRESETS), callback=one_of(tuple(PRESETS)), help="Quality or speed. [balanced]"),
    ] = None,
    deblur: Annotated[
        str | None,
        typer.Option(
            metavar="METHOD", callback=one_of(DEBLUR_METHODS), help=f"Deblurring: {', '.join(DEBLUR_METHODS)}."
        ),
    ] = None,
    shutter: Annotated[
        str | None,
        typer.Option(
            metavar="|".join(SHUTTER_METHODS),
            callback=one_of(SHUTTER_METHODS),
            help="Rolling-shutter correction. [rowwise]",
        ),
    ] = None,
    reference: Annotated[
        str | None,
        typer.Option(
            metavar="|".join(REFERENCES),
            callback=one_of(REFERENCES),
            help="Instant that a restored frame shows. [exposure-start]",
        ),
    ] = None,
    neighbours: Annotated[
        str | None,
        typer.Option(metavar="N|auto", help="Frames on each side used to restore each frame. [auto: by preset]"),
    ] = None,
    jobs: Annotated[int | None, typer.Option(metavar="N", min=1, help="Number of processes. [one per core]")] = None,
    scheduler: Annotated[str | None, typer.Option(metavar="ADDRESS", help="Run on this Dask scheduler.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue an interrupted or failed run.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing run.")] = False,
    keep_start_up: Annotated[
        bool, typer.Option("--keep-start-up", help="Also process the frames of the recorder's start-up.")
    ] = False,
    video: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="Write a video (MP4); {capture} is replaced by the capture's name."),
    ] = None,
    side_by_side: Annotated[
        bool, typer.Option("--side-by-side", help="Show recorded beside restored frames in the video.")
    ] = False,
    no_frames: Annotated[bool, typer.Option("--no-frames", help="Keep no PNG files; needs --video.")] = False,
    mask: Annotated[bool, typer.Option("--mask", help="Write masks/: 255 recorded data, 0 replicated edge.")] = False,
    crop: Annotated[
        bool, typer.Option("--crop", help="Crop all frames to the area with recorded data in every frame.")
    ] = False,
    undistort: Annotated[
        bool, typer.Option("--undistort", help="Undo the lens's distortion too: frames of a pinhole camera.")
    ] = False,
    skip_copied: Annotated[
        bool, typer.Option("--skip-copied", help="Write no PNG for frames that are only copied.")
    ] = False,
    shard: Annotated[
        str | None, typer.Option(metavar="i/N", help="Process only the i-th of N parts of the captures.")
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print frames, predicted gain, time and size; write nothing.")
    ] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Deblur and straighten captures: PNGs, parameters.jsonl and run.json in OUT/<capture>.

    \b
    $ virest process sample_data/text --preset fast
    capture  restored  copied  skipped  failed  frames/s  verdict
    text           12       0        0       0 ...
    wrote virest-out/text
    next: virest report virest-out/text shows it; ...

    \b
    $ virest process walk --video walk.mp4 --side-by-side --no-frames

    \b
    $ find /data -name movie.mp4 -printf '%h\\n' | virest process - --json | jq .blur.length_px
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    if resume and overwrite:
        raise typer.BadParameter("choose one of --resume and --overwrite")
    if scheduler is not None and find_spec("distributed") is None:
        raise typer.BadParameter("--scheduler needs the extra [cluster]: pip install 'virest[cluster]'")
    for wanted, given in (("--side-by-side", side_by_side), ("--no-frames", no_frames)):
        if given and video is None:
            raise typer.BadParameter(f"{wanted} needs --video FILE")
    chosen, part = parse_frames(frames), parse_shard(shard)
    paths = capture_paths(captures)
    if not paths:
        return 0
    if video is not None and not video.lower().endswith(FILM_ENDINGS):
        raise typer.BadParameter(f"--video {video!r}: an MP4 is written; name it *{FILM_ENDINGS[0]}")
    if video is not None and len(paths) > 1 and "{capture}" not in video:
        raise typer.BadParameter("--video: several captures need {capture} in the file name")
    prepare_process()
    from virest.app.finish import FinishOptions
    from virest.app.process import ProcessOptions, process_captures
    from virest.app.segments import PictureOptions
    from virest.app.settings import compose_settings
    from virest.capture.location import locate

    composed = compose_settings(
        settings,
        preset=preset,
        deblur=deblur,
        shutter=shutter,
        reference=reference,
        keep_start_up=keep_start_up or None,
        undistort=undistort or None,
        neighbours=parse_neighbours(neighbours),
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
        PictureOptions(mask, skip_copied),
        FinishOptions(video, side_by_side, not no_frames, crop),
        json,
        quiet,
        verbose,
    )
    if dry_run:
        from virest.app.dry_run import predict_captures

        return predict_captures(paths, options, part)
    return process_captures(paths, options, part)
