"""A phone's processing of pictures and samples: each strength against its own law, and whole captures."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from capture_files import SMALL, read_imu, read_movie

from virest.app.simulate import simulate_command
from virest.camera.profile import CameraProfile, Extensions
from virest.camera.profile_file import read_profile
from virest.errors import SettingsError
from virest.simulation.phone_gyro import filtered_rate, gyro_noise, jittered_ns, usual_delay_s
from virest.simulation.phone_isp import ISPS, PhoneIsp, make_isp
from virest.simulation.phone_pictures import (
    PhonePictures,
    denoise_in_space,
    map_local_tones,
    roll_off_highlights,
    sharpen,
    tone_curve,
)
from virest.simulation.session import SessionSettings, nominal_camera, plan_session, sample_imu

LUMA = np.array([0.299, 0.587, 0.114])


def grey_noise(rng, sigma=0.02, level=0.5, size=(90, 120)):
    """A flat grey picture with independent noise in every channel."""
    return (level + sigma * rng.standard_normal((*size, 3))).astype(np.float32)


def luma_of(picture):
    """BT.601 luma."""
    return picture @ LUMA


# ── pictures ─────────────────────────────────────────────────────────────────────────────────────────────────────


def test_highlights_bend_at_the_knee_and_never_clip():
    """With a knee of 0.25, light below 0.75 is unchanged, light 1 becomes 0.75 + 0.25 (1 − 1/e), and 5 almost 1."""
    light = np.array([0.3, 0.75, 1.0, 5.0], np.float32)
    expected = [0.3, 0.75, 0.75 + 0.25 * (1 - np.exp(-1)), 1.0]
    assert roll_off_highlights(light, 0.25) == pytest.approx(expected, abs=1e-6)
    fine = roll_off_highlights(np.linspace(0.7, 1.4, 500).astype(np.float32), 0.25)
    slope = np.diff(fine) * 499 / 0.7
    assert slope[:30] == pytest.approx(1.0, abs=1e-3)
    assert (np.abs(np.diff(slope)) < 0.01).all()


def test_the_tone_curve_keeps_both_ends_and_the_middle():
    """At 0.25 half an S curve gives ½ · 0.25 + ½ · 0.15625; the slope in the middle is 1.25."""
    assert tone_curve(np.array([0.0, 0.25, 0.5, 1.0], np.float32), 0.5) == pytest.approx([0.0, 0.203125, 0.5, 1.0])
    near = tone_curve(np.array([0.49, 0.51]), 0.5)
    assert (near[1] - near[0]) / 0.02 == pytest.approx(1.25, rel=1e-3)


def test_denoising_keeps_edges_and_affects_chroma_most(rng):
    """Flat grey loses more than half of its luma noise, and chroma more; a step of 15 deviations stays sharp."""
    noisy = grey_noise(rng)
    noisy[:, 60:] += 0.3
    clean = denoise_in_space(noisy, 1.5 * 0.02)
    before, after = (p[5:-5, 10:50] for p in (noisy, clean))
    luma = luma_of(after).std() / luma_of(before).std()
    red = (after[..., 0] - luma_of(after)).std() / (before[..., 0] - luma_of(before)).std()
    assert red < luma < 0.5
    step = luma_of(clean)[5:-5, 60].mean() - luma_of(clean)[5:-5, 59].mean()
    assert step == pytest.approx(0.3, abs=0.015)


def test_a_still_scene_is_averaged_recursively(rng):
    """A share w leaves √((1 − w)/(1 + w)) of the noise, with little loss to apparent motion."""
    phone = PhonePictures(PhoneIsp(temporal_denoise=0.6), 0.02)
    for _ in range(12):
        out = phone.develop(grey_noise(rng))
    assert out.std() / 0.02 == pytest.approx(np.sqrt(0.4 / 1.6), rel=0.12)


def test_a_moving_object_leaves_no_ghost(rng):
    """After a bright square jumps, its old place shows only the background."""
    phone = PhonePictures(PhoneIsp(temporal_denoise=0.8), 0.01)
    first, second = grey_noise(rng, 0.01), grey_noise(rng, 0.01)
    first[30:60, 20:50] += 0.3
    second[30:60, 70:100] += 0.3
    phone.develop(first)
    assert phone.develop(second)[35:55, 25:45].mean() == pytest.approx(0.5, abs=0.003)


def test_an_unsharp_mask_overshoots_beside_an_edge_by_its_amount():
    """Half a pixel beside a step of 0.4, the mask adds 0.4 · amount · Φ(−0.5/radius)."""
    step = np.full((40, 60, 3), 0.3, np.float32)
    step[:, 30:] = 0.7
    sharp = sharpen(step, 0.8, 1.4)
    beyond = 0.5 * float(cv2.getGaussianKernel(41, 1.4)[20, 0])
    below_half = 0.5 - beyond  # share of the sampled Gaussian on one side of its middle sample
    assert sharp[20, 30, 1] - 0.7 == pytest.approx(0.4 * 0.8 * below_half, rel=0.01)
    assert 0.3 - sharp[20, 29, 1] == pytest.approx(0.4 * 0.8 * below_half, rel=0.01)
    assert sharp[20, 5] == pytest.approx(0.3, abs=1e-6)


def test_local_tone_mapping_compresses_coarse_contrast_only():
    """The ratio of two halves, 0.2 and 0.8, is raised to 1 − strength; a fine pattern keeps its contrast."""
    pattern = 1 + 0.1 * np.sin(np.arange(400) * 2.1)
    picture = np.where(np.arange(400) < 200, 0.2, 0.8) * pattern
    picture = np.repeat(np.repeat(picture[None, :, None], 300, 0), 3, 2).astype(np.float32)
    mapped = map_local_tones(picture, 0.4)[150, :, 1]
    dark, bright = mapped[40:160], mapped[240:360]
    assert np.log(bright.mean() / dark.mean()) == pytest.approx(0.6 * np.log(4), rel=0.08)
    for part in (dark, bright):
        assert part.std() / part.mean() == pytest.approx(0.1 / np.sqrt(2), rel=0.1)


# ── the gyroscope ────────────────────────────────────────────────────────────────────────────────────────────────


def test_the_low_pass_halves_the_power_at_its_corner():
    """A slow rate passes unchanged and without delay; at the corner its amplitude is 1/√2."""
    time_s = np.arange(0.1, 1.5, 1 / 200)

    def passed(frequency_hz):
        def rate(t):
            return np.stack([np.sin(2 * np.pi * frequency_hz * t)] * 3, axis=1)

        return filtered_rate(rate, time_s, [30.0], usual_delay_s(30.0))[:, 0], rate(time_s)[:, 0]

    slow, as_it_was = passed(2.0)
    assert slow == pytest.approx(as_it_was, abs=0.005)
    corner, _ = passed(30.0)
    assert corner.std() * np.sqrt(2) == pytest.approx(1 / np.sqrt(2), rel=0.01)


def test_noise_density_and_jitter_have_the_given_sizes(rng):
    """A density of 0.001 rad/s/√Hz at 200 Hz gives 0.01 rad/s.

    After a low pass of 40 Hz it gives √(1.11 · 40 / 100) of that.
    """
    assert gyro_noise(0.001, 200.0, [], (20000, 3), rng).std() == pytest.approx(0.01, rel=0.02)
    low = gyro_noise(0.001, 200.0, [40.0], (20000, 3), rng)
    assert low.std() == pytest.approx(0.01 * np.sqrt(1.11 * 40 / 100), rel=0.05)
    stamps = np.arange(20000, dtype=np.int64) * 5_000_000
    jittered = jittered_ns(stamps, 0.0004, rng)
    assert (jittered - stamps).std() == pytest.approx(0.0004e9, rel=0.02)
    assert (np.diff(jittered_ns(stamps, 0.02, rng)) > 0).all()


# ── captures ─────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def phone_capture(tmp_path_factory):
    """The capture of most tests, taken by a phone."""
    folder = tmp_path_factory.mktemp("phone") / "phone"
    simulate_command(folder, **SMALL, isp=ISPS["phone"])
    return folder


def test_only_the_truth_folder_shows_the_phone(phone_capture: Path, plain_capture: Path):
    """Profile and frame logs equal those of a capture without a phone; truth/ has time offset and stabiliser."""
    for name in ("camera.yaml", "frame_timestamps.txt", "movie_metadata.csv"):
        assert (phone_capture / name).read_bytes() == (plain_capture / name).read_bytes(), name
    true = read_profile(phone_capture / "truth/camera.yaml")
    assert true.time_offset_s == pytest.approx(0.002)
    assert true.extensions.stabilisation_fraction == pytest.approx(0.1)


def test_the_same_seed_gives_the_same_phone(phone_capture: Path, tmp_path: Path):
    """The same seed gives the same bytes of movie, samples and truth."""
    simulate_command(tmp_path / "again", **SMALL, isp=ISPS["phone"])
    for name in ("movie.mp4", "gyro_accel.csv", "truth/effects.json", "truth/frames/000003.png"):
        assert (tmp_path / "again" / name).read_bytes() == (phone_capture / name).read_bytes(), name


def test_truth_includes_only_global_curves(simulate):
    """Denoising, sharpening and local tone mapping do not change truth/; the tone curve acts on each level."""
    still = {"rate_rad_s": 0.0, "frames": 2}

    def truth(name, **strengths):
        return cv2.imread(str(simulate(name, **still, isp=PhoneIsp(**strengths)) / "truth/frames/000001.png"))

    plain = truth("plain")
    assert (truth("local", denoise=2, temporal_denoise=0.5, sharpen=1, local_tone=0.3) == plain).all()
    levels = 255 * tone_curve(plain.astype(np.float32) / 255, 0.6)
    toned = truth("toned", tone=0.6)
    assert np.abs(toned - levels).max() < 1.5
    assert np.abs(toned.astype(float) - plain).max() > 5


def test_the_movie_shows_the_sharpening(simulate):
    """Sharpening a still scene increases the movie's fine contrast by more than half."""

    def detail(name, **strengths):
        luma, _ = read_movie(simulate(name, rate_rad_s=0.0, frames=2, crf=2.0, isp=PhoneIsp(**strengths)))
        return cv2.Laplacian(luma[0].astype(np.float32), cv2.CV_32F).std()

    assert detail("sharp", sharpen=1.0) > 1.5 * detail("plain")


