"""Black, white and noise of each channel of a bracket, measured from the pictures alone.

A grey that does not change with more light is an end of the curve: black if dark, white if bright.  The channels of a
scanned film or of a picture with a colour cast end at different greys.  They are equalised first, since one curve
describes all three.

Noise is tabulated by grey and channel instead of modelled as sensor noise: a tone curve amplifies it in the shadows,
and an encoder smooths it away or rounds whole blocks alike.  Of two estimates the larger is used: the variance within
flat squares, which misses errors common to a square's pixels; and the scatter of one site's greys at many exposures
about a curve, which includes them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from virest.arrays import Array, Mask
from virest.inference.chance import chi2_below
from virest.inference.robust import MEDIAN_TO_STD

DARKEST_JUDGED, BRIGHTEST_JUDGED = 4.0, 251.0
"""Range of greys in which a square's noise is mostly unclipped; beyond it, noise is clipped at 0 or 255."""
BINS, MIN_SQUARES = 13, 15
"""Greys of the noise table, and fewest squares from which one is filled.  6 or 26 greys change three simulated curves
by 0.1 levels at most; 8 or 30 squares change none."""
FLAT_SHARE = 0.1
"""Quantile of the variance that represents the flattest squares."""
ROUNDING_LEVELS = 0.15
"""Lower limit on the standard deviation of a square's mean, since neighbouring pixels share rounding errors."""
SMALLEST_VARIANCE = 0.05
"""Of a pixel, levels²: rounding alone has 1 / 12, and an encoder may leave less."""
MORE_LIGHT = 2**0.4
"""Minimum exposure ratio of two pictures to test whether a grey follows the light."""
SAME_LEVELS = 0.75
"""Greys that differ by less are the same."""
PILE = 0.02
"""Minimum fraction of a channel's samples that must rest at a grey for it to be an end."""
DIFFER_LEVELS = 1.5
"""A conversion from YCbCr rounds the three channels to ends that differ by up to this."""
CUT_SIGMA = 3.0
"""Greys this many standard deviations of noise from 0 or 255 are clipped in 1 of 740 pixels at most."""
RELIABLE_SIGMA = 2.0
"""About 2.5 % of the reliable greys are moved beyond the limit by their noise."""
WINDOW_SITES = 31
"""Sites of similar brightness in a running median, which is accurate to a fifth of their scatter."""


@dataclass(frozen=True, slots=True)
class GreyNoise:
    """Variance of a sample's grey, by channel and grey."""

    greys: Array
    """(k,) levels, increasing."""
    variance: Array
    """(channels, k) levels²; linear between the greys, constant beyond them."""

    def at(self, grey: Array, channel: NDArray[np.int64]) -> Array:
        """Variance of greys (samples, ...) of channels (samples,)."""
        found = np.empty(grey.shape)
        for c in range(len(self.variance)):
            rows = channel == c
            found[rows] = np.interp(grey[rows], self.greys, self.variance[c])
        return found

    def at_least(self, other: Array) -> GreyNoise:
        """Maximum with variances (channels, k) at the same greys; NaN: unknown."""
        return replace(self, variance=np.fmax(self.variance, other))


def grey_bins() -> tuple[Array, Array]:
    """(edges, centres) of the grey bins of the noise table, narrower in the shadows."""
    edges = DARKEST_JUDGED + (BRIGHTEST_JUDGED - DARKEST_JUDGED) * np.linspace(0, 1, BINS) ** 1.5
    return edges, 0.5 * (edges[1:] + edges[:-1])


def pixel_noise(means: Array, variances: Array, pixels: int) -> GreyNoise:
    """Noise variance of a pixel, from the flattest squares of each channel and grey.

    means, variances: (channels, ...) of squares of ``pixels`` pixels.  Greys with too few squares, or with noise
    clipped at 0, are interpolated from their neighbours; a channel without any takes the mean of the others.
    """
    edges, middles = grey_bins()
    # FLAT_SHARE of the squares with pure noise have a sample variance below this multiple of the true variance
    quantile = chi2_below(FLAT_SHARE, pixels - 1) / (pixels - 1)
    table = np.full((len(means), len(middles)), np.nan)
    for c, (greys, variance) in enumerate(zip(means, variances, strict=True)):
        grey_bin = np.digitize(greys, edges) - 1
        for k in range(len(middles)):
            inside = variance[grey_bin == k]
            if len(inside) >= MIN_SQUARES:
                table[c, k] = np.quantile(inside, FLAT_SHARE) / quantile
        table[c, middles < CUT_SIGMA * np.sqrt(np.nan_to_num(table[c]))] = np.nan
    if np.isnan(table).all():
        table[:] = 1.0
    rows = np.flatnonzero(np.isfinite(table).any(axis=1))
    filled = np.full_like(table, np.nanmean(np.where(np.isfinite(table), table, np.nan)))
    for c in rows.tolist():
        known = np.isfinite(table[c])
        filled[c] = np.interp(middles, middles[known], table[c, known])
    return GreyNoise(middles, np.maximum(filled, SMALLEST_VARIANCE))


def mean_noise(noise: GreyNoise, pixels: int) -> GreyNoise:
    """Noise variance of a square's mean, from that of its pixels."""
    return replace(noise, variance=noise.variance / pixels + ROUNDING_LEVELS**2)


