"""The movie: the index of its frames, and their pixels.

A frame is identified by its presentation time (PTS), never by counting.  Pictures are returned as stored: the display
rotation is not applied, so that the profile's intrinsics hold.
"""

from __future__ import annotations

import ctypes
import errno
import logging
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from math import inf
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.capture.files import label, require_regular_file
from virest.capture.frame_coding import FrameCoding, frame_coding
from virest.capture.location import RemotePath, unreachable
from virest.capture.pictures import (
    MAX_SIDE_PX,
    PictureList,
    first_size,
    is_picture_source,
    read_picture_list,
    read_pictures,
)
from virest.capture.pixels import to_gray, to_rgb
from virest.errors import VideoError, printable

log = logging.getLogger(__name__)

MAX_PIXELS = 40_000_000
"""8K and a margin; also checked against the coded pictures' own size before memory is allocated."""
MAX_FRAMES = 2_000_000
"""18 hours at 30 frames/s."""
MAX_BLOCK_BYTES = 1 << 28
"""Largest block of memory that FFmpeg may allocate: an index can declare millions of frames in a few bytes."""
CONTAINER = "mov"
"""MP4, QuickTime and 3GP.  Fixed, so that a playlist named like a movie cannot make the reader open other files."""
OTHER_MOVIES: dict[str, Callable[[bytes], bool]] = {
    "a Matroska or WebM movie": lambda head: head.startswith(b"\x1a\x45\xdf\xa3"),
    "an AVI movie": lambda head: head[:4] == b"RIFF" and head[8:12] == b"AVI ",
}
"""Unsupported containers, by their first bytes."""
OWN_SUFFIXES = (".mp4", ".m4v", ".mov", ".3gp")
MOVIE_SUFFIXES = (*OWN_SUFFIXES, ".mkv", ".webm", ".avi")
CENTRED_CHROMA = {"mjpeg", "mpeg1video"}
"""Codecs whose chroma samples lie between two columns of luma."""
HDR_CURVES = {16: "PQ (SMPTE ST 2084)", 18: "HLG (ARIB STD-B67)"}
"""Transfer curves that no supported response curve describes."""


@dataclass(frozen=True, slots=True)
class MovieIndex:
    """The index of a movie's frames, in presentation order."""

    width: int
    """Pixels of a stored row."""
    height: int
    time_base: Fraction
    """Seconds of one tick."""
    pts_ticks: NDArray[np.int64]
    """(n,) strictly rising."""
    keyframes: tuple[int, ...]
    """Frame indices that the decoder can start from."""
    keyframe_dts_ticks: tuple[int, ...]
    """Decoding time of each of them, for seeking."""
    codec: str = ""
    declared_frames: int = 0
    """Number of frames in the container's index; more than ``len``: the file is truncated. 0: not given."""
    repeated_pts: int = 0
    """Access units dropped because another one has the same time."""
    pictures: tuple[str, ...] = ()
    """Of a folder of pictures: their paths, relative to the folder or the list's folder; empty for a movie."""
    bits_per_px: float = inf
    """The encoder's mean bits per pixel of a frame; inf for picture files."""
    packet_bytes: NDArray[np.int64] | None = None
    """(n,) size of each coded frame; None for pictures."""

    def __len__(self) -> int:
        return len(self.pts_ticks)

    @property
    def pts_s(self) -> Array:
        """(n,) presentation times, seconds from the first frame; exact to 2^-53 of the value."""
        ticks = self.pts_ticks - self.pts_ticks[0]
        return ticks * self.time_base.numerator / self.time_base.denominator

    @property
    def pts_ns(self) -> NDArray[np.int64]:
        """(n,) presentation times, whole nanoseconds from the first frame, rounded."""
        return np.rint(self.pts_s * 1e9).astype(np.int64)

    def keyframe_before(self, frame: int) -> int:
        """Position in ``keyframes`` of the last one at or before ``frame``; 0 if there is none."""
        return max(int(np.searchsorted(self.keyframes, frame, side="right")) - 1, 0)


