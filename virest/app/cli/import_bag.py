"""`virest import`: convert a bag to a capture folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from virest.app import console
from virest.app.cli.options import Json, Quiet, Verbose, Version, emit_facts


def import_bag(
    bag: Annotated[Path, typer.Argument(metavar="BAG", help="A .bag or .mcap file, or the folder of a ROS 2 bag.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Write this capture folder.")],
    image: Annotated[
        str | None, typer.Option(metavar="TOPIC", help="Image topic. [the one with the most messages]")
    ] = None,
    imu: Annotated[
        str | None, typer.Option(metavar="TOPIC", help="IMU topic. [the one with the most messages]")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier import.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Convert a ROS bag or MCAP file to a capture folder: images, IMU, and the lens from CameraInfo; no ROS needed.

    \b
    $ virest import walk.mcap walk
    walk.mcap: 180 frames of /camera/image_raw, 1203 samples of /imu
    wrote walk
    $ virest calibrate walk
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    from virest.app.import_bag import ImportOptions, run_import

    with console.progress_bar(0, "import", quiet=quiet) as bar:
        facts, text = run_import(bag, ImportOptions(out, image, imu, overwrite), bar.update if bar else None)
    emit_facts(facts, text, as_json=json, quiet=quiet)
    return 0
