"""Fidelity measures compared with other libraries and hand calculations."""

import cv2
import numpy as np
import pytest

from virest.evaluation.fidelity import (
    difference_map,
    fidelity,
    mean_squared_error,
    psnr_of,
    shift_px,
    structural_similarity,
)


@pytest.fixture
def pair(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A smooth colour picture, not square, and a noisy version with another contrast."""
    truth = cv2.resize(rng.uniform(20, 220, (9, 13, 3)).astype(np.float32), (97, 61), interpolation=cv2.INTER_CUBIC)
    noisy = truth * 0.9 + 14 + rng.normal(0, 7, truth.shape)
    return tuple(np.clip(np.rint(p), 0, 255).astype(np.uint8) for p in (noisy, truth))  # type: ignore[return-value]


def test_mse_psnr_and_ssim_are_those_of_scikit_image(pair) -> None:
    """The three measures of the paper's tables agree with scikit-image's."""
    metrics = pytest.importorskip("skimage.metrics")
    picture, truth = pair
    found = fidelity(picture, truth)
    assert found.mse == pytest.approx(metrics.mean_squared_error(truth, picture), rel=1e-12)
    assert found.psnr_db == pytest.approx(metrics.peak_signal_noise_ratio(truth, picture), rel=1e-12)
    peer = metrics.structural_similarity(
        truth, picture, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=255
    )
    assert found.ssim == pytest.approx(peer, abs=1e-6)


@pytest.mark.parametrize(("mse", "psnr_db"), [(4456.26, 11.6411), (3853.14, 12.2727), (2959.96, 13.418)])
def test_mse_and_psnr_are_consistent(mse: float, psnr_db: float) -> None:
    """The pairs are those of the paper's Table 3 with its swapped MSE column corrected."""
    assert psnr_of(mse) == pytest.approx(psnr_db, abs=1e-3)


def test_equal_pictures_have_no_difference(pair) -> None:
    """The PSNR is infinite, the SSIM 1, and the difference map black."""
    _, truth = pair
    assert fidelity(truth, truth).psnr_db == float("inf")
    assert structural_similarity(truth, truth) == pytest.approx(1.0)
    assert not difference_map(truth, truth).any()


def test_grey_levels_do_not_wrap_around() -> None:
    """|10 − 250| is 240, in the error and in the map."""
    dark, light = (np.full((21, 33), level, np.uint8) for level in (10, 250))
    assert mean_squared_error(dark, light) == 240.0**2
    assert np.unique(difference_map(dark, light)).tolist() == [240]


def test_a_subpixel_shift_is_measured(pair) -> None:
    """A picture moved right and up has a shift of (+, −) relative to its truth."""
    _, truth = pair
    moved = cv2.warpAffine(truth, np.array([[1, 0, 0.7], [0, 1, -0.4]]), truth.shape[1::-1], flags=cv2.INTER_CUBIC)
    np.testing.assert_allclose(shift_px(moved, truth, (0, 0, 97, 61), 6), [0.7, -0.4], atol=0.06)
