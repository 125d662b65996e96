"""The unsharp mask that a phone put on its pictures, from what stands above the plateau beside an edge.

No blur of light takes a picture above the plateau beside an edge or below it, and no response curve does; an unsharp
mask y + amount (y − G_radius ∗ y) does both (Polesel, Ramponi & Mathews 2000, doi:10.1109/83.826787).  Only the side
that is looked at must be flat: beyond the edge may lie another plateau, or the other side of a stroke of print.  A line
of contrast h and width w, spread by a Gaussian of width s, leaves beside it, as part of what it goes down from the
plateau,

    z(u) = 1 − L_s(u) − amount (L_s(u) − L_t(u)),   L_s(u) = h (Φ(−u/s) − Φ(−(u + w)/s)),   t² = s² + radius²;

a step is a wide line.  Where the edge is wider than the mask, amount and radius show as amount · radius² alone; what
phones use then decides.

A mask M that may be there leaves M K x of a picture x.  Of all that is known of M, the filter of least expected error
is 1 / K over (E M² + N / (S |K|²)) / E M: a spread of M makes it weaker by 1 + Var M / (E M)² alone, which is 1.04 for
a mask of 0.3 ± 0.25, at all frequencies that come through alike.  So what is to be expected of the amount is undone,
and its spread is left out.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import ndtr

from virest.image_formation.kernels import blur_chords
from virest.image_formation.row_motion import RowMotion
from virest.inference.chance import normal_tail
from virest.inference.edges import EdgeSettings, find_edges, parallel_profiles
from virest.inference.robust import robust_std

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

RADIUS_PX, RADIUS_SPREAD = 1.2, 0.3
"""Of phones' unsharp masks, and how far it varies (in the logarithm): 0.9 to 1.6 px."""
AMOUNT, AMOUNT_SPREAD = 0.6, 0.4
"""Of phones' unsharp masks, and how far it varies."""
FALSE_ALARM = 5e-3
"""Probability that pictures that nobody sharpened are taken for surely sharpened ones.  A mask that is not undone costs
up to 2 dB where blur is short, one that is not there and undone, some tenths."""
SHARPENED = 0.25
"""Prior probability that a phone sharpened its movie.

Between 0.12 and 0.5 it changes the mean gain by no more than 0.02 dB on 13 simulated captures, sharpened and not, whose
edges leave the question open.  A lower value costs less where nobody sharpened."""
BARE_ALL, BARE_SHARPEST = (0.001, 0.003), (0.0056, 0.0056)
"""Overshoot of movies that nobody sharpened, as part of the step: mean, and how far it varies, of all edges and of the
sharpest, over 65 simulated captures of five scenes at 320 x 240 and 640 x 480, gentle and fast, coded finely and
coarsely, in focus and not; what the number of edges makes it scatter by is not in it.  ``python -m virest.app.bench
--only edges`` measures it on others.

The most are 0.009, a board's at 320 x 240, and 0.025.  The profile that the mask is fitted to may be wrong by as much
as the sharpest edges vary: neighbours within a pixel share the error."""
EDGES = EdgeSettings(edges_per_frame=600, cell_px=16, min_slope_levels=6.0)
MOST_FRAMES = 4
STILL_PX = 0.6
"""Edges across which the blur path's standard deviation is below this are used."""
SHARPEST = 0.4
"""Part of the edges that the mask is fitted to, by the width of their other half: a soft step overshoots less, and the
tails of natural edges hide it.

In photographs a mask of 0.7 with a radius of 1 px overshoots by 0.04 to 0.09 among these, and by nothing in the median
of all.  That of all tells weak masks of print and plain surfaces, where the sharpest vary more.
"""
LEAST_EDGES = 40
"""The median of fewer is moved by a few odd ones."""
ALIKE = 4
"""Edges that count as one: several lie on one contour, and one place is seen in several frames."""
MEDIAN_STD = 1.2533
"""Of the median over the mean's, for normal deviates."""
ALONG_PX = np.arange(-9.0, 9.0 + 1e-9, 0.5)
FLAT_FROM_PX, MAX_FLAT_RMS = 4.0, 0.04
"""Where the plateau begins, and its greatest rms as part of the step."""
MIN_STEP_LEVELS = 30.0
UNCLIPPED_LEVELS = (6.0, 249.0)
"""Of a plateau.  What stands above it may be clipped: the mask is then taken for less than it is."""
MAX_OFF_PX = 1.5
"""Between a crest of the slope and the middle of its edge."""
GRID_PX = np.arange(-4.0, 6.0 + 1e-9, 0.25)
FITTED = GRID_PX >= -1.0
LEFT = 0.02
"""Part of the mask's change that may remain: at an edge of 100 levels a tenth of a level."""


