"""What of the turn that a prediction lacks is constant or follows from the predicted one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from laws import TurningCamera, phone

from virest.motion.trajectory import Trajectory
from virest.restoration.neighbours.refinement import (
    NEGLIGIBLE_PX,
    FollowingTurn,
    MissingTurn,
    RefinedMotion,
    accepted_turn,
    following_turn,
    missing_turn,
    undetected_rad_s,
    with_bias,
)
from virest.restoration.neighbours.registration import PairTurn

PERIOD_S = 1 / 30
BIAS_RAD_S = (0.004, -0.006, 0.012)
FREQUENCY_HZ, PHASE_RAD = np.array([3.1, 4.3, 5.7]), np.array([0.3, 1.7, 2.9])


class _Waving(Trajectory):
    """A turn rate that is known in closed form."""

    def __init__(self) -> None:
        pass

    def rate_rad_s(self, time_s: np.ndarray) -> np.ndarray:
        return np.sin(2 * np.pi * FREQUENCY_HZ * np.asarray(time_s)[..., None] + PHASE_RAD)

    def angular_acceleration_rad_s2(self, time_s: np.ndarray) -> np.ndarray:
        angle = 2 * np.pi * FREQUENCY_HZ * np.asarray(time_s)[..., None] + PHASE_RAD
        return 2 * np.pi * FREQUENCY_HZ * np.cos(angle)


def _turns(lag_s: float, part: float, noise: float, rng: np.random.Generator) -> list[PairTurn]:
    """Twelve pairs of frames of a camera whose turn is later, and by a part larger, than predicted."""
    found = []
    for start_s in PERIOD_S * np.arange(12):
        instants_s = np.linspace(start_s, start_s + PERIOD_S, 400)
        waving = _Waving()
        lacking = lag_s * waving.angular_acceleration_rad_s2(instants_s) + part * waving.rate_rad_s(instants_s)
        rate = lacking.mean(axis=0) + rng.normal(0, noise, 3)
        found.append(PairTurn(start_s, start_s + PERIOD_S, rate, noise**2 * np.eye(3), 1.0, 12))
    return found


@pytest.mark.parametrize(("lag_s", "part"), [(0.002, 0.0), (-0.001, 0.08), (0.0, -0.1)])
def test_a_lag_and_a_scale_come_back(rng: np.random.Generator, lag_s: float, part: float) -> None:
    """Both are found from a few noisy pairs, and what they leave of these is their noise."""
    turns, waving = _turns(lag_s, part, 0.005, rng), _Waving()
    found = following_turn(turns, waving)
    assert found.lag_s == pytest.approx(lag_s, abs=3e-4)
    assert found.part == pytest.approx(part, abs=0.01)
    left = [found.residual_of(turn, waving).rate_rad_s for turn in turns]
    assert np.std(left) < 0.008
    assert found.at(waving, np.zeros(1)) == pytest.approx(
        found.lag_s * waving.angular_acceleration_rad_s2(np.zeros(1)) + found.part * waving.rate_rad_s(np.zeros(1))
    )


def test_turns_that_follow_nothing_are_not_explained(rng: np.random.Generator) -> None:
    """Of turns that are unrelated to the predicted rate next to nothing is put down to it."""
    found = following_turn(_turns(0.0, 0.0, 0.05, rng), _Waving())
    assert abs(found.lag_s) < 1.5e-3
    assert abs(found.part) < 0.03
    assert FollowingTurn().residual_of(_turns(0.0, 0.0, 0.05, rng)[0], _Waving()).rate_rad_s.any()


def test_a_rest_that_interpolation_tells_better_follows_nothing(rng: np.random.Generator) -> None:
    """A slow turn that is unrelated to the predicted rate is left to interpolation; a lag is not."""
    slow = [
        replace(turn, rate_rad_s=turn.rate_rad_s + 0.2 * np.sin(2 * np.pi * 0.8 * turn.start_s + PHASE_RAD))
        for turn in _turns(0.0, 0.0, 0.002, rng)
    ]
    assert accepted_turn([slow], _Waving())[0] == FollowingTurn()
    following, bend = accepted_turn([_turns(0.004, 0.0, 0.002, rng)], _Waving())
    assert following.lag_s == pytest.approx(0.004, abs=5e-4)
    assert bend is not None
    assert bend < 0.01**2


def _biased(turns: list[PairTurn], bias_rad_s: tuple[float, float, float] = BIAS_RAD_S) -> list[PairTurn]:
    """The pairs of a camera whose gyroscope reads too little by a constant."""
    return [replace(turn, rate_rad_s=turn.rate_rad_s + bias_rad_s) for turn in turns]


def test_a_bias_comes_back_beside_a_lag_and_a_scale(rng: np.random.Generator) -> None:
    """Each within what twelve pairs of 2 mrad/s determine."""
    found = accepted_turn([_biased(_turns(0.003, -0.08, 0.002, rng))], _Waving())[0]
    assert found.bias_rad_s == pytest.approx(BIAS_RAD_S, abs=0.003)
    assert found.lag_s == pytest.approx(0.003, abs=3e-4)
    assert found.part == pytest.approx(-0.08, abs=0.01)
    assert found.at(_Waving(), np.zeros(1)) == pytest.approx(
        replace(found, bias_rad_s=(0.0, 0.0, 0.0)).at(_Waving(), np.zeros(1)) + found.bias_rad_s
    )


def test_a_passing_bus_does_not_move_the_bias(rng: np.random.Generator) -> None:
    """A bias is a median, which a quarter of the pairs does not spoil."""
    turns = [
        replace(turn, rate_rad_s=turn.rate_rad_s + 0.3 * (k % 4 == 0))
        for k, turn in enumerate(_biased(_turns(0.0, 0.0, 0.002, rng)))
    ]
    assert with_bias(FollowingTurn(), turns, _Waving()).bias_rad_s == pytest.approx(BIAS_RAD_S, abs=0.004)


@pytest.mark.parametrize(("scatter", "believed"), [(1.2, True), (4.0, False)])
def test_a_large_turn_is_the_camera_s_if_the_tiles_agree_on_it(scatter: float, *, believed: bool) -> None:
    """It is then added whole; if the tiles scatter, something else moves, and the frame is as uncertain as any."""
    camera, usual = TurningCamera(phone(), exposure_s=0.02), 0.005
    missing = MissingTurn(usual, usual, 0.0, 1.0, 12)
    rate = np.array([0.08, -0.05, 0.02])
    middle_s = camera.motion.middle_s
    turns = [
        PairTurn(middle_s + at * PERIOD_S, middle_s + (at + 1) * PERIOD_S, rate, 0.004**2 * np.eye(3), scatter, 16)
        for at in (-1, 0)
    ]
    found = missing.refined(camera.motion, turns[:1], turns[1:], camera.trajectory)
    assert (found.further is not None) == believed
    if found.further is not None:
        assert found.further.rate_rad_s.mean(axis=0) == pytest.approx(rate, rel=0.05)
        assert np.sqrt(np.trace(found.rate_covariance) / 3) < 0.005


@pytest.mark.parametrize("count", [3, 12])
def test_noise_is_not_taken_for_a_bias(rng: np.random.Generator, count: int) -> None:
    """Pairs that scatter by 0.1 rad/s about 0, few or many, show none."""
    turns = _turns(0.0, 0.0, 0.1, rng)[:count]
    assert with_bias(FollowingTurn(), turns, _Waving()) == FollowingTurn()


def test_parallax_of_a_near_scene_is_no_bias(rng: np.random.Generator) -> None:
    """A missing rate of 80 mrad/s that three pairs share is beyond any gyroscope's bias."""
    turns = _biased(_turns(0.0, 0.0, 0.002, rng)[:3], (0.08, 0.02, 0.0))
    assert with_bias(FollowingTurn(), turns, _Waving()) == FollowingTurn()


