"""When a cause is named: one rule for every kind of evidence, its levels as data.

A cause's value must be significant, large enough to matter, and must predict what it was not fitted to.

False alarms: any of the catalogue's causes may be the one that is named by chance, so each value is judged at MAX_P, by
Bonferroni: those of points, brightness, blur and edges add up to at most FALSE_ALARM.  To that add FALSE_ALARM for each
of the three causes without a value (WORD_LEVELS), and twice MIXING_LEVELS' where exposure x ISO stays the same.
Held-out gains, which are asked for on top, only lower this.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from virest.diagnosis.catalogue import FALSE_ALARM, MAX_P
from virest.diagnosis.findings import HeldOutGain


@dataclass(frozen=True, slots=True)
class Levels:
    """What one kind of evidence must show before a cause is named."""

    max_p: float = MAX_P
    """Probability, below which a value is significant."""
    least_gain: float = 0.0
    """Part of the held-out excess (of points: of the loss) that it must take away."""
    least_fall: float = 0.0
    """Part of the held-out mean square, where the measured noise leaves no excess."""
    evenness: tuple[tuple[float, float], ...] = ()
    """(gain, p), rising: above each gain, the probability of so even a gain over the blocks, by chance, is below p."""
    least_change: Mapping[str, float] = field(default_factory=dict)
    """By cause: changes as large as this matter."""

    def significant(self, p_value: float) -> bool:
        """Whether the value is no chance."""
        return p_value < self.max_p

    def matters(self, name: str, change: float) -> bool:
        """Whether a change is large enough to be named."""
        return change > self.least_change.get(name, 0.0)

    def gains(self, held_out: HeldOutGain) -> bool:
        """Whether it predicts better what it was not fitted to."""
        enough = held_out.gain is None or held_out.gain > self.least_gain
        return enough and held_out.after**2 < (1 - self.least_fall) * held_out.before**2

    def holds(self, gain: float, p_even: float) -> bool:
        """Whether a gain is large enough, and no matter of a few blocks: of so even one by chance, p_even."""
        levels = [p for least, p in self.evenness if gain >= least]
        return gain >= self.least_gain and (not levels or p_even < levels[-1])


WORD_LEVELS = Levels(FALSE_ALARM)
"""A word, or a schedule of lags, has no value: its probability is that of so even a gain by chance."""
POINT_LEVELS = Levels(least_gain=0.004, evenness=((0.0, 0.01), (0.05, 0.05)))
"""The gain must hold between blocks too (one-sided t test; the cause was chosen by other blocks, so this is one test):
a capture with nothing wrong passes both this and the value's test at most as often as the latter alone.  Of a large
gain less evenness is asked: time blocks differ in how much they tell of a cause."""
LIGHT_LEVELS = Levels(least_gain=0.15, least_fall=0.02)
FRAME_LEVELS = Levels(least_gain=0.5, least_fall=0.02)
"""Of a value for each frame, on the picture's other sides: the greater part, for a shadow that comes over a part of the
picture dims the rest a little too."""
MIXING_LEVELS = Levels(1.5e-3, 0.15, least_change=MappingProxyType({"response_curve": 0.05, "black_level": 0.02}))
"""Changes of the logarithm of gamma, and of the black level."""
BLUR_LEVELS = Levels(least_change=MappingProxyType({"exposure_time": 0.08, "defocus": 0.5}))
"""Changes of the logarithm of the exposure, and px of defocus; the gain is told and not asked for."""
EDGE_LEVELS = Levels()
