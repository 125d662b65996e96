"""Restored points are at their true places in all four readout directions, without a shift."""

from pathlib import Path

import numpy as np
import pytest
from story import Result, process, simulate, truth_picture

from virest.evaluation.fidelity import point_distances_px, shift_px

pytestmark = pytest.mark.scenario

DIRECTIONS = ("top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left")
LARGEST_MEDIAN_PX = 0.3
LARGEST_SHIFT_PX = 0.15


def mean_shift_px(result: Result, capture: Path, folder: str = "frames") -> np.ndarray:
    """Mean shift of the frames against truth, (x, y)."""
    shifts = [
        shift_px(result.picture(line), truth_picture(capture, line["frame"], folder), line["valid_px"])
        for line in result.lines
    ]
    return np.mean(shifts, axis=0)


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_straightened_points_are_at_their_true_places(virest, work: Path, direction: str):
    """With a short exposure the median distance of corners from their global-shutter places is at most 0.3 px."""
    options = f"--width 480 --height 360 --frames 4 --exposure-ms 1 --rate 1.5 --direction {direction} --seed 31"
    capture = simulate(virest, work / direction, *options.split())
    result = process(virest, capture, work / "straight", "--deblur", "none")
    unchanged = process(virest, capture, work / "raw", "--deblur", "none", "--shutter", "none")
    distances, before = [], []
    for line, raw in zip(result.lines, unchanged.lines, strict=True):
        truth = truth_picture(capture, line["frame"])
        distances.append(point_distances_px(result.picture(line), truth, line["valid_px"]))
        before.append(point_distances_px(unchanged.picture(raw), truth, line["valid_px"]))
    assert np.median(np.concatenate(distances)) <= LARGEST_MEDIAN_PX
    assert np.median(np.concatenate(before)) > 5 * LARGEST_MEDIAN_PX


@pytest.mark.parametrize("preset", ["none", "fast", "best"])
def test_a_deblurred_and_straightened_picture_is_not_shifted(virest, hand_held: Path, tmp_path: Path, preset: str):
    """Kernel and warp use the same instant of the exposure, so the result is within 0.15 px of the truth."""
    arguments = ("--deblur", "none") if preset == "none" else ("--preset", preset)
    shift = mean_shift_px(process(virest, hand_held, tmp_path, *arguments), hand_held)
    assert np.linalg.norm(shift) < LARGEST_SHIFT_PX


def test_deblurring_without_straightening_is_not_shifted(virest, work: Path):
    """With no readout and ``--shutter none`` the deblurred picture shows the start of the exposure."""
    options = "--width 360 --height 480 --frames 4 --exposure-ms 14 --rate 2 --readout-ms 0 --seed 12"
    capture = simulate(virest, work / "global", *options.split())
    result = process(virest, capture, work / "run", "--shutter", "none", "--preset", "fast")
    assert {line["shutter"]["method"] for line in result.lines} == {"none"}
    assert np.linalg.norm(mean_shift_px(result, capture)) < LARGEST_SHIFT_PX


def test_the_reference_may_be_the_middle_of_the_frame(virest, work: Path):
    """``--reference frame-middle`` gives the picture of that instant, which differs from that of the default one."""
    options = "--width 360 --height 480 --frames 4 --exposure-ms 10 --rate 2 --reference frame-middle --seed 13"
    capture = simulate(virest, work / "middle", *options.split())
    result = process(virest, capture, work / "run", "--reference", "frame-middle", "--preset", "fast")
    shift = mean_shift_px(result, capture, "frame_middle")
    assert np.linalg.norm(shift) < LARGEST_SHIFT_PX
    start = [
        shift_px(result.picture(line), truth_picture(capture, line["frame"]), line["valid_px"]) for line in result.lines
    ]
    assert np.median(np.linalg.norm(start, axis=-1)) > 1.0
