"""What a blurred picture says of itself: the spectrum of its noise and that of its sharp content.

The predicted kernels K pass some frequencies and cancel others.  What a picture holds where they cancel is noise (of
the sensor, of the movie's codec, and of kernels that are not quite right); what it holds where they pass is the sharp
picture.  So |G|² = |K|² S + N, fitted over the tiles in rings of equal frequency, measures both: the regularisation
is no constant, and a predicted blur that the picture does not show comes out as noise and is left alone.

Grey levels throughout; a white noise of standard deviation σ has N = σ².

Blur adds up light, and a steep curve gives the grey levels of a blurred edge frequencies that no light had: where the
kernels cancel, they would pass for noise.  So its standard deviation, which weighs the data against the prior, is
measured in light, brought to grey levels by the curve's slope at each tile's mean.

Rings take S to be the same in all directions.  A grating, a brick wall or blinds have their power at few places of a
ring: where these pass and others are cancelled, S is believed there too, and noise and errors of the kernels are
restored for detail.  The fit's misfit tells such pictures, and their S is measured place by place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.camera.response import ResponseCurve
from virest.degradation.kernels import KernelField

Array = NDArray[np.float64]
LUMA_RED, LUMA_BLUE = 0.299, 0.114
RINGS = 24
_SIDE = 128
_WINDOW = np.outer(np.hanning(_SIDE + 2)[1:-1], np.hanning(_SIDE + 2)[1:-1]).astype(np.float32)
_WINDOW_SUM = float(_WINDOW.sum())
_WINDOW_POWER = np.float32((_WINDOW**2).sum())
_ROUNDING_POWER = 1 / 12
_FIT_STEPS = 6
_CELLS = 64
MANY_TILES, FEW_TILES = 12, 8
"""So many are measured at most; fewer tell weak noise to a third only."""
_MUST_CANCEL = 0.45
"""Mean |K|² of a ring above which the kernels cancel too little to tell noise from signal."""
_STEEPEST_NOISE, _LEVEL_BELOW = 2.0, 0.08
"""A coded movie's error grows towards low frequencies like f⁻² at most, and below 0.08 cycles per pixel no more."""
_SLOPE_SPAN = 3.0
"""The noise's growth is measured from the lowest determined ring to so many times its frequency."""
_STANDS_OUT = 0.5
"""A coder's noise is no longer cut with the picture where it has less than this part of what is seen."""
_CLEAR_SIGNAL = 3.0
"""What comes through the blur is clear where it has so many times the noise's power."""
_DETAIL_SLOPE = 3.0
"""The power of a natural picture falls with frequency about like f⁻³."""
_MAX_CLIPPED = 0.002
"""Tiles with a larger part of clipped pixels are taken only where there are none better."""
_ON_PATH = 2e-3
"""Kernels are larger than this where the path goes."""
_FILLING_PX = (5, 15, 45, 135)
_HYPER_LAPLACIAN_RMS = 3.62
"""RMS of a variable with density ∝ exp(−|x|^⅔): sqrt(Γ(9/2)/Γ(3/2))."""
_EDGES_BEYOND = 2.0
"""A picture's edges stand out of its spectrum by so much: rings of tiles have the mean of edge and plain surface."""
_LITTLE_MISFIT, _LARGE_MISFIT = 0.8, 1.1
"""RMS of ln |G|² about the fit's, over its cells, up to which rings are believed, and from which on they are not.

Of MANY_TILES; what fewer of them hold differs more from one to the next."""
_SINGLE_PLACES = 2.0
"""Along the axes, which the fit leaves out, single places scatter so many times as much as cells."""
_PLACES_IN_CELL = 4
"""The mean of fewer tells little."""
_INDEPENDENT = 4.0
"""Of a place's nine neighbours under the window, itself one of them, so many are independent."""
_STEEPEST_PLACE = 4.0
"""S of a place is at most so many times its ring's, or what came through the blur, whichever is more.

What exceeds both where kernels cancel is the coder's pattern."""
_FEW_PLACES = 20.0
"""A ring with so many reliable places is half way from its fit to what these have."""


