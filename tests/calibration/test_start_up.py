"""Lag schedules of synthetic repeated frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from motion.synthetic_tracks import Recording, Setup

from virest.capture.imu import ImuSamples
from virest.capture.records import Capture, CaptureMetadata, Frame
from virest.inference.recorder_lag import EXTRA_PERIODS, fit_start_up_lag, lag_schedules

PERIOD_S = 0.04


def capture(frames: int) -> Capture:
    """A movie of 25 frames per second that drops one in the middle."""
    stamp_s = PERIOD_S * (np.arange(frames) + (np.arange(frames) > frames // 2))
    imu = ImuSamples(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
    records = tuple(Frame(k, 0, float(t)) for k, t in enumerate(stamp_s))
    return Capture("c", Path("c"), Path("c"), 64, 48, records, imu, CaptureMetadata(), "REALTIME", 0)


def test_without_repeats_there_is_no_schedule() -> None:
    """Without a repeated frame, no lag is tried."""
    assert lag_schedules(capture(30), []) == []


def test_each_repeat_reduces_the_lag_by_a_period() -> None:
    """With repeats at 2, 5 and 6 of 30 frames, the lag falls from three periods to none."""
    ((lag_s, last, seconds),) = lag_schedules(capture(30), [5, 2, 6])
    assert lag_s == pytest.approx(3 * PERIOD_S)
    assert last == 6
    expected = [3, 3, 2, 2, 2, 1, 0, *[0] * 23]
    np.testing.assert_allclose(seconds, PERIOD_S * np.array(expected), atol=1e-12)
    assert all(isinstance(value, float) for value in seconds)


def test_a_recording_that_ends_while_it_lags_may_lag_longer() -> None:
    """Repeats up to the end of the movie leave the remaining lag unknown: the schedules differ by a constant."""
    found = lag_schedules(capture(12), [3, 10])
    assert [entry[0] for entry in found] == pytest.approx([PERIOD_S * (2 + extra) for extra in EXTRA_PERIODS])
    assert [entry[1] for entry in found] == [10] * len(EXTRA_PERIODS)
    base = np.array([2, 2, 2, 1, 1, 1, 1, 1, 1, 1, 0, 0])
    for extra, (_, _, seconds) in zip(EXTRA_PERIODS, found, strict=True):
        np.testing.assert_allclose(seconds, PERIOD_S * (base + extra), atol=1e-12)


def test_rotation_shows_whether_repeats_are_a_lag() -> None:
    """A lag of two periods, then one from slot 9, then none from 14 is found.

    The same repeats without lag are rejected.
    """
    recording = Recording(Setup(seed=71, frames=40, points=20, gyro_noise_rad_s=0.001))
    stamp_s, period_s = recording.stamp_s, 1 / 29.7
    late_s = period_s * np.array([2] * 9 + [1] * 5 + [0] * 26)
    shown = replace(capture(40), repeats=(9, 14), imu=recording.imu)
    for shift_s, believed in ((late_s, True), (0 * late_s, False)):
        logged_s = stamp_s - shift_s
        frames = tuple(Frame(k, 0, float(t)) for k, t in enumerate(logged_s))
        lag = fit_start_up_lag(
            replace(shown, frames=frames), replace(recording.observed, stamp_s=logged_s), recording.profile
        )
        assert lag.determined == believed
        assert lag.lag_s == pytest.approx(2 * period_s if believed else 0.0)
        assert lag.frames == (14 if believed else 0)
