"""Hand motion: angular rate and sway as sums of sinusoids, and the orientation integrated from the rate.

The rate in camera axes is ``ω(t) = Σ a cos(2π f t + φ)`` per axis, so it and its derivatives are known in closed form.
Orientation obeys ``R' = R [ω]×``.  The fourth-order Magnus method (two Gauss nodes per step; Iserles & Nørsett 1999,
doi:10.1098/rsta.1999.0362) integrates it on a fixed grid, and from the nearest grid node to any requested time.

World axes are those of the camera at its mean pose: x right, y down, z forward.  Times are seconds on the IMU clock
from the first stamp.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from virest.arrays import Array

FINE_STEP_S = 5e-4
"""Step of the simulator's fine time grids: 1/160 of the shortest period of the hand's motion, 12 Hz."""
SHARE_PER_AXIS = (0.64, 0.64, 0.42)
"""Fraction of the RMS rate on pitch, yaw and roll: hands roll less than they pitch and yaw."""
_GAUSS = 0.5 - np.sqrt(3.0) / 6.0
"""Node of two-point Gauss-Legendre quadrature on [0, 1]; the other is 1 − this."""
_COMPONENTS = 18
"""Sinusoids per axis, one in each of as many parts of the band: too many for a visible period."""


class Signal(Protocol):
    """A vector-valued function of time."""

    def at(self, time_s: Array, derivative: int = 0) -> Array:
        """Value, or its time derivative of the given order, at times (...,): (..., 3)."""


@dataclass(frozen=True, slots=True)
class Waves:
    """Sum of cosines ``Σ amplitude cos(2π frequency t + phase)`` on each of three axes."""

    frequency_hz: Array
    """(3, n)."""
    amplitude: Array
    """(3, n)."""
    phase_rad: Array
    """(3, n)."""

    def at(self, time_s: Array, derivative: int = 0) -> Array:
        """Sum, or its time derivative of the given order, at times (...,): (..., 3)."""
        omega = 2 * np.pi * self.frequency_hz
        angle = np.asarray(time_s, float)[..., None, None] * omega + self.phase_rad + derivative * np.pi / 2
        return np.sum(self.amplitude * omega**derivative * np.cos(angle), axis=-1)

    def scaled(self, factor: float) -> Waves:
        """Return the waves with amplitudes multiplied by ``factor``."""
        return Waves(self.frequency_hz, self.amplitude * factor, self.phase_rad)


@dataclass(frozen=True, slots=True)
class HandMotion:
    """Motion of a camera over [start_s, end_s]; orientation a little beyond is one coarse step from the end node."""

    rate: Signal
    """Angular rate, rad/s, camera axes."""
    sway: Signal
    """Position of the camera centre, metres, world axes."""
    node_s: Array
    """(n,) times of the integrated orientations."""
    node_quat: Array
    """(n, 4) orientations, world from camera, w x y z."""

    @property
    def start_s(self) -> float:
        """Time of the first integrated orientation."""
        return float(self.node_s[0])

    @property
    def end_s(self) -> float:
        """Time of the last integrated orientation."""
        return float(self.node_s[-1])

    def rate_rad_s(self, time_s: Array) -> Array:
        """Angular rate in camera axes at times (...,): (..., 3)."""
        return self.rate.at(time_s)

    def rotation(self, time_s: Array) -> Rotation:
        """Orientation, world from camera, at times (n,)."""
        time_s = np.atleast_1d(np.asarray(time_s, float))
        nearest = np.clip(np.round((time_s - self.node_s[0]) / FINE_STEP_S).astype(int), 0, len(self.node_s) - 1)
        step = time_s - self.node_s[nearest]
        start = Rotation.from_quat(self.node_quat[nearest], scalar_first=True)
        return start * Rotation.from_rotvec(_magnus(self.rate, self.node_s[nearest], step))

    def quat_world_cam(self, time_s: Array) -> Array:
        """Orientation, world from camera, at times (n,), w x y z with w ≥ 0: (n, 4)."""
        return self.rotation(time_s).as_quat(canonical=True, scalar_first=True)

    def position_m(self, time_s: Array) -> Array:
        """Camera centre in world axes at times (...,): (..., 3)."""
        return self.sway.at(time_s)

    def specific_force_m_s2(self, time_s: Array, arm_cam_m: Array, gravity_world_m_s2: Array) -> Array:
        """Specific force, camera axes, at times (n,) on an accelerometer at ``arm_cam_m`` (camera axes): (n, 3).

        ``f = Rᵀ (p'' − g) + ω' × r + ω × (ω × r)``; at rest it is −g, 9.8 m/s² upwards.
        """
        omega, omega_dot = self.rate.at(time_s), self.rate.at(time_s, 1)
        inertial = self.sway.at(time_s, 2) - gravity_world_m_s2
        arm = np.broadcast_to(arm_cam_m, omega.shape)
        lever = np.cross(omega_dot, arm) + np.cross(omega, np.cross(omega, arm))
        return self.rotation(time_s).inv().apply(inertial) + lever


def random_hand_motion(
    rng: np.random.Generator,
    *,
    rate_rms_rad_s: float,
    duration_s: float,
    sway_rms_m: float = 0.0,
    walk_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    pan_rad_s: float = 0.0,
    margin_s: float = 1.0,
    band_hz: tuple[float, float] = (0.5, 12.0),
) -> HandMotion:
    """Hand tremor whose rate vector has the given RMS magnitude over [0, duration_s].

    The rate spectrum rises to about 2 Hz, is flat, and falls above 8 Hz.  Orientations extend ``margin_s`` beyond both
    ends.  sway_rms_m: RMS magnitude of a translation between 0.3 and 2.5 Hz.  walk_m: a step along an arc, side to side
    along x by the first value, out and back along y and z by the others.  pan_rad_s: constant rate about the camera's
    y axis.
    """
    rate = _random_waves(rng, band_hz, lambda f: (f / 2) / (1 + f / 2) / (1 + (f / 8) ** 2))
    rate = _with_rms(rate, np.array(SHARE_PER_AXIS) * rate_rms_rad_s, duration_s)
    if pan_rad_s:
        rate = _with_constant(rate, (0.0, pan_rad_s, 0.0))
    sway = _random_waves(rng, (0.3, 2.5), lambda f: 1 / (1 + f))
    sway = _with_rms(sway, np.array([0.65, 0.65, 0.4]) * sway_rms_m, duration_s)
    if any(walk_m):
        sway = _with_arc(sway, walk_m, duration_s)
    return integrate_motion(rate, sway, -margin_s, duration_s + margin_s, centre_on_s=(0.0, duration_s))


def integrate_motion(
    rate: Signal, sway: Signal, start_s: float, end_s: float, *, centre_on_s: tuple[float, float]
) -> HandMotion:
    """Integrate orientation over [start_s, end_s]; world axes are the mean orientation over ``centre_on_s``."""
    count = int(np.ceil((end_s - start_s) / FINE_STEP_S)) + 1
    node_s: Array = start_s + FINE_STEP_S * np.arange(count, dtype=float)
    steps = Rotation.from_rotvec(_magnus(rate, node_s[:-1], np.full(count - 1, FINE_STEP_S, float)))
    quat = _running_product(steps.as_quat(scalar_first=True))
    inside = (node_s >= centre_on_s[0] - FINE_STEP_S / 2) & (node_s <= centre_on_s[1] + FINE_STEP_S / 2)
    chosen = quat[inside] if inside.any() else quat[:1]
    mean = Rotation.from_quat(chosen, scalar_first=True).mean()
    centred = mean.inv() * Rotation.from_quat(quat, scalar_first=True)
    return HandMotion(rate, sway, node_s, centred.as_quat(scalar_first=True))


def _magnus(rate: Signal, start_s: Array, step_s: Array) -> Array:
    """Rotation vectors (n, 3) of steps (n,) from start_s (n,), in the axes at the step's start; error O(step⁵)."""
    first = rate.at(start_s + _GAUSS * step_s)
    second = rate.at(start_s + (1 - _GAUSS) * step_s)
    step = step_s[:, None]
    return 0.5 * step * (first + second) + np.sqrt(3.0) / 12.0 * step**2 * np.cross(first, second)


