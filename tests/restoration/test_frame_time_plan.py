"""Plans for captures whose stamps jitter, or whose exposure times are in other frames' rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from virest.app.simulate import simulate_command
from virest.camera.profile import CameraProfile
from virest.camera.profile_file import read_profile, write_profile
from virest.capture.folder import read_capture, resolve_profile
from virest.capture.records import Capture
from virest.capture.video import probe_movie, read_decodable_gray
from virest.image_formation.row_clock import RowClock
from virest.inference.frame_exposures import OwnExposures
from virest.restoration.capture import RestorationPlan, at_true_times
from virest.restoration.capture_estimation import plan_restoration
from virest.restoration.plan_notes import NoteCode
from virest.restoration.settings import PRESETS
from virest.simulation.session import nominal_camera

Film = Callable[[Capture], RestorationPlan]
FRAMES = 40


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """A hand-held capture whose exposure differs from frame to frame."""
    folder = tmp_path_factory.mktemp("captures") / "hand"
    simulate_command(
        folder, width=320, height=240, frames=FRAMES, seed=8, rate_rad_s=1.2, exposure_ms=[3.0, 12.0, 6.0, 18.0, 9.0],
        noise_levels=1.0, bitrate_bits_per_px=1.5,
    )  # fmt: skip
    return read_capture(folder)


def planned(capture: Capture, profile: CameraProfile | None = None) -> RestorationPlan:
    """The plan of ``process --deblur none``, which needs no statistics of blur."""
    read = partial(read_decodable_gray, capture.movie, probe_movie(capture.movie))
    settings = replace(PRESETS["fast"], deblur="none")
    return plan_restoration(capture, profile or resolve_profile(capture)[0], settings, read)


def said(plan: RestorationPlan) -> list[str]:
    """Notes about the times of frames."""
    return [note.text for note in plan.said if note.code is NoteCode.TRUE_TIMES]


def middles_s(capture: Capture, plan: RestorationPlan) -> np.ndarray:
    """Mid-exposure of the middle rows by a plan, IMU clock."""
    frames = OwnExposures.stated_by(plan.profile).of(capture.frames)
    stamp_s, exposure_s = (np.array([getattr(f, name) for f in frames]) for name in ("time_s", "exposure_s"))
    return np.asarray(RowClock(plan.profile).middle_s(stamp_s, exposure_s))


def test_right_stamps_and_exposures_stay(capture: Capture) -> None:
    """No note, no delay, no shift of rows."""
    plan = planned(capture)
    assert not said(plan)
    assert not plan.profile.extensions.field
    assert plan.profile.extensions.exposures_late_frames == 0


def test_frames_with_jittering_stamps_are_used_when_their_points_were_seen(capture: Capture) -> None:
    """Nine tenths of a jitter of 4 ms are removed, and the note says how large it was."""
    right = middles_s(capture, planned(capture))
    jitter_s = np.random.default_rng(3).normal(0, 0.004, FRAMES)
    moved = tuple(replace(f, time_s=f.time_s + float(jitter_s[f.index])) for f in capture.frames)
    shaken = replace(capture, frames=moved)
    plan = planned(shaken)
    (text,) = said(plan)
    assert "stamps differ from frame to frame" in text
    off_s = middles_s(shaken, plan) - right
    assert np.std(off_s) < 0.1 * np.std(jitter_s)
    (field,) = plan.profile.extensions.field
    assert field.stamp_0_ns == capture.stamp_0_ns
    late_s, std_s = np.array(field.values)[:, 0], np.array(field.std)[:, 0]
    assert np.mean(np.abs(late_s + jitter_s - np.mean(late_s + jitter_s)) < 2 * std_s) > 0.85


def test_a_profile_gives_frames_the_exposures_that_the_log_lacks(capture: Capture) -> None:
    """The log has one exposure for all frames; with the profile's factors the plan is that of the right log."""
    own_s = np.array([frame.exposure_s for frame in capture.frames], float)
    flat = replace(capture, frames=tuple(replace(frame, exposure_s=0.01) for frame in capture.frames))
    gain = tuple((own_s / 0.01).tolist())
    plan = planned(flat, resolve_profile(capture)[0].with_extensions(exposure_gain=gain))
    assert not said(plan)
    assert plan.profile.extensions.exposure_gain == gain
    np.testing.assert_allclose(middles_s(flat, plan), middles_s(capture, planned(capture)), atol=1e-9)


