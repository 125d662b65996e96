"""Time offset and agreement, with tracks of an analytic motion and measured captures."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from motion.synthetic_motion import R_CAM_IMU, Setup, Synthetic, hand_motion, make, observed_pairs
from motion.synthetic_tracks import Setup as Hand
from motion.synthetic_tracks import recorded as hand
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile, Extensions
from virest.camera.profile_file import read_profile
from virest.capture.imu import ImuSamples
from virest.capture.records import Frame
from virest.inference.frame_selection import choose_pairs
from virest.inference.observed_tracks import ObservedTracks, observe_tracks
from virest.inference.synchronisation import (
    RIGHT_ANGLES,
    Agreement,
    OffsetEstimate,
    check_agreement,
    estimate_time_offset,
    shown_axes,
    shown_readout,
)
from virest.inference.tracking import track_pairs

SWAYING = Hand(seed=31, frames=40, points=60, gyro_noise_rad_s=0.001)
DIRECTIONS = ("top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left")


def estimate(setup: Setup) -> OffsetEstimate:
    """Record and estimate."""
    recorded = make(setup)
    return estimate_time_offset(recorded.observed(), recorded.imu, recorded.profile)


def agreement(recorded: Synthetic, time_offset_s: float) -> Agreement:
    """Check a recording against its own profile with this offset."""
    profile = replace(recorded.profile, time_offset_s=time_offset_s)
    return check_agreement(recorded.observed(profile), recorded.imu, profile)


# ── estimates ────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("time_offset_s", [0.0, 0.013, -0.4])
@pytest.mark.parametrize("direction", DIRECTIONS)
def test_offset_and_bias_are_recovered(time_offset_s: float, direction: str) -> None:
    """For all readout directions and any offset, the offset is right within 0.1 ms and the bias within 1 mrad/s."""
    stamp = ("exposure_start", "exposure_middle", "exposure_end")[DIRECTIONS.index(direction) % 3]
    setup = Setup(
        hand_motion(DIRECTIONS.index(direction)),
        time_offset_s=time_offset_s,
        readout_direction=direction,
        timestamp=stamp,
        frames=30,
        points=60,
    )
    found = estimate(setup)
    assert found.determined, found.reason
    assert abs(found.time_offset_s - time_offset_s) < 1e-4
    assert found.std_s < 3e-4
    np.testing.assert_allclose(found.bias_rad_s, setup.bias_rad_s, atol=1e-3)
    assert not found.travels


def test_a_gyroscope_with_other_axes_is_reported() -> None:
    """Frames and gyroscope belong together, but the profile has another phone's axes: the advice is to calibrate."""
    recorded = make(Setup(hand_motion(3), time_offset_s=0.011, frames=30, points=60))
    turned = np.array(recorded.profile.r_cam_imu)[[1, 0, 2]] * [[1], [-1], [1]]
    profile = replace(recorded.profile, time_offset_s=None, r_cam_imu=tuple(map(tuple, turned.tolist())))
    found = estimate_time_offset(recorded.observed(profile), recorded.imu, profile)
    assert not found.determined
    assert found.other_axes
    told = check_agreement(recorded.observed(profile), recorded.imu, replace(profile, time_offset_s=0.011))
    assert not told.agrees
    assert "virest calibrate finds them" in told.reason
    assert not estimate(Setup(hand_motion(3), frames=30, points=60)).other_axes


@pytest.mark.parametrize("turn", [RIGHT_ANGLES[5], RIGHT_ANGLES[11], RIGHT_ANGLES[20]])
def test_unstated_axes_are_those_that_the_frames_show(turn: NDArray[np.float64]) -> None:
    """Default axes that are turned by right angles are turned back."""
    recorded = make(Setup(hand_motion(3), time_offset_s=0.011, frames=30, points=60))
    default = _turned(recorded.profile, turn)
    shown = shown_axes(recorded.observed(default), recorded.imu, default)
    assert shown is not None
    assert shown.axes_known
    np.testing.assert_allclose(shown.rotation_cam_imu, recorded.profile.rotation_cam_imu, atol=1e-12)


