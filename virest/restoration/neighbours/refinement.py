"""Correct blur paths by the rotation that a frame's two neighbours show and the prediction lacks.

Whatever is wrong with the profile (clock offset, residual stabilisation, the gyroscope's low pass, focal length), the
picture moves otherwise than predicted, and the shift between two frames measures the mean error between them.  The part
that is constant or a function of the predicted rate is fitted once per capture.  The rest is interpolated linearly in
time between the middles of the intervals; its typical size, and the error of the interpolation, are measured once per
capture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from virest.arrays import Array
from virest.image_formation.neighbour import turn_jacobian_px
from virest.image_formation.row_motion import FurtherTurn, RowMotion
from virest.inference.chance import chi2_median, chi2_tail, student_deviation
from virest.motion.trajectory import Trajectory
from virest.restoration.neighbours.registration import PairTurn

FALSE_ALARM = 1e-3
"""Probability of correcting a correct prediction, and of finding a bias that there is not."""
NEGLIGIBLE_PX = 0.05
"""Path error below which nothing is corrected: it spoils 0.2 % of the power at 0.5 cycles per pixel (|2πf δ|² / 12),
less than any movie's noise.  Rows misplaced by δ rms spoil as much as a path that is √12 δ too long."""
FARTHEST, MOST_SCATTERED = 5.0, 1.8
"""Reject a pair whose missing rate exceeds this many standard deviations and whose tiles scatter by this many times the
usual: it shows something else, such as a passing bus.  By chance 16 tiles scatter that much in 1 of 1000 pairs (F
distribution); tiles that agree on a large rate show the camera."""
HALF_SPACING = 0.25
"""Error of linear interpolation over that at twice the spacing: it is proportional to the spacing squared."""


LAG_STD_S, PART_STD, BIAS_STD_RAD_S = 0.003, 0.1, 0.02
"""Priors: recorders stamp frames and samples to a few milliseconds; a stabiliser or low pass removes about a tenth of
the rotation from the picture or the log; data sheets of phones' gyroscopes state a bias of up to 1°/s, 0.02 rad/s."""
LARGEST_BIAS_RAD_S = 3 * BIAS_STD_RAD_S
"""A larger constant rate is no bias."""
MOST_REMAINING = 0.5
"""Use the fitted lag and part if they reduce the interpolation error's variance below this fraction.  A stabiliser that
cancels only slow rotation is no function of the rate, and a fit of two values always reduces the variance a little
(captures at 0.75 and above lost up to 2 dB, those at 0.3 and below gained).
"""
NODE_S = 0.004
"""Spacing, s, of the nodes between which the missing rate is linear: hands shake at up to about 12 Hz."""
RATE_STEPS = 33
"""Times in a frame at which the uncertainty of a rate is read: about 1 ms apart."""


@dataclass(frozen=True, slots=True)
class FollowingTurn:
    """The missing rate that is constant or a function of the predicted rate ω: bias + lag · dω/dt + part · ω.

    The lag is a clock offset; the part is a scale error, residual stabilisation or a low pass.
    """

    bias_rad_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lag_s: float = 0.0
    part: float = 0.0

    def at(self, trajectory: Trajectory, time_s: Array) -> Array:
        """(n, 3) rad/s at times (n,)."""
        late = self.lag_s * trajectory.angular_acceleration_rad_s2(time_s)
        return np.asarray(self.bias_rad_s + late + self.part * trajectory.rate_rad_s(time_s))

    def residual_of(self, turn: PairTurn, trajectory: Trajectory) -> PairTurn:
        """The part of a pair's missing rate that it does not explain."""
        change, mean = _change_and_mean(turn, trajectory)
        return replace(turn, rate_rad_s=turn.rate_rad_s - self.bias_rad_s - self.lag_s * change - self.part * mean)


