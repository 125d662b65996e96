"""Probabilities and deviations are computed or unknown, and residuals and noise are consistent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from motion.synthetic_tracks import Recording, Setup

from virest.diagnosis.findings import GEOMETRY, HeldOutGain
from virest.diagnosis.geometric_conclusion import lag_std_s
from virest.diagnosis.geometric_evidence import Evidence, Model, make_evidence
from virest.diagnosis.geometric_findings import findings_of
from virest.diagnosis.geometric_ladder import climb
from virest.diagnosis.residual_tests import _more_than_noise
from virest.image_formation.point_model import integrate_motion
from virest.inference.chance import chance_of
from virest.inference.comparable_noise import residual_px, tracking_noise_px
from virest.inference.track_fit import many_directions, start_scene
from virest.report.words import remaining_words, residual_words

HAND = Setup(seed=61, frames=37, points=15, readout_direction="top_to_bottom", gyro_noise_rad_s=0.001)
ROOM = Setup(
    seed=21, frames=45, points=60, inverse_depth_per_m=(0.1, 1.5), velocity_m_s=(0.5, 0.0, 0.3), rate_rad_s=0.3,
    outliers=0.0,
)  # fmt: skip


def evidence_of(setup: Setup) -> tuple[Recording, Evidence]:
    """A recording and its evidence."""
    camera = Recording(setup)
    return camera, make_evidence(camera.imu.between(-0.2, camera.stamp_s[-1] + 0.25), camera.observed)


def test_the_p_value_of_a_word_follows_from_its_gain_by_blocks() -> None:
    """The p-value of a readout direction is computed from the time blocks and is not a constant."""
    camera, evidence = evidence_of(HAND)
    shutter = replace(camera.profile.shutter, readout_direction="bottom_to_top")
    verdict = climb(evidence, replace(camera.profile, shutter=shutter), (), ())
    (finding,) = findings_of(verdict)
    assert finding.name == "readout_direction"
    assert finding.p_value is not None
    assert 1e-9 < finding.p_value < 1e-3
    assert chance_of(np.array([0.1, 0.12, 0.11, 0.09])) < 1e-3 < chance_of(np.array([0.1, -0.12, 0.31, 0.09]))


def test_few_pairs_do_not_prove_noise_beyond_tracking() -> None:
    """p-values are defined for any number of pairs and for equal residuals."""
    for pairs in (0, 1, 2, 5):
        pair = np.repeat(np.arange(pairs), 20)
        noisier, stray = _more_than_noise(np.full(len(pair), 1.5), pair, 1.0)
        assert noisier == (0.5 if pairs < 3 else 1.0)
        assert stray == (0.5 if pairs < 3 else 1.0)


def test_the_deviation_of_a_lag_follows_from_its_pairs() -> None:
    """It shrinks with the tracking noise and includes the steps of the schedule."""
    found = []
    for noise_px in (0.05, 0.4):
        camera, evidence = evidence_of(replace(HAND, noise_px=noise_px))
        early = replace(camera.profile.extensions, frame_lag_s=0.05, frame_lag_frames=20)
        model = Model(replace(camera.profile, extensions=early), None, ())
        found.append(lag_std_s(evidence, model, evidence.table(model, 2000)))
    assert found[0] < 0.5 * found[1]
    late = replace(model, profile=replace(model.profile, time_offset_s=(model.profile.time_offset_s or 0.0) + 0.006))
    assert lag_std_s(evidence, late, evidence.table(late, 2000)) == pytest.approx(0.006, rel=0.2)


def test_a_gain_without_noise_is_a_lower_bound() -> None:
    """Unknown noise is not subtracted; if the noise exceeds the residual before, the gain is undefined."""
    assert HeldOutGain(GEOMETRY, 2.0, 1.0, None).gain == pytest.approx(0.75)
    assert HeldOutGain(GEOMETRY, 2.0, 1.0, 1.0).gain == pytest.approx(1.0)
    assert HeldOutGain(GEOMETRY, 2.0, 1.0, 2.5).gain is None


@pytest.mark.parametrize("inertial", [True, False])
def test_noise_and_residual_are_consistent(inertial: bool) -> None:
    """With varying depths both exclude the parallax, so the noise is about the true one."""
    camera = Recording(ROOM)
    evidence = make_evidence(camera.imu, camera.observed)
    model = Model(camera.profile, None, ())
    table = evidence.table(model, 3000)
    known = integrate_motion(camera.imu, camera.profile, translation=True)
    scene = start_scene(camera.imu, known, table, 0.5) if inertial else many_directions(table)
    fitted = evidence.fit(replace(model, scene=scene), (), table)
    noise, residual = tracking_noise_px(camera.observed, fitted), residual_px(fitted)
    assert noise < 1.15 * residual
    assert 0.5 * ROOM.noise_px < noise < 1.6 * ROOM.noise_px


def test_residual_texts_are_plausible() -> None:
    """A residual below the noise is described as no more than the noise."""
    assert residual_words(0.399, 0.123) == "0.399 px (tracking noise 0.123 px)"
    assert residual_words(0.05, 0.763) == "0.05 px, no more than tracking noise (0.763 px)"
    assert "p unknown" in remaining_words({"p_value": None, "strongest_along": "place"}, "unexplained")
    small = {"p_value": 2e-34, "strongest_along": "time", "size": 0.12, "limit": 0.17, "unit": "px"}
    assert remaining_words(small, "explained").startswith("What remains, 0.12 px along time, is below the 0.17")
    assert "p = 0.3" in remaining_words({**small, "p_value": 0.3, "size": 0.2}, "explained")
