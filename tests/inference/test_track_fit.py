"""Terms recovered from noisy tracks, correct deviations, outliers, priors, walls and windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from motion.synthetic_tracks import Recording, Setup, recorded

from virest.camera.profile import CameraProfile
from virest.errors import ImuError
from virest.image_formation.point_model import integrate_motion, predict
from virest.inference import profile_terms as terms_of
from virest.inference.clustered import CovarianceModel
from virest.inference.coded_motion import StepSlopes, coding_bias_px, drawn_px, step_slopes
from virest.inference.track_fit import Term, TrackFit, fit_tracks, start_scene
from virest.inference.tracking_bias import bias_std
from virest.motion.scene_motion import InertialMotion

Array = np.ndarray
BASIC = (terms_of.TIME_OFFSET, terms_of.READOUT, terms_of.IMU_ROTATION, terms_of.GYRO_BIAS)
ASIDE = {
    "time_offset": (0.0063,),
    "readout_time": (-0.0042,),
    "imu_rotation": (0.012, -0.021, 0.016),
    "gyro_bias": (0.013, 0.021, -0.008),
    "gyro_scale": (0.021,),
    "focal_length": (-0.034,),
    "radial_distortion": (0.027,),
    "principal_point": (5.0, -8.0),
    "clock_skew": (0.0011,),
    "exposure_time": (0.21,),
    "focal_drift": (0.012,),
    "stabilisation": (-0.16, 0.22, 0.02, -0.03, 0.0),
}
"""Distance of each term of an altered profile from the truth."""
PORTRAIT = Setup(seed=11, gyro_noise_rad_s=0.001, frames=40)
LANDSCAPE = Setup(
    seed=12, width=640, height=480, centre_px=(331.0, 226.0), readout_direction="top_to_bottom", frames=40,
    timestamp="exposure_end", gyro_noise_rad_s=0.001, k1=0.04, gyro_scale=0.98, clock_skew=0.0013, exposure_swing=0.6,
)  # fmt: skip
FLIPPED = Setup(seed=13, readout_direction="bottom_to_top", focal_drift_per_s=0.03, stabilised=(0.5, 0.8), frames=40)
WALL = Setup(
    seed=14, sway_m=0.06, plane_per_m=(0.1, -0.15, 0.5), velocity_m_s=(0.1, -0.2, 0.15), gyro_noise_rad_s=0.001,
    readout_direction="left_to_right", frames=45, arm_m=(0.03, -0.05, 0.01), points=22,
)  # fmt: skip


def spoilt(profile: CameraProfile, terms: Sequence[Term]) -> CameraProfile:
    """The true profile with each term changed."""
    for term in terms:
        profile = term.change(profile, np.array(ASIDE[term.name]))
    return profile


def errors(fitted: TrackFit) -> Array:
    """Errors of the fitted changes."""
    return fitted.change + np.concatenate([ASIDE[term.name] for term in fitted.terms])


def deviations(fitted: TrackFit) -> Array:
    """Standard deviations of the values of all terms."""
    return np.concatenate([fitted.std(term.name) for term in fitted.terms])


def fitted_from(recording: Recording, terms: Sequence[Term]) -> TrackFit:
    """Fit rotation only, from an altered profile."""
    return fit_tracks(recording.imu, recording.table(), spoilt(recording.profile, terms), terms)


def fitted_wall(recording: Recording, terms: Sequence[Term], windows: list[list[int]] | None = None) -> TrackFit:
    """Fit with the accelerometer's path, from an altered profile and a default scene."""
    profile, table = spoilt(recording.profile, terms), recording.table(windows)
    scene = start_scene(recording.imu, integrate_motion(recording.imu, profile, translation=True), table, 0.7)
    return fit_tracks(recording.imu, table, profile, terms, scene)


# ── terms ────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("setup", "terms"),
    [
        (PORTRAIT, (*BASIC, terms_of.FOCAL)),
        (PORTRAIT, (terms_of.PRINCIPAL_POINT, terms_of.READOUT, terms_of.TIME_OFFSET)),
        (LANDSCAPE, (*BASIC, terms_of.K1, terms_of.CLOCK_SKEW)),
        (LANDSCAPE, (terms_of.GYRO_SCALE, terms_of.EXPOSURE_SCALE)),
        (FLIPPED, (terms_of.TIME_OFFSET, terms_of.GYRO_BIAS, terms_of.FOCAL_DRIFT, terms_of.STABILISATION)),
    ],
    ids=lambda value: "-".join(t.name for t in value) if isinstance(value, tuple) else "",
)
def test_every_term_is_recovered(setup: Setup, terms: tuple[Term, ...]) -> None:
    """Each value lies within four deviations of the truth, which are small, and only noise remains."""
    fitted = fitted_from(recorded(setup), terms)
    assert fitted.scale == pytest.approx(1.0, abs=0.08)
    assert (np.abs(errors(fitted)) < 4 * deviations(fitted) + 1e-9).all()
    put_aside = np.abs(errors(fitted) - fitted.change)
    if terms_of.STABILISATION in terms:
        put_aside[-3:] = np.inf  # the frames show neither the lens's lean at the start of the log nor an end of travel
    assert (deviations(fitted) < 0.2 * put_aside).all()
    assert set(fitted.slices) == {term.name for term in terms}


