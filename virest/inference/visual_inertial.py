"""The camera's metric translation from tracked points, gyroscope and accelerometer (eqs 4-6; after VINS-Mono).

A capture is divided into stretches, each with its own gravity, accelerometer bias and delay; a stretch into windows of
a few seconds, each with its own velocity and plane.  Within a window the velocity at any instant follows from the
accelerometer.  Scale comes from accelerations only: each window is checked for whether its motion determines it, and a
window that fails has a reason instead of a metric velocity.  Frames show velocity over depth, which needs no scale: it
is checked separately, and is used for restoration without a metric velocity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from virest.arrays import Array, Index, Mask
from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.capture.records import Frame
from virest.image_formation.point_model import (
    IntegratedMotion,
    TrackTable,
    integrate_motion,
    predict,
    with_profile,
    world_rays,
)
from virest.inference.camera_travel import Stretch, VisualInertialAlignment, Window
from virest.inference.coarse_alignment import MIN_PAIRS
from virest.inference.depth import LEAST_INVERSE_PER_M, SightedPoints, triangulate, triangulate_relief
from virest.inference.observed_tracks import WINDOW_S, ObservedTracks
from virest.inference.profile_terms import FOCAL, NEAR_AXES, SMALL_BIAS, STATED_OFFSET, TIME_OFFSET, UNKNOWN_READOUT
from virest.inference.relief import View, WindowRelief, find_relief, picture_grid
from virest.inference.robust import RAYLEIGH_MEDIAN
from virest.inference.track_fit import GRAVITY_M_S2, Term, TrackFit, fit_tracks, start_scene
from virest.motion.optics import settling_time_s
from virest.motion.scene_motion import InertialMotion

STRETCH_S = 14.0
"""Length of stretches with common gravity and accelerometer bias; in this time a gyroscope drifts by a few mrad."""
RUNS_PER_WINDOW, RUN_FRAMES = 4, 7
"""Frames to track: number of runs spread over each window, and consecutive frames in each."""
POINTS_PER_WINDOW = 800
"""Points that are fitted, thinned evenly; half or twice as many change a simulated depth by 0.5 σ, and twice lowers its
standard deviation by a fifth."""
MIN_POINTS = 200
"""Fewest points of a stretch."""
START_INVERSE_DEPTH_PER_M = 0.5
"""Start of every fit of translation: a scene 2 m away, as in rooms."""
MAX_RELATIVE_STD = 0.1
"""Largest relative standard deviation of scale and velocity (over its rms in a window) of a metric velocity."""
MAX_FLOW_STD = 0.2
"""Largest standard deviation of velocity over depth relative to its rms, without a metric velocity; rotation alone has
an error of 1.  Inertial data of another recording, fitted anyway, give 0.3 or more, those of the same up to 0.12."""
MAX_PRIOR_STD = 3.0
"""Reject fits that move a parameter of the profile by more than this many prior standard deviations."""
MIN_PARALLAX = 1.15
"""Smallest residual of rotation alone relative to the residual with translation."""
MAX_UNEXPLAINED = 0.15
"""Largest fraction of the parallax's power that the accelerometer's path may leave unexplained."""
MAX_SPREAD = 0.6
"""Largest spread of inverse depths about the plane relative to its inverse depth."""
GRAVITY_TOLERANCE_M_S2 = 0.7
"""Largest error of the fitted gravity's magnitude beside two of its standard deviations: an accelerometer is off by its
bias and scale."""
ROTATION_ITERATIONS = 8
"""The fit with rotation alone serves only for comparison and needs no full convergence."""
STATED_DEPTH_STD = 0.02
"""Relative standard deviation of a profile's depth."""
TRACKING_BIAS_PX = 0.04
"""Systematic tracking error from blur and codec: a constant error of each step, hence of the velocity."""
LEAST_NEARNESS = 0.5
"""The optical axis represents a window's points if the plane is at most twice as far on it as it is on their mean."""
IMU_MARGIN_S = 2.5
"""A stretch uses inertial samples up to this far beyond its tracked points."""


# ── which frames ─────────────────────────────────────────────────────────────────────────────────────────────────


def choose_runs(frames: Sequence[Frame]) -> list[int]:
    """Movie indices to decode and track: runs of consecutive usable frames, spread over windows of the capture."""
    usable = [frame for frame in frames if frame.skip_reason is None]
    if not usable:
        return []
    time_s = np.array([frame.time_s for frame in usable])
    parts = max(int(np.ceil((time_s[-1] - time_s[0]) / WINDOW_S)), 1) * RUNS_PER_WINDOW
    edges = np.linspace(time_s[0], time_s[-1], parts + 1)[1:-1]
    chosen: set[int] = set()
    for part in np.split(np.arange(len(usable)), np.searchsorted(time_s, edges)):
        chosen.update(_run(usable, part))
    return sorted(chosen)


