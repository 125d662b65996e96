"""Response curve from blur at constant exposure: motion blur mixes light before the curve is applied.

Take two frames of one scene, A nearly sharp and B blurred, with blur paths k_A and k_B from the gyroscope.  If E is
the curve, ``k_B ∗ E′(A)`` and ``k_A ∗ E′(B)`` are both the same light blurred by both paths.  Under a wrong curve the
bright side of every blurred edge grows or shrinks, whichever way the edge faces.  Registration, path length and
brightness errors have other patterns; they are free parameters in every tile, and only the remainder is used.  The path
direction is not free: correct the geometry first.  Each colour channel is mixed separately, because luma is not a curve
of light.  The luma of both sides is compared, except where colours change: movies store those at half the resolution.

A low-bitrate encoder smooths grey levels, not light.  This looks like a straighter curve, with the same sign in all
pairs of frames, so the scatter between pairs does not reveal it: coding residuals in a tile are correlated with a curve
change by a fraction of their size (AGREEMENT), independent of the blur.  The effect of a real change grows with the
mixing of light in a tile.

Nothing in a frame is much darker than its black level, which bounds the black level before any comparison.

Gamma and black level have nearly the same effect here: each is estimated with the other at its nominal value, and they
are rivals.  Only exposures × ISO that change as logged distinguish them (photometry_fit).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Index, Mask
from virest.camera.profile import CameraProfile
from virest.camera.response import ResponseCurve
from virest.capture.pixels import BT601_LUMA
from virest.capture.records import Frame
from virest.diagnosis.findings import PHOTOMETRY, HeldOutGain
from virest.diagnosis.photometry_patches import GrayFrame, path_over_exposure, registered_points
from virest.image_formation.row_clock import ROW_END, ROW_MIDDLE, ROW_START
from virest.image_formation.turning_camera import TurningCamera, turning_camera
from virest.image_formation.warp import moved_between
from virest.inference.chance import student_tail
from virest.inference.parallel import ParallelMap, one_by_one
from virest.inference.robust import robust_std
from virest.inference.time_blocks import evenly_chosen
from virest.motion.trajectory import Trajectory

Gray = NDArray[np.uint8]
Rgb = NDArray[np.uint8]
Plane = NDArray[np.float32]
ReadRgb = Callable[[Sequence[int]], Iterable[tuple[int, Rgb | None]]]
LUMA = np.array(BT601_LUMA, np.float32)

GAMMA_STEPS = np.log([0.8, 1.0, 1.25])
"""Steps at which residuals are evaluated for gamma, added to the logarithm of the profile's gamma."""
LARGEST_BLACK = 0.08
"""Largest black level at which residuals are evaluated, also at half of it and at 0; limited by the darkest greys."""
LEAST_BLACK = 0.01
"""Least limit that the darkest greys set: 2.5 of 255 levels, the typical change of a black level."""
FLOOR_QUANTILE, FLOOR_PART = 0.001, 0.5
"""Exclude a black level if this quantile of the greys is below this fraction of it; the margin covers noise and
undershoots."""
CODING_STD = {"response_curve": (0.02, 0.1), "black_level": (0.01, 0.1)}
"""(absolute, relative) σ caused by low-bitrate encoders, in addition to the scatter between pairs of frames."""
AGREEMENT = 0.07
"""Correlation of coding residuals with a curve change, measured on movies of 0.1 to 0.4 bit per pixel with the
profile's curve."""
MOST_PAIRS, REACH_FRAMES = 16, 8
"""Pairs of frames that are compared, and the most frames between a blurred frame and its sharp one."""
BLURRED_PX, SHARP_PX, SHARP_PART = (3.5, 16.0), 3.0, 0.45
"""Path lengths of blurred frames; the most of a sharp one, in px and as a part of the blurred one's."""
TILE_PX, MOST_TILES = 80, 60
"""Side of a tile, and tiles per pair, evenly spaced over the frame; more add no information."""
READ_PARTS = 4
"""Number of parts in which frames are read in parallel."""
_MIN_TILE_PIXELS = 400
"""A quarter of the pixels that are compared in a whole tile."""
_EVERY = 2
"""Pixel spacing of the comparison along both axes; neighbours in a blurred frame are redundant."""
_NODE_PX = 16
"""Spacing of the nodes of a displacement, linear between: at a turn of 0.05 rad and f = 500 px it errs by 0.006 px."""
_POSSIBLY_CLIPPED = ((np.arange(256) > 247) | (np.arange(256) < 4)).astype(np.uint8)
"""Mask of the 256 levels that may be clipped."""
_MAX_CHROMA_RANGE = 40
"""Levels of Cr or Cb within a blur's reach."""


