"""Effects outside the catalogue are described by the right covariate, shape and size, without false alarms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np
import pytest
from diagnosis.strange_phone import Strange, StrangePhone
from motion.synthetic_tracks import Setup
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from virest.calibration.geometry import calibrate_geometry
from virest.camera.field import Field, cardinal_weights
from virest.camera.profile import CameraProfile
from virest.camera.profile_file import parse_profile, profile_mapping
from virest.capture.imu import ImuSamples
from virest.capture.profile_source import focus_log
from virest.diagnosis.ambiguities import merged
from virest.diagnosis.field.bridging import (
    LEAST_PAIRS_LEFT,
    Bridges,
    Doubtful,
    doubtful_pairs,
    pair_medians,
    with_bridges,
)
from virest.diagnosis.field.contradicted import (
    climb_with_bridges,
    contradicted_stretches,
    known_stretches,
    spans_of_outliers,
    with_fields_or_bridges,
)
from virest.diagnosis.field.design import point_residuals
from virest.diagnosis.field.form_list import form_of_late_frames, forms_of_pairs
from virest.diagnosis.field.records import Distrusted
from virest.diagnosis.field.search import is_believable
from virest.diagnosis.field.stretches import bridging_form
from virest.diagnosis.field.sudden import best_instant, sudden_change
from virest.diagnosis.field.words import finding_of
from virest.diagnosis.findings import FieldFinding
from virest.diagnosis.geometric_evidence import Evidence, Model, base_scene, make_evidence
from virest.diagnosis.geometric_ladder import climb
from virest.diagnosis.geometric_verdict import GeometricVerdict
from virest.diagnosis.ladder import with_exposure_of
from virest.diagnosis.picture_ladder import PictureVerdict
from virest.image_formation.point_model import TrackTable
from virest.inference.doubtful_log import Stretch, doubtful_stretches
from virest.inference.log_bridges import KNOT_STEP_S
from virest.inference.profile_terms import FOCAL_DRIFT, GYRO_BIAS, K1, PRINCIPAL_POINT
from virest.inference.term import slopes_of
from virest.inference.track_fit import Term, TrackFit
from virest.motion.integration import missing_rate_rad_s

HAND = Setup(
    seed=71, frames=61, points=12, width=640, height=480, centre_px=(323.0, 236.0), readout_direction="top_to_bottom",
    gyro_noise_rad_s=0.001, rate_rad_s=0.8, exposure_swing=0.0,
)  # fmt: skip
PER_FORCE = np.array([[0.006, -0.003, 0.0045], [0.0015, 0.0075, -0.003], [-0.0045, 0.003, 0.006]])


def late_s(fraction):
    """A parabola over the row with a maximum of 2 ms."""
    return 0.008 * fraction * (1 - fraction)


def warming(time_s):
    """A focal length that settles at a 2 % larger value."""
    return 0.02 * (1 - np.exp(-np.maximum(time_s, 0) / 0.7))


def focus_dioptres(time_s):
    """A change of focus in the middle of the capture."""
    return 0.5 + 2 / (1 + np.exp(-(time_s - 1.0) / 0.3))


def filled(from_s, to_s):
    """Lost readings filled by linear interpolation."""

    def log(time_s, reading, _force):
        inside = np.flatnonzero((time_s >= from_s) & (time_s <= to_s))
        reading = reading.copy()
        reading[inside] = np.linspace(reading[inside[0]], reading[inside[-1]], len(inside))
        return reading

    return log


def judged(
    phone: StrangePhone, nominal: CameraProfile, rungs: int = 0, fitted: tuple[Term, ...] = ()
) -> tuple[GeometricVerdict, list[FieldFinding]]:
    """Fields after a ladder of some rungs, as in a diagnosis; ``fitted`` lists terms included from the start."""
    capture = phone.capture

    def climbing(evidence: Evidence, bridged: Callable[[Model], Model] | None) -> GeometricVerdict:
        return climb(evidence, nominal, fitted, (), max_rungs=rungs, bridged=bridged)

    found = climb_with_bridges(phone.observed, capture, nominal, climbing)
    found = with_fields_or_bridges(found, capture, nominal)
    return found, [finding_of(entry, found.noise_px) for entry in found.fields]


def fitted_to(phone: StrangePhone) -> tuple[Evidence, TrackFit, TrackTable]:
    """The phone's points, fitted with its own profile."""
    evidence = make_evidence(phone.capture.imu, phone.observed)
    model = Model(phone.profile, None, ())
    table = evidence.table(model, 6000)
    return evidence, evidence.fit(model, (), table), table


def gained(field: FieldFinding) -> float:
    """Part of the held-out excess over the true noise that a field removes."""
    before, after = (rms**2 - HAND.noise_px**2 for rms in (field.held_out.before, field.held_out.after))
    return 1 - after / before


def error(found: FieldFinding, truth) -> float:
    """Largest difference between a field and the truth over its range, relative to the truth's range."""
    along = np.linspace(found.fields[0].knots[0][0], found.fields[0].knots[0][-1], 50)
    wanted = truth(along)
    return float(np.abs(found.fields[0].at(along)[:, 0] - wanted).max() / np.ptp(wanted))


def test_an_uneven_readout_is_a_delay_over_the_row() -> None:
    """The parabola is recovered, removes most of the excess error, and is described in words."""
    phone = StrangePhone(HAND, Strange(late_s=late_s))
    verdict, (field,) = judged(phone, phone.profile)
    assert (field.kind, field.covariates, field.shape) == ("delay", ("row",), "a parabola")
    assert error(field, late_s) < 0.1
    assert gained(field) > 0.8
    assert verdict.final_rms_px == pytest.approx(HAND.noise_px, rel=0.1)
    assert "late by up to 2" in field.sentence
    assert "in the middle of the readout, a parabola of the row: lines are not read evenly" in field.sentence


def test_a_named_cause_beside_an_unknown_one_keeps_its_name_and_size() -> None:
    """An offset of 6 ms beside an uneven readout: both are found with their own sizes."""
    phone = StrangePhone(replace(HAND, seed=72), Strange(late_s=late_s))
    nominal = replace(phone.profile, time_offset_s=phone.setup.time_offset_s - 0.006)
    verdict, (field,) = judged(phone, nominal, rungs=1)
    assert [entry.name for entry in verdict.accepted] == ["time_offset"]
    assert verdict.model.profile.time_offset_s == pytest.approx(phone.setup.time_offset_s, abs=1e-4)
    assert error(field, late_s) < 0.1


def test_a_decentred_lens_is_a_second_order_map() -> None:
    """Tangential distortion is not absorbed by the principal point or k1."""
    phone = StrangePhone(replace(HAND, seed=73), Strange(tangential=(0.012, -0.008)))
    verdict, (field,) = judged(phone, phone.profile, fitted=(PRINCIPAL_POINT, K1))
    lens = verdict.model.profile.intrinsics
    assert lens is not None
    assert (lens.cx_px, lens.cy_px) == pytest.approx(HAND.centre_px, abs=3)
    assert abs(lens.coefficients[0]) < 0.01
    assert (field.kind, field.shape) == ("displacement", "growing with its square")
    assert gained(field) > 0.7
    truth = 0.012 * 3 * (200 / HAND.focal_px) ** 2 * HAND.focal_px
    seen = field.fields[0].at(HAND.centre_px[0], HAND.centre_px[1] + 200)
    assert seen[1] == pytest.approx(truth, rel=0.15)


