"""The camera profile: a written profile reads back the same; an invalid one is rejected in one line with a hint."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from virest.camera.intrinsics import COEFFICIENT_NAMES, Intrinsics
from virest.camera.profile import CameraProfile, Estimate, Extensions
from virest.camera.profile_file import format_profile, parse_profile, profile_mapping, read_profile, write_profile
from virest.camera.response import ResponseCurve
from virest.camera.shutter import READOUT_DIRECTIONS, STAMP_FRACTION, Shutter
from virest.camera.yaml_mapping import load_yaml_mapping
from virest.errors import SettingsError

CONTRACT_EXAMPLE = """
virest_profile: 1
device: Honor View 10
image: {width: 720, height: 1280}            # pixels as stored in the movie
intrinsics:
  fx_px: 980.48
  fy_px: 980.48
  cx_px: 359.5                               # (0, 0) is the centre of the top-left pixel
  cy_px: 639.5
  distortion: {model: radtan, k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0, k3: 0.0}   # OpenCV
shutter:
  readout_time_s: 0.020733                   # start of the first row → start of one past the last row
  readout_direction: right_to_left           # in the stored picture
  timestamp: exposure_start                  # of the first row read; or exposure_middle | exposure_end
  exposure_scale: 1.0                        # true exposure = logged exposure × this
imu:
  T_cam_imu: [[1,0,0,0],[0,-1,0,0],[0,0,-1,0],[0,0,0,1]]    # x_cam = T_cam_imu @ x_imu; metres
  time_offset_s: 0.0                         # null: estimate
  clock_skew: 0.0
  gyro_bias_rad_s: [0, 0, 0]                 # measured = scale * true + bias
  gyro_scale: [1, 1, 1]
response:                                    # five-segment exposure characteristic curve
  kind: five_segment
  b: [0.12, 0.08]
  c: [0.62, 0.80]
  y_max: 1.0                                 # y_d
sensor: {width_mm: null, height_mm: null, focal_length_mm: 4.75}      # eq 17, where no intrinsics are known
scene: {depth_m: null}                       # null: triangulate; inf: rotation only
estimates: {}                                # NAME: {value, std, source}
extensions:                                  # what a diagnosis added; an absent one is off (§4)
  focal_drift: {focal_drift_per_s: 0.0}
  stabilisation: {fraction: 0.0, cutoff_hz: 1.0, travel_rad: null, at_end: runs_on}
  frame_lag: {lag_s: 0.0, frames: 0}
  exposures_late_frames: 0
  exposure_gain: []
  response_gamma: 1.0
  black_level: 0.0
  vignetting: {corner_loss: 0.0}
  flicker: {amplitude: 0.0, frequency_hz: 100.0, phase_rad: 0.0}
  gain: []
  defocus: {sigma_px: 0.0}
