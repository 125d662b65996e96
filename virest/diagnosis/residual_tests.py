"""Residuals after all causes: structure along row, time, radius, rate, brightness or position, and excess noise."""

from __future__ import annotations

import logging

import numpy as np

from virest.arrays import Array, Index
from virest.capture.imu_noise import noise_density
from virest.diagnosis import photometry, picture_ladder
from virest.diagnosis.findings import GEOMETRY, PHOTOMETRY, Remaining
from virest.diagnosis.geometric_verdict import GeometricVerdict
from virest.diagnosis.structure import STRUCTURE_NOISES, Structure, structures
from virest.diagnosis.tracking_stage import STRAY_PART
from virest.image_formation.point_model import TrackTable, seen_s
from virest.inference.blur_bias import RELATIVE_STD, blur_bias_px
from virest.inference.chance import chance_of, chi2_tail
from virest.inference.robust import cauchy_weight, robust_std
from virest.inference.track_fit import TrackFit

log = logging.getLogger(__name__)

STRUCTURE_PX = 0.05
"""Structure above this size, and above STRUCTURE_NOISES of the noise, has a cause."""
STRUCTURE_P = 1e-4
"""p value of a structure, and of excess noise: the eight tests of points together stay below FALSE_ALARM."""
TRACKING_BIAS_PX = 0.02
"""Mean residual that a tracker's own bias leaves in a bin."""
SCALE_EXCESS = 1.25
"""Residuals above this many times their noise, measured without the model, and STRUCTURE_PX beyond it are not all
noise."""
LEAST_IN_PAIR, STRAY_DISTANCE = 8, 6.0
"""Pairs with at most this number of points are not tested; a point that far off, in standard deviations, is stray: of
normal errors, 1 in 7e7 is."""
HALF_WEIGHT_SIGMA = 40.0
"""Brightness residual with half weight, in robust σ: a band of the sensor is evidence, a passer-by is not."""
PHOTOMETRIC_STRUCTURE = 1.5
"""Minimum size of a structure, grey levels."""


def remaining_structure(geometric: GeometricVerdict, photometric: picture_ladder.PictureVerdict) -> Remaining:
    """The strongest structure: in the points if significant there, otherwise in brightness if significant there."""
    geometric_left = points_left(geometric)
    if geometric_left.significant or photometric.observations is None:
        return geometric_left
    light_left = _light_left(photometric)
    return light_left if light_left.significant else geometric_left


def points_left(geometric: GeometricVerdict) -> Remaining:
    """Structure, and noise in excess of the tracker's, in the points under the final model.

    Objects in front of or behind the scene's plane move points along the parallax; as far as their spread of depths
    explains this, it belongs to the scene and is not an error of the model.
    """
    fitted, table = geometric.fit, geometric.table
    noise, covariates = geometric.noise_px, _covariates(fitted, table)
    del covariates["time"]
    found = _point_structures(fitted, table, covariates)
    strongest = max(found, key=lambda s: s.size)
    stray = max(float(np.mean(fitted.distance > STRAY_DISTANCE * max(fitted.scale, 1.0))), geometric.independent_share)
    limit = max(STRUCTURE_PX, STRUCTURE_NOISES * noise)
    all_noise = float(np.hypot(noise, np.sqrt(np.mean(_turned_by_noise_px(fitted, table) ** 2))))
    beyond = float(np.sqrt(max(geometric.final_rms_px**2 - all_noise**2, 0.0)))
    p_noisier, p_stray = _more_than_noise(fitted.distance, table.pair, all_noise / geometric.step_noise_px)
    noisier = beyond > STRUCTURE_PX and geometric.final_rms_px > SCALE_EXCESS * all_noise and p_noisier < STRUCTURE_P
    strays = geometric.independent_share > STRAY_PART or (stray > STRAY_PART and p_stray < STRUCTURE_P)
    log.debug("left: %s, limit %.3f, beyond noise %.3f, stray %.3f", found, limit, beyond, stray)
    if strongest.size > limit and strongest.p_value < STRUCTURE_P and geometric.evidence is not None:
        guided = np.array([pair.guided for pair in geometric.evidence.observed.pairs])
        found = _point_structures(fitted, table, covariates, blur_bias_px(fitted.integrated, table, guided))
        strongest = max(found, key=lambda s: s.size)
        log.debug("without the tracker's bias between differently blurred frames: %s", found)
    if strongest.size > limit and strongest.p_value < STRUCTURE_P:
        sentence = f"residual {strongest.size:.3f} px, strongest along {strongest.along}"
        return Remaining(strongest.p_value, strongest.along, strongest.size, limit, GEOMETRY, True, sentence)
    if noisier:
        sentence = f"residual {beyond:.3f} px beyond tracking noise, strongest along {strongest.along}"
        return Remaining(p_noisier, strongest.along, beyond, STRUCTURE_PX, GEOMETRY, True, sentence)
    if strays:
        sentence = f"{stray:.0%} of the points move on their own"
        p_value = None if geometric.independent_share > STRAY_PART else p_stray
        return Remaining(p_value, "place", strongest.size, limit, GEOMETRY, True, sentence, only_strays=True)
    return Remaining(strongest.p_value, strongest.along, strongest.size, limit, GEOMETRY, False)


