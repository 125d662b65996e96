"""Relative blur: the same patch of the scene in two frames, as ratios of its power spectra (forward_model, section 9).

In linear light a tile's power is |K|² |lens|² |scene|² plus a noise floor.  In the ratio of two frames that show the
same patch the scene, the lens and defocus cancel: log P1/P2 = log |K1|²/|K2|².  The ratio depends on motion alone; it
needs neither edges nor a prior of the scene, only frames with unequal motion.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Index, Mask, Picture
from virest.camera.response import ResponseCurve
from virest.capture.records import Frame
from virest.restoration.statistics.tile_power import white_noise

SIDE_PX = 64
"""Side of a tile: 64 px resolve the lowest ring, 0.055 cycles per pixel, by 3.5 frequencies."""
MEMORY = 3
"""Number of frames whose blur a decoded frame may show: its own and, through H.264's prediction, those before it."""
SPACING_PX = 48
"""Of the tiles, which overlap by a quarter."""
BANDS_PER_PX = (0.055, 0.08, 0.11)
"""Bounds of the frequency rings, cycles per pixel: above the window's own width, below what H.264 quantises away."""
SECTORS = 6
"""Directions in which a ring is divided, 30° each."""
SCENE_POWER = 2.5
"""Exponent with which a scene's power falls with frequency: 2 for natural texture, 3 for edges."""
MAX_BACK_PX = 0.3
"""Drop a tile whose centre, tracked forth and back, returns with a larger error than this."""
MIN_FLOOR_LEVELS = 2.0
"""Minimum noise of a decoded frame, grey levels: quantisation adds more than smooth regions show."""
SIGNAL_TO_FLOOR = 8.0
"""Minimum ratio of a bin's power, averaged over both frames, to the noise floor."""


@dataclass(frozen=True, slots=True)
class SpectrumRatios:
    """One row per tile seen in two frames; (…, 2) holds the first and the second frame."""

    stamp_s: Array
    """(n, 2, MEMORY) camera clock, of the frame itself and of those before it, newest first."""
    exposure_s: Array
    """(n, 2, MEMORY) as logged, of the same frames."""
    points_px: Array
    """(n, 2, 2) centre of the tile."""
    log_ratio: Array
    """(n, b) log of first over second power, in each ring and sector of :func:`bins`; NaN where noise dominates."""

    def __len__(self) -> int:
        return len(self.points_px)


@lru_cache(maxsize=1)
def bins() -> tuple[Array, Index, Index]:
    """(frequencies (m, 2) inside the rings, cycles per pixel; their indices in the flat spectrum; bins (m,))."""
    fx, fy = np.meshgrid(np.fft.rfftfreq(SIDE_PX), np.fft.fftfreq(SIDE_PX))
    radius = np.hypot(fx, fy)
    half_plane = (fx > 0) | (fy > 0)
    place = np.flatnonzero((radius >= BANDS_PER_PX[0]) & (radius < BANDS_PER_PX[-1]) & half_plane)
    frequency = np.stack([fx.ravel()[place], fy.ravel()[place]], -1)
    ring = np.searchsorted(BANDS_PER_PX, radius.ravel()[place], side="right") - 1
    angle = np.arctan2(frequency[:, 1], frequency[:, 0]) % np.pi
    sector = np.minimum((angle / np.pi * SECTORS).astype(np.intp), SECTORS - 1)
    return frequency, place, ring * SECTORS + sector


def bin_count() -> int:
    """Number of bins: rings × sectors."""
    return (len(BANDS_PER_PX) - 1) * SECTORS


def mean_in_bins(values: Array) -> Array:
    """Mean over the frequencies of each bin: (n, m) -> (n, b)."""
    _, _, which = bins()
    member = (which[:, None] == np.arange(bin_count())).astype(float)
    return values @ (member / np.maximum(member.sum(axis=0), 1.0))


@lru_cache(maxsize=1)
def spectral_weights() -> tuple[Array, Array]:
    """(frequencies (k, 2), weight (k, b) of the transfer |K|² at each in the power of each bin).

    A Hann window mixes neighbouring frequencies by 1/6, 2/3, 1/6 along each axis, and a scene is stronger at the lower
    ones (power f^-SCENE_POWER), so a bin shows less blur than its own frequencies undergo.
    """
    frequency, _, which = bins()
    steps = np.rint(frequency * SIDE_PX).astype(np.intp)
    near = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), -1).reshape(-1, 2)
    share = np.array([1 / 6, 2 / 3, 1 / 6])[near + 1].prod(axis=1)
    around = (steps[:, None] + near).reshape(-1, 2)
    unique, place = np.unique(around, axis=0, return_inverse=True)
    radius = np.maximum(np.linalg.norm(unique, axis=-1), 1.0)
    weights = np.zeros((len(unique), bin_count()))
    np.add.at(weights, (place.ravel(), np.repeat(which, len(near))), np.tile(share, len(steps)))
    weights *= (radius**-SCENE_POWER)[:, None]
    return unique / SIDE_PX, weights / weights.sum(axis=0)


def ring_of_bin() -> Index:
    """(b,) ring of each bin."""
    return np.arange(bin_count()) // SECTORS


