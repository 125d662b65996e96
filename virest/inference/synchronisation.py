"""Synchronise frames and gyroscope: the time offset, the gyroscope's bias, and whether the two agree at all.

Coarse: compare rotations of frames and gyroscope at every offset within the search.  Fine: fit every tracked point at
its own row's time (track_fit), with small errors of a careful profile as further terms.  Clock drift is fitted about
the middle of the points, where it is uncorrelated with the offset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.camera.shutter import Shutter
from virest.capture.imu import ImuSamples
from virest.image_formation.point_model import TrackTable
from virest.image_formation.row_clock import as_global_shutter, right_way_round
from virest.inference.chance import chi2_tail, student_tail
from virest.inference.coarse_alignment import MIN_EXPLAINED, MIN_MOTION_PX, MIN_PAIRS, SEARCH_S, STEP_S, align_coarsely
from virest.inference.frame_rotations import FrameRotations, gyro_turns
from virest.inference.observed_tracks import MIN_TRACKS, ObservedTracks
from virest.inference.profile_terms import CLOCK_SKEW, SMALL_BIAS, careful_terms, shift_offset
from virest.inference.track_fit import Term, TrackFit, fit_directed, fit_tracks, for_table, many_directions
from virest.inference.tracking_bias import bias_std
from virest.motion.integration import integrate_gyro
from virest.motion.optics import settling_time_s

POINTS = 2500
"""Most tracked points used in the fit; more are thinned evenly."""
IMU_MARGIN_S = 0.5
"""Samples beyond the first and the last row that a fit keeps; half or twice changes the offset by less than 0.001 σ."""
TRANSLATION_RATIO = 1.25
"""The camera translates if residuals are this much larger in all directions than across the best parallax."""
MAX_STD_S = 0.02
"""Largest standard deviation of an offset that is used: 0.6 of a frame's period at 30 frames per second."""
UNKNOWN_EXPOSURE_STD_S = 0.008
"""Half of an unknown exposure, in the mean of 0 to 1/30 s."""
UNKNOWN_READOUT_STD_S = 0.003
"""Smallest standard deviation of a fitted readout, since lens and parallax also shear the picture."""
MAX_FOCAL_RESIDUAL = 1.5
"""Largest residual, in units of tracking noise, for which a fitted focal length is reported.  A stabiliser that cancels
0.1 of the motion makes it 8 to 9 % too short and leaves residuals of 3.5 to 1.7 at 0.1 to 0.2 px of noise; a principal
point 9 px off leaves 1.15 to 1.4, with focal errors below 0.1 % (tracks from three analytic motions)."""
MAX_FOCAL_SPREAD = 0.25
"""Largest relative standard deviation of a focal length that is reported."""
DRIFT_P, LEAST_DRIFT = 1e-3, 5e-4
"""A drift is noted if it is larger, s per s, and chance makes one as significant with a smaller probability: Student's
distribution with the time blocks that inform it, of which half a second has few."""
NEAR_S = 0.01
"""What the gyroscope explains at a fitted offset is read within this of it: 2.5 steps of the search."""
FOREIGN_BIAS = 4.0
"""A bias further from the profile's than this many prior σ absorbs an unmodelled scene, lens or axis map."""
READINGS = (
    (np.pi / 180, True, "read as degrees per second"),
    (-1.0, True, "with its sign reversed"),
    (-np.pi / 180, True, "read as degrees per second with its sign reversed"),
    (-1.0, False, "with one axis reversed, or two swapped,"),
)
"""Factor on the gyroscope's log that undoes a recorder's mistake, and whether the axes are then the profile's."""
RIGHT_ANGLES = np.array(
    [
        np.diag(signs) @ np.eye(3)[list(order)]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
        if np.linalg.det(np.diag(signs) @ np.eye(3)[list(order)]) > 0
    ]
)
"""(24, 3, 3) all rotations that turn axes into axes."""
MOST_REMAINING = 0.5
"""Axes are found if they leave less than this part of what the second best leave unexplained."""
DIRECTION_COST = 12.0
"""Minimum cost difference, in squared residual scales, between readouts along rows and along columns."""
READOUT_P = 1e-5
"""Significance level of a readout time that no profile states."""
AGREEMENT_SLACK_S = 0.03
"""Smaller errors of the offset are left to calibration; they do not mean that frames and gyroscope disagree."""
CLEARLY_BETTER = 30.0
"""Chi-square (1 degree of freedom) above which another offset is clearly better; well above 9, because errors of pairs
are correlated."""