def test_a_slightly_decentred_lens_is_described_by_two_parameters() -> None:
    """A map with many parameters would not be significant, and no cause of the catalogue is."""
    phone = StrangePhone(replace(HAND, seed=98, points=40), Strange(tangential=(0.003, -0.002)))
    verdict, (field,) = judged(phone, phone.profile, rungs=2)
    assert not verdict.accepted
    assert (field.kind, field.shape) == ("displacement", "growing with its square")
    assert gained(field) > 0.8


@pytest.mark.scenario
def test_two_causes_that_compensate_for_a_lens_are_removed_together() -> None:
    """A rotated sensor and another principal point absorb most of a strong tangential distortion.

    With the field both are removed.
    """
    phone = StrangePhone(replace(HAND, seed=83, frames=41), Strange(tangential=(0.012, -0.016)))
    verdict, (field,) = judged(phone, phone.profile, rungs=2)
    assert not verdict.accepted
    assert field.shape == "growing with its square"
    assert verdict.final_rms_px == pytest.approx(HAND.noise_px, rel=0.15)


def test_a_focal_length_that_settles_is_a_scale_over_time() -> None:
    """It levels off, unlike a constant drift."""
    phone = StrangePhone(replace(HAND, seed=74), Strange(longer=warming))
    _, (field,) = judged(phone, phone.profile)
    assert (field.kind, field.covariates, field.shape) == ("scale", ("time",), "levelling off")
    assert field.fields[0].stamp_0_ns is not None
    assert error(field, warming) < 0.15


def test_a_breathing_lens_is_a_scale_over_the_focus_with_time_as_rival() -> None:
    """The report states that both covariates explain this capture equally well."""
    breathing = Strange(
        longer=lambda t: 0.02 * (focus_dioptres(t) - focus_dioptres(0.0)), focus_dioptres=focus_dioptres
    )
    phone = StrangePhone(replace(HAND, seed=75), breathing)
    _, (field,) = judged(phone, phone.profile)
    assert field.covariates == ("focus",)
    assert field.confounded == ("scale over time",)
    assert "scale over time would explain it equally well" in field.sentence
    assert field.size == pytest.approx(0.04, rel=0.1)
    assert not field.fields[0].belongs_to_one_capture


@pytest.mark.parametrize("given", [0.0, 1.5])
def test_a_focal_length_that_holds_at_some_focus_distance_is_no_error(given: float) -> None:
    """The profile holds at infinity or at a focus distance of the capture: the breathing field alone explains it."""
    breathing = Strange(longer=lambda t: 0.02 * (focus_dioptres(t) - given), focus_dioptres=focus_dioptres)
    phone = StrangePhone(replace(HAND, seed=75), breathing)
    verdict, (field,) = judged(phone, phone.profile)
    assert not verdict.accepted
    assert field.covariates == ("focus",)
    assert error(field, lambda dioptres: 0.02 * (dioptres - given)) < 0.1


def test_a_focal_length_that_holds_at_no_focus_distance_is_named() -> None:
    """The profile lies 3 % outside the range that a breathing of 2 % covers."""
    breathing = Strange(longer=lambda t: 0.01 * focus_dioptres(t) - 0.05, focus_dioptres=focus_dioptres)
    phone = StrangePhone(replace(HAND, seed=75, points=20), breathing)
    verdict, (field,) = judged(phone, phone.profile)
    assert [entry.name for entry in verdict.accepted] == ["focal_length"]
    assert field.covariates == ("focus",)
    assert field.size == pytest.approx(0.02, rel=0.1)
    assert verdict.final_rms_px == pytest.approx(HAND.noise_px, rel=0.1)


def test_the_focus_log_extends_beyond_the_last_frame() -> None:
    """The log is extrapolated over the readout of the last frame; a constant value would bias the last pair."""
    dioptres = Strange(focus_dioptres=lambda t: 0.5 + 0.3 * t)
    capture = StrangePhone(HAND, dioptres).capture
    times, values = np.array(focus_log(capture))
    last_s = capture.frames[-1].time_s
    assert times[-1] > last_s + 0.03
    assert np.interp(last_s + 0.02, times, values) == pytest.approx(0.5 + 0.3 * (last_s + 0.02))
    assert focus_log(StrangePhone(HAND, Strange()).capture) is None


def test_a_gyroscope_sensitive_to_gravity_is_a_rate_over_acceleration() -> None:
    """All nine coefficients are recovered with their signs."""
    wall = replace(
        HAND, seed=76, sway_m=0.05, plane_per_m=(0.05, -0.1, 0.6), accel_bias_m_s2=(0.0, 0.0, 0.0)
    )  # fmt: skip
    phone = StrangePhone(wall, Strange(gyro=lambda t, reading, force: reading + force @ PER_FORCE.T))
    nominal = replace(phone.profile, depth_m=None)
    _, fields = judged(phone, nominal)
    assert [field.covariates for field in fields] == [("acceleration",)]
    found = np.array([(field.at(1.0) - field.at(-1.0)) / 2 for field in fields[0].fields])
    assert np.corrcoef(found.ravel(), -PER_FORCE.T.ravel())[0, 1] > 0.95


def test_a_bias_measured_at_rest_stays_with_a_sensitivity_to_gravity() -> None:
    """A bias measured in the same pose includes gravity; the field's rate at zero force subtracts it."""
    wall = replace(HAND, seed=76, sway_m=0.05, plane_per_m=(0.05, -0.1, 0.6), accel_bias_m_s2=(0.0, 0.0, 0.0))
    phone = StrangePhone(
        wall, Strange(gyro=lambda t, reading, force: reading + (force - force.mean(axis=0)) @ PER_FORCE.T)
    )
    verdict, (field,) = judged(phone, replace(phone.profile, depth_m=None))
    assert not verdict.accepted
    assert field.covariates == ("acceleration",)
    assert field.size == pytest.approx(float(np.linalg.norm(PER_FORCE, axis=0).max()), rel=0.15)
    sensitivity = np.array([(f.at(1.0) - f.at(-1.0)) / 2 for f in field.fields])
    assert np.corrcoef(sensitivity.ravel(), -PER_FORCE.T.ravel())[0, 1] > 0.95


def test_a_wrong_focal_length_beside_a_sensitivity_to_gravity_is_named() -> None:
    """The focal length is named rather than a focal drift, and forces up to 4 g are used."""
    wall = replace(HAND, seed=102, sway_m=0.25, plane_per_m=(0.05, -0.1, 0.35), accel_bias_m_s2=(0.0, 0.0, 0.0))
    phone = StrangePhone(wall, Strange(gyro=lambda t, reading, force: reading + force @ (0.6 * PER_FORCE).T))
    lens = phone.profile.intrinsics
    assert lens is not None
    shorter = replace(lens, fx_px=lens.fx_px / 1.04, fy_px=lens.fy_px / 1.04)
    verdict, fields = judged(phone, replace(phone.profile, depth_m=None, intrinsics=shorter), rungs=1)
    assert [entry.name for entry in verdict.accepted] == ["focal_length"]
    assert verdict.model.profile.intrinsics is not None
    assert verdict.model.profile.intrinsics.fx_px == pytest.approx(lens.fx_px, rel=1e-3)
    assert [field.covariates for field in fields] == [("acceleration",)]
    assert verdict.final_rms_px == pytest.approx(HAND.noise_px, rel=0.1)


def test_a_sudden_change_of_bias_is_a_step() -> None:
    """A smooth curve would overshoot at the step."""
    change = np.array([0.02, -0.015, 0.01])
    phone = StrangePhone(
        HAND, Strange(gyro=lambda t, reading, force: reading + np.where(t >= 1.13, 1.0, 0.0)[:, None] * change)
    )
    verdict, (field,) = judged(phone, phone.profile)
    assert (field.kind, field.covariates, field.shape) == ("rate", ("time",), "a step")
    assert field.fields[0].knots[0][0] == pytest.approx(1.13, abs=0.02)
    assert np.array(field.fields[0].values)[-1] == pytest.approx(-change, abs=0.002)
    assert verdict.final_rms_px < 1.1 * HAND.noise_px