def test_axes_are_not_found_from_a_rotation_about_one_axis() -> None:
    """Axes that map the axis of rotation alike explain the frames equally well."""
    motion = hand_motion(3)
    recorded = make(Setup(replace(motion, amplitude_rad_s=motion.amplitude_rad_s * [1, 0, 0]), frames=30, points=60))
    default = _turned(recorded.profile, RIGHT_ANGLES[5])
    assert shown_axes(recorded.observed(default), recorded.imu, default) is None


@pytest.mark.parametrize("direction", [*DIRECTIONS, "at once"])
def test_an_unstated_readout_is_that_which_the_points_show(direction: str) -> None:
    """Its axis, sign and time, whatever direction is assumed; a global shutter has none."""
    read = {"readout_time_s": 0.0} if direction == "at once" else {"readout_direction": direction}
    recorded = make(Setup(hand_motion(3), time_offset_s=0.011, frames=30, points=60, **read))  # type: ignore[arg-type]
    shutter = replace(recorded.profile.shutter, readout_time_s=0.0, readout_direction="left_to_right")
    unknown = replace(recorded.profile, time_offset_s=0.02, readout_known=False, shutter=shutter)
    known = {"offset_known": False, "focal_known": direction != "top_to_bottom"}
    shown = shown_readout(recorded.observed(unknown), recorded.imu, unknown, **known)
    if direction == "at once":
        assert shown is None
        return
    assert shown is not None
    found, std_s = shown
    assert found.readout_direction == direction
    assert found.readout_time_s == pytest.approx(0.0207, abs=2e-4)
    assert abs(found.readout_time_s - 0.0207) < 4 * std_s


def _turned(profile: CameraProfile, turn: NDArray[np.float64]) -> CameraProfile:
    """The profile of a phone whose axes and offset nothing states, with other axes."""
    axes = tuple(map(tuple, (turn.T @ profile.rotation_cam_imu).tolist()))
    return replace(profile, time_offset_s=None, axes_known=False, r_cam_imu=axes)


@pytest.mark.parametrize(
    ("logged", "words"),
    [
        (np.diag([180 / np.pi] * 3), "read as degrees per second it"),
        (-np.eye(3), "with its sign reversed it"),
        (-np.diag([180 / np.pi] * 3), "read as degrees per second with its sign reversed it"),
        (np.diag([1.0, 1.0, -1.0]), "with one axis reversed, or two swapped, it"),
        (np.eye(3)[[2, 1, 0]], "with one axis reversed, or two swapped, it"),
    ],
)
def test_a_log_in_another_unit_or_sign_is_recognised(logged: NDArray[np.float64], words: str) -> None:
    """The gyroscope explains nothing as logged; how it must be read is said."""
    recorded = make(Setup(hand_motion(3), time_offset_s=0.011, frames=30, points=60))
    profile = replace(recorded.profile, time_offset_s=0.011)
    imu = replace(recorded.imu, gyro_rad_s=recorded.imu.gyro_rad_s @ logged.T)
    told = check_agreement(recorded.observed(profile), imu, profile)
    assert not told.agrees
    assert f"{words} would explain" in told.reason


@pytest.mark.parametrize("error_s", [0.007, -0.012])
def test_a_slightly_wrong_offset_agrees_and_a_better_one_is_named(error_s: float) -> None:
    """Frames and gyroscope agree, and the better offset is reported coarsely."""
    recorded = make(Setup(hand_motion(2), time_offset_s=0.011, frames=30, points=60))
    right, wrong = agreement(recorded, 0.011), agreement(recorded, 0.011 + error_s)
    assert right.agrees
    assert wrong.agrees
    assert wrong.best_offset_s == pytest.approx(0.011, abs=3e-3)
    assert right.best_offset_s is None or abs(right.best_offset_s - 0.011) < 3e-3


