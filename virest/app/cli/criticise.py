"""`virest criticise`: find structure in the residuals of a calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from virest.app import console
from virest.app.cli.options import Json, Quiet, Verbose, Version, emit_facts


def criticise(
    residuals: Annotated[
        Path, typer.Argument(metavar="RESIDUALS", help="CSV with columns x, y, dx, dy in pixels, one row per point.")
    ],
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Find what the residuals of any calibration depend on, and name likely causes.

    Columns x, y give the point; dx, dy are measured minus predicted, in pixels. Optional columns: row (fraction of the
    readout), time (s), frame, vx, vy (velocity of the point, px/s), and any other covariate under its own name.

    \b
    $ virest criticise residuals.csv
    residuals.csv: 2400 residuals (2400 used), 0.202 px rms per coordinate
    tested covariates: x, y, row, frame
    field: shifts of up to 0.677 px depend on the position in the frame, ...
    remaining: 0.152 px without structure
    $ virest criticise residuals.csv --json | jq '.fields[].sentence'
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    from virest.app.criticise import criticise_file

    facts, text = criticise_file(residuals)
    emit_facts(facts, text, as_json=json)
    return 0
