"""The part of a missing turn rate that is constant or follows from the predicted rate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from laws import TurningCamera, phone

from virest.camera.field import Field
from virest.image_formation.row_motion import RowMotion
from virest.motion.trajectory import Trajectory
from virest.restoration.neighbours.refinement import (
    HALF_SPACING,
    NEGLIGIBLE_PX,
    FollowingTurn,
    MissingTurn,
    RefinedMotion,
    accepted_turn,
    following_turn,
    missing_turn,
    uncertain_rate_rad_s,
    undetected_rad_s,
    with_bias,
)
from virest.restoration.neighbours.registration import PairTurn

PERIOD_S = 1 / 30
BIAS_RAD_S = (0.004, -0.006, 0.012)
FREQUENCY_HZ, PHASE_RAD = np.array([3.1, 4.3, 5.7]), np.array([0.3, 1.7, 2.9])


class _Waving(Trajectory):
    """A turn rate in closed form."""

    def __init__(self) -> None:
        pass

    def rate_rad_s(self, time_s: np.ndarray) -> np.ndarray:
        return np.sin(2 * np.pi * FREQUENCY_HZ * np.asarray(time_s)[..., None] + PHASE_RAD)

    def angular_acceleration_rad_s2(self, time_s: np.ndarray) -> np.ndarray:
        angle = 2 * np.pi * FREQUENCY_HZ * np.asarray(time_s)[..., None] + PHASE_RAD
        return 2 * np.pi * FREQUENCY_HZ * np.cos(angle)


def _turns(lag_s: float, part: float, noise: float, rng: np.random.Generator) -> list[PairTurn]:
    """Twelve pairs of frames of a camera whose turn lags behind the predicted one and is larger by a fraction."""
    found = []
    for start_s in PERIOD_S * np.arange(12):
        instants_s = np.linspace(start_s, start_s + PERIOD_S, 400)
        waving = _Waving()
        lacking = lag_s * waving.angular_acceleration_rad_s2(instants_s) + part * waving.rate_rad_s(instants_s)
        rate = lacking.mean(axis=0) + rng.normal(0, noise, 3)
        found.append(PairTurn(start_s, start_s + PERIOD_S, rate, noise**2 * np.eye(3), 1.0, 12))
    return found


@pytest.mark.parametrize(("lag_s", "part"), [(0.002, 0.0), (-0.001, 0.08), (0.0, -0.1)])
def test_a_lag_and_a_scale_are_found(rng: np.random.Generator, lag_s: float, part: float) -> None:
    """Both are found from a few noisy pairs, and the residual of the pairs is their noise."""
    turns, waving = _turns(lag_s, part, 0.005, rng), _Waving()
    found = following_turn(turns, waving)
    assert found.lag_s == pytest.approx(lag_s, abs=3e-4)
    assert found.part == pytest.approx(part, abs=0.01)
    left = [found.residual_of(turn, waving).rate_rad_s for turn in turns]
    assert np.std(left) < 0.008
    assert found.at(waving, np.zeros(1)) == pytest.approx(
        found.lag_s * waving.angular_acceleration_rad_s2(np.zeros(1)) + found.part * waving.rate_rad_s(np.zeros(1))
    )


def test_unrelated_turns_are_not_explained(rng: np.random.Generator) -> None:
    """Hardly any of a turn unrelated to the predicted rate is attributed to it."""
    found = following_turn(_turns(0.0, 0.0, 0.05, rng), _Waving())
    assert abs(found.lag_s) < 1.5e-3
    assert abs(found.part) < 0.03
    assert FollowingTurn().residual_of(_turns(0.0, 0.0, 0.05, rng)[0], _Waving()).rate_rad_s.any()


def test_a_slow_unrelated_turn_is_left_to_interpolation(rng: np.random.Generator) -> None:
    """A slow turn unrelated to the predicted rate is left to interpolation; a lag is corrected."""
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
    """The pairs of a camera whose gyroscope reads a constant too low."""
    return [replace(turn, rate_rad_s=turn.rate_rad_s + bias_rad_s) for turn in turns]


def test_a_bias_is_found_beside_a_lag_and_a_scale(rng: np.random.Generator) -> None:
    """Each is found with the precision of twelve pairs of 2 mrad/s."""
    found = accepted_turn([_biased(_turns(0.003, -0.08, 0.002, rng))], _Waving())[0]
    assert found.bias_rad_s == pytest.approx(BIAS_RAD_S, abs=0.003)
    assert found.lag_s == pytest.approx(0.003, abs=3e-4)
    assert found.part == pytest.approx(-0.08, abs=0.01)
    assert found.at(_Waving(), np.zeros(1)) == pytest.approx(
        replace(found, bias_rad_s=(0.0, 0.0, 0.0)).at(_Waving(), np.zeros(1)) + found.bias_rad_s
    )


def test_a_quarter_of_outlier_pairs_does_not_change_the_bias(rng: np.random.Generator) -> None:
    """The bias is a median, which a quarter of the pairs cannot spoil."""
    turns = [
        replace(turn, rate_rad_s=turn.rate_rad_s + 0.3 * (k % 4 == 0))
        for k, turn in enumerate(_biased(_turns(0.0, 0.0, 0.002, rng)))
    ]
    assert with_bias(FollowingTurn(), turns, _Waving()).bias_rad_s == pytest.approx(BIAS_RAD_S, abs=0.004)


@pytest.mark.parametrize(("scatter", "believed"), [(1.2, True), (4.0, False)])
def test_a_large_turn_is_added_if_the_tiles_agree(scatter: float, *, believed: bool) -> None:
    """If the tiles scatter, something else moves, and the turn is not added."""
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
    """Few or many pairs that scatter by 0.1 rad/s around 0 give no bias."""
    turns = _turns(0.0, 0.0, 0.1, rng)[:count]
    assert with_bias(FollowingTurn(), turns, _Waving()) == FollowingTurn()


def test_the_parallax_of_a_near_scene_is_not_a_bias(rng: np.random.Generator) -> None:
    """A missing rate of 80 mrad/s shared by three pairs is larger than any gyroscope's bias."""
    turns = _biased(_turns(0.0, 0.0, 0.002, rng)[:3], (0.08, 0.02, 0.0))
    assert with_bias(FollowingTurn(), turns, _Waving()) == FollowingTurn()


