"""Undistortion in the single warp: equal to OpenCV's, with rows at their own times, and refused for folding lenses."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from laws import FISHEYE, RADTAN, TurningCamera, phone, recorded_points
from numpy.typing import NDArray

from virest.camera.intrinsics import Intrinsics
from virest.errors import SettingsError
from virest.image_formation.row_motion import RowMotion
from virest.image_formation.warp import corner_points, straightened_points
from virest.restoration.shutter import perspective_map, rowwise_map
from virest.restoration.undistortion import require_undistortable, undistortion_map

PINCUSHION = ("radtan", (0.25, 0.05, 0.0, 0.0, 0.0))
WIDE = ("fisheye", (0.0, 0.0, 0.0, 0.0))
Array = NDArray[np.float64]


def _lens(model: tuple[str, tuple[float, ...]], focal_px: float = 220.0) -> Intrinsics:
    lens = phone(focal_px=focal_px, lens=model).intrinsics
    assert lens is not None
    return lens


def _by_opencv(lens: Intrinsics) -> NDArray[np.float32]:
    k, size = np.array(lens.coefficients), (lens.width, lens.height)
    if lens.model == "fisheye":
        maps = cv2.fisheye.initUndistortRectifyMap(lens.matrix, k, np.eye(3), lens.matrix, size, cv2.CV_32FC1)
    else:
        maps = cv2.initUndistortRectifyMap(lens.matrix, k, None, lens.matrix, size, cv2.CV_32FC1)
    return np.stack(maps, -1)


@pytest.mark.parametrize("model", [RADTAN, PINCUSHION, FISHEYE, WIDE])
def test_undistortion_alone_equals_opencvs(model: tuple[str, tuple[float, ...]]) -> None:
    """The pinhole keeps focal lengths and principal point, and the map equals OpenCV's."""
    lens = _lens(model)
    require_undistortable(lens)
    source = undistortion_map(lens)
    assert source is not None
    np.testing.assert_allclose(source, _by_opencv(lens), atol=1e-3)
    assert undistortion_map(lens.pinhole) is None


@pytest.mark.parametrize("model", [RADTAN, PINCUSHION, WIDE])
@pytest.mark.parametrize("direction", ["top_to_bottom", "right_to_left"])
def test_one_warp_combines_undistortion_and_straightening(model: tuple[str, tuple[float, ...]], direction: str) -> None:
    """The map is where a row recorded OpenCV's point of the straightened picture, within 0.02 px."""
    motion = TurningCamera(phone(lens=model, readout_direction=direction)).motion
    assert motion.profile.intrinsics is not None
    shown = _by_opencv(motion.profile.intrinsics).astype(float)[::9, ::7]
    exact = recorded_points(motion, shown, 0.5)
    near = (np.abs(exact - (100, 68)) < (140, 100)).all(-1)
    read = rowwise_map(motion, 0.5, undistort=True)[::9, ::7]
    np.testing.assert_allclose(read[near], exact[near], atol=0.02)
    assert np.abs(rowwise_map(motion, 0.5)[::9, ::7] - exact).max() > 1.0


def test_the_perspective_warp_includes_the_lens() -> None:
    """At the pinhole image of a straightened corner the map reads the recorded corner."""
    motion = TurningCamera(phone(lens=PINCUSHION), (0.2, -0.3, 0.1)).motion
    lens = motion.profile.intrinsics
    assert lens is not None
    source = perspective_map(motion, 0.5, undistort=True)
    corners = corner_points(lens.width, lens.height)
    home = lens.pinhole.project(lens.rays(straightened_points(motion, corners, 0.5)))
    x, y = source[..., 0], source[..., 1]
    inside = ((home > 0) & (home < (lens.width - 1, lens.height - 1))).all(-1)
    assert inside.any()
    for place, corner in zip(home[inside].astype(np.float32), corners[inside], strict=True):
        read = [float(cv2.remap(part, place[None, :1], place[None, 1:], cv2.INTER_LINEAR)[0, 0]) for part in (x, y)]
        np.testing.assert_allclose(read, corner, atol=0.02)


def test_stabiliser_and_focal_drift_remain() -> None:
    """Lens and pinhole share the stabiliser's shift and the focal length at that time, so the map follows both."""
    profile = phone(lens=RADTAN, readout_time_s=0.0)
    moved = replace(
        profile,
        extensions=replace(
            profile.extensions, stabilisation_fraction=0.6, stabilisation_cutoff_hz=0.5, focal_drift_per_s=0.3
        ),
    )
    motion: RowMotion = TurningCamera(moved, exposure_s=0.0).motion
    scale = 1 + 0.3 * motion.reference_s
    lens = profile.intrinsics
    assert lens is not None
    zoomed = _by_opencv(lens.scaled_focal(scale))
    np.testing.assert_allclose(rowwise_map(motion, 0.0, undistort=True), zoomed, atol=0.02)
    assert np.abs(zoomed - _by_opencv(lens)).max() > 0.1


@pytest.mark.parametrize(
    ("model", "focal_px"),
    [
        (("radtan", (-0.9, 0.0, 0.0, 0.0, 0.0)), 150.0),
        (("radtan", (4.0, -12.8, 0.0, 0.0, 0.0)), 220.0),
        (("fisheye", (-1.2, 0.0, 0.0, 0.0)), 150.0),
    ],
)
def test_a_lens_that_folds_inside_the_picture_is_refused(model: tuple[str, tuple[float, ...]], focal_px: float) -> None:
    """Where the distortion polynomial turns back, one recorded pixel would appear at two places."""
    with pytest.raises(SettingsError, match="different rays at one place"):
        require_undistortable(_lens(model, focal_px))
