"""The geometric ladder on synthetic tracks: it names the hidden causes with their sizes and no others."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from motion.synthetic_tracks import Recording, Setup

from virest.camera.gyro_filter import delay_s
from virest.camera.profile import CameraProfile, Extensions
from virest.diagnosis import candidates
from virest.diagnosis.candidates import SCREEN_POINTS, Candidate, FarStart
from virest.diagnosis.cross_validation import Judged, judge, screen
from virest.diagnosis.findings import Finding, ParameterChange
from virest.diagnosis.geometric_effects import GEOMETRIC_EFFECTS
from virest.diagnosis.geometric_evidence import (
    BLOCK_LENGTHS,
    FULL_LENGTH_PAIRS,
    Evidence,
    Model,
    base_scene,
    capped_rms,
    depth_of,
    loss,
    make_evidence,
)
from virest.diagnosis.geometric_findings import findings_of
from virest.diagnosis.geometric_ladder import SearchContext, _is_simpler, climb
from virest.diagnosis.geometric_verdict import GeometricVerdict
from virest.effects.changes import rotation_between
from virest.inference import profile_terms as terms_of
from virest.inference.parallel import one_by_one
from virest.motion.scene_motion import DirectedMotion, InertialMotion

EFFECT = {effect.name: effect for effect in GEOMETRIC_EFFECTS}
HAND = Setup(seed=61, frames=37, points=15, readout_direction="top_to_bottom", gyro_noise_rad_s=0.001)
WALL = Setup(seed=62, frames=49, points=20, sway_m=0.05, plane_per_m=(0.05, -0.1, 0.6), gyro_noise_rad_s=0.001)

NEAR = replace(WALL, seed=63, frames=31, points=12)


@lru_cache(maxsize=2)
def recorded(setup: Setup) -> Recording:
    """Make each recording only once."""
    return Recording(setup)


def evidence(setup: Setup) -> Evidence:
    """The ladder's input for a recording, with shortened inertial samples to save time."""
    camera = recorded(setup)
    return make_evidence(camera.imu.between(-0.2, camera.stamp_s[-1] + 0.25), camera.observed)


def climbed(setup: Setup, nominal: CameraProfile) -> tuple[GeometricVerdict, list[Finding]]:
    """Climb from a nominal profile."""
    verdict = climb(evidence(setup), nominal, (), ())
    return verdict, findings_of(verdict)


def assert_explained(verdict: GeometricVerdict, noise_px: float) -> None:
    """Only noise is left at the end, whatever the nominal profile left, and the last rung is empty."""
    assert verdict.nominal_rms_px > 1.5 * noise_px
    assert verdict.final_rms_px == pytest.approx(noise_px, rel=0.1)
    assert verdict.rungs[-1].entered is None
    assert [rung.entered for rung in verdict.rungs[:-1]] == [entry.name for entry in verdict.accepted]


def assert_holds(change: ParameterChange, nominal: object, truth: object) -> None:
    """The nominal value is as given, and the truth lies within four deviations of the estimate."""
    np.testing.assert_allclose(change.nominal, nominal)
    assert (np.abs(np.subtract(change.estimate, truth)) < 4 * np.array(change.std)).all()
    assert (np.array(change.std) < 0.3 * np.abs(np.subtract(nominal, truth)).max()).all()


def test_a_true_profile_has_no_cause() -> None:
    """With nothing hidden, no cause is named and both residuals equal the noise."""
    verdict, found = climbed(HAND, recorded(HAND).profile)
    assert found == []
    assert [rung.entered for rung in verdict.rungs] == [None]
    assert verdict.nominal_rms_px == verdict.final_rms_px == pytest.approx(HAND.noise_px, rel=0.1)
    assert verdict.model.profile == recorded(HAND).profile


