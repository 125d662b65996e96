"""The response curve is recovered from brackets with known truth. Brackets that do not determine it are reported."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from bracket_making import (
    FIVE,
    FIVE_LOW_TOP,
    GAMMA,
    LINEAR,
    SRGB,
    make_bracket,
    make_scene,
    take,
)

from virest.calibration.bracket_samples import BracketPicture, align_pictures, sample_bracket
from virest.calibration.curve_families import log_lookup, table_curve
from virest.calibration.exposure_check import fit_first_curve, outlying, robust_line
from virest.calibration.response_curve import curve_distance_levels, fit_response, residual_structure, scale_exposure
from virest.camera.response import ResponseCurve
from virest.errors import CalibrationError, SettingsError

TRUTHS = [FIVE, FIVE_LOW_TOP, GAMMA, SRGB, LINEAR]


@pytest.fixture
def rng() -> np.random.Generator:
    """The same random numbers in every test."""
    return np.random.default_rng(11)


def debevec_distance(bracket: list[BracketPicture], truth: ResponseCurve, grey: tuple[float, float]) -> float:
    """RMS distance in grey levels of OpenCV's curve (mean of its channels) from the truth, at the best scale."""
    exposures = np.array([p.exposure for p in bracket], np.float32)
    curve = cv2.createCalibrateDebevec().process([np.ascontiguousarray(p.levels) for p in bracket], exposures)
    light = np.asarray(curve).reshape(256, 3).mean(axis=1)
    levels = np.arange(int(np.ceil(grey[0])), int(grey[1]) + 1)
    return min(
        float(np.sqrt(np.mean((255 * truth.encode(light[levels] * np.exp(s)) - levels) ** 2)))
        for s in np.linspace(-9, 9, 1801)
    )


@pytest.mark.parametrize("truth", TRUTHS, ids=lambda c: f"{c.kind}-{c.y_max}")
def test_the_kind_and_the_curve_are_found(truth: ResponseCurve, rng: np.random.Generator) -> None:
    """Eight stills over 6 EV give the right kind and an error below 0.6 grey levels, less than OpenCV's Debevec."""
    bracket = make_bracket(truth, rng)
    fit = fit_response(bracket)
    assert fit.curve.kind == truth.kind
    error = curve_distance_levels(fit.curve, truth, fit.covered_exposure)
    assert error < 0.6
    low, high = 255 * fit.curve.encode(np.array(fit.covered_exposure))
    assert low < 15
    assert high > 0.93 * 255 * truth.y_max
    assert error < debevec_distance(bracket, truth, (low, high))
    assert not any(p.contradicts for p in fit.pictures)
    assert not any("agree to" in note for note in fit.notes)
    assert max(abs(p.exposure_error_ev or 0.0) for p in fit.pictures) < 0.02


@pytest.mark.parametrize("truth", [FIVE, GAMMA], ids=lambda c: c.kind)
def test_two_wrong_exposures_are_named(truth: ResponseCurve, rng: np.random.Generator) -> None:
    """Their true values are estimated, no other picture is reported, and the curve stays accurate."""
    bracket = make_bracket(truth, rng)
    wrong = list(bracket)
    wrong[1] = replace(bracket[1], exposure=bracket[1].exposure * 2**0.5)
    wrong[6] = replace(bracket[6], exposure=bracket[6].exposure * 2**-0.3)
    fit = fit_response(wrong)
    assert [p.file for p in fit.pictures if p.contradicts] == ["01.png", "06.png"]
    assert fit.pictures[1].exposure_error_ev == pytest.approx(0.5, abs=0.03)
    assert fit.pictures[6].exposure_error_ev == pytest.approx(-0.3, abs=0.03)
    assert fit.pictures[6].likely_exposure == pytest.approx(bracket[6].exposure, rel=0.02)
    assert sum("contradicts" in note for note in fit.notes) == 2
    assert curve_distance_levels(fit.curve, truth, fit.covered_exposure) < 1.5


