"""Unknowns of the camera's translation and of the scene that a gyroscope cannot measure: fitted with every profile.

Two models.  `InertialMotion`: the accelerometer gives the path up to velocity, gravity, its own bias and delay, and the
scene is a plane in metres: a vector with priors for a Gauss-Newton fit.  `DirectedMotion`: without an accelerometer,
only the direction of travel is estimated, and only residuals across its parallax are used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from virest.arrays import Array, Index

VELOCITY_STD_M_S, PLANE_STD_PER_M = 1.0, 1.5
"""Standard deviations of the priors: walking pace; a scene at 0.7 m or farther.  Half or twice the velocity's changes
no estimate of a diagnosis of 45 frames, 0.8 m before a wall."""
GRAVITY_STD_M_S2, ACCEL_BIAS_STD_M_S2, ACCEL_DELAY_STD_S = 0.6, 0.15, 0.004
"""The same: gravity's direction to 3.5°; a bias of 15 mg; a delay of one sample at 250 Hz.  Half or twice each
changes no estimate of that diagnosis in its first four digits, and deviations by up to 11 %."""


@dataclass(frozen=True, slots=True)
class InertialMotion:
    """Path from the accelerometer; world axes of the trajectory, windows of a few seconds."""

    velocity_m_s: Array
    """(windows, 3) of the IMU at each window's middle."""
    gravity_m_s2: Array
    """(3,) pointing down, about 9.81 long."""
    accel_bias_m_s2: Array
    """(3,) IMU axes."""
    accel_delay_s: float
    """Delay of the accelerations: they are older than their timestamps by this."""
    plane_per_m: Array
    """(windows, 3) m of the scene's plane m · X = 1, origin at the camera's centre at the window's middle."""
    plane_std_per_m: tuple[float, float, float] = (PLANE_STD_PER_M,) * 3
    """Prior standard deviations of the plane about its starting value, in ``plane_axes``."""
    plane_axes: Array | None = None
    """(windows, 3, 3) R_world_plane: axes in which planes are varied; None: the world's."""

    @property
    def windows(self) -> int:
        """Number of windows."""
        return len(self.velocity_m_s)

    def vector(self) -> Array:
        """Gravity, bias, delay, then velocity and plane of each window: (7 + 6 windows,)."""
        plane = self.plane_per_m
        if self.plane_axes is not None:
            plane = np.einsum("wij,wi->wj", self.plane_axes, plane)
        own = np.concatenate([self.velocity_m_s, plane], axis=-1)
        return np.concatenate([self.gravity_m_s2, self.accel_bias_m_s2, [self.accel_delay_s], own.ravel()])

    def with_vector(self, vector: Array) -> InertialMotion:
        """The motion of such a vector."""
        own = vector[7:].reshape(-1, 6)
        plane = own[:, 3:]
        if self.plane_axes is not None:
            plane = np.einsum("wij,wj->wi", self.plane_axes, plane)
        return replace(
            self,
            velocity_m_s=own[:, :3],
            gravity_m_s2=vector[:3],
            accel_bias_m_s2=vector[3:6],
            accel_delay_s=float(vector[6]),
            plane_per_m=plane,
        )

    def prior_std(self) -> Array:
        """Prior standard deviation of each entry about its starting value."""
        own = [VELOCITY_STD_M_S] * 3 + list(self.plane_std_per_m)
        shared = [GRAVITY_STD_M_S2] * 3 + [ACCEL_BIAS_STD_M_S2] * 3 + [ACCEL_DELAY_STD_S]
        return np.array(shared + own * self.windows)

    def limits(self) -> Array:
        """Largest change of each entry in one step."""
        return np.array([0.5] * 3 + [0.3] * 3 + [0.004] + ([0.5] * 3 + [0.5] * 3) * self.windows)


@dataclass(frozen=True, slots=True)
class DirectedMotion:
    """Motion without an accelerometer: only the direction of travel, in the trajectory's world axes.

    Since depths are unknown, parallax may move a point by any amount along its direction; only residuals across count.
    """

    direction: Array
    """(groups, 3) unit vectors; one for the whole capture (a vehicle), or one for each pair."""

    def vector(self) -> Array:
        """Empty: directions are eliminated from the fit, not changed by its steps."""
        return np.zeros(0)

    def with_vector(self, vector: Array) -> DirectedMotion:
        """The same motion."""
        return self

    def prior_std(self) -> Array:
        """None."""
        return np.zeros(0)

    def limits(self) -> Array:
        """None."""
        return np.zeros(0)

    def group(self, pair: Index) -> Index:
        """(n,) index of each pair's direction."""
        return np.zeros_like(pair) if len(self.direction) == 1 else pair


Motion = InertialMotion | DirectedMotion