"""
SMALL = "virest_profile: 1\nimage: {width: 64, height: 48}\n"
FULL = CameraProfile(
    width=720,
    height=1280,
    device="Füll 10: #1",
    intrinsics=Intrinsics(720, 1280, 981.5, 979.25, 355.1, 641.7, "radtan", (-0.11, 0.02, 1e-3, -2e-4, 1e-5)),
    shutter=Shutter(0.0207, "bottom_to_top", "exposure_end", 0.97),
    r_cam_imu=((0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    p_cam_imu_m=(0.011, -0.042, 0.003),
    time_offset_s=-0.0123,
    clock_skew=3e-5,
    gyro_bias_rad_s=(1e-3, -2.5e-7, 0.02),
    gyro_scale=(1.01, 0.99, 1.002),
    response=ResponseCurve(
        "five_segment", b=(0.12, 0.08), c=(0.62, 0.8), y_max=0.95, extra_gamma=1.1, black_level=0.02
    ),
    sensor_width_mm=4.1,
    sensor_height_mm=5.6,
    focal_length_mm=4.75,
    depth_m=math.inf,
    estimates={
        "time_offset_s": Estimate(-0.0123, 1e-5, "tracks against gyroscope"),
        "gyro_bias_rad_s": Estimate([1e-3, 0.0, 0.02], [1e-4, 1e-4, 2e-4], "the same"),
        "readout_direction": Estimate("bottom_to_top", None, "likelihood"),
    },
    extensions=Extensions(
        0.01,
        0.6,
        2.5,
        0.3,
        17,
        0.35,
        0.1,
        120.0,
        0.7,
        (1.0, 0.97, 1.02),
        0.8,
        exposures_late_frames=2,
        exposure_gain=(1.4, 0.6, 1.4),
    ),
)


def _parse(text: str) -> CameraProfile:
    return parse_profile(yaml.safe_load(SMALL + text))


def _read(folder: Path, text: str | bytes) -> CameraProfile:
    path = folder / "camera.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_profile(path)


# ── reading ──────────────────────────────────────────────────────────────────────────────────────────────────────


def test_the_documented_example_is_read_literally(tmp_path: Path) -> None:
    """The profile of the documentation parses, and every value is assigned correctly."""
    profile = _read(tmp_path, CONTRACT_EXAMPLE)
    assert profile == CameraProfile(
        width=720,
        height=1280,
        device="Honor View 10",
        intrinsics=Intrinsics(720, 1280, 980.48, 980.48, 359.5, 639.5, "radtan", (0.0,) * 5),
        shutter=Shutter(0.020733, "right_to_left", "exposure_start", 1.0),
        r_cam_imu=((1, 0, 0), (0, -1, 0), (0, 0, -1)),
        time_offset_s=0.0,
        response=ResponseCurve("five_segment", b=(0.12, 0.08), c=(0.62, 0.80)),
        focal_length_mm=4.75,
    )
    assert profile.readout_known


def test_a_full_profile_survives_its_file(tmp_path: Path) -> None:
    """Writing and reading a profile with every key set gives the same profile and leaves no partial file."""
    write_profile(FULL, tmp_path / "full.yaml")
    assert read_profile(tmp_path / "full.yaml") == FULL
    assert [p.name for p in tmp_path.iterdir()] == ["full.yaml"]


def test_an_empty_profile_survives_its_file() -> None:
    """Unknown values stay unknown."""
    empty = CameraProfile(64, 48, readout_known=False)
    assert parse_profile(yaml.safe_load(format_profile(empty))) == replace(empty, shutter=Shutter(0.0, "top_to_bottom"))


def _floats(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False)


@st.composite
def _profiles(draw: st.DrawFn) -> CameraProfile:
    def some(low: float, high: float, count: int) -> tuple[float, ...]:
        return tuple(draw(_floats(low, high)) for _ in range(count))

    width, height = draw(st.integers(16, 4000)), draw(st.integers(16, 4000))
    model = draw(st.sampled_from(sorted(COEFFICIENT_NAMES)))
    lens = Intrinsics(
        width, height, *some(200, 1e5, 2), *some(-1e4, 1e4, 2), model, some(-1, 1, len(COEFFICIENT_NAMES[model]))
    )
    curve = ResponseCurve(
        draw(st.sampled_from(["linear", "srgb", "gamma"])),
        extra_gamma=draw(_floats(0.2, 5)),
        black_level=draw(_floats(0, 0.8)),
    )
    return CameraProfile(
        width,
        height,
        draw(st.text(st.characters(codec="utf-8", exclude_categories=("Cs", "Cc")), max_size=20)),
        draw(st.sampled_from([None, lens])),
        Shutter(
            *some(0, 1, 1), draw(st.sampled_from(READOUT_DIRECTIONS)), draw(st.sampled_from(sorted(STAMP_FRACTION)))
        ),
        r_cam_imu=FULL.r_cam_imu,
        p_cam_imu_m=some(-1, 1, 3),  # type: ignore[arg-type]
        time_offset_s=draw(st.one_of(st.none(), _floats(-1e3, 1e3))),
        clock_skew=draw(_floats(-0.4, 0.4)),
        gyro_bias_rad_s=some(-1, 1, 3),  # type: ignore[arg-type]
        gyro_scale=some(0.1, 2, 3),  # type: ignore[arg-type]
        response=draw(st.sampled_from([None, curve])),
        depth_m=draw(st.one_of(st.none(), st.just(math.inf), _floats(0.01, 1e4))),
        extensions=replace(
            FULL.extensions,
            gain=some(0.1, 3, draw(st.integers(0, 5))),
            gyro_averaging_s=draw(st.floats(0, 0.9)),
            gyro_misalignment_rad=some(-0.4, 0.4, 3),  # type: ignore[arg-type]
        ),
    )


@settings(max_examples=40, deadline=None)
@given(profile=_profiles())
def test_any_profile_survives_its_text(profile: CameraProfile) -> None:
    """The YAML text reproduces all values exactly."""
    assert parse_profile(yaml.safe_load(format_profile(profile))) == profile


def test_any_rotation_survives_its_text() -> None:
    """A rotation along no axis is reproduced to the last digits and stays orthogonal."""
    matrix = Rotation.from_rotvec([0.4, -1.3, 2.1]).as_matrix()
    profile = replace(FULL, r_cam_imu=tuple(map(tuple, matrix.tolist())))
    once = parse_profile(yaml.safe_load(format_profile(profile)))
    np.testing.assert_allclose(once.rotation_cam_imu, matrix, atol=1e-14)
    np.testing.assert_allclose(once.rotation_cam_imu @ once.rotation_cam_imu.T, np.eye(3), atol=1e-14)


def test_a_rounded_rotation_is_made_orthogonal() -> None:
    """A matrix written with four digits becomes the nearest rotation."""
    matrix = np.round(Rotation.from_rotvec([0.4, -1.3, 2.1]).as_matrix(), 4)
    rows = [[*row, 0.0] for row in matrix.tolist()] + [[0, 0, 0, 1]]
    found = _parse(f"imu: {{T_cam_imu: {rows}}}\n").rotation_cam_imu
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(found, matrix, atol=1e-4)


def test_numbers_in_other_notations_are_numbers() -> None:
    """YAML 1.1 reads 1e-3 as text; here it is a number, as in JSON."""
    profile = _parse("shutter: {readout_time_s: 1e-3}\nintrinsics: {fx_px: 1E3, cy_px: -2e+1}\n")
    assert profile.shutter.readout_time_s == 0.001
    assert profile.intrinsics is not None
    assert (profile.intrinsics.fx_px, profile.intrinsics.cy_px) == (1000.0, -20.0)


@pytest.mark.parametrize("word", ["inf", ".inf", "Infinity"])
def test_an_infinite_depth_is_accepted(word: str) -> None:
    """Only the depth may be infinite, in YAML's spelling and in ours, and it is written as "inf"."""
    profile = _parse(f"scene: {{depth_m: {word}}}\n")
    assert profile.depth_m == math.inf
    assert profile_mapping(profile)["scene"] == {"depth_m": "inf"}