def test_a_curve_that_no_kind_fits_becomes_a_table(rng: np.random.Generator) -> None:
    """A tone curve with two bends gives a table within 1.5 levels; a forced five-segment fit notes that it fails."""
    x = np.linspace(0, 1, 300)
    y = np.clip(np.sqrt(x) + 0.06 * np.sin(2 * np.pi * np.sqrt(x)), 0.0, 1.0)
    truth = ResponseCurve("table", x=tuple(x.tolist()), y=tuple(y.tolist()))
    bracket = make_bracket(truth, rng)
    fit = fit_response(bracket)
    assert fit.curve.kind == "table"
    assert curve_distance_levels(fit.curve, truth, fit.covered_exposure) < 1.5
    assert any("no simpler kind" in note for note in fit.notes)
    forced = fit_response(bracket, "five_segment")
    assert forced.curve.kind == "five_segment"
    assert any("--kind table" in note and "held-out" in note for note in forced.notes)


@pytest.mark.parametrize("kind", ["linear", "srgb", "gamma", "five_segment", "table"])
def test_every_kind_gives_a_curve_with_exact_inverse(kind: str, rng: np.random.Generator) -> None:
    """Whatever the truth, the curve rises and is finite, and ``linearise`` inverts ``encode`` between its ends."""
    fit = fit_response(make_bracket(GAMMA, rng, width=200, height=150, count=4, span_ev=4), kind)
    assert fit.curve.kind == kind
    low, high = fit.curve.light_range
    light = np.linspace(low, high, 500)[1:-1]
    grey = fit.curve.encode(light)
    assert np.isfinite(grey).all()
    assert (np.diff(grey) >= 0).all()
    rising = np.gradient(grey, light) > 1e-3
    np.testing.assert_allclose(fit.curve.linearise(grey)[rising], light[rising], atol=1e-6 * max(high, 1))
    assert np.isfinite(fit.cloud.residual).all()


def test_five_segments_and_tables_normalise_the_exposure_axis(rng: np.random.Generator) -> None:
    """The brightest light covered is 1."""
    bracket = make_bracket(FIVE, rng, width=200, height=150, count=5, span_ev=4)
    for kind in ("five_segment", "table"):
        assert fit_response(bracket, kind).covered_exposure[1] == pytest.approx(1.0)


def test_the_same_bracket_gives_the_same_curve(rng: np.random.Generator) -> None:
    """Samples are drawn from a seeded generator."""
    bracket = make_bracket(SRGB, rng, width=200, height=150, count=4, span_ev=4)
    assert fit_response(bracket, "gamma").curve == fit_response(bracket, "gamma").curve


def test_grey_pictures_with_fractional_levels_are_accepted(rng: np.random.Generator) -> None:
    """Equal channels count once, and levels may have fractions."""
    bracket = make_bracket(GAMMA, rng, width=240, height=180)
    grey = [replace(p, levels=np.repeat(p.levels[..., 1:2], 3, axis=2).astype(np.float32)) for p in bracket]
    fit = fit_response(grey)
    assert fit.curve.kind == "gamma"
    assert fit.curve.gamma == pytest.approx(2.2, abs=0.03)


def test_clipped_pixels_and_a_moving_corner_do_not_bias_the_curve(rng: np.random.Generator) -> None:
    """A corner that changes between pictures is left out, and a completely white picture is named."""
    bracket = make_bracket(SRGB, rng)
    for picture in bracket:
        picture.levels[:70, :90] = rng.integers(0, 255, (70, 90, 3)) // 8 * 8
    white = BracketPicture("white.png", np.full_like(bracket[0].levels, 255), bracket[-1].exposure * 8)
    fit = fit_response([*bracket, white])
    assert fit.curve.kind == "srgb"
    assert fit.pictures[-1].exposure_error_ev is None
    assert any(note.startswith("white.png") and "clipped" in note for note in fit.notes)


def test_an_almost_black_picture_does_not_bias_the_others(rng: np.random.Generator) -> None:
    """A codec brightened its few greys: the first curve keeps its slope, and the other exposures are accepted."""
    bracket = make_bracket(FIVE_LOW_TOP, rng)
    levels = 255 * FIVE_LOW_TOP.encode(FIVE_LOW_TOP.linearise(bracket[0].levels / 255) * 0.6)
    dark = BracketPicture("dark.png", np.rint(levels * 1.5 + 2).astype(np.uint8), bracket[0].exposure * 0.4)
    samples = sample_bracket([dark, *bracket], rng)
    first = fit_first_curve(samples.take(samples.measured.sum(axis=1) >= 2))
    light = FIVE_LOW_TOP.linearise(first.grey / 255)
    span = np.log(light[10] / light[2])
    assert first.log_light[10] - first.log_light[2] == pytest.approx(span, rel=0.15)
    assert np.abs(first.correction_ev[1:]).max() < 0.3


