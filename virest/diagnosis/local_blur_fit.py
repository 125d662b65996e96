"""Fit exposure time and defocus to the local blur, with clustered covariances, and judge them on other time blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from virest.arrays import Array, Mask
from virest.calibration.physical_limits import SCALE_OF_EXPOSURE
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
    time_blocks,
)
from virest.diagnosis.local_blur_edges import share_a_reach
from virest.diagnosis.local_blur_model import predicted_ratios
from virest.inference.clustered import scatter
from virest.inference.descent import Residuals, Slopes, System, descend, slices, slopes_by_steps
from virest.inference.robust import robust_std
from virest.inference.time_blocks import halves
from virest.motion.trajectory import Trajectory

SHIFT_STD_S = 0.004
"""Standard deviation of the row times after the geometric fit; their shift is a nuisance parameter of every fit."""
PATH_STD = 0.03
"""Relative error of the predicted path length, from focal length and gyroscope scale."""
EDGE_STD = 0.04
"""Relative error common to all edge widths of a capture, from soft edges in the scene and detail lost to the encoder;
``python -m virest.app.bench --only edges`` prints it for a defocus of 2 to 3.5 px."""
OWN_REACH_STD = 0.06
"""The same where too few edges are isolated over one reach and each is measured over its own: mean −0.048, standard
deviation 0.036 over 12 simulated captures."""
USUAL_SCATTER = 0.15
"""Largest relative scatter of the widths in captures of one blur each (28 simulated ones of four scenes: 3 to 15 %).
What exceeds it is done to each edge by itself, by a coder that lacks bits or by a scene of soft edges; how much of it
all edges share is not known, so that it may be all of it."""
_NUISANCE = np.array([LENS_SIGMA_PX, 0.0])
_NUISANCE_STD = np.array([LENS_STD_PX, SHIFT_STD_S])
_NUISANCE_LOW = np.array([0.35, -0.03])
_NUISANCE_HIGH = np.array([0.95, 0.03])
"""Width of a sharp edge (px) and shift of the rows' times (s): mean, standard deviation, and bounds of the fit."""
_LOW, _HIGH, _STEP = 0.02, 50.0, 0.02
"""Bounds of every effect's value, and its finite-difference step."""
_NUISANCE_STEP, _DAMPING_STEP = np.array([0.02, 5e-4]), 0.02
"""Finite-difference steps of the nuisances and of the damping."""
_LEAST_STD_PX = 1e-3
"""Keeps the scale of residuals without noise above 0."""


@dataclass(frozen=True, slots=True)
class ExposureTime:
    """True exposure = logged × exposure_scale: paths are longer or shorter than predicted."""

    name: str = "exposure_time"
    parameters: tuple[str, ...] = ("exposure_scale",)

    def starts(self, observations: BlurObservations, profile: CameraProfile) -> list[Array]:
        """The profile's value."""
        return [np.array([profile.shutter.exposure_scale])]

    def apply(self, profile: CameraProfile, values: Array) -> CameraProfile:
        """Set shutter.exposure_scale."""
        return profile.with_shutter(exposure_scale=float(np.clip(values[0], *SCALE_OF_EXPOSURE)))

    def determined(self, observations: BlurObservations, profile: CameraProfile, trajectory: Trajectory) -> bool:
        """Whether there are enough tiles in frames with unequal motion."""
        valid = observations.valid
        if valid.sum() < MIN_RATIOS:
            return False
        own = predicted_ratios(observations.ratios, profile, trajectory)[..., 0][valid]
        return float(np.sqrt(np.mean(own**2))) > MIN_CONTRAST

    def possible(self, values: Array) -> bool:
        """Whether the scale is within its bounds; at a bound, something else is wrong."""
        low, high = SCALE_OF_EXPOSURE
        return low < float(values[0]) < high

    def shows_in(self, observations: BlurObservations) -> Mask:
        """The spectra: edges are chosen where motion is short."""
        return ~observations.is_edge


