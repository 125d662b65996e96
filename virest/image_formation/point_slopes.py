"""How far small changes of a profile move predicted points, without predicting them again.

A camera that only turns sees a point at p₂ = project(R(t₂)ᵀ R(t₁) r₁).  A change of the true rates by δω turns it by
δ(t) = ∫ R δω dt in world axes, an instant that is later by δt by R ω δt, and axes that are turned on the IMU by φ see

    δr₂ = R₂ᵀ ((δ₁ − δ₂) × R₁ r₁),      δr₂ = φ × r₂ − R₂ᵀ R₁ (φ × r₁).

All of it is linear in what is worked out once for a table: the lens's slope and the turns between two sights.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.effects.touches import touched
from virest.image_formation.point_model import IntegratedMotion, Prediction, TrackTable, lens_slope, seen_s, turned
from virest.motion.integration import true_rate
from virest.motion.trajectory import vector_from_rotation

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TurningSlopes:
    """Slopes of points that a camera sees which only turns, at one prediction of them."""

    imu: ImuSamples
    known: IntegratedMotion
    table: TrackTable
    at: Prediction
    """By rotation alone, of this ground and table."""

    def moved_by(self, profile: CameraProfile) -> Array | None:
        """By how much (n, 2) another profile moves the points, to first order; None where they must be predicted."""
        own, lens = self.known.profile, self.known.lens
        if lens.shift is not None or lens.focal_drift_per_s or lens.zoom:
            return None
        rest = _with_rates_of(own, profile)
        change = touched(own, rest)
        if change.rates or change.lens or own.shutter.exposure_scale != profile.shutter.exposure_scale:
            return None
        parts = [self._by_rates(profile)] if rest != profile else []
        parts += [self._about(profile)] if change.axes else []
        same = own.shutter == rest.shutter and own.time_offset_s == rest.time_offset_s
        same = same and own.clock_skew == rest.clock_skew and own.extensions == rest.extensions
        parts += [] if same else [self._by_times(rest)]
        return np.asarray(sum(parts)) if parts else None

    def _by_times(self, profile: CameraProfile) -> Array:
        table, poses = self.table, self.at.poses
        first_s = seen_s(profile, table.first_px, table.first_stamp_s, table.first_exposure_s)
        second_s = seen_s(profile, table.second_px, table.second_stamp_s, table.second_exposure_s)
        first, second = self._world_rates
        return self._turned_by(
            first * (first_s - poses.first_s)[:, None] - second * (second_s - poses.second_s)[:, None]
        )

    def _by_rates(self, profile: CameraProfile) -> Array:
        """Changes of the rates at the samples, in world axes, by Hermite's cubics of their integral."""
        trajectory = self.known.trajectory
        change = true_rate(self.imu, profile, self.known.measured.gyro) - trajectory.rate_polynomials
        step_s = np.diff(trajectory.time_s)
        last = np.polyval(change[:, :, -1], step_s[-1])
        rate = turned(trajectory.rotation_world_cam, np.concatenate([change[3].T, last[None]]))
        halves = 0.5 * step_s[:, None] * (rate[:-1] + rate[1:])
        turn = np.concatenate([np.zeros((1, 3)), np.cumsum(halves, axis=0)])

        def at(time_s: Array) -> Array:
            interval, since_s = trajectory.locate(time_s)
            part = (since_s / step_s[interval])[:, None]
            begun, ended = rate[interval], rate[interval + 1]
            rise = turn[interval + 1] - turn[interval]
            bend = step_s[interval, None] * (part * (1 - part)) * (begun * (1 - part) - ended * part)
            return np.asarray(turn[interval] + rise * (part * part * (3 - 2 * part)) + bend)

        return self._turned_by(at(self.at.first_s) - at(self.at.second_s))

    def _about(self, profile: CameraProfile) -> Array:
        turn = vector_from_rotation(profile.rotation_cam_imu @ self.known.profile.rotation_cam_imu.T)
        before, back = self.at.poses.before, self.at.poses.back
        first = self._first_rays
        moved = np.cross(turn, turned(back, self._world_rays)) - turned(back, turned(before, np.cross(turn, first)))
        return np.squeeze(self._per_ray @ moved[..., None], -1)

    def _turned_by(self, turn: Array) -> Array:
        """Shift (n, 2) of points whose first sight turns by this more than their second, world axes (n, 3)."""
        return np.squeeze(self._per_turn @ turn[..., None], -1)

    @cached_property
    def _first_rays(self) -> Array:
        lens, first_s, sights = self.known.lens, self.at.first_s, self.at.sights
        return lens.rays_at_rest(self.table.first_px, first_s) if sights is None else sights.rays

    @cached_property
    def _world_rays(self) -> Array:
        return turned(self.at.poses.before, self._first_rays)

    @cached_property
    def _per_ray(self) -> Array:
        """(n, 2, 3) change of the second points per unit of their rays in camera axes."""
        rays = turned(self.at.poses.back, self._world_rays)
        return lens_slope(self.known, rays, self.at.second_s, self.known.lens.project(rays, self.at.second_s))

    @cached_property
    def _per_turn(self) -> Array:
        """(n, 2, 3) change of the second points per radian about the world's axes."""
        per_world = self._per_ray @ self.at.poses.back
        return np.stack([np.cross(self._world_rays, row) for row in np.moveaxis(per_world, 1, 0)], axis=1)

    @cached_property
    def _world_rates(self) -> tuple[Array, Array]:
        """(n, 3) each: the camera's rates at either sight, world axes."""
        trajectory, poses = self.known.trajectory, self.at.poses
        first, second = (trajectory.rate_rad_s(time_s) for time_s in (poses.first_s, poses.second_s))
        return turned(poses.before, first), turned(np.swapaxes(poses.back, -1, -2), second)


def _with_rates_of(own: CameraProfile, other: CameraProfile) -> CameraProfile:
    """Another profile, but for what turns gyroscope samples into rates."""
    here, there = own.extensions, other.extensions
    fields = there.field
    if any(field.kind == "rate" for field in (*here.field, *there.field)):
        kept = (field for field in there.field if field.kind != "rate")
        fields = (*kept, *(field for field in here.field if field.kind == "rate"))
    return replace(
        other,
        gyro_bias_rad_s=own.gyro_bias_rad_s,
        gyro_scale=own.gyro_scale,
        extensions=replace(there, gyro_lowpass_hz=here.gyro_lowpass_hz, field=fields),
    )
