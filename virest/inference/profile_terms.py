"""The fit's terms for possible errors of a profile's geometry, one per entry of the table of effects."""

from __future__ import annotations

from dataclasses import replace

from virest.camera.profile import CameraProfile
from virest.effects.changes import add_readout, rotate_imu, shift_offset
from virest.effects.table import EFFECTS
from virest.inference.track_fit import Term

__all__ = ["TERMS", "add_readout", "rotate_imu", "shift_offset"]

TERMS = {
    name: Term(name, steps.change, steps.quotient, steps.limit, steps.prior_std)
    for name, steps in ((effect.name, effect.steps) for effect in EFFECTS.values())
    if steps is not None
}
"""Terms by the effect's name."""

TIME_OFFSET, CLOCK_SKEW = TERMS["time_offset"], TERMS["clock_skew"]
PLAIN_READOUT = TERMS["readout_time"]
READOUT = replace(PLAIN_READOUT, change=add_readout)
"""Readout change that keeps the middle row's time, so that offset and readout are fitted independently."""
IMU_ROTATION, GYRO_BIAS, GYRO_SCALE = TERMS["imu_rotation"], TERMS["gyro_bias"], TERMS["gyro_scale"]
FOCAL, PRINCIPAL_POINT = TERMS["focal_length"], TERMS["principal_point"]
K1, K2 = TERMS["radial_distortion"], TERMS["higher_distortion"]
FOCAL_DRIFT, STABILISATION = TERMS["focal_drift"], TERMS["stabilisation"]
EXPOSURE_SCALE = TERMS["exposure_time"]

STATED_OFFSET, SMALL_BIAS = replace(TIME_OFFSET, prior_std=(0.03,)), replace(GYRO_BIAS, prior_std=(0.02,) * 3)
NEAR_AXES = replace(IMU_ROTATION, prior_std=(0.03,) * 3)
STATED_READOUT, UNKNOWN_READOUT = replace(READOUT, prior_std=(0.003,)), replace(READOUT, prior_std=(0.02,))
"""Terms with the prior standard deviations of a carefully stated profile, and of an unknown phone's readout."""


def careful_terms(profile: CameraProfile, *, offset_known: bool, focal_known: bool) -> tuple[Term, ...]:
    """The terms for small errors of a carefully stated profile and for its unknown values.

    offset_known, focal_known: whether the profile states them; otherwise they are free.
    """
    offset = STATED_OFFSET if offset_known else TIME_OFFSET
    readout = STATED_READOUT if profile.readout_known else UNKNOWN_READOUT
    return (offset, SMALL_BIAS, NEAR_AXES, readout, *(() if focal_known else (FOCAL,)))