def test_a_clock_that_is_set_delays_the_frames_after_it_and_leaves_the_log() -> None:
    """A smooth curve would delay the frames beside the step by something in between; a bridge would bend the motion."""
    late = Strange(late_in_frame_s=lambda fraction, stamp_s: np.where(stamp_s > 1.13, 0.006, 0.0))
    phone = StrangePhone(HAND, late)
    verdict, (field,) = judged(phone, phone.profile)
    assert (field.kind, field.covariates, field.shape) == ("delay", ("time",), "a step")
    assert "frames from 1.1" in field.sentence
    assert "late by 6" in field.sentence or "late by 5.9" in field.sentence
    before_s, after_s = (phone.stamp_s[phone.stamp_s > 1.13][0] - 1 / 30, phone.stamp_s[phone.stamp_s > 1.13][0])
    delays_s = field.fields[0].at_time(np.array([before_s, after_s]))[:, 0]
    assert delays_s[1] - delays_s[0] == pytest.approx(0.006, abs=1e-4)
    assert verdict.final_rms_px < 1.05 * HAND.noise_px


def test_inaccurate_points_of_blurred_frames_are_not_a_sudden_change() -> None:
    """Pairs with 30 times the others' noise scatter by as much; a focal length that changes by 1 % is still found."""
    evidence, fitted, table = fitted_to(StrangePhone(HAND, Strange()))
    rng = np.random.default_rng(5)
    noise_px = np.where(table.pair % 9 == 4, 30.0, 1.0) * HAND.noise_px
    for _ in range(10):
        scattered = table.second_px + noise_px[:, None] * rng.normal(size=(len(table), 2))
        seen = point_residuals(evidence.imu, fitted, replace(table, second_px=scattered))
        assert sudden_change(seen) is None
        zoomed = scattered + np.where(table.pair == 25, 0.01, 0.0)[:, None] * (scattered - HAND.centre_px)
        found = sudden_change(replace(seen, table=replace(table, second_px=zoomed)))
        assert found is not None
        assert found.pair == 25
        assert found.scale == pytest.approx(0.01, rel=0.2)


def test_a_bias_that_drifts_evenly_is_a_line_and_no_bias_beside_a_step() -> None:
    """A line has as few numbers as a step, and holds the mean of the bias itself."""
    change = np.array([0.02, -0.015, 0.01])
    phone = StrangePhone(HAND, Strange(gyro=lambda t, reading, force: reading + 0.5 * np.outer(t, change)))
    verdict, (field,) = judged(phone, phone.profile, rungs=1)
    assert not verdict.accepted
    assert (field.covariates, field.shape) == (("time",), "a straight line")
    assert np.array(field.fields[0].values)[-1] == pytest.approx(-0.5 * phone.stamp_s[-1] * change, abs=0.002)
    assert verdict.final_rms_px < 1.1 * HAND.noise_px


def test_axes_that_are_not_perpendicular_keep_their_name_beside_a_bias_that_drifts() -> None:
    """A curve of the bias with dozens of knots follows the points nearly as well."""

    def log(time_s, reading, force):
        sheared = reading + 0.03 * reading[:, [1]] * np.array([1.0, 0.0, 0.0])
        return sheared + np.outer(time_s, [0.024, -0.014, 0.012])

    phone = StrangePhone(replace(HAND, noise_px=0.25), Strange(gyro=log))
    verdict, (field,) = judged(phone, phone.profile, rungs=2)
    assert {entry.name for entry in verdict.accepted} == {"gyro_axes", "imu_rotation"}
    assert verdict.model.profile.extensions.gyro_misalignment_rad[0] == pytest.approx(0.015, abs=0.003)
    assert (field.kind, field.covariates, field.shape) == ("rate", ("time",), "a straight line")


def test_a_bias_beside_a_drift_that_does_not_reach_it_keeps_its_name() -> None:
    """The given bias lies outside the range of the drift."""
    change = np.array([0.01, -0.008, 0.005])
    phone = StrangePhone(HAND, Strange(gyro=lambda t, reading, force: reading + np.outer(0.5 * t + 2, change)))
    verdict, (field,) = judged(phone, phone.profile, rungs=1)
    assert [entry.name for entry in verdict.accepted] == ["gyro_bias"]
    assert (field.kind, field.covariates) == ("rate", ("time",))
    assert verdict.final_rms_px < 1.1 * HAND.noise_px


def test_an_interpolated_gap_is_bridged_from_the_points() -> None:
    """A straight line in the log is detected, confirmed by the points, and replaced by a rate estimated from them."""
    phone = StrangePhone(replace(HAND, seed=77), Strange(gyro=filled(1.0, 1.15)))
    verdict, (field,) = judged(phone, phone.profile)
    assert isinstance(verdict.fields[0], Distrusted)
    assert field.shape == "straight"
    ((from_s, to_s),) = verdict.model.profile.imu_untrusted_s
    assert (from_s, to_s) == pytest.approx((1.0, 1.15), abs=0.01)
    assert field.held_out.before > 5 * HAND.noise_px
    assert gained(field) > 0.95
    assert "inertial rows there lie on a straight line" in field.sentence
    assert verdict.final_rms_px < 1.3 * HAND.noise_px
    # with the bridge in the profile, the interval is no longer doubtful
    assert not doubtful_pairs(phone.observed, phone.capture, verdict.model.profile).stretches


def test_an_interval_that_only_the_points_contradict_is_bridged(rng: np.random.Generator) -> None:
    """Noise on the filled readings hides the straight line; neither the ladder nor another field takes the interval."""

    def log(time_s, reading, force):
        return filled(1.0, 1.15)(time_s, reading, force) + rng.normal(0, 0.004, reading.shape)

    phone = StrangePhone(replace(HAND, seed=77, points=20), Strange(gyro=log))
    assert not doubtful_stretches(phone.imu)
    verdict, (field,) = judged(phone, phone.profile, rungs=1)
    assert not verdict.accepted
    assert field.shape == "contradicted"
    ((from_s, to_s),) = verdict.model.profile.imu_untrusted_s
    assert (from_s, to_s) == pytest.approx((1.0, 1.15), abs=2 * KNOT_STEP_S)
    assert field.p_value < 1e-6
    assert gained(field) > 0.95
    assert "the log does not follow the frames" in field.sentence
    assert verdict.final_rms_px < 1.3 * HAND.noise_px


def test_an_interval_that_another_climb_found_is_bridged_from_the_start(rng: np.random.Generator) -> None:
    """It is known whether or not this climb's points would convict it, and no ladder without it is climbed."""

    def log(time_s, reading, force):
        return filled(1.0, 1.15)(time_s, reading, force) + rng.normal(0, 0.004, reading.shape)

    phone = StrangePhone(replace(HAND, seed=77, points=20), Strange(gyro=log))
    known = (Stretch("contradicted", 0.99, 1.16, (0, 1, 2), p_value=1e-9),)
    climbs = []

    def climbing(evidence: Evidence, bridged: Callable[[Model], Model] | None) -> GeometricVerdict:
        climbs.append(bridged)
        return climb(evidence, phone.profile, (), (), max_rungs=0, bridged=bridged)

    found = climb_with_bridges(phone.observed, phone.capture, phone.profile, climbing, known)
    assert len(climbs) == 1
    assert climbs[0] is not None
    assert known_stretches(found) == known
    assert found.model.profile.imu_untrusted_s == ((0.99, 1.16),)
    assert found.final_rms_px < 1.3 * HAND.noise_px


