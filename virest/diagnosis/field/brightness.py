"""A brightness field: light that varies over the frame unlike centred vignetting, and is the same in all frames.

The grey residuals of the patches are regressed on a smooth map of the log light, with the curve, vignetting and a gain
per frame as nuisances.  Each patch's own light is a nuisance too, so only patches that move across the frame are
informative.  Where all patches move alike, a linear slope is indistinguishable from a gain per frame, and stays 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import null_space

from virest.arrays import Array, Index
from virest.camera.field import Field, cardinal_weights
from virest.camera.profile import CameraProfile
from virest.diagnosis.field.screening import MAX_P, MIN_BLOCKS, MIN_T, RIVAL_GAIN_FRACTION, Design, score_forms
from virest.diagnosis.findings import PHOTOMETRY, FieldFinding, HeldOutGain
from virest.diagnosis.photometry import PhotometricObservations, Prediction, predict
from virest.diagnosis.photometry_effects import GainDrift
from virest.diagnosis.photometry_fit import fit_photometry, significance
from virest.diagnosis.selection import LIGHT_LEVELS
from virest.inference.chance import t_ratio
from virest.inference.robust import CAUCHY, cauchy_weight, robust_std

KNOTS, FINE_KNOTS = 4, 7
"""Knots along each side of a map: a cubic spline through 4 holds slope and vignetting, one through 7 follows 1.7
periods to 10 % (rms)."""
BAND_KNOTS, ACROSS_BAND = 16, 2
"""Knots of bands along the readout, for 3.8 periods to 10 %: a light at 120 Hz in a readout of 30 ms; and across it,
where bands do not change."""
FINER_LEFT = 0.98
"""A finer map must reduce the held-out residual of the coarser one below this fraction."""
FRAMES_IN_BLOCK = 3
"""Blocks of 1 or 2 frames find the same six of nine simulated shadows, of 6 only three: these are ten blocks."""
MOST_OBSERVATIONS = 15_000
"""Half or twice as many find the same shadows, and change a map by up to 0.013; the time grows by 40 % a doubling."""
MIN_SIZE = 0.06
"""Grey levels (rms).  On 19 captures without such a field, texture and encoder left up to 0.06, with t up to 1.8."""
CAP = 5.0
"""Residual cap, in noise σ."""
LEAST_SCALE = 1e-9
"""Guard against a division by zero."""
RIDGE = 1e-3
"""Added to the diagonal of the normal equations, relative: what the tangents determine loses 0.1 %."""
CURVE_STEP = 0.02
"""Step of the difference quotients of gamma, relative, and of the black level: 5 of 255 levels."""
MOST_CYCLES = 0.5
"""Flicker that drifts by less than this many cycles over all frames may be mistaken for a shadow."""
MIN_EXPLAINED = 0.9
"""Fraction of the map's variance that a shape must explain to name it."""
REASONS = (
    "the lens shades off its centre, something stands before it or dirt lies on it, or the phone corrects its shading "
    "as the profile does not"
)
NEXT = (
    "film an evenly lit wall, then the same with the phone upside down: an error that rotates with "
    "the phone belongs to the phone"
)


@dataclass(frozen=True, slots=True)
class LightField:
    """A map of the light, and its significance."""

    field: Field
    p_value: float
    held_out: HeldOutGain

    rivals: tuple[str, ...] = ()
    """Named causes that the patches cannot distinguish from it."""

    @property
    def is_bands(self) -> bool:
        """Whether it follows the readout finely, as a flickering light does."""
        return _is_bands(self.field)

    @property
    def finding(self) -> FieldFinding:
        """The finding in words."""
        size, std = _size(self.field)
        shape = map_shape(self.field)
        rms = f"patches {self.held_out.before:.3g} → {self.held_out.after:.3g} grey levels, held out"
        sentence = f"the light differs by up to {100 * size:.3g} % over the picture, {shape}, the same in all frames"
        confounded = (*(("gain over row",) if shape == BAND else ()), *self.rivals)
        return FieldFinding(
            ("x", "y"), "gain", shape, f"{sentence} ({rms})", size, "1", std, self.held_out, self.p_value, confounded,
            None, REASONS, NEXT, (self.field,),
        )  # fmt: skip


SLOPE, BAND, MAP = "growing to one side", "changing with the row alone", "a smooth map"


