"""A lens in COLMAP's camera models.

COLMAP and nerfstudio count pixels from the top-left corner of the first one, so cx and cy are half a pixel larger than
in a camera profile.
"""

from __future__ import annotations

from virest.camera.intrinsics import Intrinsics

HALF_PX = 0.5
"""From the corner of a pixel, where these tools count from, to its centre."""


def colmap_camera(lens: Intrinsics) -> tuple[str, tuple[float, ...]]:
    """COLMAP's model that holds the lens, and its parameters."""
    basic = (lens.fx_px, lens.fy_px, lens.cx_px + HALF_PX, lens.cy_px + HALF_PX)
    if lens.model == "fisheye":
        return "OPENCV_FISHEYE", (*basic, *lens.coefficients)
    if not lens.is_distorted:
        return "PINHOLE", basic
    k1, k2, p1, p2, k3 = lens.coefficients
    if k3:
        return "FULL_OPENCV", (*basic, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    return "OPENCV", (*basic, k1, k2, p1, p2)