def test_a_plateau_below_white_is_found_despite_overshoot(rng: np.random.Generator) -> None:
    """The curve ends at level 237 although overshoot brings a few pixels at edges to 255."""
    bracket = make_bracket(FIVE_LOW_TOP, rng)
    for picture in bracket:
        picture.levels[(rng.uniform(size=picture.levels.shape[:2]) < 2e-3) & (picture.levels[..., 1] > 225)] = 255
    samples = sample_bracket(bracket, rng)
    assert 234 < samples.top < 240
    assert samples.high < 237
    fit = fit_response(bracket)
    assert fit.curve.kind == "five_segment"
    assert curve_distance_levels(fit.curve, FIVE_LOW_TOP, fit.covered_exposure) < 0.8


# ── what equal exposure steps leave undetermined ─────────────────────────────────────────────────────────────────

LIGHT = 1.2 * np.linspace(0, 1, 800) ** 3
TONED = (LIGHT * (2.51 * LIGHT + 0.03) / (LIGHT * (2.43 * LIGHT + 0.59) + 0.14)) ** (1 / 2.2)
FILM = ResponseCurve("table", x=tuple(LIGHT.tolist()), y=tuple(TONED.tolist()))


@pytest.mark.parametrize(("count", "span_ev"), [(2, 3.0), (3, 6.0), (4, 5.4)])
def test_few_pictures_far_apart_give_a_smooth_curve(count: int, span_ev: float, rng: np.random.Generator) -> None:
    """A function with the period of the exposure steps would fit as well; regularisation keeps the curve smooth."""
    fit = fit_response(make_bracket(FILM, rng, count=count, span_ev=span_ev))
    assert fit.curve.kind == "table"
    assert curve_distance_levels(fit.curve, FILM, fit.covered_exposure) < 2.5


def test_the_curve_s_deviation_covers_the_error(rng: np.random.Generator) -> None:
    """Errors lie within 2.5 deviations; wide exposure steps give larger deviations than close ones."""
    for truth in (FILM, FIVE_LOW_TOP):
        std = {}
        for count, span_ev in ((2, 1.5), (4, 5.0), (9, 5.0)):
            fit = fit_response(make_bracket(truth, rng, count=count, span_ev=span_ev))
            error = curve_distance_levels(fit.curve, truth, fit.covered_exposure)
            assert error < 2.5 * fit.curve_std_grey_levels
            std[count] = fit.curve_std_grey_levels
        assert std[9] < 0.8 * std[2]
        assert std[9] < 1.0


def test_an_undetermined_curve_is_refused(rng: np.random.Generator) -> None:
    """With steps as wide as the curve's range, each pixel is seen black, once or twice grey, and white."""
    narrow = ResponseCurve("five_segment", b=(0.3, 0.1), c=(0.7, 0.6), y_max=0.8)
    with pytest.raises(CalibrationError, match=r"do not determine the curve|no overlap"):
        fit_response(make_bracket(narrow, rng, count=4, span_ev=6.5))
    fit = fit_response(make_bracket(narrow, rng, count=14, span_ev=6.5))
    assert curve_distance_levels(fit.curve, narrow, fit.covered_exposure) < 1.5


def test_a_requested_kind_that_does_not_fit_has_a_large_deviation(rng: np.random.Generator) -> None:
    """The deviation covers the distance from the truth."""
    fit = fit_response(make_bracket(GAMMA, rng), "linear")
    assert curve_distance_levels(fit.curve, GAMMA, fit.covered_exposure) < 2.0 * fit.curve_std_grey_levels


def test_a_small_exposure_trend_keeps_the_kind(rng: np.random.Generator) -> None:
    """A trend within the tolerance for listed exposures is treated as flicker; a larger one changes the curve."""
    for step, kind in ((0.004, "srgb"), (0.03, "table")):
        bracket = [replace(p, exposure=p.exposure * float(np.exp(step * (i - 3.5))))
                   for i, p in enumerate(make_bracket(SRGB, rng))]  # fmt: skip
        assert fit_response(bracket).curve.kind == kind


