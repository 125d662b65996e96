"""Camera motion from a phone's recorded gyroscope samples, in place of random hand motion.

The rate is interpolated by modified Akima polynomials (Akima 1970, doi:10.1145/321607.321609).  Each piece depends on
the six samples around it, so a gap or a knock does not ring through the rest.  Orientation is integrated as for other
simulated motions, by :func:`virest.simulation.hand_motion.integrate_motion`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import Akima1DInterpolator

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.errors import ImuError
from virest.simulation.hand_motion import HandMotion, Waves, integrate_motion
from virest.simulation.hidden import from_gyro_reading, missing_rate_rad_s
from virest.simulation.phone_gyro import averaging_window_s, before_filter


@dataclass(frozen=True, slots=True)
class RecordedRate:
    """Angular rate in camera axes at any time; held constant before the first and after the last sample."""

    start_s: float
    end_s: float
    pieces: Any
    """Piecewise cubic polynomials over [start_s, end_s], values (3,)."""

    def at(self, time_s: Array, derivative: int = 0) -> Array:
        """Rate in rad/s, or its time derivative of the given order, at times (...,): (..., 3)."""
        time_s = np.asarray(time_s, float)
        value = np.asarray(self.pieces(np.clip(time_s, self.start_s, self.end_s), nu=derivative))
        outside = (time_s < self.start_s) | (time_s > self.end_s)
        return np.where(outside[..., None], 0.0, value) if derivative else value


def recorded_rate(
    sample_s: Array, gyro_rad_s: Array, profile: CameraProfile, accel_m_s2: Array | None = None
) -> RecordedRate:
    """True rate of the camera from samples (n,), (n, 3) at increasing times.

    R_cam_imu (across⁻¹((measured − bias) / scale) + fields), the measured rate with the gyroscope's filters undone.
    sample_s: seconds on the IMU clock from stamp_0.  Raises ImuError for fewer than two samples.
    """
    if len(sample_s) < 2:
        raise ImuError(f"{len(sample_s)} gyroscope samples, at least 2 are needed", hint="check gyro_accel.csv")
    corner_hz, averaging_s = profile.extensions.gyro_lowpass_hz, profile.extensions.gyro_averaging_s
    if corner_hz or averaging_s:
        gyro_rad_s = before_filter(sample_s, gyro_rad_s, corner_hz, averaging_window_s(averaging_s))
    true = from_gyro_reading(profile, gyro_rad_s)
    true = true + missing_rate_rad_s(profile, sample_s, true, accel_m_s2)
    camera = true @ np.array(profile.r_cam_imu).T
    return RecordedRate(float(sample_s[0]), float(sample_s[-1]), Akima1DInterpolator(sample_s, camera, method="makima"))


def recorded_motion(
    sample_s: Array, gyro_rad_s: Array, profile: CameraProfile, centre_s: float, accel_m_s2: Array | None = None
) -> HandMotion:
    """Motion of a camera that rotates as recorded and does not translate; world axes are its own at ``centre_s``.

    Other arguments as for :func:`recorded_rate`.
    """
    rate = recorded_rate(sample_s, gyro_rad_s, profile, accel_m_s2)
    still = Waves(np.zeros((3, 1)), np.zeros((3, 1)), np.zeros((3, 1)))
    return integrate_motion(rate, still, rate.start_s, rate.end_s, centre_on_s=(centre_s, centre_s))
