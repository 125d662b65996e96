"""`virest calibrate-curve`: the camera's exposure curve."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from virest.app import console
from virest.app.cli.options import Json, Quiet, Verbose, Version, emit_facts, one_of
from virest.app.machine import prepare_process

CURVE_KINDS = ("auto", "linear", "five_segment", "gamma", "srgb", "table")


def calibrate_curve(
    source: Annotated[
        Path, typer.Argument(metavar="SOURCE", help="Folder of bracketed stills, or a capture of a static scene.")
    ],
    exposures: Annotated[
        Path | None, typer.Option(metavar="CSV", help="Exposure times, columns file,exposure_s. [from EXIF]")
    ] = None,
    kind: Annotated[
        str | None,
        typer.Option(
            metavar="KIND", callback=one_of(CURVE_KINDS), help=f"Curve model: {', '.join(CURVE_KINDS)}. [auto]"
        ),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="Write the response block here.")] = Path(
        "curve.yaml"
    ),
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Plot curve, data and residuals to this png, svg or pdf.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Fit the exposure curve (exposure to grey level) to pictures of a static scene at several exposures.

    \b
    $ virest calibrate-curve bracket --plot curve.png
    five_segment b (0.1564, 0.08188), c (0.794, 0.7961), y_max 1
    fit error 1.34 grey levels rms over exposures 0.06215 to 1
    the curve is known to ± 0.36 grey levels there
    ...
    $ virest calibrate-curve stills --exposures stills/exposures.csv
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    prepare_process()
    from virest.app.calibrate_curve import calibrate_curve as fit_and_write
    from virest.app.calibrate_curve import plot_format_known

    if plot is not None and not plot_format_known(plot):
        raise typer.BadParameter(f"--plot {plot.name}: the name must end in .png, .svg or .pdf")
    facts, text = fit_and_write(
        source, exposures=exposures, kind=kind or "auto", out=out, plot=plot, overwrite=overwrite
    )
    emit_facts(facts, text, as_json=json, quiet=quiet)
    return 0
