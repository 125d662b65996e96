"""Predicted points compared with an independent generator, derivatives with difference quotients, and row times."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from motion.synthetic_tracks import Recording, Setup, recorded
from scipy.spatial.transform import Rotation

from virest.camera.profile import CameraProfile
from virest.camera.shutter import READOUT_DIRECTIONS, Shutter
from virest.image_formation.point_model import (
    IntegratedMotion,
    TrackTable,
    integrate_motion,
    predict,
    pulse_delay_s,
    seen_s,
    with_profile,
)
from virest.image_formation.row_clock import right_way_round
from virest.inference import profile_terms as terms_of
from virest.inference.track_fit import Term
from virest.motion.integration import integrate_gyro
from virest.motion.scene_motion import DirectedMotion, InertialMotion

LANDSCAPE = {"width": 640, "height": 480, "centre_px": (331.0, 226.0)}
FAR = {
    "portrait, read from the right": Setup(noise_px=0.0),
    "landscape, distorted, stamped at the end": Setup(
        seed=2, noise_px=0.0, k1=0.05, readout_direction="top_to_bottom", timestamp="exposure_end", **LANDSCAPE
    ),
    "skewed clock, scaled gyroscope": Setup(
        seed=3, noise_px=0.0, readout_direction="left_to_right", clock_skew=0.003, gyro_scale=1.03, **LANDSCAPE
    ),
    "refocusing, read upwards, stamped at the middle": Setup(
        seed=4, noise_px=0.0, readout_direction="bottom_to_top", timestamp="exposure_middle", focal_drift_per_s=0.02
    ),
    "filtered gyroscope, pixels not square": Setup(seed=10, noise_px=0.0, gyro_lowpass_hz=9.0, pixel_aspect=1.03),
    "stabilised": Setup(seed=5, noise_px=0.0, stabilised=(0.6, 0.7), readout_direction="top_to_bottom"),
    "stabilised from slow sways on": Setup(seed=4, noise_px=0.0, stabilised=(0.8, 0.3)),
}
NEAR = {
    "swaying": Setup(
        seed=6, noise_px=0.0, sway_m=0.06, velocity_m_s=(0.1, -0.2, 0.15), plane_per_m=(0.1, -0.15, 0.5)
    ),
    "long arm, skewed clock": Setup(
        seed=7, noise_px=0.0, sway_m=0.05, plane_per_m=(-0.1, 0.2, 0.7), arm_m=(0.03, -0.05, 0.01),
        clock_skew=-0.002, readout_direction="bottom_to_top", **LANDSCAPE,
    ),
    "late accelerations": Setup(seed=8, noise_px=0.0, sway_m=0.05, plane_per_m=(0.1, 0.1, 0.4), accel_delay_s=0.002),
}  # fmt: skip
WINDOWS = [list(range(13)), list(range(13, 29))]


@pytest.mark.parametrize("setup", FAR.values(), ids=FAR)
def test_distant_points_are_predicted_within_a_hundredth_of_a_pixel(setup: Setup) -> None:
    """Pure rotation, with rows, exposures, clock and lens of the generator."""
    recording, table = recorded(setup), recorded(setup).table()
    found = predict(integrate_motion(recording.imu, recording.profile, translation=False), table, None)
    assert np.median(np.linalg.norm(table.second_px - table.first_px, axis=1)) > 5
    assert np.abs(found.second_px - table.second_px).max() < 0.01
    np.testing.assert_allclose(found.first_s, recording.seen_s(table.first_px, table.first), atol=1e-9)
    np.testing.assert_allclose(found.second_s, recording.seen_s(table.second_px, table.second), atol=1e-9)


@pytest.mark.parametrize("windows", [None, WINDOWS], ids=["one window", "two windows"])
@pytest.mark.parametrize("setup", NEAR.values(), ids=NEAR)
def test_points_on_a_wall_are_predicted_within_a_hundredth_of_a_pixel(
    setup: Setup, windows: list[list[int]] | None
) -> None:
    """Rotation and sway in front of a wall, with the true velocity, gravity, bias, delay and plane of each window."""
    recording, table = recorded(setup), recorded(setup).table(windows)
    known = integrate_motion(recording.imu, recording.profile, translation=True)
    found = predict(known, table, recording.scene(table))
    assert np.abs(found.second_px - table.second_px).max() < 0.012
    turning = predict(known, table, None)
    assert np.median(np.linalg.norm(turning.second_px - table.second_px, axis=1)) > 0.3


@pytest.mark.parametrize("setup", NEAR.values(), ids=NEAR)
def test_derivatives_of_the_motion_match_difference_quotients(setup: Setup) -> None:
    """Those of the planes agree within 0.2 %; the others neglect how the path changes the depths."""
    recording, table = recorded(setup), recorded(setup).table(WINDOWS)
    known, scene = integrate_motion(recording.imu, recording.profile, translation=True), recording.scene(table)
    slopes = predict(known, table, scene, slopes=True).slopes
    assert slopes is not None
    assert slopes.shape == (len(table), 2, 7 + 6 * 2)
    for entry, step in enumerate([1e-3] * 6 + [1e-5] + [1e-4] * 12):
        change = np.zeros(19)
        change[entry] = step
        ahead, back = (predict(known, table, scene.with_vector(scene.vector() + s * change)) for s in (1, -1))
        quotient = (ahead.second_px - back.second_px) / (2 * step)
        planes = entry in (10, 11, 12, 16, 17, 18)
        assert np.abs(slopes[..., entry] - quotient).max() < (0.002 if planes else 0.12) * np.abs(quotient).max(), entry


def test_points_beyond_the_horizon_are_infinitely_far_for_derivatives_too() -> None:
    """Over the ground half of the points lie above the horizon, and no small change of the plane moves those."""
    recording, table = recorded(NEAR["swaying"]), recorded(NEAR["swaying"]).table()
    known, scene = over_the_ground(recording, table)
    at = predict(known, table, scene, slopes=True)
    assert at.slopes is not None
    assert at.moved is not None
    above = at.moved.inverse_depth == 0
    assert 0.2 < above.mean() < 0.8
    assert not at.slopes[above].any()
    for entry in (10, 11, 12):
        change = np.zeros(13)
        change[entry] = 1e-5
        ahead, back = (predict(known, table, scene.with_vector(scene.vector() + s * change)) for s in (1, -1))
        quotient = (ahead.second_px - back.second_px) / 2e-5
        np.testing.assert_allclose(at.slopes[..., entry], quotient, atol=0.005 * np.abs(quotient).max())


def over_the_ground(recording: Recording, table: TrackTable) -> tuple[IntegratedMotion, InertialMotion]:
    """A recording's motion 2 m above the ground, across which the camera looks, and the scene."""
    known = integrate_motion(recording.imu, recording.profile, translation=True)
    scene = recording.scene(table)
    down = recording.in_trajectory_axes(recording.orientation(np.zeros(1)).apply([[0.0, 1.0, 0.0]]))
    return known, replace(scene, plane_per_m=0.5 * down)