def scatter_by_grey(residual: Array, grey: Array, channel: NDArray[np.int64], used: Mask) -> Array:
    """Robust variance (channels, bins) of residuals by grey; NaN for bins with too few.

    residual, grey, used: (samples, pictures) levels.  Each sample's light was fitted to its n greys, which reduces the
    variance by a factor (n − 1) / n; this is corrected for.
    """
    edges, middles = grey_bins()
    count = used.sum(axis=1, keepdims=True)
    correction = np.sqrt(count / np.maximum(count - 1, 1))
    grey_bin = np.clip(np.digitize(grey, edges) - 1, 0, len(middles) - 1)
    found = np.full((int(channel.max()) + 1, len(middles)), np.nan)
    for c in range(len(found)):
        of_channel = used & (channel == c)[:, None] & (count > 1)
        for k in range(len(middles)):
            inside = of_channel & (grey_bin == k)
            if inside.sum() >= MIN_SQUARES:
                found[c, k] = (MEDIAN_TO_STD * np.median(np.abs((residual * correction)[inside]))) ** 2
    return found


def reliably_inside(grey: Array, light: Array, limits: tuple[Array, Array], sigma: Array) -> Mask:
    """Greys (samples, pictures) that lie between their limits because of their light and not of their noise.

    grey, sigma: (samples, pictures) levels and their standard deviation.  light: (samples, pictures) brightness of each
    sample according to the other pictures, on any increasing scale.  limits: (samples, 1) each.  Without this test, a
    picture so dark that only noise lifts some samples above the lower limit would seem brighter than it is.  The
    expected grey is the median of samples of similar brightness, which needs no curve.
    """
    low, high = limits
    reliable = np.zeros(grey.shape, bool)
    for n in range(grey.shape[1]):
        order = np.argsort(light[:, n], kind="stable")
        expected = np.empty(len(grey))
        expected[order] = median_filter(grey[order, n], size=min(WINDOW_SITES, len(grey)), mode="nearest")
        margin = RELIABLE_SIGMA * sigma[:, n]
        reliable[:, n] = (expected - margin > low[:, 0]) & (expected + margin < high[:, 0])
    return reliable


# ── ends of each channel ─────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class ChannelEnds:
    """Black and white of each channel, and the common levels to which channels are equalised."""

    black: Array
    """(channels,) grey levels."""
    white: Array
    """(channels,) grey levels."""

    @property
    def common(self) -> tuple[float, float]:
        """Mean black and white over the channels."""
        return float(self.black.mean()), float(self.white.mean())

    @property
    def differ(self) -> bool:
        """Whether the channels' ends differ by more than rounding can explain."""
        return bool(max(np.ptp(self.black), np.ptp(self.white)) > DIFFER_LEVELS)

    @property
    def rms_difference_levels(self) -> float:
        """RMS difference over channels and greys between a channel's curve and the common one."""
        low, high = self.common
        at = np.linspace(0.0, 1.0, 65)
        off = (self.black - low)[:, None] * (1.0 - at) + (self.white - high)[:, None] * at
        return float(np.sqrt(np.mean(off**2)))

    @property
    def gain(self) -> Array:
        """(channels,) factor on grey differences when the channels are equalised."""
        low, high = self.common
        return np.asarray((high - low) / (self.white - self.black))

    def equalised(self, means: Array) -> Array:
        """Map greys (channels, ...) to the common ends; clipped greys, at 0 and 255, are unchanged."""
        shape = (-1,) + (1,) * (means.ndim - 1)
        moved = self.common[0] + (means - self.black.reshape(shape)) * self.gain.reshape(shape)
        clipped = (means <= 0) | (means >= 255)
        return np.where(clipped, means, np.clip(moved, 0.5, 254.5))

    def describe(self) -> str:
        """Note for the user."""
        ends = (" ".join(f"{v:.1f}" for v in side) for side in (self.black, self.white))
        black, white = ends
        return (
            f"the channels end at different greys (black at {black}, white at {white} for R G B); the curve is that of "
            f"their mean, from which a channel lies {self.rms_difference_levels:.1f} levels rms"
        )


def channel_ends(means: Array, exposure: Array) -> ChannelEnds:
    """Greys at which each channel does not follow the light; 0 and 255 if there are none.

    means: (channels, pictures, sites) levels.  exposure: (pictures,) listed.
    """
    order = np.argsort(exposure, kind="stable")
    ratio = exposure[order[1:]] / exposure[order[:-1]]
    pairs = [(order[k], order[k + 1]) for k in range(len(ratio)) if ratio[k] >= MORE_LIGHT]
    ends = [_resting_greys(channel, pairs) for channel in means]
    black, white = (np.array(side, float) for side in zip(*ends, strict=True))
    # an end that only some channels show may also be that of the others: use the default for all
    black = black if np.isfinite(black).all() else np.zeros(len(means))
    white = white if np.isfinite(white).all() else np.full(len(means), 255.0)
    return ChannelEnds(black, white)


def _resting_greys(channel: Array, pairs: list[tuple[Any, Any]]) -> tuple[float, float]:
    """(dark, bright) grey at which sites of a channel (pictures, sites) rest while the light changes; NaN if none."""
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
        peak = int(np.argmax(np.convolve(counts, np.ones(3), "same")))
        found.append(float(part[np.abs(part - peak) <= 1.5].mean()))
    return found[0], found[1]
