"""Deconvolution tile by tile in the Fourier domain.

A tile is a window of the picture with a margin around it, made periodic by a smooth bridge, so that no artificial edge
causes ringing.  Its spectrum is kept in OpenCV's packed form, real and imaginary parts side by side, so real filters
are plain products.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import repeat

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.image_formation import transforms
from virest.image_formation.blur import FAST_SIZES, Image, TileGrid, fast_size, tile_grid
from virest.restoration.deconvolution import richardson_lucy

LEAST_SIDE, LARGEST_SIDE = 0.8, 1.15
"""Least and largest side of tiles, relative to the requested one, when searching for a fast transform size."""
LITTLE_LONGER = 1.05
"""Accept a grid that takes up to this many times the fastest one's time if its side is nearer to the requested one."""
SETTLING_ITERATIONS, SETTLING_RELAXATION = 6, 1.7
"""About as good as ten plain Richardson–Lucy steps.  On nine simulated captures with lamps they gain 0.1 dB on average
(−0.05 to +0.35 dB) over four; with eight, two of the phones' lose 0.15 dB."""
HIGHLIGHT_BLEND_LEVEL = 0.02
"""Highlight level, in units of the recorded range, at which the blend is half Richardson–Lucy."""
LEAST_TRUSTED = 0.3
"""Least mean trust of a tile for a further picture to be joined to it: below, it is not worth the transforms."""
Filter = Callable[[Image], Image]
"""Turns a kernel's |K|² (packed, each value on both parts) into the real factor to be applied after conj(K)."""


@dataclass(frozen=True, slots=True)
class FurtherPicture:
    """Another picture of the same scene, registered to the pixels of the tiles' picture."""

    channels: Sequence[Image]
    """(height, width) each."""
    kernels: Image
    """(tiles, k, k)."""
    sharpness: Sequence[tuple[Image, Image]]
    """Mean attenuation by its registration error, per tile: a packed real factor s, and 1 − s²."""
    trust: Image
    """(height, width) 0 to 1."""
    weight: float = 1.0
    """Multiplies the trust."""
    variance: Image | None = None
    """Var K on a packed spectrum; None: exact kernels."""


LEAST_RATIO = 1e-12
"""Keeps divisors above 0 where N / S is 0, as at frequency 0."""


