"""Blur paths and kernels (eqs 3, 12-18; forward_model, sections 5 and 6).

The sharp picture f that restoration estimates shows each row at its *anchor*, a fixed fraction of its exposure.
Pixel p integrates f along its blur path during the row's exposure:  g(p) = mean over t of f(p + d(p, t)).
A kernel is that path splatted onto the pixel grid; g is the *correlation* of f with it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from virest.arrays import Array, Index
from virest.image_formation.light import defocus_px, flicker
from virest.image_formation.row_clock import ROW_END, ROW_START
from virest.image_formation.row_motion import RowMotion
from virest.image_formation.warp import PIXELS_WITHIN_PX, moved_between, seen_by_rows

SAMPLES_PER_PX, MIN_SAMPLES = 2.0, 16
"""Samples along a path, per pixel and at least.  Spectra of curved kernels of 1 to 30 px err by up to 0.4 %; with
half or twice as many samples per pixel by 0.7 or 0.1 %, with half or twice the minimum by 0.5 or 0.2 %."""
NODE_STEP_S = 2e-3
"""Spacing of a path's computed instants, with a cubic spline between: errs by 0.7 % of a vibration at 100 Hz."""
MIN_NODES = 8
"""Nodes of exposures up to 14 ms: half or twice as many change restored frames of 10 ms by 0.01 grey levels (rms)."""
ACROSS_PX, MIN_KNOTS = 160, 5
"""Knots of splines over the picture: largest spacing in pixels, and smallest number along each side."""


@dataclass(frozen=True, slots=True)
class KernelField:
    """One blur kernel per tile."""

    centres_px: Array
    """(n, 2) pixels at which each kernel is exact."""
    paths_px: Array
    """(n, m, 2) displacement d into the anchored picture, at m instants evenly spaced over the exposure."""
    anchor: float
    """Fraction of the exposure at which the sharp picture shows each row."""
    light: Array | None = None
    """(n, m) relative brightness of the light at those instants; None: constant."""
    defocus_sigma_px: Array | float = 0.0
    """Standard deviation of an additional Gaussian, (n,) or common to all."""

    @property
    def radius_px(self) -> int:
        """Half size of an array that holds any of the kernels with its splatting margin."""
        reach_px = np.abs(self.paths_px).max(initial=0.0) + 3.5 * np.max(self.defocus_sigma_px, initial=0.0)
        return int(np.ceil(reach_px)) + 2

    @property
    def length_px(self) -> Array:
        """(n,) arc length of each path."""
        return np.linalg.norm(np.diff(self.paths_px, axis=1), axis=-1).sum(axis=1)

    def arrays(self, radius_px: int | None = None, positive: bool = False) -> NDArray[np.float32]:
        """Kernels (n, 2r + 1, 2r + 1), each summing to 1, indexed [row, column] with d = 0 in the middle.

        Splatted by cubic convolution (Keys 1981, doi:10.1109/TASSP.1981.1163711), whose spectrum stays flat where
        bilinear splatting would blur by another 0.4 px; ``positive`` uses bilinear splatting, for methods that need
        non-negative kernels.
        """
        taps = _linear_taps if positive else _cubic_taps
        kernels = splat_paths(self.paths_px, radius_px or self.radius_px, taps, self.light)
        return _defocused(kernels, self.defocus_sigma_px) if np.any(self.defocus_sigma_px) else kernels

    def chosen(self, numbers: Index) -> KernelField:
        """The field of some of the tiles."""
        light = None if self.light is None else self.light[numbers]
        sigma_px = np.broadcast_to(self.defocus_sigma_px, len(self.paths_px))[numbers]
        centres_px, paths_px = self.centres_px[numbers], self.paths_px[numbers]
        return replace(self, centres_px=centres_px, paths_px=paths_px, light=light, defocus_sigma_px=sigma_px)

    def scaled(self, scale: float) -> KernelField:
        """The same blur in a picture that is ``scale`` times as large; the centres are unchanged."""
        return replace(self, paths_px=self.paths_px * scale, defocus_sigma_px=self.defocus_sigma_px * scale)


