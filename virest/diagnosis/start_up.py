"""The recorder's start-up: pictures later than their stamps, and how exact repeats use the lag up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from virest.capture.join import median_period_s
from virest.capture.records import Capture

Array = NDArray[np.float64]
EXTRA_PERIODS = (0.0, 0.5, 1.0, 1.5, 2.0)
"""A lag may be longer than the repeats seen use up, if the recording ends before it is over."""

Schedule = tuple[float, int, tuple[float, ...]]
"""(lag_s at slot 0, last lagging slot, seconds by which each slot shows a later capture)."""


def lag_schedules(capture: Capture, repeats: Sequence[int]) -> list[Schedule]:
    """Schedules that the repeats seen allow; none without a repeat."""
    if not repeats:
        return []
    period_s = median_period_s(np.array([frame.time_s for frame in capture.frames]))
    slots = np.arange(len(capture.frames))
    so_far = np.searchsorted(np.sort(np.array(repeats)), slots, side="right")
    last, total = max(repeats), len(repeats)
    whole_movie = last >= 0.8 * len(slots)
    found = []
    for extra in EXTRA_PERIODS if whole_movie else (0.0,):
        shift = np.where(slots <= last, total + extra - so_far, extra) * period_s
        found.append(((total + extra) * period_s, int(last), tuple(shift.tolist())))
    return found
