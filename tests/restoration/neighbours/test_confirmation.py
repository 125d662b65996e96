"""The gain of a restoration as neighbours confirm it, from hand-made figures and for the best filter."""

import numpy as np
import pytest

from virest.restoration.neighbours.confirmation import ConfirmedGain, confirmed_gain
from virest.restoration.neighbours.survey import gain_test_candidates
from virest.restoration.statistics.records import Misplaced

FRAMES, PLACES = 2000, 16
POWER, CODED = 400.0, 6.0
"""Power of a sharp picture and of its coding error, grey levels squared."""


def _filtered(strength: float) -> tuple[np.ndarray, np.ndarray]:
    """Errors of recorded signals, and changes by a Wiener filter with a multiple of the noise, (FRAMES, PLACES)."""
    rng = np.random.default_rng(5)
    passed, noise = np.linspace(1.0, 0.0, PLACES) ** 2, 0.02
    sharp = rng.normal(size=(FRAMES, PLACES))
    recorded = passed * sharp + np.sqrt(noise) * rng.normal(size=sharp.shape)
    restored = recorded * passed / (passed**2 + strength * noise)
    return sharp - recorded, restored - recorded


@pytest.mark.parametrize(("strength", "low", "high"), [(1.0, 0.97, 1.03), (0.1, -0.5, 0.7), (6.0, 1.1, 3.0)])
def test_the_confirmed_share_is_one_for_the_best_filter(strength, low, high):
    """The best filter leaves an error uncorrelated with its change.

    Assuming too little noise lowers the share, assuming too much raises it.
    """
    lacked, changed = _filtered(strength)
    fall = (lacked**2).mean() - ((lacked - changed) ** 2).mean()
    found = confirmed_gain([(fall, (changed**2).mean(), 0.02, 0.01)] * 2)
    assert found is not None
    assert low < found.share < high


def test_the_applied_part_of_a_change_minimises_the_error():
    """For a change that is too large, no other part leaves a smaller error."""
    lacked, changed = _filtered(0.1)
    fall = (lacked**2).mean() - ((lacked - changed) ** 2).mean()
    found = confirmed_gain([(fall, (changed**2).mean(), 0.02, 0.01)] * 2)
    assert found is not None
    errors = {part: ((lacked - part * changed) ** 2).mean() for part in np.linspace(0, 1, 101)}
    assert found.taken == pytest.approx(min(errors, key=errors.__getitem__), abs=0.011)
    assert found.taken < 1.0


def test_a_harmful_change_predicts_a_loss():
    """A negative share predicts a loss before anything is restored."""
    harmful = confirmed_gain([(-1.0, 2.0, 0.1, 0.2), (-0.5, 1.0, 0.1, 0.2)])
    assert harmful is not None
    assert harmful.expected_db(3.0) < 0


def test_too_few_pairs_or_no_change_confirm_nothing():
    """One pair has no scatter; no change has no share."""
    assert confirmed_gain([(1.0, 1.0, 0.2, 0.1)]) is None
    assert confirmed_gain([(0.0, 0.0, 0.1, 0.1)] * 3) is None


def test_a_larger_change_and_a_smaller_rest_predict_more():
    """The expected gain grows with the change and the loss by blur, and falls with the rest and with coding noise.

    Every prediction has a standard deviation.
    """
    found, unlike = (ConfirmedGain(1.0, 0.2, left, 4) for left in (0.02, 0.1))
    much = found.of_change_db(50.0, 80.0, 30.0, POWER, CODED)
    changed = ((5.0, 80.0, 30.0), (50.0, 8.0, 30.0), (50.0, 80.0, 300.0))
    less = [found.of_change_db(*asked, POWER, CODED) for asked in changed]
    less.append(unlike.of_change_db(50.0, 80.0, 30.0, POWER, CODED))
    less.append(found.of_change_db(50.0, 80.0, 30.0, POWER, 10 * CODED))
    assert all(0 < gain_db < much[0] for gain_db, _ in less)
    assert all(deviation > 0 for _, deviation in (much, *less))
    assert found.of_change_db(0.0, 80.0, 30.0, POWER, CODED)[0] == 0.0


def test_the_predicted_gain_does_not_depend_on_brightness():
    """A quarter of the contrast gives a sixteenth of every power and the same gain."""
    found = ConfirmedGain(1.0, 0.2, 0.02, 4)
    bright, dim = (
        found.of_change_db(50.0 * by, 80.0 * by, 30.0 * by, POWER * by, CODED * by, colour=(20.0 * by, 10.0 * by))
        for by in (1.0, 1 / 16)
    )
    np.testing.assert_allclose(bright, dim, rtol=1e-6)


def test_unrestored_chroma_lowers_the_predicted_gain():
    """Chroma that stays blurred lowers the gain; chroma blur that is removed raises it."""
    found = ConfirmedGain(1.0, 0.2, 0.02, 4)
    grey, stays, goes = (
        found.of_change_db(50.0, 80.0, 30.0, POWER, CODED, colour=colour)[0]
        for colour in ((0.0, 0.0), (0.0, 100.0), (100.0, 0.0))
    )
    assert stays < grey < goes


