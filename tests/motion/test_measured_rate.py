"""The rate before a gyroscope's low-pass filter: exact without noise, regularised with noise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from virest.camera.gyro_filter import cutoff_hz, delay_s
from virest.capture.imu import ImuSamples
from virest.motion.measured_rate import MeasuredRate, measured_rate, without_noise

TIME_S = np.arange(0, 3, 0.005)
CUTOFF_HZ = 10.0


def measured(rate: np.ndarray, time_s: np.ndarray = TIME_S) -> MeasuredRate:
    """The same rate on all three axes."""
    gyro = np.stack([rate] * 3, axis=1)
    return measured_rate(ImuSamples(time_s, gyro, np.full_like(gyro, np.nan)))


def filtered(frequency_hz: float, time_s: np.ndarray = TIME_S) -> np.ndarray:
    """The filter's output for cos(2π f t), with the response H = 1 / (1 − x² + i √2 x) and x = f / cutoff."""
    x = frequency_hz / CUTOFF_HZ
    return np.real(np.exp(2j * np.pi * frequency_hz * time_s) / (1 - x**2 + 1j * np.sqrt(2) * x))


@pytest.mark.parametrize("frequency_hz", [1.0, 4.0, 9.0])
@pytest.mark.parametrize("jitter", [0.0, 0.1])
def test_a_low_pass_is_inverted(frequency_hz: float, jitter: float) -> None:
    """The original cosine is recovered at samples inside the log, which may be up to 0.1 steps off their raster."""
    time_s = TIME_S + 0.005 * np.random.default_rng(6).uniform(-jitter, jitter, len(TIME_S))
    pieces = measured(filtered(frequency_hz, time_s), time_s).before_filter(CUTOFF_HZ)
    true = np.cos(2 * np.pi * frequency_hz * time_s)
    np.testing.assert_allclose(pieces[3, 0, 80:-80], true[80:-81], atol=0.02)


@pytest.mark.parametrize(
    ("response", "delay", "averaging_s"),
    [
        (lambda s: 1 / (1 + 0.008 * s), 0.008, 0.008),
        (lambda s: 1 / (1 + 0.005 * s) ** 2, 0.01, np.sqrt(2) * 0.005),
        (lambda s: np.sinh(0.012 * s) / (0.012 * s), 0.0, 0.024 / np.sqrt(12)),
        (lambda s: np.exp(-0.012 * s) * np.sinh(0.012 * s) / (0.012 * s), 0.012, 0.024 / np.sqrt(12)),
    ],
    ids=["first order", "two equal stages", "mean around its timestamp", "mean before its timestamp"],
)
def test_filters_of_other_families_are_inverted_by_their_delay_and_averaging(
    response: Callable[[complex], complex], delay: float, averaging_s: float
) -> None:
    """A rotation of 5 Hz is recovered to 0.1 % where the same delay alone leaves 2 to 3 %."""
    s = 2j * np.pi * 5.0
    true = np.exp(s * TIME_S)
    rate = measured(np.real(response(s) * true))
    cutoff = cutoff_hz(delay)
    both, flat = (rate.before_filter(cutoff, width)[3, 0, 80:-80] for width in (averaging_s, 0.0))
    np.testing.assert_allclose(both, np.real(true)[80:-81], atol=0.002)
    assert np.abs(flat - np.real(true)[80:-81]).max() > 0.02


def test_no_filter_or_a_high_cutoff_changes_nothing() -> None:
    """A cutoff of 0 means no filter; at 10 kHz a rate of 4 Hz hardly changes."""
    rate = measured(filtered(4.0))
    assert rate.before_filter(0.0) is rate.pieces
    np.testing.assert_allclose(rate.before_filter(1e4)[3], rate.pieces[3], atol=1e-3)


def test_inverting_the_filter_hardly_amplifies_noise() -> None:
    """With white noise of 0.01 rad/s, a plain inverse amplifies noise 100 times at 100 Hz."""
    noise = np.random.default_rng(5).normal(0, 0.01, len(TIME_S))
    clean, noisy = (measured(filtered(3.0) + n).before_filter(CUTOFF_HZ)[3, 0] for n in (0 * noise, noise))
    spline, delay = CubicSpline(TIME_S, noise), delay_s(CUTOFF_HZ)
    bare = noise + delay * spline(TIME_S, 1) + 0.5 * delay**2 * spline(TIME_S, 2)
    assert np.std((noisy - clean)[40:-40]) < 0.1 * np.std(bare[40:-40])


def test_noise_is_removed_and_a_rate_is_kept(rng: np.random.Generator) -> None:
    """Pure noise is mostly removed; a rate ten times larger is kept within a few percent."""
    noise = rng.normal(0, 0.01, (600, 1))
    assert without_noise(noise).std() < 0.005
    rate = 0.1 * np.cos(2 * np.pi * 3.0 * TIME_S)[:, None]
    assert (without_noise(rate + noise) - rate).std() < 0.005


def test_cutoff_and_delay_are_inverse_functions() -> None:
    """40 Hz gives a delay of 5.6 ms; 0 means no filter for both."""
    assert delay_s(40.0) == pytest.approx(5.627e-3, rel=1e-3)
    assert cutoff_hz(delay_s(17.0)) == pytest.approx(17.0)
    assert delay_s(0.0) == cutoff_hz(0.0) == 0.0
