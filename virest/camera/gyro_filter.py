"""The low-pass filter that a gyroscope applies before it outputs samples: its cutoff, and its delay.

A second-order Butterworth filter, H(s) = 1 / (1 + τs + τ²s²/2) with τ = √2 / (2π f): a loss of 3 dB at f, maximally
flat below (Butterworth 1930, "On the theory of filter amplifiers").  The filters of phones' sensors are of this order
and flat (InvenSense MPU-6050 register map, DLPF_CFG; Bosch BMI160 data sheet, gyroscope's cutoffs).

1 + τs + τ²s²/2 is e^{τs} to second order.  For motion well below f the filter is therefore a delay by τ; only the
terms (2π f_rate τ)³/6 of the phase and (f_rate / f)⁴/2 of the amplitude distinguish it from a time offset.
"""

from __future__ import annotations

import math

LEAST_HZ = 2.0
"""Sensors offer cutoffs from 5 Hz (MPU-6050) upwards; below 2 Hz a gyroscope would not measure hand shake."""


def delay_s(cutoff_hz: float) -> float:
    """Delay τ of slow motion for a cutoff; 0 for 0, which means no filter.  A negative cutoff has a negative delay."""
    return math.sqrt(2.0) / (2 * math.pi * cutoff_hz) if cutoff_hz else 0.0


def cutoff_hz(delay_s: float) -> float:
    """The cutoff for a delay τ: the inverse of :func:`delay_s`, by the same formula."""
    return math.sqrt(2.0) / (2 * math.pi * delay_s) if delay_s else 0.0
