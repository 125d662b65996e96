"""The gyroscope's rate between samples, and the true rate before its low-pass filter.

The rate is a cubic spline m(t) through the samples.  Before a second-order Butterworth low-pass filter
(:mod:`virest.camera.gyro_filter`) the true rate is exactly m + τ m′ + ½ τ² m″: again a cubic on each piece.

Derivatives amplify the noise of the samples.  The best linear estimate of the true rate therefore uses the derivatives
of the best estimate of m, for any filter (a linear function of a conditional mean is the conditional mean of that
function): samples after a Wiener filter, 1 − N/P at each frequency with significant power, with P the power of the
samples and N that of their noise, measured at the end of the band.  The samples themselves are kept, so that a filter
without delay changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.fft import dct, idct
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d
from scipy.special import gammainccinv

from virest.arrays import Array, Index
from virest.camera.gyro_filter import delay_s
from virest.capture.imu import ImuSamples
from virest.capture.join import GAP_PERIODS
from virest.errors import ImuError

LEAST_RUN = 32
"""Shorter runs of samples are not denoised."""
NOISE_BAND = 0.75
"""Above this fraction of the band there is only noise: 75 Hz at 200 samples/s, while hand shake ends at 15 Hz."""
BAND_PART = 40
"""The power at a frequency is the mean over 1 / this of the band: about 30 values in 3 s at 400 samples/s."""
WHITE_BAND_HZ = (20.0, 45.0)
"""Frequencies of white noise alone: above those of hand shake, and below those that a phone's own low pass weakens."""
MOST_WEAKENED = 3.0
"""How many times that low pass weakens noise at the end of the band: one of 60 Hz at 100 Hz.  What exceeds it below is
vibration, as in a car, and no noise."""
WHITE_WINDOW_S = 1.0
"""Length of the windows in which it is measured."""
BLACKMAN_HARRIS = np.array([0.35875, -0.48829, 0.14128, -0.01168])
"""A window that keeps a hand's motion 92 dB out of other frequencies (Harris 1978, doi:10.1109/PROC.1978.10837)."""
FALSE_ALARM = 1e-3
"""Probability that samples of pure noise have significant power anywhere in the band."""


@dataclass(frozen=True)
class MeasuredRate:
    """The measured rate, independent of the profile and computed once per capture."""

    time_s: Array
    """(n,) the samples' times."""
    rate_rad_s: Array
    """(n, 3) IMU axes."""
    pieces: Array
    """(4, 3, n − 1) cubic pieces between the samples, highest power first, IMU axes."""

    def behind_low_pass(self, cutoff_hz: float) -> Array:
        """Pieces (4, 3, n − 1) of the rate before a low-pass filter of this cutoff; 0: no filter."""
        delay = delay_s(cutoff_hz)
        if not delay:
            return self.pieces
        a, b, c, _ = self._without_noise
        undone = self.pieces.copy()
        undone[1] += 3 * a * delay
        undone[2] += 2 * b * delay + 3 * a * delay**2
        undone[3] += c * delay + b * delay**2
        return undone

    @cached_property
    def _without_noise(self) -> Array:
        """Like ``pieces``, from denoised samples."""
        rate = self.rate_rad_s.copy()
        for run in _runs(self.time_s):
            if len(run) >= LEAST_RUN:
                rate[run] = without_noise(rate[run])
        return _pieces(self.time_s, rate)


def measured_rate(imu: ImuSamples) -> MeasuredRate:
    """Spline through the samples; linear across gaps and in runs too short for a spline.

    Independent of the profile.  Raises ImuError for fewer than two samples.
    """
    if len(imu) < 2:
        raise ImuError(f"{len(imu)} gyroscope samples, at least 2 are needed", hint="check gyro_accel.csv")
    return MeasuredRate(imu.time_s, imu.gyro_rad_s, _pieces(imu.time_s, imu.gyro_rad_s))


def noise_density(measured: MeasuredRate) -> float:
    """Density of the rate's white noise, rad/s/√Hz, the mean power of the three axes; 0 for too few samples.

    A rotation integrated over T has a standard deviation of √T times that.  Unlike the differences of adjacent samples
    that :func:`virest.camera.kalibr.measure_imu_noise` takes, it holds for a gyroscope with a low-pass filter.
    """
    densities, weights = [], []
    for run in _runs(measured.time_s):
        if len(run) < LEAST_RUN:
            continue
        step_s = float(np.median(np.diff(measured.time_s[run])))
        frequency_hz, power = _power_density(measured.rate_rad_s[run], step_s)
        inside = (frequency_hz > WHITE_BAND_HZ[0]) & (frequency_hz < WHITE_BAND_HZ[1])
        above = frequency_hz > NOISE_BAND * frequency_hz[-1]
        if inside.any():
            densities.append(min(power[inside].mean(), MOST_WEAKENED**2 * power[above].mean()))
            weights.append(len(run))
    return float(np.sqrt(np.average(densities, weights=weights))) if densities else 0.0


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


def without_noise(samples: Array) -> Array:
    """Wiener estimate (n, k) of the signal in evenly spaced samples (n, k) with white noise, column by column.

    The cosine transform mirrors the samples at both ends, which avoids steps there.
    """
    amplitude = dct(samples, axis=0, norm="ortho")
    band = max(len(samples) // BAND_PART, 5)
    power = uniform_filter1d(amplitude**2, band, axis=0, mode="nearest")
    noise = np.median(power[int(NOISE_BAND * len(samples)) :], axis=0)
    by_chance = 2 * gammainccinv(band / 2, FALSE_ALARM * band / len(samples)) / band  # chi-square of normal values
    kept = np.where(power > by_chance * noise, 1 - noise / np.maximum(power, 1e-300), 0.0)
    return np.asarray(idct(kept * amplitude, axis=0, norm="ortho"))


def _runs(time_s: Array) -> list[Index]:
    """Runs of samples without gaps."""
    step = np.diff(time_s)
    return np.split(np.arange(len(time_s)), np.flatnonzero(step > GAP_PERIODS * np.median(step)) + 1)


def _pieces(time_s: Array, rate: Array) -> Array:
    """Cubic pieces (4, 3, n − 1), highest power first."""
    step = np.diff(time_s)
    pieces = np.zeros((4, 3, len(step)))
    pieces[2] = np.diff(rate.T) / step
    pieces[3] = rate[:-1].T
    for run in _runs(time_s):
        if len(run) >= 4:
            spline = CubicSpline(time_s[run], rate[run], axis=0)
            pieces[:, :, run[0] : run[-1]] = np.swapaxes(spline.c, 1, 2)
    return pieces
