"""Effect of a better model on the restored frames, measured without ground truth.

Some pairs of neighbouring frames, with high motion and spread over the capture, are kept back from every fit of points,
blur and curve, and restored with the given profile and with the extended one.  (Brightness fits use them: a drifting
gain belongs to its frame and cannot be inferred from other frames.)  Two neighbours are two independent observations of
one scene:

- *sharpness*: the gradient that both share.  One picture is aligned to the other by a homography through tracked
  points, and the product of their gradients is averaged: noise and the ringing of a wrong kernel differ between the two
  and cancel, while scene detail stays.  However, neighbours move alike, and so their wrong kernels are alike: the mean
  product is weighted by its fraction of the two pictures' own gradient energies, which ringing lowers.  No camera model
  is used, so none is favoured.
- *disagreement*: the model predicts where a point of one restored picture lies in the other, from the gyroscope alone
  (and the translation, where it is known); the distance to the tracked position is the error of geometry, clocks and
  rows.
- *brightness*: the light at the same points, which differs where flicker is left in one picture and not in the other.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Mask, Picture
from virest.camera.profile import CameraProfile
from virest.camera.response import ResponseCurve
from virest.capture.imu import ImuSamples
from virest.capture.records import Capture, Frame
from virest.image_formation.row_motion import RowMotion, covering_both, row_motion
from virest.image_formation.warp import moved_between
from virest.inference.frame_selection import choose_pairs
from virest.inference.guidance import GyroGuide, MapBetween, map_between
from virest.inference.guide_choice import find_guide
from virest.inference.parallel import ParallelMap, one_by_one
from virest.inference.robust import NORMAL_MEDIAN
from virest.inference.tracking import Guide, TrackPair, track_pairs
from virest.motion.integration import integrate_gyro
from virest.motion.optics import MovingLens, moving_lens
from virest.motion.trajectory import Trajectory
from virest.restoration.capture import RestorationPlan, at_true_times, restore_frames
from virest.restoration.capture_estimation import plan_restoration
from virest.restoration.frame import RestoredFrame
from virest.restoration.settings import PRESETS, RestorationSettings

Rectangle = tuple[int, int, int, int]
Reader = Callable[[Sequence[int]], Iterator[tuple[int, Picture | None]]]

PAIRS = 4
"""Pairs of frames that are restored: the cost is that of 16 frames."""
KEPT_BACK = 0.1
"""Maximum fraction of the frames that is kept back from fits."""
MIN_TRACKS = 16
"""Minimum number of points for aligning two pictures."""
HOMOGRAPHY_PX = 2.0
"""Points within this of the homography determine it."""
EDGE_PX = 4
"""Margin excluded along the border of the valid area: half the reach of the gradient and of the interpolation."""
PATCH_PX = 9
"""Side of the square over which light is averaged at a point."""
LIGHT_RANGE = (0.02, 0.9)
"""As fractions of the curve's full range; darker light is noise, brighter light may be clipped."""


@dataclass(frozen=True, slots=True)
class RestorationGain:
    """``before`` with the profile as given, ``after`` with the extended one; NaN where it could not be measured."""

    sharpness_recorded: float
    """Root of the gradient energy that neighbours share, grey levels per pixel, in the recorded pictures."""
    sharpness_before: float
    """The same in the restored pictures; all three over the area that is valid in both restorations."""
    sharpness_after: float
    disagreement_before_px: float
    """Median distance between predicted and tracked positions of points in the restored neighbour."""
    disagreement_after_px: float
    brightness_disagreement_before: float
    """Robust standard deviation, relative, of the light ratio at those points about the median of the pair."""
    brightness_disagreement_after: float
    frames: tuple[int, ...]
    """Movie indices of the frames that were restored."""


@dataclass(frozen=True, slots=True)
class _Pair:
    """Two neighbouring pictures, restored or not."""

    pictures: tuple[Picture, Picture]
    valid_px: tuple[Rectangle, Rectangle]
    tracks: TrackPair | None


