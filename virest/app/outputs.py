"""Output files: written atomically, JSON without NaN, errors with a hint."""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import secrets
import unicodedata
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest.app.png import png_bytes
from virest.capture.location import RemotePath, is_remote, locate
from virest.errors import OutputError, RestorationError

UNPRINTABLE = ("Cc", "Zl", "Zp")
"""Unicode categories of control characters and line separators."""
SIGNIFICANT_DIGITS = 10
"""A microsecond in an hour; digits beyond differ between processors."""


_HINTS = {
    errno.ENOSPC: "free some space there, then repeat the command (process: with --resume)",
    errno.EDQUOT: "your quota is exhausted; free some space, then repeat the command (process: with --resume)",
    errno.EROFS: "the disk is read-only; choose another folder with --out",
    errno.EACCES: "no permission to write there; choose another folder with --out",
    errno.EPERM: "no permission to write there; choose another folder with --out",
    errno.ENOTDIR: "part of this path is a file; choose another folder with --out",
    errno.EEXIST: "this path is a file; choose another folder with --out",
    errno.ENAMETOOLONG: "choose a shorter name",
}


def output_error(path: Path, error: OSError) -> OutputError:
    """An operating-system error as an OutputError with a hint."""
    hint = _HINTS.get(error.errno or 0, "check the folder given to --out")
    return OutputError(f"{path}: cannot be written: {error.strerror or error}", hint=hint)


def write_whole(path: Path, data: bytes) -> None:
    """Write a file atomically. Raises OutputError."""
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


def require_no_input(path: Path, inputs: Iterable[Path], option: str = "--out") -> None:
    """Raise OutputError if the output would replace a file of the recording, whatever --overwrite allows."""
    if (
        not is_remote(path)
        and path.is_file()
        and any(not is_remote(f) and f.is_file() and path.samefile(f) for f in inputs)
    ):
        raise OutputError(f"{path}: belongs to the recording", hint=f"name another file by {option}")


def require_writable(folder: Path, option: str = "--out") -> None:
    """Raise OutputError, before any work, if a folder, or the nearest existing one above it, takes no files."""
    if is_remote(folder):
        return
    place = next((place for place in (folder.absolute(), *folder.absolute().parents) if place.exists()), None)
    if place is None:
        return
    hint = f"choose another folder with {option}"
    if not place.is_dir():
        raise OutputError(f"{folder}: {'is' if place == folder.absolute() else f'{place} is'} a file", hint=hint)
    if not os.access(place, os.W_OK | os.X_OK):
        raise OutputError(f"{folder}: no permission to write in {place}, or the disk is read-only", hint=hint)


def require_file(path: Path, *, overwrite: bool, option: str = "--out") -> None:
    """Raise OutputError, before any work, if a file could not be written there; option: the one that chose it."""
    if path.is_dir():
        raise OutputError(f"{path}: is a folder", hint=f"{option} takes a file")
    if not path.absolute().parent.is_dir():
        raise OutputError(f"{path}: its folder does not exist", hint=f"create it, or choose another path by {option}")
    if (path.exists() or path.is_symlink()) and not overwrite:
        raise OutputError(f"{path}: exists already", hint=f"name another by {option}, or pass --overwrite")
    require_writable(path.absolute().parent, option)


def write_picture(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write an RGB picture as PNG."""
    try:
        data = png_bytes(picture)
    except ValueError as error:
        raise RestorationError(f"{path.name}: cannot be encoded: {error}") from error
    write_whole(path, data)


def plain(value: Any) -> Any:
    """A value ready for JSON: NaN as null, infinity as ``"inf"``, floats to 10 digits, arrays as lists."""
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
    """One record as one line of JSON."""
    return json.dumps(plain(value), allow_nan=False)


def json_text(value: dict[str, Any], indent: int = 2) -> str:
    """One record as the text of a JSON file."""
    return json.dumps(plain(value), allow_nan=False, indent=indent) + "\n"


def file_facts(path: Path) -> dict[str, Any]:
    """Name, size and sha256 of an input file."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return {"file": path.name, "bytes": path.stat().st_size, "sha256": digest}


def resolved(place: str | os.PathLike[str]) -> str:
    """A path with links resolved; a remote address unchanged."""
    found = locate(place)
    return str(found) if is_remote(found) else os.path.realpath(found)


def capture_name(path: str) -> str:
    """The name of a capture's output folder: the last part of its path, ``.`` and ``..`` resolved.

    Raises OutputError for a name that could not be a plain folder name.
    """
    place = locate(path)
    name = place.name if is_remote(place) else os.path.basename(os.path.abspath(place))
    if not name or name in (".", "..") or any(unicodedata.category(c) in UNPRINTABLE for c in name) or "/" in name:
        raise OutputError(f"{path!r}: {name!r} cannot name an output folder", hint="rename the capture's folder")
    return name
