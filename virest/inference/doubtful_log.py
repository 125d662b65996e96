"""Implausible stretches of the gyroscope log: straight lines across gaps, and clipped readings.

The log itself reveals them: a gyroscope's noise does not follow a straight line on three axes at once for long, nor do
readings accumulate at their largest value.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from virest.arrays import Array, Mask
from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples

STRAIGHT, CLIPPED, CONTRADICTED = "straight", "clipped", "contradicted"
STRAIGHT_PART = 0.03
"""Second differences below this fraction of their median count as those of a straight line."""
CHANCE = 1e-6
"""False-alarm probability of a straight run in the log, from the rate of such differences on the three axes."""
LEAST_STRAIGHT_S = 0.02
"""Shortest straight run that is doubted."""
PILES = ((0.005, 1), (0.01, 3), (0.02, 3), (0.04, 3))
"""Readings within such a part of the largest are at the limit if that many swings reach it.  Noise after the limit
spreads them; the top of one swing may be as flat as that, the tops of three are not equally high."""
LEAST_PILED, PILED_RUN = 6, 3
"""Clipping needs LEAST_PILED readings at the limit in all, with a run of PILED_RUN."""
PILE_RATIO = 4.0
"""Smallest ratio of the readings at the limit to those in an equally wide band below: 2.4 for the top of an unclipped
swing, whatever the width."""
LEAST_LIMIT = 0.5
"""Smallest largest reading one way, over that of both ways: an axis that hardly turns that way reaches no limit."""


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
    """Limit of a clipped axis: the median of its readings there."""
    p_value: float | None = None
    """Probability per capture that points contradict an interval like this by chance; None: the log shows it."""


def doubtful_stretches(imu: ImuSamples) -> list[Stretch]:
    """The implausible stretches of the log, in order of time."""
    if len(imu) < 20:
        return []
    return list(in_order(*_straight(imu), *(s for axis in range(3) for s in _clipped(imu, axis))))


def in_order(*stretches: Stretch) -> tuple[Stretch, ...]:
    """Stretches in order of time."""
    return tuple(sorted(stretches, key=lambda stretch: stretch.from_s))


def doubts(imu: ImuSamples, profile: CameraProfile | None = None) -> list[str]:
    """What a log's implausible stretches look like, one line per kind, without those that a profile bridges."""
    lines = []
    found = [s for s in doubtful_stretches(imu) if profile is None or not profile.bridges(s.from_s, s.to_s)]
    for kind in (CLIPPED, STRAIGHT):
        stretches = [stretch for stretch in found if stretch.kind == kind]
        if not stretches:
            continue
        limits = [stretch.limit_rad_s for stretch in stretches if stretch.limit_rad_s is not None]
        look = f"clipped at {np.median(limits):.3g} rad/s" if limits else "interpolated across a gap"
        count, first_s = len(stretches), stretches[0].from_s
        where = f"in {count} stretches, the first from {first_s:.2f} s" if count > 1 else f"from {first_s:.2f} s"
        lines.append(f"the gyroscope log looks {look} {where}: virest diagnose")
    return lines


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
    """Runs of readings at the axis's largest value one way or the other, if readings accumulate there."""
    rate, time_s, end = imu.gyro_rad_s[:, axis], imu.time_s.tolist(), len(imu) - 1
    found = []
    for reading in (rate, -rate):
        at_limit = _at_limit(reading, LEAST_LIMIT * float(np.abs(rate).max()))
        limit = float(np.median(reading[at_limit])) if at_limit.any() else None
        found += [
            Stretch(CLIPPED, time_s[max(first - 1, 0)], time_s[min(last + 1, end)], (axis,), limit)
            for first, last in _runs(at_limit)
        ]
    return found


def _at_limit(reading: Array, least: float) -> Mask:
    """Which readings (n,) accumulate at the largest, in the narrowest pile; none if the largest is below ``least``."""
    limit, none = float(reading.max()), np.zeros(len(reading), bool)
    if limit <= least:
        return none
    swings = _runs(np.asarray(reading > limit / 2))
    for part, least_swings in PILES:
        at_limit: Mask = np.asarray(reading >= (1 - part) * limit)
        below = int((reading >= (1 - 2 * part) * limit).sum() - at_limit.sum())
        longest = max(last - first + 1 for first, last in _runs(at_limit))
        reached = sum(bool(at_limit[first : last + 1].any()) for first, last in swings)
        piled = at_limit.sum() >= max(LEAST_PILED, PILE_RATIO * (below + 1))
        if piled and longest >= PILED_RUN and reached >= least_swings:
            return at_limit
    return none


def _runs(mask: Mask) -> list[tuple[int, int]]:
    """First and last index of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]
