"""Decide before tracking whether the frames follow the gyroscope, so that it may guide the tracking.

Tiles of some frames are matched with the next frame at every shift within reach (normalised cross-correlation), without
the gyroscope.  The gyroscope's support is the mean score at the shifts that it predicts.  Repetitive texture scores at
many shifts, but over many pairs only the true motion scores throughout.

Rivals are the same log with its axes permuted (the 24 axis maps) and reversed in time: equally fast, equally smooth,
tried at the same offsets, and unrelated to the frames.  Their supports, each the maximum over the offsets, follow
Gumbel's extreme-value distribution; the gyroscope guides if its support exceeds their quantile at FALSE_ALARMS.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Index, Picture
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.capture.join import median_period_s
from virest.capture.records import Capture, Frame
from virest.image_formation.row_clock import RowClock, row_time_s
from virest.inference.coarse_alignment import MIN_PAIRS, SEARCH_S, axis_maps
from virest.inference.frame_rotations import gyro_turns
from virest.inference.frame_selection import choose_pairs
from virest.inference.guidance import GyroGuide, gyro_guide
from virest.inference.observed_tracks import frame_times
from virest.inference.parallel import ParallelMap, one_by_one
from virest.inference.tracking import TrackPair, track_frames
from virest.motion.integration import integrate_gyro
from virest.motion.trajectory import Trajectory

Reader = Callable[[Sequence[int]], Iterable[tuple[int, Picture | None]]]
SAMPLE_FRAMES, RUN_FRAMES = 32, 8
"""Four runs of frames with the highest gyroscope motion."""
LONG_SIDE_PX, TILE_PX, REACH_PX = 192, 33, 48
"""Pixels of the reduced picture: the reach is a quarter of the longer side per frame, 480 px of 1920 px."""
TILES = 3
"""Tiles along each side."""
FLAT_LEVELS = 1.5
"""Tiles with a smaller standard deviation of grey levels are ignored."""
STEP_S, NEAR_S = 0.008, 0.04
"""Step of the offsets; range around the profile's offset, searched before that of SEARCH_S."""
FINE_STEP_S = 0.002
"""Step of the offsets about the best one."""
FALSE_ALARMS = 1e-3
"""Probability that an unrelated log guides the tracking, if its support follows the rivals' distribution."""
SAME_PX = 2.0
"""Logs whose predicted tile positions differ by less (rms) count as the same."""
MIN_RIVALS = 20
"""Fewest rivals, of at most 47, from which mean and deviation of the supports are taken."""
BLOCK_PAIRS, BLOCK_SIGMA, LEAST_BLOCKS = 4, 2.0, 0.75
"""LEAST_BLOCKS of the blocks of BLOCK_PAIRS pairs must each support the gyroscope by BLOCK_SIGMA standard deviations of
its rivals: a short part of a log may fit by chance, or be the only part of this recording."""
GUMBEL_MEAN, GUMBEL_STD = 0.5772, 1.2825
"""Of the standard Gumbel distribution: Euler's constant and π / √6."""


def find_guide(capture: Capture, profile: CameraProfile, gray: Reader, frames: Sequence[int]) -> GyroGuide | None:
    """The gyroscope as a guide through frames (movie indices); None if the frames do not demonstrably follow it.

    gray: yields (index, picture) of the requested frames.  The guide uses the profile's offset, or the offset of
    highest support if the profile has none or the frames follow the gyroscope at another one.
    """
    if profile.intrinsics is None or len(capture.imu) < 8:
        return None
    wanted = set(frames)
    usable = [frame for frame in capture.frames if frame.index in wanted]
    if not _rotates_enough(usable, capture, profile):
        return None
    sample = choose_pairs(usable, capture.imu, SAMPLE_FRAMES, RUN_FRAMES, profile.time_offset_s or 0.0)
    scores = _matched(gray(sample), profile) if len(sample) > MIN_PAIRS else None
    if scores is None or len(scores.first) < MIN_PAIRS:
        return None
    stated_s = profile.time_offset_s
    found = None if stated_s is None else _GyroSupport(capture, profile, scores).support(stated_s, NEAR_S)
    if found is None:
        few = scores.of_tiles(slice(None, None, 2))
        found = _GyroSupport(capture, profile, few).support(stated_s or 0.0, SEARCH_S)
    if found is None:
        return None
    offset_s, turn = found
    if stated_s is not None and abs(offset_s - stated_s) <= STEP_S:
        offset_s = stated_s
    mounted = tuple(map(tuple, (turn @ profile.rotation_cam_imu).tolist()))
    return gyro_guide(capture, replace(profile, time_offset_s=offset_s, r_cam_imu=mounted))


def track_guided(
    capture: Capture,
    profile: CameraProfile,
    gray: Reader,
    frames: Sequence[int],
    each: ParallelMap = one_by_one,
    progress: Callable[[int], None] | None = None,
) -> list[TrackPair]:
    """Track points through frames (movie indices, ascending) like :func:`track_frames`, guided if the frames allow."""
    return track_frames(gray, frames, each, progress, find_guide(capture, profile, gray, frames))


