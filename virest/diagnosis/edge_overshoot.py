"""Sharpening by the phone, measured from the overshoot at isolated edges with little blur.

The profile z(u) across a step is that of :mod:`virest.inference.unsharp_mask`.  A response curve bends a profile but
keeps its range, so the mean of z(u) and 1 − z(−u) is fitted.  Where the step is wider than the mask, only
amount · radius² is observable; the priors AMOUNT and RADIUS_PX then decide, and the standard deviations grow
accordingly.

A mask overshoots on the bright side by at most as much as on the dark one: light is blurred before a concave curve
encodes it, which leaves the dark side of the step steeper.  What overshoots more on the bright side is the scene:
window frames, printed outlines, polished rims.

The significance test uses all isolated edges, whatever their width: if a textured surface happens to be brightest next
to an edge, that edge overshoots and is therefore steeper, so the sharpest edges overshoot in any such scene.  The
values of the mask come from the sharpest edges, since a soft step hardly overshoots.  A scene location that appears in
many frames counts once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from virest.arrays import Array, Index
from virest.camera.profile import CameraProfile
from virest.capture.records import Capture
from virest.diagnosis.findings import EDGES, Finding, HeldOutGain, ParameterChange, Rung
from virest.diagnosis.isolated_steps import GRID_PX, IsolatedSteps, crossing
from virest.diagnosis.local_blur import STILL_PX, look_for_steps, time_blocks
from virest.diagnosis.local_blur_model import across, path_tensors
from virest.diagnosis.picture_ladder import PictureVerdict, Reader
from virest.diagnosis.selection import EDGE_LEVELS
from virest.effects.table import EFFECTS
from virest.image_formation.row_clock import RowClock
from virest.inference.chance import student_tail
from virest.inference.parallel import ParallelMap, one_by_one
from virest.inference.time_blocks import halves
from virest.inference.unsharp_mask import AMOUNT, RADIUS_PX, SHARPEST, START, edge_profile, fit_edge
from virest.motion.trajectory import Trajectory, turned

MIN_USED = 60
"""Fewest of the sharpest edges from which a mask is fitted."""
LOCATION_PX, LOCATION_GROUPS = 20.0, 16
"""Cell size of a scene location: edges whose world directions share a cell, at the lens's focal length, show the same
location; and the number of location groups of the jackknife."""
PRIOR = np.array([AMOUNT, np.log(RADIUS_PX)]), np.array([0.8, 0.45])
"""Prior of the amount and the logarithm of the radius of phones' unsharp masks, and their σ: 0.8 to 2 px.

Twice and 1.5 times as wide as where frames are restored: what is reported shall be the capture's own."""
PROFILE_STD = 0.003
"""Misfit of a mean profile, as a fraction of the step, correlated within 1 px."""
UNSHARPENED_OVERSHOOT, UNSHARPENED_STD, UNSHARPENED_CAPTURES = 0.001, 0.003, 95
"""Overshoot of unsharpened decoded movies (all edges, weaker side), its σ, and the number of simulated captures behind
it: 0.001 ± 0.002, −0.003 to 0.0065 on 5 scenes at 320 × 240 and 640 × 480; boards have 0.004."""
SELECTED_OVERSHOOT, SELECTED_STD = 0.020, 0.017
"""The same for the sharpest edges, mean of both sides: coding, interpolation, and selection of steep edges."""
UNSHARPENED_RADII_PX = (0.6, 2.2)
"""Range of this overshoot: from that of interpolation to that of edges selected for sharpness."""
SIZE_ERROR = 0.2
"""Relative error of amount and radius: coding damps the overshoot depending on frequency."""
SAME_SIGMA = 3.0
"""A mask that differs from the recorded one by fewer deviations is the same."""
BOUNDS = ([0.2, 0.0, np.log(0.4)], [3.0, 6.0, np.log(4.0)])
"""Of the edge width (px), the amount, and the logarithm of the radius, which lie 2.4 and 2.7 σ from its prior."""


@dataclass(frozen=True, slots=True)
class EdgeProfiles:
    """Profiles across isolated edges with little motion, dark to bright, 0 and 1 at the plateaus."""

    profile: Array
    """(n, m) on GRID_PX, 0.5 at the middle."""
    width_px: Array
    """(n,) half of the distance between 0.16 and 0.84."""
    stamp_s: Array
    """(n,) of the frame."""
    place: Index
    """(n,) number of the scene location."""

    def __len__(self) -> int:
        return len(self.profile)