@dataclass(frozen=True, slots=True)
class OffsetEstimate:
    """The time offset and the values fitted with it; t_imu = t_cam (1 + clock_skew) + time_offset_s."""

    time_offset_s: float
    """At the middle of the points, with the profile's readout and timestamp reference."""
    std_s: float
    """Includes model uncertainty; inf if not determined."""
    determined: bool
    """Whether the offset may be used."""
    reason: str = ""
    """Why not, or a caveat; may be empty."""
    explained: float = float("nan")
    """Fraction of the frames' changing rotation that the gyroscope explains, at most 1."""
    bias_rad_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Gyroscope bias, IMU axes, as profiles hold it."""
    bias_std_rad_s: tuple[float, float, float] = (float("nan"),) * 3
    """NaN if it is not determined, or if it may have absorbed parallax."""
    readout_s: float = 0.0
    """Fitted; negative if the rows are read in the opposite direction."""
    drift_s_per_s: float = 0.0
    """Drift of the offset: a clock skew beyond the profile's."""
    focal_px: float | None = None
    """Fitted if the profile has none, the residuals are small and the motion determines it to MAX_FOCAL_SPREAD."""
    focal_std_px: float | None = None
    travels: bool = False
    """Whether the camera translates, so that only residuals across the parallax were used."""
    other_axes: bool = False
    """Whether the frames do follow the gyroscope, but with other axes than the profile's."""


@dataclass(frozen=True, slots=True)
class Agreement:
    """Whether the frames follow the gyroscope."""

    agrees: bool
    reason: str = ""
    tested: bool = True
    """Whether there were enough points and samples for the test."""
    explained: float = float("nan")
    """Fraction of the frames' changing rotation that the gyroscope explains at the profile's offset; NaN: unknown."""
    best_offset_s: float | None = None
    """Another offset at which they agree, or agree clearly better; None: there is none, or none is needed."""


# ── the time offset ──────────────────────────────────────────────────────────────────────────────────────────────


def estimate_time_offset(
    observed: ObservedTracks, imu: ImuSamples, profile: CameraProfile, search_s: float = SEARCH_S
) -> OffsetEstimate:
    """Find the time offset within ± search_s of the profile's (of 0 if unknown), and the gyroscope's bias.

    Never raises for poor data: the result then is not determined, with a reason.
    """
    start_s, free_focal = profile.time_offset_s or 0.0, profile.intrinsics is None
    if reason := _too_few(observed, imu):
        return OffsetEstimate(start_s, float("inf"), False, reason)
    turns = observed.turns(profile)
    coarse = align_coarsely(turns, imu, profile, search_s, own_axes=True, free_focal=free_focal)
    if coarse is None:
        reason = "the inertial data do not cover the frames at any searched offset"
        return OffsetEstimate(start_s, float("inf"), False, reason)
    if (doubt := coarse.doubt(len(observed.pairs), observed.lens.fx_px)) is not None:
        still = coarse.motion_rad * observed.lens.fx_px < MIN_MOTION_PX
        explained = float("nan") if still else coarse.explained
        turned = "" if still or explained >= MIN_EXPLAINED else _with_other_axes(observed, imu, profile, search_s)
        return OffsetEstimate(start_s, float("inf"), False, turned or doubt[0], explained, other_axes=bool(turned))
    lens = profile.intrinsics or observed.lens.scaled_focal(coarse.gain)
    start = replace(profile, time_offset_s=coarse.time_offset_s, intrinsics=lens)
    found = refine_time_offset(observed, imu, start, focal_known=not free_focal)
    found = replace(found, explained=coarse.explained_near(found.time_offset_s, NEAR_S))
    if found.determined and abs(found.time_offset_s - start_s) > search_s:
        return replace(found, determined=False, reason=f"the offset left the search range (±{search_s:g} s)")
    if found.determined and found.explained < MIN_EXPLAINED:
        reason = f"at the fitted offset the gyroscope explains only {max(found.explained, 0.0):.0%} of the rotation"
        return replace(found, determined=False, reason=reason)
    return found