def test_exposures_that_are_half_wrong_are_reported_to_disagree(rng: np.random.Generator) -> None:
    """An unlisted doubling of the ISO halfway makes no single picture stand out, so the note doubts the whole list."""
    bracket = [
        replace(p, exposure=p.exposure * (2.0 if i > 3 else 1.0)) for i, p in enumerate(make_bracket(GAMMA, rng))
    ]
    fit = fit_response(bracket)
    assert any("the listed exposures agree to" in note for note in fit.notes)


# ── misalignment ─────────────────────────────────────────────────────────────────────────────────────────────────


def shifted(bracket_light: np.ndarray, shifts: list[tuple[int, int]], rng: np.random.Generator) -> list[BracketPicture]:
    """Pictures of one scene, each shifted by whole pixels (right, down)."""
    out = []
    for i, (x, y) in enumerate(shifts):
        part = bracket_light[40 - y : 340 - y, 40 - x : 440 - x]
        factor = 2.0 ** (i - len(shifts) / 2)
        out.append(BracketPicture(f"{i}.png", take(part, factor, SRGB, rng), factor))
    return out


def test_small_shifts_are_found_and_corrected(rng: np.random.Generator) -> None:
    """Shifts of a few pixels are measured within half a pixel and do not bias the curve."""
    truth = [(0, 0), (2, -1), (3, 1), (-2, 4), (1, 0), (0, -3)]
    pictures = shifted(make_scene(480, 380, rng), truth, rng)
    np.testing.assert_allclose(align_pictures(pictures), truth, atol=0.5)
    fit = fit_response(pictures)
    assert curve_distance_levels(fit.curve, SRGB, fit.covered_exposure) < 1.0
    assert any("aligned" in note for note in fit.notes)


