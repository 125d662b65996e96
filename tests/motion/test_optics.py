"""The moving lens.

Focal drift and stabiliser, compared with hand calculations, an ODE solver, and the simulator's rays.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from laws import FISHEYE, RADTAN, UNDISTORTED, phone
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.motion.integration import integrate_gyro
from virest.motion.optics import MovingLens, moving_lens, settling_time_s, stabiliser_shift
from virest.motion.trajectory import Trajectory
from virest.simulation.exposure import make_view
from virest.simulation.hand_motion import HandMotion, random_hand_motion

LENSES = [pytest.param(lens, id=lens[0]) for lens in (UNDISTORTED, RADTAN, FISHEYE)]
HAND = random_hand_motion(np.random.default_rng(5), rate_rms_rad_s=1.5, duration_s=1.0)


def extended(profile: CameraProfile, **extensions: float) -> CameraProfile:
    """The profile with the given extensions."""
    return replace(profile, extensions=replace(profile.extensions, **extensions))


def sampled(hand: HandMotion, profile: CameraProfile, start_s: float, end_s: float) -> Trajectory:
    """Trajectory integrated from the gyroscope of a simulated hand motion."""
    time_s = np.arange(start_s, end_s, 0.002)
    measured = hand.rate_rad_s(time_s) @ profile.rotation_cam_imu * profile.gyro_scale + profile.gyro_bias_rad_s
    return integrate_gyro(ImuSamples(time_s, measured, np.full((len(time_s), 3), np.nan)), profile)


def pixels() -> NDArray[np.float64]:
    """Points inside a frame of 200 × 136."""
    return np.random.default_rng(3).uniform((0, 0), (199, 135), (30, 2))


def test_steady_rotation_matches_a_hand_calculation() -> None:
    """At 0.5 Hz, θ(1 s) = ω (1 − e^(−π)) / π = 0.3046 ω; x moves by +0.6 θ_y, y by −0.6 θ_x."""
    time_s = np.array([0.3, 0.31, 0.7, 1.3, 1.301])
    rate = np.tile([-0.25, 0.4, 2.0], (5, 1))
    shift = stabiliser_shift(time_s, rate, fraction=0.6, cutoff_hz=0.5)
    assert shift[3] == pytest.approx([0.6 * 0.4 * 0.3045545, 0.6 * 0.25 * 0.3045545], rel=1e-6)
    filled = (1 - np.exp(-np.pi * (time_s - 0.3))) / np.pi
    np.testing.assert_allclose(shift, filled[:, None] * [0.24, 0.15], atol=1e-15)


def test_the_shift_solves_the_high_pass() -> None:
    """For rates linear between uneven times, it solves θ' = ω − 2π cutoff θ as accurately as an ODE solver."""
    rng = np.random.default_rng(8)
    time_s = np.cumsum(rng.uniform(0.001, 0.02, 60))
    rate = rng.normal(size=(60, 3))

    def slope(t: float, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([np.interp(t, time_s, rate[:, i]) for i in (0, 1)]) - 2 * np.pi * 1.7 * theta

    theta = [np.zeros(2)]
    for a, b in pairwise(time_s):
        theta.append(solve_ivp(slope, (a, b), theta[-1], rtol=1e-11, atol=1e-13).y[:, -1])
    pitch, yaw = np.array(theta).T
    expected = np.stack([-0.8 * yaw, 0.8 * pitch], -1)
    np.testing.assert_allclose(stabiliser_shift(time_s, rate, -0.8, 1.7), expected, atol=1e-10)


def test_a_filter_that_stops_at_the_end_turns_back_at_once() -> None:
    """θ is limited at every step, from any lean; a filter that runs on comes back late."""
    rng = np.random.default_rng(9)
    time_s = np.cumsum(rng.uniform(0.001, 0.02, 300))
    rate = np.cumsum(0.3 * rng.normal(size=(300, 3)), axis=0)
    free, lean = stabiliser_shift(time_s, rate, 0.8, 0.4), np.array([0.03, -0.02])
    stopped = stabiliser_shift(time_s, rate, 0.8, 0.4, lean, travel_rad=0.02)
    theta, end = lean[None].clip(-0.025, 0.025), 0.025
    for k, (a, b) in enumerate(pairwise(time_s)):
        step = stabiliser_shift(np.array([a, b]), rate[k : k + 2], 1.0, 0.4)[1]
        theta = np.vstack([theta, np.clip(np.exp(-0.8 * np.pi * (b - a)) * theta[-1] + [-step[1], step[0]], -end, end)])
    np.testing.assert_allclose(stopped, 0.8 * theta[:, [1, 0]] * (1.0, -1.0), atol=1e-12)
    assert np.abs(np.clip(free, -0.02, 0.02) - stopped).max() > 0.01


def test_a_cutoff_near_zero_keeps_the_complete_rotation() -> None:
    """Without the high-pass filter the shift is the plain integral of the rate."""
    time_s = np.linspace(0, 1, 11)
    rate = np.stack([time_s, 2 - time_s, time_s * 0], -1)
    shift = stabiliser_shift(time_s, rate, 1.0, 1e-7)
    np.testing.assert_allclose(shift, np.stack([2 * time_s - time_s**2 / 2, -(time_s**2) / 2], -1), atol=1e-5)


def test_the_start_does_not_matter_after_the_settling_time() -> None:
    """A log that begins one settling time before a frame gives the stabiliser's state of the complete log."""
    profile = extended(phone(), stabilisation_fraction=0.9, stabilisation_cutoff_hz=4.0)
    assert 0.5 < settling_time_s(profile) < 0.7
    whole = moving_lens(sampled(HAND, profile, -1.0, 1.0), profile)
    later = moving_lens(sampled(HAND, profile, 0.5 - settling_time_s(profile), 1.0), profile)
    at_s = np.linspace(0.5, 0.9, 30)
    np.testing.assert_allclose(later.shift_at(at_s), whole.shift_at(at_s), atol=1e-7)
    assert np.abs(whole.shift_at(at_s)).max() > 0.01
    assert settling_time_s(phone()) == 0.0


def test_a_cached_lens_is_reused_only_if_valid() -> None:
    """A lens computed from another one of the same motion equals one computed from scratch."""
    profile = phone()
    trajectory = sampled(HAND, profile, -0.5, 1.2)
    first = moving_lens(trajectory, extended(profile, stabilisation_fraction=0.6, stabilisation_cutoff_hz=0.7))
    for fraction, cutoff_hz in ((0.35, 0.7), (0.6, 1.9)):
        other = extended(profile, stabilisation_fraction=fraction, stabilisation_cutoff_hz=cutoff_hz)
        alone, alike = moving_lens(trajectory, other), moving_lens(trajectory, other, like=first)
        assert alone.shift is not None
        np.testing.assert_array_equal(alike.shift, alone.shift)
        assert np.abs(alone.shift - first.shift).max() > 1e-3
    turned = Trajectory(trajectory.time_s, trajectory.rotation_world_cam, 0.5 * trajectory.rate_polynomials)
    again = extended(profile, stabilisation_fraction=0.6, stabilisation_cutoff_hz=0.7)
    np.testing.assert_allclose(moving_lens(turned, again).shift, 0.5 * first.shift, atol=1e-12)


@pytest.mark.parametrize("lens", LENSES)
def test_a_lens_at_rest_equals_the_intrinsics(lens: tuple[str, tuple[float, ...]]) -> None:
    """Without drift and stabiliser, rays and pixels are bit-identical to those of the intrinsics."""
    profile = phone(lens=lens)
    moving, still = moving_lens(sampled(HAND, profile, -0.1, 0.1), profile), profile.intrinsics
    assert still is not None
    rays = still.rays(pixels())
    np.testing.assert_array_equal(moving.rays(pixels(), 0.03), rays)
    np.testing.assert_array_equal(moving.project(rays, 0.03), still.project(rays))


def test_a_focal_drift_matches_a_hand_calculation() -> None:
    """At 5 % per second, 2 s after stamp_0 a point at (+40, −10) px from the centre is at (+44, −11) px."""
    lens = Intrinsics(200, 136, 220.0, 210.0, 104.0, 63.0)
    moving = MovingLens(lens, 0.05)
    rays = lens.rays(np.array([[144.0, 53.0]]))
    np.testing.assert_allclose(moving.project(rays, 2.0), [[148.0, 52.0]], atol=1e-12)
    np.testing.assert_allclose(moving.project(rays, np.array([-2.0])), [[140.0, 54.0]], atol=1e-12)


@pytest.mark.parametrize("lens", LENSES)
def test_projection_inverts_rays_at_every_time(lens: tuple[str, tuple[float, ...]]) -> None:
    """Each pixel with its own time projects back to itself."""
    profile = extended(phone(lens=lens), focal_drift_per_s=-0.08, stabilisation_fraction=0.7)
    moving = moving_lens(sampled(HAND, profile, -1.0, 1.0), profile)
    time_s = np.linspace(0.1, 0.9, 30)
    np.testing.assert_allclose(moving.project(moving.rays(pixels(), time_s), time_s), pixels(), atol=1e-6)
    cut = moving.between(0.1, 0.9)
    assert cut.shift_time_s is not None
    assert moving.shift_time_s is not None
    assert len(cut.shift_time_s) < len(moving.shift_time_s)
    np.testing.assert_array_equal(cut.rays(pixels(), time_s), moving.rays(pixels(), time_s))


@pytest.mark.parametrize(("travel_rad", "at_end"), [(None, "runs_on"), (0.02, "runs_on"), (0.02, "stops")])
@pytest.mark.parametrize("lens", LENSES)
def test_rays_match_the_simulator(lens: tuple[str, tuple[float, ...]], travel_rad: float | None, at_end: str) -> None:
    """Drift and stabiliser apply in the simulator's order: shift before distortion, drift of the complete frame."""
    profile = extended(
        phone(lens=lens, time_offset_s=0.0),
        focal_drift_per_s=0.02,
        stabilisation_fraction=0.7,
        stabilisation_cutoff_hz=0.8,
        stabilisation_travel_rad=travel_rad,
        stabilisation_at_end=at_end,
    )
    moving = moving_lens(sampled(HAND, profile, -0.6, 1.0), profile)
    view = make_view(profile, HAND, rest_s=-0.6)
    for time_s in (0.05, 0.77):
        x, y = np.broadcast_arrays(*view.rays(time_s, slice(None), slice(None)))
        grid = np.stack(np.meshgrid(np.arange(200.0), np.arange(136.0)), -1)
        rays = moving.rays(grid, time_s)
        np.testing.assert_allclose(rays[..., :2], np.stack([x, y], -1), atol=1e-4)
        assert profile.intrinsics is not None
        assert np.abs(rays - profile.intrinsics.rays(grid)).max() > 0.01


def test_a_stabiliser_needs_a_focal_length() -> None:
    """Without intrinsics there is no lens to shift."""
    profile = phone()
    with pytest.raises(ValueError, match="intrinsics"):
        moving_lens(sampled(HAND, profile, 0.0, 0.1), replace(profile, intrinsics=None))
