"""The filter that a gyroscope applies before it outputs samples: its cutoff, its delay and its averaging time.

The response of any filter begins as H(s) = 1 / (1 + τs + ½ (τ² − σ²) s² + …): τ is the mean of its impulse response
and σ² the variance.  A second-order Butterworth filter of cutoff f has τ = √2 / (2π f) and σ = 0, exactly: a loss of
3 dB at f, maximally flat below (Butterworth 1930, "On the theory of filter amplifiers").  Filters of phones' sensors
are of this order and flat (InvenSense MPU-6050 register map, DLPF_CFG; Bosch BMI160 data sheet, gyroscope's cutoffs).
A first-order filter has σ = τ, exactly; two equal ones in series σ = τ / √2, exactly; the mean over a window W has
σ = W / √12, and no delay where its timestamps mark the window's middle.  No stable filter of second order has σ > τ:
there, the surplus of σ² is taken for such a mean, of response sin(πfW) / (πfW).

With σ = 0 the first terms are those of e^{τs}.  For motion well below f a flat filter is therefore a delay by τ; only
the terms (2π f_rate τ)³/6 of the phase and (f_rate / f)⁴/2 of the amplitude distinguish it from a time offset.
Averaging makes rotations at a frequency f_rate too small by the fraction ½ (2π f_rate σ)².
"""

from __future__ import annotations

import math

LEAST_HZ = 2.0
"""Sensors offer cutoffs from 5 Hz (MPU-6050) upwards; below 2 Hz a gyroscope would not measure hand shake."""


def delay_s(cutoff_hz: float) -> float:
    """Delay τ of slow motion for a cutoff; 0 for 0, which means no filter.  A negative cutoff has a negative delay."""
    return math.sqrt(2.0) / (2 * math.pi * cutoff_hz) if cutoff_hz else 0.0


def inverse_bend_s2(cutoff_hz: float, averaging_s: float) -> float:
    """Factor ½ (τ² − σ²) of the second derivative in the inverse filter; 0 where σ exceeds τ."""
    return max(0.5 * (delay_s(cutoff_hz) ** 2 - averaging_s**2), 0.0)


def window_s(cutoff_hz: float, averaging_s: float) -> float:
    """Length of the window around a timestamp whose mean has the variance by which σ² exceeds τ²; else 0."""
    return math.sqrt(12 * max(averaging_s**2 - delay_s(cutoff_hz) ** 2, 0.0))


def cutoff_hz(delay_s: float) -> float:
    """The cutoff for a delay τ: the inverse of :func:`delay_s`, by the same formula."""
    return math.sqrt(2.0) / (2 * math.pi * delay_s) if delay_s else 0.0
