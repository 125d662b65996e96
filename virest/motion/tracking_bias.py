"""What tracking gets wrong in the same way all over a capture, so that no statistics of the capture show it.

Followed points lag and shrink a little where blur changes from frame to frame, and more where the codec's predicted
blocks replace what was seen.  Measured on simulated captures with H.264 at 0.15 to 2 bits a pixel; it grows with the
noise of a tracked step, of which 0.15 px is typical.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from virest.motion.track_fit import TrackFit

Array = NDArray[np.float64]
TYPICAL_NOISE_PX, LEAST_NOISE_PX = 0.15, 0.05
SHARED = 0.06
"""Part of each point's error that goes along with a readout's own pattern: predicted blocks shear less than rows do.
Readouts of simulated captures came out 0.02 to 0.16 ms short."""
BIAS_STD: dict[str, tuple[float, ...]] = {
    "time_offset": (2e-5,),
    "imu_rotation": (2.5e-4,) * 3,
    "gyro_bias": (1.5e-4,) * 3,
    "gyro_scale": (6e-4,),
    "focal_length": (6e-4,),
    "focal_drift": (3e-4,),
    "radial_distortion": (7e-4,),
    "principal_point": (0.2, 0.2),
    "stabilisation": (0.002, 0.02, 0.0, 0.0),
    "clock_skew": (1e-5,),
    "exposure_time": (0.015,),
    "scene_depth": (0.004,),
}
"""At the typical noise, in the units of the terms of profile_terms; a depth's relative."""
WANDER_STD = {"gyro_bias": 1.5e-4}
"""What a value does of its own accord however well points are tracked: a phone's gyroscope drifts by so much within
seconds, and its noise of 3e-4 rad/s/√Hz has that mean over two of them."""


def bias_std(fit: TrackFit, name: str, noise_px: float) -> Array:
    """Standard deviation (k,) of the bias of a term's values; noise_px: of a tracked step, per coordinate.

    A readout's is what errors common to many points make of it: Σw points told it to the curvature, and no number of
    them tells better than 1 / SHARED² would.
    """
    if name == "readout_time":
        return np.asarray(SHARED * np.sqrt(2 * fit.weight.sum() * np.diag(fit.curvature)[fit.slices[name]]))
    scaled = max(noise_px, LEAST_NOISE_PX) / TYPICAL_NOISE_PX * np.array(BIAS_STD[name])
    return np.maximum(scaled, WANDER_STD.get(name, 0.0))
