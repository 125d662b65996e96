"""The report page: hostile text stays text, curves and arrows show their data, and pictures respect the byte limit."""

import base64
import hashlib
import html
import re

import cv2
import numpy as np
import pytest

from virest.effects.table import EFFECTS
from virest.report.charts import MAX_ARROWS, MAX_COLUMNS, arrow_field, band, nice_ticks, thinned, time_chart
from virest.report.html import (
    CaptureRecord,
    DiagnosisRecord,
    FrameFacts,
    RunRecord,
    choose_frames,
    embed_pictures,
    left_alone,
    ranges,
    report_page,
    run_verdict,
    show_frame,
)
from virest.report.words import CAUSE_WORDS, camera_values, with_deviation

HOSTILE = "<script>alert('x')</script>\"'& ../../etc \u202egnp.exe \x07\x1b[2J\nnext"
HOSTILE_SHOWN = "<script>alert('x')</script>\"'& ../../etc \\u202egnp.exe \\u0007\\u001b[2J next"
COUNTS = {"restored": 2, "copied": 0, "skipped": 1, "failed": 0}


def account(**changes):
    """Contents of a run.json."""
    return {
        "capture": "trip",
        "version": "1",
        "command": "virest process trip",
        "profile": {"imu": {"time_offset_s": -0.0059354}, "shutter": {"readout_time_s": 0.0227}},
        "profile_source": "trip/camera.yaml",
        "settings": {"preset": "fast"},
        "inputs": [],
        "counts": COUNTS,
        "verdict": "restored",
        "warnings": [],
        **changes,
    }


def facts(frame, state="restored", **changes):
    """Facts about one frame, 40 ms after the previous one."""
    known = {"blur_px": 3.0 + frame, "longest_blur_px": 5.0 + frame, "deblurred": True, "exposure_s": 0.009}
    return FrameFacts(frame, 5_000_000_000 + 40_000_000 * frame, state, **{**known, **changes})


def picture(height=40, width=60):
    """An asymmetric picture."""
    rows, columns = np.mgrid[:height, :width]
    return np.stack([4 * columns, 5 * rows, 3 * rows + columns], axis=-1).astype(np.uint8)


def page(**changes):
    """A page of one run with one picture."""
    frames = [facts(3), facts(4), facts(5, "skipped", warnings=("falls into a gap",))]
    tiles = [(10.0, 12.0, 0.3, 4.0), (40.0, 12.0, 0.4, 3.0)]
    shown = [show_frame(frames[0], picture(), picture()[::-1].copy(), tiles, (60, 40), 100_000)]
    record = RunRecord(account(**changes), frames, shown, changes.pop("notes", ()))
    return report_page([CaptureRecord(changes.get("capture", "trip"), record)], "1")


def text_of(markup):
    """The visible text, with white space collapsed."""
    bare = re.sub(r"<(style|script|title)>.*?</\1>", "", markup, flags=re.DOTALL)
    return " ".join(html.unescape(re.sub(r"<[^>]*>", "", bare)).split())


def test_hostile_text_is_shown_as_text():
    """Markup, quotes and control characters create no element; unprintable characters are shown as codes."""
    hostile = page(
        capture=HOSTILE, command=HOSTILE, warnings=[HOSTILE], settings={HOSTILE: HOSTILE}, profile_source=HOSTILE
    )
    assert len(re.findall("<script", hostile)) == 1
    assert not re.findall("[\u202e\x07\x1b]", hostile)
    assert text_of(hostile).count(" ".join(HOSTILE_SHOWN.split())) >= 5


def test_the_policy_allows_only_the_page_s_own_style_and_script():
    """The policy has the hashes of the page's style and script; no attribute holds style or script."""
    markup = page()
    policy = html.unescape(re.search(r'Content-Security-Policy" content="([^"]*)"', markup)[1])
    for name in ("style", "script"):
        (inside,) = re.findall(rf"<{name}>(.*?)</{name}>", markup, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(inside.encode()).digest()).decode()
        assert f"{name}-src 'sha256-{digest}'" in policy
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy
    assert "http" not in markup.replace("http-equiv", "")
    assert not re.search(r"<[^>]*\s(style|on[a-z]+)=", markup)


