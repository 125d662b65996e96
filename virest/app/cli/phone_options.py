"""Options of ``virest simulate`` for the phone's own processing, which no camera profile describes."""

from __future__ import annotations

from typing import Annotated, Any

import typer

PANEL = "The phone's own processing, not in camera.yaml (off unless given; --isp phone turns all on)"


def _strength(metavar: str, text: str) -> Any:
    return typer.Option(metavar=metavar, help=text, rich_help_panel=PANEL)


Isp = Annotated[str | None, _strength("NAME", "All of a typical phone: phone, or none.")]
Tone = Annotated[float | None, _strength("SHARE", "Global S-shaped tone curve, 0 to 1 (also applied to truth/).")]
Highlights = Annotated[float | None, _strength("SHARE", "Highlight roll-off, 0 to 0.9 of the range (also truth/).")]
LocalTone = Annotated[float | None, _strength("SHARE", "Local tone mapping: large-scale compression, 0 to 0.9.")]
Denoise = Annotated[float | None, _strength("SIGMAS", "Spatial denoising, in multiples of --noise; chroma twice that.")]
TemporalDenoise = Annotated[float | None, _strength("SHARE", "Weight of the previous frame where static, 0 to 0.95.")]
Sharpen = Annotated[str | None, _strength("AMOUNT[,PX]", "Unsharp mask: amount and radius. [radius 1 px]")]
GyroNoise = Annotated[float | None, _strength("DENSITY", "Gyroscope noise density in rad/s/sqrt(Hz).")]
GyroJitter = Annotated[float | None, _strength("MS", "Timestamp jitter of the inertial samples.")]
GyroLowpass = Annotated[float | None, _strength("HZ", "Second-order low-pass filter of the gyroscope.")]
StabiliserRest = Annotated[str | None, _strength("FRACTION[,HZ]", "Stabilisation missing from the profile. [1 Hz]")]
OffsetMs = Annotated[float | None, _strength("MS", "Time offset missing from the profile.")]
BitsPerPx = Annotated[float | None, _strength("BITS", "Encoder rate, bits per pixel; phones use 0.1 to 0.3. [0.25]")]


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
