"""Hidden effects: each changes its own fields of the profile, and nothing visible outside truth/."""

import dataclasses
import json

import numpy as np
import pytest
from capture_files import SMALL, read_imu, read_movie

from virest.camera.profile import CameraProfile
from virest.camera.profile_file import profile_mapping, read_profile
from virest.errors import SettingsError
from virest.simulation.effects import EFFECTS, EffectContext, hide_effects
from virest.simulation.hand_motion import random_hand_motion
from virest.simulation.hidden import Hidden, from_gyro_reading, gyro_reading, shaded
from virest.simulation.phone_gyro import averaging_window_s, before_filter, filtered_rate
from virest.simulation.session import SessionSettings, nominal_camera, plan_session, render_truth

CHANGES = {
    "time_offset": "imu.time_offset_s",
    "clock_skew": "imu.clock_skew",
    "readout_time": "shutter.readout_time_s",
    "readout_direction": "shutter.readout_direction",
    "timestamp_reference": "shutter.timestamp",
    "exposure_time": "shutter.exposure_scale",
    "gyro_bias": "imu.gyro_bias_rad_s",
    "gyro_scale": "imu.gyro_scale",
    "gyro_axes": "imu.gyro_scale extensions.gyro_misalignment_rad",
    "gyro_lowpass": "extensions.gyro_lowpass_hz",
    "gyro_averaging": "extensions.gyro_averaging_s",
    "imu_rotation": "imu.T_cam_imu",
    "focal_length": "intrinsics.fx_px intrinsics.fy_px",
    "pixel_aspect": "intrinsics.fy_px",
    "focal_drift": "extensions.focal_drift",
    "radial_distortion": "intrinsics.distortion",
    "higher_distortion": "intrinsics.distortion",
    "principal_point": "intrinsics.cx_px intrinsics.cy_px",
    "stabilisation": "extensions.stabilisation",
    "scene_depth": "scene.depth_m",
    "frame_lag": "extensions.frame_lag",
    "response_curve": "extensions.response_gamma",
    "black_level": "extensions.black_level",
    "vignetting": "extensions.vignetting",
    "flicker": "extensions.flicker",
    "gain_drift": "extensions.gain",
    "defocus": "extensions.defocus",
    "sharpening": "",
}
"""Each effect with the profile keys it changes; processing of finished pictures is in no profile."""
SEEN_OUTSIDE = ("camera.yaml", "edge_epochs.txt", "frame_timestamps.txt", "movie_metadata.csv")


def context(seed=0, frames=20):
    """The context that default sizes depend on."""
    return EffectContext(frames, 30.0, np.random.default_rng(seed))


def flat(profile):
    """The profile's keys, two levels deep, as text."""
    keys = {}
    for name, block in profile_mapping(profile).items():
        for key, value in block.items() if isinstance(block, dict) else [("", block)]:
            keys[f"{name}.{key}"] = str(value)
    return keys


def test_the_effect_names_are_the_documented_ones():
    """No other names exist."""
    assert set(EFFECTS) == set(CHANGES)


@pytest.mark.parametrize("name", CHANGES)
def test_an_effect_changes_only_its_own_fields(name):
    """The true profile differs from the nominal one in the documented fields, for several seeds."""
    nominal = nominal_camera(360, 640)
    for seed in range(5):
        true, applied = hide_effects(nominal, [name], context(seed))
        before, after = flat(nominal), flat(true)
        changed = {key for key in before.keys() | after.keys() if before.get(key) != after.get(key)}
        assert changed == set(CHANGES[name].split())
        assert applied[0].name == name


@pytest.mark.parametrize(
    ("text", "place", "value"),
    [
        ("time_offset=-0.0123", "imu.time_offset_s", "-0.0123"),
        ("readout-time=0.031", "shutter.readout_time_s", "0.031"),
        ("gyro_bias=0.01,-0.02,0.03", "imu.gyro_bias_rad_s", "[0.01, -0.02, 0.03]"),
        ("gyro_scale=1.05", "imu.gyro_scale", "[1.05, 1.05, 1.05]"),
        ("timestamp_reference=exposure_end", "shutter.timestamp", "exposure_end"),
        ("focal_length=0.9", "intrinsics.fx_px", str(0.9 * 512.0)),
        ("scene_depth=inf", "scene.depth_m", "inf"),
        ("frame_lag=0.2,15", "extensions.frame_lag", "{'lag_s': 0.2, 'frames': 15}"),
        ("gain_drift=1,1.5,0.8", "extensions.gain", "[1.0, 1.5, 0.8]"),
    ],
)
def test_given_values_are_used_unchanged(text, place, value):
    """``NAME=VALUE`` sets exactly that value."""
    frames = 3 if text.startswith("gain_drift") else 20
    assert flat(hide_effects(nominal_camera(360, 640), [text], context(frames=frames))[0])[place] == value


