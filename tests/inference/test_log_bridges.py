"""Bridges over clipped and interpolated stretches of the gyroscope log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from laws import phone
from scipy.ndimage import gaussian_filter1d

from virest.arrays import Array
from virest.capture.imu import ImuSamples
from virest.inference.doubtful_log import doubtful_stretches
from virest.inference.log_bridges import with_expected_rates

STEP_S = 0.005
TIME_S = STEP_S * np.arange(700)


def hand(rng: np.random.Generator) -> Array:
    """(n, 3) rad/s of a shaking hand: smooth random rates of about 1 rad/s."""
    white = rng.normal(size=(2, 3, len(TIME_S)))
    quick, slow = (
        gaussian_filter1d(part, width / STEP_S, axis=1) for part, width in zip(white, (0.05, 0.16), strict=True)
    )
    return np.asarray((quick / quick.std() + 0.7 * slow / slow.std()).T)


def wrong_log(kind: str, rate: Array, rng: np.random.Generator) -> ImuSamples:
    """A log that clips, with its noise before or after the limit, or whose gap was filled by straight lines."""
    noise, limit = rng.normal(0, 0.002, rate.shape), float(np.quantile(np.abs(rate), 0.97))
    if kind == "filled gap":
        first, last = 300, 320
        read, between = rate + noise, slice(first + 1, last)
        for axis in range(3):
            read[between, axis] = np.interp(TIME_S[between], TIME_S[[first, last]], read[[first, last], axis])
    else:
        read = np.clip(rate, -limit, limit) + noise if kind == "noise after" else np.clip(rate + noise, -limit, limit)
    return ImuSamples(TIME_S, read, np.tile([0.0, 0.0, 9.8], (len(TIME_S), 1)))


@pytest.mark.parametrize("kind", ["noise before", "noise after", "filled gap"])
def test_expected_rates_are_close_and_as_uncertain_as_stated(kind: str) -> None:
    """Most of what the log lacks is regained, and at least 90 % of the rates lie within two deviations.

    Rates that are as smooth as these are better predicted across a gap than a Matérn process states.
    """
    rng = np.random.default_rng(5)
    off, left, std = [], [], []
    for _ in range(20):
        rate = hand(rng)
        log = wrong_log(kind, rate, rng)
        profile = with_expected_rates(phone(), log, 0)
        fields = profile.over_time("rate")
        assert len(fields) == len(doubtful_stretches(log)) > 0
        for field in fields:
            inside = (field.knots[0][0] < TIME_S) & (field.knots[0][-1] > TIME_S)
            (axis,) = np.flatnonzero(np.any(field.std, axis=0)) if kind != "filled gap" else (0,)
            lacking = (rate - log.gyro_rad_s)[inside, axis]
            bridge = field.at(TIME_S[inside])[:, axis]
            off.append(lacking)
            left.append(lacking - bridge)
            std.append(np.hypot(field.std_over_time(TIME_S[inside])[:, axis], 0.002))
    off, left, std = map(np.concatenate, (off, left, std))
    assert np.sqrt(np.mean(left**2)) < 0.5 * np.sqrt(np.mean(off**2))
    assert np.mean(np.abs(left) < 2 * std) > 0.9
    least = 0.2 if kind == "filled gap" else 0.6
    assert least < np.sqrt(np.mean(left**2) / np.mean(std**2)) < 1.3


def test_a_sound_log_and_bridged_stretches_are_left_alone() -> None:
    """The profile stays as it is, and fields that it states are not added twice."""
    rng = np.random.default_rng(6)
    rate = hand(rng)
    sound = replace(wrong_log("noise before", rate, rng), gyro_rad_s=rate + rng.normal(0, 0.002, rate.shape))
    assert with_expected_rates(phone(), sound, 0) == phone()
    clipped = wrong_log("noise after", rate, rng)
    bridged = with_expected_rates(phone(), clipped, 0)
    assert with_expected_rates(bridged, clipped, 0) is bridged
