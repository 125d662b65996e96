"""Single files of a run's output: each appears whole or not at all, JSON without NaN, errors with a hint."""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import secrets
import unicodedata
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest.app.png import png_bytes
from virest.capture.location import RemotePath, is_remote, locate
from virest.errors import OutputError, RestorationError

UNPRINTABLE = ("Cc", "Zl", "Zp")
"""Control characters and separators of lines, by their Unicode category."""
SIGNIFICANT_DIGITS = 10


_HINTS = {
    errno.ENOSPC: "free some space there, then go on (a run with --resume)",
    errno.EDQUOT: "your quota is used up; free some space, then go on (a run with --resume)",
    errno.EROFS: "choose a folder that can be written with --out",
    errno.EACCES: "choose a folder that you may write with --out",
    errno.EPERM: "choose a folder that you may write with --out",
    errno.ENOTDIR: "a part of this path is a file; choose another folder with --out",
    errno.EEXIST: "this path is a file; choose another folder with --out",
    errno.ENAMETOOLONG: "choose a shorter name",
}


def output_error(path: Path, error: OSError) -> OutputError:
    """The system's complaint as one of ours, with what to do next."""
    hint = _HINTS.get(error.errno or 0, "check the folder given to --out")
    return OutputError(f"{path}: cannot be written: {error.strerror or error}", hint=hint)


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that it appears whole or not at all. Raises OutputError."""
    if isinstance(path, RemotePath):
        try:
            path.write_whole(data)
        except OSError as error:
            raise output_error(path, error) from error
        return
    part = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")
    try:
        _write_bytes(part, data)
        os.replace(part, path)
    except BaseException as error:
        with suppress(OSError):
            part.unlink()
        if isinstance(error, OSError):
            raise output_error(path, error) from error
        raise


def _write_bytes(path: Path, data: bytes) -> None:
    with path.open("xb") as file:
        file.write(data)


def write_picture(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write an RGB picture as PNG."""
    try:
        data = png_bytes(picture)
    except ValueError as error:
        raise RestorationError(f"{path.name}: cannot be encoded: {error}") from error
    write_whole(path, data)


def plain(value: Any) -> Any:
    """A value as JSON takes it: no NaN (null), no infinity (``"inf"``), floats to ten digits, arrays as lists."""
    match value:
        case bool() | str() | int() | None:
            return value
        case dict():
            return {str(key): plain(item) for key, item in value.items()}
        case list() | tuple() | set():
            return [plain(item) for item in value]
        case float():
            return _plain_float(value)
        case np.ndarray() | np.generic():
            return plain(value.tolist())
        case _:
            return str(value)


def _plain_float(value: float) -> float | str | None:
    if math.isnan(value):
        return None
    if math.isinf(value):
        return "inf" if value > 0 else "-inf"
    return float(f"{value:.{SIGNIFICANT_DIGITS}g}")


def json_line(value: dict[str, Any]) -> str:
    """One record on one line."""
    return json.dumps(plain(value), allow_nan=False)


def file_facts(path: Path) -> dict[str, Any]:
    """Name, size and sha256 of an input file."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return {"file": path.name, "bytes": path.stat().st_size, "sha256": digest}


def resolved(place: str | os.PathLike[str]) -> str:
    """Where a path really lies, links followed; an address as it is."""
    found = locate(place)
    return str(found) if is_remote(found) else os.path.realpath(found)


def capture_name(path: str) -> str:
    """The name of a capture's output folder: the last part of its path, ``.`` and ``..`` resolved.

    Raises OutputError for a name that could not be a plain folder name.
    """
    place = locate(path)
    name = place.name if is_remote(place) else os.path.basename(os.path.abspath(place))
    if not name or name in (".", "..") or any(unicodedata.category(c) in UNPRINTABLE for c in name) or "/" in name:
        raise OutputError(
            f"{path!r}: no usable name for an output folder: {name!r}", hint="rename the capture's folder"
        )
    return name