@dataclass(frozen=True, slots=True)
class MixingEvidence:
    """Evidence of each tile of each pair; scores are residuals projected on the effect of a curve change."""

    pair: Index
    """(n,) number of the pair of frames."""
    pixels: Array
    """(n,) weighted number of compared pixels, every second one along both axes."""
    noise: Array
    """(n,) robust standard deviation of the residuals, grey levels."""
    darkest: float
    """Grey level below which almost no pixel of these frames lies."""
    steps: dict[str, Array]
    """Effect → (3,) changes at which the scores are evaluated."""
    stiffness: dict[str, Array]
    """Effect → (n,) squared length of its pattern in units of noise, per squared unit of the effect."""
    score: dict[str, Array]
    """Effect → (n, 3) scores at the steps; the estimate is where their sum crosses zero."""
    rest: dict[str, Array]
    """Effect → (n,) squared length of the part that no such change explains, in units of noise."""

    def subset(self, use: Mask) -> MixingEvidence:
        """Only the chosen tiles."""
        stiffness, score, rest = (
            {name: v[use] for name, v in kind.items()} for kind in (self.stiffness, self.score, self.rest)
        )
        pair, pixels, noise = self.pair[use], self.pixels[use], self.noise[use]
        return MixingEvidence(pair, pixels, noise, self.darkest, self.steps, stiffness, score, rest)

    @property
    def largest_black(self) -> float:
        """Black level that the darkest greys allow."""
        return self.darkest / 255.0 / FLOOR_PART

    def mean_square(self, effect_name: str, change: float) -> tuple[float, float]:
        """Mean squares, grey levels², of tile differences after a curve change, and of the part no change explains.

        Each tile's registration, brightness and path length are fitted and removed.
        """
        at = np.array([np.polyval(parabola, change) for parabola in self._parabolas(effect_name)])
        square, stiffness = self.noise**2, np.maximum(self.stiffness[effect_name], 1e-12)
        rest = float(np.sum(square * self.rest[effect_name]))
        total = float(self.pixels.sum())
        return (rest + float(np.sum(square * at**2 / stiffness))) / total, rest / total

    def _parabolas(self, effect_name: str) -> Array:
        return np.polyfit(self.steps[effect_name], self.score[effect_name].T, 2).T


@dataclass(frozen=True, slots=True)
class MixingEstimate:
    """One effect of the curve."""

    value: float
    """Gamma, or black level, as the profile would hold it."""
    std: float
    p_value: float
    """Of no change."""
    pairs: int


def observe_mixing(
    read_rgb: ReadRgb,
    frames: Sequence[Frame],
    trajectory: Trajectory,
    profile: CameraProfile,
    each: ParallelMap = one_by_one,
) -> MixingEvidence:
    """Compare blurred frames with sharp ones near them. Empty if the motion provides no such pairs."""
    camera = turning_camera(trajectory, profile) if profile.intrinsics is not None else None
    pairs = _choose_pairs(frames, camera) if camera is not None else []
    wanted = sorted({k for pair in pairs for k in pair})
    runs = [part.tolist() for part in np.array_split(np.array(wanted, np.intp), READ_PARTS)]
    read = each(_read_part, [(read_rgb, run) for run in runs if run])
    pictures = {index: rgb for part in read for index, rgb in part}
    by_index = {frame.index: frame for frame in frames}
    darkest = _darkest(list(pictures.values()))
    steps = _steps(darkest)
    known = [number for number, pair in enumerate(pairs) if pair[0] in pictures and pair[1] in pictures]
    calls = [(*((by_index[k], pictures[k]) for k in pairs[number]), camera, steps) for number in known]
    compared = each(_compare, calls)
    rows = [(number, row) for number, found in zip(known, compared, strict=True) for row in found]
    table = np.array([row for _, row in rows]).reshape(-1, 12)
    names = tuple(steps)
    return MixingEvidence(
        np.array([number for number, _ in rows], np.intp),
        table[:, 0],
        table[:, 1],
        darkest,
        steps,
        {name: table[:, 5 * i + 2] for i, name in enumerate(names)},
        {name: table[:, 5 * i + 3 : 5 * i + 6] for i, name in enumerate(names)},
        {name: table[:, 5 * i + 6] for i, name in enumerate(names)},
    )


