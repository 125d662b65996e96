"""Sample an exposure bracket: grey levels of the same scene locations at every exposure.

Pictures are aligned by what exposure does not change, the rank of each pixel among the picture's grey levels (after
Ward 2003, "Fast, robust image registration for compositing high dynamic range photographs from hand-held exposures",
doi:10.1080/10867651.2003.10487583, whose median threshold bitmaps are one-bit ranks).  Samples are means over small
flat squares, spread over the picture and over its range of brightness.  Squares on edges are excluded, since there the
smallest misalignment looks like a change of light.  Black, white and noise are measured per channel (``grey_levels``);
otherwise the channels are pooled, since the camera profile has one curve.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Mask
from virest.calibration.grey_levels import CUT_SIGMA, ChannelEnds, GreyNoise, channel_ends, mean_noise, pixel_noise
from virest.errors import CalibrationError

MAX_SHIFT_PX = 8.0
"""Largest shift of a picture that is corrected."""
MIN_GAIN = 0.2
"""Minimum fraction of the squared difference between two pictures that a shift must remove to be accepted."""
RIGID_PX = 1.5
"""Maximum relative motion of the quarters of a picture."""
MAX_LEVEL_SHARE = 4 / 256
"""Fraction of the pixels at one grey level above which ranks are compressed."""
CANDIDATES, SITES = 9000, 900
"""Squares that are measured, and flat ones that are kept.  Half or twice as many change the curves of three simulated
brackets by 0.1 grey level at most, and that of a dark one coded as JPEG by 0.5, either way; twice the sites lower the
standard deviation by 3 %."""
MIN_SITES = 40
"""Fewest sites that determine a curve; three simulated brackets have more than 80."""
PILE = 0.02
"""Minimum fraction of samples within the noise of the darkest or brightest grey for that grey to be a clip level."""
ABOVE_PILE = 0.1
"""Greys brighter than a plateau are fewer than this fraction of those on it."""
MIN_SHARED = 25
"""Minimum samples unclipped in both of two pictures for their exposures to be compared."""


@dataclass(frozen=True, slots=True)
class BracketPicture:
    """One picture of the bracket."""

    file: str
    levels: NDArray[Any]
    """(h, w, 3), 0 to 255."""
    exposure: float
    """Listed exposure, in any unit common to the bracket."""


@dataclass(frozen=True)
class BracketSamples:
    """Greys of the same sites in every picture."""

    grey: Array
    """(samples, pictures), mean levels of small squares, 0 to 255."""
    site: NDArray[np.int64]
    """(samples,) site index; the channels of one site share it."""
    channel: NDArray[np.int64]
    """(samples,) 0, 1, 2."""
    exposure: Array
    """(pictures,) listed exposure."""
    lows: Array
    """(channels,) greys at or below are censored: black, or noise clipped at black."""
    highs: Array
    """(channels,) greys at or above are censored: clipped, or on the curve's plateau."""
    top: float
    """Brightest grey seen (robust)."""
    noise: GreyNoise
    """Noise of a sample."""
    shifts_px: Array
    """(pictures, 2) shift of the scene, right and down, relative to the first picture."""
    ends: ChannelEnds
    """Black and white of each channel, before the channels were equalised."""
    reliable: Mask | None = None
    """(samples, pictures) greys whose position between the limits is not decided by noise; None: not yet assessed."""

    @property
    def low(self) -> float:
        """Lower censoring limit of the darkest channel."""
        return float(self.lows.min())

    @property
    def high(self) -> float:
        """Upper censoring limit of the brightest channel."""
        return float(self.highs.max())

    @cached_property
    def limits(self) -> tuple[Array, Array]:
        """Censoring limits of each sample, (samples, 1) both."""
        return self.lows[self.channel][:, None], self.highs[self.channel][:, None]

    @cached_property
    def measured(self) -> Mask:
        """(samples, pictures): neither censored nor unreliable."""
        low, high = self.limits
        inside = (self.grey > low) & (self.grey < high)
        return inside if self.reliable is None else inside & self.reliable

    @cached_property
    def sigma(self) -> Array:
        """(samples, pictures) standard deviation of each grey."""
        return np.sqrt(self.noise.at(self.grey, self.channel))

    def take(self, rows: NDArray[Any]) -> BracketSamples:
        """Select samples."""
        reliable = None if self.reliable is None else self.reliable[rows]
        return replace(self, grey=self.grey[rows], site=self.site[rows], channel=self.channel[rows], reliable=reliable)

    def by_light(self) -> BracketSamples:
        """Sort from dark to bright, contiguous per picture: look-ups in sorted order are six times as fast."""
        ordered = self.take(np.argsort(self.grey.mean(axis=1)))
        return replace(ordered, grey=np.asfortranarray(ordered.grey))

    def without(self, picture: int) -> BracketSamples:
        """All samples, with those of one picture marked as not measured."""
        reliable = np.ones(self.grey.shape, bool) if self.reliable is None else self.reliable.copy()
        reliable[:, picture] = False
        return replace(self, reliable=reliable)

    def keep_pictures(self, keep: NDArray[Any]) -> BracketSamples:
        """Select pictures."""
        reliable = None if self.reliable is None else self.reliable[:, keep]
        grey, shifts_px = self.grey[:, keep], self.shifts_px[keep]
        return replace(self, grey=grey, exposure=self.exposure[keep], shifts_px=shifts_px, reliable=reliable)