def _rotates_enough(frames: Sequence[Frame], capture: Capture, profile: CameraProfile) -> bool:
    """Whether the rotation between frames is large enough to distinguish the gyroscope from its rivals."""
    if profile.intrinsics is None or len(frames) <= MIN_PAIRS:
        return False
    period_s = median_period_s(np.array([frame.time_s for frame in frames]))
    rate_rad_s = np.linalg.norm(capture.imu.gyro_rad_s - profile.gyro_bias_rad_s, axis=1)
    shrunk_focal_px = profile.intrinsics.fx_px * LONG_SIDE_PX / max(profile.width, profile.height)
    turned_px = float(np.sqrt(np.mean(rate_rad_s**2))) * (period_s or 0.0) * shrunk_focal_px
    return turned_px > SAME_PX


@dataclass(frozen=True, slots=True)
class _Scores:
    """Match scores of the first frames' tiles with the second frames, at every shift."""

    first: Index
    """(p,) movie index."""
    second: Index
    values: NDArray[np.float32]
    """(p, tiles, 2 r + 3, 2 r + 3) correlation at shifts (y, x) from -r - 1; 0 out of reach and for flat tiles."""
    centres_px: Array
    """(tiles, 2) in stored pixels."""
    scale: float
    """Stored pixels per pixel of the reduced picture."""

    def at(self, shift_px: Array) -> Array:
        """Mean over tiles (..., p) at shifts (..., p, tiles, 2) in stored pixels."""
        side = self.values.shape[-1]
        place = np.rint(shift_px / self.scale) + (side - 1) // 2  # nan: behind the camera
        place = np.clip(np.nan_to_num(place, nan=0.0), 0, side - 1).astype(np.int32)
        surface = np.arange(self.values.shape[0] * self.values.shape[1]).reshape(self.values.shape[:2])
        flat = (surface * side + place[..., 1]) * side + place[..., 0]
        return np.asarray(self.values.ravel()[flat].mean(axis=-1))

    def of_tiles(self, chosen: slice) -> _Scores:
        """The scores of some tiles."""
        return replace(self, values=np.ascontiguousarray(self.values[:, chosen]), centres_px=self.centres_px[chosen])


def _matched(pictures: Iterable[tuple[int, Picture | None]], profile: CameraProfile) -> _Scores | None:
    """Scores of consecutive frames; repeated frames are skipped, since their content has another time."""
    scale = max(profile.width, profile.height) / LONG_SIDE_PX
    size = round(profile.width / scale), round(profile.height / scale)
    if min(size) < TILE_PX + 2:
        return None
    corners = [np.linspace(0, length - TILE_PX, TILES).round().astype(int) for length in size]
    tiles = [(x, y) for y in corners[1] for x in corners[0]]
    found: list[tuple[int, int, NDArray[np.float32]]] = []
    before: tuple[int, Picture] | None = None
    for index, picture in pictures:
        if picture is None:
            before = None
            continue
        small = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
        if before is not None and before[0] == index - 1 and not np.array_equal(before[1], small):
            found.append((before[0], index, np.stack([_surface(before[1], small, x, y) for x, y in tiles])))
        before = (index, small)
    if not found:
        return None
    first, second = np.array([one[:2] for one in found], np.intp).T
    values = np.stack([one[2] for one in found])
    middle = (TILE_PX - 1) / 2
    centres = (np.array(tiles, float) + middle + 0.5) * scale - 0.5
    return _Scores(first, second, values, centres, scale)


def _surface(first: Picture, second: Picture, x: int, y: int) -> NDArray[np.float32]:
    """Correlation of one tile at all shifts; the outermost ring marks shifts out of reach and stays 0."""
    side = 2 * REACH_PX + 3
    scores = np.zeros((side, side), np.float32)
    tile = first[y : y + TILE_PX, x : x + TILE_PX]
    if tile.std() < FLAT_LEVELS:
        return scores
    left, top = max(x - REACH_PX, 0), max(y - REACH_PX, 0)
    area = second[top : y + TILE_PX + REACH_PX, left : x + TILE_PX + REACH_PX]
    found = cv2.matchTemplate(area, tile, cv2.TM_CCOEFF_NORMED)
    row, column = top - y + REACH_PX + 1, left - x + REACH_PX + 1
    scores[row : row + found.shape[0], column : column + found.shape[1]] = np.nan_to_num(found, posinf=0, neginf=0)
    return scores