def test_rows_are_corrected_even_if_the_blur_hardly_changes(rng: np.random.Generator) -> None:
    """With 1 ms of exposure a missing rate shifts rows read over 21 ms; without a readout nothing is corrected."""
    camera = TurningCamera(phone(), exposure_s=0.001)
    blind = TurningCamera(replace(camera.profile, readout_known=False), exposure_s=0.001)
    turns = _biased(_turns(0.0, 0.0, 0.002, rng), (0.02, 0.0, 0.0))
    assert camera.profile.intrinsics is not None
    assert 1.1 * camera.profile.intrinsics.fx_px * 0.02 * 0.001 < NEGLIGIBLE_PX
    assert missing_turn([turns], [camera.motion], _Waving()) is not None
    assert missing_turn([turns], [blind.motion], _Waving()) is None


def test_position_uncertainty_follows_from_speed_uncertainty() -> None:
    """Rows read long after the restored instant are displaced further than over the exposure."""
    motion = TurningCamera(phone()).motion
    refined = RefinedMotion(motion, np.zeros((3, 3)), scatter_px_s=30.0)
    along = np.linspace(0, 1, 2001)[:, None] * [motion.profile.width - 1, motion.profile.height - 1]
    middles_s = motion.row_time_s(along, 0.5)
    speed_px_s = np.sqrt(np.trace(refined.path_covariance_px2()) / 2) / motion.exposure_s
    off_px = speed_px_s * (middles_s - motion.reference_s)
    assert refined.position_std_px() == pytest.approx(np.sqrt(np.mean(off_px**2)), rel=1e-3)
    assert RefinedMotion(motion, np.zeros((3, 3)), 0.0).position_std_px() == 0.0


def _bridged(motion: RowMotion, from_s: float, to_s: float, std_rad_s: float) -> RowMotion:
    """The motion with a bridge whose rate about x is uncertain."""
    knots = tuple(np.linspace(from_s, to_s, 4).tolist())
    bridge = Field("rate", ("time",), (knots,), ((0.0,) * 3,) * 4, ((std_rad_s, 0.0, 0.0),) * 4)
    return replace(motion, profile=motion.profile.with_extensions(field=(bridge,)))


def test_a_bridge_makes_the_rate_of_its_rows_uncertain() -> None:
    """By its deviation if it covers all rows, by less if it covers some; outside the rows, or if negligible, by 0."""
    motion = TurningCamera(phone()).motion
    middle_s = 0.5 * (motion.start_s + motion.end_s)
    spans = [(motion.start_s - 0.01, 0.1), (middle_s, 0.1), (motion.end_s + 0.001, 0.1), (motion.start_s - 0.01, 1e-4)]
    found = [uncertain_rate_rad_s(_bridged(motion, from_s, motion.end_s + 0.03, std)) for from_s, std in spans]
    assert found[0] == pytest.approx(0.1, rel=0.02)
    assert found[1] == pytest.approx(0.1 / np.sqrt(2), rel=0.05)
    assert found[2:] == [0.0, 0.0]


def test_what_a_bridge_leaves_open_adds_to_the_missing_rotation() -> None:
    """Variances add."""
    usual = MissingTurn(0.03, 0.02, 0.01, 5.0, 12)
    found = usual.beside(0.04)
    assert (found.rate_rad_s, found.rest_rad_s) == pytest.approx((0.05, np.sqrt(0.002)))
    assert found.bend_rad_s == pytest.approx(np.hypot(0.01, HALF_SPACING * 0.04))
    assert (found.scatter_px_s, found.pairs) == (5.0, 12)


@pytest.mark.parametrize("missing_rad_s", [0.0, 0.001, 0.003])
def test_the_undetected_rate_covers_the_missing_rate(rng: np.random.Generator, missing_rad_s: float) -> None:
    """Two standard deviations cover the missing rate 19 times of 20, and fall with the number of pairs."""
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
    """Pairs with independent missing rates."""
    rates = rng.normal(0, np.hypot(noise, missing_rad_s), (pairs, 3))
    return [
        PairTurn(k * PERIOD_S, (k + 1) * PERIOD_S, rate, noise**2 * np.eye(3), 1.0, 12) for k, rate in enumerate(rates)
    ]
