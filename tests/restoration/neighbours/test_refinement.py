"""The rotation that the prediction lacks: its constant part, and what follows the predicted rate."""

import numpy as np
import pytest

from virest.restoration.neighbours.refinement import FollowingTurn, following_turn, with_bias
from virest.restoration.neighbours.registration import PairTurn

BIAS_RAD_S = (0.004, -0.006, 0.012)


class Shake:
    """A known rotation rate about three axes."""

    def rate_rad_s(self, time_s):
        """(n, 3) at times (n,)."""
        return np.stack([np.sin(9 * time_s), 0.7 * np.cos(13 * time_s), 0.5 * np.sin(5 * time_s + 1)], -1)

    def angular_acceleration_rad_s2(self, time_s):
        """Its derivative."""
        return np.stack([9 * np.cos(9 * time_s), -9.1 * np.sin(13 * time_s), 2.5 * np.cos(5 * time_s + 1)], -1)


def turns_that(lack: FollowingTurn, noise_rad_s: float, count: int = 24) -> list[PairTurn]:
    """Pairs of frames at 30 Hz that lack a turn, measured with noise."""
    rng, start_s = np.random.default_rng(5), np.arange(count) / 30
    fine = np.linspace(0, 1 / 30, 65)
    means = [lack.at(Shake(), start + fine).mean(axis=0) for start in start_s]
    noise = noise_rad_s * rng.standard_normal((count, 3))
    covariance = noise_rad_s**2 * np.eye(3)
    return [
        PairTurn(start, start + 1 / 30, mean + error, covariance, 1.0, 20)
        for start, mean, error in zip(start_s, means, noise, strict=True)
    ]


def test_bias_lag_and_part_are_told_apart():
    """Each comes back, within what 24 pairs of 2 mrad/s determine."""
    turns = turns_that(FollowingTurn(BIAS_RAD_S, 0.003, -0.08), 0.002)
    found = with_bias(following_turn(turns, Shake()), turns, Shake())
    assert found.bias_rad_s == pytest.approx(BIAS_RAD_S, abs=0.0015)
    assert found.lag_s == pytest.approx(0.003, abs=2e-4)
    assert found.part == pytest.approx(-0.08, abs=0.004)


def test_a_passing_bus_does_not_move_the_bias():
    """The bias alone is a median, which a third of the pairs cannot spoil."""
    turns = turns_that(FollowingTurn(BIAS_RAD_S), 0.002)
    for turn in turns[::4]:
        turn.rate_rad_s[:] += 0.3
    assert with_bias(FollowingTurn(), turns, Shake()).bias_rad_s == pytest.approx(BIAS_RAD_S, abs=0.003)


@pytest.mark.parametrize("count", [3, 24])
def test_noise_is_not_taken_for_a_bias(count: int):
    """Pairs that scatter by 0.1 rad/s about 0, few or many, show none."""
    assert with_bias(FollowingTurn(), turns_that(FollowingTurn(), 0.1, count), Shake()) == FollowingTurn()


def test_parallax_of_a_near_scene_is_no_bias():
    """A missing rate of 80 mrad/s that three pairs share is beyond any gyroscope's bias."""
    turns = turns_that(FollowingTurn((0.08, 0.02, 0.0)), 0.002, 3)
    assert with_bias(FollowingTurn(), turns, Shake()) == FollowingTurn()
