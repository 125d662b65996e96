"""The coarse search: far offsets, any axes, turns about one axis only, clocks of different rates, and what is told."""

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
    """The profile without its offset and bias, its axes as given."""
    return replace(
        profile, time_offset_s=None, gyro_bias_rad_s=(0.0, 0.0, 0.0), r_cam_imu=tuple(map(tuple, axes.tolist()))
    )


def apart_deg(first: np.ndarray, second: np.ndarray) -> float:
    """Angle between two rotations."""
    return float(np.degrees(Rotation.from_matrix(first @ second.T).magnitude()))


@pytest.mark.parametrize("number", [0, 5, 9, 14, 22])
def test_a_far_offset_is_found_with_any_axes(number: int) -> None:
    """From tracked points: 0.45 s to a few milliseconds and the mounting to a degree or two, whatever was given."""
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
    """A mounting known to five degrees stays as given; the fit that follows will see to the rest."""
    recording = recorded(LATE)
    nearly = Rotation.from_rotvec([0.05, -0.06, 0.03]).as_matrix() @ recording.profile.rotation_cam_imu
    found = align_coarsely(recording.turns(), recording.imu, unknowing(recording.profile, nearly))
    assert found is not None
    assert not found.axes_changed
    np.testing.assert_allclose(found.rotation_cam_imu, nearly)
    assert found.time_offset_s == pytest.approx(0.45, abs=0.006)


def test_motion_is_what_changes_in_the_turns() -> None:
    """The rms of the changing turns: about the rate times a frame, per axis, whatever steady pan lies beneath."""
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
def test_turns_about_one_axis_take_an_axis_map(axis: int) -> None:
    """They determine no rotation; the map taken brings the axis that turns where it belongs; the offset is found."""
    about = tuple(np.eye(3)[axis].tolist())
    setup = replace(LATE, frames=150, about=about, r_cam_imu=PLANAR_AXES)
    recording = recorded(setup)
    turned = np.eye(3)[2 - axis]
    # the map that turns this axis upside down: the worst there is
    wrong = max(axis_maps(), key=lambda m: -float(turned @ m @ np.array(PLANAR_AXES).T @ turned))
    found = align_coarsely(recording.turns(), recording.imu, unknowing(recording.profile, wrong))
    assert found is not None
    assert found.axes_changed
    assert any(np.array_equal(found.rotation_cam_imu, m) for m in axis_maps())
    np.testing.assert_array_equal(turned @ found.rotation_cam_imu, turned @ np.array(PLANAR_AXES))
    assert found.time_offset_s == pytest.approx(0.45, abs=0.006)
    assert found.explained > 0.97


def test_a_strange_gyroscope_is_told_and_not_refused() -> None:
    """Another hand's gyroscope explains little and its runner-up as much: for the caller to judge."""
    found = align_coarsely(recorded(LATE).turns(), recorded(replace(LATE, seed=22)).imu, recorded(LATE).profile)
    assert found is not None
    assert found.explained < 0.5
    assert found.explained - found.runner_up < 0.1


def test_an_offset_beyond_the_search_lies_at_its_end() -> None:
    """A search of ±0.4 s about nought for 0.45 s ends on the edge, or says that it found nothing good."""
    recording = recorded(replace(LATE, rate_rad_s=0.3))
    given = unknowing(recording.profile, recording.profile.rotation_cam_imu)
    near = align_coarsely(recording.turns(), recording.imu, given, search_s=0.444)
    assert near is not None
    assert near.at_end
    inside = align_coarsely(recording.turns(), recording.imu, given, search_s=0.6)
    assert inside is not None
    assert not inside.at_end


def test_no_inertial_data_no_alignment() -> None:
    """Stamps an hour away from the inertial data, or pictures that never turn, give nothing."""
    recording = recorded(LATE)
    assert align_coarsely(recording.turns(3600.0), recording.imu, recording.profile) is None
    still = replace(recording.turns(), vector_rad=np.zeros((59, 3)))
    assert align_coarsely(still, recording.imu, recording.profile) is None


@pytest.mark.parametrize("skew", [0.0, 0.0028])
def test_clocks_of_different_rates_are_searched(skew: float) -> None:
    """Over 14 s a skew of 2.8 in a thousand is found to the nearest step; equal rates stay equal."""
    recording = recorded(Setup(seed=23, time_offset_s=0.12, clock_skew=skew, frames=420))
    given = replace(recording.profile, clock_skew=0.0, time_offset_s=0.1)
    found = align_with_skew(recording.turns(), recording.imu, given, search_s=0.2)
    assert found is not None
    coarse, taken = found
    assert taken == (0.003 if skew else 0.0)
    assert coarse.time_offset_s == pytest.approx(0.12, abs=0.008)
    assert coarse.explained > 0.9


def test_there_are_24_axis_maps() -> None:
    """All proper, all different, entries −1, 0 and 1; the phone's usual mounting is among them."""
    maps = axis_maps()
    assert maps.shape == (24, 3, 3)
    assert len(np.unique(maps.reshape(24, 9), axis=0)) == 24
    np.testing.assert_allclose(np.linalg.det(maps), 1)
    np.testing.assert_array_equal(np.abs(maps).sum(axis=1), np.ones((24, 3)))
    assert any(np.array_equal(m, CameraProfile(4, 4).rotation_cam_imu) for m in maps)