def test_an_offset_and_a_bias_are_named_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """9 ms and 0.02 rad/s are hidden together, with similar causes as candidates.

    Two rungs and two findings, both right.
    """
    alike = ("time_offset", "timestamp_reference", "readout_time", "gyro_bias", "imu_rotation", "focal_length")
    monkeypatch.setattr(candidates, "GEOMETRIC_EFFECTS", tuple(EFFECT[name] for name in alike))
    truth = recorded(HAND).profile
    wrong_bias = (-0.011, 0.012, -0.009)
    nominal = replace(truth, time_offset_s=0.022, gyro_bias_rad_s=wrong_bias)
    verdict, found = climbed(HAND, nominal)
    assert {finding.name for finding in found} == {"time_offset", "gyro_bias"}
    assert_explained(verdict, HAND.noise_px)
    named = {finding.name: finding for finding in found}
    assert_holds(named["time_offset"].parameters["time_offset_s"], 0.022, truth.time_offset_s)
    assert_holds(named["gyro_bias"].parameters["gyro_bias_rad_s"], wrong_bias, truth.gyro_bias_rad_s)
    for finding in found:
        assert finding.p_value < 1e-5
        assert finding.held_out.after < finding.held_out.before
        assert finding.sentence


def test_a_wrong_readout_direction_is_named() -> None:
    """The profile has the opposite direction: the right one is found without another cause."""
    truth = recorded(HAND).profile
    nominal = replace(truth, shutter=replace(truth.shutter, readout_direction="bottom_to_top"))
    verdict, found = climbed(HAND, nominal)
    assert [finding.name for finding in found] == ["readout_direction"]
    change = found[0].parameters["readout_direction"]
    assert (change.nominal, change.estimate, change.std) == ("bottom_to_top", "top_to_bottom", None)
    assert_explained(verdict, HAND.noise_px)
    assert verdict.model.profile.shutter == truth.shutter


