"""Effects outside the catalogue: uneven row readout, varying focal length, gyroscope errors, shadows, focus.

Tests inject such effects through :class:`Hidden`.  A profile describes those that a diagnosis has found as fields.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np

from virest.arrays import Array
from virest.camera.field import FORCES, RATES
from virest.camera.profile import CameraProfile


@dataclass(frozen=True, slots=True)
class Hidden:
    """Effects in addition to those of a profile; times are seconds on the IMU clock from stamp_0."""

    row_delay_s: Callable[[Array], Array] | None = None
    """(readout fraction (rows,)) → delay of each row against an even readout."""
    row_delay_at: Callable[[float, Array], Array] | None = None
    """(time of the frame's first row, readout fraction) → a further delay of each row."""
    row_delay_exposed: Callable[[float, Array], Array] | None = None
    """(logged exposure in s, readout fraction) → a further delay of each row."""
    clock_s: Callable[[float], float] | None = None
    """(stamp) → delay of the whole frame against the clock model."""
    focal_scale: Callable[[Array], Array] | None = None
    """(time) → factor on the focal length."""
    radial_scale: Callable[[Array, Array], Array] | None = None
    """(time, observed distance from the principal point in px) → a further factor on the focal length."""
    gyro: Callable[[Array, Array, Array], Array] | None = None
    """(time (n,), reading (n, 3), specific force (n, 3)) → logged reading."""
    light: Callable[[Array, Array], Array] | None = None
    """(x, y), each 0 to 1 over the width and height → factor on the light."""
    shadow: Callable[[float, Array, Array], Array] | None = None
    """(stamp, x, y) → a further factor on the light, from an object in front of the lens or the light source."""
    blur_px: Callable[[float], float] | None = None
    """(stamp) → standard deviation of a Gaussian blur."""
    corner_blur_px: float = 0.0
    """Standard deviation of a Gaussian blur at the corners, proportional to the squared distance from the centre."""
    focus_dioptres: Callable[[Array], Array] | None = None
    """(frame time) → logged focus distance."""
    exposures_late_frames: int = 0
    """Rows by which exposure times and ISO values are logged late (negative: early)."""


NOTHING = Hidden()
LEAST_BLUR_PX, BLUR_LEVELS = 0.05, 8
"""Standard deviation up to which uniform blur is skipped; blurred copies that spatially varying blur interpolates."""


def late_rows_s(
    profile: CameraProfile, hidden: Hidden, fraction: Array, first_row_s: float, logged_exposure_s: float = 0.0
) -> Array:
    """Delay of each row (rows,) against an even readout, by readout fraction; first_row_s: IMU clock."""
    late = np.zeros(len(fraction))
    if profile.shutter.uneven is not None:
        late = late + profile.shutter.uneven.at(fraction)[:, 0]
    begun = fraction + late / (profile.shutter.readout_time_s or 1.0)
    for field in profile.extensions.field:
        if field.kind == "delay" and field.is_pair:
            over_time = field.covariates[1] == "time"
            late = late + field.at(begun, profile.camera_time_s(first_row_s) if over_time else logged_exposure_s)[:, 0]
    at = hidden.row_delay_at and partial(hidden.row_delay_at, first_row_s)
    exposed = hidden.row_delay_exposed and partial(hidden.row_delay_exposed, logged_exposure_s)
    for hide in (hidden.row_delay_s, at, exposed):
        late = late if hide is None else late + hide(fraction)
    return late


def defocused(profile: CameraProfile, hidden: Hidden, light: Any, stamp_s: float) -> Any:
    """Light (h, w, 3) with the blur that varies with time or towards the corners."""
    blurs = [f for f in profile.extensions.field if f.kind == "blur"]
    sizes = [float(f.at_time(stamp_s)[0]) for f in blurs if f.covariates != ("radius",)]
    sizes += [] if hidden.blur_px is None else [float(hidden.blur_px(stamp_s))]
    if (sigma := float(np.hypot.reduce([0.0, *sizes]))) > LEAST_BLUR_PX:
        light = cv2.GaussianBlur(light, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
    radial = [f for f in blurs if f.covariates == ("radius",)]
    if not hidden.corner_blur_px and not radial:
        return light
    height, width = light.shape[:2]
    x, y = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    size_px = hidden.corner_blur_px * (x**2 * width**2 + y**2 * height**2) / (width**2 + height**2)
    for field in radial:
        radius_px = seen_radius_px(profile, *np.meshgrid(np.arange(width), np.arange(height)))
        size_px = np.hypot(size_px, field.at(radius_px)[..., 0])
    if not (largest := float(size_px.max())):
        return light
    levels = [light, *(cv2.GaussianBlur(light, (0, 0), largest * k / BLUR_LEVELS) for k in range(1, BLUR_LEVELS + 1))]
    level = BLUR_LEVELS * size_px / largest
    below = np.minimum(level.astype(int), BLUR_LEVELS - 1)
    weight = (level - below)[..., None].astype(np.float32)
    stack = np.stack(levels)
    rows, columns = np.indices((height, width))
    return (1 - weight) * stack[below, rows, columns] + weight * stack[below + 1, rows, columns]


def shaded(hidden: Hidden, light: Any, stamp_s: float) -> Any:
    """Light (h, w, 3) after the hidden light and shadow factors."""
    passing = hidden.shadow and partial(hidden.shadow, stamp_s)
    height, width = light.shape[:2]
    for factor in (hidden.light, passing):
        if factor is not None:
            x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
            light = light * factor(x, y)[..., None].astype(np.float32)
    return light


def focal_scale(profile: CameraProfile, hidden: Hidden, time_s: Any, radius_px: Any) -> Any:
    """Factor on the focal length at times (...), for points observed at radius (...) from the principal point."""
    time_s = np.asarray(time_s, float)
    scale = 1 + profile.extensions.focal_drift_per_s * time_s
    for field in profile.extensions.field:
        if field.kind == "scale":
            # values that the camera logs are on the camera clock
            own_s = time_s if field.log is None else profile.camera_time_s(time_s)
            first = (radius_px,) if "radius" in field.covariates else ()
            scale = scale + field.at_time(own_s, *first)[..., 0]
    if hidden.focal_scale is not None:
        scale = scale * hidden.focal_scale(time_s)
    return scale if hidden.radial_scale is None else scale * hidden.radial_scale(time_s, radius_px)


def seen_radius_px(profile: CameraProfile, x_px: Any, y_px: Any) -> Any:
    """Distance (...) of observed pixels from the principal point."""
    lens = profile.intrinsics
    assert lens is not None
    return np.hypot(x_px - lens.cx_px, y_px - lens.cy_px)


def focal_changes(profile: CameraProfile, hidden: Hidden) -> bool:
    """Whether the focal length varies with time or radius."""
    extensions = profile.extensions
    own = any(field.kind == "scale" for field in extensions.field)
    asked = hidden.focal_scale is not None or hidden.radial_scale is not None
    return bool(extensions.focal_drift_per_s or own or asked)


def missing_rate_rad_s(profile: CameraProfile, time_s: Array, reading: Array, force_m_s2: Array | None) -> Array:
    """Rate (n, 3), rad/s, IMU axes, that a profile's fields add to readings corrected for bias and scale."""
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
    """Gyroscope reading (n, 3) for true rates and forces (n, 3), IMU axes: scale · across(ω − fields) + bias.

    across: each axis also reads parts of the other two where they are not perpendicular.

    A field over rates is a function of the corrected reading itself, hence the fixed-point iteration.
    """
    reading = rate_rad_s
    for _ in range(10 if any(field.kind == "rate" for field in profile.extensions.field) else 0):
        reading = rate_rad_s - missing_rate_rad_s(profile, time_s, reading, force_m_s2)
    return np.asarray(_across(profile, reading) * profile.gyro_scale + profile.gyro_bias_rad_s)


def _across(profile: CameraProfile, rate_rad_s: Array) -> Array:
    """Rates (n, 3) as axes that are not perpendicular sense them."""
    xy, xz, yz = profile.extensions.gyro_misalignment_rad
    x, y, z = rate_rad_s.T
    return np.stack([x + xy * y + xz * z, xy * x + y + yz * z, xz * x + yz * y + z], axis=-1)


def from_gyro_reading(profile: CameraProfile, reading_rad_s: Array) -> Array:
    """Rates (n, 3) of readings (n, 3) without fields: the inverse of :func:`gyro_reading`."""
    axes = _across(profile, np.eye(3))
    sensed = (reading_rad_s - profile.gyro_bias_rad_s) / profile.gyro_scale
    return np.asarray(np.linalg.solve(axes, sensed.T).T)
