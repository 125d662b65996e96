"""How long the blur paths are that the pictures show, beside the predicted ones: asked once a capture, at planning.

A wrong exposure scale, gyroscope scale, lens or stabiliser makes all paths too long or too short; tracked points, which
know the way from frame to frame only, do not see the exposure at all.  A path that is s times as long has |K(s f)|² for
|K(f)|², so |G|² = |K|² S + N is fitted ring by ring for several s, S and N free in each, and the likelihood of the
spectra (Whittle 1953: −Σ (ln λ + |G|² / λ)) over that of no blur is the evidence for s.  Frames that move differently
before one scene add up; a scene's own directions do not.

The lowest frequencies that tell anything are believed, up to a third of all evidence: higher up a picture holds what
its coder kept of the frames before, and what the curve and the change of the kernel over a tile filled in.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.camera.response import ResponseCurve
from virest.image_formation.kernels import blur_chords, smooth_field
from virest.image_formation.row_motion import RowMotion
from virest.restoration.blurred import CLIPPED_LEVELS
from virest.restoration.statistics.records import ROUNDING_POWER
from virest.restoration.statistics.ring_fit import RingCells
from virest.restoration.statistics.rings import RINGS, SIDE
from virest.restoration.statistics.tile_power import MANY_TILES, cut, evenly_steep, passed_power, windowed_power

Array = NDArray[np.float64]

SCALES = np.geomspace(2**-2, 2**1.5, 15)
"""Path lengths over the predicted ones that are tried."""
LONGEST = 2.2
"""Longer ones are no estimate: pictures with little detail, or such as no lens gives, go on to the last one tried."""
MOST_FRAMES = 16
"""Number of frames that are measured."""
MOST_TILES = 24
"""Tiles of a frame of which spectra are kept; the most blurred MANY_TILES of them are used."""
LEAST_PATH_PX = 1.5
"""Frames whose median path is predicted shorter tell too little."""
BEST_PATH_PX = SIDE / 5
"""A path that fits into a tile so often cancels much and is seen whole: frames with about such paths are looked at."""
LEAST_FRAMES = 4
BELIEVED = 1 / 3
"""Part of all evidence, from the lowest frequency on, that is believed."""
MODEL_STD = 0.1
"""How far, in the logarithm, right profiles are off: lenses, curves and paths that change over a tile."""
STARVED_BITS = 0.1
"""Bits a pixel below which a coder repeats the frames before: the scale is known half as well."""
MOST_CLIPPED = 0.002
"""Tiles with a larger part of clipped light are taken only where there are none better."""
RESAMPLED = 60
SURE = 3.0
"""Above this many standard deviations the frames contradict a profile."""
_FIT_STEPS = 6
_TINY = 1e-30


@dataclass(frozen=True, slots=True)
class TilePowers:
    """Spectra of some of a frame's tiles."""

    centres_px: Array
    """(n, 2)."""
    power: NDArray[np.float32]
    """(n, SIDE, SIDE / 2 - 1) |G|² of light in grey levels."""


@dataclass(frozen=True, slots=True)
class PathScale:
    """How many times as long as predicted the blur paths are by the pictures."""

    scale: float
    std: float
    """Of its logarithm: scatter of the frames, and what right profiles are off by."""
    frames: int

    @property
    def contradicts(self) -> bool:
        """Whether the predicted lengths are beyond doubt not what the pictures show."""
        return abs(np.log(self.scale)) > SURE * self.std and self.scale < LONGEST

    def __str__(self) -> str:
        return f"{self.scale:.2f} ± {self.scale * self.std:.2f}"


