"""Tiles of reduced frames in the Fourier domain: cut out, blurred, shifted, and compared by their phases.

Two tiles of one scene under one blur differ by a shift.  It is found where the phases of their spectra agree best
(Kuglin & Hines 1975), from low frequencies to high ones.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from virest.image_formation.blur import Image
from virest.image_formation.kernels import KernelField

Array = NDArray[np.float64]
TILE = 64
"""Side of a compared tile, in pixels of the reduced pictures."""
SHORT_SIDE = 400
"""Pictures are halved until their shorter side is less: shifts are then known to a tenth of a recorded pixel."""
AROUND = TILE // 4
"""What a tile is blurred together with on each side: half of the longest path that is compared."""
WIDE = TILE + 2 * AROUND
INNER = slice(AROUND, AROUND + TILE)
MOST_TILES = 16
CUTOFFS = (0.06, 0.12, 0.2, 0.25)
"""Highest frequencies of the successive fits, cycles per pixel: the first sees shifts of four pixels without a wrap."""
RIVAL_PEAK = 0.8
"""Of two agreements nearly as good the one nearer to the prediction is taken: periodic texture has many."""
LEAST_COHERENCE = 0.5
"""Tiles whose spectra agree less, Σ|Re A*B| over Σ|A||B|, show different things."""


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
    """A picture (height, width) of the size at which pictures are compared; rows and columns too many are cut off."""
    times = reduction(*picture.shape)
    height, width = (length // times for length in picture.shape)
    return cv2.resize(picture[: times * height, : times * width], (width, height), interpolation=cv2.INTER_AREA)


def shifted(spectra: NDArray[np.complex64], shift: Array) -> NDArray[np.complex64]:
    """Spectra (n, side, side / 2 + 1) of tiles that lie so far (n, 2) on."""
    along, down = (
        np.exp(2j * np.pi * d[:, None] * f).astype(np.complex64)
        for d, f in zip(shift.T, _axes(spectra.shape[1]), strict=True)
    )
    return np.asarray(spectra * along[:, None, :] * down[:, :, None])


def power_of(spectra: NDArray[np.complex64]) -> NDArray[np.float32]:
    """|S|² of spectra."""
    return spectra.real**2 + spectra.imag**2


def spread_tiles(height: int, width: int, most: int = MOST_TILES) -> NDArray[np.intp]:
    """(n, 2) top and left of tiles spread evenly over a picture, at most the given number."""
    tops, lefts = (
        np.linspace(0, length - TILE, max(1, -(-length // TILE) if most > MOST_TILES else length // TILE)).astype(
            np.intp
        )
        for length in (height, width)
    )
    corners = np.stack(np.meshgrid(tops, lefts, indexing="ij"), -1).reshape(-1, 2)
    chosen = np.unique(np.linspace(0, len(corners) - 1, min(len(corners), most)).round().astype(np.intp))
    return np.asarray(corners[chosen])


def full_px(tops_lefts: NDArray[np.intp], times: int, at: float) -> Array:
    """(n, 2) pixels x, y of the recorded picture at a place ``at`` rows and columns into each reduced tile."""
    return np.asarray((tops_lefts[:, ::-1] + at + 0.5) * times - 0.5)


def kernel_spectra(
    field: Callable[[Array], KernelField], tops_lefts: NDArray[np.intp], times: int
) -> NDArray[np.complex64] | None:
    """Transposes of the kernels at tiles' centres, (n, WIDE, WIDE / 2 + 1).

    None where a path does not fit into half a tile.
    """
    kernels = field(full_px(tops_lefts, times, (TILE - 1) / 2)).scaled(1 / times)
    radius = kernels.radius_px
    if 2 * radius + 1 > TILE // 2:
        return None
    along, down = (np.exp(2j * np.pi * radius * f).astype(np.complex64) for f in _axes(WIDE))
    rows = fft.rfft(kernels.arrays()[:, ::-1, ::-1], WIDE, axis=2) * along  # the transpose, its middle at 0
    return np.asarray(fft.fft(rows, WIDE, axis=1) * down[:, None])


def cut(picture: NDArray[Any], tops_lefts: NDArray[np.intp], side: int = TILE) -> NDArray[Any]:
    """Tiles (n, side, side) of a picture."""
    return np.stack([picture[top : top + side, left : left + side] for top, left in tops_lefts.tolist()])


def wide_spectra(picture: Image, tops_lefts: NDArray[np.intp]) -> NDArray[np.complex64]:
    """Spectra (n, WIDE, WIDE / 2 + 1) of tiles with what lies around them; the picture is mirrored at its edges."""
    padded = cv2.copyMakeBorder(picture, AROUND, AROUND, AROUND, AROUND, cv2.BORDER_REFLECT_101)
    return np.asarray(fft.rfft2(cut(padded, tops_lefts, WIDE)))


def inner(wide: NDArray[np.complex64]) -> Image:
    """Tiles (n, TILE, TILE) of spectra (n, WIDE, WIDE / 2 + 1)."""
    rows = fft.ifft(wide, axis=1)[:, INNER]
    return np.asarray(fft.irfft(rows, WIDE, axis=2)[:, :, INNER])


def read_at(picture: Image, source: NDArray[np.float32]) -> Image:
    """A reduced picture at the places of a map (h, w, 2); beyond its edges, these."""
    return cv2.remap(picture, source, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def spectra_of(tiles: Image, seen: Image | None = None) -> NDArray[np.complex64]:
    """Spectra (n, TILE, TILE / 2 + 1) of tiles less their mean, under a Hann window; light that changed is evened.

    seen: (n, TILE, TILE) weights of the places that make the mean; None: all.
    """
    window = _window()
    weight = np.broadcast_to(window, tiles.shape) if seen is None else window * seen
    total = np.maximum(weight.sum(axis=(1, 2)), 1e-6)
    means = (np.einsum("nij,nij->n", tiles, weight) / total)[:, None, None]
    return np.asarray(fft.rfft2((tiles / np.maximum(means, 1e-3) - 1) * window))


@lru_cache(maxsize=1)
def _window() -> Image:
    hann = np.hanning(TILE + 2)[1:-1]
    return np.outer(hann, hann).astype(np.float32)


def _axes(side: int = TILE) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Frequencies along and down of half a spectrum (side, side / 2 + 1), cycles per pixel."""
    return np.fft.rfftfreq(side).astype(np.float32), np.fft.fftfreq(side).astype(np.float32)


