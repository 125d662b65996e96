"""Pictures and gyroscope on one clock: the time offset, the gyroscope's bias, and whether the two agree at all.

Coarse: each pair's rotation against the gyroscope's at every offset within the search.  Fine: every tracked point at
its own row's mid-exposure (point_fit).  What the chosen model leaves open (parallax, a readout, an axis map or a
clock rate that is a little off) enters the standard deviation by how far it would move the offset.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.capture.records import Frame
from virest.image_formation.row_clock import RowClock
from virest.inference.frame_rotations import FrameRotations, OffsetScan, gyro_turns, picture_turns, scan_offsets
from virest.inference.observed_tracks import guessed_lens
from virest.inference.point_fit import (
    PointFit,
    PointModel,
    block_disagreement,
    fit_points,
    mask,
    point_table,
    priors,
)
from virest.inference.tracking import TrackPair
from virest.motion.integration import integrate_gyro
from virest.motion.trajectory import Trajectory

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
COARSE_STEP_S = 0.004
MIN_TRACKS = 15
"""A pair with fewer tells too little."""
MIN_PAIRS = 8
MIN_EXPLAINED = 0.5
MIN_EXPLAINED_BY_PAIR = 5.0
MAX_MIN_EXPLAINED = 0.9
"""Pictures follow the gyroscope if it explains 0.5 + 5 / pairs, at most 0.9, of their rotation: with few pairs,
unrelated motion reaches 0.7 at some offset within a second; with 40 it stays below 0.5."""
MIN_DISTINCT = 1.6
"""The best offset leaves less than 1 / this of what the second best leaves unexplained."""
MAX_POINTS = 5000
"""Tracked points used in the fine fit; evenly thinned beyond."""
MIN_MOTION_PX = 0.4
"""Least rms of the pictures' changing rotation from frame to frame, at the focal length."""
MAX_STD_S = 0.02
SMALLEST_STD_S = 1e-4
"""Blur under a bent path and KLT's own bias are not modelled."""
UNKNOWN_EXPOSURE_STD_S = 0.008
UNKNOWN_READOUT_STD_S = 0.003
"""At least, where the readout is fitted: lens and parallax shear pictures too."""
TRANSLATION_RATIO = 1.25
"""Differences this much larger in all directions than across the best parallax mean that the camera moves."""
COMMON_RATIO = 1.15
MAX_BIAS_SIGMA = {"rotation": 4.0, "common": 2.0, "pairwise": 2.0}
"""A bias further from the profile's than this many prior deviations is an unmodelled scene, lens or axis map and is not
fitted.  A moving camera's steady parallax looks like bias."""
AGREEMENT_SLACK_S = 0.03
"""An offset wrong by this is a matter for calibration, not a sign that pictures and gyroscope are strangers."""
CLEARLY_BETTER = 30.0
"""Chi-square (one degree of freedom) above which another offset is clearly better; errors of pairs go together, so
more than nine."""


@dataclass(frozen=True, slots=True)
class OffsetEstimate:
    """The time offset and what came with it; t_imu = t_cam (1 + clock_skew) + time_offset_s."""

    time_offset_s: float
    """Goes with ``readout_s`` and the profile's meaning of a stamp; see :meth:`at_readout`."""
    std_s: float
    """Includes what the model leaves open; inf where not determined."""
    bias_rad_s: tuple[float, float, float]
    """Gyroscope bias, IMU axes, as profiles hold it: measured = scale x true + bias."""
    bias_std_rad_s: tuple[float, float, float]
    residual_px: float
    """Robust standard deviation per coordinate of tracked minus predicted points, all directions."""
    noise_px: float
    """The same across the parallax: what tracking alone makes, if the model is right."""
    explained: float
    """Part of the pictures' rotation that the gyroscope explains, at most 1."""
    readout_s: float
    """The profile's, or fitted with its half-frame ambiguity where that is unknown."""
    readout_std_s: float
    """0 where the profile's is used."""
    drift_s_per_s: float
    """How the offset would drift if that were free: the clock skew that the profile may lack."""
    drift_std_s_per_s: float
    focal_px: float | None
    """Fitted where the profile knows none and the motion determines it to a quarter."""
    focal_std_px: float | None
    translation: str
    """What the camera's translation was taken for: ``rotation`` (none), ``common`` direction, or ``pairwise``."""
    pairs: int
    tracks: int
    determined: bool
    """Whether the offset may be used."""
    reason: str
    """Why not; or what to keep in mind; may be empty."""

    @property
    def centre_offset_s(self) -> float:
        """Offset at the middle of the readout: what the pictures determine best."""
        return self.time_offset_s + 0.5 * self.readout_s

    def at_readout(self, readout_s: float) -> float:
        """Return the time offset that goes with another readout time."""
        return self.centre_offset_s - 0.5 * readout_s


