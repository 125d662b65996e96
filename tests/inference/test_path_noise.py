"""Accelerometer noise propagated through path and fit to the parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from motion.synthetic_tracks import Recording, Setup

from virest.capture.imu import ImuSamples
from virest.image_formation.point_model import integrate_motion
from virest.inference import profile_terms as terms_of
from virest.inference.path_noise import path_errors_px
from virest.inference.track_fit import fit_tracks

SWAYING = Setup(
    seed=15, sway_m=0.05, plane_per_m=(0.1, -0.15, 0.5), gyro_noise_rad_s=1e-4, frames=60, points=10, noise_px=0.02
)  # fmt: skip
STD_M_S2 = 0.1
TERMS = (terms_of.TIME_OFFSET, terms_of.IMU_ROTATION, terms_of.GYRO_BIAS)


def noisy(imu: ImuSamples, seed: int) -> ImuSamples:
    """The samples with white noise on the accelerometer."""
    noise = np.random.default_rng(seed).normal(0, STD_M_S2, imu.accel_m_s2.shape)
    return replace(imu, accel_m_s2=imu.accel_m_s2 + noise)


def test_accelerometer_noise_moves_parameters_as_predicted() -> None:
    """The prediction matches the scatter over other draws of the noise, far below the complete drift."""
    recording = Recording(SWAYING)
    table, profile = recording.table(), recording.profile
    scene, imu = recording.scene(table), noisy(recording.imu, 0)
    errors_px = path_errors_px(imu, integrate_motion(imu, profile, translation=True), table, scene)
    fit = fit_tracks(imu, table, profile, TERMS, scene, errors_px=errors_px)
    draws = [fit_tracks(noisy(recording.imu, seed), table, profile, TERMS, scene).change for seed in range(1, 11)]
    scatter = np.std(draws, axis=0)
    predicted = fit.by_error[: len(scatter)]
    assert np.all(predicted < 2 * scatter)
    assert np.all(predicted > 0.5 * scatter)
    span_s = float(np.ptp(table.second_stamp_s))
    drift_rad = STD_M_S2 * (np.median(np.diff(imu.time_s)) / 3) ** 0.5 * span_s**1.5 * 0.5
    assert np.all(predicted[1:4] < 0.3 * drift_rad)
