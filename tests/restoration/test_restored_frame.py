"""A complete frame: sharper and unshifted, in colour and grey; unusual pictures neither crash nor get worse."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from blurred_scene import FRAME, MARGIN, camera, record, record_canvas
from laws import TurningCamera, phone, psnr_db, texture
from numpy.typing import NDArray

from virest.camera.response import ResponseCurve
from virest.image_formation.kernels import KernelField
from virest.image_formation.row_motion import FrameTranslation, row_motion
from virest.inference.unsharp_mask import UnsharpMask, without_mask
from virest.restoration.blurred import luma_of
from virest.restoration.frame import (
    RestoredFrame,
    copied_frame,
    restore_frame,
)
from virest.restoration.neighbours.confirmation import ConfirmedGain
from virest.restoration.parameters import degradation_parameters, unknown_parameters
from virest.restoration.positive_light import blur_along_paths, consistent_light, without_negative_light
from virest.restoration.settings import DEBLUR_METHODS, PRESETS, RestorationSettings
from virest.restoration.statistics.of_picture import most_blurred
from virest.simulation.phone_pictures import sharpen

BALANCED = RestorationSettings()
METHODS = [m for m in DEBLUR_METHODS if m != "none"]
FIVE_SEGMENT = ResponseCurve("five_segment", b=(0.12, 0.08), c=(0.62, 0.80), y_max=0.93)


def _restore(
    turning: TurningCamera, picture: NDArray[np.uint8], settings: RestorationSettings = BALANCED
) -> RestoredFrame:
    return restore_frame(FRAME, picture, turning.motion, turning.trajectory, settings)


def _picture(result: RestoredFrame) -> NDArray[np.uint8]:
    assert result.picture is not None
    assert result.picture.dtype == np.uint8
    return result.picture


def _shift_px(picture: NDArray[np.uint8], truth: NDArray[np.uint8], border: int = 40) -> float:
    """Shift of a picture relative to the truth, by phase correlation of its inside."""
    one, two = (
        cv2.cvtColor(p, cv2.COLOR_RGB2GRAY).astype(np.float32)[border:-border, border:-border] for p in (picture, truth)
    )
    window = cv2.createHanningWindow(one.shape[::-1], cv2.CV_32F)
    return float(np.hypot(*cv2.phaseCorrelate(one, two, window)[0]))


# ── sharper and unshifted ────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("reference", ["exposure-start", "frame-middle"])
@pytest.mark.parametrize("shutter", ["none", "rowwise"])
def test_a_deblurred_picture_is_sharper_and_not_shifted(reference: str, shutter: str) -> None:
    """Anchored at the start or the middle, warped or not, the frame shows the reference time within 0.12 px."""
    turning = camera(reference=reference)
    recorded = record(turning)
    result = _restore(turning, recorded.picture, replace(BALANCED, reference=reference, shutter=shutter))
    picture = _picture(result)
    assert result.status == "restored"
    assert _shift_px(picture, recorded.truth) < 0.12
    if reference == "exposure-start":
        assert _shift_px(recorded.picture, recorded.truth) > 3, "the recorded frame is shifted by half the blur"
    own = record(replace(turning, reference="frame-middle"))
    gain = psnr_db(picture, recorded.truth, 30) - psnr_db(own.picture, own.truth, 30)
    assert gain > 1.8


@pytest.mark.parametrize(
    ("direction", "shutter", "roll_rad_s", "within_px"),
    [
        ("right_to_left", "rowwise", 0.4, 0.12),
        ("bottom_to_top", "rowwise", -0.4, 0.12),
        ("bottom_to_top", "perspective", 0.0, 0.25),
    ],
)
def test_a_rolling_shutter_frame_is_straightened_and_sharp(
    direction: str, shutter: str, roll_rad_s: float, within_px: float
) -> None:
    """With a rolling shutter, the result is the global-shutter frame of the reference time.

    The paper's four corners cannot follow a roll: its homography is off by 1.4 px in the middle of the frame.
    """
    turning = camera((0.5, -1.1, roll_rad_s), 0.02, direction, exposure_s=0.016)
    recorded = record(turning)
    result = _restore(turning, recorded.picture, replace(BALANCED, shutter=shutter))
    x0, y0, x1, y1 = result.valid_px
    assert (x1 - x0) * (y1 - y0) > 0.8 * 336 * 240
    assert _shift_px(_picture(result), recorded.truth) < within_px
    straightened = _restore(turning, recorded.picture, replace(BALANCED, deblur="none"))
    assert straightened.parameters["deblur"]["method"] == "none"
    assert psnr_db(_picture(result), recorded.truth, 40) > psnr_db(_picture(straightened), recorded.truth, 40) + 1.5
    assert psnr_db(_picture(straightened), recorded.truth, 40) > psnr_db(recorded.picture, recorded.truth, 40) + 1.5


@pytest.mark.parametrize("method", [m for m in METHODS if m != "inverse"])
def test_every_method_gains(method: str) -> None:
    """Every deblurring method gains over straightening alone."""
    turning = camera()
    recorded = record(turning)
    iterations = 15 if method == "richardson-lucy" else 4
    result = _restore(turning, recorded.picture, replace(BALANCED, deblur=method, iterations=iterations))
    alone = _restore(turning, recorded.picture, replace(BALANCED, deblur="none"))
    assert result.parameters["deblur"]["method"] == method
    assert psnr_db(_picture(result), recorded.truth, 30) > psnr_db(_picture(alone), recorded.truth, 30) + 0.7
    assert _shift_px(_picture(result), recorded.truth) < 0.2


@pytest.mark.parametrize("settings", [pytest.param(s, id=n) for n, s in PRESETS.items()])
def test_a_grey_picture_stays_grey(settings: RestorationSettings) -> None:
    """Equal red, green and blue stay equal within 2 levels and are sharpened equally."""
    turning = camera()
    recorded = record(turning, grey=True)
    assert np.ptp(recorded.picture.astype(int), axis=-1).max() == 0
    picture = _picture(_restore(turning, recorded.picture, settings)).astype(int)
    assert np.ptp(picture, axis=-1).max() <= 2
    assert psnr_db(picture, recorded.truth, 30) > psnr_db(recorded.picture, recorded.truth, 30) + 2


def test_the_input_picture_is_not_changed() -> None:
    """The caller's array is not overwritten."""
    turning = camera()
    picture = record(turning).picture.copy()
    before = picture.copy()
    _restore(turning, picture)
    np.testing.assert_array_equal(picture, before)


