"""Test a profile on tracked points, and correct a wrong lens, readout, clock skew, gyroscope or stabiliser.

If points lie farther from the profile's prediction than tracking noise explains, each cause is fitted, together with
the values that any profile may have slightly wrong (clock, bias, axes, readout).  The cause that best predicts held-out
time blocks is added, and the next one is searched for in addition.  The result is used only if all causes together
explain most of the contradiction.  A stated readout time gives way to the fitted one where that differs significantly.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np

from virest.arrays import Array, Index, Mask
from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.effects.table import is_sought
from virest.image_formation.point_model import TrackTable, integrate_motion
from virest.image_formation.row_clock import as_global_shutter, right_way_round
from virest.inference.chance import chance_of, chi2_tail
from virest.inference.coarse_alignment import MIN_PAIRS
from virest.inference.fit_start import FitStart
from virest.inference.hold_out import distances, group_means, loss
from virest.inference.observed_tracks import ObservedTracks
from virest.inference.profile_terms import (
    CLOCK_SKEW,
    K1,
    K2,
    STATED_READOUT,
    UNKNOWN_READOUT,
    careful_terms,
    shift_offset,
)
from virest.inference.robust import RAYLEIGH_MEDIAN
from virest.inference.stabiliser_fit import without_idle_ends
from virest.inference.time_blocks import even_blocks, halves
from virest.inference.track_fit import Term, TrackFit, fit_tracks, many_directions, start_scene
from virest.inference.tracking_bias import bias_std
from virest.inference.visual_inertial import START_INVERSE_DEPTH_PER_M
from virest.motion.scene_motion import Motion
from virest.restoration.conflict_causes import CAUSES, SOURCE, TWINS, Cause

log = logging.getLogger(__name__)

CONTRADICTED = 1.3
"""Robust residual, in units of the tracking noise, above which the model is wrong.  Correct profiles leave 0.9 to 1.15
(simulated captures, hand-held and walking); a stabiliser that cancels 10 %, or a focal length 2 % off, leave more than
2."""
MOST_LEFT = 0.5
"""Largest remaining fraction of the contradiction, as variance beyond the tracking noise, for the result to be used."""
HELD_OUT_P = 0.05
"""Significance level, one-sided, of the mean gain on held-out blocks (Student's t): a fit must predict other blocks."""
VALUE_P = 1e-5
"""Significance level of a value, with the tracking bias included in its deviation: with at most fourteen trials, a
false cause is found in about one capture of ten thousand."""
READOUT_DOUBT_S = 0.001
"""Replace a stated readout time that differs by at least this much, s: the first and last rows are then displaced by
the path of half of it, half a pixel at a hand's 1 rad/s and 1000 px.  Of 26 captures with the right one (20 simulated
outside, as phones film, and 6 real) none differs by more than 3.7 deviations."""
TOLD_SIGMA = 3.0
"""A cause is distinguished from its twin if, fitted beside it, it remains above this many standard deviations."""
MAX_CAUSES = 3
"""Of the five causes, two of which are twins, and k₂ beside k₁.  Their rounds have at most 5 + 5 + 4 trials."""
JUDGED = 2
"""Number of causes with plausible values tested on held-out blocks in each round, those that fit best."""
MOST_BENT = 0.2
"""Largest residual, as a part of the points' motion, that a distortion can cause: k₁ changes motion along the radius by
3 k₁ r², 0.2 for −0.3 at r = 0.5.  Beyond it, focal length and distortion explain another recording's gyroscope."""
BLOCKS = 8
"""Time blocks.  Student's t at HELD_OUT_P is then 1.89; with half as many blocks 2.35, with twice as many 1.75."""
POINTS, START_POINTS, STARTS = 1500, 400, 2
"""Number of points in a fit, and in the ranking of starting values; number of starting values that are fitted, each
from the profile before or after the last fit, whichever is nearer."""
TRANSLATION_GAIN = 0.9
"""Include camera translation if it reduces the residual below this fraction of that of rotation alone."""


@dataclass(frozen=True, slots=True)
class Settled:
    """Result of testing a profile on tracked points."""

    profile: CameraProfile
    """The given profile, or the corrected one."""
    contradicted: bool = False
    """Whether the given profile leaves a larger residual than tracking noise explains."""
    taken: tuple[str, ...] = ()
    """Messages about the corrected values."""
    before_px: float = 0.0
    """Robust residual per coordinate with the given profile."""
    after_px: float = 0.0
    """The same with the corrected profile."""
    noise_px: float = 0.0
    """Typical tracking noise between two frames."""
    offset: tuple[float, float] | None = None
    """Clock offset at the profile's readout time, and its standard deviation, s, fitted together with all else."""
    motion_px: float = 0.0
    """Typical motion of a point between frames, on the scale of the residuals."""
    focal: tuple[float, float] | None = None
    """Focal length and its standard deviation, px; None if it was known."""

    @property
    def explained(self) -> float:
        """Fraction of the variance of the points' motion that the resulting profile explains."""
        return 1 - (self.after_px / self.motion_px) ** 2 if self.motion_px else 0.0


def settle_conflict(
    observed: ObservedTracks,
    imu: ImuSamples,
    profile: CameraProfile,
    *,
    offset_known: bool,
    focal_known: bool = True,
    only_readout: bool = False,
) -> Settled:
    """Test a profile on tracked points, and correct the values that they contradict.

    offset_known, focal_known: whether these are stated; otherwise they are fitted freely together with each cause.
    only_readout: test the readout time alone; no cause is searched for.
    """
    observed = observed.covered(imu, profile)
    if profile.intrinsics is None or len(observed.pairs) < MIN_PAIRS:
        return Settled(profile)
    nuisances = careful_terms(profile, offset_known=offset_known, focal_known=focal_known)
    search = _Search(imu, observed.table(POINTS), observed.table(START_POINTS), profile, nuisances)
    base = search.base()
    noise_px = float(np.median(observed.noise_px))
    readout_s, left_px = profile.shutter.readout_time_s, base.scale * noise_px
    motion_px = _motion_px(search.table)
    found = Settled(profile, False, (), left_px, left_px, noise_px, _offset(base, readout_s, noise_px), motion_px)
    found = found if focal_known else replace(found, focal=_focal(base, noise_px))
    if base.scale < CONTRADICTED:
        return search.with_readout(found, base)
    if only_readout:
        return found
    across = search.along_other_axis(base)
    if across is not None and across.scale**2 - 1 < MOST_LEFT * (base.scale**2 - 1):
        turned = search.with_readout(found, across)
        if turned.taken:
            assert turned.offset is not None
            begun = turned.profile if offset_known else replace(turned.profile, time_offset_s=turned.offset[0])
            rest = settle_conflict(observed, imu, begun, offset_known=offset_known, focal_known=focal_known)
            return replace(rest, contradicted=True, taken=(*turned.taken, *rest.taken), before_px=left_px)
    fit, causes = search.add_causes(base)
    log.debug("points lie %.2f off; %s leave %.2f", base.scale, [cause.name for cause in causes], fit.scale)
    if not causes or fit.scale**2 - 1 > MOST_LEFT * (base.scale**2 - 1):
        return replace(found, contradicted=True)
    resolved = profile
    stds = [_std(fit, cause, noise_px) for cause in causes]
    for cause, std in zip(causes, stds, strict=True):
        resolved = cause.adopt(resolved, fit.profile, std)
    messages = tuple(cause.message(profile, fit.profile, std) for cause, std in zip(causes, stds, strict=True))
    messages = tuple(
        text + search.ambiguity_note(fit, causes, cause) for text, cause in zip(messages, causes, strict=True)
    )
    offset = _offset(fit, readout_s, noise_px)
    focal = None if focal_known else _focal(fit, noise_px)
    after_px = fit.scale * noise_px
    settled = Settled(resolved, True, messages, left_px, after_px, noise_px, offset, motion_px, focal)
    return search.with_readout(settled, fit)


def _offset(fit: TrackFit, readout_s: float, noise_px: float) -> tuple[float, float]:
    """Clock offset converted to another readout time at a constant middle-row time, and its standard deviation."""
    offset_s = (fit.profile.time_offset_s or 0.0) + 0.5 * (fit.profile.shutter.readout_time_s - readout_s)
    return offset_s, float(np.hypot(fit.std("time_offset")[0], bias_std(fit, "time_offset", noise_px)[0]))


def _motion_px(table: TrackTable) -> float:
    moved = np.linalg.norm(table.second_px - table.first_px, axis=-1)
    return float(np.median(moved)) / RAYLEIGH_MEDIAN


def _focal(fit: TrackFit, noise_px: float) -> tuple[float, float]:
    assert fit.profile.intrinsics is not None
    focal_px = fit.profile.intrinsics.fx_px
    std = np.hypot(fit.std("focal_length"), bias_std(fit, "focal_length", noise_px))
    return focal_px, focal_px * float(std[0])


def _std(fit: TrackFit, cause: Cause, noise_px: float) -> Array:
    return np.asarray(np.hypot(fit.std(cause.term.name), bias_std(fit, cause.term.name, noise_px)))


@dataclass(frozen=True, slots=True)
class _Start:
    """Starting point of a fit: profile, causes to fit, and camera translation."""

    profile: CameraProfile
    causes: tuple[Cause, ...]
    scene: Motion | None


@dataclass(frozen=True, slots=True)
class _Search:
    """Stepwise search for causes; the fields stay constant during it."""

    imu: ImuSamples
    table: TrackTable
    few: TrackTable
    given: CameraProfile
    nuisances: tuple[Term, ...]

    def base(self) -> TrackFit:
        """Fit of the given profile with its nuisances: rotation only, or with translation if that explains more."""
        plain = self.fit(_Start(self.given, (), None))
        depth_m = self.given.depth_m
        if plain.scale < CONTRADICTED or (depth_m is not None and np.isinf(depth_m)):
            return plain
        travelling = self.fit(_Start(self.given, (), self._travel()))
        return travelling if travelling.scale < TRANSLATION_GAIN * plain.scale else plain

    def _travel(self) -> Motion:
        known = integrate_motion(self.imu, self.given, translation=True)
        if known.displacement is None:
            return many_directions(self.table)
        depth_m = self.given.depth_m
        return start_scene(self.imu, known, self.table, 1 / depth_m if depth_m else START_INVERSE_DEPTH_PER_M)

    def fit(self, start: _Start, use: Mask | None = None) -> TrackFit:
        """Fit the nuisances and the causes; use: (n,) fit these points only, without covariances."""
        table = self.table if use is None else self.table.chosen(use)
        terms = (*self.nuisances, *(cause.term for cause in start.causes))
        return fit_tracks(self.imu, table, start.profile, terms, start.scene, covariances=use is None)

    def along_other_axis(self, base: TrackFit) -> TrackFit | None:
        """Fit of a readout of either sign along the other axis, columns instead of rows; None: no stated readout."""
        if not self.given.readout_known or self.given.shutter.uneven is not None:
            return None
        direction = "top_to_bottom" if self.given.shutter.reads_columns else "left_to_right"
        start = as_global_shutter(self.given, direction)
        terms = tuple(UNKNOWN_READOUT if term is STATED_READOUT else term for term in self.nuisances)
        scene = None if base.scene is None else self._travel()
        return fit_tracks(self.imu, self.table, start, terms, scene)

    def with_readout(self, found: Settled, fit: TrackFit) -> Settled:
        """The result with the fit's readout and offset, where the points contradict the stated time or direction.

        A readout that takes longer than a frame is none.
        """
        stated, fitted = found.profile.shutter, right_way_round(fit.profile)
        same_axis = fit.profile.shutter.reads_columns == stated.reads_columns
        off_s = fit.profile.shutter.readout_time_s - (stated.readout_time_s if same_axis else 0.0)
        if not found.profile.readout_known or stated.uneven is not None or abs(off_s) < READOUT_DOUBT_S:
            return found
        noise_px = float(np.median(self.table.noise_px))
        std_s = float(np.hypot(fit.std("readout_time")[0], bias_std(fit, "readout_time", noise_px)[0]))
        readout_s, direction = fitted.shutter.readout_time_s, fitted.shutter.readout_direction
        period_s = float(np.median(self.table.second_stamp_s - self.table.first_stamp_s))
        if chi2_tail((off_s / std_s) ** 2, 1) >= VALUE_P or readout_s > period_s:
            return found
        profile = found.profile.with_shutter(readout_time_s=readout_s, readout_direction=direction)
        profile = profile.with_estimate("readout_time_s", readout_s, std_s, SOURCE)
        text = f"readout time of {readout_s * 1e3:.2f} ± {std_s * 1e3:.2f} ms"
        instead = f"the profile's {stated.readout_time_s * 1e3:g} ms"
        if direction != stated.readout_direction:
            profile = profile.with_estimate("readout_direction", direction, None, SOURCE)
            text, instead = f"{text} {direction}", f"{instead} {stated.readout_direction}"
        of_middle_s = _offset(fit, readout_s, noise_px)[1]  # the fit keeps the middle row's time
        offset = fitted.time_offset_s or 0.0, float(np.hypot(of_middle_s, 0.5 * std_s))
        taken = (*found.taken, f"{text} used instead of {instead}")
        return replace(found, profile=profile, contradicted=True, taken=taken, offset=offset)

    def add_causes(self, base: TrackFit) -> tuple[TrackFit, tuple[Cause, ...]]:
        """Add causes one by one; returns the fit with all of them, and the causes."""
        here, fit = _Start(self.given, (), None if base.scene is None else self._travel()), base
        while len(here.causes) < MAX_CAUSES and fit.scale >= CONTRADICTED:
            entered = self._next(here, fit)
            if entered is None:
                break
            here, fit = entered
        return fit, here.causes

    def ambiguity_note(self, fit: TrackFit, causes: tuple[Cause, ...], cause: Cause) -> str:
        """Text to append to the message about a cause that points do not distinguish from its twin; else empty."""
        twin = next((other for other in CAUSES if other.name == TWINS.get(cause.name)), None)
        fitted = {term.name for term in (*self.nuisances, *(other.term for other in causes))}
        if twin is None or twin.term.name in fitted:
            return ""
        both = self.fit(_Start(fit.profile, (*causes, twin), fit.scene))
        change = cause.change(self.given, both.profile)
        std = _std(both, cause, float(np.median(self.table.noise_px)))[0]
        return "" if abs(change) > TOLD_SIGMA * std else f" (or a {twin.name}: this motion cannot tell them apart)"

    def _next(self, here: _Start, fit: TrackFit) -> tuple[_Start, TrackFit] | None:
        """The cause with a plausible value that predicts held-out blocks best, if significantly better than none."""
        fitted = {term.name for term in (*self.nuisances, *(cause.term for cause in here.causes))}
        left = fit.scale * float(np.median(self.table.noise_px)) / _motion_px(self.table)
        open_causes = [
            cause
            for cause in CAUSES
            if cause.term.name not in fitted
            and is_sought(cause.term.name, fitted, here.profile)
            and (cause.term not in (K1, K2) or left < MOST_BENT)
        ]
        tried = [best for cause in open_causes if (best := self._best(here, fit, cause)) is not None]
        better = [one for one in tried if one[1].cost < fit.cost and one[1].scale < fit.scale and self._has_value(*one)]
        judged = sorted(better, key=lambda one: one[1].cost)[:JUDGED]
        if not judged:
            return None
        scale = min(found.scale for _, found in judged)
        without, *each = (self._block_loss(self._held_out(*one), scale) for one in ((here, fit), *judged))
        significant = [n for n, loss in enumerate(each) if chance_of(without - loss) < HELD_OUT_P]
        return judged[min(significant, key=lambda n: float(each[n].mean()))] if significant else None

    def _best(self, here: _Start, fit: TrackFit, cause: Cause) -> tuple[_Start, TrackFit] | None:
        """The cause's best fit from its best starts, on the profile as it stood before the last fit and after it."""
        ways = [
            cause.starts(FitStart(self.imu, self.table, profile, here.scene)) for profile in (here.profile, fit.profile)
        ]
        if cause.term is CLOCK_SKEW:
            ways += [[self._at_the_same_offset(profile) for profile in starts] for starts in ways]
        off = np.array([[self._typical_distance(profile, here.scene) for profile in starts] for starts in ways])
        found = []
        for number in np.argsort(off.min(axis=0))[:STARTS]:
            start = _Start(ways[off[:, number].argmin()][number], (*here.causes, cause), here.scene)
            found.append(self._without_idle_ends(start, self.fit(start)))
        return min(found, key=lambda one: one[1].cost, default=None)

    def _at_the_same_offset(self, profile: CameraProfile) -> CameraProfile:
        """A profile with another clock skew, with the given profile's offset in the middle of the capture."""
        middle_s = float(np.mean(self.table.second_stamp_s))
        return shift_offset(profile, np.array([(self.given.clock_skew - profile.clock_skew) * middle_s]))

    def _without_idle_ends(self, start: _Start, fit: TrackFit) -> tuple[_Start, TrackFit]:
        """A fit with its start; both again without a stabiliser's ends, if its lens does not reach them."""
        endless = without_idle_ends(fit)
        if endless is None:
            return start, fit
        start = replace(start, profile=endless)
        return start, self.fit(start)

    def _typical_distance(self, profile: CameraProfile, scene: Motion | None) -> float:
        """Median normalised distance of START_POINTS points from a profile's prediction."""
        fit = fit_tracks(self.imu, self.few, profile, (), scene, max_iterations=0)
        return float(np.median(fit.distance))

    def _has_value(self, start: _Start, fit: TrackFit) -> bool:
        """Whether the last cause has a plausible value that differs significantly from the given one."""
        cause, found = start.causes[-1], fit.profile
        ratio = cause.change(self.given, found) / _std(fit, cause, float(np.median(self.table.noise_px)))[0]
        return cause.plausible(self.given, found) and chi2_tail(ratio**2, 1) < VALUE_P

    def _held_out(self, start: _Start, fit: TrackFit) -> Array:
        """(n,) normalised distances of all points from the predictions of fits without their block."""
        block = self._block()
        distance = np.empty(len(self.table))
        for seen in halves(block):
            own = self.fit(start, seen)
            distance[~seen] = distances(self.imu, own, self.table, fit.depth_spread_per_m)[~seen]
        return distance

    def _block(self) -> Index:
        """(n,) index of each point's time block."""
        return even_blocks(self.table.pair, self.table.n_pairs, min(BLOCKS, self.table.n_pairs))

    def _block_loss(self, distance: Array, scale: float) -> Array:
        """(blocks,) mean Cauchy loss of each block."""
        return group_means(loss(distance, scale), self._block())
