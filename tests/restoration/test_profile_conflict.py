"""Profiles contradicted by tracked points: the cause is found and corrected, and a right profile is not changed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from motion.synthetic_tracks import Recording, Setup, recorded

from virest.camera.profile import CameraProfile, Extensions
from virest.image_formation.row_clock import right_way_round
from virest.restoration.capture import RestorationPlan
from virest.restoration.conflict_plan import _with_open_values
from virest.restoration.profile_conflict import Settled, settle_conflict
from virest.restoration.settings import RestorationSettings

HAND = Setup(seed=71, frames=26, points=40, gyro_noise_rad_s=0.002)


def settled(recording: Recording, profile: CameraProfile, *, offset_known: bool = True) -> Settled:
    """The recording's points applied to a profile."""
    return settle_conflict(recording.observed, recording.imu, profile, offset_known=offset_known)


def focal_px(profile: CameraProfile) -> float:
    """The profile's focal length."""
    assert profile.intrinsics is not None
    return profile.intrinsics.fx_px


@pytest.mark.parametrize("factor", [0.55, 1.75])
def test_a_wrong_focal_length_is_corrected(factor: float) -> None:
    """The principal point stays, and the estimate is recorded with its deviation."""
    recording = recorded(HAND)
    lens = recording.profile.intrinsics
    assert lens is not None
    found = settled(recording, replace(recording.profile, intrinsics=lens.scaled_focal(factor)))
    assert found.contradicted
    assert focal_px(found.profile) == pytest.approx(520.0, rel=0.005)
    assert found.profile.intrinsics is not None
    assert found.profile.intrinsics.cx_px == lens.cx_px
    assert found.profile.estimates["fx_px"].std is not None
    assert found.after_px < 1.2 * found.noise_px < found.before_px


def test_a_gyroscope_s_scale_is_not_taken_for_a_focal_length() -> None:
    """In a roll, points do not move with the focal length: the gyroscope scale is found, and the lens stays."""
    recording = recorded(replace(HAND, gyro_scale=1.05))
    found = settled(recording, replace(recording.profile, gyro_scale=(1.0, 1.0, 1.0)))
    assert found.contradicted
    assert found.profile.gyro_scale == pytest.approx((1.05,) * 3, rel=2e-3)
    assert focal_px(found.profile) == pytest.approx(520.0, rel=1e-9)
    assert len(found.taken) == 1
    assert "gyroscope scale" in found.taken[0]
    assert "cannot tell them apart" not in found.taken[0]


def test_indistinguishable_gyroscope_scale_and_focal_length_are_both_named() -> None:
    """With a narrow lens, yaw and pitch determine only the product of focal length and scale."""
    narrow = replace(HAND, seed=72, focal_px=2500.0, rate_rad_s=0.15, about=(0.0, 1.0, 1.0), gyro_scale=1.05)
    recording = recorded(narrow)
    found = settled(recording, replace(recording.profile, gyro_scale=(1.0, 1.0, 1.0)))
    assert len(found.taken) == 1
    assert "gyroscope scale" in found.taken[0]
    assert "focal length" in found.taken[0]
    assert "cannot tell them apart" in found.taken[0]


@pytest.mark.parametrize(("k1", "k2"), [(-0.12, 0.0), (-0.3, 0.16)])
def test_a_distortion_that_the_profile_lacks_is_found(k1: float, k2: float) -> None:
    """Its coefficients are right, focal length and principal point stay, and no other cause is reported."""
    recording = recorded(replace(HAND, k1=k1, k2=k2))
    lens = recording.profile.intrinsics
    assert lens is not None
    plain = replace(lens, model="none", coefficients=())
    found = settled(recording, replace(recording.profile, intrinsics=plain))
    assert ["k1 =" in text or "k2 =" in text for text in found.taken] == [True] * (2 if k2 else 1)
    kept = found.profile.intrinsics
    assert kept is not None
    assert kept.coefficients[:2] == pytest.approx((k1, k2), abs=0.005)
    assert (kept.fx_px, kept.fy_px, kept.cx_px, kept.cy_px) == (lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px)
    assert found.after_px < 1.2 * found.noise_px < found.before_px


