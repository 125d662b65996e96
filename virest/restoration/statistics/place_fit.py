"""Pictures whose power lies at few frequencies: detected by the rings' misfit, measured frequency by frequency.

A place is one frequency (row and column) of a tile's spectrum.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.restoration.statistics.records import ROUNDING_POWER, PictureStatistics, PlaceStatistics
from virest.restoration.statistics.rings import RINGS, axes, place_ring
from virest.restoration.statistics.tile_power import MANY_TILES

_LITTLE_MISFIT, _LARGE_MISFIT = 0.8, 1.1
"""RMS misfit of ln |G|² over the cells below which rings are fully trusted, and above which not at all.

For MANY_TILES; fewer tiles scatter more."""
_SINGLE_PLACES = 2.0
"""Along the axes, which the fit leaves out, single places scatter this many times as much as the fit's cells."""
_INDEPENDENT = 4.0
"""Effective number of independent places in a 3×3 neighbourhood under the window."""
_STEEPEST_PLACE = 4.0
"""Upper bound on S of a place over its ring's S; the recorded power beyond the noise is allowed too, if larger.

Anything above both, where kernels cancel, is the coder's pattern."""
_FEW_PLACES = 20.0
"""With this many reliable places, a ring's typical S is half way (in the logarithm) between the fit and their mean."""


def unevenness(rings: PictureStatistics, observed: NDArray[np.float32], passed: NDArray[np.float32]) -> float:
    """0 if the rings fit as well as for ordinary pictures, up to 1 if the power lies at few places.

    observed, passed: as in :func:`place_statistics`.
    """
    misfit = max(rings.misfit, _scatter_along_axes(rings, observed, passed) / _SINGLE_PLACES)
    misfit *= min(1.0, float(np.sqrt(len(observed) / MANY_TILES)))
    return float(np.clip((misfit - _LITTLE_MISFIT) / (_LARGE_MISFIT - _LITTLE_MISFIT), 0.0, 1.0))


def _scatter_along_axes(rings: PictureStatistics, observed: NDArray[np.float32], passed: NDArray[np.float32]) -> float:
    """Standard deviation of ln |G|² about the fit along the axes, where horizontal and vertical edges have their power.

    Boards, print and the coder's blocks have more power there than elsewhere, but spread evenly; vertical bars and
    horizontal blinds have it at few places.  observed, passed: as in :func:`place_statistics`.
    """
    rows, columns = axes()
    ring = place_ring()[rows, columns]
    seen, k = (spectra[:, rows, columns].mean(axis=0) for spectra in (observed, passed))
    return float(np.std(np.log(np.maximum(seen, ROUNDING_POWER) / (k * rings.signal[ring] + rings.noise[ring]))))


def place_statistics(
    rings: PictureStatistics, observed: NDArray[np.float32], passed: NDArray[np.float32], weight: float
) -> PlaceStatistics:
    """S of each place, (|G|² − N) / |K|² around it where that is reliable, else the typical S of its ring.

    Typical is the mean of ln S over the places that pass the blur, which a few strong places do not raise, and at most
    the ring's fit.  observed, passed: |G|² and |K|² of the tiles, (n, SIDE, SIDE / 2 - 1).
    """
    count, ring = _INDEPENDENT * len(observed), place_ring()
    signal, noise = rings.signal[ring], rings.noise[ring]
    seen, k = (_around(np.asarray(spectra.mean(axis=0))) for spectra in (observed, passed))
    k = np.maximum(k, 1e-6)
    own, own_std = (seen - noise) / k, noise / (k * np.sqrt(count))
    most = np.maximum(_STEEPEST_PLACE * signal, seen - noise)
    logarithms = np.log(np.clip(own, np.minimum(own_std, signal), most) / signal)
    reliable = k * signal / (k * signal + noise)
    sums, counts = (np.bincount(ring.ravel(), w.ravel(), RINGS) for w in (reliable * logarithms, reliable))
    typical = signal * np.exp(np.minimum(sums / (counts + _FEW_PLACES), 0.0))[ring]
    known = count / (count + (1 + noise / (k * typical)) ** 2)
    found = np.clip(typical + known * (own - typical), np.minimum(own_std, typical), most)
    return PlaceStatistics(weight, ((found / signal) ** weight).astype(np.float32), k.astype(np.float32))


def _around(spectrum: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mean over each place and its eight neighbours; rows wrap around."""
    return cv2.blur(cv2.copyMakeBorder(spectrum, 1, 1, 0, 0, cv2.BORDER_WRAP), (3, 3))[1:-1]
