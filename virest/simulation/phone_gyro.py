"""A phone's gyroscope: its low pass, its noise, and time stamps that jitter."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfilt, sosfilt_zi

Array = NDArray[np.float64]

FINE_STEP_S = 5e-4
SETTLING_PERIODS = 2.0
"""Of the corner's period: the filter starts this much before the first sample, at rest at the first rate."""
MOST_JITTER = 0.45
"""Of the sampling interval, so that stamps keep their order."""


def low_passed_rate(rate_rad_s: Callable[[Array], Array], time_s: Array, corner_hz: float) -> Array:
    """Rates (n, 3) at time_s behind a causal second-order Butterworth low pass, the constant part of its delay undone.

    Inertial sensors filter digitally before they put out samples (InvenSense MPU-6050 register map, DLPF_CFG), and
    Android asks for stamps of when an event happened (Compatibility Definition, section 7.3): the delay √2 / (2π f)
    that the filter has at low frequencies is taken out of the stamps.  What remains is its loss and its phase.
    """
    delay_s = np.sqrt(2.0) / (2 * np.pi * corner_hz)
    begin_s = time_s[0] + delay_s - SETTLING_PERIODS / corner_hz
    fine_s = np.arange(begin_s, time_s[-1] + delay_s + 2 * FINE_STEP_S, FINE_STEP_S)
    rate = rate_rad_s(fine_s)
    sections: Any = butter(2, corner_hz, fs=1 / FINE_STEP_S, output="sos")
    state = sosfilt_zi(sections)[:, :, None] * rate[0]
    passed, _ = sosfilt(sections, rate, axis=0, zi=state)
    return np.stack([np.interp(time_s + delay_s, fine_s, passed[:, i]) for i in range(rate.shape[1])], axis=1)


def gyro_noise(
    density: float, rate_hz: float, corner_hz: float, shape: tuple[int, ...], rng: np.random.Generator
) -> Array:
    """White noise of a one-sided density (rad/s/√Hz) up to half the sampling rate, behind the low pass if there is one.

    Its standard deviation is density √(rate / 2): 0.01 rad/s for 0.001 at 200 samples/s (IEEE Std 952-1997, angle
    random walk; data sheets give 0.0001 to 0.0003 for a phone's gyroscope at rest, vibration adds to it).
    """
    noise = density * np.sqrt(rate_hz / 2) * rng.normal(size=shape)
    if not 0 < corner_hz < rate_hz / 2:
        return noise
    return np.asarray(sosfilt(butter(2, corner_hz, fs=rate_hz, output="sos"), noise, axis=0))


def jittered_ns(time_ns: NDArray[np.int64], jitter_s: float, rng: np.random.Generator) -> NDArray[np.int64]:
    """Stamps off by ``jitter_s`` (standard deviation) each, within their interval, so that they keep their order."""
    most_ns = MOST_JITTER * float(np.min(np.diff(time_ns)))
    off_ns = np.clip(1e9 * jitter_s * rng.normal(size=len(time_ns)), -most_ns, most_ns)
    return time_ns + np.rint(off_ns).astype(np.int64)