@dataclass(frozen=True, slots=True)
class PlaceStatistics:
    """What rings do not tell: power over the places of a tile's spectrum, as :func:`_power` orders them."""

    weight: float
    """How far the rings' S is wrong: more than 0, and 1 from a large misfit on."""
    share: NDArray[np.float32]
    """(_SIDE, _SIDE / 2 - 1) S of each place over that of its ring."""
    passed: NDArray[np.float32]
    """(_SIDE, _SIDE / 2 - 1) mean |K|² of the kernels."""

    def after(self, passed: Array) -> PlaceStatistics:
        """The same where more blur came on top, that passes so much (RINGS,) of |G|²."""
        return replace(self, passed=(self.passed * passed[_place_ring()]).astype(np.float32))

    def expected_gain_db(self, signal: Array, noise: Array) -> float:
        """As :attr:`PictureStatistics.expected_gain_db`, by the rings' S and N, (RINGS,).

        More noise than what comes through the blur counts as that: it may be a grating that the kernels nearly cancel,
        and taking it away is no gain.
        """
        ring = _place_ring()
        s, n = signal[ring] * self.share, noise[ring]
        through = self.passed * s
        left = np.sum((1 - np.sqrt(self.passed)) ** 2 * s + np.minimum(n, through))
        return max(float(10 * np.log10(left / np.sum(s * n / (through + n)))), 0.0)


@dataclass(frozen=True, slots=True)
class PictureStatistics:
    """Measured on one blurred picture, over rings of spatial frequency, in grey levels squared."""

    frequency: Array
    """(RINGS,) middle of each ring, cycles per pixel."""
    signal: Array
    """(RINGS,) power of the sharp picture."""
    noise: Array
    """(RINGS,) power of the noise."""
    passed: Array
    """(RINGS,) mean |K|² of the kernels."""
    noise_levels: float
    """One standard deviation of the noise: at the frequencies where signal and noise are about equal."""
    measured: bool = True
    """False where the picture told nothing, and the values stand in for it."""
    misfit: float = 0.0
    """RMS of the natural logarithm of |G|² over the fit's |K|² S + N, cell by cell."""
    places: PlaceStatistics | None = None
    """Of a picture that the rings do not fit; None: they do."""

    @property
    def unevenness(self) -> float:
        """0 where S is even over each ring, up to 1 where it lies at few places."""
        return 0.0 if self.places is None else self.places.weight

    @property
    def noise_to_signal(self) -> Array:
        """(RINGS,) N / S."""
        return self.noise / self.signal

    @property
    def between_rings_and_level(self) -> PictureStatistics:
        """The same with noise half way, by its logarithm, from the rings' own to the level that was measured in light.

        The rings' takes in the overtones of blurred edges, most of all at low frequencies; the level is that of the
        frequencies where signal and noise are about equal, and a coder's noise is not level.  The truth lies between.
        """
        return replace(self, noise=np.sqrt(self.noise) * self.noise_levels)

    @property
    def gradient_scale(self) -> float:
        """Unit u of the prior exp(−|∇f/u|^⅔): of edges, that stand out of the sharp picture's mean square gradient."""
        # forward differences pass 4 sin²(π f_x); its mean over a ring's directions is 2 − 2 J0(2π f)
        gain = 2 - 2 * _bessel_j0(2 * np.pi * self.frequency)
        area = 2 * np.pi * self.frequency * (self.frequency[1] - self.frequency[0]) * (self.frequency < 0.5)
        return float(_EDGES_BEYOND * np.sqrt(np.sum(area * gain * self.signal)) / _HYPER_LAPLACIAN_RMS)

    @property
    def finest(self) -> float:
        """Highest frequency, in cycles per pixel, at which more of the picture than of noise comes through the blur."""
        clear = np.flatnonzero(self.passed * self.signal > self.noise)
        return float(self.frequency[clear[-1] if len(clear) else 0])

    def scaled(self, scale: float) -> PictureStatistics:
        """Those of the same picture ``scale`` times as large, each pixel the mean of what it covers; the rings stay."""
        return replace(
            self,
            frequency=self.frequency / scale,
            signal=scale**2 * self.signal,
            noise=scale**2 * self.noise,
            noise_levels=scale * self.noise_levels,
        )

    @property
    def expected_gain_db(self) -> float:
        """What the ideal linear filter gains over leaving the blur, by these spectra; 0 or more, 0 if not measured."""
        if not self.measured:
            return 0.0
        if self.places is not None:
            return self.places.expected_gain_db(self.signal, self.noise)
        area = self.frequency
        through = self.passed * self.signal
        left = np.sum(area * ((1 - np.sqrt(self.passed)) ** 2 * self.signal + self.noise))
        restored = np.sum(area * self.signal * self.noise / (through + self.noise))
        return float(10 * np.log10(left / restored))


