"""The gyroscope's rate between samples, and the true rate before its low-pass filter.

The rate is a cubic spline m(t) through the samples.  Before a filter of delay τ and averaging time σ
(:mod:`virest.camera.gyro_filter`) the true rate is m + τ m′ + ½ (τ² − σ²) m″: again a cubic on each piece.  A mean over
a window around each timestamp is undone at the samples, by its response at each frequency.

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
from scipy.fft import dct, idct
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d
from scipy.special import gammainccinv

from virest.arrays import Array
from virest.camera.gyro_filter import delay_s, inverse_bend_s2, window_s
from virest.capture.imu import ImuSamples
from virest.capture.imu_noise import LEAST_RUN, NOISE_BAND, runs_without_gap
from virest.errors import ImuError

BAND_PART = 40
"""The power at a frequency is the mean over 1 / this of the band: about 30 values in 3 s at 400 samples/s."""
LEAST_RESPONSE = 0.25
"""A mean over a window is undone up to the frequency where it leaves this much: 0.81 / window."""
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

    def before_filter(self, cutoff_hz: float, averaging_s: float = 0.0) -> Array:
        """Pieces (4, 3, n − 1) of the rate before a filter of this cutoff and averaging time; 0, 0: no filter."""
        delay, bend = delay_s(cutoff_hz), inverse_bend_s2(cutoff_hz, averaging_s)
        if not delay and not averaging_s:
            return self.pieces
        undone, clean = self.pieces.copy(), self._without_noise
        if window := window_s(cutoff_hz, averaging_s):
            before_mean = self._denoised(window)
            undone, clean = undone + before_mean - clean, before_mean
        a, b, c, _ = clean
        undone[1] += 3 * a * delay
        undone[2] += 2 * b * delay + 6 * a * bend
        undone[3] += c * delay + 2 * b * bend
        return undone

    @cached_property
    def _without_noise(self) -> Array:
        """Like ``pieces``, from denoised samples."""
        return self._denoised(0.0)

    def _denoised(self, window_s: float) -> Array:
        """The same for the rate whose means over this window the denoised samples are.

        Timestamps jitter: the spline is denoised at even times, since a second derivative would amplify their jitter.
        """
        rate = self.rate_rad_s.copy()
        for run in runs_without_gap(self.time_s):
            if len(run) >= LEAST_RUN:
                time_s = self.time_s[run]
                even_s, step_s = np.linspace(time_s[0], time_s[-1], len(run), retstep=True)
                even = without_noise(CubicSpline(time_s, rate[run])(even_s), window_s / float(step_s))
                rate[run] = CubicSpline(even_s, even)(time_s)
        return _pieces(self.time_s, rate)


def measured_rate(imu: ImuSamples) -> MeasuredRate:
    """Spline through the samples; linear across gaps and in runs too short for a spline.

    Independent of the profile.  Raises ImuError for fewer than two samples.
    """
    if len(imu) < 2:
        raise ImuError(f"{len(imu)} gyroscope samples, at least 2 are needed", hint="check gyro_accel.csv")
    return MeasuredRate(imu.time_s, imu.gyro_rad_s, _pieces(imu.time_s, imu.gyro_rad_s))


def without_noise(samples: Array, window: float = 0.0) -> Array:
    """Wiener estimate (n, k) of the signal in evenly spaced samples (n, k) with white noise, column by column.

    The cosine transform mirrors the samples at both ends, which avoids steps there.  window: the signal's means over
    this many samples were recorded.
    """
    amplitude = dct(samples, axis=0, norm="ortho")
    band = max(len(samples) // BAND_PART, 5)
    power = uniform_filter1d(amplitude**2, band, axis=0, mode="nearest")
    noise = np.median(power[int(NOISE_BAND * len(samples)) :], axis=0)
    by_chance = 2 * gammainccinv(band / 2, FALSE_ALARM * band / len(samples)) / band  # chi-square of normal values
    kept = np.where(power > by_chance * noise, 1 - noise / np.maximum(power, 1e-300), 0.0)
    response = np.maximum(np.sinc(np.arange(len(samples))[:, None] * window / (2 * len(samples))), LEAST_RESPONSE)
    return np.asarray(idct(kept / response * amplitude, axis=0, norm="ortho"))


def _pieces(time_s: Array, rate: Array) -> Array:
    """Cubic pieces (4, 3, n − 1), highest power first."""
    step = np.diff(time_s)
    pieces = np.zeros((4, 3, len(step)))
    pieces[2] = np.diff(rate.T) / step
    pieces[3] = rate[:-1].T
    for run in runs_without_gap(time_s):
        if len(run) >= 4:
            spline = CubicSpline(time_s[run], rate[run], axis=0)
            pieces[:, :, run[0] : run[-1]] = np.swapaxes(spline.c, 1, 2)
    return pieces