class _GyroSupport:
    """Compares the gyroscope's support with that of its rivals."""

    def __init__(self, capture: Capture, profile: CameraProfile, scores: _Scores) -> None:
        assert profile.intrinsics is not None
        self.lens: Intrinsics = profile.intrinsics
        self.scores = scores
        self.trajectory: Trajectory = integrate_gyro(capture.imu, profile)
        stamp_s, exposure_s, _ = frame_times(capture)
        self.clock = RowClock(replace(profile, time_offset_s=0.0))
        self.first_s, self.second_s = (
            self.clock.seen_s(scores.centres_px, stamp_s[index, None], exposure_s[index, None])
            for index in (scores.first, scores.second)
        )
        self.maps = axis_maps()
        own = np.abs(self.maps - np.eye(3)).max(axis=(1, 2)) == 0
        self.maps = np.concatenate([self.maps[own], self.maps[~own]])

    def support(self, centre_s: float, search_s: float) -> tuple[float, Array] | None:
        """Offset within ± search_s of the centre and axis map (3, 3) that the pictures support beyond chance."""
        steps = int(np.ceil(search_s / STEP_S))
        offsets = centre_s + STEP_S * np.arange(-steps, steps + 1, dtype=float)
        ways = self._turns(offsets), -self._turns(offsets, backwards=True)
        contest = [self._best(way @ turn.T) for way in ways for turn in self.maps]
        by_pair, shifts = (np.array([one[k] for one in contest]) for k in (1, 2))
        chosen = int(np.argmax(by_pair[: len(self.maps)].mean(axis=1)))
        away_px = np.sqrt(((shifts - shifts[chosen]) ** 2).sum(axis=-1).mean(axis=(1, 2)))
        still = float(self.scores.at(np.zeros_like(shifts[chosen])).mean())
        rivals = by_pair[away_px > SAME_PX * self.scores.scale]
        if by_pair[chosen].mean() <= still or not _beyond_chance(by_pair[chosen], rivals):
            return None
        return self._refined(float(offsets[contest[chosen][0]]), self.maps[chosen]), self.maps[chosen]

    def _best(self, vector: Array) -> tuple[int, Array, Array]:
        """Index of the offset at which rotations (offsets, p, tiles, 3) score best, scores (p,) and shifts there."""
        shifts = self._shifts(vector)
        by_pair = self.scores.at(shifts)
        best = int(np.argmax(by_pair.mean(axis=-1)))
        return best, by_pair[best], shifts[best]

    def _refined(self, offset_s: float, turn: Array) -> float:
        near = offset_s + np.arange(-STEP_S, STEP_S + FINE_STEP_S / 2, FINE_STEP_S)
        support = self.scores.at(self._shifts(self._turns(near) @ turn.T)).mean(axis=-1)
        return float(near[support >= support.max() - 1e-9].mean())

    def _turns(self, offsets_s: Array, backwards: bool = False) -> NDArray[np.float32]:
        """Predicted rotation vectors (offsets, p, tiles, 3), each tile at its row's time."""
        first_s, second_s = (time_s + offsets_s[:, None, None] for time_s in (self.first_s, self.second_s))
        if backwards:
            ends = sum(self.trajectory.span_s)
            first_s, second_s = ends - second_s, ends - first_s
        return gyro_turns(self.trajectory, first_s, second_s).astype(np.float32)

    def _shifts(self, vector: Array) -> Array:
        """Shifts (..., p, tiles, 2) of the tiles, stored pixels, rotated by vectors (..., p, tiles, 3) to second order.

        A tile that moves down the picture is read later, and keeps moving at the same rate until then.
        """
        rays = self.lens.rays(self.scores.centres_px).astype(np.float32)
        once = np.cross(vector, rays)
        turned = rays + once + 0.5 * np.cross(vector, once)
        moved = self.lens.project(turned) - self.scores.centres_px
        lasting = np.maximum(self.second_s - self.first_s, 1e-6)
        return np.asarray(moved * (1 + self._late_s(moved) / lasting)[..., None])

    def _late_s(self, moved: Array) -> Array:
        """Delay (..., p, tiles) of the tiles' readout caused by their shifts."""
        before_px, fraction = self.scores.centres_px, self.clock.readout_fraction
        later = fraction(before_px + moved) - fraction(before_px)
        return np.asarray(row_time_s(0.0, self.clock.profile.shutter.readout_time_s, later))


def _beyond_chance(own: Array, rivals: Array) -> bool:
    """Whether scores of pairs (p,) exceed those of rivals (k, p) significantly, overall and in most time blocks."""
    if len(rivals) < MIN_RIVALS:
        return False
    threshold = -np.log(-np.log1p(-FALSE_ALARMS))
    if _deviations(own.mean(), rivals.mean(axis=1)) < (threshold - GUMBEL_MEAN) / GUMBEL_STD:
        return False
    blocks = np.array_split(np.arange(len(own)), max(len(own) // BLOCK_PAIRS, 1))
    supported = [_deviations(own[block].mean(), rivals[:, block].mean(axis=1)) > BLOCK_SIGMA for block in blocks]
    return float(np.mean(supported)) >= LEAST_BLOCKS


def _deviations(value: float, others: Array) -> float:
    """Excess of a value over the mean of the others (n,), in their standard deviations."""
    return float((value - others.mean()) / max(float(others.std(ddof=1)), 1e-6))
