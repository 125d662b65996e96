"""A picture with luma restored at a smaller scale: all quantities use the scale of the smaller picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from virest.camera.response import ResponseCurve
from virest.image_formation.kernels import KernelField
from virest.restoration import blurred, clipped_light, tile_layout
from virest.restoration.settings import PRESETS
from virest.restoration.statistics.records import PictureStatistics

HEIGHT, WIDTH = 120, 168
CURVE = ResponseCurve("srgb")


def _field(centres_px: NDArray[np.float64]) -> KernelField:
    """Straight paths along x, longer by 0.01 px for every pixel to the right."""
    length = 10 + 0.01 * centres_px[:, 0, None]
    along = length * np.linspace(-0.5, 0.5, 31)
    return KernelField(centres_px, np.stack([along, 0 * along], -1), 0.5)


def _blurred(picture: NDArray[np.uint8]) -> blurred.BlurredPicture:
    frequency = (np.arange(24) + 0.5) / 48
    statistics = PictureStatistics(frequency, frequency**-3.0, np.ones(24), np.ones(24), 1.0)
    return blurred.blurred_picture(picture, CURVE, (statistics, statistics), _field, 12.0)


def test_kernels_and_light_follow_the_smaller_picture() -> None:
    """A pixel of the small picture has the shortened kernel of its position; a uniform grey stays the same."""
    small = blurred.reduced(_blurred(np.full((HEIGHT, WIDTH, 3), (40, 90, 200), np.uint8)), 1.5)
    assert small.light[0].shape == (80, 112)
    assert np.ptp(small.light[0]) < 1e-6
    assert small.slopes(1, 40, (112, 80)).shape == (80, 112)
    at = np.array([[20.0, 30.0]])
    np.testing.assert_allclose(small.field(at).paths_px * 1.5, _field((at + 0.5) * 1.5 - 0.5).paths_px)
    assert small.longest_px == pytest.approx(8.0)
    assert small.clipped == [None] * 3


def test_clipped_light_stays_clipped_in_the_smaller_picture() -> None:
    """A clipped highlight covers exactly the pixels of the small picture that it touches."""
    picture = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    picture[40:47, 90:101] = 255
    hole = blurred.reduced(_blurred(picture), 1.5).clipped[0]
    assert hole is not None
    rows, columns = np.nonzero(hole)
    assert (rows.min(), rows.max()) == (26, 31)
    assert (columns.min(), columns.max()) == (60, 67)


def test_blocks_at_the_edge_are_means_of_their_pixels(rng: np.random.Generator) -> None:
    """Complete squares and the narrower ones at the right and bottom have the mean of their own pixels."""
    plane = rng.random((11, 16)).astype(np.float32)
    means = blurred.block_means(plane, 3)
    assert means.shape == (4, 6)
    expected = [[plane[r : r + 3, c : c + 3].mean() for c in range(0, 16, 3)] for r in range(0, 11, 3)]
    np.testing.assert_allclose(means, expected, rtol=1e-5)
    np.testing.assert_allclose(blurred.block_means(plane[:8], 4), plane[:8].reshape(2, 4, 4, 4).mean((1, 3)), rtol=1e-5)


def test_tiles_are_as_large_as_their_kernels_allow() -> None:
    """Paths or a defocus that grow twice as fast, or half the noise, halve the side; uniform ones set no limit."""

    def sides(growth: float, noise_levels: float) -> NDArray[np.float64]:
        def field(centres_px: NDArray[np.float64]) -> KernelField:
            along = (10 + growth * centres_px[:, 0, None]) * np.linspace(-0.5, 0.5, 31)
            return KernelField(centres_px, np.stack([along, 0 * along], -1), 0.5, None, 1 + growth * centres_px[:, 1])

        blurred = _blurred(np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
        statistics = replace(blurred.statistics, noise_levels=noise_levels)
        return np.array(tile_layout._largest_sides_px(replace(blurred, field=field, statistics=statistics)))

    assert sides(0.02, 1.0) == pytest.approx(sides(0.01, 1.0) / 2, rel=1e-6)
    assert sides(0.01, 0.5) == pytest.approx(sides(0.01, 1.0) / 2, rel=1e-6)
    assert sides(0.0, 1.0).min() > 1e4


def test_tiles_are_smaller_where_flicker_moves_the_light_along_the_paths() -> None:
    """The side shrinks with the change of light from row to row; constant light does not matter."""

    def side_px(per_row_rad: float) -> float:
        def field(centres_px: NDArray[np.float64]) -> KernelField:
            phase = np.linspace(0, 7, 31) + per_row_rad * centres_px[:, 1, None]
            return replace(_field(centres_px), light=1 + 0.4 * np.sin(phase))

        blurred = replace(_blurred(np.full((HEIGHT, WIDTH, 3), 90, np.uint8)), field=field)
        return tile_layout.luma_tiles(blurred, PRESETS["balanced"]).grid.side

    assert side_px(0.03) < side_px(0.015) < side_px(0.0) == side_px(1e-6)


def test_a_path_longer_than_a_tile_enlarges_the_transform() -> None:
    """Thin margins grow if a kernel would not fit."""
    blurred = _blurred(np.full((HEIGHT, WIDTH, 3), 90, np.uint8))

    def field(centres_px: NDArray[np.float64]) -> KernelField:
        along = np.linspace(-230.0, 230.0, 900) * np.ones((len(centres_px), 1))
        return KernelField(centres_px, np.stack([along, 0 * along], -1), 0.5)

    long = replace(blurred, field=field, longest_px=460.0)
    deconvolution = tile_layout.luma_tiles(long, PRESETS["fast"], tile_layout.THINNEST_MARGIN)
    assert deconvolution.size >= 465
    ratio = np.full((deconvolution.size,) * 2, 1e-3, np.float32)
    projected = deconvolution.back_projected(blurred.light[0])
    flat = deconvolution.blend(deconvolution.solutions(projected, [ratio] * len(projected)))
    assert np.isfinite(flat).all()


def test_the_measured_part_is_reduced_only_around_holes() -> None:
    """It is 0 in the holes, rises within the codec's reach, and is 1 beyond, also at the corner of the frame."""
    holes = np.zeros((HEIGHT, WIDTH), np.float32)
    holes[2:9, 3:14] = 1
    part = clipped_light.measured_part(holes)
    assert part[holes > 0].max() == 0
    assert 0 < part[5, 18] < part[5, 22] < 1
    assert part[5, 40] == part[60, 5] == 1
    assert (np.diff(part[5, 14:40]) >= -1e-6).all()


def test_any_channel_may_be_clipped() -> None:
    """The result is 1 where any channel is clipped, and None if none is."""
    picture = np.full((30, 44, 3), 100, np.uint8)
    assert blurred.clipped_anywhere(picture, CURVE) is None
    picture[3, 5, 0] = picture[7, 11, 1] = picture[13, 17, 2] = 255
    found = blurred.clipped_anywhere(picture, CURVE)
    assert found is not None
    assert np.argwhere(found).tolist() == [[3, 5], [7, 11], [13, 17]]
    assert found.max() == 1