def test_the_log_has_gyroscope_noise_and_jitter(simulate):
    """The rates of a resting camera are noise alone, and timestamps with jitter are not evenly spaced."""
    isp = PhoneIsp(gyro_noise=0.001, gyro_jitter_s=0.0003)
    time_ns, gyro, _ = read_imu(simulate("noisy", rate_rad_s=0.0, frames=30, isp=isp))
    assert gyro.std() == pytest.approx(0.01, rel=0.1)
    assert np.diff(time_ns).std() == pytest.approx(np.sqrt(2) * 0.0003e9, rel=0.15)


def test_jitter_has_a_random_stream_of_its_own():
    """Near objects are drawn from [seed, 7], and so is the jitter in captures without them."""

    def jitter_s(near_m):
        settings = SessionSettings(frames=30, seed=5, near_m=near_m)
        camera = nominal_camera(64, 48, depth_m=2.0)
        session = plan_session(camera, camera, settings)
        jittered = dataclasses.replace(
            session, settings=dataclasses.replace(settings, isp=PhoneIsp(gyro_jitter_s=1e-4))
        )
        return 1e-9 * (sample_imu(jittered).time_ns - sample_imu(session).time_ns)

    alone, with_objects = jitter_s(None), jitter_s(1.0)
    shared = 1e-4 * np.random.default_rng([5, 7]).normal(size=len(alone))
    np.testing.assert_allclose(alone, shared, atol=1e-9)
    assert abs(np.corrcoef(with_objects, shared)[0, 1]) < 0.3


@pytest.mark.parametrize(
    "strengths", [{"tone": 1.5}, {"denoise": -1}, {"bits_per_px": 0.0}, {"gyro_lowpass_hz": 2000}, {"local_tone": 1}]
)
def test_an_invalid_strength_is_refused(strengths):
    """The error names the strength."""
    with pytest.raises(SettingsError, match=next(iter(strengths))):
        make_isp("phone", **strengths)


def test_a_phone_has_one_stabiliser():
    """A residual of stabilisation and a stabiliser in the true profile would be two stabilisers."""
    profile = CameraProfile(64, 48, extensions=Extensions(stabilisation_fraction=0.5))
    with pytest.raises(SettingsError, match="two stabilisers"):
        PhoneIsp(stabiliser_rest=0.1).true_profile(profile)
