"""|G|² = |K|² S + N, ring by ring: what is noise, and what the sharp picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from virest.restoration.statistics.records import (
    ROUNDING_POWER,
    Array,
    PictureStatistics,
    coder_noise,
    falling_power,
)
from virest.restoration.statistics.rings import RINGS, SIDE, ring_index

_FIT_STEPS = 6
_CELLS = 64
_MUST_CANCEL = 0.45
"""Mean |K|² of a ring above which the kernels cancel too little to tell noise from signal."""
_STEEPEST_NOISE, _LEVEL_BELOW = 2.0, 0.08
"""A coded movie's error grows towards low frequencies like f⁻² at most, and below 0.08 cycles per pixel no more."""
_CODER_SLOPE = 1.5
"""Where kernels cancel nothing, only the highest frequencies show noise by itself, and a coder leaves least of it
there: recorded less true pictures at 0.25 bits a pixel fall about as f⁻¹·⁵ from 0.08 to 0.5 cycles per pixel (five
frames, read by eye).  It hardly matters: ``python -m virest.app.bench --only fits`` finds 1.9 ± 2.2, and between 0.5
and 2.5 the mean gain on 14 captures changes by 0.01 dB."""
_FINEST = slice(-3, None)
"""Rings of the finest detail."""
_RECORDED = 0.1
"""Mean |K|² of the finest rings above which the coder still had detail to code there: paths of up to some 4 px."""
_SLOPE_SPAN = 3.0
"""The noise's growth is measured from the lowest determined ring to this many times its frequency."""
_STANDS_OUT = 0.5
"""A coder's noise is no longer cut with the picture where it has less than this part of what is seen."""
_CLEAR_SIGNAL = 3.0
"""What passes the blur is clear where it has this many times the noise's power."""
_PLACES_IN_CELL = 4
"""The mean of fewer tells little."""
_OF_FIT = 2.0
"""How many times the misfit of the fit itself counts beside that of what is settled on.

Of 108 gratings (waves, bars and boards of 7 to 21 px in four directions, under paths of 3 to 10 px) 94 have more
than 0.8 of the latter, and 92 of these have 0.58 to 2.2 of the former.  Of frames of ordinary scenes, from which a
coder took detail, 15 in six simulated captures have more than 1.1 of the latter, ten of them 0.3 to 0.5 of the former.
"""


class RingCells:
    """The places of all tiles' spectra, sorted into cells of equal ring and nearly equal |K|²."""

    def __init__(self, passed: NDArray[np.float32]) -> None:
        """passed: |K|² of each tile, ordered as in :mod:`rings`."""
        share = np.minimum((passed * np.float32(_CELLS)).astype(np.intp), _CELLS - 1)
        self._cell = (ring_index(SIDE) * _CELLS + share).ravel()
        self.count = self._sums(None)
        """(RINGS, _CELLS) places in each cell."""
        self.passed = self.means(passed)

    def means(self, values: NDArray[np.float32]) -> Array:
        """(RINGS, _CELLS) mean of each cell; 0 where it is empty."""
        return np.asarray(self._sums(values.ravel()) / np.maximum(self.count, 1))

    def _sums(self, weights: NDArray[np.float32] | None) -> Array:
        sums = np.bincount(self._cell, weights, (RINGS + 1) * _CELLS).astype(np.float64)
        return sums[: RINGS * _CELLS].reshape(RINGS, _CELLS)


def fit_rings(
    *spectra: tuple[NDArray[np.float32], RingCells, float, float | None],
) -> list[PictureStatistics]:
    """Weighted least squares of |G|² = |K|² S + N in every ring, on cells of equal ring and nearly equal |K|².

    spectra: |G|², its cells, the white noise of the picture that it is of, and the step of its coder's quantiser, None
    where that is not known; all are fitted at once.
    """
    count, k, g = (
        np.stack(parts)
        for parts in zip(*((cells.count, cells.passed, cells.means(seen)) for seen, cells, *_ in spectra), strict=True)
    )
    in_ring = np.maximum(count.sum(-1), 1)
    mean_k, mean_g = (count * k).sum(-1) / in_ring, (count * g).sum(-1) / in_ring
    signal, noise = 0.9 * mean_g / np.maximum(mean_k, 0.05), 0.1 * mean_g
    products = np.stack([np.ones_like(k), k, k * k, g, k * g], -1)
    for _ in range(_FIT_STEPS):
        expected = np.maximum(noise[..., None] + signal[..., None] * k, 1e-6)
        weight = count / (expected * np.sqrt(expected))
        w, wk, wkk, wg, wkg = np.moveaxis((weight[..., None, :] @ products)[..., 0, :], -1, 0)
        determinant = np.maximum(w * wkk - wk * wk, 1e-30)
        signal = np.clip((w * wkg - wk * wg) / determinant, 1e-4 * mean_g, None)
        noise = np.clip((wkk * wg - wk * wkg) / determinant, ROUNDING_POWER, None)
    spread = np.sqrt(np.maximum((count * k * k).sum(-1) / in_ring - mean_k**2, 0))
    determined = (spread > 0.1) & (mean_k < _MUST_CANCEL) & (in_ring > 20)
    found = []
    for i, (_, _, white_levels, step) in enumerate(spectra):
        settled = _settled(signal[i], noise[i], mean_k[i], mean_g[i], determined[i], white_levels, step)
        by_law, by_fit = (
            _misfit(count[i], g[i], n[:, None] + s[:, None] * k[i])
            for n, s in ((settled.noise, settled.signal), (noise[i], signal[i]))
        )
        found.append(replace(settled, misfit=min(by_law, _OF_FIT * by_fit)))
    return found