def test_a_badly_tracked_pair_is_no_interval_of_the_log(rng: np.random.Generator) -> None:
    """Errors that differ from point to point need no other rate, however large."""
    phone = StrangePhone(replace(HAND, seed=77), Strange())
    pairs = list(phone.observed.pairs)
    for k in (20, 21):
        moved = pairs[k].points_second_px + rng.normal(0, 1.0, pairs[k].points_second_px.shape)
        pairs[k] = replace(pairs[k], points_second_px=moved)
    evidence = make_evidence(phone.imu, replace(phone.observed, pairs=tuple(pairs)))
    found = climb(evidence, phone.profile, (), (), max_rungs=0)
    found.evidence = evidence
    medians = pair_medians(found.fit.distance, found.table, len(pairs))
    assert medians[20:22].min() > 5 * np.median(medians)
    assert not contradicted_stretches(found, phone.capture, phone.profile)


@pytest.mark.filterwarnings("error")
def test_pairs_that_do_not_count_contradict_no_interval() -> None:
    """With too few points in every pair there is no usual residual."""
    phone = StrangePhone(HAND, Strange())
    unknown = np.full(len(phone.observed.pairs), np.nan)
    assert not spans_of_outliers(phone.observed, Model(phone.profile, None, ()), unknown)


@pytest.mark.parametrize("late_s", [0.02, 0.05])
def test_frames_that_are_late_are_no_interval_of_the_log(late_s: float) -> None:
    """A free rate imitates frames at other times, but leaves their points more than noise."""
    late = Strange(late_in_frame_s=lambda fraction, stamp_s: np.where((stamp_s > 1.0) & (stamp_s < 1.2), late_s, 0.0))
    verdict, _ = judged(StrangePhone(replace(HAND, seed=77), late), StrangePhone(HAND, Strange()).profile)
    assert not any(isinstance(entry, Distrusted) for entry in verdict.fields)


def test_a_clipping_gyroscope_is_found_with_its_limit() -> None:
    """The limit is reported, and the peaks are bridged."""
    phone = StrangePhone(replace(HAND, seed=78), Strange(gyro=lambda t, reading, _: np.clip(reading, -1.4, 1.4)))
    stretches = doubtful_stretches(phone.imu)
    assert {stretch.kind for stretch in stretches} == {"clipped"}
    assert {stretch.limit_rad_s for stretch in stretches} == {1.4}
    _, (field,) = judged(phone, phone.profile)
    assert "beyond 1.4 rad/s the gyroscope reads too little: it clips" in field.sentence
    assert field.held_out.after < field.held_out.before


def test_a_sensor_that_clips_before_its_noise_is_found_by_the_points(rng: np.random.Generator) -> None:
    """Strong noise on the clipped readings hides the limit in the log; the intervals reach it in common."""

    def log(time_s, reading, force):
        return np.clip(reading, -1.6, 1.6) + rng.normal(0, 0.02, reading.shape)

    phone = StrangePhone(replace(HAND, seed=78), Strange(gyro=log))
    assert not doubtful_stretches(phone.imu)
    _, (field,) = judged(phone, phone.profile)
    assert field.shape == "contradicted"
    assert len(field.stretches_s) >= 3
    assert "the rate reaches its largest reading, from 1.6" in field.sentence
    assert "clips" in field.reasons
    assert field.held_out.after < 0.5 * field.held_out.before


def test_noise_and_a_bias_after_the_limit_do_not_hide_it(rng: np.random.Generator) -> None:
    """Readings pile up at one limit for each direction."""
    phone = StrangePhone(replace(HAND, seed=78), Strange(gyro=lambda t, reading, _: np.clip(reading, -1.2, 1.2)))
    noise = rng.normal(0, 0.004, phone.imu.gyro_rad_s.shape)
    stretches = doubtful_stretches(replace(phone.imu, gyro_rad_s=phone.imu.gyro_rad_s + noise + 0.03))
    assert {stretch.kind for stretch in stretches} == {"clipped"}
    limits = np.array([stretch.limit_rad_s for stretch in stretches])
    assert np.all(np.minimum(abs(limits - 1.23), abs(limits - 1.17)) < 0.01)
    assert {1.17, 1.23} <= set(np.round(limits, 2))


@pytest.mark.parametrize("seed", range(60, 72))
def test_the_tops_of_swings_are_no_limit(seed: int, rng: np.random.Generator) -> None:
    """A hand's swings are not equally high, however flat their tops are within the noise."""
    imu = StrangePhone(replace(HAND, seed=seed), Strange()).imu
    for noise in (0.0, 0.004, 0.02):
        assert not doubtful_stretches(replace(imu, gyro_rad_s=imu.gyro_rad_s + rng.normal(0, noise, (len(imu), 3))))


def test_an_interval_that_the_points_deny_is_dropped_beside_one_that_they_confirm() -> None:
    """Each kind is tested by its own points: a confirmed gap confirms no limit that the rate only seems to reach."""
    phone = StrangePhone(replace(HAND, seed=77), Strange(gyro=filled(1.0, 1.15)))
    verdict, _ = judged(phone, phone.profile)
    (gap,) = doubtful_stretches(phone.imu)
    sound = Stretch("clipped", 0.3, 0.34, (0,), 1.5)
    bridges = Bridges.over(
        Doubtful.over((sound, gap), phone.observed, phone.profile), phone.observed, phone.capture, phone.profile
    )
    verdict.fields.clear()
    verdict.model = replace(verdict.model, profile=phone.profile)
    with_bridges(verdict, bridges, phone.capture)
    (entry,) = verdict.fields
    assert [stretch.kind for stretch in entry.stretches] == ["straight"]
    assert verdict.model.profile.imu_untrusted_s == ((gap.from_s, gap.to_s),)
    assert any("look clipped; tracked points do not confirm it" in note for note in verdict.notes)


class WholeRowsLost(StrangePhone):
    """The accelerometer's readings are lost and interpolated too."""

    @cached_property
    def imu(self) -> ImuSamples:
        """The log."""
        log = StrangePhone.imu.func(self)  # type: ignore[attr-defined]
        return replace(log, accel_m_s2=filled(0.9, 1.15)(log.time_s, log.accel_m_s2, None))


@pytest.mark.parametrize("phone_of", [StrangePhone, WholeRowsLost])
def test_a_bridged_gap_does_not_turn_gravity_into_a_bias(phone_of: type[StrangePhone]) -> None:
    """Without its bridge, a gap rotates gravity in all later frames, and a gyroscope bias compensates for it."""
    wall = replace(HAND, seed=86, sway_m=0.1, plane_per_m=(0.05, -0.1, 0.4), accel_bias_m_s2=(0.0, 0.0, 0.0))
    phone = phone_of(wall, Strange(gyro=filled(0.9, 1.15)))
    nominal = replace(phone.profile, depth_m=None)
    doubtful = doubtful_pairs(phone.observed, phone.capture, nominal)
    evidence = make_evidence(phone.imu, doubtful.for_ladder(phone.observed), nominal)
    start = Model(nominal, None, ())
    table = evidence.table(start, 4000)
    assert table.n_windows == (2 if phone_of is WholeRowsLost else 1)
    start = replace(start, scene=base_scene(evidence, nominal, table))
    bridged = Bridges.over(doubtful, phone.observed, phone.capture, nominal).refitted(start)
    fits = [evidence.fit(model, (GYRO_BIAS,), table) for model in (start, bridged)]
    away, left = (float(np.linalg.norm(fit.value("gyro_bias") / fit.std("gyro_bias"))) for fit in fits)
    assert left < 4
    assert away > 2 * left
    assert fits[1].scale < 1.1