@dataclass(frozen=True, slots=True)
class Defocus:
    """A Gaussian blur of the light in addition to the lens's; no edge is sharper than it."""

    name: str = "defocus"
    parameters: tuple[str, ...] = ("sigma_px",)

    def starts(self, observations: BlurObservations, profile: CameraProfile) -> list[Array]:
        """Excess of the edges' 0.4 quantile of width over the lens's width."""
        width = float(np.quantile(observations.edges.width_px, 0.4)) if len(observations.edges) else LENS_SIGMA_PX
        return [np.array([np.sqrt(max(width**2 - LENS_SIGMA_PX**2, 0.04))])]

    def apply(self, profile: CameraProfile, values: Array) -> CameraProfile:
        """Set extensions.defocus_sigma_px."""
        return profile.with_extensions(defocus_sigma_px=float(np.clip(values[0], 0.0, 50.0)))

    def determined(self, observations: BlurObservations, profile: CameraProfile, trajectory: Trajectory) -> bool:
        """Whether there are enough isolated steps."""
        return observations.edges_determined

    def possible(self, values: Array) -> bool:
        """Always: zero defocus is a valid estimate."""
        return True

    def shows_in(self, observations: BlurObservations) -> Mask:
        """The edges: ratios of spectra between frames lack a blur that all frames share."""
        return observations.is_edge


BlurEffect = ExposureTime | Defocus
"""One cause that local blur can show."""


