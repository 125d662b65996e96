"""What may be wrong with a profile's geometry, one term of the fit each, as the table of effects says."""

from __future__ import annotations

from dataclasses import replace

from virest.effects.changes import add_readout, rotate_imu, shift_offset
from virest.effects.table import EFFECTS
from virest.inference.track_fit import Term

__all__ = ["TERMS", "add_readout", "rotate_imu", "shift_offset"]

GYRO_SCALE_OFF = 0.15
"""Makers trim gyroscopes to 3 % (BMI160, LSM6DSO, ICM-20602: sensitivity tolerance); five times that is a fault."""

TERMS = {
    name: Term(name, steps.change, steps.quotient, steps.limit, steps.prior_std)
    for name, steps in ((effect.name, effect.steps) for effect in EFFECTS.values())
    if steps is not None
}
"""By the name of the effect."""

TIME_OFFSET, CLOCK_SKEW = TERMS["time_offset"], TERMS["clock_skew"]
PLAIN_READOUT = TERMS["readout_time"]
READOUT = replace(PLAIN_READOUT, change=add_readout)
"""With the picture's middle row kept where it was: offset and readout are then fitted apart."""
IMU_ROTATION, GYRO_BIAS, GYRO_SCALE = TERMS["imu_rotation"], TERMS["gyro_bias"], TERMS["gyro_scale"]
FOCAL, K1, PRINCIPAL_POINT = TERMS["focal_length"], TERMS["radial_distortion"], TERMS["principal_point"]
FOCAL_DRIFT, STABILISATION = TERMS["focal_drift"], TERMS["stabilisation"]
EXPOSURE_SCALE = TERMS["exposure_time"]