def probe_movie(path: Path) -> MovieIndex:
    """Index the movie by its packets, without decoding; or the pictures of a list or a folder.

    Raises VideoError for a missing, truncated or foreign file, no video stream, and impossible sizes.
    """
    if is_picture_source(path):
        return index_pictures(path, read_picture_list(path))
    size = require_regular_file(path, VideoError, _missing_movie_hint(path))
    if size == 0:
        raise VideoError(f"{label(path)}: is empty", hint="the recording was not stopped cleanly, or the copy failed")
    try:
        with _opened(path) as container:
            stream = _video_stream(container, path)
            width, height = stream.codec_context.width, stream.codec_context.height
            _check_size(width, height, path)
            _check_curve(stream, path)
            return _index(container, stream, width, height, path)
    except (av.FFmpegError, UnicodeError, ValueError) as fault:
        raise VideoError(
            f"{label(path)}: cannot be opened as a movie ({_reason(fault)}, {size} bytes)", hint=_unopened_hint(path)
        ) from None


def _unopened_hint(path: Path) -> str:
    """The hint for a file that is not a readable MP4, by its first bytes."""
    try:
        with path.open("rb") as stream:
            head = stream.read(16)
    except OSError:
        head = b""
    kind = next((name for name, is_it in OTHER_MOVIES.items() if is_it(head)), None)
    if kind is not None:
        return f"it is {kind}; put the same stream into an MP4: ffmpeg -i FILE -c copy movie.mp4"
    return "it has no index (moov) if the recorder was not stopped cleanly; stop it, then copy again"


def _missing_movie_hint(path: Path) -> str:
    """The hint for a missing movie.mp4, with the name of another movie in the folder."""
    needs = "a capture needs its movie.mp4"
    try:
        if isinstance(path, RemotePath) or path.exists():
            return needs
        if path.is_symlink():
            return "it is a link to a file that is not there; put the movie itself in its place"
        others = sorted(file.name for file in path.parent.iterdir() if file.suffix.lower() in MOVIE_SUFFIXES)
    except (OSError, ValueError):
        return needs
    if not others:
        return needs
    shown = printable(others[0][:60])
    what = "rename it" if Path(others[0]).suffix.lower() in OWN_SUFFIXES else "ffmpeg -i FILE -c copy movie.mp4"
    return f"{needs}; is it '{shown}'? {what}"


def _check_curve(stream: Any, path: Path) -> None:
    """Raise VideoError for HDR movies: read with a standard curve, their light would be wrong throughout."""
    curve = HDR_CURVES.get(int(stream.codec_context.color_trc or 0))
    if curve is not None:
        raise VideoError(
            f"{label(path)}: is an HDR movie with the transfer curve {curve}, which is not supported",
            hint="film with HDR off, or convert it to BT.709, keeping its timestamps",
        )


def index_pictures(path: Path, found: PictureList) -> MovieIndex:
    """Index listed pictures: ticks of 1 ns, every picture a key frame."""
    width, height = first_size(found, path)
    _check_size(width, height, path)
    every = tuple(range(len(found.names)))
    codec = Path(found.names[0]).suffix.lstrip(".").lower()
    return MovieIndex(width, height, Fraction(1, 10**9), found.time_ns, every, every, codec, pictures=found.names)


def read_frames(
    path: Path, index: MovieIndex, first: int, last: int, coding: dict[int, FrameCoding] | None = None
) -> Iterator[tuple[int, NDArray[np.uint8] | None]]:
    """Stream frames ``first`` to ``last`` (both included, ends clipped) as (frame index, RGB (h, w, 3) or None).

    None: the frame, or one that it depends on, cannot be decoded; later ones still follow.  One frame is in memory.
    coding: filled with how each frame was coded, if the decoder reports it, before the frame is yielded.
    """
    yield from _read(path, index, range(max(first, 0), min(last, len(index) - 1) + 1), to_rgb, coding)


def read_gray(
    path: Path, index: MovieIndex, frames: Iterable[int], coding: dict[int, FrameCoding] | None = None
) -> Iterator[tuple[int, NDArray[np.uint8] | None]]:
    """Stream the luma of ``frames`` (rising order) as (frame index, (h, w) or None), 0 black and 255 white.

    coding: as of :func:`read_frames`.
    """
    yield from _read(path, index, frames, to_gray, coding)


