"""Blur paths and kernels (eqs 3, 12-18; forward_model, sections 5 and 6).

The sharp picture f that restoration looks for shows each row at its *anchor*, a fixed part of its own exposure.
What pixel p gathers during its row's exposure lies in f along a path:  g(p) = mean over t of f(p + d(p, t)).
A kernel is that path splatted onto the pixel grid; g is the *correlation* of f with it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest.degradation.row_motion import RowMotion
from virest.degradation.warp import moved_between, seen_by_rows

Array = NDArray[np.float64]
SAMPLES_PER_PX = 2.0
MIN_SAMPLES = 16


@dataclass(frozen=True, slots=True)
class KernelField:
    """One blur kernel per tile."""

    centres_px: Array
    """(n, 2) where each kernel holds exactly."""
    paths_px: Array
    """(n, m, 2) displacement d into the anchored picture, at m instants evenly over the exposure."""
    anchor: float
    """Part of the exposure that the sharp picture shows."""

    @property
    def radius_px(self) -> int:
        """Half size of an array that holds every kernel with its splatting margin."""
        return int(np.ceil(np.abs(self.paths_px).max(initial=0.0))) + 2

    @property
    def length_px(self) -> Array:
        """(n,) length of each path, along it."""
        return np.linalg.norm(np.diff(self.paths_px, axis=1), axis=-1).sum(axis=1)

    def arrays(self, radius_px: int | None = None, positive: bool = False) -> NDArray[np.float32]:
        """Kernels (n, 2r + 1, 2r + 1), each summing to 1, indexed [row, column] with d = 0 in the middle.

        Splatted by cubic convolution (Keys 1981, doi:10.1109/TASSP.1981.1163711), whose spectrum stays flat where
        bilinear splatting would blur by another 0.4 px; ``positive`` takes the bilinear one, for methods that need it.
        """
        return splat_paths(self.paths_px, radius_px or self.radius_px, _linear_taps if positive else _cubic_taps)


def kernel_field(motion: RowMotion, centres_px: Array, anchor: float = 0.5, inverse_depth: Any = 0.0) -> KernelField:
    """Blur paths of the tiles centred at pixels (n, 2), exact to the rows' own times on both sides."""
    chord = np.linalg.norm(blur_chords(motion, centres_px, inverse_depth), axis=-1).max(initial=0.0)
    samples = max(MIN_SAMPLES, int(np.ceil(SAMPLES_PER_PX * 1.3 * chord)))
    part = (np.arange(samples) + 0.5) / samples
    gathered_s = motion.row_start_s(centres_px)[:, None] + part * motion.exposure_s
    points = np.broadcast_to(centres_px[:, None], (len(centres_px), samples, 2))
    depth = np.broadcast_to(np.asarray(inverse_depth, float)[..., None], gathered_s.shape)
    return KernelField(centres_px, seen_by_rows(motion, points, gathered_s, anchor, depth) - points, anchor)


def blur_chords(motion: RowMotion, points_px: Array, inverse_depth: Any = 0.0) -> Array:
    """Motion (n, 2) in pixels of image points over the exposure of their own rows, start to end (eqs 12-14).

    Its angle and length are the paper's degradation parameters (eqs 15, 16); see :func:`angle_and_length`.
    """
    start_s = motion.row_start_s(points_px)
    return moved_between(motion, points_px, start_s, start_s + motion.exposure_s, inverse_depth) - points_px


def angle_and_length(chords_px: Array) -> tuple[Array, Array]:
    """Angle in (−π, π], x right and y down, and length in pixels of chords (..., 2) (eqs 15, 16)."""
    angle = np.arctan2(chords_px[..., 1], chords_px[..., 0])
    return np.where(angle <= -np.pi, np.pi, angle), np.linalg.norm(chords_px, axis=-1)


def splat_paths(paths_px: Array, radius_px: int, taps: Any) -> NDArray[np.float32]:
    """Paths (n, m, 2) as arrays (n, 2r + 1, 2r + 1) whose sums are 1."""
    count, samples, _ = paths_px.shape
    size = 2 * radius_px + 1
    base = np.floor(paths_px).astype(np.intp)
    offsets, wx = taps(paths_px[..., 0] - base[..., 0])
    _, wy = taps(paths_px[..., 1] - base[..., 1])
    columns = np.clip(base[..., 0, None] + offsets + radius_px, 0, size - 1)
    rows = np.clip(base[..., 1, None] + offsets + radius_px, 0, size - 1)
    flat = (np.arange(count)[:, None, None, None] * size + rows[..., :, None]) * size + columns[..., None, :]
    weights = wy[..., :, None] * wx[..., None, :] / samples
    kernels = np.bincount(flat.ravel(), weights.ravel(), count * size * size)
    return kernels.reshape(count, size, size).astype(np.float32)


def _linear_taps(part: Array) -> tuple[NDArray[np.intp], Array]:
    return np.arange(0, 2), np.stack([1 - part, part], -1)


def _cubic_taps(part: Array) -> tuple[NDArray[np.intp], Array]:
    rest = 1 - part
    weights = [
        -0.5 * part * rest**2,
        1 + part**2 * (1.5 * part - 2.5),
        1 + rest**2 * (1.5 * rest - 2.5),
        -0.5 * rest * part**2,
    ]
    return np.arange(-1, 3), np.stack(weights, -1)
