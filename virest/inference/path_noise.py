"""What the accelerometer's noise does to tracked points: it displaces the path, and the points by parallax.

A fit of velocity, gravity and the accelerometer's bias absorbs most of that; what other values absorb of the rest
follows from the fit's own slopes (``by_error``).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from virest.arrays import Array
from virest.capture.imu import ImuSamples
from virest.capture.imu_noise import noise_density
from virest.image_formation.point_model import IntegratedMotion, TrackTable, predict
from virest.motion.displacement import integrate_accelerometer
from virest.motion.scene_motion import InertialMotion

DRAWS = 16
"""A standard deviation from this many draws is known to 18 %."""


def path_errors_px(imu: ImuSamples, known: IntegratedMotion, table: TrackTable, scene: InertialMotion) -> Array:
    """Changes (DRAWS, n, 2) of predicted points by white noise of the accelerometer; together one standard deviation.

    The density is measured from the samples.  (0, n, 2) if there are too few of them.
    """
    density = noise_density(imu.time_s, imu.accel_m_s2)
    if density is None:
        return np.zeros((0, len(table), 2))
    std_m_s2, rng = density / float(np.median(np.diff(imu.time_s))) ** 0.5, np.random.default_rng(0)
    at, found = predict(known, table, scene), []
    for _ in range(DRAWS):
        noisy = replace(imu, accel_m_s2=imu.accel_m_s2 + rng.normal(0, std_m_s2, imu.accel_m_s2.shape))
        moved = replace(known, displacement=integrate_accelerometer(noisy, known.profile, known.trajectory))
        found.append(predict(moved, table, scene).second_px - at.second_px)
    return np.stack(found) / DRAWS**0.5