def test_parallax_lies_along_the_direction_of_travel() -> None:
    """Points at any depth deviate from the rotation's prediction along the flow of the camera's true direction."""
    setup = Setup(seed=9, noise_px=0.0, velocity_m_s=(0.4, -0.3, 1.5), inverse_depth_per_m=(0.02, 0.2), about=(0, 0, 0))
    recording, table = recorded(setup), recorded(setup).table()
    known = integrate_motion(recording.imu, recording.profile, translation=False)
    way = recording.in_trajectory_axes(np.array(setup.velocity_m_s))
    along = predict(known, table, DirectedMotion(way[None] / np.linalg.norm(way)), slopes=True).along_px
    assert along is not None
    moved = table.second_px - predict(known, table, None).second_px
    unit = along / np.linalg.norm(along, axis=1, keepdims=True)
    across = moved[:, 0] * unit[:, 1] - moved[:, 1] * unit[:, 0]
    assert np.quantile(np.linalg.norm(moved, axis=1), 0.9) > 2
    assert np.abs(across).max() < 0.02
    # c₁ − c₂ points against the direction of travel
    assert ((moved * unit).sum(axis=1) < 0.01).all()


@pytest.mark.parametrize("setup", NEAR.values(), ids=NEAR)
def test_the_direction_of_parallax_is_the_same_with_derivatives(setup: Setup) -> None:
    """A difference quotient and the lens's derivative give the same pixels per inverse depth."""
    recording, table = recorded(setup), recorded(setup).table()
    known, scene = integrate_motion(recording.imu, recording.profile, translation=True), recording.scene(table)
    quick, exact = (predict(known, table, scene, slopes=slopes).along_px for slopes in (False, True))
    assert quick is not None
    assert exact is not None
    np.testing.assert_allclose(quick, exact, atol=1e-3 * np.abs(exact).max())