def _run(usable: Sequence[Frame], part: Index) -> list[int]:
    """The unbroken run closest to the middle of a part, or all of a short part."""
    if len(part) <= RUN_FRAMES:
        return [usable[int(k)].index for k in part]
    starts = part[: len(part) - RUN_FRAMES + 1]
    order = np.argsort(np.abs(starts - starts.mean()), kind="stable")
    for start in starts[order]:
        run = [usable[int(k)].index for k in range(int(start), int(start) + RUN_FRAMES)]
        if run[-1] - run[0] == RUN_FRAMES - 1:
            return run
    return []


# ── the fit ──────────────────────────────────────────────────────────────────────────────────────────────────────


def align(
    observed: ObservedTracks, imu: ImuSamples, profile: CameraProfile, depth_m: float | None = None
) -> VisualInertialAlignment:
    """Fit velocity, gravity, accelerometer bias and planes to tracked points, and check what the motion determines.

    Clock, IMU rotation and gyroscope bias are fitted too, with the priors of a careful profile, or freely if unknown
    (time_offset_s None).  depth_m: the scene's, if the profile states it; the scale then needs no acceleration.  Never
    raises for poor data: windows have reasons instead.
    """
    if profile.intrinsics is None:
        return VisualInertialAlignment((), "the focal length is unknown")
    observed = observed.covered(imu, profile)
    if len(observed.pairs) < MIN_PAIRS:
        return VisualInertialAlignment((), f"only {len(observed.pairs)} pairs of frames have enough points")
    if not imu.has_accelerometer:
        return VisualInertialAlignment((), "no accelerometer to determine the camera's path")
    stretches = []
    for part in _parts(observed):
        stretch = _fit_stretch(part, imu, profile, depth_m)
        if stretch is not None:
            stretches.append(stretch)
    return VisualInertialAlignment(tuple(stretches), "" if stretches else "too few points or accelerations")


def _parts(observed: ObservedTracks) -> list[ObservedTracks]:
    """Parts of about STRETCH_S."""
    middle = np.array([observed.stamp_s[pair.second] for pair in observed.pairs])
    count = max(int(np.ceil((middle[-1] - middle[0]) / STRETCH_S)), 1)
    edges = np.linspace(middle[0], middle[-1], count + 1)[1:-1]
    number = np.searchsorted(edges, middle, side="right")
    return [observed.chosen(number == k) for k in range(count)]


def nuisance_terms(profile: CameraProfile) -> tuple[Term, ...]:
    """Terms fitted with the scene: everything that could be mistaken for parallax.

    In front of a tilted wall, another translation with another rotation gives nearly the same picture (a plane's second
    motion); the prior of the gyroscope's bias excludes that rotation.
    """
    known = profile.time_offset_s is not None and "time_offset_s" not in profile.estimates
    terms = [STATED_OFFSET if known else TIME_OFFSET, SMALL_BIAS, NEAR_AXES]
    if not profile.readout_known:
        terms.append(UNKNOWN_READOUT)
    focal = profile.estimates.get("fx_px")
    if focal is not None and isinstance(focal.std, float) and focal.std and profile.intrinsics is not None:
        terms.append(replace(FOCAL, prior_std=(focal.std / profile.intrinsics.fx_px,)))
    return tuple(terms)


def _fit_stretch(
    observed: ObservedTracks, imu: ImuSamples, profile: CameraProfile, depth_m: float | None
) -> Stretch | None:
    if len(observed.pairs) < MIN_PAIRS:
        return None
    span_s = observed.stamp_s[observed.pairs[-1].second] - observed.stamp_s[observed.pairs[0].first]
    table = observed.table(POINTS_PER_WINDOW * max(int(np.ceil(span_s / WINDOW_S)), 1))
    if len(table) < MIN_POINTS:
        return None
    first, last = (float(profile.imu_time_s(t)) for t in (table.first_stamp_s.min(), table.second_stamp_s.max()))
    imu = imu.between(first - IMU_MARGIN_S - settling_time_s(profile), last + IMU_MARGIN_S)
    terms = nuisance_terms(profile)
    rotating = fit_tracks(imu, table, profile, terms, max_iterations=ROTATION_ITERATIONS)
    known = integrate_motion(imu, profile, translation=True)
    if known.displacement is None:
        return None
    inverse_depth = START_INVERSE_DEPTH_PER_M if depth_m is None else 1 / depth_m
    scene = start_scene(imu, known, table, inverse_depth)
    fit = fit_tracks(imu, table, profile, terms, scene, known=known)
    if depth_m is not None:
        fit = _at_depth(fit, imu, table, profile, terms, depth_m)
    assert isinstance(fit.scene, InertialMotion)
    points = triangulate(fit.integrated, fit.scene, table)
    rays = _nearness_rays(fit, table)
    floor_m_s = _velocity_floor(_nearness_per_m(fit, table, rays), fit, table)
    stretch = Stretch(fit, table, (), points, rays, floor_m_s, _perturbed(fit, imu))
    stretch = replace(stretch, windows=tuple(_judged(stretch, rotating, k, depth_m) for k in range(table.n_windows)))
    sights = triangulate_relief(fit.integrated, fit.scene, observed.table(observed.tracks))
    reliefs = tuple(_relief(stretch, sights, k) for k in range(table.n_windows))
    windows = tuple(_with_a_surface(window, relief) for window, relief in zip(stretch.windows, reliefs, strict=True))
    return replace(stretch, windows=windows, reliefs=reliefs)