def sample_bracket(pictures: Sequence[BracketPicture], rng: np.random.Generator) -> BracketSamples:
    """Align the pictures and sample them.

    Raises CalibrationError if they are shifted by more than MAX_SHIFT_PX or not rigidly, are too small, have too few
    flat sites that overlap in exposure, or are clipped throughout.
    """
    shifts_px = align_pictures(pictures)
    height, width = pictures[0].levels.shape[:2]
    half = 2 if height * width > 300_000 else 1
    centres = _candidates(height, width, half + int(np.ceil(np.abs(shifts_px).max())) + 1, rng)
    channels = 1 if _is_grey(pictures) else 3
    means, variances = _squares(pictures, centres, shifts_px, half, channels)
    exposure = np.array([p.exposure for p in pictures], np.float64)
    ends = channel_ends(means, exposure)
    if ends.differ:
        means, variances = ends.equalised(means), variances * (ends.gain**2)[:, None, None]
    pixels = (2 * half + 1) ** 2
    by_pixel = pixel_noise(means, variances, pixels)
    lows, highs, top = _limits(means, by_pixel)
    measured = (means > lows[:, None, None]) & (means < highs[:, None, None])
    if not measured.any(axis=1).any():
        text = f"all {len(pictures)} pictures are clipped throughout"
        raise CalibrationError(text, hint="take exposures at which the scene is neither black nor white")
    noise = mean_noise(by_pixel, pixels)
    keep = _flat_sites(means, variances, measured, noise, pixels)
    chosen = _spread_sites(means[:, :, keep], keep, rng)
    grey = means[:, :, chosen].transpose(2, 0, 1).reshape(-1, len(pictures))
    site = np.repeat(np.arange(len(chosen)), channels)
    channel = np.tile(np.arange(channels), len(chosen))
    samples = BracketSamples(grey, site, channel, exposure, lows, highs, top, noise, shifts_px, ends)
    seen = samples.measured.sum(axis=1) >= 2
    if len(np.unique(site[seen])) < MIN_SITES:
        text = f"only {len(np.unique(site[seen]))} flat areas are unclipped in two pictures, {MIN_SITES} are needed"
        raise CalibrationError(f"no overlap: {text}", hint="take exposures closer together, of a scene with flat areas")
    return samples.take(seen)


