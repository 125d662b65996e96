"""Brightness: flicker over the rows and vignetting over the picture (contract, section 4).

Light is what reaches the sensor, before the response curve.  Flicker: light × (1 + amplitude sin(2π frequency t +
phase)) at every instant t of an exposure, IMU clock from stamp_0.  Vignetting: light × (1 − corner_loss (r /
r_corner)²) about the picture's centre.  A gain common to a whole frame commutes with every linear step and is not
undone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.camera.field import Field
from virest.camera.profile import CameraProfile
from virest.image_formation.row_clock import ROW_MIDDLE
from virest.image_formation.row_motion import RowMotion
from virest.image_formation.warp import grid_filled, straightened_points

Image = NDArray[np.float32]
LEAST_LIGHT = 0.05
"""Smallest fraction of the light that is compensated; below it mostly noise would be amplified."""


@dataclass(frozen=True, slots=True)
class FrameLight:
    """Factors on the light of one frame, (height, width) each."""

    recorded: Image
    """Flicker times vignetting of each recorded pixel."""
    vignetting: Image
    """Vignetting of each recorded pixel."""
    kept: Image
    """Vignetting at the position to which rolling-shutter correction moves each recorded pixel."""

    def evened(self, light: Image, clipped: Image | None) -> Image:
        """The light of a channel without flicker and vignetting; clipped light is not darkened in bright rows."""
        even = light / self.recorded
        if clipped is None:
            return even
        return np.where(clipped > 0, np.maximum(even, light / self.vignetting), even)

    @property
    def most_change(self) -> float:
        """Largest relative change of light from the recorded to the restored picture."""
        return float(np.abs(self.kept / self.recorded - 1).max())


def frame_light(motion: RowMotion, anchor: float, straighten: bool) -> FrameLight | None:
    """The factors of one frame, with rows at their anchor; None if the profile has neither flicker nor vignetting."""
    extensions = motion.profile.extensions
    shaded = bool(extensions.vignetting_corner_loss or light_maps(motion.profile))
    if not extensions.flicker_amplitude and not shaded:
        return None
    width, height = motion.profile.width, motion.profile.height
    here = vignetting(motion.profile, np.arange(width)[None, :], np.arange(height)[:, None]).astype(np.float32)
    there = here
    if straighten and shaded:
        placed = grid_filled(motion, lambda points: straightened_points(motion, points, anchor))
        there = vignetting(motion.profile, placed[..., 0], placed[..., 1])
    rows = flicker_of_rows(motion)
    return FrameLight(here if rows is None else here * rows, here, there)


def flicker_of_rows(motion: RowMotion) -> Image | None:
    """Mean flicker of each row of one frame, (height, 1), or (1, width) if columns are read; None without flicker."""
    if not motion.profile.extensions.flicker_amplitude:
        return None
    rows = row_light(motion, _along_readout(motion.profile))
    return np.asarray(np.maximum(rows, LEAST_LIGHT), np.float32)


def _along_readout(profile: CameraProfile) -> Array:
    """One pixel of each row (height, 1, 2), or of each column (1, width, 2) if columns are read."""
    if profile.shutter.reads_columns:
        x, y = np.meshgrid(np.arange(profile.width, dtype=float), [0.0])
    else:
        x, y = np.meshgrid([0.0], np.arange(profile.height, dtype=float))
    return np.stack([x, y], -1)


def flicker(profile: CameraProfile, middle_s: Any, lasting_s: Any = 0.0) -> Array:
    """Mean factor on the light (...) over spans of ``lasting_s``, one or (...), around times (...)."""
    extensions = profile.extensions
    # the mean of a sine over a span is the sine at its middle times sin(x) / x of half the span
    amplitude = extensions.flicker_amplitude * np.sinc(extensions.flicker_frequency_hz * lasting_s)
    phase = 2 * np.pi * extensions.flicker_frequency_hz * np.asarray(middle_s, float) + extensions.flicker_phase_rad
    return np.asarray(1.0 + amplitude * np.sin(phase))


def row_light(motion: RowMotion, points_px: Array) -> Array:
    """Mean flicker over the exposure of the rows through pixels (..., 2)."""
    return flicker(motion.profile, motion.row_time_s(points_px, ROW_MIDDLE), motion.exposure_s)


def vignetting(profile: CameraProfile, x_px: Any, y_px: Any) -> Any:
    """Fraction of the light that remains at pixels (x, y), with the profile's fields of gain; float32 stays float32."""
    x, y = np.subtract(x_px, 0.5 * (profile.width - 1)), np.subtract(y_px, 0.5 * (profile.height - 1))
    corner_squared = 0.25 * (profile.width**2 + profile.height**2)
    left = _left(profile.extensions.vignetting_corner_loss / corner_squared, x * x + y * y)
    for field in light_maps(profile):
        gain = np.maximum(1.0 + field.at(x_px, y_px)[..., 0], LEAST_LIGHT)
        left = left * gain.astype(np.asarray(left).dtype)
    return left


def light_maps(profile: CameraProfile) -> list[Field]:
    """The fields of gain over the picture."""
    return [field for field in profile.extensions.field if field.kind == "gain"]


def vignetting_at_radius(profile: CameraProfile, radius: Array) -> Array:
    """The same at distances (...) from the picture's centre, 1 in its corners."""
    return np.asarray(_left(profile.extensions.vignetting_corner_loss, radius**2))


def _left(loss: float, radius_squared: Any) -> Any:
    return np.maximum(1.0 - loss * radius_squared, LEAST_LIGHT)


def defocus_px(profile: CameraProfile, points_px: Array) -> Array:
    """Standard deviation (...) of the lens's Gaussian blur at pixels (..., 2) of one frame.

    The variances of a uniform defocus and of fields over the distance from the principal point add up.
    """
    lens, middle = profile.intrinsics, ((profile.width - 1) / 2, (profile.height - 1) / 2)
    radius_px = np.linalg.norm(points_px - np.array(middle if lens is None else (lens.cx_px, lens.cy_px)), axis=-1)
    even = np.full(radius_px.shape, profile.extensions.defocus_sigma_px)
    return np.asarray(np.hypot.reduce([even, *(field.at(radius_px)[..., 0] for field in _softness(profile))]))


def most_defocus_px(profile: CameraProfile) -> float:
    """Largest standard deviation of the lens's Gaussian blur in the picture."""
    largest = [max(value for (value,) in field.values) for field in _softness(profile)]
    return float(np.hypot.reduce([profile.extensions.defocus_sigma_px, *largest]))


def equivalent_length_px(length_px: Any, defocus_px: Any) -> Any:
    """Length (...) of a uniform path with the variance of a path of ``length_px`` and a defocus together."""
    return np.hypot(length_px, np.sqrt(12.0) * defocus_px)


def _softness(profile: CameraProfile) -> list[Field]:
    return [f for f in profile.extensions.field if (f.kind, f.covariates) == ("blur", ("radius",))]
