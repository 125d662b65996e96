"""Estimate the unsharp mask that a phone applied to its pictures, from the overshoot beside edges.

Neither blur nor a response curve takes a picture above or below the plateau beside an edge; an unsharp mask
y + amount (y − G_radius ∗ y) does both (Polesel, Ramponi & Mathews 2000, doi:10.1109/83.826787).  Only the analysed
side must be flat: beyond the edge may be another plateau, or the other side of a printed stroke.  Beside a line of
contrast h and width w, blurred by a Gaussian of width s, the profile relative to the depth below the plateau is

    z(u) = 1 − L_s(u) − amount (L_s(u) − L_t(u)),   L_s(u) = h (Φ(−u/s) − Φ(−(u + w)/s)),   t² = s² + radius²;

a step is a wide line.  If the edge is wider than the mask, only amount · radius² is observable, and the priors of
phones' masks decide.

What is filmed may overshoot itself: outlined print, polished rims, a photograph on a wall.  A mask and a blur can be
exchanged, so no comparison of frames tells the two apart, and a mask is never certain.

An uncertain mask M turns a picture x into M K x.  Given the distribution of M, the filter of least expected error
is 1 / K over (E M² + N / (S |K|²)) / E M: the uncertainty of M only attenuates it by 1 + Var M / (E M)², which is 1.04
for a mask of 0.3 ± 0.25, equally at all frequencies that pass.  So the expected amount is undone, and its uncertainty
is neglected.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.special import ndtr

from virest.arrays import Array, Picture
from virest.image_formation.kernels import blur_chords
from virest.image_formation.row_motion import RowMotion
from virest.inference.chance import normal_tail
from virest.inference.edges import EdgeSettings, find_edges, moved_profiles, parallel_profiles
from virest.inference.robust import robust_std

RADIUS_PX, RADIUS_SPREAD = 1.2, 0.3
"""Prior mean and standard deviation (of the logarithm) of the radius of phones' unsharp masks: 0.9 to 1.6 px."""
AMOUNT, AMOUNT_SPREAD = 0.6, 0.4
"""Prior mean and standard deviation of the amount of phones' unsharp masks."""
START = (0.7, 0.3, np.log(RADIUS_PX))
"""Edge width, amount and log radius at which fits begin."""
OUTLINED = 0.2
"""Probability that a filmed scene's own edges overshoot as a mask's do: 2 of 9 simulated captures of photographs that
no phone sharpened.

On one of them, undoing the whole fitted mask costs 2.4 dB with ``balanced`` and takes three of 48 frames below
straightening alone; undoing what is expected costs 0.8 dB and takes none."""
SHARPENED = 0.25
"""Prior probability that a phone sharpened its movie.

On five simulated captures whose edges hide their mask, undoing what is expected gains 0.09 dB with ``balanced``; on
four that follow their profile it costs 0.01 dB, on the most sensitive of the shaken set 0.06 dB.  At 0.5 the former are
0.18 and 0.21 dB."""
HIDDEN = 0.5
"""Fraction of sharpened movies whose edges show no overshoot, since natural edges approach their plateau slowly: 5 of
10 simulated captures with masks of 0.2 to 0.8."""
BARE_ALL, BARE_SHARPEST = (0.001, 0.003), (0.0056, 0.0056)
"""Overshoot of unsharpened movies relative to the step, mean and standard deviation, for all edges and the sharpest.

From 65 simulated captures of five scenes at 320 x 240 and 640 x 480, slow and fast, coded finely and coarsely, in and
out of focus; excludes the scatter from the number of edges.  ``python -m virest.app.bench --only edges`` measures it on
others.  The largest are 0.009, of a board at 320 x 240, and 0.025.  The profile to which the mask is fitted may be off
by the same standard deviation as the sharpest edges: neighbours within 1 px share the error."""
EDGES = EdgeSettings(edges_per_frame=600, cell_px=16, min_slope_levels=6.0)
"""The smallest step that counts has this slope at a width of 1.7 px, with the search's smoothing 2 px."""
MOST_FRAMES = 4
"""Frames that are searched for edges: 600 each, where LEAST_EDGES suffice."""
FALSE_ALARM = 5e-3
"""Probability that edges of a scene without outlines are said to overshoot."""
STILL_PX = 0.6
"""Edges across which the blur path's standard deviation is below this are used."""
SHARPEST = 0.4
"""Fraction of the edges, the sharpest by the width of their far half, to which the mask is fitted: soft steps overshoot
less, and the tails of natural edges hide it.

In photographs a mask of 0.7 with a radius of 1 px overshoots by 0.04 to 0.09 at these edges, and not at all in the
median of all edges.  The latter reveals weak masks on print and plain surfaces, where the sharpest vary more.
"""
LEAST_EDGES = 40
"""With fewer edges a few outliers shift the median."""
EDGES_PER_SAMPLE = 4
"""Edges that count as one independent sample: several lie on one contour, and some are seen in several frames."""
MEDIAN_STD = 1.2533
"""Standard deviation of the median over that of the mean, for normal deviates."""
ALONG_PX = np.arange(-9.0, 9.0 + 1e-9, 0.5)
"""Half a pixel apart; beyond FLAT_FROM_PX there are 11 samples of the plateau."""
FLAT_FROM_PX, MAX_FLAT_RMS = 4.0, 0.04
"""Start of the plateau, and its largest rms relative to the step."""
MIN_STEP_LEVELS = 30.0
"""Noise of one grey level is 3 % of it, within MAX_FLAT_RMS."""
UNCLIPPED_LEVELS = (6.0, 249.0)
"""Range of an unclipped plateau.  The overshoot itself may be clipped, so that the mask is underestimated."""
MAX_OFF_PX = 1.5
"""Largest distance between the maximum of the gradient and the middle of its edge."""
GRID_PX = np.arange(-4.0, 6.0 + 1e-9, 0.25)
FITTED = GRID_PX >= -1.0
RESIDUAL_AMOUNT = 0.01
"""Amount of a mask that may remain: 0.1 level at an edge of 100 levels."""