def test_a_readout_of_the_opposite_direction_becomes_negative() -> None:
    """Started as a global shutter read upwards, a readout downwards ends with a negative readout time."""
    recording = recorded(replace(LANDSCAPE, clock_skew=0.0))
    shutter = replace(recording.profile.shutter, readout_time_s=0.0, readout_direction="bottom_to_top")
    start = replace(recording.profile, shutter=shutter)
    fitted = fit_tracks(recording.imu, recording.table(), start, (terms_of.TIME_OFFSET, terms_of.READOUT))
    assert fitted.profile.shutter.readout_time_s == pytest.approx(-LANDSCAPE.readout_time_s, abs=2e-4)
    assert fitted.scale == pytest.approx(1.0, abs=0.08)


def test_deviations_match_the_errors() -> None:
    """Over 20 motions and noises the errors match the deviations, and none is many times larger."""
    scores, terms = [], (terms_of.TIME_OFFSET, terms_of.READOUT, terms_of.GYRO_BIAS)
    for seed in range(200, 220):
        fitted = fitted_from(Recording(Setup(seed=seed, frames=22, points=18)), terms)
        scores.append(errors(fitted) / deviations(fitted))
    score = np.array(scores)
    assert score.shape == (20, 5)
    assert 0.7 < np.sqrt(np.mean(score**2)) < 1.45
    assert np.mean(np.abs(score) < 2) > 0.85
    assert (np.abs(score) < 5).all()


def test_a_third_of_outliers_does_no_harm() -> None:
    """Values stay within five deviations, and the weights identify the outliers."""
    recording = recorded(replace(PORTRAIT, outliers=1 / 3))
    fitted = fitted_from(recording, BASIC)
    assert (np.abs(errors(fitted)) < 5 * deviations(fitted)).all()
    clean = recorded(PORTRAIT)
    honest = fitted_from(clean, BASIC)
    assert (deviations(fitted) < 4 * deviations(honest)).all()
    step = np.linalg.norm(fitted.difference_px, axis=1)
    assert np.mean(step > 2) > 0.2
    assert fitted.weight[step > 2].max() < 0.1
    assert np.median(fitted.weight[step < 0.3]) > 0.7


def test_a_prior_holds_a_term_at_its_start() -> None:
    """A prior as sharp as the data halves the change; a sharper one prevents it, and a wider one hardly matters.

    For a unit normal, Cauchy's loss at 2.4 has 0.81 of the information that its mean weight suggests.
    """
    recording = recorded(PORTRAIT)
    start = terms_of.shift_offset(recording.profile, np.array([0.0002]))
    free = fit_tracks(recording.imu, recording.table(), start, (terms_of.TIME_OFFSET,))
    alone = float(np.sqrt(free.curvature[0, 0]))
    way = float(free.change[0])
    for sharpness in (1.0, 20.0, 1 / 3):
        part = 0.81 / (0.81 + sharpness**2)
        term = replace(terms_of.TIME_OFFSET, prior_std=(alone / sharpness,))
        held = fit_tracks(recording.imu, recording.table(), start, (term,))
        assert held.change[0] == pytest.approx(part * way, abs=0.04 * abs(way))


def test_without_terms_the_profile_is_only_judged() -> None:
    """The differences of a wrong offset stay."""
    recording = recorded(PORTRAIT)
    wrong = terms_of.shift_offset(recording.profile, np.array([0.01]))
    judged = fit_tracks(recording.imu, recording.table(), wrong, (), max_iterations=0)
    truth = fit_tracks(recording.imu, recording.table(), recording.profile, (), max_iterations=0)
    assert judged.profile == wrong
    assert judged.scale > 10 * truth.scale
    assert judged.cost > 5 * truth.cost
    np.testing.assert_allclose(judged.distance, np.linalg.norm(judged.difference_px, axis=1) / PORTRAIT.noise_px)