@dataclass(frozen=True, slots=True)
class PairsRestored:
    """Frames restored with one profile, and their poses under it."""

    plan: RestorationPlan
    frames: dict[int, Frame]
    restored: dict[int, RestoredFrame]
    trajectory: Trajectory | None
    lens: MovingLens | None
    guide: GyroGuide | None
    """Tracking guide of the recorded frames; None if they do not follow the gyroscope."""

    def pair(self, first: int) -> _Pair | None:
        """Frames ``first`` and ``first + 1``; None if one of them could not be restored."""
        a, b = (self.restored.get(first + step) for step in (0, 1))
        if a is None or b is None or a.picture is None or b.picture is None:
            return None
        return _tracked(first, (a.picture, b.picture), (a.valid_px, b.valid_px), self)

    def seen_before(self, first: int, second: int, shape: tuple[int, int], factor: int) -> MapBetween | None:
        """As a tracking guide for restored frames; None if the gyroscope does not guide the recorded ones."""
        if self.guide is None:
            return None
        return map_between(lambda points_px: self.predicted(points_px, second, first), shape, factor)

    def predicted(self, points_px: Array, frame: int, other: int) -> Array:
        """Positions (n, 2) in another restored frame of the points (n, 2) of one, by the model."""
        assert self.trajectory is not None
        assert self.lens is not None
        here, there = (self._motion(number) for number in (frame, other))
        both = covering_both(here, there, self.trajectory, self.lens)
        return moved_between(both, points_px, here.reference_s, there.reference_s)

    def _motion(self, number: int) -> RowMotion:
        assert self.trajectory is not None
        frame, plan = self.frames[number], self.plan
        times = frame.time_s, frame.exposure_s, plan.settings.reference
        translation = (plan.translations or {}).get(number)
        return row_motion(self.trajectory, plan.profile, *times, translation, self.lens)


def measure_restoration_gain(
    capture: Capture,
    nominal: CameraProfile,
    extended: CameraProfile,
    pictures: Reader,
    gray: Reader,
    settings: RestorationSettings = PRESETS["balanced"],
    each: ParallelMap = one_by_one,
    firsts: Sequence[int] | None = None,
    before: PairsRestored | None = None,
) -> RestorationGain:
    """Restore a few pairs of neighbours with both profiles and compare; pictures: RGB by index, gray: luma.

    firsts: the first frame of each pair, kept back from the fits behind the extended profile; None: any.
    before: the result of :func:`restore_pairs` with the nominal profile, if already computed.
    """
    firsts = chosen_pairs(capture, extended) if firsts is None else firsts
    numbers = _frames_of(firsts)
    recorded = {index: picture for index, picture in pictures(numbers) if picture is not None}
    wanted = [] if before is not None else [nominal]
    wanted += [] if extended == nominal else [extended]
    restored = _restored(capture, wanted, recorded, gray, settings, each)
    restored = restored if before is None else [before, *restored]
    before, after = restored[0], restored[-1]
    whole = (0, 0, capture.width, capture.height)
    sharp: dict[str, list[float]] = {"recorded": [], "before": [], "after": []}
    apart: dict[str, list[Array]] = {"before": [], "after": []}
    light: dict[str, list[Array]] = {"before": [], "after": []}
    for first in firsts:
        both = {"before": before.pair(first), "after": after.pair(first)}
        pairs = {name: pair for name, pair in both.items() if pair is not None and pair.tracks is not None}
        if len(pairs) < len(both):
            continue
        shared = _shared([pair.valid_px for pair in pairs.values()])
        raw = _tracked(first, (recorded[first], recorded[first + 1]), (whole, whole), after.guide)
        for name, pair in {"recorded": raw, **pairs}.items():
            sharp[name].append(shared_gradient(pair.pictures, shared, pair.tracks))
        for name, restoration in (("before", before), ("after", after)):
            apart[name].append(_distances(restoration, pairs[name], first))
            light[name].append(_light_ratios(restoration.plan.profile, pairs[name]))
    return RestorationGain(
        sharpness_recorded=_root_mean(sharp["recorded"]),
        sharpness_before=_root_mean(sharp["before"]),
        sharpness_after=_root_mean(sharp["after"]),
        disagreement_before_px=_median(apart["before"]),
        disagreement_after_px=_median(apart["after"]),
        brightness_disagreement_before=_spread(light["before"]),
        brightness_disagreement_after=_spread(light["after"]),
        frames=tuple(numbers),
    )