@pytest.mark.parametrize("exposure_s", [0.0005, 0.004, 0.013])
def test_flicker_moves_the_mean_time_of_the_light(exposure_s: float) -> None:
    """The delay equals the integral of the light over the exposure."""
    profile = recorded(Setup()).profile
    pulsing = replace(profile.extensions, flicker_amplitude=0.6, flicker_frequency_hz=100.0, flicker_phase_rad=0.4)
    profile = replace(profile, extensions=pulsing)
    middle_s = np.linspace(0.3, 0.33, 7)
    around_s = (np.arange(20_000) + 0.5) / 20_000 * exposure_s - 0.5 * exposure_s
    light = 1 + 0.6 * np.sin(2 * np.pi * 100.0 * (middle_s[:, None] + around_s) + 0.4)
    expected_s = (light * around_s).sum(axis=1) / light.sum(axis=1)
    found_s = pulse_delay_s(profile, middle_s, np.full(7, exposure_s))
    np.testing.assert_allclose(found_s, expected_s, atol=1e-6 * exposure_s)


# ── the gyroscope ────────────────────────────────────────────────────────────────────────────────────────────────


def test_angular_acceleration_is_the_derivative_of_the_rate() -> None:
    """It equals the numerical derivative of the generator's rate, in camera axes."""
    recording = recorded(FAR["portrait, read from the right"])
    trajectory = integrate_gyro(recording.imu, recording.profile)
    time_s = np.array([[0.1007, 0.3333], [0.5, 0.9114]])
    found = trajectory.angular_acceleration_rad_s2(time_s)
    truth = (recording.rate(time_s.ravel() + 1e-5) - recording.rate(time_s.ravel() - 1e-5)) / 2e-5
    assert found.shape == (2, 2, 3)
    np.testing.assert_allclose(found.reshape(-1, 3), truth, atol=2e-3 * np.abs(truth).max())
    quotient = (trajectory.rate_rad_s(time_s + 1e-6) - trajectory.rate_rad_s(time_s - 1e-6)) / 2e-6
    np.testing.assert_allclose(found, quotient, atol=1e-4)


def test_mean_orientation_is_the_mean_over_the_exposure() -> None:
    """It agrees with SciPy's mean within 5 % of its distance to the middle's; without exposure it is the middle's."""
    recording = recorded(replace(FAR["portrait, read from the right"], rate_rad_s=1.5))
    trajectory = integrate_gyro(recording.imu, recording.profile)
    middle_s, exposure_s = np.array([0.21, 0.4, 0.77]), np.array([0.04, 0.03, 0.04])
    mean, still = (trajectory.mean_orientation(middle_s, e) for e in (exposure_s, 0 * exposure_s))
    found = Rotation.from_matrix(mean.knot @ mean.since)
    nodes = np.linspace(-0.5, 0.5, 401)[:-1] + 0.5 / 400
    truth = Rotation.concatenate(
        [
            Rotation.from_matrix(trajectory.orientation(m + e * nodes)).mean()
            for m, e in zip(middle_s, exposure_s, strict=True)
        ]
    )
    plain = Rotation.from_matrix(trajectory.orientation(middle_s))
    bend = (plain.inv() * truth).magnitude()
    assert bend.min() > 1e-4
    assert ((found.inv() * truth).magnitude() < 0.05 * bend).all()
    np.testing.assert_allclose(still.knot @ still.since, plain.as_matrix(), atol=1e-12)
    rays = np.array([[0.1, -0.2, 1.0], [0.3, 0.1, 1.0], [-0.2, 0.0, 1.0]])
    np.testing.assert_allclose(mean.to_world(rays), found.apply(rays), atol=1e-14)
    np.testing.assert_allclose(mean.to_camera(mean.to_world(rays)), rays, atol=1e-14)
    by_world = np.stack([mean.to_camera(np.tile(axis, (3, 1))) for axis in np.eye(3)], axis=-1)
    np.testing.assert_allclose(mean.per_world(np.tile(np.eye(3), (3, 1, 1))), by_world, atol=1e-14)


# ── row times ────────────────────────────────────────────────────────────────────────────────────────────────────


def phone(readout_s: float, direction: str) -> CameraProfile:
    """A phone with an ordinary size, timestamp and clock."""
    return CameraProfile(
        480, 640, shutter=Shutter(readout_s, direction, "exposure_end", 0.9), time_offset_s=0.031, clock_skew=0.0
    )


POINTS_PX = np.random.default_rng(5).uniform((0, 0), (480, 640), (50, 2))


