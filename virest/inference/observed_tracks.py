"""Prepare tracked pairs for a geometric fit: usable pairs, their noise, rotations, windows and point table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from virest.arrays import Array, Index, Mask
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.capture.folder import GUESSED_FOCAL
from virest.capture.imu import ImuSamples
from virest.capture.records import Capture
from virest.image_formation.point_model import TrackTable
from virest.image_formation.row_clock import RowClock
from virest.inference.frame_rotations import FrameRotations, picture_rotation
from virest.inference.track_noise import step_noise_px
from virest.inference.tracking import TrackPair

MIN_TRACKS = 15
"""Fewest points of a usable pair."""
WINDOW_S = 3.5
"""Longest time over which accelerations are integrated to a path; the path's noise grows with time to the power 1.5."""
IMU_PAUSE_PERIODS = 3.0
"""Median periods between samples above which the inertial data have a pause; shorter than where a log is split."""
MARGIN_S = 0.02
"""Time at both ends of a pair by which fits may move the clocks, and the shortest pause."""
CELLS, LEAST_IN_CELL, ASTRAY, MOST_ASTRAY = 8, 10, 2.5, 0.5
"""Cells along each side, points of a cell that is judged, and the limits of :meth:`ObservedTracks.astray_cells`."""


@dataclass(frozen=True, slots=True)
class ObservedTracks:
    """Usable pairs, with their frames' timestamps and exposures."""

    pairs: tuple[TrackPair, ...]
    stamp_s: Array
    """(frames,) by movie index, camera clock from stamp_0."""
    exposure_s: Array
    """(frames,) as logged; missing ones are the median, or 0 if most are missing."""
    exposure_known: bool
    noise_px: Array
    """(pairs,) standard deviation of a step per coordinate."""
    lens: Intrinsics
    """The profile's, or a guess."""
    bits_per_px: float = np.inf
    """The movie's, mean; inf: pictures that were not encoded as a movie."""

    @property
    def tracks(self) -> int:
        """Number of tracked points."""
        return sum(map(len, self.pairs))

    def turns(self, profile: CameraProfile) -> FrameRotations:
        """Rotation of every pair, at the middle of the readout and exposure, camera clock."""
        clock = RowClock(profile)
        middle = clock.camera_time_s(clock.middle_s(self.stamp_s, self.exposure_s))
        first, second = ([getattr(pair, name) for pair in self.pairs] for name in ("first", "second"))
        vectors = np.array([picture_rotation(self.lens, pair) for pair in self.pairs]).reshape(-1, 3)
        return FrameRotations(middle[first], middle[second], vectors)

    def chosen(self, use: Mask) -> ObservedTracks:
        """Some of the pairs."""
        kept = tuple(pair for pair, u in zip(self.pairs, use, strict=True) if u)
        return replace(self, pairs=kept, noise_px=self.noise_px[use])

    def spans_s(self, profile: CameraProfile) -> tuple[Array, Array]:
        """Begin of the first frame's exposure and end of the second's, IMU clock, (pairs,) each."""
        shutter = profile.shutter
        start = np.asarray(RowClock(profile).time_s(self.stamp_s, self.exposure_s))
        last = abs(shutter.readout_time_s) + shutter.true_exposure_s(self.exposure_s)
        begin = np.array([start[pair.first] for pair in self.pairs])
        return begin, np.array([start[pair.second] + last[pair.second] for pair in self.pairs])

    def covered(self, imu: ImuSamples, profile: CameraProfile) -> ObservedTracks:
        """The pairs whose frames lie inside the inertial data, without a gap or untrusted stretch between them."""
        begin, end = self.spans_s(profile)
        begin, end = begin - MARGIN_S, end + MARGIN_S
        use = (begin > imu.time_s[0]) & (end < imu.time_s[-1])
        steps = np.diff(imu.time_s)
        for gap in np.flatnonzero(steps > max(MARGIN_S, IMU_PAUSE_PERIODS * float(np.median(steps)))):
            use &= (end < imu.time_s[gap]) | (begin > imu.time_s[gap + 1])
        for from_s, to_s in profile.unbridged_s:
            use &= (end < from_s) | (begin > to_s)
        return self.chosen(use)

    def without_astray(self, first_px: Array, distance: Array) -> tuple[ObservedTracks, float]:
        """Drop image regions that move independently; also returns the dropped fraction of the points."""
        astray = self.astray_cells(first_px, distance)
        if not astray.any():
            return self, 0.0
        return self.without_cells(astray), float(astray[self.cells(first_px)].mean())

    def astray_cells(self, first_px: Array, distance: Array) -> Mask:
        """Mask (CELLS²,) of cells of the picture that move independently: a dashboard, a passer-by.

        first_px (n, 2), distance (n,): points of a fit and their residuals, in standard deviations.  A cell counts if
        its median residual exceeds ASTRAY times the typical cell's; none count if they would hold most points.
        """
        cell = self.cells(first_px)
        counts = np.bincount(cell, minlength=CELLS**2)
        medians = np.zeros(CELLS**2)
        full = np.flatnonzero(counts >= LEAST_IN_CELL)
        for number in full:
            medians[number] = np.median(distance[cell == number])
        astray = medians > ASTRAY * (np.median(medians[full]) if len(full) else np.inf)
        return astray & (counts[astray].sum() <= MOST_ASTRAY * counts.sum())

    def without_cells(self, cells: Mask) -> ObservedTracks:
        """Drop the points that start in some cells (CELLS²,) of the picture, and pairs left with too few points."""
        kept = [_selected(pair, ~cells[self.cells(pair.points_first_px)]) for pair in self.pairs]
        use = np.array([len(pair) >= MIN_TRACKS for pair in kept])
        return replace(self, pairs=tuple(kept)).chosen(use)

    def cells(self, points_px: Array) -> Index:
        """Number of each point's cell."""
        part = points_px * (CELLS / np.array([self.lens.width, self.lens.height]))
        x, y = np.clip(part.astype(np.intp), 0, CELLS - 1).T
        return np.asarray(y * CELLS + x)

    def table(self, max_points: int) -> TrackTable:
        """All points in one table, evenly thinned to about max_points."""
        stride = max(-(-self.tracks // max_points), 1)
        pairs = [_selected(pair, slice(k % stride, None, stride)) for k, pair in enumerate(self.pairs)]
        table = track_table(pairs, self.stamp_s, self.exposure_s, self.noise_px, self._windows())
        return replace(table, bits_per_px=self.bits_per_px)

    def _windows(self) -> list[list[int]]:
        """Equal windows of at most WINDOW_S; a gap of half of it also ends a window."""
        middle = np.array([self.stamp_s[pair.second] for pair in self.pairs])
        parts: list[list[int]] = []
        for run in np.split(np.arange(len(middle)), np.flatnonzero(np.diff(middle) > 0.5 * WINDOW_S) + 1):
            count = max(int(np.ceil((middle[run[-1]] - middle[run[0]]) / WINDOW_S)), 1)
            edges = np.linspace(middle[run[0]], middle[run[-1]], count + 1)[1:-1]
            parts += [list(part) for part in np.split(run, np.searchsorted(middle[run], edges)) if len(part)]
        return parts


def observe_tracks(capture: Capture, pairs: Sequence[TrackPair], profile: CameraProfile) -> ObservedTracks:
    """Keep the pairs with enough points and known timestamps."""
    stamp_s, exposure_s, known = frame_times(capture)
    kept = tuple(
        pair for pair in pairs if len(pair) >= MIN_TRACKS and np.isfinite(stamp_s[[pair.first, pair.second]]).all()
    )
    lens = profile.intrinsics or guessed_lens(profile)
    return ObservedTracks(kept, stamp_s, exposure_s, known, step_noise_px(kept), lens, capture.bits_per_px)


def frame_times(capture: Capture) -> tuple[Array, Array, bool]:
    """(timestamps (frames,) by movie index, exposures (frames,), whether most exposures are logged).

    Missing exposures are the median; if most are missing, all missing ones are 0.
    """
    stamp_s = np.array([frame.time_s for frame in capture.frames], float)
    exposure_s = np.array([np.nan if f.exposure_s is None else f.exposure_s for f in capture.frames], float)
    known = bool(np.isfinite(exposure_s).mean() > 0.5)
    exposure_s = np.where(np.isfinite(exposure_s), exposure_s, np.nanmedian(exposure_s) if known else 0.0)
    return stamp_s, exposure_s, known


def guessed_lens(profile: CameraProfile) -> Intrinsics:
    """The lens of a typical phone's main camera, for an unknown one."""
    return profile.lens_of(GUESSED_FOCAL * max(profile.width, profile.height))


def _selected(pair: TrackPair, rows: Mask | slice) -> TrackPair:
    return replace(pair, points_first_px=pair.points_first_px[rows], points_second_px=pair.points_second_px[rows])


def track_table(
    pairs: Sequence[TrackPair],
    stamp_s: Array,
    exposure_s: Array,
    noise_px: Array,
    windows: Sequence[Sequence[int]] | None = None,
) -> TrackTable:
    """The table of all pairs' points; stamp_s, exposure_s (frames,) by movie index, exposure 0 where unknown.

    windows: numbers of the pairs in each window; None: one window.
    """
    windows = windows or [range(len(pairs))]
    sizes = [len(pair) for pair in pairs]
    first = np.repeat([pair.first for pair in pairs], sizes)
    second = np.repeat([pair.second for pair in pairs], sizes)
    number = np.zeros(len(pairs), np.intp)
    for k, members in enumerate(windows):
        number[list(members)] = k
    middles = np.array([0.5 * (stamp_s[pair.first] + stamp_s[pair.second]) for pair in pairs])
    origin = np.array([middles[number == k].mean() if (number == k).any() else 0.0 for k in range(len(windows))])
    return TrackTable(
        np.repeat(np.arange(len(pairs)), sizes),
        np.repeat(number, sizes),
        first,
        second,
        np.concatenate([pair.points_first_px for pair in pairs]),
        np.concatenate([pair.points_second_px for pair in pairs]),
        stamp_s[first],
        stamp_s[second],
        exposure_s[first],
        exposure_s[second],
        origin,
        noise_px,
    )