def test_a_gyroscope_that_clips_in_most_frames_is_bridged() -> None:
    """Too few pairs remain for the ladder; with bridges it uses all pairs and finds no other cause."""
    phone = StrangePhone(replace(HAND, seed=87), Strange(gyro=lambda t, reading, _: np.clip(reading, -1.0, 1.0)))
    doubtful = doubtful_pairs(phone.observed, phone.capture, phone.profile)
    assert (~doubtful.hit).sum() < LEAST_PAIRS_LEFT
    verdict, (field,) = judged(phone, phone.profile, rungs=1)
    assert not verdict.accepted
    assert gained(field) > 0.9


def test_points_of_few_unaffected_pairs_do_not_deny_a_limit_that_bridges_explain() -> None:
    """The pairs elsewhere are too few for a comparison; residuals with bridges take their place."""
    phone = StrangePhone(replace(HAND, seed=87), Strange(gyro=lambda t, reading, _: np.clip(reading, -1.0, 1.0)))
    sound = StrangePhone(replace(HAND, seed=87), Strange())
    doubtful = doubtful_pairs(phone.observed, phone.capture, phone.profile)
    chance = []
    for one in (phone, sound):
        bridges = Bridges.over(doubtful, one.observed, one.capture, one.profile)
        found = climb(make_evidence(one.imu, one.observed), one.profile, (), (), max_rungs=0)
        chance.append(bridges.held_out(found).p_value("clipped"))
    assert chance[0] < 1e-6
    assert chance[1] > 0.05


@pytest.mark.scenario
def test_a_wrong_offset_beside_a_gap_keeps_its_name_and_size() -> None:
    """Bridges are refitted for each cause that enters."""
    wall = replace(HAND, seed=88, sway_m=0.03, plane_per_m=(0.05, -0.1, 0.4), accel_bias_m_s2=(0.0, 0.0, 0.0))
    phone = StrangePhone(wall, Strange(gyro=filled(1.1, 1.25)))
    nominal = replace(phone.profile, depth_m=None, time_offset_s=phone.setup.time_offset_s - 0.006)
    verdict, (field,) = judged(phone, nominal, rungs=2)
    assert [entry.name for entry in verdict.accepted] == ["time_offset"]
    assert verdict.model.profile.time_offset_s == pytest.approx(phone.setup.time_offset_s, abs=1e-4)
    assert gained(field) > 0.95


def test_a_bridge_that_does_not_explain_its_points_is_withheld_from_the_profile() -> None:
    """The fit uses it to join both sides of its interval, but restoration must not use it."""
    stretches = tuple(Stretch("straight", t, t + 0.1, (0, 1, 2)) for t in (0.5, 1.5))
    good, bad = bridging_form(stretches, 0, StrangePhone(HAND, Strange()).imu).fields
    entry = Distrusted(stretches, (good, bad), (True, False), 1e-9, 3.0, 0.2, 0.1)
    assert entry.withheld == (bad,)
    field = finding_of(entry, 0.05)
    assert field.fields == (good,)
    assert field.held_out.noise == 0.1
    assert "1 of 2 bridged from the points, the others not corrected by process" in field.sentence
    assert not entry.better_than_none
    clipped = tuple(replace(stretch, kind="clipped", limit_rad_s=1.0) for stretch in stretches)
    assert replace(entry, stretches=clipped).better_than_none == ((1.5, 1.6),)


def test_the_knots_of_a_bridge_resolve_a_clipped_peak() -> None:
    """The angle of the missing rate is reproduced to 0.15 mrad in a typical peak."""
    phone = StrangePhone(replace(HAND, seed=91, frames=240), Strange())
    time_s, whole = phone.imu.time_s, phone.imu.gyro_rad_s
    limit = 1.3
    clipped = replace(phone.imu, gyro_rad_s=np.clip(whole, -limit, limit))
    worst_rad = []
    for stretch in doubtful_stretches(clipped):
        form = bridging_form([stretch], 0, clipped)
        (axis,), knots = stretch.axes, form.fields[0].knots[0]
        inside = (time_s >= stretch.from_s) & (time_s <= stretch.to_s)
        if inside.sum() < 6:
            continue
        lacking = (whole - clipped.gyro_rad_s)[inside, axis]
        basis = cardinal_weights(knots, time_s[inside])[:, 1:-1]
        left = lacking - basis @ np.linalg.lstsq(basis, lacking)[0]
        worst_rad.append(float(np.ptp(np.cumsum(left)) * np.median(np.diff(time_s))))
    assert len(worst_rad) > 10
    assert np.median(worst_rad) < 1.5e-4


@pytest.mark.parametrize("kind", ["straight", "clipped"])
def test_a_bridge_without_points_follows_the_readings_around_it(kind: str) -> None:
    """The expected rate errs a third as much as a straight line or the limit; its deviation says by how much."""
    errors, deviations, without = [], [], []
    for seed in range(84, 96):
        phone = StrangePhone(replace(HAND, seed=seed), Strange())
        time_s, whole = phone.imu.time_s, phone.imu.gyro_rad_s
        if kind == "clipped":
            log = replace(phone.imu, gyro_rad_s=np.clip(whole, -0.5, 0.5))
            stretches = doubtful_stretches(log)
        else:
            stretches = [Stretch("straight", t, t + 0.04, (0, 2)) for t in np.arange(0.3, 2.0, 0.2)]
            log = replace(phone.imu, gyro_rad_s=whole)
            for stretch in stretches:
                log = replace(log, gyro_rad_s=filled(stretch.from_s, stretch.to_s)(time_s, log.gyro_rad_s, None))
        form = bridging_form(stretches, 0, log)
        uncertain = form.filled(np.zeros(form.basis.shape[1]), np.eye(form.basis.shape[1]))
        for stretch, bridge, around in zip(stretches, form.fields, uncertain, strict=True):
            values, std = np.array(bridge.values), np.array(around.std)
            assert not np.any(values[[0, -1]])
            assert not np.any(std[[0, -1]])
            others = [axis for axis in range(3) if axis not in stretch.axes]
            assert not np.any(values[:, others])
            assert not np.any(std[:, others])
            for axis in stretch.axes:
                lacking = np.interp(bridge.knots[0], time_s, whole[:, axis] - log.gyro_rad_s[:, axis])[1:-1]
                errors.append(values[1:-1, axis] - lacking)
                deviations.append(std[1:-1, axis])
                without.append(lacking)
    error, std = np.concatenate(errors), np.concatenate(deviations)
    assert len(error) > 100
    assert np.sqrt(np.mean(error**2)) < 0.35 * np.sqrt(np.mean(np.concatenate(without) ** 2))
    assert np.mean(np.abs(error) < 2 * std) > 0.9


def test_two_unknown_effects_at_once_are_two_fields() -> None:
    """Neither hides the other."""
    phone = StrangePhone(replace(HAND, seed=79), Strange(late_s=late_s, tangential=(0.01, 0.008)))
    _, fields = judged(phone, phone.profile)
    assert {field.kind for field in fields} == {"delay", "displacement"}


