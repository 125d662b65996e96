"""How far a path that was found lies from the true one: evo's absolute pose error after a Sim(3) alignment.

One camera's pictures give a path up to a similarity, so rotation, position and scale are aligned first (Umeyama 1991,
doi:10.1109/34.88573), as ``evo_ape --align --correct_scale`` does; the score is the RMSE of what is left, in metres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from virest.errors import CaptureError, SettingsError

Array = NDArray[np.float64]

LEAST_POSES = 4
"""Three points can always be aligned; an error needs one more."""
LEAST_TRACKED = 0.5
"""A path through fewer of the frames counts as lost: its error says little about the rest."""


@dataclass(frozen=True, slots=True)
class CameraPath:
    """Poses of a camera at increasing times."""

    time_s: Array
    """(n,)."""
    position_m: Array
    """(n, 3) of the camera's centre; metres, or any unit where the scale is unknown."""
    q_world_cam: Array
    """(n, 4) w x y z."""

    def at(self, time_s: Array) -> CameraPath:
        """Poses at other times (m,): a cubic spline through the positions, the shortest turn between orientations."""
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
        """Length of the way from pose to pose."""
        return float(np.linalg.norm(np.diff(self.position_m, axis=0), axis=1).sum())


@dataclass(frozen=True, slots=True)
class TrajectoryScore:
    """How well one run found the path."""

    rmse_m: float
    """Root mean square distance between aligned and true positions; infinite where the path was lost."""
    poses: int
    """Frames with a pose."""
    frames: int
    """Frames that were given."""

    @property
    def tracked(self) -> float:
        """Part of the frames with a pose."""
        return self.poses / self.frames if self.frames else 0.0

    @property
    def lost(self) -> bool:
        """Whether there is no path to speak of."""
        return not np.isfinite(self.rmse_m)


@dataclass(frozen=True, slots=True)
class ScoreSummary:
    """Several runs of one thing."""

    median_m: float
    low_m: float
    high_m: float
    tracked: float
    """Median part of the frames with a pose."""


def score_path(truth: CameraPath, found: Mapping[int, Sequence[float]], time_s: Array) -> TrajectoryScore:
    """Score positions by frame number against truth at the times that the frames refer to, aligned by Sim(3).

    found: position (3,) of each frame that has one, any unit and axes.  time_s: (frames,) of all frames.
    """
    numbers = sorted(found)
    count = len(time_s)
    if len(numbers) < max(LEAST_POSES, LEAST_TRACKED * count):
        return TrajectoryScore(np.inf, len(numbers), count)
    reference = truth.at(np.asarray(time_s, float)[numbers])
    rmse = aligned_rmse(reference.position_m, np.array([found[n] for n in numbers], float), reference.time_s)
    return TrajectoryScore(rmse, len(numbers), count)


def aligned_rmse(truth_m: Array, found: Array, time_s: Array) -> float:
    """RMSE (metres) that evo_ape gives for positions (n, 3) of equal times after a Sim(3) alignment.

    Infinite where the positions found do not span a line: evo then has no alignment.
    """
    try:
        from evo.core.geometry import GeometryException
        from evo.core.metrics import PoseRelation
        from evo.core.trajectory import PoseTrajectory3D
        from evo.main_ape import ape
    except ImportError as error:
        raise SettingsError("trajectories are scored by evo", hint="pip install 'virest[slam]'") from error
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(time_s), 1))
    true, estimate = (PoseTrajectory3D(np.array(xyz, float), upright, np.array(time_s)) for xyz in (truth_m, found))
    try:
        result = ape(true, estimate, PoseRelation.translation_part, align=True, correct_scale=True)
    except GeometryException:
        return float("inf")
    return float(result.stats["rmse"])


def match_times(stamps_s: Array, found: CameraPath, tolerance_s: float) -> dict[int, Array]:
    """Positions by frame number: each pose goes to the nearest stamp, if that is within the tolerance."""
    order = np.argsort(stamps_s)
    held = np.asarray(stamps_s, float)[order]
    matched: dict[int, Array] = {}
    for time, position in zip(found.time_s.tolist(), found.position_m, strict=True):
        after = int(np.clip(np.searchsorted(held, time), 1, max(len(held) - 1, 1)))
        nearest = min((k for k in (after - 1, after) if k < len(held)), key=lambda k: abs(held[k] - time))
        if abs(held[nearest] - time) <= tolerance_s:
            matched[int(order[nearest])] = position
    return matched


def parse_tum(text: str) -> CameraPath:
    """Path of a TUM trajectory: lines ``time x y z qx qy qz qw``, # for comments; times as they stand, in order.

    Raises SettingsError where a line is no pose.
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
    """Write a path as TUM's lines."""
    table = np.column_stack([path.time_s, path.position_m, path.q_world_cam[:, [1, 2, 3, 0]]])
    return "".join(" ".join([f"{row[0]:.9f}", *(f"{v:.9g}" for v in row[1:])]) + "\n" for row in table.tolist())


def summarise(scores: Sequence[TrajectoryScore]) -> ScoreSummary:
    """Median and range over the runs; a lost run counts as infinite."""
    errors = np.array([score.rmse_m for score in scores])
    middle = sorted(errors.tolist())[len(errors) // 2] if len(errors) % 2 else _even_median(errors)
    return ScoreSummary(middle, float(errors.min()), float(errors.max()), float(np.median([s.tracked for s in scores])))


def added_error_removed(global_m: float, rolling_m: float, restored_m: float) -> float | None:
    """Part of the error that the rolling shutter adds which restoration takes away: 1 all of it, 0 nothing.

    None where the rolling shutter adds nothing that could be taken away, or a path was lost.
    """
    added = rolling_m - global_m
    if not np.isfinite([global_m, restored_m]).all() or added <= 0:
        return None
    return 1.0 if np.isinf(rolling_m) else (rolling_m - restored_m) / added


# ── parts ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def _even_median(errors: Array) -> float:
    """Median of an even number of errors of which some may be infinite."""
    half = len(errors) // 2
    low, high = sorted(errors.tolist())[half - 1 : half + 1]
    return low if low == high else 0.5 * (low + high)
