"""What tracking gets wrong in the same way all over a capture, so that no statistics of the capture show it.

:func:`bias_std` holds for points as they were tracked, :func:`remaining_std` for points that
:mod:`virest.inference.blur_bias` has corrected.

Followed points lag and shrink a little where blur changes from frame to frame, and more where the codec's predicted
blocks replace what was seen.  Measured on simulated captures with H.264 at 0.12 to 2 bits a pixel; it grows with the
noise of a tracked step, of which 0.15 px is typical.

Whatever its pattern is, a part of it is correlated with what a value itself does to the points.  Where a value moves
many
points far, that is little; where it moves them by hundredths of a pixel (a lens seen while walking straight on, a skew
within three seconds), it is most of what is not known.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from virest.inference.blur_bias import RELATIVE_STD
from virest.inference.track_fit import TrackFit

Array = NDArray[np.float64]
TYPICAL_NOISE_PX, LEAST_NOISE_PX = 0.15, 0.05
SHARED = 0.025
"""Part of each point's error that is correlated with a value's own pattern.  Ten kinds of values in forty captures
whose
truth was known came out wrong by 0.018 to 0.027 of it (rms), hand-held or walking, before far things, walls and rooms,
at 0.04 to 0.19 px of noise; statistics alone had put one in five of them more than two deviations off."""
SHARED_READOUT = 0.03
"""The same for a readout: predicted blocks shear less than rows do.  With it median |error| / deviation is 0.71 of
readouts and 0.68 of the offsets of their first rows in seven hand-held
captures drawn as `bench --only calibration` draws them; 0.67 is right, and twice the part gave 0.40 and 0.39."""
SHARED_RELIEF = 0.6
"""Part of the spread of depths about the plane that parts of the picture share in a constant rate's own sense: travel
of which the depths are wrong looks like one.  In rooms that were walked through biases were off by 0.5 to 2 of it."""
BIAS_STD: dict[str, tuple[float, ...]] = {
    "time_offset": (2e-5,),
    "imu_rotation": (2.5e-4,) * 3,
    "gyro_bias": (1.5e-4,) * 3,
    "gyro_scale": (6e-4,),
    "gyro_lowpass": (2e-5,),
    "focal_length": (6e-4,),
    "pixel_aspect": (8e-4,),
    "focal_drift": (3e-4,),
    "radial_distortion": (7e-4,),
    "principal_point": (0.2, 0.2),
    "stabilisation": (0.002, 0.02, 0.0, 0.0),
    "clock_skew": (1e-5,),
    "exposure_time": (0.015,),
    "scene_depth": (0.004,),
}
"""At the typical noise, in the units of the terms of profile_terms; a depth's relative.  By analogy, not measured: a
low pass's delay as an offset, pixel_aspect as √2 of a focal length, since one of two directions tells it."""
WANDER_STD = {"gyro_bias": 1.5e-4}
"""What a value does of its own accord however well points are tracked: a phone's gyroscope drifts by this much within
seconds, and its noise of 3e-4 rad/s/√Hz has that mean over two of them."""


def bias_std(fit: TrackFit, name: str, noise_px: float) -> Array:
    """Standard deviation (k,) of the bias of a term's values; noise_px: of a tracked step, per coordinate.

    At least what errors common to many points make of them: Σw points told a value to the curvature, and no number of
    points tells it better than 1 / SHARED² would.
    """
    own = fit.slices.get(name)
    told = np.zeros(1) if own is None else np.sqrt(2 * fit.weight.sum() * np.diag(fit.curvature)[own])
    by_coding = np.zeros(1) if own is None else fit.by_coding[own]
    if name == "readout_time":
        return np.asarray(np.hypot(SHARED_READOUT * told, by_coding))
    scaled = max(noise_px, LEAST_NOISE_PX) / TYPICAL_NOISE_PX * np.array(BIAS_STD[name])
    floor = np.maximum(np.maximum(scaled, SHARED * told), WANDER_STD.get(name, 0.0))
    floor = np.hypot(floor, by_coding)
    if name == "gyro_bias" and own is not None:
        floor = np.hypot(floor, SHARED_RELIEF * fit.by_relief[own])
    return np.asarray(floor)


# ── points without the bias of their blur ────────────────────────────────────────────────────────────────────────

STILL_SHARED = {
    "time_offset": 0.010,
    "readout_time": 0.026,
    "imu_rotation": 0.006,
    "gyro_bias": 0.005,
    "focal_length": 0.014,
    "radial_distortion": 0.012,
    "principal_point": 0.018,
    "exposure_time": 0.010,
}
"""Part of a step's noise that is correlated with a value's own pattern once blur's bias is taken out: what remains is
mostly the codec's, whose predicted blocks shear less than rows do.  Those of 52 captures that were drawn as
``python -m virest.app.bench --only calibration`` draws them; that command prints what its captures ask for."""
STILL_SHARED_OTHER = 0.012
"""The same for all other values: the typical one."""
GYRO_WANDER_RAD_S = 5e-5
"""Bias instability of phones' gyroscopes: 10 degrees an hour (data sheets of BMI160, LSM6DSO, ICM-20602: 3 to 10)."""


def remaining_std(fit: TrackFit, name: str, moved: Array, gyro_mean_std_rad_s: float) -> Array:
    """Standard deviation (k,) of what is left of a term's bias in points that blur's bias was taken out of.

    moved (k,): by how much that moved the values.  gyro_mean_std_rad_s: of the gyroscope's noise, over the capture.
    """
    own = fit.slices[name]
    std = np.hypot(np.hypot(shared_std(fit, name), RELATIVE_STD * moved), fit.by_coding[own])
    if name == "gyro_bias":
        wander = np.hypot(GYRO_WANDER_RAD_S, gyro_mean_std_rad_s)
        return np.asarray(np.hypot(np.hypot(std, wander), SHARED_RELIEF * fit.by_relief[own]))
    return np.asarray(std)


def shared_std(fit: TrackFit, name: str) -> Array:
    """The part (k,) of :func:`remaining_std` that STILL_SHARED makes."""
    told = np.sqrt(2 * fit.weight.sum() * np.diag(fit.curvature)[fit.slices[name]])
    return np.asarray(STILL_SHARED.get(name, STILL_SHARED_OTHER) * told)