def _point_structures(
    fitted: TrackFit, table: TrackTable, covariates: dict[str, Array], bias_px: Array | None = None
) -> list[Structure]:
    """Structures of the residuals over the covariates and over time.

    bias_px: (n, 2) of the tracked second points, which all points of a pair share: frames that are blurred differently
    do not match at their true shift.  Known to RELATIVE_STD of its size, since textures differ.
    """
    left_px = fitted.across_relief_px(bias_px)
    uncertain_px = None if bias_px is None else RELATIVE_STD * bias_px
    outwards = _from_centre_px(fitted, table) / np.maximum(covariates["radius"], 1.0)[:, None]
    radial = (left_px * outwards).sum(axis=-1)
    difference = np.concatenate([left_px, radial[:, None]], axis=-1)
    found = structures(difference, fitted.weight, covariates, table.pair, TRACKING_BIAS_PX)
    turned_px = _turned_by_noise_px(fitted, table)
    return [*found, _along_time(left_px, fitted.weight, table.pair, turned_px, uncertain_px)]


def _turned_by_noise_px(fitted: TrackFit, table: TrackTable) -> Array:
    """(pairs,) standard deviation, per axis, of a pair's shift by the gyroscope's white noise between its frames."""
    lens = fitted.profile.intrinsics
    assert lens is not None
    apart_s = np.abs(table.second_stamp_s - table.first_stamp_s)
    pair_s = np.bincount(table.pair, apart_s) / np.maximum(np.bincount(table.pair), 1)
    gyro = fitted.integrated.measured.gyro
    return np.asarray(lens.fx_px * (noise_density(gyro.time_s, gyro.rate_rad_s) or 0.0) * np.sqrt(pair_s))


def _from_centre_px(fitted: TrackFit, table: TrackTable) -> Array:
    """(n, 2) from the principal point to the second points."""
    lens = fitted.profile.intrinsics
    assert lens is not None
    return table.second_px - np.array([lens.cx_px, lens.cy_px])


def _covariates(fitted: TrackFit, table: TrackTable) -> dict[str, Array]:
    """What residuals of the second points may depend on."""
    profile, second_px = fitted.profile, table.second_px
    second_s = seen_s(profile, second_px, table.second_stamp_s, table.second_exposure_s)
    return {
        "row": profile.shutter.readout_fraction(second_px, profile.width, profile.height),
        "time": second_s,
        "radius": np.linalg.norm(_from_centre_px(fitted, table), axis=-1),
        "x": second_px[:, 0],
        "y": second_px[:, 1],
        "rate": np.linalg.norm(fitted.integrated.trajectory.rate_rad_s(second_s), axis=-1),
    }


