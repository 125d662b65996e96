"""Stretches of the inertial log that do not look like a gyroscope's: straight lines across gaps, readings at a limit.

The log alone shows them: a gyroscope's noise never lies on a straight line on three axes at once for long, nor piles up
at its largest value.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from virest.capture.imu import ImuSamples

Mask = NDArray[np.bool_]
STRAIGHT, CLIPPED = "straight", "clipped"
STRAIGHT_PART = 0.03
"""Second differences below this part of their median are those of a straight line."""
CHANCE = 1e-6
"""Of a straight run somewhere in the log, by the rate of such differences on the three axes."""
LEAST_STRAIGHT_S = 0.02
PILE_PART, LEAST_PILED, PILED_RUN = 0.005, 6, 3
"""Readings within this part of the largest count as at the limit; this many in all, with a run this long, show
clipping."""
PILE_RATIO = 4.0
"""Of readings at the limit to those in as wide a band just below: a peak's top is wider than its flanks, but not so."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """A part of the log that is not trusted."""

    kind: str
    """``straight`` or ``clipped``."""
    from_s: float
    """IMU clock from stamp_0; the last reading that is trusted."""
    to_s: float
    axes: tuple[int, ...]
    limit_rad_s: float | None = None
    """Largest reading of a clipped axis."""


def doubtful_stretches(imu: ImuSamples) -> list[Stretch]:
    """What the log itself shows, in the order of time."""
    if len(imu) < 20:
        return []
    found = [*_straight(imu), *(s for axis in range(3) for s in _clipped(imu, axis))]
    return sorted(found, key=lambda s: s.from_s)


def _straight(imu: ImuSamples) -> list[Stretch]:
    """Runs of samples on a straight line, on all axes at once, too long for chance."""
    time_s, rate = imu.time_s, imu.gyro_rad_s
    slope = np.diff(rate, axis=0) / np.diff(time_s)[:, None]
    bend = np.abs(np.diff(slope, axis=0))
    small = bend <= STRAIGHT_PART * np.median(bend, axis=0)
    chance = float(np.prod(np.maximum(small.mean(axis=0), STRAIGHT_PART)))
    if chance >= 0.5 or not np.all(np.median(bend, axis=0) > 0):
        return []
    least = int(np.ceil(np.log(CHANCE / len(time_s)) / np.log(chance)))
    stretches = []
    for first, last in _runs(np.asarray(small.all(axis=1))):
        from_s, to_s = float(time_s[first]), float(time_s[last + 2])
        if last - first + 1 >= least and to_s - from_s >= LEAST_STRAIGHT_S:
            stretches.append(Stretch(STRAIGHT, from_s, to_s, (0, 1, 2)))
    return stretches


def _clipped(imu: ImuSamples, axis: int) -> list[Stretch]:
    """Runs of readings at the axis' largest value, where they pile up there."""
    size = np.abs(imu.gyro_rad_s[:, axis])
    limit = float(size.max())
    at_limit: Mask = np.asarray(size >= (1 - PILE_PART) * limit)
    below = int(((size >= (1 - 2 * PILE_PART) * limit) & ~at_limit).sum())
    runs = _runs(at_limit)
    longest = max((last - first + 1 for first, last in runs), default=0)
    if at_limit.sum() < max(LEAST_PILED, PILE_RATIO * (below + 1)) or longest < PILED_RUN:
        return []
    return [
        Stretch(
            CLIPPED,
            float(imu.time_s[max(first - 1, 0)]),
            float(imu.time_s[min(last + 1, len(size) - 1)]),
            (axis,),
            limit,
        )
        for first, last in runs
    ]


def _runs(mask: Mask) -> list[tuple[int, int]]:
    """First and last index of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]
