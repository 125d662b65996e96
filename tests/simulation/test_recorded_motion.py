"""Re-creation of a capture with its own motion, times and exposures, in front of one of its own pictures."""

import dataclasses
import json

import numpy as np
import pytest
import yaml
from capture_files import SMALL, read_imu, read_movie, read_stamps
from scipy.spatial.transform import Rotation

from virest.app import cli
from virest.app.recreate import simulate_like
from virest.app.simulate import simulate_command
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile, Extensions
from virest.camera.profile_file import read_profile
from virest.capture.folder import read_capture
from virest.capture.records import Frame
from virest.errors import CaptureError, ImuError, OutputError, SettingsError
from virest.simulation.hand_motion import random_hand_motion
from virest.simulation.recorded_motion import recorded_motion, recorded_rate
from virest.simulation.recreation import from_frame, known_frames

LIVELY = {**SMALL, "width": 160, "height": 128, "frames": 7, "noise_levels": 0.5, "crf": 12.0}
TILTED = tuple(map(tuple, Rotation.from_rotvec([0.4, -0.9, 1.3]).as_matrix().tolist()))
PROFILE = CameraProfile(
    160,
    128,
    intrinsics=Intrinsics(160, 128, 130.0, 134.0, 78.0, 65.0),
    r_cam_imu=TILTED,
    time_offset_s=0.004,
    clock_skew=3e-4,
    gyro_bias_rad_s=(0.02, -0.01, 0.03),
    gyro_scale=(1.02, 0.99, 1.01),
)


@pytest.fixture(scope="module")
def lively(tmp_path_factory):
    """A capture in which the camera turns by several pixels per frame."""
    folder = tmp_path_factory.mktemp("like") / "lively"
    simulate_command(folder, **LIVELY)
    return folder


def test_a_motion_is_recovered_from_its_samples(rng):
    """Sampled at 200 Hz with scale, bias and rotated axes, a hand's turns are recovered within 0.1 mrad."""
    hand = random_hand_motion(rng, rate_rms_rad_s=1.5, duration_s=1.0)
    sample_s = np.arange(-0.8, 1.8, 0.005)
    measured = hand.rate_rad_s(sample_s) @ np.array(TILTED) * PROFILE.gyro_scale + PROFILE.gyro_bias_rad_s
    again = recorded_motion(sample_s, measured, PROFILE, 0.3)
    time_s = np.linspace(0.0, 1.0, 77)
    expected = hand.rotation(np.array([0.3])).inv() * hand.rotation(time_s)
    assert np.abs((expected.inv() * again.rotation(time_s)).as_rotvec()).max() < 1e-4
    np.testing.assert_allclose(again.rate_rad_s(time_s), hand.rate_rad_s(time_s), atol=0.02)
    assert not again.position_m(time_s).any()


def test_a_rate_is_held_outside_its_samples(rng):
    """Outside the samples the rate is constant; inside a gap it does not overshoot by large factors."""
    sample_s = np.array([0.0, 0.005, 0.01, 0.4, 0.405, 0.412])
    rate = recorded_rate(sample_s, rng.normal(size=(6, 3)), dataclasses.replace(PROFILE, r_cam_imu=np.eye(3).tolist()))
    at = rate.at(sample_s)
    np.testing.assert_allclose(rate.at(np.array([-1.0, 9.0])), at[[0, -1]])
    assert not rate.at(np.array([-1.0, 9.0]), derivative=1).any()
    gap = rate.at(np.linspace(0.01, 0.4, 50))
    assert np.abs(gap).max() < 40 * np.abs(at).max()


def test_a_single_sample_is_refused():
    """The error gives the number of samples."""
    with pytest.raises(ImuError, match="1 gyroscope"):
        recorded_rate(np.zeros(1), np.zeros((1, 3)), PROFILE)


def test_a_profile_counted_from_a_later_frame_is_equivalent():
    """Clock, focal drift, flicker, gains and lag describe the same instants after the first frames are cut off."""
    extensions = Extensions(
        focal_drift_per_s=0.02, flicker_amplitude=0.2, flicker_frequency_hz=97.0, flicker_phase_rad=0.7,
        gain=(1.0, 1.1, 0.9, 1.2), frame_lag_s=0.2, frame_lag_frames=4,
    )  # fmt: skip
    whole = dataclasses.replace(PROFILE, extensions=extensions, depth_m=2.0)
    frames = [Frame(k, 0, 1.3 + 0.03 * k, 0.01) for k in (2, 3)]
    cut, later = from_frame(whole, frames), frames[0].time_s
    time_s = np.linspace(1.0, 2.0, 5)
    np.testing.assert_allclose(cut.imu_time_s(time_s - later), whole.imu_time_s(time_s) - later, rtol=0, atol=1e-12)
    ext = cut.extensions
    focal = cut.intrinsics.fx_px * (1 + ext.focal_drift_per_s * (time_s - later))
    np.testing.assert_allclose(focal, 130.0 * (1 + 0.02 * time_s), rtol=1e-12)
    phase = 2 * np.pi * 97.0 * (time_s - later) + ext.flicker_phase_rad
    np.testing.assert_allclose(np.sin(phase), np.sin(2 * np.pi * 97.0 * time_s + 0.7), atol=1e-9)
    assert ext.gain == (0.9, 1.2)
    assert (ext.frame_lag_s, ext.frame_lag_frames) == (0.1, 2)
    assert np.isinf(cut.depth_m)


def test_frames_with_unknown_motion_are_left_out():
    """Start-up frames are re-created; a frame inside a gap of the inertial data is not."""
    frames = [Frame(0, 0, 0.0, skip_reason="late", skip_codes=("start-up",)), Frame(1, 1, 0.1)]
    hole = Frame(2, 2, 0.2, skip_reason="hole", skip_codes=("imu-gap",))
    assert known_frames([*frames, hole]) == tuple(frames)


