"""Expected rates in untrusted parts of a gyroscope log, with their covariance: a Gaussian process given the log around.

The process is of the Matérn kind, smoothness 5/2 (Rasmussen and Williams 2006, Gaussian Processes for Machine Learning,
eq 4.17), with the mean, variance, slope and noise of the log.  A clipped axis adds inequalities: what it could not read
lies beyond its limit, where readings clip and in the variance of the whole log.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special

from virest.arrays import Array
from virest.capture.imu import ImuSamples
from virest.inference.doubtful_log import CLIPPED, Stretch

SLOPE_STEP_S = 0.015
"""Time between the readings whose difference is a slope: far shorter than a swing of a hand, yet above the noise."""
LEAST_READINGS, MOST_READINGS = 20, 80
"""Trusted readings that tell noise and slope, else all do; most readings, about, on which rates are conditioned."""
LEAST_NOISE_RAD_S = 1e-3
"""Least noise of a reading: 0.06°/s, a step of a 16-bit gyroscope."""
CENSORED_STEPS, TRUNCATED_SWEEPS = 50, 20
"""Iterations for the moments of a log, and of a stretch: twice as many change a variance by less than 0.1 %."""


def rates_given_log(imu: ImuSamples, axis: int, time_s: Array, untrusted: Sequence[Stretch]) -> tuple[Array, Array]:
    """Mean (n,) and covariance (n, n) of an axis's rate at some times, given the readings outside untrusted stretches.

    time_s: ascending, IMU clock from stamp_0.  untrusted: stretches that include this axis.
    """
    rate, outside = imu.gyro_rad_s[:, axis], np.ones(len(imu), bool)
    beyond, side, least = np.zeros(len(imu)), np.zeros(len(time_s)), np.zeros(len(time_s))
    for stretch in untrusted:
        begun = stretch.from_s if stretch.from_s > imu.time_s[0] else -np.inf  # at an end of the log nothing is trusted
        ended = stretch.to_s if stretch.to_s < imu.time_s[-1] else np.inf
        inside = (imu.time_s > begun) & (imu.time_s < ended)
        outside &= ~inside
        if stretch.kind == CLIPPED and stretch.limit_rad_s is not None and inside.any():
            clipped_s, way = imu.time_s[inside], np.sign(rate[inside].mean())
            at_limit = (time_s >= clipped_s[0]) & (time_s <= clipped_s[-1])
            beyond[inside], side[at_limit], least[at_limit] = way, way, stretch.limit_rad_s
    known_s, known = imu.time_s[outside], rate[outside]
    usual_s, usual = (known_s, known) if len(known) >= LEAST_READINGS else (imu.time_s, rate)
    noise = max(float(np.mean(np.diff(usual, 3) ** 2)) / 20, LEAST_NOISE_RAD_S**2)
    slope = max(_slope_variance(usual_s, usual) - 2 * noise / SLOPE_STEP_S**2, noise / SLOPE_STEP_S**2)
    mean, variance = _censored_moments(rate, beyond)
    variance = max(variance - noise, noise)
    length_s = float(np.sqrt(5 / 3 * variance / slope))
    near = np.flatnonzero((known_s > time_s[0] - 2 * length_s) & (known_s < time_s[-1] + 2 * length_s))
    near = near[:: len(near) // MOST_READINGS + 1]
    known_s, known = known_s[near], known[near]

    def covariance(first_s: Array, second_s: Array) -> Array:
        apart = np.sqrt(5.0) * np.abs(first_s[:, None] - second_s) / length_s
        return np.asarray(variance * (1 + apart + apart**2 / 3) * np.exp(-apart))

    across = covariance(time_s, known_s)
    weights = np.linalg.solve(covariance(known_s, known_s) + noise * np.eye(len(known_s)), across.T).T
    left = covariance(time_s, time_s) - weights @ across.T + LEAST_NOISE_RAD_S**2 * np.eye(len(time_s))
    return _truncated(mean + weights @ (known - mean), left, side, least)


def _truncated(mean: Array, covariance: Array, side: Array, least: Array) -> tuple[Array, Array]:
    """Moments of a normal vector (n,) with ``side`` · value >= ``least`` for each entry whose side is not 0.

    Expectation propagation with one normal factor per inequality (Cunningham, Hennig and Lacoste-Julien 2011,
    arXiv:1111.6832).
    """
    precision, shift = np.zeros(len(mean)), np.zeros(len(mean))
    natural = np.linalg.solve(covariance, mean)
    now, spread = mean.copy(), covariance.copy()
    for _ in range(TRUNCATED_SWEEPS if side.any() else 0):
        for k in np.flatnonzero(side):
            left = 1 / max(1 / spread[k, k] - precision[k], 1e-12)
            centre = left * (now[k] / spread[k, k] - shift[k])
            deviation = float(np.sqrt(left))
            height = (side[k] * centre - least[k]) / deviation
            ratio = _inverse_mills(height)
            value, narrowed = centre + side[k] * deviation * ratio, left * max(1 - ratio * (height + ratio), 1e-6)
            added = max(1 / narrowed - 1 / left, 0.0) - precision[k]
            precision[k] += added
            shift[k] = value * (precision[k] + 1 / left) - centre / left
            column = spread[:, k].copy()
            spread -= (added / (1 + added * column[k])) * np.outer(column, column)
            now = spread @ (natural + shift)
    return now, spread


def _censored_moments(rate: Array, beyond: Array) -> tuple[float, float]:
    """Mean and variance of a normal rate (n,), some of whose values lie beyond what was read.

    beyond: 1 where a value is larger than the reading, -1 where it is smaller, else 0.  The EM algorithm for censored
    values (Dempster, Laird and Rubin 1977, section 4.2).
    """
    mean, variance = float(rate.mean()), max(float(rate.var()), LEAST_NOISE_RAD_S**2)
    side = beyond[beyond != 0]
    for _ in range(CENSORED_STEPS if len(side) else 0):
        deviation = np.sqrt(variance)
        height = side * (mean - rate[beyond != 0]) / deviation
        ratio = _inverse_mills(height)
        value, second = rate.copy(), np.zeros(len(rate))
        value[beyond != 0] = mean + side * deviation * ratio
        second[beyond != 0] = variance * (1 - ratio * (height + ratio))
        mean = float(value.mean())
        variance = float(np.mean((value - mean) ** 2 + second))
    return mean, variance


def _inverse_mills(height: Array) -> Array:
    """Normal density over the normal distribution, which does not overflow for heights far below 0."""
    return np.asarray(np.exp(-0.5 * np.square(height) - special.log_ndtr(height)) / np.sqrt(2 * np.pi))


def _slope_variance(time_s: Array, rate: Array) -> float:
    """Mean square slope, (rad/s²)², of a rate (n,) between readings about SLOPE_STEP_S apart."""
    later = np.searchsorted(time_s, time_s + SLOPE_STEP_S)
    first = np.flatnonzero(later < len(time_s))
    step_s = time_s[later[first]] - time_s[first]
    near = step_s <= max(2 * SLOPE_STEP_S, float(step_s.min()))
    return float(np.mean(((rate[later[first]] - rate[first])[near] / step_s[near]) ** 2))