class TileDeconvolution:
    """Windows, margins and kernels of one picture, to filter any number of its channels.

    Methods that return iterators yield one spectrum at a time: a tile that is filtered and blended at once stays in
    the cache.
    """

    def __init__(
        self,
        grid: TileGrid,
        kernels: Image,
        margin: int,
        bridge: int | None = None,
        variance: Callable[[int], Image] | None = None,
    ) -> None:
        """bridge: its least length, px; None: the margin.  variance: Var K on a packed spectrum; None: exact kernels.

        With E[K] for K and E|K|² for |K|², all filters minimise the expected data term.
        """
        self.grid = grid
        self.margin = margin
        self.patch = grid.side + 2 * margin
        self.size = fast_size(self.patch + (margin if bridge is None else bridge))
        self._windows = grid.windows()
        self._bridge = _bridge(self.size - self.patch)
        self._tile, self._spectrum, self._divisor = np.empty((3, self.size, self.size), np.float32)
        self.kernels = np.empty((len(kernels), self.size, self.size), np.float32)
        """(tiles, size, size) packed spectra, see :func:`_kernel_spectra`."""
        self.powers = np.empty_like(self.kernels)
        """(tiles, size, size) E|K|², as real factors."""
        for _ in map(_power_inside, _kernel_spectra(kernels, self.size, self.kernels), self.powers):
            pass
        _power_at_ends(self.kernels, self.powers)
        if variance is not None:
            self.powers += variance(self.size)
        self._joined: list[Image] = []
        """Σ w K_kᵀ g_k over all pictures: per channel, (tiles, size, size) spectra; empty: no further pictures."""
        self._without_highlights: dict[int, Image] = {}
        """By tile number: spectrum of the recorded tile with its clipped highlights removed."""
        self._rest: dict[int, Image] = {}
        """By tile number: spectrum of the Richardson–Lucy solution without the highlights."""
        self._highlights: dict[int, tuple[Image, Image]] = {}
        """By tile number: weight of the Richardson–Lucy solution and its weighted light, (side, side) each."""

    def filters(self, make: Filter) -> Iterator[Image]:
        """The packed real factor of each tile."""
        return map(make, self.powers)

    def back_projected(self, channel: Image, number_joined: int = 0) -> Image:
        """Spectra of Kᵀ g, (tiles, size, size); channel (height, width) is extended by replication, never wrapped.

        After :meth:`join`, the sum over all pictures for the channel ``number_joined`` instead.  In tiles whose
        highlights were removed, g is the recorded light without them.
        """
        if self._joined:
            return self._joined[number_joined]
        padded, projected = self.padded(channel), np.empty_like(self.kernels)
        ends = np.empty((*self.kernels.shape[:2], 2), np.float32)
        for number, corner in enumerate(self.grid.corners()):
            spectrum = self._recorded(padded, number, corner)
            inner = _inner_numbers(projected[number])
            np.multiply(_inner_numbers(spectrum), _inner_numbers(self.kernels[number]), out=inner)
            ends[number] = _ends(spectrum)
        _ends(projected)[:] = _ends_product(ends, _ends(self.kernels))
        return projected

    def _recorded(self, padded: Image, number: int, corner: tuple[int, int]) -> Image:
        """Spectrum of a recorded tile, without its highlights where these were removed; valid until the next call."""
        spectrum = self._without_highlights.get(number)
        return transforms.forward(self.periodic(padded, *corner), self._spectrum) if spectrum is None else spectrum

    def join(
        self,
        channels: Sequence[Image],
        further: Sequence[FurtherPicture],
        ratio: Image,
        factors: Sequence[float] | None = None,
    ) -> None:
        """Add further pictures of the same scene to the data term; channels (height, width) of the tiles' own picture.

        Registration error acts as extra noise, (1 − s²) |K|² of the signal, and so does the kernel's variance, beside
        the frame's own, N / S ``ratio``; both reduce the further picture's weight.  Its power E|K|² stays, as in any
        expected data term.  A tile weighs by its mean trust.  Untrusted pixels are replaced by the linear filter's
        estimate from the pictures joined so far, blurred by the further picture's kernel, which adds no information; so
        pictures that are trusted all over a tile are joined first.

        Noise may be common to all pictures, since a coder repeats a still scene with its noise.  Common noise N is
        back-projected to |Σ w K|² N, independent noise to Σ w |K|² N.  Along different paths the former is no larger;
        along one path it is, and nothing is gained.  The data term is weighted by the ratio of the two, at most 1.

        The work is done tile by tile, so that the data stay in the cache.
        """
        padded = [self.padded(channel) for channel in channels]
        others = [_Joining(self, one) for one in further]
        self._joined = [np.empty_like(self.kernels) for _ in channels]
        one, sums, *_ = buffers = np.empty((4, self.size, self.size), np.float32)
        for number, corner in enumerate(self.grid.corners()):
            power, projected = self.powers[number], [joined[number] for joined in self._joined]
            for plane, back in zip(padded, projected, strict=True):
                _product(self._recorded(plane, number, corner), self.kernels[number], back)
            telling = sorted(
                (other for other in others if other.used[number]), key=lambda other: not other.whole[number]
            )
            if not telling:
                continue
            sums[:] = self.kernels[number]
            own_ratio = ratio if factors is None else cv2.multiply(ratio, factors[number])
            least = cv2.add(own_ratio, LEAST_RATIO)
            for other in telling:
                known: list[Image] = []
                if not other.whole[number]:
                    divisor = cv2.add(power, own_ratio)
                    rest = self._rest.get(number)
                    known = [cv2.divide(b, divisor) for b in projected] if rest is None else [rest]
                other.add(number, known, (own_ratio, least), power, projected, buffers)
            _whole_power(sums, one)
            evidence = cv2.divide(power, cv2.max(cv2.max(one, power), LEAST_RATIO), one)
            for spectrum in (power, *projected):
                cv2.multiply(spectrum, evidence, spectrum)

    def touched(self, mask: Image) -> list[int]:
        """Numbers of the tiles that overlap a mask (height, width), margins included."""
        padded, patch = self.padded(mask), self.patch
        return [
            number
            for number, (top, left) in enumerate(self.grid.corners())
            if cv2.hasNonZero(padded[top : top + patch, left : left + patch])
        ]

    def remove_highlights(
        self, numbers: list[int], kernels: Image, channel: Image, weight: Image, top_light: float
    ) -> None:
        """Remove clipped highlights from some tiles, so that only light within the recorded range is left.

        A linear filter rings around a highlight, since the missing light there is many times what was recorded.
        Richardson–Lucy's multiplicative steps keep light positive and do not change the dark surroundings.  They
        estimate the light f = highlight + rest, where the highlight is the part above ``top_light``.  The blurred rest
        is then g − K highlight where g was measured, and K rest elsewhere.  kernels: of these tiles, non-negative.
        channel, weight: (height, width); the bridges have weight 0.
        """
        light, weights = self.padded(channel), self.padded(weight)
        corners, patch, margin = list(self.grid.corners()), self.patch, self.margin
        for number, kernel in zip(numbers, _kernel_spectra(kernels, self.size), strict=True):
            top, left = corners[number]
            measured = np.zeros((self.size, self.size), np.float32)
            measured[:patch, :patch] = weights[top : top + patch, left : left + patch]
            recorded = self.periodic(light, top, left)
            found = _sharpened(recorded, kernel, measured)
            rest = cv2.min(found, top_light)
            self._rest[number] = transforms.forward(rest)
            highlight = cv2.subtract(found, rest)
            blurred_rest, blurred_highlight = (_through(part, self.kernels[number], True) for part in (rest, highlight))
            left_over = recorded - blurred_highlight - blurred_rest
            self._without_highlights[number] = transforms.forward(
                cv2.add(blurred_rest, cv2.multiply(measured, left_over))
            )
            near = cv2.max(_through(blurred_highlight, self.kernels[number], False), 0.0)
            share = near / (near + np.float32(HIGHLIGHT_BLEND_LEVEL * top_light))
            inner = np.s_[margin : margin + self.grid.side, margin : margin + self.grid.side]
            self._highlights[number] = share[inner].copy(), (highlight + share * rest)[inner]

    def restore_highlights(self, picture: Image) -> Image:
        """A picture (height, width) restored from tiles without highlights, with the highlights put back.

        Along a highlight's streak the Richardson–Lucy solution is used: the codec's error there is proportional to the
        highlight's light, and a linear filter would spread it.
        """
        if not self._highlights:
            return picture
        grid, side = self.grid, self.grid.side
        shares, highlights = np.zeros((2, grid.tops[-1] + side, grid.lefts[-1] + side), np.float32)
        corners = list(grid.corners())
        for number, parts in self._highlights.items():
            top, left = corners[number]
            for part, whole in zip(parts, (shares, highlights), strict=True):
                cv2.accumulateProduct(part, self._windows[number], whole[top : top + side, left : left + side])
        shares, highlights = (whole[: grid.height, : grid.width] for whole in (shares, highlights))
        return cv2.add(cv2.subtract(picture, cv2.multiply(picture, shares)), highlights)

    def solutions(self, projected: Iterable[Image], regularisations: Iterable[Image]) -> Iterator[Image]:
        """Each tile's spectrum over |K|² + R, with its own regularisation R.

        A spectrum is valid until the next is requested, as those of :meth:`pulled` are.
        """
        divisor = self._divisor
        for spectrum, power, regularisation in zip(projected, self.powers, regularisations, strict=True):
            yield cv2.divide(spectrum, cv2.add(power, regularisation, divisor), divisor)

    def pulled(self, projected: Iterable[Image], pull: Image, factors: Iterable[float]) -> Iterator[Image]:
        """Each tile's spectrum plus its factor times that of ``pull`` (height, width).

        Beyond the picture's edges and on the bridges ``pull`` counts as 0: there the solution is a guess anyway.
        """
        padded, patch = self.padded(pull, cv2.BORDER_CONSTANT), self.patch
        tile, spectrum = np.zeros_like(self._tile), self._spectrum
        for (top, left), back, factor in zip(self.grid.corners(), projected, factors, strict=True):
            tile[:patch, :patch] = padded[top : top + patch, left : left + patch]
            transforms.forward(tile, spectrum)
            yield cv2.scaleAdd(spectrum, factor, back, spectrum)

    def blend(self, spectra: Iterable[Image]) -> Image:
        """Transform tiles back and blend them, weighted by the windows, into one picture (height, width)."""
        grid, side, margin = self.grid, self.grid.side, self.margin
        result = np.zeros((grid.tops[-1] + side, grid.lefts[-1] + side), np.float32)
        tile = self._tile
        for (top, left), window, spectrum in zip(grid.corners(), self._windows, spectra, strict=True):
            transforms.inverse(spectrum, tile)
            inner = tile[margin : margin + side, margin : margin + side]
            cv2.accumulateProduct(inner, window, result[top : top + side, left : left + side])
        return result[: grid.height, : grid.width]

    def padded(self, channel: Image, border: int = cv2.BORDER_REPLICATE) -> Image:
        """The channel with the margin that the outermost tiles need; border: OpenCV's border mode."""
        grid, margin = self.grid, self.margin
        below = grid.tops[-1] + grid.side + margin - grid.height
        right = grid.lefts[-1] + grid.side + margin - grid.width
        return cv2.copyMakeBorder(channel, margin, below, margin, right, border)

    def periodic(self, padded: Image, top: int, left: int) -> Image:
        """One tile with its margin, bridged from each edge to the opposite one, (size, size); valid until the next."""
        patch, tile, bridge = self.patch, self._tile, self._bridge
        tile[:patch, :patch] = padded[top : top + patch, left : left + patch]
        np.matmul(tile[:patch, patch - 1 :: 1 - patch], bridge, out=tile[:patch, patch:])
        np.matmul(bridge.T, tile[patch - 1 :: 1 - patch], out=tile[patch:])
        return tile


