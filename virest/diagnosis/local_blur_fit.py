"""Fit exposure time and defocus to the local blur, with deviations that hold, and judge them on other time blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile
from virest.diagnosis.findings import BLUR, HeldOutGain
from virest.diagnosis.local_blur import (
    LENS_SIGMA_PX,
    LENS_STD_PX,
    MIN_CONTRAST,
    MIN_RATIOS,
    BlurObservations,
    PredictedBlur,
    predicted_blur,
    residuals,
    robust_weights,
    time_blocks,
)
from virest.diagnosis.local_blur_model import predicted_ratios
from virest.inference.clustered import scatter
from virest.inference.robust import robust_std
from virest.inference.time_blocks import halves
from virest.motion.trajectory import Trajectory

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_EXPOSURE_SCALES = (0.05, 20.0)
SHIFT_STD_S = 0.004
"""How far the rows' times may be off after the geometry was fitted; a shift is a nuisance of every fit."""
PATH_STD = 0.03
"""Relative error of the predicted path's length that focal length and gyroscope scale leave."""
_NUISANCE = np.array([LENS_SIGMA_PX, 0.0])
_NUISANCE_STD = np.array([LENS_STD_PX, SHIFT_STD_S])
_NUISANCE_LOW = np.array([0.35, -0.03])
_NUISANCE_HIGH = np.array([0.95, 0.03])
_NUISANCE_STEP = np.array([0.02, 5e-4])
_DAMPING_STEP = 0.02
_STEPS = 5


class BlurEffect(Protocol):
    """One cause that local blur can show."""

    name: str
    parameters: tuple[str, ...]

    def starts(self, observations: BlurObservations, profile: CameraProfile) -> list[Array]:
        """Values from which to fit."""

    def apply(self, profile: CameraProfile, values: Array) -> CameraProfile:
        """The profile with the effect's parameters set."""

    def determined(self, observations: BlurObservations, profile: CameraProfile, trajectory: Trajectory) -> bool:
        """Whether the capture can tell the effect at all."""

    def possible(self, values: Array) -> bool:
        """Whether fitted values are an estimate, and not the end of what they may be."""


@dataclass(frozen=True, slots=True)
class ExposureTime:
    """True exposure = logged × exposure_scale: paths are longer or shorter than predicted."""

    name: str = "exposure_time"
    parameters: tuple[str, ...] = ("exposure_scale",)

    def starts(self, observations: BlurObservations, profile: CameraProfile) -> list[Array]:
        """What the profile has."""
        return [np.array([profile.shutter.exposure_scale])]

    def apply(self, profile: CameraProfile, values: Array) -> CameraProfile:
        """Set shutter.exposure_scale."""
        scale = float(np.clip(values[0], *_EXPOSURE_SCALES))
        return replace(profile, shutter=replace(profile.shutter, exposure_scale=scale))

    def determined(self, observations: BlurObservations, profile: CameraProfile, trajectory: Trajectory) -> bool:
        """Enough tiles, in frames that moved unequally."""
        valid = observations.valid
        if valid.sum() < MIN_RATIOS:
            return False
        own = predicted_ratios(observations.ratios, profile, trajectory)[..., 0][valid]
        return float(np.sqrt(np.mean(own**2))) > MIN_CONTRAST

    def possible(self, values: Array) -> bool:
        """Paths that would have no length, or any, explain nothing: something else is wrong."""
        low, high = _EXPOSURE_SCALES
        return low < float(values[0]) < high


@dataclass(frozen=True, slots=True)
class Defocus:
    """A Gaussian on the light beyond the lens: no edge is sharper than it."""

    name: str = "defocus"
    parameters: tuple[str, ...] = ("sigma_px",)

    def starts(self, observations: BlurObservations, profile: CameraProfile) -> list[Array]:
        """What the sharper half of the edges have beyond the lens."""
        width = float(np.quantile(observations.edges.width_px, 0.4)) if len(observations.edges) else LENS_SIGMA_PX
        return [np.array([np.sqrt(max(width**2 - LENS_SIGMA_PX**2, 0.04))])]

    def apply(self, profile: CameraProfile, values: Array) -> CameraProfile:
        """Set extensions.defocus_sigma_px."""
        sigma = float(np.clip(values[0], 0.0, 50.0))
        return replace(profile, extensions=replace(profile.extensions, defocus_sigma_px=sigma))

    def determined(self, observations: BlurObservations, profile: CameraProfile, trajectory: Trajectory) -> bool:
        """Enough isolated steps."""
        return observations.edges_determined

    def possible(self, values: Array) -> bool:
        """No defocus at all is an estimate too."""
        return True