def test_misplaced_rows_lower_the_predicted_gain():
    """The more error misplacement adds to a sharp picture than to a blurred one, the lower the gain, down to a loss."""
    found = ConfirmedGain(1.0, 0.2, 0.02, 4)
    in_place, less, lost = (
        found.of_change_db(50.0, 80.0, 30.0, POWER, CODED, misplaced)[0]
        for misplaced in (Misplaced(), _misplaced(20.0, 60.0), _misplaced(50.0, 400.0))
    )
    assert lost < 0 < less < in_place


def test_a_small_predicted_gain_has_a_standard_deviation():
    """Misplaced rows lower the mean gain and raise its standard deviation."""
    found = ConfirmedGain(1.0, 0.2, 0.02, 4)
    places = _misplaced(40.0, 50.0), Misplaced()
    off, in_place = (found.of_change_db(5.0, 5.0, 5.0, POWER, CODED, misplaced) for misplaced in places)
    assert 0 < off[0] < in_place[0]
    assert off[1] > in_place[1] > 0


def test_a_weak_restoration_loses_little_by_misplacement():
    """A frame that is hardly changed can hardly become worse."""
    found = ConfirmedGain(1.0, 0.2, 0.02, 4)
    misplaced = _misplaced(50.0, 400.0, 80.0)
    weak, strong = (found.of_change_db(by, by, 30.0, POWER, CODED, misplaced)[0] for by in (0.01, 60.0))
    assert strong < weak
    assert weak == pytest.approx(0.0, abs=0.01)


def test_disagreeing_estimates_widen_the_prediction():
    """Change and loss have the same geometric mean, once equal and once a hundredfold apart."""
    found = ConfirmedGain(1.0, 0.0, 0.02, 4)
    alike, apart = (found.of_change_db(changed, 100.0 / changed, 30.0, POWER, CODED) for changed in (10.0, 100.0))
    assert alike[0] == pytest.approx(apart[0])
    assert apart[1] > 1.5 * alike[1]


def _misplaced(blurred: float, restored: float, removed: float = 1.0) -> Misplaced:
    """Rows with equal probability in place or misplaced with these errors."""
    return Misplaced(np.array([0.0, blurred]), np.array([0.0, restored]), removed, np.array([0.5, 0.5]))


def test_a_change_that_leaves_the_error_is_not_confirmed():
    """A change that correlates with the missing detail but leaves nearly all of the error has a share of 0."""
    unlike = confirmed_gain([(0.5, 0.1, 0.405, 0.4)] * 4)
    alike = confirmed_gain([(0.5, 0.1, 0.5, 0.4)] * 4)
    assert unlike is not None
    assert unlike.share == 0.0
    assert alike is not None
    assert alike.share == pytest.approx(5.0)


def _pairs(*shares: float) -> list[tuple[float, float, float, float]]:
    """Pairs with these shares, each for a change of 1; neighbours are predicted better if the share is positive."""
    return [(share, 1.0, 0.1 * 10 ** (0.05 * share), 0.1) for share in shares]


def test_few_contradictory_pairs_do_not_outweigh_the_usual_share():
    """Two pairs at −4.4 and −8.8 say little; eight that agree on a loss are believed."""
    scattered, agreed = confirmed_gain(_pairs(-4.4, -8.8)), confirmed_gain(_pairs(*np.linspace(-0.9, -0.5, 8)))
    assert scattered is not None
    assert agreed is not None
    assert 0.3 < scattered.share < 1.0
    assert agreed.share == pytest.approx(-0.7, abs=0.05)


def test_a_pair_with_little_change_does_not_decide():
    """Calm frames predict their neighbours no better; blurred ones that gain decide."""
    calm = [(-0.001, 0.001, 0.05, 0.0505)] * 3
    found = confirmed_gain([*calm, (1.0, 1.0, 0.2, 0.1), (0.9, 1.0, 0.2, 0.1)])
    assert found is not None
    assert found.share > 0.8


def test_candidates_for_the_gain_test_are_blurred_enough():
    """The first sufficiently blurred frame of each run comes first, then the others.

    Frames without two neighbours are never candidates.
    """
    path_px = dict(enumerate([1.0, 2.0, 3.0, 9.0, 8.0, 2.0, 1.0, 12.0]))
    assert gain_test_candidates([(0, 1, 2, 3), (4, 5, 6, 7)], path_px) == [2, 4, 3, 1, 5, 6]
    assert gain_test_candidates([(0, 1, 2, 3)], {n: path_px[n] / 4 for n in range(4)}) == [2, 1]
    assert gain_test_candidates([(4, 5, 6, 7)], {n: path_px[n] for n in (4, 5, 7)}) == []


def test_an_unchanged_pair_is_ignored() -> None:
    """A pair without change neither confirms nor refutes, and makes no NaN."""
    pairs = [(0.8, 1.0, 0.2, 0.1), (0.5, 0.8, 0.2, 0.1)]
    assert confirmed_gain([*pairs, (0.0, 0.0, 0.2, 0.2)]) == confirmed_gain(pairs)
    assert confirmed_gain([pairs[0], (0.0, 0.0, 0.2, 0.2)]) is None
