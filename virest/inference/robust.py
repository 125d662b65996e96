"""Constants of robust fits."""

from __future__ import annotations

CAUCHY = 2.4
"""A value this many standard deviations away has half its weight: 95 % efficient for normal errors (Holland & Welsch
1977, doi:10.1080/03610927708827533)."""
NORMAL_MEDIAN, RAYLEIGH_MEDIAN = 0.6745, 1.1774
"""Medians of |x| and of √(x² + y²) for normal x and y of unit variance."""
