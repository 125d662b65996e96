"""A diagnosis does not depend on a processor's rounding."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from motion.synthetic_tracks import Recording, Setup

from virest.diagnosis import geometric_ladder
from virest.diagnosis.cross_validation import Judged
from virest.diagnosis.findings import ParameterChange
from virest.diagnosis.geometric_evidence import Evidence, Model, make_evidence
from virest.diagnosis.geometric_findings import _widened
from virest.diagnosis.geometric_ladder import _better_end
from virest.diagnosis.geometric_verdict import Accepted

TESTS = Path(__file__).resolve().parent.parent
CORES = ("Haswell", "Nehalem")
"""Processor types whose sums OpenBLAS orders differently; both run on any x86-64 with AVX2."""
HAND = Setup(seed=61, frames=37, points=15, readout_direction="top_to_bottom", gyro_noise_rad_s=0.001)
CLIMB = """
import json
from dataclasses import replace
from motion.synthetic_tracks import Recording, Setup
from virest.diagnosis import candidates
from virest.diagnosis.geometric_effects import GEOMETRIC_EFFECTS
from virest.diagnosis.geometric_evidence import make_evidence
from virest.diagnosis.geometric_findings import findings_of
from virest.diagnosis.geometric_ladder import climb

alike = ("time_offset", "timestamp_reference", "readout_time", "gyro_bias", "focal_length")
candidates.GEOMETRIC_EFFECTS = tuple(effect for effect in GEOMETRIC_EFFECTS if effect.name in alike)
camera = Recording(Setup(seed=61, frames=37, points=15, readout_direction="top_to_bottom", gyro_noise_rad_s=0.001))
evidence = make_evidence(camera.imu.between(-0.2, camera.stamp_s[-1] + 0.25), camera.observed)
found = findings_of(climb(evidence, replace(camera.profile, time_offset_s=0.02), (), ()))
print(json.dumps({f.name: {k: [c.estimate, c.std] for k, c in f.parameters.items()} for f in found}))
"""


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="core types of x86 processors")
def test_two_processor_types_give_the_same_diagnosis() -> None:
    """The causes are the same, and values differ by far less than their deviations."""
    told = []
    for core in CORES:
        env = {**os.environ, "OPENBLAS_CORETYPE": core, "OPENCV_IPP": "disabled"}
        env["PYTHONPATH"] = os.pathsep.join([str(TESTS), str(TESTS.parent), env.get("PYTHONPATH", "")])
        done = subprocess.run([sys.executable, "-c", CLIMB], capture_output=True, text=True, env=env, check=True)
        told.append(json.loads(done.stdout))
    assert told[0].keys() == told[1].keys() == {"time_offset"}
    (one, std), (other, _) = (each["time_offset"]["time_offset_s"] for each in told)
    assert abs(one - other) < 0.05 * std


def ends(monkeypatch: pytest.MonkeyPatch, losses: tuple[np.ndarray, np.ndarray]) -> tuple[Evidence, list]:
    """Two final states of a ladder with different causes and given held-out losses by time block."""
    camera = Recording(HAND)
    evidence = make_evidence(camera.imu, camera.observed)
    model = Model(camera.profile, None, ())

    def end(*names: str) -> SimpleNamespace:
        accepted = [Accepted(name, None, "", 1.0, 0.2, 1e-9, ()) for name in names]
        fit = SimpleNamespace(scale=1.0, depth_spread_per_m=0.0)
        return SimpleNamespace(model=model, accepted=accepted, fit=fit, notes=[], rival=None)

    judged = [Judged(None, np.zeros(1), loss, np.zeros(1), float(loss.mean())) for loss in losses]  # type: ignore[arg-type]
    monkeypatch.setattr(geometric_ladder, "judge", lambda _e, screened, *_: judged)
    return evidence, [end("clock_skew", "stabilisation"), end("clock_skew", "principal_point")]


WOBBLE = np.array([0.03, -0.02, 0.01, -0.03, 0.02, -0.01])


@pytest.mark.parametrize("swapped", [False, True])
def test_ladder_ends_that_held_out_points_cannot_separate_are_rivals(
    swapped: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The reported end does not depend on the order; the cause of the other is named as a rival."""
    evidence, (one, other) = ends(monkeypatch, (0.5 + WOBBLE, 0.5 - WOBBLE))
    first, second = (other, one) if swapped else (one, other)
    found = _better_end(evidence, first, second)
    assert [entry.name for entry in found.accepted] == ["clock_skew", "principal_point"]
    rivals = {entry.name: [rival.name for rival in entry.rivals] for entry in found.accepted}
    assert rivals == {"clock_skew": [], "principal_point": ["stabilisation"]}
    assert found.rival is one


@pytest.mark.parametrize("swapped", [False, True])
def test_the_rival_with_the_smaller_held_out_loss_is_reported(swapped: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """One standard error cannot separate the rivals but determines the reported one, whatever the order."""
    good, bad = 0.5 + WOBBLE, 0.504 + 1.3 * WOBBLE
    evidence, (one, other) = ends(monkeypatch, (bad, good) if swapped else (good, bad))
    first, second = (other, one) if swapped else (one, other)
    found = _better_end(evidence, first, second)
    assert [entry.name for entry in found.accepted] == ["clock_skew", "stabilisation"]
    assert [rival.name for rival in found.accepted[1].rivals] == ["principal_point"]


def test_a_clearly_better_ladder_end_has_no_rival(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every time block prefers the same end."""
    evidence, (one, other) = ends(monkeypatch, (0.5 + 0.1 * WOBBLE, 0.7 - 0.1 * WOBBLE))
    assert _better_end(evidence, one, other) is one
    assert one.rival is None


def test_deviations_include_the_difference_of_two_ends() -> None:
    """Two equally likely estimates add half of their squared difference to the variance."""
    change = _widened(ParameterChange(0.0, 0.0041, 2e-4), ParameterChange(0.0, 0.00515, 2e-4))
    assert change.std == pytest.approx(np.hypot(2e-4, 0.00105 / np.sqrt(2)))
    word = ParameterChange("exposure_start", "exposure_end", None)
    assert _widened(word, word) == word
