"""Implausible stretches of the gyroscope log: straight lines across gaps, and clipped readings.

The log itself reveals them: a gyroscope's noise does not follow a straight line on three axes at once for long, nor do
readings accumulate at their largest value.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

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
SAME_LIMIT = 0.02
"""Largest difference between the limits of two axes, relative: biases of 0.02 rad/s at 1 rad/s."""
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
    return list(in_order(*_straight(imu), *_clipped(imu)))


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
        lines.append(f"the gyroscope log looks {look} {where}")
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


def _clipped(imu: ImuSamples) -> list[Stretch]:
    """Runs of readings at the sensor's limit, on each axis and either way.

    A sensor has one range for all its axes.  Once readings pile up at a limit on one of them, fewer swings show that
    another has reached it.
    """
    ways = [(axis, way * imu.gyro_rad_s[:, axis]) for axis in range(3) for way in (1, -1)]
    largest = np.abs(imu.gyro_rad_s).max(axis=0)
    piles = [_pile(reading, LEAST_LIMIT * float(largest[axis])) for axis, reading in ways]
    limits = [limit for limit in piles if limit is not None]
    time_s, end = imu.time_s.tolist(), len(imu) - 1
    found = []
    for (axis, reading), own in zip(ways, piles, strict=True):
        limit = own or next((pile for pile in map(partial(_same_pile, reading), limits) if pile is not None), None)
        if limit is not None:
            found += [
                Stretch(CLIPPED, time_s[max(first - 1, 0)], time_s[min(last + 1, end)], (axis,), limit.rate_rad_s)
                for first, last in _runs(_at_limit(reading, limit))
            ]
    return found


@dataclass(frozen=True, slots=True)
class _Pile:
    """Readings that accumulate at the largest."""

    rate_rad_s: float
    """Their median."""
    least_rad_s: float
    """As far below it as the largest is above: noise after the limit spreads them both ways."""

    @property
    def lowest_rad_s(self) -> float:
        """Twice as far below it: a reading that noise puts between this and ``least_rad_s`` does not end a stretch."""
        return 2 * self.least_rad_s - self.rate_rad_s


def _pile(reading: Array, least: float) -> _Pile | None:
    """The narrowest pile of readings (n,) at the largest of them; None if that is below ``least``."""
    limit = float(reading.max())
    if limit <= least:
        return None
    for part, least_swings in PILES:
        if _is_pile(reading, part * limit, least_swings):
            return _pile_within(reading, part * limit)
    return None


def _at_limit(reading: Array, limit: _Pile) -> Mask:
    """Which readings (n,) belong to the pile, with those between two of them that noise puts just below it."""
    inside: Mask = np.asarray(reading >= limit.least_rad_s)
    for first, last in _runs(np.asarray(reading >= limit.lowest_rad_s)):
        own = first + np.flatnonzero(inside[first : last + 1])
        if len(own):
            inside[own[0] : own[-1]] = True
    return inside


def _same_pile(reading: Array, known: _Pile) -> _Pile | None:
    """The pile of readings (n,) at another axis's limit, as wide as there; None where they are no pile, or go beyond.

    Axes differ by their biases, of at most SAME_LIMIT.
    """
    width = 2 * (known.rate_rad_s - known.least_rad_s)
    apart = abs(float(reading.max()) - known.least_rad_s - width)
    if apart > SAME_LIMIT * known.rate_rad_s or not _is_pile(reading, width, 1):
        return None
    return _pile_within(reading, width)


def _pile_within(reading: Array, width: float) -> _Pile:
    """The pile around the median of the readings (n,) within ``width`` of the largest one."""
    limit = float(reading.max())
    middle = float(np.median(reading[reading >= limit - width]))
    return _Pile(middle, min(2 * middle - limit, limit - width))


def _is_pile(reading: Array, width: float, least_swings: int) -> bool:
    """Whether readings (n,) accumulate within ``width`` of the largest one, in ``least_swings`` swings or more."""
    limit = float(reading.max())
    at_limit: Mask = np.asarray(reading >= limit - width)
    below = int((reading >= limit - 2 * width).sum() - at_limit.sum())
    longest = max(last - first + 1 for first, last in _runs(at_limit))
    reached = sum(bool(at_limit[first : last + 1].any()) for first, last in _runs(np.asarray(reading > limit / 2)))
    piled = at_limit.sum() >= max(LEAST_PILED, PILE_RATIO * (below + 1))
    return bool(piled and longest >= PILED_RUN and reached >= least_swings)


def _runs(mask: Mask) -> list[tuple[int, int]]:
    """First and last index of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]
