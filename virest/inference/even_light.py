"""Brightness changes between two frames, which displace tracked points: pictures with equal grey levels for matching.

Matching takes the same point for equally bright in both frames.  Where auto-exposure or a lamp changes the levels by a
few percent, each gradient turns the difference into a displacement, and beyond 20 % most points are lost (median error
of photographs and leaves: 0.01 to 0.02 px per grey level).  Exposure and gain scale linear light; in grey levels, that
is close to a straight line:

    second ≈ slope · first + offset
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Picture
from virest.camera.response import ResponseCurve
from virest.inference.robust import CAUCHY, cauchy_weight, robust_std

LEAST_LEVELS = 1.0
"""Change in grey levels that is evened; a smaller one displaces points by a tenth of the usual tracking noise."""
LEAST_POINTS = 20
"""Matched points from which the line is fitted."""
SIDE_PX = 21
"""Side of the squares whose means are compared, that of the tracker's window: noise and most blur average out."""
CLIPPED = (3, 250)
"""Levels from which a pixel counts as black or white; a coder's ringing keeps clipped ones below 255."""
STEPS = 8
"""Reweightings of the fit; it converges in 4 to 6."""


@dataclass(frozen=True, slots=True)
class LevelChange:
    """Grey levels of a second picture over those of the first."""

    slope: float = 1.0
    offset: float = 0.0

    def log_light(self, curve: ResponseCurve) -> float:
        """Logarithm of the second frame's light over the first's: the median over grey levels unclipped in both."""
        black, white = CLIPPED
        levels = np.linspace(black, white, 25)
        changed = self.slope * levels + self.offset
        shown = (changed > black) & (changed < white)
        if not shown.any():
            return 0.0
        light, changed_light = (
            np.interp(at[shown], np.arange(256.0), curve.linear_table()) for at in (levels, changed)
        )
        return float(np.median(np.log(changed_light / light)))

    def is_near(self, other: LevelChange, picture: Picture) -> bool:
        """Whether two changes differ by less than LEAST_LEVELS at the first picture's mean level.

        Where one frame is more blurred, its levels lie nearer to their mean: that is no change of light.
        """
        return abs((self.slope - other.slope) * float(picture.mean()) + self.offset - other.offset) < LEAST_LEVELS

    def evened(self, first: Picture, second: Picture) -> tuple[Picture, Picture]:
        """Both pictures, the one of higher contrast with the other's levels, so that no level is stretched."""
        if self == SAME_LEVELS:
            return first, second
        levels = np.arange(256.0)
        if self.slope < 1:
            return _with_levels(first, self.slope * levels + self.offset), second
        return first, _with_levels(second, (levels - self.offset) / self.slope)


SAME_LEVELS = LevelChange()
"""No change."""


def level_change(first: Picture, second: Picture, before: NDArray[Any], after: NDArray[Any]) -> LevelChange:
    """The change between two pictures, from matched points (n, 2) in each: a robust straight line (Cauchy weights).

    With few points that are neither black nor white, the slope is that of the pictures' means.
    """
    x, y = (_levels(*seen) if len(before) else np.zeros(0) for seen in ((first, before), (second, after)))
    unclipped = np.isfinite(x + y)
    if unclipped.sum() < LEAST_POINTS:
        return LevelChange(float(second.mean()) / max(float(first.mean()), 1.0))
    x, y = x[unclipped], y[unclipped]
    line = np.array([1.0, float(np.median(y - x))])
    terms = np.stack([x, np.ones(len(x))], axis=-1)
    for _ in range(STEPS):
        left = y - terms @ line
        weight = np.sqrt(cauchy_weight(left**2, max(CAUCHY * robust_std(left), 1e-3)))
        line = np.linalg.lstsq(terms * weight[:, None], y * weight)[0]
    return LevelChange(float(line[0]), float(line[1])) if line[0] > 0 else SAME_LEVELS


def _levels(picture: Picture, points: NDArray[Any]) -> Array:
    """Mean grey levels (n,) of squares around points (n, 2); NaN for squares with clipped pixels."""
    x, y = (np.ascontiguousarray(points[None, :, k], np.float32) for k in (0, 1))
    clipped = cv2.bitwise_not(cv2.inRange(picture, CLIPPED[0] + 1, CLIPPED[1] - 1))
    means, off = (cv2.blur(plane, (SIDE_PX, SIDE_PX)) for plane in (picture, clipped))
    levels, lost = (
        cv2.remap(plane, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0] for plane in (means, off)
    )
    return np.where(lost > 0, np.nan, levels.astype(float))


def _with_levels(picture: Picture, levels: Array) -> Picture:
    """A picture with each grey level replaced, levels (256,)."""
    return np.asarray(cv2.LUT(picture, np.clip(np.rint(levels), 0, 255).astype(np.uint8)))
