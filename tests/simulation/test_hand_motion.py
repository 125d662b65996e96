"""Motion of the hand: rates, orientations integrated from them, and accelerometer readings."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from steady_hand import constant_motion

from virest.simulation.hand_motion import random_hand_motion

GRAVITY = np.array([0.0, 9.81, 0.0])


def test_a_constant_rate_turns_by_rate_times_time():
    """The orientation at any time is the rotation vector ω t."""
    motion = constant_motion((0.3, -0.8, 1.1))
    times = np.array([-0.71234, 0.0, 0.12345, 0.9999])
    assert motion.rotation(times).as_rotvec() == pytest.approx(times[:, None] * [0.3, -0.8, 1.1], abs=1e-9)


def test_orientation_agrees_with_a_general_solver(rng):
    """After 1.3 s of 2 rad/s tremor the orientation equals a high-order Runge–Kutta solution within a microradian."""
    motion = random_hand_motion(rng, rate_rms_rad_s=2.0, duration_s=1.0)

    def turning(time_s, q):
        w, v = q[0], q[1:]
        rate = motion.rate_rad_s(np.array(time_s))
        return 0.5 * np.concatenate([[-v @ rate], w * rate + np.cross(v, rate)])

    start = motion.quat_world_cam(np.array([-0.2]))[0]
    solved = solve_ivp(turning, (-0.2, 1.1234), start, method="DOP853", rtol=1e-10, atol=1e-12).y[:, -1]
    difference = Rotation.from_quat(solved, scalar_first=True).inv() * motion.rotation(np.array([1.1234]))
    assert difference.magnitude()[0] < 1e-6


def test_the_rate_has_the_requested_rms_on_all_axes(rng):
    """The RMS over the duration is as requested, every axis turns, and poses stay near the mean."""
    motion = random_hand_motion(rng, rate_rms_rad_s=0.7, duration_s=2.0)
    times = np.linspace(0, 2, 3000)
    rate = motion.rate_rad_s(times)
    assert np.sqrt((rate**2).sum(axis=1).mean()) == pytest.approx(0.7, rel=0.02)
    assert np.sqrt((rate**2).mean(axis=0)).min() > 0.2
    assert motion.rotation(times).mean().magnitude() < 1e-3


def test_at_rest_the_accelerometer_reads_gravity_upwards():
    """World y points down, so an upright camera reads −9.81 along its y."""
    motion = constant_motion((0.0, 0.0, 0.0))
    assert motion.specific_force_m_s2(np.zeros(1), np.zeros(3), GRAVITY)[0] == pytest.approx([0, -9.81, 0])


def test_specific_force_is_the_second_derivative_of_the_path(rng):
    """At the end of an arm from the camera it is Rᵀ(p'' − g), with p differentiated numerically."""
    motion = random_hand_motion(rng, rate_rms_rad_s=1.0, duration_s=1.0, sway_rms_m=0.02)
    arm, step, time_s = np.array([0.03, -0.01, 0.02]), 1e-3, np.array([0.4321])
    path = [motion.position_m(t) + motion.rotation(t).apply(arm) for t in (time_s - step, time_s, time_s + step)]
    second = (path[0] - 2 * path[1] + path[2]) / step**2
    expected = motion.rotation(time_s).inv().apply(second - GRAVITY)
    assert motion.specific_force_m_s2(time_s, arm, GRAVITY) == pytest.approx(expected, abs=5e-3)


def test_a_walk_adds_an_arc_to_the_sway():
    """The hand's own motion is unchanged; the arc leads from +x/2 to −x/2, and y and z go out and back."""
    options = {"rate_rms_rad_s": 0.8, "duration_s": 2.5, "sway_rms_m": 0.01}
    still = random_hand_motion(np.random.default_rng(4), **options)
    walking = random_hand_motion(np.random.default_rng(4), walk_m=(0.5, -0.1, 0.2), **options)
    times = np.array([0.0, 1.25, 2.5])
    walked = walking.position_m(times) - still.position_m(times)
    np.testing.assert_allclose(walked, [[0.25, 0, 0], [0, -0.1, 0.2], [-0.25, 0, 0]], atol=1e-12)
    np.testing.assert_array_equal(walking.node_quat, still.node_quat)


def test_a_pan_adds_a_constant_rate_to_the_tremor():
    """The rate about the camera's y axis is that of tremor plus pan at all times; the other axes are unchanged."""
    options = {"rate_rms_rad_s": 0.7, "duration_s": 1.0}
    still = random_hand_motion(np.random.default_rng(4), **options)
    panning = random_hand_motion(np.random.default_rng(4), pan_rad_s=1.2, **options)
    times = np.linspace(0, 1, 7)
    expected = np.broadcast_to((0.0, 1.2, 0.0), (7, 3))
    np.testing.assert_allclose(panning.rate_rad_s(times) - still.rate_rad_s(times), expected, atol=1e-9)
