"""A video of a run: restored frames, or recorded beside restored ones, as MP4 with the movie's stamps and rotation."""

from __future__ import annotations

import os
import secrets
import struct
from collections.abc import Iterable, Iterator
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

from virest.app.outputs import output_error
from virest.arrays import Picture
from virest.capture.join import TICKS_PER_S
from virest.capture.pixels import BT601
from virest.errors import OutputError

QUALITY = "17"
"""x264's constant rate factor: hardly distinguishable from the PNGs."""
UPRIGHT = (1, 0, 0, 1)
"""The identity: no rotation."""
_BOXES_WITH_BOXES = (b"moov", b"trak", b"mdia")
_MOST_HEADER_BYTES = 64 * 2**20
"""The tables of more than a day of video, at 16 bytes per frame and 30 frames per second."""


def write_film(
    path: Path, frames: Iterable[tuple[int, Picture]], fps: float, rotation: tuple[int, int, int, int] = UPRIGHT
) -> int:
    """Write (timestamp in ns from the first, RGB picture) as H.264, atomically.

    rotation: a, b, c, d of the display matrix, as :func:`display_matrix` reads it.  Returns the number of frames.
    Raises OutputError.
    """
    part = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")
    count, size = 0, (0, 0)
    try:
        with av.open(str(part), "w", format="mp4") as container:
            stream: Any = None
            for stamp_ns, picture in frames:
                even = _even(picture)
                if stream is None:
                    size = (even.shape[1], even.shape[0])
                    stream = _stream(container, *size, fps)
                frame = av.VideoFrame.from_ndarray(even, format="rgb24").reformat(
                    format="yuv420p", dst_colorspace=BT601, dst_color_range=1
                )
                frame.pts, frame.time_base = round(stamp_ns * TICKS_PER_S / 1e9), Fraction(1, TICKS_PER_S)
                container.mux(stream.encode(frame))
                count += 1
            if stream is None:
                raise OutputError(f"{path}: no frame to show", hint="select other frames")
            container.mux(stream.encode(None))
        if rotation != UPRIGHT:
            _write_display_matrix(part, rotation, *size)
        os.replace(part, path)
    except OSError as error:
        raise output_error(path, error) from error
    finally:
        with suppress(OSError):
            part.unlink()
    return count


def side_by_side(left: Picture, right: Picture, rotation: tuple[int, int, int, int]) -> Picture:
    """Join two pictures of one size so that players show them side by side: stacked if the video is rotated by 90°."""
    a, b, _, _ = rotation
    if a:
        return np.hstack([left, right] if a > 0 else [right, left])
    return np.vstack([right, left] if b > 0 else [left, right])


def _stream(container: Any, width: int, height: int, fps: float) -> Any:
    stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
    stream.time_base = Fraction(1, TICKS_PER_S)
    coder = stream.codec_context
    coder.time_base, coder.max_b_frames, coder.thread_count = Fraction(1, TICKS_PER_S), 0, 1
    coder.colorspace, coder.color_range, coder.color_primaries, coder.color_trc = BT601, 1, BT601, BT601
    stream.options = {"preset": "veryfast", "crf": QUALITY}
    return stream


def _even(picture: Picture) -> Picture:
    """The picture with its last row or column repeated if its size is odd; the format needs even sizes."""
    height, width = picture.shape[:2]
    if height % 2 or width % 2:
        picture = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), "edge")
    return np.ascontiguousarray(picture)


# ── the rotation of an MP4 or MOV file ───────────────────────────────────────────────────────────────────────────────


def display_matrix(path: Path) -> tuple[int, int, int, int]:
    """a, b, c, d of the movie's display matrix, each −1, 0 or 1 (ISO/IEC 14496-12); UPRIGHT if it has none."""
    found = next(_picture_tracks(path), None)
    if found is None:
        return UPRIGHT
    _, matrix = found
    a, b, _, c, d = struct.unpack(">5i", matrix[:20])
    rotation = tuple(round(value / 65536) for value in (a, b, c, d))
    return rotation if sorted(map(abs, rotation)) == [0, 0, 1, 1] else UPRIGHT  # type: ignore[return-value]


def _write_display_matrix(path: Path, rotation: tuple[int, int, int, int], width: int, height: int) -> None:
    """Write the display matrix; its offset moves the rotated picture back to the origin."""
    position, _ = next(_picture_tracks(path))
    a, b, c, d = rotation
    x = width * (a < 0) + height * (c < 0)
    y = width * (b < 0) + height * (d < 0)
    one, last = 1 << 16, 1 << 30
    matrix = struct.pack(">9i", a * one, b * one, 0, c * one, d * one, 0, x * one, y * one, last)
    with path.open("r+b") as file:
        file.seek(position)
        file.write(matrix)


def _picture_tracks(path: Path) -> Iterator[tuple[int, bytes]]:
    """File position and bytes of the matrix of each track that has a size."""
    try:
        with path.open("rb") as file:
            for position, size in _boxes(file, 0, path.stat().st_size):
                file.seek(position)
                version = file.read(1)[0]
                at = position + (52 if version == 1 else 40)
                file.seek(at)
                data = file.read(44)
                if len(data) == 44 and size >= at - position + 44 and any(data[36:44]):
                    yield at, data[:36]
    except (OSError, IndexError, AttributeError):
        return


def _boxes(file: Any, start: int, end: int) -> Iterator[tuple[int, int]]:
    """Positions and sizes of the contents of all track headers."""
    while start + 8 <= end:
        file.seek(start)
        size, kind = struct.unpack(">I4s", file.read(8))
        head = 8
        if size == 1:
            size, head = struct.unpack(">Q", file.read(8))[0], 16
        size = size or end - start
        if size < head:
            return
        if kind in _BOXES_WITH_BOXES and size <= _MOST_HEADER_BYTES:
            yield from _boxes(file, start + head, min(start + size, end))
        elif kind == b"tkhd":
            yield start + head, size - head
        start += size