@dataclass(frozen=True, slots=True)
class SeenFrame:
    """The picture of a frame, with the metadata of the frame and of the MEMORY − 1 before it."""

    picture: Picture
    recent: tuple[Frame, ...]
    """Newest first; a frame without known times, or before the movie, is replaced by the next one."""


def observe_pair(
    first: SeenFrame, second: SeenFrame, curve: ResponseCurve, predicted: Callable[[Array], Array] | None = None
) -> SpectrumRatios:
    """Spectrum ratios of the tiles that can be tracked from one frame to the other.

    predicted: where points (n, 2) of the first frame are expected in the second; None: near the same place.
    """
    picture_1, picture_2 = first.picture, second.picture
    start, moved = _tracked_tiles(picture_1, picture_2, predicted)
    table, slope = curve.linear_table(), curve.slope_table()
    clipped = curve.clipped_table(1.5)
    power_1, grey_1, bad_1 = _tile_powers(picture_1, start, table, clipped)
    power_2, _, bad_2 = _tile_powers(picture_2, moved, table, clipped)
    noise_levels = max(MIN_FLOOR_LEVELS, white_noise(picture_1), white_noise(picture_2))
    floor = (noise_levels / slope[np.clip(grey_1, 0, 255).astype(np.intp)]) ** 2 * float((_window() ** 2).sum())
    strong = 0.5 * (power_1 + power_2) > SIGNAL_TO_FLOOR * floor[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(strong, np.log(power_1) - np.log(power_2), np.nan)
    keep = ~bad_1 & ~bad_2 & strong.any(axis=1)
    both = np.ones((int(keep.sum()), 1, 1))
    logs = (first.recent, second.recent)
    return SpectrumRatios(
        stamp_s=both * [[f.time_s for f in recent] for recent in logs],
        exposure_s=both * [[f.exposure_s or 0.0 for f in recent] for recent in logs],
        points_px=np.stack([start, moved], 1)[keep],
        log_ratio=ratio[keep],
    )


def join_ratios(parts: Iterable[SpectrumRatios]) -> SpectrumRatios:
    """Concatenate the rows of several pairs."""
    parts = list(parts)
    if not parts:
        logs = np.zeros((0, 2, MEMORY))
        return SpectrumRatios(logs, logs, np.zeros((0, 2, 2)), np.zeros((0, bin_count())))
    return SpectrumRatios(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(SpectrumRatios)))


def _tracked_tiles(first: Picture, second: Picture, predicted: Callable[[Array], Array] | None) -> tuple[Array, Array]:
    """Whole-pixel centres (n, 2) of tiles in both frames, tracked forth and back."""
    height, width = first.shape
    reach = SIDE_PX // 2
    x, y = np.meshgrid(
        np.arange(reach, width - reach + 1, SPACING_PX), np.arange(reach, height - reach + 1, SPACING_PX)
    )
    start = np.stack([x, y], -1).reshape(-1, 1, 2).astype(np.float32)
    near = start if predicted is None else predicted(start[:, 0].astype(float))[:, None].astype(np.float32)
    ahead, found = _followed(first, second, start, near)
    back, returned = _followed(second, first, ahead, start if predicted is not None else ahead)
    moved = np.rint(ahead[:, 0])
    good = (
        (found.ravel() == 1)
        & (returned.ravel() == 1)
        & (np.abs(back - start).max(axis=(1, 2), initial=0.0) < MAX_BACK_PX)
    )
    good &= (moved >= reach).all(axis=1) & (moved[:, 0] <= width - reach) & (moved[:, 1] <= height - reach)
    return start[good, 0].astype(float), moved[good].astype(float)


def _followed(
    first: Picture, second: Picture, points: NDArray[np.float32], near: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Places (n, 1, 2) of points in the second picture, searched from ``near``, and whether each was found."""
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    ahead, found, _ = cv2.calcOpticalFlowPyrLK(
        first, second, points, near.copy(), winSize=(31, 31), maxLevel=4, flags=flags
    )
    return np.asarray(ahead, np.float32), np.asarray(found, np.uint8)


def _tile_powers(
    picture: Picture, middles: Array, table: NDArray[np.float32], clipped: Mask
) -> tuple[Array, Array, Mask]:
    """(power (n, b) in linear light, mean grey (n,), mask of the tiles with clipped light)."""
    reach = SIDE_PX // 2
    cuts = [picture[int(y) - reach : int(y) + reach, int(x) - reach : int(x) + reach] for x, y in middles]
    tiles = np.stack(cuts) if cuts else np.zeros((0, SIDE_PX, SIDE_PX), np.uint8)
    window = _window()
    light = table[tiles].astype(float)
    level = (light * window).sum(axis=(1, 2), keepdims=True) / window.sum()
    spectrum = np.fft.rfft2((light - level) * window).reshape(len(tiles), SIDE_PX * (SIDE_PX // 2 + 1))
    _, place, _ = bins()
    powers = mean_in_bins(np.abs(spectrum[:, place]) ** 2)
    return powers, tiles.mean(axis=(1, 2)), clipped[tiles].mean(axis=(1, 2)) > 1e-3


@lru_cache(maxsize=1)
def _window() -> Array:
    ramp = np.hanning(SIDE_PX + 2)[1:-1]
    return np.outer(ramp, ramp)
