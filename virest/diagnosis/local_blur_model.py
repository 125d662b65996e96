"""Local blur as the profile predicts it: blur paths of the forward model, across edges and in spectra.

A fit needs the paths of about 100 frames many times, so they are computed for all frames together, from the trajectory
and the moving lens that `image_formation.kernels` also uses; a test compares the two.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.special import erf

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.diagnosis.local_blur_edges import STEP_PX, fit_steps
from virest.diagnosis.local_blur_spectra import MEMORY, SpectrumRatios, spectral_weights
from virest.image_formation.row_clock import ROW_MIDDLE
from virest.image_formation.turning_camera import turning_camera
from virest.image_formation.warp import seen_by_rows
from virest.motion.trajectory import Trajectory

_NODES = 4
"""Nodes along each side for the six terms of a quadratic in position."""
_INSTANTS = 5
"""Gauss-Legendre nodes of an exposure: exact for paths that are fourth-order polynomials in time."""
_RATIOS = np.linspace(0.0, 6.0, 25)
"""Widths of a path over that of the Gaussian at which the ratio is tabulated."""
LEAST_ANGLE = 1e-3
"""Below it sin q / q is 1 to single precision."""


def fitted_width(motion_px: Array, defocus_px: Array | float, lens_px: float) -> Array:
    """Width that the edge fit reports for the convolution of a straight path and a Gaussian.

    motion_px: standard deviation of the path across the edge.  A path alone is a ramp, not a Gaussian, so the fitted
    width is not exactly the root of the summed variances; the ratio of the two is tabulated by fitting such profiles.
    """
    still = np.hypot(defocus_px, lens_px)
    return np.hypot(motion_px, still) * np.interp(motion_px / still, _RATIOS, _shape_table())


@lru_cache(maxsize=1)
def _shape_table() -> Array:
    """Fitted width over the root of the summed variances, for paths of _RATIOS times the Gaussian's width."""
    total, reach = 2.0, 9.0
    u = np.linspace(-reach, reach, round(2 * reach / STEP_PX) + 1)
    still = (total / np.hypot(1.0, _RATIOS))[:, None, None]
    path = _RATIOS[:, None, None] * still * np.sqrt(12.0) * ((np.arange(64) + 0.5) / 64 - 0.5)
    profiles = erf((u[:, None] - path) / (np.sqrt(2.0) * still)).mean(axis=-1)
    return fit_steps(profiles, reach)[1] / total


def path_tensors(
    stamp_s: Array, exposure_s: Array, points_px: Array, profile: CameraProfile, trajectory: Trajectory
) -> Array:
    """Covariance xx, xy, yy, px², (n, 3), of the blur path at points (n, 2) of frames with stamps and exposures (n,).

    Paths are computed at a few nodes over each frame; their covariance is a smooth function of image position.
    """
    nodes, inverse = _nodes(profile.width, profile.height)
    frames, number = np.unique(np.stack([stamp_s, exposure_s], axis=-1), axis=0, return_inverse=True)
    spread = node_tensors(nodes, frames[:, 0], frames[:, 1], profile, trajectory)
    coefficients = np.einsum("ij,fjk->fik", inverse, spread)
    basis = _monomials(points_px, profile.width, profile.height)
    return np.asarray(np.einsum("ni,nik->nk", basis, coefficients[number.ravel()]))


def node_tensors(
    nodes_px: Array, stamp_s: Array, exposure_s: Array, profile: CameraProfile, trajectory: Trajectory
) -> Array:
    """Covariance xx, xy, yy (f, n, 3) of the paths at pixels (n, 2) of frames (f,) over their rows' exposures."""
    frames = turning_camera(trajectory, profile).frames(stamp_s[:, None, None], exposure_s[:, None, None])
    instant, share = np.polynomial.legendre.leggauss(_INSTANTS)
    nodes_px = nodes_px[:, None]
    time_s = frames.row_time_s(nodes_px, 0.5 * (1 + instant))
    seen = seen_by_rows(frames, nodes_px, time_s, ROW_MIDDLE)
    weight = 0.5 * share[:, None]
    centred = seen - (weight * seen).sum(axis=-2, keepdims=True)
    x, y = centred[..., 0], centred[..., 1]
    return np.stack([x * x, x * y, y * y], axis=-1).swapaxes(-1, -2) @ weight[:, 0]


def across(tensors: Array, direction: Array) -> Array:
    """n' Σ n of tensors (..., 3) and directions (..., 2), not below 0."""
    x, y = direction[..., 0], direction[..., 1]
    return np.maximum(tensors[..., 0] * x * x + 2 * tensors[..., 1] * x * y + tensors[..., 2] * y * y, 0.0)


def transfers(ratios: SpectrumRatios, profile: CameraProfile, trajectory: Trajectory) -> Array:
    """|K|² of each tile's two frames and of those before them, averaged over each bin: (n, 2, MEMORY, b).

    A straight path has |K|² = (sin q / q)² with q² = 3 (2π)² f' Σ f.  Single precision is accurate to 1e-6, the
    measurement to about 1e-2.
    """
    points = np.broadcast_to(ratios.points_px[:, :, None], (len(ratios), 2, MEMORY, 2))
    tensors = path_tensors(
        ratios.stamp_s.ravel(), ratios.exposure_s.ravel(), points.reshape(-1, 2), profile, trajectory
    )
    frequency, weights = spectral_weights()
    x, y = frequency.T
    form = np.stack([x * x, 2 * x * y, y * y]) * (12 * np.pi**2)
    angle = np.sqrt(np.maximum(tensors.astype(np.float32) @ form.astype(np.float32), LEAST_ANGLE**2))
    amplitude = np.sin(angle) / angle
    seen = (amplitude * amplitude) @ weights.astype(np.float32)
    return np.maximum(seen, 1e-6).astype(float).reshape(len(ratios), 2, MEMORY, seen.shape[-1])


def predicted_ratios(ratios: SpectrumRatios, profile: CameraProfile, trajectory: Trajectory) -> Array:
    """log |K1|²/|K2|² of the frames themselves and of those before them: (n, b, MEMORY)."""
    logs = np.log(transfers(ratios, profile, trajectory))
    return np.moveaxis(logs[:, 0] - logs[:, 1], 1, 2)


@lru_cache(maxsize=4)
def _nodes(width: int, height: int) -> tuple[Array, Array]:
    """Nodes (n, 2), and the matrix that maps values there to coefficients of :func:`_monomials`."""
    part = (np.arange(_NODES) + 0.5) / _NODES
    points = np.stack(np.meshgrid(part * width, part * height), -1).reshape(-1, 2)
    return points, np.asarray(np.linalg.pinv(_monomials(points, width, height)), float)


def _monomials(points: Array, width: int, height: int) -> Array:
    x, y = points[:, 0] / width - 0.5, points[:, 1] / height - 0.5
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1)