def _more_than_noise(distance: Array, pair: Index, noise: float) -> tuple[float, float]:
    """p values of the hypotheses that whitened distances are noise alone, and that the stray points are chance.

    One-sided t tests over the pairs: of their capped mean squares against 2 (SCALE_EXCESS noise)², and of their stray
    fractions against STRAY_PART.
    """
    count = np.maximum(np.bincount(pair), 1)
    used = np.bincount(pair) > LEAST_IN_PAIR
    square = np.bincount(pair, np.minimum(distance, STRAY_DISTANCE) ** 2) / count
    stray = np.bincount(pair, distance > STRAY_DISTANCE) / count
    tests = ((square, 2 * (SCALE_EXCESS * noise) ** 2), (stray, STRAY_PART))
    first, second = (chance_of(v[used] - mean) for v, mean in tests)
    return first, second


def _along_time(difference: Array, weight: Array, pair: Index, turned: Array, shared: Array | None = None) -> Structure:
    """Structure over time: scatter of the pairs' mean residuals in excess of what the scatter of their points gives.

    turned: (pairs,) standard deviation of a pair's mean residual by the gyroscope's noise.  shared: (n, 2) of an error
    with the same sign in all points of a pair.
    """
    total = np.maximum(np.bincount(pair, weight), 1e-9)
    excess, chi2, freedom = 0.0, 0.0, 0
    errors = np.zeros_like(difference) if shared is None else shared
    for column, error in zip(difference.T, errors.T, strict=True):
        mean = np.bincount(pair, weight * column) / total
        variance = np.bincount(pair, (weight * (column - mean[pair])) ** 2) / total**2
        used = np.bincount(pair) > LEAST_IN_PAIR
        common = np.bincount(pair, weight * error) / total
        spread = 2 * variance[used] + TRACKING_BIAS_PX**2 + common[used] ** 2 + turned[used] ** 2
        excess += float(np.mean(np.maximum(mean[used] ** 2 - spread, 0.0)))
        chi2 += float(np.sum(mean[used] ** 2 / spread))
        freedom += int(used.sum())
    return Structure("time", float(np.sqrt(excess / 2)), chi2_tail(chi2, max(freedom, 1)))


def _light_left(photometric: picture_ladder.PictureVerdict) -> Remaining:
    observations = photometric.observations
    assert observations is not None
    left = photometry.residuals(observations, photometric.profile)
    covariates = {
        "row": observations.row_fraction, "radius": observations.radius, "brightness": observations.grey,
    }  # fmt: skip
    weight = cauchy_weight(left**2, HALF_WEIGHT_SIGMA * max(robust_std(left), 1.0))
    found = structures(left[:, None], weight, covariates, observations.frame.astype(np.intp), 0.5)
    strongest = max(found, key=lambda s: s.size)
    log.debug("light left: %s", found)
    significant = strongest.size > PHOTOMETRIC_STRUCTURE and strongest.p_value < STRUCTURE_P
    sentence = f"residual {strongest.size:.1f} grey levels, strongest along {strongest.along}" if significant else ""
    size, limit = strongest.size, PHOTOMETRIC_STRUCTURE
    return Remaining(strongest.p_value, strongest.along, size, limit, PHOTOMETRY, significant, sentence)


def residuals(geometric: GeometricVerdict, nominal: bool) -> dict[str, Array]:
    """Point residuals (px) with their covariates, before or after the causes, for figures."""
    fitted = geometric.nominal_fit if nominal else geometric.fit
    table = geometric.nominal_table if nominal else geometric.table
    covariates = _covariates(fitted, table)
    return {
        "x_px": fitted.difference_px[:, 0],
        "y_px": fitted.difference_px[:, 1],
        **{name: covariates[name] for name in ("row", "time", "radius", "rate")},
        "column": covariates["x"],
        "line": covariates["y"],
        "pair": table.pair.astype(float),
        "weight": fitted.weight,
        "distance": fitted.distance,
    }