@dataclass(frozen=True, slots=True)
class Agreement:
    """Whether the pictures move as the gyroscope says."""

    agrees: bool
    explained: float
    """Part of the pictures' changing rotation that the gyroscope explains at the profile's offset; NaN: unknown."""
    residual_px: float
    """rms of the pictures' rotation minus the gyroscope's from frame to frame, at the focal length."""
    motion_px: float
    """rms of the pictures' changing rotation."""
    best_offset_s: float | None
    """Another offset at which they would agree, or agree clearly better; None: there is none, or none is needed."""
    reason: str


# ── the time offset ──────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class _Observed:
    """Pairs that are worth something, with their times, and the gyroscope."""

    pairs: list[TrackPair]
    frame_time_s: Array
    exposure_s: Array
    exposure_known: bool
    lens: Intrinsics
    profile: CameraProfile
    turns: FrameRotations
    trajectory: Trajectory

    @property
    def motion_px(self) -> float:
        changing = self.turns.detrended(self.turns.vector_rad)
        return float(np.sqrt(np.mean((changing**2).sum(axis=-1))) * self.lens.fx_px)


def estimate_time_offset(
    pairs: Sequence[TrackPair],
    frames_time_s: Sequence[float] | Array,
    exposures_s: Sequence[float | None] | Array,
    imu: ImuSamples,
    profile: CameraProfile,
    search_s: float = 1.0,
) -> OffsetEstimate:
    """Find the time offset within ± search_s of the profile's (of 0 where that is unknown), and the gyroscope's bias.

    frames_time_s, exposures_s: (frames,) by movie index, stamps from stamp_0, logged exposures (None or NaN: unknown).
    Never raises for poor data: the result says that nothing is determined, and why.
    """
    observed, reason = _observe(pairs, frames_time_s, exposures_s, imu, profile)
    if observed is None:
        return _undetermined(profile, reason, pairs)
    if observed.motion_px < MIN_MOTION_PX:
        return _undetermined(
            profile, f"the pictures hardly turn ({observed.motion_px:.2f} px from frame to frame)", observed.pairs
        )
    scan = _scan(observed, search_s)
    best, reason = _distinct_peak(scan, search_s, _least_explained(observed))
    if best is None:
        return _undetermined(profile, reason, observed.pairs, float(np.max(scan.explained)))
    model, start = _point_model(observed, float(scan.offset_s[best]), float(scan.gain[best]))
    fitted = _fit(model, start, profile)
    return _conclude(observed, fitted, _drift(model, fitted.fit), search_s)


def _observe(
    pairs: Sequence[TrackPair],
    frames_time_s: Sequence[float] | Array,
    exposures_s: Sequence[float | None] | Array,
    imu: ImuSamples,
    profile: CameraProfile,
) -> tuple[_Observed | None, str]:
    time_s = np.array(frames_time_s, float)
    exposure_s = np.array([np.nan if value is None else value for value in exposures_s], float)
    kept = [pair for pair in pairs if len(pair) >= MIN_TRACKS and np.isfinite(time_s[[pair.first, pair.second]]).all()]
    if len(kept) < MIN_PAIRS:
        return None, f"{len(kept)} pairs of frames with {MIN_TRACKS} or more tracked points; {MIN_PAIRS} are needed"
    if len(imu) < 8:
        return None, f"{len(imu)} gyroscope samples"
    known = bool(np.isfinite(exposure_s[[pair.first for pair in kept]]).mean() > 0.5)
    typical = float(np.nanmedian(exposure_s)) if known else 0.0
    exposure_s = np.where(np.isfinite(exposure_s), exposure_s, typical)
    readout_s = float(priors(profile)[0][4])
    clock = RowClock(replace(profile, shutter=replace(profile.shutter, readout_time_s=readout_s)))
    centre_s = clock.camera_time_s(clock.middle_s(time_s, exposure_s))
    lens = profile.intrinsics or guessed_lens(profile)
    turns = picture_turns(lens, kept, centre_s[[pair.first for pair in kept]], centre_s[[pair.second for pair in kept]])
    kept = _thinned(kept)
    return _Observed(kept, time_s, exposure_s, known, lens, profile, turns, integrate_gyro(imu, profile)), ""


