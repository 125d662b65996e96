"""Tiles in the Fourier domain: packed spectra equal NumPy's, with no seams and no shift, and undo a known blur."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
import pytest
from laws import psnr_db, random_picture, texture
from numpy.typing import NDArray

from virest.image_formation.blur import Image, fast_size, tile_grid
from virest.restoration.statistics.on_tiles import packed_frequency
from virest.restoration.tile_layout import border_noise_to_signal, in_tiles
from virest.restoration.tiles import (
    FurtherPicture,
    TileDeconvolution,
    _ends,
    _ends_product,
    _inner_numbers,
    _power_at_ends,
    _power_inside,
    _product,
    gradient_power,
    inverse_filter,
    quick_grid,
    wiener_filter,
)

SIZES = [16, 64, 96, 144]


def _filtered(picture: NDArray[np.float32], packed: NDArray[np.float32]) -> NDArray[np.float32]:
    return cv2.idft(cv2.dft(picture) * packed, flags=cv2.DFT_SCALE)


def _filtered_by_numpy(
    picture: NDArray[np.float32], factor: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Multiply the full complex spectrum by a factor of (f_y, f_x)."""
    fy, fx = np.meshgrid(np.fft.fftfreq(len(picture)), np.fft.fftfreq(len(picture)), indexing="ij")
    return np.fft.ifft2(np.fft.fft2(picture) * factor(fy, fx)).real


def _lopsided_kernel(size: int = 15) -> NDArray[np.float32]:
    """A curved asymmetric stroke that starts off the middle and sums to 1."""
    kernel = np.zeros((size, size), np.float32)
    points = np.array([[4, 5], [7, 6], [10, 8], [12, 11]], np.int32)
    cv2.polylines(kernel, [points[:, None]], False, 1.0)
    kernel[8, 10] += 2
    return kernel / kernel.sum()


def packed_power(spectrum: Image) -> Image:
    """|K|² of packed spectra, computed as for tiles."""
    power = np.empty_like(spectrum)
    _power_inside(spectrum, power)
    _power_at_ends(spectrum, power)
    return power


def packed_product(first: Image, second: Image) -> Image:
    """Multiply packed spectra as for tiles: one at a time, or in place of the first."""
    if first.ndim == 2:
        product = first.copy()
        _product(product, second, product)
        return product
    product = np.empty_like(first)
    np.multiply(_inner_numbers(first), _inner_numbers(second), out=_inner_numbers(product))
    _ends(product)[:] = _ends_product(_ends(first), _ends(second))
    return product


