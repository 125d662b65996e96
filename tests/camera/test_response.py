"""The response curve: it is invertible, smooth and finite."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from laws import assert_round_trip

from virest.camera.response import ResponseCurve
from virest.errors import SettingsError

FIVE = {"kind": "five_segment", "b": (0.12, 0.08), "c": (0.62, 0.80), "y_max": 0.93}
TABLE = {"kind": "table", "x": (0.0, 0.02, 0.1, 0.35, 0.7, 1.0), "y": (0.0, 0.11, 0.33, 0.66, 0.9, 1.0)}
PLAIN: dict[str, dict[str, Any]] = {
    "linear": {"kind": "linear"},
    "srgb": {"kind": "srgb"},
    "gamma": {"kind": "gamma", "gamma": 1.8},
    "five_segment": FIVE,
    "table": TABLE,
}
EXTRA = {"extra_gamma": 1.3, "black_level": 0.04}
CURVES = [pytest.param(ResponseCurve(**c), id=n) for n, c in PLAIN.items()] + [
    pytest.param(ResponseCurve(**c, **EXTRA), id=f"{n} extended") for n, c in PLAIN.items()
]
LEVELS = np.arange(256) / 255


@pytest.mark.parametrize("curve", CURVES)
def test_linearise_inverts_encode(curve: ResponseCurve) -> None:
    """Encoding linear light and linearising it returns the light, between A and D."""
    low, high = curve.light_range
    assert_round_trip(curve.encode, curve.linearise, np.linspace(low, high, 1001), atol=1e-5)


@pytest.mark.parametrize("curve", CURVES)
def test_encode_inverts_linearise(curve: ResponseCurve) -> None:
    """Every grey between the curve's darkest and brightest is reproduced from its light."""
    low, high = curve.encode(np.array(curve.light_range))
    assert_round_trip(curve.linearise, curve.encode, np.linspace(low, high, 777), atol=1e-9)


@pytest.mark.parametrize("curve", CURVES)
def test_curves_rise_and_stay_finite(curve: ResponseCurve) -> None:
    """Both directions are monotonic and finite, also far outside the range."""
    light = np.linspace(-0.5, 2.0, 2001)
    grey = curve.encode(light)
    assert np.isfinite(grey).all()
    assert (np.diff(grey) >= -1e-12).all()
    assert grey.min() >= 0
    assert grey.max() <= 1 + 1e-12
    back = curve.linearise(np.linspace(-0.3, 1.4, 2001))
    assert np.isfinite(back).all()
    assert (np.diff(back) >= -1e-12).all()


@pytest.mark.parametrize("curve", CURVES)
def test_single_precision_stays_single(curve: ResponseCurve) -> None:
    """Pictures in float32 stay float32 and agree with float64."""
    light = np.linspace(*curve.light_range, 301)
    for function, values in ((curve.encode, light), (curve.linearise, curve.encode(light))):
        single = function(values.astype(np.float32))
        assert single.dtype == np.float32
        np.testing.assert_allclose(single, function(values), atol=2e-3)


@pytest.mark.parametrize("curve", CURVES)
def test_linear_table_is_the_inverse_at_every_level(curve: ResponseCurve) -> None:
    """The lookup table holds the light of each of the 256 levels."""
    np.testing.assert_allclose(curve.linear_table(), curve.linearise(LEVELS), rtol=1e-6, atol=1e-7)


def test_srgb_follows_the_standard() -> None:
    """Known pairs of IEC 61966-2-1: the middle grey, half of the light, and the linear segment."""
    light = np.array([0.0021, 0.2140411, 0.5, 1.0])
    np.testing.assert_allclose(ResponseCurve("srgb").encode(light), [0.027132, 0.5, 0.7353570, 1.0], atol=1e-6)


def test_gamma_encodes_by_its_reciprocal() -> None:
    """Gamma 2 encodes a quarter of the light as half of the grey range."""
    assert ResponseCurve("gamma", gamma=2.0).encode(np.array(0.25)) == pytest.approx(0.5)


def test_knots_match_a_hand_calculation() -> None:
    """k1 = 0.72 / 0.5 = 1.44, so x_a = 0.12 − 0.16 / 1.44 and x_d = 0.62 + 0.26 / 1.44."""
    x_a, x_d = ResponseCurve(**FIVE).knots
    assert x_a == pytest.approx(0.0088889, abs=1e-6)
    assert x_d == pytest.approx(0.8005556, abs=1e-6)


def test_five_segments_meet_without_steps_or_kinks() -> None:
    """At A, B, C and D the slope is the same from both sides; the line has slope k1."""
    curve = ResponseCurve(**FIVE)
    h = 1e-6
    for x, slope in zip((curve.knots[0], 0.12, 0.62, curve.knots[1]), (0.0, 1.44, 1.44, 0.0), strict=True):
        before, at, after = curve.encode(np.array([x - h, x, x + h]))
        assert (at - before) / h == pytest.approx(slope, abs=1e-4)
        assert (after - at) / h == pytest.approx(slope, abs=1e-4)


def test_five_segments_match_a_hand_calculation() -> None:
    """Zero below A, a quarter of y_b halfway along the toe, the middle of the line, and y_d above D."""
    curve = ResponseCurve(**FIVE)
    toe = (curve.knots[0] + 0.12) / 2
    np.testing.assert_allclose(curve.encode(np.array([0.0, toe, 0.37, 0.95])), [0, 0.02, 0.44, 0.93], atol=1e-12)


