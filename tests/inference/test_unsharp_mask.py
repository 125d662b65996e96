"""A phone's unsharp mask is detected at edges, distinguished from other effects, and reversed."""

import cv2
import numpy as np
import pytest
from laws import TurningCamera, phone
from scipy.special import ndtr

from virest.inference.unsharp_mask import (
    HIDDEN,
    OUTLINED,
    SHARPENED,
    Overshoot,
    UnsharpMask,
    _beside_line,
    overshoot,
    without_mask,
)
from virest.simulation.phone_pictures import sharpen

SIZE = 280
AT_REST = TurningCamera(phone(SIZE, SIZE, 300.0), (1e-4, 0.0, 0.0)).motion


def strokes(rng, width_px=0.75, stroke_px=3.0, bright=200.0, dark=60.0):
    """Dark printed strokes in all directions on bright paper, softened by a lens, in grey levels."""
    y, x = np.mgrid[:SIZE, :SIZE].astype(float)
    ink = np.zeros((SIZE, SIZE))
    near = 17  # a stroke ends within this distance
    for top in range(24, SIZE - 20, 34):
        for left in range(24, SIZE - 20, 34):
            angle, half = rng.uniform(0, np.pi), rng.uniform(7, 9)
            here = np.s_[top - near : top + near, left - near : left + near]
            along = (x - left)[here] * np.cos(angle) + (y - top)[here] * np.sin(angle)
            beside = (y - top)[here] * np.cos(angle) - (x - left)[here] * np.sin(angle)
            line, ends = (
                ndtr((at + reach) / width_px) - ndtr((at - reach) / width_px)
                for at, reach in ((beside, stroke_px / 2), (along, half))
            )
            ink[here] = np.maximum(ink[here], line * ends)
    return bright + (dark - bright) * ink


def discs(rng):
    """Overlapping discs of uniform light: steps of all heights with flat sides."""
    fine = np.full((2 * SIZE, 2 * SIZE), 128, np.uint8)
    for _ in range(250):
        x, y, radius_px = (int(v) for v in rng.uniform(0, [2 * SIZE, 2 * SIZE, 70]))
        cv2.circle(fine, (x, y), radius_px, int(rng.uniform(40, 215)), -1, cv2.LINE_AA)
    return cv2.GaussianBlur(cv2.resize(fine, (SIZE, SIZE), interpolation=cv2.INTER_AREA).astype(float), (0, 0), 0.7)


def masked(grey, amount, radius_px):
    """A grey or colour picture with the mask."""
    colour = (grey if grey.ndim == 3 else np.repeat(grey[..., None], 3, axis=-1)) / 255
    shown = 255 * sharpen(colour.astype(np.float32), amount, radius_px)
    return shown if grey.ndim == 3 else shown[..., 0]


def recorded(rng, grey, amount=0.0, radius_px=1.0):
    """An 8-bit picture with the mask and noise of one grey level."""
    shown = masked(grey, amount, radius_px) if amount else grey
    return np.clip(np.rint(shown + rng.standard_normal(grey.shape)), 0, 255).astype(np.uint8)


def seen(rng, scene, **mask):
    """The overshoot of edges in three frames of a camera at rest."""
    grey = scene(rng)
    return overshoot([(recorded(rng, grey, **mask), AT_REST) for _ in range(3)])


@pytest.mark.parametrize("scene", [strokes, discs])
@pytest.mark.parametrize(("amount", "radius_px"), [(0.4, 1.0), (0.7, 1.3), (1.0, 1.1)])
def test_a_mask_is_detected(rng, scene, amount, radius_px):
    """Its gain is right within a third at frequencies at which pictures have detail."""
    found = seen(rng, scene, amount=amount, radius_px=radius_px)
    assert found is not None
    assert found.overshoots
    mask = found.mask()
    for frequency in (0.15, 0.3):
        passed, truth = (
            a * (1 - np.exp(-2 * (np.pi * r * frequency) ** 2))
            for a, r in ((mask.amount, mask.radius_px), (amount, radius_px))
        )
        assert passed == pytest.approx(truth, rel=0.34), frequency


def with_tails(rng):
    """A picture with 60 % soft and hazy area, where an edge approaches its plateau slowly."""
    sharp = discs(rng)
    hazy = 0.75 * cv2.GaussianBlur(sharp, (0, 0), 0.8) + 0.25 * cv2.GaussianBlur(sharp, (0, 0), 4.0)
    return np.where(np.arange(SIZE) < 0.6 * SIZE, hazy, sharp)


def test_a_mask_is_detected_among_soft_edges(rng):
    """Most edges hide it in their tails; the sharpest ones reveal it."""
    found = seen(rng, with_tails, amount=0.8, radius_px=1.0)
    assert found is not None
    mask = found.mask()
    assert mask.amount * mask.radius_px**2 == pytest.approx(0.8, rel=0.34)


