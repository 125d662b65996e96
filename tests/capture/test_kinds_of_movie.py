"""Kinds of movies: HDR, chroma location, 4K, 240 frames per second, long pauses, rotation tags, iPhone folders."""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from virest.capture.folder import read_capture, resolve_profile
from virest.capture.pixels import to_rgb
from virest.capture.video import probe_movie, read_frames, read_gray
from virest.errors import VideoError


def write(path: Path, pictures, ticks, codec: str = "libx264", **tags: int) -> Path:
    """A movie of RGB frames at PTS in ticks of 90 kHz; ``tags`` are set on the codec context and the frames."""
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
    """HDR is never silently treated as sRGB."""
    picture = np.full((48, 64, 3), 120, np.uint8)
    movie = write(tmp_path / "movie.mp4", [picture] * 3, range(0, 9000, 3000), color_trc=curve)
    with pytest.raises(VideoError, match=name):
        probe_movie(movie)


def test_chroma_is_located_at_the_left_column() -> None:
    """Chroma sample k belongs to column 2 k: a ramp is decoded without a shift, up to rounding."""
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


def test_4k_frames_are_read(tmp_path: Path) -> None:
    """Frames of 3840 × 2160 are decoded with the right content."""
    rows, columns = np.mgrid[0:2160, 0:3840]
    pictures = [
        np.repeat(((rows + columns + 40 * k) // 24 % 200)[..., None], 3, axis=2).astype(np.uint8) for k in (0, 1)
    ]
    movie = write(tmp_path / "movie.mp4", pictures, (0, 3000))
    index = probe_movie(movie)
    assert (index.width, index.height, len(index)) == (3840, 2160, 2)
    found = dict(read_frames(movie, index, 0, 1))
    assert np.abs(found[1].astype(int) - pictures[1]).mean() < 2


def test_times_at_240_frames_per_second_and_after_half_an_hour_are_exact(tmp_path: Path) -> None:
    """Frames are 375 ticks apart and continue after a pause of 30 min; a late frame is found by seeking."""
    late = 30 * 60 * 90_000
    ticks = [*range(0, 375 * 40, 375), *range(late, late + 375 * 40, 375)]
    pictures = [np.full((32, 48, 3), 20 + 2 * k, np.uint8) for k in range(80)]
    index = probe_movie(movie := write(tmp_path / "movie.mp4", pictures, ticks))
    np.testing.assert_array_equal(index.pts_ns, np.rint(np.array(ticks) / 90_000 * 1e9))
    ((number, luma),) = read_gray(movie, index, [73])
    assert number == 73
    assert luma is not None
    assert luma.mean() == pytest.approx(20 + 2 * 73, abs=2)


QUARTER_TURN = (0, 65536, 0, -65536, 0, 0, 0, 0, 1 << 30)
"""Display matrix that phones write for an upright recording with a landscape sensor."""


def turn(movie: Path, matrix: tuple[int, ...] = QUARTER_TURN) -> Path:
    """Write a display matrix into the track header (version 0: 40 bytes after its type and flags)."""
    data = bytearray(movie.read_bytes())
    at = data.index(b"tkhd") + 4
    assert data[at] == 0
    data[at + 40 : at + 76] = struct.pack(">9i", *matrix)
    movie.write_bytes(bytes(data))
    return movie


def striped(width: int = 64, height: int = 48) -> np.ndarray:
    """A picture that every rotation changes: dark on the left, with a bright top-left corner."""
    picture = np.full((height, width, 3), 160, np.uint8)
    picture[:, : width // 2] = 60
    picture[: height // 4, : width // 4] = 220
    return picture


@pytest.mark.parametrize("name", ["movie.mp4", "IMG_0042.MOV"])
def test_a_rotation_tag_does_not_rotate_pixels(tmp_path: Path, name: str) -> None:
    """Rows stay the sensor's rows: size and pixels are as stored."""
    movie = turn(write(tmp_path / name, [striped()] * 3, range(0, 9000, 3000)))
    with av.open(str(movie)) as container:
        assert abs(next(container.decode(video=0)).rotation) == 90  # FFmpeg recognises the tag
    index = probe_movie(movie)
    assert (index.width, index.height) == (64, 48)
    ((_, picture),) = read_frames(movie, index, 1, 1)
    assert picture is not None
    assert np.abs(picture.astype(int) - striped()).mean() < 3
    ((_, luma),) = read_gray(movie, index, [2])
    assert luma is not None
    assert luma.shape == (48, 64)


def test_bt2020_sdr_frames_use_the_bt2020_matrix(tmp_path: Path) -> None:
    """BT.2020 luma weights red by 0.2627; another matrix changes the colour of a red wall."""
    red = np.full((48, 64, 3), (200, 30, 60), np.uint8)
    frame = av.VideoFrame.from_ndarray(red, format="rgb24").reformat(format="yuv420p", dst_colorspace=9)
    frame.colorspace = 9
    assert np.abs(to_rgb(frame).astype(int) - red).max() <= 3
    frame.colorspace = 5
    assert np.abs(to_rgb(frame).astype(int) - red).max() > 8


def test_10_bit_sdr_frames_are_read(tmp_path: Path) -> None:
    """Without an HDR curve, 10 bits are a finer scale of 8 bits."""
    ramp = np.repeat(np.linspace(20, 230, 64)[None, :, None], 48, axis=0).repeat(3, axis=2).astype(np.uint8)
    frame = av.VideoFrame.from_ndarray(ramp, format="rgb24").reformat(format="yuv420p10le")
    assert np.abs(to_rgb(frame).astype(int) - ramp).max() <= 4


def test_an_iphone_folder_with_a_rotated_movie_keeps_landscape_intrinsics(tmp_path: Path) -> None:
    """The logged intrinsics of the unrotated buffer apply: width is the long side, with the logged fx and cx."""
    count, width, height = 12, 96, 64
    stamps = [1_000_000_000_000 + k * 33_333_333 for k in range(count)]
    ticks = [round(k * 33_333_333 * 9e-5) for k in range(count)]
    turn(write(tmp_path / "IMG_0042.MOV", [striped(width, height)] * count, ticks))
    rows = [f"{t}, 82.50, 82.50, 47.75, 31.50, 8000000" for t in stamps]
    head = "Timestamp[nanosec], fx[px], fy[px], cx[px], cy[px], exposure duration[nanosec]"
    (tmp_path / "movie_metadata.csv").write_text("\n".join([head, *rows]) + "\n")
    samples = range(stamps[0] - 100_000_000, stamps[-1] + 200_000_000, 10_000_000)
    gyro = [f"{t}, 0.010000, 0.200000, -0.100000, 0.100000, 9.700000, 0.300000" for t in samples]
    head = "Timestamp[nanosec], gx[rad/s], gy[rad/s], gz[rad/s], ax[m/s^2], ay[m/s^2], az[m/s^2]"
    (tmp_path / "gyro_accel.csv").write_text("\n".join([head, *gyro]) + "\n")
    capture = read_capture(tmp_path)
    profile, _ = resolve_profile(capture)
    assert capture.kind == "MARSLogger for iOS"
    assert (capture.width, capture.height) == (width, height)
    assert profile.intrinsics is not None
    assert (profile.intrinsics.fx_px, profile.intrinsics.cx_px) == (82.5, 47.75)
    assert profile.shutter.readout_direction == "top_to_bottom"