def refine_time_offset(
    observed: ObservedTracks, imu: ImuSamples, start: CameraProfile, *, focal_known: bool = True
) -> OffsetEstimate:
    """Fit the offset to tracked points, from a profile whose offset is correct to a few hundredths of a second."""
    assert start.time_offset_s is not None
    covered = observed.covered(imu, start)
    if len(covered.pairs) < MIN_PAIRS:
        reason = f"only {len(covered.pairs)} pairs of frames lie inside the inertial data"
        return OffsetEstimate(start.time_offset_s, float("inf"), False, reason)
    table = covered.table(POINTS)
    first_s, last_s = float(table.first_stamp_s.min()), float(table.second_stamp_s.max())
    middle_s = float(np.mean(0.5 * (table.first_stamp_s + table.second_stamp_s)))
    margin_s = IMU_MARGIN_S + settling_time_s(start)
    imu = imu.between(float(start.imu_time_s(first_s)) - margin_s, float(start.imu_time_s(last_s)) + margin_s)

    def skewed(profile: CameraProfile, v: Array) -> CameraProfile:
        return shift_offset(CLOCK_SKEW.change(profile, v), -middle_s * v)

    skew = replace(CLOCK_SKEW, change=skewed, prior_std=(0.005,))
    terms = (*careful_terms(start, offset_known=False, focal_known=focal_known), skew)
    fit = _simplest(imu, table, start, terms)
    covered, astray = covered.without_astray(table.first_px, fit.distance)
    if astray and len(covered.pairs) >= MIN_PAIRS:
        table = covered.table(POINTS)
        fit = fit_tracks(imu, table, fit.profile, terms, for_table(fit.scene, table))
    spread_s = float(np.std(0.5 * (table.first_stamp_s + table.second_stamp_s) - middle_s))
    return _concluded(fit, observed, start, middle_s, spread_s, focal_known)


def _simplest(imu: ImuSamples, table: TrackTable, start: CameraProfile, terms: Sequence[Term]) -> TrackFit:
    """The fit with rotation alone, or with directions of travel if the points need them."""
    rotating = fit_tracks(imu, table, start, terms)
    if start.depth_m is not None and np.isinf(start.depth_m):
        return rotating
    many = fit_tracks(imu, table, rotating.profile, terms, many_directions(table))
    if rotating.scale < TRANSLATION_RATIO * many.scale:
        return rotating
    return fit_directed(imu, table, rotating.profile, terms, many)


def _concluded(
    fit: TrackFit, observed: ObservedTracks, start: CameraProfile, middle_s: float, spread_s: float, focal_known: bool
) -> OffsetEstimate:
    found, noise_px, notes = fit.profile, float(np.median(observed.noise_px)), []

    def std(name: str) -> Array:
        return np.asarray(np.hypot(fit.std(name), bias_std(fit, name, noise_px)))

    readout_off_s, drift = (
        found.shutter.readout_time_s - start.shutter.readout_time_s,
        found.clock_skew - start.clock_skew,
    )
    offset_s = (found.time_offset_s or 0.0) + 0.5 * readout_off_s + drift * middle_s
    variance, readout_std_s, drift_std = std("time_offset")[0] ** 2, std("readout_time")[0], std("clock_skew")[0]
    if start.readout_known:
        variance += 0.25 * max(readout_off_s**2 - readout_std_s**2, 0.0)
    else:
        variance += 0.25 * (readout_std_s**2 + UNKNOWN_READOUT_STD_S**2)
        notes.append("readout unknown: only the sum of the offset and half the readout is well determined")
    determined = bool(np.sqrt(variance) <= MAX_STD_S)
    if not determined:
        notes = [f"the motion does not determine the offset (standard deviation {1e3 * np.sqrt(variance):.0f} ms)"]
    if not observed.exposure_known:
        variance += UNKNOWN_EXPOSURE_STD_S**2
        notes.append("exposure unknown: the offset includes half of it")
    freedom = max(float(fit.stretches[fit.slices["clock_skew"]][0]) - 1, 1.0)
    if abs(drift) > LEAST_DRIFT and 2 * student_tail(abs(drift) / drift_std, freedom) < DRIFT_P:
        variance += (drift * np.hypot(middle_s, spread_s)) ** 2
        notes.append(f"the offset drifts by {1e3 * drift:.2f} ms per second: the clocks run at different rates")
    bias_std_rad_s = std("gyro_bias")
    changed = np.abs(np.subtract(found.gyro_bias_rad_s, start.gyro_bias_rad_s)) / np.array(SMALL_BIAS.prior_std)
    if fit.scene is not None or np.max(changed) > FOREIGN_BIAS:
        bias_std_rad_s = np.full(3, np.nan)
    focal_px, focal_std_px = None, None
    fits = not focal_known and fit.scale < MAX_FOCAL_RESIDUAL
    if fits and found.intrinsics is not None and (spread := std("focal_length")[0]) <= MAX_FOCAL_SPREAD:
        focal_px, focal_std_px = found.intrinsics.fx_px, float(found.intrinsics.fx_px * spread)
    return OffsetEstimate(
        offset_s, float(np.sqrt(variance)), determined, "; ".join(notes), float("nan"), found.gyro_bias_rad_s,
        tuple(bias_std_rad_s.tolist()), found.shutter.readout_time_s, drift, focal_px, focal_std_px,
        fit.scene is not None,
    )  # fmt: skip


