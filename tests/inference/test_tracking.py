"""Tracking on pictures with known motion."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from virest.inference import tracking
from virest.inference.tracking import TrackingSettings, find_corners, track_frames, track_pairs

Picture = NDArray[np.uint8]


def texture(height: int, width: int, seed: int = 0) -> Picture:
    """Blobs of several sizes."""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width))
    for sigma in (1.5, 3.0, 8.0):
        layer = cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), sigma)
        total += layer / layer.std()
    return np.clip(128 + 35 * total, 0, 255).astype(np.uint8)


def view(picture: Picture, shift_px: tuple[float, float], size: tuple[int, int] = (360, 480)) -> Picture:
    """Cut a window of the picture; its content moves by shift_px (x, y)."""
    moved = ndimage.shift(picture.astype(float), (shift_px[1], shift_px[0]), order=3, mode="reflect")
    return np.clip(np.rint(moved[150 : 150 + size[0], 150 : 150 + size[1]]), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("shift_px", [(0.4, -1.7), (17.3, 9.6), (-58.0, 37.0)])
def test_points_follow_the_picture(shift_px: tuple[float, float]) -> None:
    """Points move with the content, from less than 1 px to 70 px, with a median error below 0.05 px."""
    scene = texture(700, 800)
    pair = track_pairs([(4, view(scene, (0, 0))), (5, view(scene, shift_px))])[0]
    assert (pair.first, pair.second) == (4, 5)
    assert len(pair) > 60
    moved = pair.points_second_px - pair.points_first_px
    assert np.abs(np.median(moved - shift_px, axis=0)).max() < 0.03
    assert np.median(np.abs(moved - shift_px)) < 0.05


def test_blurred_pictures_are_tracked() -> None:
    """A motion blur of 15 px in both pictures does not lose the points."""
    scene = cv2.filter2D(texture(700, 800), -1, np.full((1, 15), 1 / 15))
    pair = track_pairs([(0, view(scene, (0, 0))), (1, view(scene, (12.5, -3.0)))])[0]
    assert len(pair) > 60
    assert np.median(np.abs(pair.points_second_px - pair.points_first_px - (12.5, -3.0))) < 0.1


def test_tracking_in_parts_gives_the_same_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cuts, jumps and repeated frames neither lose, duplicate nor add a pair."""
    scene = texture(700, 800)
    movie = {k: view(scene, (2.5 * k, -1.5 * k), (120, 160)) for k in (*range(9), *range(20, 25))}
    movie[4] = movie[3]

    def gray(frames: Sequence[int]) -> list[tuple[int, Picture | None]]:
        return [(k, movie[k]) for k in frames]

    whole = track_pairs(gray(list(movie)))
    for length in (3, 4, 5):
        monkeypatch.setattr(tracking, "PART_FRAMES", length)
        done: list[int] = []
        parts = track_frames(gray, list(movie), progress=done.append)
        assert [(p.first, p.second) for p in parts] == [(p.first, p.second) for p in whole]
        assert all(np.array_equal(a.points_second_px, b.points_second_px) for a, b in zip(parts, whole, strict=True))
        assert sum(done) == len(movie)
        assert max(done) <= length


def test_halving_keeps_stored_coordinates() -> None:
    """Large pictures are halved for tracking; points have the coordinates of the stored picture."""
    scene = texture(1300, 1300)
    big = [view(scene, shift, (700, 1000)) for shift in ((0, 0), (10.0, 6.0))]
    pair = track_pairs(list(enumerate(big)))[0]
    assert np.abs(np.median(pair.points_second_px - pair.points_first_px - (10.0, 6.0), axis=0)).max() < 0.05
    assert pair.points_first_px[:, 0].max() > 900
    corners = find_corners(cv2.resize(big[0], (500, 350), interpolation=cv2.INTER_AREA), TrackingSettings())
    np.testing.assert_allclose(
        np.min(np.linalg.norm(pair.points_first_px[0] - (2 * corners + 0.5), axis=1)), 0, atol=1e-3
    )


def test_repeats_and_jumps_give_no_pair() -> None:
    """A repeated picture, a missing one and a jump in the index break the chain."""
    scene = texture(700, 800)
    a, b, c, d = (view(scene, (2.0 * k, 1.0 * k)) for k in range(4))
    pairs = track_pairs([(0, a), (1, b), (2, b.copy()), (3, c), (4, d), (5, None), (6, a), (9, b), (10, c)])
    assert [(pair.first, pair.second) for pair in pairs] == [(0, 1), (3, 4), (9, 10)]


def test_textureless_pictures_give_no_pairs() -> None:
    """Flat pictures have no points, even with sensor noise of two levels."""
    rng = np.random.default_rng(0)
    noisy = [(k, rng.normal(100, 2, (360, 480)).astype(np.uint8)) for k in range(3)]
    assert track_pairs(noisy) == []
    assert track_pairs([(k, np.full((360, 480), 90 + k, np.uint8)) for k in range(3)]) == []


def test_points_are_spread_over_the_picture() -> None:
    """A strongly textured corner does not take all points: the number per grid cell is limited."""
    picture = (texture(360, 480).astype(float) * 0.3 + 60).astype(np.uint8)
    picture[:120, :120] = texture(120, 120, 1)
    corners = find_corners(picture, TrackingSettings())
    in_corner = ((corners < 120).all(axis=1)).mean()
    assert in_corner < 0.2
