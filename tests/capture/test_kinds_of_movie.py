"""Movies of other kinds: HDR, chroma's place, 4K, 240 frames a second, half an hour."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from virest.capture.video import probe_movie, read_frames, read_gray, to_rgb
from virest.errors import VideoError


def write(path: Path, pictures, ticks, codec: str = "libx264", **tags: int) -> Path:
    """A movie of RGB pictures at PTS in ticks of 90 kHz; tags: of the codec's context."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 90_000)
        stream.options = {"preset": "ultrafast", "crf": "4", "g": "30", "bf": "0"}
        for name, value in tags.items():
            setattr(stream.codec_context, name, value)
        for picture, pts in zip(pictures, ticks, strict=True):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(format="yuv420p")
            for name, value in tags.items():
                setattr(frame, name, value)
            frame.pts, frame.time_base = int(pts), Fraction(1, 90_000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


@pytest.mark.parametrize(("curve", "name"), [(16, "PQ"), (18, "HLG")])
def test_hdr_movies_are_refused_by_name(tmp_path: Path, curve: int, name: str) -> None:
    """Never taken for sRGB in silence."""
    picture = np.full((48, 64, 3), 120, np.uint8)
    movie = write(tmp_path / "movie.mp4", [picture] * 3, range(0, 9000, 3000), color_trc=curve)
    with pytest.raises(VideoError, match=name):
        probe_movie(movie)


def test_chroma_lies_on_the_left_column() -> None:
    """A chroma sample k belongs to column 2 k: a ramp comes back without a shift, up to rounding."""
    frame = av.VideoFrame(64, 16, "yuv420p")
    luma = np.full((16, 64), 120, np.uint8)
    ramp = np.tile((64 + 2 * np.arange(32)).astype(np.uint8), (8, 1))
    for plane, values in zip(frame.planes, (luma, np.full((8, 32), 128, np.uint8), ramp), strict=True):
        padded = np.zeros((values.shape[0], plane.line_size), np.uint8)
        padded[:, : values.shape[1]] = values
        plane.update(padded.tobytes())
    red = to_rgb(frame)[8, :62, 0].astype(float)
    centred = to_rgb(frame, centred=True)[8, :62, 0].astype(float)
    code = 64 + np.arange(62)
    expected = 255 / 219 * (120 - 16) + 1.402 * 255 / 224 * (code - 128)
    inner = (expected > 5) & (np.arange(62) > 1)
    assert np.abs(red - expected)[inner].max() < 1.0
    assert np.mean((centred - expected)[inner]) == pytest.approx(-0.5 * 1.402 * 255 / 224, abs=0.2)


def test_frames_of_4k_come_back(tmp_path: Path) -> None:
    """3840 x 2160, and its luma."""
    rows, columns = np.mgrid[0:2160, 0:3840]
    pictures = [
        np.repeat(((rows + columns + 40 * k) // 24 % 200)[..., None], 3, axis=2).astype(np.uint8) for k in (0, 1)
    ]
    movie = write(tmp_path / "movie.mp4", pictures, (0, 3000))
    index = probe_movie(movie)
    assert (index.width, index.height, len(index)) == (3840, 2160, 2)
    found = dict(read_frames(movie, index, 0, 1))
    assert np.abs(found[1].astype(int) - pictures[1]).mean() < 2


def test_times_of_240_frames_a_second_and_of_half_an_hour_are_exact(tmp_path: Path) -> None:
    """375 ticks apart, then after half an hour's pause; a frame is found there by seeking."""
    late = 30 * 60 * 90_000
    ticks = [*range(0, 375 * 40, 375), *range(late, late + 375 * 40, 375)]
    pictures = [np.full((32, 48, 3), 20 + 2 * k, np.uint8) for k in range(80)]
    index = probe_movie(movie := write(tmp_path / "movie.mp4", pictures, ticks))
    np.testing.assert_array_equal(index.pts_ns, np.rint(np.array(ticks) / 90_000 * 1e9))
    ((number, luma),) = read_gray(movie, index, [73])
    assert number == 73
    assert luma is not None
    assert luma.mean() == pytest.approx(20 + 2 * 73, abs=2)
