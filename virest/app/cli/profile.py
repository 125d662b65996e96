"""`virest profile`: create a camera profile; list known phones."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from virest.app import console
from virest.app.cli.options import Json, Quiet, Verbose, Version, emit_facts

profile = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Create a camera profile; list the readout times of known phones."
)


@profile.command("new", short_help="Create a camera profile.")
def new(
    capture: Annotated[
        str | None, typer.Argument(metavar="CAPTURE", help="Use what this capture's recorder logged.")
    ] = None,
    device: Annotated[
        str | None, typer.Option(metavar="NAME", help="Take the readout time from the table of known phones.")
    ] = None,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Frame size, if no capture is given.")] = None,
    focal_px: Annotated[float | None, typer.Option(metavar="PX", min=1.0, help="Focal length in pixels.")] = None,
    fov_deg: Annotated[
        float | None, typer.Option(metavar="DEG", help="Field of view along the long side; sets the focal length.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="Write the profile here.")] = Path(
        "camera.yaml"
    ),
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Write a commented camera profile with all known values; unknown ones are null.

    \b
    $ virest profile new sample_data/text
    base: text, sample_data/text/camera.yaml
    wrote camera.yaml

    \b
    $ virest profile new --device "Honor View" --size 1280x720 --fov-deg 66
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    for one, other, both in (
        ("CAPTURE", "--size", capture is not None and size is not None),
        ("--focal-px", "--fov-deg", focal_px is not None and fov_deg is not None),
    ):
        if both:
            raise typer.BadParameter(f"{one} and {other} state the same; give one of them")
    from virest.app.new_profile import NewProfile, parse_size, run_new_profile

    folder = None if capture is None else Path(console.folder_of(capture))
    request = NewProfile(folder, device, None if size is None else parse_size(size), focal_px, fov_deg, out, overwrite)
    facts, text = run_new_profile(request)
    emit_facts(facts, text, as_json=json, quiet=quiet)
    return 0


@profile.command("devices", short_help="List the readout times of known phones.")
def devices(
    text: Annotated[str, typer.Argument(metavar="TEXT", help="Only devices whose name contains this text.")] = "",
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """List published readout times with their sources.

    \b
    $ virest profile devices honor
    device           mode  readout ms     ±  source
    Honor View 10  1280x720     20.68  0.13  J. Huai
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    from virest.app.new_profile import known_devices

    facts, shown = known_devices(text)
    emit_facts(facts, shown, as_json=json, quiet=quiet)
    return 0