def test_exposures_that_the_log_lacks_follow_the_brightness(capture: Capture) -> None:
    """The log has one exposure, and the ISO values of exposures that differ: factors up to a common one."""
    own_s = np.array([frame.exposure_s for frame in capture.frames], float)
    flat = replace(capture, frames=tuple(replace(frame, exposure_s=0.01) for frame in capture.frames))
    plan = planned(flat)
    assert "differ from the logged ones as brightness does" in said(plan)[-1]
    factors = np.array(plan.profile.extensions.exposure_gain) / (own_s / own_s.mean())
    assert np.ptp(factors) < 0.1
    right_s = middles_s(capture, planned(capture))
    assert np.std(middles_s(flat, plan) - right_s) < 0.1 * np.std(own_s / 2)


def test_exposures_that_change_slowly_unlogged_follow_the_brightness(tmp_path: Path) -> None:
    """No frame is late by itself: the brightness says how the exposures may have changed, the points that they did."""
    simulate_command(
        tmp_path / "hand", width=320, height=240, frames=FRAMES, seed=9, rate_rad_s=1.5, exposure_ms=12.0,
        noise_levels=1.0, bitrate_bits_per_px=1.5,
    )  # fmt: skip
    right = read_capture(tmp_path / "hand")
    factor = 1 + 0.5 * np.sin(2 * np.pi * np.arange(FRAMES) / FRAMES)
    logged = tuple(replace(f, exposure_s=0.012 * float(factor[f.index])) for f in right.frames)
    plan = planned(replace(right, frames=logged))
    assert "differ from the logged ones as brightness does" in said(plan)[-1]
    np.testing.assert_allclose(np.ptp(np.log(np.array(plan.profile.extensions.exposure_gain) * factor)), 0, atol=0.05)


@pytest.mark.scenario
@pytest.mark.parametrize("hidden", ["exposures", "stamps"])
def test_the_length_of_blur_tells_exposures_from_stamps(tmp_path: Path, hidden: str) -> None:
    """Both delay frames alike where gains compensate for the exposures; each is found where it is true."""
    simulate_command(
        tmp_path / "hand", width=320, height=240, frames=FRAMES, seed=10, rate_rad_s=2.0, noise_levels=1.0,
        bitrate_bits_per_px=1.5, exposure_ms=[8.0, 8.0, 8.0, 16.0, 16.0, 16.0] if hidden == "exposures" else 12.0,
    )  # fmt: skip
    right = read_capture(tmp_path / "hand")
    late_s = np.where(np.arange(FRAMES) % 6 < 3, -0.002, 0.002)
    own_s = np.array([frame.exposure_s for frame in right.frames], float)
    if hidden == "exposures":
        told = [replace(f, exposure_s=0.012, iso=f.iso * own_s[f.index] / 0.012) for f in right.frames]
    else:
        told = [replace(f, time_s=f.time_s - float(late_s[f.index])) for f in right.frames]
    capture = replace(right, frames=tuple(told))
    read = partial(read_decodable_gray, capture.movie, probe_movie(capture.movie))
    plan = plan_restoration(capture, resolve_profile(capture)[0], PRESETS["fast"], read)
    (*_, text) = said(plan)
    if hidden == "stamps":
        assert "stamps differ from frame to frame" in text
        assert not plan.profile.extensions.exposure_gain
    else:
        assert "exposure times differ from the logged ones as frames are late" in text
        np.testing.assert_allclose(np.array(plan.profile.extensions.exposure_gain) * 0.012, own_s, atol=0.0012)


def test_exposures_in_other_rows_are_given_back_to_their_frames(capture: Capture) -> None:
    """The plan's profile says by how many rows, and a run with that profile finds no more of them.

    The last frames, whose rows were never written, may be given delays of their own.
    """
    rows = 2
    late = replace(capture, frames=OwnExposures(-rows).of(capture.frames))
    plan = planned(late)
    assert f"logged {abs(rows)} frame" in said(plan)[-1]
    assert plan.profile.extensions.exposures_late_frames == rows
    again = planned(late, resolve_profile(capture)[0].with_extensions(exposures_late_frames=rows))
    assert not any("logged" in text for text in said(again))
    assert again.profile.extensions.exposures_late_frames == rows
    off_s = (middles_s(late, again) - middles_s(capture, planned(capture)))[2:-2]
    assert np.sqrt(np.mean(off_s**2)) < 1.5e-4  # mid-exposures were off by 4 ms
    assert np.abs(off_s).max() < 4e-4


