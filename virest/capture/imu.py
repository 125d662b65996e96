"""The inertial samples of a capture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from virest.arrays import Array


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
