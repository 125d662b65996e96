"""What deblurring really gains on a capture, confirmed by neighbours that were blurred along other paths.

Restoring changes a picture by D, and takes its error from |M|² to |M − D|².  Where D is the best that the data allow,
what is left is unrelated to it, and |M|² − |M − D|² = |D|² (the projection theorem): a restored picture tells by itself
what it gained, if it is right.  Whether it is, its neighbours tell: blurred as each was, the share
(|M|² − |M − D|²) / |D|² is 1 for the best restoration, 0 for one that changes as much for the worse as for the better,
and less for one that harms.  Noise of the neighbour's own and what it cannot see cancel in it, since D holds none of
that.  Where the share s is below 1, too much is changed: of a D, (1 + s) / 2 leaves the least error, and that is taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from virest.inference.chance import student_deviation
from virest.restoration.statistics.records import Misplaced

Array = NDArray[np.float64]
LEAST_PAIRS = 2
"""A single one has no scatter."""
LEAST_SEEN_DB = 0.1
"""Least improvement in predicting neighbours, in dB; a frame is not deblurred for less either."""
USUAL_SHARE, USUAL_SHARE_STD = 1.0, 0.5
"""The share before any pair is asked: 1 is that of a right restoration.  On 8 simulated captures that were looked at,
obedient ones and phones, it scattered by 0.3 from capture to capture; models that are wrong are to be found out, so
the width is more, and a few pairs that contradict each other still do not outweigh it."""
LEFT_OVER = (3.51, 0.59, 0.26)
"""ln of the squared error that is left in a restored picture, grey levels squared: a constant, and how much it grows
with the logarithms of what the spectra leave and of the part that neighbours see left.

Each of the two tells it to a factor only.  ``python -m virest.app.bench --only fits`` fits them to pictures with
truth: 3.51 ± 0.36, 0.59 ± 0.08, 0.26 ± 0.06 on 18 captures, together to 0.59 dB in the median."""
LEFT_OVER_STD = 0.50
"""One standard deviation of that logarithm; by the same bench."""
IN_PLACE = Misplaced()
"""Rows that are where they belong."""


@dataclass(frozen=True, slots=True)
class ConfirmedGain:
    """How much of what restoring changes on this capture is for the better, by its neighbours."""

    share: float
    """Of the square of the change, what the error's square falls by."""
    std: float
    """One standard deviation of the share from pair to pair."""
    left: float
    """Of what a neighbour shows, the part of its power that the restored frame, blurred as it was, does not."""
    pairs: int

    def expected_db(self, promised_db: float) -> float:
        """The expected gain for a gain that the model promises, before anything is restored."""
        return _gain_db(min(self.share, 1.0) * (1 - 10 ** (-promised_db / 10)))

    def taken(self, further: float) -> float:
        """Part of the change that leaves the least error.

        further: sum of the weights of pictures restored with the frame; what is wrong with one's kernels is not what is
        wrong with another's, so the wrong part of the change falls with their number.
        """
        return float(np.clip(1 - 0.5 * (1 - self.share) / (1 + further), 0.0, 1.0))

    def of_change_db(
        self, changed: float, lost: float, ideal: float, misplaced: Misplaced = IN_PLACE
    ) -> tuple[float, float]:
        """The gain of a restored picture that differs by ``changed`` from the recorded one, and its deviation.

        Mean squares in grey levels; lost: what the blur took, ideal: what an ideal filter would leave, by the spectra.
        misplaced: what rows that lie wrong make of that.  Unknown are what is left, by its law; what was removed, by
        the scatter of the share and by how far the two that tell it lie apart; and where the rows lie.
        """
        left = float(np.exp(tellers(ideal, self.left) @ np.array(LEFT_OVER)))
        gone = removed(changed, lost)
        before, after = errors(left, gone, *misplaced.errors(gone))
        gains_db = 10 * np.log10(before / after)
        gain_db = float(misplaced.weight @ gains_db)
        per_removed, per_left = (float(misplaced.weight @ s) for s in (gone / before, left / before - left / after))
        apart = 0.5 * abs(np.log(changed / lost)) if gone > 0 else 0.0
        of_place_db = np.sqrt(misplaced.weight @ (gains_db - gain_db) ** 2)
        of_rest = np.linalg.norm((per_left * LEFT_OVER_STD, per_removed * self.std, per_removed * apart))
        return gain_db, float(np.hypot(of_place_db, 10 / np.log(10) * of_rest))


def errors(left: Array | float, gone: Array | float, blurred: Array, restored: Array) -> tuple[Array, Array]:
    """Squared errors before and after a restoration: what it leaves, removes, and what misplaced rows add to each."""
    return left + gone + blurred, left + restored


def removed(changed: float, lost: float) -> float:
    """Squared error that restoring removes, by what it changed and by what the blur took.

    Either would be it, were the restoration right and were the spectra, and a change beyond what was lost is an error
    of its own: the mean of their logarithms.  A fit that weighs them freely gives the change 0.36 ± 0.12.
    """
    return float(np.sqrt(changed * max(lost, 0.0)))


def tellers(ideal: float, left: float) -> Array:
    """(3,) what :data:`LEFT_OVER` multiplies."""
    return np.asarray(np.log(np.maximum((np.e, ideal, left), 1e-6)))


def _gain_db(part: float) -> float:
    """Gain in dB for a removed part of the error."""
    return 10 * float(np.log10(1 / max(1 - part, 1e-3)))


def confirmed_gain(found: Sequence[tuple[float, float, float, float]]) -> ConfirmedGain | None:
    """The share by pairs of (fall of the squared error, squared change, part lacked, part left); None: too few.

    A ratio of sums: pairs that changed little tell little.  Few pairs tell the share no better than their scatter lets
    them, so it is weighed against what is usual (normal distributions; the deviation of a mean of few is Student's).
    Nothing is confirmed where a change for the better predicts neighbours hardly better than recorded frames do: what
    these lack is then something else than sharpness.
    """
    if len(found) < LEAST_PAIRS:
        return None
    gained, changed, lacked, left = np.array(found).T
    if changed.sum() <= 0:
        return None
    measured, weight = gained.sum() / changed.sum(), changed / changed.sum()
    scatter = float(np.sqrt(weight @ (gained / changed - measured) ** 2))
    freedom = len(found) - 1
    of_mean = student_deviation(freedom) / np.sqrt(freedom)
    usual = (of_mean * scatter) ** 2 / ((of_mean * scatter) ** 2 + USUAL_SHARE_STD**2)
    share = usual * USUAL_SHARE + (1 - usual) * measured
    seen_db = 10 * np.log10(lacked / left)
    mean_db = weight @ seen_db
    if measured > 0 and mean_db + of_mean * np.sqrt(weight @ (seen_db - mean_db) ** 2) < LEAST_SEEN_DB:
        share = 0.0
    return ConfirmedGain(float(share), scatter, float(np.mean(left)), len(found))
