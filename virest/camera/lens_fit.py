"""The standard lens closest to one with a displacement field, for formats without fields."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from virest.arrays import Array
from virest.camera.intrinsics import Intrinsics

GRID = (25, 19)
"""Grid over the picture on which the lenses are matched: ample for the eight parameters of a smooth lens."""


def standard_lens(lens: Intrinsics) -> tuple[Intrinsics, float]:
    """The lens without a displacement that maps rays to nearly the same pixels, and the largest deviation, px.

    Focal lengths, principal point and coefficients of the lens's own model (``radtan`` for a lens without distortion;
    k3 only if the lens has one, since few formats support it) are fitted by least squares over a grid of the picture.
    A tangential displacement becomes p1 and p2.
    """
    if lens.displaced is None:
        return lens, 0.0
    bare = replace(lens, displaced=None)
    if lens.model == "none":
        bare = replace(bare, model="radtan", coefficients=(0.0,) * 5)
    x, y = (np.linspace(0.0, side - 1.0, count) for side, count in zip((lens.width, lens.height), GRID, strict=True))
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = lens.rays(pixels)

    count = 4 if bare.model == "radtan" and not bare.coefficients[4] else len(bare.coefficients)

    def fitted(numbers: Array) -> Intrinsics:
        fx, fy, cx, cy = (float(number) for number in numbers[:4])
        coefficients = (*(float(number) for number in numbers[4:]), *bare.coefficients[count:])
        return replace(bare, fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy, coefficients=coefficients)

    def off_px(numbers: Array) -> Array:
        return np.asarray(fitted(numbers).project(rays) - pixels).ravel()

    start = np.array([bare.fx_px, bare.fy_px, bare.cx_px, bare.cy_px, *bare.coefficients[:count]])
    found = least_squares(off_px, start, x_scale=np.array([bare.fx_px] * 2 + [100.0] * 2 + [0.1] * count))
    return fitted(found.x), float(np.linalg.norm(off_px(found.x).reshape(-1, 2), axis=-1).max())
