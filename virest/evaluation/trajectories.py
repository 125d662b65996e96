"""Trajectory error: evo's absolute pose error after Sim(3) alignment.

A monocular trajectory is known up to a similarity, so rotation, position and scale are aligned first (Umeyama 1991,
doi:10.1109/34.88573), as ``evo_ape --align --correct_scale`` does.  The score is the RMSE of the residual in metres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from virest.arrays import Array
from virest.errors import CaptureError, SettingsError

LEAST_POSES = 4
"""Three points can always be aligned; an error needs one more."""
LEAST_TRACKED = 0.5
"""Minimum fraction of frames with a pose; below it the trajectory counts as lost, since its error says little."""


@dataclass(frozen=True, slots=True)
class CameraPath:
    """Camera poses at increasing times."""

    time_s: Array
    """(n,)."""
    position_m: Array
    """(n, 3) camera centres, metres, or any unit if the scale is unknown."""
    q_world_cam: Array
    """(n, 4) w x y z."""

    def at(self, time_s: Array) -> CameraPath:
        """Poses at other times (m,): positions by cubic spline, orientations by slerp.

        Raises CaptureError if the poses do not cover the times.
        """
        time_s = np.asarray(time_s, float)
        if len(time_s) and (time_s.min() < self.time_s[0] or time_s.max() > self.time_s[-1]):
            asked = f"{time_s.min():.3f} to {time_s.max():.3f} s"
            raise CaptureError(
                f"the true trajectory covers {self.time_s[0]:.3f} to {self.time_s[-1]:.3f} s, frames need {asked}",
                hint="give a trajectory of the whole capture",
            )
        turn = Slerp(self.time_s, Rotation.from_quat(self.q_world_cam, scalar_first=True))
        position = CubicSpline(self.time_s, self.position_m)(time_s)
        return CameraPath(time_s, position, turn(time_s).as_quat(scalar_first=True))

    @property
    def length_m(self) -> float:
        """Path length, summed from pose to pose."""
        return float(np.linalg.norm(np.diff(self.position_m, axis=0), axis=1).sum())


@dataclass(frozen=True, slots=True)
class TrajectoryScore:
    """Score of one run."""

    rmse_m: float
    """RMS distance between aligned and true positions; infinite if the trajectory was lost."""
    poses: int
    """Number of frames with a pose."""
    frames: int
    """Number of frames given."""

    @property
    def tracked(self) -> float:
        """Fraction of the frames with a pose."""
        return self.poses / self.frames if self.frames else 0.0

    @property
    def lost(self) -> bool:
        """Whether the trajectory was lost."""
        return not np.isfinite(self.rmse_m)


@dataclass(frozen=True, slots=True)
class ScoreSummary:
    """Scores of several runs on the same frames."""

    median_m: float
    low_m: float
    high_m: float
    tracked: float
    """Median fraction of the frames with a pose."""


def score_path(truth: CameraPath, found: Mapping[int, Sequence[float]], time_s: Array) -> TrajectoryScore:
    """Score positions against truth at the frames' reference times, after Sim(3) alignment.

    found: position (3,) by frame number, in any unit and axes.  time_s: (frames,) reference times of all frames.
    """
    numbers = sorted(found)
    count = len(time_s)
    if len(numbers) < max(LEAST_POSES, LEAST_TRACKED * count):
        return TrajectoryScore(np.inf, len(numbers), count)
    reference = truth.at(np.asarray(time_s, float)[numbers])
    rmse = aligned_rmse(reference.position_m, np.array([found[n] for n in numbers], float), reference.time_s)
    return TrajectoryScore(rmse, len(numbers), count)


def aligned_rmse(truth_m: Array, found: Array, time_s: Array) -> float:
    """RMSE in metres, as computed by evo_ape, of positions (n, 3) at equal times after Sim(3) alignment.

    Infinite for degenerate positions that evo cannot align.
    """
    try:
        from evo.core.geometry import GeometryException
        from evo.core.metrics import PoseRelation
        from evo.core.trajectory import PoseTrajectory3D
        from evo.main_ape import ape
    except ImportError as error:
        raise SettingsError("trajectories are scored by evo", hint="pip install 'virest[slam]'") from error
    identity = np.tile([1.0, 0.0, 0.0, 0.0], (len(time_s), 1))
    true, estimate = (PoseTrajectory3D(np.array(xyz, float), identity, np.array(time_s)) for xyz in (truth_m, found))
    try:
        result = ape(true, estimate, PoseRelation.translation_part, align=True, correct_scale=True)
    except GeometryException:
        return float("inf")
    return float(result.stats["rmse"])


def match_times(stamps_s: Array, found: CameraPath, tolerance_s: float) -> dict[int, Array]:
    """Positions by frame number: each pose is assigned to the nearest timestamp, if within the tolerance."""
    order = np.argsort(stamps_s)
    ordered_s = np.asarray(stamps_s, float)[order]
    matched: dict[int, Array] = {}
    for time, position in zip(found.time_s.tolist(), found.position_m, strict=True):
        after = int(np.clip(np.searchsorted(ordered_s, time), 1, max(len(ordered_s) - 1, 1)))
        nearest = min((k for k in (after - 1, after) if k < len(ordered_s)), key=lambda k: abs(ordered_s[k] - time))
        if abs(ordered_s[nearest] - time) <= tolerance_s:
            matched[int(order[nearest])] = position
    return matched


def parse_tum(text: str) -> CameraPath:
    """Read a TUM trajectory: lines ``time x y z qx qy qz qw``, # for comments; poses are sorted by time.

    Raises SettingsError if a line is not a pose.
    """
    rows = [line.replace(",", " ").split() for line in text.splitlines() if line.strip() and line.strip()[0] != "#"]
    try:
        table = np.array([[float(value) for value in row[:8]] for row in rows]).reshape(len(rows), -1)
    except ValueError:
        table = np.empty((len(rows), 0))
    if len(rows) and (table.shape[1] != 8 or not np.isfinite(table).all()):
        raise SettingsError("the trajectory is not of TUM's form", hint="write lines 'time x y z qx qy qz qw'")
    table = table.reshape(-1, 8)
    table = table[np.argsort(table[:, 0], kind="stable")]
    return CameraPath(table[:, 0], table[:, 1:4], table[:, [7, 4, 5, 6]])


def tum_text(path: CameraPath) -> str:
    """Format a trajectory as TUM lines."""
    table = np.column_stack([path.time_s, path.position_m, path.q_world_cam[:, [1, 2, 3, 0]]])
    return "".join(" ".join([f"{row[0]:.9f}", *(f"{v:.9g}" for v in row[1:])]) + "\n" for row in table.tolist())


def summarise(scores: Sequence[TrajectoryScore]) -> ScoreSummary:
    """Median and range over the runs; a lost run counts as an infinite error."""
    errors = np.array([score.rmse_m for score in scores])
    middle = sorted(errors.tolist())[len(errors) // 2] if len(errors) % 2 else _even_median(errors)
    return ScoreSummary(middle, float(errors.min()), float(errors.max()), float(np.median([s.tracked for s in scores])))


def added_error_removed(global_m: float, rolling_m: float, restored_m: float) -> float | None:
    """Fraction of the error added by the rolling shutter that restoration removes: 1 all of it, 0 nothing.

    1 if only the recorded frames lose the trajectory.  None if the rolling shutter adds no error, or if the trajectory
    of the global-shutter or the restored frames was lost.
    """
    added = rolling_m - global_m
    if not np.isfinite([global_m, restored_m]).all() or added <= 0:
        return None
    return 1.0 if np.isinf(rolling_m) else (rolling_m - restored_m) / added


# ── parts ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def _even_median(errors: Array) -> float:
    """Median of an even number of errors, some of which may be infinite."""
    half = len(errors) // 2
    low, high = sorted(errors.tolist())[half - 1 : half + 1]
    return low if low == high else 0.5 * (low + high)
