"""The space-variant blur as an operator: forward and adjoint (Hirsch et al. 2010, doi:10.1109/CVPR.2010.5540158).

g = Σ_r w_r · (k_r ⋆ f): every tile correlates the sharp picture with its own kernel, and windows w_r that sum to one
blend the results.  f is larger than g by a border on every side, so there is no wrap-around and no assumption about the
scene outside the picture: it stays unknown.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.image_formation import transforms

Image = NDArray[np.float32]
FAST_SIZES = (64, 80, 96, 128, 144, 160, 176, 192, 240, 256, 288, 320, 384, 480, 512, 640, 768, 1024)
"""Sides of square tiles whose transform is fast: from 96 px on at most 1.4 ns a pixel, while the other sizes that
``cv2.getOptimalDFTSize`` returns up to 640 px take 1.2 to 3.2 ns."""


@dataclass(frozen=True, slots=True)
class TileGrid:
    """Overlapping tiles over a picture, with windows that sum to one."""

    height: int
    width: int
    tops: tuple[int, ...]
    """First row of each row of tiles."""
    lefts: tuple[int, ...]
    """First column of each column of tiles."""
    side: int
    """Rows and columns of a tile's window."""
    overlap: int

    @property
    def centres_px(self) -> Array:
        """(n, 2) middle of each tile's window, x then y, clipped to the picture."""
        x, y = np.meshgrid(np.array(self.lefts) + (self.side - 1) / 2, np.array(self.tops) + (self.side - 1) / 2)
        return np.stack([np.clip(x, 0, self.width - 1), np.clip(y, 0, self.height - 1)], -1).reshape(-1, 2)

    def corners(self) -> Iterator[tuple[int, int]]:
        """(top, left) of each tile, in the order of centres_px."""
        return ((top, left) for top in self.tops for left in self.lefts)

    def windows(self) -> list[Image]:
        """Window (side, side) of each tile: ramps over the overlaps, 1 at the picture's own edges."""
        return _windows(self)


@lru_cache(maxsize=24)
def _windows(grid: TileGrid) -> list[Image]:
    """Shared by all frames of a movie, with one array for identical windows; treat as read-only."""
    rows = _ramps(grid.tops, grid.side, grid.overlap)
    columns = _ramps(grid.lefts, grid.side, grid.overlap)
    windows: dict[tuple[bytes, bytes], Image] = {}
    for r in rows:
        for c in columns:
            if (r.tobytes(), c.tobytes()) not in windows:
                windows[r.tobytes(), c.tobytes()] = np.outer(r, c).astype(np.float32)
    return [windows[r.tobytes(), c.tobytes()] for r in rows for c in columns]


def tile_grid(height: int, width: int, side: int, overlap: int) -> TileGrid:
    """Cover a picture by tiles of ``side`` that overlap by ``overlap``; the last ones may extend beyond it."""
    step = side - overlap
    tops = tuple(range(0, max(height - overlap, 1), step))
    lefts = tuple(range(0, max(width - overlap, 1), step))
    return TileGrid(height, width, tops, lefts, side, overlap)


def _ramps(starts: tuple[int, ...], side: int, overlap: int) -> list[Array]:
    rise = (np.arange(overlap) + 0.5) / overlap
    smooth = rise * rise * (3 - 2 * rise)
    ramps = []
    for k in range(len(starts)):
        ramp = np.ones(side)
        if k > 0:
            ramp[:overlap] = smooth
        if k < len(starts) - 1:
            ramp[side - overlap :] = smooth[::-1]
        ramps.append(ramp)
    return ramps


def fast_size(at_least: int) -> int:
    """The next size at which the Fourier transform is fast."""
    return next((size for size in FAST_SIZES if size >= at_least), cv2.getOptimalDFTSize(at_least))


class SpaceVariantBlur:
    """g = Σ_r w_r · (k_r ⋆ f) and its adjoint, for float32 pictures.

    f: (height + 2 border, width + 2 border); g: (height, width).  One channel per call.
    """

    def __init__(self, grid: TileGrid, kernels: Image) -> None:
        self.grid = grid
        self.border = kernels.shape[1] // 2
        self.latent_shape = (grid.height + 2 * self.border, grid.width + 2 * self.border)
        self._patch = grid.side + 2 * self.border
        self._size = fast_size(self._patch)
        self._windows = grid.windows()
        self._spectra = [self._spectrum(kernel) for kernel in kernels]
        self._transformed, self._moved = np.empty((2, self._size, self._size), np.float32)

    def apply(self, sharp: Image) -> Image:
        """Blur a sharp picture."""
        grid, side, patch, size = self.grid, self.grid.side, self._patch, self._size
        padded = self._padded(sharp, patch)
        blurred = np.zeros((grid.tops[-1] + side, grid.lefts[-1] + side), np.float32)
        buffer = np.zeros((size, size), np.float32)
        for (top, left), window, spectrum in zip(grid.corners(), self._windows, self._spectra, strict=True):
            buffer[:patch, :patch] = padded[top : top + patch, left : left + patch]
            moved = self._correlate(buffer, spectrum, conjugate=True)
            cv2.accumulateProduct(moved[:side, :side], window, blurred[top : top + side, left : left + side])
        return blurred[: grid.height, : grid.width]

    def adjoint(self, blurred: Image) -> Image:
        """The transpose of :meth:`apply`."""
        grid, side, patch, size = self.grid, self.grid.side, self._patch, self._size
        reach = (grid.tops[-1] + side, grid.lefts[-1] + side)
        padded = np.zeros(reach, np.float32)
        padded[: grid.height, : grid.width] = blurred
        spread = np.zeros((reach[0] + 2 * self.border, reach[1] + 2 * self.border), np.float32)
        buffer = np.zeros((size, size), np.float32)
        for (top, left), window, spectrum in zip(grid.corners(), self._windows, self._spectra, strict=True):
            np.multiply(window, padded[top : top + side, left : left + side], out=buffer[:side, :side])
            moved = self._correlate(buffer, spectrum, conjugate=False)
            cv2.accumulate(moved[:patch, :patch], spread[top : top + patch, left : left + patch])
        return spread[: self.latent_shape[0], : self.latent_shape[1]]

    def _padded(self, sharp: Image, patch: int) -> Image:
        rows = self.grid.tops[-1] + patch - sharp.shape[0]
        columns = self.grid.lefts[-1] + patch - sharp.shape[1]
        return np.pad(sharp, ((0, max(rows, 0)), (0, max(columns, 0))))

    def _spectrum(self, kernel: Image) -> Image:
        buffer = np.zeros((self._size, self._size), np.float32)
        buffer[: kernel.shape[0], : kernel.shape[1]] = kernel
        return transforms.forward(buffer)

    def _correlate(self, buffer: Image, spectrum: Image, conjugate: bool) -> Image:
        """The result is valid until the next call, which reuses its array."""
        transformed = transforms.forward(buffer, self._transformed)
        product = cv2.mulSpectrums(transformed, spectrum, 0, transformed, conjB=conjugate)
        return transforms.inverse(product, self._moved)