@pytest.mark.parametrize(
    ("velocity_m_s", "depth_m"), [((0.1, -0.1, 3.0), (5.0, 60.0)), ((0.2, 0.1, 0.0), (1.5, 12.0))], ids=["car", "sway"]
)
def test_parallax_is_separated_from_rotation(
    velocity_m_s: tuple[float, float, float], depth_m: tuple[float, float]
) -> None:
    """A camera that also moves gives its offset within three deviations and 0.5 ms."""
    for seed in range(3):
        motion = hand_motion(30 + seed, 0.25, velocity_m_s=velocity_m_s)
        setup = Setup(motion, time_offset_s=-0.005, depth_m=depth_m, points=100, seed=seed)
        found = estimate(setup)
        assert found.determined, found.reason
        assert found.travels
        assert abs(found.time_offset_s + 0.005) < min(3 * found.std_s, 5e-4)


def test_moving_objects_do_not_change_the_offset() -> None:
    """A quarter of the points belong to a moving object."""
    found = estimate(Setup(hand_motion(6, 0.3), time_offset_s=-0.021, outliers=0.25))
    assert found.determined, found.reason
    assert abs(found.time_offset_s + 0.021) < 1.5e-4


def test_errors_fit_their_standard_deviations() -> None:
    """Over twelve recordings with few noisy points, errors in standard deviations are plausible."""
    ratios = []
    for seed in range(12):
        found = estimate(
            Setup(hand_motion(seed, 0.15), time_offset_s=0.02, points=20, frames=20, noise_px=0.4, seed=seed)
        )
        assert found.determined, found.reason
        ratios.append((found.time_offset_s - 0.02) / found.std_s)
    assert 0.2 < np.std(ratios) < 1.6
    assert np.max(np.abs(ratios)) < 4


def test_wrong_readout_shows_in_the_standard_deviation() -> None:
    """With a readout time 6 % off, the middle row's time is right.

    The deviation covers the error of the first row's time.
    """
    setup = Setup(hand_motion(80, 0.3), readout_time_s=0.0207)
    recorded = make(setup)
    wrong = replace(recorded.profile, shutter=replace(recorded.profile.shutter, readout_time_s=0.022))
    found = estimate_time_offset(recorded.observed(wrong), recorded.imu, wrong)
    assert abs(found.time_offset_s + 0.5 * 0.022 - 0.5 * 0.0207) < 2e-4
    assert abs(found.time_offset_s) < 2 * found.std_s


def test_an_unknown_readout_is_fitted_with_the_offset() -> None:
    """The deviation accounts for the fact that only their sum is well determined."""
    setup = Setup(hand_motion(60, 0.3), time_offset_s=0.1)
    recorded = make(setup)
    unknown = replace(
        recorded.profile, readout_known=False, shutter=replace(recorded.profile.shutter, readout_time_s=0.0)
    )
    found = estimate_time_offset(recorded.observed(unknown), recorded.imu, unknown)
    assert found.determined
    assert abs(found.readout_s - setup.readout_time_s) < 1e-3
    assert 1e-3 < found.std_s < 5e-3
    assert abs(found.time_offset_s - (0.1 + 0.5 * setup.readout_time_s)) < 2e-4
    assert "readout unknown" in found.reason


def test_unknown_focal_length_is_found_with_the_offset() -> None:
    """Without intrinsics the motion gives the focal length within 1 %, and the offset within 1 ms."""
    recorded = make(Setup(hand_motion(71, 0.3), time_offset_s=0.1))
    unknown = replace(recorded.profile, intrinsics=None)
    found = estimate_time_offset(recorded.observed(unknown), recorded.imu, unknown)
    assert found.determined, found.reason
    assert found.focal_px is not None
    assert abs(found.focal_px / 980.0 - 1) < 0.01
    assert abs(found.time_offset_s - 0.1) < 1e-3


