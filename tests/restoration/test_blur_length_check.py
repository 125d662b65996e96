"""Whether the pictures' spectra show paths as long as those predicted."""

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
    """As the reader gives it."""
    return cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)


def shown(exposures: float) -> list[tuple[RowMotion, TilePowers]]:
    """Frames that turned each in its own way, with what is predicted for so many times their true exposure."""
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
def test_a_wrong_exposure_is_seen_in_the_length_of_the_paths(exposures: float) -> None:
    """Paths that are predicted twice as long are half as long by the pictures, and that is beyond doubt."""
    found = path_scale(shown(exposures))
    assert found is not None
    assert found.frames == len(RATES)
    assert found.contradicts
    assert abs(np.log(found.scale * exposures)) < 2 * found.std


def test_right_paths_are_not_contradicted() -> None:
    """The scale of a right profile is 1 within two standard deviations, and those are no wider than a quarter."""
    found = path_scale(shown(1.0))
    assert found is not None
    assert abs(np.log(found.scale)) < 2 * found.std < 0.25
    assert not found.contradicts


def test_a_movie_of_few_bits_is_doubted() -> None:
    """Its coder repeats the blur of frames before."""
    frames = shown(1.5)
    much, few = path_scale(frames), path_scale(frames, bits_per_px=0.05)
    assert much is not None
    assert few is not None
    assert few.scale == much.scale
    assert few.std > 3 * much.std
    assert not few.contradicts


def test_frames_that_hardly_moved_tell_nothing() -> None:
    """Nor do a few that did, nor pictures smaller than a tile."""
    still = [(camera((0.02, -0.03, 0.01)).motion, powers) for _, powers in shown(1.0)]
    assert path_scale(still) is None
    assert path_scale([*still, *shown(1.0)[: LEAST_FRAMES - 1]]) is None
    assert tile_powers(np.zeros((100, 300), np.uint8), CURVE) is None


def test_lamps_are_passed_over() -> None:
    """Tiles with clipped light are left out while there are others."""
    picture = luma(record(camera()).picture)
    whole = tile_powers(picture, CURVE)
    picture[:60, :60] = 255
    lit = tile_powers(picture, CURVE)
    assert whole is not None
    assert lit is not None
    assert len(lit.power) == len(whole.power) - 1
    assert not np.any(np.all(lit.centres_px == whole.centres_px[0], axis=1))


def test_lumas_pass_through_and_spectra_of_some_are_kept() -> None:
    """In order and unchanged."""
    picture = luma(record(camera()).picture)
    kept: dict[int, TilePowers] = {}
    passed = list(store_powers(((n, picture) for n in range(5)), (1, 3, 9), CURVE, kept))
    assert [n for n, _ in passed] == [0, 1, 2, 3, 4]
    assert all(seen is picture for _, seen in passed)
    assert sorted(kept) == [1, 3]


def test_frames_are_looked_at_whose_paths_tell_most() -> None:
    """Neither those that hardly moved nor those whose paths leave the tiles; evenly, and not too many."""
    paths = BEST_PATH_PX * np.tile([0.01, 0.9, 30.0, 1.2], 30)
    chosen = frames_to_measure(range(120), paths)
    assert len(chosen) <= MOST_FRAMES
    assert {n % 4 for n in chosen} <= {1, 3}
    assert min(chosen) < 10
    assert max(chosen) > 105


def test_an_account_reads_as_a_number_with_its_deviation() -> None:
    """The deviation is the scale's, not its logarithm's."""
    assert str(PathScale(0.5, 0.2, 7)) == "0.50 ± 0.10"
