"""Deblur a single picture with a given kernel or blur path, the same all over; no capture, no gyroscope."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.camera.response import ResponseCurve
from virest.errors import SettingsError
from virest.image_formation.blur import tile_grid
from virest.image_formation.kernels import KernelField
from virest.restoration.blurred import blurred_picture, clipped_anywhere
from virest.restoration.clipped_light import keep_unmeasured
from virest.restoration.deblur import deblur
from virest.restoration.settings import RestorationSettings
from virest.restoration.shutter import rounded
from virest.restoration.statistics.measure import measure_picture
from virest.restoration.statistics.of_picture import SAMPLE_TILE_PX

LEAST_PART = 1e-6
"""Kernel values below this fraction of the largest count as 0."""
SAMPLES = 64
"""Least number of samples of a path."""


def deblur_along(
    picture: NDArray[np.uint8], path_px: Array, light: Array | None, curve: ResponseCurve, settings: RestorationSettings
) -> NDArray[np.uint8]:
    """Deblur a picture whose points all moved along ``path_px`` during the exposure.

    Model: grey = E(mean over the path of sharp light at p − d) + noise, E the tone curve.  picture: (height, width, 3)
    RGB.  path_px: (m, 2) displacements d, x right, y down; the sharp picture shows d = 0.  light: (m,) weights; None:
    equal.  The noise is measured on the picture.  Raises SettingsError if the picture is too small for that.
    """
    height, width = picture.shape[:2]

    def field(centres_px: Array) -> KernelField:
        count = len(centres_px)
        paths = np.broadcast_to(path_px, (count, *path_px.shape))
        weights = None if light is None else np.broadcast_to(light / light.mean(), (count, len(light)))
        return KernelField(centres_px, -paths, 0.0, weights)

    centres = tile_grid(height, width, SAMPLE_TILE_PX, 0).centres_px
    luma, chroma = measure_picture(picture, field(centres), curve, clipped_anywhere(picture, curve))
    if not luma.measured:
        raise SettingsError(
            f"a picture of {width}x{height} is too small for this kernel: its noise cannot be measured",
            hint="crop less, or pass a shorter kernel",
        )
    longest_px = float(np.linalg.norm(np.ptp(path_px, axis=0)))
    blurred = blurred_picture(picture, curve, (luma, chroma), field, longest_px)
    restored = keep_unmeasured(deblur(blurred, replace(settings, shutter="none")), picture, blurred)
    return rounded(restored(slice(0, height)))


def path_of_kernel(kernel: Array) -> tuple[Array, Array]:
    """Displacements (m, 2) from the centre of a convolution kernel, and the light (m,) at each.

    Raises SettingsError unless the kernel is 2-D, finite and non-negative, with a positive sum.
    """
    kernel = np.asarray(kernel, float)
    if kernel.ndim != 2 or not kernel.size or not np.isfinite(kernel).all() or kernel.min() < 0 or not kernel.sum() > 0:
        raise SettingsError(
            "a kernel is a two-dimensional array of finite values, none below 0, with a positive sum",
            hint="pass kernel=, or path_px= for a blur path",
        )
    rows, columns = np.nonzero(kernel > LEAST_PART * kernel.max())
    middle = (np.array(kernel.shape[::-1]) - 1) // 2
    return np.stack([columns, rows], axis=-1) - middle.astype(float), kernel[rows, columns]


def even_path(path_px: Array) -> Array:
    """A path (k, 2), k ≥ 2, resampled evenly in time to SAMPLES points or four per pixel, whichever is more.

    The given points are taken as evenly spaced in time.  Raises SettingsError for other shapes or values.
    """
    path_px = np.asarray(path_px, float)
    if path_px.ndim != 2 or path_px.shape[1] != 2 or len(path_px) < 2 or not np.isfinite(path_px).all():
        raise SettingsError(
            "a blur path is an array (k, 2) of finite displacements, k at least 2", hint="x right, y down"
        )
    count = max(SAMPLES, 4 * int(np.linalg.norm(np.diff(path_px, axis=0), axis=1).sum()))
    at, middles = np.linspace(0, 1, len(path_px)), (np.arange(count) + 0.5) / count
    return np.stack([np.interp(middles, at, path_px[:, axis]) for axis in (0, 1)], axis=-1)


def as_colour(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """An 8-bit picture (h, w) or (h, w, 3) as RGB; raises SettingsError for anything else."""
    picture = np.asarray(picture)
    shaped = picture.size and (picture.ndim == 2 or (picture.ndim == 3 and picture.shape[2] == 3))
    if picture.dtype != np.uint8 or not shaped:
        raise SettingsError(
            f"a picture is an array of uint8, (height, width) or (height, width, 3) RGB, not {picture.dtype} "
            f"{picture.shape}",
            hint="scale to 0..255 grey levels and convert",
        )
    return np.ascontiguousarray(picture if picture.ndim == 3 else cv2.merge([picture] * 3))