def read_decodable_gray(
    path: Path, index: MovieIndex, frames: Iterable[int], coding: dict[int, FrameCoding] | None = None
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """As :func:`read_gray`, without the frames that cannot be decoded."""
    return ((number, picture) for number, picture in read_gray(path, index, frames, coding) if picture is not None)


@dataclass(frozen=True, slots=True)
class GrayReader:
    """Reads the luma of requested frames; plain data that a worker process can use by itself."""

    movie: Path
    index: MovieIndex

    @classmethod
    def of(cls, movie: Path) -> GrayReader:
        """A reader of this movie."""
        return cls(movie, probe_movie(movie))

    def __call__(self, frames: Iterable[int]) -> Iterator[tuple[int, NDArray[np.uint8] | None]]:
        """As `read_gray`."""
        return read_gray(self.movie, self.index, frames)


# ── the container ────────────────────────────────────────────────────────────────────────────────────────────────


def _reason(fault: Exception) -> str:
    if getattr(fault, "errno", None) == errno.ENOMEM:
        return "a part of it claims an impossible size"  # FFmpeg has not allocated it, see _bound_memory
    return (getattr(fault, "strerror", None) or str(fault)).lower()


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The movie's container, with bounds on memory.

    Raises `unreachable` for a URL that gives no bytes, since the movie may be sound.
    """
    _bound_memory()
    bounds = {"max_pixels": str(MAX_PIXELS)}
    if isinstance(path, RemotePath):
        try:
            with (
                path.open_at_random() as stream,
                av.open(stream, format=CONTAINER, metadata_errors="replace", options=bounds) as container,
            ):
                yield container
        except av.FFmpegError:
            raise
        except OSError as fault:
            raise unreachable(path, fault) from None
        return
    # An absolute path cannot be mistaken for a protocol ("http:...").
    with av.open(str(path.absolute()), format=CONTAINER, metadata_errors="replace", options=bounds) as container:
        yield container


@lru_cache(maxsize=1)
def _bound_memory() -> bool:
    """Have FFmpeg refuse blocks above MAX_BLOCK_BYTES; False if its library cannot be found (not Linux)."""
    try:
        mapped = Path("/proc/self/maps").read_text().splitlines()
        libraries = {line.split(maxsplit=5)[-1] for line in mapped if "/libavutil" in line}  # OpenCV brings one too
        for library in libraries:
            ctypes.CDLL(library).av_max_alloc(ctypes.c_size_t(MAX_BLOCK_BYTES))
    except (OSError, AttributeError):
        return False
    return bool(libraries)


def _video_stream(container: Any, path: Path) -> Any:
    if not container.streams.video:
        raise VideoError(f"{label(path)}: has no video stream", hint="is it the movie of this capture?")
    stream = container.streams.video[0]
    if stream.codec_context is None:
        raise VideoError(f"{label(path)}: its video codec is unknown", hint="convert it to H.264, timestamps kept")
    return stream


def _check_size(width: int, height: int, path: Path) -> None:
    if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX and width * height <= MAX_PIXELS):
        text = f"{label(path)}: picture size {width}x{height}; at most {MAX_SIDE_PX} px per side, {MAX_PIXELS} in all"
        raise VideoError(text, hint="is the file damaged?")


def _index(container: Any, stream: Any, width: int, height: int, path: Path) -> MovieIndex:
    rows: list[tuple[int, int, bool, int]] = []
    try:
        for packet in container.demux(stream):
            pts = packet.pts if packet.pts is not None else packet.dts
            if pts is None or packet.is_discard or packet.size == 0:
                continue
            rows.append((pts, packet.dts if packet.dts is not None else pts, packet.is_keyframe, packet.size))
            if len(rows) > MAX_FRAMES:
                raise VideoError(f"{label(path)}: more than {MAX_FRAMES} frames", hint="cut the movie")
    except av.FFmpegError as fault:
        log.warning("%s: reading stopped after %d frames: %s", label(path), len(rows), _reason(fault))
    if not rows:
        hint = "the recording was not stopped cleanly, or the copy is incomplete"
        raise VideoError(f"{label(path)}: has no frames", hint=hint)
    table = np.array(rows, np.int64)
    order = np.argsort(table[:, 0], kind="stable")
    table = table[order]
    fresh = np.concatenate([[True], np.diff(table[:, 0]) > 0])
    kept = table[fresh]
    keys = np.flatnonzero(kept[:, 2])
    return MovieIndex(
        width,
        height,
        Fraction(stream.time_base),
        kept[:, 0].copy(),
        tuple(keys.tolist()),
        tuple(kept[keys, 1].tolist()),
        stream.codec_context.name,
        int(stream.frames or 0),
        int(len(table) - len(kept)),
        bits_per_px=8.0 * float(kept[:, 3].mean()) / (width * height),
        packet_bytes=kept[:, 3].copy(),
    )


# ── decoding ─────────────────────────────────────────────────────────────────────────────────────────────────────


def _read(
    path: Path,
    index: MovieIndex,
    frames: Iterable[int],
    convert: Callable[..., NDArray[np.uint8]],
    coding: dict[int, FrameCoding] | None = None,
) -> Iterator[tuple[int, NDArray[np.uint8] | None]]:
    if index.pictures:
        base, size = path if path.is_dir() else path.parent, (index.width, index.height)
        yield from read_pictures(base, index.pictures, size, frames, gray=convert is to_gray)
        return
    require_regular_file(path, VideoError, _missing_movie_hint(path))
    centred = index.codec in CENTRED_CHROMA
    for run in _runs(index, frames):
        try:
            with _opened(path) as container:
                stream = _video_stream(container, path)
                stream.thread_type = "NONE"
                stream.codec_context.thread_count = 1
                extra = {} if coding is None else {"export_side_data": "venc_params"}
                stream.codec_context.options = {"max_pixels": str(MAX_PIXELS), **extra}
                for frame_index, frame in _in_order(run, _decoded(container, stream, index, run[0])):
                    usable = frame is not None and (frame.width, frame.height) == (index.width, index.height)
                    if usable and coding is not None:
                        found = frame_coding(frame, bool(stream.codec_context.has_b_frames))
                        if found is not None:
                            coding[frame_index] = found
                    yield frame_index, convert(frame, centred=centred) if usable else None
        except (av.FFmpegError, UnicodeError) as fault:
            raise VideoError(f"{label(path)}: cannot be read ({_reason(fault)})", hint="copy the movie again") from None


def _runs(index: MovieIndex, frames: Iterable[int]) -> Iterator[range | list[int]]:
    """Split requested frames where seeking to the next key frame saves decoding."""
    if isinstance(frames, range) and frames.step == 1:
        if len(frames):
            yield frames
        return
    run: list[int] = []
    for frame in sorted({f for f in frames if 0 <= f < len(index)}):
        if run and index.keyframes and index.keyframes[index.keyframe_before(frame)] > run[-1] + 1:
            yield run
            run = []
        run.append(frame)
    if run:
        yield run


def _in_order(wanted: range | list[int], decoded: Iterator[tuple[int, Any]]) -> Iterator[tuple[int, Any]]:
    """Pick the requested frames from the decoded ones; None for a frame that is missing."""
    position = 0
    for frame_index, frame in decoded:
        while position < len(wanted) and wanted[position] < frame_index:
            yield wanted[position], None
            position += 1
        if position == len(wanted):
            return
        if wanted[position] == frame_index:
            yield frame_index, frame
            position += 1
            if position == len(wanted):
                return
    for missing in wanted[position:]:
        yield missing, None


def _decoded(container: Any, stream: Any, index: MovieIndex, first: int) -> Iterator[tuple[int, Any]]:
    """(frame index, frame or None) in presentation order, from the key frame at or before ``first``."""
    if index.keyframes and first > 0:
        container.seek(index.keyframe_dts_ticks[index.keyframe_before(first)], stream=stream, backward=True)
    lookup = {int(ticks): number for number, ticks in enumerate(index.pts_ticks)}
    broken_since: int | None = None
    for packet in _packets(container, stream):
        try:
            frames = stream.decode(packet)
        except av.FFmpegError:
            frames = []
            if packet is not None and packet.pts is not None:
                broken_since = packet.pts if broken_since is None else min(broken_since, packet.pts)
        for frame in frames:
            if frame.pts is None or int(frame.pts) not in lookup:
                continue
            if frame.is_corrupt:
                broken_since = frame.pts if broken_since is None else broken_since
            elif frame.key_frame and broken_since is not None and frame.pts > broken_since:
                broken_since = None
            # Frames after a lost one are predicted from it, hence wrong up to the next key frame.
            lost = broken_since is not None and frame.pts >= broken_since
            yield lookup[int(frame.pts)], None if lost else frame


def _packets(container: Any, stream: Any) -> Iterator[Any]:
    """Packets up to the end of the readable data, then a flush packet: empty, or None after a read error."""
    try:
        yield from container.demux(stream)
    except av.FFmpegError as fault:
        log.warning("the movie's data end prematurely: %s", _reason(fault))
        yield None
