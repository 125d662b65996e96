"""Tracked points as evidence: fitted on some time blocks, judged on the others."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from virest.arrays import Array, Index, Mask
from virest.calibration.physical_limits import impossible
from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.image_formation.point_model import TrackTable, centre, integrate_motion, seen_s
from virest.image_formation.row_clock import RowClock
from virest.inference.comparable_noise import noise_distances
from virest.inference.doubtful_log import STRAIGHT, STRAIGHT_PART, doubtful_stretches
from virest.inference.fit_start import FitStart
from virest.inference.hold_out import distances, group_means, loss
from virest.inference.observed_tracks import ObservedTracks
from virest.inference.robust import CAUCHY, RAYLEIGH_MEDIAN
from virest.inference.time_blocks import varied_blocks
from virest.inference.track_fit import Term, TrackFit, fit_tracks, many_directions, start_scene
from virest.inference.visual_inertial import START_INVERSE_DEPTH_PER_M
from virest.motion.scene_motion import InertialMotion, Motion

CAP = 4.0
"""Residual cap, in median scales, so that single lost tracks do not dominate."""
BLOCK_LENGTHS = (7, 11, 8, 13, 9)
"""Pairs per time block, repeated in this order."""
FULL_LENGTH_PAIRS = 60
"""With fewer pairs, blocks are shortened so that about 6 remain."""
TILT_STD, KNOWN_DEPTH_STD = 0.8, 0.03
"""Prior σ of a plane at a known depth: its slope, and the relative variation of its depth over time."""
MAX_DEPTH_PULL, HELD_DEPTH_STD = 4.0, 1e-3
"""If the fit moves a plane by more than MAX_DEPTH_PULL × KNOWN_DEPTH_STD, hold it at the profile's depth (relative σ
HELD_DEPTH_STD), so that this depth is judged."""
ITERATIONS = 10
"""Steps of a fit: half or twice as many change two simulated causes by less than 1e-8 of their values."""
STARTS_KEPT = 4
"""A search fits many causes to the two halves of the points from one or two models in turn."""
MIN_SWAY_DEPTH_PER_M = 1e-4
"""Smallest inverse depth: that of the farthest scene (physical_limits.DEPTH_M)."""


@dataclass(frozen=True, slots=True)
class Model:
    """A profile with its scene and start-up lag, and the terms fitted so far."""

    profile: CameraProfile
    scene: Motion | None
    terms: tuple[Term, ...]
    lag: tuple[float, ...] = ()
    """(frames,) s by which a frame slot shows a later capture; empty: none."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """All tracked pairs of a capture."""

    imu: ImuSamples
    observed: ObservedTracks
    block: Index
    """(pairs,) number of the time block."""
    break_s: Array
    """Times (breaks,) at which the path from the accelerometer is unknown, camera clock."""
    _starts: dict[tuple[Hashable, ...], FitStart] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __reduce__(self) -> tuple[type[Evidence], tuple[Any, ...]]:
        """Without the starts: in another process the models have other identities."""
        return Evidence, (self.imu, self.observed, self.block, self.break_s)

    def start(self, model: Model, part: Hashable, table: Callable[[], TrackTable]) -> FitStart:
        """Where fits of a part of the points begin from a model; the last STARTS_KEPT are kept.

        part: names the points, which ``table`` returns with the model's frame stamps.
        """
        key = id(model.profile), id(model.scene), model.lag, part
        if key not in self._starts:
            while len(self._starts) >= STARTS_KEPT:
                self._starts.pop(next(iter(self._starts)))
            self._starts[key] = FitStart(self.imu, table(), model.profile, model.scene)
        return self._starts[key]

    def noise_px(self, fitted: TrackFit) -> float:
        """Tracking noise, px: capped residual rms per coordinate about a free smooth flow, without the camera model."""
        return capped_rms(noise_distances(self.observed, fitted)) * self.typical_px

    @property
    def typical_px(self) -> float:
        """Typical noise of a step, px per coordinate."""
        return float(np.median(self.observed.noise_px))

    @property
    def period_s(self) -> float:
        """Time between frames."""
        stamps = self.observed.stamp_s[np.isfinite(self.observed.stamp_s)]
        return float(np.median(np.diff(stamps))) if len(stamps) > 1 else np.inf

    @property
    def exposure_s(self) -> float:
        """Typical exposure as logged; 0 where unknown."""
        return float(np.median(self.observed.exposure_s))

    def impossible(self, profile: CameraProfile) -> frozenset[str]:
        """Names of the effects with physically impossible values in a profile."""
        return impossible(profile, self.period_s, self.exposure_s)

    def table(self, model: Model, max_points: int) -> TrackTable:
        """The points, with the model's frame stamps."""
        observed = self.observed
        if model.lag:
            observed = replace(observed, stamp_s=observed.stamp_s + np.array(model.lag))
        table = observed.table(max_points)
        return _split(table, self.break_s) if len(self.break_s) else table

    def fit(self, model: Model, terms: Sequence[Term], table: TrackTable, use: Mask | None = None) -> TrackFit:
        """Fit terms and the scene from a model, on the pairs in ``use`` (pairs,)."""
        return fit_model(self.imu, model, terms, table if use is None else table.chosen(use[table.pair]))

    def distances(self, fitted: TrackFit, table: TrackTable, depth_spread_per_m: float) -> Array:
        """Whitened distances (n,) of all points of a table under a fit, which may have used only some of them."""
        return distances(self.imu, fitted, table, depth_spread_per_m)


