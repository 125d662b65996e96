"""Black, white and noise by channel and grey level: weights of dark greys, and channels with different end levels."""

from __future__ import annotations

import numpy as np
import pytest
from bracket_making import GAMMA, SRGB, make_bracket, make_dark_jpegs, make_scans

from virest.calibration.bracket_samples import sample_bracket
from virest.calibration.grey_levels import channel_ends, grey_bins, pixel_noise, reliably_inside, scatter_by_grey
from virest.calibration.response_curve import curve_distance_levels, fit_response
from virest.camera.response import ResponseCurve


@pytest.fixture
def rng() -> np.random.Generator:
    """The same random numbers in every test."""
    return np.random.default_rng(0)


@pytest.mark.parametrize("read_noise", [12.0, 25.0])
def test_correct_dark_jpegs_are_not_reported_as_contradicting(read_noise: float) -> None:
    """Noise cut off at black brightens the darkest pictures; their exposures are still accepted."""
    fit = fit_response(make_dark_jpegs(SRGB, np.random.default_rng(1), read_noise=read_noise))
    assert not [p.file for p in fit.pictures if p.contradicts]
    errors = [p.exposure_error_ev for p in fit.pictures if p.exposure_error_ev is not None]
    assert len(errors) >= 6
    assert np.abs(errors).max() < 0.06
    assert curve_distance_levels(fit.curve, SRGB, fit.covered_exposure) < 3.0 * fit.curve_std_grey_levels


def test_scanned_film_with_different_channel_ends_has_a_curve(rng: np.random.Generator) -> None:
    """The curve is that of the channels' mean, and its deviation covers the distance of the channels from it."""
    ends = np.array([[5.0, 13.0, 25.0], [252.0, 245.0, 230.0]])
    fit = fit_response(make_scans(GAMMA, rng, ends))
    assert not any(p.contradicts for p in fit.pictures)
    assert any("channels end at different greys" in note for note in fit.notes)
    black, white = ends.mean(axis=1) / 255
    light = np.linspace(0.0, 1.0, 2000) ** 2.2
    grey = black + (white - black) * GAMMA.encode(light)
    truth = ResponseCurve("table", x=tuple(light.tolist()), y=tuple(grey.tolist()))
    assert curve_distance_levels(fit.curve, truth, fit.covered_exposure) < 2.0
    apart = np.abs(ends - ends.mean(axis=1, keepdims=True))
    assert apart.min() < fit.curve_std_grey_levels < apart.max()


def test_channels_of_an_ordinary_bracket_have_common_ends(rng: np.random.Generator) -> None:
    """Colours of the scene are not mistaken for end levels."""
    samples = sample_bracket(make_bracket(GAMMA, rng), rng)
    assert not samples.ends.differ


def test_channel_ends_are_the_saturated_greys(rng: np.random.Generator) -> None:
    """Greys that more light does not change give the ends. Equalised channels share them, and clipped values stay."""
    light = np.exp(rng.normal(-1.0, 2.0, (3, 1, 4000)))
    exposure = 2.0 ** np.arange(-10.0, 6.0)
    black, white = np.array([6.0, 14.0, 21.0]), np.array([250.0, 243.0, 231.0])
    grey = np.clip(light * exposure[:, None], 0.0, 1.0) ** (1 / 1.5)
    means = black[:, None, None] + (white - black)[:, None, None] * grey + rng.normal(0, 0.2, grey.shape)
    ends = channel_ends(means, exposure)
    np.testing.assert_allclose(ends.black, black, atol=1.0)
    np.testing.assert_allclose(ends.white, white, atol=0.5)
    rests = ends.equalised(means)[:, -1].max(axis=1)
    assert np.ptp(rests) < 1.5
    assert (ends.equalised(np.array([[0.0, 255.0]] * 3)) == [0.0, 255.0]).all()


def test_noise_is_a_table_by_grey_and_channel(rng: np.random.Generator) -> None:
    """Noise is higher in the dark and in blue; no straight line over grey describes both."""
    grey = rng.uniform(2, 253, (3, 20_000))
    true = np.array([1.0, 1.0, 4.0])[:, None] * (1.0 + 8.0 * np.exp(-grey / 30))
    pixels = 9
    variances = true * rng.chisquare(pixels - 1, grey.shape) / (pixels - 1)
    noise = pixel_noise(grey, variances, pixels)
    for c in range(3):
        wanted = np.array([1.0, 1.0, 4.0])[c] * (1.0 + 8.0 * np.exp(-noise.greys / 30))
        clear = noise.greys > 3 * np.sqrt(wanted)
        np.testing.assert_allclose(noise.variance[c][clear], wanted[clear], rtol=0.25)
    at = noise.at(np.array([[20.0], [20.0]]), np.array([0, 2]))
    assert at[1, 0] > 3 * at[0, 0]


def test_scatter_measures_noise_shared_by_a_square(rng: np.random.Generator) -> None:
    """Errors common to a square's pixels are recovered although the fit absorbed a quarter of them."""
    grey = np.tile(rng.uniform(6, 240, (4000, 1)), (1, 4))
    sigma = np.where(grey < 40, 2.0, 0.5)
    miss = sigma * rng.standard_normal(grey.shape)
    miss -= miss.mean(axis=1, keepdims=True)
    channel = np.zeros(len(grey), np.int64)
    found = scatter_by_grey(miss, grey, channel, np.ones(grey.shape, bool))[0]
    middles = grey_bins()[1]
    clear = (np.abs(middles - 40) > 15) & (middles < 230)
    np.testing.assert_allclose(np.sqrt(found[clear]), np.where(middles < 40, 2.0, 0.5)[clear], rtol=0.2)


def test_noise_does_not_decide_what_is_dark(rng: np.random.Generator) -> None:
    """Samples just below the limit are excluded even if noise lifts them above it."""
    light = np.linspace(0.0, 20.0, 2000)[:, None]
    grey = light + rng.normal(0, 1.0, light.shape)
    limits = np.full((2000, 1), 8.0), np.full((2000, 1), 250.0)
    fair = reliably_inside(grey, light, limits, np.ones(light.shape))
    assert not fair[light[:, 0] < 9.0].any()
    assert fair[light[:, 0] > 11.0].all()