def test_imu_rotation_multiplies_on_the_left():
    """A turn of 90° about camera z takes the camera's x to y: R = exp(r) R_nominal."""
    true, _ = hide_effects(nominal_camera(360, 640), ["imu_rotation=0,0,1.5707963267948966"], context())
    assert np.array(true.r_cam_imu) == pytest.approx(np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]]), abs=1e-12)


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("time_ofset", "did you mean 'time_offset'"),
        ("gyro_bias=0.1", "takes 3"),
        ("readout_direction=sideways", "top_to_bottom"),
        ("flicker=much", "not a number"),
        ("focal_length=inf", "not a finite number"),
        ("gain_drift=1,1.1,0.9", "3 factors for 20 frames"),
        ("gain_drift=1e9", "too much"),
    ],
)
def test_an_invalid_effect_is_refused_with_a_hint(text, part):
    """Unknown names, wrong counts and invalid values raise a settings error with a hint."""
    with pytest.raises(SettingsError) as caught:
        hide_effects(nominal_camera(360, 640), [text], context())
    assert part in str(caught.value)


@pytest.mark.parametrize("name", [n for n in CHANGES if n not in ("scene_depth", "readout_direction")])
def test_a_hidden_effect_cannot_be_read_outside_truth(name, plain_capture, simulate):
    """Profile, timestamps, metadata and clocks equal those of the capture without the effect; truth/ names it."""
    folder = simulate("hidden", effects=[name], frames=5)
    for file in SEEN_OUTSIDE:
        assert (folder / file).read_bytes() == (plain_capture / file).read_bytes(), file
    told = json.loads((folder / "truth" / "effects.json").read_text())
    assert [effect["name"] for effect in told["effects"]] == [name]
    true, nominal = (read_profile(folder / place / "camera.yaml") for place in ("truth", "."))
    assert (true != nominal) == bool(CHANGES[name])


@pytest.mark.parametrize("name", ["gyro_bias", "gyro_scale", "imu_rotation"])
def test_imu_effects_do_not_change_the_pictures(name, plain_capture, simulate):
    """The movie has the same bytes; the gyroscope data differ."""
    folder = simulate("imu", effects=[name])
    assert (folder / "movie.mp4").read_bytes() == (plain_capture / "movie.mp4").read_bytes()
    assert np.abs(read_imu(folder)[1] - read_imu(plain_capture)[1]).max() > 0.01


@pytest.mark.parametrize(
    "name", ["time_offset", "readout_time", "timestamp_reference", "exposure_time", "focal_length", "radial_distortion",
             "stabilisation", "vignetting", "flicker", "gain_drift", "defocus", "black_level", "clock_skew=0.02"]
)  # fmt: skip
def test_camera_effects_do_not_change_the_imu(name, plain_capture, simulate):
    """The inertial data have the same bytes; the movie differs."""
    folder = simulate("camera", effects=[name])
    assert (folder / "gyro_accel.csv").read_bytes() == (plain_capture / "gyro_accel.csv").read_bytes()
    assert (folder / "movie.mp4").read_bytes() != (plain_capture / "movie.mp4").read_bytes()


def test_gyro_is_scale_times_true_plus_bias(plain_capture, simulate):
    """Each sample is scale × true + bias."""
    folder = simulate("gyro", effects=["gyro_scale=1.1", "gyro_bias=0.1,-0.2,0.3"])
    assert read_imu(folder)[1] == pytest.approx(1.1 * read_imu(plain_capture)[1] + [0.1, -0.2, 0.3], abs=1e-6)


def test_frames_are_taken_at_the_times_of_the_clock_model(simulate):
    """The start of frame 3 is (t_cam − half the true exposure)(1 + skew) + offset, computed by hand at 100 ms."""
    effects = ["time_offset=0.05", "clock_skew=0.01", "timestamp_reference=exposure_middle", "exposure_time=1.5"]
    told = json.loads((simulate("clock", effects=effects) / "truth" / "effects.json").read_text())
    assert told["slots"][3]["exposure_s"] == pytest.approx(0.012)
    assert told["slots"][3]["first_row_start_s"] == pytest.approx((0.1 - 0.006) * 1.01 + 0.05, abs=1e-9)
    assert told["slots"][3]["middle_s"] == pytest.approx(told["slots"][3]["first_row_start_s"] + 0.009 + 0.006)