def test_extensions_apply_on_top_of_the_curve() -> None:
    """Grey = black + (1 − black) curve(light)^gamma; computed by hand: 0.1 + 0.9 · 0.5^1.5."""
    curve = ResponseCurve("linear", extra_gamma=1.5, black_level=0.1)
    assert curve.encode(np.array(0.5)) == pytest.approx(0.1 + 0.9 * 0.5**1.5)
    assert curve.encode(np.array(0.0)) == pytest.approx(0.1)
    assert curve.linearise(np.array(0.05)) == 0.0


@pytest.mark.parametrize("curve", CURVES)
def test_slope_table_is_the_derivative(curve: ResponseCurve) -> None:
    """Slopes agree with a numerical derivative away from kinks and ends, and are positive and finite everywhere."""
    table = curve.slope_table()
    assert np.isfinite(table).all()
    assert (table > 0).all()
    h = 1e-5
    light = curve.linearise(LEVELS)
    slope = 255 * (curve.encode(light + h) - curve.encode(light - h)) / (2 * h)
    kinks = 255 * curve.encode(np.array([*curve.light_range, curve.b[0], curve.c[0], *(curve.x or (0.0,))]))
    clear = np.abs(np.arange(256)[:, None] - kinks).min(axis=1) > 4
    clear &= (np.arange(256) > kinks[0]) & (np.arange(256) < kinks[1])
    assert clear.sum() > 150
    np.testing.assert_allclose(table[clear], slope[clear], rtol=0.05)


def test_clipped_levels_are_censored() -> None:
    """A plain curve loses only the top level; a margin adds the given number of levels."""
    assert np.flatnonzero(ResponseCurve("srgb").censored_table()).tolist() == [255]
    assert np.flatnonzero(ResponseCurve("srgb").censored_table(8)).tolist() == list(range(247, 256))


def test_levels_below_a_and_above_d_are_censored() -> None:
    """With y_d = 0.93 (level 237.15) all levels from 237 are censored, and 0, which hides light below A."""
    expected = [0, *range(237, 256)]
    assert np.flatnonzero(ResponseCurve(**FIVE).censored_table()).tolist() == expected


def test_the_black_level_moves_the_censored_levels() -> None:
    """With black at 0.1, light below A is hidden at levels up to 26 (25.5 + 0.5)."""
    censored = ResponseCurve(**FIVE, black_level=0.1).censored_table()
    assert np.flatnonzero(censored[:128]).tolist() == list(range(27))


@pytest.mark.parametrize(
    "fault",
    [
        {"kind": "log"},
        {"kind": "gamma", "gamma": 0.0},
        {"kind": "gamma", "gamma": float("nan")},
        {"kind": "srgb", "extra_gamma": -1.0},
        {"kind": "srgb", "black_level": 0.95},
        {"kind": "srgb", "black_level": -0.1},
        {**FIVE, "b": (0.7, 0.08)},
        {**FIVE, "b": (0.12, 0.8)},
        {**FIVE, "b": (0.12, -0.1)},
        {**FIVE, "y_max": 0.7},
        {**FIVE, "y_max": 1.1},
        {**FIVE, "c": (float("inf"), 0.8)},
        {"kind": "table", "x": (0.0,), "y": (0.0,)},
        {"kind": "table", "x": (0.0, 1.0), "y": (0.0, 0.5, 1.0)},
        {"kind": "table", "x": (0.0, 0.5, 0.4), "y": (0.0, 0.5, 1.0)},
        {"kind": "table", "x": (0.0, 0.5, 1.0), "y": (0.0, 0.6, 0.6)},
        {"kind": "table", "x": (0.0, float("nan"), 1.0), "y": (0.0, 0.5, 1.0)},
    ],
)
def test_curves_that_cannot_be_inverted_are_refused(fault: dict[str, Any]) -> None:
    """A curve that falls, is constant or is not finite is a settings error of one line."""
    with pytest.raises(SettingsError, match="response") as caught:
        ResponseCurve(**fault)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("curve", "name"),
    [
        (ResponseCurve(), "srgb"),
        (ResponseCurve("gamma", gamma=2.2), "gamma 2.2"),
        (ResponseCurve("linear", extra_gamma=1.1, black_level=0.02), "linear ^1.1 black 0.02"),
    ],
)
def test_curves_have_short_names(curve: ResponseCurve, name: str) -> None:
    """The log's name states the kind and the extensions."""
    assert curve.describe() == name


@settings(max_examples=60, deadline=None)
@given(
    x_b=st.floats(0.02, 0.4), width=st.floats(0.1, 0.6), y_b=st.floats(0, 0.3), rise=st.floats(0.1, 0.5),
    above=st.floats(0, 0.2), extra=st.floats(0.5, 2), black=st.floats(0, 0.2),
)  # fmt: skip
def test_any_five_segment_curve_inverts(
    x_b: float, width: float, y_b: float, rise: float, above: float, extra: float, black: float
) -> None:
    """For any fitted knots, the curve rises and its inverse returns the light."""
    knots = {"b": (x_b, y_b), "c": (x_b + width, y_b + rise), "y_max": y_b + rise + above}
    curve = ResponseCurve("five_segment", **knots, extra_gamma=extra, black_level=black)
    light = np.linspace(*curve.light_range, 101)
    assert (np.diff(curve.encode(light)) >= 0).all()
    assert_round_trip(curve.encode, curve.linearise, light, atol=2e-3)


def test_writing_to_a_table_does_not_change_the_cache() -> None:
    """Tables are cached between calls; a caller's changes to one are not."""
    curve = ResponseCurve("srgb")
    for table in (curve.linear_table, curve.slope_table, curve.censored_table, curve.clipped_table):
        before = table().copy()
        table()[:] = 1
        np.testing.assert_array_equal(table(), before)