def test_null_is_unknown() -> None:
    """A null readout, offset, curve, lens or depth is unknown; the readout time is then 0."""
    profile = _parse(
        "intrinsics: {fx_px: null, fy_px: null}\nshutter: {readout_time_s: null}\n"
        "imu: {T_cam_imu: null, time_offset_s: null}\nresponse: null\nscene: {depth_m: null}\n"
        "sensor: {width_mm: null}\nestimates: null\nextensions: null\n"
    )
    assert (profile.intrinsics, profile.response, profile.depth_m, profile.time_offset_s) == (None,) * 4
    assert (profile.readout_known, profile.shutter.readout_time_s) == (False, 0.0)
    assert profile.imu_time_s(2.0) == 2.0


@pytest.mark.parametrize(
    "text",
    [
        "device:",
        "intrinsics:",
        "intrinsics: {distortion: {model: radtan, k1: null}}",
        "shutter:",
        "shutter: {readout_direction: null, timestamp: null, exposure_scale: null}",
        "imu:",
        "sensor:",
        "scene:",
        "extensions: {focal_drift: null, stabilisation: {fraction: null}, response_gamma: null, gain: null}",
    ],
)
def test_a_null_that_cannot_be_estimated_gives_the_default(text: str) -> None:
    """A null block or value equals one that is left out."""
    assert _parse(text + "\n") == _parse("")


