"""White noise of inertial sensors, measured on logs of a moving phone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from virest.capture.imu import ImuSamples
from virest.capture.imu_noise import measure_imu_noise, noise_density

TIME_S = np.arange(0, 3, 0.005)


@pytest.mark.parametrize("rate_hz", [100.0, 150.0, 400.0])
def test_noise_is_measured_during_hand_motion(rng: np.random.Generator, rate_hz: float) -> None:
    """White noise on rotations of up to 2 rad/s at 3 Hz is measured within 10 % at any sampling rate."""
    time_s = np.arange(int(30 * rate_hz)) / rate_hz
    swing = np.exp(-((time_s - 11) ** 2) / 50)[:, None] * np.sin(2 * np.pi * 3 * time_s[:, None] + [0.0, 1.0, 2.0])
    gyro = 2 * swing + rng.normal(0, 0.003, swing.shape)
    accel = 3 * swing + [0, 9.8, 0] + rng.normal(0, 0.04, swing.shape)
    found = measure_imu_noise(ImuSamples(time_s, gyro, accel))
    assert found is not None
    assert found.update_rate_hz == pytest.approx(rate_hz)
    assert found.gyro_density == pytest.approx(0.003 / np.sqrt(rate_hz), rel=0.1)
    assert found.accel_density == pytest.approx(0.04 / np.sqrt(rate_hz), rel=0.1)


def test_unmeasurable_noise_is_unknown(rng: np.random.Generator) -> None:
    """Too few samples give no result; without accelerometer, or at 30 samples/s and less, there is no density."""
    gyro, none = rng.normal(0, 0.01, (600, 3)), np.full((600, 3), np.nan)
    assert measure_imu_noise(ImuSamples(TIME_S[:20], gyro[:20], none[:20])) is None
    found = measure_imu_noise(ImuSamples(TIME_S, gyro, none))
    assert found is not None
    assert found.accel_density is None
    assert found.gyro_density is not None
    assert noise_density(TIME_S * 200 / 30, gyro) is None
    assert noise_density(TIME_S * 200 / 0.3, gyro) is None


def test_neither_motion_nor_low_pass_nor_vibration_changes_it(rng: np.random.Generator) -> None:
    """Shaking by 1 rad/s and a phone's 60 Hz low pass do not change it; vibration at 30 Hz is no noise."""
    true = 0.01 / np.sqrt(200)
    shaking = np.cos(2 * np.pi * 3.1 * TIME_S)[:, None] * [1.0, 0.6, 0.3]
    white = rng.normal(0, 0.01, (600, 3))
    fast = rng.normal(0, 0.01 * np.sqrt(10), (6000, 3))  # of the same density, at 2000 samples/s
    passed = signal.lfilter(*signal.butter(2, 60, fs=2000), fast, axis=0)[::10]
    vibration = 0.1 * np.cos(2 * np.pi * 30.0 * TIME_S + np.cumsum(rng.normal(0, 0.03, 600)))[:, None]
    assert noise_density(TIME_S, shaking + white) == pytest.approx(true, rel=0.2)
    assert noise_density(TIME_S, shaking + passed) == pytest.approx(true, rel=0.25)
    assert noise_density(TIME_S, shaking + vibration + 0.1 * white) < 0.6 * true


def test_a_gap_is_not_noise(rng: np.random.Generator) -> None:
    """Samples on both sides of a gap of half a second, between which the phone turned, are measured apart."""
    kept = (TIME_S < 1.2) | (TIME_S > 1.7)
    rate = rng.normal(0, 0.01, (600, 3)) + 3.0 * (TIME_S > 1.5)[:, None]
    assert noise_density(TIME_S[kept], rate[kept]) == pytest.approx(0.01 / np.sqrt(200), rel=0.2)
