"""Pictures with few spatial frequencies: brick walls, blinds, gratings, distant boards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from blurred_scene import FRAME, MARGIN, camera, record_canvas
from laws import TurningCamera, psnr_db, texture
from numpy.typing import NDArray

from virest.camera.response import ResponseCurve
from virest.image_formation.kernels import kernel_field
from virest.restoration.frame import restore_frame
from virest.restoration.settings import PRESETS, RestorationSettings
from virest.restoration.statistics.measure import measure_picture
from virest.restoration.statistics.of_picture import most_blurred
from virest.restoration.statistics.on_tiles import on_spectrum
from virest.restoration.statistics.records import PictureStatistics, PlaceStatistics
from virest.restoration.taken_part import blurred_part

WIDTH, HEIGHT = 520, 400
Scene = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
ALONG_RAD = np.arctan2(0.9, 2.0)
"""Approximate direction of motion in the frame for RATE_RAD_S."""
RATE_RAD_S = (0.9, -2.0, 0.6)


def _sine(period_px: float, angle_rad: float) -> Scene:
    return lambda x, y: 0.4 + 0.25 * np.sin(2 * np.pi * (x * np.cos(angle_rad) + y * np.sin(angle_rad)) / period_px)


def _bars(period_px: float, angle_rad: float) -> Scene:
    wave = _sine(period_px, angle_rad)
    return lambda x, y: 0.4 + np.clip(1.6 * (wave(x, y) - 0.4), -0.25, 0.25)


def _board(period_px: float, angle_rad: float) -> Scene:
    one, two = _bars(period_px, angle_rad), _bars(period_px, angle_rad + np.pi / 2)
    return lambda x, y: 0.4 + 4 * (one(x, y) - 0.4) * (two(x, y) - 0.4)


def _canvas(scene: Scene) -> NDArray[np.float32]:
    y, x = np.mgrid[: HEIGHT + 2 * MARGIN, : WIDTH + 2 * MARGIN].astype(float)
    return np.repeat(scene(x, y)[..., None], 3, -1).astype(np.float32)


def _statistics(turning: TurningCamera, picture: NDArray[np.uint8]) -> PictureStatistics:
    x, y = np.meshgrid(np.arange(64, WIDTH, 110.0), np.arange(64, HEIGHT, 110.0))
    centres_px = most_blurred(turning.motion, np.stack([x, y], -1).reshape(-1, 2))
    return measure_picture(picture, kernel_field(turning.motion, centres_px, 0.5), ResponseCurve("srgb"))[0]


# ── statistics of the picture ────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("angle_rad", [ALONG_RAD, ALONG_RAD + np.pi / 2, 1.2])
def test_a_grating_is_distinguished_from_texture(angle_rad: float) -> None:
    """Statistics by rings fit texture without single frequencies; a grating in any direction does not fit them."""
    turning = camera(RATE_RAD_S, width=WIDTH, height=HEIGHT)
    natural = np.repeat(texture(HEIGHT + 2 * MARGIN, WIDTH + 2 * MARGIN, 5)[..., None], 3, -1).astype(np.float32)
    assert _statistics(turning, record_canvas(turning, natural, noise_levels=2.0).picture).places is None
    grating = _canvas(_sine(13.0, angle_rad))
    found = _statistics(turning, record_canvas(turning, grating, noise_levels=2.0).picture)
    assert found.unevenness > 0.3


@pytest.mark.parametrize("speed", [1.0, 0.3])
@pytest.mark.parametrize("scene", [_bars, _board])
def test_gratings_of_any_size_and_direction_are_detected(scene: Callable[[float, float], Scene], speed: float) -> None:
    """Neither the best-fitting ring statistics nor the final ones describe them: both misfits are large."""
    turning = camera(tuple(speed * r for r in RATE_RAD_S), width=WIDTH, height=HEIGHT)  # type: ignore[arg-type]
    for period_px in (7.0, 21.0):
        for angle_rad in (ALONG_RAD, 1.2):
            canvas = _canvas(scene(period_px, angle_rad))
            found = _statistics(turning, record_canvas(turning, canvas, noise_levels=2.0).picture)
            assert found.unevenness == 1.0


def test_upright_bars_are_detected_by_frequencies_on_the_axes() -> None:
    """Frequencies near the axes are not part of the fit, so upright bars do not affect it."""
    turning = camera(tuple(0.5 * r for r in RATE_RAD_S), 0.02, width=WIDTH, height=HEIGHT)  # type: ignore[arg-type]
    found = _statistics(turning, record_canvas(turning, _canvas(_bars(21.0, 0.02)), noise_levels=3.0).picture)
    assert found.misfit < 0.6
    assert found.unevenness > 0.3


def test_bars_along_the_motion_have_a_small_expected_gain() -> None:
    """Bars that the motion does not blur lose no power, so there is little to gain.

    Ring statistics alone would assume equal power in all directions, most of it removed by the blur.
    """
    turning = camera(RATE_RAD_S, width=WIDTH, height=HEIGHT)
    bars = record_canvas(turning, _canvas(_sine(13.0, ALONG_RAD + np.pi / 2)), noise_levels=2.0).picture
    found = _statistics(turning, bars)
    assert found.expected_gain_db < 0.5 * replace(found, places=None).expected_gain_db


def test_statistics_of_a_frequency_apply_to_that_frequency() -> None:
    """Ten times less power at (−20, 30) / 128 gives ten times the N / S up to halfway to the next frequency."""
    frequency, share = (np.arange(24) + 0.5) / 48, np.ones((128, 63), np.float32)
    share[108, 29] = 0.1
    places = PlaceStatistics(1.0, share, share)
    even = PictureStatistics(frequency, np.ones(24), np.ones(24), np.ones(24), 1.0)
    changed = on_spectrum(replace(even, places=places), np.ones(24), 128) / np.maximum(
        on_spectrum(even, np.ones(24), 128), 1e-9
    )
    assert changed[108, [59, 60]] == pytest.approx([10, 10], rel=1e-5)
    changed[108, [59, 60]] = 1.0
    changed[0, 0] = 1.0
    np.testing.assert_allclose(changed, 1.0, rtol=1e-5)


# ── no loss ──────────────────────────────────────────────────────────────────────────────────────────────────────

SCENES = {
    "sine along": _sine(17.0, ALONG_RAD),
    "sine across": _sine(17.0, ALONG_RAD + np.pi / 2),
    "sine aslant": _sine(9.0, ALONG_RAD + 0.9),
    "bars aslant": _bars(14.0, ALONG_RAD + 1.2),
    "bars upright": _bars(21.0, 0.02),
    "board": _board(16.0, 0.4),
}


@pytest.mark.parametrize("scene", [pytest.param(s, id=n) for n, s in SCENES.items()])
@pytest.mark.parametrize("rate", [1.0, 0.5])
def test_no_grating_gets_worse(scene: Scene, rate: float) -> None:
    """Restored gratings are at most 0.1 dB worse than straightened ones, in any direction."""
    turning = camera(tuple(rate * r for r in RATE_RAD_S), 0.02, width=WIDTH, height=HEIGHT)
    recorded = record_canvas(turning, _canvas(scene), noise_levels=3.0)

    def likeness_db(settings: RestorationSettings) -> float:
        restored = restore_frame(FRAME, recorded.picture, turning.motion, turning.trajectory, settings)
        assert restored.picture is not None
        return psnr_db(restored.picture, recorded.truth, 50)

    gains_db = {
        name: likeness_db(settings) - likeness_db(replace(settings, deblur="none"))
        for name, settings in PRESETS.items()
    }
    assert min(gains_db.values()) > -0.1, gains_db


# ── tiles around the centre of rotation ──────────────────────────────────────────────────────────────────────────


def test_a_kernel_is_not_used_where_paths_change_within_its_tile() -> None:
    """For a roll, larger tiles leave more of the centre unchanged; kernels without tiles do not."""
    motion = camera((0.0, 0.0, 6.0), width=WIDTH, height=HEIGHT).motion
    left_alone = []
    for tile_px in (0, 60, 120, 180):
        part = np.broadcast_to(blurred_part(motion, 1.0, tile_px), (HEIGHT, WIDTH))
        left_alone.append(float(np.mean(1 - part)))
        assert part[0, 0] == 1.0
    assert (np.diff(left_alone) > 0).all()
    assert left_alone[-1] < 0.5


def test_a_pan_is_restored_everywhere() -> None:
    """If the blur paths are nearly the same over the frame, tiles of any size are valid."""
    motion = camera(RATE_RAD_S, 0.02, width=WIDTH, height=HEIGHT).motion
    assert blurred_part(motion, 1.0, 144) == 1.0
