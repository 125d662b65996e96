"""What was measured on a blurred picture: over rings of spatial frequency, and over places where those do not do."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from virest.image_formation.kernel_spread import KernelSpread
from virest.restoration.statistics.rings import RINGS, SIDE, place_ring

Array = NDArray[np.float64]
LUMA_RED, LUMA_BLUE = 0.299, 0.114
_HYPER_LAPLACIAN_RMS = 3.62
"""RMS of a variable with density ∝ exp(−|x|^⅔): sqrt(Γ(9/2)/Γ(3/2))."""
_EDGES_BEYOND = 2.0
"""A picture's edges exceed its mean spectrum by this factor: rings of tiles have the mean of edge and plain surface."""
_STANDS_OUT = 2.0
"""Gradients of this many times the noise survive the prior."""
_DETAIL_SLOPE = 3.0
"""The power of a natural picture falls with frequency about like f⁻³."""
ROUNDING_POWER = 1 / 12
_LIKELY_SQUARES, _LIKELY_WEIGHTS = np.polynomial.laguerre.laggauss(12)
"""Half the squares of distances, in standard deviations of each axis, and how likely each is, together 1."""
_DEAD_ZONE = 5 / 6
"""Part of its step below which an H.264 coder leaves a coefficient out, and of a further step at which it rounds up."""
_CODER_SHARE = (_DEAD_ZONE**3 + (1 - _DEAD_ZONE) ** 3) / 3
"""Error that leaves, as part of the step's square: of a remainder that is anywhere between two steps."""


@dataclass(frozen=True, slots=True)
class PlaceStatistics:
    """What rings do not tell: power over the places of a tile's spectrum, ordered as in :mod:`rings`."""

    weight: float
    """How far the rings' S is wrong: more than 0, and 1 from a large misfit on."""
    share: NDArray[np.float32]
    """(SIDE, SIDE / 2 - 1) S of each place over that of its ring."""
    passed: NDArray[np.float32]
    """(SIDE, SIDE / 2 - 1) mean |K|² of the kernels."""

    def after(self, passed: Array) -> PlaceStatistics:
        """The same after further blur that passes the given part (RINGS,) of |G|²."""
        return replace(self, passed=(self.passed * passed[place_ring()]).astype(np.float32))

    def expected_gain_db(self, signal: Array, noise: Array) -> float:
        """As :attr:`PictureStatistics.expected_gain_db`, by the rings' S and N, (RINGS,).

        More noise than what comes through the blur counts as that: it may be a grating that the kernels nearly cancel,
        and taking it away is no gain.
        """
        ring = place_ring()
        s, n = signal[ring] * self.share, noise[ring]
        through = self.passed * s
        left = np.sum((1 - np.sqrt(self.passed)) ** 2 * s + np.minimum(n, through))
        return max(float(10 * np.log10(left / np.sum(s * n / (through + n)))), 0.0)


