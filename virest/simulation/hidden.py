"""What no catalogue names: rows that are not read evenly, focal lengths that wander, gyroscopes that read wrong.

Tests hide such effects by :class:`Hidden`; a profile's fields say the same where a diagnosis has found them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.camera.field import FORCES, RATES
from virest.camera.profile import CameraProfile

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Hidden:
    """Effects beside those of a profile; times in seconds on the IMU's clock from stamp_0."""

    row_delay_s: Callable[[Array], Array] | None = None
    """Of the fraction of the readout (rows,): how much later than evenly each row starts."""
    row_delay_at: Callable[[float, Array], Array] | None = None
    """The same of the time of a frame's first row, and of the fraction."""
    clock_s: Callable[[float], float] | None = None
    """Of a stamp: how much later than the clocks say the frame is taken."""
    focal_scale: Callable[[Array], Array] | None = None
    """Of time: factor on the focal length."""
    radial_scale: Callable[[Array, Array], Array] | None = None
    """Of time and of the seen distance from the principal point, px: another."""
    gyro: Callable[[Array, Array, Array], Array] | None = None
    """Of time (n,), reading (n, 3) and specific force (n, 3): what is logged instead of the reading."""
    light: Callable[[Array, Array], Array] | None = None
    """Of x and y as parts of the width and height: factor on the light."""
    shadow: Callable[[float, Array, Array], Array] | None = None
    """Of a stamp, and of x and y: another factor, of what passes before the lens or across the light."""
    blur_px: Callable[[float], float] | None = None
    """Of a stamp: standard deviation of a Gaussian on the light."""
    corner_blur_px: float = 0.0
    """Standard deviation of a Gaussian in the corners, growing with the square of the distance from the middle."""
    focus_dioptres: Callable[[Array], Array] | None = None
    """Of a frame's time: the focus distance that is logged."""


NOTHING = Hidden()
LEAST_BLUR_PX, STEPS = 0.05, 8


def late_rows_s(profile: CameraProfile, hidden: Hidden, fraction: Array, first_row_s: float) -> Array:
    """How much later than evenly rows start (rows,), by their fraction of the readout; first_row_s: IMU clock."""
    late = np.zeros(len(fraction))
    if profile.shutter.uneven is not None:
        late = late + profile.shutter.uneven.at(fraction)[:, 0]
    begun = fraction + late / (profile.shutter.readout_time_s or 1.0)
    for field in profile.extensions.field:
        if field.kind == "delay" and field.covariates == ("row", "time"):
            late = late + field.at(begun, profile.camera_time_s(first_row_s))[:, 0]
    for hide in (hidden.row_delay_s, hidden.row_delay_at and partial(hidden.row_delay_at, first_row_s)):
        late = late if hide is None else late + hide(fraction)
    return late


def defocused(profile: CameraProfile, hidden: Hidden, light: Any, stamp_s: float) -> Any:
    """Light (h, w, 3) out of focus at some times, or towards the corners."""
    blurs = [f for f in profile.extensions.field if f.kind == "blur"]
    sizes = [float(f.at_time(stamp_s)[0]) for f in blurs if f.covariates != ("radius",)]
    sizes += [] if hidden.blur_px is None else [float(hidden.blur_px(stamp_s))]
    if (sigma := float(np.hypot.reduce([0.0, *sizes]))) > LEAST_BLUR_PX:
        light = cv2.GaussianBlur(light, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
    outwards = [f for f in blurs if f.covariates == ("radius",)]
    if not hidden.corner_blur_px and not outwards:
        return light
    height, width = light.shape[:2]
    x, y = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    size_px = hidden.corner_blur_px * (x**2 * width**2 + y**2 * height**2) / (width**2 + height**2)
    for field in outwards:
        radius_px = seen_radius_px(profile, *np.meshgrid(np.arange(width), np.arange(height)))
        size_px = np.hypot(size_px, field.at(radius_px)[..., 0])
    if not (largest := float(size_px.max())):
        return light
    levels = [light, *(cv2.GaussianBlur(light, (0, 0), largest * k / STEPS) for k in range(1, STEPS + 1))]
    place = STEPS * size_px / largest
    below = np.minimum(place.astype(int), STEPS - 1)
    above = (place - below)[..., None].astype(np.float32)
    whole = np.stack(levels)
    rows, columns = np.indices((height, width))
    return (1 - above) * whole[below, rows, columns] + above * whole[below + 1, rows, columns]


def shaded(hidden: Hidden, light: Any, stamp_s: float) -> Any:
    """Light (h, w, 3) as it falls on the sensor."""
    passing = hidden.shadow and partial(hidden.shadow, stamp_s)
    height, width = light.shape[:2]
    for factor in (hidden.light, passing):
        if factor is not None:
            x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
            light = light * factor(x, y)[..., None].astype(np.float32)
    return light


def focal_scale(profile: CameraProfile, hidden: Hidden, time_s: Any, radius_px: Any) -> Any:
    """Factor on the profile's focal length at times (...), for points seen this far (...) from the principal point."""
    time_s = np.asarray(time_s, float)
    scale = 1 + profile.extensions.focal_drift_per_s * time_s
    for field in profile.extensions.field:
        if field.kind == "scale":
            # what the camera logs runs on its clock
            own_s = time_s if field.log is None else profile.camera_time_s(time_s)
            first = (radius_px,) if "radius" in field.covariates else ()
            scale = scale + field.at_time(own_s, *first)[..., 0]
    if hidden.focal_scale is not None:
        scale = scale * hidden.focal_scale(time_s)
    return scale if hidden.radial_scale is None else scale * hidden.radial_scale(time_s, radius_px)


def seen_radius_px(profile: CameraProfile, x_px: Any, y_px: Any) -> Any:
    """Distance (...) of pixels from the principal point."""
    lens = profile.intrinsics
    assert lens is not None
    return np.hypot(x_px - lens.cx_px, y_px - lens.cy_px)


def focal_changes(profile: CameraProfile, hidden: Hidden) -> bool:
    """Whether the focal length is another at another time."""
    extensions = profile.extensions
    own = any(field.kind == "scale" for field in extensions.field)
    asked = hidden.focal_scale is not None or hidden.radial_scale is not None
    return bool(extensions.focal_drift_per_s or own or asked)


def missing_rate_rad_s(profile: CameraProfile, time_s: Array, reading: Array, force_m_s2: Array | None) -> Array:
    """What a profile's fields add (n, 3), rad/s, IMU axes, to readings less bias and over scale."""
    total = np.zeros(reading.shape)
    for field in profile.extensions.field:
        name = field.covariates[0]
        if field.kind != "rate" or (name in FORCES and force_m_s2 is None):
            continue
        known = {"time": time_s, **dict(zip(RATES, reading.T, strict=True))}
        known |= {} if force_m_s2 is None else dict(zip(FORCES, np.nan_to_num(force_m_s2).T, strict=True))
        total = total + field.at(*(known[name] for name in field.covariates))
    return total


def gyro_reading(profile: CameraProfile, time_s: Array, rate_rad_s: Array, force_m_s2: Array) -> Array:
    """What the gyroscope reads (n, 3) of true rates and forces (n, 3), IMU axes: scale (ω − fields) + bias.

    Along rates a field runs over the reading itself, less bias and over scale: found in a few steps.
    """
    reading = rate_rad_s
    for _ in range(10 if any(field.kind == "rate" for field in profile.extensions.field) else 0):
        reading = rate_rad_s - missing_rate_rad_s(profile, time_s, reading, force_m_s2)
    return np.asarray(reading * profile.gyro_scale + profile.gyro_bias_rad_s)
