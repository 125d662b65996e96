"""Where files lie: a folder of this machine, or an address such as ``s3://bucket/trips/one`` that fsspec opens.

`locate` is the one door.  It gives a plain `Path` for what is local, ``file://`` included, so that local files are
read as ever.  For the rest it gives a `RemotePath`, which has those methods of `Path` that this program uses.  An
object store knows no folders: one without files is not there, and making one is nothing to do.  A file is written by
one request, so it appears whole or not at all.
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

from virest.errors import SettingsError, VideoError

ADDRESS = re.compile(r"([A-Za-z][A-Za-z0-9+.\-]*)://(.*)", re.DOTALL)
HERE = ("file", "local")
EXTRA = "pip install 'virest[cluster]'"
BLOCK_BYTES = 1 << 18
"""What one request for a movie's bytes brings: some eight frames of a phone's movie."""
KEPT_BLOCKS = 32
"""Blocks of a movie that stay at hand, for a reader that goes to and fro between the table of contents and the data."""
STREAM_BYTES = 1 << 23
"""What one request brings where a file is read from end to end."""
AT_ONCE = 64
"""Small files fetched together."""


def locate(text: str | os.PathLike[str]) -> Path:
    """The place that a path or an address names; to the reader of types every place is a `Path`.

    Raises SettingsError for an address that no installed package opens.
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
            f"{text}: is not a full address", hint=f"write {protocol}://BUCKET/FOLDER, without . and .."
        )
    return cast(Path, RemotePath(protocol, PurePosixPath("/", rest).as_posix().lstrip("/")))


def unreachable(path: RemotePath, fault: OSError) -> VideoError:
    """The error of an address that gives no bytes: no damage of the recording, so no frame is to be called failed."""
    text = f"{path}: cannot be reached ({fault.strerror or fault})"
    return VideoError(text, hint="check the network and the store, then continue with --resume", unreachable=True)


def is_unreachable(error: BaseException) -> bool:
    """Whether an error is one of :func:`unreachable`."""
    return isinstance(error, VideoError) and bool(error.facts.get("unreachable"))


def is_remote(path: os.PathLike[str]) -> bool:
    """Whether a place lies behind an address."""
    return isinstance(path, RemotePath)


@lru_cache
def _file_system(protocol: str) -> Any:
    """What opens addresses of a kind; nothing that it lists is kept, since others write there too."""
    try:
        import fsspec

        return fsspec.filesystem(protocol, use_listings_cache=False)
    except ImportError as fault:
        text = f"{protocol}:// needs a package that is not installed ({' '.join(str(fault).split())[:80]})"
        raise SettingsError(text, hint=EXTRA) from None
    except ValueError:
        text = f"{protocol}://: no such kind of address"
        raise SettingsError(text, hint="s3://, gs:// and file:// are known") from None


@contextmanager
def _plain_errors(path: RemotePath) -> Iterator[None]:
    """Whatever a store's package raises becomes an OSError with its number and one line of text."""
    try:
        yield
    except (FileNotFoundError, NotADirectoryError):
        raise FileNotFoundError(errno.ENOENT, "no such file", str(path)) from None
    except PermissionError as fault:
        raise PermissionError(errno.EACCES, _line(fault) or "access denied", str(path)) from None
    except Exception as fault:  # botocore, aiohttp and google each have a tree of their own
        raise OSError(errno.EIO, f"{type(fault).__name__}: {_line(fault)}", str(path)) from None


def _line(fault: BaseException) -> str:
    return " ".join(str(fault).split())[:200]


@dataclass(frozen=True, slots=True)
class RemotePath:
    """A place behind an address; plain data, so that it travels to a worker."""

    protocol: str
    key: str
    """Bucket and names, parted by /, none of them empty."""

    def __str__(self) -> str:
        return f"{self.protocol}://{self.key}"

    def __fspath__(self) -> str:
        """The address, which pandas opens by itself."""
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
        """The folder; a bucket is its own."""
        return RemotePath(self.protocol, self.key.rpartition("/")[0] or self.key)

    def with_name(self, name: str) -> RemotePath:
        """A neighbour."""
        return self.parent / name

    def absolute(self) -> RemotePath:
        """Itself: an address is never relative."""
        return self

    def resolve(self, *, strict: bool = False) -> RemotePath:
        """Itself; with ``strict`` it has to be there."""
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
        """Whether a file, or a folder with files, is there."""
        return self.is_file() or self.is_dir()

    def is_file(self) -> bool:
        """Whether a file is there."""
        return self._has_mode(stat.S_IFREG)

    def is_dir(self) -> bool:
        """Whether files lie below."""
        return self._has_mode(stat.S_IFDIR)

    def is_symlink(self) -> bool:
        """Never."""
        return False

    def iterdir(self) -> Iterator[RemotePath]:
        """What lies directly below; nothing, where nothing is there."""
        try:
            with _plain_errors(self):
                found = self._store.ls(self.key, detail=False)
        except FileNotFoundError:
            return
        for name in sorted(found):
            if (place := str(name).strip("/")) != self.key:
                yield self / PurePosixPath(place).name

    # ── reading ──────────────────────────────────────────────────────────────────────────────────────────────────

    def open(self, mode: str = "rb") -> io.RawIOBase:
        """A stream for reading from end to end."""
        if mode != "rb":
            raise ValueError(f"{self}: opened with {mode!r}; write_whole writes")
        return _Stream(self, block_size=STREAM_BYTES, cache_type="readahead")

    def open_at_random(self) -> io.RawIOBase:
        """A stream for a reader that jumps: a few blocks are kept, and no more is asked for than is read."""
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
        """Put a file there by one request, over what was there."""
        with _plain_errors(self):
            self._store.pipe_file(self.key, data)

    def mkdir(self, *, parents: bool = False, exist_ok: bool = False) -> None:
        """Nothing to do: a folder is there as soon as a file is."""

    def rmdir(self) -> None:
        """Nothing to do: a folder goes with its last file."""

    def unlink(self, *, missing_ok: bool = False) -> None:
        """Remove the file."""
        try:
            with _plain_errors(self):
                self._store.rm_file(self.key)
        except FileNotFoundError:
            if not missing_ok:
                raise


class _Stream(io.RawIOBase):
    """A store's stream, whose faults are OSErrors."""

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
    """The files' contents, in order; of those behind an address some are fetched together."""
    waiting = iter(paths)
    while batch := list(islice(waiting, AT_ONCE)):
        if is_remote(batch[0]):
            yield from _fetch([cast(RemotePath, path) for path in batch])
        else:
            yield from (path.read_bytes() for path in batch)


def _fetch(paths: list[RemotePath]) -> Iterator[bytes]:
    if len(paths) == 1:  # for one, fsspec gives the bytes themselves
        yield paths[0].read_bytes()
        return
    with _plain_errors(paths[0]):
        found = paths[0]._store.cat([path.key for path in paths])
    yield from (bytes(found[path.key]) for path in paths)


def remove_files(paths: Sequence[Path]) -> None:
    """Remove files, those behind an address together; one that is gone already is as good."""
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