@dataclass(frozen=True, slots=True)
class MissingTurn:
    """Statistics of the rotation that a capture's prediction lacks, from pairs of its frames."""

    rate_rad_s: float
    """Standard deviation of the missing rotation rate, per axis."""
    rest_rad_s: float
    """The same for the part that is not a function of the predicted rate."""
    bend_rad_s: float
    """Standard deviation, per axis, of the error of linear interpolation of that rest between adjacent intervals."""
    scatter_px_s: float
    """Standard deviation, per axis, of the tiles' speeds about the common rotation."""
    pairs: int
    """Number of pairs."""
    following: FollowingTurn = FollowingTurn()

    def beside(self, rate_rad_s: float) -> MissingTurn:
        """With a further missing rate of this standard deviation per axis, independent from interval to interval."""
        rate, rest = (float(np.hypot(own, rate_rad_s)) for own in (self.rate_rad_s, self.rest_rad_s))
        bend = float(np.hypot(self.bend_rad_s, HALF_SPACING * rate_rad_s))
        return replace(self, rate_rad_s=rate, rest_rad_s=rest, bend_rad_s=bend)

    def refined(
        self,
        motion: RowMotion,
        before: Sequence[PairTurn | None],
        after: Sequence[PairTurn | None],
        trajectory: Trajectory,
    ) -> RefinedMotion:
        """A frame's motion with the missing rotation added, from the pairs before and after the frame, nearest first.

        The adjacent pairs give the frame's own correction; those beyond, up to the first gap, that of its neighbours.
        """
        prior = self.rest_rad_s**2 * np.eye(3)
        chains = [
            self._until_gap([None if turn is None else self.following.residual_of(turn, trajectory) for turn in turns])
            for turns in (before, after)
        ]
        if not any(chains):
            return RefinedMotion(motion, prior, self.scatter_px_s)
        known = [_shrunk(turn, self.rest_rad_s) for turn in (*reversed(chains[0]), *chains[1])]
        times_s, rates, covariances = (np.array(parts) for parts in zip(*known, strict=True))
        if all(chains):
            first, last = len(chains[0]) - 1, len(chains[0])
            part = (motion.middle_s - times_s[first]) / (times_s[last] - times_s[first])
            covariance = (1 - part) ** 2 * covariances[first] + part**2 * covariances[last]
            bend = self.bend_rad_s
        else:
            covariance, bend = covariances[-1 if chains[0] else 0], self.bend_rad_s / HALF_SPACING
        scatter = float(np.mean([chain[0].scatter_px_s for chain in chains if chain]))
        around_s = float(np.abs(times_s - motion.middle_s).max()) + motion.end_s - motion.start_s
        steps = np.arange(-int(np.ceil(around_s / NODE_S)), int(np.ceil(around_s / NODE_S)) + 1)
        nodes_s: Array = motion.middle_s + NODE_S * steps.astype(float)
        rest = np.stack([np.interp(nodes_s, times_s, along) for along in rates.T], -1)
        further = FurtherTurn(nodes_s, rest + self.following.at(trajectory, nodes_s))
        return RefinedMotion(motion.turned(further), covariance + bend**2 * np.eye(3), scatter, further)

    def _until_gap(self, turns: Sequence[PairTurn | None]) -> list[PairTurn]:
        """The pairs up to the first that is missing or is an outlier."""
        known = [turn if turn is not None and self._is_inlier(turn) else None for turn in turns]
        return [turn for turn in known[: known.index(None) if None in known else None] if turn is not None]

    def _is_inlier(self, turn: PairTurn) -> bool:
        if turn.scatter_px_s < MOST_SCATTERED * self.scatter_px_s:
            return True
        spread = turn.covariance + self.rest_rad_s**2 * np.eye(3)
        return float(turn.rate_rad_s @ np.linalg.solve(spread, turn.rate_rad_s)) < FARTHEST**2


@dataclass(frozen=True, slots=True)
class RefinedMotion:
    """A frame's motion and the uncertainty of its blur paths."""

    motion: RowMotion
    rate_covariance: Array
    """(3, 3) covariance of the rotation rate, (rad/s)²."""
    scatter_px_s: float
    """Standard deviation, per axis, of the tiles' speeds about this motion."""
    further: FurtherTurn | None = None
    """The rotation added to the predicted motion; None: none."""

    def path_covariance_px2(self) -> Array:
        """(2, 2) covariance of the blur path's end relative to its start, at the picture's centre, x then y."""
        jacobian = _per_turn_px(self.motion)
        spread = jacobian @ self.rate_covariance @ jacobian.T + self.scatter_px_s**2 * np.eye(2)
        return np.asarray(spread * self.motion.exposure_s**2)

    def position_std_px(self) -> float:
        """RMS uncertainty of the rows' positions at mid-exposure after straightening, per axis.

        The speed error accumulates over the time between a row's mid-exposure and the reference time.
        """
        exposure_s = self.motion.exposure_s
        if exposure_s <= 0:
            return 0.0
        per_exposure_px = np.sqrt(np.trace(self.path_covariance_px2()) / 2)
        return float(per_exposure_px * _rms_from_reference_s(self.motion) / exposure_s)


def uncertain_rate_rad_s(motion: RowMotion) -> float:
    """Standard deviation of the profile's fields of the rate over time, rms over a frame; of its most uncertain axis.

    Such a field bridges a stretch of the log; one that the frame's exposures do not reach adds nothing.  The error is
    taken to last for the exposure, since a bridge's knots are about as far apart.  0 if its harm is negligible.
    """
    time_s, variance = np.linspace(motion.start_s, motion.end_s, RATE_STEPS), np.zeros(3)
    for field in motion.profile.over_time("rate"):
        if field.std and field.knots[0][0] < motion.end_s and field.knots[0][-1] > motion.start_s:
            variance += np.mean(field.std_over_time(time_s) ** 2, axis=0)
    std_rad_s = float(np.sqrt(variance.max()))
    return std_rad_s if _harm_px(motion, std_rad_s) > NEGLIGIBLE_PX else 0.0