def measure_picture(
    picture: NDArray[np.uint8],
    field: KernelField,
    curve: ResponseCurve,
    clipped: NDArray[np.uint8] | None = None,
    most_tiles: int = MANY_TILES,
) -> tuple[PictureStatistics, PictureStatistics]:
    """Fit |G|² = |K|² S + N over tiles at the field's centres, ring by ring.

    picture: (height, width, 3) RGB.  clipped: (height, width), 1 where light was too much to be measured; it and what a
    path reaches from it are left out.  Returns the statistics of luma and of chroma, both colour differences together.
    """
    corners = _corners(field, picture.shape[:2])
    if not corners or field.radius_px >= _SIDE // 2:
        return _unknown_picture(), _unknown_picture()
    chosen = _least_clipped(clipped, corners, most_tiles)
    kernels = field.chosen(chosen).arrays()
    passed = np.stack([_passed(kernel) for kernel in kernels])
    known = [None if clipped is None else _known(clipped, corners[i], k) for i, k in zip(chosen, kernels, strict=True)]

    parts = [cv2.split(cv2.cvtColor(_cut(picture, corners[i]), cv2.COLOR_RGB2YCrCb)) for i in chosen]

    def observed(plane: int, every: int) -> NDArray[np.float32]:
        tiles = zip(parts[::every], known[::every], strict=True)
        return np.stack([_windowed_power(part[plane], seen) for part, seen in tiles])

    tiles = zip(chosen, known, strict=True)
    light = np.stack([_windowed_power(_evenly_steep(_cut(picture, corners[i]), curve), seen) for i, seen in tiles])
    colour = (observed(1, 2) + observed(2, 2)) * np.float32(0.5)
    luma, red, _ = cv2.split(cv2.cvtColor(_some_rows(picture), cv2.COLOR_RGB2YCrCb))
    cells, white_levels = _RingCells(passed), white_noise(luma)
    grey, cells_of_colour = observed(0, 1), _RingCells(passed[::2])
    of_light, of_luma, of_chroma = _fit_rings(
        (light, cells, white_levels), (grey, cells, white_levels), (colour, cells_of_colour, white_noise(red))
    )
    of_luma = replace(of_luma, noise_levels=of_light.noise_levels)
    weight = _unevenness(max(of_luma.misfit, _scatter(of_luma, grey, passed) / _SINGLE_PLACES), len(chosen))
    if not weight:
        return of_luma, of_chroma
    return (
        replace(of_luma, places=_place_statistics(of_luma, grey, passed, weight)),
        replace(of_chroma, places=_place_statistics(of_chroma, colour, passed[::2], weight)),
    )


