"""Extensions of a profile improve restored frames: simulated captures with nominal and true profiles."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from virest.app.process import ProcessOptions, process_captures
from virest.app.segments import cut_imu
from virest.app.simulate import simulate_command
from virest.camera.field import Field
from virest.camera.profile import CameraProfile
from virest.camera.response import ResponseCurve
from virest.capture.folder import read_capture, resolve_profile
from virest.capture.records import Capture, Frame
from virest.capture.video import probe_movie, read_frames
from virest.image_formation.row_motion import FrameTranslation, frame_times_s
from virest.restoration.capture import RestorationPlan, at_true_times, restore_frames
from virest.restoration.frame import RestoredFrame
from virest.restoration.settings import PRESETS
from virest.simulation.hidden import Hidden
from virest.simulation.recording import RecordingOptions, write_recording
from virest.simulation.session import SessionSettings, nominal_camera, plan_session

Simulated = Callable[..., Capture]
SETTINGS = PRESETS["fast"]


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    """A small capture with hidden effects, made once per set of options."""
    made: dict[str, Capture] = {}

    def make(**options: Any) -> Capture:
        if str(options) not in made:
            folder = tmp_path_factory.mktemp("captures") / "hand"
            usual = {"width": 320, "height": 240, "frames": 10, "seed": 4, "rate_rad_s": 1.6, "exposure_ms": 12.0}
            coding = {"noise_levels": 1.0, "bitrate_bits_per_px": 1.5}
            simulate_command(folder, **{**usual, **coding, **options})
            made[str(options)] = read_capture(folder)
        return made[str(options)]

    return make


def profiles(capture: Capture) -> tuple[CameraProfile, CameraProfile]:
    """Nominal and true profile."""
    return resolve_profile(capture)[0], resolve_profile(capture, capture.folder / "truth" / "camera.yaml")[0]


def restored(
    capture: Capture, plan: RestorationPlan, chosen: slice, frames: tuple[Frame, ...] | None = None
) -> list[RestoredFrame]:
    """The capture's selected frames, restored."""
    frames = frames or capture.frames
    last = frames[chosen][-1].index
    pictures = dict(read_frames(capture.movie, probe_movie(capture.movie), 0, last))
    return list(restore_frames(((f, pictures[f.index]) for f in frames[chosen]), capture.imu, plan))


def psnr_db(capture: Capture, found: RestoredFrame) -> float:
    """PSNR against the truth, within the valid rectangle."""
    truth = cv2.imread(str(capture.folder / "truth" / "frames" / f"{found.frame.index:06d}.png"))
    assert truth is not None
    assert found.picture is not None
    x0, y0, x1, y1 = found.valid_px
    inner = np.s_[y0 + 8 : y1 - 8, x0 + 8 : x1 - 8]
    error = truth[..., ::-1][inner].astype(float) - found.picture[inner]
    return float(10 * np.log10(255**2 / np.mean(error**2)))


def gains_db(capture: Capture, chosen: slice) -> NDArray[np.float64]:
    """PSNR with the true profile minus that with the nominal one, per frame."""
    nominal, true = (
        np.array([psnr_db(capture, f) for f in restored(capture, RestorationPlan(p, SETTINGS), chosen)])
        for p in profiles(capture)
    )
    return true - nominal


@pytest.mark.parametrize(
    ("effect", "options", "least_db"),
    [
        ("stabilisation=0.7,0.8", {}, 5.0),
        ("flicker=0.3,100", {"exposure_ms": 7.0}, 1.5),
        ("defocus=1.2", {}, 1.5),
        ("focal_drift=0.5", {"rate_rad_s": 3.0, "readout_ms": 28.0}, 0.3),
        ("vignetting=0.75", {"rate_rad_s": 3.0, "readout_ms": 28.0}, 0.3),
    ],
)
def test_a_profile_with_the_effect_restores_better(
    simulated: Simulated, effect: str, options: dict[str, Any], least_db: float
) -> None:
    """The mean gain is that of the effect, and no frame loses more than 0.2 dB."""
    gain = gains_db(simulated(effects=[effect], **options), slice(1, 10, 3))
    assert gain.mean() > least_db
    assert gain.min() > -0.2