def test_rows_are_corrected_though_the_blur_hardly_changes(rng: np.random.Generator) -> None:
    """At 1 ms of exposure a missing rate displaces rows that are read over 21 ms; without a readout nothing does."""
    camera = TurningCamera(phone(), exposure_s=0.001)
    blind = TurningCamera(replace(camera.profile, readout_known=False), exposure_s=0.001)
    turns = _biased(_turns(0.0, 0.0, 0.002, rng), (0.02, 0.0, 0.0))
    assert camera.profile.intrinsics is not None
    assert 1.1 * camera.profile.intrinsics.fx_px * 0.02 * 0.001 < NEGLIGIBLE_PX
    assert missing_turn([turns], [camera.motion], _Waving()) is not None
    assert missing_turn([turns], [blind.motion], _Waving()) is None


def test_rows_lie_off_by_what_is_unknown_of_the_speed() -> None:
    """Over rows read long after the restored instant an unknown speed carries them further than over the exposure."""
    motion = TurningCamera(phone()).motion
    refined = RefinedMotion(motion, np.zeros((3, 3)), scatter_px_s=30.0)
    along = np.linspace(0, 1, 2001)[:, None] * [motion.profile.width - 1, motion.profile.height - 1]
    middles_s = motion.row_time_s(along, 0.5)
    speed_px_s = np.sqrt(np.trace(refined.path_covariance_px2()) / 2) / motion.exposure_s
    off_px = speed_px_s * (middles_s - motion.reference_s)
    assert refined.position_std_px() == pytest.approx(np.sqrt(np.mean(off_px**2)), rel=1e-3)
    assert RefinedMotion(motion, np.zeros((3, 3)), 0.0).position_std_px() == 0.0


@pytest.mark.parametrize("missing_rad_s", [0.0, 0.001, 0.003])
def test_what_pairs_do_not_exclude_holds_what_is_missing(rng: np.random.Generator, missing_rad_s: float) -> None:
    """Two deviations hold what is missing 19 times of 20, and the deviation falls with the number of pairs."""
    noise = 0.005
    few, many = (
        np.array([undetected_rad_s([_scattered(pairs, missing_rad_s, noise, rng)]) for _ in range(200)])
        for pairs in (4, 40)
    )
    assert np.mean(2 * few >= missing_rad_s) >= 0.95
    assert np.mean(2 * many >= missing_rad_s) >= 0.95
    assert np.median(many) < 2 * max(missing_rad_s, 0.5 * noise)
    assert np.median(many) < np.median(few)
    assert np.all(few > 0)
    assert undetected_rad_s([_scattered(1, 0.0, noise, rng), [None]]) is None


def _scattered(pairs: int, missing_rad_s: float, noise: float, rng: np.random.Generator) -> list[PairTurn]:
    """Pairs that lack independent rates."""
    rates = rng.normal(0, np.hypot(noise, missing_rad_s), (pairs, 3))
    return [
        PairTurn(k * PERIOD_S, (k + 1) * PERIOD_S, rate, noise**2 * np.eye(3), 1.0, 12) for k, rate in enumerate(rates)
    ]
