"""Deviations of causes while points stay astray: what a cause outside the model would move counts."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from motion.synthetic_tracks import Recording, Setup

from virest.camera.profile import CameraProfile
from virest.diagnosis.candidates import FarStart, candidates_of
from virest.diagnosis.geometric_effects import GEOMETRIC_EFFECTS
from virest.diagnosis.geometric_evidence import Model, make_evidence
from virest.diagnosis.geometric_significance import is_plausible
from virest.diagnosis.left_open import variance_left_open
from virest.inference.parallel import one_by_one

BY_NAME = {effect.name: effect for effect in GEOMETRIC_EFFECTS}
HAND = Setup(seed=71, frames=31, points=15, gyro_noise_rad_s=0.001)


@lru_cache(maxsize=1)
def recording() -> Recording:
    """Made once."""
    return Recording(HAND)


def left_open(given: CameraProfile, further: tuple[str, ...]) -> tuple[float, float, float]:
    """(error of the offset, its own variance, variance left open) with only the offset in the model."""
    camera, offset = recording(), BY_NAME["time_offset"]
    evidence = make_evidence(camera.imu.between(-0.2, camera.stamp_s[-1] + 0.25), camera.observed)
    table = evidence.table(Model(given, None, ()), 7000)
    fitted = evidence.fit(Model(given, None, ()), (offset.term,), table)
    model = Model(fitted.profile, None, (offset.term,))
    candidates = candidates_of(evidence, given, model, set(), (), FarStart())
    more = [candidate for candidate in candidates if candidate.name in further and candidate.added]
    found = variance_left_open(evidence, model, [offset], more, is_plausible, one_by_one)
    error = fitted.profile.time_offset_s - camera.profile.time_offset_s
    return error, float(fitted.std("time_offset")[0] ** 2), float(found["time_offset"][0])


def test_a_cause_outside_the_model_widens_what_it_would_move() -> None:
    """With a readout that is wrong and nobody to say so, the offset errs by more than its own deviation tells."""
    truth = recording().profile
    given = replace(truth, shutter=replace(truth.shutter, readout_time_s=truth.shutter.readout_time_s - 0.012))
    error, own, opened = left_open(given, ("gyro_bias", "readout_time", "imu_rotation"))
    assert error**2 > 9 * own
    assert error**2 < 4 * (own + opened)


def test_a_right_model_is_as_sure_as_its_covariance() -> None:
    """Where nothing is missing, no further cause moves the value by more than its own freedom."""
    truth = recording().profile
    _, own, opened = left_open(truth, ("gyro_bias", "focal_length", "imu_rotation", "readout_time"))
    assert opened < 4 * own
    assert np.isfinite(opened)