def test_a_stabiliser_is_not_taken_for_another_focal_length() -> None:
    """It halves the rotation in the frames; the points do not follow such a lens, and no focal length is reported."""
    for fraction, told in ((0.0, True), (0.5, False)):
        recording = hand(replace(SWAYING, stabilised=(fraction, 1.0)))
        unknown = replace(recording.profile, intrinsics=None, time_offset_s=None, extensions=Extensions())
        observed = observed_pairs(recording.pairs, recording.stamp_s, recording.exposure_s, unknown)
        assert (estimate_time_offset(observed, recording.imu, unknown).focal_px is not None) is told


def test_a_dashboard_is_left_out() -> None:
    """Static points in the lower quarter change neither offset nor focal length."""
    recorded = make(Setup(hand_motion(72, 0.3), time_offset_s=0.02, points=160))
    pairs = []
    for pair in recorded.pairs:
        rests = pair.points_first_px[:, 1] > 960
        second_px = np.where(rests[:, None], pair.points_first_px, pair.points_second_px)
        pairs.append(replace(pair, points_second_px=second_px))
    unknown = replace(recorded.profile, intrinsics=None)
    found = estimate_time_offset(replace(recorded, pairs=pairs).observed(unknown), recorded.imu, unknown)
    assert found.determined, found.reason
    assert abs(found.time_offset_s - 0.02) < 1e-4
    assert found.focal_px == pytest.approx(980.0, rel=0.005)


def test_a_drifting_clock_is_reported() -> None:
    """A clock skew missing from the profile is reported; the deviation widens to include the first frame's offset."""
    recorded = make(Setup(hand_motion(50, 0.3), time_offset_s=0.1, clock_skew=0.004, frames=60, points=50))
    given = replace(recorded.profile, clock_skew=0.0)
    found = estimate_time_offset(recorded.observed(), recorded.imu, given)
    assert abs(found.drift_s_per_s - 0.004) < 5e-4
    assert abs(found.time_offset_s - 0.1) < 2 * found.std_s
    assert "drifts" in found.reason


def test_a_short_capture_shows_no_drift_by_chance() -> None:
    """Common errors of points imitate a drift in these short captures; at most one is reported."""
    drifts = 0
    for seed in (1, 26, 29, 31, 39, 48):
        recorded = make(
            Setup(hand_motion(100 + seed), time_offset_s=0.013, frames=14, points=60, noise_px=0.3, seed=seed)
        )
        rng = np.random.default_rng(seed)
        pairs = [replace(p, points_second_px=p.points_second_px + rng.normal(0, 1.5, 2)) for p in recorded.pairs]
        found = estimate_time_offset(replace(recorded, pairs=pairs).observed(), recorded.imu, recorded.profile)
        drifts += "drifts" in found.reason
    assert drifts <= 1


# ── rejections ───────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("motion", "word"),
    [(hand_motion(1, 0.0004), "hardly change"), (hand_motion(1, 1e-7, pan_rad_s=(0.1, 0.5, 0.05)), "hardly change")],
    ids=["still", "steady pan"],
)
def test_uninformative_motion_is_refused(motion: object, word: str) -> None:
    """A still camera and one that turns at a constant rate look the same at every offset."""
    recorded = make(Setup(motion, frames=20, points=40))  # type: ignore[arg-type]
    found = estimate_time_offset(recorded.observed(), recorded.imu, recorded.profile)
    assert not found.determined
    assert word in found.reason
    assert not np.isfinite(found.std_s)
    still = agreement(recorded, 0.0)
    assert still.agrees
    assert "too little motion" in still.reason


def foreign(recorded: Synthetic, seed: int) -> ImuSamples:
    """The gyroscope of another recording."""
    return replace(recorded.imu, gyro_rad_s=hand_motion(900 + seed).rate(recorded.imu.time_s) @ np.array(R_CAM_IMU))


def shuffled(recorded: Synthetic, seed: int) -> ImuSamples:
    """The gyroscope's table cut into twelve pieces in random order."""
    pieces = np.array_split(recorded.imu.gyro_rad_s, 12)
    order = np.random.default_rng(seed).permutation(12)
    return replace(recorded.imu, gyro_rad_s=np.concatenate([pieces[k] for k in order]))