@dataclass(frozen=True, slots=True)
class Sharpening:
    """An unsharp mask estimated from edges."""

    amount: float
    amount_std: float
    radius_px: float
    radius_std_px: float
    sides: tuple[float, float]
    """Overshoot of the sharpest edges, dark and bright side, as a fraction of the step."""
    brighter: float
    """Excess of the bright side's over the dark side's, in σ: that of a mask is at most 0."""
    z: float
    """Excess overshoot of all edges over that of unsharpened movies, in σ, on the weaker side."""
    held_out: HeldOutGain
    """Residual rms of the mean profile, as a fraction of the step, without and with the mask."""

    @property
    def overshoot(self) -> float:
        """Mean of both sides."""
        return float(np.mean(self.sides))

    @property
    def is_scene(self) -> bool:
        """Whether the bright side overshoots more than any mask explains."""
        return EDGE_LEVELS.significant(student_tail(self.brighter, LOCATION_GROUPS - 1))

    @property
    def p_value(self) -> float:
        """Probability of such an overshoot on both sides without sharpening.

        Student's t, with the degrees of freedom of the captures on which the unsharpened overshoot was measured.
        """
        return student_tail(self.z, UNSHARPENED_CAPTURES - 1)


def judge_sharpening(
    capture: Capture,
    profile: CameraProfile,
    trajectory: Trajectory,
    gray: Reader,
    each: ParallelMap = one_by_one,
    steps: IsolatedSteps | None = None,
) -> PictureVerdict:
    """Report sharpening where edges overshoot more than coding explains.

    Restoration does not undo it, so the profile has no place for it; one that its estimates record is no new cause.
    steps: those of the frames of :func:`frames_to_read`, if already detected.
    """
    verdict = PictureVerdict(profile)
    seen = look_for_steps(gray, capture, each) if steps is None else steps
    found = fit_sharpening(edge_profiles(seen, profile, trajectory)) if len(seen) else None
    if found is None:
        verdict.notes.append("too few sharp, isolated edges: sharpening was not tested")
    elif found.is_scene:
        dark, bright = found.sides
        verdict.notes.append(
            f"edges overshoot by {bright:.0%} on the bright side and {dark:.0%} on the dark one, which no unsharp mask "
            "does: the scene's edges are outlined, and sharpening was not tested"
        )
    elif EDGE_LEVELS.significant(found.p_value):
        values = {"amount": (found.amount, found.amount_std), "radius_px": (found.radius_px, found.radius_std_px)}
        known = EFFECTS["sharpening"].read(profile, profile)
        changes = {name: ParameterChange(known[name], *found_so) for name, found_so in values.items()}
        if known["amount"] and all(abs(c.estimate - c.nominal) < SAME_SIGMA * c.std for c in changes.values()):
            verdict.notes.append(
                f"the phone sharpens its frames by an unsharp mask of {found.amount:.2g}, as the estimates record"
            )
            return verdict
        sentence = (
            f"edges overshoot by {found.overshoot:.0%} of their step: the phone sharpened its frames with an unsharp "
            f"mask (amount {found.amount:.2g}, radius {found.radius_px:.2g} px)"
        )
        verdict.findings.append(Finding("sharpening", changes, found.held_out, (), found.p_value, sentence))
        verdict.rungs.append(Rung("sharpening", {"sharpening": found.held_out.after}, found.held_out.before, EDGES))
    return verdict


def edge_profiles(steps: IsolatedSteps, profile: CameraProfile, trajectory: Trajectory) -> EdgeProfiles:
    """Profiles of the steps with little motion, in grey levels, since sharpening is applied after the curve."""
    clock, lens = RowClock(profile), profile.intrinsics
    assert lens is not None
    tensors = path_tensors(steps.stamp_s, steps.exposure_s, steps.points_px, profile, trajectory)
    steps = steps.chosen(np.sqrt(across(tensors, steps.normal)) < STILL_PX)
    seen_s = clock.seen_s(steps.points_px, steps.stamp_s, steps.exposure_s)
    ways = turned(trajectory.orientation(seen_s), lens.rays(steps.points_px))
    return _measured(steps.profile, steps.stamp_s, _locations(ways, lens.fx_px))


def fit_sharpening(edges: EdgeProfiles) -> Sharpening | None:
    """Amount and radius; None with too few sharp edges or scene locations."""
    if len(edges) < MIN_USED / SHARPEST or len(np.unique(edges.place)) < LOCATION_GROUPS:
        return None
    sharp = edges.width_px <= np.quantile(edges.width_px, SHARPEST)
    profiles, block = edges.profile[sharp], time_blocks(edges.stamp_s[sharp])
    numbers = np.unique(block)
    if len(profiles) < MIN_USED or len(numbers) < 4:
        return None
    mean, place = np.median(profiles, axis=0), edges.place[sharp]
    theta, covariance = _fit(_symmetrised(mean))
    without = [np.median(profiles[block != b], axis=0) for b in numbers]
    scatter = _jackknife([_fit(_symmetrised(one))[0] for one in without])
    std = np.sqrt(np.diag(covariance + scatter + _covariance_of_unsharpened(_symmetrised(mean), theta)))
    amount, radius_px = float(theta[1]), float(np.exp(theta[2]))
    return Sharpening(
        amount,
        float(np.hypot(std[1], SIZE_ERROR * amount)),
        radius_px,
        radius_px * float(np.hypot(std[2], SIZE_ERROR)),
        _overshoots(mean),
        _brighter(profiles, place),
        _significance(edges),
        _held_out(profiles, block),
    )