def _is_grey(pictures: Sequence[BracketPicture]) -> bool:
    part = pictures[len(pictures) // 2].levels[::7, ::7]
    return bool((part[..., 0] == part[..., 1]).all() and (part[..., 0] == part[..., 2]).all())


def _candidates(height: int, width: int, margin: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Candidate sites on a jittered grid, (n, 2), x y."""
    if min(height, width) < 2 * margin + 8:
        raise CalibrationError(f"pictures of {width}x{height} px are too small", hint="take larger ones")
    step = max(2.0 * (margin > 3) + 1.0, np.sqrt(height * width / CANDIDATES))
    grid = np.stack(np.meshgrid(np.arange(margin, width - margin, step), np.arange(margin, height - margin, step)), -1)
    sites = grid.reshape(-1, 2) + rng.uniform(0, step, (grid.shape[0] * grid.shape[1], 2))
    return np.clip(sites, margin, [width - margin - 1, height - margin - 1]).astype(np.int64)


def _squares(
    pictures: Sequence[BracketPicture], centres: NDArray[np.int64], shifts_px: Array, half: int, channels: int
) -> tuple[Array, Array]:
    """Mean and variance of the square around each site, (channels, pictures, sites).

    A square with any pixel at 0 or 255 gets the mean 0 or 255, so that it is censored.
    """
    span = np.arange(-half, half + 1)
    means = np.empty((channels, len(pictures), len(centres)))
    variances = np.empty_like(means)
    for n, picture in enumerate(pictures):
        x, y = (centres + np.rint(shifts_px[n]).astype(int)).T
        rows, columns = y[:, None, None] + span[:, None], x[:, None, None] + span[None, :]
        patch = picture.levels[rows, columns, :channels].astype(np.float32).reshape(len(centres), -1, channels)
        mean = np.where(patch.max(axis=1) >= 255, 255.0, patch.mean(axis=1))
        means[:, n] = np.where(patch.min(axis=1) <= 0, 0.0, mean).T
        variances[:, n] = patch.var(axis=1, ddof=1).T
    return means, variances


def _limits(means: Array, noise: GreyNoise) -> tuple[Array, Array, float]:
    """Censoring limits of each channel, and the brightest grey seen.

    means: (channels, pictures, sites).  noise: of a pixel.  Noise clipped at black biases means upwards, so greys
    within CUT_SIGMA of black are censored, and likewise near white.
    """
    bottom, top = (float(v) for v in np.quantile(means, [0.001, 0.999]))
    dark, bright = (CUT_SIGMA * np.sqrt(noise.variance[:, end]) for end in (0, -1))
    dark, bright = np.clip(dark, 2.0, 24.0), np.clip(bright, 2.0, 12.0)
    margin = float(np.clip(CUT_SIGMA * np.sqrt(np.median(noise.variance)), 2.0, 12.0))
    lows = np.array([bottom + m if np.mean(means < bottom + m) > PILE else bottom for m in dark])
    top = min(top, _plateau(means, margin))
    highs = np.array([top - m if np.mean(means > top - m) > PILE else top for m in bright])
    return np.maximum(lows, dark), np.minimum(highs, 255.0 - bright), top


def _plateau(means: Array, margin: float) -> float:
    """Grey level of the curve's upper plateau: a peak of the histogram with little above it; 255 if there is none.

    A curve may end below 255 while ringing of the codec at edges still reaches 255, so no quantile finds its end.
    """
    counts = np.bincount(np.rint(means).ravel().astype(np.int64), minlength=256)
    reach = int(np.ceil(margin))
    pile = np.convolve(counts, np.ones(2 * reach + 1), "same")
    peak = 128 + int(np.argmax(pile[128:]))
    little_above = counts[peak + reach + 1 :].sum() < ABOVE_PILE * pile[peak]
    if pile[peak] < PILE * means.size or not little_above:
        return 255.0
    return float(np.median(means[np.abs(means - peak) <= reach + 0.5]))


def _flat_sites(means: Array, variances: Array, measured: Mask, noise: GreyNoise, pixels: int) -> NDArray[np.int64]:
    """Index of the flatter half of the sites, and of all with at most twice the noise variance.

    Flatness is the largest ratio of variance to expected noise over the greys that are not clipped.
    """
    expected = pixels * noise.at(means, np.arange(len(means)))
    excess = np.where(measured, variances / expected, 0.0).max(axis=(0, 1))
    seen = np.flatnonzero((measured.sum(axis=1) >= 2).any(axis=0))
    if not len(seen):
        text = "no area is unclipped in two pictures"
        raise CalibrationError(f"no overlap: {text}", hint="take exposures closer together, at most 3 EV apart")
    return seen[excess[seen] <= max(np.quantile(excess[seen], 0.5), 2.0)]


def _spread_sites(means: Array, keep: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.int64]:
    """Choose up to SITES sites, as evenly as possible over 24 classes of brightness."""
    brightness = means.mean(axis=(0, 1))
    edges = np.linspace(brightness.min(), brightness.max() + 1e-6, 25)
    classes = np.digitize(brightness, edges)
    order = rng.permutation(len(keep))
    rank = np.empty(len(keep), np.int64)
    for number in np.unique(classes):
        members = order[classes[order] == number]
        rank[members] = np.arange(len(members))
    return np.sort(keep[np.argsort(rank, kind="stable")[:SITES]])


# ── alignment ────────────────────────────────────────────────────────────────────────────────────────────────────


def align_pictures(pictures: Sequence[BracketPicture]) -> Array:
    """Shift (pictures, 2) of each picture's scene, right and down, relative to the first picture, in pixels.

    Neighbours in exposure are compared by rank within the greys that neither clips; a shift is accepted if it explains
    the difference.  Raises CalibrationError beyond MAX_SHIFT_PX from the median, and if parts of a picture move
    differently.
    """
    order = np.argsort([p.exposure for p in pictures], kind="stable")
    shifts = np.zeros((len(pictures), 2))
    step = 2 if pictures[0].levels.shape[0] * pictures[0].levels.shape[1] > 500_000 else 1
    green = [_small_green(pictures[i].levels, step) for i in order]
    for n in range(1, len(order)):
        shift = step * _shift_between(green[n - 1], green[n], pictures[order[n - 1]].file, pictures[order[n]].file)
        shifts[order[n]] = shifts[order[n - 1]] + shift
    shifts -= shifts[0]
    furthest = int(np.argmax(np.hypot(*(shifts - np.median(shifts, axis=0)).T)))
    _require_small(float(np.hypot(*(shifts[furthest] - np.median(shifts, axis=0)))), pictures[furthest].file)
    return shifts


def _require_small(size_px: float, file: str) -> None:
    if size_px > MAX_SHIFT_PX:
        raise CalibrationError(
            f"{file} is shifted by {size_px:.1f} px against the others, at most {MAX_SHIFT_PX:g} px can be corrected",
            hint="take the bracket from a tripod",
        )


def _small_green(levels: NDArray[Any], step: int) -> NDArray[Any]:
    green = np.ascontiguousarray(levels[..., 1])
    if step > 1:
        height, width = green.shape[0] // step, green.shape[1] // step
        green = cv2.resize(green[: height * step, : width * step], (width, height), interpolation=cv2.INTER_AREA)
    return np.rint(cv2.GaussianBlur(green, (0, 0), 1.0)).astype(np.uint8)


def _shift_between(first: NDArray[Any], second: NDArray[Any], first_name: str, second_name: str) -> Array:
    """Shift (x, y) of the second picture relative to the first, in their pixels; zero without usable structure.

    Raises CalibrationError if quarters of the picture move relative to each other: a quarter's own shift counts if it
    explains much of the difference that the common shift leaves.
    """
    pair = _common_ranks(first, second)
    if pair is None:
        return np.zeros(2)
    shift, gain = _tested_shift(*pair)
    shift = shift if gain >= MIN_GAIN else np.zeros(2)
    aligned = pair[0], _moved(pair[1], shift)
    parts = [_tested_shift(*(rank[part] for rank in aligned)) for part in _quarters(first.shape)]
    clear = np.array([np.zeros(2), *(part for part, part_gain in parts if part_gain > 1.5 * MIN_GAIN)])
    apart_px = float(np.hypot(*np.ptp(clear, axis=0)))
    if apart_px > RIGID_PX:
        raise CalibrationError(
            f"between {first_name} and {second_name} parts of the picture move by {apart_px:.1f} px against each other",
            hint="a turn, a near object or a moving scene; take the bracket of a still scene from a tripod",
        )
    return shift


def _quarters(shape: tuple[int, ...]) -> list[tuple[slice, slice]]:
    y, x = shape[0] // 2, shape[1] // 2
    return [(rows, columns) for rows in (slice(0, y), slice(y, 2 * y)) for columns in (slice(0, x), slice(x, 2 * x))]


def _common_ranks(first: NDArray[Any], second: NDArray[Any]) -> tuple[Any, Any] | None:
    """Both pictures as ranks in [0, 1], limited to the range that neither clips; None if less than 5 % remains.

    Ranks spread the noise of a flat area over the same fraction of [0, 1] as the area occupies of the picture.  Ranks
    are therefore compressed where one grey level holds more than MAX_LEVEL_SHARE of the pixels.
    """
    shares = [np.cumsum(np.bincount(p.ravel(), minlength=256)) / p.size for p in (first, second)]
    low = max(share[min(int(np.searchsorted(share, 0.001)) + 4, 255)] for share in shares)
    high = min(share[max(int(np.searchsorted(share, 0.999)) - 6, 0)] for share in shares)
    if high - low < 0.05:
        return None
    rank = np.linspace(low, high, 512)
    # one mapping of rank for both pictures: ranks compressed in either are compressed in both
    crowd = np.max([np.diff(share, prepend=0.0)[np.searchsorted(share, rank).clip(0, 255)] for share in shares], axis=0)
    value = np.cumsum(np.minimum(1.0, MAX_LEVEL_SHARE / np.maximum(crowd, 1e-9)))
    value = (value - value[0]) / (value[-1] - value[0])
    ranks = []
    for picture, share in zip((first, second), shares, strict=True):
        middle = share - 0.5 * np.diff(share, prepend=0.0)
        ranks.append(np.interp(middle, rank, value).astype(np.float32)[picture])
    return ranks[0], ranks[1]


def _moved(picture: Any, shift: Array) -> Any:
    """Move the picture's content back by a shift (x, y), replicating the border."""
    return cv2.warpAffine(picture, np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32), picture.shape[::-1],
                          flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE)  # fmt: skip


def _tested_shift(first: Any, second: Any) -> tuple[Array, float]:
    """Shift (x, y) by phase correlation, and the fraction of the squared difference that it removes."""
    size = (first.shape[1], first.shape[0])
    (dx, dy), _ = cv2.phaseCorrelate(first, second, cv2.createHanningWindow(size, cv2.CV_32F))
    margin = int(min(np.ceil(max(abs(dx), abs(dy))) + 1, min(first.shape) // 3))
    inner = (slice(margin, -margin), slice(margin, -margin))
    moved = _moved(second, np.array([dx, dy]))
    before = float(np.mean((first - second)[inner] ** 2))
    after = float(np.mean((first - moved)[inner] ** 2))
    return np.array([dx, dy]), 1.0 - after / before if before > 0 else 0.0
