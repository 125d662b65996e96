"""Slopes of a turning camera's points against difference quotients of their predictions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from motion.synthetic_tracks import Setup, recorded

from virest.camera.profile import CameraProfile
from virest.image_formation.point_model import ground, predict, with_profile
from virest.image_formation.point_slopes import TurningSlopes
from virest.inference.profile_terms import READOUT, TERMS
from virest.inference.term import Term, slopes_of

SETUPS = [
    Setup(noise_px=0.0),
    Setup(seed=3, noise_px=0.0, k1=0.05, readout_direction="left_to_right", clock_skew=0.003, gyro_scale=1.03),
    Setup(seed=10, noise_px=0.0, gyro_lowpass_hz=9.0, timestamp="exposure_middle"),
]
FOLLOWED = ("time_offset", "clock_skew", "readout_time", "gyro_bias", "gyro_scale", "gyro_lowpass", "imu_rotation")


@pytest.mark.parametrize("setup", SETUPS, ids=("plain", "skewed", "filtered"))
@pytest.mark.parametrize("name", FOLLOWED)
def test_slopes_are_those_of_the_predictions(setup: Setup, name: str) -> None:
    """Of clocks, rates and axes: quotients to both sides say the same, to a thousandth.

    Behind a low pass the rate's slope jumps at the samples, and the mean over an exposure with it, which no slope has.
    """
    recording, table = recorded(setup), recorded(setup).table()
    profile, term = recording.profile, TERMS[name]
    known = ground(recording.imu, profile, translation=False)
    at = predict(known, table, None)
    slopes = TurningSlopes(recording.imu, known, table, at)

    def by_turns(other: CameraProfile) -> np.ndarray:
        moved = slopes.moved_by(other)
        assert moved is not None
        return moved

    def predicted(other: CameraProfile) -> np.ndarray:
        return predict(with_profile(known, recording.imu, other), table, None).second_px

    found = slopes_of(term, profile, table, by_turns)
    for k, step in enumerate(np.diag(0.1 * np.array(term.quotient))):
        ends = (predicted(term.change(profile, side * step)) for side in (1, -1))
        wanted = np.subtract(*ends) / (2 * step[k])
        off = np.sqrt(np.mean((found[..., k] - wanted) ** 2))
        part = 0.03 if setup.gyro_lowpass_hz else 2e-3
        assert off < part * np.sqrt(np.mean(wanted**2)), f"{name} {k}: {off}"


def test_changes_add_up() -> None:
    """A readout that keeps the middle row moves the offset too; an offset and a bias together are their sum."""
    recording, table = recorded(SETUPS[0]), recorded(SETUPS[0]).table()
    known = ground(recording.imu, recording.profile, translation=False)
    slopes = TurningSlopes(recording.imu, known, table, predict(known, table, None))
    offset = replace(recording.profile, time_offset_s=(recording.profile.time_offset_s or 0.0) + 1e-4)
    bias = replace(recording.profile, gyro_bias_rad_s=(1e-4, -2e-4, 3e-4))
    both = replace(bias, time_offset_s=offset.time_offset_s)
    parts = [slopes.moved_by(profile) for profile in (offset, bias, both)]
    np.testing.assert_allclose(parts[2], parts[0] + parts[1], atol=1e-12)  # type: ignore[operator]
    assert slopes.moved_by(READOUT.change(recording.profile, np.array([1e-4]))) is not None


@pytest.mark.parametrize("term", [t for t in TERMS.values() if t.name not in FOLLOWED], ids=lambda term: term.name)
def test_what_else_moves_points_is_left_to_predictions(term: Term) -> None:
    """Lens, stabiliser and exposure: there is no such slope, and none for a lens that moves."""
    recording, table = recorded(SETUPS[0]), recorded(SETUPS[0]).table()
    known = ground(recording.imu, recording.profile, translation=False)
    slopes = TurningSlopes(recording.imu, known, table, predict(known, table, None))
    changed = term.change(recording.profile, np.array(term.quotient))
    assert slopes.moved_by(changed) is None
    moving = with_profile(known, recording.imu, changed)
    if moving.lens.shift is not None or moving.lens.focal_drift_per_s:
        later = replace(changed, time_offset_s=(changed.time_offset_s or 0.0) + 1e-4)
        slopes = TurningSlopes(recording.imu, moving, table, predict(moving, table, None))
        assert slopes.moved_by(later) is None