def _significance(edges: EdgeProfiles) -> float:
    """Excess overshoot of all edges over that of unsharpened movies, in σ, on the weaker side."""
    sides, covariance = _sides(edges.profile, edges.place)
    return float(((sides - UNSHARPENED_OVERSHOOT) / np.sqrt(np.diag(covariance) + UNSHARPENED_STD**2)).min())


def _brighter(profiles: Array, place: Index) -> float:
    """Excess of the bright side's overshoot over the dark side's, in σ."""
    sides, covariance = _sides(profiles, place)
    variance = covariance[0, 0] + covariance[1, 1] - 2 * covariance[0, 1] + 2 * SELECTED_STD**2
    return float((sides[1] - sides[0]) / np.sqrt(variance))


def _sides(profiles: Array, place: Index) -> tuple[Array, Array]:
    """Overshoots (2,) of the median profile and their covariance, by location groups."""
    group = np.unique(place, return_inverse=True)[1] % LOCATION_GROUPS
    without = [_overshoots(np.median(profiles[group != g], axis=0)) for g in range(LOCATION_GROUPS)]
    return np.array(_overshoots(np.median(profiles, axis=0))), _jackknife(without)


def sharpened_step(width_px: float, amount: float, radius_px: float) -> Array:
    """z(u) on GRID_PX."""
    return edge_profile(GRID_PX, width_px, amount, np.log(radius_px))


# ── parts ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def _locations(ways: Array, focal_px: float) -> Index:
    """Number (n,) of the scene location in each world direction (n, 3)."""
    cell = np.floor(ways / np.linalg.norm(ways, axis=-1, keepdims=True) * focal_px / LOCATION_PX)
    return np.unique(cell, axis=0, return_inverse=True)[1].ravel()


def _measured(profiles: Array, stamp_s: Array, place: Index) -> EdgeProfiles:
    near = np.abs(GRID_PX) <= 3.0
    width = crossing(profiles[:, near], 0.84, GRID_PX[near]) - crossing(profiles[:, near], 0.16, GRID_PX[near])
    return EdgeProfiles(profiles, 0.5 * width, stamp_s, place)


def _symmetrised(mean: Array) -> Array:
    return np.asarray(0.5 * (mean + 1.0 - mean[::-1]))


def _overshoots(mean: Array) -> tuple[float, float]:
    """Below the dark plateau and above the bright one."""
    return float(-mean[GRID_PX < 0].min()), float(mean[GRID_PX > 0].max() - 1.0)


def _fit(mean: Array) -> tuple[Array, Array]:
    """Width, amount, log radius, and their covariance; amount and radius have priors."""
    found = fit_edge(GRID_PX, mean, PROFILE_STD, PRIOR, START, BOUNDS)
    return found.x, np.linalg.pinv(found.jac.T @ found.jac)


def _covariance_of_unsharpened(mean: Array, theta: Array) -> Array:
    """Covariance (3, 3) of the values due to overshoot from other sources, narrow and wide."""
    moved = np.zeros((3, 3))
    for radius_px in UNSHARPENED_RADII_PX:
        bare = sharpened_step(theta[0], 1.0, radius_px) - sharpened_step(theta[0], 0.0, radius_px)
        away = _fit(mean - np.hypot(SELECTED_OVERSHOOT, SELECTED_STD) / bare.max() * bare)[0] - theta
        moved += np.outer(away, away)
    return moved


def _jackknife(values: Sequence[Array | tuple[float, ...]]) -> Array:
    """Jackknife covariance of an estimate from its leave-one-block-out values."""
    away = np.array(values, float)
    away -= away.mean(axis=0)
    return np.asarray(away.T @ away * (len(values) - 1) / len(values))


def _held_out(profiles: Array, block: Index) -> HeldOutGain:
    """Held-out rms of the mean profile of every other block, step fitted to the rest, without and with a mask."""
    seen, judged = (_symmetrised(np.median(profiles[use], axis=0)) for use in halves(block))
    width = least_squares(lambda s: sharpened_step(s[0], 0.0, 1.0) - seen, [0.7], bounds=(BOUNDS[0][0], BOUNDS[1][0]))
    theta, _ = _fit(seen)
    models = sharpened_step(width.x[0], 0.0, 1.0), sharpened_step(theta[0], theta[1], float(np.exp(theta[2])))
    before, after = (float(np.sqrt(np.mean((model - judged) ** 2))) for model in models)
    return HeldOutGain(EDGES, before, after, None)
