"""Trajectories compared with the truth: alignment, lost runs, times, and TUM's file format."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from virest.errors import CaptureError, SettingsError
from virest.evaluation.trajectories import (
    CameraPath,
    TrajectoryScore,
    added_error_removed,
    aligned_rmse,
    match_times,
    parse_tum,
    score_path,
    summarise,
    tum_text,
)

pytest.importorskip("evo", reason="the extra [slam] is not installed")


@pytest.fixture
def walk() -> CameraPath:
    """A curved walk of 2 s with uneven rotation; times do not start at 0."""
    time_s = np.linspace(-0.3, 1.7, 401)
    position = np.stack([0.4 * time_s, 0.1 * np.sin(3 * time_s), 0.2 * np.cos(2 * time_s) + 1], axis=1)
    turn = Rotation.from_rotvec(np.stack([0.2 * time_s, -0.4 * time_s**2, 0.3 + 0 * time_s], axis=1))
    return CameraPath(time_s, position, turn.as_quat(scalar_first=True))


def moved(position: np.ndarray) -> np.ndarray:
    """The same path with other axes and origin, 3.7 times as large."""
    return 3.7 * Rotation.from_rotvec([0.7, -1.1, 0.4]).apply(position) + [5.0, -2.0, 11.0]


def umeyama_rmse(truth: np.ndarray, found: np.ndarray) -> float:
    """RMSE after the best similarity, computed independently (Umeyama 1991, eqs 38-43)."""
    a, b = found - found.mean(0), truth - truth.mean(0)
    u, d, vt = np.linalg.svd(b.T @ a / len(a))
    sign = np.diag([1, 1, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    scale = np.trace(np.diag(d) @ sign) / (a**2).sum(1).mean()
    left = b - scale * a @ (u @ sign @ vt).T
    return float(np.sqrt((left**2).sum(1).mean()))


def test_a_similarity_transform_does_not_change_the_score(walk: CameraPath):
    """Frames determine a path only up to a similarity."""
    frames_s = np.arange(12) / 9.0
    found = dict(enumerate(moved(walk.at(frames_s).position_m)))
    score = score_path(walk, found, frames_s)
    assert score.rmse_m < 1e-9
    assert (score.poses, score.frames, score.tracked) == (12, 12, 1.0)


def test_the_error_is_the_rmse_after_umeyama(walk: CameraPath, rng: np.random.Generator):
    """evo's figure equals the definition in the alignment's paper."""
    truth = walk.at(np.linspace(0, 1.5, 20)).position_m
    found = moved(truth + rng.normal(0, 0.013, truth.shape))
    assert aligned_rmse(truth, found, np.arange(20.0)) == pytest.approx(umeyama_rmse(truth, found), rel=1e-9)


def test_a_path_scored_at_the_wrong_times_is_worse(walk: CameraPath):
    """Positions 30 ms later do not fit a curved path."""
    frames_s = np.arange(12) / 9.0
    found = dict(enumerate(moved(walk.at(frames_s + 0.03).position_m)))
    assert score_path(walk, found, frames_s + 0.03).rmse_m < 1e-9
    assert score_path(walk, found, frames_s).rmse_m > 1e-4


def test_a_path_through_less_than_half_of_the_frames_is_lost(walk: CameraPath):
    """Few frames align well in any case, so they do not count."""
    frames_s = np.arange(12) / 9.0
    position = walk.at(frames_s).position_m
    assert score_path(walk, {k: position[k] for k in (1, 2, 5, 7, 9)}, frames_s).lost
    kept = score_path(walk, {k: position[k] for k in (0, 2, 5, 7, 9, 11)}, frames_s)
    assert not kept.lost
    assert kept.tracked == 0.5


def test_frames_outside_the_true_path_are_refused(walk: CameraPath):
    """No pose is extrapolated."""
    with pytest.raises(CaptureError, match=r"covers -0\.300 to 1\.700 s"):
        walk.at(np.array([0.0, 1.8]))


def test_median_and_range_are_defined_with_lost_runs():
    """Two lost runs of three make the median infinite; one of three does not."""
    good, bad = TrajectoryScore(0.02, 9, 10), TrajectoryScore(float("inf"), 2, 10)
    assert summarise([bad, good, good]).median_m == 0.02
    assert np.isinf(summarise([bad, good, good]).high_m)
    assert np.isinf(summarise([bad, good, bad]).median_m)
    assert summarise([good, TrajectoryScore(0.04, 9, 10)]).median_m == pytest.approx(0.03)


def test_the_removed_part_of_the_added_error():
    """1 is as good as a global shutter, below 0 is worse than recorded."""
    assert added_error_removed(16.4, 45.5, 23.7) == pytest.approx(0.749, abs=1e-3)
    assert added_error_removed(0.5, 2.5, 3.0) == pytest.approx(-0.25)
    assert added_error_removed(0.5, float("inf"), 0.6) == 1.0
    assert added_error_removed(0.5, 0.4, 0.4) is None
    assert added_error_removed(0.5, 2.5, float("inf")) is None


def test_a_written_trajectory_reads_back_the_same(walk: CameraPath):
    """TUM's order of a quaternion is x y z w; comments are skipped, and poses are sorted by time."""
    again = parse_tum("# a comment\n" + tum_text(walk))
    np.testing.assert_allclose(again.time_s, walk.time_s, atol=1e-8)
    np.testing.assert_allclose(again.position_m, walk.position_m, atol=1e-8)
    np.testing.assert_allclose(again.q_world_cam, walk.q_world_cam, atol=1e-8)
    late = parse_tum("1403636580.5 1 2 3 0 0 0 1\n1403636579.5 4 5 6 0.5 0.5 -0.5 0.5")
    np.testing.assert_allclose(late.time_s, [1403636579.5, 1403636580.5])
    np.testing.assert_array_equal(late.position_m[0], [4, 5, 6])
    np.testing.assert_array_equal(late.q_world_cam[0], [0.5, 0.5, 0.5, -0.5])


@pytest.mark.parametrize("text", ["0 1 2 3\n", "a b c d e f g h\n", "0 1 2 3 0 0 0 nan\n", "0 1 2 3 0 0 0 1\n1 2\n"])
def test_a_file_that_is_not_a_trajectory_is_refused(text: str):
    """A line that is not a pose is an error and is not skipped."""
    with pytest.raises(SettingsError, match="TUM"):
        parse_tum(text)


def test_an_empty_trajectory_has_no_poses():
    """A SLAM program that never started gives an empty trajectory."""
    assert len(parse_tum("# nothing\n").time_s) == 0
    assert match_times(np.arange(5.0), parse_tum(""), 0.1) == {}


def test_poses_match_the_nearest_frame_within_the_tolerance():
    """A pose between two frames or after the last matches none."""
    position = np.arange(12.0).reshape(4, 3)
    found = CameraPath(np.array([0.98, 2.04, 2.5, 9.0]), position, np.tile([1.0, 0, 0, 0], (4, 1)))
    matched = match_times(np.array([0.0, 1.0, 2.0, 3.0]), found, 0.1)
    assert sorted(matched) == [1, 2]
    np.testing.assert_array_equal(matched[2], [3, 4, 5])
