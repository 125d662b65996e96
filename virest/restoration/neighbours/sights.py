"""Stream of frames, each with its neighbours in the movie."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Picture
from virest.camera.response import ResponseCurve
from virest.capture.folder import Frame
from virest.capture.frame_coding import FrameCoding
from virest.capture.pixels import BT601_LUMA
from virest.image_formation.blur import Image
from virest.image_formation.kernel_spread import kernel_spread
from virest.image_formation.kernels import KernelField, kernel_field
from virest.image_formation.light import flicker_of_rows, frame_light
from virest.image_formation.neighbour import NeighbourView, neighbour_view
from virest.image_formation.row_clock import ROW_MIDDLE
from virest.image_formation.row_motion import RowMotion
from virest.motion.optics import MovingLens
from virest.motion.trajectory import Trajectory
from virest.restoration.neighbours.joint import (
    ComparedNeighbours,
    NeighbourRegistration,
    half_size,
    is_detailed,
    most_useful,
    register_neighbour,
    resample_neighbour,
    rings_passed,
)
from virest.restoration.neighbours.own_motion import moves_on_its_own
from virest.restoration.neighbours.reduced_tiles import reduced, reduced_light
from virest.restoration.neighbours.refinement import MissingTurn, RefinedMotion, uncertain_rate_rad_s, unmeasured_turn
from virest.restoration.neighbours.registration import (
    FrameTiles,
    PairTurn,
    frame_tiles,
    pair_turn,
    tile_agreement,
)
from virest.restoration.statistics.records import PictureStatistics
from virest.restoration.statistics.rings import RINGS

TYPICAL_WEIGHTS = (1.0, 0.95, 0.85)
"""Mean weights of neighbours one, two, and three or more frames away, all neighbours included: on four simulated
captures, a shake, a pan, a walk and photographs."""


@dataclass(frozen=True, slots=True)
class Sight:
    """One decoded frame with its predicted motion."""

    frame: Frame
    picture: NDArray[np.uint8]
    """(height, width, 3) RGB, or the luma alone, (height, width)."""
    motion: RowMotion | None
    """None: focal length unknown."""
    outside: str = ""
    """Why its motion is unknown, if it reaches beyond the inertial data; else empty."""
    recorded: NDArray[np.uint8] | None = None
    """The recorded picture, if the phone's sharpening was undone in ``picture``; None: ``picture`` is as recorded."""
    coding: FrameCoding | None = None
    """How it was coded; None: unknown."""

    @property
    def usable(self) -> bool:
        """Whether its motion and exposure are known, so that it can be compared with its neighbours."""
        return self.motion is not None and not self.outside and self.motion.exposure_s > 0

    @property
    def coding_step(self) -> float | None:
        """The coder's quantiser step, grey levels; None: unknown."""
        return None if self.coding is None else self.coding.step


def with_neighbours(
    sights: Iterable[Sight], reach: int
) -> Iterator[tuple[tuple[Sight, ...], Sight, tuple[Sight, ...]]]:
    """Yield each frame with up to ``reach`` frames before and after it, in order; holds 2 reach + 1 at a time."""
    window: deque[Sight] = deque()
    here = 0
    for sight in sights:
        window.append(sight)
        if len(window) - here > reach:
            yield _around(window, here, reach)
            here += 1
        if here > reach:
            window.popleft()
            here -= 1
    for last in range(here, len(window)):
        yield _around(window, last, reach)


def _around(window: Sequence[Sight], here: int, reach: int) -> tuple[tuple[Sight, ...], Sight, tuple[Sight, ...]]:
    sights = tuple(window)
    return sights[max(here - reach, 0) : here], sights[here], sights[here + 1 : here + 1 + reach]


