"""The blur that a coded movie shows, where a frame keeps that of the frame it was predicted from.

A coder predicts a frame from the previous one, moved block by block, and stores only the difference: the coefficients
beyond its quantiser's dead zone.  So a frame keeps the previous frame's blur where the two blurs differ by too little
to be stored: after a sharper frame it is sharper than its own path says, after a more blurred one less sharp.

Let K be the kernel of the frame's path, K' that of the frame before as stored, moved so that their means coincide, and
S the sharp picture's power.  The difference has the power |K' − K|² S.  A coder's coefficients are about Laplacian (Lam
& Goodman 2000, doi:10.1109/83.869177), and a Laplacian variable of deviation σ has the part m of its power within a
dead zone ± z:

    K_stored = K + m (K' − K),   m = 1 − e^{−u} (1 + u + u² / 2),   u = √2 z / σ.

No constant is fitted.  With true pictures, the best part of the change by restoring was 0.28 ± 0.21 where 0.3 to 0.5
is derived, 0.63 ± 0.24 for 0.7 to 0.8, and 0.84 ± 0.28 for 0.9 to 0.97 (mean ± scatter of 1296 frames, 36 simulated
captures, ``fast``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from virest.arrays import Array, Picture
from virest.image_formation.blur import fast_size
from virest.image_formation.kernels import KernelField, kernel_field
from virest.image_formation.row_motion import RowMotion
from virest.restoration.statistics.records import DEAD_ZONE, PictureStatistics

ACROSS, DOWN = 3, 2
"""Places of the picture at which kernels are compared."""
LEAST_SIZE, LARGEST_SIZE = 32, 256
"""Sides of the transforms: twice the kernels' size, so that their products do not wrap around."""
BLOCK_PX, DETAIL_PX = 16, 5
"""Sides of a coder's blocks, and of the squares whose mean is taken off to leave detail."""
PARTS = 10
"""Parts of the blocks, from plain to busy: with one, up to 0.3 too much of a facade's power would count as kept."""
ALONE_PART = 0.25
"""Weight of the share without further pictures in the mean.  On 432 frames of twelve simulated captures (``balanced``)
the mean gain is 2.347 dB with 0, 2.368 with ¼ and 2.365 with ½, and 6, 5 and 3 frames lose more than 0.1 dB; half costs
0.15 dB on captures of the project's own simulator, ¼ half as much."""
FRAMES_BACK = 2
"""Earlier frames whose blur is looked at."""


@dataclass(frozen=True, slots=True)
class Predicted:
    """A step of a frame's prediction: the frame before, and the coder's step for what was stored."""

    motion: RowMotion
    """Of the frame before."""
    step: float
    """The quantiser's step for the frame after it, grey levels."""


@dataclass(frozen=True, slots=True)
class CodedBlur:
    """The stored frame's blur compared with that of its own path."""

    share: float = 1.0
    """Part of the change by restoring that leaves the least error, at most 1."""
    lost: float = 1.0
    """Squared error by the blur, over that of the path's blur, at most 1: more is not restored with its kernels."""


def coded_blur(
    picture: Picture, motion: RowMotion, before: Sequence[Predicted], luma: PictureStatistics, further: Array
) -> CodedBlur:
    """Compare the blur of a frame as stored with that of its path.

    before: the frame before, then the one before that, as far as each was predicted from the next.  luma: the frame's
    statistics.  further: (RINGS,) weighted |K|² of further pictures restored with it.

    The restoration is the linear filter that is ideal for the path's kernels: it changes the picture by D.  With the
    error E before it, ⟨E, D⟩ / |D|² of D leaves the least error.  Further pictures are coded too, which is not looked
    at: the share is a geometric mean of that with exact ones and that with none.
    """
    if not before or not luma.measured:
        return CodedBlur()
    width, height = motion.profile.width, motion.profile.height
    x, y = ((np.arange(count) + 0.5) / count * side - 0.5 for count, side in ((ACROSS, width), (DOWN, height)))
    centres_px = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    own = kernel_field(motion, centres_px)
    fields = [own, *(_moved_onto(kernel_field(one.motion, centres_px), own) for one in before)]
    size = int(np.clip(fast_size(4 * max(field.radius_px for field in fields)), LEAST_SIZE, LARGEST_SIZE))
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size))
    signal, noise = (np.interp(frequency, luma.frequency, p).astype(np.float32) for p in (luma.signal, luma.noise))
    uneven = _unevenness(picture)
    path, *earlier = (_spectra(field, size) for field in fields)
    stored = earlier[-1]
    for kernels, one in zip([path, *earlier[:-1]][::-1], before[::-1], strict=True):
        apart = stored - kernels
        stored = kernels + _kept(np.square(np.abs(apart)) * signal, DEAD_ZONE * one.step, uneven) * apart
    shares = []
    for joined in (0.0, np.interp(frequency, luma.frequency, further).astype(np.float32)):
        solved = 1 / (np.square(np.abs(path)) + joined + noise / signal)
        amplified = np.conj(path) * solved - 1
        of_path, of_stored = (
            _useful_part(1 - kernels, (np.conj(path) * kernels + joined) * solved - kernels, amplified, signal, noise)
            for kernels in (path, stored)
        )
        shares.append(np.clip(of_stored / of_path, 0.0, 1.0) if of_path > 0 else 1.0)
    lost, lost_stored = (float(np.sum(signal * np.square(np.abs(1 - kernels)))) for kernels in (path, stored))
    share = shares[0] ** ALONE_PART * shares[1] ** (1 - ALONE_PART)
    return CodedBlur(float(share), min(lost_stored / lost, 1.0) if lost > 0 else 1.0)


