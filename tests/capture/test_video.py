"""The movie: index, order, seeking, colour and damage."""

from __future__ import annotations

import gc
import os
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from capture_writing import moving_pictures, write_movie

from virest.capture import video
from virest.capture.pixels import to_gray, to_rgb
from virest.capture.video import probe_movie, read_frames, read_gray
from virest.errors import VideoError

STEPS = [i * 33_400_000 for i in range(24)]


@pytest.fixture
def movie(tmp_path: Path) -> Path:
    """24 frames with a key frame every 10."""
    write_movie(tmp_path / "movie.mp4", moving_pictures(24), STEPS)
    return tmp_path / "movie.mp4"


def uniform_frame(y: int, u: int = 128, v: int = 128, pixel_format: str = "yuv420p") -> av.VideoFrame:
    """A frame of one colour, 32 × 16."""
    frame = av.VideoFrame(32, 16, pixel_format)
    for plane, value in zip(frame.planes, (y, u, v), strict=True):
        plane.update(bytes([value]) * plane.buffer_size)
    return frame


def test_index_holds_size_times_and_key_frames(movie):
    """The index has one entry per frame with its exact time, without decoding."""
    index = probe_movie(movie)
    assert (index.width, index.height, len(index)) == (64, 96, 24)
    assert index.keyframes == (0, 10, 20)
    np.testing.assert_array_equal(index.pts_ns, STEPS)


@pytest.mark.parametrize("qp", [22, 28])
def test_quantiser_steps_are_those_of_the_encoder(tmp_path, qp):
    """A QP larger by 6 doubles the step; frames are the same whether or not steps are requested."""
    path = tmp_path / "movie.mp4"
    write_movie(path, moving_pictures(4), STEPS[:4], qmin=str(qp), qmax=str(qp))
    index, coding = probe_movie(path), {}
    told = dict(read_frames(path, index, 0, 3, coding))
    assert [coding[n].step for n in range(4)] == pytest.approx([0.625 * 2 ** (qp / 6)] * 4)
    for number, picture in read_frames(path, index, 0, 3):
        np.testing.assert_array_equal(picture, told[number])


def test_no_frame_waits_for_the_garbage_collector(tmp_path):
    """Reading quantiser steps leaves no reference cycle: a frame's memory is free once the next frame is read."""
    path = tmp_path / "movie.mp4"
    write_movie(path, moving_pictures(12), STEPS[:12])
    index = probe_movie(path)
    gc.collect()
    gc.disable()
    try:
        for _ in read_frames(path, index, 0, 11, {}):
            pass
        alive = [kept for kept in gc.get_objects() if isinstance(kept, av.VideoFrame)]
    finally:
        gc.enable()
    assert not alive


def test_b_frames_come_in_presentation_order(tmp_path):
    """With B-frames the index is sorted by time and each time has the right frame."""
    pictures = moving_pictures(24)
    write_movie(tmp_path / "movie.mp4", pictures, STEPS, bf="3", preset="veryfast", **{"b-adapt": "0"})
    index = probe_movie(tmp_path / "movie.mp4")
    np.testing.assert_array_equal(index.pts_ns, STEPS)
    for number, gray in read_gray(tmp_path / "movie.mp4", index, range(24)):
        assert gray is not None
        errors = [np.abs(gray.astype(int) - picture).mean() for picture in pictures]
        assert int(np.argmin(errors)) == number


def test_seeking_gives_the_same_frames(movie):
    """A frame is the same whether read from the start or by seeking, in runs or alone."""
    index = probe_movie(movie)
    whole = dict(read_frames(movie, index, 0, 23))
    assert list(whole) == list(range(24))
    part = dict(read_frames(movie, index, 13, 22))
    assert list(part) == list(range(13, 23))
    sparse = dict(read_gray(movie, index, [2, 3, 15, 23]))
    assert list(sparse) == [2, 3, 15, 23]
    for number, picture in part.items():
        np.testing.assert_array_equal(picture, whole[number])
    grays = dict(read_gray(movie, index, range(24)))
    for number, picture in sparse.items():
        np.testing.assert_array_equal(picture, grays[number])