def kernel_field(motion: RowMotion, centres_px: Array, anchor: float = 0.5) -> KernelField:
    """Blur paths of tiles centred at pixels (n, 2), with the rows' own times in both pictures."""
    return field_along(motion, centres_px, _path_nodes(motion, centres_px, anchor), anchor)


def smooth_field(motion: RowMotion, anchor: float = 0.5) -> Callable[[Array], KernelField]:
    """Like :func:`kernel_field` for any centres inside the picture, with paths interpolated by splines.

    With relief, paths change at depth edges, where splines would oscillate: each path is then computed.
    """
    if motion.translation is not None and motion.translation.relief is not None:
        return lambda centres_px: kernel_field(motion, centres_px, anchor)
    at = splined_nodes(motion, lambda centres_px: _path_nodes(motion, centres_px, anchor))
    return lambda centres_px: field_along(motion, centres_px, at(centres_px), anchor)


def splined_nodes(motion: RowMotion, nodes: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """Path nodes (n, k, 2) for any centres (n, 2) inside the picture, by splines over a few computed ones.

    A knot for every ACROSS_PX pixels, and for every NODE_STEP_S of the readout.
    """
    profile = motion.profile
    least = [-(-length // ACROSS_PX) + 1 for length in (profile.width, profile.height)]
    along = 0 if profile.shutter.reads_columns else 1
    least[along] = max(least[along], int(np.ceil(motion.readout_time_s / NODE_STEP_S)) + 1)
    across, down = (_spline(n, max(k, MIN_KNOTS)) for n, k in zip((profile.width, profile.height), least, strict=True))
    at_knots = nodes(np.stack(np.meshgrid(across.x, down.x), -1).reshape(-1, 2))
    flat = at_knots.reshape(len(at_knots), -1)

    def splined(centres_px: Array) -> Array:
        x, y = across(centres_px[:, 0]), down(centres_px[:, 1])
        weights = (y[:, :, None] * x[:, None, :]).reshape(len(centres_px), -1)
        return np.asarray((weights @ flat).reshape(len(centres_px), *at_knots.shape[1:]))

    return splined


def instants(motion: RowMotion, points_px: Array) -> Array:
    """(n, k) evenly spaced instants, ends included, of the exposures of the rows through pixels (n, 2)."""
    count = max(MIN_NODES, int(np.ceil(motion.exposure_s / NODE_STEP_S)) + 1)
    return motion.row_time_s(points_px[:, None], np.linspace(0.0, 1.0, count))


def _path_nodes(motion: RowMotion, centres_px: Array, anchor: float) -> Array:
    """Displacements (n, k, 2) at evenly spaced instants of the exposure, ends included: a spline's nodes."""
    gathered_s = instants(motion, centres_px)
    points = np.broadcast_to(centres_px[:, None], (*gathered_s.shape, 2))
    return seen_by_rows(motion, points, gathered_s, anchor, PIXELS_WITHIN_PX) - points


def field_along(motion: RowMotion, centres_px: Array, nodes_px: Array, anchor: float) -> KernelField:
    """Kernels along given path nodes (n, k, 2) of :func:`instants`; flicker and defocus are the profile's."""
    length = np.linalg.norm(np.diff(nodes_px, axis=1), axis=-1).sum(axis=1).max(initial=0.0)
    samples = max(MIN_SAMPLES, int(np.ceil(SAMPLES_PER_PX * 1.3 * length)))
    paths_px = _between(nodes_px.shape[1], samples) @ nodes_px
    light, sigma_px = _light(motion, centres_px, samples), defocus_px(motion.profile, centres_px)
    return KernelField(centres_px, paths_px, anchor, light, sigma_px)


@lru_cache(maxsize=8)
def _spline(length: int, knots: int) -> CubicSpline:
    """Weights of evenly spaced knots from the first pixel to the last, as functions of the position."""
    return CubicSpline(np.linspace(0.0, length - 1.0, knots), np.eye(knots))


def _light(motion: RowMotion, centres_px: Array, samples: int) -> Array | None:
    """Flicker (n, samples) over equal pieces of the exposure of the rows through pixels (n, 2); None without."""
    if not motion.profile.extensions.flicker_amplitude:
        return None
    middles_s = motion.row_time_s(centres_px[:, None], (np.arange(samples) + 0.5) / samples)
    return flicker(motion.profile, middles_s, motion.exposure_s / samples)


@lru_cache(maxsize=64)
def _between(count: int, samples: int) -> Array:
    """Weights (samples, count) of a cubic spline's evenly spaced nodes at the middles of ``samples`` equal pieces."""
    middles = (np.arange(samples) + 0.5) / samples
    return np.asarray(CubicSpline(np.linspace(0.0, 1.0, count), np.eye(count))(middles))


def blur_chords(motion: RowMotion, points_px: Array) -> Array:
    """Motion (n, 2) in pixels of image points over the exposure of their own rows, start to end (eqs 12-14).

    Its angle and length are the paper's degradation parameters (eqs 15, 16); see :func:`angle_and_length`.
    """
    start_s, end_s = (motion.row_time_s(points_px, share) for share in (ROW_START, ROW_END))
    return moved_between(motion, points_px, start_s, end_s) - points_px


def angle_and_length(chords_px: Array) -> tuple[Array, Array]:
    """Angle in (−π, π], x right and y down, and length in pixels of chords (..., 2) (eqs 15, 16)."""
    angle = np.arctan2(chords_px[..., 1], chords_px[..., 0])
    return np.where(angle <= -np.pi, np.pi, angle), np.linalg.norm(chords_px, axis=-1)


def splat_paths(paths_px: Array, radius_px: int, taps: Any, light: Array | None = None) -> NDArray[np.float32]:
    """Splat paths (n, m, 2), with the light (n, m) at their instants, into arrays (n, 2r + 1, 2r + 1) of sum 1."""
    count, samples, _ = paths_px.shape
    size = 2 * radius_px + 1
    base = np.floor(paths_px).astype(np.intp)
    offsets, wx = taps(paths_px[..., 0] - base[..., 0])
    _, wy = taps(paths_px[..., 1] - base[..., 1])
    columns = np.clip(base[..., 0, None] + offsets + radius_px, 0, size - 1)
    rows = np.clip(base[..., 1, None] + offsets + radius_px, 0, size - 1)
    flat = (np.arange(count)[:, None, None, None] * size + rows[..., :, None]) * size + columns[..., None, :]
    weights = wy[..., :, None] * wx[..., None, :] / samples
    if light is not None:
        weights *= (light / light.mean(axis=1, keepdims=True))[..., None, None]
    kernels = np.bincount(flat.ravel(), weights.ravel(), count * size * size)
    return kernels.reshape(count, size, size).astype(np.float32)


def _defocused(kernels: NDArray[np.float32], sigma_px: Array | float) -> NDArray[np.float32]:
    """Kernels (n, k, k) convolved with Gaussians of (n,) or one common size, zero outside the arrays."""
    blurred = [
        cv2.GaussianBlur(kernel, (0, 0), float(sigma), borderType=cv2.BORDER_CONSTANT) if sigma else kernel
        for kernel, sigma in zip(kernels, np.broadcast_to(sigma_px, len(kernels)), strict=True)
    ]
    sums = [k.sum() for k in blurred]
    return np.stack([k / s for k, s in zip(blurred, sums, strict=True)])


def _linear_taps(part: Array) -> tuple[Index, Array]:
    return np.arange(0, 2), np.stack([1 - part, part], -1)


def _cubic_taps(part: Array) -> tuple[Index, Array]:
    rest = 1 - part
    weights = [
        -0.5 * part * rest**2,
        1 + part**2 * (1.5 * part - 2.5),
        1 + rest**2 * (1.5 * rest - 2.5),
        -0.5 * rest * part**2,
    ]
    return np.arange(-1, 3), np.stack(weights, -1)