@pytest.mark.parametrize("direction", READOUT_DIRECTIONS)
def test_a_negative_readout_time_reverses_the_direction(direction: str) -> None:
    """Every point keeps its time when the profile is corrected, and a second correction changes nothing."""
    backwards = phone(-0.0193, direction)
    right = right_way_round(backwards)
    assert right.shutter.readout_time_s == 0.0193
    assert right.shutter.readout_direction != direction
    assert right.shutter.reads_columns == backwards.shutter.reads_columns
    before, after = (seen_s(p, POINTS_PX, np.full(50, 0.7), np.full(50, 0.011)) for p in (backwards, right))
    np.testing.assert_allclose(after, before, atol=1e-12)
    assert np.ptp(before) > 0.015
    assert right_way_round(right) == right


@pytest.mark.parametrize("direction", READOUT_DIRECTIONS)
def test_a_step_of_the_readout_keeps_the_middle_row(direction: str) -> None:
    """From +12 ms to −9 ms, the row at half the readout keeps its time and the others move about it."""
    before, after = phone(0.012, direction), terms_of.add_readout(phone(0.012, direction), np.array([-0.021]))
    assert after.shutter.readout_time_s == pytest.approx(-0.009)
    fraction = before.shutter.readout_fraction(POINTS_PX, 480, 640)
    change = np.subtract(*(seen_s(p, POINTS_PX, np.full(50, 0.7), np.full(50, 0.011)) for p in (after, before)))
    np.testing.assert_allclose(change, -0.021 * (fraction - 0.5), atol=1e-12)


# ── the table and cached integrations ────────────────────────────────────────────────────────────────────────────

TERMS = [value for value in vars(terms_of).values() if isinstance(value, Term)]


@pytest.mark.parametrize("term", TERMS, ids=lambda term: term.name)
def test_a_cached_integration_gives_the_same_predictions(term: Term) -> None:
    """An integration adapted to a changed profile predicts like a new one, with and without translation."""
    setup = replace(NEAR["long arm, skewed clock"], points=4)
    recording, table = recorded(setup), recorded(setup).table()
    known = integrate_motion(recording.imu, recording.profile, translation=True)
    changed = term.change(recording.profile, 3 * np.array(term.quotient))
    assert changed != recording.profile
    for scene in (None, recording.scene(table)):
        carried = predict(with_profile(known, recording.imu, changed), table, scene)
        fresh = predict(integrate_motion(recording.imu, changed, translation=True), table, scene)
        np.testing.assert_allclose(carried.second_px, fresh.second_px, rtol=0, atol=1e-9)
        assert np.abs(carried.second_px - predict(known, table, scene).second_px).max() > 1e-4


@pytest.mark.parametrize("term", TERMS, ids=lambda term: term.name)
def test_the_steps_of_a_term_add_up_and_are_reversible(term: Term) -> None:
    """For each parameter, two steps equal one of their sum, and the opposite step restores the prediction."""
    setup = replace(NEAR["long arm, skewed clock"], points=4, stabilised=(0.3, 0.8), k1=0.02)
    recording, table = recorded(setup), recorded(setup).table()

    def predicted(profile: CameraProfile) -> np.ndarray:
        return predict(integrate_motion(recording.imu, profile, translation=False), table, None).second_px

    for k, quotient in enumerate(term.quotient):
        step = quotient * np.eye(len(term))[k]
        once = term.change(recording.profile, step)
        np.testing.assert_allclose(
            predicted(term.change(once, 2 * step)), predicted(term.change(recording.profile, 3 * step)), atol=1e-6
        )
        np.testing.assert_allclose(predicted(term.change(once, -step)), predicted(recording.profile), atol=1e-6)


def test_the_table_arranges_pairs_in_windows() -> None:
    """Pairs are numbered from 0, each with its window; the origin of a window is the mean of its timestamps."""
    recording = recorded(Setup(frames=9, points=5))
    table = recording.table([[0, 1, 2, 3, 4], [5, 6, 7]])
    assert table.n_pairs == 8
    assert table.n_windows == 2
    assert len(table) == sum(map(len, recording.pairs))
    np.testing.assert_array_equal(table.window, table.pair >= 5)
    np.testing.assert_array_equal(table.second, table.first + 1)
    np.testing.assert_allclose(table.origin_s, [np.mean(recording.stamp_s[:6]), np.mean(recording.stamp_s[5:9])])
    np.testing.assert_array_equal(table.second_stamp_s, recording.stamp_s[table.pair + 1])
    np.testing.assert_array_equal(table.first_exposure_s, recording.exposure_s[table.pair])
    some = table.chosen(table.pair % 3 == 2)
    assert set(some.pair) == {2, 5}
    assert some.n_windows == 2
    np.testing.assert_array_equal(some.first_px, table.first_px[table.pair % 3 == 2])