def test_a_start_up_lag_ends_through_repeats(simulate):
    """A lag of 3 frames over 6 slots gives repeats at slots 2, 4 and 6; repeated pictures are nearly equal."""
    folder = simulate("lag", effects=["frame_lag=0.1,6"], frames=9, noise_levels=3.0)
    told = json.loads((folder / "truth" / "effects.json").read_text())
    assert [slot["shows"] for slot in told["slots"]] == [3, 4, 4, 5, 5, 6, 6, 7, 8]
    luma = read_movie(folder)[0].astype(float)
    change = np.abs(np.diff(luma, axis=0)).mean(axis=(1, 2))
    assert change[[1, 3, 5]].max() < 0.3 * change[[0, 2, 4, 6, 7]].min()


def test_scene_depth_makes_the_hand_sway_at_that_distance(simulate):
    """The median distance of frames along the optical axis is the effect's depth."""
    folder = simulate("depth", effects=["scene_depth=0.6"])
    told = json.loads((folder / "truth" / "effects.json").read_text())
    path = np.loadtxt(folder / "truth" / "trajectory.csv", delimiter=",", skiprows=1)
    distances = []
    for slot in told["slots"]:
        row = path[np.argmin(np.abs(path[:, 0] - slot["first_row_start_s"]))]
        x, y = row[5:7]
        distances.append((told["scene_plane"]["depth_m"] - row[3]) / (1 - 2 * (x * x + y * y)))
    assert np.median(distances) == pytest.approx(0.6, abs=1e-3)
    assert np.ptp(path[:, 1:4], axis=0).max() > 0.005
    assert dataclasses.asdict(read_profile(folder / "camera.yaml"))["depth_m"] == np.inf


def test_two_effects_combine(simulate):
    """Both are in the true profile."""
    folder = simulate("two", effects=["time_offset=0.01", "vignetting=0.4"])
    true = read_profile(folder / "truth" / "camera.yaml")
    assert (true.time_offset_s, true.extensions.vignetting_corner_loss) == (0.01, 0.4)
    assert SMALL["frames"] == len(list((folder / "truth" / "frames").iterdir()))


def test_sharpening_is_hidden_in_the_phones_processing(simulate):
    """The effects and the ISP strengths contain its values; a radius that is not given is drawn at random."""
    folder = simulate("sharp", frames=2, effects=["sharpening=1.3"])
    truth = json.loads((folder / "truth/effects.json").read_text(encoding="utf-8"))
    values = truth["effects"][0]["parameters"]
    assert values["amount"] == 1.3
    assert 1.0 <= values["radius_px"] <= 1.8
    assert truth["isp"] == {"sharpen": 1.3, "sharpen_radius_px": values["radius_px"]}


def test_a_low_pass_delays_rates_and_attenuates_fast_ones():
    """A tenth of the cutoff is delayed by √2 / (2π f); the cutoff loses 3 dB and a quarter period, computed by hand."""
    time_s = np.arange(400) / 200

    def passed(frequency_hz):
        def rate(t):
            return np.stack([np.sin(2 * np.pi * frequency_hz * t)] * 3, axis=1)

        return filtered_rate(rate, time_s, [20.0])[:, 0]

    late_s = np.sqrt(2) / (2 * np.pi * 20)
    assert passed(2.0) == pytest.approx(np.sin(2 * np.pi * 2.0 * (time_s - late_s)), abs=2e-3)
    assert passed(20.0) == pytest.approx(-np.cos(2 * np.pi * 20.0 * time_s) / np.sqrt(2), abs=3e-3)


def test_a_hidden_low_pass_changes_only_the_gyroscope_log(simulate):
    """Motion and movie are the same; the log's rates come later by the filter's delay."""
    plain, late = (simulate(name, frames=30, effects=e) for name, e in (("none", []), ("late", ["gyro_lowpass=15"])))
    assert (plain / "movie.mp4").read_bytes() == (late / "movie.mp4").read_bytes()
    before, after = (read_imu(folder)[1][:, :3] for folder in (plain, late))
    lags = [np.sum(before[20 : 120 - k] * after[20 + k : 120]) for k in range(8)]
    assert np.argmax(lags) in (2, 3, 4)  # a delay of 15 ms is three samples of 5 ms, and a little less for fast turns


