"""What deblurring really gains on a capture, confirmed by neighbours that were blurred along other paths.

A frame is restored, blurred as its neighbour was and compared with what the neighbour recorded; so is the frame as it
was recorded.  The neighbour holds noise of its own and cancels some frequencies, so it sees only a part of the gain;
but it sees what the model of light, noise and kernels does not know, since none of that went into it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

SEEN_BY_TRUTH = 0.65
"""Gain against the true picture for a gain of 1 against the neighbours.

Of eight simulated captures the ratio was 0.15 to 1.65, median 0.54, and about 0.7 for two of four without a phone's own
processing.  This value was read off between these; no bench fits it yet."""
LEAST_PAIRS = 2
"""A single one has no scatter."""


@dataclass(frozen=True, slots=True)
class ConfirmedGain:
    """How much of a promised gain neighbours confirm on this capture."""

    share: float
    """Gain to be expected for a promise of 1 dB; 0 or less: none."""
    std_db: float
    """One standard deviation of a frame's gain about what is expected."""
    pairs: int

    def expected_db(self, promised_db: float) -> float:
        """The gain to be expected where the model promises so much."""
        return self.share * promised_db


def confirmed_gain(found: Sequence[tuple[float, float]]) -> ConfirmedGain | None:
    """The share by pairs of (promised, confirmed) gains in dB; None where they are too few.

    A ratio of medians: single pairs see too little of a gain to be divided by.
    """
    if len(found) < LEAST_PAIRS:
        return None
    promised, confirmed = np.array(found).T
    if np.median(promised) <= 0:
        return None
    share = SEEN_BY_TRUTH * float(np.median(confirmed) / np.median(promised))
    left = SEEN_BY_TRUTH * confirmed - share * promised
    std_db = float(1.4826 * np.median(np.abs(left - np.median(left))))
    return ConfirmedGain(share, std_db, len(found))