class _Joining:
    """A further picture while it is being joined to the tiles."""

    def __init__(self, tiles: TileDeconvolution, picture: FurtherPicture) -> None:
        self._tiles, self._sharpness, self._variance = tiles, picture.sharpness, picture.variance
        self._padded, self._trusted = [tiles.padded(c) for c in picture.channels], tiles.padded(picture.trust)
        self._corners, patch = list(tiles.grid.corners()), tiles.patch
        parts = [self._trusted[top : top + patch, left : left + patch] for top, left in self._corners]
        bounds = [cv2.minMaxLoc(part)[:2] for part in parts]
        means = [cv2.mean(part)[0] for part in parts]
        self.used = [mean > LEAST_TRUSTED for mean in means]
        """(tiles,) whether it is joined to a tile."""
        self.whole = [least > 0 for least, _ in bounds]
        """(tiles,) whether it is trusted all over a tile."""
        self._weights, self._most = [picture.weight * mean for mean in means], [most for _, most in bounds]
        chosen = picture.kernels[np.array(self.used, bool)]
        self._spectra = _kernel_spectra(chosen, tiles.size, repeat(np.empty_like(tiles.powers[0])))

    def add(
        self,
        number: int,
        known: Sequence[Image],
        ratios: tuple[Image, Image],
        power: Image,
        projected: Sequence[Image],
        buffers: Image,
    ) -> None:
        """Add it to a tile's power and projected channels, and w K to the second buffer; call with tiles in order.

        known: spectra of the sharp channels estimated without it.  ratios: N / S, and the same plus LEAST_RATIO.
        """
        one, sums, weight, back = buffers
        kernel = next(self._spectra)
        tiles, corner, share = self._tiles, self._corners[number], None
        if not self.whole[number]:
            share = np.zeros_like(one)  # 0 on the bridge, which is not a measurement
            top, left = corner
            part = self._trusted[top : top + tiles.patch, left : left + tiles.patch]
            cv2.multiply(part, 1 / self._most[number], share[: tiles.patch, : tiles.patch])
            forward = cv2.multiply(kernel, _conjugating(tiles.size))
        sharpness, lost = self._sharpness[number]
        ratio, least = ratios
        _whole_power(kernel, one)
        cv2.add(cv2.multiply(lost, one, weight), least, weight)
        if self._variance is not None:
            cv2.add(weight, self._variance, weight)
            cv2.add(one, self._variance, one)
        cv2.divide(ratio, weight, weight, self._weights[number])
        cv2.accumulateProduct(one, weight, power)
        cv2.multiply(kernel, cv2.multiply(sharpness, weight, weight), kernel)
        cv2.accumulate(kernel, sums)
        for channel, (plane, joined) in enumerate(zip(self._padded, projected, strict=True)):
            tile = tiles.periodic(plane, *corner)
            if share is not None:
                _product(known[channel], forward, back)
                predicted = transforms.inverse(back, one)
                tile = cv2.add(cv2.multiply(share, cv2.subtract(tile, predicted, back), back), predicted, back)
            _product(transforms.forward(tile, one), kernel, one)
            cv2.accumulate(one, joined)


