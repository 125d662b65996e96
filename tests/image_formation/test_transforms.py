"""Both libraries' transforms give the same packed spectra, and the choice between them depends on no timing."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from virest.image_formation import transforms
from virest.image_formation.blur import FAST_SIZES, SpaceVariantBlur, tile_grid

SIZES = [(4, 4), (8, 6), (64, 80), (128, 128), (192, 160)]


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_pocketfft_packs_as_opencv_does(height: int, width: int, rng: np.random.Generator) -> None:
    """Spectra of both libraries are equal, so filters and products work with either."""
    picture = rng.normal(size=(height, width)).astype(np.float32)
    packed = np.empty_like(picture)
    assert transforms.pocketfft_forward(picture, packed) is packed
    np.testing.assert_allclose(packed, cv2.dft(picture), atol=1e-4 * np.sqrt(height * width))


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_pocketfft_reads_packed_spectra(height: int, width: int, rng: np.random.Generator) -> None:
    """OpenCV's spectra are inverted into a given array and into a new one, and are not changed."""
    picture = rng.normal(size=(height, width)).astype(np.float32)
    spectrum, into = cv2.dft(picture), np.empty_like(picture)
    kept = spectrum.copy()
    assert transforms.pocketfft_inverse(spectrum, into) is into
    np.testing.assert_allclose(into, picture, atol=1e-5)
    np.testing.assert_array_equal(transforms.pocketfft_inverse(spectrum), into)
    np.testing.assert_array_equal(spectrum, kept)


@pytest.mark.parametrize("ipp", [True, False])
def test_the_library_follows_from_build_and_size(ipp: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """With IPP it is always OpenCV; without it, pocketfft for large tiles with even sides, as all fast sizes have."""
    monkeypatch.setattr(cv2.ipp, "useIPP", lambda: ipp)
    large = transforms.POCKETFFT if not ipp else transforms.OPENCV
    for size in FAST_SIZES:
        wanted = large if size >= transforms.LEAST_POCKETFFT_PX else transforms.OPENCV
        assert transforms.library(size, size) == wanted
    assert transforms.library(1125, 1125) == transforms.OPENCV


def test_a_round_trip_returns_the_picture_without_ipp(rng: np.random.Generator, monkeypatch) -> None:
    """The forward and inverse transforms belong to the same library."""
    monkeypatch.setattr(cv2.ipp, "useIPP", lambda: False)
    picture = rng.normal(size=(192, 192)).astype(np.float32)
    np.testing.assert_allclose(transforms.inverse(transforms.forward(picture)), picture, atol=1e-5)


def test_both_libraries_give_the_same_blur(rng: np.random.Generator, monkeypatch) -> None:
    """Only rounding differs."""
    grid = tile_grid(210, 260, 128, 32)
    kernels = rng.random((len(grid.centres_px), 11, 11)).astype(np.float32)
    light = rng.random((220, 270)).astype(np.float32)
    blurred = []
    for ipp in (True, False):
        monkeypatch.setattr(cv2.ipp, "useIPP", lambda ipp=ipp: ipp)
        blurred.append(SpaceVariantBlur(grid, kernels).apply(light))
    assert not np.array_equal(*blurred), "the same library ran twice"
    np.testing.assert_allclose(*blurred, rtol=1e-5)