def test_calibrate_uses_the_delay_field_of_a_profile() -> None:
    """With a delay over the row, offset and readout time are estimated correctly, and the field stays."""
    phone = StrangePhone(replace(HAND, seed=85, points=20), Strange(late_s=late_s))
    rows = Field("delay", ("row",), ((0.0, 0.25, 0.5, 0.75, 1.0),), ((0.0,), (0.0015,), (0.002,), (0.0015,), (0.0,)))
    given = phone.profile.with_fields([rows])
    given = replace(given, time_offset_s=phone.setup.time_offset_s - 0.004)
    found = calibrate_geometry(phone.capture, given, phone.pairs)
    assert found.profile.shutter.uneven == rows
    assert found.profile.time_offset_s == pytest.approx(phone.setup.time_offset_s, abs=1e-4)
    assert found.profile.shutter.readout_time_s == pytest.approx(phone.profile.shutter.readout_time_s, rel=0.01)
    assert found.residual_px < 1.1 * HAND.noise_px


@pytest.mark.parametrize("seed", [81, 82])
def test_an_ordinary_phone_has_no_field_and_no_doubtful_interval(seed: int) -> None:
    """No false alarm is raised."""
    phone = StrangePhone(replace(HAND, seed=seed), Strange())
    verdict, fields = judged(phone, phone.profile)
    assert not fields
    assert not verdict.model.profile.fields
    assert not doubtful_stretches(phone.imu)


@pytest.mark.parametrize(("size", "left_px", "stated"), [(0.55, 1.2, False), (0.55, 0.25, True), (0.05, 1.2, True)])
def test_an_implausible_field_must_explain_the_points(size: float, left_px: float, stated: bool) -> None:
    """A zoom by 55 % is accepted only if the residual falls to about the noise of 0.24 px."""
    assert is_believable("scale", [np.array([[0.0], [size]])], left_px, 0.24) is stated


def test_causes_of_the_catalogue_alone_give_no_field() -> None:
    """The ladder's causes leave no residual to describe."""
    phone = StrangePhone(replace(HAND, seed=84, k1=-0.08, focal_drift_per_s=0.02), Strange())
    lens = phone.profile.intrinsics
    assert lens is not None
    plain = replace(lens, model="none", coefficients=())
    nominal = replace(
        phone.profile, intrinsics=plain, extensions=replace(phone.profile.extensions, focal_drift_per_s=0.0)
    )
    verdict, fields = judged(phone, nominal, fitted=(K1, FOCAL_DRIFT))
    assert verdict.nominal_rms_px == pytest.approx(HAND.noise_px, rel=0.1)
    assert not fields


def test_a_found_field_holds_in_another_capture_of_the_phone() -> None:
    """The extended profile predicts the points of a capture that was not used."""
    strange = Strange(late_s=late_s)
    phone = StrangePhone(HAND, strange)
    found, _ = judged(phone, phone.profile)
    other = StrangePhone(replace(HAND, seed=85), strange)
    evidence = make_evidence(other.capture.imu, other.observed)
    before, after = (
        climb(evidence, replace(other.profile, shutter=shutter), (), (), max_rungs=0).final_rms_px
        for shutter in (other.profile.shutter, found.model.profile.shutter)
    )
    excess = (after**2 - HAND.noise_px**2) / (before**2 - HAND.noise_px**2)
    assert before > 3 * HAND.noise_px
    assert excess < 0.2
    assert isinstance(found.model.profile.shutter.uneven, Field)


def test_a_lens_switch_is_a_step_and_not_a_drift() -> None:
    """The focal length changes by 1.5 % at one instant; a focal drift must not replace the step."""
    phone = StrangePhone(replace(HAND, seed=86), Strange(longer=lambda t: np.where(t < 1.21, 0.0, 0.015)))
    verdict, (field,) = judged(phone, phone.profile, rungs=2)
    assert not verdict.accepted
    assert (field.kind, field.covariates, field.shape) == ("scale", ("time",), "a step")
    assert field.size == pytest.approx(0.015, rel=0.1)
    # between two frames the instant is not determined
    assert np.mean(field.fields[0].knots[0]) == pytest.approx(1.21, abs=0.04)
    assert verdict.final_rms_px == pytest.approx(HAND.noise_px, rel=0.1)


def test_a_slight_lens_switch_is_a_step() -> None:
    """At 0.2 %, points move less between the two frames than their tracking error."""
    phone = StrangePhone(replace(HAND, seed=86), Strange(longer=lambda t: np.where(t < 1.21, 0.0, 0.002)))
    verdict, (field,) = judged(phone, phone.profile, rungs=2)
    assert not verdict.accepted
    assert (field.kind, field.covariates, field.shape) == ("scale", ("time",), "a step")
    assert field.size == pytest.approx(0.002, rel=0.3)


@pytest.mark.parametrize("off_s", [-0.09, 0.09])
def test_the_instant_of_a_lens_switch_is_found_from_some_frames_off(off_s: float) -> None:
    """The search starts up to 0.09 s off, as far as the first estimate may err."""
    phone = StrangePhone(replace(HAND, seed=86), Strange(longer=lambda t: np.where(t < 1.21, 0.0, 0.015)))
    evidence, fitted, table = fitted_to(phone)
    seen = point_residuals(evidence.imu, fitted, table)
    form = best_instant(seen, phone.capture, 1.21 + off_s, 0.015, evidence.period_s)
    assert form.step_s == pytest.approx(1.21, abs=0.04)


def test_a_quickly_settling_focal_length_is_one_curve() -> None:
    """It changes most between the first two frames but is not described as a step and a curve."""
    setup = replace(HAND, seed=87, frames=91, points=40)
    phone = StrangePhone(setup, Strange(longer=lambda t: 0.01 * (1 - np.exp(-np.maximum(t, 0) / 0.4))))
    _, (field,) = judged(phone, phone.profile, rungs=2)
    assert (field.covariates, field.shape) == (("time",), "levelling off")


def test_a_quickly_settling_focal_length_is_not_a_wrong_focal_length() -> None:
    """The ladder names the constant part; the field, which describes all of it, replaces that cause."""

    def longer(time_s):
        return 0.02 * (1 - np.exp(-np.maximum(time_s, 0) / 0.4))

    phone = StrangePhone(replace(HAND, seed=87), Strange(longer=longer))
    verdict, (field,) = judged(phone, phone.profile, rungs=2)
    assert not verdict.accepted
    assert (field.covariates, field.shape) == (("time",), "levelling off")
    assert gained(field) > 0.8


def test_an_effect_in_the_first_time_blocks_is_found() -> None:
    """It settles within a seventh of the capture, and the scatter over all time blocks would hide its gain."""

    def longer(time_s):
        return -0.0054 * (1 - np.exp(-np.maximum(time_s, 0) / 0.475))

    setup = replace(HAND, seed=7932, frames=91, points=40, rate_rad_s=1.095, gyro_noise_rad_s=0.0013166)
    phone = StrangePhone(setup, Strange(longer=longer))
    verdict, (field,) = judged(phone, phone.profile, rungs=2)
    assert not verdict.accepted
    assert (field.covariates, field.shape) == (("time",), "levelling off")


def test_a_pause_in_the_readout_is_a_jump_over_the_row() -> None:
    """Two even blocks with 2 ms between them need more than six knots."""

    def pause(fraction):
        return 0.002 * (np.clip((fraction - 0.55) / 0.03, 0, 1) - fraction)

    phone = StrangePhone(replace(HAND, seed=88, points=40), Strange(late_s=pause))
    _, (field,) = judged(phone, phone.profile)
    assert len(field.fields[0].knots[0]) > 6
    assert field.shape == "even blocks with a jump between them"
    assert gained(field) > 0.8