def _misfit(count: Array, observed: Array, expected: Array) -> float:
    """RMS of ln(observed / expected) over the cells, by their places; of what is below the rounding's power, none.

    No S and N of rings fit a grating.  Where those that fit differ from those that are settled on, a coder took away
    detail that the law of natural pictures puts back: nothing is wrong with rings.
    """
    weight = count * (count >= _PLACES_IN_CELL)
    logarithms = np.log(np.maximum(observed, ROUNDING_POWER) / np.maximum(expected, ROUNDING_POWER))
    return float(np.sqrt(np.sum(weight * logarithms**2) / max(np.sum(weight), 1.0)))


def _settled(
    signal: Array,
    noise: Array,
    passed: Array,
    observed: Array,
    determined: NDArray[np.bool_],
    white_levels: float,
    step: float | None,
) -> PictureStatistics:
    """Rings that cannot tell S from N borrow the noise of those that can; S never rises with frequency.

    Kernels too short to cancel anything leave the noise open: at the highest frequencies it is then what a picture's
    second differences say, and at most what these hold; below, it rises as a coder's does.
    """
    frequency = (np.arange(RINGS) + 0.5) * 0.5 / RINGS
    if determined.any():
        noise = np.interp(frequency, frequency[determined], noise[determined])
        noise = np.maximum.accumulate(noise[::-1])[::-1]
        noise *= _growth_downwards(frequency, noise, determined, observed)
        if passed[_FINEST].mean() > _RECORDED:
            noise = np.minimum(noise, _at_most(frequency, observed))
        if step is not None:
            noise = np.minimum(noise, observed[_FINEST].mean() + coder_noise(observed, step))
    else:
        finest = min(float(observed[_FINEST].mean()), 2 * white_levels**2)
        noise = _falling_noise(frequency, finest, _CODER_SLOPE)
    through = np.maximum(observed - noise, 0.05 * observed) / np.maximum(passed, 0.05)
    signal = np.where(determined, signal, through)
    signal = np.maximum(np.maximum.accumulate(signal[::-1])[::-1], 1e-3 * noise)
    signal = _as_detail_falls(frequency, signal, passed, noise)
    return PictureStatistics(frequency, signal, noise, passed, _standard_deviation(frequency, passed * signal, noise))


def _standard_deviation(frequency: Array, through: Array, noise: Array) -> float:
    """That of the noise, weighted to where about as much of the signal comes through the blur."""
    weight = frequency * through * noise / (through + noise) ** 2
    return float(np.sqrt(np.sum(weight * noise) / np.sum(weight)))


def _at_most(frequency: Array, observed: Array) -> Array:
    """Most noise that there can be in each ring (RINGS,) where the finest ones hold detail.

    A short path cancels little, in one direction only, and what a picture lacks or has in that direction passes for
    noise: fits of 40 to 440 grey levels squared were seen where less than 10 was true.  Of noise the finest rings hold
    their part, all of what they show at most, and towards low frequencies it grows like f⁻² at most.
    """
    return _falling_noise(frequency, float(observed[_FINEST].mean()), _STEEPEST_NOISE)


def _falling_noise(frequency: Array, finest: float, slope: float) -> Array:
    """Noise (RINGS,) by that of the finest rings, growing towards low frequencies as a coder's does."""
    return np.asarray(max(finest, ROUNDING_POWER) * (frequency[-2] / np.maximum(frequency, _LEVEL_BELOW)) ** slope)


def _growth_downwards(frequency: Array, noise: Array, determined: NDArray[np.bool_], observed: Array) -> Array:
    """How many times larger the noise is below the determined rings, (RINGS,): it goes on as they rise.

    A sensor's noise is white. A coder's falls with the picture's power where it cuts that away; where the picture
    stands out of the noise, at lower frequencies, it is level (reverse water-filling).
    """
    first = int(np.flatnonzero(determined)[0])
    near = determined & (frequency <= _SLOPE_SPAN * frequency[first])
    slope = 0.0
    if np.count_nonzero(near) > 2:
        over = np.log(frequency[near]) - np.log(frequency[near]).mean()
        slope = -float(over @ np.log(noise[near]) / (over @ over))
    rise = np.maximum(frequency[first] / np.maximum(frequency, _LEVEL_BELOW), 1.0)
    growth = np.asarray(rise ** np.clip(slope, 0.0, _STEEPEST_NOISE))
    stands_out = np.flatnonzero(growth[:first] * noise[:first] < _STANDS_OUT * observed[:first])
    if len(stands_out):
        growth[: stands_out[-1]] = growth[stands_out[-1]]
    return growth


def _as_detail_falls(frequency: Array, signal: Array, passed: Array, noise: Array) -> Array:
    """S where the noise comes near it: at least what the last clear ring says by the law of natural pictures.

    There the coder has taken the blurred picture's faint detail away, and the fit finds less than the sharp one has.
    """
    doubtful = np.flatnonzero(passed * signal < _CLEAR_SIGNAL * noise)
    doubtful = doubtful[doubtful > 1]
    if not len(doubtful):
        return signal
    last = int(doubtful[0]) - 1
    return np.append(signal[: last + 1], np.maximum(signal, falling_power(frequency, signal, last))[last + 1 :])
