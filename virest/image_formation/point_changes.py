"""Displacement of predicted points between a profile and others, for the slopes of a fit.

Where only the angular rates differ, by δω in camera axes, the orientation differs by the small rotation (world axes)

    θ(t) = ∫ R δω dt,

and the force along the path, f in camera axes, by θ × R f + R δf, with δf where the IMU's axes differ; the camera's
centre c differs by its double integral.  With x = R(t₁) r₁ + (c(t₁) − c(t₂)) ρ, seen at p₂ = project(R(t₂)ᵀ x), a
point moves by

    δp₂ = ∂p₂/∂x (θ₁ × R(t₁) r₁ + δ((c(t₁) − c(t₂)) ρ) − θ₂ × x).

All profiles are integrated at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.effects.touches import touched
from virest.image_formation.point_model import (
    SMALLEST_DEPTH,
    IntegratedMotion,
    Prediction,
    TrackTable,
    lens_slope,
    predict,
    with_profile,
    world_rays,
)
from virest.motion.integration import camera_rate
from virest.motion.scene_motion import InertialMotion, Motion
from virest.motion.trajectory import Turning

Moved = Callable[[CameraProfile], Array]
"""Displacement (n, 2) of points for another profile."""


@dataclass(frozen=True)
class PointChanges:
    """Points as predicted for one profile, and their displacements for others, px."""

    imu: ImuSamples
    known: IntegratedMotion
    table: TrackTable
    scene: Motion | None
    at: Prediction
    """Of these."""

    def by(self, profile: CameraProfile) -> Array:
        """Displacement (n, 2) for another profile."""
        moved = with_profile(self.known, self.imu, profile)
        return predict(moved, self.table, self.scene, like=self.at).second_px - self.at.second_px

    def by_each(self, profiles: Sequence[CameraProfile]) -> Array:
        """Displacements (n, 2, k) for slightly different profiles, to first order where only the IMU's differ."""
        moved = np.empty((len(self.table), 2, len(profiles)))
        quick = [k for k, one in enumerate(profiles) if self._differs_by_motion(one)]
        if quick:
            moved[:, :, quick] = self._by_motion([profiles[k] for k in quick])
        for k in {*range(len(profiles))} - {*quick}:
            moved[:, :, k] = self.by(profiles[k])
        return moved

    def _differs_by_motion(self, profile: CameraProfile) -> bool:
        """Whether only rates and axes differ, and no stabiliser follows them."""
        return self.known.lens.shift is None and touched(self.known.profile, profile).only_motion

    def _by_motion(self, profiles: Sequence[CameraProfile]) -> Array:
        way, gyro = self.known.trajectory, self.known.measured.gyro
        rates = [camera_rate(self.imu, profile, gyro) - way.rate_polynomials for profile in profiles]
        turning = way.turned_by(np.stack(rates, axis=-1))
        poses, count = self.at.poses, len(self.table)
        turned = turning.at(poses.both_s, poses.both_exposure_s)
        before, after = turned[:count], turned[count:]
        world, whole, per_whole = self._seen_whole
        moved = np.cross(before, world[..., None], axis=1)
        if isinstance(self.scene, InertialMotion):
            turns = [one.rotation_cam_imu - self.known.profile.rotation_cam_imu for one in profiles]
            moved += self._by_path(turning, np.stack(turns, axis=-1), moved, self.scene)
        moved -= np.cross(after, whole[..., None], axis=1)
        return np.asarray(per_whole @ moved)

    @cached_property
    def _seen_whole(self) -> tuple[Array, Array, Array]:
        """R₁ r₁ and x (n, 3), world axes, and the change (n, 2, 3) of the second points per unit of x."""
        poses, lens = self.at.poses, self.known.lens
        world = world_rays(self.known, self.table, poses, self.at.sights)
        step = self.at.moved
        whole = world if step is None else world + step.step * step.inverse_depth[:, None]
        rays = poses.after.to_camera(whole)
        return world, whole, poses.after.per_world(lens_slope(lens, rays, poses, self.at.second_px))

    def _by_path(self, turning: Turning, turns: Array, moved_rays: Array, scene: InertialMotion) -> Array:
        """Change (n, 3, k) of (c(t₁) − c(t₂)) ρ; that of R_cam_imu (3, 3, k) and of R₁ r₁ (n, 3, k)."""
        step, displacement, force = self.at.moved, self.known.displacement, self.known.measured.force
        assert displacement is not None
        assert force is not None
        assert step is not None
        assert step.paths is not None
        felt = force[0] - scene.accel_bias_m_s2 + force[1] * scene.accel_delay_s
        window, count = self.table.window, len(self.table)
        origin_s = np.asarray(self.known.profile.imu_time_s(self.table.origin_s))
        centre = displacement.turned_by(
            turning, felt @ self.known.profile.rotation_cam_imu.T, np.tensordot(felt, turns, (1, 1)),
            self.at.poses.both_s, origin_s, np.concatenate([window, window]),
        )  # fmt: skip
        first, second = centre[:count], centre[count:]
        plane = scene.plane_per_m[window]
        where = step.paths[0].centre(scene, scene.velocity_m_s[window])
        clearance = np.maximum(1 - (plane * where).sum(axis=-1), SMALLEST_DEPTH)[:, None]
        nearer = np.einsum("ni,nik->nk", plane, moved_rays + step.inverse_depth[:, None, None] * first) / clearance
        nearer[step.inverse_depth == 0] = 0.0  # beyond the plane's horizon
        return (first - second) * step.inverse_depth[:, None, None] + step.step[:, :, None] * nearer[:, None, :]