@dataclass(frozen=True, slots=True)
class UnsharpMask:
    """y + amount (y − G ∗ y) on the luma, the same change on all channels."""

    amount: float
    radius_px: float
    """Standard deviation of the Gaussian."""


@dataclass(frozen=True, slots=True)
class Overshoot:
    """Overshoot of edges above the plateaus beside them, relative to the step."""

    of_all: float
    """Median over all edges."""
    of_sharpest: float
    p_value: float
    """p value of the more significant of the two for unsharpened pictures, corrected for two tests."""
    sharpest_std: float
    """Standard deviation of the sharpest edges' overshoot for unsharpened pictures."""
    sharpest: Array
    """(m,) median profile of the sharpest on GRID_PX."""

    def mask(self) -> UnsharpMask:
        """The mask fitted to the sharpest edges; its amount is 0 or less without overshoot."""
        _, amount, log_radius, *_ = _fitted(self.sharpest)
        return UnsharpMask(float(amount), float(np.exp(log_radius)))

    @property
    def overshoots(self) -> bool:
        """Whether edges overshoot more than those of scenes without outlines."""
        return self.p_value <= FALSE_ALARM

    def expected_mask(self) -> UnsharpMask:
        """The expectation over no mask, a usual one that the edges hide, and the fitted one, which they show."""
        theta = _fitted(self.sharpest)
        fitted, radius_px = max(float(theta[1]), 0.0), float(np.exp(theta[2]))
        shown, hidden = self._chances(theta)
        parts = np.array([shown * fitted, hidden * AMOUNT])
        return UnsharpMask(float(parts.sum()), float(parts @ (radius_px, RADIUS_PX) / max(parts.sum(), 1e-9)))

    def _chances(self, theta: Array) -> tuple[float, float]:
        """Probabilities of a mask that the edges show, and of one that they hide, from the sharpest edges' overshoot.

        The overshoot is normal.  With a mask that shows, the mean is the overshoot that a usual mask causes at edges of
        the fitted width, and the standard deviation includes that of the amount.  A hidden mask changes nothing, and
        an outlined scene overshoots as a mask does.
        """
        usual = np.array([theta[0], AMOUNT, *theta[2:]])
        more = float(_beside_line(usual).max() - _beside_line(usual * (1, 0, 1, 1, 1, 1)).max())
        found, std = self.of_sharpest - BARE_SHARPEST[0], self.sharpest_std
        std_with = float(np.hypot(std, more * AMOUNT_SPREAD / AMOUNT))
        log_ratio = 0.5 * ((found / std) ** 2 - ((found - more) / std_with) ** 2)
        likely = np.array([1.0, std / std_with * np.exp(min(log_ratio, 700.0))])  # without and with an overshoot
        masked = SHARPENED * np.array([HIDDEN, 1 - HIDDEN]) * likely
        bare = (1 - SHARPENED) * np.array([1 - OUTLINED, OUTLINED]) * likely
        hidden, shown = masked / (masked.sum() + bare.sum())
        return float(shown), float(hidden)


def overshoot(pictures: Iterable[tuple[Picture, RowMotion]]) -> Overshoot | None:
    """Overshoot of some frames' edges; None if there are too few.

    pictures: grey (h, w), and the motion over the frame.
    """
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
    """A picture (h, w) or (h, w, 3) before the mask y = (1 + amount) x − amount G ∗ x on its luma.

    x ← (y + amount G ∗ x) / (1 + amount) converges at least by a factor amount / (1 + amount) per step (Banach).  Its
    gain is between 1 / (1 + amount) and 1, so noise is not amplified.  Possibly clipped pixels are kept: darkened, they
    would pass for measured light, and the streak of a clipped highlight for a dim line.
    """
    luma = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    sharp = luma.astype(np.float32)
    falls = mask.amount / (1 + mask.amount)
    soft = sharp
    for _ in range(max(int(np.ceil(np.log(RESIDUAL_AMOUNT / mask.amount) / np.log(falls))), 1)):
        soft = cv2.addWeighted(sharp, 1 - falls, cv2.GaussianBlur(soft, (0, 0), mask.radius_px), falls, 0.0)
    change = cv2.subtract(soft, sharp)
    if picture.ndim == 3:
        change = cv2.merge([change] * 3)
    undone = np.asarray(cv2.add(picture, change, dtype=cv2.CV_8U), np.uint8)
    np.copyto(undone, picture, where=picture > UNCLIPPED_LEVELS[1])
    return undone