def _read_part(read_rgb: ReadRgb, wanted: list[int]) -> list[tuple[int, Rgb]]:
    return [(index, rgb) for index, rgb in read_rgb(wanted) if rgb is not None]


def _steps(darkest: float) -> dict[str, Array]:
    """Changes at which residuals are evaluated; a black level above the darkest greys would only clip the frame."""
    most = float(np.clip(darkest / 255.0 / FLOOR_PART, LEAST_BLACK, LARGEST_BLACK))
    return {"response_curve": GAMMA_STEPS, "black_level": np.array([0.0, 0.5, 1.0]) * most}


def estimate_mixing(evidence: MixingEvidence, profile: CameraProfile, effect_name: str) -> MixingEstimate | None:
    """Gamma or black level, the other as in the profile; None with fewer than 3 pairs of frames.

    std: jackknife over pairs, combined with AGREEMENT divided by the effect per pixel in units of noise.  A black level
    below 0 or above the darkest greys is rejected: its p value is 1.
    """
    pairs = np.unique(evidence.pair)
    if len(pairs) < 3:
        return None
    change = _root(evidence, effect_name)
    left_out = np.array([_root(evidence.subset(evidence.pair != k), effect_name) for k in pairs])
    jackknife = (len(pairs) - 1) / len(pairs) * float(np.sum((left_out - left_out.mean()) ** 2))
    strength = float(np.sqrt(evidence.stiffness[effect_name].sum() / evidence.pixels.sum()))
    absolute, relative = CODING_STD[effect_name]
    std = float(np.sqrt(jackknife + absolute**2 + (AGREEMENT / max(strength, 1e-6)) ** 2))
    p_value = 2 * student_tail(abs(change) / std, len(pairs) - 1)
    std = float(np.hypot(std, relative * change))
    curve = profile.curve
    if effect_name == "response_curve":
        value = curve.extra_gamma * float(np.exp(change))
        return MixingEstimate(value, std * value, p_value, len(pairs))
    value = curve.black_level + change
    possible = -std < value <= evidence.largest_black
    return MixingEstimate(max(value, 0.0), std, p_value if possible else 1.0, len(pairs))


def judge_mixing(evidence: MixingEvidence, effect_name: str) -> HeldOutGain | None:
    """Estimate the change on half of the frame pairs and judge it on the others, and vice versa.

    Rms luma difference, grey levels, between the light of both frames after mutual blur and encoding.
    """
    pairs = np.unique(evidence.pair)
    if len(pairs) < 4:
        return None
    folds = []
    for odd in (0, 1):
        change = _root(evidence.subset(np.isin(evidence.pair, pairs[odd::2])), effect_name)
        held = evidence.subset(np.isin(evidence.pair, pairs[1 - odd :: 2]))
        squares = (held.mean_square(effect_name, 0.0)[0], *held.mean_square(effect_name, change))
        folds.append(tuple(np.sqrt(squares).tolist()))
    return HeldOutGain.of_folds(PHOTOMETRY, folds)


