"""Reading and writing Kalibr's files."""

from dataclasses import replace

import numpy as np
import pytest
import yaml

from virest.camera.intrinsics import Intrinsics
from virest.camera.kalibr import (
    ImuNoise,
    format_camchain,
    format_imu,
    is_kalibr,
    parse_camchain,
    parse_imu,
)
from virest.camera.profile import CameraProfile, Extensions
from virest.camera.response import ResponseCurve
from virest.camera.shutter import Shutter
from virest.capture.profile_source import read_any_profile
from virest.errors import SettingsError

CHAIN = {
    "cam0": {
        "T_cam_imu": [[0.0, -1.0, 0.0, 0.01], [-1.0, 0.0, 0.0, 0.02], [0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
        "camera_model": "pinhole",
        "distortion_coeffs": [0.1, -0.2, 0.001, 0.002],
        "distortion_model": "radtan",
        "intrinsics": [911.0, 913.0, 640.5, 361.5],
        "line_delay_nanoseconds": 28000,
        "resolution": [1280, 720],
        "timeshift_cam_imu": -0.0123,
    }
}


def test_a_camchain_file_becomes_a_profile(tmp_path):
    """The profile has the file's intrinsics, distortion, pose, time shift and line delay."""
    path = tmp_path / "camchain-imucam.yaml"
    path.write_text(yaml.safe_dump(CHAIN))
    profile = read_any_profile(path)
    assert (profile.width, profile.height) == (1280, 720)
    assert profile.intrinsics.coefficients == (0.1, -0.2, 0.001, 0.002, 0.0)
    assert profile.intrinsics.fy_px == 913.0
    assert profile.time_offset_s == -0.0123
    assert profile.p_cam_imu_m == (0.01, 0.02, 0.0)
    assert profile.shutter.readout_time_s == pytest.approx(0.02016)


def test_an_equidistant_lens_is_read_as_fisheye():
    """Kalibr's equidistant model is the Kannala–Brandt fisheye."""
    chain = {"cam0": {**CHAIN["cam0"], "distortion_model": "equidistant"}}
    assert parse_camchain(chain).intrinsics.model == "fisheye"


@pytest.mark.parametrize("key", ["resolution", "intrinsics", "distortion_coeffs"])
def test_a_missing_key_is_named(key):
    """A chain without a required key is rejected, and the error names the key."""
    chain = {"cam0": {k: v for k, v in CHAIN["cam0"].items() if k != key}}
    with pytest.raises(SettingsError, match=key):
        parse_camchain(chain)


def test_a_virest_profile_is_not_a_camchain():
    """A virest profile is never read as a camera chain."""
    assert is_kalibr(CHAIN)
    assert not is_kalibr({"virest_profile": 1})


# ── written ──────────────────────────────────────────────────────────────────────────────────────────────────────

LENS = Intrinsics(1280, 720, 911.0, 913.5, 640.25, 361.75, "radtan", (0.11, -0.23, 0.0013, -0.0024, 0.0))
PROFILE = CameraProfile(
    1280,
    720,
    intrinsics=LENS,
    shutter=Shutter(0.0217, "top_to_bottom"),
    r_cam_imu=((0.0, -1.0, 0.0), (-0.6, 0.0, 0.8), (-0.8, 0.0, -0.6)),
    p_cam_imu_m=(0.011, -0.023, 0.0034),
    time_offset_s=-0.0173,
)


def reread(text: str) -> CameraProfile:
    """Parse a written chain."""
    return parse_camchain(yaml.safe_load(text))


def comments(text: str) -> str:
    """All comments of a file."""
    return "\n".join(line for line in text.splitlines() if line.startswith("#"))


@pytest.mark.parametrize(
    "lens",
    [
        LENS,
        replace(LENS, model="none", coefficients=()),
        replace(LENS, model="fisheye", coefficients=(0.02, -0.013, 0.0057, -0.0011)),
    ],
    ids=["radtan", "none", "fisheye"],
)
def test_a_written_camchain_reads_back_the_same(lens):
    """Lens, pose, offset and a top-to-bottom readout are written and read without loss."""
    back = reread(format_camchain(replace(PROFILE, intrinsics=lens)))
    assert back.intrinsics == lens
    assert back.p_cam_imu_m == PROFILE.p_cam_imu_m
    assert back.time_offset_s == PROFILE.time_offset_s
    assert back.shutter.readout_time_s == pytest.approx(0.0217, rel=1e-12)
    assert back.shutter.readout_direction == "top_to_bottom"
    np.testing.assert_allclose(back.rotation_cam_imu, PROFILE.rotation_cam_imu, atol=1e-12)


def test_the_line_delay_is_the_readout_of_one_row():
    """21.7 ms over 720 rows, in nanoseconds."""
    camera = yaml.safe_load(format_camchain(PROFILE))["cam0"]
    assert camera["line_delay_nanoseconds"] == pytest.approx(30138.889, rel=1e-6)


@pytest.mark.parametrize("direction", ["bottom_to_top", "left_to_right", "right_to_left"])
def test_an_unsupported_readout_direction_is_written_as_global(direction):
    """The global shutter has the time of the middle row, and a comment names the direction."""
    text = format_camchain(replace(PROFILE, shutter=Shutter(0.0217, direction)))
    assert direction in comments(text)
    assert "line_delay_nanoseconds" not in yaml.safe_load(text)["cam0"]
    back = reread(text)
    assert not back.readout_known
    assert back.time_offset_s == pytest.approx(-0.0173 + 0.0217 / 2)


def test_a_timestamp_at_exposure_end_is_shifted_to_exposure_start():
    """A Kalibr chain is read as exposure_start: the shift subtracts a true exposure; a comment gives half of it."""
    shutter = replace(PROFILE.shutter, timestamp="exposure_end", exposure_scale=1.5)
    text = format_camchain(replace(PROFILE, shutter=shutter), exposure_s=0.008)
    assert reread(text).time_offset_s == pytest.approx(-0.0173 - 0.012)
    assert "6 ms later" in comments(text)


def test_unsupported_values_are_named_in_comments():
    """A camera chain cannot hold the curve, clock skew, bias, third radial coefficient or extensions."""
    rich = replace(
        PROFILE,
        intrinsics=replace(LENS, coefficients=(0.11, -0.23, 0.0013, -0.0024, 0.031)),
        clock_skew=2e-4,
        gyro_bias_rad_s=(0.01, -0.02, 0.003),
        response=ResponseCurve("srgb"),
        extensions=Extensions(focal_drift_per_s=0.01),
    )
    said = comments(format_camchain(rich))
    for word in ("k3: 0.031", "clock_skew", "gyro_bias_rad_s", "srgb", "extensions"):
        assert word in said
    plain = comments(format_camchain(PROFILE))
    assert not any(word in plain for word in ("clock_skew", "gyro_bias_rad_s", "response curve", "extensions"))


def test_unknown_values_are_left_out_and_an_unknown_lens_is_refused():
    """No offset or readout is invented; a chain requires a focal length."""
    back = reread(format_camchain(replace(PROFILE, time_offset_s=None, readout_known=False, shutter=Shutter())))
    assert back.time_offset_s is None
    assert not back.readout_known
    with pytest.raises(SettingsError, match="focal length"):
        format_camchain(replace(PROFILE, intrinsics=None))


# ── imu.yaml ─────────────────────────────────────────────────────────────────────────────────────────────────────

NOISE = ImuNoise(198.5, 1.7e-4, 2.3e-3, 3.1e-6, 7.7e-5, "/phone/imu")


def test_a_written_imu_yaml_reads_back_the_same():
    """Five numbers and the topic, including small numbers that YAML 1.1 would read as text."""
    assert parse_imu(yaml.safe_load(format_imu(NOISE))) == NOISE


def test_kalibr_s_own_imu_result_is_read():
    """Kalibr writes the same keys below ``imu0``, beside others that are ignored."""
    block = {"T_i_b": [[1, 0, 0, 0]], "gyroscope_noise_density": "1e-4", "update_rate": 400, "rostopic": "/imu"}
    read = parse_imu({"imu0": block})
    assert (read.update_rate_hz, read.gyro_density, read.accel_density, read.topic) == (400.0, 1e-4, None, "/imu")


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ({"gyroscope_noise_density": 1e-4}, "update_rate"),
        ({"update_rate": 0}, "update_rate"),
        ({"update_rate": 200, "accelerometer_noise_density": "loud"}, "accelerometer_noise_density"),
        ({"update_rate": True}, "update_rate"),
        ({"imu0": [1, 2]}, "imu0"),
    ],
)
def test_the_error_for_a_faulty_imu_yaml_names_the_key(content, says):
    """The value is missing, zero or not a number."""
    with pytest.raises(SettingsError, match=says):
        parse_imu(content)


def test_an_unknown_random_walk_gets_a_default_and_a_comment():
    """Kalibr needs random walks, which a short capture does not determine. An unknown noise density is left out."""
    text = format_imu(ImuNoise(100.0, 1e-4, None))
    content = yaml.safe_load(text)
    assert content["gyroscope_random_walk"] > 0
    assert "not measured" in text
    assert "accelerometer_noise_density" not in content
