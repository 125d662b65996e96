"""What neighbours' account of a change makes of its promise, by hand-made figures and by the best filter."""

import numpy as np
import pytest

from virest.restoration.neighbours.confirmation import ConfirmedGain, confirmed_gain
from virest.restoration.neighbours.survey import gain_test_candidates
from virest.restoration.statistics.records import Misplaced

FRAMES, PLACES = 2000, 16
POWER, CODED = 400.0, 6.0
"""Of a sharp picture, and of its coder's error, grey levels squared."""


def _filtered(strength: float) -> tuple[np.ndarray, np.ndarray]:
    """What recorded signals lack, and what a Wiener filter with a multiple of the noise changes, (FRAMES, PLACES)."""
    rng = np.random.default_rng(5)
    passed, noise = np.linspace(1.0, 0.0, PLACES) ** 2, 0.02
    sharp = rng.normal(size=(FRAMES, PLACES))
    recorded = passed * sharp + np.sqrt(noise) * rng.normal(size=sharp.shape)
    restored = recorded * passed / (passed**2 + strength * noise)
    return sharp - recorded, restored - recorded


@pytest.mark.parametrize(("strength", "low", "high"), [(1.0, 0.97, 1.03), (0.1, -0.5, 0.7), (6.0, 1.1, 3.0)])
def test_the_share_is_one_for_the_best_filter_and_less_for_one_that_does_too_much(strength, low, high):
    """What the best filter leaves is unrelated to what it changed; too little noise assumed takes the share down."""
    lacked, changed = _filtered(strength)
    fall = (lacked**2).mean() - ((lacked - changed) ** 2).mean()
    found = confirmed_gain([(fall, (changed**2).mean(), 0.02, 0.01)] * 2)
    assert found is not None
    assert low < found.share < high


def test_the_part_taken_leaves_the_least_error():
    """Of a change that is too large, no other part leaves less of the error."""
    lacked, changed = _filtered(0.1)
    fall = (lacked**2).mean() - ((lacked - changed) ** 2).mean()
    found = confirmed_gain([(fall, (changed**2).mean(), 0.02, 0.01)] * 2)
    assert found is not None
    errors = {part: ((lacked - part * changed) ** 2).mean() for part in np.linspace(0, 1, 101)}
    assert found.taken == pytest.approx(min(errors, key=errors.__getitem__), abs=0.011)
    assert found.taken < 1.0


def test_a_change_for_the_worse_promises_nothing():
    """A share below nothing promises a loss before anything is restored."""
    harmful = confirmed_gain([(-1.0, 2.0, 0.1, 0.2), (-0.5, 1.0, 0.1, 0.2)])
    assert harmful is not None
    assert harmful.expected_db(3.0) < 0


def test_too_few_pairs_or_no_change_confirm_nothing():
    """One pair has no scatter; no change has no share."""
    assert confirmed_gain([(1.0, 1.0, 0.2, 0.1)]) is None
    assert confirmed_gain([(0.0, 0.0, 0.1, 0.1)] * 3) is None


def test_a_larger_change_promises_more_and_a_larger_rest_less():
    """The promise grows with what was changed and what was lost, falls with what is left, and has a deviation."""
    found, unlike = (ConfirmedGain(1.0, 0.2, left, 4) for left in (0.02, 0.1))
    much = found.of_change_db(50.0, 80.0, 30.0, POWER, CODED)
    changed = ((5.0, 80.0, 30.0), (50.0, 8.0, 30.0), (50.0, 80.0, 300.0))
    less = [found.of_change_db(*asked, POWER, CODED) for asked in changed]
    less.append(unlike.of_change_db(50.0, 80.0, 30.0, POWER, CODED))
    less.append(found.of_change_db(50.0, 80.0, 30.0, POWER, 10 * CODED))
    assert all(0 < gain_db < much[0] for gain_db, _ in less)
    assert all(deviation > 0 for _, deviation in (much, *less))
    assert found.of_change_db(0.0, 80.0, 30.0, POWER, CODED)[0] == 0.0


def test_a_dimmer_picture_is_promised_the_same():
    """A quarter of the light's contrast is a sixteenth of every power: no gain changes by that."""
    found = ConfirmedGain(1.0, 0.2, 0.02, 4)
    bright, dim = (
        found.of_change_db(50.0 * by, 80.0 * by, 30.0 * by, POWER * by, CODED * by, colour=(20.0 * by, 10.0 * by))
        for by in (1.0, 1 / 16)
    )
    np.testing.assert_allclose(bright, dim, rtol=1e-6)


def test_colour_that_stays_blurred_promises_less_and_colour_that_is_removed_more():
    """Saturated scenes have as much error in colour as in luma."""
    found = ConfirmedGain(1.0, 0.2, 0.02, 4)
    grey, stays, goes = (
        found.of_change_db(50.0, 80.0, 30.0, POWER, CODED, colour=colour)[0]
        for colour in ((0.0, 0.0), (0.0, 100.0), (100.0, 0.0))
    )
    assert stays < grey < goes


