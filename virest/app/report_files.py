"""Validated reading of run.json, parameters.jsonl and diagnosis.json for a page; the files are not trusted."""

from __future__ import annotations

import json
import logging
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from virest.errors import CaptureError
from virest.report.html import FrameFacts

log = logging.getLogger(__name__)
MAX_ACCOUNT_BYTES = 64 << 20
"""Far larger than any file that virest writes."""
MAX_COUNT, MAX_STAMP_NS = 10**9, 1 << 61
"""More frames than a movie holds; 73 years, so differences of two timestamps fit 64 bits."""
Model = TypeVar("Model", bound=BaseModel)
_Count = Annotated[int, Field(ge=0, le=MAX_COUNT)]


class _Lenient(BaseModel):
    model_config = ConfigDict(extra="ignore", strict=False)


class Input(_Lenient):
    """An input file, as the run found it."""

    file: str
    bytes: int
    sha256: str


class Account(_Lenient):
    """run.json."""

    virest_run: int
    capture: str
    folder: str | None = None
    movie: str | None = None
    version: str = ""
    command: str = ""
    profile: dict[str, Any] = Field(default_factory=dict)
    profile_source: str = ""
    crop_px: tuple[int, int, int, int] | None = None
    settings: dict[str, Any] = Field(default_factory=dict)
    inputs: list[Input] = Field(default_factory=list)
    counts: dict[str, _Count]
    verdict: str
    warnings: list[str] = Field(default_factory=list)
    failure: dict[str, Any] | None = None
    """Why the capture could not be processed; there are no frames then."""


class Tile(_Lenient):
    """The blur of one tile."""

    centre_px: tuple[float, float]
    angle_rad: float
    length_px: float


class _Blur(_Lenient):
    length_px: float | None = None
    tiles: list[Tile] = Field(default_factory=list)


class _Motion(_Lenient):
    rate_rad_s: tuple[float, float, float] | None = None
    velocity_m_s: tuple[float, float, float] | None = None


class _Shutter(_Lenient):
    method: str = "none"
    max_displacement_px: float | None = None


class _Deblur(_Lenient):
    method: str = "none"
    expected_gain_db: float | None = None
    neighbours_gain_db: float | None = None
    noise_grey_levels: float | None = None


class FrameLine(_Lenient):
    """A line of parameters.jsonl."""

    frame: _Count
    timestamp_ns: int = Field(ge=-MAX_STAMP_NS, le=MAX_STAMP_NS)
    status: str = Field(pattern="^(restored|copied|skipped|failed)$")
    exposure_s: float | None = None
    output: str | None = None
    warnings: list[str] = Field(default_factory=list)
    depth_m: float | str | None = None
    motion: _Motion | None = None
    blur: _Blur | None = None
    shutter: _Shutter | None = None
    deblur: _Deblur | None = None
    valid_px: tuple[int, int, int, int] | None = None


class _Change(_Lenient):
    nominal: Any = None
    estimate: Any = None
    std: Any = None


class _HeldOut(_Lenient):
    quantity: str = ""
    before: float | str | None = None
    after: float | str | None = None
    gain: float | None = None


class _Rival(_Lenient):
    name: str
    held_out_after: float | str | None = None


class _Cause(_Lenient):
    name: str
    sentence: str = ""
    parameters: dict[str, _Change] = Field(default_factory=dict)
    held_out: _HeldOut = Field(default_factory=_HeldOut)
    rivals: list[_Rival] = Field(default_factory=list)


class _Field(_Lenient):
    sentence: str = ""
    reasons: str = ""
    next: str = ""


class DiagnosisFile(_Lenient):
    """diagnosis.json."""

    schema_: str = Field(alias="schema", pattern="^virest/diagnosis/")
    verdict: str
    nominal: dict[str, float | str | None] = Field(default_factory=dict)
    causes: list[_Cause] = Field(default_factory=list)
    fields: list[_Field] = Field(default_factory=list)
    unexplained: dict[str, float | str | None] = Field(default_factory=dict)
    restoration_gain: dict[str, Any] = Field(default_factory=dict)