def backwards(recorded: Synthetic, seed: int) -> ImuSamples:
    """The gyroscope's table in reverse."""
    return replace(recorded.imu, gyro_rad_s=recorded.imu.gyro_rad_s[::-1])


@pytest.mark.parametrize(("spoil", "frames"), [(foreign, 12), (foreign, 30), (backwards, 30)])
def test_unrelated_gyroscopes_are_refused(spoil: Callable[[Synthetic, int], ImuSamples], frames: int) -> None:
    """A gyroscope of another recording or in reverse gives neither an offset nor agreement."""
    for seed in range(8):
        recorded = make(Setup(hand_motion(seed), frames=frames, points=25, seed=seed))
        recorded = replace(recorded, imu=spoil(recorded, seed))
        found = estimate_time_offset(recorded.observed(), recorded.imu, recorded.profile)
        assert not found.determined
        assert "gyroscope" in found.reason or "equally" in found.reason
        assert not agreement(recorded, 0.0).agrees


def test_a_shuffled_gyroscope_is_refused() -> None:
    """The pieces belong to the recording but are in the wrong order."""
    for seed in range(6):
        recorded = make(Setup(hand_motion(seed), points=25, seed=seed))
        recorded = replace(recorded, imu=shuffled(recorded, seed))
        assert not estimate_time_offset(recorded.observed(), recorded.imu, recorded.profile).determined


def test_few_tracks_are_refused() -> None:
    """Pairs with few points, or few pairs, determine nothing."""
    recorded = make(Setup(hand_motion(2), points=8, frames=20))
    assert "tracked points" in estimate_time_offset(recorded.observed(), recorded.imu, recorded.profile).reason
    recorded = make(Setup(hand_motion(2), points=40, frames=6))
    assert not estimate_time_offset(recorded.observed(), recorded.imu, recorded.profile).determined
    assert not estimate_time_offset(replace(recorded, pairs=[]).observed(), recorded.imu, recorded.profile).determined


def test_a_gyroscope_at_other_times_is_refused() -> None:
    """The reason for samples that end before the frames begin is missing coverage."""
    recorded = make(Setup(hand_motion(2), points=40, frames=20))
    late = replace(recorded, frame_time_s=recorded.frame_time_s + 50.0)
    assert "cover" in estimate_time_offset(late.observed(), late.imu, late.profile).reason


def test_offset_beyond_the_search_is_refused() -> None:
    """An offset outside the search range is not replaced by the best one inside."""
    recorded = make(Setup(hand_motion(3), time_offset_s=0.4, points=40))
    assert not estimate_time_offset(recorded.observed(), recorded.imu, recorded.profile, search_s=0.2).determined


def test_agreement_names_a_better_offset() -> None:
    """At a wrong offset the frames do not agree, and a matching offset is reported."""
    recorded = make(Setup(hand_motion(4), time_offset_s=-0.3, points=40))
    assert agreement(recorded, -0.3).agrees
    wrong = agreement(recorded, 0.0)
    assert not wrong.agrees
    assert wrong.best_offset_s == pytest.approx(-0.3, abs=0.02)


# ── selection of frames ──────────────────────────────────────────────────────────────────────────────────────────


def test_selected_frames_are_few_have_high_motion_and_are_spread() -> None:
    """From a long capture at most 60 usable frames are selected, in runs with high motion."""
    frames = [Frame(k, k, k / 30, skip_reason="start-up" if k < 12 else None) for k in range(3000)]
    time_s = np.arange(-1, 101, 0.005)
    lively = np.where((time_s % 20 > 8) & (time_s % 20 < 9), 1.0, 0.01)
    imu = ImuSamples(
        time_s, lively[:, None] * np.sin(20 * time_s)[:, None] * np.ones(3), np.full((len(time_s), 3), np.nan)
    )
    chosen = choose_pairs(frames, imu)
    assert 40 <= len(chosen) <= 60
    assert chosen == sorted(set(chosen))
    assert min(chosen) >= 12
    assert sum(np.diff(chosen) == 1) >= 0.8 * len(chosen)
    assert max(chosen) - min(chosen) > 1500
    assert np.mean([7.5 < (k / 30) % 20 < 9.5 for k in chosen]) > 0.6


