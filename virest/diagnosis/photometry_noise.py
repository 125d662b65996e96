"""Noise of patches' brightness, measured without the camera model.

Each frame gets a free smooth field of position, row and brightness, and each patch a brightness of its own, whatever
the cause.  Both are estimated together, so that a patch seen only during long exposures is not an outlier.  The rest is
noise: of the sensor, of the encoder, and of registration.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import lsmr

from virest.arrays import Array, Index
from virest.camera.response import ResponseCurve
from virest.diagnosis.photometry import PhotometricObservations
from virest.inference.robust import MEDIAN_TO_STD

_MOST_ROW_KNOTS = 17
"""Maximum number of row knots; lamps pulse two or three times per readout, which this many knots represent."""
_PLACES_PER_TERM = 3.0
"""Minimum number of places of a frame per term of its field; the three channels of a place are not independent."""
_PRIOR_COUNT = 6.0
"""Weight, in observations, of the frame's noise against that of the patch."""
_LEAST_LEVELS = 0.05
"""Least noise of a frame, grey levels: keeps the weights finite."""
_PASSES, _SOLVER_STEPS = 4, 60
"""Reweightings, and steps of each solution.  Twice as many change simulated vignetting and flicker by less than 0.15 σ,
and their standard deviations by 5 % at most."""


def measured_noise(observations: PhotometricObservations, curve: ResponseCurve) -> PhotometricObservations:
    """The observations with their noise: a factor per frame times one per patch, from the residuals of the free fields.

    curve: the profile's; it removes the effect of logged exposure × ISO, so that a smooth field can model the rest.
    """
    if len(observations) == 0:
        return observations
    left = _two_way_residual(observations, curve)
    frame = np.searchsorted(observations.frames, observations.frame)
    frame_noise = np.maximum(_robust_std(frame, left), _LEAST_LEVELS)[frame]
    ratio = np.clip(left / frame_noise, -6, 6) ** 2
    count = np.bincount(observations.patch)
    per_patch = (np.bincount(observations.patch, ratio) + _PRIOR_COUNT) / (np.maximum(count - 1, 0) + _PRIOR_COUNT)
    return replace(observations, noise=frame_noise * np.sqrt(per_patch)[observations.patch])


def _two_way_residual(observations: PhotometricObservations, curve: ResponseCurve) -> Array:
    """(n,) residuals of a robust joint fit of patch levels and frame fields, scaled for the degrees of freedom used.

    ``grey = level + change(level, exposure × ISO) + field[frame](place, row, level)``, grey levels; ``level`` is one
    value per patch.  Change and field are evaluated at the previous pass's levels; the rest is linear least squares.
    """
    patch = np.unique(observations.patch, return_inverse=True)[1]
    frame = np.searchsorted(observations.frames, observations.frame)
    level = _medians(patch, _relit(observations.grey, -observations.log_product, curve))[patch]
    weight, left = np.ones(len(level)), np.zeros(len(level))
    for _ in range(_PASSES):
        target = observations.grey - _relit(level, observations.log_product, curve)
        design, scale = _design(observations, patch, frame, level, weight)
        found = lsmr(design, weight * target, atol=1e-7, btol=1e-7, maxiter=_SOLVER_STEPS)[0]
        left = target - (design @ found) / weight
        level = level + (found[: len(scale)] * scale)[patch]
        spread = _robust_std(frame, left)[frame]
        weight = np.sqrt(1 / (1 + (left / np.maximum(2.0 * spread, _LEAST_LEVELS)) ** 2))
    places = len(np.unique(np.stack([observations.place, observations.frame]), axis=1).T)
    spent = len(np.unique(observations.place)) + design.shape[1] - len(scale)
    return left * np.sqrt(places / max(places - spent, 0.25 * places))


def _relit(grey: Array, log_light: Array, curve: ResponseCurve) -> Array:
    """Grey levels after a change of log light, by the curve."""
    if not log_light.any():
        return grey
    light = curve.linearise(np.clip(grey / 255.0, 0.0, 1.0)) * np.exp(log_light)
    return np.asarray(255.0 * curve.encode(light), float)


def _medians(group: Index, values: Array) -> Array:
    """(groups,) lower median of each group."""
    order = np.lexsort((values, group))
    count = np.bincount(group)
    start = np.cumsum(count) - count
    return np.asarray(values[order][start + np.maximum(count - 1, 0) // 2])


def _robust_std(group: Index, values: Array) -> Array:
    """(groups,) robust standard deviation about zero, from the lower median of the absolute values."""
    return MEDIAN_TO_STD * _medians(group, np.abs(values))


def _design(
    observations: PhotometricObservations, patch: Index, frame: Index, level: Array, weight: Array
) -> tuple[sparse.csr_matrix, Array]:
    """(weighted columns of all patches and of all frames' fields, scales of the patch columns).

    The patch columns are orthonormal, and so is the basis within each frame: LSMR then needs few steps.
    """
    scale = 1 / np.sqrt(np.bincount(patch, weight**2))
    blocks = [sparse.csr_matrix((weight * scale[patch], (np.arange(len(patch)), patch)))]
    rows, columns, values, width = [], [], [], 0
    for k in range(int(frame.max()) + 1):
        chosen = np.flatnonzero(frame == k)
        basis = np.linalg.qr(weight[chosen, None] * _basis(observations, chosen, level[chosen]))[0]
        rows.append(np.repeat(chosen, basis.shape[1]))
        columns.append(np.tile(width + np.arange(basis.shape[1]), len(chosen)))
        values.append(basis.ravel())
        width += basis.shape[1]
    place = np.concatenate(rows), np.concatenate(columns)
    blocks.append(sparse.csr_matrix((np.concatenate(values), place), shape=(len(patch), width)))
    return sparse.csr_matrix(sparse.hstack(blocks)), scale


def _basis(observations: PhotometricObservations, chosen: Index, level: Array) -> Array:
    """A cubic in brightness, and brightness times (a quadratic in position + hat functions along the readout).

    The number of places in the frame limits the number of terms.
    """
    size = max(observations.width, observations.height)
    x = (observations.x_px[chosen] - observations.width / 2) / size
    y = (observations.y_px[chosen] - observations.height / 2) / size
    part = level / 128.0
    smooth = np.column_stack(
        [np.ones_like(part), part**2, part[:, None] * np.column_stack([x, y, x * x, x * y, y * y])]
    )
    columns = np.column_stack([part, smooth, part**3])
    terms = int(len(np.unique(observations.place[chosen])) / _PLACES_PER_TERM)
    knots = min(terms - columns.shape[1] + 2, _MOST_ROW_KNOTS)
    if knots < 4:
        return np.asarray(columns[:, : max(terms, 1)])
    hats = np.abs(observations.row_fraction[chosen, None] * (knots - 1) - np.arange(1, knots - 1))
    return np.column_stack([columns, part[:, None] * np.maximum(0, 1 - hats)])
