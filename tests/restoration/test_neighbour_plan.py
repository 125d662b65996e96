"""What planning takes from some runs of neighbouring frames."""

from __future__ import annotations

import cv2
import pytest
from blurred_scene import FRAME, camera, record

from virest.inference.unsharp_mask import UnsharpMask, without_mask
from virest.restoration.neighbour_plan import MOST_COST, _without_great_cost
from virest.restoration.neighbours.sights import Sight
from virest.restoration.settings import RestorationSettings
from virest.restoration.trial import blur_error

MASK, BALANCED = UnsharpMask(0.4, 1.2), RestorationSettings()


def _sight(speed: float) -> Sight:
    turning = camera((0.9 * speed, -2.0 * speed, 0.6 * speed))
    return Sight(FRAME, cv2.cvtColor(record(turning).picture, cv2.COLOR_RGB2GRAY), turning.motion)


def test_a_mask_is_undone_as_far_as_its_change_is_small_beside_the_blur() -> None:
    """All of it with 10 px of blur, still frames or not, a part with 2 px, and nothing where no blur is known."""
    long, short = _sight(1.0), _sight(0.2)
    assert _without_great_cost(MASK, {0: long, 1: long, 2: _sight(0.02)}, BALANCED) == MASK
    part = _without_great_cost(MASK, {0: short}, BALANCED)
    assert part.radius_px == MASK.radius_px
    change = cv2.norm(without_mask(short.picture, part), short.picture, cv2.NORM_L2SQR) / short.picture.size
    assert short.motion is not None
    lost = blur_error(short.picture, short.motion, BALANCED, None)
    assert lost is not None
    assert 0.5 * MOST_COST < change / lost < 2 * MOST_COST  # rounded to grey levels
    whole = cv2.norm(without_mask(short.picture, MASK), short.picture, cv2.NORM_L2SQR) / short.picture.size
    assert whole / lost > 4 * MOST_COST
    assert _without_great_cost(MASK, {}, BALANCED).amount == pytest.approx(0.0)
