"""White noise of inertial sensors, measured on a log of a moving phone."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from virest.arrays import Array, Index
from virest.camera.kalibr import ImuNoise
from virest.capture.imu import ImuSamples
from virest.capture.join import GAP_PERIODS

LEAST_RUN = 32
"""Shorter runs of samples without a gap are not analysed."""
NOISE_BAND = 0.75
"""Above this fraction of the band there is only noise: 75 Hz at 200 samples/s, while hand shake ends at 15 Hz."""
WHITE_BAND_HZ = (20.0, 45.0)
"""Frequencies of white noise alone: above those of hand shake, and below those that a phone's own low pass weakens."""
MOST_WEAKENED = 3.0
"""How many times that low pass weakens noise at the end of the band: one of 60 Hz at 100 Hz.  What exceeds it below is
vibration, as in a car, and no noise."""
WHITE_WINDOW_S = 1.0
"""Length of the windows in which it is measured."""
BLACKMAN_HARRIS = np.array([0.35875, -0.48829, 0.14128, -0.01168])
"""A window that keeps a hand's motion 92 dB out of other frequencies (Harris 1978, doi:10.1109/PROC.1978.10837)."""


def measure_imu_noise(imu: ImuSamples) -> ImuNoise | None:
    """Sampling rate and noise densities of a log; None for fewer than LEAST_RUN samples.

    Densities are None where too few samples, or none above 20 Hz, determine them, as without an accelerometer.
    """
    if len(imu) < LEAST_RUN:
        return None
    rate_hz = 1.0 / float(np.median(np.diff(imu.time_s)))
    return ImuNoise(rate_hz, noise_density(imu.time_s, imu.gyro_rad_s), noise_density(imu.time_s, imu.accel_m_s2))


def noise_density(time_s: Array, samples: Array) -> float | None:
    """Density of the white noise of samples (n, k), their unit per √Hz, the mean power of the axes; None: unknown.

    The integral over T has a standard deviation of √T times that.  Measured between 20 and 45 Hz, so that neither hand
    shake nor a sensor's own low pass changes it.
    """
    known = np.isfinite(samples).all(axis=1)
    time_s, samples = time_s[known], samples[known]
    densities, weights = [], []
    for run in runs_without_gap(time_s):
        step_s = float(np.median(np.diff(time_s[run]))) if len(run) >= LEAST_RUN else np.inf
        if 2 * WHITE_BAND_HZ[0] * step_s > 1:
            continue
        frequency_hz, power = _power_density(samples[run], step_s)
        inside = (frequency_hz > WHITE_BAND_HZ[0]) & (frequency_hz < WHITE_BAND_HZ[1])
        above = frequency_hz > NOISE_BAND * frequency_hz[-1]
        if inside.any():
            densities.append(min(power[inside].mean(), MOST_WEAKENED**2 * power[above].mean()))
            weights.append(len(run))
    return (float(np.sqrt(np.average(densities, weights=weights))) or None) if densities else None


def runs_without_gap(time_s: Array) -> list[Index]:
    """Numbers of the samples of each run without a gap."""
    step = np.diff(time_s)
    typical = np.median(step) if len(step) else 0.0
    return np.split(np.arange(len(time_s)), np.flatnonzero(step > GAP_PERIODS * typical) + 1)


def _power_density(samples: Array, step_s: float) -> tuple[Array, Array]:
    """Frequencies, Hz, and the mean power per Hz, negative frequencies apart, of samples (n, k) in their windows.

    Welch 1967 (doi:10.1109/TAU.1967.1161901): windows overlap by half, and a line is subtracted from each.
    """
    length = min(len(samples), round(WHITE_WINDOW_S / step_s))
    parts = sliding_window_view(samples, length, axis=0)[:: max(length // 2, 1)]
    line = np.linspace(-1.0, 1.0, length)
    parts = parts - parts.mean(axis=-1, keepdims=True)
    parts = parts - (parts @ line / (line @ line))[..., None] * line
    angle = 2 * np.pi * np.arange(length) / length
    window = BLACKMAN_HARRIS @ np.cos(np.arange(4)[:, None] * angle)
    power = np.abs(np.fft.rfft(parts * window)) ** 2 * (step_s / (window @ window))
    return np.asarray(np.fft.rfftfreq(length, step_s)), np.asarray(power.mean(axis=(0, 1)))