def _relief(stretch: Stretch, sights: SightedPoints, window: int) -> WindowRelief | None:
    """Relief on a window's planes, if it predicts held-out points better."""
    if not stretch.windows[window].usable:
        return None
    grid = picture_grid(stretch.fit.integrated.lens, stretch.origin_s(window))

    def view(time_s: float) -> View:
        return stretch.view(window, time_s, stretch.frame_plane(window, time_s).plane_per_m)

    return find_relief(sights.chosen(sights.points.window == window), grid, view)


def _nearness_rays(fit: TrackFit, table: TrackTable) -> Array:
    """Rays (windows, 3), z = 1, camera axes, on which the planes' nearness is judged.

    The optical axis; or, where it meets the plane far behind the points or never, as that of a level camera over the
    ground does, the mean ray of the points on the plane.
    """
    scene, known = fit.scene, fit.integrated
    assert isinstance(scene, InertialMotion)
    prediction = predict(known, table, scene)
    assert prediction.moved is not None
    ways, of_points = world_rays(known, table, prediction.poses, prediction.sights), prediction.moved.inverse_depth
    rotation = known.trajectory.orientation(np.asarray(fit.profile.imu_time_s(table.origin_s)))
    found = np.tile([0.0, 0.0, 1.0], (table.n_windows, 1))
    for window, nearness in enumerate(_nearness_per_m(fit, table, found)):
        on_plane = (table.window == window) & (of_points > 0)
        if on_plane.any() and nearness < LEAST_NEARNESS * of_points[on_plane].mean():
            ray = rotation[window].T @ ways[on_plane].mean(axis=0)
            found[window] = ray / ray[2]
    return found


def _nearness_per_m(fit: TrackFit, table: TrackTable, rays: Array) -> Array:
    """Inverse depths (windows,) of the planes on rays (windows, 3), z = 1, camera axes, at the windows' middles."""
    assert isinstance(fit.scene, InertialMotion)
    rotation = fit.integrated.trajectory.orientation(np.asarray(fit.profile.imu_time_s(table.origin_s)))
    return np.asarray(np.einsum("wij,wj,wi->w", rotation, rays, fit.scene.plane_per_m))


def _perturbed(fit: TrackFit, imu: ImuSamples) -> tuple[IntegratedMotion, ...]:
    """The fit's integrated motion with each value of its terms changed by its difference step."""
    steps = [(term, np.diag(term.quotient)[k]) for term in fit.terms for k in range(len(term))]
    return tuple(with_profile(fit.integrated, imu, term.change(fit.profile, step)) for term, step in steps)


def _velocity_floor(nearness_per_m: Array, fit: TrackFit, table: TrackTable) -> Array:
    """Velocity error from a constant error of TRACKING_BIAS_PX per step, at each window's depth."""
    assert fit.profile.intrinsics is not None
    step_s = float(np.median(table.second_stamp_s - table.first_stamp_s))
    depth_m = 1 / np.maximum(nearness_per_m, 1e-3)
    return np.asarray(TRACKING_BIAS_PX / fit.profile.intrinsics.fx_px * depth_m / max(step_s, 1e-3))


def _at_depth(
    fit: TrackFit, imu: ImuSamples, table: TrackTable, profile: CameraProfile, terms: tuple[Term, ...], depth_m: float
) -> TrackFit:
    """Fit again with each window's plane at the stated depth on its ray, with the fitted tilt."""
    scene = fit.scene
    assert isinstance(scene, InertialMotion)
    nearness = _nearness_per_m(fit, table, _nearness_rays(fit, table))
    ratio = (1 / depth_m) / np.maximum(nearness, 0.02)[:, None]
    plane = scene.plane_per_m * ratio
    spread = STATED_DEPTH_STD / depth_m
    held = replace(
        scene, velocity_m_s=scene.velocity_m_s / ratio, plane_per_m=plane, plane_std_per_m=(spread, spread, spread)
    )
    return fit_tracks(imu, table, profile, terms, held)