def test_a_recreated_capture_has_the_same_data_and_similar_pictures(lively, tmp_path):
    """Samples and timestamps are equal; pictures differ by a small part of the change by motion."""
    again = tmp_path / "again"
    facts = simulate_like(again, lively, noise_levels=0.5)
    assert facts["frames"] == 7
    for mine, own in zip(read_imu(again), read_imu(lively), strict=True):
        np.testing.assert_array_equal(mine, own)
    np.testing.assert_array_equal(read_stamps(again), read_stamps(lively))
    old, new = read_capture(lively), read_capture(again)
    assert [f.exposure_s for f in new.frames] == [f.exposure_s for f in old.frames]
    assert read_profile(again / "camera.yaml") == read_profile(lively / "camera.yaml")
    (measured, old_s), (simulated, new_s) = read_movie(lively), read_movie(again)
    np.testing.assert_allclose(new_s, old_s, atol=2e-5)
    inner = (slice(None), slice(24, -24), slice(24, -24))
    apart = np.abs(measured[inner].astype(float) - simulated[inner]).mean(axis=(1, 2))
    moved = np.abs(np.diff(measured[inner].astype(float), axis=0)).mean()
    assert np.median(apart) < 0.3 * moved
    assert apart.max() < 0.6 * moved


def test_an_effect_can_be_hidden_in_a_partly_recreated_capture(lively, tmp_path):
    """Only the truth folder's profile has the effect, and the scene stays in front of the camera."""
    again = tmp_path / "again"
    facts = simulate_like(again, lively, frames=slice(2, 6), effects=["readout_time=0.009"], seed=5)
    assert facts["frames"] == 4
    assert read_stamps(again).tolist() == read_stamps(lively)[2:6].tolist()
    assert read_profile(again / "camera.yaml").shutter.readout_time_s == pytest.approx(0.018)
    assert read_profile(again / "truth/camera.yaml").shutter.readout_time_s == pytest.approx(0.009)
    assert json.loads((again / "truth/effects.json").read_text())["effects"][0]["name"] == "readout_time"
    assert len(list((again / "truth/frames").iterdir())) == 4
    assert all(frame.skip_reason is None for frame in read_capture(again).frames)


def test_brighter_exposures_make_brighter_pictures(simulate, tmp_path):
    """The light of a re-creation follows the logged exposure × ISO."""
    bracket = simulate("bracket", auto_exposure_ev=2.0, auto_exposure_steps=2, rate_rad_s=0.3, frames=6)
    again = tmp_path / "again"
    simulate_like(again, bracket)
    levels = [[plane.mean() for plane in read_movie(folder)[0]] for folder in (bracket, again)]
    assert levels[0][-1] > levels[0][0] + 25
    np.testing.assert_allclose(levels[1], levels[0], atol=6)


def test_a_view_beyond_the_scene_is_refused(simulate, tmp_path):
    """One picture has no scene behind the camera; the hint names --frames."""
    spinning = simulate("spinning", gyro_noise_rad_s=0.0)
    table = (spinning / "gyro_accel.csv").read_text().splitlines()
    rows = [row.split(",") for row in table[1:]]
    text = "\n".join([table[0], *(",".join([row[0], "0.0", "25.0", "0.0", *row[4:]]) for row in rows)])
    (spinning / "gyro_accel.csv").write_text(text + "\n")
    with pytest.raises(CaptureError, match="degrees") as error:
        simulate_like(tmp_path / "again", spinning)
    assert "--frames" in error.value.hint
    assert not (tmp_path / "again").exists()


def test_an_invalid_recreation_is_refused(lively, tmp_path):
    """The capture itself as output, steps between frames, and a range without frames are refused.

    A changed exposure scale in the profile is accepted.
    """
    with pytest.raises(OutputError):
        simulate_like(lively, lively)
    with pytest.raises(SettingsError, match="consecutive frames"):
        simulate_like(tmp_path / "a", lively, frames=slice(0, 6, 2))
    with pytest.raises(CaptureError, match="no frame"):
        simulate_like(tmp_path / "a", lively, frames=slice(90, 95))
    content = yaml.safe_load((lively / "camera.yaml").read_text())
    content["shutter"]["exposure_scale"] = 1.5
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump(content))
    facts = simulate_like(tmp_path / "a", lively, config=tmp_path / "camera.yaml", frames=slice(0, 2))
    assert facts["blur_px"] > 0


def test_the_command_recreates_a_capture(lively, tmp_path, capfd):
    """``--like`` uses the capture's camera and times, and ``--frames A:B`` selects frames.

    Options that would be ignored end with 2, a folder without a capture with 4, and an unknown effect with 3.
    """
    again = tmp_path / "again"
    assert cli.run(["simulate", str(again), "--like", str(lively), "--frames", "1:4", "--json"]) == 0
    facts = json.loads(capfd.readouterr().out)
    assert (facts["frames"], facts["width"], facts["effects"]) == (3, 160, [])
    assert cli.run(["simulate", str(again), "--like", str(lively)]) == 8
    assert cli.run(["simulate", str(again), "--like", str(lively), "--frames", "2", "--overwrite"]) == 0
    assert len(read_stamps(again)) == 2
    for arguments, code in (
        (["--like", str(lively), "--width", "320"], 2),
        (["--like", str(tmp_path / "nowhere")], 4),
        (["--frames", "1:4"], 2),
        (["--like", str(lively), "--frames", "a:b"], 2),
        (["--like", str(lively), "--effect", "flikker"], 3),
    ):
        assert cli.run(["simulate", str(tmp_path / "none"), *arguments]) == code, arguments
    assert not (tmp_path / "none").exists()