def restore_pairs(
    capture: Capture,
    profile: CameraProfile,
    firsts: Sequence[int],
    pictures: Reader,
    gray: Reader,
    settings: RestorationSettings = PRESETS["balanced"],
) -> PairsRestored:
    """Restore pairs of neighbours with one profile in a single call, for example in another process."""
    recorded = {index: picture for index, picture in pictures(_frames_of(firsts)) if picture is not None}
    return _restored(capture, [profile], recorded, gray, settings, one_by_one)[0]


def chosen_pairs(capture: Capture, profile: CameraProfile) -> list[int]:
    """First frames of high-motion pairs over the capture, and of one in the start-up if the profile has a lag."""
    frames = at_true_times(capture.frames, profile, capture.repeats)
    offset_s = profile.time_offset_s or 0.0
    chosen = choose_pairs(frames, capture.imu, 2 * PAIRS, 2, offset_s)
    lagging = profile.extensions.frame_lag_frames
    if lagging:
        chosen += choose_pairs(frames[: lagging + 1], capture.imu, 2, 2, offset_s)
    return _pairs_of(chosen, capture)


def pairs_to_keep_back(capture: Capture, profile: CameraProfile) -> list[int]:
    """First frames of the pairs to exclude from all fits, spread over the capture, including the start-up.

    Empty if one pair is more than KEPT_BACK of the capture.
    """
    frames = [
        dataclasses.replace(frame, skip_reason=None, skip_codes=()) if frame.only_startup else frame
        for frame in capture.frames
    ]
    count = min(PAIRS, int(KEPT_BACK * sum(frame.skip_reason is None for frame in frames) / 2))
    if not count:
        return []
    return _pairs_of(choose_pairs(frames, capture.imu, 2 * count, 2, profile.time_offset_s or 0.0), capture)[:count]


def _pairs_of(chosen: Sequence[int], capture: Capture) -> list[int]:
    """First frames of pairs of neighbours among some frames, without exact repeats; no two pairs share a frame."""
    firsts: list[int] = []
    for index in sorted(set(chosen)):
        free = not firsts or index > firsts[-1] + 1
        if free and index + 1 in chosen and index + 1 not in capture.repeats:
            firsts.append(index)
    return firsts


def shared_gradient(
    pictures: tuple[Picture, Picture], valid_px: tuple[Rectangle, Rectangle], tracks: TrackPair | None
) -> float:
    """Gradient energy that two pictures of one scene share, (grey levels per pixel)²; NaN without a common area.

    ⟨∇a·∇b⟩² / √(⟨|∇a|²⟩⟨|∇b|²⟩), not below 0, with b aligned to a by a homography through the tracks.
    """
    homography = _homography(tracks)
    if homography is None:
        return np.nan
    first, second = (cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32) for picture in pictures)
    size = first.shape[1], first.shape[0]
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    aligned = cv2.warpPerspective(second, homography, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    valid = [_inside(rectangle, first.shape) for rectangle in valid_px]
    there = cv2.warpPerspective(valid[1], homography, size, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP)
    common = cv2.erode(valid[0] & there, np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), np.uint8), borderValue=0) > 0
    if not common.any():
        return np.nan
    a, b = (np.stack([_slope(p, 1, 0)[common], _slope(p, 0, 1)[common]]) for p in (first, aligned))
    product, own = float(np.vdot(a, b)), float(np.sqrt(np.vdot(a, a) * np.vdot(b, b)))
    return max(product, 0.0) ** 2 / max(own, 1e-9) / int(common.sum())


