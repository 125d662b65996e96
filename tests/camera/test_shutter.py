"""The shutter: row times, compared with hand calculations (forward_model, section 1)."""

from __future__ import annotations

import numpy as np
import pytest

from virest.camera.shutter import READOUT_DIRECTIONS, STAMP_FRACTION, Shutter
from virest.errors import SettingsError

WIDTH, HEIGHT = 10, 4
TABLE = {
    # pixel (3, 1) of a frame of 10 × 4 pixels, the first and the last row or column read, and the fraction of the last
    "top_to_bottom": (0.25, (5, 0), (5, 3), 0.75),
    "bottom_to_top": (0.5, (5, 3), (5, 0), 0.75),
    "left_to_right": (0.3, (0, 2), (9, 2), 0.9),
    "right_to_left": (0.6, (9, 2), (0, 2), 0.9),
}


def _fraction(direction: str, point: tuple[float, float]) -> float:
    return float(Shutter(0.02, direction).readout_fraction(np.array(point), WIDTH, HEIGHT))


@pytest.mark.parametrize("direction", READOUT_DIRECTIONS)
def test_readout_fractions_match_a_hand_calculation(direction: str) -> None:
    """The fraction is 0 for the first row read and one row below 1 for the last."""
    inside, first, last, at_last = TABLE[direction]
    assert _fraction(direction, (3, 1)) == pytest.approx(inside)
    assert _fraction(direction, first) == pytest.approx(0.0)
    assert _fraction(direction, last) == pytest.approx(at_last)


@pytest.mark.parametrize("direction", READOUT_DIRECTIONS)
def test_fractions_continue_outside_the_frame(direction: str) -> None:
    """Points outside the frame are not clipped, and subpixel positions are interpolated."""
    far = {"top_to_bottom": (2.0, 5.0, 1.25), "bottom_to_top": (2.0, 5.0, -0.5)}
    far |= {"left_to_right": (-2.0, 1.0, -0.2), "right_to_left": (-2.0, 1.0, 1.1)}
    x, y, expected = far[direction]
    assert _fraction(direction, (x, y)) == pytest.approx(expected)
    middle = 0.5 * (_fraction(direction, (2, 1)) + _fraction(direction, (3, 2)))
    assert _fraction(direction, (2.5, 1.5)) == pytest.approx(middle)


def test_fractions_keep_the_shape_of_the_points() -> None:
    """An array of points (..., 2) gives an array of fractions (...)."""
    points = np.random.default_rng(0).uniform(0, 4, (3, 5, 2))
    assert Shutter(0.02, "bottom_to_top").readout_fraction(points, WIDTH, HEIGHT).shape == (3, 5)


def test_only_sideways_directions_read_columns() -> None:
    """A sideways readout runs along x."""
    assert [Shutter(0, d).reads_columns for d in READOUT_DIRECTIONS] == [False, False, True, True]


@pytest.mark.parametrize(
    ("timestamp", "start_s"), [("exposure_start", 5.0), ("exposure_middle", 4.988), ("exposure_end", 4.976)]
)
def test_timestamps_refer_to_the_point_in_the_profile(timestamp: str, start_s: float) -> None:
    """The first row starts 0, half or one *true* exposure before the timestamp: 0.020 s logged × 1.2 = 0.024 s."""
    shutter = Shutter(0.03, "left_to_right", timestamp, exposure_scale=1.2)
    assert shutter.true_exposure_s(0.020) == pytest.approx(0.024)
    assert shutter.first_row_start_s(5.0, 0.020) == pytest.approx(start_s, abs=1e-12)


def test_timestamp_references_are_as_documented() -> None:
    """A timestamp has three possible references."""
    assert STAMP_FRACTION == {"exposure_start": 0.0, "exposure_middle": 0.5, "exposure_end": 1.0}


def test_unknown_words_are_refused() -> None:
    """An unknown direction or timestamp reference is a settings error that repeats the word."""
    with pytest.raises(SettingsError, match="sideways"):
        Shutter(0.02, "sideways")
    with pytest.raises(SettingsError, match="exposure_begin"):
        Shutter(0.02, "top_to_bottom", "exposure_begin")
