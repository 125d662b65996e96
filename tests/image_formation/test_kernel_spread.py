"""Kernels with an uncertain path."""

import numpy as np

from virest.image_formation.kernel_spread import kernel_spread
from virest.image_formation.kernels import KernelField

SIZE = 64


def _slanted(centres_px: np.ndarray) -> KernelField:
    """A path of (7, 3) px, slightly curved, about its middle."""
    part = (np.arange(40) + 0.5) / 40 - 0.5
    path = np.stack([7 * part, 3 * part + 2 * part**2], -1)
    return KernelField(centres_px, np.broadcast_to(path, (len(centres_px), 40, 2)), 0.5)


def test_the_variance_matches_randomly_drawn_paths(rng):
    """Var K from four points agrees with 1000 random path ends at frequencies with a period well above the spread."""
    covariance = np.array([[0.09, 0.03], [0.03, 0.04]])
    spread = kernel_spread(_slanted, 60, 40, covariance)
    assert spread is not None
    drawn = rng.multivariate_normal((0, 0), covariance, 1000)
    path = _slanted(np.zeros((1, 2))).paths_px[0]
    since = ((np.arange(40) + 0.5) / 40 - 0.5)[:, None]
    fx, fy = np.meshgrid(np.fft.rfftfreq(SIZE), np.fft.fftfreq(SIZE))
    low = np.hypot(fx, fy) < 0.2
    spectra = np.array(
        [np.exp(2j * np.pi * (fx[low][:, None] * p[:, 0] + fy[low][:, None] * p[:, 1])).mean(-1)
         for p in (path + since * end for end in drawn)]
    )  # fmt: skip
    expected = spectra.var(axis=0)
    np.testing.assert_allclose(spread.variance(SIZE)[low], expected, atol=0.25 * expected.max())


def test_frequencies_are_interpolated():
    """Spectra with many and with few frequencies agree at their common frequencies."""
    spread = kernel_spread(_slanted, 60, 40, np.array([[0.09, 0.03], [0.03, 0.04]]))
    assert spread is not None
    few, many = spread.variance(15), spread.variance(15 * 16)
    assert many.shape == (240, 121)
    np.testing.assert_allclose(many[::16, ::16], few, atol=1e-6)


def test_a_known_path_has_no_spread():
    """A zero covariance gives no spread."""
    assert kernel_spread(_slanted, 60, 40, np.zeros((2, 2))) is None
