"""Clipped light spreads along the blur path of its own place."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from virest.image_formation.kernels import KernelField
from virest.restoration.clipped_light import _along_paths, unmeasured_masks

WIDTH, HEIGHT, LENGTH = 160, 120, 12.0


def field(centres_px: np.ndarray) -> KernelField:
    """Across in the left half of the picture, down in the right one; twelve pixels long."""
    along = np.linspace(0.0, LENGTH, 40)
    across = np.stack([along, 0 * along], -1)
    down = np.stack([0 * along, along], -1)
    paths = np.array([across if x < WIDTH / 2 else down for x, _ in centres_px])
    return KernelField(centres_px, paths, 0.0)


BLURRED = SimpleNamespace(field=field, longest_px=LENGTH)


def test_a_highlight_reaches_along_the_path_of_where_it_lies() -> None:
    """Two lamps: the left one's streak lies across, the right one's down; neither is taken for the other's."""
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[55:58, 40] = mask[55:58, 120] = 1
    touched = _along_paths(mask, BLURRED, cv2.dilate)  # type: ignore[arg-type]
    left, right = touched[:, : WIDTH // 2], touched[:, WIDTH // 2 :]
    assert np.ptp(np.flatnonzero(left.any(axis=0))) >= 2 * LENGTH
    assert np.ptp(np.flatnonzero(left.any(axis=1))) <= 6
    assert np.ptp(np.flatnonzero(right.any(axis=1))) >= 2 * LENGTH
    assert np.ptp(np.flatnonzero(right.any(axis=0))) <= 4


@pytest.mark.parametrize("level", [0.05, 0.2])
def test_parts_meet_without_a_seam(level: float) -> None:
    """Where all paths are one, the parts make what the whole picture would; with half of it clipped and with little."""
    rng = np.random.default_rng(4)
    mask = (cv2.GaussianBlur(rng.normal(size=(HEIGHT, WIDTH)), (0, 0), 3) > level).astype(np.uint8)
    same = SimpleNamespace(field=lambda c: field(np.zeros_like(c)), longest_px=LENGTH)
    path = field(np.zeros((1, 2))).arrays(positive=True)[0]
    reach = (path + path[::-1, ::-1] > 2e-3).astype(np.uint8)
    for operation in (cv2.dilate, cv2.erode):
        np.testing.assert_array_equal(_along_paths(mask, same, operation), operation(mask, reach))  # type: ignore[arg-type]


def test_a_clipped_pixel_alone_is_kept_nowhere() -> None:
    """The path is longer than it: its neighbours tell what light there was, and nothing needs to be copied."""
    clipped = np.zeros((HEIGHT, WIDTH), np.float32)
    clipped[55:57, 40] = 1.0
    blurred = SimpleNamespace(field=field, light=[clipped] * 3, dark=[None] * 3, clipped=[clipped, None, None])
    assert unmeasured_masks(blurred) == [None] * 3  # type: ignore[arg-type]
    clipped[40:80, 20:60] = 1.0
    assert unmeasured_masks(blurred)[0] is not None  # type: ignore[arg-type]
