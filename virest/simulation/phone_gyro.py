"""A phone's gyroscope: its low pass, its noise, and time stamps that jitter."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, cont2discrete, lfilter, lfilter_zi, sosfilt

Array = NDArray[np.float64]

FINE_STEP_S = 5e-4
SETTLING_PERIODS = 2.0
"""Of the corner's period: the filter starts this much before the first sample, at rest at the first rate."""
FAINTEST = 0.1
"""Share of a rate that a low pass must have left for the rate to be told from noise."""
MOST_JITTER = 0.45
"""Of the sampling interval, so that stamps keep their order."""


def low_passed_rate(
    rate_rad_s: Callable[[Array], Array], time_s: Array, corners_hz: Sequence[float], undone_s: float = 0.0
) -> Array:
    """Rates (n, 3) at time_s behind causal second-order Butterworth low passes, one after the other.

    undone_s: delay that the recorder takes out of the stamps, see :func:`usual_delay_s`.  Each filter is solved exactly
    for a rate that runs straight between fine steps.
    """
    begin_s = time_s[0] + undone_s - sum(SETTLING_PERIODS / corner for corner in corners_hz)
    fine_s = np.arange(begin_s, time_s[-1] + undone_s + 2 * FINE_STEP_S, FINE_STEP_S)
    passed = rate_rad_s(fine_s)
    for corner_hz in corners_hz:
        analogue = butter(2, 2 * np.pi * corner_hz, analog=True)
        ahead, back, _ = cont2discrete(analogue, FINE_STEP_S, method="foh")
        state = lfilter_zi(ahead[0], back)[:, None] * passed[0]
        passed, _ = lfilter(ahead[0], back, passed, axis=0, zi=state)
    return np.stack([np.interp(time_s + undone_s, fine_s, passed[:, i]) for i in range(passed.shape[1])], axis=1)


def usual_delay_s(corner_hz: float) -> float:
    """What a phone takes out of the stamps: √2 / (2π f), by which the filter delays slow turns.

    Inertial sensors filter digitally before they put out samples (InvenSense MPU-6050 register map, DLPF_CFG), and
    Android asks for stamps of when an event happened (Compatibility Definition, section 7.3).
    """
    return float(np.sqrt(2.0) / (2 * np.pi * corner_hz)) if corner_hz else 0.0


def before_low_pass(time_s: Array, rate_rad_s: Array, corner_hz: float) -> Array:
    """Rates (n, 3) that a low pass turned into these, for a motion to be taken again from a phone's log.

    In frequency, on an even grid mirrored about both ends: conj(H) / (|H|² + FAINTEST²), which holds back what the
    filter left less than FAINTEST of.
    """
    count = max(int(np.ceil((time_s[-1] - time_s[0]) / float(np.median(np.diff(time_s))))) + 1, 2)
    even_s = np.linspace(time_s[0], time_s[-1], count)
    even = np.stack([np.interp(even_s, time_s, column) for column in rate_rad_s.T], axis=1)
    mirrored = np.concatenate([even, even[-2:0:-1]])
    frequency = np.fft.rfftfreq(len(mirrored), even_s[1] - even_s[0])[:, None] / corner_hz
    response = 1 / (1 - frequency**2 + 1j * np.sqrt(2.0) * frequency)
    change = np.conj(response) / (np.abs(response) ** 2 + FAINTEST**2) * (1 + FAINTEST**2) - 1
    added = np.fft.irfft(change * np.fft.rfft(mirrored, axis=0), n=len(mirrored), axis=0)[:count]
    return rate_rad_s + np.stack([np.interp(time_s, even_s, column) for column in added.T], axis=1)


def gyro_noise(
    density: float, rate_hz: float, corners_hz: Sequence[float], shape: tuple[int, ...], rng: np.random.Generator
) -> Array:
    """White noise of a one-sided density (rad/s/√Hz) up to half the sampling rate, behind low passes.

    Its standard deviation is density √(rate / 2): 0.01 rad/s for 0.001 at 200 samples/s (IEEE Std 952-1997, angle
    random walk; data sheets give 0.0001 to 0.0003 for a phone's gyroscope at rest, vibration adds to it).
    """
    noise = density * np.sqrt(rate_hz / 2) * rng.normal(size=shape)
    for corner_hz in corners_hz:
        if corner_hz < rate_hz / 2:
            noise = np.asarray(sosfilt(butter(2, corner_hz, fs=rate_hz, output="sos"), noise, axis=0))
    return noise


def jittered_ns(time_ns: NDArray[np.int64], jitter_s: float, rng: np.random.Generator) -> NDArray[np.int64]:
    """Stamps off by ``jitter_s`` (standard deviation) each, within their interval, so that they keep their order."""
    most_ns = MOST_JITTER * float(np.min(np.diff(time_ns)))
    off_ns = np.clip(1e9 * jitter_s * rng.normal(size=len(time_ns)), -most_ns, most_ns)
    return time_ns + np.rint(off_ns).astype(np.int64)