def test_a_wandering_clock_is_a_delay_over_time() -> None:
    """Neither an offset nor a constant skew describes it; the frames' times are recovered."""

    def late(stamp_s):
        return 0.003 * np.sin(2 * np.pi * 0.6 * stamp_s)

    phone = WanderingPhone(replace(HAND, seed=89), late)
    verdict, (field,) = judged(phone, phone.profile)
    assert (field.kind, field.covariates) == ("delay", ("time",))
    assert "the stamps' clock wanders" in field.sentence
    profile, stamps = verdict.model.profile, phone.stamp_s
    off = profile.imu_time_s(stamps) - phone.profile.imu_time_s(stamps) - late(stamps)
    line = np.polyval(np.polyfit(stamps, off, 1), stamps)
    assert np.std(off - line) < 5e-4


def test_stamps_that_jitter_are_named_and_each_frame_gets_its_time(rng: np.random.Generator) -> None:
    """A frame's delay says nothing about the next one's; the points give each frame its own."""
    jitter_s = rng.normal(0.0, 0.0015, HAND.frames)
    setup = replace(HAND, seed=93)
    stamps = StrangePhone(setup, Strange()).stamp_s
    phone = WanderingPhone(setup, lambda stamp_s: np.interp(stamp_s, stamps, jitter_s))
    verdict, (field,) = judged(phone, phone.profile)
    assert "the frames' stamps jitter" in field.sentence
    assert field.size == pytest.approx(np.std(jitter_s), abs=3 * field.std)
    assert gained(field) > 0.8
    off = verdict.model.profile.imu_time_s(stamps) - phone.profile.imu_time_s(stamps) - jitter_s
    assert np.std(off[1:]) < 1e-4  # no pair shows the first frame
    assert parse_profile(profile_mapping(verdict.model.profile)).fields == verdict.model.profile.fields


@pytest.mark.parametrize("jitter_rms_s", [0.0, 0.0015])
def test_a_clock_offset_stays_one_whether_or_not_stamps_jitter(rng: np.random.Generator, jitter_rms_s: float) -> None:
    """Delays of single frames are about their mean, also where some frames have no points that could hold it."""
    setup = replace(HAND, seed=94)
    stamps, jitter_s = StrangePhone(setup, Strange()).stamp_s, rng.normal(0.006, jitter_rms_s, HAND.frames)
    phone = WanderingPhone(setup, lambda stamp_s: np.interp(stamp_s, stamps, jitter_s))
    verdict, fields = judged(phone, phone.profile, rungs=2)
    assert [cause.name for cause in verdict.accepted] == ["time_offset"]
    off_s = verdict.model.profile.time_offset_s - phone.profile.time_offset_s
    assert off_s == pytest.approx(0.006, abs=0.001)
    assert [field.shape for field in fields] == (["jitter"] if jitter_rms_s else [])
    for field in fields:
        assert field.size == pytest.approx(np.std(jitter_s), abs=3 * field.std)


def test_only_frames_with_points_have_a_delay_of_their_own() -> None:
    """Free delays of others would hold the mean that a clock offset leaves to no frame, and stand in for it."""
    phone = WanderingPhone(replace(HAND, seed=94), lambda stamp_s: np.full_like(stamp_s, 0.006))
    ends_s = phone.stamp_s[[0, -1]]
    for seen_s in (phone.stamp_s, phone.stamp_s[2:-2]):
        form = form_of_late_frames(phone.capture, phone.profile, (ends_s[0], ends_s[1]), seen_s)
        assert form is not None
        np.testing.assert_allclose(form.fields[0].knots[0], seen_s, atol=1e-4)


@pytest.mark.parametrize("seed", [111, 112, 113])
def test_stamps_that_jitter_are_named_in_a_second_of_noisy_points(seed: int) -> None:
    """A few pairs of frames turn fast and gain most: their signs tell more than the mean."""
    setup = replace(HAND, seed=seed, frames=26, noise_px=0.3, rate_rad_s=1.2)
    stamps, jitter_s = StrangePhone(setup, Strange()).stamp_s, np.random.default_rng(seed).normal(0.0, 0.004, 26)
    phone = WanderingPhone(setup, lambda stamp_s: np.interp(stamp_s, stamps, jitter_s))
    _, (field,) = judged(phone, phone.profile)
    assert "the frames' stamps jitter" in field.sentence
    assert field.size == pytest.approx(np.std(jitter_s), abs=3 * field.std)


def test_slopes_of_single_frames_delays_are_those_of_difference_quotients() -> None:
    """Delaying several frames at once, of which no pair has both, gives the slopes of each."""
    phone = StrangePhone(replace(HAND, seed=93, frames=16), Strange())
    evidence, fitted, table = fitted_to(phone)
    seen = point_residuals(evidence.imu, fitted, table)
    span_s = float(fitted.seconds.min()), float(fitted.seconds.max())
    for known in (frozenset(), frozenset({"time_offset", "clock_skew"})):
        form = form_of_late_frames(phone.capture, phone.profile, span_s, phone.stamp_s, known)
        assert form is not None
        quick = slopes_of([form.term], seen.changes)
        plain = slopes_of([replace(form.term, slopes=None)], seen.changes)
        np.testing.assert_allclose(quick, plain, atol=1e-3 * np.abs(plain).max())


@pytest.mark.parametrize("seed", [94, 95])
def test_a_noisy_gyroscope_delays_no_frames(seed: int) -> None:
    """It turns frames about all axes; delays remove only the part along the motion."""
    phone = StrangePhone(replace(HAND, seed=seed, gyro_noise_rad_s=0.03), Strange())
    _, fields = judged(phone, phone.profile)
    assert fields == []


def test_a_hunting_focus_is_a_scale_over_time() -> None:
    """An oscillation at 1.4 Hz is invisible to knots 0.4 s apart and is described by finer ones."""
    phone = StrangePhone(replace(HAND, seed=90), Strange(longer=lambda t: 0.005 * np.sin(2 * np.pi * 1.4 * t)))
    _, (field,) = judged(phone, phone.profile)
    assert (field.kind, field.covariates) == ("scale", ("time",))
    assert field.size == pytest.approx(0.01, rel=0.1)
    assert gained(field) > 0.8


def test_a_scale_below_the_tracking_noise_is_not_a_field() -> None:
    """Tracking errors of a blurred frame are correlated; a small scale change of single frames may be such an error."""
    phone = StrangePhone(replace(HAND, seed=91), Strange(longer=lambda t: 0.001 * np.sin(2 * np.pi * 1.4 * t)))
    assert not judged(phone, phone.profile)[1]


def test_a_short_pulse_of_the_focal_length_is_not_a_step() -> None:
    """A pulse of 0.2 s covers too few frames for a sign test and is found by its size."""
    phone = StrangePhone(
        replace(HAND, seed=91, points=40), Strange(longer=lambda t: 0.012 * np.exp(-(((t - 1.1) / 0.12) ** 2)))
    )
    _, (field,) = judged(phone, phone.profile)
    assert (field.kind, field.covariates) == ("scale", ("time",))
    assert field.shape != "a step"
    assert field.size == pytest.approx(0.012, rel=0.2)
    assert gained(field) > 0.8


@pytest.mark.scenario
def test_a_gyroscope_dead_zone_is_not_a_scale() -> None:
    """A dead zone of 0.02 rad/s is found although the ladder first names a wrong gyroscope scale."""
    stuck = Strange(gyro=lambda t, reading, _: np.sign(reading) * np.maximum(np.abs(reading) - 0.02, 0))
    phone = StrangePhone(replace(HAND, seed=92, points=40), stuck)
    verdict, (field,) = judged(phone, phone.profile, rungs=2)
    assert not verdict.accepted
    assert (field.kind, field.covariates) == ("rate", ("rate",))
    assert gained(field) > 0.8
    assert field.size == pytest.approx(0.02, abs=0.015)
    assert "it sticks there" in field.sentence


