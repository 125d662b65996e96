"""The coarse search: distant offsets, any axes, rotation about one axis, different clock rates, and its reports."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from motion.synthetic_tracks import Setup, recorded
from scipy.spatial.transform import Rotation

from virest.camera.profile import CameraProfile
from virest.inference.coarse_alignment import align_coarsely, align_with_skew, axis_maps

LATE = Setup(seed=21, time_offset_s=0.45, frames=60, points=20, readout_direction="bottom_to_top")
PLANAR_AXES = ((0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0))


def unknowing(profile: CameraProfile, axes: np.ndarray) -> CameraProfile:
    """The profile without its offset and bias, with the given axes."""
    return replace(
        profile, time_offset_s=None, gyro_bias_rad_s=(0.0, 0.0, 0.0), r_cam_imu=tuple(map(tuple, axes.tolist()))
    )


def apart_deg(first: np.ndarray, second: np.ndarray) -> float:
    """Angle between two rotations."""
    return float(np.degrees(Rotation.from_matrix(first @ second.T).magnitude()))


@pytest.mark.parametrize("number", [0, 5, 9, 14, 22])
def test_a_distant_offset_is_found_with_any_axes(number: int) -> None:
    """From tracked points, an offset of 0.45 s is found within 6 ms and the mounting within 3°, for any given axes."""
    recording = recorded(LATE)
    given = unknowing(recording.profile, axis_maps()[number])
    found = align_coarsely(recording.observed.turns(given), recording.imu, given)
    assert found is not None
    assert found.time_offset_s == pytest.approx(0.45, abs=0.006)
    assert found.explained > 0.97
    assert found.runner_up < 0.7
    assert abs(found.runner_up_s - found.time_offset_s) > 0.06
    assert not found.at_end
    if apart_deg(axis_maps()[number], recording.profile.rotation_cam_imu) > 30:
        assert found.axes_changed
        assert apart_deg(found.rotation_cam_imu, recording.profile.rotation_cam_imu) < 3


def test_axes_that_fit_are_kept() -> None:
    """A mounting known to 5° is kept as given and refined by the subsequent fit."""
    recording = recorded(LATE)
    nearly = Rotation.from_rotvec([0.05, -0.06, 0.03]).as_matrix() @ recording.profile.rotation_cam_imu
    found = align_coarsely(recording.turns(), recording.imu, unknowing(recording.profile, nearly))
    assert found is not None
    assert not found.axes_changed
    np.testing.assert_allclose(found.rotation_cam_imu, nearly)
    assert found.time_offset_s == pytest.approx(0.45, abs=0.006)


def test_motion_is_the_varying_part_of_the_rotation() -> None:
    """The RMS of the rotation per frame excludes a steady pan."""
    recording = recorded(LATE)
    found = align_coarsely(recording.turns(), recording.imu, recording.profile)
    assert found is not None
    turns = recording.turns().vector_rad
    assert found.motion_rad == pytest.approx(np.sqrt((turns**2).sum(axis=1).mean()), rel=0.1)
    panned = replace(recording.turns(), vector_rad=turns + np.array([0.01, -0.02, 0.015]))
    moved = align_coarsely(panned, recording.imu, recording.profile)
    assert moved is not None
    assert moved.motion_rad == pytest.approx(found.motion_rad, rel=0.02)
    assert moved.time_offset_s == pytest.approx(found.time_offset_s, abs=0.005)


@pytest.mark.parametrize("axis", [0, 1, 2], ids=["yaw", "pitch", "roll"])
def test_rotation_about_one_axis_selects_an_axis_map(axis: int) -> None:
    """It does not determine all axes; the selected map assigns the rotating axis correctly, and the offset is found."""
    about = tuple(np.eye(3)[axis].tolist())
    setup = replace(LATE, frames=150, about=about, r_cam_imu=PLANAR_AXES)
    recording = recorded(setup)
    turned = np.eye(3)[2 - axis]
    # the map that reverses this axis is the worst one
    wrong = max(axis_maps(), key=lambda m: -float(turned @ m @ np.array(PLANAR_AXES).T @ turned))
    found = align_coarsely(recording.turns(), recording.imu, unknowing(recording.profile, wrong))
    assert found is not None
    assert found.axes_changed
    assert any(np.array_equal(found.rotation_cam_imu, m) for m in axis_maps())
    np.testing.assert_array_equal(turned @ found.rotation_cam_imu, turned @ np.array(PLANAR_AXES))
    assert found.time_offset_s == pytest.approx(0.45, abs=0.006)
    assert found.explained > 0.97


def test_a_foreign_gyroscope_is_reported_to_the_caller() -> None:
    """Another recording's gyroscope explains little, hardly more than the second-best offset."""
    found = align_coarsely(recorded(LATE).turns(), recorded(replace(LATE, seed=22)).imu, recorded(LATE).profile)
    assert found is not None
    assert found.explained < 0.5
    assert found.explained - found.runner_up < 0.1


def test_an_offset_beyond_the_search_range_is_at_its_end() -> None:
    """A search range too small for 0.45 s gives a result at its limit, marked as such."""
    recording = recorded(replace(LATE, rate_rad_s=0.3))
    given = unknowing(recording.profile, recording.profile.rotation_cam_imu)
    near = align_coarsely(recording.turns(), recording.imu, given, search_s=0.444)
    assert near is not None
    assert near.at_end
    inside = align_coarsely(recording.turns(), recording.imu, given, search_s=0.6)
    assert inside is not None
    assert not inside.at_end


def test_without_inertial_data_there_is_no_alignment() -> None:
    """Timestamps an hour away from the samples, or frames without rotation, give no result."""
    recording = recorded(LATE)
    assert align_coarsely(recording.turns(3600.0), recording.imu, recording.profile) is None
    still = replace(recording.turns(), vector_rad=np.zeros((59, 3)))
    assert align_coarsely(still, recording.imu, recording.profile) is None


@pytest.mark.parametrize("skew", [0.0, 0.0028])
def test_clocks_of_different_rates_are_searched(skew: float) -> None:
    """Over 14 s, a skew of 0.0028 is found to the nearest step; equal rates stay equal."""
    recording = recorded(Setup(seed=23, time_offset_s=0.12, clock_skew=skew, frames=420))
    given = replace(recording.profile, clock_skew=0.0, time_offset_s=0.1)
    found = align_with_skew(recording.turns(), recording.imu, given, search_s=0.2)
    assert found is not None
    coarse, taken = found
    assert taken == (0.003 if skew else 0.0)
    assert coarse.time_offset_s == pytest.approx(0.12, abs=0.008)
    assert coarse.explained > 0.9


def test_there_are_24_axis_maps() -> None:
    """All are different proper rotations with entries −1, 0 and 1; the usual mounting is among them."""
    maps = axis_maps()
    assert maps.shape == (24, 3, 3)
    assert len(np.unique(maps.reshape(24, 9), axis=0)) == 24
    np.testing.assert_allclose(np.linalg.det(maps), 1)
    np.testing.assert_array_equal(np.abs(maps).sum(axis=1), np.ones((24, 3)))
    assert any(np.array_equal(m, CameraProfile(4, 4).rotation_cam_imu) for m in maps)