def fit_model(
    imu: ImuSamples,
    model: Model,
    terms: Sequence[Term],
    table: TrackTable,
    iterations: int = ITERATIONS,
    covariances: bool = True,
) -> TrackFit:
    """Fit terms and the scene from a model."""
    return fit_tracks(imu, table, model.profile, terms, model.scene, max_iterations=iterations, covariances=covariances)


def make_evidence(imu: ImuSamples, observed: ObservedTracks, clocks: CameraProfile | None = None) -> Evidence:
    """Collect the pairs and number their time blocks; clocks: a profile with the clocks' offset, None: they agree."""
    part = min(len(observed.pairs) / FULL_LENGTH_PAIRS, 1.0)
    lengths = [max(round(part * length), 1) for length in BLOCK_LENGTHS]
    break_s = path_breaks(imu)
    break_s = break_s if clocks is None else np.asarray(RowClock(clocks).camera_time_s(break_s))
    return Evidence(imu, observed, varied_blocks(np.arange(len(observed.pairs)), lengths), break_s)


def path_breaks(imu: ImuSamples) -> Array:
    """Middles (breaks,), IMU clock, of the intervals in which gyroscope and accelerometer follow straight lines."""
    bend = np.abs(np.diff(np.diff(imu.accel_m_s2, axis=0) / np.diff(imu.time_s)[:, None], axis=0))
    time_s, typical = imu.time_s[1:-1], np.median(bend, axis=0)
    straight = [s for s in doubtful_stretches(imu) if s.kind == STRAIGHT]
    inside = [(time_s > s.from_s) & (time_s < s.to_s) for s in straight]
    middles = [
        0.5 * (s.from_s + s.to_s)
        for s, rows in zip(straight, inside, strict=True)
        if np.all(np.median(bend[rows], axis=0) <= STRAIGHT_PART * typical)
    ]
    return np.array(middles)


def _split(table: TrackTable, break_s: Array) -> TrackTable:
    """The table with windows that also end at breaks: each has its own velocity."""
    middle_s = 0.5 * (table.first_stamp_s + table.second_stamp_s)
    parts = np.stack([table.window, np.searchsorted(break_s, middle_s)])
    window = np.unique(parts, axis=1, return_inverse=True)[1]
    return replace(table, window=window, origin_s=group_means(middle_s, window))


def relief_loss(fitted: TrackFit) -> float:
    """Mean loss of a fit as a likelihood, including the cost of its spread of depths."""
    return float((loss(fitted.distance, 1.0) + 2 / CAUCHY**2 * fitted.relief_cost()).mean())