@pytest.mark.scenario
def test_a_local_distortion_takes_a_finer_map() -> None:
    """The distortion covers a sixth of the frame's width."""

    def shifted(arm_px, _time):
        off = (arm_px - (130, -60)) / 100
        return 2.5 * off * np.exp(-0.5 * (off**2).sum(axis=1))[:, None]

    phone = StrangePhone(replace(HAND, seed=93, points=50), Strange(shifted_px=shifted))
    _, (field,) = judged(phone, phone.profile)
    assert field.kind == "displacement"
    assert len(field.fields[0].knots[0]) > 4
    assert gained(field) > 0.8


def test_a_changing_readout_is_a_delay_over_row_and_time() -> None:
    """Neither covariate alone describes it, and no compensating cause stays in the model."""
    phone = StrangePhone(
        replace(HAND, seed=94, points=20), Strange(late_in_frame_s=lambda row, stamp_s: 0.0025 * row * (stamp_s > 1))
    )
    verdict, (field,) = judged(phone, phone.profile, rungs=2)
    assert not verdict.accepted
    assert (field.kind, field.covariates) == ("delay", ("row", "time"))
    assert field.shape.startswith("a straight line of the row times")
    assert gained(field) > 0.8
    assert field.fields[0].belongs_to_one_capture


@pytest.mark.parametrize(("exposures_s", "knots"), [((0.008,), 0), ((0.004, 0.008), 2), ((0.004, 0.005, 0.008), 3)])
def test_rows_are_paired_with_exposures_that_vary(exposures_s: tuple[float, ...], knots: int) -> None:
    """The field has at most as many knots as logged exposures; a fitted readout takes its mean."""
    phone = StrangePhone(HAND, Strange())
    frames = [
        replace(frame, exposure_s=exposures_s[k % len(exposures_s)]) for k, frame in enumerate(phone.capture.frames)
    ]
    capture = replace(phone.capture, frames=tuple(frames))
    for known in (frozenset[str](), frozenset({"readout_time"})):
        forms = forms_of_pairs(capture, phone.profile, (0.0, 2.0), known)
        numbers = {form.covariates: form.basis.shape[1] for form in forms}
        assert numbers.get(("row", "exposure"), 0) == 2 * max(knots - len(known), 0)


def test_a_readout_that_follows_the_exposure_holds_for_the_phone() -> None:
    """The exposure changes from frame to frame, so no curve over time fits."""
    setup = replace(HAND, seed=94, exposure_swing=0.5)

    def late_in_frame_s(row, stamp_s):
        exposure_s = np.interp(stamp_s, phone.stamp_s, phone.exposure_s)
        return 0.3 * row * np.maximum(exposure_s - setup.exposure_s, 0)

    phone = StrangePhone(setup, Strange(late_in_frame_s=late_in_frame_s))
    verdict, (field,) = judged(phone, phone.profile)
    assert not verdict.accepted
    assert (field.kind, field.covariates) == ("delay", ("row", "exposure"))
    assert gained(field) > 0.8
    assert not field.fields[0].belongs_to_one_capture


def test_distortion_that_follows_the_focus_holds_for_the_phone() -> None:
    """It is a scale over radius and focus; time explains this capture equally well and is named as a rival."""

    def shifted(arm_px, time_s):
        return 5.0 * ((focus_dioptres(time_s) - 0.5) / 2 * ((arm_px / 320) ** 2).sum(axis=1))[:, None] * arm_px / 320

    phone = StrangePhone(replace(HAND, seed=95, points=40), Strange(shifted_px=shifted, focus_dioptres=focus_dioptres))
    _, (field,) = judged(phone, phone.profile)
    assert field.covariates == ("radius", "focus")
    assert field.confounded == ("scale over radius, time",)
    assert gained(field) > 0.8
    assert not field.fields[0].belongs_to_one_capture


@pytest.mark.scenario
def test_a_gyroscope_whose_scale_drifts_is_a_rate_over_rate_and_time() -> None:
    """A constant scale leaves half of the error."""
    drifting = Strange(gyro=lambda t, reading, _: reading * (1 + 0.03 * np.clip(t / 2, 0, 1))[:, None])
    phone = StrangePhone(replace(HAND, seed=96), drifting)
    verdict, (field,) = judged(phone, phone.profile, rungs=1)
    assert not verdict.accepted
    assert (field.kind, field.covariates) == ("rate", ("rate", "time"))
    assert gained(field) > 0.8


def test_a_gyroscope_that_is_knocked_is_turned_from_an_instant_on() -> None:
    """The angle is found; a rotation of the IMU for the whole capture would leave half of the error."""
    slip = np.array([0.03, -0.015, 0.02])

    def log(time_s, reading, _force):
        return np.where((time_s > 1.13)[:, None], Rotation.from_rotvec(slip).apply(reading), reading)

    phone = StrangePhone(replace(HAND, seed=97, frames=46), Strange(gyro=log))
    verdict, (field,) = judged(phone, phone.profile)
    assert not verdict.accepted
    assert (field.kind, field.covariates, field.shape) == ("rate", ("rate", "time"), "a step")
    assert "from 1.1" in field.sentence
    assert field.size is not None
    assert field.std is not None
    assert abs(field.size - np.linalg.norm(slip)) < 3 * field.std < 0.005
    assert verdict.final_rms_px < 1.1 * HAND.noise_px


def test_the_form_of_a_turning_gyroscope_holds_its_rates() -> None:
    """They are the cross products of a turn and the rates, at any time."""
    phone = StrangePhone(HAND, Strange())
    (form,) = (f for f in forms_of_pairs(phone.capture, phone.profile, (0.0, 2.0)) if f.is_turn)
    knots = np.array(form.fields[0].knots[1])
    turn = np.outer(knots, [0.02, -0.01, 0.015])
    rates = np.eye(3) * [field.knots[0][-1] for field in form.fields]
    corners = [np.stack([-np.cross(turn, rate), np.cross(turn, rate)]) for rate in rates]
    numbers = form.basis.T @ np.concatenate([part.ravel() for part in corners])
    profile = phone.profile.with_fields(form.filled(numbers))
    rate_rad_s = profile.true_rate_rad_s(phone.imu.gyro_rad_s)
    inside = (phone.imu.time_s > knots[0]) & (phone.imu.time_s < knots[-1])
    wanted = np.cross(np.outer(phone.imu.time_s, [0.02, -0.01, 0.015]), rate_rad_s)
    missing = missing_rate_rad_s(phone.imu, profile)
    assert missing is not None
    np.testing.assert_allclose(missing[inside], wanted[inside], atol=2e-6)
    assert form.can_hold(profile)


def test_an_exposure_that_a_field_has_replaced_is_not_in_the_extended_profile() -> None:
    """The photometric stage keeps a scale that a later field replaced; the profile must not."""
    given = StrangePhone(HAND, Strange()).profile
    light = PictureVerdict(given.with_shutter(exposure_scale=0.74))
    lit = with_exposure_of(light, given).profile
    assert merged(given, lit, lit, is_exposure=False).shutter.exposure_scale == 1.0


class WanderingPhone(StrangePhone):
    """A phone whose frames lag their timestamps by a function of the timestamp."""

    def __init__(self, setup: Setup, late: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> None:
        super().__init__(setup, Strange())
        self.late = late

    def seen_s(self, points_px, frame):
        """All rows of a frame have the same lag."""
        return super().seen_s(points_px, frame) + self.late(self.stamp_s)[frame]
