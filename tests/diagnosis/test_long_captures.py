"""The parts of long captures that a diagnosis uses."""

from __future__ import annotations

import numpy as np

from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.capture.records import Frame
from virest.diagnosis.photometry_patches import halved_profile
from virest.diagnosis.picture_ladder import MAX_LIGHT_FRAMES, WHOLE_LIGHT_FRAMES, light_stretch


def frames_with(exposure_s: np.ndarray) -> list[Frame]:
    """Frames at 30 per second and ISO 200."""
    return [Frame(k, k * 33_333_333, k / 30, float(e), 200.0) for k, e in enumerate(exposure_s)]


def test_brightness_is_judged_where_exposures_vary() -> None:
    """The exposure changes only between 35 s and 38 s, and the selected frames include that time."""
    exposure_s = np.full(1800, 0.008)
    exposure_s[1050:1140] = np.geomspace(0.008, 0.003, 90)
    exposure_s[1140:] = 0.003
    stretch = light_stretch(frames_with(exposure_s))
    assert len(stretch) == MAX_LIGHT_FRAMES
    assert [frame.index for frame in stretch] == list(range(stretch[0].index, stretch[0].index + MAX_LIGHT_FRAMES))
    assert stretch[0].index < 1070
    assert stretch[-1].index > 1120


def test_at_constant_exposure_the_middle_is_used() -> None:
    """No other part is preferable; a short capture is used completely."""
    frames = frames_with(np.full(1001, 0.006))
    stretch = light_stretch(frames)
    assert abs(0.5 * (stretch[0].index + stretch[-1].index) - 500) < 25
    assert light_stretch(frames[:WHOLE_LIGHT_FRAMES]) == frames[:WHOLE_LIGHT_FRAMES]


def test_a_camera_of_half_the_size_sees_the_same_rays() -> None:
    """Pixel x of a frame corresponds to (x − ½) / 2 of the halved frame, including distortion."""
    lens = Intrinsics(1281, 720, 1010.0, 990.0, 655.0, 349.0, "radtan", (-0.08, 0.02, 0.001, -0.002, 0.0))
    half = halved_profile(CameraProfile(1281, 720, intrinsics=lens)).intrinsics
    assert half is not None
    assert (half.width, half.height) == (640, 360)
    points = np.array([[12.0, 700.0], [640.5, 31.0], [1200.0, 380.5]])
    np.testing.assert_allclose(half.rays((points - 0.5) / 2), lens.rays(points), atol=1e-8)
