"""First-order displacements of points compared with predictions for each profile."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from image_formation.test_point_model import FAR, NEAR, over_the_ground
from motion.synthetic_tracks import Setup, recorded

from virest.camera.field import Field
from virest.camera.profile import CameraProfile
from virest.image_formation.point_changes import PointChanges
from virest.image_formation.point_model import integrate_motion, predict
from virest.inference.profile_terms import TERMS
from virest.motion.scene_motion import DirectedMotion, Motion

SETUPS = {
    **{name: (setup, False) for name, setup in FAR.items()},
    **{name: (setup, True) for name, setup in NEAR.items()},
}
MOTION = ("imu_rotation", "gyro_bias", "gyro_scale", "gyro_axes", "gyro_lowpass", "gyro_averaging")
OVER_TIME = Field("rate", ("time",), ((0.0, 0.4, 0.8, 1.2),), ((0.0,) * 3, (0.01, 0.0, -0.02), (0.0,) * 3, (0.02,) * 3))
OVER_FORCE = Field("rate", ("accel_y",), ((-80.0, 0.0, 80.0),), ((0.1, 0.0, 0.0), (0.0,) * 3, (-0.1, 0.0, 0.05)))


def changed(profile: CameraProfile) -> dict[str, CameraProfile]:
    """Profiles whose rates and axes differ slightly."""
    found = {}
    for name in MOTION:
        term = TERMS[name]
        for k, quotient in enumerate(term.quotient):
            found[f"{name} {k}"] = term.change(profile, quotient * np.eye(len(term))[k])
    for field in (OVER_TIME, OVER_FORCE):
        extensions = replace(profile.extensions, field=(field.with_values(0.02 * np.array(field.values)),))
        found[f"rate over {field.covariates[0]}"] = replace(profile, extensions=extensions)
    return found


def test_directions_of_travel_do_not_move_points() -> None:
    """A fit eliminates them: the displacements are those of a rotating camera."""
    recording = recorded(FAR["portrait, read from the right"])
    table, known = recording.table(), integrate_motion(recording.imu, recording.profile, translation=False)
    scenes: list[Motion | None] = [None, DirectedMotion(np.array([[0.6, 0.0, 0.8]]))]
    each = [PointChanges(recording.imu, known, table, scene, predict(known, table, scene)) for scene in scenes]
    profiles = list(changed(recording.profile).values())
    np.testing.assert_allclose(each[1].by_each(profiles), each[0].by_each(profiles), atol=1e-12)


@pytest.mark.parametrize(("setup", "travels"), SETUPS.values(), ids=SETUPS)
def test_changes_of_rates_and_axes_move_points_as_new_predictions_do(setup: Setup, travels: bool) -> None:
    """Within 0.5 % of the largest displacement: what a slope of a fit may err by is far more."""
    recording = recorded(setup)
    table, profile = recording.table(), recording.profile
    scene = recording.scene(table) if travels else None
    known = integrate_motion(recording.imu, profile, translation=travels)
    changes = PointChanges(recording.imu, known, table, scene, predict(known, table, scene))
    profiles = changed(profile)
    found = changes.by_each(list(profiles.values()))
    for k, (name, one) in enumerate(profiles.items()):
        expected = changes.by(one)
        largest = np.abs(expected).max()
        assert largest > 1e-6, name
        assert np.abs(found[:, :, k] - expected).max() < 0.005 * largest, name


def test_points_beyond_the_horizon_turn_with_the_camera_alone() -> None:
    """Over the ground half of the points lie above the horizon, and stay infinitely far when axes change slightly."""
    recording = recorded(NEAR["swaying"])
    table = recording.table()
    known, scene = over_the_ground(recording, table)
    changes = PointChanges(recording.imu, known, table, scene, predict(known, table, scene))
    term = TERMS["imu_rotation"]
    profiles = [term.change(recording.profile, 1e-5 * np.eye(3)[k]) for k in range(3)]
    expected = np.stack([changes.by(one) for one in profiles], axis=-1)
    np.testing.assert_allclose(changes.by_each(profiles), expected, atol=0.01 * np.abs(expected).max())


def test_other_changes_are_predicted_anew() -> None:
    """A clock, and a value that changes beside the rates, are no changes of the motion alone."""
    recording = recorded(NEAR["swaying"])
    table, profile = recording.table(), recording.profile
    scene = recording.scene(table)
    known = integrate_motion(recording.imu, profile, translation=True)
    changes = PointChanges(recording.imu, known, table, scene, predict(known, table, scene))
    biased = replace(profile, gyro_bias_rad_s=(0.001, 0.0, 0.0))
    others = [replace(profile, time_offset_s=0.001), replace(biased, time_offset_s=0.001)]
    found = changes.by_each([others[0], biased, others[1]])
    for k, one in ((0, others[0]), (2, others[1])):
        np.testing.assert_array_equal(found[:, :, k], changes.by(one))
    assert not np.array_equal(found[:, :, 1], changes.by(biased))