@dataclass(frozen=True, slots=True)
class Misplaced:
    """What it costs that a picture's rows do not lie quite where they belong.

    Mean squares in grey levels, (n,), for n distances that are as likely as their weights say.
    """

    blurred: Array = field(default_factory=lambda: np.zeros(1))
    """Of the picture as it was recorded."""
    restored: Array = field(default_factory=lambda: np.zeros(1))
    """Of what an ideal filter makes of it: sharp edges beside their place are farther off than blurred ones."""
    removed: float = 0.0
    """What that filter takes off the squared error of rows in their place."""
    weight: Array = field(default_factory=lambda: np.ones(1))

    def errors(self, removed: float) -> tuple[Array, Array]:
        """Errors (n,) by misplaced rows before and after a restoration, by the squared error that it removes elsewhere.

        A restoration that removes less than the ideal filter sharpens less, and loses less by edges beside their place.
        """
        part = min(removed / self.removed, 1.0) if self.removed > 0 else 1.0
        return self.blurred, self.blurred + part * (self.restored - self.blurred)


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
    real: Array | None = None
    """(RINGS,) mean real part of the kernels' spectra: what of the picture stays in its place; None: √passed."""
    cells: tuple[Array, Array] | None = None
    """Places (RINGS, cells), and their |K|², which a ring's mean hides; None: the mean alone."""

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
    def drowned(self) -> float:
        """0 where the picture's gradients stand out of the noise, up to 1 where nothing does.

        A prior of sparse gradients then takes texture for noise.
        """
        return 1 - min(1.0, self.gradient_scale / self.noise_levels / _STANDS_OUT)

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

    def with_error_share(self, share: float) -> PictureStatistics:
        """With an error of ``share`` times S beside the noise: the known error of the model of light.

        It comes from edges, whose power lies everywhere; a grating's, which lies at few places, is as it is.
        """
        share *= 1 - self.unevenness
        return self._with_noise(self.noise + share * self.signal) if self.measured and share else self

    def with_coder_noise(self, step: float, share: float) -> PictureStatistics:
        """With no less than ``share`` of the noise that a quantiser of such a step leaves, grey levels."""
        if not self.measured:
            return self
        least = share * coder_noise(self.passed * self.signal + self.noise, step)
        return self._with_noise(np.maximum(self.noise, least))

    def _with_noise(self, noise: Array) -> PictureStatistics:
        """With more noise (RINGS,), and a level that has grown as the noise where it weighs."""
        through = self.frequency * self.passed * self.signal
        before, after = (
            np.sum(through * n * n / (self.passed * self.signal + n) ** 2)
            / np.sum(through * n / (self.passed * self.signal + n) ** 2)
            for n in (self.noise, noise)
        )
        return replace(self, noise=noise, noise_levels=self.noise_levels * float(np.sqrt(after / before)))

    def doubted_by(self, spread: KernelSpread | None) -> PictureStatistics:
        """With uncertain kernels: what their variance leaves unknown of S counts as noise."""
        if spread is None:
            return self
        over_places = spread.variance(SIDE)[:, 1 : SIDE // 2]
        sums = np.bincount(place_ring().ravel(), over_places.ravel(), RINGS)
        in_ring = sums / np.maximum(np.bincount(place_ring().ravel(), minlength=RINGS), 1)
        return replace(self, noise=self.noise + in_ring * self.signal)

    @property
    def expected_gain_db(self) -> float:
        """:meth:`joint_gain_db` of the picture by itself."""
        return self.joint_gain_db(np.zeros(RINGS))

    def joint_gain_db(self, further: Array) -> float:
        """What the ideal linear filter gains over leaving the blur, by these spectra; 0 or more, 0 if not measured.

        Left as it is, a picture misses (1 − K) F, |1 − K|² = 1 − 2 Re K + |K|²; where a path reverses a frequency
        that is more than all of it.  further: (RINGS,) weighted |K|² of further pictures restored with it.
        """
        if not self.measured:
            return 0.0
        if self.places is not None:
            return self.places.expected_gain_db(self.signal, self.noise)
        left = np.sum(self.frequency * (self._lost() + self.noise))
        return max(float(10 * np.log10(left / np.sum(self.frequency * self._wrong(further)))), 0.0)

    def ideal_error(self, further: Array) -> float:
        """Mean square, in grey levels, that the ideal linear filter leaves; arguments as of :meth:`joint_gain_db`."""
        return float(self._area() @ self._wrong(further))

    @property
    def blur_error(self) -> float:
        """Mean square, in grey levels, of what the picture misses for its blur."""
        return float(self._area() @ self._lost())

    def misplaced(self, std_px: float, further: Array) -> Misplaced:
        """What rows that lie wrong by ``std_px``, each axis, make of restoring; further: as of :meth:`joint_gain_db`.

        Of power S at f, restored to a part R and moved by δ, |1 − R e^{2πi f δ}|² S is missing: (1 − R)² as in its
        place and 2 R (1 − J₀(2π f |δ|)) for the move, in the mean over a ring; √|K|² for R where nothing was
        restored.  The square of a normal δ is distributed exponentially (Gauss–Laguerre quadrature).
        """
        off = 2 - 2 * _bessel_j0(2 * np.pi * np.outer(std_px * np.sqrt(2 * _LIKELY_SQUARES), self.frequency))
        passed, power = self.passed + further, self._area() * self.signal
        restored, blurred = passed * self.signal / (passed * self.signal + self.noise), np.sqrt(self.passed)
        removed = float(power @ ((1 - blurred) ** 2 - (1 - restored) ** 2))
        return Misplaced(off @ (power * blurred), off @ (power * restored), removed, _LIKELY_WEIGHTS)

    def _area(self) -> Array:
        return np.asarray(2 * np.pi * self.frequency * (self.frequency[1] - self.frequency[0]))

    def _lost(self) -> Array:
        """(RINGS,) power of (1 − K) F."""
        real = np.sqrt(self.passed) if self.real is None else self.real
        return np.asarray((1 - 2 * real + self.passed) * self.signal)

    def _wrong(self, further: Array) -> Array:
        """(RINGS,) power of what the ideal linear filter leaves."""
        count, passed = (np.ones((RINGS, 1)), self.passed[:, None]) if self.cells is None else self.cells
        signal, noise, passed = self.signal[:, None], self.noise[:, None], passed + further[:, None]
        wrong = count * signal * noise / (passed * signal + noise)
        return np.asarray(wrong.sum(axis=1) / np.maximum(count.sum(axis=1), 1))


def coder_noise(observed: Array, step: float) -> Array:
    """Noise (RINGS,) that a coder leaves in a picture, by the step of its quantiser.

    Of what stands far above the step an error of the step's own, and what lies far below it is left out: reverse
    water-filling (Cover & Thomas 2006, section 10.3.3), smooth between the two, for rings hold weak and strong places.
    """
    level = max(_CODER_SHARE * step**2, ROUNDING_POWER)
    falling = np.maximum(np.maximum.accumulate(observed[::-1])[::-1], ROUNDING_POWER)
    return np.asarray(level * falling / (level + falling))


def falling_power(frequency: Array, signal: Array, ring: int) -> Array:
    """S by a ring's own, falling as f⁻³: between edges (f⁻³) and the lens's softening of the texture."""
    return np.asarray(signal[ring] * (frequency[ring] / frequency) ** _DETAIL_SLOPE)


def unknown_picture() -> PictureStatistics:
    """Nothing could be measured: the picture is smaller than a tile, or the blur larger."""
    frequency = (np.arange(RINGS) + 0.5) * 0.5 / RINGS
    return PictureStatistics(frequency, np.ones(RINGS), np.ones(RINGS), np.ones(RINGS), 1.0, False)


def _bessel_j0(x: Array) -> Array:
    angle = (np.arange(64) + 0.5) * np.pi / 64
    return np.asarray(np.cos(x[..., None] * np.sin(angle)).mean(axis=-1))
