"""Relief: inverse depth relative to a plane over one frame's picture, on a coarse grid with bilinear interpolation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array


@dataclass(frozen=True, slots=True)
class Relief:
    """Inverse depth relative to a plane over one frame's picture; camera axes at the frame's reference time."""

    low: Array
    """(2,) angles of the first node."""
    size: Array
    """(2,) angle from the first node to the last along x and y."""
    above_per_m: NDArray[np.float32]
    """(rows, columns) at the nodes; bilinear between them, constant beyond the outermost."""
    std_per_m: NDArray[np.float32]
    """(fewer rows, fewer columns) standard deviation over the same angles, without that of the metric scale."""

    def at(self, rays: Array) -> Array:
        """Inverse depth above the plane (...) along rays (..., 3)."""
        return self._between(self.above_per_m, rays)

    def std_at(self, rays: Array) -> Array:
        """Standard deviation (...) along rays (..., 3)."""
        return self._between(self.std_per_m, rays)

    def _between(self, values: NDArray[np.float32], rays: Array) -> Array:
        rows, columns = values.shape
        nodes = np.array([columns - 1, rows - 1])
        position = np.clip((angles(rays) - self.low) / self.size * nodes, 0.0, nodes - 1e-6)
        first = position.astype(np.intp)
        x, y = np.moveaxis(position - first, -1, 0)
        flat, start = values.ravel(), first[..., 1] * columns + first[..., 0]
        upper = flat[start] * (1 - x) + flat[start + 1] * x
        lower = flat[start + columns] * (1 - x) + flat[start + columns + 1] * x
        return np.asarray(upper * (1 - y) + lower * y)


def angles(rays: Array) -> Array:
    """Rays (..., 3) as angles from the optical axis along x and y, (..., 2): evenly spaced for wide lenses too."""
    side = np.linalg.norm(rays[..., :2], axis=-1)
    return np.asarray(rays[..., :2] * (np.arctan2(side, rays[..., 2]) / np.maximum(side, 1e-12))[..., None])
