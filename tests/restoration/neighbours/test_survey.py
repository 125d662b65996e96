"""The frames that planning compares with their neighbours."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from virest.app.simulate import simulate_command
from virest.capture.folder import read_capture, resolve_profile
from virest.image_formation.row_motion import row_motion
from virest.motion.integration import integrate_gyro
from virest.restoration.capture import RestorationPlan
from virest.restoration.neighbour_plan import with_neighbour_survey
from virest.restoration.neighbours.survey import MOST_RUNS, RUN_FRAMES, survey_runs
from virest.restoration.settings import PRESETS


@pytest.mark.parametrize("count", [14, 31, 60, 240])
def test_runs_are_spread_over_a_capture_of_any_length(rng: np.random.Generator, count: int) -> None:
    """An unbroken capture gives as many runs as one with gaps, since one run of fast frames may show nothing."""
    path_px = dict(enumerate(rng.uniform(1, 30, count).tolist()))
    runs = survey_runs(path_px, path_px)
    assert len(runs) == min(count // RUN_FRAMES, MOST_RUNS)
    assert all(np.array_equal(np.diff(run), np.ones(RUN_FRAMES - 1)) for run in runs)
    assert all(before[-1] < after[0] for before, after in pairwise(runs))
    assert runs[0][0] < count / MOST_RUNS
    assert runs[-1][-1] >= count * (1 - 1 / MOST_RUNS)


def test_the_most_blurred_frames_of_each_part_are_compared() -> None:
    """No run extends over a gap between stretches."""
    numbers = [*range(8), *range(20, 28)]
    path_px = {n: 20.0 if 2 <= n <= 5 or n >= 24 else 1.0 for n in numbers}
    runs = survey_runs(numbers, path_px)
    assert (24, 25, 26, 27) in runs
    assert all(run[-1] - run[0] == len(run) - 1 for run in runs)


@pytest.mark.parametrize("off_rad_s", [None, 0.1])
def test_a_point_residual_replaces_a_missing_pair_of_frames(
    tmp_path: Path, rng: np.random.Generator, off_rad_s: float | None
) -> None:
    """Noise gives no turn; the rate missing from the points then makes every path uncertain, and nothing else."""
    simulate_command(tmp_path / "noise", width=320, height=240, frames=6, rate_rad_s=1.0, truth_frames=False)
    capture = read_capture(tmp_path / "noise")
    profile, _ = resolve_profile(capture, None)
    plan = RestorationPlan(profile, PRESETS["fast"], points_off_rad_s=off_rad_s)
    lumas = {n: rng.integers(120, 137, (240, 320)).astype(np.uint8) for n in range(6)}
    found = with_neighbour_survey(plan, capture, [tuple(range(4))], lumas, {}).missing_turn
    if off_rad_s is None:
        assert found is None
        return
    assert found is not None
    trajectory = integrate_gyro(capture.imu, profile)
    motion = row_motion(trajectory, profile, capture.frames[2].time_s, 0.01)
    refined = found.refined(motion, [None], [None], trajectory)
    assert refined.further is None
    assert np.sqrt(np.diag(refined.rate_covariance)) == pytest.approx([off_rad_s] * 3)
    assert profile.intrinsics is not None
    path_std_px = np.sqrt(np.diag(refined.path_covariance_px2()))
    assert path_std_px == pytest.approx([profile.intrinsics.fx_px * off_rad_s * 0.01] * 2, rel=0.02)