def _too_few(observed: ObservedTracks, imu: ImuSamples) -> str:
    if len(observed.pairs) < MIN_PAIRS:
        return f"{len(observed.pairs)} pairs of frames have {MIN_TRACKS} or more tracked points; {MIN_PAIRS} are needed"
    return f"only {len(imu)} gyroscope samples" if len(imu) < 8 else ""


# ── agreement ────────────────────────────────────────────────────────────────────────────────────────────────────


def check_agreement(observed: ObservedTracks, imu: ImuSamples, profile: CameraProfile) -> Agreement:
    """Check whether the frames rotate as the gyroscope measures at the profile's offset ± AGREEMENT_SLACK_S.

    Bias and steady drift are free; moving objects and parallax have little weight.  Too few data count as agreement,
    since nothing contradicts the gyroscope.
    """
    if reason := _too_few(observed, imu):
        return Agreement(True, f"too few data to tell: {reason}", tested=False)
    offset_s, focal_px, turns = profile.time_offset_s or 0.0, observed.lens.fx_px, observed.turns(profile)
    seen_px, predicted_px = (focal_px * changes for changes in _changes_rad(turns, imu, profile))
    if max(_rms(seen_px), _rms(predicted_px)) < MIN_MOTION_PX:
        return Agreement(True, "too little motion to tell")
    free_focal = profile.intrinsics is None
    coarse = align_coarsely(turns, imu, profile, own_axes=True, free_focal=free_focal)
    explained = -np.inf if coarse is None else coarse.explained_near(offset_s, AGREEMENT_SLACK_S)
    if coarse is None or not np.isfinite(explained):
        return Agreement(True, "too few data to tell: no inertial data at the frames")
    if explained >= MIN_EXPLAINED:
        better = _clearly_better(coarse.offset_s, coarse.explained_at, offset_s, 3 * len(observed.pairs))
        return Agreement(True, explained=explained, best_offset_s=better)
    elsewhere = None if coarse.doubt(len(observed.pairs), focal_px) else coarse.time_offset_s
    if elsewhere is not None:
        hint = f"at an offset of {elsewhere:+.3f} s it would explain {coarse.explained:.0%}"
    else:
        hint = _with_other_axes(observed, imu, profile, SEARCH_S) or other_reading(observed, imu, profile)
        hint = hint or "was the movie stabilised in the camera, or is it from another recording?"
    reason = f"the gyroscope explains {max(explained, 0.0):.0%} of the frames' rotation: {hint}"
    return Agreement(False, reason, explained=explained, best_offset_s=elsewhere)


def shown_axes(observed: ObservedTracks, imu: ImuSamples, profile: CameraProfile) -> CameraProfile | None:
    """The profile with its axes turned by right angles, as the frames show: sensors are mounted along a phone's edges.

    None if no such axes agree, or if others agree nearly as well, as with motion about one axis alone.
    """
    turns, own = observed.turns(profile), profile.rotation_cam_imu
    turned = [replace(profile, r_cam_imu=tuple(map(tuple, (turn @ own).tolist()))) for turn in RIGHT_ANGLES]
    tried = [align_coarsely(turns, imu, one, own_axes=True) for one in turned]
    if None in tried:
        return None
    left = np.array([1 - one.explained for one in tried if one is not None])
    best, second = np.argsort(left)[:2]
    agree = 1 - left[best] >= MIN_EXPLAINED and left[best] < MOST_REMAINING * left[second]
    return replace(turned[best], axes_known=True) if agree else None