def _root(evidence: MixingEvidence, effect_name: str) -> float:
    """Zero of the parabola through the 3 summed scores, the one nearest to the linear estimate."""
    x = evidence.steps[effect_name]
    total = evidence.score[effect_name].sum(axis=0)
    straight = -total[1 if effect_name == "response_curve" else 0] * (x[2] - x[0]) / (total[2] - total[0])
    roots = np.roots(np.polyfit(x, total, 2))
    real = roots[np.abs(roots.imag) < 1e-9].real
    best = float(real[np.argmin(np.abs(real - straight))]) if len(real) else float(straight)
    return float(np.clip(best, 3 * x[0] - 0.1, 3 * x[2]))


# ── pairs of frames ────────────────────────────────────────────────────────────────────────────────────────────────


def _choose_pairs(frames: Sequence[Frame], camera: TurningCamera) -> list[tuple[int, int]]:
    """(sharp, blurred) movie indices with the most blur between them."""
    if any(frame.exposure_s is None for frame in frames) or len(frames) < 2:
        return []
    length = _central_blur_px(frames, camera)
    index = np.array([frame.index for frame in frames])
    found = []
    for i in np.flatnonzero((length > BLURRED_PX[0]) & (length < BLURRED_PX[1])):
        near = np.flatnonzero(np.abs(index - index[i]) <= REACH_FRAMES)
        best = near[np.argmin(length[near])]
        if length[best] < min(SHARP_PX, SHARP_PART * length[i]):
            found.append((float(length[i] - 1.5 * length[best]), int(index[best]), int(index[i])))
    return [(sharp, blurred) for _, sharp, blurred in sorted(found, reverse=True)[:MOST_PAIRS]]


def _central_blur_px(frames: Sequence[Frame], camera: TurningCamera) -> Array:
    """Blur length (n,), px, at the frame centre: distance of the point between start and end of the exposure."""
    centre = np.array([(camera.profile.width - 1) / 2, (camera.profile.height - 1) / 2])
    logged_s = np.array([frame.exposure_s or 0.0 for frame in frames])
    at = camera.frames(np.array([frame.time_s for frame in frames]), logged_s)
    middle_s = at.row_time_s(centre, ROW_MIDDLE)
    first, last = (moved_between(at, centre, middle_s, at.row_time_s(centre, share)) for share in (ROW_START, ROW_END))
    return np.asarray(np.linalg.norm(last - first, axis=-1))


def _darkest(pictures: Sequence[Rgb]) -> float:
    """Grey level below which almost no pixel lies; 0 without frames."""
    return float(np.median([np.quantile(rgb[::2, ::2], FLOOR_QUANTILE) for rgb in pictures])) if pictures else 0.0


