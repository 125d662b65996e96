"""The inertial samples of a capture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from virest.arrays import Array
from virest.errors import ImuError

LEAST_ROWS = 20
"""Fewest rows in which runs of equal readings are looked for."""
MOST_HELD, MOST_ALIKE = 12, 0.97
"""Longest run of equal rows that polling makes, 500 Hz of rows over 40 Hz of readings; least fraction of the runs whose
length is within one row of the median.  Runs of a reading that changes with a chance of its own are geometric: at most
0.88 of them lie within one row of a median of 2, and 0.46 of one of 3."""


@dataclass(frozen=True, slots=True)
class ImuSamples:
    """Gyroscope and accelerometer, IMU axes, IMU clock; strictly rising, no NaN in time or gyroscope."""

    time_s: Array
    """(n,) seconds counted from the capture's first stamp (row 0 of the frame stamps)."""
    gyro_rad_s: Array
    """(n, 3) angular rate."""
    accel_m_s2: Array
    """(n, 3) specific force, +9.8 upwards at rest; NaN without an accelerometer."""

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def has_accelerometer(self) -> bool:
        """Whether at least one row has an acceleration."""
        return bool(np.isfinite(self.accel_m_s2).all(axis=1).any())

    def between(self, start_s: float, end_s: float, margin_samples: int = 4) -> ImuSamples:
        """The samples that cover [start_s, end_s], plus a margin on both sides."""
        first = max(int(np.searchsorted(self.time_s, start_s)) - margin_samples, 0)
        last = min(int(np.searchsorted(self.time_s, end_s)) + margin_samples, len(self.time_s))
        return ImuSamples(self.time_s[first:last], self.gyro_rad_s[first:last], self.accel_m_s2[first:last])


def without_held_readings(imu: ImuSamples) -> tuple[ImuSamples, int]:
    """The samples without rows that only repeat a gyroscope's reading, and in how many rows each reading stands.

    Apps that poll a sensor faster than it measures log each reading several times.  The rates would be a staircase,
    late by half a step on average.  Such runs of equal rows have one length; a gyroscope at rest, whose last digit
    seldom changes, has runs of all lengths, and one that sticks has a few long ones.  A run's first row is kept.
    Without such runs the samples are unchanged, and the number is 1.
    """
    if len(imu) < LEAST_ROWS:
        return imu, 1
    first = np.concatenate([[True], np.any(np.diff(imu.gyro_rad_s, axis=0) != 0, axis=1)])
    lengths = np.diff(np.flatnonzero(np.append(first, True)))
    rows = int(np.median(lengths))
    if not 1 < rows <= MOST_HELD or np.mean(np.abs(lengths - rows) <= 1) < MOST_ALIKE:
        return imu, 1
    return ImuSamples(imu.time_s[first], imu.gyro_rad_s[first], imu.accel_m_s2[first]), rows


def checked_samples(imu: ImuSamples) -> ImuSamples:
    """Samples built by hand, as arrays of numbers.  Raises ImuError for wrong shapes, gaps in the numbers or times."""
    time_s, gyro, accel = (np.asarray(part, float) for part in (imu.time_s, imu.gyro_rad_s, imu.accel_m_s2))
    count = time_s.size
    if (time_s.shape, gyro.shape, accel.shape) != ((count,), (count, 3), (count, 3)):
        raise ImuError(
            f"inertial samples of shapes {time_s.shape}, {gyro.shape}, {accel.shape}",
            hint="time_s is (n,), gyro_rad_s and accel_m_s2 are (n, 3)",
        )
    if not (np.isfinite(time_s).all() and np.isfinite(gyro).all()):
        raise ImuError("times or rates of the inertial samples are not finite", hint="leave those rows out")
    if (np.diff(time_s) <= 0).any():
        at = int(np.argmax(np.diff(time_s) <= 0)) + 1
        raise ImuError(f"times of the inertial samples do not rise at row {at}", hint="sort them, each time once")
    return ImuSamples(time_s, gyro, accel)
