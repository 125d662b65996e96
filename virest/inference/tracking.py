"""Track points from frame to frame (pyramidal Lucas-Kanade, Bouguet 2001), with a forward-backward check.

A guide (`guidance`) may predict their positions: the first picture is then warped by the predicted map before matching.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Index, Mask, Picture
from virest.inference.even_light import SAME_LEVELS, LevelChange, level_change
from virest.inference.parallel import ParallelMap, one_by_one

Points = NDArray[np.float32]
Stream = Iterable[tuple[int, Picture | None]]
PART_FRAMES = 60
"""Frames in one part; each part also decodes its lead frames and everything from the key frame before them."""
LEAD_FRAMES = 2
"""The frame before a part's first, to pair with it, and one more, to detect whether that frame is a repeat."""
CORNER_BLOCK_PX = 5
"""Side of the square over which the structure tensor is averaged.  On 45 simulated frames 3, 5 and 9 px give 8499, 8381
and 7434 tracks with a noise of 0.121, 0.123 and 0.116 px."""
CORNER_SPACING_PX = 7
"""A corner is the strongest in a square of this side."""
LIGHT_ROUNDS = 3
"""Matches of a pair at most, each with the brightness change that the last one shows."""
OUTSIDE_PX = 1e6
"""Finite bound outside any picture for positions where the lens model diverges."""
REPEATS = 1.9
"""Ratio of squared differences below which two patches of about 100 independent pixels are equally similar: noise
alone exceeds it in 1 of 1000 cases (F distribution)."""


@dataclass(frozen=True, slots=True)
class TrackingSettings:
    """How points are selected and tracked. Lengths are pixels of the reduced picture."""

    halve_above_px: int = 800
    """Pictures are halved repeatedly until their longer side is at most this."""
    grid: tuple[int, int] = (8, 8)
    """(columns, rows) of cells over the picture; each gives its best corners."""
    points_per_cell: int = 4
    window_px: int = 21
    pyramid_levels: int = 4
    """Pyramid levels above the picture: 4 with this window track up to about 70 px."""
    guided_levels: int = 2
    """The same with a guide: prediction errors of up to about 20 px."""
    repeats_from_px: float = 4.0
    """A point found further than this from its prediction may be a repetition of the texture."""
    max_forward_backward_px: float = 0.3
    """Points with a larger forward-backward distance are dropped."""
    min_corner_levels: float = 1.5
    """Smallest gradient of a corner along its weaker axis, grey levels per pixel; noise of 2 levels gives about 1."""
    border_px: int = 6
    """Points closer to the picture's edge are dropped."""


class Between(Protocol):
    """A guide's map between two pictures."""

    def second_of(self, points_px: Array) -> Array:
        """Positions in the second picture of points (n, 2) of the first."""

    def warped(self, first: Picture) -> Picture:
        """The first picture warped to the second, and blurred if the second is more blurred."""

    def blurred(self, second: Picture) -> Picture:
        """The second picture, blurred if the first is more blurred."""


class Guide(Protocol):
    """Predicts the positions of points; picklable if parts are sent to processes."""

    def seen_before(self, first: int, second: int, shape: tuple[int, int], factor: int) -> Between | None:
        """The map between two frames' pictures, (height, width), reduced by ``factor``; None: unknown."""


@dataclass(frozen=True, slots=True)
class TrackPair:
    """Points seen in two consecutive frames; (0, 0) is the centre of the top-left pixel of the stored picture."""

    first: int
    """Movie index of the first frame."""
    second: int
    points_first_px: Array
    """(n, 2)."""
    points_second_px: Array
    """(n, 2), the same points."""
    guided: bool = False
    """Whether a guide warped the first picture and made both pictures equally blurred before matching."""
    levels: LevelChange = SAME_LEVELS
    """Grey levels of the second frame over those of the first."""

    def __len__(self) -> int:
        return len(self.points_first_px)


def track_pairs(
    pictures: Iterable[tuple[int, Picture | None]],
    settings: TrackingSettings | None = None,
    progress: Callable[[int], None] | None = None,
    guide: Guide | None = None,
) -> list[TrackPair]:
    """Track points between consecutive frames of a stream of (movie index, grey (h, w) or None).

    guide: predicts the points' positions in the next frame; see :mod:`virest.inference.guidance`.

    New corners are selected in every first frame, so pairs are independent of each other.  None and jumps in the index
    interrupt the sequence.  A frame identical to its predecessor has content of another time, and gives no pair with
    either neighbour.  Two pictures are in memory at a time.  progress is called with each index.
    """
    settings = settings or TrackingSettings()
    pairs: list[TrackPair] = []
    before: tuple[int, Picture] | None = None
    newest: Picture | None = None
    for index, picture in pictures:
        repeated = picture is not None and newest is not None and np.array_equal(picture, newest)
        newest = picture
        if progress is not None:
            progress(index)
        if picture is None or repeated:
            before = None
            continue
        small, factor = _halved(picture, settings.halve_above_px)
        if before is not None and before[0] == index - 1 and before[1].shape == small.shape:
            pair = _track(before[1], small, factor, before[0], settings, guide)
            if len(pair):
                pairs.append(pair)
        before = (index, small)
    return pairs


