"""Kalibr's camera chain as a profile."""

import pytest
import yaml

from virest.camera.kalibr import is_kalibr, parse_camchain
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
    """Intrinsics, distortion, pose, time shift and line delay arrive in the profile."""
    path = tmp_path / "camchain-imucam.yaml"
    path.write_text(yaml.safe_dump(CHAIN))
    profile = read_any_profile(path)
    assert (profile.width, profile.height) == (1280, 720)
    assert profile.intrinsics.coefficients == (0.1, -0.2, 0.001, 0.002, 0.0)
    assert profile.intrinsics.fy_px == 913.0
    assert profile.time_offset_s == -0.0123
    assert profile.p_cam_imu_m == (0.01, 0.02, 0.0)
    assert profile.shutter.readout_time_s == pytest.approx(0.02016)


def test_an_equidistant_lens_is_our_fisheye():
    """Kalibr's equidistant model is the Kannala-Brandt fisheye."""
    chain = {"cam0": {**CHAIN["cam0"], "distortion_model": "equidistant"}}
    assert parse_camchain(chain).intrinsics.model == "fisheye"


@pytest.mark.parametrize("key", ["resolution", "intrinsics", "distortion_coeffs"])
def test_a_missing_key_is_named(key):
    """A chain that lacks a needed key is refused with that key's name."""
    chain = {"cam0": {k: v for k, v in CHAIN["cam0"].items() if k != key}}
    with pytest.raises(SettingsError, match=key):
        parse_camchain(chain)


def test_our_own_profile_is_no_camchain():
    """A profile of ours is never taken for a camera chain."""
    assert is_kalibr(CHAIN)
    assert not is_kalibr({"virest_profile": 1})