@pytest.mark.parametrize(("travel_rad", "at_end"), [(0.015, "runs_on"), (0.012, "stops"), (None, "runs_on")])
def test_a_stabiliser_is_named_with_its_travel_if_it_reaches_an_end(
    travel_rad: float | None, at_end: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fraction, cutoff and travel hold; a lens that reaches no end has no travel."""
    alike = ("stabilisation", "time_offset", "gyro_scale", "focal_length", "gyro_bias")
    monkeypatch.setattr(candidates, "GEOMETRIC_EFFECTS", tuple(EFFECT[name] for name in alike))
    setup = replace(HAND, seed=90, stabilised=(0.9, 0.4), travel_rad=travel_rad, at_end=at_end)
    truth = recorded(setup).profile
    verdict, found = climbed(setup, replace(truth, extensions=Extensions()))
    assert [finding.name for finding in found] == ["stabilisation"]
    assert_explained(verdict, HAND.noise_px)
    parameters = found[0].parameters
    assert_holds(parameters["fraction"], 0.0, 0.9)
    assert parameters["cutoff_hz"].estimate == pytest.approx(0.4, abs=4 * parameters["cutoff_hz"].std)
    assert ("travel_rad" in parameters) == (", up to " in found[0].sentence) == (travel_rad is not None)
    assert verdict.model.profile.extensions.stabilisation_at_end == at_end
    if travel_rad is not None:
        travel = parameters["travel_rad"]
        assert travel.nominal is None
        assert travel.estimate == pytest.approx(travel_rad, abs=4 * travel.std)
        assert travel.std < 0.02 * travel_rad


@pytest.mark.parametrize(("seed", "scale", "as_pair"), [(81, 1.12, True), (82, 0.9, False)])
def test_two_causes_that_hide_each_other_are_named_together(seed: int, scale: float, as_pair: bool) -> None:
    """A wrong gyroscope scale and a focal length that compensates for it are wrong only for roll.

    Correcting one alone is worse.  as_pair: they enter on one rung; without it other causes may enter first, and are
    removed.
    """
    setup = replace(HAND, seed=seed, frames=61, about=(0.8, 1.0, 1.0), gyro_scale=scale)
    truth = recorded(setup).profile
    lens = truth.intrinsics
    assert lens is not None
    shorter = replace(lens, fx_px=lens.fx_px / scale, fy_px=lens.fy_px / scale)
    nominal = replace(truth, gyro_scale=(1.0, 1.0, 1.0), intrinsics=shorter)
    verdict, found = climbed(setup, nominal)
    named = {finding.name: finding for finding in found}
    assert set(named) == {"gyro_scale", "focal_length"}
    assert verdict.final_rms_px == pytest.approx(setup.noise_px, rel=0.1)
    assert not as_pair or any(rung.has("gyro_scale") and rung.has("focal_length") for rung in verdict.rungs)
    assert_holds(named["gyro_scale"].parameters["gyro_scale"], 1.0, scale)
    assert_holds(named["focal_length"].parameters["focal_scale"], 1.0, scale)
    for finding in found:
        assert finding.held_out.after < 0.8 * finding.held_out.before
        # the noise is the residual of a smooth flow, not that of the fit
        assert finding.held_out.noise == verdict.noise_px != verdict.final_rms_px


@pytest.fixture
def like_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Candidates limited to causes similar to a low-pass filter and non-square pixels; the scenario tests use all."""
    alike = ("time_offset", "readout_time", "gyro_scale", "focal_length", "stabilisation")
    own = (EFFECT[name] for name in (*alike, "gyro_lowpass", "pixel_aspect"))
    monkeypatch.setattr(candidates, "GEOMETRIC_EFFECTS", tuple(own))


@pytest.mark.parametrize("cutoff_hz", [9.0, 18.0])
def test_a_gyroscope_low_pass_is_named(cutoff_hz: float, like_them: None) -> None:
    """The filter delays rates and attenuates fast rotation; a clock offset is tried and not chosen."""
    setup = replace(HAND, seed=85, frames=61, gyro_lowpass_hz=cutoff_hz)
    truth = recorded(setup).profile
    verdict, found = climbed(setup, replace(truth, extensions=replace(truth.extensions, gyro_lowpass_hz=0.0)))
    assert [finding.name for finding in found] == ["gyro_lowpass"]
    assert "time_offset" in verdict.rungs[0].tried
    assert_explained(verdict, HAND.noise_px)
    told = found[0].parameters["gyro_lowpass_hz"]
    assert (told.nominal, told.estimate) == (0.0, pytest.approx(cutoff_hz, rel=0.05))
    assert abs(told.estimate - cutoff_hz) < 4 * told.std


@pytest.mark.parametrize("hidden", ["time_offset", "gyro_lowpass"])
def test_a_low_pass_above_hand_motion_is_reported_as_an_offset(hidden: str, like_them: None) -> None:
    """Below 4 Hz, a cutoff of 90 Hz equals a delay of 2.5 ms to 1e-4.

    The simpler cause is named, with the filter as a rival.
    """
    cutoff_hz, late_s = 90.0, np.sqrt(2) / (2 * np.pi * 90.0)
    setup = replace(HAND, seed=86, gyro_lowpass_hz=cutoff_hz if hidden == "gyro_lowpass" else 0.0)
    truth = recorded(setup).profile
    offset_s = setup.time_offset_s if hidden == "gyro_lowpass" else setup.time_offset_s - late_s
    plain = replace(truth.extensions, gyro_lowpass_hz=0.0)
    _, found = climbed(setup, replace(truth, time_offset_s=offset_s, extensions=plain))
    assert [finding.name for finding in found] == ["time_offset"]
    assert "gyro_lowpass" in {rival.name for rival in found[0].rivals}
    told = found[0].parameters["time_offset_s"]
    assert abs(told.estimate - offset_s - late_s) < 4 * told.std


GYROSCOPES = ("gyro_scale", "gyro_axes", "gyro_bias", "gyro_lowpass", "gyro_averaging", "imu_rotation")


@pytest.fixture
def gyroscopes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Candidates limited to a gyroscope's errors, the clock and the lens."""
    beside = ("time_offset", "readout_time", "focal_length", "radial_distortion", "stabilisation")
    monkeypatch.setattr(candidates, "GEOMETRIC_EFFECTS", tuple(EFFECT[name] for name in (*GYROSCOPES, *beside)))


@pytest.mark.parametrize(
    ("filters", "late_s", "averaging_s"),
    [
        ({"gyro_lag_s": (0.01,)}, 0.01, 0.01),
        ({"gyro_lag_s": (0.006, 0.006)}, 0.012, np.sqrt(2) * 0.006),
        ({"gyro_window_s": 0.03}, 0.0, 0.03 / np.sqrt(12)),
    ],
    ids=["first order", "two equal stages", "mean around its timestamp"],
)
def test_a_gyroscope_filter_of_another_family_is_a_delay_and_an_average(
    filters: dict[str, Any], late_s: float, averaging_s: float, gyroscopes: None
) -> None:
    """The delay and the width of the filter's response are named with their sizes, and neither clock nor scale is."""
    setup = replace(HAND, seed=87, frames=61, **filters)
    verdict, found = climbed(setup, recorded(setup).profile)
    assert {finding.name for finding in found} == {"gyro_averaging", *(["gyro_lowpass"] if late_s else [])}
    assert_explained(verdict, HAND.noise_px)
    told = {finding.name: next(iter(finding.parameters.values())) for finding in found}
    width = told["gyro_averaging"]
    assert abs(width.estimate - averaging_s) < 4 * width.std < 0.2 * averaging_s
    if late_s:
        assert delay_s(told["gyro_lowpass"].estimate) == pytest.approx(late_s, rel=0.03)


@pytest.mark.parametrize("plane_factor", [-3.0, 0.01])
def test_a_judged_cause_does_not_depend_on_where_its_scene_began(plane_factor: float) -> None:
    """From a plane behind the camera, or too far by 100, a fit ends elsewhere; it takes over the better scene."""
    profile, given = replace(recorded(WALL).profile, depth_m=None), evidence(WALL)
    start = Model(profile, None, ())
    scene = base_scene(given, profile, given.table(start, SCREEN_POINTS))
    assert isinstance(scene, InertialMotion)
    astray = replace(scene, plane_per_m=plane_factor * scene.plane_per_m, velocity_m_s=scene.velocity_m_s + 3.0)
    begun = [Candidate(name, replace(start, scene=own), (), None) for name, own in (("near", scene), ("far", astray))]
    near, far = judge(given, screen(given, begun, one_by_one), 1.0, 0.0, one_by_one)
    assert far.rms == pytest.approx(near.rms, rel=0.01)
    assert near.rms < 1.2


@pytest.mark.parametrize(
    ("name", "gained", "rms", "simpler"),
    [
        ("time_offset", 3.2, 1.10, True),
        ("time_offset", 3.2, 1.20, False),
        ("time_offset", 2.5, 1.10, False),
        ("clock_skew", 3.2, 1.10, False),
    ],
    ids=["nearly as good", "leaves more than tracking errors", "gains less", "no simpler alternative"],
)
def test_a_simpler_cause_may_leave_what_tracking_errors_leave(
    name: str, gained: float, rms: float, simpler: bool
) -> None:
    """Blocks that agree on 0.2 of the noise do not exclude it; on 0.5 they do."""
    model = Model(recorded(HAND).profile, None, ())

    def judged(cause: str, loss_left: float, rms_left: float) -> Judged:
        losses = np.full(12, loss_left)
        return Judged(Candidate(cause, model, (), None), losses, losses, losses, rms_left)

    before, best = judged("", 3.5, 10.0), judged("gyro_lowpass", 0.2, 1.07)
    gain = before.block_loss - best.block_loss
    assert _is_simpler(before, best, judged(name, 3.5 - gained, rms), gain) is simpler


def test_axes_that_differ_are_named_and_neither_lens_nor_focal_length_is(gyroscopes: None) -> None:
    """One axis of another scale resembles a focal length; axes that are not perpendicular resemble a rotation."""
    axes = ((1.0, 0.02, 0.0), (0.02, 1.0, -0.015), (0.0, -0.015, 0.93))
    setup = replace(HAND, seed=88, frames=61, gyro_axes=axes)
    verdict, found = climbed(setup, recorded(setup).profile)
    assert {finding.name for finding in found} == {"gyro_axes", "gyro_scale"}
    assert_explained(verdict, HAND.noise_px)
    whole = np.cbrt(0.93)
    told = {finding.name: finding.parameters for finding in found}
    np.testing.assert_allclose(told["gyro_scale"]["gyro_scale"].estimate, whole, atol=0.003)
    np.testing.assert_allclose(told["gyro_axes"]["axis_scale"].estimate, np.array([1, 1, 0.93]) / whole, atol=0.003)
    misalignment = told["gyro_axes"]["misalignment_rad"]
    true_rad = (0.02, 0.0, -0.015 / np.sqrt(0.93))  # rows and columns over the roots of the scales
    assert np.all(np.abs(np.subtract(misalignment.estimate, true_rad)) < 4 * np.array(misalignment.std))


def test_a_clock_offset_is_not_a_low_pass(like_them: None) -> None:
    """An offset of 12 ms, as from a cutoff of 19 Hz, does not attenuate fast rotation."""
    truth = recorded(HAND).profile
    _, found = climbed(HAND, replace(truth, time_offset_s=HAND.time_offset_s - 0.012))
    assert [finding.name for finding in found] == ["time_offset"]
    assert "gyro_lowpass" not in {rival.name for rival in found[0].rivals}


@pytest.mark.parametrize("aspect", [1.05, 0.985])
def test_non_square_pixels_are_named(aspect: float, like_them: None) -> None:
    """Only fy is wrong; neither the focal length nor the gyroscope scale replaces it."""
    setup = replace(HAND, seed=87, pixel_aspect=aspect)
    truth = recorded(setup).profile
    assert truth.intrinsics is not None
    square = replace(truth.intrinsics, fy_px=truth.intrinsics.fx_px)
    verdict, found = climbed(setup, replace(truth, intrinsics=square))
    assert [finding.name for finding in found] == ["pixel_aspect"]
    assert found[0].rivals == ()
    assert verdict.final_rms_px == pytest.approx(HAND.noise_px, rel=0.1)
    assert_holds(found[0].parameters["pixel_aspect"], 1.0, aspect)


def test_a_wide_lens_needs_both_coefficients() -> None:
    """A strong barrel distortion, where k1 alone leaves a residual: both are named, with their own sizes."""
    setup = replace(HAND, seed=89, k1=-0.2, k2=0.07)
    truth = recorded(setup).profile
    assert truth.intrinsics is not None
    verdict, found = climbed(setup, replace(truth, intrinsics=replace(truth.intrinsics, model="none", coefficients=())))
    assert [finding.name for finding in found] == ["radial_distortion", "higher_distortion"]
    assert verdict.final_rms_px == pytest.approx(HAND.noise_px, rel=0.1)
    assert_holds(found[0].parameters["k1"], 0.0, -0.2)
    assert_holds(found[1].parameters["k2"], 0.0, 0.07)


def test_a_stated_distortion_may_lack_its_second_coefficient() -> None:
    """With the right k1 in the profile, k2 alone is named."""
    setup = replace(HAND, seed=90, k1=-0.2, k2=0.07)
    truth = recorded(setup).profile
    assert truth.intrinsics is not None
    stated = replace(truth.intrinsics, coefficients=(-0.2, 0.0, 0.0, 0.0, 0.0))
    _, found = climbed(setup, replace(truth, intrinsics=stated))
    assert [finding.name for finding in found] == ["higher_distortion"]
    assert_holds(found[0].parameters["k2"], 0.0, 0.07)


def test_non_square_pixels_are_found_with_rotation_about_one_axis(like_them: None) -> None:
    """Vertical motion determines fy but hardly fx: the aspect is named, or listed as the focal length's rival."""
    setup = replace(HAND, seed=88, about=(0.0, 0.0, 1.0), pixel_aspect=1.04)
    truth = recorded(setup).profile
    assert truth.intrinsics is not None
    square = replace(truth.intrinsics, fy_px=truth.intrinsics.fx_px)
    _, found = climbed(setup, replace(truth, intrinsics=square))
    assert len(found) == 1
    assert "pixel_aspect" in {found[0].name, *(rival.name for rival in found[0].rivals)}


def wall_m(recording: Recording) -> float:
    """Median over the frames of the wall's distance along the optical axis."""
    middle_s = recording.stamp_s + recording.setup.time_offset_s + 0.014
    sight = recording.orientation(middle_s).apply([0.0, 0.0, 1.0])
    plane, half = np.array(WALL.plane_per_m), len(middle_s) // 2
    moved = recording.position(middle_s) - recording.position(middle_s[half : half + 1])
    return float(np.median((1 - moved @ plane) / (sight @ plane)))


def test_the_depth_of_a_wall_is_found() -> None:
    """The median distance along the optical axis lies within four deviations of the truth."""
    recording, given = recorded(WALL), evidence(WALL)
    profile = replace(recording.profile, depth_m=None)
    model = Model(profile, None, ())
    table = given.table(model, 1500)
    scene = base_scene(given, profile, table)
    assert isinstance(scene, InertialMotion)
    depth_m, std = depth_of(given.fit(replace(model, scene=scene), (), table), table)
    assert abs(depth_m - wall_m(recording)) < 4 * std + 0.01
    assert std < 0.15 * wall_m(recording)


def test_a_wrong_scene_depth_is_named() -> None:
    """Only the depth is named, with an error below 3 %; a wrong plane is not described as relief."""
    recording = recorded(NEAR)
    verdict, found = climbed(NEAR, replace(recording.profile, depth_m=2.9))
    assert [finding.name for finding in found] == ["scene_depth"]
    told = found[0].parameters["depth_m"]
    assert told.nominal == 2.9
    assert told.estimate == pytest.approx(wall_m(recording), rel=0.03)
    assert_explained(verdict, NEAR.noise_px)


def test_beside_bridges_no_depth_is_sought() -> None:
    """Beyond a bridged stretch of the log gravity is uncertain, and so is how far the camera travels."""
    given, profile = evidence(NEAR), replace(recorded(NEAR).profile, depth_m=2.9)
    model = Model(profile, base_scene(given, profile, given.table(Model(profile, None, ()), SCREEN_POINTS)), ())
    plain = SearchContext(given, profile, (), FarStart(), one_by_one)
    bridged = replace(plain, bridged=lambda model: model)
    untrusted = replace(model, profile=replace(profile, imu_untrusted_s=((0.3, 0.4),)))
    sought = [
        {candidate.name for candidate in context.candidates(start, set())}
        for context, start in ((plain, model), (bridged, model), (plain, untrusted))
    ]
    assert "scene_depth" in sought[0]
    assert sought[1:] == [sought[0] - {"scene_depth"}] * 2


def test_varying_exposures_determine_the_exposure_scale() -> None:
    """The middle of each row's exposure moves by half of the exposure error, unlike with an offset."""
    truth = recorded(HAND).profile
    nominal = replace(truth, shutter=replace(truth.shutter, exposure_scale=truth.shutter.exposure_scale / 1.4))
    verdict, found = climbed(HAND, nominal)
    assert [finding.name for finding in found] == ["exposure_time"]
    assert found[0].parameters["exposure_scale"].estimate == pytest.approx(truth.shutter.exposure_scale, rel=0.1)
    assert_explained(verdict, HAND.noise_px)


# ── parts of the ladder ──────────────────────────────────────────────────────────────────────────────────────────


def test_the_scene_model_follows_the_profile() -> None:
    """An infinite depth has no scene; a finite or unknown depth has a plane.

    Without accelerometer each pair has a direction.
    """
    given, profile = evidence(WALL), recorded(WALL).profile
    table = given.table(Model(profile, None, ()), 500)
    assert base_scene(given, replace(profile, depth_m=np.inf), table) is None
    wall = base_scene(given, replace(profile, depth_m=2.5), table)
    assert isinstance(wall, InertialMotion)
    assert np.linalg.norm(wall.plane_per_m[0]) == pytest.approx(0.4)
    assert wall.plane_std_per_m[2] < wall.plane_std_per_m[0]
    blind = replace(given, imu=replace(given.imu, accel_m_s2=np.full_like(given.imu.accel_m_s2, np.nan)))
    free = base_scene(blind, replace(profile, depth_m=None), table)
    assert isinstance(free, DirectedMotion)
    assert len(free.direction) == table.n_pairs


def test_time_blocks_have_different_lengths() -> None:
    """Every pair has a block in rising order.

    Lengths follow the list, shortened for few pairs, and the last block may be cut.
    """
    block = evidence(HAND).block
    assert len(block) == len(recorded(HAND).pairs)
    assert set(np.diff(block)) <= {0, 1}
    counts = np.bincount(block)
    part = min(len(block) / FULL_LENGTH_PAIRS, 1.0)
    np.testing.assert_array_equal(counts[:-1], [round(part * BLOCK_LENGTHS[k % 5]) for k in range(len(counts) - 1)])
    assert len(set(counts[:4])) >= 3


def test_a_lag_shifts_the_timestamps_of_early_frames() -> None:
    """The table's timestamps are those of the content that the early frames show."""
    given = evidence(HAND)
    lag = (0.06, 0.06, 0.03, *[0.0] * 34)
    plain, late = (given.table(Model(recorded(HAND).profile, None, (), lag=way), 10**6) for way in ((), lag))
    np.testing.assert_allclose(late.first_stamp_s - plain.first_stamp_s, np.array(lag)[plain.first])
    np.testing.assert_allclose(late.second_stamp_s - plain.second_stamp_s, np.array(lag)[plain.second])


def test_a_fit_of_some_pairs_is_judged_on_all() -> None:
    """Fitted on the even time blocks, a wrong offset is also corrected on the odd ones, with unit distances."""
    given, profile = evidence(HAND), terms_of.shift_offset(recorded(HAND).profile, np.array([0.006]))
    model = Model(profile, None, ())
    table = given.table(model, 10**6)
    fitted = given.fit(model, (terms_of.TIME_OFFSET,), table, given.block % 2 == 0)
    distance = given.distances(fitted, table, 0.0)
    assert len(distance) == len(table) > len(fitted.distance)
    odd = given.block[table.pair] % 2 == 1
    assert capped_rms(distance[odd]) == pytest.approx(1.0, rel=0.1)
    assert capped_rms(given.distances(given.fit(model, (), table), table, 0.0)[odd]) > 2


def test_lost_tracks_have_little_influence() -> None:
    """2 % of tracks off by 1000 deviations raise the capped RMS by less than 15 % and the loss by less than 0.25."""
    distance = np.random.default_rng(3).rayleigh(1.0, 4000)
    astray = np.where(np.arange(4000) % 50 == 0, 1000.0, distance)
    assert capped_rms(distance) == pytest.approx(1.0, rel=0.03)
    assert capped_rms(astray) < 1.15
    assert loss(astray, 1.0).mean() - loss(distance, 1.0).mean() < 0.25
    assert capped_rms(3 * distance) == pytest.approx(3 * capped_rms(distance))


@pytest.mark.parametrize("effect", [e for e in GEOMETRIC_EFFECTS if e.term is not None], ids=lambda e: e.name)
def test_the_total_change_equals_the_change_of_a_term(effect: object) -> None:
    """The values put into a profile are read back from the two profiles, for every term."""
    entry = EFFECT[effect.name]  # type: ignore[attr-defined]
    assert entry.term is not None
    profile = recorded(HAND).profile
    step = np.array([0.004, -0.007, 0.011, -0.002, 0.005])[: len(entry.term)]
    found = entry.total_change(profile, entry.term.change(profile, step))
    # a stabiliser's cutoff has no zero, and its lean does not belong to the cause
    known = slice(0, 1) if entry.name == "stabilisation" else slice(None)
    np.testing.assert_allclose(found[known], step[known], atol=1e-9)


def test_rotations_between_profiles_are_vectors() -> None:
    """Rotation vectors apply on the left of the nominal mounting and may be large."""
    profile = recorded(HAND).profile
    vector = np.array([0.3, -0.8, 0.5])
    np.testing.assert_allclose(rotation_between(profile, terms_of.rotate_imu(profile, vector)), vector, atol=1e-9)