def test_every_cause_has_a_description():
    """Exactly the causes that a diagnosis can name are described in plain words."""
    assert CAUSE_WORDS.keys() == EFFECTS.keys()


@pytest.mark.parametrize(
    ("name", "value", "std", "text"),
    [
        ("time_offset_s", -0.00593540, 0.00092300, "−5.94 ± 0.92 ms"),
        ("readout_time_s", 0.0149111, 5.488e-05, "14.911 ± 0.055 ms"),
        ("fx_px", 1024.04, 31.2, "1024 ± 31 px"),
        ("gyro_bias_rad_s", [0.01792, -0.01076], [0.00019, 0.00021],
         "0.01792 ± 0.00019 rad/s; −0.01076 ± 0.00021 rad/s"),
        ("gyro_scale", 1.01, None, "1.01"),
        ("depth_m", "inf", None, "infinity"),
        ("depth_m", None, None, "unknown"),
        ("gain", [1.0] * 30, None, "30 values"),
        ("focal_drift_per_s", 0.002, 0.0, "0.002 1/s"),
    ],
)  # fmt: skip
def test_a_value_is_shown_to_two_digits_of_its_deviation(name, value, std, text):
    """It has the unit of its name; seconds are shown as milliseconds."""
    assert with_deviation(name, value, std) == text


def test_an_estimate_is_shown_with_its_deviation_and_source():
    """An estimate names its method, a given value its file; null is shown as unknown."""
    estimate = {"value": 0.4624, "std": 0.0168, "source": "tracked points"}
    profile = {"imu": {"time_offset_s": 0.4624}, "shutter": {"readout_time_s": None},
               "intrinsics": {"fx_px": 980.5}, "estimates": {"time_offset_s": estimate}}  # fmt: skip
    values = {value.title: value for value in camera_values(profile, "camera.yaml")}
    assert (values["Time offset"].text, values["Time offset"].source) == ("462 ± 17 ms", "tracked points")
    assert values["Focal length"].source == "given by camera.yaml"
    assert values["Readout time"].text == "unknown"
    assert camera_values({"imu": 3, "estimates": [1]}, "")[0].text == "unknown"


def test_unrestored_frames_are_grouped_by_reason():
    """Numbers in a reason do not matter.

    Copied, skipped and failed frames, and those with a remark, are listed as ranges.
    """
    frames = [facts(k, warnings=(f"blur of 0.{k} px is below 1 px",), deblurred=False) for k in (1, 2, 3, 7)]
    frames += [facts(k, "skipped", warnings=("gap",)) for k in (4, 5)]
    frames += [facts(6, "copied"), facts(8, warnings=("a remark",)), facts(9)]
    told = [(r.state, r.text, r.varies, r.count, r.ranges) for r in left_alone(frames)]
    assert told == [
        ("skipped", "gap", False, 2, "4–5"),
        ("copied", "no reason is logged", False, 1, "6"),
        ("straightened", "blur of 0.1 px is below 1 px", True, 4, "1–3, 7"),
        ("remark", "a remark", False, 1, "8"),
    ]
    assert ranges([]) == ""


def test_the_verdict_counts_frames():
    """All, some or no frames are restored, and the others are counted by their status."""
    mixed = run_verdict({**COUNTS, "failed": 4}, "some frames failed", [facts(3)])
    assert (mixed.level, mixed.headline) == ("poor", "1 of 7 frames deblurred, 1 only straightened")
    assert mixed.sentence.startswith("1 skipped, 4 failed.")
    assert run_verdict({**COUNTS, "skipped": 0}, "restored", []).level == "good"
    told = run_verdict({"restored": 103, "copied": 0, "skipped": 0, "failed": 0, "deblurred": 14}, "restored", [])
    assert told.headline == "14 of 103 frames deblurred, 89 only straightened"
    none = run_verdict({"restored": 0, "copied": 3, "skipped": 0, "failed": 0}, "copied: focal length unknown", [])
    assert none.sentence == "3 copied unchanged. Copied: focal length unknown."


