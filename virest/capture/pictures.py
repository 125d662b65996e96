"""Picture files in place of a movie: a list of times and names, or names that are times; with random access.

One path names a source, as for a movie: the list (EuRoC's data.csv, TUM's rgb.txt, frame_timestamps.txt), or the folder
itself if the names are nanoseconds.  Names that lead out of the list's folder are refused.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Mask
from virest.capture.files import label, require_regular_file, scan_text
from virest.capture.location import is_remote
from virest.capture.marslogger_android import STAMPS, read_frame_timestamps
from virest.capture.pixels import luma_of
from virest.capture.tables import INTEGER, MAX_FIELDS, Int64, exact_times_ns, keep_rising, text_chunks
from virest.errors import CaptureError, ClockError, VideoError

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")
MOVIE_SUFFIXES = (".mp4", ".mov", ".m4v", ".3gp", ".insv", ".360")
LISTS = ("data.csv", "rgb.txt", "timestamps.csv", "timestamps.txt", "times.txt", STAMPS)
"""File names of lists, in order of preference."""
PLACES = ("", "data", "rgb", "images", "frames", "color")
"""Folders of the pictures, relative to the list's folder."""
MAX_BYTES = 1 << 28
MAX_SIDE_PX = 16384
"""Twice the side of 8K; also of the frames of a movie."""
SIXTEEN_BITS = 257.0
"""16-bit steps per 8-bit grey level."""
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True, slots=True)
class PictureList:
    """Which pictures there are, and when they were taken."""

    base: Path
    """Folder that the names are relative to."""
    time_ns: Int64
    """(n,) strictly rising."""
    names: tuple[str, ...]
    """(n,) paths relative to ``base``."""
    rows: int
    dropped: dict[str, int]


def is_picture_source(path: Path) -> bool:
    """Whether a capture's movie is a list of pictures or a folder of them."""
    kind = path.suffix.lower()
    return kind in (".csv", ".txt") or (kind not in MOVIE_SUFFIXES and path.is_dir())


def find_picture_source(folder: Path) -> Path | None:
    """The list of pictures in a folder, else the folder whose pictures are named by nanoseconds; None if neither."""
    for name in LISTS:
        if (folder / name).is_file() and any(_pictures(folder / place) for place in PLACES):
            return folder / name
    for place in PLACES:
        names = _pictures(folder / place)
        if names and all(INTEGER.fullmatch(Path(name).stem) for name in names):
            return folder / place
    return None


def read_picture_list(path: Path) -> PictureList:
    """Read a list of pictures, or a folder of pictures named by nanoseconds.

    Raises VideoError (no pictures, names outside the folder), ClockError (times, not one timestamp per picture).
    """
    if path.is_dir():
        return _from_names(path)
    if path.name == STAMPS:
        return _in_order(path)
    scan = scan_text(path, VideoError, "a folder of pictures needs the list of their times")
    rows = _list_rows(path, scan.head)
    if rows is None:
        return _in_order(path)
    time_ns, listed, total, dropped = rows
    place = _place(path.parent, listed)
    names = [_join(place, name, path) for name in listed]
    there = _existing(path.parent, names)
    dropped["picture is missing"] += int((~there).sum())
    return _rising(
        path, time_ns[there], [name for name, seen in zip(names, there, strict=True) if seen], total, dropped
    )


def _rising(path: Path, time_ns: Int64, names: list[str], rows: int, dropped: Counter[str]) -> PictureList:
    keep = keep_rising(time_ns, path, dropped)
    if not keep.any():
        raise VideoError(f"{label(path)}: none of its {rows} rows has a picture", hint="copy the pictures too")
    base = path if path.is_dir() else path.parent
    kept = tuple(name for name, good in zip(names, keep, strict=True) if good)
    return PictureList(base, time_ns[keep], kept, rows, dict(+dropped))


# ── lists ────────────────────────────────────────────────────────────────────────────────────────────────────────


def _list_rows(path: Path, head: str) -> tuple[Int64, list[str], int, Counter[str]] | None:
    """(times, names, rows, dropped) of a list; None if its rows have no names. Raises VideoError, ClockError."""
    lines = [line.strip() for line in head.replace('"', "").splitlines()]
    lines = [line for line in lines if line and not line.startswith("#")]
    separator = "," if any("," in line for line in lines[:2]) else r"\s+"
    row = next((re.split(separator, line) for line in lines if re.match(r"[+-]?\d", line)), [])
    fields = [field.strip().lower() for field in row]
    column = next((i for i, field in enumerate(fields) if field.endswith(SUFFIXES)), None)
    if column is None:
        return None
    if column >= MAX_FIELDS:
        text = f"{label(path)}: the picture's name is field {column + 1} of its row, at most {MAX_FIELDS} are read"
        raise VideoError(text, hint="write a line time,name for each picture")
    clock = 1 if column == 0 else 0
    dropped: Counter[str] = Counter()
    times: list[Int64] = [np.zeros(0, np.int64)]
    names: list[str] = []
    rows = 0
    for chunk in text_chunks(path, separator):
        time_ns, good = exact_times_ns(chunk[clock], path)
        entries = chunk[column].str.strip()
        named = entries.str.lower().str.endswith(SUFFIXES).to_numpy()
        blank = ((chunk[0].str.strip() == "") | chunk[0].str.startswith("#")).to_numpy()
        head_rows = ~good & ~named
        rows += int((~blank & ~head_rows).sum())
        dropped["cut or unreadable row"] += int((~blank & ~head_rows & ~(good & named)).sum())
        times.append(time_ns[good & named])
        names += entries[good & named].tolist()
    return np.concatenate(times), names, rows, dropped