def test_delays_of_single_frames_are_taken_as_they_are_and_completed(capture: Capture) -> None:
    """A diagnosis keeps frames back; a spline through the other frames' jitter says nothing about theirs."""
    jitter_s = np.random.default_rng(4).normal(0, 0.004, FRAMES)
    moved = tuple(replace(f, time_s=f.time_s + float(jitter_s[f.index])) for f in capture.frames)
    shaken = replace(capture, frames=moved)
    found = planned(shaken)
    (field,) = found.profile.fields
    whole = resolve_profile(capture)[0].with_fields([field])
    assert not said(planned(shaken, whole))
    left_out = np.array([6, 7, 20, 33])
    kept = np.setdiff1d(np.arange(FRAMES), left_out)
    knots, values, std = (np.array(part) for part in (field.knots[0], field.values, field.std))
    assert len(knots) == FRAMES
    rows = [tuple(map(tuple, part[kept].tolist())) for part in (values + 0.0005, std)]
    less = replace(field, knots=(tuple(knots[kept].tolist()),), values=rows[0], std=rows[1])
    plan = planned(shaken, whole.with_fields([less]))
    (text,) = said(plan)
    assert text.startswith("4 frames that the profile gives no delay")
    (completed,) = plan.profile.fields
    off_s = completed.at_time(knots)[:, 0] - field.at_time(knots)[:, 0] - 0.0005
    assert np.abs(off_s[kept]).max() < 1e-5
    assert np.abs(off_s[left_out]).max() < 3e-4
    spline_s = less.at_time(knots[left_out])[:, 0] - field.at_time(knots[left_out])[:, 0]
    assert np.abs(spline_s).max() > 2e-3
    curve = replace(less, knots=(tuple(knots[::4].tolist()),), values=rows[0][:10], std=rows[1][:10])
    assert not said(planned(shaken, whole.with_fields([curve])))


def test_simulate_logs_exposures_without_the_gain_of_the_profile(tmp_path: Path) -> None:
    """Reading the log with that profile gives each frame the exposure that it was taken with."""
    gain = (0.5, 2.0, 1.25)
    camera = nominal_camera(64, 48).with_extensions(exposure_gain=gain)
    simulate_command(tmp_path / "off", frames=5, profile=camera, exposure_ms=[4.0], rate_rad_s=0.5, seed=3)
    off = read_capture(tmp_path / "off")
    exposures_ms = [[1e3 * (f.exposure_s or 0.0) for f in frames] for frames in (off.frames, at_true_times(
        off.frames, resolve_profile(off)[0]))]  # fmt: skip
    np.testing.assert_allclose(exposures_ms, [[8.0, 2.0, 3.2, 4.0, 4.0], [4.0] * 5], rtol=1e-6)


def test_simulate_logs_exposures_as_late_as_the_profile_says(tmp_path: Path) -> None:
    """Row k holds the exposure of frame k − 2, and reading it with that profile gives each frame its own."""
    exposures_ms = [3.0, 12.0, 6.0, 18.0, 9.0]
    camera = nominal_camera(64, 48).with_extensions(exposures_late_frames=2)
    simulate_command(tmp_path / "late", frames=10, profile=camera, exposure_ms=exposures_ms, rate_rad_s=0.5, seed=3)
    late = read_capture(tmp_path / "late")
    logged_ms = [1e3 * (frame.exposure_s or 0.0) for frame in late.frames]
    np.testing.assert_allclose(logged_ms[2:], (2 * exposures_ms)[:8])
    own = at_true_times(late.frames, resolve_profile(late)[0])
    np.testing.assert_allclose([1e3 * (frame.exposure_s or 0.0) for frame in own[:8]], (2 * exposures_ms)[:8])


def test_the_file_of_a_profile_keeps_the_rows(tmp_path: Path, capture: Capture) -> None:
    """``exposures_late_frames`` is written and read."""
    profile = resolve_profile(capture)[0].with_extensions(exposures_late_frames=-2)
    write_profile(profile, tmp_path / "camera.yaml")
    assert read_profile(tmp_path / "camera.yaml").extensions.exposures_late_frames == -2