def _thinned(pairs: list[TrackPair]) -> list[TrackPair]:
    stride = -(-sum(len(pair) for pair in pairs) // MAX_POINTS)
    return [
        replace(
            pair,
            points_first_px=pair.points_first_px[::stride],
            points_second_px=pair.points_second_px[::stride],
            forward_backward_px=None,
        )
        for pair in pairs
    ]


def _scan(observed: _Observed, search_s: float) -> OffsetScan:
    centre = observed.profile.time_offset_s or 0.0
    steps = int(np.ceil(search_s / COARSE_STEP_S))
    offsets = centre + COARSE_STEP_S * np.arange(-steps, steps + 1, dtype=float)
    unknown_focal = observed.profile.intrinsics is None
    return scan_offsets(observed.turns, observed.trajectory, observed.profile.clock_skew, offsets, unknown_focal)


def _distinct_peak(scan: OffsetScan, search_s: float, least: float) -> tuple[int | None, str]:
    """Find the index of the one offset that explains the pictures, or None and the reason."""
    peaks = scan.peaks()
    if not len(peaks) or not np.isfinite(scan.explained[peaks[0]]):
        return None, "the inertial data do not cover the frames at any offset searched"
    best = int(peaks[0])
    explained = float(scan.explained[best])
    if explained < least:
        return None, (
            f"the pictures do not follow the gyroscope: at best it explains {max(explained, 0.0):.0%} "
            "of their rotation (stabilised pictures, or not of this recording?)"
        )
    if best in (0, len(scan.offset_s) - 1):
        return None, f"the offset lies at the end of the search (±{search_s:g} s)"
    others = peaks[~_same_valley(scan, best)[peaks]]
    if len(others):
        left_other = 1 - float(scan.explained[others[0]])
        if left_other < MIN_DISTINCT * (1 - explained):
            return None, (
                f"offsets of {scan.offset_s[best]:+.3f} and {scan.offset_s[others[0]]:+.3f} s explain the pictures "
                f"about equally well ({explained:.0%}, {1 - left_other:.0%})"
            )
    return best, ""


def _least_explained(observed: _Observed) -> float:
    return min(MIN_EXPLAINED + MIN_EXPLAINED_BY_PAIR / len(observed.pairs), MAX_MIN_EXPLAINED)


def _same_valley(scan: OffsetScan, best: int) -> NDArray[np.bool_]:
    """(k,) the offsets around the best one, up to where twice as much is left unexplained."""
    worse = 1 - scan.explained > 2 * (1 - scan.explained[best])
    numbers = np.arange(len(worse))
    below = np.max(numbers[worse & (numbers < best)], initial=-1)
    above = np.min(numbers[worse & (numbers > best)], initial=len(worse))
    return (numbers > below) & (numbers < above)


@dataclass(frozen=True, slots=True)
class _Fitted:
    fit: PointFit
    variance: Array
    """(13,) of its values, with what the model leaves open."""
    rotation_noise_px: float
    """What a fit without translation leaves."""


def _fit(model: PointModel, start: Array, profile: CameraProfile) -> _Fitted:
    """Fit with the simplest translation that the differences ask for."""
    active = mask("offset", "bias")
    if not profile.readout_known:
        active |= mask("readout")
    if profile.intrinsics is None:
        active |= mask("log_focal")
    chosen, other, rotation_noise = _chosen_model(model, start, active)
    farthest = float(np.max(np.abs(chosen.values - model.prior_mean)[1:4] / model.prior_std[1:4]))
    if farthest > MAX_BIAS_SIGMA[chosen.model]:
        log.debug("bias %s rad/s is held", chosen.values[1:4])
        active &= ~mask("bias")
        chosen, other, rotation_noise = _chosen_model(model, start, active)
    own = np.diag(chosen.covariance(chosen.active))
    disagreement = _excess(chosen.values - other.values, np.diag(other.covariance(other.active)) - own)
    left_open = {name: _excess_with(chosen, name) for name in ("readout", "drift", "tilt", "log_focal")}
    _log_fit(chosen, own, disagreement, left_open)
    variance = own + np.where(active, disagreement + sum(left_open.values()), 0.0)
    if active[4]:
        variance = variance + UNKNOWN_READOUT_STD_S**2 * (mask("readout") + 0.25 * mask("offset"))
    variance = np.where(mask("bias") & ~active, model.prior_std**2, variance)
    return _Fitted(chosen, variance, rotation_noise)


def _chosen_model(model: PointModel, start: Array, active: NDArray[np.bool_]) -> tuple[PointFit, PointFit, float]:
    """Return the fit with the simplest sufficient translation, the next best, and the rotation-only fit's noise."""
    rotation = _settled(model, start, active, "rotation")
    moving = active | mask("flow")
    pairwise = _settled(model, rotation.values, moving, "pairwise")
    if rotation.noise_px < TRANSLATION_RATIO * pairwise.noise_px:
        return rotation, pairwise, rotation.noise_px
    common = _settled(model, rotation.values, moving, "common")
    if common.noise_px < COMMON_RATIO * pairwise.noise_px:
        return common, pairwise, rotation.noise_px
    return pairwise, common, rotation.noise_px


def _drift(model: PointModel, fit: PointFit) -> tuple[float, float]:
    """Drift of the offset and its standard deviation, s/s; fitted anew where a first look finds any."""
    wider = fit.active | mask("drift")
    drift, std = fit.step(wider)[6], np.sqrt(fit.covariance(wider)[6, 6])
    if abs(drift) > 2 * std:
        free = fit_points(model, fit.values, wider, fit.model, overdispersion=fit.overdispersion)
        drift, std = free.values[6], np.sqrt(free.covariance(wider)[6, 6])
    return float(drift), float(std)


def _log_fit(fit: PointFit, own: Array, disagreement: Array, left_open: dict[str, Array]) -> None:
    parts = ", ".join(f"{name} {1e3 * np.sqrt(excess[0]):.3f}" for name, excess in left_open.items())
    log.debug(
        "offset %.3f ms (%s): own std %.3f, other translation model %.3f, left open: %s",
        1e3 * fit.values[0],
        fit.model,
        1e3 * np.sqrt(own[0]),
        1e3 * np.sqrt(disagreement[0]),
        parts,
    )


def _point_model(observed: _Observed, offset_s: float, gain: float = 1.0) -> tuple[PointModel, Array]:
    """Lay out the model with the pairs that lie inside the inertial data at this offset, and its starting values."""
    profile = observed.profile
    start_s, end_s = observed.trajectory.span_s
    margin_s = 0.02 + profile.shutter.readout_time_s
    first = profile.clock_skew * observed.turns.first_s + observed.turns.first_s + offset_s
    second = profile.clock_skew * observed.turns.second_s + observed.turns.second_s + offset_s
    inside = (first - margin_s > start_s) & (second + margin_s < end_s) & ~_crosses_gap(observed, first, second)
    pairs = [pair for pair, keep in zip(observed.pairs, inside, strict=True) if keep] or observed.pairs
    mean, std = priors(profile)
    points = point_table(pairs, observed.frame_time_s, observed.exposure_s, profile)
    start = mean.copy()
    start[0], start[5] = offset_s, np.log(gain)
    return PointModel(points, observed.trajectory, observed.lens, profile.clock_skew, mean, std), start


def _crosses_gap(observed: _Observed, first_s: Array, second_s: Array) -> NDArray[np.bool_]:
    """(p,) whether the gyroscope paused for 20 ms or more between the two pictures."""
    time_s = observed.trajectory.time_s
    before = np.flatnonzero(np.diff(time_s) > max(0.02, 3 * float(np.median(np.diff(time_s)))))
    crossed = np.zeros(len(first_s), bool)
    for gap in before:
        crossed |= (first_s - 0.02 < time_s[gap + 1]) & (second_s + 0.02 > time_s[gap])
    return crossed


def _settled(model: PointModel, start: Array, active: NDArray[np.bool_], translation: str) -> PointFit:
    """Fit, learn how much the blocks disagree, fit again with the priors weighed by it."""
    fit = fit_points(model, start, active, translation)
    return fit_points(model, fit.values, active, translation, overdispersion=block_disagreement(fit))


def _excess(shift: Array, expected_variance: Array) -> Array:
    """Return the part of squared shifts that the extra freedom's own noise does not explain."""
    return np.maximum(shift**2 - np.maximum(expected_variance, 0.0), 0.0)


def _excess_with(fit: PointFit, name: str) -> Array:
    """How far freeing one more quantity would move the others (13,), squared, beyond its noise; 0 if free already."""
    wider = fit.active | mask(name)
    if (wider == fit.active).all():
        return np.zeros(len(wider))
    return _excess(fit.step(wider), np.diag(fit.covariance(wider)) - np.diag(fit.covariance(fit.active)))


def _conclude(
    observed: _Observed, fitted: _Fitted, drift_and_std: tuple[float, float], search_s: float
) -> OffsetEstimate:
    profile, fit, variance, (drift, drift_std) = observed.profile, fitted.fit, fitted.variance, drift_and_std
    values = fit.values
    notes = []
    std_s = float(np.hypot(np.sqrt(variance[0]), SMALLEST_STD_S))
    explained = _explained_at(observed, float(values[0]))
    determined, problem = _verdict(values[0], std_s, explained, profile, search_s)
    if not observed.exposure_known:
        std_s = float(np.hypot(std_s, UNKNOWN_EXPOSURE_STD_S))
        notes.append("exposure unknown: the offset contains half of it")
    if not profile.readout_known:
        notes.append("readout unknown: the offset and half the readout are determined together only")
    if abs(drift) > 4 * drift_std and abs(drift) > 5e-4:
        std_s = float(np.hypot(std_s, drift * _rms_time_s(observed)))
        notes.append(f"the offset drifts by {1e3 * drift:.2f} ms a second: the clocks' rates differ")
    to_imu = profile.rotation_cam_imu.T
    bias = np.array(profile.gyro_bias_rad_s) + np.array(profile.gyro_scale) * (to_imu @ values[1:4])
    bias_std = np.sqrt(to_imu**2 @ variance[1:4]) * np.abs(profile.gyro_scale)
    focal, focal_std = _focal(observed, fit, variance)
    return OffsetEstimate(
        time_offset_s=float(values[0]),
        std_s=std_s,
        bias_rad_s=tuple(bias.tolist()),
        bias_std_rad_s=tuple(bias_std.tolist()),
        residual_px=fitted.rotation_noise_px,
        noise_px=fit.noise_px,
        explained=explained,
        readout_s=float(values[4]),
        readout_std_s=float(np.sqrt(variance[4])),
        drift_s_per_s=drift,
        drift_std_s_per_s=drift_std,
        focal_px=focal,
        focal_std_px=focal_std,
        translation=fit.model,
        pairs=len(observed.pairs),
        tracks=sum(len(pair) for pair in observed.pairs),
        determined=determined,
        reason="; ".join(([problem] if problem else []) + notes),
    )


def _rms_time_s(observed: _Observed) -> float:
    """Typical distance of the pairs from stamp_0, from where a drifting offset is counted."""
    return float(np.sqrt(np.mean(observed.turns.middle_s**2)))


def _verdict(
    offset_s: float, std_s: float, explained: float, profile: CameraProfile, search_s: float
) -> tuple[bool, str]:
    if not np.isfinite(std_s) or std_s > MAX_STD_S:
        return False, f"the motion does not determine the offset (standard deviation {1e3 * std_s:.0f} ms)"
    if abs(offset_s - (profile.time_offset_s or 0.0)) > search_s:
        return False, f"the offset left the search (±{search_s:g} s)"
    if explained < MIN_EXPLAINED:
        return False, f"at the fitted offset the gyroscope explains only {max(explained, 0.0):.0%} of the rotation"
    return True, ""


def _explained_at(observed: _Observed, offset_s: float) -> float:
    near = offset_s + np.linspace(-0.01, 0.01, 5)
    free = observed.profile.intrinsics is None
    return float(
        np.max(scan_offsets(observed.turns, observed.trajectory, observed.profile.clock_skew, near, free).explained)
    )


def _focal(observed: _Observed, fit: PointFit, variance: Array) -> tuple[float | None, float | None]:
    spread = float(np.sqrt(variance[5]))
    if not fit.active[5] or spread > 0.25:
        return None, None
    focal = observed.lens.fx_px * float(np.exp(fit.values[5]))
    return focal, focal * spread


def _undetermined(
    profile: CameraProfile, reason: str, pairs: Sequence[TrackPair], explained: float = float("nan")
) -> OffsetEstimate:
    nan = float("nan")
    return OffsetEstimate(
        time_offset_s=profile.time_offset_s or 0.0,
        std_s=float("inf"),
        bias_rad_s=profile.gyro_bias_rad_s,
        bias_std_rad_s=(nan, nan, nan),
        residual_px=nan,
        noise_px=nan,
        explained=explained,
        readout_s=profile.shutter.readout_time_s,
        readout_std_s=0.0 if profile.readout_known else float("inf"),
        drift_s_per_s=nan,
        drift_std_s_per_s=nan,
        focal_px=None,
        focal_std_px=None,
        translation="rotation",
        pairs=len(pairs),
        tracks=sum(len(pair) for pair in pairs),
        determined=False,
        reason=reason,
    )


# ── agreement ────────────────────────────────────────────────────────────────────────────────────────────────────


def check_agreement(
    pairs: Sequence[TrackPair],
    frames_time_s: Sequence[float] | Array,
    exposures_s: Sequence[float | None] | Array,
    imu: ImuSamples,
    profile: CameraProfile,
    search_s: float = 1.0,
) -> Agreement:
    """Tell whether the pictures turn as the gyroscope says at the profile's offset, give or take AGREEMENT_SLACK_S.

    Arguments as for :func:`estimate_time_offset`.  Bias and steady drift are free, moving objects and parallax count
    little.  Too little to tell counts as agreement: nothing speaks against the gyroscope.
    """
    nan = float("nan")
    observed, reason = _observe(pairs, frames_time_s, exposures_s, imu, profile)
    if observed is None:
        return Agreement(True, nan, nan, nan, None, f"too little to tell: {reason}")
    offset_s = profile.time_offset_s or 0.0
    seen, gyro_px = _changes_px(observed, offset_s)
    motion_px, residual_px = _rms(seen), _rms(seen - gyro_px)
    if max(motion_px, _rms(gyro_px)) < MIN_MOTION_PX:
        return Agreement(True, nan, residual_px, motion_px, None, "too little motion to tell")
    scan = _scan(observed, search_s)
    near = np.abs(scan.offset_s - offset_s) <= AGREEMENT_SLACK_S
    explained = float(np.max(scan.explained[near]))
    if not np.isfinite(explained):
        return Agreement(True, nan, residual_px, motion_px, None, "too little to tell: no inertial data at the frames")
    if explained >= MIN_EXPLAINED:
        better = _clearly_better(scan, offset_s, near, 3 * len(pairs))
        return Agreement(True, explained, residual_px, motion_px, better, "")
    best, _ = _distinct_peak(scan, search_s, _least_explained(observed))
    elsewhere = None if best is None else float(scan.offset_s[best])
    reason = f"the gyroscope explains {max(explained, 0.0):.0%} of the pictures' rotation"
    hint = "stabilised pictures, or not of this recording?"
    if elsewhere is not None:
        hint = f"at an offset of {elsewhere:+.3f} s it would explain {float(np.max(scan.explained)):.0%}"
    return Agreement(False, explained, residual_px, motion_px, elsewhere, f"{reason}: {hint}")


def _clearly_better(scan: OffsetScan, offset_s: float, near: NDArray[np.bool_], figures: int) -> float | None:
    """Offset near the given one that leaves clearly less unexplained; None: there is none.

    What is left, as a parabola over the offset, has its least there; times ``figures`` / least, the difference is a
    chi-square of one.
    """
    best = int(np.flatnonzero(near)[np.argmax(scan.explained[near])])
    if not 0 < best < len(scan.offset_s) - 1:
        return None
    before, here, after = 1 - scan.explained[best - 1 : best + 2]
    bend, lean = (before + after) / 2 - here, (after - before) / 2
    if not np.isfinite(bend) or bend <= 0:
        return None
    steps = float(np.clip(-lean / (2 * bend), -0.5, 0.5))
    least = max(float(here + lean * steps + bend * steps**2), 1e-9)
    at_given = 1 - float(np.interp(offset_s, scan.offset_s, scan.explained))
    chi_square = figures * (at_given / least - 1)
    return float(scan.offset_s[best]) + steps * COARSE_STEP_S if chi_square > CLEARLY_BETTER else None


def _changes_px(observed: _Observed, offset_s: float) -> tuple[Array, Array]:
    """Compute the changing rotation of pictures and gyroscope, (p, 3) each, in pixels at the focal length."""
    turns = observed.turns
    expected = gyro_turns(
        observed.trajectory,
        turns.first_s * (1 + observed.profile.clock_skew) + offset_s,
        turns.second_s * (1 + observed.profile.clock_skew) + offset_s,
    )
    focal = observed.lens.fx_px
    return turns.detrended(turns.vector_rad) * focal, turns.detrended(expected) * focal


def _rms(vectors: Array) -> float:
    return float(np.sqrt(np.mean((vectors**2).sum(axis=-1))))
