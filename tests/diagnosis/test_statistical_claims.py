"""Probabilities and deviations are computed or unknown, and sums are such as can be."""

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


def test_a_word_is_as_probable_as_its_gain_by_blocks() -> None:
    """A readout of the wrong sense has a probability that follows from the blocks, not a constant."""
    camera, evidence = evidence_of(HAND)
    shutter = replace(camera.profile.shutter, readout_direction="bottom_to_top")
    verdict = climb(evidence, replace(camera.profile, shutter=shutter), (), ())
    (finding,) = findings_of(verdict)
    assert finding.name == "readout_direction"
    assert finding.p_value is not None
    assert 1e-9 < finding.p_value < 1e-3
    assert chance_of(np.array([0.1, 0.12, 0.11, 0.09])) < 1e-3 < chance_of(np.array([0.1, -0.12, 0.31, 0.09]))


def test_two_pairs_prove_no_noise_beyond_tracking_s() -> None:
    """Probabilities are numbers, however few pairs there are and however alike."""
    for pairs in (0, 1, 2, 5):
        pair = np.repeat(np.arange(pairs), 20)
        noisier, stray = _more_than_noise(np.full(len(pair), 1.5), pair, 1.0)
        assert noisier == (0.5 if pairs < 3 else 1.0)
        assert stray == (0.5 if pairs < 3 else 1.0)


def test_a_lag_is_as_well_known_as_its_pairs_tell_it() -> None:
    """The deviation of a lag shrinks with tracking noise, and holds what lies between two steps of the schedule."""
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
    """Unknown noise takes nothing away from before; noise above before leaves nothing of which to take a part."""
    assert HeldOutGain(GEOMETRY, 2.0, 1.0, None).gain == pytest.approx(0.75)
    assert HeldOutGain(GEOMETRY, 2.0, 1.0, 1.0).gain == pytest.approx(1.0)
    assert HeldOutGain(GEOMETRY, 2.0, 1.0, 2.5).gain is None


@pytest.mark.parametrize("inertial", [True, False])
def test_noise_stands_beside_the_residual_that_it_is_part_of(inertial: bool) -> None:
    """Where depths vary, both leave the parallax out: the noise is then about what was put in, and no more."""
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


def test_sums_can_be() -> None:
    """A residual below the noise is said to be no more than it."""
    assert residual_words(0.399, 0.123) == "0.399 px (tracking noise 0.123 px)"
    assert residual_words(0.05, 0.763) == "0.05 px, no more than tracking noise (0.763 px)"
    assert "p unknown" in remaining_words({"p_value": None, "strongest_along": "place"}, "unexplained")