def _frames_of(firsts: Sequence[int]) -> list[int]:
    """Both frames of each pair, ascending."""
    return sorted({first + step for first in firsts for step in (0, 1)})


# ── parts ────────────────────────────────────────────────────────────────────────────────────────────────────────


def _restored(
    capture: Capture,
    profiles: Sequence[CameraProfile],
    recorded: dict[int, Picture],
    gray: Reader,
    settings: RestorationSettings,
    each: ParallelMap,
) -> list[PairsRestored]:
    """The recorded frames restored with each profile."""
    planned = [_planned(capture, profile, gray, settings) for profile in profiles]
    asked = [
        (dataclasses.replace(one.frames[n], skip_reason=None, skip_codes=()), recorded[n], one.plan)
        for one in planned
        for n in sorted(recorded)
    ]
    done = each(_restored_one, [(frame, picture, capture.imu, plan) for frame, picture, plan in asked])
    size = len(recorded)
    return [
        dataclasses.replace(one, restored={f.frame.index: f for f in done[k * size : (k + 1) * size] if f is not None})
        for k, one in enumerate(planned)
    ]


def _restored_one(frame: Frame, picture: Picture, imu: ImuSamples, plan: RestorationPlan) -> RestoredFrame | None:
    return next(iter(restore_frames([(frame, picture)], imu, plan)), None)


def _planned(capture: Capture, profile: CameraProfile, gray: Reader, settings: RestorationSettings) -> PairsRestored:
    """Plan and poses of the frames under a profile, with nothing restored yet."""
    plan = _plan(capture, profile, gray, settings)
    frames = {frame.index: frame for frame in at_true_times(capture.frames, plan.profile, capture.repeats)}
    known = plan.profile.intrinsics is not None
    trajectory = integrate_gyro(capture.imu, plan.profile) if known else None
    lens = moving_lens(trajectory, plan.profile) if trajectory is not None else None
    guide = find_guide(capture, plan.profile, gray, [frame.index for frame in capture.frames])
    return PairsRestored(plan, frames, {}, trajectory, lens, guide)


def decodable(gray: Reader, numbers: Sequence[int]) -> Iterator[tuple[int, Picture]]:
    """The frames that can be decoded."""
    return ((index, picture) for index, picture in gray(numbers) if picture is not None)


def _plan(capture: Capture, profile: CameraProfile, gray: Reader, settings: RestorationSettings) -> RestorationPlan:
    """The plan that `process` would use; a scene at infinity needs no estimate of translation."""
    if profile.depth_m is not None and np.isinf(profile.depth_m) and profile.intrinsics is not None:
        return RestorationPlan(profile, settings, imu_gaps_s=capture.imu_gaps_s)
    plan = plan_restoration(capture, profile, settings, lambda numbers: decodable(gray, numbers))
    return dataclasses.replace(plan, refusal=None, contradicted=None, missing_turn=None, mask=None, confirmed=None)


def _tracked(
    first: int, pictures: tuple[Picture, Picture], valid_px: tuple[Rectangle, Rectangle], guide: Guide | None
) -> _Pair:
    luma = [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in pictures]
    found = track_pairs([(first, luma[0]), (first + 1, luma[1])], guide=guide)
    if not found:
        return _Pair(pictures, valid_px, None)
    pair = found[0]
    points = pair.points_first_px, pair.points_second_px
    kept = np.logical_and(*(_within(p, v) for p, v in zip(points, valid_px, strict=True)))
    tracks = TrackPair(first, first + 1, points[0][kept], points[1][kept])
    return _Pair(pictures, valid_px, tracks if len(tracks) >= MIN_TRACKS else None)


