"""Bracketed pictures of a static scene, with the relative light of each.

Two sources: a folder of stills with exposure times in a CSV (``file,exposure_s``) or in their EXIF data, and a
MARSLogger capture whose logged exposure × ISO changes.  Light scales with exposure × ISO / f-number².
"""

from __future__ import annotations

import csv
import math
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from struct import Struct, error
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.capture.files import label, read_small_text, require_regular_file
from virest.capture.pictures import PNG_SIGNATURE
from virest.capture.records import NO_STAMP, STARTUP, Capture, Frame
from virest.capture.video import probe_movie, read_frames
from virest.errors import CalibrationError, CaptureError, printable

SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff"}
COLUMNS = ("file", "exposure_s")
MAX_STILLS = 64
"""A bracket has about ten; all are held in memory."""
MAX_STILL_BYTES = 400 << 20
MAX_SAMPLED_PX = 4_000_000
"""Larger pictures are reduced by an integer factor, by block means."""
MAX_CSV_LINE = 4096
"""Characters; a longer line is not a file name with a number."""
MAX_IFD_ENTRIES = 512
"""Cameras write fewer than 100; damaged files can claim 65 535."""
EXIF_IFD, EXPOSURE_TIME, F_NUMBER, ISO = 0x8769, 0x829A, 0x829D, 0x8827
"""Tags of EXIF 2.3."""
MAX_GROUPS = 12
"""Of a capture: more exposures hardly improve the curve but lengthen its fit."""
FRAMES_PER_GROUP = 6
"""Their mean has 0.4 of a frame's noise."""
SAME_EXPOSURE_EV = 0.02
"""1.4 % of light: less than two grey levels in sRGB."""


@dataclass(frozen=True, slots=True)
class Still:
    """One picture of a bracket."""

    file: str
    """Its file name; of a capture, for example ``frame 000017``, the first of the averaged frames."""
    levels: NDArray[Any]
    """(h, w, 3) RGB grey levels 0 to 255; uint8, or float32 if the file has 16 bits or frames were averaged."""
    exposure_s: float
    """As listed."""
    gain: float = 1.0
    """Factor of ISO and f-number, relative to the bracket's first picture."""

    @property
    def exposure(self) -> float:
        """Listed light, exposure_s × gain."""
        return self.exposure_s * self.gain


@dataclass(frozen=True, slots=True)
class ExifExposure:
    """Exposure data of one picture; None: not given."""

    exposure_s: float | None = None
    f_number: float | None = None
    iso: float | None = None


# ── a folder of stills ───────────────────────────────────────────────────────────────────────────────────────────


def read_bracket(folder: Path, exposures_csv: Path | None = None) -> tuple[list[Still], list[str]]:
    """The pictures of a folder with their exposures, in order of their names, and notes.

    Raises CaptureError for a folder without pictures, unknown exposures, faults of the CSV, pictures that cannot be
    decoded, and pictures of different sizes.
    """
    if not folder.is_dir():
        reason = "is not a folder" if folder.exists() else "no such folder"
        raise CaptureError(f"{folder}: {reason}", hint="pass a folder of bracketed pictures, or a capture")
    names = sorted(p.name for p in folder.iterdir() if _is_picture(p))
    if not names:
        raise CaptureError(f"{folder}: holds no PNG, JPEG or TIFF", hint="pass a folder of bracketed pictures")
    notes: list[str] = []
    listed = None
    if exposures_csv is not None:
        listed = read_exposures(exposures_csv, names)
        spare = [name for name in names if name not in listed]
        if spare:
            count = f"{len(spare)} picture{'s are' if len(spare) > 1 else ' is'}"
            notes.append(f"{count} not in {exposures_csv.name} and left out ({_some(spare)})")
        names = [name for name in names if name in listed]
    if len(names) > MAX_STILLS:
        raise CaptureError(f"{folder}: {len(names)} pictures, at most {MAX_STILLS} allowed", hint="list fewer in a CSV")
    stills = [_read_still(folder / name, listed[name] if listed else None) for name in names]
    _require_one_size(stills)
    return _relative_gains(stills, notes), notes


def _is_picture(path: Path) -> bool:
    """By its name; hidden files, such as macOS writes beside each picture, do not count."""
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()


def _some(names: list[str]) -> str:
    return ", ".join(names[:3]) + (", …" if len(names) > 3 else "")


