"""Black, white and noise of each channel of a bracket, measured from the pictures alone.

A grey that more light does not change is an end of the curve: black where it is dark, white where it is bright.  The
channels of a scanned film or of a picture with a colour cast end at different greys; those are brought to common ends
first, since one curve stands for all three.

Noise goes by grey and by channel, as a table and not as a law of sensors: a tone curve lifts the noise of the dark, an
encoder smooths it away or rounds whole blocks alike.  Two witnesses, of which the larger counts: the spread within flat
squares, which does not see what a square's pixels share; and how far the greys of one place at many exposures lie from
any one curve, which does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.stats import chi2

from virest.inference.robust import MEDIAN_TO_STD

Array = NDArray[np.float64]
DARKEST_JUDGED, BRIGHTEST_JUDGED = 4.0, 251.0
"""Greys between which the noise of a square is that of its light, mostly: beyond, it is cut off at 0 or 255."""
BINS = 13
FEW_SQUARES = 15
FLAT_SHARE = 0.1
ROUNDING_LEVELS = 0.15
"""Neighbours share the rounding of their levels: no mean of a square is more precise."""
SMALLEST_VARIANCE, LARGEST_VARIANCE = 0.05, 400.0
MORE_LIGHT = 2**0.4
"""Between two pictures, for a grey to show that it does not follow the light."""
SAME_LEVELS = 0.75
PILE = 0.02
"""Share of a channel's samples that rest at an end, for it to be one."""
APART_LEVELS = 1.5
"""A conversion from YCbCr rounds three channels apart by up to this."""
CUT_SIGMA = 3.0
FAIR_SIGMA = 2.0
"""A fortieth of the greys that are fairly inside fall beyond the limit by their noise."""
ALIKE = 31
"""Places of about one brightness, whose median is good to a fifth of their scatter."""


@dataclass(frozen=True, slots=True)
class GreyNoise:
    """Variance of a sample's grey, by channel and grey."""

    greys: Array
    """(k,) levels, rising."""
    variance: Array
    """(channels, k) levels squared; straight between the greys, held beyond them."""

    def at(self, grey: Array, channel: NDArray[np.int64]) -> Array:
        """Variance of greys (samples, ...) of channels (samples,)."""
        found = np.empty(grey.shape)
        for c in range(len(self.variance)):
            rows = channel == c
            found[rows] = np.interp(grey[rows], self.greys, self.variance[c])
        return found

    def at_least(self, other: Array) -> GreyNoise:
        """The larger of this and of variances (channels, k) at the same greys; NaN: not known."""
        return replace(self, variance=np.fmax(self.variance, other))


def grey_bins() -> tuple[Array, Array]:
    """(edges, middles) of the greys at which noise is told, closer where it is dark."""
    edges = DARKEST_JUDGED + (BRIGHTEST_JUDGED - DARKEST_JUDGED) * np.linspace(0, 1, BINS) ** 1.5
    return edges, 0.5 * (edges[1:] + edges[:-1])


def pixel_noise(means: Array, variances: Array, pixels: int) -> GreyNoise:
    """Variance of a pixel, from the flattest squares of each channel and grey.

    means, variances: (channels, ...) of squares of ``pixels`` pixels.  Greys with too few squares take their
    neighbours' noise, a channel with none the others'; so do greys whose noise is cut off at 0.
    """
    edges, middles = grey_bins()
    # of squares that hold nothing but noise, this share has a smaller variance than chance x the true one
    chance = float(chi2.ppf(FLAT_SHARE, pixels - 1)) / (pixels - 1)
    table = np.full((len(means), len(middles)), np.nan)
    for c, (greys, spread) in enumerate(zip(means, variances, strict=True)):
        place = np.digitize(greys, edges) - 1
        for k in range(len(middles)):
            inside = spread[place == k]
            if len(inside) >= FEW_SQUARES:
                table[c, k] = np.quantile(inside, FLAT_SHARE) / chance
        table[c, middles < CUT_SIGMA * np.sqrt(np.nan_to_num(table[c]))] = np.nan
    if np.isnan(table).all():
        table[:] = 1.0
    rows = np.flatnonzero(np.isfinite(table).any(axis=1))
    filled = np.full_like(table, np.nanmean(np.where(np.isfinite(table), table, np.nan)))
    for c in rows.tolist():
        known = np.isfinite(table[c])
        filled[c] = np.interp(middles, middles[known], table[c, known])
    return GreyNoise(middles, np.clip(filled, SMALLEST_VARIANCE, LARGEST_VARIANCE))


def of_means(noise: GreyNoise, pixels: int) -> GreyNoise:
    """Variance of a square's mean, from that of its pixels."""
    return replace(noise, variance=noise.variance / pixels + ROUNDING_LEVELS**2)