def tile_powers(luma: NDArray[np.uint8], curve: ResponseCurve) -> TilePowers | None:
    """Spectra of tiles spread over a frame's luma (height, width), in light; None where it is smaller than a tile."""
    height, width = luma.shape
    if min(height, width) < SIDE:
        return None
    rows, columns = (np.linspace(0, length - SIDE, -(-length // SIDE)).astype(int) for length in (height, width))
    corners = np.stack(np.meshgrid(rows, columns, indexing="ij"), -1).reshape(-1, 2)
    corners = _least_clipped(luma, corners[:: -(-len(corners) // MOST_TILES)], curve)
    tiles = (cut(luma, (int(top), int(left))) for top, left in corners)
    power = [windowed_power(evenly_steep(cv2.LUT(tile, curve.linear_table()), curve)) for tile in tiles]
    return TilePowers(corners[:, ::-1].astype(float) + (SIDE - 1) / 2, np.stack(power))


def path_scale(frames: Iterable[tuple[RowMotion, TilePowers]], bits_per_px: float = np.inf) -> PathScale | None:
    """Find the scale from frames with their predicted motion; None where too few are blurred enough to tell."""
    evidence = np.array([found for motion, tiles in frames if (found := _evidence(motion, tiles)) is not None])
    if len(evidence) < LEAST_FRAMES:
        return None
    best = _best(_believed(evidence.sum(axis=0)))
    rng = np.random.default_rng(len(evidence))
    drawn = rng.integers(0, len(evidence), (RESAMPLED, len(evidence)))
    scatter = float(np.std([_best(_believed(evidence[numbers].sum(axis=0))) for numbers in drawn]))
    starved = (STARVED_BITS / bits_per_px) ** 3
    return PathScale(float(np.exp(best)), float(np.hypot(scatter, MODEL_STD * (1 + starved))), len(evidence))


# ── parts ────────────────────────────────────────────────────────────────────────────────────────────────────────


def _least_clipped(luma: NDArray[np.uint8], corners: NDArray[np.intp], curve: ResponseCurve) -> NDArray[np.intp]:
    """The tiles whose light was measured: a lamp's streak has a spectrum of its own."""
    clipped = curve.clipped_table(CLIPPED_LEVELS)
    if not clipped[int(luma.max())]:
        return corners
    lost = cv2.LUT(luma, clipped.astype(np.uint8))
    parts = np.array([cut(lost, (int(top), int(left))).mean() for top, left in corners])
    return corners[parts <= max(MOST_CLIPPED, float(np.quantile(parts, 0.25)))]


def _evidence(motion: RowMotion, tiles: TilePowers) -> Array | None:
    """(scales, RINGS) logarithm of the likelihood ratio to no blur; None where the paths are too short or too long."""
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
    """(scales, RINGS) logarithm of the likelihood of |K|² S + N, with the best S and N, over that of an even N.

    cells: of the |K|² of each scale.
    """
    count, k, g = (np.stack(parts) for parts in zip(*((c.count, c.passed, c.means(seen)) for c in cells), strict=True))
    in_ring = np.maximum(count.sum(-1), 1)
    even = np.maximum((count * g).sum(-1) / in_ring, ROUNDING_POWER)
    mean_k = (count * k).sum(-1) / in_ring
    signal, noise = 0.9 * even / np.maximum(mean_k, 0.05), 0.1 * even
    products = np.stack([np.ones_like(k), k, k * k, g, k * g], -1)
    for _ in range(_FIT_STEPS):
        expected = np.maximum(noise[..., None] + signal[..., None] * k, ROUNDING_POWER)
        w, wk, wkk, wg, wkg = np.moveaxis(((count / expected**2)[..., None, :] @ products)[..., 0, :], -1, 0)
        determinant = np.maximum(w * wkk - wk * wk, _TINY)
        signal, noise = (w * wkg - wk * wg) / determinant, (wkk * wg - wk * wkg) / determinant
        signal = np.where(noise < 0, wkg / np.maximum(wkk, _TINY), signal)
        noise = np.where(signal < 0, even, np.maximum(noise, 0))
        signal = np.maximum(signal, 0)
    expected = np.maximum(noise[..., None] + signal[..., None] * k, ROUNDING_POWER)
    flat = even[..., None]
    found = (count * (np.log(flat / expected) + g / flat - g / expected)).sum(-1)
    return np.asarray(np.maximum(found, 0.0))


def _believed(evidence: Array) -> Array:
    """(scales,) the evidence (scales, RINGS) of the lowest rings that hold BELIEVED of it."""
    reached = np.cumsum(evidence.max(axis=0))
    last = int(np.searchsorted(reached, BELIEVED * reached[-1]))
    return np.asarray(evidence[:, : last + 1].sum(axis=1))


def _best(evidence: Array) -> float:
    """Logarithm of the scale at which evidence (scales,) is greatest, by the parabola through its neighbours."""
    i = int(np.argmax(evidence))
    step = 0.0
    if 0 < i < len(evidence) - 1:
        before, here, after = evidence[i - 1 : i + 2]
        bend = before - 2 * here + after
        step = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return float(np.interp(i + step, np.arange(len(SCALES)), np.log(SCALES)))


def telling(numbers: Sequence[int], path_px: Array) -> tuple[int, ...]:
    """At most MOST_FRAMES of some frames, evenly over the half of them whose paths are nearest to BEST_PATH_PX."""
    if not numbers:
        return ()
    off = np.abs(np.log(np.maximum(path_px, 1e-3) / BEST_PATH_PX))
    near = [n for n, distance in zip(numbers, off, strict=True) if distance <= np.median(off)]
    return tuple(near[:: -(-len(near) // MOST_FRAMES)])


def kept_powers(
    pictures: Iterable[tuple[int, NDArray[np.uint8]]],
    wanted: Iterable[int],
    curve: ResponseCurve,
    into: dict[int, TilePowers],
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Pass lumas on by their index, and keep the spectra of those that are wanted."""
    chosen = set(wanted)
    for index, luma in pictures:
        if index in chosen and (powers := tile_powers(luma, curve)) is not None:
            into[index] = powers
        yield index, luma