# ── unchanged frames ─────────────────────────────────────────────────────────────────────────────────────────────


def test_a_still_camera_is_copied() -> None:
    """Without motion the decoded pixels are returned unchanged with status "copied" and a reason."""
    turning = camera((0.0, 0.0, 0.0), 0.02)
    picture = record(turning).picture
    result = _restore(turning, picture)
    assert result.status == "copied"
    np.testing.assert_array_equal(_picture(result), picture)
    assert any("blur of 0.00 px" in w for w in result.warnings)
    assert result.valid_px == (0, 0, 336, 240)
    assert (result.parameters["deblur"]["method"], result.parameters["shutter"]["method"]) == ("none", "none")


def test_a_blur_longer_than_the_picture_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """A log in degrees predicts such blurs: nothing is measured on them."""
    monkeypatch.setattr("virest.restoration.frame.picture_statistics", None)
    turning = camera((20.0, -60.0, 0.0), 0.02)
    result = _restore(turning, record(camera()).picture, replace(BALANCED, shutter="none"))
    assert result.parameters["deblur"]["method"] == "none"
    assert any("longer than the picture" in warning for warning in result.warnings)


def test_without_an_exposure_time_a_frame_is_only_straightened() -> None:
    """An unknown exposure prevents deblurring but not straightening, and the log says so."""
    turning = camera((0.5, -1.1, 0.4), 0.02)
    recorded = record(turning)
    blind = replace(turning, exposure_s=None)
    result = _restore(blind, recorded.picture)
    assert (result.status, result.exposure_s) == ("restored", None)
    assert (result.parameters["deblur"]["method"], result.parameters["shutter"]["method"]) == ("none", "rowwise")
    assert any("exposure" in w for w in result.warnings)


