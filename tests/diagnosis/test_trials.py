"""Many candidates start, few are fitted to the end, and the right one is among them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from motion.synthetic_tracks import Recording, Setup

from virest.diagnosis.candidates import FarStart, candidates_of
from virest.diagnosis.cross_validation import (
    FIRST_ITERATIONS,
    FOLDS,
    SURVIVING_STARTS,
    SURVIVORS,
    best_of_each,
    race,
    screen,
)
from virest.diagnosis.geometric_evidence import ITERATIONS, Model, make_evidence
from virest.diagnosis.geometric_ladder import SearchContext
from virest.inference.parallel import one_by_one

HAND = Setup(seed=61, frames=37, points=15, readout_direction="top_to_bottom", gyro_noise_rad_s=0.001)
CAMERA = Recording(HAND)
EVIDENCE = make_evidence(CAMERA.imu.between(-0.2, CAMERA.stamp_s[-1] + 0.25), CAMERA.observed)


def test_the_right_cause_wins_a_race_as_it_wins_a_screening() -> None:
    """Few of all causes and starts are fitted completely.

    The hidden one ranks first with the same loss as in a full fit.
    """
    wrong = Model(replace(CAMERA.profile, time_offset_s=0.025), None, ())
    candidates = candidates_of(EVIDENCE, wrong.profile, wrong, set(), (), FarStart())
    iterations: list[int] = []

    def each(function: Any, calls: Any, done: Any = None) -> list[Any]:
        calls = list(calls)
        iterations.extend(call[-1] for call in calls)
        return one_by_one(function, calls, done)

    raced = best_of_each(race(EVIDENCE, candidates, 1, each))
    assert iterations.count(FIRST_ITERATIONS) == len(FOLDS) * len(candidates)
    assert 0 < iterations.count(ITERATIONS - FIRST_ITERATIONS) <= len(FOLDS) ** 2 * SURVIVORS * SURVIVING_STARTS
    assert len(iterations) < 2 * len(FOLDS) * len(candidates)
    right = [candidate for candidate in candidates if candidate.name == "time_offset"]
    screened = best_of_each(screen(EVIDENCE, right, one_by_one))
    assert raced[0].candidate.name == "time_offset"
    np.testing.assert_allclose(raced[0].losses, screened[0].losses, rtol=0.01)


def test_a_rival_search_uses_only_the_causes_of_the_first() -> None:
    """The comparison search may only include causes that entered the first search."""
    model = Model(replace(CAMERA.profile, time_offset_s=0.025), None, ())
    course = SearchContext(EVIDENCE, model.profile, (), FarStart(), one_by_one)
    some = replace(course, among=frozenset({"gyro_bias", "focal_length"}))
    assert {candidate.name for candidate in some.candidates(model, {"focal_length"})} == {"gyro_bias"}
    assert {"gyro_bias", "stabilisation"} < {candidate.name for candidate in course.candidates(model, set())}
