"""Clipped readings are found where they pile up, after a filter and on every axis."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import butter, lfilter

from virest.capture.imu import ImuSamples
from virest.inference.doubtful_log import doubtful_stretches

RATE_HZ = 400.0
LIMIT_RAD_S = 1.0
TIME_S = np.arange(0.0, 4.0, 1 / RATE_HZ)
SWING = np.exp(-(((TIME_S - 2.3) / 0.08) ** 2))
"""One fast turn."""


def turned() -> NDArray[np.float64]:
    """Rates of a hand: about x often beyond the limit, about y up to 0.985 of it, about z once beyond."""
    x = 1.5 * np.sin(2 * np.pi * 1.3 * TIME_S) + 0.3 * np.sin(2 * np.pi * 4.1 * TIME_S + 0.5)
    y = 0.55 * np.sin(2 * np.pi * 1.9 * TIME_S) + 0.3 * np.sin(2 * np.pi * 0.7 * TIME_S)
    z = 0.4 * np.sin(2 * np.pi * 1.1 * TIME_S) + 1.6 * SWING
    return np.stack([x, y * 0.985 / np.abs(y).max(), z], axis=-1)


def logged(rates: NDArray[np.float64], filter_hz: float, rng: np.random.Generator) -> ImuSamples:
    """The rates clipped, then filtered by the sensor and with its noise and bias."""
    clipped = np.clip(rates, -LIMIT_RAD_S, LIMIT_RAD_S)
    if filter_hz:
        clipped = lfilter(*butter(2, filter_hz / (0.5 * RATE_HZ)), clipped, axis=0)
    rate = clipped + rng.normal(0, 0.002, rates.shape) + [0.004, -0.003, 0.006]
    return ImuSamples(TIME_S, rate, np.full_like(rate, np.nan))


@pytest.mark.parametrize("filter_hz", [0.0, 90.0, 50.0])
def test_each_clipped_interval_is_one_stretch(filter_hz: float, rng: np.random.Generator) -> None:
    """Noise does not divide it, a filter only delays and shortens it, and one swing of an axis is enough beside others.

    The axis whose highest swing ends just below the limit is trusted.
    """
    rates = turned()
    stretches = doubtful_stretches(logged(rates, filter_hz, rng))
    filter_s = 0.5 / filter_hz if filter_hz else 0.0
    for axis in range(3):
        beyond = np.concatenate([[False], np.abs(rates[:, axis]) > LIMIT_RAD_S, [False]])
        edges = np.flatnonzero(np.diff(beyond.astype(int)))
        wanted = [(TIME_S[a], TIME_S[min(b, len(TIME_S) - 1)]) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        found = [stretch for stretch in stretches if stretch.axes == (axis,)]
        assert len(found) == len(wanted)
        for stretch, (from_s, to_s) in zip(found, wanted, strict=True):
            assert from_s - 0.01 < stretch.from_s < from_s + filter_s + 0.01
            assert to_s - 0.01 < stretch.to_s < to_s + 2 * filter_s + 0.01
            assert stretch.limit_rad_s == pytest.approx(LIMIT_RAD_S, abs=0.03)
    assert {stretch.axes for stretch in stretches} == {(0,), (2,)}