def test_soft_corners_are_restored_with_their_local_blur(tmp_path: Path) -> None:
    """The local blur of each tile is better than no blur and than the mean blur everywhere."""
    sigma_px, corner_px = 2.4, float(np.hypot(320, 240) / 2)
    nominal = nominal_camera(320, 240, focal_px=260.0, readout_time_s=0.02, response=ResponseCurve("srgb"))
    settings = SessionSettings("leaves", 10, 30.0, exposure_s=(0.01,), rate_rad_s=1.2, noise_levels=1.0, seed=3)
    session = plan_session(nominal, nominal, settings, hidden=Hidden(corner_blur_px=sigma_px))
    write_recording(session, tmp_path / "soft", options=RecordingOptions(bits_per_px=1.5))
    capture = read_capture(tmp_path / "soft")
    radius = np.linspace(0, corner_px, 9)
    values = tuple((sigma_px * (r / corner_px) ** 2,) for r in radius.tolist())
    known = nominal.with_fields([Field("blur", ("radius",), (tuple(radius.tolist()),), values)])
    even = replace(nominal, extensions=replace(nominal.extensions, defocus_sigma_px=0.45 * sigma_px))
    without, right, mean = (
        np.array([psnr_db(capture, f) for f in restored(capture, RestorationPlan(p, SETTINGS), slice(1, 7))])
        for p in (nominal, known, even)
    )
    assert (right - without).mean() > 1.0
    assert (right - mean).mean() > 1.0
    assert min(right - without) > 0


def test_a_gain_of_the_frame_is_kept(simulated: Simulated) -> None:
    """The truth has the frame's gain, and so has the restored frame, with and without the gain in the profile."""
    capture = simulated(effects=["gain_drift=0.15"])
    found = restored(capture, RestorationPlan(profiles(capture)[1], SETTINGS), slice(1, 10, 4))
    assert min(psnr_db(capture, f) for f in found) > 30
    np.testing.assert_array_equal(gains_db(capture, slice(1, 10, 4)), 0)


def test_start_up_frames_are_restored_at_their_true_times(simulated: Simulated) -> None:
    """Frames three periods late are restored better than with their own timestamps."""
    capture = simulated(effects=["stabilisation=0.7,0.8", "frame_lag=0.1,7"], frames=20)
    _, true = profiles(capture)
    plan = RestorationPlan(true, SETTINGS)
    late = at_true_times(capture.frames, true, capture.repeats)
    right = [psnr_db(capture, f) for f in restored(capture, plan, slice(0, 8, 2), late)]
    unaware = tuple(replace(f, skip_reason=None) for f in capture.frames)
    wrong = [psnr_db(capture, f) for f in restored(capture, plan, slice(0, 8, 2), unaware)]
    assert np.mean(right) > np.mean(wrong) + 4
    assert min(right) > 30


def true_poses(capture: Capture) -> tuple[CubicSpline, Slerp]:
    """Position in world axes and rotation from camera to world, at any time."""
    table = np.loadtxt(capture.folder / "truth" / "trajectory.csv", delimiter=",", skiprows=1)
    turn = Slerp(table[:, 0], Rotation.from_quat(table[:, 4:8], scalar_first=True))
    return CubicSpline(table[:, 0], table[:, 1:4]), turn


def true_translations(capture: Capture, profile: CameraProfile) -> dict[int, FrameTranslation]:
    """Velocity, acceleration and scene plane of each frame, from the true trajectory in world axes."""
    position, turn = true_poses(capture)
    plane = json.loads((capture.folder / "truth" / "effects.json").read_text(encoding="utf-8"))["scene_plane"]
    normal, foot = np.array(plane["normal"]), np.array([0, 0, plane["depth_m"]])
    found = {}
    for frame in capture.frames:
        _, at_s = frame_times_s(profile, frame.time_s, frame.exposure_s, SETTINGS.reference)
        to_camera = turn(at_s).as_matrix().T
        nearness = to_camera @ normal / (normal @ (foot - position(at_s)))
        velocity, acceleration = (to_camera @ position(at_s, order) for order in (1, 2))
        found[frame.index] = FrameTranslation(velocity, acceleration, nearness, 1 / nearness[2], "triangulated")
    return found