@dataclass(frozen=True, slots=True)
class BlurFit:
    """Values of some effects, fitted together with the nuisances of the measurement."""

    effects: tuple[str, ...]
    values: tuple[Array, ...]
    """One array per effect."""
    covariance: Array
    """Covariance of all values, in order of effects; infinite where the capture does not determine the effect."""
    nuisance: Array
    """Width of a sharp edge (px), shift of the rows' times (s)."""
    profile: CameraProfile
    """With the effects applied, without the nuisances."""
    rms_px: float
    """Robust rms of the residuals that were fitted."""
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
    """Robust fit of the effects' values, together with the nuisances, which have priors.

    use: mask of the residuals.  Effects that the capture does not determine, or whose values reach a bound, are not
    fitted: their values are NaN with infinite variance, and the profile keeps its own.  The covariance is a sandwich
    over time blocks, within which errors are correlated.
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
    """As :func:`fit`; ``known``: which of the effects are determined and thus fitted."""
    free = [e for e, yes in zip(effects, known, strict=True) if yes]
    evidence = _Widths(observations, profile, trajectory, free, use)
    found = descend(evidence, np.concatenate([*(e.starts(observations, profile)[0] for e in free), _NUISANCE]))
    return _as_fit(evidence, effects, known, found)


def judge(observations: BlurObservations, found: BlurFit, trajectory: Trajectory, use: Mask) -> float:
    """Robust rms, px, of the residuals at a mask under a fit."""
    lens, shift = found.nuisance
    moved = _shifted(found.profile, float(shift))
    return robust_std(residuals(observations, moved, trajectory, float(lens))[use])


def held_out(
    observations: BlurObservations, profile: CameraProfile, trajectory: Trajectory, effects: Sequence[BlurEffect]
) -> list[HeldOutGain]:
    """Robust rms, px, without and with the effects, fitted to every other time block and judged on the rest.

    Each effect is judged on the residuals that determine it: the other kind outnumbers them, and hides its gain.
    """
    folds = []
    for fitted in halves(time_blocks(observations.time_s)):
        fits = [fit(observations, profile, trajectory, chosen, fitted) for chosen in ((), effects)]
        masks = [~fitted & effect.shows_in(observations) for effect in effects]
        folds.append([tuple(judge(observations, one, trajectory, mask) for one in fits) for mask in masks])
    gains = (HeldOutGain.of_folds(BLUR, [(*pair, 0.0) for pair in own]) for own in zip(*folds, strict=True))
    return [replace(gain, noise=None) for gain in gains]


@dataclass(frozen=True, slots=True)
class _Widths:
    """Edge widths and spectra as evidence; parameters: the effects' values, then the nuisances."""

    observations: BlurObservations
    profile: CameraProfile
    trajectory: Trajectory
    effects: Sequence[BlurEffect]
    use: Mask
    known: dict[tuple[float, float], PredictedBlur] = field(default_factory=dict)
    """Predicted blur by exposure scale and shift, the only parameters of a fit that change the paths."""

    @property
    def count(self) -> int:
        """Number of the effects' values."""
        return sum(len(e.parameters) for e in self.effects)

    def applied(self, values: Array) -> CameraProfile:
        """The profile with the effects' values."""
        profile = self.profile
        for effect, own in zip(self.effects, slices(len(e.parameters) for e in self.effects), strict=True):
            profile = effect.apply(profile, values[own])
        return profile

    def left(self, values: Array, damping: float = 1.0) -> Array:
        """The used residuals, px."""
        lens, shift = values[self.count :]
        profile = _shifted(self.applied(values), float(shift))
        key = profile.shutter.exposure_scale, float(shift)
        if key not in self.known:
            self.known[key] = predicted_blur(self.observations, profile, self.trajectory)
        return residuals(self.observations, profile, self.trajectory, float(lens), damping, self.known[key])[self.use]

    def look(self, values: Array, before: Residuals | None = None, limit: Slopes = Slopes.HERE) -> Residuals:
        """Residuals, and slopes by finite differences."""
        left, steps = self.left(values), self._with_nuisances(_STEP, _NUISANCE_STEP)
        if before is not None and not (kept := replace(before, left=left)).is_stale(limit):
            return kept
        high = self._with_nuisances(_HIGH, _NUISANCE_HIGH)
        return Residuals(left, slopes_by_steps(lambda at: -self.left(at), -left, values, steps, high), left)

    def weighed(self, values: Array, look: Residuals) -> System[Array, Residuals]:
        """Edges and spectra each have their own scale, estimated from their residuals."""
        scale, edge = np.empty(len(look.left)), self.observations.is_edge[self.use]
        for kind in (edge, ~edge):
            scale[kind] = max(robust_std(look.left[kind]), _LEAST_STD_PX)
        prior = self._with_nuisances(0.0, _NUISANCE_STD**-2)
        off = values - self._with_nuisances(0.0, _NUISANCE)
        low, high = self._with_nuisances(_LOW, _NUISANCE_LOW), self._with_nuisances(_HIGH, _NUISANCE_HIGH)
        rows, left = look.slope[:, None], look.left[:, None]
        return System(values, look, rows, left, look.left**2, scale, prior, off, room=(low - values, high - values))

    def moved(self, values: Array, step: Array) -> Array:
        """After a step."""
        return values + step

    def _with_nuisances(self, of_effects: float, of_nuisances: Array) -> Array:
        return np.append(np.full(self.count, of_effects), of_nuisances)

    def covariance(self, found: System[Array, Residuals]) -> Array:
        """H⁻¹ (Σ g g' over time blocks + prior) H⁻¹ of all values, plus the effect of unknown damping and width errors.

        The damping is not fitted: apart from the path length, only the curvature of the ratios determines it, and
        coding changes that too.  Nor is an error common to all widths, which acts like a defocus.
        """
        observations, edge = self.observations, self.observations.is_edge
        block, used_edge = time_blocks(observations.time_s)[self.use], edge[self.use]
        by_damping = (self.left(found.state, 1.0 + _DAMPING_STEP) - found.look.left) / _DAMPING_STEP
        by_width = np.zeros(len(edge))
        by_width[edge] = observations.edges.width_px
        edge_std = EDGE_STD if share_a_reach(observations.edges) else OWN_REACH_STD
        scattered = found.look.left[used_edge] / by_width[self.use][used_edge]
        excess = np.sqrt(max(robust_std(scattered) ** 2 - USUAL_SCATTER**2, 0.0)) if len(scattered) else 0.0
        unknown = np.hypot(observations.damping_std, 2 * PATH_STD), np.hypot(edge_std, excess)
        both = np.stack([by_damping, by_width[self.use]], axis=-1) * unknown
        pulled = found.inverse() @ found.pull(both[:, None])
        return found.sandwich(scatter(found.score, block)) + pulled @ pulled.T


def _as_fit(
    evidence: _Widths, effects: Sequence[BlurEffect], known: tuple[bool, ...], found: System[Array, Residuals]
) -> BlurFit:
    """Arrange the fitted effects' values among those of all requested effects."""
    sizes, count = [len(e.parameters) for e in effects], evidence.count
    place = np.flatnonzero(np.repeat(known, sizes))
    values, spread = np.full(sum(sizes), np.nan), np.diag(np.full(sum(sizes), np.inf))
    values[place] = found.state[:count]
    spread[np.ix_(place, place)] = evidence.covariance(found)[:count, :count]
    names, each = tuple(e.name for e in effects), tuple(values[own] for own in slices(sizes))
    profile, rms_px = evidence.applied(found.state), robust_std(found.look.left)
    return BlurFit(names, each, spread, found.state[count:], profile, rms_px, known)


def _shifted(profile: CameraProfile, shift_s: float) -> CameraProfile:
    return replace(profile, time_offset_s=(profile.time_offset_s or 0.0) + shift_s)