def _running_product(steps: Array) -> Array:
    """Running products q0 = 1, q1 = s0, q2 = s0 s1, … of quaternions (n, 4): (n + 1, 4)."""
    result = np.empty((len(steps) + 1, 4))
    w, x, y, z = 1.0, 0.0, 0.0, 0.0
    result[0] = w, x, y, z
    for i, (a, b, c, d) in enumerate(steps.tolist(), start=1):
        w, x, y, z = (
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        )
        result[i] = w, x, y, z
    return result / np.linalg.norm(result, axis=1, keepdims=True)


def _random_waves(rng: np.random.Generator, band_hz: tuple[float, float], spectrum: Callable[[Array], Array]) -> Waves:
    """One component per equal interval of log frequency, with random phase and an amplitude within ±40 %."""
    low, high = np.log(band_hz)
    fraction = (np.arange(_COMPONENTS) + rng.uniform(size=(3, _COMPONENTS))) / _COMPONENTS
    frequency = np.exp(low + (high - low) * fraction)
    amplitude = spectrum(frequency) * rng.uniform(0.6, 1.4, (3, _COMPONENTS))
    return Waves(frequency, amplitude, rng.uniform(0, 2 * np.pi, (3, _COMPONENTS)))


def _with_arc(waves: Waves, walk_m: tuple[float, float, float], duration_s: float) -> Waves:
    """Add half an ellipse over [0, duration_s]: x from +walk/2 to −walk/2, y and z out by walk and back."""
    frequency = np.full((3, 1), 0.5 / duration_s)
    amplitude = np.array([[0.5 * walk_m[0]], [walk_m[1]], [walk_m[2]]])
    phase = np.array([[0.0], [-np.pi / 2], [-np.pi / 2]])
    parts = ((waves.frequency_hz, frequency), (waves.amplitude, amplitude), (waves.phase_rad, phase))
    return Waves(*(np.concatenate(pair, axis=1) for pair in parts))


def _with_constant(waves: Waves, value: tuple[float, float, float]) -> Waves:
    """Add a constant, as a wave of frequency 0."""
    zero = np.zeros((3, 1))
    parts = ((waves.frequency_hz, zero), (waves.amplitude, np.array(value)[:, None]), (waves.phase_rad, zero))
    return Waves(*(np.concatenate(pair, axis=1) for pair in parts))


def _with_rms(waves: Waves, rms_per_axis: Array, duration_s: float) -> Waves:
    """Scale each axis to its RMS over [0, duration_s]."""
    sampled = waves.at(np.linspace(0.0, max(duration_s, 0.05), 2000))
    now = np.sqrt(np.mean(sampled**2, axis=0))
    return Waves(waves.frequency_hz, waves.amplitude * (rms_per_axis / now)[:, None], waves.phase_rad)
