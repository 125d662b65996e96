"""Physical limits of fitted camera values, from how sensors and lenses work.

A value at or beyond its limit describes no real camera: the fit is compensating for something else.
"""

from __future__ import annotations

from virest.camera.gyro_filter import LEAST_HZ
from virest.camera.profile import CameraProfile
from virest.effects.table import CLOCK_SKEW_OFF, GYRO_SCALE_OFF

LEAST_READOUT_S = 1e-3
"""The fastest rolling shutters (stacked sensors, 960 frames/s) read a frame in about 1 ms."""
GLOBAL_READOUT_S = 1e-4
"""A fitted readout up to this, a tenth of any rolling shutter's, is that of a global shutter."""
GLOBAL_SIGMA = 3.0
"""So is one that lies within this many standard deviations of 0, if they exclude a rolling shutter."""
FOCAL_OF_LONG_SIDE = (0.3, 10.0)
"""From an 11 mm ultra-wide to a 360 mm telephoto lens (35 mm equivalent), as a multiple of the image's long side."""
DEPTH_M = (0.02, 1e4)
"""From the closest focus of a macro lens to where parallax within an exposure is unmeasurable."""
LEAST_EXPOSURE_S = 1e-6
"""No phone's or action camera's electronic shutter is faster than a few microseconds."""
SCALE_OF_EXPOSURE = (0.05, 20.0)
"""True exposure time / logged exposure time."""
OFFSET_S = 2.0
"""A larger offset means another recording or another clock."""


def is_global(readout_s: float, std_s: float = 0.0) -> bool:
    """Whether a fitted readout is that of a global shutter: 0 within its standard deviation."""
    margin_s = max(GLOBAL_SIGMA * std_s, GLOBAL_READOUT_S)
    return abs(readout_s) <= margin_s < LEAST_READOUT_S


def impossible(profile: CameraProfile, period_s: float, exposure_s: float) -> frozenset[str]:
    """Names of the effects whose values in a profile lie at or beyond their physical limits.

    period_s: between frames.  exposure_s: typical logged value; 0: unknown.  Readout and exposure must be shorter than
    the period.  A readout between a global shutter's and LEAST_READOUT_S is no camera's.
    """
    found = set()
    shutter, lens = profile.shutter, profile.intrinsics
    readout_s = abs(shutter.readout_time_s)
    if not (LEAST_READOUT_S <= readout_s < period_s or is_global(readout_s)):
        found.add("readout_time")
    low, high = SCALE_OF_EXPOSURE
    true_exposure_s = exposure_s * shutter.exposure_scale
    in_time = exposure_s <= 0 or LEAST_EXPOSURE_S < true_exposure_s < period_s
    if not low < shutter.exposure_scale < high or not in_time:
        found.add("exposure_time")
    if lens is not None:
        low, high = (part * max(profile.width, profile.height) for part in FOCAL_OF_LONG_SIDE)
        if not (low < lens.fx_px < high and low < lens.fy_px < high):
            found.add("focal_length")
    if abs(profile.time_offset_s or 0.0) >= OFFSET_S:
        found.add("time_offset")
    if profile.extensions.gyro_lowpass_hz and profile.extensions.gyro_lowpass_hz < LEAST_HZ:
        found.add("gyro_lowpass")
    return frozenset(found)


def limit_reasons(profile: CameraProfile, period_s: float, exposure_s: float) -> dict[str, str]:
    """Why values of a fitted profile are implausible, by effect: the value and its physical range."""
    shutter, lens = profile.shutter, profile.intrinsics
    least_px, most_px = (part * max(profile.width, profile.height) for part in FOCAL_OF_LONG_SIDE)
    reasons = {
        "readout_time": (
            f"{1e3 * shutter.readout_time_s:.2f} ms, where rolling shutters take {1e3 * LEAST_READOUT_S:g} to "
            f"{1e3 * period_s:.1f} ms"
        ),
        "exposure_time": (
            f"{shutter.exposure_scale:.3g} times the logged exposure, {1e3 * exposure_s:.2f} ms, "
            f"in a frame of {1e3 * period_s:.1f} ms"
        ),
        "focal_length": f"{lens.fx_px if lens else 0:.0f} px, where lenses have {least_px:.0f} to {most_px:.0f} px",
        "gyro_lowpass": (
            f"{profile.extensions.gyro_lowpass_hz:.3g} Hz, where gyroscopes have filters of {LEAST_HZ:g} Hz and more"
        ),
        "time_offset": f"{profile.time_offset_s or 0.0:+.2f} s, where one recording has less than {OFFSET_S:g} s",
    }
    found = {name: reasons[name] for name in impossible(profile, period_s, exposure_s)}
    worst = max(profile.gyro_scale, key=lambda scale: abs(scale - 1))
    if abs(worst - 1) >= GYRO_SCALE_OFF:
        found["gyro_scale"] = f"{worst:.3f}, where gyroscopes are right to within {GYRO_SCALE_OFF:.0%}"
    if abs(profile.clock_skew) >= CLOCK_SKEW_OFF:
        found["clock_skew"] = f"{profile.clock_skew:+.4f}, where clocks differ by less than {CLOCK_SKEW_OFF:.0%}"
    return found


def is_depth(depth_m: float) -> bool:
    """Whether a fitted depth is within its limits."""
    return DEPTH_M[0] < depth_m < DEPTH_M[1]