def read_bytes(path: Path, limit: int) -> bytes:
    """The content of a regular file of bounded size. Raises CaptureError."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode) or status.st_size > limit:
            raise CaptureError(
                f"{path}: is not a regular file of at most {limit >> 20} MB", hint="check that virest wrote this file"
            )
        return path.read_bytes()
    except OSError as error:
        raise CaptureError(f"{path}: {error.strerror}", hint="run virest process again") from None


def read_model(path: Path, model: type[Model], kind: str) -> Model:
    """A JSON file, validated. Raises CaptureError with the first error."""
    try:
        return model.model_validate(json.loads(read_bytes(path, MAX_ACCOUNT_BYTES)))
    except ValidationError as error:
        raise CaptureError(
            f"{path}: {_complaint(error)}: not a valid {kind}", hint="check that virest wrote this file"
        ) from None
    except (ValueError, RecursionError) as error:
        raise CaptureError(f"{path}: not valid JSON ({error})", hint="repeat the command that wrote it") from None


def _complaint(error: ValidationError) -> str:
    first = error.errors(include_url=False, include_input=False)[0]
    place = ".".join(str(part) for part in first["loc"])
    return f"{place + ': ' if place else ''}{first['msg'].lower()}"


def read_frame_lines(folder: Path, expected: int) -> tuple[dict[int, FrameFacts], list[str]]:
    """The frames of parameters.jsonl by line number, and a note if some lines cannot be read.

    Tiles are not kept, since a long run has millions; those of the frames shown are read again.
    """
    path = folder / "parameters.jsonl"
    frames: dict[int, FrameFacts] = {}
    bad: list[int] = []
    for number, text in _numbered(path):
        try:
            frames[number] = _frame_facts(FrameLine.model_validate_json(text))
        except ValidationError:
            bad.append(number)
    if not frames and (expected or bad):
        raise CaptureError(f"{path}: none of its {len(bad)} lines can be read", hint="run virest process again")
    notes = []
    if bad or len(frames) != expected:
        which = f"; line {bad[0]} is the first that cannot be read" if bad else ""
        notes.append(f"parameters.jsonl describes {len(frames)} of {expected} frames{which}: only those are shown.")
        log.warning("%s: %s", folder.name, notes[0])
    return frames, notes


def read_tiles(folder: Path, numbers: set[int]) -> dict[int, list[Tile]]:
    """The tiles of the frames on these lines, by frame."""
    lines = (FrameLine.model_validate_json(text) for n, text in _numbered(folder / "parameters.jsonl") if n in numbers)
    return {line.frame: line.blur.tiles if line.blur else [] for line in lines}


def _numbered(path: Path) -> Iterator[tuple[int, bytes]]:
    try:
        with path.open("rb") as file:
            yield from ((number, text) for number, text in enumerate(file, start=1) if text.strip())
    except OSError as error:
        raise CaptureError(f"{path}: {error.strerror}", hint="run virest process again") from None


def _frame_facts(line: FrameLine) -> FrameFacts:
    blur, motion = line.blur or _Blur(), line.motion or _Motion()
    shutter, deblur = line.shutter or _Shutter(), line.deblur or _Deblur()
    velocity = motion.velocity_m_s
    return FrameFacts(
        frame=line.frame,
        timestamp_ns=line.timestamp_ns,
        state=line.status,
        warnings=tuple(line.warnings),
        exposure_s=line.exposure_s,
        blur_px=blur.length_px,
        longest_blur_px=max((tile.length_px for tile in blur.tiles), default=blur.length_px),
        rate_rad_s=motion.rate_rad_s,
        shift_px=shutter.max_displacement_px,
        depth_m=line.depth_m if isinstance(line.depth_m, float) else None,
        speed_m_s=None if velocity is None else float(np.hypot.reduce(velocity)),
        gain_db=deblur.expected_gain_db,
        neighbours_gain_db=deblur.neighbours_gain_db,
        noise_levels=deblur.noise_grey_levels,
        deblurred=deblur.method != "none",
        straightened=line.status == "restored" and shutter.method != "none",
        valid_px=line.valid_px,
    )
