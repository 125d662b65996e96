"""A line of the log, made from a frame's record, has the same keys for every status."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from virest.app.frame_log import frame_line
from virest.app.outputs import json_line
from virest.camera.profile import CameraProfile
from virest.capture.folder import Frame
from virest.restoration.frame import RestoredFrame
from virest.restoration.parameters import (
    Deblurring,
    DegradationParameters,
    ExposureMotion,
    FrameBlur,
    FrameShutter,
    JoinedNeighbour,
    TileBlur,
    unknown_parameters,
)

FRAME = Frame(17, 500_000_000, 0.5, 0.01)
PROFILE = CameraProfile(64, 48)
DEBLURRING = Deblurring(
    "wiener", "fast", 3, 1.0, 128, 1.5, 2.0, 0.5, 2.5, 0.1, (JoinedNeighbour(16, 0.75),), 0.2, 1.0, 0.0
)
FOUND = DegradationParameters(
    ExposureMotion(None, (1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0), None),
    None,
    "none",
    FrameBlur(0.5, 3.0, (TileBlur((32.0, 24.0), 0.5, 3.0), TileBlur((48.0, 24.0), 0.4, 4.0))),
    FrameShutter(0.02, "rowwise", ((0.0, 1.0), (63.0, 1.0), (63.0, 48.0), (0.0, 48.0)), 1.0),
    "srgb",
    DEBLURRING,
)  # fmt: skip
PICTURE = np.zeros((48, 64, 3), np.uint8)


def _line(restored: RestoredFrame) -> dict:
    line = frame_line("walk", PROFILE, restored, Path("frames/000017.png"), {"decode": 0.12345})
    return json.loads(json_line(line))


def test_every_line_has_the_same_keys_in_the_same_order() -> None:
    """The status (restored, copied or failed) changes no key."""
    frames = [
        RestoredFrame(FRAME, "restored", PICTURE, degradation=FOUND),
        RestoredFrame(FRAME, "copied", PICTURE, degradation=unknown_parameters(PROFILE)),
        RestoredFrame(FRAME, "failed", None, ("the frame cannot be decoded",)),
    ]
    lines = [_line(one) for one in frames]
    assert list(lines[0]) == [
        "capture", "frame", "timestamp_ns", "exposure_s", "status", "done", "output", "warnings", "valid_px", "motion",
        "depth_m", "depth_source", "blur", "shutter", "response", "deblur", "seconds",
    ]  # fmt: skip
    assert all(list(line) == list(lines[0]) for line in lines)
    assert [line["output"] for line in lines] == ["frames/000017.png", "frames/000017.png", None]
    assert lines[0]["seconds"] == {"decode": 0.1235}


def test_a_record_is_written_with_its_field_names() -> None:
    """Nested records become mappings and tuples become lists."""
    line = _line(RestoredFrame(FRAME, "restored", PICTURE, degradation=FOUND))
    assert line["blur"]["tiles"][1] == {"centre_px": [48.0, 24.0], "angle_rad": 0.4, "length_px": 4.0}
    assert line["shutter"]["corners_px"][2] == [63.0, 48.0]
    assert line["deblur"]["neighbours"] == [{"frame": 16, "weight": 0.75}]
    assert FOUND.blur.longest_px == 4.0
    assert {name: line[name] for name in FOUND.as_json()} == FOUND.as_json()


def test_the_steps_done_follow_from_the_record() -> None:
    """Only restored frames list steps."""
    plain = replace(FOUND, deblur=None)
    still = replace(plain, shutter=replace(FOUND.shutter, method="none"))
    frames = (
        RestoredFrame(FRAME, "restored", PICTURE, degradation=FOUND, undistorted=True),
        RestoredFrame(FRAME, "restored", PICTURE, degradation=plain),
        RestoredFrame(FRAME, "copied", PICTURE, degradation=still),
        RestoredFrame(FRAME, "skipped", None),
    )
    done = [_line(one)["done"] for one in frames]
    assert done == [["deblurred", "straightened", "undistorted"], ["straightened"], [], []]
    assert _line(frames[1])["deblur"] == {"method": "none"}