def track_frames(
    gray: Callable[[Sequence[int]], Stream],
    frames: Sequence[int],
    each: ParallelMap = one_by_one,
    progress: Callable[[int], None] | None = None,
    guide: Guide | None = None,
) -> list[TrackPair]:
    """Track points through frames (movie indices, ascending) in parts, with the same result as in a single stream.

    gray: yields (index, picture) of the requested frames; picklable if ``each`` sends parts to processes.  progress is
    called with the number of frames of each finished part.
    """
    parts = _parts(frames)
    sizes = [sum(index >= first for index in part) for part, first in parts]
    found = each(
        _track_part,
        [(gray, part, first, guide) for part, first in parts],
        None if progress is None else lambda number: progress(sizes[number]),
    )
    return [pair for pairs in found for pair in pairs]


def _parts(frames: Sequence[int]) -> list[tuple[list[int], int]]:
    """Parts of the runs of consecutive frames, each with its lead frames, and the index of its first own frame."""
    ascending = np.array(sorted(set(frames)), np.intp)
    parts: list[tuple[list[int], int]] = []
    for run in np.split(ascending, np.flatnonzero(np.diff(ascending) > 1) + 1):
        cuts = np.linspace(0, len(run), -(-len(run) // PART_FRAMES) + 1).round().astype(int)
        for start, end in pairwise(cuts):
            parts.append((run[max(start - LEAD_FRAMES, 0) : end].tolist(), int(run[start])))
    return parts


def _track_part(
    gray: Callable[[Sequence[int]], Stream], frames: list[int], own_from: int, guide: Guide | None
) -> list[TrackPair]:
    """Pairs whose second frame is the part's own."""
    return [pair for pair in track_pairs(gray(frames), guide=guide) if pair.second >= own_from]


def find_corners(picture: Picture, settings: TrackingSettings) -> NDArray[np.float32]:
    """Corners (n, 2) of a grey picture, strongest first, at most ``points_per_cell`` from each cell of the grid.

    Strength is the smaller eigenvalue of the structure tensor (Shi & Tomasi 1994).
    """
    strength = cv2.cornerMinEigenVal(picture, CORNER_BLOCK_PX, ksize=3)
    # OpenCV's scaling of 8-bit pictures makes this 4 x (mean squared gradient) / 255².
    least = 4 * (settings.min_corner_levels / 255.0) ** 2
    peak = cv2.dilate(strength, np.ones((CORNER_SPACING_PX, CORNER_SPACING_PX), np.uint8))
    candidate = (strength >= peak) & (strength > least)
    edge = settings.border_px
    candidate[:edge], candidate[-edge:], candidate[:, :edge], candidate[:, -edge:] = False, False, False, False
    y, x = np.nonzero(candidate)
    order = np.argsort(-strength[y, x], kind="stable")
    y, x = y[order], x[order]
    height, width = picture.shape
    columns, rows = settings.grid
    cell = (y * rows // height) * columns + x * columns // width
    kept = _rank_within(cell) < settings.points_per_cell
    return np.stack([x[kept], y[kept]], axis=-1).astype(np.float32)


def _rank_within(group: Index) -> Index:
    """Number of earlier entries with the same group."""
    order = np.argsort(group, kind="stable")
    ordered = group[order]
    start = np.searchsorted(ordered, ordered, side="left")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(group)) - start
    return rank


def shrink_factor(width: int, height: int, limit_px: int = TrackingSettings().halve_above_px) -> int:
    """Width of a tracked picture's pixel in stored pixels."""
    factor = 1
    while max(width, height) // factor > limit_px and min(width, height) // factor >= 64:
        factor *= 2
    return factor


def _halved(picture: Picture, limit_px: int) -> tuple[Picture, int]:
    """The picture halved until it fits, by means over 2 x 2 pixels, and the factor."""
    factor = shrink_factor(picture.shape[0], picture.shape[1], limit_px)
    for _ in range(factor.bit_length() - 1):
        even = picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]
        picture = cv2.resize(even, (even.shape[1] // 2, even.shape[0] // 2), interpolation=cv2.INTER_AREA)
    return picture, factor


def _track(
    first: Picture, second: Picture, factor: int, index: int, settings: TrackingSettings, guide: Guide | None
) -> TrackPair:
    start = find_corners(first, settings)
    if len(start) == 0:
        return TrackPair(index, index + 1, np.zeros((0, 2)), np.zeros((0, 2)))
    between = None if guide is None else guide.seen_before(index, index + 1, first.shape, factor)
    light = SAME_LEVELS
    for _ in range(LIGHT_ROUNDS):
        ahead, good = _matched(*light.evened(first, second), start, settings, between)
        found = level_change(first, second, start[good], ahead[good])
        if found.is_near(light, first):
            break
        light = found
    points_px = _stored(start[good], factor), _stored(ahead[good], factor)
    return TrackPair(index, index + 1, *points_px, between is not None, found)


def _matched(
    first: Picture, second: Picture, start: Points, settings: TrackingSettings, between: Between | None
) -> tuple[Points, Mask]:
    """Found positions (n, 2) of points, and the mask (n,) of reliable ones."""
    if between is None:
        return _there_and_back(first, second, start, settings, settings.pyramid_levels)
    return _guided(first, second, start, settings, between)


def _guided(
    first: Picture, second: Picture, start: Points, settings: TrackingSettings, between: Between
) -> tuple[Points, Mask]:
    """Track points from their predicted positions; points not found there are tracked without the guide.

    The first picture is warped into the second, rotation and shear included, before matching.  A point found far from
    its prediction is dropped if the warped picture looks the same there: repetitive texture.
    """
    predicted = np.clip(between.second_of(start.astype(float)), -OUTSIDE_PX, OUTSIDE_PX).astype(np.float32)
    warped, blurred = between.warped(first), between.blurred(second)
    ahead, good = predicted.copy(), np.zeros(len(predicted), bool)
    guided, plain = (
        (warped, blurred, predicted, settings.guided_levels),
        (first, second, start, settings.pyramid_levels),
    )
    for before, after, begun, levels in (guided, plain):
        missing = np.flatnonzero(_inside(predicted, second, settings) & ~good)
        if len(missing):
            ahead[missing], good[missing] = _there_and_back(before, after, begun[missing], settings, levels)
    far = np.flatnonzero(good & (np.linalg.norm(ahead - predicted, axis=-1) > settings.repeats_from_px))
    good[far[_repeats(warped, blurred, predicted[far], ahead[far], settings)]] = False
    return ahead, good


def _repeats(warped: Picture, second: Picture, predicted: Points, ahead: Points, settings: TrackingSettings) -> Mask:
    """Mask (n,): the warped picture at the found position matches the second picture about as well as the point itself.

    Compares squared differences of patches normalised in mean and contrast; for repetitive texture both are noise.
    """
    if not len(predicted):
        return np.zeros(0, bool)
    there = _patches(second, ahead, settings.window_px)
    own, others = (_patches(warped, at, settings.window_px) for at in (predicted, ahead))
    unlike_own, unlike_others = (1 - (there * patches).sum(axis=1) for patches in (own, others))
    return np.asarray(unlike_others < REPEATS * unlike_own)


def _patches(picture: Picture, points: Points, side: int) -> NDArray[np.float32]:
    """Patches (n, side²) around points (n, 2), of mean 0 and norm 1."""
    offset = np.arange(side, dtype=np.float32) - (side - 1) / 2
    x = np.broadcast_to(points[:, :1, None] + offset[None, None, :], (len(points), side, side))
    y = np.broadcast_to(points[:, 1:, None] + offset[None, :, None], (len(points), side, side))
    rows = (len(points), side * side)
    shown = cv2.remap(picture, x.reshape(rows), y.reshape(rows), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    centred = shown.astype(np.float32) - shown.mean(axis=1, keepdims=True, dtype=np.float32)
    return np.asarray(centred / np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1e-3), np.float32)


def _there_and_back(
    first: Picture, second: Picture, start: Points, settings: TrackingSettings, levels: int
) -> tuple[Points, Mask]:
    """Found positions (n, 2) of points, and the mask (n,) of those that also lead back to their start."""
    ahead, found = _follow(first, second, start, settings, levels)
    back, returned = _follow(second, first, ahead, settings, levels)
    distance = np.linalg.norm(back - start, axis=-1)
    good = found & returned & _inside(ahead, second, settings) & (distance < settings.max_forward_backward_px)
    return ahead, good


def _inside(points: Points, picture: Picture, settings: TrackingSettings) -> Mask:
    height, width = picture.shape
    edge = settings.border_px
    return (points >= edge).all(axis=-1) & (points[:, 0] < width - edge) & (points[:, 1] < height - edge)


def _follow(
    first: Picture, second: Picture, points: Points, settings: TrackingSettings, levels: int
) -> tuple[Points, Mask]:
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        first,
        second,
        points[:, None],
        None,
        winSize=(settings.window_px, settings.window_px),
        maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.005),
    )
    return moved[:, 0], status.ravel() == 1


def _stored(points: Points, factor: int) -> Array:
    """Pixels of the stored picture: the mean of factor x factor pixels lies at their common centre."""
    return points.astype(float) * factor + (factor - 1) / 2