def missing_turn(
    runs: Sequence[Sequence[PairTurn | None]], motions: Sequence[RowMotion], trajectory: Trajectory
) -> MissingTurn | None:
    """Measure the missing rotation on runs of consecutive pairs.

    None with fewer than two pairs, or if they agree with the prediction, or if the path error is negligible.  motions:
    of frames with typical exposures.  trajectory: as predicted.
    """
    turns = [turn for run in runs for turn in run if turn is not None]
    if len(turns) < 2 or not motions:
        return None
    squares = [t.rate_rad_s @ np.linalg.solve(t.covariance, t.rate_rad_s) for t in turns]
    if chi2_tail(np.sum(squares), 3 * len(turns)) > FALSE_ALARM:
        return None
    variance = _variance(turns)
    if variance <= 0:
        return None
    following, bend = accepted_turn(runs, trajectory)
    rest = max(_variance([following.residual_of(turn, trajectory) for turn in turns]), 0.0)
    bend = rest if bend is None else bend
    found = MissingTurn(
        float(np.sqrt(variance)),
        float(np.sqrt(rest)),
        float(HALF_SPACING * np.sqrt(bend)),
        float(np.median([t.scatter_px_s for t in turns])),
        len(turns),
        following,
    )
    longest = max(_harm_px(motion, found.rate_rad_s) for motion in motions)
    return found if longest > NEGLIGIBLE_PX else None


def undetected_rad_s(runs: Sequence[Sequence[PairTurn | None]]) -> float | None:
    """Standard deviation, per axis, of a missing rate that runs of pairs do not exclude; None with fewer than 2 pairs.

    The variance found and its standard error, which is √(2 / 3n) of a single pair's variance for rates of 3 axes.
    """
    turns = [turn for run in runs for turn in run if turn is not None]
    if len(turns) < 2:
        return None
    noise = float(np.mean([np.trace(turn.covariance) / 3 for turn in turns]))
    found = max(_variance(turns), 0.0)
    return float(np.sqrt(found + (found + noise) * np.sqrt(2 / (3 * len(turns)))))


def unrefined_path_std_px(motion: RowMotion, rate_std_rad_s: float) -> float:
    """Standard deviation of a frame's blur path, per axis, at the picture's centre, for that of the rotation rate."""
    jacobian = _per_turn_px(motion)
    return float(rate_std_rad_s * motion.exposure_s * np.sqrt(np.trace(jacobian @ jacobian.T) / 2))


def unmeasured_turn(rate_rad_s: float) -> MissingTurn:
    """A rotation of this standard deviation per axis that the prediction lacks, and that no surveyed pair shows.

    The usual scatter of tiles is unknown, so a pair beyond FARTHEST deviations is rejected however its tiles agree.
    """
    return MissingTurn(rate_rad_s, rate_rad_s, HALF_SPACING * rate_rad_s, 0.0, 0)


def following_turn(turns: Sequence[PairTurn], trajectory: Trajectory) -> FollowingTurn:
    """Fit the lag and the part to pairs' missing rates, with their priors (ridge regression)."""
    design = np.concatenate([np.stack(_change_and_mean(turn, trajectory), -1) for turn in turns])
    rates = np.concatenate([turn.rate_rad_s for turn in turns])
    left = rates - design @ np.linalg.lstsq(design, rates, rcond=None)[0]
    variance = max(float(left @ left) / max(len(left) - 2, 1), 1e-12)
    usual = np.diag([1 / LAG_STD_S**2, 1 / PART_STD**2])
    lag_s, part = np.linalg.solve(design.T @ design / variance + usual, design.T @ rates / variance)
    return FollowingTurn(lag_s=float(lag_s), part=float(part))


def with_bias(following: FollowingTurn, turns: Sequence[PairTurn], trajectory: Trajectory) -> FollowingTurn:
    """With the bias of the rest: its median over the pairs, shrunk towards 0 by that median's variance.

    0 if the median may be due to chance, or is beyond any gyroscope's bias: parallax of a near scene lasts for a few
    frames too, but changes, and is followed from frame to frame.  The variance is π / 2n of one pair's, times that of
    Student's distribution, since few pairs hardly show their scatter.
    """
    rates = np.array([following.residual_of(turn, trajectory).rate_rad_s for turn in turns])
    middle, freedom = np.median(rates, axis=0), len(rates) - 1
    of_one = np.median(((rates - middle) ** 2).sum(axis=1)) / chi2_median(3)
    variance = of_one * np.pi / 2 * student_deviation(freedom) ** 2 / freedom
    by_chance = chi2_tail(middle @ middle / max(variance, 1e-12), 3) > FALSE_ALARM
    if by_chance or np.linalg.norm(middle) > LARGEST_BIAS_RAD_S:
        return following
    x, y, z = (middle * BIAS_STD_RAD_S**2 / (BIAS_STD_RAD_S**2 + variance)).tolist()
    return replace(following, bias_rad_s=(x, y, z))


