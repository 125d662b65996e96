"""Estimate the length of the blur paths in the frames relative to the predicted ones, once per capture at planning.

A wrong exposure scale, gyroscope scale, lens or stabiliser makes all paths too long or too short.  Tracked points give
only the motion from frame to frame and do not depend on the exposure.  A path s times as long has |K(s f)|² in place of
|K(f)|², so |G|² = |K|² S + N is fitted ring by ring for several s, with S and N free in each ring.  The evidence for s
is the likelihood of the spectra (Whittle 1953: −Σ (ln λ + |G|² / λ)) over that of no blur.  The evidence of frames with
different motion adds up; that of directional content in the scene does not.

Only the lowest frequencies are used, up to a third of all evidence.  Higher frequencies are affected by content that
the coder carries over from earlier frames, by the tone curve, and by the variation of the kernel over a tile.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Index
from virest.camera.response import ResponseCurve
from virest.image_formation.kernels import blur_chords, smooth_field
from virest.image_formation.row_motion import RowMotion
from virest.restoration.blurred import CLIPPED_LEVELS
from virest.restoration.statistics.records import ROUNDING_POWER
from virest.restoration.statistics.ring_fit import FIT_STEPS, RingCells
from virest.restoration.statistics.rings import RINGS, SIDE
from virest.restoration.statistics.tile_power import MANY_TILES, cut, light_in_grey_levels, passed_power, windowed_power

SCALES = np.geomspace(2**-2, 2**1.5, 15)
"""Path lengths to try, relative to the predicted ones."""
LONGEST = 2.2
"""Ignore larger scales: with little detail, or with content that no lens gives, the fit runs to the largest one tried.
"""
MOST_FRAMES = 16
"""Largest number of measured frames."""
MOST_TILES = 24
"""Spectra are kept of this many tiles per frame; the most blurred MANY_TILES of them are used."""
LEAST_PATH_PX = 1.5
"""Skip frames whose predicted median path is shorter."""
BEST_PATH_PX = SIDE / 5
"""Best path length, px: it cancels many frequencies and still fits into a tile."""
LEAST_FRAMES = 4
"""A bootstrap of n frames underestimates a standard deviation by √(1 − 1/n): by 13 % for four."""
EVIDENCE_FRACTION = 1 / 3
"""Fraction of all evidence, from the lowest frequency up, that is used."""
MODEL_STD = 0.1
"""Standard deviation of ln scale for correct profiles, from lenses, curves and paths that vary over a tile."""
STARVED_BITS = 0.1
"""Bits per pixel at which MODEL_STD is doubled: a coder then largely repeats earlier frames."""
MOST_CLIPPED = 0.002
"""Use tiles with a larger fraction of clipped light only if too few tiles have less."""
RESAMPLED = 60
"""Number of bootstrap samples of the frames."""
CERTAIN_SIGMA = 3.0
"""Above this many standard deviations the frames contradict a profile."""


@dataclass(frozen=True, slots=True)
class TilePowers:
    """Power spectra of some of a frame's tiles."""

    centres_px: Array
    """(n, 2) tile centres."""
    power: NDArray[np.float32]
    """(n, SIDE, SIDE / 2 - 1) |G|² of light scaled to grey levels."""


@dataclass(frozen=True, slots=True)
class PathScale:
    """Length of the blur paths in the frames, relative to the predicted ones."""

    scale: float
    std: float
    """Standard deviation of ln scale: the frames' scatter and MODEL_STD."""
    frames: int
    """Number of measured frames."""

    @property
    def contradicts(self) -> bool:
        """Whether the frames contradict the predicted lengths significantly."""
        return abs(np.log(self.scale)) > CERTAIN_SIGMA * self.std and self.scale < LONGEST

    def __str__(self) -> str:
        return f"{self.scale:.2f} ± {self.scale * self.std:.2f}"


