"""`virest calibrate`: fit camera and IMU parameters to an ordinary capture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from virest.app import console
from virest.app.cli.options import Config, Json, OneCapture, Quiet, Verbose, Version, emit_facts, one_capture
from virest.app.machine import cores, prepare_process

CALIBRATED_EXTRAS = (
    "focal",
    "distortion",
    "higher-distortion",
    "principal-point",
    "gyro-scale",
    "clock-skew",
    "exposure-scale",
    "frame-lag",
)


def calibrate(
    capture: OneCapture,
    config: Config = None,
    extra: Annotated[
        list[str] | None,
        typer.Option("--with", metavar="NAME,...", help=f"Also fit these: {', '.join(CALIBRATED_EXTRAS)}."),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="Write the calibrated profile here.")] = Path(
        "camera.yaml"
    ),
    kalibr: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Also write Kalibr's camchain-imucam.yaml and imu.yaml to DIR.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Fit time offset, readout, IMU-camera rotation and gyroscope bias to an ordinary capture.

    \b
    $ virest calibrate shaken --with focal
    shaken: calibrated
    value                       start     calibrated        ±  determined  note
    time_offset_s           0.0000000      0.0309982  8.5e-06  yes
    readout_time_s           0.020000       0.022711  1.5e-05  yes
    readout_direction   right_to_left  right_to_left           yes
    ...
    residual 0.392 -> 0.0702 px (tracking noise 0.0693 px)
    ...
    wrote camera.yaml

    \b
    $ virest calibrate shaken --json --out found.yaml | jq '.values[] | select(.determined) | .name, .value, .std'
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    prepare_process()
    from virest.app.calibrate import CalibrationOutput, plan_calibration, run_calibration
    from virest.app.process_map import process_map

    names = _parse_extras(extra or [])
    output = CalibrationOutput(out, kalibr, overwrite)
    output.require()
    path = one_capture(capture, "calibrate")
    plan = plan_calibration(Path(path), config, names)
    with process_map(cores()) as each, console.progress_bar(plan.steps, "calibrate", quiet=quiet) as bar:
        facts, text = run_calibration(plan, output, bar.update if bar else None, each)
    emit_facts(facts, text, as_json=json, quiet=quiet)
    return 0


def _parse_extras(options: list[str]) -> tuple[str, ...]:
    """Names of ``--with``, each once; every option may list several, separated by commas."""
    from virest.app.calibrate import unknown_extra

    names = tuple(dict.fromkeys(name.strip() for option in options for name in option.split(",") if name.strip()))
    for complaint in filter(None, map(unknown_extra, names)):
        raise typer.BadParameter(f"--with {complaint}")
    return names
