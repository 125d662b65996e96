"""What tracking gets wrong in the same way all over a capture, so that no statistics of the capture show it.

Followed points lag and shrink a little where blur changes from frame to frame, and more where the codec's predicted
blocks replace what was seen.  Measured on simulated captures with H.264 at 0.15 to 2 bits a pixel; it grows with the
noise of a tracked step, of which 0.15 px is typical.
"""

from __future__ import annotations

TYPICAL_NOISE_PX, LEAST_NOISE_PX = 0.15, 0.05
READOUT_PART = 0.0035
"""Of the readout: predicted blocks shear less than rows do."""
BIAS_STD: dict[str, tuple[float, ...]] = {
    "time_offset": (2e-5,),
    "imu_rotation": (2.5e-4,) * 3,
    "gyro_bias": (1.5e-4,) * 3,
    "gyro_scale": (6e-4,),
    "focal_length": (6e-4,),
    "focal_drift": (3e-4,),
    "radial_distortion": (7e-4,),
    "principal_point": (0.2, 0.2),
    "stabilisation": (0.002, 0.02),
    "clock_skew": (1e-5,),
    "exposure_time": (0.03,),
}
"""At the typical noise, in the units of the terms of profile_terms."""


def bias_std(name: str, noise_px: float, readout_time_s: float) -> tuple[float, ...]:
    """Standard deviation of the bias of a term's values; noise_px: of a tracked step, per coordinate."""
    grown = max(noise_px, LEAST_NOISE_PX) / TYPICAL_NOISE_PX
    base = (READOUT_PART * abs(readout_time_s),) if name == "readout_time" else BIAS_STD[name]
    return tuple(grown * value for value in base)