def tile_powers(luma: NDArray[np.uint8], curve: ResponseCurve) -> TilePowers | None:
    """Power spectra, in light, of tiles spread over a frame's luma (height, width); None if it has less than a tile."""
    height, width = luma.shape
    if min(height, width) < SIDE:
        return None
    rows, columns = (np.linspace(0, length - SIDE, -(-length // SIDE)).astype(int) for length in (height, width))
    corners = np.stack(np.meshgrid(rows, columns, indexing="ij"), -1).reshape(-1, 2)
    corners = _least_clipped(luma, corners[:: -(-len(corners) // MOST_TILES)], curve)
    tiles = (cut(luma, (int(top), int(left))) for top, left in corners)
    power = [windowed_power(light_in_grey_levels(cv2.LUT(tile, curve.linear_table()), curve)) for tile in tiles]
    return TilePowers(corners[:, ::-1].astype(float) + (SIDE - 1) / 2, np.stack(power))


def path_scale(frames: Iterable[tuple[RowMotion, TilePowers]], bits_per_px: float = np.inf) -> PathScale | None:
    """Estimate the scale from frames with their predicted motion; None if fewer than LEAST_FRAMES are usable."""
    evidence = np.array([found for motion, tiles in frames if (found := _evidence(motion, tiles)) is not None])
    if len(evidence) < LEAST_FRAMES:
        return None
    best = _best(_low_ring_evidence(evidence.sum(axis=0)))
    rng = np.random.default_rng(len(evidence))
    drawn = rng.integers(0, len(evidence), (RESAMPLED, len(evidence)))
    scatter = float(np.std([_best(_low_ring_evidence(evidence[numbers].sum(axis=0))) for numbers in drawn]))
    starved = (STARVED_BITS / bits_per_px) ** 3
    return PathScale(float(np.exp(best)), float(np.hypot(scatter, MODEL_STD * (1 + starved))), len(evidence))


def log_lengths(frames: Iterable[tuple[RowMotion, TilePowers]]) -> Array:
    """Logarithm (frames,) of each frame's own path length over the predicted one; NaN: not measured.

    A frame alone measures it to MODEL_STD, or not at all where the scene has a direction.
    """
    seen = (_evidence(motion, tiles) for motion, tiles in frames)
    return np.array([np.nan if one is None else _best(_low_ring_evidence(one)) for one in seen])


def log_likelihood_of_lengths(lengths: Array) -> float:
    """Log likelihood of log lengths (n,) that share one factor, at the factor that fits best, up to a constant.

    Their errors are taken for Cauchy-distributed with a width of MODEL_STD.
    """
    off = (lengths[:, None] - lengths) / MODEL_STD
    return -float(np.log1p(off**2).sum(axis=0).min(initial=np.inf))


# ── parts ────────────────────────────────────────────────────────────────────────────────────────────────────────


def _least_clipped(luma: NDArray[np.uint8], corners: Index, curve: ResponseCurve) -> Index:
    """The tiles with little clipped light: the streak of a highlight has a spectrum of its own."""
    clipped = curve.clipped_table(CLIPPED_LEVELS)
    if not clipped[int(luma.max())]:
        return corners
    lost = cv2.LUT(luma, clipped.astype(np.uint8))
    parts = np.array([cut(lost, (int(top), int(left))).mean() for top, left in corners])
    return corners[parts <= max(MOST_CLIPPED, float(np.quantile(parts, 0.25)))]


def _evidence(motion: RowMotion, tiles: TilePowers) -> Array | None:
    """(scales, RINGS) log likelihood ratio to no blur; None if the paths are too short or too long."""
    length_px = np.linalg.norm(blur_chords(motion, tiles.centres_px), axis=-1)
    if np.median(length_px) < LEAST_PATH_PX:
        return None
    chosen = np.sort(np.argsort(-length_px, kind="stable")[:MANY_TILES])
    field, seen = smooth_field(motion)(tiles.centres_px[chosen]), tiles.power[chosen]
    if field.radius_px >= SIDE // 2:
        return None
    scaled = [field.scaled(scale) for scale in SCALES.tolist()]
    fitting = [k for k, one in enumerate(scaled) if one.radius_px < SIDE // 2]
    found = np.zeros((len(SCALES), RINGS))
    cells = [RingCells(np.stack([passed_power(kernel) for kernel in scaled[k].arrays()])) for k in fitting]
    if cells:
        found[fitting] = _ring_evidence(cells, seen)
    return found


def _ring_evidence(cells: Sequence[RingCells], seen: NDArray[np.float32]) -> Array:
    """(scales, RINGS) log likelihood ratio of |K|² S + N, with the best S and N, to constant power in the ring.

    cells: one per scale, of its |K|².
    """
    count, k, g = (np.stack(parts) for parts in zip(*((c.count, c.passed, c.means(seen)) for c in cells), strict=True))
    in_ring = np.maximum(count.sum(-1), 1)
    even = np.maximum((count * g).sum(-1) / in_ring, ROUNDING_POWER)
    mean_k = (count * k).sum(-1) / in_ring
    signal, noise = 0.9 * even / np.maximum(mean_k, 0.05), 0.1 * even
    products = np.stack([np.ones_like(k), k, k * k, g, k * g], -1)
    for _ in range(FIT_STEPS):
        expected = np.maximum(noise[..., None] + signal[..., None] * k, ROUNDING_POWER)
        w, wk, wkk, wg, wkg = np.moveaxis(((count / expected**2)[..., None, :] @ products)[..., 0, :], -1, 0)
        determinant = np.maximum(w * wkk - wk * wk, 1e-30)
        signal, noise = (w * wkg - wk * wg) / determinant, (wkk * wg - wk * wkg) / determinant
        signal = np.where(noise < 0, wkg / np.maximum(wkk, 1e-30), signal)
        noise = np.where(signal < 0, even, np.maximum(noise, 0))
        signal = np.maximum(signal, 0)
    expected = np.maximum(noise[..., None] + signal[..., None] * k, ROUNDING_POWER)
    flat = even[..., None]
    found = (count * (np.log(flat / expected) + g / flat - g / expected)).sum(-1)
    return np.asarray(np.maximum(found, 0.0))


def _low_ring_evidence(evidence: Array) -> Array:
    """(scales,) sum of the evidence (scales, RINGS) over the lowest rings that hold EVIDENCE_FRACTION of the total."""
    reached = np.cumsum(evidence.max(axis=0))
    last = int(np.searchsorted(reached, EVIDENCE_FRACTION * reached[-1]))
    return np.asarray(evidence[:, : last + 1].sum(axis=1))


def _best(evidence: Array) -> float:
    """Logarithm of the scale with the largest evidence (scales,), refined by a parabola through its neighbours."""
    i = int(np.argmax(evidence))
    step = 0.0
    if 0 < i < len(evidence) - 1:
        before, here, after = evidence[i - 1 : i + 2]
        bend = before - 2 * here + after
        step = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return float(np.interp(i + step, np.arange(len(SCALES)), np.log(SCALES)))


def frames_to_measure(numbers: Sequence[int], path_px: Array) -> tuple[int, ...]:
    """At most MOST_FRAMES frames, evenly spaced among the half whose paths are nearest to BEST_PATH_PX."""
    if not numbers:
        return ()
    off = np.abs(np.log(np.maximum(path_px, 1e-3) / BEST_PATH_PX))
    near = [n for n, distance in zip(numbers, off, strict=True) if distance <= np.median(off)]
    return tuple(near[:: -(-len(near) // MOST_FRAMES)])


def store_powers(
    pictures: Iterable[tuple[int, NDArray[np.uint8]]],
    wanted: Iterable[int],
    curve: ResponseCurve,
    into: dict[int, TilePowers],
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Pass (index, luma) pairs through, and store the spectra of the wanted ones in ``into``."""
    chosen = set(wanted)
    for index, luma in pictures:
        if index in chosen and (powers := tile_powers(luma, curve)) is not None:
            into[index] = powers
        yield index, luma