def test_nulls_of_the_gyroscope_are_open_until_they_are_estimated() -> None:
    """They hold their defaults, are written as null, and are known once they have an estimate."""
    text = "imu: {clock_skew: null, gyro_bias_rad_s: null}\n"
    profile = _parse(text)
    assert replace(profile, open_imu=()) == _parse("")
    assert profile.open_imu == ("clock_skew", "gyro_bias_rad_s")
    written = profile_mapping(profile)["imu"]
    assert [written[key] for key in ("clock_skew", "gyro_bias_rad_s", "gyro_scale")] == [None, None, [1.0] * 3]
    assert parse_profile(profile_mapping(profile)) == profile
    found = profile.with_estimate("clock_skew", 1e-4, 1e-5, "points", clock_skew=1e-4)
    assert found.open_imu == ("gyro_bias_rad_s",)
    assert profile_mapping(found)["imu"]["clock_skew"] == 1e-4


@pytest.mark.parametrize("text", ["scene: {dept_m: null}", "extensions: {gain: [1.0, null]}", "response: {kind: null}"])
def test_null_does_not_hide_an_error(text: str) -> None:
    """Unknown keys, null elements of a list and null for a required key are rejected."""
    with pytest.raises(SettingsError):
        _parse(text + "\n")


@pytest.mark.parametrize(
    "text",
    [
        "intrinsics: {cx_px: -1.0e+300}",
        "intrinsics: {fx_px: 100, distortion: {model: radtan, k1: -1.0e+300}}",
        "extensions: {focal_drift: {focal_drift_per_s: -100000}}",
        "extensions: {flicker: {phase_rad: 1.0e+300}}",
    ],
)
def test_numbers_that_overflow_are_refused(text: str) -> None:
    """They would otherwise fail during restoration or allocate huge arrays."""
    with pytest.raises(SettingsError):
        _parse(text + "\n")


def test_omitted_values_have_defaults() -> None:
    """One focal length holds for both axes, the principal point is the centre, and the axes are Android's."""
    profile = _parse("intrinsics: {fy_px: 70}\n")
    assert profile.intrinsics == Intrinsics(64, 48, 70.0, 70.0, 31.5, 23.5)
    np.testing.assert_array_equal(profile.rotation_cam_imu, np.diag([1, -1, -1]))


def test_focal_length_from_the_sensor_by_hand() -> None:
    """Eq 17: a focal length of 4 mm with a sensor of 6.4 mm × 4.0 mm gives 40 px and 48 px for 64 × 48 px."""
    lens = _parse("sensor: {width_mm: 6.4, height_mm: 4.0, focal_length_mm: 4}\n").intrinsics
    assert lens is not None
    assert (lens.fx_px, lens.fy_px) == (pytest.approx(40.0), pytest.approx(48.0))
    square = _parse("sensor: {height_mm: 4.0, focal_length_mm: 4}\n").intrinsics
    assert square is not None
    assert (square.fx_px, square.fy_px) == (pytest.approx(48.0), pytest.approx(48.0))


def test_curve_extensions_apply_to_the_default_curve() -> None:
    """A black level without a response curve applies to the default, sRGB."""
    profile = _parse("extensions: {black_level: 0.1, response_gamma: 1.2}\n")
    assert profile.response == ResponseCurve("srgb", extra_gamma=1.2, black_level=0.1)