# ── walls ────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_the_path_in_front_of_a_wall_is_found_with_the_profile() -> None:
    """For a swaying camera, rotation alone leaves a large residual, the accelerometer's path only noise."""
    recording = recorded(WALL)
    plain = fitted_from(recording, BASIC)
    fitted = fitted_wall(recording, BASIC)
    assert plain.scale > 2
    assert fitted.scale == pytest.approx(1.0, abs=0.08)
    assert (np.abs(errors(fitted)) < 4 * deviations(fitted)).all()
    truth = recording.scene(recording.table())
    assert isinstance(fitted.scene, InertialMotion)
    spread = np.sqrt(np.diag(fitted.covariance))[8:]
    assert (np.abs(fitted.scene.vector() - truth.vector()) < 4.5 * spread).all()
    assert spread[7:10].max() < 0.3
    assert np.linalg.norm(fitted.scene.plane_per_m[0] - truth.plane_per_m[0]) < 0.2


def test_two_windows_have_a_velocity_and_a_plane_each() -> None:
    """The same wall seen from two places has the true values of each window."""
    recording = recorded(WALL)
    windows = [list(range(20)), list(range(20, 44))]
    fitted = fitted_wall(recording, BASIC[:1], windows)
    truth = recording.scene(recording.table(windows))
    assert isinstance(fitted.scene, InertialMotion)
    assert fitted.scene.windows == 2
    assert np.abs(np.diff(truth.velocity_m_s, axis=0)).max() > 0.05
    spread = np.sqrt(np.diag(fitted.covariance))[1:]
    assert (np.abs(fitted.scene.vector() - truth.vector()) < 4.5 * spread).all()
    assert fitted.scale == pytest.approx(1.0, abs=0.08)


def test_points_off_the_wall_widen_the_depth_spread() -> None:
    """Points between 1/0.3 m and 1/0.7 m fit no plane: a spread is measured, and the offset is still right."""
    setup = replace(WALL, plane_per_m=None, inverse_depth_per_m=(0.3, 0.7), sway_m=0.1)
    fitted = fitted_wall(recorded(setup), BASIC[:1])
    flat = fitted_wall(recorded(replace(WALL, sway_m=0.1)), BASIC[:1])
    assert 0.05 < fitted.depth_spread_per_m < 0.25
    assert flat.depth_spread_per_m < 0.03
    assert abs(errors(fitted)[0]) < 4 * deviations(fitted)[0]


def test_gyroscope_drift_does_not_shrink_with_tracking_noise() -> None:
    """Better tracks improve the lens's values, but the drift of the gyroscope stays."""
    fitted = fitted_from(recorded(PORTRAIT), BASIC)
    blurred, sharp = (bias_std(fitted, "gyro_bias", noise_px) for noise_px in (0.3, 0.05))
    assert np.all(blurred >= sharp)
    assert np.all(sharp >= 1.5e-4)
    assert np.all(bias_std(fitted, "focal_length", 0.05) < 0.5 * bias_std(fitted, "focal_length", 0.15))


def test_more_points_do_not_reduce_common_errors() -> None:
    """Eight times the points reduce the scatter of a lens value, but not the tracking errors that they share."""
    many = recorded(replace(PORTRAIT, points=80, noise_px=0.8))
    table = many.table()
    fits = [
        fit_tracks(many.imu, table.chosen(np.arange(len(table)) % 8 < part), many.profile, (terms_of.K1,))
        for part in (1, 8)
    ]
    few_std, all_std = (float(fit.std("radial_distortion")[0]) for fit in fits)
    few_bias, all_bias = (float(bias_std(fit, "radial_distortion", 0.0)[0]) for fit in fits)
    assert all_std < 0.6 * few_std
    assert all_bias == pytest.approx(few_bias, rel=0.15)
    weight, curvature = fits[1].weight.sum(), float(fits[1].curvature[0, 0])
    shared = 0.025 * np.sqrt(2 * weight * curvature)
    assert all_bias == pytest.approx(np.hypot(shared, fits[1].by_coding[0]), rel=1e-6)