def _change_and_mean(turn: PairTurn, trajectory: Trajectory) -> tuple[Array, Array]:
    """(3,) rad/s², mean rate of change of the predicted rate between a pair's frames, and (3,) rad/s, its mean."""
    rate_rad_s = trajectory.rate_rad_s(np.linspace(turn.start_s, turn.end_s, 17))
    mean = (rate_rad_s[1:] + rate_rad_s[:-1]).mean(axis=0) / 2
    return np.asarray((rate_rad_s[-1] - rate_rad_s[0]) / (turn.end_s - turn.start_s)), np.asarray(mean)


def _variance(turns: Sequence[PairTurn]) -> float:
    """Variance of the rates about 0, per axis, minus that of their measurement errors."""
    noise = np.mean([np.trace(t.covariance) / 3 for t in turns])
    return float(np.median([t.rate_rad_s @ t.rate_rad_s for t in turns]) / chi2_median(3) - noise)


def accepted_turn(
    runs: Sequence[Sequence[PairTurn | None]], trajectory: Trajectory
) -> tuple[FollowingTurn, float | None]:
    """The fitted lag and part if they meet MOST_REMAINING, else none, with a bias; and :func:`_bend` of the rest."""
    turns = [turn for run in runs for turn in run if turn is not None]
    none, bend = with_bias(FollowingTurn(), turns, trajectory), _bend(runs)
    if bend is None:
        return none, None
    fitted = following_turn(turns, trajectory)
    left = _bend([[None if turn is None else fitted.residual_of(turn, trajectory) for turn in run] for run in runs])
    if left is None or left >= MOST_REMAINING * bend:
        return none, bend
    return with_bias(fitted, turns, trajectory), left


def _bend(runs: Sequence[Sequence[PairTurn | None]]) -> float | None:
    """Variance, per axis, of the rates about the mean of the two adjacent intervals; None: no three in a row."""
    bends = [
        (here.rate_rad_s - (a.rate_rad_s + b.rate_rad_s) / 2, here.covariance + (a.covariance + b.covariance) / 4)
        for run in runs
        for a, here, b in zip(run, run[1:], run[2:], strict=False)
        if a is not None and here is not None and b is not None
    ]
    return float(np.mean([max(e @ e - np.trace(c), 0.0) / 3 for e, c in bends])) if bends else None


def _harm_px(motion: RowMotion, rate_rad_s: float) -> float:
    """Change, px, of the blur path in the picture's centre by such a missing rate; or √12 times that of its rows' rms.

    The latter is 0 where the readout is unknown, so that rows stay where they are.
    """
    speed_px_s = float(np.abs(_per_turn_px(motion)).max() * rate_rad_s)
    apart_s = _rms_from_reference_s(motion) if motion.profile.readout_known else 0.0
    return speed_px_s * max(motion.exposure_s, float(np.sqrt(12)) * apart_s)


def _per_turn_px(motion: RowMotion) -> Array:
    """(2, 3) px per rad: shift of the picture's centre by a rotation."""
    centre = np.array([[(motion.profile.width - 1) / 2, (motion.profile.height - 1) / 2]])
    return np.asarray(turn_jacobian_px(motion, centre)[0])


def _rms_from_reference_s(motion: RowMotion) -> float:
    """RMS over the rows of the time between their mid-exposure and the reference."""
    corners = np.array([[0.0, 0.0], [motion.profile.width - 1.0, motion.profile.height - 1.0]])
    first, last = motion.row_time_s(corners, 0.5) - motion.reference_s
    return float(np.sqrt((first**2 + first * last + last**2) / 3))


def _shrunk(turn: PairTurn, rest_rad_s: float) -> tuple[float, Array, Array]:
    """(middle of the interval, rate, covariance) after applying a prior: the usual missing rate, or this larger one."""
    own = max(float(turn.rate_rad_s @ turn.rate_rad_s - np.trace(turn.covariance)) / 3, 0.0)
    prior = max(rest_rad_s**2, own) * np.eye(3)
    gain = prior @ np.linalg.inv(prior + turn.covariance)
    return 0.5 * (turn.start_s + turn.end_s), gain @ turn.rate_rad_s, gain @ turn.covariance