@pytest.mark.parametrize("fraction", [0.2])
def test_an_unlisted_stabiliser_is_found(fraction: float) -> None:
    """Fraction and cutoff are right, and no other cause is reported."""
    recording = recorded(replace(HAND, stabilised=(fraction, 0.8)))
    found = settled(recording, replace(recording.profile, extensions=Extensions()))
    assert found.profile.extensions.stabilisation_fraction == pytest.approx(fraction, abs=0.02)
    assert found.profile.extensions.stabilisation_cutoff_hz == pytest.approx(0.8, rel=0.15)
    assert len(found.taken) == 1
    assert set(found.profile.estimates) == {"stabilisation_fraction", "stabilisation_cutoff_hz"}


@pytest.mark.parametrize(
    ("fraction", "travel_rad", "cutoff_hz", "at_end"),
    [(0.9, 0.012, 0.5, "runs_on"), (1.0, 0.02, 0.3, "runs_on"), (0.9, 0.013, 0.4, "stops")],
)
def test_a_stabiliser_at_the_end_of_its_travel_is_found(
    fraction: float, travel_rad: float, cutoff_hz: float, at_end: str
) -> None:
    """The lens rests at an end for part of the time; one without ends explains little of the motion."""
    recording = recorded(replace(HAND, stabilised=(fraction, cutoff_hz), travel_rad=travel_rad, at_end=at_end))
    assert 0.1 < np.isclose(np.abs(recording._shift[1]), travel_rad).mean() < 0.9
    found = settled(recording, replace(recording.profile, extensions=Extensions()))
    ext = found.profile.extensions
    assert ext.stabilisation_fraction == pytest.approx(fraction, abs=0.03)
    assert ext.stabilisation_cutoff_hz == pytest.approx(cutoff_hz, rel=0.15)
    assert ext.stabilisation_at_end == at_end
    assert ext.stabilisation_travel_rad == pytest.approx(travel_rad, rel=0.03)
    assert found.after_px < 1.2 * found.noise_px < found.before_px
    assert "rad, used instead" in found.taken[0]


@pytest.mark.parametrize("seed", [71, 73, 75])
def test_a_stabiliser_with_a_very_low_cutoff_is_found(seed: int) -> None:
    """Half a second cannot resolve a cutoff below 1 Hz; the fraction is still found."""
    recording = recorded(replace(HAND, seed=seed, frames=16, stabilised=(0.2, 0.002)))
    found = settled(recording, replace(recording.profile, extensions=Extensions()))
    assert found.profile.extensions.stabilisation_fraction == pytest.approx(0.2, abs=0.03)
    assert found.after_px < 1.3 * found.noise_px
    assert focal_px(found.profile) == pytest.approx(520.0, rel=1e-9)


def test_drifting_clocks_are_found_with_and_without_a_known_offset() -> None:
    """The skew is 0.01 over less than 2 s; an unknown offset is fitted too."""
    recording = recorded(replace(HAND, clock_skew=0.01, frames=50, points=25))
    given = replace(recording.profile, clock_skew=0.0)
    assert settled(recording, given).profile.clock_skew == pytest.approx(0.01, abs=3e-4)
    started = replace(given, time_offset_s=0.021)
    found = settled(recording, started, offset_known=False)
    assert found.profile.clock_skew == pytest.approx(0.01, abs=3e-4)
    assert found.offset is not None
    assert found.offset[0] == pytest.approx(0.013, abs=5e-4)


def test_a_stabiliser_and_a_wrong_focal_length_are_separated() -> None:
    """The two causes enter one after the other."""
    recording = recorded(replace(HAND, stabilised=(0.5, 1.0)))
    lens = recording.profile.intrinsics
    assert lens is not None
    given = replace(recording.profile, extensions=Extensions(), intrinsics=lens.scaled_focal(0.85))
    found = settled(recording, given)
    assert focal_px(found.profile) == pytest.approx(520.0, rel=0.01)
    assert found.profile.extensions.stabilisation_fraction == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize("only_readout", [False, True])
