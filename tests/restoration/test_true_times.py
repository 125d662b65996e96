"""Frames of the recorder's start-up at the times of what they show, and a plan's lines about profile extensions."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
from laws import TurningCamera, phone

from virest.camera.profile import CameraProfile, Extensions
from virest.capture.records import NO_IMU, STARTUP, Frame
from virest.image_formation.row_motion import FrameTranslation, row_motion
from virest.motion.optics import moving_lens
from virest.restoration.capture import RestorationPlan, at_true_times
from virest.restoration.capture_estimation import applied_extensions, resting_points
from virest.restoration.settings import RestorationSettings


def frames(count: int) -> tuple[Frame, ...]:
    """Frames at 25 Hz with different exposures; the first four are left out as start-up."""
    made = [Frame(k, 10**9 + k, 0.04 * k, 0.001 * (k + 1)) for k in range(count)]
    return tuple(replace(f, skip_reason="start-up", skip_codes=(STARTUP,)) if f.index < 4 else f for f in made)


def lagging(lag_s: float, slots: int) -> CameraProfile:
    """A phone whose recorder starts late."""
    return replace(phone(), extensions=Extensions(frame_lag_s=lag_s, frame_lag_frames=slots))


def shown(found: tuple[Frame, ...]) -> list[int]:
    """Numbers of the captures that the slots show, by their times."""
    return np.rint([frame.time_s / 0.04 for frame in found]).astype(int).tolist()


def test_evenly_spread_repeats_use_up_a_lag_of_two() -> None:
    """Slot k shows capture k + 2 minus the repeats so far. The repeats are slots 3 and 6: 2 3 4 4 5 6 6 7 8."""
    found = at_true_times(frames(9), lagging(0.08, 6))
    assert shown(found) == [2, 3, 4, 4, 5, 6, 6, 7, 8]
    np.testing.assert_allclose([f.exposure_s for f in found], 0.001 * (np.array(shown(found)) + 1))
    assert [f.timestamp_ns for f in found] == [10**9 + k for k in range(9)]
    assert not any(f.skip_reason for f in found)


def test_observed_repeats_count_if_they_match_the_lag() -> None:
    """Repeats seen at 1 and 4 are used. A single one, or one after the start-up, says nothing about the others."""
    assert shown(at_true_times(frames(9), lagging(0.08, 6), (1, 4)))[:7] == [2, 2, 3, 4, 4, 5, 6]
    assert shown(at_true_times(frames(9), lagging(0.08, 6), (1,)))[:7] == [2, 3, 4, 4, 5, 6, 6]
    assert shown(at_true_times(frames(9), lagging(0.08, 6), (1, 8)))[:7] == [2, 3, 4, 4, 5, 6, 6]


def test_captures_after_the_movie_follow_its_period() -> None:
    """A movie that ends during start-up shows captures without timestamps of their own."""
    found = at_true_times(frames(4), lagging(0.12, 9))
    assert shown(found) == [3, 4, 5, 5]
    assert found[2].exposure_s == 0.004


def test_a_lag_longer_than_the_movie_remains_at_its_end() -> None:
    """Repeats at 2 and 8 use up two of 3.5 periods; the last slots still lag by 1.5."""
    found = at_true_times(frames(10), lagging(0.14, 8), (2, 8))
    shows = np.array([frame.time_s / 0.04 for frame in found])
    np.testing.assert_allclose(shows, np.arange(10) + 3.5 - np.array([0, 0, 1, 1, 1, 1, 1, 1, 2, 2]), atol=1e-9)


def test_without_a_lag_nothing_changes() -> None:
    """With a lag, frames left out for another reason stay left out."""
    assert at_true_times(frames(6), phone()) == frames(6)
    mixed = (replace(frames(9)[0], skip_codes=(STARTUP, NO_IMU)), *frames(9)[1:])
    found = at_true_times(mixed, lagging(0.08, 6))
    assert [f.index for f in found if f.skip_reason] == [0]


def test_a_plan_lists_applied_extensions() -> None:
    """It has one line per active extension."""
    assert applied_extensions(phone()) == ()
    profile = replace(phone(), extensions=Extensions(defocus_sigma_px=1.3, gain=(1.0, 0.9, 1.1)))
    lines = applied_extensions(profile)
    assert len(lines) == 2
    assert "gain of 3 frames" in lines[0]
    assert "1.3 px" in lines[1]


def test_a_worker_gets_the_translations_of_its_frames() -> None:
    """A plan without translations is returned as it is; a plan with them survives pickling."""
    still = FrameTranslation(np.zeros(3), np.zeros(3), np.array([0, 0, 0.5]), 2.0, "profile")
    plan = RestorationPlan(phone(), RestorationSettings())
    assert plan.of(frames(3)) is plan
    known = replace(plan, translations={k: replace(still, depth_m=2.0 + k) for k in range(5)})
    sent = pickle.loads(pickle.dumps(known.of(frames(9)[3:])))
    assert {k: t.depth_m for k, t in sent.translations.items()} == {3: 5.0, 4: 6.0}


def test_tracks_are_converted_to_a_lens_at_rest() -> None:
    """A still point moved by the stabiliser has one place after conversion, whichever row and frame sees it."""
    turning = TurningCamera(phone(readout_direction="right_to_left"), rate_rad_s=(0.35, -0.8, 0.5))
    held = replace(turning.profile.extensions, stabilisation_fraction=0.6, focal_drift_per_s=0.2)
    profile = replace(turning.profile, extensions=held)
    motion = row_motion(turning.trajectory, profile, 0.1, 0.012)
    rays = profile.intrinsics.rays(np.array([[30.0, 110.0], [160.0, 40.0]]))
    seen = motion.optics.lens.project(rays)
    for _ in range(30):
        seen = motion.optics.project(rays, motion.row_time_s(seen, 0.0) + 0.5 * motion.exposure_s)
    lens = moving_lens(turning.trajectory, profile)
    resting = resting_points(lens, profile, Frame(0, 10**9, 0.1, 0.012), seen)
    np.testing.assert_allclose(resting, [[30, 110], [160, 40]], atol=1e-6)
    assert np.abs(seen - resting).max() > 1