def read_exposures(path: Path, names: list[str]) -> dict[str, float]:
    """Exposure times from a CSV with the columns ``file,exposure_s``; every file must be one of ``names``.

    Raises CaptureError with the line number for a missing or unknown column, a file that is missing or listed twice,
    and an exposure that is not a positive finite number.
    """
    require_regular_file(path, hint="check the path given to --exposures")
    text = read_small_text(path)
    if "\0" in text:
        raise CaptureError(f"{label(path)}: has NUL bytes, so it is not plain text", hint="write file,exposure_s")
    found: dict[str, float] = {}
    header: list[str] | None = None
    for number, line in enumerate(text.splitlines(), 1):
        where = f"{label(path)} line {number}"
        if len(line) > MAX_CSV_LINE:
            raise CaptureError(f"{where}: {len(line)} characters", hint="a line is a file name and an exposure time")
        if not line.strip():
            continue
        row = [cell.strip() for cell in next(csv.reader([line]))]
        if header is None:
            header = _csv_header(row, where)
        else:
            name, exposure_s = _csv_row(row, header, where, names)
            if name in found:
                raise CaptureError(f"{where}: {name} is listed twice", hint="keep one line per picture")
            found[name] = exposure_s
    if not found:
        raise CaptureError(f"{label(path)}: lists no pictures", hint="write a line file,exposure_s, then the pictures")
    return found


def _shown(text: str) -> str:
    short = text if len(text) <= 60 else text[:57] + "..."
    return printable(short)


def _csv_header(row: list[str], where: str) -> list[str]:
    if sorted(row) != sorted(COLUMNS):
        strange = [name for name in row if name not in COLUMNS]
        what = f"unknown column '{_shown(strange[0])}'" if strange else f"columns {_shown(','.join(row))}"
        raise CaptureError(f"{where}: {what}", hint="the columns are file,exposure_s")
    return row


def _csv_row(row: list[str], header: list[str], where: str, names: list[str]) -> tuple[str, float]:
    if len(row) != len(header):
        raise CaptureError(f"{where}: {len(row)} values, 2 expected", hint="a line is a file name and an exposure time")
    cells = dict(zip(header, row, strict=True))
    name = cells["file"]
    if name not in names:
        raise CaptureError(f"{where}: no picture {_shown(name)!r} in the folder", hint="use the folder's file names")
    try:
        exposure_s = float(cells["exposure_s"])
    except ValueError:
        exposure_s = math.nan
    if not (math.isfinite(exposure_s) and exposure_s > 0):
        value = _shown(cells["exposure_s"])
        raise CaptureError(f"{where}: exposure_s {value!r} is not above zero", hint="write seconds, such as 0.008")
    return name, exposure_s


def _read_still(path: Path, exposure_s: float | None) -> Still:
    size = require_regular_file(path)
    if size > MAX_STILL_BYTES:
        raise CaptureError(f"{label(path)}: {size} bytes, more than {MAX_STILL_BYTES}", hint="is it a picture?")
    try:
        data = path.read_bytes()
    except OSError as fault:
        raise CaptureError(f"{label(path)}: {fault.strerror}", hint="check its permissions") from None
    gain = 1.0
    if exposure_s is None:
        exif = read_exif_exposure(data)
        exposure_s = exif.exposure_s
        if exposure_s is None:
            hint = "write a CSV with the columns file,exposure_s and pass it with --exposures"
            raise CaptureError(f"{label(path)}: its EXIF data have no exposure time", hint=hint)
        gain = (exif.iso or 100.0) / 100.0 / (exif.f_number or 1.0) ** 2
    return Still(path.name, _decode(data, path), exposure_s, gain)


def _decode(data: bytes, path: Path) -> NDArray[Any]:
    if data[:8] == PNG_SIGNATURE and not _whole_png(data):
        raise CaptureError(f"{label(path)}: is cut off or damaged ({len(data)} bytes)", hint="copy the picture again")
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except cv2.error:
        picture = None
    finally:
        cv2.utils.logging.setLogLevel(level)
    if picture is None or picture.dtype not in (np.uint8, np.uint16):
        raise CaptureError(f"{label(path)}: cannot be decoded ({len(data)} bytes)", hint="copy the picture again")
    levels = picture[..., ::-1] if picture.dtype == np.uint8 else (picture[..., ::-1] / np.float32(257)).astype("f4")
    factor = math.ceil(math.sqrt(levels.shape[0] * levels.shape[1] / MAX_SAMPLED_PX))
    return np.ascontiguousarray(levels) if factor < 2 else _reduced(levels, factor)


