"""Implausible stretches of the gyroscope log: straight lines across gaps, and clipped readings.

The log itself reveals them: a gyroscope's noise does not follow a straight line on three axes at once for long, nor do
readings accumulate at their largest value.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from virest.arrays import Mask
from virest.capture.imu import ImuSamples

STRAIGHT, CLIPPED, CONTRADICTED = "straight", "clipped", "contradicted"
STRAIGHT_PART = 0.03
"""Second differences below this fraction of their median count as those of a straight line."""
CHANCE = 1e-6
"""False-alarm probability of a straight run in the log, from the rate of such differences on the three axes."""
LEAST_STRAIGHT_S = 0.02
"""Shortest straight run that is doubted."""
PILE_PART, LEAST_PILED, PILED_RUN = 0.005, 6, 3
"""Readings within PILE_PART of the largest are at the limit; clipping needs LEAST_PILED of them in all, with a run of
PILED_RUN."""
PILE_RATIO = 4.0
"""Smallest ratio of the readings at the limit to those in an equally wide band below; for an unclipped peak it is
lower."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """An untrusted part of the log."""

    kind: str
    """``straight`` or ``clipped``; ``contradicted``: only the points show it, not the log."""
    from_s: float
    """IMU clock from stamp_0; the last trusted reading before it."""
    to_s: float
    axes: tuple[int, ...]
    limit_rad_s: float | None = None
    """Largest reading of a clipped axis."""
    p_value: float | None = None
    """Probability per capture that points contradict an interval like this by chance; None: the log shows it."""


def doubtful_stretches(imu: ImuSamples) -> list[Stretch]:
    """The implausible stretches of the log, in order of time."""
    if len(imu) < 20:
        return []
    found = [*_straight(imu), *(s for axis in range(3) for s in _clipped(imu, axis))]
    return sorted(found, key=lambda s: s.from_s)


def _straight(imu: ImuSamples) -> list[Stretch]:
    """Runs of samples on a straight line on all axes at once that are too long for chance."""
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
    """Runs of readings at the axis's largest value, if readings accumulate there."""
    size = np.abs(imu.gyro_rad_s[:, axis])
    limit = float(size.max())
    at_limit: Mask = np.asarray(size >= (1 - PILE_PART) * limit)
    below = int(((size >= (1 - 2 * PILE_PART) * limit) & ~at_limit).sum())
    runs = _runs(at_limit)
    longest = max((last - first + 1 for first, last in runs), default=0)
    if at_limit.sum() < max(LEAST_PILED, PILE_RATIO * (below + 1)) or longest < PILED_RUN:
        return []
    time_s, end = imu.time_s.tolist(), len(size) - 1
    return [Stretch(CLIPPED, time_s[max(a - 1, 0)], time_s[min(b + 1, end)], (axis,), limit) for a, b in runs]


def _runs(mask: Mask) -> list[tuple[int, int]]:
    """First and last index of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]