def test_true_velocity_and_plane_correct_the_sway(simulated: Simulated) -> None:
    """A hand sways by 0.08 m in front of a tilted wall at 1.5 m: restoration is far better than with rotation alone."""
    capture = simulated(depth_m=1.5, sway_m=0.08, tilt_deg=(12, -18), rate_rad_s=0.6, exposure_ms=14.0, seed=7)
    _, true = profiles(capture)
    plan = RestorationPlan(true, SETTINGS)
    moving = replace(plan, translations=true_translations(capture, true))
    turned, moved = (restored(capture, p, slice(1, 10, 3)) for p in (plan, moving))
    gain = [psnr_db(capture, m) - psnr_db(capture, t) for m, t in zip(moved, turned, strict=True)]
    assert np.mean(gain) > 6
    assert turned[0].warnings[0] == "camera translation unknown: rotation only"
    said = moved[0].parameters
    assert said["depth_source"] == "triangulated"
    assert said["depth_m"] == pytest.approx(1.5, abs=0.2)
    position, turn = true_poses(capture)
    start_s = moved[0].frame.time_s + 119.5 / 240 * 0.020
    to_camera = turn(start_s).as_matrix().T
    travelled = to_camera @ (position(start_s + 0.014) - position(start_s))
    np.testing.assert_allclose(
        said["motion"]["delta_position_m"], travelled, atol=1e-4
    )  # the hand's motion also has jerk
    np.testing.assert_allclose(said["motion"]["velocity_m_s"], to_camera @ position(start_s, 1), atol=0.01)
    back = turn(start_s + 0.014).as_matrix().T @ to_camera.T
    end = back @ ([0, 0, said["depth_m"]] - travelled)
    assert true.intrinsics is not None
    length = true.intrinsics.fx_px * np.hypot(*end[:2]) / end[2]
    assert said["blur"]["length_px"] == pytest.approx(length, abs=0.05)
    assert turned[0].parameters["blur"]["length_px"] != pytest.approx(length, abs=0.2)


def test_a_stabilised_frame_does_not_depend_on_the_cut_of_the_log(simulated: Simulated) -> None:
    """A worker with a part of the inertial data gives the same result as one with all of it."""
    capture = simulated(effects=["stabilisation=0.7,0.8"], frames=150, width=160, height=128, rate_rad_s=2.0)
    _, true = profiles(capture)
    plan = RestorationPlan(true, SETTINGS)
    frames = capture.frames[-3:]
    part = cut_imu(capture.imu, frames, plan)
    assert len(part) < 0.9 * len(capture.imu)
    whole = restored(capture, plan, slice(-3, None))
    few = restored(replace(capture, imu=part), plan, slice(-3, None))
    for a, b in zip(whole, few, strict=True):
        assert a.parameters["blur"]["length_px"] == pytest.approx(b.parameters["blur"]["length_px"], abs=1e-4)
        assert a.picture is not None
        assert b.picture is not None
        assert np.abs(a.picture.astype(int) - b.picture).max() <= 1


def test_process_applies_extensions_for_any_number_of_jobs(
    simulated: Simulated, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """With stabiliser and recorder lag, no frame is skipped, the log names both, and the bytes are the same."""
    capture = simulated(effects=["stabilisation=0.7,0.8", "frame_lag=0.1,7"], frames=20)
    config = capture.folder / "truth" / "camera.yaml"
    written = []
    for jobs in (1, 2):
        options = ProcessOptions(tmp_path / str(jobs), SETTINGS, config=config, jobs=jobs, quiet=True)
        with caplog.at_level(logging.INFO, "virest"):
            assert process_captures([str(capture.folder)], options) == 0
        run = tmp_path / str(jobs) / capture.name
        lines = [json.loads(line) for line in (run / "parameters.jsonl").read_text(encoding="utf-8").splitlines()]
        assert {line["status"] for line in lines} == {"restored"}
        written.append([(run / line["output"]).read_bytes() for line in lines])
    assert written[0] == written[1]
    assert len(written[0]) == 20
    assert "stabiliser cancelling 0.7 above 0.8 Hz: followed" in caplog.text
    assert "first 7 frames are used at their true times" in caplog.text
    assert "not applied" not in caplog.text
