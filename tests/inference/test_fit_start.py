"""Fits that start at the same profile and motion share cached values within a process."""

import pickle

import numpy as np
from motion.synthetic_tracks import Recording, Setup

from virest.inference.fit_start import FitStart
from virest.inference.profile_terms import FOCAL, GYRO_BIAS, TIME_OFFSET
from virest.inference.track_fit import fit_from, fit_tracks

SETUP = Setup(seed=5, frames=21, points=40, velocity_m_s=(0.0, 0.0, 0.0), rate_rad_s=1.2, noise_px=0.1)


def test_fits_with_a_shared_start_give_the_same_result() -> None:
    """Earlier fits from the same start have no influence."""
    recording = Recording(SETUP)
    table = recording.observed.table(400)
    start = FitStart(recording.imu, table, recording.profile)
    for terms in ((FOCAL,), (FOCAL, TIME_OFFSET), (GYRO_BIAS, FOCAL)):
        shared = fit_from(start, terms)
        alone = fit_tracks(recording.imu, table, recording.profile, terms)
        np.testing.assert_allclose(shared.difference_px, alone.difference_px, atol=1e-12)


def test_cached_values_are_not_sent_to_another_process() -> None:
    """They are found by object identity, which differs there."""
    recording = Recording(SETUP)
    start = FitStart(recording.imu, recording.observed.table(400), recording.profile)
    fresh = len(pickle.dumps(start))
    fit_from(start, (FOCAL, TIME_OFFSET))
    assert len(pickle.dumps(start)) == fresh
