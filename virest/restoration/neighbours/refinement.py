"""Blur paths corrected by what a frame's two neighbours show of the turn that the prediction lacks.

An offset, a stabiliser's rest, a gyroscope's low pass, a focal length: whatever is wrong with the profile, the picture
moves otherwise than predicted, and the shift between two frames measures by how much, on average from the one to the
other.  Between the middles of intervals the missing rate is taken as linear in time.  How large it usually is, and
how far it is from linear, is measured once a capture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from virest.image_formation.neighbour import turn_jacobian_px
from virest.image_formation.row_motion import FurtherTurn, RowMotion
from virest.inference.chance import chi2_median, chi2_tail
from virest.restoration.neighbours.registration import PairTurn

Array = NDArray[np.float64]
FALSE_ALARM = 1e-3
"""Probability at which right predictions would be corrected all the same."""
NEGLIGIBLE_PX = 0.05
"""A path that is wrong by so little spoils 0.2 % of the power at half a cycle per pixel (|2πf δ|² / 12): less than any
movie's noise."""
FARTHEST = 5.0
"""Standard deviations of the usual missing rate beyond which a pair shows something else, such as a passing bus."""
HALF_SPACING = 0.25
"""Of the error of linear interpolation at twice the spacing, which falls with its square."""


@dataclass(frozen=True, slots=True)
class MissingTurn:
    """What the prediction of a capture usually lacks, by pairs of its frames."""

    rate_rad_s: float
    """One standard deviation of the missing turn rate, each axis."""
    bend_rad_s: float
    """One standard deviation of what linear interpolation between neighbouring intervals leaves of it."""
    scatter_px_s: float
    """One standard deviation, each axis, of the speeds of parts of the picture about the common turn."""
    pairs: int

    def refined(
        self, motion: RowMotion, before: Sequence[PairTurn | None], after: Sequence[PairTurn | None]
    ) -> RefinedMotion:
        """The motion of a frame with the missing turn, by the pairs of frames before and after it, nearest first.

        Those next to it tell its own motion; those beyond, as far as they follow without a gap, that of its neighbours.
        """
        prior = self.rate_rad_s**2 * np.eye(3)
        chains = [self._unbroken(turns) for turns in (before, after)]
        if not any(chains):
            return RefinedMotion(motion, prior, self.scatter_px_s)
        known = [_shrunk(turn, prior) for turn in (*reversed(chains[0]), *chains[1])]
        times_s, rates, covariances = (np.array(parts) for parts in zip(*known, strict=True))
        if all(chains):
            first, last = len(chains[0]) - 1, len(chains[0])
            part = (motion.middle_s - times_s[first]) / (times_s[last] - times_s[first])
            covariance = (1 - part) ** 2 * covariances[first] + part**2 * covariances[last]
            bend = self.bend_rad_s
        else:
            covariance, bend = covariances[-1 if chains[0] else 0], self.bend_rad_s / HALF_SPACING
        scatter = float(np.mean([chain[0].scatter_px_s for chain in chains if chain]))
        further = FurtherTurn(times_s, rates)
        return RefinedMotion(motion.turned(further), covariance + bend**2 * np.eye(3), scatter, further)

    def _unbroken(self, turns: Sequence[PairTurn | None]) -> list[PairTurn]:
        """The turns up to the first that is missing or shows something else."""
        known = [turn if turn is not None and self._likely(turn) else None for turn in turns]
        return [turn for turn in known[: known.index(None) if None in known else None] if turn is not None]

    def _likely(self, turn: PairTurn) -> bool:
        spread = turn.covariance + self.rate_rad_s**2 * np.eye(3)
        return float(turn.rate_rad_s @ np.linalg.solve(spread, turn.rate_rad_s)) < FARTHEST**2


@dataclass(frozen=True, slots=True)
class RefinedMotion:
    """A frame's motion and how well its blur paths are known."""

    motion: RowMotion
    rate_covariance: Array
    """(3, 3) of the turn rate, (rad/s)²."""
    scatter_px_s: float
    """One standard deviation, each axis, of parts of the picture about it."""
    further: FurtherTurn | None = None
    """What was added to the predicted motion; None: it stays as predicted."""

    def path_covariance_px2(self) -> Array:
        """(2, 2) covariance of the blur path's end over its start, at the picture's middle, x then y."""
        profile = self.motion.profile
        centre = np.array([[(profile.width - 1) / 2, (profile.height - 1) / 2]])
        jacobian = turn_jacobian_px(self.motion, centre)[0]
        spread = jacobian @ self.rate_covariance @ jacobian.T + self.scatter_px_s**2 * np.eye(2)
        return np.asarray(spread * self.motion.exposure_s**2)


def missing_turn(runs: Sequence[Sequence[PairTurn | None]], motions: Sequence[RowMotion]) -> MissingTurn | None:
    """Measure it on runs of consecutive pairs; None where the pairs agree with the prediction, or are too few.

    motions: of frames whose exposures are typical.
    """
    turns = [turn for run in runs for turn in run if turn is not None]
    if len(turns) < 2 or not motions:
        return None
    squares = [t.rate_rad_s @ np.linalg.solve(t.covariance, t.rate_rad_s) for t in turns]
    if chi2_tail(np.sum(squares), 3 * len(turns)) > FALSE_ALARM:
        return None
    noise = np.mean([np.trace(t.covariance) / 3 for t in turns])
    variance = np.median([t.rate_rad_s @ t.rate_rad_s for t in turns]) / chi2_median(3) - noise
    if variance <= 0:
        return None
    bends = [
        (here.rate_rad_s - (a.rate_rad_s + b.rate_rad_s) / 2, here.covariance + (a.covariance + b.covariance) / 4)
        for run in runs
        for a, here, b in zip(run, run[1:], run[2:], strict=False)
        if a is not None and here is not None and b is not None
    ]
    bend = np.mean([max(e @ e - np.trace(c), 0.0) / 3 for e, c in bends]) if bends else variance
    found = MissingTurn(
        float(np.sqrt(variance)),
        float(HALF_SPACING * np.sqrt(bend)),
        float(np.median([t.scatter_px_s for t in turns])),
        len(turns),
    )
    longest = max(_path_change_px(motion, found.rate_rad_s) for motion in motions)
    return found if longest > NEGLIGIBLE_PX else None


def _path_change_px(motion: RowMotion, rate_rad_s: float) -> float:
    """Pixels by which such a missing rate changes the blur path in the picture's middle."""
    profile = motion.profile
    centre = np.array([[(profile.width - 1) / 2, (profile.height - 1) / 2]])
    return float(np.abs(turn_jacobian_px(motion, centre)[0]).max() * rate_rad_s * motion.exposure_s)


def _shrunk(turn: PairTurn, prior: Array) -> tuple[float, Array, Array]:
    """(middle of the interval, rate, covariance) with the usual size of missing rates as a prior."""
    gain = prior @ np.linalg.inv(prior + turn.covariance)
    return 0.5 * (turn.start_s + turn.end_s), gain @ turn.rate_rad_s, gain @ turn.covariance
