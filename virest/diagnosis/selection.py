"""When a cause is named: one rule for every kind of evidence, with its levels as data.

A cause's value must be significant, large enough to matter, and must predict data that it was not fitted to.

False alarms: any effect of the table may be named by chance, so each value is tested at MAX_P (Bonferroni): those of
points, brightness, blur and edges add up to at most FALSE_ALARM.  Each of the three causes without a value
(WORD_LEVELS) adds FALSE_ALARM, and constant exposure × ISO adds twice the level of MIXING_LEVELS.  The held-out gains
that are also required only lower this.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from virest.diagnosis.findings import HeldOutGain
from virest.effects.table import EFFECTS

FALSE_ALARM = 1e-3
"""Probability that any cause is reported for a capture without errors."""
MAX_P = FALSE_ALARM / len(EFFECTS)
"""p value below which a cause is significant: Bonferroni correction over all causes."""


@dataclass(frozen=True, slots=True)
class Levels:
    """What one kind of evidence must show before a cause is named."""

    max_p: float = MAX_P
    """p value below which a value is significant."""
    least_gain: float = 0.0
    """Minimum fraction of the held-out excess (for points: of the loss) that it must remove."""
    least_fall: float = 0.0
    """Minimum fraction of the held-out mean square that it must remove; the only test where there is no excess."""
    evenness: tuple[tuple[float, float], ...] = ()
    """(gain, p), ascending: from each gain on, the p value of its consistency over the blocks must be below p."""
    least_change: Mapping[str, float] = field(default_factory=dict)
    """By cause: changes must be larger than this to be named."""

    def significant(self, p_value: float) -> bool:
        """Whether a p value is below its level."""
        return p_value < self.max_p

    def matters(self, name: str, change: float) -> bool:
        """Whether a change is large enough to be named."""
        return change > self.least_change.get(name, 0.0)

    def gains(self, held_out: HeldOutGain) -> bool:
        """Whether held-out data are predicted sufficiently better."""
        enough = held_out.gain is None or held_out.gain > self.least_gain
        return enough and held_out.after**2 < (1 - self.least_fall) * held_out.before**2

    def holds(self, gain: float, p_even: float) -> bool:
        """Whether a gain is large enough, and consistent over the blocks; p_even: p value of its consistency."""
        levels = [p for least, p in self.evenness if gain >= least]
        return gain >= self.least_gain and (not levels or p_even < levels[-1])


WORD_LEVELS = Levels(FALSE_ALARM)
"""A word, or a schedule of lags, has no value to test: its p value is that of such a consistent gain by chance."""
POINT_LEVELS = Levels(least_gain=0.004, evenness=((0.0, 0.01), (0.05, 0.05)))
"""The gain must also be consistent over the blocks (one-sided t test; the cause was chosen by other blocks, so this is
one test): a capture without errors passes this and the value's test at most as often as the latter alone.  A large gain
may be less consistent, because time blocks differ in how much they reveal of a cause."""
LIGHT_LEVELS = Levels(least_gain=0.15, least_fall=0.02)
FRAME_LEVELS = Levels(least_gain=0.5, least_fall=0.02)
"""For a value per frame, judged on other sides of the frame: most of the excess must go, because a shadow over part of
the frame also dims the rest a little."""
MIXING_LEVELS = Levels(1.5e-3, 0.15, least_change=MappingProxyType({"response_curve": 0.05, "black_level": 0.02}))
"""Minimum changes: of the logarithm of gamma, and of the black level."""
BLUR_LEVELS = Levels(least_change=MappingProxyType({"exposure_time": 0.08, "defocus": 0.5}))
"""Minimum changes: of the logarithm of the exposure, and of defocus in px.  The gain is reported but not required."""
EDGE_LEVELS = Levels()