def test_an_average_reads_the_mean_over_a_window_around_its_timestamp():
    """The mean of a sine over a window W is the sine times sin(πfW) / (πfW), without a delay."""
    time_s, frequency_hz, averaging_s = np.arange(200) / 200, 6.0, 0.01
    window_s = averaging_window_s(averaging_s)

    def rate(t):
        return np.stack([np.sin(2 * np.pi * frequency_hz * t)] * 3, axis=1)

    passed = filtered_rate(rate, time_s, [], window_s=window_s)[:, 0]
    assert window_s == pytest.approx(np.sqrt(12) * averaging_s)
    assert passed == pytest.approx(np.sinc(frequency_hz * window_s) * rate(time_s)[:, 0], abs=1e-4)


def test_crooked_axes_read_parts_of_each_other_and_are_corrected():
    """A turn about y at 1 rad/s, with a misalignment of xy by 0.02, reads 0.02 on x times the scale of x."""
    profile = CameraProfile(640, 480, gyro_scale=(1.1, 1.0, 0.9), gyro_bias_rad_s=(0.01, 0.0, 0.0))
    profile = profile.with_extensions(gyro_misalignment_rad=(0.02, 0.0, -0.03))
    turn = np.array([[0.0, 1.0, 0.0]])
    reading = gyro_reading(profile, np.zeros(1), turn, np.zeros((1, 3)))
    np.testing.assert_allclose(reading, [[1.1 * 0.02 + 0.01, 1.0, 0.9 * -0.03]])
    np.testing.assert_allclose(from_gyro_reading(profile, reading), turn, atol=1e-12)
    np.testing.assert_allclose(profile.true_rate_rad_s(reading), turn, atol=1e-12)


@pytest.mark.parametrize(
    ("corner_hz", "averaging_s", "left"), [(12.0, 0.0, 0.02), (20.0, 0.006, 0.02), (0.0, 0.012, 0.03)]
)
def test_a_filter_can_be_inverted(rng, corner_hz, averaging_s, left):
    """Inverting the filters leaves a part of what they change in a hand's rates.

    Without a delay they change less: at |H| = 0.85 the regularised inverse is 0.4 % too small, of 15 % that are lost.
    """
    motion = random_hand_motion(rng, rate_rms_rad_s=1.0, duration_s=2.0, band_hz=(0.5, 8.0))
    time_s, window_s = np.arange(-0.5, 2.5, 0.005), averaging_window_s(averaging_s)
    corners_hz = [corner_hz] if corner_hz else []
    true, logged = motion.rate_rad_s(time_s), filtered_rate(motion.rate_rad_s, time_s, corners_hz, window_s=window_s)
    found = before_filter(time_s, logged, corner_hz, window_s)
    inner = slice(60, -60)
    assert np.std((found - true)[inner]) < left * np.std((logged - true)[inner])


def test_a_shadow_covers_its_place_at_its_time():
    """It multiplies the constant shading. Coordinates are fractions of the picture, x to the right and y down."""
    hidden = Hidden(
        light=lambda x, y: 1 - 0.5 * y, shadow=lambda stamp_s, x, y: np.where((stamp_s > 1) & (x > 0.5), 0.25, 1.0)
    )
    light = np.ones((3, 4, 3), np.float32)
    before, there = (shaded(hidden, light, stamp_s)[..., 0] for stamp_s in (0.5, 1.5))
    np.testing.assert_allclose(before, np.array([[1.0], [0.75], [0.5]]) * np.ones((1, 4)))
    np.testing.assert_allclose(there, before * (1, 1, 0.25, 0.25))


@pytest.mark.parametrize("longer", [0.5, 2.2])
def test_another_focal_length_does_not_defocus(longer):
    """The lens blurs by a number of pixels, whatever angle a pixel covers."""
    nominal = nominal_camera(200, 150)
    lens = nominal.intrinsics
    other = dataclasses.replace(lens, fx_px=longer * lens.fx_px, fy_px=longer * lens.fy_px)
    settings = SessionSettings(scene="board", frames=8, seed=3)

    def steepest_step(true_lens):
        session = plan_session(nominal, dataclasses.replace(nominal, intrinsics=true_lens), settings)
        pictures = np.array([render_truth(session, slot) for slot in range(settings.frames)], float)
        return max(np.abs(np.diff(pictures, axis=axis)).max() for axis in (1, 2)) / np.ptp(pictures)

    assert steepest_step(other) == pytest.approx(steepest_step(lens), rel=0.05)
