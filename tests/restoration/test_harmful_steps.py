"""Steps that the pictures' own account of the motion speaks against are not taken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from blurred_scene import FRAME, camera, record

from virest.image_formation.row_motion import RowMotion
from virest.restoration.frame import restore_frame
from virest.restoration.harmful_steps import OTHER_BLUR, OTHER_ROWS, deblurring_harms, straightening_harms
from virest.restoration.settings import PRESETS

RATE = (0.9, -2.0, 0.1)


def turning(times: float = 1.0, turned_rad: float = 0.0) -> RowMotion:
    """A motion so many times as fast, in a direction turned in the picture."""
    x, y, z = RATE
    cos, sin = np.cos(turned_rad), np.sin(turned_rad)
    rate = (times * (cos * x - sin * y), times * (sin * x + cos * y), times * z)
    return camera(rate, readout_time_s=0.02).motion


@pytest.mark.parametrize(
    ("times", "turned_rad", "loses"),
    [(1.0, 0.0, False), (1.2, 0.0, False), (1.5, 0.0, True), (0.4, 0.0, False), (1.0, 0.15, False), (1.0, 1.6, True)],
)
def test_what_reaches_beyond_the_seen_path_is_a_loss(times: float, turned_rad: float, loses: bool) -> None:
    """A path predicted too short does no harm; one far too long, or across, does."""
    assert deblurring_harms(turning(times, turned_rad), turning()) is loses


@pytest.mark.parametrize(("times", "loses"), [(1.0, False), (0.3, False), (1.6, False), (2.2, True), (-0.5, True)])
def test_straightening_is_a_loss_where_points_would_end_further_off(times: float, loses: bool) -> None:
    """As far too far, or the wrong way."""
    assert straightening_harms(turning(times), turning(), 0.5) is loses


def test_a_frame_against_which_everything_speaks_is_copied_and_says_why() -> None:
    """Against none of it, it is restored; both reasons stand in its warnings."""
    made = camera(RATE, readout_time_s=0.02)
    picture = record(made).picture
    settings = PRESETS["fast"]
    trusted = restore_frame(FRAME, picture, made.motion, made.trajectory, settings, made.motion)
    plain = restore_frame(FRAME, picture, made.motion, made.trajectory, settings)
    assert trusted.status == plain.status == "restored"
    np.testing.assert_array_equal(trusted.picture, plain.picture)
    copied = restore_frame(FRAME, picture, made.motion, made.trajectory, settings, turning(-0.5))
    assert copied.status == "copied"
    assert copied.picture is picture
    assert {OTHER_BLUR, OTHER_ROWS} <= set(copied.warnings)
    assert copied.parameters["deblur"] == {"method": "none"}
    assert copied.parameters["shutter"]["method"] == "none"


def test_rows_may_be_right_where_the_blur_is_not() -> None:
    """A wrong exposure leaves the rows' own times: straightened, not deblurred."""
    made = camera(RATE, readout_time_s=0.02)
    assert made.exposure_s is not None
    seen = replace(made, exposure_s=0.4 * made.exposure_s, stamp_s=made.stamp_s + 0.3 * made.exposure_s).motion
    found = restore_frame(FRAME, record(made).picture, made.motion, made.trajectory, PRESETS["fast"], seen)
    assert found.status == "restored"
    assert found.parameters["deblur"]["method"] == "none"
    assert found.parameters["shutter"]["method"] == "rowwise"
    assert OTHER_BLUR in found.warnings