def scatter_by_grey(residual: Array, grey: Array, channel: NDArray[np.int64], used: NDArray[np.bool_]) -> Array:
    """(channels, bins) variance of residuals by grey, robustly; NaN where there are few.

    residual, grey, used: (samples, pictures) levels.  Each sample's light was fitted to its n greys, which takes one
    part in n of the variance away.
    """
    edges, middles = grey_bins()
    seen = used.sum(axis=1, keepdims=True)
    free = np.sqrt(seen / np.maximum(seen - 1, 1))
    place = np.clip(np.digitize(grey, edges) - 1, 0, len(middles) - 1)
    found = np.full((int(channel.max()) + 1, len(middles)), np.nan)
    for c in range(len(found)):
        of_channel = used & (channel == c)[:, None] & (seen > 1)
        for k in range(len(middles)):
            inside = of_channel & (place == k)
            if inside.sum() >= FEW_SQUARES:
                found[c, k] = (MEDIAN_TO_STD * np.median(np.abs((residual * free)[inside]))) ** 2
    return found


def fairly_inside(grey: Array, light: Array, limits: tuple[Array, Array], sigma: Array) -> NDArray[np.bool_]:
    """Where a grey lies between its limits by its light, and not by its noise, (samples, pictures).

    grey, sigma: (samples, pictures) levels and their deviation; light: (samples, pictures) how bright each place is by
    the other pictures, in any rising measure; limits: (samples, 1) each.  A picture so dark that only noise lifts some
    places above the lower limit would else seem brighter than it is.  What a light gives is the median grey of the
    places that are about as bright: that needs no curve.
    """
    low, high = limits
    fair = np.zeros(grey.shape, bool)
    for n in range(grey.shape[1]):
        order = np.argsort(light[:, n], kind="stable")
        usual = np.empty(len(grey))
        usual[order] = median_filter(grey[order, n], size=min(ALIKE, len(grey)), mode="nearest")
        margin = FAIR_SIGMA * sigma[:, n]
        fair[:, n] = (usual - margin > low[:, 0]) & (usual + margin < high[:, 0])
    return fair


# ── ends of each channel ─────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class ChannelEnds:
    """Black and white of each channel, and the common ones that they are brought to."""

    black: Array
    """(channels,) grey levels."""
    white: Array

    @property
    def common(self) -> tuple[float, float]:
        """Black and white of the picture as a whole."""
        return float(self.black.mean()), float(self.white.mean())

    @property
    def apart(self) -> bool:
        """Whether the channels end at greys that rounding cannot make different."""
        return bool(max(np.ptp(self.black), np.ptp(self.white)) > APART_LEVELS)

    @property
    def spread_levels(self) -> float:
        """Rms over channels and greys of how far a channel's curve lies from the common one."""
        low, high = self.common
        at = np.linspace(0.0, 1.0, 65)
        off = (self.black - low)[:, None] * (1.0 - at) + (self.white - high)[:, None] * at
        return float(np.sqrt(np.mean(off**2)))

    @property
    def gain(self) -> Array:
        """(channels,) by which a difference of greys grows where the ends become the common ones."""
        low, high = self.common
        return np.asarray((high - low) / (self.white - self.black))

    def levelled(self, means: Array) -> Array:
        """Greys (channels, ...) with the common ends; clipped ones, at 0 and 255, stay."""
        shape = (-1,) + (1,) * (means.ndim - 1)
        moved = self.common[0] + (means - self.black.reshape(shape)) * self.gain.reshape(shape)
        clipped = (means <= 0) | (means >= 255)
        return np.where(clipped, means, np.clip(moved, 0.5, 254.5))

    def describe(self) -> str:
        """For people."""
        ends = (" ".join(f"{v:.1f}" for v in side) for side in (self.black, self.white))
        black, white = ends
        return (
            f"the channels end at different greys (black at {black}, white at {white} for R G B); the curve is that of "
            f"their mean, from which a channel lies {self.spread_levels:.1f} levels rms"
        )


def channel_ends(means: Array, exposure: Array) -> ChannelEnds:
    """Where each channel's greys rest although the light changes; 0 and 255 where none do.

    means: (channels, pictures, places) levels; exposure: (pictures,) listed.
    """
    order = np.argsort(exposure, kind="stable")
    ratio = exposure[order[1:]] / exposure[order[:-1]]
    pairs = [(order[k], order[k + 1]) for k in range(len(ratio)) if ratio[k] >= MORE_LIGHT]
    ends = [_resting_greys(channel, pairs) for channel in means]
    black, white = (np.array(side, float) for side in zip(*ends, strict=True))
    # an end that only some channels show may be the others' too
    black = black if np.isfinite(black).all() else np.zeros(len(means))
    white = white if np.isfinite(white).all() else np.full(len(means), 255.0)
    return ChannelEnds(black, white)


def _resting_greys(channel: Array, pairs: list[tuple[Any, Any]]) -> tuple[float, float]:
    """(dark, bright) grey at which places of a channel (pictures, places) rest; NaN: none does."""
    if not pairs:
        return np.nan, np.nan
    darker, brighter = channel[[p[0] for p in pairs]], channel[[p[1] for p in pairs]]
    resting = 0.5 * (darker + brighter)[np.abs(brighter - darker) < SAME_LEVELS]
    found = []
    for part in (resting[resting < 128], resting[resting >= 128]):
        if len(part) < PILE * darker.size:
            found.append(np.nan)
            continue
        counts = np.bincount(np.rint(part).astype(np.int64), minlength=256)
        place = int(np.argmax(np.convolve(counts, np.ones(3), "same")))
        found.append(float(part[np.abs(part - place) <= 1.5].mean()))
    return found[0], found[1]
