"""Profiles across isolated steps in frames, in grey levels: evidence of edge processing without a camera model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from virest.arrays import Array, Index, Mask, Picture
from virest.capture.records import Frame
from virest.inference.edges import moved_profiles, parallel_profiles
from virest.inference.unsharp_mask import ALONG_PX, MIN_STEP_LEVELS, UNCLIPPED_LEVELS

PLATEAU_PX = 5.0
"""A profile must be flat beyond this distance, where the effect of a 2 px unsharp mask has faded."""
MAX_PLATEAU_RMS = 0.04
"""Maximum rms of a plateau about its level, as a fraction of the step."""
MAX_OFF_PX = 1.0
"""Maximum distance between the gradient maximum and the middle of its step."""
GRID_PX = np.arange(-6.0, 6.0 + 1e-9, 0.25)
"""Distances from the middle of a step at which profiles are compared: PLATEAU_PX, and MAX_OFF_PX of freedom."""


@dataclass(frozen=True, slots=True)
class IsolatedSteps:
    """Steps between two flat plateaus, one row per step, in order of frames."""

    profile: Array
    """(n, m) on GRID_PX, dark to bright, 0 and 1 at the plateaus, 0.5 at the middle."""
    points_px: Array
    """(n, 2) the gradient maximum."""
    normal: Array
    """(n, 2) unit normal, from dark to bright."""
    stamp_s: Array
    """(n,) the frame's timestamp, camera clock."""
    exposure_s: Array
    """(n,) as logged."""

    def __len__(self) -> int:
        return len(self.profile)

    def chosen(self, rows: Mask) -> IsolatedSteps:
        """The steps at a mask."""
        return IsolatedSteps(*(getattr(self, f.name)[rows] for f in fields(self)))


def join_steps(parts: Sequence[IsolatedSteps]) -> IsolatedSteps:
    """Concatenate the steps of several frames."""
    if not parts:
        return IsolatedSteps(np.zeros((0, len(GRID_PX))), *(np.zeros((0, 2)) for _ in range(2)), *np.zeros((2, 0)))
    return IsolatedSteps(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(IsolatedSteps)))


def isolated_steps(picture: Picture, frame: Frame, points_px: Array, normals: Array) -> IsolatedSteps:
    """The isolated steps among a frame's edges (n, 2), (n, 2) from `find_edges`; frame: with an exposure."""
    profile, kept = _isolated(parallel_profiles(picture, points_px, normals, ALONG_PX))
    times = ((time_s or 0.0) * np.ones(len(kept)) for time_s in (frame.time_s, frame.exposure_s))
    return IsolatedSteps(profile, points_px[kept], normals[kept], *times)


def crossing(part: Array, level: float, along_px: Array) -> Array:
    """(n,) position where each profile first reaches a level, by linear interpolation."""
    if not len(part):
        return np.zeros(0)
    after = np.maximum(np.argmax(part >= level, axis=1), 1)
    rows = np.arange(len(part))
    below, above = part[rows, after - 1], part[rows, after]
    share = np.clip((level - below) / np.where(above > below, above - below, 1.0), 0.0, 1.0)
    return np.asarray(along_px[after - 1] + share * (along_px[1] - along_px[0]))


def _isolated(levels: Array) -> tuple[Array, Index]:
    """(profiles (n, m) on GRID_PX of the isolated steps, normalised by step height, middle at 0; their indices)."""
    low, high = UNCLIPPED_LEVELS
    kept = np.flatnonzero((levels.min(axis=1) > low) & (levels.max(axis=1) < high))
    levels = levels[kept]
    dark, bright = ALONG_PX <= -PLATEAU_PX, ALONG_PX >= PLATEAU_PX
    ends = [np.median(levels[:, side], axis=1) for side in (dark, bright)]
    step = ends[1] - ends[0]
    part = (levels - ends[0][:, None]) / np.maximum(step, 1e-3)[:, None]
    rms = [np.sqrt(np.mean((part[:, side] - end) ** 2, axis=1)) for side, end in ((dark, 0.0), (bright, 1.0))]
    once = (np.diff((part >= 0.5).astype(np.int8), axis=1) != 0).sum(axis=1) == 1
    flat = (step > MIN_STEP_LEVELS) & (np.maximum(*rms) < MAX_PLATEAU_RMS) & once
    part, kept = part[flat], kept[flat]
    middle = crossing(part, 0.5, ALONG_PX)
    centred = np.abs(middle) < MAX_OFF_PX
    return moved_profiles(part[centred], middle[centred], ALONG_PX, GRID_PX), kept[centred]
