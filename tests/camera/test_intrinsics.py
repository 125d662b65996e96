"""The lens: projection inverts rays, and OpenCV agrees."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from laws import FISHEYE, RADTAN, UNDISTORTED, assert_round_trip
from numpy.typing import NDArray

from virest.camera.intrinsics import Intrinsics
from virest.errors import SettingsError

LENSES = [
    pytest.param(UNDISTORTED, id="none"),
    pytest.param(RADTAN, id="radtan"),
    pytest.param(("radtan", (0.09, -0.02, -0.002, 0.003, 0.005)), id="pincushion"),
    pytest.param(FISHEYE, id="fisheye"),
    pytest.param(("fisheye", (0.0, 0.0, 0.0, 0.0)), id="equidistant"),
]
Model = tuple[str, tuple[float, ...]]


def _lens(lens: Model, focal_px: float = 412.0) -> Intrinsics:
    return Intrinsics(640, 360, focal_px, 0.98 * focal_px, 331.2, 171.9, *lens)


def _pixels() -> NDArray[np.float64]:
    """Pixels at the corners, the edges and inside the frame."""
    x, y = np.meshgrid(np.linspace(0, 639, 9), np.linspace(0, 359, 7))
    return np.stack([x, y], -1)


@pytest.mark.parametrize("tangential", [(0.0, 0.0), (0.001, -0.0005)])
def test_rays_are_bounded_where_a_lens_folds_back(tangential: tuple[float, float]) -> None:
    """With k1 = −0.2 nothing is visible beyond 0.86 focal lengths. Rays of pixels outside hardly depend on the lens."""

    def rays(k1: float) -> NDArray[np.float64]:
        lens = Intrinsics(640, 360, 330.0, 330.0, 390.0, 205.0, "radtan", (k1, 0.0, *tangential, 0.0))
        return lens.rays(pixels)[..., :2]

    x, y = np.meshgrid(np.linspace(0, 639, 33), np.linspace(0, 359, 21))
    pixels = np.stack([x, y], -1)
    beyond = np.hypot(x - 390.0, y - 205.0) / 330.0 > 2 / 3 * np.sqrt(1 / 0.6)
    assert 0.05 < beyond.mean() < 0.3
    assert np.linalg.norm(rays(-0.2), axis=-1).max() < np.sqrt(1 / 0.6) + 0.01
    assert np.abs(rays(-0.2 + 1e-6) - rays(-0.2)).max() < 50e-6


@pytest.mark.parametrize("lens", LENSES)
def test_projection_inverts_rays(lens: Model) -> None:
    """The ray through a pixel projects to that pixel, also at the corners."""
    camera = _lens(lens)
    assert_round_trip(camera.rays, camera.project, _pixels(), atol=1e-6)


def test_wide_fisheye_reaches_its_corners() -> None:
    """A fisheye of more than 130° across its diagonal can be inverted at its corners."""
    camera = _lens(FISHEYE, focal_px=280.0)
    assert_round_trip(camera.rays, camera.project, _pixels(), atol=1e-6)
    half_angle = np.degrees(np.arctan(np.linalg.norm(camera.rays(np.array([[0.0, 359.0]]))[0, :2])))
    assert half_angle > 65


@settings(max_examples=40, deadline=None)
@given(k1=st.floats(-0.12, 0.25), k2=st.floats(-0.02, 0.04), p1=st.floats(-0.004, 0.004), p2=st.floats(-0.004, 0.004))
def test_any_mild_lens_round_trips(k1: float, k2: float, p1: float, p2: float) -> None:
    """For mild distortions, as in phones, projection inverts rays over the whole frame."""
    camera = _lens(("radtan", (k1, k2, p1, p2, 0.0)))
    assert_round_trip(camera.rays, camera.project, _pixels(), atol=1e-6)


@pytest.mark.parametrize("lens", [UNDISTORTED, RADTAN])
def test_projection_equals_opencvs(lens: Model) -> None:
    """Brown's model has OpenCV's coefficients in OpenCV's order."""
    camera = _lens(lens)
    rays = np.random.default_rng(1).uniform((-0.7, -0.4, 0.8), (0.7, 0.4, 1.3), (50, 3))
    expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.matrix, np.array(lens[1] or [0.0] * 5))
    np.testing.assert_allclose(camera.project(rays), expected[:, 0], atol=1e-8)


def test_fisheye_projection_equals_opencvs() -> None:
    """The fisheye has OpenCV's coefficients in OpenCV's order."""
    camera = _lens(FISHEYE)
    rays = np.random.default_rng(2).uniform((-2, -1, 0.8), (2, 1, 1.3), (50, 3))
    expected, _ = cv2.fisheye.projectPoints(
        rays[:, None], np.zeros(3), np.zeros(3), camera.matrix, np.array(FISHEYE[1])
    )
    np.testing.assert_allclose(camera.project(rays), expected[:, 0], atol=1e-8)


def test_axes_are_x_right_y_down_z_forward() -> None:
    """Points right of and below the optical axis have larger pixel coordinates; the axis projects to (cx, cy)."""
    camera = _lens(RADTAN)
    centre, right, below = camera.project(np.array([[0, 0, 2.0], [0.2, 0, 2.0], [0, 0.2, 2.0]]))
    np.testing.assert_allclose(centre, (331.2, 171.9))
    assert right[0] > centre[0] + 30
    assert below[1] > centre[1] + 30


def test_a_ray_s_length_does_not_matter() -> None:
    """Scaling a ray changes no pixel, and rays are returned with z = 1."""
    camera = _lens(FISHEYE)
    rays = camera.rays(_pixels())
    np.testing.assert_array_equal(rays[..., 2], 1.0)
    np.testing.assert_allclose(camera.project(3.7 * rays), _pixels(), atol=1e-6)


def test_scaled_focal_scales_both_and_keeps_the_rest() -> None:
    """A longer focal length moves pixels away from the principal point."""
    camera = _lens(UNDISTORTED)
    ray = np.array([[0.3, -0.2, 1.0]])
    moved = camera.scaled_focal(1.1).project(ray) - (331.2, 171.9)
    np.testing.assert_allclose(moved, 1.1 * (camera.project(ray) - (331.2, 171.9)))


def test_only_a_lens_without_any_effect_counts_as_undistorted() -> None:
    """A radtan lens with zero coefficients has no distortion.

    An equidistant fisheye has some even with zero coefficients.
    """
    assert not _lens(UNDISTORTED).is_distorted
    assert not _lens(("radtan", (0.0,) * 5)).is_distorted
    assert _lens(("fisheye", (0.0,) * 4)).is_distorted


@pytest.mark.parametrize("lens", [("brown", ()), ("radtan", (0.1, 0.2)), ("none", (0.1,)), ("fisheye", (0.0,) * 5)])
def test_unknown_models_and_wrong_counts_are_refused(lens: Model) -> None:
    """An unknown model or a wrong number of coefficients is a settings error that names the model."""
    with pytest.raises(SettingsError, match=lens[0]):
        _lens(lens)