@pytest.mark.parametrize("size", SIZES)
def test_packed_powers_are_real_factors(size: int, rng: np.random.Generator) -> None:
    """Multiplying by packed |K|² equals multiplying NumPy's full spectrum by |K|²."""
    kernel = random_picture((size, size), rng) / size
    picture = random_picture((size, size), rng)
    expected = _filtered_by_numpy(picture, lambda fy, fx: np.abs(np.fft.fft2(kernel)) ** 2)
    filtered = _filtered(picture, packed_power(cv2.dft(kernel)))
    np.testing.assert_allclose(filtered, expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("size", SIZES)
def test_packed_products_are_periodic_convolutions(size: int, rng: np.random.Generator) -> None:
    """The product of two packed spectra equals the product of NumPy's full spectra."""
    picture, kernel = (random_picture((size, size), rng) / size for _ in range(2))
    expected = np.fft.ifft2(np.fft.fft2(picture) * np.fft.fft2(kernel)).real
    product = cv2.idft(packed_product(cv2.dft(picture), cv2.dft(kernel)), flags=cv2.DFT_SCALE)
    np.testing.assert_allclose(product, expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("size", SIZES)
def test_packed_frequency_equals_numpys(size: int, rng: np.random.Generator) -> None:
    """A factor made from the packed frequency equals that factor made from NumPy's frequencies."""
    picture = random_picture((size, size), rng)
    expected = _filtered_by_numpy(picture, lambda fy, fx: np.hypot(fx, fy) ** 2 + 0.3)
    np.testing.assert_allclose(_filtered(picture, packed_frequency(size) ** 2 + 0.3), expected, atol=1e-5)


@pytest.mark.parametrize("size", SIZES)
def test_gradient_power_is_that_of_forward_differences(size: int, rng: np.random.Generator) -> None:
    """Filtering by |Dx|² + |Dy|² is Dᵀ D, the periodic negative Laplacian."""
    picture = random_picture((size, size), rng)
    around = sum(np.roll(picture, s, axis) for s in (1, -1) for axis in (0, 1))
    np.testing.assert_allclose(_filtered(picture, gradient_power(size)), 4 * picture - around, atol=1e-4)


@pytest.mark.parametrize(("height", "width", "side"), [(137, 211, 64), (41, 29, 64), (96, 200, 96)])
def test_a_constant_picture_stays_constant(height: int, width: int, side: int) -> None:
    """No seams between tiles and no dark borders: a flat picture stays flat within 0.1 %, edges included."""
    grid = tile_grid(height, width, side, side // 4)
    deconvolution = TileDeconvolution(grid, np.repeat(_lopsided_kernel()[None], len(grid.centres_px), 0), 16)
    flat = np.full((height, width), 0.4, np.float32)
    for make in (inverse_filter, lambda power: wiener_filter(power, 1e-4)):
        spectra = deconvolution.back_projected(flat)
        factors = deconvolution.filters(make)
        restored = deconvolution.blend([s * f for s, f in zip(spectra, factors, strict=True)])
        assert restored.shape == (height, width)
        np.testing.assert_allclose(restored, flat, atol=1e-3 * 0.4)


@pytest.mark.parametrize("side", [64, 128])
def test_a_known_asymmetric_blur_is_undone(side: int) -> None:
    """A picture blurred by a curved, off-centre stroke becomes sharp, without a shift."""
    sharp = (255 * texture(199 + 40, 262 + 40)).astype(np.float32)
    kernel = _lopsided_kernel()
    blurred = cv2.filter2D(sharp, cv2.CV_32F, kernel)[20:-20, 20:-20]
    blurred += np.random.default_rng(0).normal(0, 0.3, blurred.shape).astype(np.float32)
    sharp = sharp[20:-20, 20:-20]
    grid = tile_grid(*sharp.shape, side, side // 4)
    deconvolution = TileDeconvolution(grid, np.repeat(kernel[None], len(grid.centres_px), 0), 24)
    factors = deconvolution.filters(lambda power: wiener_filter(power, 1e-3))
    spectra = deconvolution.back_projected(blurred)
    restored = deconvolution.blend([s * f for s, f in zip(spectra, factors, strict=True)])
    assert psnr_db(restored, sharp, 24) > psnr_db(blurred, sharp, 24) + 8
    assert psnr_db(restored, sharp) > psnr_db(blurred, sharp) + 4
    shift, _ = cv2.phaseCorrelate(restored[24:-24, 24:-24].copy(), sharp[24:-24, 24:-24].copy())
    assert np.hypot(*shift) < 0.05


def test_each_tile_is_restored_by_its_own_kernel() -> None:
    """Kernels shift left tiles up and right tiles down; back projection shifts each of them back."""
    sharp = texture(64, 300).astype(np.float32)
    grid = tile_grid(64, 300, 64, 16)
    kernels = np.zeros((len(grid.centres_px), 9, 9), np.float32)
    down = grid.centres_px[:, 0] > 150
    kernels[~down, 4 - 2, 4] = 1
    kernels[down, 4 + 3, 4] = 1
    deconvolution = TileDeconvolution(grid, kernels, 16)
    restored = deconvolution.blend(deconvolution.back_projected(sharp))
    np.testing.assert_allclose(restored[10:50, :90], sharp[12:52, :90], atol=1e-4)
    np.testing.assert_allclose(restored[10:50, 250:], sharp[7:47, 250:], atol=1e-4)


def test_the_naive_inverse_is_bounded() -> None:
    """It stays finite where the kernel cancels, and is exact where it passes."""
    np.testing.assert_allclose(inverse_filter(np.array([0.0, 1e-6, 0.25], np.float32)), [1000, 1000, 4], rtol=1e-6)


def test_the_pull_is_zero_outside_the_picture() -> None:
    """Each tile receives the pull at its place, times its own factor."""
    pull = texture(150, 210).astype(np.float32)
    grid = tile_grid(150, 210, 64, 16)
    deconvolution = TileDeconvolution(grid, np.repeat(_lopsided_kernel()[None], len(grid.centres_px), 0), 16)
    nothing = [np.zeros((deconvolution.size,) * 2, np.float32)] * len(deconvolution.kernels)
    beyond = np.pad(pull, 100)
    factors = np.linspace(0.03, 0.5, len(nothing)).tolist()
    pulled = deconvolution.pulled(nothing, pull, factors)
    for spectrum, (top, left), factor in zip(pulled, grid.corners(), factors, strict=True):
        expected = np.zeros((deconvolution.size,) * 2)
        rows, columns = (slice(84 + k, 84 + k + deconvolution.patch) for k in (top, left))
        expected[: deconvolution.patch, : deconvolution.patch] = beyond[rows, columns]
        tile = cv2.idft(spectrum, flags=cv2.DFT_SCALE)
        np.testing.assert_allclose(tile, expected * factor, atol=1e-5)


def test_a_lamp_at_the_border_does_not_ring() -> None:
    """A lamp that enters a dark picture fits no blur beyond the border: tiles there are filtered less.

    Filtered as usual, dark and bright spots a blur length apart reach 40 px inwards.
    """
    recorded = _filtered(0.05 + 0.02 * texture(320, 320).astype(np.float32), packed_frequency(320) < 0.04)
    grid, kernel = tile_grid(320, 320, 96, 24), _stroke(False)
    deconvolution = TileDeconvolution(grid, np.repeat(kernel[None], len(grid.centres_px), 0), 12)
    usual = border_noise_to_signal(deconvolution, recorded, 11.0)
    assert 0 < usual.count(0.0) < len(usual)
    recorded[-2:, 150:158] = 0.8
    least = border_noise_to_signal(deconvolution, recorded, 11.0)
    ratio = np.full((deconvolution.size,) * 2, 3e-4, np.float32)
    projected = deconvolution.back_projected(recorded)

    def ripple(least: list[float]) -> float:
        sharp = deconvolution.blend(deconvolution.solutions(projected, in_tiles(ratio, least)))
        return float(np.abs(sharp - recorded)[-40:-14, 140:170].max())

    changed = [corner for corner, a, b in zip(grid.corners(), usual, least, strict=True) if b > 2 * a]
    assert changed
    assert all(top + 96 > 306 and left < 170 and left + 120 > 140 for top, left in changed)
    assert ripple(least) < 0.3 * ripple(usual)


@pytest.mark.parametrize(("height", "width", "margin"), [(480, 640, 16), (1280, 720, 23), (360, 640, 8), (90, 70, 41)])
def test_quick_tiles_cover_the_picture(height: int, width: int, margin: int) -> None:
    """The grid reaches every pixel, tiles have about the requested side, and the windows sum to 1."""
    grid = quick_grid(height, width, 120, 3 * margin, 5)
    total = np.zeros((grid.tops[-1] + grid.side, grid.lefts[-1] + grid.side))
    for (top, left), window in zip(grid.corners(), grid.windows(), strict=True):
        total[top : top + grid.side, left : left + grid.side] += window
    np.testing.assert_allclose(total[:height, :width], 1, atol=1e-6)
    assert 0.8 * 120 <= grid.side <= 1.15 * 120


@pytest.mark.parametrize(("height", "width"), [(853, 480), (480, 853), (640, 360)])
def test_a_flexible_overlap_saves_tiles(height: int, width: int) -> None:
    """Tiles still cover the picture, overlap by almost the requested amount, and cost no more than 5 % extra pixels."""
    strict, loose = (quick_grid(height, width, 117, 18, 3, give) for give in (0.0, 0.1))
    pixels = [len(g.tops) * len(g.lefts) * fast_size(g.side + 18) ** 2 for g in (strict, loose)]
    assert pixels[1] <= 1.05 * pixels[0]
    assert loose.overlap >= 0.9 * (loose.side // 3) - 1
    assert loose.tops[-1] + loose.side >= height
    assert loose.lefts[-1] + loose.side >= width


def test_stacked_spectra_are_multiplied_one_by_one(rng: np.random.Generator) -> None:
    """Products and powers of stacked packed spectra equal those of each spectrum, including the end columns."""
    first, second = (np.stack([cv2.dft(random_picture((16, 16), rng)) for _ in range(3)]) for _ in range(2))
    for stacked, single in (
        (packed_product(first, second), [packed_product(a, b) for a, b in zip(first, second, strict=True)]),
        (packed_power(first), [packed_power(a) for a in first]),
    ):
        np.testing.assert_allclose(stacked, single, rtol=1e-5, atol=1e-4)


def test_a_bridge_may_be_longer_than_the_margins() -> None:
    """Thin margins with a long bridge share one period; tiles of the same kind share a window."""
    grid = tile_grid(300, 260, 80, 20)
    deconvolution = TileDeconvolution(grid, np.repeat(_lopsided_kernel()[None], len(grid.centres_px), 0), 16, 40)
    assert deconvolution.patch == 80 + 2 * 16
    assert deconvolution.size >= deconvolution.patch + 40
    assert len({id(window) for window in grid.windows()}) == 9


def _lamp_behind_a_blur() -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """A dim scene with a highlight of 12 times full light.

    The sharp scene, the scene blurred by a stroke, and the kernel.
    """
    sharp = (0.1 + 0.2 * texture(150, 210)).astype(np.float32)
    sharp[70:76, 101:109] = 12.0
    kernel = np.zeros((17, 17), np.float32)
    cv2.line(kernel, (3, 5), (14, 11), 1.0)
    kernel /= kernel.sum()
    return sharp, cv2.filter2D(sharp, cv2.CV_32F, kernel), kernel


def _with_lamp_tamed(recorded: NDArray[np.float32], kernel: NDArray[np.float32]) -> tuple[TileDeconvolution, list[int]]:
    """Tiles of a picture clipped at 1 after removing the clipped highlights, and numbers of the touched tiles."""
    grid = tile_grid(*recorded.shape, 64, 16)
    deconvolution = TileDeconvolution(grid, np.repeat(kernel[None], len(grid.centres_px), 0), 16)
    holes = (recorded >= 1).astype(np.float32)
    numbers = deconvolution.touched(holes)
    deconvolution.remove_highlights(numbers, np.repeat(kernel[None], len(numbers), 0), recorded, 1 - holes, 1.0)
    return deconvolution, numbers


def _filtered_with_lamps(deconvolution: TileDeconvolution, recorded: NDArray[np.float32]) -> NDArray[np.float32]:
    ratio = np.full((deconvolution.size,) * 2, 1e-3, np.float32)
    projected = deconvolution.back_projected(recorded)
    return deconvolution.restore_highlights(
        deconvolution.blend(deconvolution.solutions(projected, [ratio] * len(projected)))
    )


def test_a_highlight_is_recovered_from_its_clipped_streak() -> None:
    """The highlight and the dark beside it are recovered from the clipped streak; other tiles are filtered as usual."""
    sharp, blurred, kernel = _lamp_behind_a_blur()
    recorded = np.minimum(blurred, 1)
    deconvolution, numbers = _with_lamp_tamed(recorded, kernel)
    assert 0 < len(numbers) < len(deconvolution.grid.centres_px)
    restored = _filtered_with_lamps(deconvolution, recorded)
    near = np.s_[55:91, 85:125]
    before, after = (np.abs(np.minimum(p, 1) - np.minimum(sharp, 1))[near].mean() for p in (recorded, restored))
    assert after < 0.5 * before
    assert restored.min() > -0.05, "a dark ring appears beside the highlight"
    far = np.s_[20:130, 10:40]
    assert np.abs(restored - sharp)[far].mean() < np.abs(recorded - sharp)[far].mean()


def test_a_highlight_does_not_affect_the_rest_of_its_tiles() -> None:
    """Outside the highlight's streak a tile is as sharp as in the scene without the highlight."""
    sharp, blurred, kernel = _lamp_behind_a_blur()
    dim = np.minimum(sharp, 0.3)
    without = cv2.filter2D(dim, cv2.CV_32F, kernel)
    plain, none = _with_lamp_tamed(without, kernel)
    assert none == []
    expected = _filtered_with_lamps(plain, without)
    recorded = np.minimum(blurred, 1)
    tamed, _ = _with_lamp_tamed(recorded, kernel)
    found = _filtered_with_lamps(tamed, recorded)
    beside = np.ones(sharp.shape, bool)
    beside[45:101, 75:135] = False
    beside[:16], beside[-16:], beside[:, :16], beside[:, -16:] = False, False, False, False
    with_lamp, without_lamp, before = (np.abs(p - sharp)[beside].mean() for p in (found, expected, recorded))
    assert with_lamp < 1.05 * without_lamp < before


def test_only_tiles_near_a_hole_are_touched() -> None:
    """A hole touches the tiles whose margins reach it; an empty mask touches none."""
    grid = tile_grid(100, 300, 64, 16)
    deconvolution = TileDeconvolution(grid, np.repeat(_lopsided_kernel()[None], len(grid.centres_px), 0), 16)
    holes = np.zeros((100, 300), np.float32)
    assert deconvolution.touched(holes) == []
    holes[20, 70] = 1
    corners = list(grid.corners())
    expected = [n for n, (top, left) in enumerate(corners) if top - 16 <= 20 < top + 80 and left - 16 <= 70 < left + 80]
    assert deconvolution.touched(holes) == expected


def _stroke(across: bool) -> NDArray[np.float32]:
    kernel = np.zeros((15, 15), np.float32)
    cv2.line(kernel, *(((2, 7), (12, 7)) if across else ((7, 2), (7, 12))), 1.0)
    return kernel / kernel.sum()


def _joined(
    picture: Image,
    kernel: Image,
    further: Image,
    its_kernel: Image,
    sharpness: float = 1.0,
    ratio: float = 1e-3,
    trust: Image | None = None,
    weight: float = 1.0,
    variance: float | None = None,
) -> TileDeconvolution:
    """Tiles of a picture joined with a further one; a trust of None means trust everywhere."""
    grid = tile_grid(*picture.shape, 64, 16)
    count = len(grid.centres_px)
    deconvolution = TileDeconvolution(grid, np.repeat(kernel[None], count, 0), 16)
    sharp, noise = (np.full((deconvolution.size,) * 2, value, np.float32) for value in (sharpness, ratio))
    trust = np.ones_like(picture) if trust is None else trust
    kept = [(sharp, 1 - sharp * sharp)] * count
    spread = None if variance is None else np.full((deconvolution.size,) * 2, variance, np.float32)
    other = FurtherPicture([further], np.repeat(its_kernel[None], count, 0), kept, trust, weight, spread)
    deconvolution.join([picture], [other], noise)
    return deconvolution


def _blurred_by(sharp: Image, kernels: Sequence[Image], seed: int) -> list[Image]:
    """The picture blurred by each kernel, with independent noise."""
    rng = np.random.default_rng(seed)
    noise = (rng.normal(0, 0.01, sharp.shape).astype(np.float32) for _ in kernels)
    return [cv2.filter2D(sharp, cv2.CV_32F, kernel) + one for kernel, one in zip(kernels, noise, strict=True)]


def test_joining_a_picture_with_itself_adds_nothing() -> None:
    """A coder that repeats a still frame repeats its noise, so two equal measurements weigh as much as one."""
    picture, kernel = texture(100, 150).astype(np.float32), _lopsided_kernel()
    twice = _joined(picture, kernel, picture, kernel)
    once = TileDeconvolution(twice.grid, np.repeat(kernel[None], len(twice.grid.centres_px), 0), 16)
    np.testing.assert_allclose(twice.powers, once.powers, rtol=1e-4, atol=1e-9)
    projected = once.back_projected(picture)
    np.testing.assert_allclose(twice.back_projected(picture), projected, atol=1e-5 * np.abs(projected).max())


def test_a_picture_with_finer_coding_steps_weighs_more() -> None:
    """For two equally blurred pictures the data term is their mean, weighted by the other picture's weight."""
    kernel, (first, second) = _lopsided_kernel(), (texture(100, 150).astype(np.float32) * gain for gain in (1.0, 1.2))
    joined = _joined(first, kernel, second, kernel, weight=3.0)
    once = TileDeconvolution(joined.grid, np.repeat(kernel[None], len(joined.grid.centres_px), 0), 16)
    np.testing.assert_allclose(joined.powers, once.powers, rtol=1e-4, atol=1e-9)
    projected = once.back_projected(0.25 * first + 0.75 * second)
    np.testing.assert_allclose(joined.back_projected(first), projected, atol=1e-5 * np.abs(projected).max())


def test_another_blur_path_restores_lost_frequencies() -> None:
    """A horizontal and a vertical stroke each pass the frequencies the other cancels; together the error halves."""
    sharp = texture(140, 200).astype(np.float32)
    across, down = _stroke(True), _stroke(False)
    first, second = _blurred_by(sharp, (across, down), seed=3)

    def error(deconvolution: TileDeconvolution) -> float:
        ratio = np.full((deconvolution.size,) * 2, 1e-3, np.float32)
        projected = deconvolution.back_projected(first)
        restored = deconvolution.blend(deconvolution.solutions(projected, [ratio] * len(projected)))
        return float(np.mean((restored - sharp)[20:-20, 20:-20] ** 2))

    together = error(_joined(first, across, second, down))
    alone = error(_joined(first, across, first, across))
    assert together < 0.5 * alone


def test_a_neighbour_with_an_uncertain_place_weighs_less() -> None:
    """If the share s of the signal survives averaging, (1 − s²) |K|² of it is an error of the neighbour."""
    picture, across, down = texture(100, 150).astype(np.float32), _stroke(True), _stroke(False)
    known, uncertain = (_joined(picture, across, picture, down, sharpness).powers for sharpness in (1.0, 0.5))
    alone = TileDeconvolution(tile_grid(100, 150, 64, 16), np.repeat(across[None], len(known), 0), 16).powers
    gain_known, gain_uncertain = (float((powers - alone).clip(0).sum()) for powers in (known, uncertain))
    assert 0 < gain_uncertain < 0.2 * gain_known


def test_a_neighbour_with_an_uncertain_kernel_weighs_less() -> None:
    """The kernel's variance makes an error that takes most of the weight."""
    picture, across, down = texture(100, 150).astype(np.float32), _stroke(True), _stroke(False)
    known, uncertain = (_joined(picture, across, picture, down, variance=v).powers for v in (None, 0.1))
    alone = TileDeconvolution(tile_grid(100, 150, 64, 16), np.repeat(across[None], len(known), 0), 16).powers
    gain_known, gain_uncertain = (float((powers - alone).clip(0).sum()) for powers in (known, uncertain))
    assert 0 < gain_uncertain < 0.2 * gain_known


def test_untrusted_places_of_a_neighbour_change_nothing() -> None:
    """Where trust is 0 the neighbour's content has no effect; the same content with trust would change the result."""
    sharp = texture(140, 200).astype(np.float32)
    across, down = _stroke(True), _stroke(False)
    first, second = _blurred_by(sharp, (across, down), seed=4)
    trust, foreign = np.ones_like(sharp), second.copy()
    trust[50:90, 70:120], foreign[50:90, 70:120] = 0, 1
    left_out = [_joined(first, across, other, down, trust=trust).back_projected(first) for other in (second, foreign)]
    np.testing.assert_allclose(*left_out, atol=1e-4 * np.abs(left_out[0]).max())
    wrong = _joined(first, across, foreign, down).back_projected(first)
    assert np.abs(wrong - left_out[0]).max() > 0.01 * np.abs(left_out[0]).max()
