"""The true gain of deblurring on a capture, measured on neighbours that were blurred along other paths.

Restoring changes a picture by D and reduces its error from |M|² to |M − D|².  If D is the best estimate that the data
allow, the remaining error is uncorrelated with it, and |M|² − |M − D|² = |D|² (the projection theorem): the size of the
change then equals the gain.  Neighbours test whether that holds.  With all blurred along the neighbour's path, the
share (|M|² − |M − D|²) / |D|² is 1 for the best restoration, 0 for one that does as much harm as good, and negative for
one that does more harm.  The neighbour's own noise, and what it cannot show, cancel, since D contains neither.  If the
share s is below 1, the change is too large: (1 + s) / 2 of D leaves the least error, and that is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from virest.arrays import Array
from virest.inference.chance import student_deviation
from virest.restoration.statistics.records import Misplaced

LEAST_PAIRS = 2
"""A single pair has no scatter."""
LEAST_SEEN_DB = 0.1
"""Least improvement in predicting neighbours, dB; a frame is not deblurred for less either."""
USUAL_SHARE, USUAL_SHARE_STD = 1.0, 0.5
"""Prior of the share: 1 for a correct restoration.  On 8 simulated captures, with exact profiles and with a phone's
errors, it scattered by 0.3 between captures.  The prior is wider, so that wrong models are detected, while a few pairs
that contradict each other still do not outweigh it."""
LEFT_OVER = (1.28, 0.61, 0.29, 0.08, 0.73)
"""Coefficients of the remaining squared error, grey levels squared.  Of ln of luma's over the sharp picture's power: a
constant, and the slopes over ln of the spectra's ideal error over that power, over ln of the part that neighbours do
not find restored, and over ln of the coder's error over that power; so a dimmer picture has as much less error.  Then
that of the colour differences' ideal error, which a regression on the restored luma undercuts.

The coder's error counts beyond its noise: a coder drops the faint detail of a blurred picture and fills it in from
other frames, so what is left there is not the blurred picture.

Each predicts the error only to a factor.  ``python -m virest.app.bench --only fits`` fits the coefficients to pictures
with ground truth: 1.45 ± 0.48, 0.75 ± 0.10, 0.13 ± 0.13, 0.28 ± 0.13, 0.57 ± 0.36 on 22 captures, median error 0.45 dB.
These are fitted to 17 captures of another simulator too, with effects of phones that no profile has, and differ by at
most 1.5 deviations.  Where each capture is left out of its own fit, the median error is 0.53 dB on the 22 captures and
0.58 dB on the 17.  On all 55 captures of that simulator they predict 0.5 dB too much (median error 0.84 dB).  Fitted to
those too, they predict 0.28 dB too much there, but 0.28 dB too little on the 22, so that frames which gain are refused
(``fast`` on phones: +1.29 instead of +1.35 dB)."""
LEFT_OVER_STD = 0.71
"""Standard deviation of that logarithm, from the same 39 captures."""
IN_PLACE = Misplaced()
"""No row displacement."""


@dataclass(frozen=True, slots=True)
class ConfirmedGain:
    """How much of the change by restoring is an improvement on this capture, according to neighbouring frames."""

    share: float
    """Decrease of the squared error over the squared change."""
    std: float
    """Standard deviation of the share between pairs."""
    left: float
    """Fraction of a neighbour's power that the restored frame, blurred along the neighbour's path, does not predict."""
    pairs: int
    """Number of compared pairs."""

    def expected_db(self, promised_db: float) -> float:
        """The expected gain, dB, given the model's predicted gain, before a frame is restored."""
        return _gain_db(min(self.share, 1.0) * (1 - 10 ** (-promised_db / 10)))

    @property
    def taken(self) -> float:
        """The fraction of the change that leaves the least error.

        It holds for frames restored with neighbours too: what is wrong with a phone's kernels (its tone curve, the
        gyroscope's low pass) is wrong in all frames.
        """
        return float(np.clip(0.5 * (1 + self.share), 0.0, 1.0))

    def of_change_db(
        self,
        changed: float,
        lost: float,
        ideal: float,
        power: float,
        coded: float,
        misplaced: Misplaced = IN_PLACE,
        colour: tuple[float, float] = (0.0, 0.0),
    ) -> tuple[float, float]:
        """Gain, dB, of a restored picture, and its standard deviation.

        changed: mean square difference from the recorded picture; lost: that removed by the blur; ideal: an ideal
        filter's error; power: the sharp picture's; the last three of luma, from the spectra.  coded: the coder's error,
        or the noise where the coder's step is unknown.  All in grey levels squared.  misplaced: error by displaced
        rows.  colour: errors that an ideal filter removes from the colour differences, and that it leaves.
        The deviation combines the uncertainty of the remaining error (LEFT_OVER_STD), of the removed error (the scatter
        of the share, and the disagreement of ``changed`` and ``lost``), and of the rows' displacement.
        """
        lost += colour[0]
        left = float(remaining_error(gain_regressors(ideal, power, self.left, coded, colour[1]), np.array(LEFT_OVER)))
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
    """Squared errors before and after a restoration, from what it leaves and removes, and what displaced rows add."""
    return left + gone + blurred, left + restored


def removed(changed: float, lost: float) -> float:
    """Squared error that restoring removes: the geometric mean of its squared change and of what the blur removed.

    The first would be exact for a correct restoration, the second for correct spectra, and a change larger than the
    loss is itself an error.  A fit with a free weight finds 0.36 ± 0.12 instead of ½ for the change.
    """
    return float(np.sqrt(changed * max(lost, 0.0)))


def gain_regressors(ideal: float, power: float, left: float, coded: float, colour: float) -> Array:
    """(6,) the regressors of :data:`LEFT_OVER`, and the sharp picture's power."""
    power = max(power, 1e-6)
    return np.array([1.0, *np.log(np.maximum((ideal / power, left, coded / power), 1e-6)), colour, power])


def remaining_error(regressors: Array, coefficients: Array) -> Array:
    """Squared error (...) that a restoration leaves, from regressors (..., 6) and :data:`LEFT_OVER`."""
    luma, colour = np.exp(regressors[..., :4] @ coefficients[:4]), coefficients[4] * regressors[..., 4]
    return np.asarray(regressors[..., 5] * luma + colour)


def _gain_db(part: float) -> float:
    """Gain, dB, if this fraction of the squared error is removed."""
    return 10 * float(np.log10(1 / max(1 - part, 1e-3)))


def confirmed_gain(found: Sequence[tuple[float, float, float, float]]) -> ConfirmedGain | None:
    """The share from pairs of (decrease of the squared error, squared change, part lacked, part left).

    None with fewer than LEAST_PAIRS pairs in which restoring changed anything.  The share is a ratio of sums, since
    pairs that changed little carry little information.  It is combined with the prior USUAL_SHARE by its scatter
    (normal distributions; Student's deviation for a mean of few).  A positive share becomes 0 if the restored frames
    predict the neighbours hardly better than the recorded ones do: what these lack is then not sharpness.
    """
    found = [pair for pair in found if pair[1] > 0]
    if len(found) < LEAST_PAIRS:
        return None
    gained, changed, lacked, left = np.array(found).T
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
