"""Delays of single frames from the rotations between them: their size, their deviations, and false alarms."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from virest.arrays import Array
from virest.inference.frame_delays import LEAST, LEAST_NOISE, MOST, Turns, _System, fit_frame_delays

FOCAL_PX, PERIOD_S = 800.0, 1 / 30


def hand_rate(rng: np.random.Generator, count: int) -> Array:
    """(count, 3) rates of a hand at the frames, rad/s: sines between 0.5 and 8 Hz."""
    time_s = PERIOD_S * np.arange(count)
    hz, phase = rng.uniform(0.5, 8, (12, 3)), rng.uniform(0, 2 * np.pi, (12, 3))
    return np.asarray(np.sin(2 * np.pi * hz * time_s[:, None, None] + phase).sum(axis=1) * 0.2)


def turns_of(rng: np.random.Generator, late_s: Array, *, walk_rad: float = 0.0, offset_s: float = 0.0) -> Turns:
    """Turns between successive frames that are late by late_s (frames,), with noise of 0.1 px and slow errors."""
    count = len(late_s)
    rate = hand_rate(rng, count)
    total_s = late_s + offset_s + 0.5 * offset_s * np.linspace(-1, 1, count)
    per_first, per_second = -rate[:-1], rate[1:]
    mixing = rng.normal(size=(count - 1, 3, 3)) * 0.3 + np.eye(3)
    information = (FOCAL_PX / 0.1) ** 2 * np.einsum("pij,pkj->pik", mixing, mixing)
    noise = np.linalg.solve(np.linalg.cholesky(information).swapaxes(1, 2), rng.normal(size=(count - 1, 3, 1)))[..., 0]
    slow = np.cumsum(walk_rad * rng.normal(size=(count - 1, 3)), axis=0)
    left = per_first * total_s[:-1, None] + per_second * total_s[1:, None] + slow + noise
    return Turns(np.arange(count - 1), np.arange(1, count), left, per_first, per_second, information)


def test_delays_of_jittering_stamps_are_found_and_their_deviations_hold() -> None:
    """Beside a slow error of 0.05 px a frame and a clock 6 ms late, which is no jitter; 95 % lie within two σ."""
    off = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        late_s = rng.normal(0, 0.0015, 60)
        found = fit_frame_delays(turns_of(rng, late_s, walk_rad=0.05 / FOCAL_PX, offset_s=0.006))
        assert found is not None
        assert found.p < 1e-20
        assert found.jitter_s == pytest.approx(0.0015, rel=3.5 / np.sqrt(2 * 60))
        off.append((found.late_s - late_s - 0.006 - 0.003 * np.linspace(-1, 1, 60)) / found.std_s)
    within = np.mean(np.abs(np.concatenate(off)) < 2)
    assert 0.92 < within < 0.99


def test_frames_on_time_get_no_delays() -> None:
    """Slow errors, an offset and a drift of the clock are no jitter: p below 5 % in about one capture of twenty."""
    found = []
    for seed in range(60):
        rng = np.random.default_rng(100 + seed)
        walk_rad = rng.uniform(0, 0.1) / FOCAL_PX
        fit = fit_frame_delays(turns_of(rng, np.zeros(40), walk_rad=walk_rad, offset_s=rng.normal(0, 0.004)))
        assert fit is not None
        found.append(fit.p)
    assert min(found) > 1e-4
    assert np.mean(np.array(found) < 0.05) < 0.15


def test_one_late_frame_among_many_is_told_from_its_neighbours(rng: np.random.Generator) -> None:
    """A single stamp 10 ms off is seen by both of its pairs."""
    late_s = np.zeros(50)
    late_s[20] = 0.01
    found = fit_frame_delays(turns_of(rng, late_s))
    assert found is not None
    assert found.p < 1e-5
    assert found.late_s[20] == pytest.approx(0.01, abs=4 * found.std_s[20] + 0.001)
    assert np.abs(np.delete(found.late_s, 20)).max() < 0.002


def test_runs_of_frames_far_apart_are_fitted_together(rng: np.random.Generator) -> None:
    """Frames are known by their movie index, and slow errors start anew in each run."""
    late_s = rng.normal(0, 0.002, 60)
    whole = turns_of(rng, late_s, walk_rad=0.05 / FOCAL_PX)
    near = (whole.second < 20) | (whole.first >= 40)
    shifted = {name: getattr(whole, name)[near] for name in ("left_rad", "per_first_s", "per_second_s", "information")}
    first = whole.first[near] + np.where(whole.first[near] >= 40, 500, 0)
    found = fit_frame_delays(Turns(first, first + 1, **shifted))
    assert found is not None
    assert found.frame.tolist() == [*range(20), *range(540, 560)]
    true_s = late_s[[*range(20), *range(40, 60)]]
    assert np.corrcoef(found.late_s, true_s)[0, 1] > 0.95


def test_too_few_pairs_say_nothing(rng: np.random.Generator) -> None:
    """Three sizes cannot be had from a handful of pairs, nor from pairs of distant frames."""
    assert fit_frame_delays(turns_of(rng, np.zeros(6))) is None
    turns = turns_of(rng, np.zeros(30))
    assert fit_frame_delays(replace(turns, second=turns.first + 5)) is None


def test_points_that_tell_nothing_end_in_no_delays(rng: np.random.Generator) -> None:
    """Neither a camera at rest nor large errors of other kinds end in an error."""
    still = turns_of(rng, np.zeros(30))
    nothing = {"per_first_s": 0 * still.per_first_s, "per_second_s": 0 * still.per_second_s}
    wild = rng.normal(0, 0.05, still.left_rad.shape)
    for turns in (
        replace(still, **nothing),
        replace(still, left_rad=0 * still.left_rad),
        replace(still, left_rad=np.cumsum(wild, axis=0)),
        replace(still, left_rad=wild, **nothing),
    ):
        found = fit_frame_delays(turns)
        assert found is not None
        assert found.p > 1e-3
        assert np.isfinite(found.late_s).all()
        assert np.isfinite(found.std_s).all()


@pytest.mark.parametrize("count", [12, 90, 600])
def test_all_sizes_between_the_bounds_can_be_solved(rng: np.random.Generator, count: int) -> None:
    """A gap in the log asks for noise and steps at their bounds; points in one corner hardly show one rotation."""
    turns = turns_of(rng, np.zeros(count), walk_rad=1e-3)
    turns.left_rad[count // 2 :] += 0.3
    weak = turns.information.copy()
    weak[:, 2, :], weak[:, :, 2] = 0.0, 0.0
    weak[:, 2, 2] = 1e-9 * weak.trace(axis1=1, axis2=2)
    for seen in (turns, replace(turns, information=weak)):
        system = _System.of(seen, np.ones(count - 1, bool))
        for sizes in product((LEAST_NOISE, MOST), (LEAST, MOST), (LEAST, MOST)):
            assert np.isfinite(system._cost(np.array(sizes))), sizes
        found = fit_frame_delays(seen)
        assert found is not None
        assert np.isfinite(found.std_s).all()
