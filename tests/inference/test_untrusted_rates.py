"""What a clipped axis could not read: a normal vector beyond limits, and the moments of censored readings."""

import numpy as np
import pytest

from virest.arrays import Array
from virest.capture.imu import ImuSamples
from virest.inference.doubtful_log import Stretch, doubtful_stretches
from virest.inference.untrusted_rates import _censored_moments, _truncated, rates_given_log


def _smooth(length: float, size: int) -> Array:
    apart = np.subtract.outer(np.arange(size), np.arange(size)) / length
    return np.exp(-0.5 * apart**2) + 1e-6 * np.eye(size)


@pytest.mark.parametrize("least", [-0.5, 0.5, 1.5])
def test_moments_beyond_a_limit_are_those_of_samples(least: float) -> None:
    """Draw many smooth vectors, and keep those beyond the limit where there is one."""
    mean, covariance = np.array([0.3, 0.6, 0.8, 0.5, 0.0]), 0.5 * _smooth(1.5, 5)
    side = np.array([0.0, 1.0, 1.0, 1.0, 0.0])
    drawn = np.random.default_rng(1).multivariate_normal(mean, covariance, 2_000_000)
    kept = drawn[(drawn[:, 1:4] > least).all(axis=1)]
    assert len(kept) > 2000
    value, spread = _truncated(mean, covariance, side, np.where(side != 0, least, -np.inf))
    assert value == pytest.approx(kept.mean(axis=0), abs=0.05)
    assert np.sqrt(np.diag(spread)) == pytest.approx(kept.std(axis=0), rel=0.1)
    assert np.any(np.abs(value - mean) > 0.05)


def test_a_lower_limit_mirrors_an_upper_one() -> None:
    """Negative readings clip as positive ones do."""
    mean, covariance, side = np.array([0.2, 0.9, 1.1]), _smooth(1.0, 3), np.array([1.0, 1.0, 0.0])
    up = _truncated(mean, covariance, side, np.array([1.2, 1.2, -np.inf]))
    down = _truncated(-mean, covariance, -side, np.array([1.2, 1.2, -np.inf]))
    assert down[0] == pytest.approx(-up[0])
    assert down[1] == pytest.approx(up[1])


def test_without_a_limit_nothing_changes() -> None:
    """A straight line across a gap bounds nothing."""
    mean, covariance = np.array([0.2, -0.4]), _smooth(1.0, 2)
    value, spread = _truncated(mean, covariance, np.zeros(2), np.full(2, -np.inf))
    assert np.array_equal(value, mean)
    assert np.array_equal(spread, covariance)


@pytest.mark.parametrize("limits", [(-0.4, 0.8), (-9.0, 0.1), (-0.5, 0.5)])
def test_clipped_readings_tell_the_variance_of_the_whole(limits: tuple[float, float]) -> None:
    """A third to two thirds of a normal rate cannot be read."""
    whole = np.random.default_rng(2).normal(0.1, 0.7, 4000)
    read = np.clip(whole, *limits)
    beyond = np.where(whole > limits[1], 1.0, np.where(whole < limits[0], -1.0, 0.0))
    mean, variance = _censored_moments(read, beyond)
    assert mean == pytest.approx(0.1, abs=0.05)
    assert np.sqrt(variance) == pytest.approx(0.7, rel=0.06)
    assert read.std() < 0.9 * 0.7


def _log(rate: Array, time_s: Array) -> ImuSamples:
    gyro = np.stack([rate, 0.1 * np.sin(3 * time_s), 0.1 * np.cos(5 * time_s)], axis=1)
    return ImuSamples(time_s, gyro, np.full_like(gyro, np.nan))


def test_rates_lie_beyond_a_limit_but_not_beyond_a_contradicted_reading() -> None:
    """An interval that only the points contradict bounds no axis, even if its readings have a common largest value."""
    time_s = np.arange(0, 3, 0.005)
    log = _log(np.clip(1.5 * np.sin(2 * np.pi * 2 * time_s), -1.0, 1.0), time_s)
    first = doubtful_stretches(log)[0]
    assert first.kind == "clipped"
    knots = np.linspace(first.from_s, first.to_s, 8)[1:-1]
    expected, _ = rates_given_log(log, 0, knots, [first])
    assert np.all(expected > 1.0)
    told = Stretch("contradicted", first.from_s, first.to_s, (0, 1, 2), 1.0, 1e-9)
    plain, wider = rates_given_log(log, 1, knots, [told])
    assert np.all(np.abs(plain) < 0.5)
    without = rates_given_log(log, 1, knots, [Stretch("straight", first.from_s, first.to_s, (0, 1, 2))])
    assert np.array_equal(plain, without[0])
    assert np.array_equal(wider, without[1])


def test_an_axis_that_is_stuck_has_finite_rates() -> None:
    """A constant reading is at its limit all the time."""
    time_s = np.arange(0, 2, 0.005)
    log = _log(np.full(len(time_s), 0.7), time_s)
    stretches = [stretch for stretch in doubtful_stretches(log) if stretch.axes == (0,)]
    knots = np.linspace(0.5, 0.8, 12)
    expected, covariance = rates_given_log(log, 0, knots, stretches)
    assert np.isfinite(expected).all()
    assert np.all(np.linalg.eigvalsh(covariance) > 0)