def _unevenness(picture: Picture) -> NDArray[np.float32]:
    """Power of the detail over its mean, in PARTS equal parts of a picture's blocks, from plain to busy.

    Edges hold most of the detail in few blocks, and there differences are stored.
    """
    luma = (picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)).astype(np.float32)
    size = max(luma.shape[1] // BLOCK_PX, 1), max(luma.shape[0] // BLOCK_PX, 1)
    detail = cv2.subtract(luma, cv2.blur(luma, (DETAIL_PX, DETAIL_PX)))
    blocks = np.sort(cv2.resize(cv2.multiply(detail, detail), size, interpolation=cv2.INTER_AREA), axis=None)
    parts = np.array([part.mean() for part in np.array_split(blocks, min(PARTS, blocks.size))], np.float32)
    return np.asarray(parts / max(float(parts.mean()), 1e-6))


def _moved_onto(field: KernelField, own: KernelField) -> KernelField:
    """Kernels moved as a coder's motion vectors do, so that their means are those of the frame's own."""
    apart_px = own.paths_px.mean(axis=1, keepdims=True) - field.paths_px.mean(axis=1, keepdims=True)
    return replace(field, paths_px=field.paths_px + apart_px)


def _spectra(field: KernelField, size: int) -> NDArray[np.complex64]:
    """Spectra (n, size, size / 2 + 1) of kernels; what lies beyond the square counts at its rim."""
    kernels = field.arrays(min(field.radius_px, size // 2 - 1))
    radius = kernels.shape[1] // 2
    padded = np.zeros((len(kernels), size, size), np.float32)
    padded[:, : 2 * radius + 1, : 2 * radius + 1] = kernels
    return np.asarray(fft.rfft2(np.roll(padded, (-radius, -radius), (1, 2))), np.complex64)


def _kept(power: NDArray[np.float32], dead_zone: float, uneven: NDArray[np.float32]) -> NDArray[np.float32]:
    """Part of the power of Laplacian variables within ± dead_zone; uneven: their powers over ``power``, equally likely.

    A plain picture keeps everything.
    """
    if not uneven.any():
        return np.ones_like(power)
    u = np.float32(np.sqrt(2) * dead_zone) / np.sqrt(np.maximum(power, np.float32(1e-6)))
    kept = np.zeros_like(u)
    for part in uneven[uneven > 0]:
        v = u / np.sqrt(part)
        kept += part * (1 - np.exp(-v) * (1 + v + v * v / 2))
    return np.asarray(kept / uneven.sum(), np.float32)


def _useful_part(
    lost: NDArray[np.complex64],
    change: NDArray[np.complex64],
    amplified: NDArray[np.complex64],
    signal: NDArray[np.float32],
    noise: NDArray[np.float32],
) -> float:
    """⟨E, D⟩ / |D|² over all frequencies and kernels; 0 if nothing is changed.

    lost: what the blur takes from the sharp picture; change: what restoring adds to it; amplified: what it adds to the
    noise, each per unit.
    """
    useful = np.sum(signal * (lost * np.conj(change)).real - noise * amplified.real)
    size = np.sum(signal * np.square(np.abs(change)) + noise * np.square(np.abs(amplified)))
    return float(useful / size) if size > 0 else 0.0