def test_shifts_of_a_few_flat_patches_are_found(rng: np.random.Generator) -> None:
    """Most of the picture is flat and noise dominates most ranks; the edges still determine the shifts."""
    light = np.full((380, 480, 3), 0.18, np.float32)
    for i in range(6):
        y, x = 50 + 150 * (i // 3), 60 + 140 * (i % 3)
        light[y : y + 100, x : x + 100] = 0.5**i
    truth = [(0, 0), (2, -1), (3, 1), (-2, 4)]
    pictures = shifted(cv2.GaussianBlur(light, (0, 0), 0.8), truth, rng)
    np.testing.assert_allclose(align_pictures(pictures), truth, atol=0.5)


def test_large_shifts_and_rotations_are_refused(rng: np.random.Generator) -> None:
    """For a shift the error names the picture."""
    light = make_scene(480, 380, rng)
    with pytest.raises(CalibrationError, match=r"3\.png is shifted by"):
        fit_response(shifted(light, [(0, 0), (0, 0), (0, 0), (17, 9), (0, 0)], rng))
    turn = cv2.getRotationMatrix2D((240, 190), 1.8, 1.0)
    pictures = [
        BracketPicture(f"{i}.png", take(light if i < 2 else cv2.warpAffine(light, turn, (480, 380)), f, SRGB, rng), f)
        for i, f in enumerate((0.25, 0.5, 1.0, 2.0))
    ]
    with pytest.raises(CalibrationError):
        fit_response(pictures)


# ── refusals ─────────────────────────────────────────────────────────────────────────────────────────────────────


def test_undetermined_brackets_are_refused(rng: np.random.Generator) -> None:
    """One picture, one exposure, no overlap, clipped pictures, or a moving scene: exit 6 and the reason."""
    bracket = make_bracket(GAMMA, rng, width=240, height=180)
    other = make_bracket(GAMMA, np.random.default_rng(99), width=240, height=180)
    black, white = np.zeros_like(bracket[0].levels), np.full_like(bracket[0].levels, 255)
    cases = {
        "1 picture:": bracket[:1],
        "one exposure": [replace(p, exposure=0.01) for p in bracket],
        "clipped throughout": [replace(p, levels=white if i % 2 else black) for i, p in enumerate(bracket)],
        "no overlap": make_bracket(LINEAR, rng, width=240, height=180, count=2, span_ev=16),
        "not still|move by|shifted": [b if i % 2 else o for i, (b, o) in enumerate(zip(bracket, other, strict=True))],
    }
    for reason, pictures in cases.items():
        with pytest.raises(CalibrationError, match=reason) as refusal:
            fit_response(pictures)
        assert refusal.value.exit_code == 6
        assert "\n" not in str(refusal.value)


def test_an_unknown_kind_is_a_settings_error(rng: np.random.Generator) -> None:
    """The error lists the known kinds."""
    with pytest.raises(SettingsError, match="five_segment"):
        fit_response(make_bracket(SRGB, rng, width=200, height=150), "cubic")


def test_few_and_narrow_brackets_are_noted_as_weak(rng: np.random.Generator) -> None:
    """Three pictures over 1 EV give a result with notes."""
    fit = fit_response(make_bracket(SRGB, rng, width=240, height=180, count=3, span_ev=1.0), "srgb")
    assert any("too few" in note for note in fit.notes)
    assert any("weakly" in note for note in fit.notes)


# ── properties of the parts ──────────────────────────────────────────────────────────────────────────────────────


def test_two_outliers_of_seven_do_not_bend_a_line() -> None:
    """The robust line follows the level and trend of most points."""
    x = np.array([0.0, 0.9, 2.1, 2.8, 4.2, 5.0, 6.1])
    y = 0.3 - 0.07 * x
    y[[1, 5]] += [0.4, -0.6]
    np.testing.assert_allclose(robust_line(x, y), (0.3, -0.07), atol=1e-9)
    assert outlying(y - 0.3 + 0.07 * x).tolist() == [False, True, False, False, False, True, False]


@pytest.mark.parametrize("curve", TRUTHS, ids=lambda c: f"{c.kind}-{c.y_max}")
def test_the_lookup_table_agrees_with_the_curve(curve: ResponseCurve) -> None:
    """It agrees within 0.1 grey levels, and its inverse within 0.001."""
    light = np.geomspace(max(curve.light_range[0] * 1.05, 0.002), curve.light_range[1] * 0.98, 300)
    lookup = log_lookup(curve)
    np.testing.assert_allclose(lookup.level(np.log(light)), 255 * curve.encode(light), atol=0.1)
    grey = 255 * curve.encode(light)
    np.testing.assert_allclose(lookup.level(lookup.light(grey)), grey, atol=1e-3)


def test_scaling_the_exposure_axis_keeps_the_curve() -> None:
    """Encoding x / unit with the scaled curve equals encoding x; the distance of the two curves is zero."""
    table = table_curve(np.linspace(-1, 0.3, 9), np.linspace(6, 250, 10), 255.0)
    for curve in (FIVE, table):
        light = np.linspace(*curve.light_range, 50)
        np.testing.assert_allclose(scale_exposure(curve, 1.7).encode(light / 1.7), curve.encode(light), atol=1e-9)
        assert curve_distance_levels(scale_exposure(curve, 1.7), curve, (0.1, 0.5)) < 0.01


def test_residual_structure_is_measured_above_noise(rng: np.random.Generator) -> None:
    """Pure noise gives almost no structure; a wave over grey gives its RMS."""
    grey = rng.uniform(5, 250, 20_000)
    noise = rng.standard_normal(20_000)
    assert residual_structure(grey, noise) < 0.05
    assert residual_structure(grey, noise + 0.5 * np.sin(grey / 30)) == pytest.approx(0.35, abs=0.05)


@pytest.mark.parametrize("seed", [1, 2])
def test_equal_exposures_listed_as_different_are_refused(seed):
    """Five pictures with one exposure, listed over 8 EV, give an error instead of a curve."""
    rng = np.random.default_rng(seed)
    light = make_scene(420, 310, rng)
    true = [1.0] * 5 + [2.0**k for k in (-3, -1, 1, 2)]
    listed = [2.0**k for k in (-4, -2, 0, 2, 4)] + true[5:]
    pairs = zip(true, listed, strict=True)
    bracket = [BracketPicture(f"{k}.png", take(light, t, GAMMA, rng), s / 60) for k, (t, s) in enumerate(pairs)]
    with pytest.raises(CalibrationError, match="EV"):
        fit_response(bracket)
