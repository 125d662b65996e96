"""Fit |G|² = |K|² S + N ring by ring, to separate noise from the sharp picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Mask
from virest.restoration.statistics.records import (
    ROUNDING_POWER,
    PictureStatistics,
    coder_noise,
    falling_power,
)
from virest.restoration.statistics.rings import RINGS, SIDE, ring_index

FIT_STEPS = 6
"""Reweighted fits of a ring: half as many change restored frames by 0.06 grey levels (rms), twice as many by 0.01."""
_CELLS = 64
"""Cells of |K|² in a ring: half or twice as many change restored frames by 0.14 or 0.11 grey levels (rms)."""
_MUST_CANCEL = 0.45
"""Mean |K|² of a ring above which the kernels cancel too little to tell noise from signal."""
_STEEPEST_NOISE, _LEVEL_BELOW = 2.0, 0.08
"""Coding noise rises towards low frequencies as f⁻² at most, and not at all below 0.08 cycles per pixel."""
_CODER_SLOPE = 1.5
"""Where kernels cancel nothing, only the highest frequencies show noise alone, and coding noise is least there.  The
error of pictures coded at 0.25 bits per pixel falls about as f⁻¹·⁵ from 0.08 to 0.5 cycles per pixel (five frames,
read by eye).  The value hardly matters: ``python -m virest.app.bench --only fits`` finds 1.9 ± 2.2, and between 0.5 and
2.5 the mean gain on 14 captures changes by 0.01 dB."""
_FINEST = slice(-3, None)
"""The rings of highest frequency."""
_RECORDED = 0.1
"""Mean |K|² of the finest rings above which they still had detail to code: paths of up to about 4 px."""
_SLOPE_SPAN = 3.0
"""The noise's slope is fitted from the lowest determined ring to this many times its frequency."""
_STANDS_OUT = 0.5
"""Noise below this fraction of the observed power is constant: the coder no longer drops it with the picture."""
_CLEAR_SIGNAL = 3.0
"""S is reliable where the power that passes the blur is at least this many times the noise."""
_PLACES_IN_CELL = 4
"""Cells with fewer places are left out of the misfit."""
_OF_FIT = 2.0
"""Factor on the misfit of the ring fit when it is compared with that of the final S and N; the smaller one counts.

Of 108 gratings (waves, bars and boards of 7 to 21 px in four directions, under paths of 3 to 10 px) 94 have a final
misfit above 0.8, and 92 of these have 0.58 to 2.2 for the ring fit.  Of frames of ordinary scenes, from which a coder
removed detail, 15 in six simulated captures have a final misfit above 1.1, ten of them 0.3 to 0.5 for the ring fit.
"""


class RingCells:
    """The places of all tiles' spectra, sorted into cells of the same ring and nearly equal |K|²."""

    def __init__(self, passed: NDArray[np.float32]) -> None:
        """passed: |K|² of each tile, ordered as in :mod:`rings`."""
        share = np.minimum((passed * np.float32(_CELLS)).astype(np.intp), _CELLS - 1)
        self._cell = (ring_index(SIDE) * _CELLS + share).ravel()
        self.count = self._sums(None)
        """(RINGS, _CELLS) number of places in each cell."""
        self.passed = self.means(passed)

    def means(self, values: NDArray[np.float32]) -> Array:
        """(RINGS, _CELLS) mean of each cell; 0 if it is empty."""
        return np.asarray(self._sums(values.ravel()) / np.maximum(self.count, 1))

    def _sums(self, weights: NDArray[np.float32] | None) -> Array:
        sums = np.bincount(self._cell, weights, (RINGS + 1) * _CELLS).astype(np.float64)
        return sums[: RINGS * _CELLS].reshape(RINGS, _CELLS)


def fit_rings(
    *spectra: tuple[NDArray[np.float32], RingCells, float, float | None],
) -> list[PictureStatistics]:
    """Fit |G|² = |K|² S + N in every ring by weighted least squares over its cells.

    spectra, all fitted at once: each |G|², its cells, the picture's white noise, and the coder's quantiser step or
    None if unknown; the last two in grey levels.
    """
    count, k, g = (
        np.stack(parts)
        for parts in zip(*((cells.count, cells.passed, cells.means(seen)) for seen, cells, *_ in spectra), strict=True)
    )
    in_ring = np.maximum(count.sum(-1), 1)
    mean_k, mean_g = (count * k).sum(-1) / in_ring, (count * g).sum(-1) / in_ring
    signal, noise = 0.9 * mean_g / np.maximum(mean_k, 0.05), 0.1 * mean_g
    products = np.stack([np.ones_like(k), k, k * k, g, k * g], -1)
    for _ in range(FIT_STEPS):
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
        final = _final_statistics(signal[i], noise[i], mean_k[i], mean_g[i], determined[i], white_levels, step)
        by_law, by_fit = (
            _misfit(count[i], g[i], n[:, None] + s[:, None] * k[i])
            for n, s in ((final.noise, final.signal), (noise[i], signal[i]))
        )
        found.append(replace(final, misfit=min(by_law, _OF_FIT * by_fit)))
    return found


