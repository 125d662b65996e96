"""Clipped light spreads along the local blur path."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from virest.image_formation.kernels import KernelField
from virest.image_formation.reach import along_paths
from virest.restoration.clipped_light import keep_unmeasured, unmeasured_masks

WIDTH, HEIGHT, LENGTH = 160, 120, 12.0


def field(centres_px: np.ndarray) -> KernelField:
    """Horizontal paths in the left half of the frame, vertical ones in the right half; 12 px long."""
    along = np.linspace(0.0, LENGTH, 40)
    across = np.stack([along, 0 * along], -1)
    down = np.stack([0 * along, along], -1)
    paths = np.array([across if x < WIDTH / 2 else down for x, _ in centres_px])
    return KernelField(centres_px, paths, 0.0)


def test_a_highlight_spreads_along_its_local_path() -> None:
    """The left highlight's streak is horizontal, the right one's vertical."""
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[55:58, 40] = mask[55:58, 120] = 1
    touched = along_paths(mask, field, cv2.dilate)
    left, right = touched[:, : WIDTH // 2], touched[:, WIDTH // 2 :]
    assert np.ptp(np.flatnonzero(left.any(axis=0))) >= 2 * LENGTH
    assert np.ptp(np.flatnonzero(left.any(axis=1))) <= 6
    assert np.ptp(np.flatnonzero(right.any(axis=1))) >= 2 * LENGTH
    assert np.ptp(np.flatnonzero(right.any(axis=0))) <= 4


@pytest.mark.parametrize("level", [0.05, 0.2])
def test_parts_meet_without_a_seam(level: float) -> None:
    """If all paths are equal, the parts give the result of the whole frame, for much and for little clipped area."""
    rng = np.random.default_rng(4)
    mask = (cv2.GaussianBlur(rng.normal(size=(HEIGHT, WIDTH)), (0, 0), 3) > level).astype(np.uint8)

    def even(centres_px: np.ndarray) -> KernelField:
        return field(np.zeros_like(centres_px))

    path = field(np.zeros((1, 2))).arrays(positive=True)[0]
    reach = (path + path[::-1, ::-1] > 2e-3).astype(np.uint8)
    for operation in (cv2.dilate, cv2.erode):
        np.testing.assert_array_equal(along_paths(mask, even, operation), operation(mask, reach))


def test_a_single_clipped_pixel_is_not_kept_as_recorded() -> None:
    """The path is longer than the pixel, so its neighbours determine the light."""
    clipped = np.zeros((HEIGHT, WIDTH), np.float32)
    clipped[55:57, 40] = 1.0
    blurred = SimpleNamespace(field=field, light=[clipped] * 3, dark=[None] * 3, clipped=[clipped, None, None])
    assert unmeasured_masks(blurred) == [None] * 3  # type: ignore[arg-type]
    clipped[40:80, 20:60] = 1.0
    assert unmeasured_masks(blurred)[0] is not None  # type: ignore[arg-type]


def test_nothing_beside_clipped_light_becomes_darker_than_its_surroundings() -> None:
    """Dark beads on the rim of a highlight are raised to the darkest level around; far from it they stay."""
    recorded = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    recorded[50:60, 30:50] = 255
    holes = (recorded[..., 0] == 255).astype(np.float32)
    blurred = SimpleNamespace(
        field=field, light=[holes] * 3, dark=[None] * 3, clipped=[holes] * 3, holes=holes, longest_px=LENGTH
    )
    sharp = recorded.astype(np.float32)
    sharp[55, 54:58] = sharp[100, 54:58] = 10.0
    kept = keep_unmeasured(lambda rows: sharp[rows].copy(), recorded, blurred)(slice(0, HEIGHT))  # type: ignore[arg-type]
    assert kept[55, 54:58].min() == 90
    assert kept[100, 54:58].max() == 10