def test_short_captures_are_used_completely() -> None:
    """Up to the limit every usable frame is used."""
    frames = [Frame(k, k, k / 30) for k in range(25)]
    imu = ImuSamples(np.arange(0, 1, 0.01), np.ones((100, 3)), np.full((100, 3), np.nan))
    assert choose_pairs(frames, imu) == list(range(25))


# ── measured captures ────────────────────────────────────────────────────────────────────────────────────────────

Measured = tuple[ObservedTracks, ImuSamples, CameraProfile]


def measured(name: str) -> Measured:
    """Track a measured capture; skip the test without one."""
    root = os.environ.get("VIREST_REALDATA")
    if not root or not (Path(root) / name).is_dir():
        pytest.skip("VIREST_REALDATA does not point to the measured captures")
    from virest.capture.folder import read_capture
    from virest.capture.video import probe_movie, read_gray

    folder = Path(root) / name
    capture = read_capture(folder, look_at_pictures=False)
    chosen = choose_pairs(capture.frames, capture.imu)
    pairs = track_pairs(read_gray(capture.movie, probe_movie(capture.movie), chosen))
    profile = read_profile(folder / "camera.yaml")
    return observe_tracks(capture, pairs, profile), capture.imu, profile


def test_car_recording_gives_its_offset() -> None:
    """lhaippp_car: −5.1 ms within two deviations, although the nominal readout is 5 % too long.

    Middle row within 0.4 ms.
    """
    recorded = measured("lhaippp_car")
    found = estimate_time_offset(*recorded)
    assert found.determined, found.reason
    assert abs(found.time_offset_s + 0.0051) < 2 * found.std_s
    assert found.std_s < 2e-3
    middle_row_mid_exposure_s = found.time_offset_s + 0.5 * recorded[2].shutter.readout_time_s + 0.5 * 0.00535
    assert abs(middle_row_mid_exposure_s - 0.0134) < 4e-4
    assert check_agreement(*recorded[:2], replace(recorded[2], time_offset_s=found.time_offset_s)).agrees


def test_a_shaken_phone_gives_an_offset_of_nearly_half_a_second() -> None:
    """nexus5_162941: the offset is found from zero, and its drift is estimated."""
    recorded = measured("nexus5_162941")
    found = estimate_time_offset(*recorded)
    assert found.determined, found.reason
    assert 0.39 < found.time_offset_s < 0.47
    assert abs(found.time_offset_s + 0.5 * recorded[2].shutter.readout_time_s - 0.461) < 0.006
    assert found.std_s > 0.005
    assert 0.003 < found.drift_s_per_s < 0.007  # with calibrate 0.0048 ± 0.0004
    assert check_agreement(*recorded[:2], replace(recorded[2], time_offset_s=found.time_offset_s)).agrees


def test_gimballed_drone_gives_its_offset() -> None:
    """gopro_karma: −18 ms to −32 ms, with a deviation above 1 ms since the readout is unknown."""
    recorded = measured("gopro_karma")
    found = estimate_time_offset(*recorded)
    assert found.determined, found.reason
    assert -0.032 < found.time_offset_s < -0.018
    assert found.std_s > 1e-3
    assert check_agreement(*recorded[:2], replace(recorded[2], time_offset_s=found.time_offset_s)).agrees


def test_frames_stabilised_in_the_camera_are_refused() -> None:
    """gopro_hero7: neither an offset nor agreement at any offset."""
    recorded = measured("gopro_hero7")
    found = estimate_time_offset(*recorded)
    assert not found.determined
    assert "do not follow" in found.reason
    verdict = check_agreement(*recorded[:2], replace(recorded[2], time_offset_s=0.0))
    assert not verdict.agrees
    assert verdict.best_offset_s is None