def test_imu_time_is_skewed_then_shifted() -> None:
    """t_imu = t_cam (1 + clock_skew) + time_offset_s; computed by hand: 10 s · 1.001 − 0.25 s."""
    profile = CameraProfile(64, 48, clock_skew=1e-3, time_offset_s=-0.25)
    assert profile.imu_time_s(10.0) == pytest.approx(9.76)


def test_an_estimate_changes_the_value_and_records_its_source() -> None:
    """A fitted value is added with deviation and source; the original profile is unchanged."""
    changed = FULL.with_estimate("clock_skew", 2e-5, 1e-6, "fit", clock_skew=2e-5)
    assert changed.clock_skew == 2e-5
    assert changed.estimates["clock_skew"] == Estimate(2e-5, 1e-6, "fit")
    assert set(changed.estimates) == {*FULL.estimates, "clock_skew"}
    assert "clock_skew" not in FULL.estimates


# ── rejecting ────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("text", "key", "nearest"),
    [
        ("devize: x", "devize", "device"),
        ("shutter: {readout_s: 0.02}", "shutter.readout_s", "readout_time_s"),
        ("imu: {time_ofset_s: 0.02}", "imu.time_ofset_s", "time_offset_s"),
        ("intrinsics: {fx: 100}", "intrinsics.fx", "fx_px"),
        ("intrinsics: {distortion: {model: radtan, k7: 1}}", "intrinsics.distortion.k7", "k"),
        ("response: {kind: gamma, gama: 2}", "response.gama", "gamma"),
        ("extensions: {flickr: {}}", "extensions.flickr", "flicker"),
        ("extensions: {flicker: {amplitud: 0.1}}", "extensions.flicker.amplitud", "amplitude"),
        ("estimates: {fx_px: {value: 1, sdt: 2}}", "estimates.fx_px.sdt", "std"),
    ],
)
def test_the_error_for_an_unknown_key_suggests_the_nearest(text: str, key: str, nearest: str) -> None:
    """The error for a misspelt key names its path and the likely key."""
    with pytest.raises(SettingsError) as caught:
        _parse(text)
    assert f"unknown key '{key}'" in str(caught.value)
    assert f"did you mean '{nearest}" in str(caught.value)


def test_the_error_for_an_unrelated_key_lists_the_known_ones() -> None:
    """Without a similar key, the error lists the keys of that block."""
    with pytest.raises(SettingsError, match="known keys: depth_m"):
        _parse("scene: {zzzzzz: 1}")