def capped_rms(distance: Array) -> float:
    """Rms per coordinate of whitened distances, each capped at CAP times their median scale."""
    scale = max(float(np.median(distance)) / RAYLEIGH_MEDIAN, 1e-9)
    return float(np.sqrt(np.mean(np.minimum(distance, CAP * scale) ** 2) / 2))


def base_scene(evidence: Evidence, profile: CameraProfile, table: TrackTable) -> Motion | None:
    """The scene motion that the profile allows: None for pure rotation (depth inf), or translation before a plane."""
    depth_m = profile.depth_m
    if depth_m is not None and np.isinf(depth_m):
        return None
    known = integrate_motion(evidence.imu, profile, translation=True)
    if known.displacement is None:
        return many_directions(table)
    scene = start_scene(evidence.imu, known, table, START_INVERSE_DEPTH_PER_M if depth_m is None else 1 / depth_m)
    if depth_m is None:
        return scene
    axes = known.trajectory.orientation(np.asarray(profile.imu_time_s(table.origin_s)))
    tilt = TILT_STD / depth_m
    placed = replace(scene, plane_std_per_m=(tilt, tilt, KNOWN_DEPTH_STD / depth_m), plane_axes=axes)
    pulled_m, _ = depth_of(evidence.fit(Model(profile, placed, ()), (), table), table)
    if abs(depth_m / pulled_m - 1) < MAX_DEPTH_PULL * KNOWN_DEPTH_STD:
        return placed
    return replace(placed, plane_std_per_m=(tilt, tilt, HELD_DEPTH_STD / depth_m))


def free_scene(evidence: Evidence, profile: CameraProfile, table: TrackTable) -> InertialMotion | None:
    """A plane at an unknown depth; None without an accelerometer."""
    known = integrate_motion(evidence.imu, profile, translation=True)
    if known.displacement is None:
        return None
    return start_scene(evidence.imu, known, table, START_INVERSE_DEPTH_PER_M)


def depth_of(fitted: TrackFit, table: TrackTable) -> tuple[float, float]:
    """Median over the frames of the distance along the optical axis at the frame centre, and its standard deviation."""
    scene = fitted.scene
    assert isinstance(scene, InertialMotion)
    assert fitted.integrated.displacement is not None
    frames, rows = np.unique(table.first, return_index=True)
    profile, window = fitted.profile, table.window[rows]
    middle = np.tile([0.5 * (profile.width - 1), 0.5 * (profile.height - 1)], (len(frames), 1))
    time_s = seen_s(profile, middle, table.first_stamp_s[rows], table.first_exposure_s[rows])
    origin_s = np.asarray(profile.imu_time_s(table.origin_s))[window]
    where = centre(fitted.integrated.displacement, scene, scene.velocity_m_s[window], time_s, origin_s)[0]
    world = np.squeeze(
        fitted.integrated.trajectory.orientation(time_s) @ fitted.integrated.lens.rays(middle, time_s)[..., None], -1
    )
    plane = scene.plane_per_m[window]
    inverse = (plane * world).sum(axis=-1) / np.maximum(1 - (plane * where).sum(axis=-1), 0.05)
    typical = int(np.argsort(inverse)[len(inverse) // 2])
    return 1 / max(float(inverse[typical]), MIN_SWAY_DEPTH_PER_M), _depth_std(fitted, world[typical], window[typical])


def _depth_std(fitted: TrackFit, world: Array, window: int) -> float:
    first = len(fitted.change) + 7 + 6 * int(window) + 3
    part = fitted.covariance[first : first + 3, first : first + 3]
    assert isinstance(fitted.scene, InertialMotion)
    inverse = float(fitted.scene.plane_per_m[int(window)] @ world)
    axes = fitted.scene.plane_axes
    way = world if axes is None else axes[int(window)].T @ world
    variance = float(way @ part @ way)
    return float(np.sqrt(max(variance, 0.0))) / max(inverse, MIN_SWAY_DEPTH_PER_M) ** 2