@dataclass(frozen=True, slots=True)
class UnsharpMask:
    """y + amount (y − G ∗ y) on the luma, the same change on all channels."""

    amount: float
    radius_px: float
    """Standard deviation of the Gaussian."""


@dataclass(frozen=True, slots=True)
class Overshoot:
    """How far edges stand above the plateaus beside them, as part of the step."""

    of_all: float
    """In the median of all edges."""
    of_sharpest: float
    p_value: float
    """Probability of the more significant of the two where nobody sharpened, for two that were asked."""
    sharpest_std: float
    """One standard deviation of that of the sharpest, where nobody sharpened."""
    sharpest: Array
    """(m,) median profile of the sharpest on GRID_PX."""

    def mask(self) -> UnsharpMask:
        """What fits the sharpest; its amount is 0 or less where nothing overshoots."""
        _, amount, log_radius, *_ = _fitted(self.sharpest)
        return UnsharpMask(float(amount), float(np.exp(log_radius)))

    def expected_mask(self) -> UnsharpMask:
        """The mask that fits, as strong as it is on the mean of its being there and not."""
        theta = _fitted(self.sharpest)
        amount = max(float(theta[1]), 0.0) * (1.0 if self.p_value <= FALSE_ALARM else self._chance(theta))
        return UnsharpMask(amount, float(np.exp(theta[2])))

    def _chance(self, theta: Array) -> float:
        """Probability that the movie was sharpened, by how far the sharpest overshoot, normal with and without a mask.

        With one they overshoot by as much as a usual one makes edges of the fitted width do, give or take how far its
        amount varies.  0 where that is less likely than none: a profile holds that nothing speaks against.
        """
        usual = np.array([theta[0], AMOUNT, *theta[2:]])
        more = float(_beside_line(usual).max() - _beside_line(usual * (1, 0, 1, 1, 1, 1)).max())
        found, std = self.of_sharpest - BARE_SHARPEST[0], self.sharpest_std
        std_with = float(np.hypot(std, more * AMOUNT_SPREAD / AMOUNT))
        odds = std / std_with * np.exp(0.5 * ((found / std) ** 2 - ((found - more) / std_with) ** 2))
        return float(SHARPENED * odds / (SHARPENED * odds + 1 - SHARPENED)) if odds > 1 else 0.0


def seen_mask(pictures: Iterable[tuple[Picture, RowMotion]]) -> UnsharpMask | None:
    """The mask to expect by what some frames' edges show; None: none, or too few edges tell.

    pictures: grey (h, w), and the motion over the frame.
    """
    found = overshoot(pictures)
    if found is None:
        return None
    mask = found.expected_mask()
    return mask if mask.amount > 0 else None