def test_the_most_blurred_frame_of_each_part_is_shown():
    """Restored frames come first, and there are never more than exist."""
    blur = [2, 9, 4, 1, 3, 8, 5, 6, 7]
    frames = [facts(k, longest_blur_px=float(b)) for k, b in enumerate(blur)] + [facts(20, "copied")]
    assert [f.frame for f in choose_frames(frames, 3)] == [1, 5, 8]
    assert [f.frame for f in choose_frames([facts(4, "skipped"), facts(5, "copied")], 6)] == [5]
    assert len(choose_frames(frames, 50)) == 9
    assert choose_frames([], 3) == []


def test_pictures_respect_the_byte_limit_and_have_equal_size(rng):
    """A lower limit makes both smaller; a sufficient one keeps size and colours, in the order RGB."""
    noisy = rng.integers(0, 255, (300, 500, 3)).astype(np.uint8)
    before, none, after = embed_pictures([noisy, None, noisy[:, ::-1]], 40_000)
    assert none is None
    assert len(before.uri) + len(after.uri) <= 40_000
    assert (before.width, before.height) == (after.width, after.height)
    assert before.width / before.height == pytest.approx(500 / 300, rel=0.02)
    (roomy,) = embed_pictures([picture()], 100_000)
    data = np.frombuffer(base64.b64decode(roomy.uri.partition(",")[2]), np.uint8)
    assert np.abs(cv2.imdecode(data, cv2.IMREAD_COLOR_RGB).astype(int) - picture()).mean() < 6


def numbers_of(path):
    """The points of an SVG path."""
    return np.array(re.findall(r"-?[\d.]+", path), float).reshape(-1, 2)


def test_arrows_point_where_the_points_moved_and_are_centred_on_their_tile():
    """x is right and y is down; lengths are in pixels times the stated scale."""
    field = arrow_field(np.array([[30.0, 20.0], [70.0, 60.0]]), np.array([0.4, -2.2]), np.array([6.0, 3.0]), 100, 80)
    for arrow, centre, angle, length in zip(field.arrows, [(30, 20), (70, 60)], [0.4, -2.2], [6, 3], strict=True):
        tail, tip = numbers_of(arrow.path)[:2]
        assert (tail + tip) / 2 == pytest.approx(centre, abs=0.11)
        assert np.arctan2(*(tip - tail)[::-1]) == pytest.approx(angle, abs=0.03)
        assert np.hypot(*(tip - tail)) == pytest.approx(field.scale * length, abs=0.2)
    assert field.scale > 1
    assert arrow_field(np.zeros((0, 2)), np.zeros(0), np.zeros(0), 100, 80).arrows == ()


def test_many_tiles_are_thinned_evenly():
    """A fine grid keeps complete rows and columns; a single long row keeps some tiles."""
    x, y = np.meshgrid(np.arange(30.0), np.arange(40.0))
    for centres in (np.column_stack([x.ravel(), y.ravel()]), np.column_stack([np.arange(500.0), np.zeros(500)])):
        arrows = arrow_field(centres, np.zeros(len(centres)), np.ones(len(centres)), 500, 400).arrows
        assert MAX_ARROWS / 4 < len(arrows) <= MAX_ARROWS


def test_a_curve_breaks_at_unknown_values():
    """Larger values are higher; a single value is still drawn; without any value there is no chart."""
    time_s = np.arange(6) * 0.04
    chart = time_chart("Blur", "px", time_s, [("a", [1.0, 9.0, None, 4.0, None, 2.0]), ("b", [None] * 6)], [0.08])
    (line,) = chart.lines
    points = numbers_of(line.path.replace("h0", ""))
    assert line.path.count("M") == 3
    assert line.path.count("h0") == 2
    assert points[:, 1].argmin() == 1
    assert chart.y_ticks[0].label == "0"
    assert len(chart.marks) == 1
    assert chart.summary == "a: 1 to 9 px, median 3"
    assert time_chart("Depth", "m", time_s, [("a", [None] * 6)], []) is None


