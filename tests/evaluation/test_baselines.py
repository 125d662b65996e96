"""Baselines remove a blur of their own model, with the frame's own kernels."""

import sys

import cv2
import numpy as np
import pytest

from virest.evaluation.baselines import BASELINES, Baseline, blended, deconvolved_inside
from virest.evaluation.dong2020 import centred_spectrum, filtered, poisson_tv_l0
from virest.evaluation.matching import count_matches


@pytest.fixture
def psf() -> np.ndarray:
    """A curved, uneven path whose centre differs from its centre of mass."""
    kernel = np.zeros((9, 9), np.float32)
    kernel[[1, 2, 3, 4, 4, 5], [2, 3, 3, 4, 5, 7]] = [0.3, 0.2, 0.1, 0.2, 0.1, 0.1]
    return kernel


@pytest.fixture
def sharp(rng: np.random.Generator) -> np.ndarray:
    """Light with edges and letters, not square."""
    grey = cv2.resize(rng.integers(20, 200, (12, 17), np.uint8), (170, 120), interpolation=cv2.INTER_NEAREST)
    cv2.putText(grey, "edges", (12, 70), cv2.FONT_HERSHEY_SIMPLEX, 1.4, 240, 3)
    return grey.astype(np.float32) / 255


def blurred(sharp: np.ndarray, psf: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A true convolution, mirrored at the edges, with a little noise."""
    light = cv2.filter2D(sharp, -1, psf[::-1, ::-1].copy(), borderType=cv2.BORDER_REFLECT)
    return np.maximum(light + rng.normal(0, 0.004, light.shape), 0).astype(np.float32)


@pytest.mark.parametrize("name", BASELINES)
def test_a_baseline_removes_the_blur_of_its_own_kernel(name: str, sharp, psf, rng: np.random.Generator) -> None:
    """With the true kernel, its best setting at least halves the squared error of the blur."""
    baseline = BASELINES[name]
    if not baseline.available:
        pytest.skip(f"{baseline.library} is not installed")
    observed = blurred(sharp, psf, rng)
    inner = np.s_[10:-10, 10:-10]

    def error(plane: np.ndarray) -> float:
        return float(np.mean((plane - sharp)[inner] ** 2))

    found = [
        error(deconvolved_inside(lambda p, s=setting: baseline.deconvolve(p, psf, s), observed, psf))
        for setting in baseline.settings
    ]
    assert min(found) < 0.5 * error(observed)


def test_a_kernel_s_spectrum_convolves_about_its_centre(psf) -> None:
    """A point of light becomes the kernel, centred at the point."""
    point = np.zeros((24, 31), np.float32)
    point[11, 17] = 1
    spread = filtered(point, psf, lambda k: k)
    np.testing.assert_allclose(spread[7:16, 13:22], psf, atol=1e-6)
    assert centred_spectrum(psf, (24, 31))[0, 0] == pytest.approx(1.0)


def test_stronger_weights_make_flatter_pictures(sharp, psf, rng: np.random.Generator) -> None:
    """Total variation decreases with its weight, and no value is negative."""
    observed = blended(blurred(sharp, psf, rng), 16)
    variations = []
    for tv in (1.0, 30.0, 900.0):
        found = poisson_tv_l0(observed, psf, tv, l0=0.0)
        assert found.min() >= 0
        variations.append(float(np.abs(np.diff(found, axis=1)).sum()))
    assert variations[0] > variations[1] > variations[2]


def test_a_blended_border_has_no_step(rng: np.random.Generator) -> None:
    """A slope with very different ends continues around the edges without a jump."""
    slope = np.add.outer(np.linspace(0, 3, 40), np.linspace(0, 1, 50)).astype(np.float32)
    wide = blended(slope, 12)
    np.testing.assert_array_equal(wide[12:52, 12:62], slope)
    steps = [np.abs(wide - np.roll(wide, 1, axis=axis)).max() for axis in (0, 1)]
    assert max(steps) < 0.5


def test_a_missing_library_makes_a_baseline_unavailable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Importing the package loads none of the optional libraries."""
    assert not Baseline(lambda p, k, s: p, (0,), "", library="no_such_library_here").available
    assert BASELINES["inverse"].available
    monkeypatch.delitem(sys.modules, "virest.evaluation.baselines")
    monkeypatch.setitem(sys.modules, "skimage", None)
    __import__("virest.evaluation.baselines")


def test_blur_reduces_matches_and_a_shift_moves_them(sharp, psf, rng: np.random.Generator) -> None:
    """A picture matches itself best and in place; shifted by 6 px it still matches, but not in place."""
    grey = np.clip(255 * sharp, 0, 255).astype(np.uint8)
    same = count_matches(grey, grey)
    assert same.good == same.in_place > 20
    blur = np.clip(255 * blurred(sharp, psf, rng), 0, 255).astype(np.uint8)
    assert count_matches(blur, grey).good < same.good
    moved = count_matches(np.roll(grey, 6, axis=1), grey)
    assert moved.good > 0.5 * same.good
    assert moved.in_place < 0.2 * moved.good
    assert count_matches(np.full_like(grey, 90), grey).good == 0
