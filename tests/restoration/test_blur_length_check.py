"""Comparison of blur path lengths in the spectra of frames with the predicted ones."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from blurred_scene import camera, record

from virest.camera.response import ResponseCurve
from virest.image_formation.row_motion import RowMotion
from virest.restoration.blur_length_check import (
    BEST_PATH_PX,
    LEAST_FRAMES,
    MOST_FRAMES,
    PathScale,
    TilePowers,
    frames_to_measure,
    path_scale,
    store_powers,
    tile_powers,
)

RATES = ((0.9, -2.0, 0.6), (-1.8, 0.7, -0.4), (1.2, 1.5, 0.3), (0.4, -1.3, -0.8), (-1.4, -1.6, 0.2), (1.9, 0.2, 0.5))
CURVE = ResponseCurve("srgb")


def luma(picture: np.ndarray) -> np.ndarray:
    """Luma, as from the reader."""
    return cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)


def shown(exposures: float) -> list[tuple[RowMotion, TilePowers]]:
    """Frames with different rotations, and predictions for their true exposure times this factor."""
    found = []
    for rate in RATES:
        true = camera(rate, readout_time_s=0.015)
        assert true.exposure_s is not None
        powers = tile_powers(luma(record(true).picture), CURVE)
        assert powers is not None
        middle_s = 0.5 * (1 - exposures) * true.exposure_s
        taken = replace(true, exposure_s=exposures * true.exposure_s, stamp_s=true.stamp_s + middle_s)
        found.append((taken.motion, powers))
    return found


@pytest.mark.parametrize("exposures", [0.6, 1.5, 2.0])
def test_a_wrong_exposure_shows_in_the_blur_path_length(exposures: float) -> None:
    """Predicted paths that are twice as long are measured as half as long, significantly."""
    found = path_scale(shown(exposures))
    assert found is not None
    assert found.frames == len(RATES)
    assert found.contradicts
    assert abs(np.log(found.scale * exposures)) < 2 * found.std


def test_right_blur_paths_are_not_contradicted() -> None:
    """The scale for a right profile is 1 within two deviations, which are below 0.125."""
    found = path_scale(shown(1.0))
    assert found is not None
    assert abs(np.log(found.scale)) < 2 * found.std < 0.25
    assert not found.contradicts


def test_a_low_bit_rate_widens_the_deviation() -> None:
    """Its encoder repeats the blur of earlier frames."""
    frames = shown(1.5)
    much, few = path_scale(frames), path_scale(frames, bits_per_px=0.05)
    assert much is not None
    assert few is not None
    assert few.scale == much.scale
    assert few.std > 3 * much.std
    assert not few.contradicts


def test_frames_with_little_motion_give_no_result() -> None:
    """Nor do too few frames with motion, or frames smaller than a tile."""
    still = [(camera((0.02, -0.03, 0.01)).motion, powers) for _, powers in shown(1.0)]
    assert path_scale(still) is None
    assert path_scale([*still, *shown(1.0)[: LEAST_FRAMES - 1]]) is None
    assert tile_powers(np.zeros((100, 300), np.uint8), CURVE) is None


def test_tiles_with_clipped_highlights_are_left_out() -> None:
    """Other tiles are used instead."""
    picture = luma(record(camera()).picture)
    whole = tile_powers(picture, CURVE)
    picture[:60, :60] = 255
    lit = tile_powers(picture, CURVE)
    assert whole is not None
    assert lit is not None
    assert len(lit.power) == len(whole.power) - 1
    assert not np.any(np.all(lit.centres_px == whole.centres_px[0], axis=1))


def test_frames_pass_through_while_spectra_are_stored() -> None:
    """Frames keep their order and are not changed."""
    picture = luma(record(camera()).picture)
    kept: dict[int, TilePowers] = {}
    passed = list(store_powers(((n, picture) for n in range(5)), (1, 3, 9), CURVE, kept))
    assert [n for n, _ in passed] == [0, 1, 2, 3, 4]
    assert all(seen is picture for _, seen in passed)
    assert sorted(kept) == [1, 3]


def test_frames_with_the_most_informative_paths_are_measured() -> None:
    """Frames with very short or very long paths are left out; the others are spread evenly up to a limit."""
    paths = BEST_PATH_PX * np.tile([0.01, 0.9, 30.0, 1.2], 30)
    chosen = frames_to_measure(range(120), paths)
    assert len(chosen) <= MOST_FRAMES
    assert {n % 4 for n in chosen} <= {1, 3}
    assert min(chosen) < 10
    assert max(chosen) > 105


def test_a_path_scale_is_shown_with_its_deviation() -> None:
    """The deviation is that of the scale, not of its logarithm."""
    assert str(PathScale(0.5, 0.2, 7)) == "0.50 ± 0.10"
