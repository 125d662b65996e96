"""Tiles of reduced frames in the Fourier domain: cut out, blurred, shifted, and registered by phase.

Two tiles of one scene under the same blur differ by a shift.  It is estimated as the one that aligns the phases of
their spectra (Kuglin & Hines 1975), from low to high frequencies.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from virest.arrays import Array, Index
from virest.image_formation.blur import Image
from virest.image_formation.kernels import KernelField

TILE = 64
"""Side of a compared tile, reduced pixels."""
SHORT_SIDE = 400
"""Pictures are halved until their shorter side is below this; shifts are then known to a tenth of a recorded pixel."""
AROUND = TILE // 4
"""Margin of a tile for blurring, reduced pixels: half of the longest path that is compared."""
WIDE = TILE + 2 * AROUND
"""Side of a tile with its margins."""
INNER = slice(AROUND, AROUND + TILE)
MOST_TILES = 16
"""Tiles of a frame that are compared: half as many change restored frames of 320 × 240 px by 0.4 grey levels (rms)."""
CUTOFFS = (0.06, 0.12, 0.2, 0.25)
"""Highest frequencies of the successive fits, cycles per pixel: the first allows shifts of 4 px without phase wrap."""
RIVAL_PEAK = 0.8
"""Among correlation peaks of at least this fraction of the highest, the one nearest to the prediction is used: periodic
texture has many."""
LEAST_COHERENCE = 0.5
"""Tiles with a lower coherence, Σ|A||B| cos(phase residual) over Σ|A||B|, show different content."""


def reduction(height: int, width: int) -> int:
    """How many times smaller the compared pictures are."""
    times = 1
    while min(height, width) / times >= SHORT_SIDE:
        times *= 2
    return times


def reduced_light(luma: NDArray[np.uint8], light: NDArray[np.float32]) -> Image:
    """A frame's luma (height, width), reduced, in linear light by a table (256,)."""
    return cv2.LUT(reduced(luma), light)