def _compare(
    sharp: tuple[Frame, Rgb], blurred: tuple[Frame, Rgb], camera: TurningCamera, steps: dict[str, Array]
) -> list[Array]:
    """Pixels, noise, and for each effect stiffness, scores and rest, (12,) in all, of each usable tile of one pair."""
    height, width = blurred[1].shape[:2]
    here, there = (GrayFrame(frame, cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)) for frame, rgb in (blurred, sharp))
    where = registered_points(here, there, camera, _nodes(width, height))
    if where is None:
        return []
    x, y = ((np.arange(n) / _NODE_PX).astype(np.float32) for n in (width, height))
    place = cv2.remap(where, np.tile(x, (height, 1)), np.tile(y[:, None], (1, width)), cv2.INTER_LINEAR)
    usable = _usable(sharp[1], blurred[1], place)
    tiles = _tiles(width, height, TILE_PX)
    middles = np.array([((t[1].start + t[1].stop) / 2, (t[0].start + t[0].stop) / 2) for t in tiles])
    kernels = [
        [_kernel(path) for path in path_over_exposure(middles, frame, camera)] for frame in (sharp[0], blurred[0])
    ]
    chosen = evenly_chosen(np.flatnonzero([_is_usable(usable[tile]) for tile in tiles]), MOST_TILES).tolist()
    pixels = [_compared(usable, tiles[k]) for k in chosen]
    if not chosen:
        return []
    curve = camera.profile.curve

    def light(seen: ResponseCurve) -> list[tuple[Plane, list[Plane]]]:
        """Light of both frames, aligned to the blurred one, each with the other's kernels."""
        table = seen.linear_table()
        moved = cv2.remap(cv2.LUT(sharp[1], table), place, None, cv2.INTER_CUBIC)
        return [(np.asarray(moved, np.float32), kernels[1]), (np.asarray(cv2.LUT(blurred[1], table)), kernels[0])]

    def levels(changed: ResponseCurve, both: list[tuple[Plane, list[Plane]]]) -> Array:
        """Luma difference (n,) of both frames in the compared pixels of all usable tiles."""
        first, second = (
            np.concatenate([_filtered(one, by[k], tiles[k])[at] for k, at in zip(chosen, pixels, strict=True)])
            for one, by in both
        )
        return np.asarray((255 * (changed.encode(second) - changed.encode(first))) @ LUMA, float)

    as_given = light(curve)
    from_sharp = as_given[0]
    whole = np.empty_like(from_sharp[0])
    for kernel, tile in zip(from_sharp[1], tiles, strict=True):
        whole[tile] = _filtered(from_sharp[0], kernel, tile)
    nominal, nuisance = levels(curve, as_given), _nuisances((255 * curve.encode(whole)) @ LUMA)
    bent = [replace(curve, extra_gamma=curve.extra_gamma * float(np.exp(s))) for s in steps["response_curve"][[0, 2]]]
    raised = [replace(curve, black_level=curve.black_level + float(s)) for s in steps["black_level"][1:]]
    gammas, blacks = ([levels(one, light(one)) for one in changed] for changed in (bent, raised))
    stacks = [np.stack(stack, axis=-1) for stack in ((gammas[0], nominal, gammas[1]), (nominal, *blacks))]
    free = np.concatenate(
        [np.stack([plane[tiles[k]][at] for plane in nuisance], axis=-1) for k, at in zip(chosen, pixels, strict=True)]
    )
    ends = np.cumsum([len(at[0]) for at in pixels])
    parts = [slice(end - len(at[0]), end) for end, at in zip(ends, pixels, strict=True)]
    return [_tile_scores([stack[part] for stack in stacks], tuple(steps.values()), free[part]) for part in parts]


def _is_usable(usable: Mask) -> bool:
    """Whether enough of a tile's pixels can be compared."""
    return bool(usable.sum() >= 2 * _MIN_TILE_PIXELS and usable[::_EVERY, ::_EVERY].sum() >= _MIN_TILE_PIXELS)


def _compared(usable: Mask, tile: tuple[slice, slice]) -> tuple[Index, Index]:
    """Rows and columns, within a tile, of the pixels to compare."""
    row, column = np.nonzero(usable[tile][::_EVERY, ::_EVERY])
    return row * _EVERY, column * _EVERY


def _tile_scores(levels: list[Array], steps: tuple[Array, ...], free: Array) -> Array:
    """Scores of one tile after projecting out all nuisances, with robust weights per pixel.

    levels: for each effect, luma differences (n, 3) at its steps.  free: (n, k) nuisance patterns.
    """
    free = free.astype(float)
    patterns = [(level[:, 2] - level[:, 0]) / (x[2] - x[0]) for level, x in zip(levels, steps, strict=True)]
    design, target = np.column_stack([patterns[0], free]), levels[0][:, 1]
    weight, noise = np.ones(len(target)), 1.0
    for _ in range(3):
        fit = np.linalg.lstsq(weight[:, None] * design, weight * target, rcond=1e-8)[0]
        left = target - design @ fit
        noise = robust_std(left) + 0.2
        weight = 1 / np.sqrt(1 + (left / (2.5 * noise)) ** 2)
    base = np.linalg.qr(weight[:, None] * free)[0]
    row = [float(np.sum(weight**2)), noise]
    for level, pattern, nominal in zip(levels, patterns, (1, 0), strict=True):
        own = weight * pattern
        own = own - base @ (base.T @ own)
        stiffness, score = float(own @ own) / noise**2, own @ (weight[:, None] * level) / noise**2
        row += [stiffness, *score, max(_length2(weight * target, base) / noise**2 - score[nominal] ** 2 / stiffness, 0)]
    return np.array(row)


