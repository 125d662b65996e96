"""A phone's gyroscope: filters, noise and timestamp jitter."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.simulation.hand_motion import FINE_STEP_S

SETTLING_PERIODS = 2.0
"""Periods of the corner frequency by which the filter starts before the first sample, settled at the first rate."""
LEAST_RESPONSE = 0.1
"""Filter response |H| below which a rate cannot be told from noise; regularises the inverse filter."""
MOST_JITTER = 0.45
"""Limit on the jitter, as a fraction of the shortest sampling interval, so that timestamps stay in order."""


def filtered_rate(
    rate_rad_s: Callable[[Array], Array],
    time_s: Array,
    corners_hz: Sequence[float],
    removed_delay_s: float = 0.0,
    window_s: float = 0.0,
) -> Array:
    """Rates (n, 3) at time_s after a cascade of causal second-order Butterworth filters and a mean over a window.

    removed_delay_s: filter delay that the recorder subtracts from the timestamps, see :func:`usual_delay_s`.  Each
    filter is solved exactly for a rate that is linear within steps of FINE_STEP_S.  window_s: the timestamps mark the
    window's middle.
    """
    from scipy.signal import butter, cont2discrete, lfilter, lfilter_zi  # with it all of `scipy.stats` is loaded

    begin_s = time_s[0] + removed_delay_s - sum(SETTLING_PERIODS / corner for corner in corners_hz) - window_s
    fine_s = np.arange(begin_s, time_s[-1] + removed_delay_s + window_s + 2 * FINE_STEP_S, FINE_STEP_S)
    filtered = rate_rad_s(fine_s)
    for corner_hz in corners_hz:
        analogue = butter(2, 2 * np.pi * corner_hz, analog=True)
        b, a, _ = cont2discrete(analogue, FINE_STEP_S, method="foh")
        state = lfilter_zi(b[0], a)[:, None] * filtered[0]
        filtered, _ = lfilter(b[0], a, filtered, axis=0, zi=state)
    at_s = time_s + removed_delay_s
    if not window_s:
        return np.stack([np.interp(at_s, fine_s, column) for column in filtered.T], axis=1)
    steps = 0.5 * (filtered[1:] + filtered[:-1]) * FINE_STEP_S
    angle = np.concatenate([np.zeros((1, filtered.shape[1])), np.cumsum(steps, axis=0)])
    ends = (at_s + 0.5 * window_s, at_s - 0.5 * window_s)
    after, before = (np.stack([np.interp(end, fine_s, column) for column in angle.T], axis=1) for end in ends)
    return np.asarray((after - before) / window_s)


def averaging_window_s(averaging_s: float) -> float:
    """Length of the window whose mean has this averaging time: √12 standard deviations of a uniform distribution."""
    return float(np.sqrt(12.0)) * averaging_s


def usual_delay_s(corner_hz: float) -> float:
    """Delay that a phone subtracts from the timestamps: the filter's group delay at low frequency, √2 / (2π f).

    Inertial sensors filter digitally before they output samples (InvenSense MPU-6050 register map, DLPF_CFG), and
    Android requires timestamps of when the event happened (Compatibility Definition, section 7.3).
    """
    return float(np.sqrt(2.0) / (2 * np.pi * corner_hz)) if corner_hz else 0.0


def before_filter(time_s: Array, rate_rad_s: Array, corner_hz: float, window_s: float = 0.0) -> Array:
    """Undo a gyroscope's filters: rates (n, 3) before them, for recreating a motion from a phone's log.

    Regularised inverse in the frequency domain, on an even grid mirrored at both ends:
    conj(H) (1 + ε²) / (|H|² + ε²), ε = LEAST_RESPONSE, so the gain at zero frequency is 1 and components with |H| < ε
    are suppressed.
    """
    count = max(int(np.ceil((time_s[-1] - time_s[0]) / float(np.median(np.diff(time_s))))) + 1, 2)
    even_s = np.linspace(time_s[0], time_s[-1], count)
    even = np.stack([np.interp(even_s, time_s, column) for column in rate_rad_s.T], axis=1)
    mirrored = np.concatenate([even, even[-2:0:-1]])
    frequency_hz = np.fft.rfftfreq(len(mirrored), even_s[1] - even_s[0])[:, None]
    response = np.sinc(frequency_hz * window_s).astype(complex)
    if corner_hz:
        part = frequency_hz / corner_hz
        response /= 1 - part**2 + 1j * np.sqrt(2.0) * part
    change = np.conj(response) / (np.abs(response) ** 2 + LEAST_RESPONSE**2) * (1 + LEAST_RESPONSE**2) - 1
    added = np.fft.irfft(change * np.fft.rfft(mirrored, axis=0), n=len(mirrored), axis=0)[:count]
    return rate_rad_s + np.stack([np.interp(time_s, even_s, column) for column in added.T], axis=1)


def gyro_noise(
    density: float, rate_hz: float, corners_hz: Sequence[float], shape: tuple[int, ...], rng: np.random.Generator
) -> Array:
    """White noise of a one-sided density (rad/s/√Hz) up to half the sampling rate, then low-pass filtered.

    The standard deviation before filtering is density · √(rate / 2): 0.01 rad/s for 0.001 rad/s/√Hz at 200 Hz (IEEE Std
    952-1997, angle random walk).  Data sheets give 0.0001 to 0.0003 for a phone's gyroscope at rest; vibration adds to
    it.  Corners at or above half the sampling rate have no effect.
    """
    from scipy.signal import butter, sosfilt

    noise = density * np.sqrt(rate_hz / 2) * rng.normal(size=shape)
    for corner_hz in corners_hz:
        if corner_hz < rate_hz / 2:
            noise = np.asarray(sosfilt(butter(2, corner_hz, fs=rate_hz, output="sos"), noise, axis=0))
    return noise


def jittered_ns(time_ns: NDArray[np.int64], jitter_s: float, rng: np.random.Generator) -> NDArray[np.int64]:
    """Timestamps with Gaussian jitter of standard deviation ``jitter_s``, clipped so that they stay in order."""
    limit_ns = MOST_JITTER * float(np.min(np.diff(time_ns)))
    jitter_ns = np.clip(1e9 * jitter_s * rng.normal(size=len(time_ns)), -limit_ns, limit_ns)
    return time_ns + np.rint(jitter_ns).astype(np.int64)