def test_without_deblurring_and_straightening_a_frame_is_copied() -> None:
    """The pixels are returned unchanged."""
    turning = camera()
    picture = record(turning).picture
    result = _restore(turning, picture, replace(BALANCED, deblur="none", shutter="none"))
    assert result.status == "copied"
    np.testing.assert_array_equal(_picture(result), picture)


def test_a_frame_without_any_straightened_pixel_is_copied() -> None:
    """If straightening would leave no recorded pixel, the recorded frame is returned with a warning."""
    turning = camera((0.5, 1.0, 0.2), readout_time_s=0.02)
    intrinsics = replace(turning.profile.intrinsics, cx_px=-1e5)
    turning = replace(turning, profile=replace(turning.profile, intrinsics=intrinsics))
    picture = np.random.default_rng(1).integers(0, 255, (240, 336, 3), dtype=np.uint8)
    result = _restore(turning, picture)
    assert (result.status, result.valid_px) == ("copied", (0, 0, 336, 240))
    np.testing.assert_array_equal(result.picture, picture)
    assert "no recorded pixel" in result.warnings[0]
    assert result.parameters["shutter"]["method"] == result.parameters["deblur"]["method"] == "none"


def test_a_copied_frame_has_a_reason() -> None:
    """Its log has all keys."""
    picture = np.full((48, 64, 3), 7, np.uint8)
    result = copied_frame(FRAME, picture, phone(64, 48), "no focal length")
    assert (result.status, result.warnings, result.valid_px) == ("copied", ("no focal length",), (0, 0, 64, 48))
    assert result.picture is picture
    assert result.exposure_s == pytest.approx(0.012)
    assert set(result.parameters) == {"motion", "depth_m", "depth_source", "blur", "shutter", "response", "deblur"}


# ── unusual pictures ─────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("colour", [(0, 0, 0), (255, 255, 255), (200, 40, 90), (128, 128, 128)])
def test_a_uniform_picture_stays_unchanged(method: str, colour: tuple[int, int, int]) -> None:
    """Every method returns a black, white or single-coloured frame without seams."""
    turning = camera(readout_time_s=0.01, width=200, height=136)
    picture = np.full((136, 200, 3), colour, np.uint8)
    result = _picture(_restore(turning, picture, replace(BALANCED, deblur=method, iterations=3)))
    np.testing.assert_allclose(result.astype(int), picture, atol=2)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("width", "height"), [(64, 48), (47, 65), (16, 16)])
def test_tiny_pictures_are_restored_without_a_crash(
    method: str, width: int, height: int, rng: np.random.Generator
) -> None:
    """Frames smaller than a tile, also with odd sizes, keep their size and cause no NumPy warning."""
    turning = camera(readout_time_s=0.01, width=width, height=height)
    picture = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    with np.errstate(invalid="raise", divide="raise"):
        result = _restore(turning, picture, replace(BALANCED, deblur=method, iterations=2))
    assert _picture(result).shape == picture.shape


@pytest.mark.parametrize("settings", [pytest.param(s, id=n) for n, s in PRESETS.items()])
def test_highlights_in_the_dark_do_not_ring(settings: RestorationSettings) -> None:
    """Around a clipped streak on black, the dark stays dark beyond a blur length."""
    turning = camera()
    picture = np.full((240, 336, 3), 4, np.uint8)
    cv2.line(picture, (150, 100), (164, 112), (255, 255, 255), 5)
    result = _picture(_restore(turning, picture, settings)).astype(int)
    far = np.ones((240, 336), bool)
    far[70:150, 110:210] = False
    assert np.abs(result - picture)[far].max() <= 6


