"""Deviations of causes include the effect of causes outside the model."""

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
    """The recording, made only once."""
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


def test_a_cause_outside_the_model_widens_the_deviation() -> None:
    """With a wrong readout time outside the model, the offset's error exceeds its own deviation."""
    truth = recording().profile
    given = replace(truth, shutter=replace(truth.shutter, readout_time_s=truth.shutter.readout_time_s - 0.012))
    error, own, opened = left_open(given, ("gyro_bias", "readout_time", "imu_rotation"))
    assert error**2 > 9 * own
    assert error**2 < 4 * (own + opened)


def test_a_complete_model_keeps_its_covariance() -> None:
    """If no cause is missing, other causes hardly change the parameter."""
    truth = recording().profile
    _, own, opened = left_open(truth, ("gyro_bias", "focal_length", "imu_rotation", "readout_time"))
    assert opened < 4 * own
    assert np.isfinite(opened)
