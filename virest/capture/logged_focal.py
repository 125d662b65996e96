"""The focal length frame by frame, where a recorder logs one that changes: a lens that focuses breathes.

Android's logger works it out from the focus distance, iOS has it from the system.  What counts is each frame's length
over the recording's median: it holds whatever pixels the logger counts in, and whatever profile states the median.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
VISIBLE_PX = 0.1
"""Less at the picture's corner is below what tracked points tell."""
ONE_LENS = (0.5, 2.0)
"""Of the median; beyond it is a fault of the log."""
MOST_DECIMALS = 9


def focal_scales(logged_px: Array, time_s: Array, half_diagonal_px: float) -> Array | None:
    """(n,) focal length of each frame over the median; None where none is logged or no change is to be seen.

    logged_px: (n,), NaN: not logged; such a frame's lies between its neighbours'.  A change counts beyond two steps of
    the numbers as they are written, and where it moves the picture's corner by VISIBLE_PX.
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
    """The step of numbers written with a number of decimals, 1 for whole ones."""
    distinct = np.unique(values)
    for decimals in range(MOST_DECIMALS):
        if np.allclose(distinct, np.round(distinct, decimals), rtol=0.0, atol=1e-9):
            return float(10.0**-decimals)
    return 0.0


def corners(time_s: Array, values: Array) -> tuple[Array, Array]:
    """The points of a line over time between which it is straight: where it rests, two stand for many."""
    if len(values) < 3:
        return time_s, values
    rests = (values[1:-1] == values[:-2]) & (values[1:-1] == values[2:])
    keep = np.concatenate([[True], ~rests, [True]])
    return time_s[keep], values[keep]