def _in_order(path: Path) -> PictureList:
    """Timestamps without names: row i belongs to the i-th picture in the order of the numbers in the file names."""
    stamps = read_frame_timestamps(path)
    place = next((place for place in PLACES if _pictures(path.parent / place)), "")
    names = sorted(_pictures(path.parent / place), key=_natural)
    if len(names) != stamps.rows or len(names) != len(stamps.time_ns):
        text = f"{label(path)}: {len(stamps.time_ns)} of {stamps.rows} stamps are usable, for {len(names)} pictures"
        raise ClockError(text, hint="give one stamp per picture, or a list with the pictures' names")
    joined = [str(PurePosixPath(place) / name) for name in names]
    return PictureList(path.parent, stamps.time_ns, tuple(joined), stamps.rows, stamps.dropped)


def _from_names(folder: Path) -> PictureList:
    names = [name for name in _pictures(folder) if INTEGER.fullmatch(Path(name).stem)]
    if not names:
        text = f"{label(folder)}: is a folder without pictures named by their time in nanoseconds"
        raise VideoError(text, hint="list times and names in data.csv")
    names.sort(key=lambda name: int(Path(name).stem))
    times = np.array([int(Path(name).stem) for name in names], np.int64)
    return _rising(folder, times, names, len(names), Counter())


def _pictures(folder: Path) -> list[str]:
    """Names of a folder's regular files with a picture's suffix, sorted."""
    try:
        if is_remote(folder):
            return [place.name for place in folder.iterdir() if place.name.lower().endswith(SUFFIXES)]
        with os.scandir(folder) as entries:
            return sorted(e.name for e in entries if e.name.lower().endswith(SUFFIXES) and e.is_file())
    except (OSError, ValueError):
        return []


def _natural(name: str) -> list[Any]:
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]


def _place(base: Path, names: list[str]) -> str:
    """The folder of the listed pictures: the list's own, or one of PLACES."""
    for name in names[:20]:
        for place in ("data", *PLACES):
            if _is_inside(name) and _is_file(base / place / name):
                return place
    return ""


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a name too long
        return False


def _is_inside(name: str) -> bool:
    parts = PurePosixPath(name).parts
    elsewhere = name.startswith(("/", "~")) or re.match(r"[A-Za-z]:", name) or set(name) & set("\\\0")
    return bool(parts) and not elsewhere and ".." not in parts


def _join(place: str, name: str, path: Path) -> str:
    if not _is_inside(name):
        text = f"{label(path)}: picture {name[:60]!r} lies outside the folder"
        raise VideoError(text, hint="write names relative to the list's folder, without .. and without drives")
    return str(PurePosixPath(place) / name)


def _existing(base: Path, names: list[str]) -> Mask:
    """(n,) which names are regular files, listing each folder once."""
    inside = {folder: set(_pictures(base / folder)) for folder in {str(PurePosixPath(n).parent) for n in names}}
    parts = [PurePosixPath(name) for name in names]
    return np.array([part.name in inside[str(part.parent)] for part in parts], bool)


# ── pixels ───────────────────────────────────────────────────────────────────────────────────────────────────────


def decode_picture(path: Path) -> NDArray[np.uint8] | None:
    """RGB (h, w, 3) or grey (h, w), 8 bits, rounded, as stored; None if the file cannot be decoded."""
    try:
        size = require_regular_file(path, VideoError)
        data = path.read_bytes() if size <= MAX_BYTES else b""
    except (OSError, CaptureError):
        return None
    if not data or _is_huge(data):
        return None
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    if picture is None or picture.dtype not in (np.uint8, np.uint16):
        return None
    if picture.dtype == np.uint16:
        picture = np.rint(picture / np.float32(SIXTEEN_BITS)).astype(np.uint8)
    if picture.ndim == 2 or picture.shape[2] == 1:
        return np.asarray(picture.reshape(picture.shape[:2]), np.uint8)
    return np.ascontiguousarray(picture[..., 2::-1], np.uint8)


def _is_huge(data: bytes) -> bool:
    """Whether a PNG declares a side above MAX_SIDE_PX: a few bytes can declare any size."""
    if not data.startswith(PNG_SIGNATURE):
        return False
    return max(int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")) > MAX_SIDE_PX


def first_size(found: PictureList, path: Path) -> tuple[int, int]:
    """(width, height) of the first picture that can be decoded. Raises VideoError if none of the first can."""
    for name in found.names[:10]:
        picture = decode_picture(found.base / name)
        if picture is not None:
            return picture.shape[1], picture.shape[0]
    hint = "copy the pictures again"
    raise VideoError(f"{label(path)}: {found.names[0]} and those after it cannot be decoded", hint=hint)


def read_pictures(
    base: Path, names: tuple[str, ...], size: tuple[int, int], frames: Iterable[int], *, gray: bool
) -> Iterator[tuple[int, NDArray[np.uint8] | None]]:
    """Stream (frame index, picture) of ``frames``, RGB or grey; None: missing, not decodable, or of another size."""
    for frame in frames:
        if not 0 <= frame < len(names):
            continue
        picture = decode_picture(base / names[frame])
        if picture is None or (picture.shape[1], picture.shape[0]) != size:
            yield frame, None
        else:
            yield frame, luma_of(picture) if gray else _to_rgb(picture)


def _to_rgb(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return picture if picture.ndim == 3 else np.asarray(cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB), np.uint8)
