"""Lens undistortion: the position at which the lens shows what a pinhole of the same intrinsics shows at a pixel.

A pixel p of the pinhole picture is seen along the ray K⁻¹ p, and the lens projects that ray to another position.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.camera.intrinsics import Intrinsics
from virest.errors import SettingsError
from virest.motion.optics import MovingLens
from virest.restoration.row_chunks import bands

MARGIN_PX = 16
"""A lens must be invertible this far around the picture, since the grid of a map extends beyond it."""
WITHIN_PX = 0.1
"""Largest error when a ray is projected and back-projected by the lens."""


def distorted_points(lens: MovingLens, points_px: Array, at_s: float = 0.0) -> Array:
    """Where a lens shows, at a given time, what its pinhole shows at pixels (..., 2).

    The stabiliser's shift is the same for both and is left out; both have the focal length at that time.
    """
    still = replace(lens, shift=None)
    return still.project(replace(still, lens=lens.lens.pinhole).rays(points_px, at_s), at_s)


@lru_cache(maxsize=1)
def undistortion_map(lens: Intrinsics) -> NDArray[np.float32] | None:
    """Where each pixel of the pinhole picture is in the lens's picture, (height, width, 2); None without distortion.

    The map is cached and read-only; it is used for frames that no other step warps.
    """
    if not lens.is_distorted:
        return None
    source = np.empty((lens.height, lens.width, 2), np.float32)
    still = MovingLens(lens)
    for rows in bands(lens.height):
        x, y = np.meshgrid(np.arange(lens.width, dtype=np.float64), np.arange(rows.start, rows.stop, dtype=np.float64))
        source[rows] = distorted_points(still, np.stack([x, y], -1))
    source.flags.writeable = False
    return source


def require_undistortable(lens: Intrinsics) -> None:
    """Raise SettingsError if the lens projects different rays to one point: its distortion polynomial turns back."""
    x, y = (np.linspace(-MARGIN_PX, length - 1 + MARGIN_PX, 33) for length in (lens.width, lens.height))
    rays = lens.pinhole.rays(np.stack(np.meshgrid(x, y), -1))
    back = lens.rays(lens.project(rays))
    wrong = ~(lens.fx_px * np.linalg.norm(back - rays, axis=-1) < WITHIN_PX)
    if wrong.any():
        raise SettingsError(
            f"--undistort: the profile's distortion cannot be undone in {wrong.mean():.0%} of the picture: "
            "it shows different rays at one place",
            hint="calibrate the lens again, or leave --undistort out",
        )