def _within(points_px: Array, rectangle: Rectangle) -> Mask:
    x0, y0, x1, y1 = rectangle
    low, high = np.array([x0, y0]) + EDGE_PX, np.array([x1, y1]) - 1 - EDGE_PX
    return np.all((points_px >= low) & (points_px <= high), axis=1)


def _shared(pairs: list[tuple[Rectangle, Rectangle]]) -> tuple[Rectangle, Rectangle]:
    """(area of the first pictures, area of the second pictures) that is valid in every restoration."""
    first, second = (np.array([pair[k] for pair in pairs]) for k in (0, 1))
    return _overlap(first), _overlap(second)


def _overlap(rectangles: NDArray[np.int64]) -> Rectangle:
    x0, y0 = rectangles[:, :2].max(axis=0).tolist()
    x1, y1 = rectangles[:, 2:].min(axis=0).tolist()
    return x0, y0, x1, y1


def _inside(rectangle: Rectangle, shape: tuple[int, ...]) -> Picture:
    x0, y0, x1, y1 = rectangle
    mask = np.zeros(shape[:2], np.uint8)
    mask[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)] = 1
    return mask


def _homography(tracks: TrackPair | None) -> Array | None:
    """Homography from first to second picture; None if the points do not determine it."""
    if tracks is None or len(tracks) < MIN_TRACKS:
        return None
    homography, used = cv2.findHomography(tracks.points_first_px, tracks.points_second_px, cv2.RANSAC, HOMOGRAPHY_PX)
    return None if homography is None or int(used.sum()) < MIN_TRACKS // 2 else np.asarray(homography, float)


def _slope(picture: NDArray[np.float32], across: int, down: int) -> NDArray[np.float32]:
    """Sobel derivative, grey levels per pixel."""
    return np.asarray(cv2.Sobel(picture, cv2.CV_32F, across, down, ksize=3, scale=1 / 8))


def _distances(restoration: PairsRestored, pair: _Pair, first: int) -> Array:
    if restoration.lens is None or pair.tracks is None:
        return np.empty(0)
    predicted_px = restoration.predicted(pair.tracks.points_first_px, first, first + 1)
    return np.asarray(np.linalg.norm(pair.tracks.points_second_px - predicted_px, axis=1))


def _light_ratios(profile: CameraProfile, pair: _Pair) -> Array:
    """Log ratio of the light at tracked points minus the pair's median, since exposure may change between frames."""
    if pair.tracks is None:
        return np.empty(0)
    curve = profile.curve
    points = pair.tracks.points_first_px, pair.tracks.points_second_px
    a, b = (_patch_light(picture, curve, where) for picture, where in zip(pair.pictures, points, strict=True))
    low, high = (part * float(curve.linear_table().max()) for part in LIGHT_RANGE)
    usable = (np.minimum(a, b) > low) & (np.maximum(a, b) < high)
    ratio = np.log(a[usable] / b[usable])
    return ratio - np.median(ratio) if len(ratio) else ratio


def _patch_light(picture: Picture, curve: ResponseCurve, points_px: Array) -> Array:
    light = curve.linear_table()[cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)]
    smooth = cv2.blur(light, (PATCH_PX, PATCH_PX))
    where = points_px.astype(np.float32)[:, None]
    sampled = cv2.remap(smooth, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return sampled[:, 0].astype(float)


def _root_mean(energies: list[float]) -> float:
    known = [energy for energy in energies if np.isfinite(energy)]
    return float(np.sqrt(max(float(np.mean(known)), 0.0))) if known else float("nan")


def _median(lengths: list[Array]) -> float:
    values = np.concatenate([np.empty(0), *lengths])
    return float(np.median(values)) if len(values) else float("nan")


def _spread(ratios: list[Array]) -> float:
    values = np.concatenate([np.empty(0), *ratios])
    return float(np.median(np.abs(values)) / NORMAL_MEDIAN) if len(values) else float("nan")