def _some_rows(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Every other four rows of a picture (height, width, 3): enough for :func:`white_noise`, which looks at such."""
    height, width, channels = picture.shape
    return picture[: height - height % 8].reshape(-1, 8, width, channels)[:, :4].reshape(-1, width, channels)


def _unevenness(misfit: float, tiles: int) -> float:
    """0 where a misfit on so many tiles is an ordinary picture's, to 1 where its power lies at few places."""
    misfit *= min(1.0, float(np.sqrt(tiles / MANY_TILES)))
    return float(np.clip((misfit - _LITTLE_MISFIT) / (_LARGE_MISFIT - _LITTLE_MISFIT), 0.0, 1.0))


def _scatter(rings: PictureStatistics, observed: NDArray[np.float32], passed: NDArray[np.float32]) -> float:
    """Standard deviation of ln |G|² about the fit's along the axes, where upright things have their power.

    Boards, print and the coder's blocks have more of it there than elsewhere, but about as much everywhere; upright
    bars and lying blinds have theirs at few places.  observed, passed: as in :func:`_place_statistics`.
    """
    rows, columns = _axes()
    ring = _place_ring()[rows, columns]
    seen, k = (spectra[:, rows, columns].mean(axis=0) for spectra in (observed, passed))
    return float(np.std(np.log(np.maximum(seen, _ROUNDING_POWER) / (k * rings.signal[ring] + rings.noise[ring]))))


@lru_cache(maxsize=1)
def _axes() -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the places of :func:`_power` that :func:`_ring_index` leaves out near the axes."""
    fy, fx = np.fft.fftfreq(_SIDE)[:, None], np.arange(1, _SIDE // 2)[None, :] / _SIDE
    radius = np.hypot(fx, fy)
    rows, columns = np.nonzero((_ring_index(_SIDE) == RINGS) & (radius > 2.5 / _SIDE) & (radius < 0.5))
    return rows, columns


def _place_statistics(
    rings: PictureStatistics, observed: NDArray[np.float32], passed: NDArray[np.float32], weight: float
) -> PlaceStatistics:
    """S of each place, (|G|² − N) / |K|² around it, as far as that is known; else what is typical of its ring.

    Typical is the mean of the logarithm, which a few strong places do not raise, over those that come through the blur.
    observed, passed: |G|² and |K|² of the tiles, (n, _SIDE, _SIDE / 2 - 1).
    """
    count, ring = _INDEPENDENT * len(observed), _place_ring()
    signal, noise = rings.signal[ring], rings.noise[ring]
    seen, k = (_around(np.asarray(spectra.mean(axis=0))) for spectra in (observed, passed))
    k = np.maximum(k, 1e-6)
    own, doubt = (seen - noise) / k, noise / (k * np.sqrt(count))
    most = np.maximum(_STEEPEST_PLACE * signal, seen - noise)
    logarithms = np.log(np.clip(own, np.minimum(doubt, signal), most) / signal)
    reliable = k * signal / (k * signal + noise)
    sums, counts = (np.bincount(ring.ravel(), w.ravel(), RINGS) for w in (reliable * logarithms, reliable))
    typical = signal * np.exp(np.minimum(sums / (counts + _FEW_PLACES), 0.0))[ring]
    known = count / (count + (1 + noise / (k * typical)) ** 2)
    found = np.clip(typical + known * (own - typical), np.minimum(doubt, typical), most)
    return PlaceStatistics(weight, ((found / signal) ** weight).astype(np.float32), k.astype(np.float32))


def _around(spectrum: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mean of each place and its eight neighbours; the rows go round."""
    return cv2.blur(cv2.copyMakeBorder(spectrum, 1, 1, 0, 0, cv2.BORDER_WRAP), (3, 3))[1:-1]


@lru_cache(maxsize=1)
def _place_ring() -> NDArray[np.intp]:
    """Ring of each place of :func:`_power`, the highest for those beyond half a cycle per pixel."""
    fy, fx = np.fft.fftfreq(_SIDE)[:, None], np.arange(1, _SIDE // 2)[None, :] / _SIDE
    return np.minimum((np.hypot(fx, fy) / 0.5 * RINGS).astype(np.intp), RINGS - 1)


def _evenly_steep(tile: NDArray[np.uint8], curve: ResponseCurve) -> NDArray[np.float32]:
    """Light of a tile (height, width, 3) as grey levels (height, width) of the straight curve through its mean."""
    weights = np.array([[LUMA_RED, 1 - LUMA_RED - LUMA_BLUE, LUMA_BLUE]], np.float32)
    light = cv2.transform(cv2.LUT(tile, curve.linear_table()), weights)
    mean_level = 255 * float(curve.encode(np.array(light.mean())))
    return np.asarray(light * np.interp(mean_level, np.arange(256), curve.slope_table()), np.float32)


def _least_clipped(
    clipped: NDArray[np.uint8] | None, corners: list[tuple[int, int]], most_tiles: int
) -> NDArray[np.intp]:
    """Numbers of the tiles to measure: at most so many, evenly over those with the least clipped light."""
    chosen = np.arange(len(corners))
    if clipped is not None:
        parts = np.array([np.count_nonzero(_cut(clipped, corner)) for corner in corners]) / _SIDE**2
        chosen = np.flatnonzero(parts <= max(_MAX_CLIPPED, float(np.quantile(parts, 0.25))))
    return chosen[:: int(np.ceil(len(chosen) / most_tiles))]


def _known(
    clipped: NDArray[np.uint8], corner: tuple[int, int], kernel: NDArray[np.float32]
) -> NDArray[np.float32] | None:
    """1.0 where a tile shows no light that a path reaches from clipped light; None: everywhere."""
    tile = _cut(clipped, corner)
    if not tile.any():
        return None
    reach = (kernel + kernel[::-1, ::-1] > _ON_PATH).astype(np.uint8)
    return np.float32(1) - cv2.dilate(cv2.dilate(tile, reach), np.ones((3, 3), np.uint8))


def white_noise(plane: NDArray[np.uint8]) -> float:
    """Standard deviation of a plane's white noise, grey levels: the median absolute second difference both ways.

    Immerkær 1996, doi:10.1006/cviu.1996.0060; edges and texture are outliers to the median.
    """
    above, here, below = (plane[first : len(plane) - 4 + first : 4].astype(np.int16) for first in (1, 2, 3))
    down = above - 2 * here + below
    residual = down[:, 1:-3:4] - 2 * down[:, 2:-2:4] + down[:, 3:-1:4]
    return _median(np.abs(residual)) / 0.6745 / 6.0


def _median(levels: NDArray[np.int16]) -> float:
    """The median of whole numbers from 0 on, by their histogram: quicker than by their order."""
    reached = np.cumsum(np.bincount(levels.ravel()))
    middles = (reached[-1] + 1) // 2, reached[-1] // 2 + 1
    return float(np.mean(np.searchsorted(reached, middles)))


def _corners(field: KernelField, shape: tuple[int, ...]) -> list[tuple[int, int]]:
    """(top, left) of the tile around each centre, moved inside the picture; none if the picture is too small."""
    height, width = shape
    if min(height, width) < _SIDE:
        return []
    corners = np.clip(field.centres_px[:, ::-1] - _SIDE / 2, 0, (height - _SIDE, width - _SIDE))
    return [(top, left) for top, left in corners.astype(int).tolist()]


def _cut(plane: NDArray[np.uint8], corner: tuple[int, int]) -> NDArray[np.uint8]:
    return plane[corner[0] : corner[0] + _SIDE, corner[1] : corner[1] + _SIDE]


def _windowed_power(
    tile: NDArray[np.uint8] | NDArray[np.float32], known: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Power of a tile less its mean under a Hann window; white noise of variance σ² gives σ² everywhere.

    What is not known (0 in ``known``) is filled in smoothly and adds no power.
    """
    values, power = tile.astype(np.float32), float(_WINDOW_POWER)
    if known is not None:
        values, power = _smoothly_filled(values, known), max(float(np.vdot(_WINDOW**2, known)), 1.0)
    mean = np.float32(np.vdot(values, _WINDOW) / _WINDOW_SUM)
    return _power((values - mean) * _WINDOW) / np.float32(power)


def _smoothly_filled(values: NDArray[np.float32], known: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means of what is known around each unknown place, over the smallest neighbourhood that knows any."""
    filled, left = values * known, known == 0
    for side in _FILLING_PX:
        near = cv2.blur(known, (side, side))
        here = left & (near > 0.1)
        filled[here] = (cv2.blur(values * known, (side, side))[here]) / near[here]
        left &= ~here
    if left.any():
        filled[left] = filled[~left].mean() if not left.all() else 0.0
    return filled


def _passed(kernel: NDArray[np.float32]) -> NDArray[np.float32]:
    """|K|² as seen through the tile's window."""
    padded = np.zeros((_SIDE, _SIDE), np.float32)
    padded[: kernel.shape[0], : kernel.shape[1]] = kernel
    return cv2.blur(_power(padded), (3, 3), borderType=cv2.BORDER_REPLICATE)


def _power(tile: NDArray[np.float32]) -> NDArray[np.float32]:
    """|F|² at the horizontal frequencies 1 ... side / 2 − 1 of the transform, (side, side / 2 − 1)."""
    packed = cv2.dft(tile)[:, 1:-1]
    squares = packed * packed
    return squares[:, ::2] + squares[:, 1::2]


@lru_cache(maxsize=8)
def _ring_index(side: int) -> NDArray[np.intp]:
    """Ring of each place of :func:`_power`; RINGS for those beyond half a cycle per pixel, and for the lowest."""
    fy, fx = np.fft.fftfreq(side)[:, None], np.arange(1, side // 2)[None, :] / side
    radius = np.hypot(fx, fy)
    ring = (radius / 0.5 * RINGS).astype(np.intp)
    return np.where(
        (radius < 0.5) & (radius > 2.5 / side) & (np.abs(fx) > 1.5 / side) & (np.abs(fy) > 1.5 / side), ring, RINGS
    )


class _RingCells:
    """The places of all tiles' spectra, sorted into cells of equal ring and nearly equal |K|²."""

    def __init__(self, passed: NDArray[np.float32]) -> None:
        """passed: |K|² of each tile, as :func:`_power` orders it."""
        share = np.minimum((passed * np.float32(_CELLS)).astype(np.intp), _CELLS - 1)
        self._cell = (_ring_index(_SIDE) * _CELLS + share).ravel()
        self.count = self._sums(None)
        """(RINGS, _CELLS) places in each cell."""
        self.passed = self.means(passed)

    def means(self, values: NDArray[np.float32]) -> Array:
        """(RINGS, _CELLS) mean of each cell; 0 where it is empty."""
        return np.asarray(self._sums(values.ravel()) / np.maximum(self.count, 1))

    def _sums(self, weights: NDArray[np.float32] | None) -> Array:
        sums = np.bincount(self._cell, weights, (RINGS + 1) * _CELLS).astype(np.float64)
        return sums[: RINGS * _CELLS].reshape(RINGS, _CELLS)


def _fit_rings(*spectra: tuple[NDArray[np.float32], _RingCells, float]) -> list[PictureStatistics]:
    """Weighted least squares of |G|² = |K|² S + N in every ring, on cells of equal ring and nearly equal |K|².

    spectra: |G|², its cells, and the white noise of the picture that it is of; all are fitted at once.
    """
    count, k, g = (
        np.stack(parts)
        for parts in zip(*((cells.count, cells.passed, cells.means(seen)) for seen, cells, _ in spectra), strict=True)
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
        noise = np.clip((wkk * wg - wk * wkg) / determinant, _ROUNDING_POWER, None)
    spread = np.sqrt(np.maximum((count * k * k).sum(-1) / in_ring - mean_k**2, 0))
    determined = (spread > 0.1) & (mean_k < _MUST_CANCEL) & (in_ring > 20)
    found = []
    for i, (_, _, white_levels) in enumerate(spectra):
        settled = _settled(signal[i], noise[i], mean_k[i], mean_g[i], determined[i], white_levels)
        misfit = _misfit(count[i], g[i], settled.noise[:, None] + settled.signal[:, None] * k[i])
        found.append(replace(settled, misfit=misfit))
    return found


def _misfit(count: Array, observed: Array, expected: Array) -> float:
    """RMS of ln(observed / expected) over the cells, by their places; of what is below the rounding's power, none."""
    weight = count * (count >= _PLACES_IN_CELL)
    logarithms = np.log(np.maximum(observed, _ROUNDING_POWER) / np.maximum(expected, _ROUNDING_POWER))
    return float(np.sqrt(np.sum(weight * logarithms**2) / max(np.sum(weight), 1.0)))


def _settled(
    signal: Array,
    noise: Array,
    passed: Array,
    observed: Array,
    determined: NDArray[np.bool_],
    white_levels: float,
) -> PictureStatistics:
    """Rings that cannot tell S from N borrow the noise of those that can; S never rises with frequency.

    Kernels too short to cancel anything leave the noise open: then it is what a picture's second differences say, and
    at most what the highest frequencies hold.
    """
    frequency = (np.arange(RINGS) + 0.5) * 0.5 / RINGS
    if determined.any():
        noise = np.interp(frequency, frequency[determined], noise[determined])
        noise = np.maximum.accumulate(noise[::-1])[::-1]
        noise *= _growth_downwards(frequency, noise, determined, observed)
    else:
        noise = np.full(RINGS, max(min(float(observed[-3:].mean()), 2 * white_levels**2), _ROUNDING_POWER))
    through = np.maximum(observed - noise, 0.05 * observed) / np.maximum(passed, 0.05)
    signal = np.where(determined, signal, through)
    signal = np.maximum(np.maximum.accumulate(signal[::-1])[::-1], 1e-3 * noise)
    signal = _as_detail_falls(frequency, signal, passed, noise)
    return PictureStatistics(frequency, signal, noise, passed, _standard_deviation(frequency, passed * signal, noise))


def _standard_deviation(frequency: Array, through: Array, noise: Array) -> float:
    """That of the noise, weighted to where about as much of the signal comes through the blur."""
    weight = frequency * through * noise / (through + noise) ** 2
    return float(np.sqrt(np.sum(weight * noise) / np.sum(weight)))


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


def falling_power(frequency: Array, signal: Array, ring: int) -> Array:
    """S by a ring's own, falling as f⁻³: between edges (f⁻³) and the lens's softening of the texture."""
    return np.asarray(signal[ring] * (frequency[ring] / frequency) ** _DETAIL_SLOPE)


def _unknown_picture() -> PictureStatistics:
    """Nothing could be measured: the picture is smaller than a tile, or the blur larger."""
    frequency = (np.arange(RINGS) + 0.5) * 0.5 / RINGS
    return PictureStatistics(frequency, np.ones(RINGS), np.ones(RINGS), np.ones(RINGS), 1.0, False)


@lru_cache(maxsize=8)
def packed_frequency(size: int) -> NDArray[np.float32]:
    """Frequency in cycles per pixel of each place of OpenCV's packed spectrum, (size, size)."""
    index = (np.arange(size) + 1) // 2
    along = np.minimum(np.arange(size), size - np.arange(size)) / size
    packed = np.hypot(along[:, None], index[None, :] / size)
    packed[:, 0] = index / size
    packed[:, -1] = np.hypot(index / size, 0.5)
    return packed.astype(np.float32)


def on_spectrum(
    statistics: PictureStatistics, ring_values: Array, size: int, scale: float = 1.0, by_place: bool = True
) -> NDArray[np.float32]:
    """Noise-to-signal of the rings spread over a packed spectrum of a tile; falls as f² below the lowest ring.

    scale: pixels of the measured picture per pixel of the tile, 2 for a picture of half the size.  by_place: where S
    is uneven, by each place's own.
    """
    below, part, falling = _between_rings(size, _widening(statistics, scale))
    levels = np.log(ring_values).astype(np.float32)
    values = np.exp(levels[below] + part * np.append(np.diff(levels), np.float32(0))[below]) * falling
    if statistics.places is not None and by_place:
        values = values / _spread_places(statistics.places.share, size, _widening(statistics, scale))
    return np.asarray(values, np.float32)


def _widening(statistics: PictureStatistics, scale: float) -> float:
    """Pixels of the picture whose rings were measured per pixel of a tile."""
    return scale * float(statistics.frequency[0] + statistics.frequency[-1]) / 0.5


def _spread_places(share: NDArray[np.float32], size: int, scale: float) -> NDArray[np.float32]:
    """Values at the places of :func:`_power` on a packed spectrum (size, size); the nearest beyond them."""
    rising = np.roll(share, _SIDE // 2, axis=0)
    return cv2.remap(rising, *_on_places(size, scale), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


@lru_cache(maxsize=8)
def _on_places(size: int, scale: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Column and row, rows from the lowest frequency on, at which each place of a packed spectrum lies."""
    packed = (np.arange(size) + 1) // 2 / size
    fx, fy = (a.copy() for a in np.broadcast_arrays(packed[None, :], np.fft.fftfreq(size)[:, None]))
    fx[:, -1] = 0.5
    fy[:, 0] = fy[:, -1] = packed
    return (fx / scale * _SIDE - 1).astype(np.float32), (fy / scale * _SIDE + _SIDE // 2).astype(np.float32)


@lru_cache(maxsize=8)
def _between_rings(size: int, scale: float) -> tuple[NDArray[np.intp], NDArray[np.float32], NDArray[np.float32]]:
    """Ring below each place of a packed spectrum, part of the way to the next one, and f² below the lowest ring."""
    position = packed_frequency(size) / scale * (RINGS / 0.5) - 0.5
    held = np.clip(position, 0, RINGS - 1)
    below = np.floor(held).astype(np.intp)
    falling = np.minimum((position + 0.5) / 0.5, 1.0) ** 2
    return below, (held - below).astype(np.float32), falling.astype(np.float32)


def _bessel_j0(x: Array) -> Array:
    angle = (np.arange(64) + 0.5) * np.pi / 64
    return np.cos(x[:, None] * np.sin(angle)).mean(axis=1)
