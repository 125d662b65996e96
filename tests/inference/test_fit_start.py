"""Fits that begin at one profile and motion: what they share is computed once, and stays in its process."""

import pickle

import numpy as np
from motion.synthetic_tracks import Recording, Setup

from virest.inference.fit_start import FitStart
from virest.inference.profile_terms import FOCAL, GYRO_BIAS, TIME_OFFSET
from virest.inference.track_fit import fit_from, fit_tracks

SETUP = Setup(seed=5, frames=21, points=40, velocity_m_s=(0.0, 0.0, 0.0), rate_rad_s=1.2, noise_px=0.1)


def test_fits_that_share_a_start_end_as_those_that_do_not() -> None:
    """Whatever was fitted before from the same start."""
    recording = Recording(SETUP)
    table = recording.observed.table(400)
    start = FitStart(recording.imu, table, recording.profile)
    for terms in ((FOCAL,), (FOCAL, TIME_OFFSET), (GYRO_BIAS, FOCAL)):
        shared = fit_from(start, terms)
        alone = fit_tracks(recording.imu, table, recording.profile, terms)
        np.testing.assert_allclose(shared.difference_px, alone.difference_px, atol=1e-12)


def test_what_is_shared_does_not_follow_into_another_process() -> None:
    """It is found by the identity of objects, which is another one there."""
    recording = Recording(SETUP)
    start = FitStart(recording.imu, recording.observed.table(400), recording.profile)
    fresh = len(pickle.dumps(start))
    fit_from(start, (FOCAL, TIME_OFFSET))
    assert len(pickle.dumps(start)) == fresh