def _misfit(count: Array, observed: Array, expected: Array) -> float:
    """RMS of ln(observed / expected) over the cells, weighted by their places; powers below rounding's count as that.

    No S and N of rings fit a grating.  But where the ring fit is good and the final S and N are not, the coder removed
    detail that the law of natural pictures restores: the rings themselves are adequate.
    """
    weight = count * (count >= _PLACES_IN_CELL)
    logarithms = np.log(np.maximum(observed, ROUNDING_POWER) / np.maximum(expected, ROUNDING_POWER))
    return float(np.sqrt(np.sum(weight * logarithms**2) / max(np.sum(weight), 1.0)))


def _final_statistics(
    signal: Array,
    noise: Array,
    passed: Array,
    observed: Array,
    determined: Mask,
    white_levels: float,
    step: float | None,
) -> PictureStatistics:
    """The final statistics: rings that cannot separate S from N take over N from those that can; S never rises.

    If the kernels are too short to cancel anything, N is undetermined.  At the highest frequencies it is then taken
    from the picture's second differences, and is at most the power there; below, it rises as coding noise does.
    """
    frequency = (np.arange(RINGS) + 0.5) * 0.5 / RINGS
    if determined.any():
        noise = np.interp(frequency, frequency[determined], noise[determined])
        noise = np.maximum.accumulate(noise[::-1])[::-1]
        noise *= _low_frequency_growth(frequency, noise, determined, observed)
        if passed[_FINEST].mean() > _RECORDED:
            noise = np.minimum(noise, _noise_bound(frequency, observed))
        if step is not None:
            noise = np.minimum(noise, observed[_FINEST].mean() + coder_noise(observed, step))
    else:
        finest = min(float(observed[_FINEST].mean()), 2 * white_levels**2)
        noise = _falling_noise(frequency, finest, _CODER_SLOPE)
    through = np.maximum(observed - noise, 0.05 * observed) / np.maximum(passed, 0.05)
    signal = np.where(determined, signal, through)
    signal = np.maximum(np.maximum.accumulate(signal[::-1])[::-1], 1e-3 * noise)
    signal = _extrapolated_detail(frequency, signal, passed, noise)
    return PictureStatistics(frequency, signal, noise, passed, _standard_deviation(frequency, passed * signal, noise))


def _standard_deviation(frequency: Array, through: Array, noise: Array) -> float:
    """Standard deviation of the noise, weighted to frequencies where about as much signal passes the blur."""
    weight = frequency * through * noise / (through + noise) ** 2
    return float(np.sqrt(np.sum(weight * noise) / np.sum(weight)))


def _noise_bound(frequency: Array, observed: Array) -> Array:
    """Upper bound on the noise of each ring (RINGS,) where the finest rings still hold detail.

    A short path cancels little, and in one direction only, so the picture's own anisotropy is fitted as noise: fits
    gave 40 to 440 grey levels squared where the truth was below 10.  In the finest rings noise is at most the observed
    power, and towards low frequencies it rises as f⁻² at most.
    """
    return _falling_noise(frequency, float(observed[_FINEST].mean()), _STEEPEST_NOISE)


def _falling_noise(frequency: Array, finest: float, slope: float) -> Array:
    """Noise (RINGS,) extrapolated from the finest rings, rising towards low frequencies as coding noise does."""
    return np.asarray(max(finest, ROUNDING_POWER) * (frequency[-2] / np.maximum(frequency, _LEVEL_BELOW)) ** slope)


def _low_frequency_growth(frequency: Array, noise: Array, determined: Mask, observed: Array) -> Array:
    """Factor on the noise, (RINGS,), below the determined rings: it continues at the slope of the determined ones.

    Sensor noise is white.  Coding noise falls with the picture's power where the coder drops it; at lower frequencies,
    where the picture stands out of the noise, it is constant (reverse water-filling).
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


def _extrapolated_detail(frequency: Array, signal: Array, passed: Array, noise: Array) -> Array:
    """S, and where it is close to the noise, at least the f⁻³ extrapolation from the last reliable ring.

    There the coder has removed the blurred picture's faint detail, and the fit finds less than the sharp picture has.
    """
    doubtful = np.flatnonzero(passed * signal < _CLEAR_SIGNAL * noise)
    doubtful = doubtful[doubtful > 1]
    if not len(doubtful):
        return signal
    last = int(doubtful[0]) - 1
    return np.append(signal[: last + 1], np.maximum(signal, falling_power(frequency, signal, last))[last + 1 :])