def _reduced(levels: NDArray[Any], factor: int) -> NDArray[np.float32]:
    """Means over squares of ``factor`` pixels, (h // factor, w // factor, 3)."""
    height, width = levels.shape[0] // factor, levels.shape[1] // factor
    cut = np.ascontiguousarray(levels[: height * factor, : width * factor], np.float32)
    return cv2.resize(cut, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)


def _require_one_size(stills: list[Still]) -> None:
    first = stills[0]
    for still in stills[1:]:
        if still.levels.shape != first.levels.shape:
            sizes = " and ".join(f"{s.file} {s.levels.shape[1]}x{s.levels.shape[0]}" for s in (first, still))
            raise CaptureError(f"pictures of different sizes: {sizes}", hint="take the bracket with one setting")


def _relative_gains(stills: list[Still], notes: list[str]) -> list[Still]:
    first = stills[0].gain
    out = [Still(s.file, s.levels, s.exposure_s, s.gain / first) for s in stills]
    if any(abs(math.log2(s.gain)) > 0.01 for s in out):
        notes.append("ISO or f-number change between the pictures (EXIF): light counted as exposure × ISO / f-number²")
    return out


# ── EXIF ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def read_exif_exposure(data: bytes) -> ExifExposure:
    """Exposure time, f-number and ISO from a JPEG's APP1 segment, a PNG's eXIf chunk, or a TIFF file itself.

    Bounded: every offset is checked, at most MAX_IFD_ENTRIES entries of two directories are read; damaged data count as
    "not given" (EXIF 2.32, CIPA DC-008; TIFF 6.0).
    """
    block = _exif_block(data)
    try:
        return _read_tiff(block) if block else ExifExposure()
    except (error, IndexError, ValueError):
        return ExifExposure()


def _exif_block(data: bytes) -> bytes | None:
    if data[:4] in (b"II*\0", b"MM\0*"):
        return data
    if data[:8] == PNG_SIGNATURE:
        return next((body for kind, body in _png_chunks(data) if kind == b"eXIf"), None)
    if data[:2] == b"\xff\xd8":
        return next((body[6:] for kind, body in _jpeg_segments(data) if kind == 0xE1 and body[:6] == b"Exif\0\0"), None)
    return None


def _whole_png(data: bytes) -> bool:
    """Whether all chunks up to IEND are complete; for broken ones the decoder would print a warning of its own."""
    at = 8
    while at + 12 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        if data[at + 8 + size : at + 12 + size] != zlib.crc32(data[at + 4 : at + 8 + size]).to_bytes(4, "big"):
            return False
        if data[at + 4 : at + 8] == b"IEND":
            return True
        at += 12 + size
    return False


def _png_chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = 8
    while at + 12 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        yield data[at + 4 : at + 8], data[at + 8 : at + 8 + size]
        at += 12 + size


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Marker segments before the first scan."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        if data[at + 1] == 0xFF:
            at += 1
            continue
        size = int.from_bytes(data[at + 2 : at + 4], "big")
        if size < 2:
            return
        yield data[at + 1], data[at + 4 : at + 2 + size]
        at += 2 + size


def _read_tiff(block: bytes) -> ExifExposure:
    order = {b"II": "<", b"MM": ">"}[block[:2]] if block[:2] in (b"II", b"MM") else "<"
    entries = _directory(block, Struct(order + "I").unpack_from(block, 4)[0], order)
    if EXIF_IFD in entries:
        entries |= _directory(block, int(entries[EXIF_IFD]), order)
    picked = [entries.get(tag) for tag in (EXPOSURE_TIME, F_NUMBER, ISO)]
    return ExifExposure(*(v if v is not None and math.isfinite(v) and v > 0 else None for v in picked))


