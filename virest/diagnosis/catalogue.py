"""The causes that have names, and how sure each must be.

They stand in the table of effects.  Points: geometric_effects; brightness: photometry_effects; blur: local_blur_fit;
edges: edge_overshoot.  A phone's denoiser has no line: at 0.15 to 0.3 bit a pixel the encoder takes more of the noise
in flat places than a strong denoiser does, and how much depends on the encoder more than on the denoiser.
"""

from __future__ import annotations

from virest.effects.table import EFFECTS as CATALOGUE

__all__ = ["CATALOGUE", "FALSE_ALARM", "MAX_P"]

FALSE_ALARM = 1e-3
"""Probability that a capture with nothing wrong has any cause named."""

MAX_P = FALSE_ALARM / len(CATALOGUE)
"""Probability, below which a cause's value is significant: by Bonferroni, since any cause may be the one that is."""
