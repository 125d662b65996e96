"""`virest simulate`: captures with known ground truth."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import typer

from virest.app import console
from virest.app.cli.options import Json, Quiet, Verbose, Version, emit_facts, one_of, parse_frames
from virest.app.cli.phone_options import (
    BitsPerPx,
    Denoise,
    GyroJitter,
    GyroLowpass,
    GyroNoise,
    Highlights,
    Isp,
    LocalTone,
    OffsetMs,
    Sharpen,
    StabiliserRest,
    TemporalDenoise,
    Tone,
    one_or_two,
)
from virest.app.machine import prepare_process
from virest.restoration.settings import REFERENCES

DIRECTIONS = ("top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left")
"""camera.shutter.READOUT_DIRECTIONS, here without loading NumPy."""
LIKE_OPTIONS = (
    "out",
    "like",
    "frames",
    "config",
    "noise",
    "effect",
    "reference",
    "seed",
    "overwrite",
    "json",
    "quiet",
    "verbose",
    "version",
)
"""Options that `simulate --like` uses; everything else comes from the capture."""


def simulate(
    context: typer.Context,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Write the capture to this folder.")],
    like: Annotated[
        Path | None,
        typer.Option(metavar="CAPTURE", help="Re-create this capture: its camera, timestamps, exposures and motion."),
    ] = None,
    scene: Annotated[
        str, typer.Option(metavar="KIND", help="Scene: leaves, colours, bright, board, text or photographs.")
    ] = "leaves",
    width: Annotated[int, typer.Option(metavar="PX", help="Frame width.")] = 720,
    height: Annotated[int, typer.Option(metavar="PX", help="Frame height.")] = 1280,
    frames: Annotated[
        str | None, typer.Option(metavar="N", help="Number of frames; with --like also A:B of its frames. [12; all]")
    ] = None,
    fps: Annotated[float, typer.Option(metavar="HZ", help="Frames per second.")] = 30.0,
    exposure_ms: Annotated[
        str, typer.Option(metavar="MS[,MS...]", help="Exposure time; frames cycle through several.")
    ] = "10",
    auto_exposure: Annotated[
        str | None,
        typer.Option(
            metavar="EV[:STEPS]",
            help="Vary exposure x ISO and brightness over EV, smoothly or in STEPS steps. [constant]",
        ),
    ] = None,
    readout_ms: Annotated[
        float, typer.Option(metavar="MS", help="Readout time, from the first row to one past the last.")
    ] = 20.0,
    direction: Annotated[
        str | None,
        typer.Option(
            metavar="DIRECTION", callback=one_of(DIRECTIONS), help=f"Readout direction: {', '.join(DIRECTIONS)}."
        ),
    ] = None,
    focal_px: Annotated[float | None, typer.Option(metavar="PX", help="Focal length.")] = None,
    rate: Annotated[float, typer.Option(metavar="RAD_S", help="Rotation rate of the hand; 0: none.")] = 1.0,
    pan: Annotated[float, typer.Option(metavar="RAD_S", help="Constant yaw rate in addition to --rate.")] = 0.0,
    noise: Annotated[float, typer.Option(metavar="LEVELS", help="Image noise in grey levels.")] = 1.5,
    response: Annotated[
        str, typer.Option(metavar="CURVE", help="Response: srgb, linear, gamma:2.2, five_segment[:xb,yb,xc,yc,y_max].")
    ] = "srgb",
    depth_m: Annotated[float | None, typer.Option(metavar="M", help="Distance of the scene. [infinity]")] = None,
    near_m: Annotated[
        float | None, typer.Option(metavar="M", help="Distance of objects in front of the scene. [none]")
    ] = None,
    moving: Annotated[
        float, typer.Option(metavar="PX_S", help="Speed of objects moving across the scene; 0: none.")
    ] = 0.0,
    config: Annotated[Path | None, typer.Option(metavar="FILE", help="Take the camera from this profile.")] = None,
    effect: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[=VALUE]", help="Apply this effect without stating it in camera.yaml; may be repeated."
        ),
    ] = None,
    reference: Annotated[
        str,
        typer.Option(
            metavar="|".join(REFERENCES), callback=one_of(REFERENCES), help="Instant that the truth frames show."
        ),
    ] = REFERENCES[0],
    seed: Annotated[
        int, typer.Option(metavar="N", min=0, help="Random seed; the same seed gives the same capture.")
    ] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a simulated capture.")] = False,
    isp: Isp = None,
    tone: Tone = None,
    highlights: Highlights = None,
    local_tone: LocalTone = None,
    denoise: Denoise = None,
    temporal_denoise: TemporalDenoise = None,
    sharpen: Sharpen = None,
    gyro_noise: GyroNoise = None,
    gyro_jitter_ms: GyroJitter = None,
    gyro_lowpass: GyroLowpass = None,
    stabiliser_rest: StabiliserRest = None,
    offset_ms: OffsetMs = None,
    bits_per_px: BitsPerPx = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Write a capture with known ground truth: movie, logs, camera.yaml, and truth/ with sharp frames and motion.

    \b
    $ virest simulate leaves --width 360 --height 640 --frames 20 --rate 1.5 --effect time_offset=0.012
    leaves: 20 frames of 360x640, blur 6.26 px, effects: time_offset (time_offset_s 0.012)
    $ virest process leaves

    \b
    $ virest simulate bracket --auto-exposure 5:9 --rate 0 --exposure-ms 4 --frames 27
    $ virest calibrate-curve bracket

    \b
    $ virest simulate phone --isp phone --sharpen 0 --offset-ms 5 --noise 3

    \b
    $ virest simulate again --like 2022_03_09_15_21_07 --frames 30:90 --effect flicker=0.2,100
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    if like is not None:
        _require_only(context, LIKE_OPTIONS, "has no effect with --like, which takes it from the capture")
        options = {"noise_levels": noise, "effects": effect or [], "reference": reference, "seed": seed}
        facts = _simulate_like(out, like, config, frames, quiet, overwrite=overwrite, **options)
        emit_facts(facts, _describe_simulation(facts), as_json=json, quiet=quiet)
        return 0
    count = _parse_count(frames, 12)
    exposures_ms = _parse_exposures(exposure_ms)
    auto_exposure_ev, auto_exposure_steps = _parse_auto_exposure(auto_exposure)
    amount, radius_px = one_or_two("--sharpen", sharpen)
    rest, rest_cutoff_hz = one_or_two("--stabiliser-rest", stabiliser_rest)
    prepare_process()
    from virest.app.simulate import simulate_command
    from virest.camera.profile_file import read_profile
    from virest.simulation.phone_isp import make_isp

    phone = make_isp(
        isp, tone=tone, highlights=highlights, local_tone=local_tone, denoise=denoise,
        temporal_denoise=temporal_denoise, sharpen=amount, sharpen_radius_px=radius_px, gyro_noise=gyro_noise,
        gyro_jitter_s=_seconds(gyro_jitter_ms), gyro_lowpass_hz=gyro_lowpass, stabiliser_rest=rest,
        stabiliser_cutoff_hz=rest_cutoff_hz, offset_s=_seconds(offset_ms), bits_per_px=bits_per_px,
    )  # fmt: skip

    with console.progress_bar(count, "simulate", quiet=quiet) as bar:
        facts = simulate_command(
            out, scene=scene, width=width, height=height, frames=count, fps=fps, exposure_ms=exposures_ms,
            auto_exposure_ev=auto_exposure_ev, auto_exposure_steps=auto_exposure_steps, readout_ms=readout_ms,
            direction=direction, focal_px=focal_px, rate_rad_s=rate, pan_rad_s=pan, near_m=near_m, moving_px_s=moving,
            noise_levels=noise, response=response, depth_m=depth_m, profile=read_profile(config) if config else None,
            effects=effect or [], reference=reference, seed=seed, overwrite=overwrite, isp=phone,
            progress=(lambda _done, _total: bar.update(1)) if bar else None,
        )  # fmt: skip
    emit_facts(facts, _describe_simulation(facts), as_json=json, quiet=quiet)
    return 0


def _simulate_like(
    out: Path, like: Path, config: Path | None, frames: str | None, quiet: bool, **options: Any
) -> dict[str, Any]:
    """Re-create a capture; a single number N in ``--frames`` means its first N frames."""
    chosen = parse_frames(frames if frames is None or ":" in frames else f":{frames}")
    prepare_process()
    from virest.app.recreate import count_frames, simulate_like

    with console.progress_bar(count_frames(like, chosen), "simulate", quiet=quiet) as bar:
        step = (lambda _done, _total: bar.update(1)) if bar else None
        return simulate_like(out, like, config=config, frames=chosen, progress=step, **options)


def _describe_simulation(facts: dict[str, Any]) -> str:
    effects = [
        f"{effect['name']} ({', '.join(f'{name} {value}' for name, value in effect['parameters'].items())})"
        for effect in facts["effects"]
    ]
    size = f"{facts['frames']} frames of {facts['width']}x{facts['height']}"
    phone = ", ".join(f"{name} {value:g}" for name, value in facts.get("isp", {}).items())
    text = f"{facts['capture']}: {size}, blur {facts['blur_px']} px, effects: {', '.join(effects) or 'none'}"
    return text + (f", phone: {phone}" if phone else "")


def _seconds(milliseconds: float | None) -> float | None:
    return None if milliseconds is None else milliseconds / 1000


def _require_only(context: typer.Context, allowed: tuple[str, ...], why: str) -> None:
    """Refuse options that were given but would have no effect."""
    for name in context.params:
        source = context.get_parameter_source(name)
        if name not in allowed and source is not None and source.name == "COMMANDLINE":
            raise typer.BadParameter(f"--{name.replace('_', '-')}: {why}")


def _parse_count(text: str | None, default: int) -> int:
    if text is None:
        return default
    if not re.fullmatch(r"\s*[+-]?\d{1,9}\s*", text, re.ASCII):
        raise typer.BadParameter(f"--frames {text!r} is not a number; A:B is for --like")
    return int(text)


def _parse_exposures(text: str) -> list[float]:
    """Exposures in milliseconds, separated by commas."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not a list of milliseconds; write 10 or 5,10,20") from None


def _parse_auto_exposure(text: str | None) -> tuple[float | None, int | None]:
    """Parse a range in EV, and the number of steps for a staircase: ``4`` or ``6:9``."""
    if text is None:
        return None, None
    found = re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*(?::\s*([0-9]{1,6})\s*)?", text, re.ASCII)
    if found is None:
        raise typer.BadParameter(f"{text!r} is not an exposure range; write 4 (smooth change) or 6:9 (nine steps)")
    return float(found[1]), None if found[2] is None else int(found[2])