def shown_readout(
    observed: ObservedTracks, imu: ImuSamples, profile: CameraProfile, *, offset_known: bool, focal_known: bool
) -> tuple[Shutter, float] | None:
    """The profile's shutter with the readout time and direction that the points show, and the time's deviation.

    The readout takes either sign along rows or columns; the middle row keeps its time.  offset_known, focal_known:
    whether these are stated; otherwise they are fitted too.  None where the points do not tell the four directions
    apart, or show no readout, or one that takes longer than a frame.
    """
    observed = observed.covered(imu, profile)
    if len(observed.pairs) < MIN_PAIRS:
        return None
    table, noise_px = observed.table(POINTS), float(np.median(observed.noise_px))
    unknown = replace(profile, readout_known=False)
    terms = careful_terms(unknown, offset_known=offset_known, focal_known=focal_known)
    fits = [
        _simplest(imu, table, as_global_shutter(profile, direction), terms)
        for direction in ("top_to_bottom", "left_to_right")
    ]
    best, other = sorted(fits, key=lambda fit: fit.cost)
    std_s = float(np.hypot(best.std("readout_time")[0], bias_std(best, "readout_time", noise_px)[0]))
    found = right_way_round(best.profile)
    readout_s, period_s = found.shutter.readout_time_s, float(np.median(table.second_stamp_s - table.first_stamp_s))
    clear = other.cost - best.cost > DIRECTION_COST * best.scale**2
    if not clear or readout_s > period_s or chi2_tail((readout_s / std_s) ** 2, 1) >= READOUT_P:
        return None
    direction = found.shutter.readout_direction
    return replace(profile.shutter, readout_time_s=readout_s, readout_direction=direction), std_s


def _with_other_axes(observed: ObservedTracks, imu: ImuSamples, profile: CameraProfile, search_s: float) -> str:
    """What the gyroscope explains with other axes than the profile's; empty: not enough either."""
    coarse = align_coarsely(observed.turns(profile), imu, profile, search_s)
    if coarse is None or not coarse.axes_changed or coarse.doubt(len(observed.pairs), observed.lens.fx_px):
        return ""
    return f"with other axes than the profile's it would explain {coarse.explained:.0%}: virest calibrate finds them"


def other_reading(observed: ObservedTracks, imu: ImuSamples, profile: CameraProfile) -> str:
    """What the gyroscope explains if its log has another unit or sign, and what to do; empty: not enough either."""
    turns = observed.turns(profile)
    for factor, own_axes, words in READINGS:
        read = replace(imu, gyro_rad_s=factor * imu.gyro_rad_s)
        coarse = align_coarsely(turns, read, profile, own_axes=own_axes)
        if coarse is not None and not coarse.doubt(len(observed.pairs), observed.lens.fx_px):
            return f"{words} it would explain {coarse.explained:.0%}: correct gyro_accel.csv"
    return ""


def _clearly_better(tried_s: Array, explained_at: Array, offset_s: float, figures: int) -> float | None:
    """Offset near the given one that explains clearly more; None: there is none.

    The unexplained part is approximated by a parabola over the offset; its excess over the minimum, times ``figures`` /
    minimum, is a chi-square with 1 degree of freedom.
    """
    near = np.abs(tried_s - offset_s) <= AGREEMENT_SLACK_S
    best = int(np.argmax(np.where(near, explained_at, -np.inf)))
    if not 0 < best < len(tried_s) - 1:
        return None
    before, here, after = 1 - explained_at[best - 1 : best + 2]
    bend, lean = (before + after) / 2 - here, (after - before) / 2
    if not np.isfinite(bend) or bend <= 0:
        return None
    steps = float(np.clip(-lean / (2 * bend), -0.5, 0.5))
    least = max(float(here + lean * steps + bend * steps**2), 1e-9)
    at_given = 1 - float(np.interp(offset_s, tried_s, explained_at))
    chi_square = figures * (at_given / least - 1)
    return float(tried_s[best]) + steps * STEP_S if chi_square > CLEARLY_BETTER else None


def _changes_rad(turns: FrameRotations, imu: ImuSamples, profile: CameraProfile) -> tuple[Array, Array]:
    """The changing rotation of frames and gyroscope at the profile's offset, (p, 3) each."""
    times = (np.asarray(profile.imu_time_s(time_s)) for time_s in (turns.first_s, turns.second_s))
    predicted = gyro_turns(integrate_gyro(imu, profile), *times)
    return turns.detrended(turns.vector_rad), turns.detrended(predicted)


def _rms(vectors: Array) -> float:
    return float(np.sqrt(np.mean((vectors**2).sum(axis=-1))))