@pytest.mark.parametrize("factor", [0.5, 1.4, -1.0], ids=["half", "too long", "reversed"])
def test_a_wrong_readout_is_corrected(factor: float, only_readout: bool) -> None:
    """The true readout is found to its deviation, and with an unknown offset the true offset too."""
    recording = recorded(HAND)
    true = recording.profile.shutter
    wrong = right_way_round(recording.profile.with_shutter(readout_time_s=factor * true.readout_time_s))
    given = replace(wrong, time_offset_s=recording.profile.time_offset_s)
    found = settle_conflict(recording.observed, recording.imu, given, offset_known=False, only_readout=only_readout)
    assert len(found.taken) == 1
    assert "readout time" in found.taken[0]
    shutter, estimate = found.profile.shutter, found.profile.estimates["readout_time_s"]
    assert abs(shutter.readout_time_s - true.readout_time_s) < 3 * estimate.std < 1e-3
    assert shutter.readout_direction == true.readout_direction
    assert ("readout_direction" in found.profile.estimates) == (factor < 0)
    assert found.offset is not None
    assert abs(found.offset[0] - (recording.profile.time_offset_s or 0.0)) < 3 * found.offset[1] < 2e-3


def test_no_readout_is_longer_than_a_frame() -> None:
    """Points that such a readout would explain change nothing."""
    recording = recorded(replace(HAND, readout_time_s=1.3 / 30))
    given = recording.profile.with_shutter(readout_time_s=0.9 / 30)
    assert not settled(recording, given).taken


def test_a_readout_along_the_wrong_axis_is_corrected() -> None:
    """Columns given as rows."""
    recording = recorded(HAND)
    true = recording.profile.shutter
    wrong = "top_to_bottom" if true.reads_columns else "left_to_right"
    found = settled(recording, recording.profile.with_shutter(readout_direction=wrong))
    assert found.profile.shutter.readout_direction == true.readout_direction
    assert found.profile.shutter.readout_time_s == pytest.approx(true.readout_time_s, abs=5e-4)
    assert len(found.taken) == 1
    assert found.after_px < 1.2 * found.noise_px < found.before_px


@pytest.mark.parametrize(
    "setup",
    [
        HAND,
        replace(HAND, outliers=0.2),
        replace(HAND, gyro_bias_rad_s=(0.03, -0.02, 0.01)),
        replace(HAND, rate_rad_s=0.05),
    ],
    ids=["right", "moving object", "gyroscope's bias", "hardly moving"],
)
def test_a_right_profile_is_not_changed(setup: Setup) -> None:
    """Moving objects, a bias and a camera nearly at rest give no correction."""
    recording = recorded(setup)
    given = replace(recording.profile, gyro_bias_rad_s=HAND.gyro_bias_rad_s)
    found = settled(recording, given)
    assert not found.taken
    assert found.profile is given


def test_an_unexplained_conflict_changes_nothing() -> None:
    """With another recording's gyroscope, the profile stays and is reported as contradicted."""
    recording, stranger = recorded(HAND), recorded(replace(HAND, seed=72))
    found = settle_conflict(recording.observed, stranger.imu, recording.profile, offset_known=True)
    assert found.contradicted
    assert found.profile is recording.profile


def test_a_lens_found_beside_an_unknown_focal_length_is_kept() -> None:
    """The focal length is that of the points, and the distortion stays."""
    profile = replace(recorded(Setup(seed=3, frames=6)).profile, time_offset_s=None)
    lens = profile.intrinsics
    assert lens is not None
    bent = replace(profile, intrinsics=replace(lens, model="radtan", coefficients=(-0.2, 0.05, 0.0, 0.0, 0.0)))
    found = Settled(bent, True, ("k1 of -0.2 is used",), 2.0, 0.1, 0.1, (0.004, 1e-4), 10.0, (410.0, 1.5))
    plan = _with_open_values(RestorationPlan(replace(profile, intrinsics=None), RestorationSettings()), found)
    assert plan.profile.intrinsics is not None
    assert plan.profile.intrinsics.coefficients == (-0.2, 0.05, 0.0, 0.0, 0.0)
    assert plan.profile.intrinsics.fx_px == pytest.approx(410.0)
    assert plan.profile.estimates["fx_px"].std == 1.5