@dataclass(frozen=True, slots=True)
class BlurFit:
    """Values of some effects, with the measurement's nuisances fitted beside them."""

    effects: tuple[str, ...]
    values: tuple[Array, ...]
    """One array an effect."""
    covariance: Array
    """Of all values, one effect after another; infinite where the capture does not determine the effect."""
    nuisance: Array
    """Width of a sharp edge (px), shift of the rows' times (s)."""
    profile: CameraProfile
    """With the effects applied; the nuisances are no part of it."""
    rms_px: float
    """Robust rms of the residuals used."""
    determined: tuple[bool, ...]

    @property
    def std(self) -> Array:
        """Standard deviations of all values."""
        return np.sqrt(np.diag(self.covariance))


def fit(
    observations: BlurObservations,
    profile: CameraProfile,
    trajectory: Trajectory,
    effects: Sequence[BlurEffect],
    use: Mask | None = None,
) -> BlurFit:
    """Robust Gauss-Newton by finite differences for the effects' values and the nuisances, which have priors.

    use: mask over the residuals.  Effects that the capture does not determine, or whose values run to the end of what
    they may be, keep their values, with infinite deviations.  The covariance is a sandwich over time blocks: what lies
    in one block shares its errors.
    """
    use = np.ones(len(observations), bool) if use is None else use
    known = tuple(e.determined(observations, profile, trajectory) for e in effects)
    found = _fit(observations, profile, trajectory, effects, use, known)
    inside = tuple(yes and e.possible(v) for e, yes, v in zip(effects, known, found.values, strict=True))
    return found if inside == known else _fit(observations, profile, trajectory, effects, use, inside)


def _fit(
    observations: BlurObservations,
    profile: CameraProfile,
    trajectory: Trajectory,
    effects: Sequence[BlurEffect],
    use: Mask,
    known: tuple[bool, ...],
) -> BlurFit:
    """As :func:`fit`, for those effects that are known to be determined."""
    free = [e for e, yes in zip(effects, known, strict=True) if yes]
    problem = _Problem(observations, profile, trajectory, free, use)
    theta = np.concatenate([*(e.starts(observations, profile)[0] for e in free), _NUISANCE])
    for _ in range(_STEPS):
        residual, jacobian, weight = problem.linearised(theta)
        move = problem.solve(residual, jacobian, weight, theta)
        theta = problem.held(theta + move)
        if np.all(np.abs(move) < 0.02 * problem.steps):
            break
    residual, jacobian, weight = problem.linearised(theta)
    covariance = problem.covariance(theta, residual, jacobian, weight)
    return _as_fit(problem, effects, known, theta, covariance, robust_std(residual))


def judge(observations: BlurObservations, found: BlurFit, trajectory: Trajectory, use: Mask) -> float:
    """Robust rms, px, of the residuals of a mask under a fit made on others."""
    lens, shift = found.nuisance
    moved = _shifted(found.profile, float(shift))
    return robust_std(residuals(observations, moved, trajectory, float(lens))[use])


def held_out(
    observations: BlurObservations, profile: CameraProfile, trajectory: Trajectory, effects: Sequence[BlurEffect]
) -> HeldOutGain:
    """Robust rms, px, without and with the effects, fitted on every other time block and judged on the rest."""
    even, odd = halves(time_blocks(observations.time_s))
    before, after = (fit(observations, profile, trajectory, chosen, even) for chosen in ((), effects))
    before_px, after_px = (judge(observations, one, trajectory, odd) for one in (before, after))
    return HeldOutGain(BLUR, before_px, after_px, None)


