"""Systematic tracking errors that are the same throughout a capture, so that its own statistics do not reveal them.

:func:`bias_std` applies to points as tracked, :func:`remaining_std` to points tracked in equally blurred frames
(:mod:`virest.inference.even_blur`).

Tracked steps are slightly late and short where blur changes from frame to frame, and more so where the codec's
predicted blocks replace image detail.  The error was measured on simulated captures with H.264 at 0.12 to 2 bits per
pixel; it grows with the noise of a tracked step, typically 0.15 px.

Part of the error is correlated with the change of the points that a value itself causes.  If a value moves many points
far, that matters little; if it moves them by hundredths of a pixel (a lens while walking straight ahead, a clock skew
within 3 s), it is most of the uncertainty.
"""

from __future__ import annotations

import numpy as np

from virest.arrays import Array
from virest.inference.track_fit import TrackFit

TYPICAL_NOISE_PX, LEAST_NOISE_PX = 0.15, 0.05
SHARED = 0.025
"""Fraction of each point's error that is correlated with a value's own pattern.  In 40 captures of known truth, ten
kinds of values were off by 0.018 to 0.027 of it (rms): hand-held or walking, distant scenes, walls and rooms, 0.04 to
0.19 px of noise.  By statistics alone, one value in five was off by more than 2 σ."""
SHARED_READOUT = 0.04
"""The same for a readout: predicted blocks shear less than rows do.  In 20 captures as phones film them, simulated
outside, the rms of error / σ was 1.28 at 0.03; in seven hand-held captures drawn like those of `bench --only
calibration`, median |error| / σ was 0.71 at 0.03 and 0.40 at 0.06, where 0.67 is ideal."""
SHARED_RELIEF = 0.6
"""Fraction of the spread of depths about the plane that image regions share in the pattern of a constant rate, since
translation with wrong depths resembles one.  In rooms walked through, biases were off by 0.5 to 2 times it."""
BIAS_STD: dict[str, tuple[float, ...]] = {
    "time_offset": (2e-5,),
    "imu_rotation": (2.5e-4,) * 3,
    "gyro_bias": (1.5e-4,) * 3,
    "gyro_scale": (6e-4,),
    "gyro_axes": (6e-4, 6e-4, 2.5e-4, 2.5e-4, 2.5e-4),
    "gyro_lowpass": (2e-5,),
    "gyro_averaging": (3e-6,),
    "focal_length": (6e-4,),
    "pixel_aspect": (8e-4,),
    "focal_drift": (3e-4,),
    "radial_distortion": (7e-4,),
    "higher_distortion": (2e-3,),
    "principal_point": (0.2, 0.2),
    "stabilisation": (0.002, 0.02, 0.0, 0.0, 0.0),
    "clock_skew": (1e-5,),
    "exposure_time": (0.015,),
    "scene_depth": (0.004,),
}
"""Bias at the typical noise, in the units of the terms of profile_terms; relative for a depth.  By analogy, not
measured: the low-pass filter's delay as a time offset, pixel_aspect as √2 of a focal length, since only one of two
directions determines it; k2 as the k1 that bends as much at 0.6 focal lengths from the centre; the scales of axes as
the gyroscope's, their misalignment as a rotation of the IMU, and the square of the averaging time as that scale at 3 Hz
(½ (2π f σ)²).  For a stabiliser's lean and travel SHARED alone counts: four travels were off by at most 0.5 σ."""
DRIFT_STD = {"gyro_bias": 1.5e-4}
"""Changes of a value itself, however well points are tracked: a phone's gyroscope drifts by this much within seconds,
and the mean of its noise of 3e-4 rad/s/√Hz over 2 s is about as large."""


def bias_std(fit: TrackFit, name: str, noise_px: float) -> Array:
    """Standard deviation (k,) of the bias of a term's values; noise_px: of a tracked step, per coordinate.

    At least the error that points share: the curvature is that of Σw independent points, but no number of points can
    determine a value better than 1 / SHARED² of them.
    """
    own = fit.slices.get(name)
    per_point = np.zeros(1) if own is None else np.sqrt(2 * fit.weight.sum() * np.diag(fit.curvature)[own])
    by_coding = np.zeros(1) if own is None else fit.by_coding[own]
    if name == "readout_time":
        return np.asarray(np.hypot(SHARED_READOUT * per_point, by_coding))
    scaled = max(noise_px, LEAST_NOISE_PX) / TYPICAL_NOISE_PX * np.array(BIAS_STD[name])
    floor = np.maximum(np.maximum(scaled, SHARED * per_point), DRIFT_STD.get(name, 0.0))
    floor = np.hypot(floor, by_coding)
    if name == "gyro_bias" and own is not None:
        floor = np.hypot(floor, SHARED_RELIEF * fit.by_relief[own])
    return np.asarray(floor)


# ── points from equally blurred frames, without the encoder's mean bias ──────────────────────────────────────────

EVEN_SHARED = 0.006
"""Fraction of a step's noise that is correlated with a value's own pattern: the largest that is not half as likely as
the most likely one (0.004) for all values in the 45 captures of :data:`virest.inference.blur_bias.LEFT_BY_EVEN_BLUR`.
``python -m virest.app.bench --only calibration`` prints what its captures imply."""
EVEN_SHARED_READOUT = 0.015
"""The same for a readout, which coded frames show too short: by 0.10 % (mean of 12 captures of a plane at 0.5 bits per
pixel, simulated outside; none of it at 6).  In 24 such captures at 0.12 to 0.5, the rms of error / σ was 1.25 at 0.006,
1.04 at 0.015 and 0.93 at 0.02."""
GYRO_WANDER_RAD_S = 5e-5
"""Bias instability of phones' gyroscopes: 10 degrees an hour (data sheets of BMI160, LSM6DSO, ICM-20602: 3 to 10)."""


def remaining_std(fit: TrackFit, name: str, gyro_mean_std_rad_s: float) -> Array:
    """Standard deviation (k,) of a term's remaining bias, from equally blurred frames without the encoder's mean bias.

    gyro_mean_std_rad_s: standard deviation of the mean gyroscope noise over the capture.
    """
    own = fit.slices[name]
    std = np.hypot(shared_std(fit, name), fit.by_coding_left[own])
    if name == "gyro_bias":
        wander = np.hypot(GYRO_WANDER_RAD_S, gyro_mean_std_rad_s)
        return np.asarray(np.hypot(np.hypot(std, wander), SHARED_RELIEF * fit.by_relief[own]))
    return np.asarray(std)


def shared_std(fit: TrackFit, name: str) -> Array:
    """The part (k,) of :func:`remaining_std` that comes from EVEN_SHARED."""
    part = EVEN_SHARED_READOUT if name == "readout_time" else EVEN_SHARED
    return np.asarray(part * np.sqrt(2 * fit.weight.sum() * np.diag(fit.curvature)[fit.slices[name]]))