def test_a_long_curve_keeps_its_peaks():
    """Minimum and maximum of each part survive the thinning."""
    values = np.sin(np.arange(20_000) / 37.0)
    values[12_345], values[7:9] = 50.0, np.nan
    time_s, kept = thinned(np.arange(20_000.0), values)
    assert len(kept) <= 2 * MAX_COLUMNS
    assert np.nanmax(kept) == 50.0
    assert time_s[np.nanargmax(kept)] == 12_345
    assert (np.diff(time_s) > 0).all()


@pytest.mark.parametrize(("low", "high"), [(0.0, 16.6), (-2.3, 1.7), (0.0, 0.0), (0.0, 0.00042), (3.0, 3.0), (0, 9e7)])
def test_ticks_enclose_the_values_in_round_steps(low, high):
    """There are 2 to 8 ticks, even if all values are equal."""
    ticks = nice_ticks(low, high)
    steps = np.diff(ticks)
    assert ticks[0] <= low
    assert ticks[-1] >= high
    assert 2 <= len(ticks) <= 8
    assert steps == pytest.approx(steps[0])
    assert re.fullmatch(r"[125]e[+-]\d+", f"{steps[0]:.0e}")


def test_a_band_shows_runs_of_states():
    """Widths are fractions of all frames."""
    stretches = [(s.state, s.start, s.width) for s in band(["a", "a", "b", "a"])]
    assert stretches == [("a", 0.0, 0.5), ("b", 0.5, 0.25), ("a", 0.75, 0.25)]
    assert band([]) == ()


def test_a_diagnosis_is_shown_with_values_deviations_and_rivals():
    """The page gives values before and after, held-out residuals, rivals and the remaining residual."""
    change = {"nominal": 0.0, "estimate": 0.0042, "std": 0.00011}
    cause = {"name": "time_offset", "parameters": {"time_offset_s": change},
             "held_out": {"quantity": "geometry_rms_px", "before": 1.41, "after": 0.22, "gain": 0.987},
             "rivals": [{"name": "timestamp_reference", "held_out_after": 0.23}]}  # fmt: skip
    found = {"verdict": "explained", "causes": [cause], "unexplained": {"p_value": 0.6, "strongest_along": "row"}}
    told = text_of(report_page([CaptureRecord("trip", None, DiagnosisRecord(found))], "1"))
    for words in ("0 ms → 4.20 ± 0.11 ms", "1.41 → 0.22 points, px", "99%", "timestamp reference (0.23)",
                  "camera and IMU clocks differ by an offset", "Found: time offset."):  # fmt: skip
        assert words in told
    assert "is significant" in text_of(
        report_page([CaptureRecord("t", None, DiagnosisRecord({**found, "verdict": "unexplained"}))], "1")
    )


def test_a_copied_frame_is_not_called_straightened():
    """The description follows the steps done, not the distortion by the shutter."""
    bent = facts(3, "copied", shift_px=5.0, deblurred=False)
    assert bent.done == "copied unchanged"
    straight = facts(4, shift_px=5.0, deblurred=False, straightened=True)
    assert straight.done == "straightened"
    assert facts(5, deblurred=True, straightened=True).done == "deblurred and straightened"


def test_only_values_in_the_profile_are_called_given():
    """A null is unknown whatever its default; other values may come from the file or be defaults."""
    profile = {"imu": {"time_offset_s": None, "gyro_bias_rad_s": [0.0, 0.0, 0.0]}, "intrinsics": {"fx_px": 500.0}}
    values = {value.title: value.source for value in camera_values(profile, "camera.yaml")}
    assert values["Time offset"] == "unknown"
    assert values["Gyroscope bias"] == "camera.yaml, or the default"
    assert values["Focal length"] == "given by camera.yaml"