@pytest.mark.parametrize(("preset", "left"), [("fast", 0.7), ("balanced", 0.45), ("best", 0.45)])
def test_dark_areas_beside_a_bright_colour_keep_their_own_colour(preset: str, left: float) -> None:
    """On a surface of one hue with light and dark squares, colour that the blur carried into the dark is removed.

    The edges of luma and colour coincide.
    """
    turning = camera(reference="frame-middle")
    height, width = turning.profile.height + 2 * MARGIN, turning.profile.width + 2 * MARGIN
    squares = np.random.default_rng(5).random((height // 24 + 1, width // 24 + 1)) < 0.5
    light = (0.02 + 0.9 * np.kron(squares, np.ones((24, 24)))).astype(np.float32)[:height, :width]
    recorded = record_canvas(turning, light[..., None] * np.array([0.9, 0.5, 0.2], np.float32))
    settings = replace(PRESETS[preset], shutter="none", reference="frame-middle")
    restored = _picture(_restore(turning, recorded.picture, settings))
    shade = recorded.truth[..., 1] < 60

    def wrong(picture: NDArray[np.uint8]) -> float:
        more_red = [p[..., 0].astype(float) - p[..., 2] for p in (picture, recorded.truth)]
        inside = np.s_[30:-30, 30:-30]
        return float(np.sqrt(np.mean((more_red[0] - more_red[1])[inside][shade[inside]] ** 2)))

    assert wrong(restored) < left * wrong(recorded.picture)


@pytest.mark.parametrize("settings", [pytest.param(s, id=n) for n, s in PRESETS.items()])
def test_a_vivid_surface_keeps_its_colour(settings: RestorationSettings) -> None:
    """Green tiles with one clipped channel keep their colour, including the edges."""
    turning = camera()
    picture = record(turning).picture.copy()
    tiles = np.zeros(picture.shape[:2], np.uint8)
    for left in range(90, 240, 50):
        cv2.rectangle(tiles, (left, 80), (left + 24, 170), 1, -1)
    picture[tiles > 0] = (180, 255, 90)
    result = _picture(_restore(turning, picture, settings)).astype(int)
    assert (result != picture).any()
    inside = cv2.erode(tiles, np.ones((9, 9), np.uint8)) > 0
    colour = (result[..., 1] - result[..., 2])[inside]
    assert colour.mean() > 150, "the recorded difference is 165"


@pytest.mark.parametrize("settings", [pytest.param(s, id=n) for n, s in PRESETS.items()])
def test_thin_lines_on_clipped_paper_are_kept(settings: RestorationSettings) -> None:
    """Between clipped white areas there is no measured light to restore lines from: they stay as recorded."""
    turning = camera()
    picture = record(turning).picture.copy()
    picture[60:200, 80:280] = 255
    for left in range(88, 276, 14):
        cv2.line(picture, (left, 66), (left + 5, 194), (60, 40, 90), 3, cv2.LINE_AA)
    result = _picture(_restore(turning, picture, settings)).astype(int)
    straight = _picture(_restore(turning, picture, replace(settings, deblur="none")))
    inside = np.s_[110:150, 130:230]
    assert (result != straight).any()
    assert np.abs(result - straight)[inside].mean() < 3


def test_noise_is_measured_where_the_blur_is() -> None:
    """For a roll, tiles around the centre, where the blur removes nothing, are left out."""
    turning = camera((0.0, 0.0, 2.0))
    x, y = np.meshgrid(np.linspace(20, 315, 8), np.linspace(20, 220, 6))
    centres = np.stack([x, y], -1).reshape(-1, 2)
    kept = most_blurred(turning.motion, centres)
    far = np.linalg.norm(kept - (167.5, 119.5), axis=1)
    assert 6 <= len(kept) < len(centres)
    assert far.min() > 0.4 * far.max()


def test_a_bare_page_does_not_hide_the_noise_of_print_beside_it() -> None:
    """A coder leaves a bare page without noise; the noise of the rest is measured all the same."""
    turning = camera((0.0, 0.0, 2.0))
    recorded, noise = record(turning).picture, {}
    bare = recorded.copy()
    bare[:, :40], bare[:, -120:] = 230, 230
    for name, picture in (("print", recorded), ("page", bare)):
        found = restore_frame(
            FRAME, picture, turning.motion, turning.trajectory, PRESETS["balanced"], coding_step=12.0
        ).degradation
        assert found is not None
        assert found.deblur is not None
        noise[name] = found.deblur.noise_grey_levels
    assert noise["page"] == pytest.approx(noise["print"], rel=0.5)


def test_few_iterations_assume_coding_noise() -> None:
    """``fast`` assumes at least half of the noise of steps of 60 grey levels, ``balanced`` the measured noise."""
    turning = camera()
    recorded = record(turning)
    noise = {}
    for preset in ("fast", "balanced"):
        for step in (None, 60.0):
            found = restore_frame(
                FRAME, recorded.picture, turning.motion, turning.trajectory, PRESETS[preset], coding_step=step
            )
            assert found.degradation is not None
            assert found.degradation.deblur is not None
            noise[preset, step] = found.degradation.deblur.noise_grey_levels
    assert noise["fast", 60.0] > 1.2 * noise["fast", None]
    assert noise["balanced", 60.0] == noise["balanced", None]


def test_few_iterations_keep_faint_texture() -> None:
    """A coding step far too large for faint texture costs ``fast`` less than 2 dB.

    The prior of sparse gradients alone treats that texture as noise and loses twice as much.
    """
    turning = camera((0.4, -1.0, 0.3))
    light = texture(turning.profile.height + 2 * MARGIN, turning.profile.width + 2 * MARGIN)
    faint = (light.mean() + 0.3 * (light - light.mean())).astype(np.float32)
    recorded = record_canvas(turning, np.stack([faint] * 3, -1), 3)
    quality_db = []
    for step in (None, 60.0):
        result = restore_frame(
            FRAME, recorded.picture, turning.motion, turning.trajectory, PRESETS["fast"], coding_step=step
        )
        quality_db.append(psnr_db(_picture(result), recorded.truth, 40))
    assert quality_db[1] > quality_db[0] - 2.0


# ── the log ──────────────────────────────────────────────────────────────────────────────────────────────────────


def _numbers(value: Any) -> list[float]:
    if isinstance(value, dict):
        return [n for v in value.values() for n in _numbers(v)]
    if isinstance(value, list | tuple):
        return [n for v in value for n in _numbers(v)]
    return [value] if isinstance(value, int | float) else []


def test_the_log_has_the_documented_figures() -> None:
    """Motion, blur and shutter of a known rotation.

    Quaternion of ω e, blur in the opposite direction, corners by eq 28.
    """
    turning = camera((0.0, -2.0, 0.0), 0.02)
    result = _restore(turning, record(turning).picture)
    log = result.parameters
    half = 0.5 * 2.0 * 0.012
    np.testing.assert_allclose(log["motion"]["delta_q_wxyz"], [np.cos(half), 0, -np.sin(half), 0], atol=1e-7)
    np.testing.assert_allclose(log["motion"]["rate_rad_s"], [0, -2, 0], atol=1e-6)
    assert log["motion"]["velocity_m_s"] is None
    assert abs(log["blur"]["angle_rad"]) < 0.01, "a yaw to the left moves points to the right"
    assert log["blur"]["length_px"] == pytest.approx(380 * 0.024, rel=0.01)
    corners = np.array([[0, 0], [335, 0], [335, 239], [0, 239]], float)
    motion = turning.motion
    home = turning.seen(corners, turning.row_start_s(corners, motion.start_s), motion.reference_s, motion.reference_s)
    np.testing.assert_allclose(log["shutter"]["corners_px"], home, atol=1e-4)
    expected = np.linalg.norm(home - corners, axis=1).max()
    assert log["shutter"]["max_displacement_px"] == pytest.approx(expected, abs=1e-3)
    assert log["response"] == "srgb"
    assert result.exposure_s == pytest.approx(0.012)
    assert all(np.isfinite(_numbers(log)))
    assert {"estimate", "deblur", "shutter"} <= set(result.seconds)


def test_translation_over_depth_is_corrected_without_metres() -> None:
    """Blur and straightening equal those of the translation in metres; displacement, velocity and depth are null."""
    turning = camera((0.0, -2.0, 0.0), 0.02)
    travel = FrameTranslation(np.array([0.4, 0.1, 0.2]), np.zeros(3), np.array([0.05, 0.0, 0.6]), 1.6, "triangulated")
    logs = []
    for known in (travel, replace(travel, depth_m=np.inf), replace(travel, depth_m=None, unit=1)):
        motion = row_motion(turning.trajectory, turning.profile, FRAME.time_s, FRAME.exposure_s, translation=known)
        logs.append(degradation_parameters(motion, turning.trajectory))
    metres, over_ground, over_depth = logs
    assert metres.blur == over_depth.blur
    assert metres.shutter == over_depth.shutter
    assert (metres.depth_m, over_depth.depth_m, over_depth.depth_source) == (1.6, None, "none")
    assert (over_ground.depth_m, over_ground.depth_source) == (None, "triangulated")
    for key in ("delta_position_m", "velocity_m_s"):
        assert getattr(metres.motion, key) is not None
        assert getattr(over_depth.motion, key) is None
    picture = record(turning).picture
    said = restore_frame(FRAME, picture, motion, turning.trajectory, BALANCED).warnings
    assert any("not in metres" in text for text in said)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("level", [0, 255])
def test_censored_areas_keep_their_grey_level(preset: str, level: int) -> None:
    """Inside an area beyond A or D, a blur length from its edge, the recorded level is kept."""
    turning = camera(reference="frame-middle")
    turning = replace(turning, profile=replace(turning.profile, response=FIVE_SEGMENT))
    picture = np.clip(record(turning).picture, 40, 220)
    picture[60:180, 90:250] = level
    settings = replace(PRESETS[preset], shutter="none", reference="frame-middle")
    restored = _picture(_restore(turning, picture, settings))
    np.testing.assert_array_equal(restored[85:155, 115:225], level)


def test_a_reversed_mask_does_not_affect_the_result() -> None:
    """Deblurred without the mask, the frame is close to that of a picture without one.

    A copied frame stays as recorded.
    """
    turning = camera(reference="frame-middle")
    recorded = record(turning)
    mask = UnsharpMask(0.8, 1.2)
    shown = np.rint(255 * sharpen(recorded.picture.astype(np.float32) / 255, mask.amount, mask.radius_px))
    shown = np.clip(shown, 0, 255).astype(np.uint8)
    settings, unmasked = replace(BALANCED, reference="frame-middle"), without_mask(shown, mask)
    arguments = (FRAME, shown, turning.motion, turning.trajectory, settings)
    undone, kept = (_picture(restore_frame(*arguments, unmasked=without)) for without in (unmasked, None))
    plain = _picture(_restore(turning, recorded.picture, settings))
    assert psnr_db(undone, plain, 30) > psnr_db(kept, plain, 30) + 6
    assert psnr_db(undone, recorded.truth, 30) > psnr_db(kept, recorded.truth, 30)
    resting = camera((0.0, 0.0, 0.0), reference="frame-middle")
    copied = restore_frame(FRAME, shown, resting.motion, resting.trajectory, settings, unmasked=unmasked)
    assert copied.status == "copied"
    np.testing.assert_array_equal(_picture(copied), shown)


def test_the_mask_stays_where_nothing_was_blurred() -> None:
    """For a roll, the centre stays as recorded and the corners are deblurred without the mask."""
    turning = camera((0.0, 0.0, 2.5), reference="frame-middle")
    shown = record(turning).picture
    unmasked = without_mask(shown, UnsharpMask(0.8, 1.2))
    settings = replace(BALANCED, reference="frame-middle", shutter="none")
    arguments = (FRAME, shown, turning.motion, turning.trajectory, settings)
    restored = _picture(restore_frame(*arguments, unmasked=unmasked)).astype(int)
    x_px, y_px = (round(centre) for centre in (turning.profile.intrinsics.cx_px, turning.profile.intrinsics.cy_px))
    middle = np.s_[y_px - 8 : y_px + 9, x_px - 8 : x_px + 9]
    np.testing.assert_allclose(restored[middle], shown[middle], atol=1)
    assert np.abs(unmasked.astype(int) - shown)[middle].max() > 2
    assert np.abs(restored - shown)[:40, :40].mean() > 2


def test_hardly_blurred_colours_keep_their_detail() -> None:
    """Even with few iterations: red and blue waves of 12 px with equal luma, for a path of 2 px."""
    turning = camera(rate_rad_s=(0.18, -0.4, 0.12), reference="frame-middle")
    profile = turning.profile
    height, width = profile.height + 2 * MARGIN, profile.width + 2 * MARGIN
    y, x = np.mgrid[:height, :width]
    grey, wave = texture(height, width, seed=4), 0.08 * np.sin(2 * np.pi * x / 12) * np.sin(2 * np.pi * y / 15)
    canvas = 0.15 + 0.5 * grey[..., None] + wave[..., None] * (1 / 0.299, 0.0, -1 / 0.114) * 0.114
    recorded = record_canvas(turning, canvas.astype(np.float32), 3)
    picture = _picture(_restore(turning, recorded.picture, replace(PRESETS["fast"], reference="frame-middle")))
    assert (picture != recorded.picture).any()
    off = [
        np.square(
            cv2.cvtColor(p, cv2.COLOR_RGB2YCrCb).astype(float) - cv2.cvtColor(recorded.truth, cv2.COLOR_RGB2YCrCb)
        )
        for p in (picture, recorded.picture)
    ]
    after, before = (error[40:-40, 40:-40, 1:].mean() for error in off)
    assert after < 3 * before, "chroma at a quarter of the size gives seven times the error"


def test_the_log_of_a_frame_without_motion_has_the_known_readout() -> None:
    """An unknown readout time is null."""
    profile = phone(64, 64, 80.0, readout_time_s=0.02)
    assert unknown_parameters(profile).as_json()["shutter"]["readout_time_s"] == 0.02
    unknown = replace(profile, readout_known=False)
    assert unknown_parameters(unknown).as_json()["shutter"]["readout_time_s"] is None


@pytest.mark.parametrize("preset", ["fast", "balanced"])
def test_a_colourful_object_on_grey_keeps_its_colour(preset: str) -> None:
    """The only colour lies where the roll blurs least; noise is measured where it blurs most."""
    turning = camera(
        rate_rad_s=(2.0 * 100 / 380, 2.0 * 150 / 380, 2.0), width=480, height=336, reference="frame-middle"
    )
    profile = turning.profile
    y, x = np.mgrid[-MARGIN : profile.height + MARGIN, -MARGIN : profile.width + MARGIN]
    from_disc = np.hypot(x - 410, y - 280)
    light = (0.1 + 0.5 * texture(*x.shape, seed=4))[..., None] * (1 + (from_disc < 55)[..., None] * (0.7, 0.0, -0.7))
    recorded = record_canvas(turning, light.astype(np.float32))
    result = _picture(_restore(turning, recorded.picture, replace(PRESETS[preset], reference="frame-middle")))
    near = from_disc[MARGIN:-MARGIN, MARGIN:-MARGIN] < 90

    def wrong(picture: NDArray[np.uint8]) -> float:
        chroma = [cv2.cvtColor(p, cv2.COLOR_RGB2YCrCb)[..., 1:].astype(float) for p in (picture, recorded.truth)]
        return float(np.sqrt(np.mean((chroma[0] - chroma[1])[near] ** 2)))

    assert wrong(result) < 1.5 * wrong(recorded.picture)


@pytest.mark.parametrize("preset", ["fast", "balanced"])
def test_a_saturated_surface_gets_no_stripes(preset: str) -> None:
    """Green without red beside a bright area: ringing of red would show at the dark end of the curve."""
    turning = camera(reference="frame-middle")
    profile = turning.profile
    y, x = np.mgrid[-MARGIN : profile.height + MARGIN, -MARGIN : profile.width + MARGIN]
    from_disc = np.hypot(x - 150, y - 120)
    ground = (0.2 + 0.6 * texture(*x.shape, seed=6))[..., None] * np.ones(3)
    light = np.where(from_disc[..., None] < 70, (0.002, 0.25, 0.1), ground)
    recorded = record_canvas(turning, light.astype(np.float32), 3)
    result = _picture(_restore(turning, recorded.picture, replace(PRESETS[preset], reference="frame-middle")))
    inside = from_disc[MARGIN:-MARGIN, MARGIN:-MARGIN] < 50
    shown, wanted = (picture[..., 0][inside].astype(float) for picture in (result, recorded.truth))
    assert np.sqrt(np.mean((shown - wanted) ** 2)) < 2.5, "1.1 for the recorded frame, 3 with the linear filter alone"


def _seen_along(path_px: NDArray[np.float64], curve: ResponseCurve) -> Any:
    """Input of the light corrections for a picture of 80 × 120 blurred along one path everywhere."""

    def field(centres_px: NDArray[np.float64]) -> KernelField:
        return KernelField(centres_px, np.repeat(path_px[None], len(centres_px), 0), 0.5)

    statistics = SimpleNamespace(noise_levels=1.0, colour_noise_levels=1.0)
    return SimpleNamespace(
        longest_px=12.0,
        curve=curve,
        statistics=statistics,
        chroma=statistics,
        clipped=[None],
        dark=[None],
        field=field,
        light=[np.zeros((80, 120), np.float32)],
    )


def test_consistent_light_is_unchanged_even_below_zero() -> None:
    """The curve's zero of light is a convention: uniform surfaces stay on either side of it."""
    curve = ResponseCurve("five_segment", b=(0.12, 0.14), c=(0.62, 0.88), y_max=1.0)
    assert curve.light_range[0] < -0.05
    blurred = _seen_along(np.linspace(-6, 6, 16)[:, None] * (1.0, 0.3), curve)
    channels = [np.full((40, 60), light, np.float32) for light in (-0.05, 0.1, 0.3)]
    for coarse in (2, 4):
        along = blur_along_paths(blurred, coarse)
        found = consistent_light(blurred, luma_of(channels), channels, channels, along, 2, 2)
        np.testing.assert_allclose(found, channels, atol=1e-4)
    luma = np.full((80, 120), -0.05, np.float32)
    np.testing.assert_allclose(without_negative_light(blurred, luma, along, 2), luma, atol=1e-4)


def test_waves_in_dark_areas_shrink_to_the_mean_light() -> None:
    """Waves as long as the path are invisible in the record; clipping them at 0 would brighten the area."""
    blurred = _seen_along(np.linspace(-6, 6, 16)[:, None] * (1.0, 0.0), ResponseCurve("srgb"))
    light = np.full((80, 120), 0.02, np.float32)
    light[:, 60:] = 0.4 + 0.1 * np.sin(np.arange(60) * 2 * np.pi / 12)
    light[:, :48] += 0.2 * np.sin(np.arange(48) * 2 * np.pi / 12)
    found = without_negative_light(blurred, light, blur_along_paths(blurred, 2), 2)
    assert found.min() >= 0
    waves = found[:, 12:36]
    assert abs(waves.mean() - 0.02) < 0.005, "0.07 if negative light is only clipped"
    assert waves.max() < 0.08, "0.22 before the correction"
    np.testing.assert_allclose(found[:, 72:], light[:, 72:], rtol=1e-3)  # no negative light within reach: unchanged


def test_the_less_the_expected_gain_the_less_of_the_change_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seven tenths of the change for a gain of 1 dB, two fifths if it is uncertain, all for 3 dB; the log says so."""
    turning = camera(reference="frame-middle")
    recorded = record(turning).picture
    settings = replace(BALANCED, shutter="none", reference="frame-middle")
    pictures, shares = [], []
    for gain in ((3.0, 0.3), (1.0, 0.3), (1.0, 2.0)):
        monkeypatch.setattr(ConfirmedGain, "of_change_db", lambda *_, gain=gain: gain)
        confirmed = ConfirmedGain(1.0, 0.2, 0.02, 4)
        result = restore_frame(FRAME, recorded, turning.motion, turning.trajectory, settings, confirmed=confirmed)
        pictures.append(_picture(result).astype(float))
        shares.append(result.parameters["deblur"]["share"])
    assert shares == pytest.approx([1.0, 0.7, 0.4])
    for picture, share in zip(pictures, shares, strict=True):
        np.testing.assert_allclose(picture - recorded, share * (pictures[0] - recorded), atol=1.0)
    assert np.abs(pictures[0] - recorded).mean() > 2