def overshoot(pictures: Iterable[tuple[Picture, RowMotion]]) -> Overshoot | None:
    """What some frames' edges do beside their plateaus; None where too few tell.  Arguments as of :func:`seen_mask`."""
    found = [np.zeros((0, len(GRID_PX))), *(_profiles(picture, motion) for picture, motion in pictures)]
    profiles = np.concatenate(found)
    if len(profiles) < LEAST_EDGES:
        return None
    width = _inner_width(profiles)
    sharp = profiles[width <= np.quantile(width, SHARPEST, method="lower")]
    (of_all, std), (of_sharpest, sharpest_std) = _overshoot(profiles, BARE_ALL[1]), _overshoot(sharp, BARE_SHARPEST[1])
    over = (of_all - BARE_ALL[0]) / std, (of_sharpest - BARE_SHARPEST[0]) / sharpest_std
    p_value = min(1.0, len(over) * normal_tail(max(over)))
    return Overshoot(of_all, of_sharpest, p_value, sharpest_std, np.median(sharp, axis=0))


def without_mask(picture: Picture, mask: UnsharpMask) -> Picture:
    """A picture (h, w) or (h, w, 3) as it was before the mask, y = (1 + amount) x − amount G ∗ x on its luma.

    x ← (y + amount G ∗ x) / (1 + amount) falls to the solution by amount / (1 + amount) a step at least (Banach).  Its
    gain lies between 1 / (1 + amount) and 1: no noise is amplified.  What may be clipped stays as it is: taken down it
    would pass for light that was measured, and a lamp's streak for a dim line.
    """
    luma = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    sharp = luma.astype(np.float32)
    falls = mask.amount / (1 + mask.amount)
    soft = sharp
    for _ in range(max(int(np.ceil(np.log(LEFT) / np.log(falls))), 1)):
        soft = cv2.addWeighted(sharp, 1 - falls, cv2.GaussianBlur(soft, (0, 0), mask.radius_px), falls, 0.0)
    change = cv2.subtract(soft, sharp)
    if picture.ndim == 3:
        change = cv2.merge([change] * 3)
    undone = np.asarray(cv2.add(picture, change, dtype=cv2.CV_8U), np.uint8)
    np.copyto(undone, picture, where=picture > UNCLIPPED_LEVELS[1])
    return undone


# ── parts ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def _profiles(picture: Picture, motion: RowMotion) -> Array:
    """Profiles (n, m) on GRID_PX across edges that hardly moved, 1 at a flat plateau, 0 at the least within reach.

    Each edge is looked at from both its sides.
    """
    points, normals = find_edges(picture, EDGES)
    if not len(points):
        return np.zeros((0, len(GRID_PX)))
    path_px = np.abs((blur_chords(motion, points) * normals).sum(axis=1)) / np.sqrt(12)
    still = path_px < STILL_PX
    levels = parallel_profiles(picture, points[still], normals[still], ALONG_PX)
    return np.concatenate([_beside_plateau(levels), _beside_plateau(-levels[:, ::-1])])


def _beside_plateau(levels: Array) -> Array:
    """Those profiles (n, m) on ALONG_PX that end on a plateau from below, scaled, their middle at 0."""
    flat, near = ALONG_PX >= FLAT_FROM_PX, (ALONG_PX > -FLAT_FROM_PX) & (ALONG_PX < 1)
    plateau, lowest = np.median(levels[:, flat], axis=1), levels[:, near].min(axis=1)
    step = np.maximum(plateau - lowest, 1e-3)
    part = (levels - lowest[:, None]) / step[:, None]
    rms = np.sqrt(np.mean((part[:, flat] - 1) ** 2, axis=1))
    low, high = UNCLIPPED_LEVELS
    unclipped = (np.abs(plateau) > low) & (np.abs(plateau) < high)
    part = part[(plateau - lowest > MIN_STEP_LEVELS) & (rms < MAX_FLAT_RMS) & unclipped]
    below = part < 0.5
    last = len(ALONG_PX) - 1 - np.argmax(below[:, ::-1], axis=1)
    part, last = part[last < len(ALONG_PX) - 1], last[last < len(ALONG_PX) - 1]
    rows = np.arange(len(part))
    before, after = part[rows, last], part[rows, last + 1]
    middle = ALONG_PX[last] + (ALONG_PX[1] - ALONG_PX[0]) * (0.5 - before) / (after - before)
    centred = np.abs(middle) < MAX_OFF_PX
    return _moved(part[centred], middle[centred])