@dataclass(frozen=True, slots=True)
class _Problem:
    """The least squares of one fit: values of the effects, then the nuisances."""

    observations: BlurObservations
    profile: CameraProfile
    trajectory: Trajectory
    effects: Sequence[BlurEffect]
    use: Mask
    known: dict[tuple[float, float], PredictedBlur] = field(default_factory=dict)
    """What paths were seen to make, by exposure scale and shift: nothing else in a fit changes them."""

    @property
    def count(self) -> int:
        """Values of the effects."""
        return sum(len(e.parameters) for e in self.effects)

    @property
    def steps(self) -> Array:
        """Finite differences of all values."""
        return np.concatenate([np.full(self.count, 0.02), _NUISANCE_STEP])

    @property
    def precision(self) -> Array:
        """Diagonal of the priors' inverse covariance."""
        return np.concatenate([np.zeros(self.count), _NUISANCE_STD**-2])

    def applied(self, theta: Array) -> CameraProfile:
        """The profile with the effects' values."""
        profile, at = self.profile, 0
        for effect in self.effects:
            profile = effect.apply(profile, theta[at : at + len(effect.parameters)])
            at += len(effect.parameters)
        return profile

    def residual(self, theta: Array, damping: float = 1.0) -> Array:
        """The used residuals."""
        lens, shift = theta[self.count :]
        profile = _shifted(self.applied(theta), float(shift))
        key = profile.shutter.exposure_scale, float(shift)
        if key not in self.known:
            self.known[key] = predicted_blur(self.observations, profile, self.trajectory)
        return residuals(self.observations, profile, self.trajectory, float(lens), damping, self.known[key])[self.use]

    def linearised(self, theta: Array) -> tuple[Array, Array, Array]:
        """Residuals, their derivatives (n, p), and robust weights over variance, each kind by its own scale."""
        residual = self.residual(theta)
        columns = [
            (self.residual(theta + size * one) - residual) / size
            for size, one in zip(self.steps, np.eye(len(theta)), strict=True)
        ]
        weight = np.zeros(len(residual))
        edge = self.observations.is_edge[self.use]
        for kind in (edge, ~edge):
            weight[kind] = robust_weights(residual[kind]) / max(robust_std(residual[kind]), 1e-3) ** 2
        return residual, np.stack(columns, -1), weight

    def solve(self, residual: Array, jacobian: Array, weight: Array, theta: Array) -> Array:
        """The Gauss-Newton step."""
        prior = np.concatenate([np.zeros(self.count), theta[self.count :] - _NUISANCE])
        gradient = jacobian.T @ (weight * residual) + self.precision * prior
        return -np.linalg.pinv(self._hessian(jacobian, weight)) @ gradient

    def _hessian(self, jacobian: Array, weight: Array) -> Array:
        return (jacobian * weight[:, None]).T @ jacobian + np.diag(self.precision)

    def covariance(self, theta: Array, residual: Array, jacobian: Array, weight: Array) -> Array:
        """H⁻¹ (Σ g g' over time blocks + prior) H⁻¹ of all values, and what an unknown damping adds.

        The damping is not fitted: beside the length of the path it would be told by the ratios' curvature alone,
        which coding changes too.
        """
        block = time_blocks(self.observations.time_s)[self.use]
        meat = scatter(jacobian * (weight * residual)[:, None], block) + np.diag(self.precision)
        inverse = np.linalg.pinv(self._hessian(jacobian, weight))
        by_damping = (self.residual(theta, 1.0 + _DAMPING_STEP) - residual) / _DAMPING_STEP
        pulled = inverse @ (jacobian.T @ (weight * by_damping)) * np.hypot(self.observations.damping_std, 2 * PATH_STD)
        return inverse @ meat @ inverse + np.outer(pulled, pulled)

    def held(self, theta: Array) -> Array:
        """Values inside what is possible."""
        values = np.clip(theta[: self.count], 0.02, 50.0)
        return np.concatenate([values, np.clip(theta[self.count :], _NUISANCE_LOW, _NUISANCE_HIGH)])


def _as_fit(
    problem: _Problem,
    effects: Sequence[BlurEffect],
    known: tuple[bool, ...],
    theta: Array,
    covariance: Array,
    rms_px: float,
) -> BlurFit:
    """Spread the free effects' values among all that were asked for."""
    total = sum(len(e.parameters) for e in effects)
    spread = np.diag(np.full(total, np.inf))
    place = np.flatnonzero([yes for e, yes in zip(effects, known, strict=True) for _ in e.parameters])
    spread[np.ix_(place, place)] = covariance[: len(place), : len(place)]
    values, at = [], 0
    for effect, yes in zip(effects, known, strict=True):
        size = len(effect.parameters)
        values.append(theta[at : at + size] if yes else np.full(size, np.nan))
        at += size if yes else 0
    names = tuple(e.name for e in effects)
    return BlurFit(names, tuple(values), spread, theta[problem.count :], problem.applied(theta), rms_px, known)


def _shifted(profile: CameraProfile, shift_s: float) -> CameraProfile:
    return replace(profile, time_offset_s=(profile.time_offset_s or 0.0) + shift_s)