def edge_profile(
    u_px: Array,
    width: float,
    amount: float,
    log_radius: float,
    line: float = np.inf,
    contrast: float = 1.0,
    middle: float = 0.0,
) -> Array:
    """z(u) at distances u_px from the middle of an edge, which moves it to −middle; line: infinite for a step."""
    u = u_px + middle

    def spread(by: float) -> Array:
        return np.asarray(contrast * (ndtr(-u / by) - ndtr(-(u + line) / by)))

    seen = spread(width)
    return np.asarray(1 - seen - amount * (seen - spread(float(np.hypot(width, np.exp(log_radius))))))


def fit_edge(
    u_px: Array,
    mean: Array,
    misfit_std: float,
    prior: tuple[Array, Array],
    start: Sequence[float],
    bounds: tuple[Sequence[float], Sequence[float]],
) -> OptimizeResult:
    """The arguments of :func:`edge_profile` that fit a mean profile, as many as the start has.

    misfit_std: of the model, correlated within 1 px.  prior: means and standard deviations of all but the edge width.
    """
    share = np.sqrt(u_px[1] - u_px[0]) / misfit_std

    def off(theta: Array) -> Array:
        return np.append(share * (edge_profile(u_px, *theta) - mean), (theta[1:] - prior[0]) / prior[1])

    return least_squares(off, start, bounds=bounds)


# ── parts ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def _profiles(picture: Picture, motion: RowMotion) -> Array:
    """Profiles (n, m) on GRID_PX across edges with little blur, 1 on a flat plateau, 0 at the minimum within reach.

    Each edge is analysed from both sides.
    """
    points, normals = find_edges(picture, EDGES)
    if not len(points):
        return np.zeros((0, len(GRID_PX)))
    path_px = np.abs((blur_chords(motion, points) * normals).sum(axis=1)) / np.sqrt(12)
    still = path_px < STILL_PX
    levels = parallel_profiles(picture, points[still], normals[still], ALONG_PX)
    return np.concatenate([_beside_plateau(levels), _beside_plateau(-levels[:, ::-1])])


def _beside_plateau(levels: Array) -> Array:
    """The profiles (n, m) on ALONG_PX that rise to a plateau, scaled, with their middle at 0."""
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
    return moved_profiles(part[centred], middle[centred], ALONG_PX, GRID_PX)


def _inner_width(profiles: Array) -> Array:
    """(n,) distance from the middle of an edge to where it has fallen to 0.16, away from the plateau."""
    inside = profiles[:, GRID_PX <= 0][:, ::-1]
    after = np.argmax(inside <= 0.16, axis=1)
    rows = np.arange(len(inside))
    above, below = inside[rows, after - 1], inside[rows, after]
    width = (after - (0.16 - below) / np.maximum(above - below, 1e-9)) * (GRID_PX[1] - GRID_PX[0])
    return np.where(after > 0, width, np.inf)


def _overshoot(profiles: Array, bare_std: float) -> tuple[float, float]:
    """Overshoot of profiles and its standard deviation; bare_std: that of unsharpened movies alone."""
    median = np.median(profiles, axis=0)
    at = int(np.argmax(np.where(GRID_PX > 0, median, 0.0)))
    crest = float(median[at])
    typical = robust_std(profiles[:, at] - crest)
    noise = MEDIAN_STD * typical / np.sqrt(len(profiles) / EDGES_PER_SAMPLE)
    return crest - 1, float(np.hypot(noise, bare_std))


def _fitted(mean: Array) -> Array:
    """Fitted edge width, amount, log radius, line width, contrast and middle; all but the edge width have priors."""
    starts = ([*START, width, 1.0, 0.0] for width in (2.0, 5.0))
    tries = [
        fit_edge(GRID_PX[FITTED], mean[FITTED], BARE_SHARPEST[1], (_USUAL, _SPREAD), start, _BOUNDS) for start in starts
    ]
    return np.asarray(min(tries, key=lambda found: float(found.cost)).x)


_USUAL = np.array([AMOUNT, np.log(RADIUS_PX), 4.0, 1.0, 0.0])
_SPREAD = np.array([AMOUNT_SPREAD, RADIUS_SPREAD, 3.0, 0.2, 0.2])
_BOUNDS = ([0.3, -0.5, np.log(0.5), 0.5, 0.5, -1.0], [3.0, 3.0, np.log(3.0), 20.0, 3.0, 1.0])
"""Prior means and standard deviations of amount, log radius, line width (px), contrast and middle; bounds of these and,
first, of the edge width."""


def _beside_line(theta: Array) -> Array:
    """z(u) on GRID_PX."""
    return edge_profile(GRID_PX, *theta)