def test_rows_that_lie_wrong_promise_less():
    """The more a sharp picture loses by its place over a blurred one, the less is promised; a loss is told as one."""
    found = ConfirmedGain(1.0, 0.2, 0.02, 4)
    in_place, less, lost = (
        found.of_change_db(50.0, 80.0, 30.0, POWER, CODED, misplaced)[0]
        for misplaced in (Misplaced(), _misplaced(20.0, 60.0), _misplaced(50.0, 400.0))
    )
    assert lost < 0 < less < in_place


def test_a_promise_of_next_to_nothing_still_has_a_deviation():
    """Rows that may lie anywhere within half a pixel: the mean gain is small, what it may be is not."""
    found = ConfirmedGain(1.0, 0.2, 0.02, 4)
    places = _misplaced(40.0, 50.0), Misplaced()
    off, in_place = (found.of_change_db(5.0, 5.0, 5.0, POWER, CODED, misplaced) for misplaced in places)
    assert 0 < off[0] < in_place[0]
    assert off[1] > in_place[1] > 0


def test_a_weaker_restoration_loses_less_by_its_place():
    """What was hardly changed can hardly be worse."""
    found = ConfirmedGain(1.0, 0.2, 0.02, 4)
    misplaced = _misplaced(50.0, 400.0, 80.0)
    weak, strong = (found.of_change_db(by, by, 30.0, POWER, CODED, misplaced)[0] for by in (0.01, 60.0))
    assert strong < weak
    assert weak == pytest.approx(0.0, abs=0.01)


def test_two_tellers_that_disagree_widen_the_promise():
    """The same geometric mean of what was changed and what was lost, once alike and once a hundredfold apart."""
    found = ConfirmedGain(1.0, 0.0, 0.02, 4)
    alike, apart = (found.of_change_db(changed, 100.0 / changed, 30.0, POWER, CODED) for changed in (10.0, 100.0))
    assert alike[0] == pytest.approx(apart[0])
    assert apart[1] > 1.5 * alike[1]


def _misplaced(blurred: float, restored: float, removed: float = 1.0) -> Misplaced:
    """Either in its place or off by such errors, as likely."""
    return Misplaced(np.array([0.0, blurred]), np.array([0.0, restored]), removed, np.array([0.5, 0.5]))


def test_neighbours_that_lack_something_else_confirm_nothing():
    """A change that correlates with what is missing, and leaves nearly all of it, is not confirmed."""
    unlike = confirmed_gain([(0.5, 0.1, 0.405, 0.4)] * 4)
    alike = confirmed_gain([(0.5, 0.1, 0.5, 0.4)] * 4)
    assert unlike is not None
    assert unlike.share == 0.0
    assert alike is not None
    assert alike.share == pytest.approx(5.0)


def _pairs(*shares: float) -> list[tuple[float, float, float, float]]:
    """Pairs of such shares, each of a change of 1; neighbours are predicted better where the share is positive."""
    return [(share, 1.0, 0.1 * 10 ** (0.05 * share), 0.1) for share in shares]


def test_few_pairs_that_contradict_each_other_do_not_outweigh_what_is_usual():
    """Two pairs at -4.4 and -8.8 say little about a capture; eight that agree on a loss are believed."""
    scattered, agreed = confirmed_gain(_pairs(-4.4, -8.8)), confirmed_gain(_pairs(*np.linspace(-0.9, -0.5, 8)))
    assert scattered is not None
    assert agreed is not None
    assert 0.3 < scattered.share < 1.0
    assert agreed.share == pytest.approx(-0.7, abs=0.05)


def test_a_pair_that_changed_little_does_not_decide():
    """Calm frames predict their neighbours no better; the blurred one that gained tells."""
    calm = [(-0.001, 0.001, 0.05, 0.0505)] * 3
    found = confirmed_gain([*calm, (1.0, 1.0, 0.2, 0.1), (0.9, 1.0, 0.2, 0.1)])
    assert found is not None
    assert found.share > 0.8


def test_candidates_for_the_gain_test_are_blurred_enough():
    """The first frame of each run that was blurred enough, then the others; those without two neighbours never."""
    path_px = dict(enumerate([1.0, 2.0, 3.0, 9.0, 8.0, 2.0, 1.0, 12.0]))
    assert gain_test_candidates([(0, 1, 2, 3), (4, 5, 6, 7)], path_px) == [2, 4, 3, 1, 5, 6]
    assert gain_test_candidates([(0, 1, 2, 3)], {n: path_px[n] / 4 for n in range(4)}) == [2, 1]
    assert gain_test_candidates([(4, 5, 6, 7)], {n: path_px[n] for n in (4, 5, 7)}) == []


def test_a_pair_that_restoring_leaves_alone_says_nothing() -> None:
    """It neither confirms nor refutes, and makes no share that is no number."""
    pairs = [(0.8, 1.0, 0.2, 0.1), (0.5, 0.8, 0.2, 0.1)]
    assert confirmed_gain([*pairs, (0.0, 0.0, 0.2, 0.2)]) == confirmed_gain(pairs)
    assert confirmed_gain([pairs[0], (0.0, 0.0, 0.2, 0.2)]) is None
