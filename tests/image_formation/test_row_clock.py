"""The row clock, compared with hand calculations and with all code that uses row times."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from virest.camera.field import Field
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.camera.shutter import READOUT_DIRECTIONS, STAMP_FRACTION, Shutter
from virest.capture.imu import ImuSamples
from virest.image_formation.point_model import seen_s
from virest.image_formation.row_clock import RowClock
from virest.image_formation.row_motion import frame_times_s, row_motion
from virest.motion.integration import integrate_gyro

PHONE = CameraProfile(
    10,
    4,
    intrinsics=Intrinsics(10, 4, 12.0, 12.0, 4.5, 1.5),
    shutter=Shutter(0.02, "top_to_bottom", "exposure_middle", exposure_scale=1.5),
    time_offset_s=0.25,
    clock_skew=0.001,
)
"""The frame stamped 3 s and logged with 8 ms is exposed for 12 ms from 2.994 s, which is 3.246994 s on the IMU's clock.
"""
POINTS_PX = np.array([[3.0, 1.0], [5.0, 3.0], [0.5, -0.5]])


def test_times_match_a_hand_calculation() -> None:
    """Offset and skew move the start of the first row; readout and exposure have their stated durations."""
    clock = RowClock(PHONE)
    assert clock.time_s(3.0, 0.008) == pytest.approx(3.246994, abs=1e-12)
    assert clock.time_s(3.0, 0.008, 0.25, 1.0) == pytest.approx(3.263994, abs=1e-12)
    assert clock.middle_s(3.0, 0.008) == pytest.approx(3.262994, abs=1e-12)
    assert clock.end_s(3.0, 0.008) == pytest.approx(3.278994, abs=1e-12)
    seen = clock.seen_s(POINTS_PX, 3.0, 0.008)
    np.testing.assert_allclose(seen, 3.246994 + 0.006 + np.array([0.005, 0.015, -0.0025]), atol=1e-12)


def test_a_delay_over_the_rows_is_added() -> None:
    """A delay of 0 ms to 4 ms over the rows adds 1 ms at a quarter of the readout."""
    late = Field("delay", ("row",), ((0.0, 1.0),), ((0.0,), (0.004,)))
    before, after = (RowClock(p).seen_s(POINTS_PX[:2], 3.0, 0.008) for p in (PHONE, PHONE.with_fields([late])))
    np.testing.assert_allclose(after - before, [0.001, 0.003], atol=1e-12)


def test_a_delay_over_time_is_added_and_inverted() -> None:
    """A delay of 2 ms at 3 s moves a frame's rows by 2 ms, and the conversion to camera times inverts it."""
    knots = (0.0, 1.5, 3.0, 4.5)
    late = Field("delay", ("time",), (knots,), ((0.0,), (-0.001,), (0.002,), (0.0,)))
    phone = replace(PHONE, shutter=replace(PHONE.shutter, timestamp="exposure_start")).with_fields([late])
    plain = phone.with_fields([])
    assert RowClock(phone).time_s(3.0, 0.008) - RowClock(plain).time_s(3.0, 0.008) == pytest.approx(0.002, abs=1e-12)
    camera_s = np.array([0.4, 1.9, 3.3])
    np.testing.assert_allclose(RowClock(phone).camera_time_s(phone.imu_time_s(camera_s)), camera_s, atol=1e-9)


def test_an_unknown_offset_counts_as_zero() -> None:
    """Times then count from the camera's own zero."""
    clock = RowClock(replace(PHONE, time_offset_s=None))
    assert clock.time_s(3.0, 0.008) == pytest.approx(2.996994, abs=1e-12)


def test_shapes_broadcast() -> None:
    """Frames (2, 1, 1), points (3, 1) and parts of the exposure (5,) give (2, 3, 5)."""
    stamps, logged = np.array([1.0, 3.0])[:, None, None], np.array([0.004, 0.008])[:, None, None]
    seen = RowClock(PHONE).seen_s(POINTS_PX[:, None], stamps, logged, np.linspace(0.0, 1.0, 5))
    assert seen.shape == (2, 3, 5)
    np.testing.assert_allclose(seen[1, 0], 3.251994 + np.linspace(0.0, 0.012, 5), atol=1e-12)


def test_camera_times_are_recovered() -> None:
    """Conversion to the IMU's clock and back gives the same times."""
    clock, camera_s = RowClock(PHONE), np.array([-0.3, 0.0, 2.994])
    np.testing.assert_allclose(clock.camera_time_s(PHONE.imu_time_s(camera_s)), camera_s, atol=1e-12)
    assert clock.camera_time_s(3.246994) == pytest.approx(2.994, abs=1e-12)


@pytest.mark.parametrize("direction", READOUT_DIRECTIONS)
@pytest.mark.parametrize("timestamp", STAMP_FRACTION)
def test_all_row_times_agree(direction: str, timestamp: str) -> None:
    """Restoration, the fit of points, and the formula written out here give the same time for a point's row."""
    profile = replace(PHONE, shutter=replace(PHONE.shutter, readout_direction=direction, timestamp=timestamp))
    fraction = profile.shutter.readout_fraction(POINTS_PX, 10, 4)
    first_row_s = (1.2 - STAMP_FRACTION[timestamp] * 0.012) * 1.001 + 0.25
    middle_s = first_row_s + fraction * 0.02 + 0.006
    time_s = np.arange(0.0, 3.0, 0.01)
    imu = ImuSamples(time_s, np.full((len(time_s), 3), 0.3), np.full((len(time_s), 3), np.nan))
    motion = row_motion(integrate_gyro(imu, profile), profile, 1.2, 0.008)
    np.testing.assert_allclose(motion.row_time_s(POINTS_PX, 0.5), middle_s, atol=1e-12)
    np.testing.assert_allclose((motion.middle_s, motion.end_s), first_row_s + np.array([0.016, 0.032]), atol=1e-12)
    reference_s = frame_times_s(profile, 1.2, 0.008, "frame-middle")
    np.testing.assert_allclose(reference_s, first_row_s + np.array([0.0, 0.016]), atol=1e-12)
    stamps_s, logged_s = np.full(3, 1.2), np.full(3, 0.008)
    np.testing.assert_allclose(seen_s(profile, POINTS_PX, stamps_s, logged_s), middle_s, atol=1e-12)
