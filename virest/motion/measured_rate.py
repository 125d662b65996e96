"""What the gyroscope's samples say between themselves, and the true rate behind a low pass.

The rate runs as a cubic spline m(t) through the samples.  Behind a second-order Butterworth low pass
(:mod:`virest.camera.gyro_filter`) the true rate is m + τ m′ + ½ τ² m″, exactly: on a cubic piece another cubic piece.

Derivatives enlarge the noise of the samples.  The best linear estimate of the true rate takes the derivatives of the
best estimate of m instead, whatever the filter (a linear function of a conditional mean is the conditional mean of that
function): of samples behind a Wiener filter, 1 − N/P at each frequency where P is more than chance, with P the power of
the samples there and N that of their noise, measured where the band ends.  The samples themselves stay as they are, so
that a filter of no delay changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, idct
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d
from scipy.special import gammainccinv

from virest.camera.gyro_filter import delay_s
from virest.capture.imu import ImuSamples
from virest.errors import ImuError

Array = NDArray[np.float64]
GAP_PERIODS = 5.0
"""A pause longer than this many median sample periods ends one spline and begins the next."""
LEAST_RUN = 32
"""Shorter runs of samples are not told from their noise, and taken as they are."""
NOISE_BAND = 0.75
"""From this part of the band up there is noise alone: 75 Hz at 200 samples/s, where a hand shakes at up to 15 Hz."""
BAND_PART = 40
"""The power at a frequency is the mean over this part of the band: some 30 values in 3 s at 400 samples/s."""
FALSE_ALARM = 1e-3
"""Probability that in samples of noise alone any part of the band is taken for a turn."""


@dataclass(frozen=True)
class MeasuredRate:
    """The rate as measured, whatever the profile: the work that is done once for a capture."""

    time_s: Array
    """(n,) the samples' times."""
    rate_rad_s: Array
    """(n, 3) IMU axes."""
    pieces: Array
    """(4, 3, n − 1) cubic pieces between the samples, highest power first, IMU axes."""

    def behind_low_pass(self, cutoff_hz: float) -> Array:
        """Pieces (4, 3, n − 1) of the rate that a low pass of this cutoff turned into the measured one; 0: none."""
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
        """Pieces as ``pieces``, of samples less the noise that their spectrum shows."""
        rate = self.rate_rad_s.copy()
        for run in _runs(self.time_s):
            if len(run) >= LEAST_RUN:
                rate[run] = without_noise(rate[run])
        return _pieces(self.time_s, rate)


def measured_rate(imu: ImuSamples) -> MeasuredRate:
    """Spline through the samples; straight lines across gaps and in runs too short for a spline.

    No profile changes it.  Raises ImuError if fewer than two samples are given.
    """
    if len(imu) < 2:
        raise ImuError(f"{len(imu)} gyroscope samples, at least 2 are needed", hint="check gyro_accel.csv")
    return MeasuredRate(imu.time_s, imu.gyro_rad_s, _pieces(imu.time_s, imu.gyro_rad_s))


def without_noise(samples: Array) -> Array:
    """Wiener estimate (n, k) of what evenly taken samples (n, k) have beside white noise, each column on its own.

    Cosine transforms mirror the samples at both ends, which therefore are no steps.
    """
    amplitude = dct(samples, axis=0, norm="ortho")
    band = max(len(samples) // BAND_PART, 5)
    power = uniform_filter1d(amplitude**2, band, axis=0, mode="nearest")
    noise = np.median(power[int(NOISE_BAND * len(samples)) :], axis=0)
    by_chance = 2 * gammainccinv(band / 2, FALSE_ALARM * band / len(samples)) / band  # chi-square of normal values
    kept = np.where(power > by_chance * noise, 1 - noise / np.maximum(power, 1e-300), 0.0)
    return np.asarray(idct(kept * amplitude, axis=0, norm="ortho"))


def _runs(time_s: Array) -> list[NDArray[np.intp]]:
    """Samples without a gap between them."""
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
