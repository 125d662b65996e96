"""Options of ``virest simulate`` for the phone's own processing, which no camera profile knows of."""

from __future__ import annotations

from typing import Annotated, Any

import typer

PANEL = "Phone's processing, none of it in camera.yaml (each off unless given; --isp phone turns all on)"


def _strength(metavar: str, text: str) -> Any:
    return typer.Option(metavar=metavar, help=text, rich_help_panel=PANEL)


Isp = Annotated[str | None, _strength("NAME", "A whole phone: phone, or none.")]
Tone = Annotated[float | None, _strength("SHARE", "Global tone curve, 0 to 1 of an S (truth/ has it too).")]
Highlights = Annotated[float | None, _strength("SHARE", "Top of the range that rolls off, 0 to 0.9 (truth/ too).")]
LocalTone = Annotated[float | None, _strength("SHARE", "Compression of the coarse brightness, 0 to 0.9.")]
Denoise = Annotated[float | None, _strength("SIGMAS", "Spatial denoising, in deviations of --noise; chroma twice.")]
TemporalDenoise = Annotated[float | None, _strength("SHARE", "Of the frame before where nothing moves, 0 to 0.95.")]
Sharpen = Annotated[str | None, _strength("AMOUNT[,PX]", "Unsharp mask, and its radius. [radius 1]")]
GyroNoise = Annotated[float | None, _strength("DENSITY", "Gyroscope's noise, rad/s/sqrt(Hz); 0.001: 0.01 rad/s.")]
GyroJitter = Annotated[float | None, _strength("MS", "Jitter of the inertial time stamps.")]
GyroLowpass = Annotated[float | None, _strength("HZ", "Second-order low pass of the gyroscope.")]
StabiliserRest = Annotated[str | None, _strength("FRACTION[,HZ]", "A stabiliser not in the profile. [1 Hz]")]
OffsetMs = Annotated[float | None, _strength("MS", "Time offset not in the profile.")]
BitsPerPx = Annotated[float | None, _strength("BITS", "Encoder: bits a pixel and frame; phones 0.1 to 0.3. [0.25]")]


def one_or_two(option: str, text: str | None) -> tuple[float | None, float | None]:
    """Parse ``A`` or ``A,B``."""
    if text is None:
        return None, None
    try:
        first, second = [*map(float, text.split(",")), None][:2] if text.count(",") <= 1 else [None, None]
    except ValueError:
        first = None
    if first is None:
        raise typer.BadParameter(f"{option} {text!r}: write one number, or two with a comma")
    return first, second
