"""The causes that have names: where each shows, what its parameters are, where a profile keeps it.

One line an effect.  Points: geometric_effects; brightness: photometry_effects; blur: local_blur_fit; edges:
edge_overshoot.  A phone's denoiser has no line: at 0.15 to 0.3 bit a pixel the encoder takes more of the noise in flat
places than a strong denoiser does, and how much depends on the encoder more than on the denoiser.
"""

from __future__ import annotations

from dataclasses import dataclass

from virest.diagnosis.findings import BLUR, EDGES, GEOMETRY, PHOTOMETRY


@dataclass(frozen=True, slots=True)
class Cause:
    """One named cause."""

    shows_in: str
    """The quantity in which it is judged."""
    parameters: tuple[str, ...]
    profile_key: str
    """Where a profile keeps it; empty: nowhere, for restoring does not undo it."""


FALSE_ALARM = 1e-3
"""Probability that a capture with nothing wrong has any cause named."""

CATALOGUE: dict[str, Cause] = {
    "time_offset": Cause(GEOMETRY, ("time_offset_s",), "imu.time_offset_s"),
    "clock_skew": Cause(GEOMETRY, ("clock_skew",), "imu.clock_skew"),
    "readout_time": Cause(GEOMETRY, ("readout_time_s",), "shutter.readout_time_s"),
    "readout_direction": Cause(GEOMETRY, ("readout_direction",), "shutter.readout_direction"),
    "timestamp_reference": Cause(GEOMETRY, ("timestamp",), "shutter.timestamp"),
    "exposure_time": Cause(BLUR, ("exposure_scale",), "shutter.exposure_scale"),
    "gyro_bias": Cause(GEOMETRY, ("gyro_bias_rad_s",), "imu.gyro_bias_rad_s"),
    "gyro_scale": Cause(GEOMETRY, ("gyro_scale",), "imu.gyro_scale"),
    "imu_rotation": Cause(GEOMETRY, ("rotation_rad",), "imu.T_cam_imu"),
    "focal_length": Cause(GEOMETRY, ("focal_scale",), "intrinsics.fx_px"),
    "focal_drift": Cause(GEOMETRY, ("focal_drift_per_s",), "extensions.focal_drift"),
    "radial_distortion": Cause(GEOMETRY, ("k1",), "intrinsics.distortion"),
    "principal_point": Cause(GEOMETRY, ("offset_px",), "intrinsics.cx_px"),
    "stabilisation": Cause(GEOMETRY, ("fraction", "cutoff_hz"), "extensions.stabilisation"),
    "scene_depth": Cause(GEOMETRY, ("depth_m",), "scene.depth_m"),
    "frame_lag": Cause(GEOMETRY, ("lag_s", "frames"), "extensions.frame_lag"),
    "response_curve": Cause(PHOTOMETRY, ("gamma",), "extensions.response_gamma"),
    "black_level": Cause(PHOTOMETRY, ("black_level",), "extensions.black_level"),
    "vignetting": Cause(PHOTOMETRY, ("corner_loss",), "extensions.vignetting"),
    "flicker": Cause(PHOTOMETRY, ("amplitude", "frequency_hz", "phase_rad"), "extensions.flicker"),
    "gain_drift": Cause(PHOTOMETRY, ("gain",), "extensions.gain"),
    "defocus": Cause(BLUR, ("sigma_px",), "extensions.defocus"),
    "sharpening": Cause(EDGES, ("amount", "radius_px"), ""),
}

MAX_P = FALSE_ALARM / len(CATALOGUE)
"""Probability, below which a cause's value is significant: by Bonferroni, since any cause may be the one that is."""