def _directory(block: bytes, start: int, order: str) -> dict[int, float]:
    """First value of each short, long or rational entry of one directory."""
    count = min(Struct(order + "H").unpack_from(block, start)[0], MAX_IFD_ENTRIES)
    entry, found = Struct(order + "HHI"), {}
    for i in range(count):
        at = start + 2 + 12 * i
        tag, kind, _number = entry.unpack_from(block, at)
        if kind == 3:
            found[tag] = float(Struct(order + "H").unpack_from(block, at + 8)[0])
        elif kind == 4:
            found[tag] = float(Struct(order + "I").unpack_from(block, at + 8)[0])
        elif kind == 5 and tag in (EXPOSURE_TIME, F_NUMBER):
            (offset,) = Struct(order + "I").unpack_from(block, at + 8)
            above, below = Struct(order + "II").unpack_from(block, offset)
            found[tag] = above / below if below else math.nan
    return found


# ── a capture ────────────────────────────────────────────────────────────────────────────────────────────────────


def capture_bracket(capture: Capture) -> tuple[list[Still], list[str]]:
    """The frames of a capture of a static scene as a bracket: one mean picture for each logged exposure × ISO.

    At most MAX_GROUPS exposures, spread over those that occur, each the mean of up to FRAMES_PER_GROUP frames.  Frames
    of the start-up, whose content is later than their timestamps, are skipped.  Raises CaptureError if no exposures are
    logged, CalibrationError if all are equal.
    """
    usable = [f for f in capture.frames if f.exposure_s and not {STARTUP, NO_STAMP} & set(f.skip_codes)]
    if not usable:
        hint = "movie_metadata.csv must give exposure times; or take bracketed stills"
        raise CaptureError(f"{capture.name}: no frame has a logged exposure", hint=hint)
    iso_known = all(f.iso for f in usable)
    notes = [] if iso_known else ["ISO is not logged for every frame: light counted as exposure alone"]
    groups = _groups(usable, iso_known)
    if len(groups) < 2:
        text = f"{capture.name}: its {len(usable)} frames have one exposure × ISO: a response curve needs several"
        raise CalibrationError(text, hint="film a static scene at exposures from dark to bright, 1 EV apart")
    wanted = {f.index: n for n, group in enumerate(groups) for f in group}
    sums, counts = _mean_frames(capture, wanted, len(groups))
    first_iso = groups[0][0].iso or 1.0
    stills = [
        Still(
            f"frame {group[0].index:06d}",
            (sums[n] / counts[n]).astype(np.float32),
            float(group[0].exposure_s or 0.0),
            (group[0].iso or 1.0) / first_iso if iso_known else 1.0,
        )
        for n, group in enumerate(groups)
        if counts[n]
    ]
    notes.append(f"{sum(counts)} frames at {len(stills)} exposures, averaged for each exposure")
    return stills, notes


def _light(frame: Frame, iso_known: bool) -> float:
    return (frame.exposure_s or 0.0) * ((frame.iso or 1.0) if iso_known else 1.0)


def _groups(frames: list[Frame], iso_known: bool) -> list[list[Frame]]:
    """Frames of one exposure each, dark to bright, thinned to MAX_GROUPS spread evenly in EV."""
    groups: list[list[Frame]] = []
    for frame in sorted(frames, key=lambda f: (_light(f, iso_known), f.index)):
        light = _light(frame, iso_known)
        if groups and math.log2(light / _light(groups[-1][0], iso_known)) < SAME_EXPOSURE_EV:
            groups[-1].append(frame)
        else:
            groups.append([frame])
    if len(groups) > MAX_GROUPS:
        ev = np.log2([_light(g[0], iso_known) for g in groups])
        goals = np.linspace(ev[0], ev[-1], MAX_GROUPS)
        groups = [groups[i] for i in sorted({int(np.argmin(np.abs(ev - goal))) for goal in goals})]
    return [_evenly_spaced(sorted(group, key=lambda f: f.index)) for group in groups]


def _evenly_spaced(group: list[Frame]) -> list[Frame]:
    picks = np.linspace(0, len(group) - 1, min(len(group), FRAMES_PER_GROUP)).round().astype(int)
    return [group[i] for i in picks.tolist()]


def _mean_frames(capture: Capture, wanted: dict[int, int], groups: int) -> tuple[list[Any], list[int]]:
    sums: list[Any] = [0.0] * groups
    counts = [0] * groups
    index = probe_movie(capture.movie)
    for frame, picture in read_frames(capture.movie, index, min(wanted), max(wanted)):
        if frame in wanted and picture is not None:
            sums[wanted[frame]] = sums[wanted[frame]] + picture.astype(np.float32)
            counts[wanted[frame]] += 1
    return sums, counts