def reduced(picture: NDArray[Any]) -> NDArray[Any]:
    """A picture (height, width) reduced to the size for comparison; excess rows and columns are cut off."""
    times = reduction(*picture.shape)
    height, width = (length // times for length in picture.shape)
    return cv2.resize(picture[: times * height, : times * width], (width, height), interpolation=cv2.INTER_AREA)


def shifted(spectra: NDArray[np.complex64], shift: Array) -> NDArray[np.complex64]:
    """Spectra (n, side, side / 2 + 1) of tiles moved by ``shift`` (n, 2), px: f(x + shift)."""
    along, down = (
        np.exp(2j * np.pi * d[:, None] * f).astype(np.complex64)
        for d, f in zip(shift.T, _axes(spectra.shape[1]), strict=True)
    )
    return np.asarray(spectra * along[:, None, :] * down[:, :, None])


def power_of(spectra: NDArray[np.complex64]) -> NDArray[np.float32]:
    """|S|² of spectra."""
    return spectra.real**2 + spectra.imag**2


def spread_tiles(height: int, width: int, most: int = MOST_TILES) -> Index:
    """(n, 2) top and left of at most ``most`` tiles, evenly spaced over a picture; none if it is smaller than a tile.

    With ``most`` above MOST_TILES, tiles overlap where needed to cover the picture completely.
    """
    if min(height, width) < TILE:
        return np.zeros((0, 2), np.intp)
    tops, lefts = (
        np.linspace(0, length - TILE, -(-length // TILE) if most > MOST_TILES else length // TILE).astype(np.intp)
        for length in (height, width)
    )
    corners = np.stack(np.meshgrid(tops, lefts, indexing="ij"), -1).reshape(-1, 2)
    chosen = np.unique(np.linspace(0, len(corners) - 1, min(len(corners), most)).round().astype(np.intp))
    return np.asarray(corners[chosen])


def full_px(tops_lefts: Index, times: int, at: float) -> Array:
    """(n, 2) x, y in the recorded picture of the point ``at`` rows and columns into each reduced tile."""
    return np.asarray((tops_lefts[:, ::-1] + at + 0.5) * times - 0.5)


def kernel_spectra(
    field: Callable[[Array], KernelField], tops_lefts: Index, times: int
) -> NDArray[np.complex64] | None:
    """Spectra of the transposed kernels at tiles' centres, (n, WIDE, WIDE / 2 + 1); a product applies the blur.

    None if a path does not fit into half a tile, or if there are no tiles.
    """
    if not len(tops_lefts):
        return None
    kernels = field(full_px(tops_lefts, times, (TILE - 1) / 2)).scaled(1 / times)
    radius = kernels.radius_px
    if 2 * radius + 1 > TILE // 2:
        return None
    along, down = (np.exp(2j * np.pi * radius * f).astype(np.complex64) for f in _axes(WIDE))
    rows = fft.rfft(kernels.arrays()[:, ::-1, ::-1], WIDE, axis=2) * along  # the transpose, centred at 0
    return np.asarray(fft.fft(rows, WIDE, axis=1) * down[:, None])


def cut(picture: NDArray[Any], tops_lefts: Index, side: int = TILE) -> NDArray[Any]:
    """Tiles (n, side, side) of a picture."""
    return np.stack([picture[top : top + side, left : left + side] for top, left in tops_lefts.tolist()])


def wide_spectra(picture: Image, tops_lefts: Index) -> NDArray[np.complex64]:
    """Spectra (n, WIDE, WIDE / 2 + 1) of tiles with their margins; the picture is mirrored at its edges."""
    padded = cv2.copyMakeBorder(picture, AROUND, AROUND, AROUND, AROUND, cv2.BORDER_REFLECT_101)
    return np.asarray(fft.rfft2(cut(padded, tops_lefts, WIDE)))


def inner(wide: NDArray[np.complex64]) -> Image:
    """Tiles (n, TILE, TILE) from their wide spectra (n, WIDE, WIDE / 2 + 1)."""
    rows = fft.ifft(wide, axis=1)[:, INNER]
    return np.asarray(fft.irfft(rows, WIDE, axis=2)[:, :, INNER])


def read_at(picture: Image, source: NDArray[np.float32]) -> Image:
    """A reduced picture resampled by a map (h, w, 2); its edges are replicated."""
    return cv2.remap(picture, source, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def spectra_of(tiles: Image, seen: Image | None = None, *, masked: bool = False) -> NDArray[np.complex64]:
    """Spectra (n, TILE, TILE / 2 + 1) of tiles under a Hann window, divided by their mean, minus 1.

    The division removes brightness changes.  seen: (n, TILE, TILE) weights for the mean; None: all 1.  masked: weigh
    the deviations from the mean by them too.
    """
    window = _window()
    weight = np.broadcast_to(window, tiles.shape) if seen is None else window * seen
    total = np.maximum(weight.sum(axis=(1, 2)), 1e-6)
    means = (np.einsum("nij,nij->n", tiles, weight) / total)[:, None, None]
    return np.asarray(fft.rfft2((tiles / np.maximum(means, 1e-3) - 1) * (weight if masked else window)))


@lru_cache(maxsize=1)
def _window() -> Image:
    hann = np.hanning(TILE + 2)[1:-1]
    return np.outer(hann, hann).astype(np.float32)


def _axes(side: int = TILE) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Horizontal and vertical frequencies of half a spectrum (side, side / 2 + 1), cycles per pixel."""
    return np.fft.rfftfreq(side).astype(np.float32), np.fft.fftfreq(side).astype(np.float32)


@lru_cache(maxsize=2)
def radii(side: int = TILE) -> Array:
    """Radial frequency over half a spectrum (side, side / 2 + 1), cycles per pixel."""
    return np.hypot(*np.meshgrid(np.fft.rfftfreq(side), np.fft.fftfreq(side)))


@lru_cache(maxsize=1)
def _fitted_phases() -> tuple[Index, NDArray[np.float32], tuple[int, ...]]:
    """Flat indices into half a spectrum of the m phases to fit, by increasing frequency, and 2π f there, (2, m).

    The third: how many of them lie below each of CUTOFFS.
    """
    radius = radii().ravel()
    order = np.argsort(radius, kind="stable")
    order = order[(radius[order] > 1 / TILE) & (radius[order] <= CUTOFFS[-1])]
    waves = 2 * np.pi * np.stack([f.ravel()[order] for f in np.meshgrid(*_axes())]).astype(np.float32)
    return order, waves, tuple(int(n) for n in np.searchsorted(radius[order], CUTOFFS, side="right"))


def common_shift(a: NDArray[np.complex64], b: NDArray[np.complex64]) -> Array:
    """Shift d (2,) with b(x) ≈ a(x + d) for most tiles: the peak of their summed phase correlation, integer pixels."""
    product = np.conj(a) * b
    surface = fft.irfft2((product / np.sqrt(np.abs(product) + 1e-12)).sum(axis=0), (TILE, TILE))
    rows, columns = np.nonzero(surface >= RIVAL_PEAK * surface.max())
    shifts = -np.stack([columns, rows], -1).astype(float)
    shifts[shifts < -TILE // 2] += TILE
    return np.asarray(shifts[np.argmin(np.linalg.norm(shifts, axis=1))])


def tile_shifts(a: NDArray[np.complex64], b: NDArray[np.complex64], start_px: Array) -> tuple[Array, Array]:
    """Shifts (n, 2) of tiles and their precision (n,), 1 / px², from the phases' scatter; 0: different content."""
    indices, waves, counts = _fitted_phases()
    product = np.conj(a.reshape(len(a), -1)[:, indices]) * b.reshape(len(b), -1)[:, indices]
    size, phase, shift = np.abs(product), np.angle(product), np.tile(start_px, (len(a), 1))
    squares = np.stack([waves[0] ** 2, waves[0] * waves[1], waves[1] ** 2], -1)
    for count in counts:
        left = _phase_residual(phase[:, :count], shift, waves[:, :count])
        weight = size[:, :count] * np.maximum(np.cos(left), 0)
        xx, xy, yy = (weight @ squares[:count]).T.astype(float)
        x, y = ((weight * left) @ waves[:, :count].T).T.astype(float)
        determinant = np.maximum(xx * yy - xy * xy, 1e-3 * (xx + yy) ** 2 + 1e-20)
        shift += np.stack([(yy * x - xy * y) / determinant, (xx * y - xy * x) / determinant], -1)
    total = np.maximum(size.sum(axis=1, dtype=float), 1e-20)
    coherence = (size * np.cos(_phase_residual(phase, shift, waves))).sum(axis=1, dtype=float) / total
    scatter = np.maximum(1 - coherence**2, 1e-4) / np.maximum(coherence**2, 1e-4)
    narrow = determinant / np.maximum(xx + yy, 1e-20) / total
    return shift, np.where(coherence > LEAST_COHERENCE, narrow / scatter, 0.0)


def _phase_residual(phase: NDArray[np.float32], shift: Array, waves: NDArray[np.float32]) -> NDArray[np.float32]:
    """Phase residuals (n, m) after shifts (n, 2), wrapped to ± π."""
    left = phase - shift.astype(np.float32) @ waves
    return np.asarray(left - np.float32(2 * np.pi) * np.rint(left * np.float32(0.5 / np.pi)), np.float32)