WRONG = {
    "number for text": "device: 5",
    "date for text": "device: 2020-01-01",
    "text for number": "intrinsics: {fx_px: wide}",
    "list for number": "intrinsics: {fx_px: [1, 2]}",
    "true for number": "shutter: {readout_time_s: true}",
    "nan": "shutter: {readout_time_s: .nan}",
    "infinite readout": "shutter: {readout_time_s: .inf}",
    "decimal point missing": "intrinsics: {fx_px: 100, cx_px: 31500}",
    "picture behind the lens": "intrinsics: {fx_px: 100, fy_px: 1.0e-3}",
    "infinite focal length as text": "intrinsics: {fx_px: inf}",
    "nan depth": "scene: {depth_m: nan}",
    "depth behind": "scene: {depth_m: -1}",
    "negative readout": "shutter: {readout_time_s: -0.01}",
    "readout in ms": "shutter: {readout_time_s: 20}",
    "negative focal length": "intrinsics: {fx_px: -3}",
    "no exposure": "shutter: {exposure_scale: 0}",
    "endless number": "shutter: {readout_time_s: " + "9" * 400 + "}",
    "direction": "shutter: {readout_direction: up}",
    "stamp": "shutter: {timestamp: 17}",
    "two biases": "imu: {gyro_bias_rad_s: [0, 0]}",
    "gyroscope axes in one plane": "extensions: {gyro_misalignment_rad: [0.9, 0, 0]}",
    "two misalignments": "extensions: {gyro_misalignment_rad: [0.01, 0]}",
    "averaging in ms": "extensions: {gyro_averaging_s: 12}",
    "text in bias": "imu: {gyro_bias_rad_s: [0, 0, x]}",
    "skew": "imu: {clock_skew: 2}",
    "zero gyro scale": "imu: {T_cam_imu: [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]], gyro_scale: [1, 0, 1]}",
    "zero gyro scale, axes unknown": "imu: {gyro_scale: [1, 0, 1]}",
    "three columns": "imu: {T_cam_imu: [[1,0,0],[0,1,0],[0,0,1]]}",
    "scaled": "imu: {T_cam_imu: [[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]}",
    "mirrored": "imu: {T_cam_imu: [[1,0,0,0],[0,1,0,0],[0,0,-1,0],[0,0,0,1]]}",
    "ragged": "imu: {T_cam_imu: [[1,0,0,0],[0,1],[0,0,1,0],[0,0,0,1]]}",
    "version": "virest_profile: 2",
    "small picture": "image: {width: 4, height: 48}",
    "no height": "image: {width: 64}",
    "curve": "response: {kind: log}",
    "curve without knots": "response: {kind: five_segment}",
    "falling curve": "response: {kind: five_segment, b: [0.5, 0.1], c: [0.2, 0.8]}",
    "table beyond 1": "response: {kind: table, x: [0, 1], y: [0, 255]}",
    "table of one list": "response: {kind: table, x: [0, 1]}",
    "foreign coefficient": "intrinsics: {fx_px: 9, distortion: {model: fisheye, p1: 0.1}}",
    "lens": "intrinsics: {fx_px: 9, distortion: {model: brown}}",
    "full black": "extensions: {black_level: 1}",
    "negative gain": "extensions: {gain: [1, -1]}",
    "gamma": "extensions: {response_gamma: 50}",
    "lag in text": "extensions: {frame_lag: {frames: many}}",
    "key that is a number": "1: 2",
    "key of two lines": '"a\\nb": 1',
    "value of two lines": 'shutter: {timestamp: "a\\nb"}',
}


@pytest.mark.parametrize("text", [pytest.param(text, id=name) for name, text in WRONG.items()])
def test_wrong_values_are_refused_in_one_line(text: str, tmp_path: Path) -> None:
    """A value of the wrong type, shape or range is a settings error of one line that names the file."""
    base = "\n".join(line for line in SMALL.splitlines() if line.split(":")[0] != text.split(":")[0])
    with pytest.raises(SettingsError) as caught:
        _read(tmp_path, f"{base}\n{text}\n")
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    assert message.startswith("camera.yaml")
    assert len(message) < 400


@pytest.mark.parametrize(
    "content",
    [
        pytest.param("", id="empty"),
        pytest.param("- 1\n- 2\n", id="list"),
        pytest.param("just words", id="words"),
        pytest.param("image: {width: 64\n", id="cut"),
        pytest.param("a:\tb: c", id="not yaml"),
        pytest.param(b"\x00\x01\x02", id="control bytes"),
        pytest.param(b"\xff\xfe\xfa\xc3", id="binary"),
        pytest.param(b"\x89PNG\r\n\x1a\n" + bytes(range(256)), id="png"),
        pytest.param(SMALL + "---\n" + SMALL, id="two documents"),
        pytest.param(SMALL + 'device: !!python/object/apply:os.system ["exit 1"]\n', id="python tag"),
        pytest.param(SMALL + "device: !mine x\n", id="own tag"),
        pytest.param(SMALL + "estimates: {a: &x {value: 1}, b: *x}\n", id="alias"),
        pytest.param(SMALL + "estimates: {a: &x {value: 1}, b: {<<: *x}}\n", id="merge"),
        pytest.param(SMALL + "device: 2020-13-99\n", id="impossible date"),
        pytest.param(SMALL + "x: " + "{a: " * 2000 + "1" + "}" * 2000, id="deep"),
    ],
)
def test_a_file_that_is_not_a_plain_profile_is_refused(content: str | bytes, tmp_path: Path) -> None:
    """Empty, binary, truncated and hostile files give one line and no traceback."""
    with pytest.raises(SettingsError, match=r"camera\.yaml") as caught:
        _read(tmp_path, content)
    assert len(str(caught.value).splitlines()) == 1


