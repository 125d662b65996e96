"""Residuals of points: relief of the scene and small sensor noise are not faults of the model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from motion.synthetic_tracks import Recording, Setup

from virest.diagnosis import residual_tests
from virest.diagnosis.findings import Remaining
from virest.diagnosis.geometric_evidence import make_evidence
from virest.diagnosis.geometric_ladder import climb
from virest.diagnosis.geometric_verdict import GeometricVerdict
from virest.diagnosis.ladder import MOST_TRAVEL_PX, travel_blur_px
from virest.diagnosis.residual_tests import points_left
from virest.inference.blur_bias import blur_bias_px

WALL = Setup(
    seed=71, frames=31, points=40, velocity_m_s=(0.1, -0.05, 0.8), plane_per_m=(0.05, -0.1, 0.6), noise_px=0.08
)


@pytest.fixture(scope="module")
def before_a_wall() -> GeometricVerdict:
    """The true profile's verdict for a camera that walks towards a wall."""
    recording = Recording(WALL)
    imu = recording.imu.between(-0.2, recording.stamp_s[-1] + 0.25)
    profile = replace(recording.profile, depth_m=None)
    return climb(make_evidence(imu, recording.observed), profile, (), (), max_rungs=0)


def shifted(verdict: GeometricVerdict, *, across: bool) -> GeometricVerdict:
    """Points of the upper part of the frame shifted along their parallax, as by a nearer scene, or across it."""
    along = verdict.fit.along_px
    assert along is not None
    off = 0.15 * along * (verdict.table.second_px[:, 1:] < 250)
    if across:
        off = np.stack([-off[:, 1], off[:, 0]], axis=-1)
    fit = replace(verdict.fit, difference_px=verdict.fit.difference_px + off, depth_spread_per_m=0.15)
    return replace(verdict, fit=fit)


def test_relief_is_not_residual_structure(before_a_wall: GeometricVerdict) -> None:
    """A ceiling nearer than the wall shifts points along their parallax; a fault shifts them across it."""
    assert not points_left(before_a_wall).significant
    assert not points_left(shifted(before_a_wall, across=False)).significant
    found = points_left(shifted(before_a_wall, across=True))
    assert found.significant
    assert found.size > 0.05


def test_a_very_small_residual_is_not_a_fault(before_a_wall: GeometricVerdict) -> None:
    """Gyroscope noise may be a large part of a very small residual; the same part of a larger one is a fault."""
    calm = replace(before_a_wall, noise_px=0.027, final_rms_px=0.035)
    assert not points_left(calm).significant
    noisier = replace(before_a_wall.fit, distance=1.7 * before_a_wall.fit.distance)
    found = points_left(replace(before_a_wall, fit=noisier, noise_px=0.08, final_rms_px=0.13))
    assert found.significant
    assert found.p_value is not None
    assert found.p_value < 1e-4


def test_the_noise_of_the_gyroscope_is_not_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    """White noise of 0.02 rad/s turns each pair by 0.13 px; uncounted, it would be structure over time."""
    recording = Recording(replace(WALL, gyro_noise_rad_s=0.02, noise_px=0.05))
    imu = recording.imu.between(-0.2, recording.stamp_s[-1] + 0.25)
    profile = replace(recording.profile, depth_m=None)
    verdict = climb(make_evidence(imu, recording.observed), profile, (), (), max_rungs=0)
    assert not points_left(verdict).significant
    monkeypatch.setattr(residual_tests, "noise_density", lambda *_: None)
    assert points_left(verdict).significant


def test_an_inconsistent_residual_is_not_a_fault(before_a_wall: GeometricVerdict) -> None:
    """A residual above the noise that the pairs of frames do not confirm is not reported."""
    found = points_left(replace(before_a_wall, noise_px=0.08, final_rms_px=0.13))
    assert not found.significant


def test_tracking_bias_from_blur_is_not_a_fault() -> None:
    """Points shift together as the blur paths of both frames predict; the opposite shift is a fault."""
    recording = Recording(replace(WALL, velocity_m_s=(0.0, 0.0, 0.0), rate_rad_s=1.2, noise_px=0.1))
    imu = recording.imu.between(-0.2, recording.stamp_s[-1] + 0.25)
    evidence = make_evidence(imu, recording.observed)
    verdict = climb(evidence, replace(recording.profile, depth_m=np.inf), (), (), max_rungs=0)
    verdict = replace(verdict, evidence=evidence)
    blurred = np.full(len(verdict.table), 0.024)
    table = replace(verdict.table, first_exposure_s=blurred, second_exposure_s=blurred)
    guided = np.zeros(len(evidence.observed.pairs), bool)
    bias_px = blur_bias_px(verdict.fit.integrated, table, guided)
    assert np.sqrt(np.mean(bias_px**2)) > 0.05

    def left(part: float) -> Remaining:
        off = verdict.fit.difference_px + part * bias_px
        return points_left(replace(verdict, table=table, fit=replace(verdict.fit, difference_px=off)))

    assert not left(1.3).significant
    assert left(-1.3).significant


def exposed_for(verdict: GeometricVerdict, exposure_s: float) -> GeometricVerdict:
    """The same points with another exposure."""
    table = verdict.table
    return replace(verdict, table=replace(table, second_exposure_s=np.full(len(table), exposure_s)))


def test_translation_blur_is_the_motion_within_an_exposure(before_a_wall: GeometricVerdict) -> None:
    """Walking at 0.8 m/s towards a wall at 1.6 m blurs a long exposure, hardly a short one; rotation does not."""
    short, long = (travel_blur_px(exposed_for(before_a_wall, exposure_s)) for exposure_s in (0.0005, 0.01))
    assert long == pytest.approx(20 * short, rel=0.2)
    assert short < MOST_TRAVEL_PX < long
    lens = before_a_wall.fit.profile.intrinsics
    assert lens is not None
    edge_px = 0.5 * np.hypot(before_a_wall.fit.profile.width, before_a_wall.fit.profile.height)
    assert 0.3 * edge_px < long / (0.01 * 0.8 * 0.6) < 1.5 * max(edge_px, lens.fx_px)
    turning = replace(before_a_wall, model=replace(before_a_wall.model, scene=None))
    assert travel_blur_px(turning) == 0.0