def light_field(observations: PhotometricObservations, profile: CameraProfile, gains: bool = True) -> LightField | None:
    """The map that the patches support in addition to the profile's light; None where they support none.

    gains: whether each frame may also have its own gain.
    """
    seen = _thinned(observations)
    block = np.unique(seen.frame // FRAMES_IN_BLOCK, return_inverse=True)[1]
    if len(seen) < 500 or block.max() + 1 < MIN_BLOCKS:
        return None
    order = np.argsort(block, kind="stable")
    at = predict(seen, profile)
    left = at.residual / seen.noise
    weight = _weight(left)
    tangent = _tangent(seen, profile, at, gains) / seen.noise[:, None]
    forms: list[tuple[tuple[int, int], ...]] = [((KNOTS, KNOTS), (FINE_KNOTS, FINE_KNOTS)), (_bands(profile),)]
    designs = []
    for counts in forms:
        zero = _zero_map(profile, counts[0])
        basis = _basis(zero, profile, vignetted=True)
        design = -at.respond(_weights(zero, seen) @ basis) / seen.noise[:, None]
        designs.append(Design("gain", design[order, None], over_time=False))
    best: LightField | None = None
    scored = score_forms(left[order, None], weight[order], tangent[order, None], designs, block[order])
    for one in sorted(scored, key=lambda one: one.index):
        if one.parts_gain is None or one.p_value > MAX_P:
            continue
        size = float(np.sqrt(max(one.gain.sum(), 0.0) / weight.sum())) * float(np.median(seen.noise))
        if min(t_ratio(one.gain), t_ratio(one.parts_gain)) < MIN_T or size < MIN_SIZE:
            continue
        for count in forms[one.index]:
            found = _fitted(seen, profile, at, tangent, weight, block, count, one.p_value)
            most_left = found.held_out.before if best is None else FINER_LEFT * best.held_out.after
            if found.held_out.after < most_left:
                best = found
    return best


def _bands(profile: CameraProfile) -> tuple[int, int]:
    """Knots along x and y of bands along the readout."""
    return (BAND_KNOTS, ACROSS_BAND) if profile.shutter.reads_columns else (ACROSS_BAND, BAND_KNOTS)


def _fitted(
    seen: PhotometricObservations, profile: CameraProfile, at: Prediction, tangent: Array, weight: Array, block: Index,
    count: tuple[int, int], p_value: float,
) -> LightField:  # fmt: skip
    """The map with these numbers of knots along x and y."""
    zero, vignetted = _zero_map(profile, count), bool(profile.extensions.vignetting_corner_loss)
    basis = _basis(zero, profile, vignetted)
    if not vignetted:  # the map may contain its r² pattern
        tangent = tangent[:, 1:]
    left, design = at.residual / seen.noise, -at.respond(_weights(zero, seen) @ basis) / seen.noise[:, None]
    columns = np.concatenate([design, tangent], axis=1)
    numbers, covariance = _solved(columns, left, weight, block, design.shape[1])
    values = basis @ numbers
    std = np.sqrt(np.maximum(np.einsum("vk,kl,vl->v", basis, covariance, basis), 0.0))
    factor = np.exp(values)
    field = zero.with_values((factor - 1)[:, None], (factor * std)[:, None])
    return LightField(field, p_value, _held_out(columns, design.shape[1], left, weight, block, seen))


def instead_of_flicker(observations: PhotometricObservations, profile: CameraProfile) -> LightField | None:
    """The map that explains the patches as well as the profile's flicker, if the flicker is phase-locked.

    A light that flickers a whole number of cycles per frame looks like a fixed shadow over the rows, or like bands that
    belong to them; bands of several periods are as fine as a light's, so patches alone cannot tell them apart: they
    need to remove nearly as much.  None where the phase drifts, or the flicker explains more.
    """
    seen = _thinned(observations)
    if not _is_phase_locked(seen, profile):
        return None
    found = light_field(observations, without_flicker(profile))
    if found is None:
        return None
    before, flickering = found.held_out.before**2, _left_by(seen, profile) ** 2
    most_left = before - RIVAL_GAIN_FRACTION * (before - flickering) if found.is_bands else flickering
    if found.held_out.after**2 > most_left:
        return None
    return replace(found, rivals=(f"flicker at {profile.extensions.flicker_frequency_hz:.4g} Hz",))


def instead_of_gain(observations: PhotometricObservations, profile: CameraProfile) -> LightField | None:
    """The constant map that explains the same residuals as the profile's gain per frame; None where there is none.

    Where all patches move alike, a slope of the light looks like a gain that follows the viewing direction.  If a few
    constant numbers remove nearly as much as one gain per frame, or leave no significant gain beside them, they are the
    likelier reason.
    """
    if not profile.extensions.gain:
        return None
    found = light_field(observations, without_gain(profile), gains=False)
    if found is None:
        return None
    before = found.held_out.before**2
    by_gain = before - _left_by(_thinned(observations), profile) ** 2
    removes_as_much = before - found.held_out.after**2 >= RIVAL_GAIN_FRACTION * by_gain
    if not removes_as_much and _gains_are_significant(observations, with_light_field(without_gain(profile), found)):
        return None
    return replace(found, rivals=("gain_drift",))


def _gains_are_significant(observations: PhotometricObservations, profile: CameraProfile) -> bool:
    """Whether the frames have gains of their own beside the profile's light."""
    frames = tuple(observations.frames.tolist())
    gains = GainDrift(frames, frames[-1] + 1)
    fitted = fit_photometry(observations, profile, [gains])
    return LIGHT_LEVELS.significant(significance(fitted, gains.name, observations, profile)[1])


def without_flicker(profile: CameraProfile) -> CameraProfile:
    """The profile without flicker."""
    return replace(profile, extensions=replace(profile.extensions, flicker_amplitude=0.0))


def without_gain(profile: CameraProfile) -> CameraProfile:
    """The profile without a gain per frame."""
    return replace(profile, extensions=replace(profile.extensions, gain=()))


def _is_phase_locked(seen: PhotometricObservations, profile: CameraProfile) -> bool:
    """Whether the flicker phase drifts by less than half a cycle over all frames."""
    if not profile.extensions.flicker_amplitude or len(seen) < 2:
        return False
    frames, first = np.unique(seen.frame, return_index=True)
    cycles = profile.extensions.flicker_frequency_hz * (seen.stamp_s[first] - seen.stamp_s[first[0]])
    per_frame = cycles[-1] / max(int(frames[-1] - frames[0]), 1)
    return bool(np.ptp(cycles - np.round(per_frame) * (frames - frames[0])) < MOST_CYCLES)


def _left_by(seen: PhotometricObservations, profile: CameraProfile) -> float:
    """Capped residual rms of the patches under a profile, nuisances removed, grey levels."""
    at = predict(seen, profile)
    left, tangent = at.residual / seen.noise, _tangent(seen, profile, at) / seen.noise[:, None]
    weight = _weight(left)
    block = np.unique(seen.frame // FRAMES_IN_BLOCK, return_inverse=True)[1]
    for fold in (0, 1):
        judged = block % 2 == fold
        left[judged] = _without(tangent[judged], left[judged], weight[judged], block[judged])
    return float(np.sqrt(np.mean(seen.noise**2))) * _capped_rms(left)


def _weight(left: Array) -> Array:
    """Robust weights (n,) of residuals over their squared scale."""
    scale = max(robust_std(left), LEAST_SCALE)
    return cauchy_weight(left**2, CAUCHY * scale) / scale**2


def with_light_field(profile: CameraProfile, found: LightField) -> CameraProfile:
    """The profile with the map in it."""
    return profile.with_fields([*profile.fields, found.field])


def _thinned(observations: PhotometricObservations) -> PhotometricObservations:
    thin = -(-len(observations) // MOST_OBSERVATIONS)
    seen = observations if thin < 2 else observations.subset(observations.place % thin == 0)
    return seen.subset(np.bincount(seen.patch)[seen.patch] >= 2)


def _zero_map(profile: CameraProfile, count: tuple[int, int]) -> Field:
    """A map of zeros with these numbers of knots along x and y."""
    sides = profile.width, profile.height
    knots = tuple(tuple(np.linspace(0.0, side - 1, n).tolist()) for side, n in zip(sides, count, strict=True))
    return Field("gain", ("x", "y"), knots, ((0.0,),) * (count[0] * count[1]))


def _basis(field: Field, profile: CameraProfile, vignetted: bool) -> Array:
    """(knots, n) basis of a map's free numbers: 0 at the centre (each patch's own light); bands are even across.

    vignetted: without the r² pattern of a vignetting, which has a number of its own.
    """
    x, y = (a.ravel() for a in np.meshgrid(*field.knots, indexing="ij"))
    radius2 = (x - 0.5 * (profile.width - 1)) ** 2 + (y - 0.5 * (profile.height - 1)) ** 2
    tied = np.eye(len(x))
    if _is_bands(field):
        along, across = (x, y) if profile.shutter.reads_columns else (y, x)
        tied = (along[:, None] == along[across == 0.0]).astype(float)
    fixed = [_middle(field, profile), radius2 / np.linalg.norm(radius2)][: 1 + vignetted]
    return np.asarray(tied @ null_space(np.stack(fixed) @ tied))


def _is_bands(field: Field) -> bool:
    return BAND_KNOTS in map(len, field.knots)


def _middle(field: Field, profile: CameraProfile) -> Array:
    """(knots,) interpolation weights at the centre of the frame."""
    middle = (0.5 * (profile.width - 1), 0.5 * (profile.height - 1))
    return np.outer(*(cardinal_weights(k, m) for k, m in zip(field.knots, middle, strict=True))).ravel()


def _weights(field: Field, seen: PhotometricObservations) -> Array:
    """(n, knots) of the map's values in each observation."""
    across, down = (cardinal_weights(k, c) for k, c in zip(field.knots, (seen.x_px, seen.y_px), strict=True))
    return np.asarray(across[:, :, None] * down[:, None, :]).reshape(len(seen), -1)


def _tangent(seen: PhotometricObservations, profile: CameraProfile, at: Prediction, gains: bool = True) -> Array:
    """Effects of vignetting, a gain per frame and the curve (n, m), grey levels."""
    frames = (seen.frame[:, None] == seen.frames[None, : len(seen.frames) * gains]).astype(float)
    factors = -at.respond(np.concatenate([(seen.radius**2)[:, None], frames], axis=1))
    curve = profile.curve
    changed = (
        replace(curve, extra_gamma=curve.extra_gamma * (1 + CURVE_STEP)),
        replace(curve, black_level=curve.black_level + CURVE_STEP),
    )
    bent = [at.residual - predict(seen, replace(profile, response=other)).residual for other in changed]
    return np.concatenate([factors, np.stack(bent, axis=-1) / CURVE_STEP], axis=1)


def _solved(columns: Array, left: Array, weight: Array, block: Index, count: int) -> tuple[Array, Array]:
    """The first ``count`` numbers of a ridge regression, and their covariance with errors clustered by block."""
    weighted = columns * weight[:, None]
    normal = weighted.T @ columns
    inverse = np.linalg.inv(normal + RIDGE * np.diag(np.maximum(np.diag(normal), 1e-9)))
    numbers = inverse @ (weighted.T @ left)
    pull = weighted * (left - columns @ numbers)[:, None]
    sums = np.stack([np.bincount(block, column) for column in pull.T], axis=-1)
    blocks = len(sums)
    covariance = inverse @ (sums.T @ sums) @ inverse * blocks / max(blocks - 1, 1)
    return numbers[:count], covariance[:count, :count]


def _held_out(
    columns: Array, count: int, left: Array, weight: Array, block: Index, seen: PhotometricObservations
) -> HeldOutGain:
    """Fit on every other block, judge on the rest, both ways; nuisances are refitted on the judged blocks."""
    others = columns[:, count:]
    before, after = np.zeros(len(left)), np.zeros(len(left))
    for fold in (0, 1):
        fitted, judged = block % 2 == fold, block % 2 != fold
        numbers = _solved(columns[fitted], left[fitted], weight[fitted], block[fitted], count)[0]
        for rest, target in ((left, before), (left - columns[:, :count] @ numbers, after)):
            target[judged] = _without(others[judged], rest[judged], weight[judged], block[judged])
    typical = float(np.sqrt(np.mean(seen.noise**2)))
    return HeldOutGain(PHOTOMETRY, typical * _capped_rms(before), typical * _capped_rms(after), typical)


def _without(columns: Array, left: Array, weight: Array, block: Index) -> Array:
    """Residuals of a regression on nuisances."""
    return left - columns @ _solved(columns, left, weight, block, columns.shape[1])[0]


def _capped_rms(left: Array) -> float:
    return float(np.sqrt(np.mean(np.clip(left, -CAP, CAP) ** 2)))


def _size(field: Field) -> tuple[float, float]:
    """Largest absolute value of the map, and its standard deviation."""
    values = np.abs(np.array(field.values)[:, 0])
    place = int(np.argmax(values))
    return float(values[place]), float(field.std[place][0])


def map_shape(field: Field) -> str:
    """Name the shape of a map over the frame."""
    x, y = np.meshgrid(*(np.linspace(k[0], k[-1], 21) for k in field.knots), indexing="ij")
    values = field.at(x, y)[..., 0]
    values = values - values.mean()
    total = float((values**2).sum())
    if not total:
        return "nothing"
    plane = np.stack([np.ones(x.size), x.ravel() / np.ptp(x), y.ravel() / np.ptp(y)], axis=-1)
    left = values.ravel() - plane @ np.linalg.lstsq(plane, values.ravel(), rcond=None)[0]
    if float((left**2).sum()) < (1 - MIN_EXPLAINED) * total:
        return SLOPE
    rows = values - values.mean(axis=0, keepdims=True)
    return BAND if float((rows**2).sum()) < (1 - MIN_EXPLAINED) * total else MAP