def test_coherent_relief_widens_deviations_more_than_scattered_relief() -> None:
    """During a walk, walls bias the same regions of every frame, so the deviations are larger."""
    recording = recorded(replace(WALL, sway_m=0.02, velocity_m_s=(0.05, -0.1, 1.0), points=200))
    table = recording.table()
    scene = recording.scene(table)
    known = integrate_motion(recording.imu, recording.profile, translation=True)
    along = predict(known, table, scene).along_px
    assert along is not None
    parts = (table.first_px // 120).astype(int)
    relief = 0.06 * np.random.default_rng(3).normal(size=(8, 8))[parts[:, 0], parts[:, 1]]
    strewn = np.random.default_rng(4).permutation(relief)
    standing, scattered, flat = (
        fit_tracks(
            recording.imu, replace(table, second_px=table.second_px + along * shape[:, None]), recording.profile,
            (terms_of.GYRO_BIAS,), scene,
        )
        for shape in (relief, strewn, 0 * relief)
    )  # fmt: skip
    assert np.all(standing.std("gyro_bias") > 1.5 * scattered.std("gyro_bias"))
    deep, even = (bias_std(fit, "gyro_bias", 0.0) for fit in (scattered, flat))
    assert np.max(deep / even) > 2
    assert np.all(deep > even)


def test_a_wall_needs_an_accelerometer() -> None:
    """Without one there is no path to fit, and the error says so."""
    recording = recorded(WALL)
    table = recording.table()
    blind = replace(recording.imu, accel_m_s2=np.full_like(recording.imu.accel_m_s2, np.nan))
    with pytest.raises(ImuError, match="no accelerometer"):
        fit_tracks(blind, table, recording.profile, BASIC[:1], recording.scene(table))


def test_the_initial_scene_has_gravity_down() -> None:
    """It starts at rest in front of a frontal plane, with gravity of 9.81 m/s² within 10° of the truth."""
    recording = recorded(WALL)
    table = recording.table()
    scene = start_scene(recording.imu, integrate_motion(recording.imu, recording.profile, translation=True), table, 0.4)
    truth = recording.scene(table)
    assert np.linalg.norm(scene.gravity_m_s2) == pytest.approx(9.81)
    assert scene.gravity_m_s2 @ truth.gravity_m_s2 / 9.81**2 > np.cos(np.radians(10))
    assert not scene.velocity_m_s.any()
    origin_s = np.asarray(recording.profile.imu_time_s(table.origin_s))
    sight = recording.in_trajectory_axes(recording.orientation(origin_s).apply([0.0, 0.0, 0.4]))
    np.testing.assert_allclose(scene.plane_per_m, sight, atol=1e-4)


def test_a_swaying_camera_is_fitted_from_rest() -> None:
    """Accelerations of 10 m/s², integrated from rest, lead far away; the fit must still converge."""
    recording = recorded(
        Setup(seed=59, sway_m=0.4, velocity_m_s=(-0.4, 0.3, -0.6), plane_per_m=(0.0, -0.1, 0.4), rate_rad_s=1.2,
              frames=70, points=15, gyro_noise_rad_s=0.001)
    )  # fmt: skip
    table = recording.table()
    known = integrate_motion(recording.imu, recording.profile, translation=True)
    fitted = fit_tracks(recording.imu, table, recording.profile, (), start_scene(recording.imu, known, table, 0.5))
    truth = recording.scene(table)
    assert isinstance(fitted.scene, InertialMotion)
    assert fitted.scale == pytest.approx(1.0, abs=0.1)
    np.testing.assert_allclose(fitted.scene.velocity_m_s, truth.velocity_m_s, atol=0.05)
    np.testing.assert_allclose(fitted.scene.plane_per_m, truth.plane_per_m, atol=0.03)


def test_errors_that_cancel_in_a_combination_are_excluded() -> None:
    """The errors of two values cancel in their sum; correcting one alone must not add them again."""
    together = np.array([[1.0, -1.0], [-1.0, 1.0]])
    by_region = np.array([[3.0, -3.0], [-3.0, 3.0]])
    model = CovarianceModel(1e-6 * np.eye(2), together, by_region, np.zeros((2, 2)), relief=np.array([[0.5, -0.5]]))
    each = model.propagate(np.eye(2))
    np.testing.assert_allclose(np.diag(each), 4.0)
    total = np.array([[1.0, 1.0]])
    np.testing.assert_allclose(model.propagate(total), 2e-6)
    np.testing.assert_allclose(model.propagate_relief(total), 0.0, atol=1e-12)
    np.testing.assert_allclose(model.propagate_relief(np.array([[1.0, 0.0]])), 0.25)
    lopsided = replace(model, by_region=np.diag([3.0, -1.0]))
    np.testing.assert_allclose(np.diag(lopsided.propagate(np.eye(2))), [4.0, 1.0])


# ── bias of points towards the coding blocks above ───────────────────────────────────────────────────────────────


@pytest.mark.parametrize("read", ["top_to_bottom", "bottom_to_top"])
@pytest.mark.parametrize(
    "term", [terms_of.TIME_OFFSET, terms_of.PLAIN_READOUT, terms_of.CLOCK_SKEW], ids=lambda term: term.name
)
def test_steps_of_the_rows_above_are_within_the_deviation(term: Term, read: str) -> None:
    """Points biased towards the motion above them seem late, or early if rows are read upwards.

    Whichever of offset, readout and skew is fitted, its deviation includes this bias.
    """
    recording = recorded(replace(LANDSCAPE, readout_direction=read, gyro_noise_rad_s=0.0, noise_px=0.15, frames=60))
    table, profile = replace(recording.table(), bits_per_px=0.1), recording.profile
    known = integrate_motion(recording.imu, profile, translation=False)
    slopes = step_slopes(known, table, None, predict(known, table, None))
    drawn = drawn_px(slopes, table.noise_px[table.pair], table.bits_per_px)[1]
    fits = [
        fit_tracks(recording.imu, replace(table, second_px=table.second_px + shift), profile, (term,))
        for shift in (0.0, drawn)
    ]
    moved = float(fits[1].change[0] - fits[0].change[0])
    bias, coded = bias_std(fits[1], term.name, 0.15)[0], fits[1].by_coding[0]
    assert 0.5 * coded < abs(moved) < 1.001 * coded
    assert abs(moved) < 1.1 * bias
    if term is terms_of.TIME_OFFSET:
        assert (moved < 0) == (read == "top_to_bottom")


def test_a_steady_rotation_is_not_pulled() -> None:
    """Every frame is biased alike, including rows' times and roll, so steps between frames have no bias."""
    recording = recorded(replace(LANDSCAPE, gyro_noise_rad_s=0.0, clock_skew=0.0, exposure_swing=0.0, frames=20))
    table, imu = recording.table(), recording.imu
    steady = replace(imu, gyro_rad_s=np.broadcast_to([0.2, -0.3, 0.8], imu.gyro_rad_s.shape))
    for rotating, imu in ((False, steady), (True, recording.imu)):
        known = integrate_motion(imu, recording.profile, translation=False)
        slopes = step_slopes(known, table, None, predict(known, table, None))
        assert np.abs(slopes.lasting).max() > 1e-3
        assert (np.abs(slopes.changed).max() > 1e-3) == rotating


def test_uniform_motion_has_no_coding_bias() -> None:
    """Without a gradient there is no bias; for a small gradient it is at most that over a block's side."""
    none, little = np.zeros((2, 5, 2)), np.full((2, 5, 2), 1e-3)
    assert not drawn_px(StepSlopes(none, none), np.full(5, 0.2), 0.1).any()
    slight = drawn_px(StepSlopes(little, none), np.full(5, 0.5), 0.1)
    assert np.abs(slight).max() <= 16e-3


def test_coding_bias_follows_the_bit_rate() -> None:
    """A quarter of the bit rate doubles every bias; uncoded frames have none."""
    rng = np.random.default_rng(5)
    slopes, noise_px = StepSlopes(*rng.normal(0, 0.01, (2, 2, 5, 2))), np.full(5, 0.05)
    coarse, fine, uncoded = (drawn_px(slopes, noise_px, bits) for bits in (0.1, 0.4, np.inf))
    assert np.abs(fine).max() > 1e-4
    np.testing.assert_allclose(coarse, 2 * fine)
    assert not uncoded.any()


def test_the_mean_pull_is_predicted_and_undone() -> None:
    """An upward pull in a picture read from top to bottom looks like a delay; removing the mean undoes it."""
    recording = recorded(replace(LANDSCAPE, gyro_noise_rad_s=0.0, noise_px=0.1, clock_skew=0.0))
    table, profile = replace(recording.table(), bits_per_px=0.1), recording.profile
    bias_px = coding_bias_px(integrate_motion(recording.imu, profile, translation=False), table, None)
    terms = (terms_of.TIME_OFFSET, terms_of.READOUT)
    clean, coded = (
        fit_tracks(recording.imu, replace(table, second_px=table.second_px + shift), profile, terms)
        for shift in (0.0, bias_px)
    )
    moved = coded.change - clean.change
    assert moved[0] < -0.5 * coded.by_coding[0]
    assert abs(moved[0]) < coded.by_coding[0]
    assert coded.by_coding_left[0] < coded.by_coding[0]
    predicted = fit_tracks(recording.imu, table, profile, terms, errors_px=bias_px[None]).by_error
    np.testing.assert_allclose(predicted, np.abs(moved), rtol=0.05, atol=1e-6)
