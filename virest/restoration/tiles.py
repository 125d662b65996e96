"""Deconvolution tile by tile in the Fourier domain.

A tile is a window of the picture with a margin around it, closed to a period by a smooth bridge, so that nothing rings
in from a border that is not there.  Its spectrum is kept in OpenCV's packed form, real and imaginary parts side by
side, so real filters are plain products.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import cv2
import numpy as np

from virest.degradation.blur import Image, TileGrid, fast_size

Filter = Callable[[Image], Image]
"""Turns a kernel's power spectrum |K|² (packed, real parts doubled) into the real factor that follows conj(K)."""


class TileDeconvolution:
    """Windows, margins and kernels of one picture, ready to filter any number of its channels."""

    def __init__(self, grid: TileGrid, kernels: Image, margin: int) -> None:
        self.grid = grid
        self.margin = margin = max(margin, kernels.shape[1] // 2 + 1)
        self.patch = grid.side + 2 * margin
        self.size = fast_size(self.patch + max(8, self.patch // 16))
        self.at_border = [
            top < margin
            or left < margin
            or top + grid.side > grid.height - margin
            or left + grid.side > grid.width - margin
            for top, left in grid.corners()
        ]
        self._windows = grid.windows()
        self._bridge = _bridge(self.size - self.patch)
        self._kernels = [self._kernel_spectrum(kernel) for kernel in kernels]
        self.powers = [doubled(cv2.mulSpectrums(k, k, 0, conjB=True)) for k in self._kernels]

    def filters(self, make: Filter, at_border: Filter | None = None) -> list[Image]:
        """The packed real factor of each tile; ``at_border`` makes those of tiles that see beyond the picture."""
        return [
            (at_border or make)(power) if border else make(power)
            for power, border in zip(self.powers, self.at_border, strict=True)
        ]

    def back_projected(self, channel: Image) -> list[Image]:
        """Spectrum of Kᵀ g for each tile; channel (height, width) is extended, never wrapped."""
        padded = self.padded(channel)
        return [
            cv2.mulSpectrums(cv2.dft(self.periodic(padded, top, left)), spectrum, 0, conjB=False)
            for (top, left), spectrum in zip(self.grid.corners(), self._kernels, strict=True)
        ]

    def blend(self, spectra: list[Image]) -> Image:
        """Tiles back into one picture (height, width), through the windows."""
        grid, side, margin = self.grid, self.grid.side, self.margin
        result = np.zeros((grid.tops[-1] + side, grid.lefts[-1] + side), np.float32)
        for (top, left), window, spectrum in zip(grid.corners(), self._windows, spectra, strict=True):
            tile = cv2.idft(spectrum, flags=cv2.DFT_SCALE)[margin : margin + side, margin : margin + side]
            cv2.accumulateProduct(window, tile, result[top : top + side, left : left + side])
        return result[: grid.height, : grid.width]

    def padded(self, channel: Image, border: int = cv2.BORDER_REPLICATE) -> Image:
        """The channel with the margin that the outermost tiles need."""
        grid, margin = self.grid, self.margin
        below = grid.tops[-1] + grid.side + margin - grid.height
        right = grid.lefts[-1] + grid.side + margin - grid.width
        return cv2.copyMakeBorder(channel, margin, below, margin, right, border)

    def periodic(self, padded: Image, top: int, left: int) -> Image:
        """One tile with its margin, bridged from each edge to the opposite one, (size, size)."""
        patch = self.patch
        tile = np.empty((self.size, self.size), np.float32)
        tile[:patch, :patch] = padded[top : top + patch, left : left + patch]
        bridge = self._bridge
        tile[:patch, patch:] = np.outer(tile[:patch, patch - 1], 1 - bridge) + np.outer(tile[:patch, 0], bridge)
        tile[patch:] = np.outer(1 - bridge, tile[patch - 1]) + np.outer(bridge, tile[0])
        return tile

    def _kernel_spectrum(self, kernel: Image) -> Image:
        """Spectrum of the *flipped* use: conj, so that mulSpectrums applies the transpose of a correlation."""
        radius = kernel.shape[0] // 2
        buffer = np.zeros((self.size, self.size), np.float32)
        buffer[: kernel.shape[0], : kernel.shape[1]] = kernel
        return cv2.dft(np.roll(buffer, (-radius, -radius), (0, 1)))


def _bridge(length: int) -> Image:
    rise = (np.arange(length, dtype=np.float32) + 1) / (length + 1)
    return (rise * rise * (3 - 2 * rise)).astype(np.float32)


def doubled(packed: Image) -> Image:
    """Copy the real parts of a packed spectrum onto its imaginary places: a real factor for packed spectra.

    OpenCV's packing: column 0 and the last hold their real and imaginary parts in alternate rows, all others in
    alternate columns; the corners are real.  Sizes are even.
    """
    packed[:, 2:-1:2] = packed[:, 1:-2:2]
    packed[2:-1:2, 0] = packed[1:-2:2, 0]
    packed[2:-1:2, -1] = packed[1:-2:2, -1]
    return packed


@lru_cache(maxsize=8)
def gradient_power(size: int) -> Image:
    """|Dx|² + |Dy|² of forward differences, as a packed real factor (size, size)."""
    frequency = 4 * np.sin(np.pi * np.arange(size) / size) ** 2
    index = (np.arange(size) + 1) // 2
    packed = frequency[np.arange(size)][:, None] + frequency[index][None, :]
    packed[:, 0] = frequency[index]
    packed[:, -1] = frequency[index] + frequency[size // 2]
    return packed.astype(np.float32)


def inverse_filter(power: Image, floor: float = 1e-3) -> Image:
    """1 / |K|², held where |K| falls below the square root of ``floor``: the naive inverse, for comparison."""
    return (1.0 / np.maximum(power, floor)).astype(np.float32)


def wiener_filter(power: Image, noise_to_signal: Image) -> Image:
    """1 / (|K|² + N/S), with the noise-to-signal ratio at each place of the packed spectrum."""
    return 1.0 / (power + noise_to_signal)
