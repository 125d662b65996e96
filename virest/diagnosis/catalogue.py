"""The named causes, and the significance that each needs.

They are listed in the table of effects.  Points: geometric_effects; brightness: photometry_effects; blur:
local_blur_fit; edges: edge_overshoot.  A phone's denoiser is not listed: at 0.15 to 0.3 bit per pixel the encoder
removes more noise in flat regions than a strong denoiser does, and the amount depends more on the encoder than on the
denoiser.
"""

from __future__ import annotations

from virest.effects.table import EFFECTS as CATALOGUE

__all__ = ["CATALOGUE", "FALSE_ALARM", "MAX_P"]

FALSE_ALARM = 1e-3
"""Probability that any cause is reported for a capture without errors."""

MAX_P = FALSE_ALARM / len(CATALOGUE)
"""p value below which a cause is significant: Bonferroni correction over all causes."""
