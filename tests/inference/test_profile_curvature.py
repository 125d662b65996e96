"""Deviations of parameters from points across their parallax, with parallax close to the tracking noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from motion.synthetic_tracks import Recording, Setup

from virest.inference import profile_terms as terms_of
from virest.inference.track_fit import fit_tracks, many_directions

TERMS = (
    terms_of.TIME_OFFSET, terms_of.READOUT, terms_of.IMU_ROTATION, terms_of.GYRO_BIAS, terms_of.FOCAL, terms_of.K1,
    terms_of.PRINCIPAL_POINT,
)  # fmt: skip
SWAYING = Setup(
    plane_per_m=(0.03, -0.05, 0.3), gyro_noise_rad_s=0.001, frames=60, arm_m=(0.03, -0.05, 0.01), points=9
)  # fmt: skip


@pytest.mark.parametrize("sway_m", [0.02, 0.06])
def test_deviations_are_right_with_uncertain_directions(sway_m: float) -> None:
    """Without an accelerometer, Gauss–Newton's deviations would be exceeded twofold by one error in four."""
    ratios = []
    for seed in range(320, 324):
        recording = Recording(replace(SWAYING, seed=seed, sway_m=sway_m))
        table = recording.table()
        fit = fit_tracks(recording.imu, table, recording.profile, TERMS, many_directions(table))
        ratios.append(fit.change / np.sqrt(np.diag(fit.covariance)))
    ratio = np.abs(ratios)
    assert np.mean(ratio < 2) > 0.8
    assert 0.25 < np.median(ratio) < 1.0
