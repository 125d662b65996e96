"""The space-variant blur: windows that sum to 1, the laws of operators, and comparison with plain sums."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from laws import assert_adjoint, assert_energy, assert_linear, random_picture
from numpy.typing import NDArray

from virest.image_formation.blur import SpaceVariantBlur, fast_size, tile_grid

GRIDS = [
    pytest.param((137, 211, 64, 16), id="odd picture"),
    pytest.param((64, 64, 64, 16), id="one tile exactly"),
    pytest.param((41, 29, 64, 16), id="smaller than a tile"),
    pytest.param((65, 300, 64, 32), id="one row more than a tile"),
    pytest.param((19, 180, 48, 12), id="a strip"),
    pytest.param((120, 90, 40, 0), id="no overlap"),
]
Sizes = tuple[int, int, int, int]


def _kernels(count: int, radius: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Different asymmetric kernels that sum to 1, with negative values."""
    kernels = rng.normal(0.2, 1, (count, 2 * radius + 1, 2 * radius + 1))
    kernels[:, :radius] *= 0.3
    kernels[:, :, : radius - 1] *= 0.2
    kernels[:, radius, radius + 1] += 5
    return (kernels / kernels.sum(axis=(1, 2), keepdims=True)).astype(np.float32)


def _operator(sizes: Sizes, rng: np.random.Generator, radius: int = 5) -> SpaceVariantBlur:
    grid = tile_grid(*sizes)
    return SpaceVariantBlur(grid, _kernels(len(grid.centres_px), radius, rng))


@pytest.mark.parametrize("sizes", GRIDS)
def test_windows_sum_to_one(sizes: Sizes) -> None:
    """At every pixel the windows of all tiles sum to 1, and none is negative."""
    height, width, side, _ = sizes
    grid = tile_grid(*sizes)
    total = np.zeros((grid.tops[-1] + side, grid.lefts[-1] + side))
    for (top, left), window in zip(grid.corners(), grid.windows(), strict=True):
        assert window.shape == (side, side)
        assert window.min() >= 0
        total[top : top + side, left : left + side] += window
    np.testing.assert_allclose(total[:height, :width], 1, atol=1e-6)


@pytest.mark.parametrize("sizes", GRIDS)
def test_centres_are_tile_centres_inside_the_frame(sizes: Sizes) -> None:
    """Centres have the order of the corners, x first, and lie in the frame."""
    height, width, side, _ = sizes
    grid = tile_grid(*sizes)
    assert len(grid.centres_px) == len(list(grid.corners())) == len(grid.windows())
    for (top, left), (x, y) in zip(grid.corners(), grid.centres_px, strict=True):
        assert x == min(left + (side - 1) / 2, width - 1)
        assert y == min(top + (side - 1) / 2, height - 1)


@pytest.mark.parametrize("sizes", GRIDS)
def test_the_blur_is_linear_and_conserves_light(sizes: Sizes, rng: np.random.Generator) -> None:
    """It is linear, its adjoint is its transpose, and it conserves light."""
    operator = _operator(sizes, rng)
    latent, seen = operator.latent_shape, sizes[:2]
    assert latent == (sizes[0] + 10, sizes[1] + 10)
    assert_linear(operator.apply, latent, rng)
    assert_linear(operator.adjoint, seen, rng)
    assert_adjoint(operator.apply, operator.adjoint, latent, seen, rng)
    assert_energy(operator.apply, operator.adjoint, latent, seen, rng, rtol=1e-3)


@pytest.mark.parametrize("sizes", GRIDS)
def test_equal_kernels_are_one_correlation(sizes: Sizes, rng: np.random.Generator) -> None:
    """With the same asymmetric kernel in every tile the blur equals OpenCV's correlation, edges included."""
    grid = tile_grid(*sizes)
    kernel = _kernels(1, 4, rng)[0]
    operator = SpaceVariantBlur(grid, np.repeat(kernel[None], len(grid.centres_px), axis=0))
    sharp = random_picture(operator.latent_shape, rng)
    expected = cv2.filter2D(sharp, cv2.CV_32F, kernel)[4:-4, 4:-4]
    np.testing.assert_allclose(operator.apply(sharp), expected, atol=2e-4)


def test_a_kernel_gathers_from_its_offset() -> None:
    """A kernel with 1 at d = (+3, −2) shows at each pixel the value 3 px to the right and 2 px above."""
    grid = tile_grid(50, 70, 32, 8)
    kernels = np.zeros((len(grid.centres_px), 9, 9), np.float32)
    kernels[:, 4 - 2, 4 + 3] = 1
    sharp = random_picture((58, 78), np.random.default_rng(0))
    shown = SpaceVariantBlur(grid, kernels).apply(sharp)
    np.testing.assert_allclose(shown, sharp[4 - 2 : 54 - 2, 4 + 3 : 74 + 3], atol=1e-5)


def test_different_kernels_are_blended_by_the_windows(rng: np.random.Generator) -> None:
    """G = Σ_r w_r (k_r ⋆ f), computed with one plain correlation of the frame per tile."""
    sizes = (75, 118, 48, 12)
    grid = tile_grid(*sizes)
    kernels = _kernels(len(grid.centres_px), 6, rng)
    operator = SpaceVariantBlur(grid, kernels)
    sharp = random_picture(operator.latent_shape, rng)
    expected = np.zeros((grid.tops[-1] + 48, grid.lefts[-1] + 48))
    for (top, left), window, kernel in zip(grid.corners(), grid.windows(), kernels, strict=True):
        whole = np.zeros_like(expected)
        whole[:75, :118] = cv2.filter2D(sharp, cv2.CV_32F, kernel)[6:-6, 6:-6]
        expected[top : top + 48, left : left + 48] += window * whole[top : top + 48, left : left + 48]
    np.testing.assert_allclose(operator.apply(sharp), expected[:75, :118], atol=2e-4)


def test_nothing_wraps_around() -> None:
    """Light at one edge does not appear at the opposite one."""
    grid = tile_grid(60, 84, 48, 12)
    kernels = np.full((len(grid.centres_px), 11, 11), 1 / 121, np.float32)
    operator = SpaceVariantBlur(grid, kernels)
    sharp = np.zeros(operator.latent_shape, np.float32)
    sharp[:, 0], sharp[0] = 100, 100
    blurred = operator.apply(sharp)
    assert np.abs(blurred[12:, 12:]).max() < 1e-3
    assert blurred[30, 0] == pytest.approx(100 / 11, rel=1e-4)


def test_fast_sizes_are_even_and_large_enough() -> None:
    """A transform is never too small, and its size is even, as the packed spectra require."""
    for at_least in (1, 63, 64, 65, 200, 1000, 1025, 2049):
        assert fast_size(at_least) >= at_least
        assert fast_size(at_least) % 2 == 0, at_least