def _sharpened(tile: Image, kernel: Image, weight: Image) -> Image:
    """Richardson–Lucy on a periodic tile."""

    def blur(sharp: Image) -> Image:
        return _through(sharp, kernel, True)

    def unblur(seen: Image) -> Image:
        return _through(seen, kernel, False)

    return richardson_lucy(tile, blur, unblur, tile, weight, SETTLING_ITERATIONS, SETTLING_RELAXATION)


def _through(picture: Image, kernel: Image, forward: bool) -> Image:
    """A periodic tile blurred by a kernel's spectrum, or by the transpose if ``forward`` is False."""
    return transforms.inverse(cv2.mulSpectrums(transforms.forward(picture), kernel, 0, conjB=forward))


@lru_cache(maxsize=64)
def quick_grid(height: int, width: int, side: int, around: int, overlap_parts: int, give: float = 0.0) -> TileGrid:
    """Tiles of about ``side`` px, of a size at which all their transforms together are fast.

    They overlap by side / overlap_parts, or by up to the fraction ``give`` less.  around: rows or columns that margins
    and bridge add to each tile.
    """
    sides = [size - around for size in FAST_SIZES]
    fitting = [s for s in sides if LEAST_SIDE * side <= s <= LARGEST_SIDE * side] or [side]
    grids = [
        tile_grid(height, width, s, overlap)
        for s in fitting
        for overlap in range(s // overlap_parts, int(np.ceil((1 - give) * (s // overlap_parts))) - 1, -1)
    ]
    pixels = [len(grid.tops) * len(grid.lefts) * fast_size(grid.side + around) ** 2 for grid in grids]
    quick = [(grid, count) for grid, count in zip(grids, pixels, strict=True) if count <= LITTLE_LONGER * min(pixels)]
    return min(quick, key=lambda found: (abs(found[0].side - side), found[1], -found[0].overlap))[0]


def _kernel_spectra(kernels: Image, size: int, into: Iterable[Image] | None = None) -> Iterator[Image]:
    """Packed spectra of kernels that the blur applies by correlation: a plain product applies the blur's transpose.

    into: output arrays, (size, size) each.
    """
    radius = kernels.shape[1] // 2
    buffer = np.zeros((size, size), np.float32)
    for kernel, spectrum in zip(kernels, repeat(None) if into is None else into, strict=False):
        buffer[: radius + 1, : radius + 1] = kernel[radius:, radius:]
        buffer[: radius + 1, size - radius :] = kernel[radius:, :radius]
        buffer[size - radius :, : radius + 1] = kernel[:radius, radius:]
        buffer[size - radius :, size - radius :] = kernel[:radius, :radius]
        yield transforms.forward(buffer, spectrum)


def _bridge(length: int) -> Image:
    """Weights (2, length) of a tile's last and first sample along the smooth bridge between them."""
    rise = (np.arange(length, dtype=np.float32) + 1) / (length + 1)
    smooth = rise * rise * (3 - 2 * rise)
    return np.stack([1 - smooth, smooth]).astype(np.float32)


def _power_inside(spectrum: Image, power: Image) -> None:
    """Write |K|² of all numbers except those of :func:`_ends`, as a real factor for packed spectra.

    OpenCV's own products take nearly twice as long, since they are not vectorised.
    """
    numbers, powers = _inner_numbers(spectrum), _inner_numbers(power)
    np.multiply(numbers, np.conjugate(numbers, out=powers), out=powers)
    powers *= np.complex64(1 + 1j)  # copy the real part to the imaginary one


def _power_at_ends(spectrum: Image, power: Image) -> None:
    """Write |K|² of the numbers of :func:`_ends`, with the real part's value on the imaginary part too."""
    ends = np.array(_ends(spectrum))
    ends *= ends
    ends[..., 1:-1:2, :] += ends[..., 2:-1:2, :]
    ends[..., 2:-1:2, :] = ends[..., 1:-1:2, :]
    _ends(power)[:] = ends


def _inner_numbers(packed: Image) -> NDArray[np.complex64]:
    """A view of packed spectra as one row of complex numbers.

    It wrongly pairs a row's last value with the next row's first: these are handled by :func:`_ends`.
    """
    return packed.reshape(-1)[1:-1].view(np.complex64)


def _ends(packed: Image) -> Image:
    """A view of the first and last column of packed spectra, where a number's two parts lie in alternate rows."""
    return packed[..., :: packed.shape[-1] - 1]


def _product(first: Image, second: Image, into: Image) -> None:
    """Write the product of two packed spectra; ``into`` may be one of the two."""
    ends = _ends_product(np.array(_ends(first)), np.array(_ends(second)))
    np.multiply(_inner_numbers(first), _inner_numbers(second), out=_inner_numbers(into))
    _ends(into)[:] = ends


def _whole_power(spectrum: Image, power: Image) -> None:
    """Write |K|², as a real factor for packed spectra."""
    _power_inside(spectrum, power)
    _power_at_ends(spectrum[None], power[None])


@lru_cache(maxsize=8)
def _conjugating(size: int) -> Image:
    """Signs (size, size) that turn a packed spectrum into its conjugate."""
    signs = np.ones((size, size), np.float32)
    signs[:, 2:-1:2] = -1
    signs[:, :: size - 1] = 1
    signs[2:-1:2, :: size - 1] = -1
    return signs


def _ends_product(first: Image, second: Image) -> Image:
    """The product of two :func:`_ends`: all numbers are complex except the corners, which are real."""
    product = first * second
    real, imaginary = np.s_[..., 1:-1:2, :], np.s_[..., 2:-1:2, :]
    product[real] -= product[imaginary]
    product[imaginary] = first[real] * second[imaginary] + first[imaginary] * second[real]
    return product


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
    """1 / |K|², limited to 1 / ``floor``: the naive inverse filter, for comparison."""
    return (1.0 / np.maximum(power, floor)).astype(np.float32)


def wiener_filter(power: Image, noise_to_signal: Image) -> Image:
    """1 / (|K|² + N / S), with the noise-to-signal ratio of each packed frequency."""
    return 1.0 / (power + noise_to_signal)
