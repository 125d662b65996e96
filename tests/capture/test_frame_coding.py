"""Decoders report the quantisation step that the encoder used."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from laws import texture

from virest.capture.frame_coding import VP9_STEPS, FrameCoding
from virest.capture.video import probe_movie, read_gray


def _coding(path: Path, codec: str, options: dict[str, str]) -> tuple[dict[int, FrameCoding], float]:
    """What is reported of three frames of a texture, and the mean squared coding error of the first."""
    pictures = [np.rint(255 * texture(96, 128, seed)).astype(np.uint8) for seed in range(3)]
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream(codec, rate=30)
        stream.width, stream.height, stream.pix_fmt, stream.options = 128, 96, "yuv420p", options
        for number, picture in enumerate(pictures):
            planes = np.concatenate([np.rint(16 + picture * (219 / 255)).ravel(), np.full(96 * 64, 128)])
            frame = av.VideoFrame.from_ndarray(planes.astype(np.uint8).reshape(144, 128), format="yuv420p")
            frame.pts, frame.time_base, frame.color_range = number, Fraction(1, 30), 1
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    told: dict[int, FrameCoding] = {}
    read = dict(read_gray(path, probe_movie(path), range(3), told))
    return told, float(np.mean((read[0].astype(float) - pictures[0]) ** 2))


@pytest.mark.parametrize(
    ("codec", "options", "step"),
    [
        ("libx264", {"qp": "30", "aq-mode": "0"}, 0.625 * 2 ** (27 / 6)),  # x264 codes key frames with a QP lower by 3
        ("libvpx-vp9", {"qmin": "40", "qmax": "40", "b": "0", "crf": "40"}, 305 / 8),  # index 160 of VP9's table
    ],
)
def test_a_decoder_reports_the_quantisation_step(
    tmp_path: Path, codec: str, options: dict[str, str], step: float
) -> None:
    """The error of a textured key frame matches the step Δ: at most Δ² / 3, where a dead zone of Δ drops everything."""
    told, error = _coding(tmp_path / "coded.mp4", codec, options)
    assert len(told) == 3
    assert told[0].step == pytest.approx(step, rel=0.05)
    assert 0.3 / 12 < error / told[0].step ** 2 < 1 / 3


@pytest.mark.parametrize(
    ("codec", "options", "predicted"),
    [
        ("libx264", {"bf": "0", "sc_threshold": "0"}, [False, True, True]),
        ("libx264", {"bf": "0", "sc_threshold": "0", "g": "2"}, [False, True, False]),
        ("libx264", {"bf": "2", "x264-params": "b-adapt=0"}, [False, False, False]),  # from later frames too
        ("libvpx-vp9", {}, [False, False, False]),  # from frames that are not shown
    ],
)
def test_a_frame_predicted_from_the_one_before(
    tmp_path: Path, codec: str, options: dict[str, str], predicted: list[bool]
) -> None:
    """Only where nothing else can be its source."""
    told, _ = _coding(tmp_path / "coded.mp4", codec, options)
    assert [told[n].from_previous for n in range(3)] == predicted


def test_an_unreported_step_is_missing(tmp_path: Path) -> None:
    """FFmpeg does not report the step of HEVC."""
    told, _ = _coding(tmp_path / "coded.mp4", "libx265", {"x265-params": "log-level=none"})
    assert not told


def test_vp9_steps_match_the_specification() -> None:
    """Several of the 256 values are compared."""
    assert len(VP9_STEPS) == 256
    assert [8 * VP9_STEPS[i] for i in (0, 1, 95, 120, 150, 200, 255)] == [4, 8, 102, 152, 255, 639, 1828]
