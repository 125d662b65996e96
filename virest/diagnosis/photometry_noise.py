"""How well the brightness of a patch is measured, found without the camera model.

Each frame gets a free smooth field: what all its patches have in common as a function of place, row and brightness is
taken away, whatever its cause.  What remains is noise: of the sensor, of the encoder, and of looking beside the patch.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from virest.diagnosis.photometry import Array, Indices, PhotometricObservations

_ROW_KNOTS = 9
_PRIOR_COUNT = 6.0
"""Weight of the frame's own noise, in observations, against that of the patch."""
_LEAST_LEVELS = 0.05
_PASSES = 3


def measured_noise(observations: PhotometricObservations) -> PhotometricObservations:
    """The observations with their noise: a factor per frame and one per patch, from what the free fields leave."""
    if len(observations) == 0:
        return observations
    left = np.zeros(len(observations))
    reference = _patch_medians(observations)
    rest = observations.grey - reference[observations.patch]
    frame_noise = np.ones(len(observations))
    for frame in observations.frames:
        chosen = np.flatnonzero(observations.frame == frame)
        left[chosen], noise = _field_residual(observations, chosen, rest[chosen], reference)
        frame_noise[chosen] = noise
    # Medians of patches know nothing of where the patch is in each frame; their mean residual is theirs.
    left -= _patch_mean(observations.patch, left)
    ratio = np.clip(left / frame_noise, -6, 6) ** 2
    count = np.bincount(observations.patch)
    per_patch = (np.bincount(observations.patch, ratio) + _PRIOR_COUNT) / (np.maximum(count - 1, 0) + _PRIOR_COUNT)
    return replace(observations, noise=frame_noise * np.sqrt(per_patch)[observations.patch])


def _patch_medians(observations: PhotometricObservations) -> Array:
    """(largest patch + 1,) median grey of each patch."""
    order = np.lexsort((observations.grey, observations.patch))
    patch, grey = observations.patch[order], observations.grey[order]
    count = np.bincount(patch)
    start = np.cumsum(count) - count
    middle = start + np.maximum(count - 1, 0) // 2
    return np.asarray(grey[np.minimum(middle, len(grey) - 1)])


def _patch_mean(patch: Indices, values: Array) -> Array:
    return np.asarray((np.bincount(patch, values) / np.maximum(np.bincount(patch), 1))[patch])


def _field_residual(
    observations: PhotometricObservations, chosen: Indices, rest: Array, reference: Array
) -> tuple[Array, float]:
    """Robust fit of the free field to one frame's deviations from the patches' medians: residuals and their spread."""
    basis = _basis(observations, chosen, reference[observations.patch[chosen]])
    weight = np.ones(len(chosen))
    left = rest
    for _ in range(_PASSES):
        fit = np.linalg.lstsq(weight[:, None] * basis, weight * rest, rcond=1e-8)[0]
        left = rest - basis @ fit
        spread = 1.4826 * float(np.median(np.abs(left)))
        weight = np.sqrt(1 / (1 + (left / max(2.0 * spread, _LEAST_LEVELS)) ** 2))
    free = max(len(chosen) - basis.shape[1], 1)
    grown = spread * np.sqrt(len(chosen) / free)
    return left, max(float(grown), _LEAST_LEVELS)


def _basis(observations: PhotometricObservations, chosen: Indices, level: Array) -> Array:
    """Brightness times (a quadratic in place + hats along the readout), and a cubic in brightness."""
    size = max(observations.width, observations.height)
    x = (observations.x_px[chosen] - observations.width / 2) / size
    y = (observations.y_px[chosen] - observations.height / 2) / size
    part = level / 128.0
    knots = np.linspace(0, 1, _ROW_KNOTS)
    hats = np.maximum(0, 1 - np.abs(observations.row_fraction[chosen, None] - knots) * (_ROW_KNOTS - 1))
    smooth = np.column_stack([x, y, x * x, x * y, y * y, hats])
    return np.column_stack([part[:, None] * smooth, np.ones_like(part), part**2, part**3])
