"""The single warp: identity without motion, exact corners, and a valid rectangle that contains only recorded data."""

from __future__ import annotations

import numpy as np
import pytest
from blurred_scene import camera
from laws import RADTAN, TurningCamera, phone, recorded_points
from numpy.typing import NDArray

from virest.image_formation.warp import corner_points, straightened_points
from virest.restoration.shutter import perspective_map, rowwise_map, valid_rectangle, warp


def _identity(height: int, width: int) -> NDArray[np.float32]:
    return np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float32)


def test_the_identity_map_changes_nothing(rng: np.random.Generator) -> None:
    """The identity map returns the same picture, to the last grey level."""
    picture = rng.integers(0, 256, (37, 53, 3), dtype=np.uint8)
    np.testing.assert_array_equal(warp(picture, _identity(37, 53)), picture)


def test_a_warp_reads_at_its_source_and_repeats_the_edge(rng: np.random.Generator) -> None:
    """A map of (x + 2, y − 3) reads the source there; outside the picture it repeats the nearest edge pixel."""
    picture = rng.integers(0, 256, (37, 53, 3), dtype=np.uint8)
    shown = warp(picture, _identity(37, 53) + np.float32([2, -3]))
    np.testing.assert_array_equal(shown[3:, :-2], picture[:-3, 2:])
    np.testing.assert_array_equal(shown[:3, :-2], np.repeat(picture[:1, 2:], 3, axis=0))
    np.testing.assert_array_equal(shown[3:, -2:], np.repeat(picture[:-3, -1:], 2, axis=1))


@pytest.mark.parametrize("direction", ["bottom_to_top", "left_to_right"])
@pytest.mark.parametrize("anchor", [0.0, 0.5])
def test_rowwise_maps_give_the_place_of_recording(direction: str, anchor: float) -> None:
    """The map at a straightened pixel is the recorded point, within 0.02 px."""
    motion = TurningCamera(phone(lens=RADTAN, readout_direction=direction)).motion
    source = rowwise_map(motion, anchor)
    points = np.array([[0, 0], [199, 135], [20, 97], [150, 40]])
    exact = recorded_points(motion, points.astype(float), anchor)
    np.testing.assert_allclose(source[points[:, 1], points[:, 0]], exact, atol=0.02)


@pytest.mark.parametrize("direction", ["top_to_bottom", "right_to_left"])
def test_perspective_maps_are_exact_at_the_corners(direction: str) -> None:
    """At the straightened place of a recorded corner the homography reads that corner, within 0.02 px."""
    turning = camera((0.9, -1.2, 0.6), 0.02, direction, reference="frame-middle")
    motion = turning.motion
    corners = corner_points(336, 240)
    straightened = straightened_points(motion, corners, 0.5)
    source = perspective_map(motion, 0.5)
    slope_y, slope_x = np.gradient(source.astype(float), axis=(0, 1))
    for home, corner in zip(straightened, corners, strict=True):
        x, y = np.clip(np.rint(home).astype(int), 0, (335, 239))
        read = source[y, x] + slope_x[y, x] * (home[0] - x) + slope_y[y, x] * (home[1] - y)
        np.testing.assert_allclose(read, corner, atol=0.02)


def test_both_methods_agree_without_readout() -> None:
    """If all rows share one time, the rowwise map is a homography."""
    motion = camera((0.9, -2.0, 1.6)).motion
    np.testing.assert_allclose(perspective_map(motion, 0.5), rowwise_map(motion, 0.5), atol=0.02)


def _missing(source: NDArray[np.float32]) -> NDArray[np.bool_]:
    height, width = source.shape[:2]
    x, y = source[..., 0], source[..., 1]
    return (x < -0.5) | (x > width - 0.5) | (y < -0.5) | (y > height - 0.5)


def _largest_area(good: NDArray[np.bool_]) -> int:
    """Area of the largest rectangle of True values, by trying every pair of rows and the widest run between them."""
    best = 0
    for top in range(len(good)):
        run = np.ones(good.shape[1], bool)
        for bottom in range(top, len(good)):
            run &= good[bottom]
            edges = np.flatnonzero(np.diff(np.concatenate([[0], run.view(np.int8), [0]])))
            if len(edges) == 0:
                break
            best = max(best, int((edges[1::2] - edges[::2]).max()) * (bottom - top + 1))
    return best


@pytest.mark.parametrize("rate", [(0.9, -2.0, 0.6), (-3.0, 1.0, 4.0), (0.0, 0.0, -8.0), (2.0, 5.0, 0.0)])
@pytest.mark.parametrize("direction", ["top_to_bottom", "right_to_left"])
def test_the_valid_rectangle_is_recorded_and_nearly_maximal(rate: tuple[float, float, float], direction: str) -> None:
    """Every pixel inside was recorded, and the area is at least 0.9 of the largest possible one."""
    profile = phone(120, 88, 150.0, readout_direction=direction)
    source = rowwise_map(TurningCamera(profile, rate).motion, 0.5)
    missing = _missing(source)
    x0, y0, x1, y1 = valid_rectangle(source)
    assert not missing[y0:y1, x0:x1].any()
    assert (x1 - x0) * (y1 - y0) >= 0.9 * _largest_area(~missing)


def test_everything_is_valid_without_motion() -> None:
    """The identity keeps the whole picture; a map that reads outside it gives an empty rectangle."""
    assert valid_rectangle(_identity(37, 53)) == (0, 0, 53, 37)
    x0, y0, x1, y1 = valid_rectangle(_identity(37, 53) + 1000)
    assert 0 <= x0 <= x1 <= 53
    assert 0 <= y0 <= y1 <= 37
    assert (x1 - x0) * (y1 - y0) == 0, "a rectangle without real data is empty"
