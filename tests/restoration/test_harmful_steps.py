"""Steps contradicted by the observed motion are not applied."""

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
    """A motion with this factor of speed, in a direction rotated in the frame."""
    x, y, z = RATE
    cos, sin = np.cos(turned_rad), np.sin(turned_rad)
    rate = (times * (cos * x - sin * y), times * (sin * x + cos * y), times * z)
    return camera(rate, readout_time_s=0.02).motion


@pytest.mark.parametrize(
    ("times", "turned_rad", "loses"),
    [(1.0, 0.0, False), (1.2, 0.0, False), (1.5, 0.0, True), (0.4, 0.0, False), (1.0, 0.15, False), (1.0, 1.6, True)],
)
def test_deblurring_harms_if_the_path_exceeds_the_observed_one(times: float, turned_rad: float, loses: bool) -> None:
    """A predicted path that is too short does no harm; one that is far too long or perpendicular does."""
    assert deblurring_harms(turning(times, turned_rad), turning()) is loses


@pytest.mark.parametrize(("times", "loses"), [(1.0, False), (0.3, False), (1.6, False), (2.2, True), (-0.5, True)])
def test_straightening_harms_if_points_would_move_away(times: float, loses: bool) -> None:
    """Turns of 2.2 times the true one, or in the wrong direction, move points away from their true places."""
    assert straightening_harms(turning(times), turning(), 0.5) is loses


def test_a_frame_with_contradicting_motion_is_copied_with_reasons() -> None:
    """Both reasons appear in its warnings; a frame without contradictions is restored."""
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


def test_a_wrong_blur_still_allows_straightening() -> None:
    """A wrong exposure does not affect row times: the frame is straightened but not deblurred."""
    made = camera(RATE, readout_time_s=0.02)
    assert made.exposure_s is not None
    seen = replace(made, exposure_s=0.4 * made.exposure_s, stamp_s=made.stamp_s + 0.3 * made.exposure_s).motion
    found = restore_frame(FRAME, record(made).picture, made.motion, made.trajectory, PRESETS["fast"], seen)
    assert found.status == "restored"
    assert found.parameters["deblur"]["method"] == "none"
    assert found.parameters["shutter"]["method"] == "rowwise"
    assert OTHER_BLUR in found.warnings