def _length2(values: Array, base: Array) -> float:
    """Squared length of values (n,) after removing the orthonormal base (n, k)."""
    left = values - base @ (base.T @ values)
    return float(left @ left)


def _nuisances(grey: Plane) -> list[Plane]:
    """Patterns of registration, brightness and path-length errors: gradients, the frame, a constant, the Laplacian."""
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    slopes = [cv2.Sobel(smooth, cv2.CV_32F, *order) for order in ((1, 0), (0, 1))]
    bend = cv2.Laplacian(cv2.GaussianBlur(grey, (0, 0), 1.5), cv2.CV_32F)
    planes = [*slopes, grey, np.ones_like(grey), bend]
    return [np.asarray(plane, np.float32) for plane in planes]


def _nodes(width: int, height: int) -> Array:
    """Pixels (rows, columns, 2) every _NODE_PX, one beyond the frame border."""
    x, y = (np.arange(n // _NODE_PX + 2) * float(_NODE_PX) for n in (width, height))
    return np.stack(np.meshgrid(x, y), axis=-1)


def _tiles(width: int, height: int, side: int) -> list[tuple[slice, slice]]:
    columns, rows = (np.linspace(0, n, max(n // side, 1) + 1).astype(int) for n in (width, height))
    return [(slice(int(a), int(b)), slice(int(c), int(d))) for a, b in pairwise(rows) for c, d in pairwise(columns)]


def _usable(sharp: Rgb, blurred: Rgb, place: Plane) -> Mask:
    """Pixels whose neighbourhood is inside both frames, unclipped in all channels, and nearly uniform in chroma."""
    height, width = blurred.shape[:2]
    edge = 8
    x, y = place[..., 0], place[..., 1]
    inside = (x > edge) & (x < width - 1 - edge) & (y > edge) & (y < height - 1 - edge)

    def unfit(rgb: Rgb) -> Gray:
        around = np.ones((21, 21), np.uint8)
        ends = [cv2.LUT(plane, _POSSIBLY_CLIPPED) for plane in cv2.split(rgb)]
        unfit = cv2.dilate(ends[0] | ends[1] | ends[2], around)
        for chroma in cv2.split(cv2.cvtColor(rgb, cv2.COLOR_RGB2YCrCb))[1:]:
            varied = cv2.dilate(chroma, around) - cv2.erode(chroma, around)
            unfit |= (varied > _MAX_CHROMA_RANGE).astype(np.uint8)
        return np.asarray(unfit, np.uint8)

    seen = cv2.remap(unfit(sharp), place, None, cv2.INTER_NEAREST)
    return np.asarray(inside & (unfit(blurred) == 0) & (seen == 0))


def _kernel(path_px: Array) -> Plane:
    """Weights with which a pixel gathers light along a path (m, 2), located at minus the displacement."""
    fine = (path_px[:-1, None] + np.diff(path_px, axis=0)[:, None] * (np.arange(6) / 6)[:, None]).reshape(-1, 2)
    reach = int(np.abs(fine).max() + 2)
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    at = reach - fine
    whole = np.floor(at).astype(int)
    part = at - whole
    for right in (0, 1):
        for down in (0, 1):
            share = np.abs(1 - right - part[:, 0]) * np.abs(1 - down - part[:, 1])
            np.add.at(kernel, (whole[:, 1] + down, whole[:, 0] + right), share)
    return (kernel / kernel.sum()).astype(np.float32)


def _filtered(light: Plane, kernel: Plane, tile: tuple[slice, slice]) -> Plane:
    """One tile of a frame blurred by its own kernel, including the neighbouring pixels that the kernel reaches."""
    reach, (height, width), (rows, columns) = len(kernel) // 2, light.shape[:2], tile
    top, left = max(rows.start - reach, 0), max(columns.start - reach, 0)
    part = light[top : min(rows.stop + reach, height), left : min(columns.stop + reach, width)]
    part = cv2.filter2D(part, cv2.CV_32F, kernel, borderType=cv2.BORDER_REFLECT)
    return np.asarray(part[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left], np.float32)