def _moved(part: Array, middle: Array) -> Array:
    """Profiles with their middles at 0, on GRID_PX, linear between samples."""
    at = (GRID_PX + middle[:, None] - ALONG_PX[0]) / (ALONG_PX[1] - ALONG_PX[0])
    index = np.clip(at.astype(np.intp), 0, len(ALONG_PX) - 2)
    rows = np.arange(len(part))[:, None]
    return np.asarray(part[rows, index] * (1 - (at - index)) + part[rows, index + 1] * (at - index))


def _inner_width(profiles: Array) -> Array:
    """(n,) from the middle of an edge to where it has gone down to 0.16, away from the plateau."""
    inside = profiles[:, GRID_PX <= 0][:, ::-1]
    after = np.argmax(inside <= 0.16, axis=1)
    rows = np.arange(len(inside))
    above, below = inside[rows, after - 1], inside[rows, after]
    width = (after - (0.16 - below) / np.maximum(above - below, 1e-9)) * (GRID_PX[1] - GRID_PX[0])
    return np.where(after > 0, width, np.inf)


def _crest(profiles: Array) -> tuple[int, float]:
    """Where on GRID_PX their median is highest beyond the edge, and how high."""
    median = np.median(profiles, axis=0)
    at = int(np.argmax(np.where(GRID_PX > 0, median, 0.0)))
    return at, float(median[at])


def _overshoot(profiles: Array, bare_std: float) -> tuple[float, float]:
    """How far they stand above their plateaus, and the deviation of that; bare_std: that of bare movies alone."""
    at, crest = _crest(profiles)
    typical = robust_std(profiles[:, at] - crest)
    noise = MEDIAN_STD * typical / np.sqrt(len(profiles) / ALIKE)
    return crest - 1, float(np.hypot(noise, bare_std))


def _fitted(mean: Array) -> Array:
    """Width, amount, log radius, line's width and contrast, and the middle; amount and radius have priors."""
    share = np.sqrt(GRID_PX[1] - GRID_PX[0]) / BARE_SHARPEST[1]

    def off(theta: Array) -> Array:
        misfit = share * (_beside_line(theta) - mean)[FITTED]
        held = (theta[1:] - _USUAL) / _SPREAD
        return np.append(misfit, held)

    tries = [least_squares(off, [0.7, 0.3, np.log(RADIUS_PX), width, 1.0, 0.0], bounds=_BOUNDS) for width in (2.0, 5.0)]
    return np.asarray(min(tries, key=lambda found: float(found.cost)).x)


_USUAL = np.array([AMOUNT, np.log(RADIUS_PX), 4.0, 1.0, 0.0])
_SPREAD = np.array([AMOUNT_SPREAD, RADIUS_SPREAD, 3.0, 0.2, 0.2])
_BOUNDS = ([0.3, -0.5, np.log(0.5), 0.5, 0.5, -1.0], [3.0, 3.0, np.log(3.0), 20.0, 3.0, 1.0])
"""Of amount, log radius, the line's width in pixels, its contrast, and the middle: what is usual, and how far it
varies; and the bounds, of the edge's width too."""


def _beside_line(theta: Array) -> Array:
    """z(u) on GRID_PX."""
    width, amount, log_radius, line, contrast, middle = theta
    u = GRID_PX + middle

    def spread(by: float) -> Array:
        return np.asarray(contrast * (ndtr(-u / by) - ndtr(-(u + line) / by)))

    seen = spread(width)
    return np.asarray(1 - seen - amount * (seen - spread(float(np.hypot(width, np.exp(log_radius))))))