@lru_cache(maxsize=2)
def radii(side: int = TILE) -> Array:
    """Distance from zero over half a spectrum (side, side / 2 + 1), cycles per pixel."""
    return np.hypot(*np.meshgrid(np.fft.rfftfreq(side), np.fft.fftfreq(side)))


@lru_cache(maxsize=1)
def _looked_at() -> tuple[NDArray[np.intp], NDArray[np.float32], tuple[int, ...]]:
    """Places of half a spectrum whose phases are looked at, by rising frequency, and 2π f there, (2, m).

    The third: how many of them each of CUTOFFS takes.
    """
    radius = radii().ravel()
    order = np.argsort(radius, kind="stable")
    order = order[(radius[order] > 1 / TILE) & (radius[order] <= CUTOFFS[-1])]
    waves = 2 * np.pi * np.stack([f.ravel()[order] for f in np.meshgrid(*_axes())]).astype(np.float32)
    return order, waves, tuple(int(n) for n in np.searchsorted(radius[order], CUTOFFS, side="right"))


def common_shift(a: NDArray[np.complex64], b: NDArray[np.complex64]) -> Array:
    """Shift d (2,) with b(x) ≈ a(x + d) for most tiles: the peak of their summed phase correlation, whole pixels."""
    product = np.conj(a) * b
    surface = fft.irfft2((product / np.sqrt(np.abs(product) + 1e-12)).sum(axis=0), (TILE, TILE))
    rows, columns = np.nonzero(surface >= RIVAL_PEAK * surface.max())
    shifts = -np.stack([columns, rows], -1).astype(float)
    shifts[shifts < -TILE // 2] += TILE
    return np.asarray(shifts[np.argmin(np.linalg.norm(shifts, axis=1))])


def tile_shifts(a: NDArray[np.complex64], b: NDArray[np.complex64], start_px: Array) -> tuple[Array, Array]:
    """Shifts (n, 2) of tiles and their precision (n,), 1 / px², by the phases' scatter; 0: it shows something else."""
    places, waves, counts = _looked_at()
    product = np.conj(a.reshape(len(a), -1)[:, places]) * b.reshape(len(b), -1)[:, places]
    size, phase, shift = np.abs(product), np.angle(product), np.tile(start_px, (len(a), 1))
    squares = np.stack([waves[0] ** 2, waves[0] * waves[1], waves[1] ** 2], -1)
    for count in counts:
        left = _left(phase[:, :count], shift, waves[:, :count])
        weight = size[:, :count] * np.maximum(np.cos(left), 0)
        xx, xy, yy = (weight @ squares[:count]).T.astype(float)
        x, y = ((weight * left) @ waves[:, :count].T).T.astype(float)
        determinant = np.maximum(xx * yy - xy * xy, 1e-3 * (xx + yy) ** 2 + 1e-20)
        shift += np.stack([(yy * x - xy * y) / determinant, (xx * y - xy * x) / determinant], -1)
    total = np.maximum(size.sum(axis=1, dtype=float), 1e-20)
    coherence = (size * np.cos(_left(phase, shift, waves))).sum(axis=1, dtype=float) / total
    scatter = np.maximum(1 - coherence**2, 1e-4) / np.maximum(coherence**2, 1e-4)
    narrow = determinant / np.maximum(xx + yy, 1e-20) / total
    return shift, np.where(coherence > LEAST_COHERENCE, narrow / scatter, 0.0)


def _left(phase: NDArray[np.float32], shift: Array, waves: NDArray[np.float32]) -> NDArray[np.float32]:
    """Phases (n, m) that shifts (n, 2) leave, within a half turn."""
    left = phase - shift.astype(np.float32) @ waves
    return np.asarray(left - np.float32(2 * np.pi) * np.rint(left * np.float32(0.5 / np.pi)), np.float32)