class FrameNeighbours:
    """Uses neighbours to refine each frame's motion, and registers them for joint restoration.

    Each pair of frames is compared once and the result reused.
    """

    def __init__(self, trajectory: Trajectory, lens: MovingLens, missing: MissingTurn | None) -> None:
        """lens: of the whole trajectory.  missing: the capture's missing rotation; None: none."""
        self._trajectory, self._lens, self._missing = trajectory, lens, missing
        self._light: dict[int, Image] = {}
        self._full: dict[int, tuple[Image, Image]] = {}
        self._passed: dict[int, Array] = {}
        self._turns: dict[int, PairTurn | None] = {}

    def refined(self, before: Sequence[Sight], here: Sight, after: Sequence[Sight]) -> RefinedMotion | None:
        """The frame's motion refined by its neighbours; None if it lacks no rotation, and its rates are certain.

        Pairs that are not consecutive in the movie are not used.
        """
        assert here.motion is not None
        self._forget_before(here.frame.index - max(len(before), 1))
        missing, uncertain_rad_s = self._missing, uncertain_rate_rad_s(here.motion)
        if uncertain_rad_s:
            missing = unmeasured_turn(uncertain_rad_s) if missing is None else missing.beside(uncertain_rad_s)
        if missing is None:
            return None
        turns = [self.turn(first, second) for first, second in pairwise((*before, here, *after))]
        return missing.refined(here.motion, turns[: len(before)][::-1], turns[len(before) :], self._trajectory)

    def checked(
        self,
        adjacent: Sequence[Sight],
        here: Sight,
        refined: RefinedMotion | None,
        least_px: float,
        luma: PictureStatistics,
        field: Callable[[Array], KernelField],
    ) -> ComparedNeighbours:
        """Compare a frame that is restored alone with adjacent ones, if anything in it moves on its own.

        Points tracked into one of them tell, at less than a tenth of its cost.  least_px: path per exposure that
        matters; see :func:`moves_on_its_own`.  luma, field: see :meth:`joined`.
        """
        assert here.motion is not None
        usable = [other for other in adjacent if other.usable and not _same_instant(here.motion, other.motion)]
        if not usable:
            return ComparedNeighbours()
        view = self._view(here, usable[0], refined)
        if not moves_on_its_own(view, _luma(here), _luma(usable[0]), least_px):
            return ComparedNeighbours()
        tiles = frame_tiles(self.light(here), here.motion.profile, field, everywhere=True)
        if tiles is None:
            return ComparedNeighbours()
        found = (self._registration(here, other, refined, tiles, luma) for other in usable)
        return ComparedNeighbours(tuple(one for one in found if one is not None))

    def joined(
        self,
        around: Sequence[Sight],
        here: Sight,
        refined: RefinedMotion | None,
        most: int,
        luma: PictureStatistics,
        field: Callable[[Array], KernelField],
    ) -> ComparedNeighbours:
        """Register at most ``most`` of a frame's neighbours, chosen by how much they reduce the ideal filter's error.

        A neighbour's weight is first predicted from its distance in frames.  Once registered, the measured weight
        counts, and neighbours at least as far from the frame are expected to lose as much: in scenes with relief,
        nearer neighbours are then preferred.

        luma: the frame's statistics.  field: its kernels.
        """
        assert here.motion is not None
        left = {other.frame.index: other for other in around if other.usable and other.frame.index != here.frame.index}
        if not left:
            return ComparedNeighbours()
        tiles = frame_tiles(self.light(here), here.motion.profile, field, everywhere=True)
        found: dict[int, NeighbourRegistration] = {}
        taken: list[int] = []
        sights = dict(left)
        passed = {n: _coding_noise_ratio(other, here) * self._passed_of(other, here) for n, other in left.items()}
        while tiles is not None and left and len(taken) < most:
            sum_taken = np.sum([np.zeros(RINGS), *(passed[number] for number in taken)], axis=0)
            number = list(left)[most_useful([passed[n] for n in left], sum_taken, luma)]
            if number in found:
                taken.append(number)
                del left[number]
                continue
            registration = self._registration(here, left[number], refined, tiles, luma)
            if registration is None or registration.weight == 0:
                del left[number]
                continue
            found[number] = registration
            measured = registration.passed(luma.frequency)
            share = np.minimum(measured / np.maximum(passed[number], 1e-12), 1.0)
            apart = abs(number - here.frame.index)
            for other in left:
                if other not in found and abs(other - here.frame.index) >= apart:
                    passed[other] = passed[other] * share
            passed[number] = measured
        detailed = {n: is_detailed(replace(luma, passed=self._passed[n])) for n in taken}
        pictures = (resample_neighbour(found[n], *self._full_of(sights[n]), detailed[n]) for n in sorted(taken))
        return ComparedNeighbours(tuple(found[n] for n in sorted(taken)), tuple(pictures))

    def _registration(
        self, here: Sight, other: Sight, refined: RefinedMotion | None, tiles: FrameTiles, luma: PictureStatistics
    ) -> NeighbourRegistration | None:
        """Register a neighbour to the frame; None if it shows different content or its path is too long."""
        assert here.motion is not None
        assert other.motion is not None
        curve, view = here.motion.profile.curve, self._view(here, other, refined)
        along = view.field()
        agreement = tile_agreement(view, tiles, along, self.light(other))
        if agreement is None:
            return None
        level = 255 * float(curve.encode(np.array(agreement.light)))
        slope = float(np.interp(level, np.arange(256), curve.slope_table()))
        error = agreement.expected_error(luma.frequency, luma.noise, slope)
        registration = register_neighbour(view, along, other.frame.index, agreement, error)
        if registration is None:
            return None
        spread = None
        if refined is not None:  # the rate is as uncertain in the neighbour as in the frame
            profile, of_path = here.motion.profile, replace(refined, motion=other.motion).path_covariance_px2()
            spread = kernel_spread(along, profile.width, profile.height, of_path)
        return replace(registration, coding_noise_ratio=_coding_noise_ratio(other, here), spread=spread)

    def _view(self, here: Sight, other: Sight, refined: RefinedMotion | None) -> NeighbourView:
        assert here.motion is not None
        assert other.motion is not None
        further = refined.further if refined else None
        return neighbour_view(here.motion, other.motion, self._trajectory, self._lens, further=further)

    def with_missing_turn(self, missing: MissingTurn | None) -> FrameNeighbours:
        """A copy with the capture's missing rotation, which shares the pair comparisons made so far."""
        found = FrameNeighbours(self._trajectory, self._lens, missing)
        found._light, found._turns = self._light, self._turns
        return found

    def turn(self, first: Sight, second: Sight) -> PairTurn | None:
        """The rotation rate missing between two frames; None if not consecutive, or if either is unusable."""
        number = first.frame.index
        if second.frame.index != number + 1:
            return None
        if not first.usable or not second.usable:
            return None
        if number not in self._turns:
            self._turns[number] = turn_between(
                first, second, self.light(first), self.light(second), self._trajectory, self._lens
            )
        return self._turns[number]

    def light(self, sight: Sight) -> Image:
        """A usable frame's luma in linear light, reduced and cached."""
        if sight.frame.index not in self._light:
            self._light[sight.frame.index] = light_of(sight)
        return self._light[sight.frame.index]

    def _passed_of(self, sight: Sight, here: Sight) -> Array:
        """(RINGS,) mean |K|² over a neighbour's picture, times the typical weight at its distance from the frame."""
        assert sight.motion is not None
        if sight.frame.index not in self._passed:
            width, height = sight.motion.profile.width, sight.motion.profile.height
            x, y = (np.linspace(0.1, 0.9, count) * (size - 1) for count, size in ((3, width), (2, height)))
            centres_px = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
            self._passed[sight.frame.index] = rings_passed(kernel_field(sight.motion, centres_px))
        apart = abs(sight.frame.index - here.frame.index)
        return TYPICAL_WEIGHTS[min(apart, len(TYPICAL_WEIGHTS)) - 1] * self._passed[sight.frame.index]

    def _full_of(self, sight: Sight) -> tuple[Image, Image]:
        if sight.frame.index not in self._full:
            self._full[sight.frame.index] = _luma_and_half(sight)
        return self._full[sight.frame.index]

    def _forget_before(self, number: int) -> None:
        for kept in (self._light, self._full, self._passed, self._turns):
            for old in [n for n in kept if n < number]:
                del kept[old]  # type: ignore[attr-defined]


