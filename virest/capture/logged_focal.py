"""The focal length of each frame, if the recorder logs a changing one: a lens that refocuses breathes.

Android's logger computes it from the focus distance, iOS reports it.  Only the ratio to the recording's median is used:
it depends neither on the pixels that the logger counts in nor on the profile that states the median.
"""

from __future__ import annotations

import numpy as np

from virest.arrays import Array

VISIBLE_PX = 0.1
"""Smaller displacements of the picture's corner are below the tracking noise."""
ONE_LENS = (0.5, 2.0)
"""Plausible range relative to the median; values outside it are logging errors."""
MOST_DECIMALS = 9
"""Numbers are compared to 1e-9."""


def focal_scales(logged_px: Array, time_s: Array, half_diagonal_px: float) -> Array | None:
    """(n,) focal length of each frame over the median; None if none is logged or it does not visibly change.

    logged_px: (n,), NaN: not logged, which is interpolated.  A change counts if it exceeds two steps of the numbers as
    written and moves the picture's corner by VISIBLE_PX.
    """
    known = np.isfinite(logged_px)
    if known.sum() < 2:
        return None
    scale = logged_px / np.median(logged_px[known])
    known &= (scale > ONE_LENS[0]) & (scale < ONE_LENS[1])
    change = float(np.ptp(scale[known])) if known.any() else 0.0
    if change * half_diagonal_px < VISIBLE_PX or np.ptp(logged_px[known]) < 2.5 * written_step(logged_px[known]):
        return None
    return np.interp(time_s, time_s[known], scale[known])


def written_step(values: Array) -> float:
    """The step of numbers written with a fixed number of decimals, 1 for integers."""
    distinct = np.unique(values)
    for decimals in range(MOST_DECIMALS):
        if np.allclose(distinct, np.round(distinct, decimals), rtol=0.0, atol=1e-9):
            return float(10.0**-decimals)
    return 0.0


def corners(time_s: Array, values: Array) -> tuple[Array, Array]:
    """The vertices of a line over time; of a constant stretch only its two ends are kept."""
    if len(values) < 3:
        return time_s, values
    rests = (values[1:-1] == values[:-2]) & (values[1:-1] == values[2:])
    keep = np.concatenate([[True], ~rests, [True]])
    return time_s[keep], values[keep]