# ── judgement ────────────────────────────────────────────────────────────────────────────────────────────────────


def _judged(stretch: Stretch, rotating: TrackFit, window: int, depth_m: float | None) -> Window:
    fit, table = stretch.fit, stretch.table
    mine = table.window == window
    start_s, end_s = float(table.first_stamp_s[mine].min()), float(table.second_stamp_s[mine].max())
    times = np.linspace(start_s, end_s, 32)
    velocity, covariance = stretch.seen_velocity(window, times)
    spread = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1).mean())
    speed = max(float(np.sqrt((velocity**2).sum(axis=-1).mean())), 1e-6)
    inverse = max(float(_nearness_per_m(fit, table, stretch.nearness_rays)[window]), LEAST_INVERSE_PER_M)
    scale_std = stretch.plane_std_per_m(window) / inverse
    flow, flow_covariance = stretch.flow(window, times)
    flow_std = np.sqrt(np.trace(flow_covariance, axis1=-2, axis2=-1).mean() / max((flow**2).sum(axis=-1).mean(), 1e-12))
    left, before = _left(fit, mine), _left(rotating, mine)
    found = Window(
        start_s, end_s, scale_std, float(spread) / speed, before / max(left, 1e-6), left, "",
        fit.depth_spread_per_m / inverse, float(flow_std),
    )  # fmt: skip
    reason = _no_parallax(found) or _no_fit(found, *_gravity_m_s2(stretch), before) or _far_from_profile(fit)
    if reason:
        return replace(found, reason=reason)
    return replace(found, reason=_no_metres(found), over_depth=found.flow_std < MAX_FLOW_STD)


def _left(fit: TrackFit, mine: Mask) -> float:
    """Robust standard deviation per coordinate of a window's whitened residuals."""
    return float(np.median(fit.distance[mine])) / RAYLEIGH_MEDIAN


def _no_parallax(found: Window) -> str:
    if found.parallax < MIN_PARALLAX:
        return f"too little parallax: rotation alone leaves {found.parallax:.2f} times the residual of translation"
    return ""


def _gravity_m_s2(stretch: Stretch) -> tuple[float, float]:
    """Magnitude of the fitted gravity, and its standard deviation."""
    gravity, first = stretch.scene.gravity_m_s2, len(stretch.fit.change)
    size = float(np.linalg.norm(gravity))
    up = gravity / max(size, 1e-9)
    variance = float(up @ stretch.fit.covariance[first : first + 3, first : first + 3] @ up)
    return size, float(np.sqrt(max(variance, 0.0)))


def _no_fit(found: Window, gravity_m_s2: float, std_m_s2: float, before: float) -> str:
    unexplained = max(found.residual**2 - 1, 0.0) / max(before**2 - 1, 1e-6)
    too_far_m_s2 = float(np.hypot(GRAVITY_TOLERANCE_M_S2, 2 * std_m_s2))
    if unexplained > MAX_UNEXPLAINED or abs(gravity_m_s2 - GRAVITY_M_S2) > too_far_m_s2:
        return (
            f"the accelerometer does not fit the frames: {unexplained:.0%} of the parallax unexplained, "
            f"gravity {gravity_m_s2:.2f} ± {std_m_s2:.2f} m/s²"
        )
    return ""


def _far_from_profile(fit: TrackFit) -> str:
    for term in fit.terms:
        ratio = float(np.max(np.abs(fit.value(term.name)) / np.array(term.prior_std)))
        if ratio > MAX_PRIOR_STD:
            name = term.name.replace("_", " ").replace("imu", "IMU")
            return f"frames and accelerometer fit only if the {name} is {ratio:.0f} σ off the profile's"
    return ""


def _no_metres(found: Window) -> str:
    for name, std in (("scale", found.scale_std), ("velocity", found.velocity_std)):
        if std > MAX_RELATIVE_STD:
            return f"{name} undetermined: ± {min(std, 1):.0%}{' or more' if std > 1 else ''}"
    return ""


def _with_a_surface(window: Window, relief: WindowRelief | None) -> Window:
    """The window, unusable if its depths spread too far for a plane and it has no surface."""
    if not window.usable or relief is not None or window.spread <= MAX_SPREAD:
        return window
    return replace(window, reason=f"no common plane: inverse depths spread by {window.spread:.0%}", over_depth=False)
