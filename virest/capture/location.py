"""Where files are: a local folder, or a URL such as ``s3://bucket/trips/one`` that fsspec opens.

`locate` is the only entry point.  It returns a plain `Path` for local files, ``file://`` included, and a `RemotePath`
for the rest, which has the methods of `Path` that this program uses.  An object store has no folders: a folder without
files does not exist, and mkdir does nothing.  A file is written by one request, so it appears whole or not at all.
"""

from __future__ import annotations

import errno
import io
import os
import re
import stat
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any, cast

from virest.errors import SettingsError, VideoError, one_line

ADDRESS = re.compile(r"([A-Za-z][A-Za-z0-9+.\-]*)://(.*)", re.DOTALL)
HERE = ("file", "local")
EXTRA = "pip install 'virest[cluster]'"
BLOCK_BYTES = 1 << 18
"""Bytes of a movie that one request fetches: about eight frames of a phone's movie."""
KEPT_BLOCKS = 32
"""Blocks of a movie that are cached, because its reader jumps between the index and the data."""
STREAM_BYTES = 1 << 23
"""Bytes that one request fetches where a file is read from end to end."""
AT_ONCE = 64
"""Small files fetched concurrently."""


def locate(text: str | os.PathLike[str]) -> Path:
    """The location that a path or a URL names; its static type is always `Path`.

    Raises SettingsError for a URL that no installed package opens.
    """
    if isinstance(text, RemotePath | Path):
        return cast(Path, text)
    found = ADDRESS.fullmatch(os.fspath(text))
    if found is None:
        return Path(text)
    protocol, rest = found.group(1).lower(), found.group(2)
    if protocol in HERE:
        return Path(rest)
    _file_system(protocol)
    if not rest.strip("/") or {".", ".."} & set(rest.split("/")):
        raise SettingsError(
            f"{text}: is not a complete URL", hint=f"write {protocol}://BUCKET/FOLDER, without . and .."
        )
    return cast(Path, RemotePath(protocol, PurePosixPath("/", rest).as_posix().lstrip("/")))


def unreachable(path: RemotePath, fault: OSError) -> VideoError:
    """The error of an unreachable URL: the recording may be sound, so no frame counts as failed."""
    text = f"{path}: cannot be reached ({fault.strerror or fault})"
    return VideoError(text, hint="check the network and the store, then continue with --resume", unreachable=True)


def is_unreachable(error: BaseException) -> bool:
    """Whether an error is one of :func:`unreachable`."""
    return isinstance(error, VideoError) and bool(error.facts.get("unreachable"))


def is_remote(path: os.PathLike[str]) -> bool:
    """Whether a location is a URL."""
    return isinstance(path, RemotePath)


@lru_cache
def _file_system(protocol: str) -> Any:
    """The fsspec file system of a protocol; listings are not cached, since others write there too."""
    try:
        import fsspec

        return fsspec.filesystem(protocol, use_listings_cache=False)
    except ImportError as fault:
        text = f"{protocol}:// needs a package that is not installed ({one_line(fault, 80)})"
        raise SettingsError(text, hint=EXTRA) from None
    except ValueError:
        text = f"{protocol}://: unknown protocol"
        raise SettingsError(text, hint="use s3://, gs:// or file://") from None


@contextmanager
def _plain_errors(path: RemotePath) -> Iterator[None]:
    """Turn whatever a store's package raises into an OSError with a number and one line of text."""
    try:
        yield
    except (FileNotFoundError, NotADirectoryError):
        raise FileNotFoundError(errno.ENOENT, "no such file", str(path)) from None
    except PermissionError as fault:
        raise PermissionError(errno.EACCES, one_line(fault) or "access denied", str(path)) from None
    except Exception as fault:  # botocore, aiohttp and google each have their own exceptions
        raise OSError(errno.EIO, f"{type(fault).__name__}: {one_line(fault)}", str(path)) from None