def test_ends_are_clipped(movie):
    """Frame numbers outside the movie are ignored."""
    index = probe_movie(movie)
    assert [number for number, _ in read_frames(movie, index, -3, 2)] == [0, 1, 2]
    assert [number for number, _ in read_frames(movie, index, 22, 99)] == [22, 23]
    assert not list(read_frames(movie, index, 30, 40))


def test_a_damaged_frame_affects_only_its_group(movie):
    """After a damaged packet, frames are None up to the next key frame, then right again."""
    index = probe_movie(movie)
    good = dict(read_frames(movie, index, 0, 23))
    with av.open(str(movie)) as container:
        places = sorted((p.pts, p.pos, p.size) for p in container.demux(video=0) if p.size)
    raw = bytearray(movie.read_bytes())
    _, position, size = places[13]
    raw[position : position + size] = bytes(size)
    movie.write_bytes(raw)
    seen = dict(read_frames(movie, index, 0, 23))
    assert list(seen) == list(range(24))
    assert [number for number, picture in seen.items() if picture is None] == list(range(13, 20))
    np.testing.assert_array_equal(seen[21], good[21])


def test_a_truncated_movie_keeps_its_first_frames(tmp_path):
    """A movie with a complete index but truncated data gives its first frames, then None."""
    path = tmp_path / "movie.mp4"
    with av.open(str(path), "w", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 96, "yuv420p"
        for picture in moving_pictures(24):
            picture = np.ascontiguousarray(picture)
            frame = av.VideoFrame.from_ndarray(picture, format="gray").reformat(format="yuv420p")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    index = probe_movie(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    seen = dict(read_frames(path, index, 0, 23))
    assert list(seen) == list(range(24))
    assert seen[0] is not None
    assert seen[23] is None
    assert len(probe_movie(path)) < probe_movie(path).declared_frames == 24


@pytest.mark.parametrize("grey", [16, 17, 63, 126, 200, 235])
def test_a_known_grey_is_exact(grey):
    """A uniform limited-range grey is converted to its rounded full-range value in all three channels."""
    frame = uniform_frame(grey)
    expected = round((grey - 16) * 255 / 219)
    assert set(np.unique(to_rgb(frame))) == {expected}
    assert set(np.unique(to_gray(frame))) == {expected}


def test_the_mean_bias_over_all_greys_is_small():
    """Values are rounded, not truncated: the mean error over all codes is below 0.02 levels."""
    codes = range(16, 236)
    errors = [to_rgb(uniform_frame(code)).mean() - (code - 16) * 255 / 219 for code in codes]
    assert abs(np.mean(errors)) < 0.02


@pytest.mark.parametrize(
    ("matrix", "kr", "kb"), [(1, 0.2126, 0.0722), (2, 0.299, 0.114), (6, 0.299, 0.114), (9, 0.2627, 0.0593)]
)
@pytest.mark.parametrize("full_range", [False, True])
def test_matrix_and_range_of_the_stream_are_used(matrix, kr, kb, full_range):
    """Each matrix and range gives the colours of its defining equations; untagged video is BT.601."""
    frame = uniform_frame(120, 90, 160)
    frame.colorspace = matrix
    frame.color_range = 2 if full_range else 1
    y = 120.0 if full_range else (120 - 16) * 255 / 219
    scale = 1.0 if full_range else 255 / 224
    red = y + 2 * (1 - kr) * (160 - 128) * scale
    blue = y + 2 * (1 - kb) * (90 - 128) * scale
    green = (y - kr * red - kb * blue) / (1 - kr - kb)
    np.testing.assert_allclose(to_rgb(frame)[5, 7], np.clip([red, green, blue], 0, 255), atol=0.53)


def test_a_colour_picture_survives_chroma_subsampling(tmp_path):
    """A smooth colour picture is reconstructed from 4:2:0 at better than 45 dB, since chroma is located correctly.

    FFmpeg's scaler averages two columns, so its chroma lies between them.
    """
    y, x = np.mgrid[:128, :160]
    channels = [128 + 100 * np.sin(x / 6), 128 + 100 * np.sin(y / 7 + 1), 128 + 90 * np.sin((x + y) / 9)]
    picture = np.stack(channels, -1).round().astype(np.uint8)
    frame = av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(format="yuv420p", dst_colorspace="ITU601")
    error = to_rgb(frame, centred=True).astype(float) - picture
    assert 10 * np.log10(255**2 / np.mean(error**2)) > 45
    assert abs(error.mean()) < 0.1


@pytest.mark.parametrize("centred", [False, True])
@pytest.mark.parametrize("along", [0, 1])
def test_colour_detail_keeps_its_contrast(along: int, centred: bool):
    """Waves of 8 px across rows or columns keep amplitude and phase.

    Linear interpolation would keep 85 % of the amplitude.
    """
    at = np.arange(0, 128, 2) + (0.5 if centred or along == 0 else 0.0)
    wave = 40 * np.sin(2 * np.pi * at / 8)
    chroma = np.rint(128 + (np.tile(wave[:, None], 64) if along == 0 else np.tile(wave, (64, 1)))).astype(np.uint8)
    frame = av.VideoFrame(128, 128, "yuv420p")
    for plane, values in zip(
        frame.planes, (np.full((128, 128), 128, np.uint8), np.full_like(chroma, 128), chroma), strict=True
    ):
        rows = np.zeros((plane.height, plane.line_size), np.uint8)
        rows[:, : plane.width] = values
        plane.update(rows)
    red = to_rgb(frame, centred=centred)[..., 0].astype(float)
    shown = np.moveaxis(red, along, 0)[16:-16, 64]
    position = np.arange(16, 112)
    waves = np.exp(-2j * np.pi * position / 8)
    expected = 40 * 2 * (1 - 0.299) * 255 / 224
    assert 2 * np.abs(shown @ waves) / len(position) == pytest.approx(expected, rel=0.06)
    assert np.angle(shown @ waves) == pytest.approx(-np.pi / 2, abs=0.02), "the phase is kept as well"


def test_odd_sizes_keep_their_shape():
    """The last chroma sample of an odd side is cut after upsampling."""
    frame = av.VideoFrame.from_ndarray(np.full((15, 33, 3), 77, np.uint8), format="rgb24").reformat(format="yuv420p")
    assert to_rgb(frame).shape == (15, 33, 3)
    assert to_gray(frame).shape == (15, 33)


@pytest.mark.parametrize("content", [b"", b"not a movie", b"#EXTM3U\nhttp://localhost/x\n", bytes(5000)])
def test_a_file_that_is_not_a_movie_is_refused(tmp_path, content):
    """Empty files, text, playlists and zeros give an error that names the file."""
    path = tmp_path / "movie.mp4"
    path.write_bytes(content)
    with pytest.raises(VideoError, match=r"movie\.mp4"):
        probe_movie(path)


def test_a_movie_without_its_index_is_refused(movie):
    """The error for a movie cut before its moov box explains the likely cause."""
    movie.write_bytes(movie.read_bytes()[:2000])
    with pytest.raises(VideoError, match="stopped cleanly"):
        probe_movie(movie)


def test_a_movie_without_video_is_refused(tmp_path):
    """A file with only an audio stream is an error."""
    path = tmp_path / "movie.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=48_000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate, frame.pts, frame.time_base = 48_000, 0, Fraction(1, 48_000)
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    with pytest.raises(VideoError, match="no video stream"):
        probe_movie(path)


def test_an_implausible_frame_size_is_refused(movie, monkeypatch):
    """A frame larger than any camera's is rejected before memory is allocated."""
    monkeypatch.setattr(video, "MAX_SIDE_PX", 90)
    with pytest.raises(VideoError, match="64x96"):
        probe_movie(movie)


def test_pipe_and_folder_do_not_hang(tmp_path):
    """A named pipe or a folder in place of the movie is rejected at once."""
    os.mkfifo(tmp_path / "movie.mp4")
    with pytest.raises(VideoError, match="not a regular file"):
        probe_movie(tmp_path / "movie.mp4")
    with pytest.raises(VideoError, match="is a folder"):
        probe_movie(tmp_path)


def test_mpeg4_part_2(realdata):
    """The older codec is indexed and decoded like H.264."""
    path = realdata / "nexus5_162941" / "movie.mp4"
    index = probe_movie(path)
    assert (index.codec, len(index)) == ("mpeg4", 152)
    pictures = dict(read_frames(path, index, 60, 63))
    assert all(picture is not None and picture.shape == (768, 1280, 3) for picture in pictures.values())