@pytest.mark.parametrize("scene", [strokes, discs, with_tails])
def test_an_unsharpened_picture_has_no_mask(rng, scene):
    """Print and plain surfaces, in focus and defocused; only what a hidden mask would be is undone."""
    for picture in (scene, lambda r: cv2.GaussianBlur(scene(r), (0, 0), 1.2)):
        found = seen(rng, picture)
        assert found is not None
        assert not found.overshoots
        assert found.expected_mask().amount < 0.15


def test_a_response_curve_is_not_a_mask(rng):
    """A curve shapes the two sides of an edge differently and exceeds neither plateau."""
    found = seen(rng, lambda r: 255 * (strokes(r) / 255) ** 0.5)
    assert found is not None
    assert not found.overshoots


def test_without_edges_no_mask_is_detected(rng):
    """A uniform picture and an empty list give no result."""
    assert seen(rng, lambda r: np.full((SIZE, SIZE), 128.0), amount=0.7) is None
    assert overshoot([]) is None


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize(("amount", "radius_px"), [(0.5, 1.0), (1.4, 0.8), (1.0, 2.0)])
def test_a_mask_is_reversed(rng, channels, amount, radius_px):
    """The result is right within rounding, and the differences of colours from luma stay."""
    grey = strokes(rng, bright=170.0, dark=90.0)
    colour = np.stack([grey, grey - 20, grey + 15], -1)
    if channels == 1:
        colour = colour @ np.array([0.299, 0.587, 0.114])
    shown = np.rint(masked(colour, amount, radius_px))
    assert 0 < shown.min() < shown.max() < 255
    undone = without_mask(shown.astype(np.uint8), UnsharpMask(amount, radius_px)).astype(float)
    inner = np.s_[20:-20, 20:-20]
    assert np.abs(shown - colour)[inner].max() > 10
    assert np.abs(undone - colour)[inner].max() < 4
    assert np.sqrt(np.mean((undone - colour)[inner] ** 2)) < 0.6


def test_clipped_light_stays_clipped(rng):
    """A clipped highlight is not turned into a measured value; pixels beside it lose their overshoot."""
    colour = np.repeat(strokes(rng, bright=170.0, dark=90.0)[..., None], 3, -1)
    colour[60:90, 70:95] = 900.0
    shown = np.clip(np.rint(masked(colour, 0.8, 1.0)), 0, 255).astype(np.uint8)
    undone = without_mask(shown, UnsharpMask(0.8, 1.0))
    assert np.all(undone[shown == 255] == 255)
    assert np.any(undone != shown)


def test_an_overshoot_is_reversed_in_part():
    """The reversed part of the mask grows with the sharpest edges' overshoot, up to what an outlined scene leaves."""
    shares = []
    for amount in (0.3, 0.5, 0.6, 0.8):
        profile = _beside_line(np.array([0.8, amount, np.log(1.1), 6.0, 1.0, 0.0]))
        found = Overshoot(0.0, float(profile.max() - 1), 1.0, 0.01, profile)
        shares.append(found.expected_mask().amount / found.mask().amount)
    assert 0.2 < shares[0] < shares[1] < shares[2] < shares[3]
    shown, outlined = SHARPENED * (1 - HIDDEN), (1 - SHARPENED) * OUTLINED
    assert shares[3] == pytest.approx(shown / (shown + outlined), rel=0.02)


@pytest.mark.parametrize("scene", [strokes, discs])
def test_an_outlined_scene_keeps_its_outlines(rng, scene):
    """A scene may overshoot as a mask does: undoing what is expected harms it less than a blur of 3 px."""
    outlined = masked(scene(rng), 0.8, 1.4)
    found = overshoot([(recorded(rng, outlined), AT_REST) for _ in range(3)])
    assert found is not None
    assert found.overshoots

    def harm(picture):
        return np.sqrt(np.mean((picture.astype(float) - outlined)[20:-20, 20:-20] ** 2))

    seen = np.clip(np.rint(outlined), 0, 255).astype(np.uint8)
    assert harm(without_mask(seen, found.expected_mask())) < 0.9 * harm(cv2.blur(outlined, (3, 1)))
    assert harm(without_mask(seen, found.mask())) > harm(cv2.blur(outlined, (3, 1)))


def test_an_invisible_mask_is_expected_with_its_probability():
    """Edges without overshoot exclude a visible mask only: the usual one remains, if the edges hide it."""
    profile = _beside_line(np.array([0.5, 0.0, np.log(1.2), 20.0, 1.0, 0.0]))
    mask = Overshoot(0.0, 0.0, 1.0, 0.006, profile).expected_mask()
    hidden, bare = SHARPENED * HIDDEN, (1 - SHARPENED) * (1 - OUTLINED)
    assert mask.amount == pytest.approx(0.6 * hidden / (hidden + bare), rel=0.02)
    assert mask.radius_px == pytest.approx(1.2, abs=0.02)