@dataclass(frozen=True, slots=True)
class RemotePath:
    """A location behind a URL; plain data, so that it can be sent to a worker."""

    protocol: str
    key: str
    """Bucket and names, separated by /, none of them empty."""

    def __str__(self) -> str:
        return f"{self.protocol}://{self.key}"

    def __fspath__(self) -> str:
        """The URL, which pandas opens by itself."""
        return str(self)

    def __truediv__(self, name: str | os.PathLike[str]) -> RemotePath:
        return RemotePath(self.protocol, str(PurePosixPath(self.key) / PurePosixPath(str(name).lstrip("/"))))

    def __lt__(self, other: RemotePath) -> bool:
        return str(self) < str(other)

    # ── names ────────────────────────────────────────────────────────────────────────────────────────────────────

    @property
    def name(self) -> str:
        """The last part."""
        return PurePosixPath(self.key).name

    @property
    def stem(self) -> str:
        """The last part without its suffix."""
        return PurePosixPath(self.key).stem

    @property
    def suffix(self) -> str:
        """The last part's suffix, with its dot."""
        return PurePosixPath(self.key).suffix

    @property
    def parent(self) -> RemotePath:
        """The folder; a bucket is its own parent."""
        return RemotePath(self.protocol, self.key.rpartition("/")[0] or self.key)

    def with_name(self, name: str) -> RemotePath:
        """A sibling."""
        return self.parent / name

    def absolute(self) -> RemotePath:
        """Itself: a URL is never relative."""
        return self

    def resolve(self, *, strict: bool = False) -> RemotePath:
        """Itself; with ``strict`` it must exist."""
        if strict:
            self.stat()
        return self

    # ── looking ──────────────────────────────────────────────────────────────────────────────────────────────────

    @property
    def _store(self) -> Any:
        return _file_system(self.protocol)

    def stat(self) -> os.stat_result:
        """Size and kind."""
        with _plain_errors(self):
            facts = self._store.info(self.key)
        mode = stat.S_IFDIR if facts["type"] == "directory" else stat.S_IFREG
        return os.stat_result((mode | 0o644, 0, 0, 1, 0, 0, int(facts.get("size") or 0), 0, 0, 0))

    lstat = stat

    def _has_mode(self, mode: int) -> bool:
        try:
            return stat.S_IFMT(self.stat().st_mode) == mode
        except FileNotFoundError:
            return False

    def exists(self) -> bool:
        """Whether it is a file, or a folder with files."""
        return self.is_file() or self.is_dir()

    def is_file(self) -> bool:
        """Whether it is a file."""
        return self._has_mode(stat.S_IFREG)

    def is_dir(self) -> bool:
        """Whether it is a folder with files."""
        return self._has_mode(stat.S_IFDIR)

    def is_symlink(self) -> bool:
        """Never."""
        return False

    def iterdir(self) -> Iterator[RemotePath]:
        """The direct children; none if there is no such folder."""
        try:
            with _plain_errors(self):
                found = self._store.ls(self.key, detail=False)
        except FileNotFoundError:
            return
        for name in sorted(found):
            if (key := str(name).strip("/")) != self.key:
                yield self / PurePosixPath(key).name

    # ── reading ──────────────────────────────────────────────────────────────────────────────────────────────────

    def open(self, mode: str = "rb") -> io.RawIOBase:
        """A stream for reading from end to end."""
        if mode != "rb":
            raise ValueError(f"{self}: opened with {mode!r}; write_whole writes")
        return _Stream(self, block_size=STREAM_BYTES, cache_type="readahead")

    def open_at_random(self) -> io.RawIOBase:
        """A stream for random access: a few blocks are cached, and nothing beyond what is read is fetched."""
        blocks = {"maxblocks": KEPT_BLOCKS}
        return _Stream(self, block_size=BLOCK_BYTES, cache_type="blockcache", cache_options=blocks)

    def read_bytes(self) -> bytes:
        """The whole file."""
        with _plain_errors(self):
            return bytes(self._store.cat_file(self.key))

    def read_text(self, encoding: str = "utf-8") -> str:
        """The whole file as text."""
        return self.read_bytes().decode(encoding)

    # ── writing ──────────────────────────────────────────────────────────────────────────────────────────────────

    def write_whole(self, data: bytes) -> None:
        """Write the file by one request, replacing what was there."""
        with _plain_errors(self):
            self._store.pipe_file(self.key, data)

    def mkdir(self, *, parents: bool = False, exist_ok: bool = False) -> None:
        """Does nothing: a folder exists as soon as a file in it does."""

    def rmdir(self) -> None:
        """Does nothing: a folder disappears with its last file."""

    def unlink(self, *, missing_ok: bool = False) -> None:
        """Remove the file."""
        try:
            with _plain_errors(self):
                self._store.rm_file(self.key)
        except FileNotFoundError:
            if not missing_ok:
                raise


class _Stream(io.RawIOBase):
    """A store's stream that raises only OSError."""

    def __init__(self, path: RemotePath, **options: Any) -> None:
        super().__init__()
        self._path = path
        with _plain_errors(path):
            self._inner = path._store.open(path.key, "rb", **options)

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        with _plain_errors(self._path):
            data = self._inner.read(len(buffer))
        buffer[: len(data)] = data
        return len(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        with _plain_errors(self._path):
            return int(self._inner.seek(offset, whence))

    def tell(self) -> int:
        return int(self._inner.tell())

    def close(self) -> None:
        if not self.closed:
            self._inner.close()
        super().close()


# ── many files ───────────────────────────────────────────────────────────────────────────────────────────────────


def read_each(paths: Iterable[Path]) -> Iterator[bytes]:
    """The files' contents, in order; remote files are fetched AT_ONCE at a time."""
    waiting = iter(paths)
    while batch := list(islice(waiting, AT_ONCE)):
        if is_remote(batch[0]):
            yield from _fetch([cast(RemotePath, path) for path in batch])
        else:
            yield from (path.read_bytes() for path in batch)


def _fetch(paths: list[RemotePath]) -> Iterator[bytes]:
    if len(paths) == 1:  # for a single path, fsspec returns bytes instead of a dict
        yield paths[0].read_bytes()
        return
    with _plain_errors(paths[0]):
        found = paths[0]._store.cat([path.key for path in paths])
    yield from (bytes(found[path.key]) for path in paths)


def remove_files(paths: Sequence[Path]) -> None:
    """Remove files, remote ones together; files that are already gone are ignored."""
    remote = [cast(RemotePath, path) for path in paths if is_remote(path)]
    for path in paths:
        if not is_remote(path):
            path.unlink(missing_ok=True)
    if remote:
        try:
            _remove_together(remote)
        except FileNotFoundError:
            for place in remote:
                place.unlink(missing_ok=True)


def _remove_together(paths: list[RemotePath]) -> None:
    with _plain_errors(paths[0]):
        paths[0]._store.rm([path.key for path in paths])
