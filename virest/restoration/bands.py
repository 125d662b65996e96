"""How much of a picture is worked on at a time."""

from __future__ import annotations

BAND_ROWS = 64
"""Of a picture, that stay in the cache."""