def _coding_noise_ratio(other: Sight, here: Sight) -> float:
    """The frame's noise over the neighbour's, as the ratio of their coding steps; 1 if these are unknown.

    Coding noise grew as the step to the power of 1.15 between frames on five simulated captures at 0.25 bits per pixel
    (40 frames, correlation 0.86): less than as its square, since the coder drops what lies below the step.
    """
    if here.coding_step is None or other.coding_step is None:
        return 1.0
    return here.coding_step / other.coding_step


def _same_instant(first: RowMotion, second: RowMotion | None) -> bool:
    """Whether the second frame is a repeat of the first: it shows the same instant."""
    return second is not None and first.start_s == second.start_s


def _luma(sight: Sight) -> Picture:
    """A frame's luma, (height, width), grey levels."""
    return sight.picture if sight.picture.ndim == 2 else cv2.cvtColor(sight.picture, cv2.COLOR_RGB2GRAY)


def light_of(sight: Sight) -> Image:
    """A frame's luma in linear light, reduced, without flicker."""
    assert sight.motion is not None
    luma = _luma(sight)
    light, rows = reduced_light(luma, _linear(sight.motion.profile.curve)), flicker_of_rows(sight.motion)
    return light if rows is None else light / reduced(np.broadcast_to(rows, luma.shape))


def _luma_and_half(sight: Sight) -> tuple[Image, Image]:
    """Luma of a frame's linear light, (height, width), and its light at half the size, (height / 2, width / 2, 3).

    Without flicker and vignetting, as the frame is deblurred.
    """
    assert sight.motion is not None
    light = cv2.LUT(sight.picture, _linear(sight.motion.profile.curve))
    factors = frame_light(sight.motion, ROW_MIDDLE, straighten=False)
    if factors is not None:
        light /= factors.recorded[..., None]
    weights = np.array([BT601_LUMA], np.float32)
    return np.asarray(cv2.transform(light, weights), np.float32), half_size(light)


@lru_cache(maxsize=4)
def _linear(curve: ResponseCurve) -> NDArray[np.float32]:
    return curve.linear_table()


def turn_between(
    first: Sight, second: Sight, first_light: Image, second_light: Image, trajectory: Trajectory, lens: MovingLens
) -> PairTurn | None:
    """The rotation rate missing between two frames; None if either is unusable.  lens: of the trajectory."""
    if not first.usable or not second.usable:
        return None
    assert first.motion is not None
    assert second.motion is not None
    if _same_instant(first.motion, second.motion):
        return None
    return pair_turn(neighbour_view(first.motion, second.motion, trajectory, lens), first_light, second_light)