def test_a_yaml_bomb_is_refused(tmp_path: Path) -> None:
    """Ten levels of ten aliases would give 10¹⁰ values; the first alias is rejected."""
    levels = ["a0: &a0 [x]"] + [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 11)]
    with pytest.raises(SettingsError, match="aliases"):
        _read(tmp_path, "\n".join(levels))


def test_files_that_are_too_large_missing_or_folders_are_refused(tmp_path: Path) -> None:
    """The message names the path and the reason."""
    (tmp_path / "large.yaml").write_bytes(b"#" * 1_000_001)
    with pytest.raises(SettingsError, match=r"large\.yaml: 1000001 bytes"):
        read_profile(tmp_path / "large.yaml")
    with pytest.raises(SettingsError, match=r"none\.yaml: no such file"):
        read_profile(tmp_path / "none.yaml")
    with pytest.raises(SettingsError, match="is not a regular file"):
        load_yaml_mapping(tmp_path)


@pytest.mark.parametrize("twice", ["device: a\ndevice: b\n", "imu: {clock_skew: 0.0, clock_skew: 0.001}\n"])
def test_a_repeated_key_is_refused(tmp_path: Path, twice: str) -> None:
    """A repeated block is a mistake; neither copy is used silently."""
    path = tmp_path / "camera.yaml"
    path.write_text("virest_profile: 1\nimage: {width: 64, height: 48}\n" + twice)
    with pytest.raises(SettingsError, match=r"camera\.yaml: line \d: '(device|clock_skew)' is written a second time"):
        read_profile(path)


def test_reading_does_not_change_the_mapping() -> None:
    """The caller's mapping stays unchanged."""
    content: dict[str, Any] = yaml.safe_load(CONTRACT_EXAMPLE)
    parse_profile(content)
    assert content == yaml.safe_load(CONTRACT_EXAMPLE)


def test_centre_and_distortion_stay_while_the_focal_length_is_unknown():
    """A null fx keeps cx, cy and the distortion, which a focal length estimated later uses."""
    lens = {"fx_px": None, "fy_px": None, "cx_px": 301.0, "cy_px": 250.5, "distortion": {"model": "radtan", "k1": -0.1}}
    profile = parse_profile({"virest_profile": 1, "image": {"width": 640, "height": 480}, "intrinsics": lens})
    assert profile.intrinsics is None
    written = profile_mapping(profile)["intrinsics"]
    assert (written["fx_px"], written["cx_px"], written["cy_px"]) == (None, 301.0, 250.5)
    found = profile.with_focal(512.0, 3.0, "points").intrinsics
    assert found is not None
    assert (found.fx_px, found.fy_px, found.cx_px, found.cy_px) == (512.0, 512.0, 301.0, 250.5)
    assert found.coefficients[0] == -0.1


def test_a_file_with_opencvs_first_line_is_read(tmp_path: Path):
    """OpenCV writes ``%YAML:1.0``, which is not valid YAML; line numbers in messages stay right."""
    path = tmp_path / "camera.yaml"
    path.write_text("%YAML:1.0\n---\nvirest_profile: 1\nimage: {width: 640, height: 480}\n")
    assert read_profile(path).width == 640
    path.write_text("%YAML:1.0\n---\nvirest_profile: [1\n")
    with pytest.raises(SettingsError, match="line 4"):
        read_profile(path)
