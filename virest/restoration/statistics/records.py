"""Statistics of a blurred picture: over rings of spatial frequency, and per frequency where rings do not fit.

A place is one frequency (row and column) of a tile's spectrum.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.capture.pixels import BT601_LUMA
from virest.image_formation.kernel_spread import KernelSpread
from virest.restoration.statistics.rings import RINGS, SIDE, place_ring

LUMA_RED, LUMA_GREEN, LUMA_BLUE = BT601_LUMA
PER_COLOUR_POWER = sum((2 * (1 - own)) ** 2 * (1 + (own / LUMA_GREEN) ** 2) / 3 for own in (LUMA_RED, LUMA_BLUE))
"""Mean square over red, green and blue of what errors of Cr and Cb make, over the mean of their powers: 1.91.

By ITU-R BT.601 they change red by 2 (1 − 0.299) Cr, blue by 2 (1 − 0.114) Cb, and green so that luma stays."""
_HYPER_LAPLACIAN_RMS = 3.62
"""RMS of a variable with density ∝ exp(−|x|^⅔): sqrt(Γ(9/2)/Γ(3/2))."""
_EDGES_BEYOND = 2.0
"""Edge amplitude over that of the mean spectrum: the tiles' rings average edges and plain surfaces."""
_STANDS_OUT = 2.0
"""Gradients of this many times the noise survive the prior."""
_DETAIL_SLOPE = 3.0
"""The power of a natural picture falls with frequency approximately as f⁻³."""
ROUNDING_POWER = 1 / 12
"""Variance of rounding to whole grey levels."""
_LIKELY_SQUARES, _LIKELY_WEIGHTS = np.polynomial.laguerre.laggauss(12)
"""Quadrature nodes: half the squared distance, in units of the variance per axis, and their weights, which sum to 1."""
DEAD_ZONE = 5 / 6
"""Fraction of its step below which an H.264 coder drops a coefficient, and of a further step at which it rounds up."""
_CODER_SHARE = (DEAD_ZONE**3 + (1 - DEAD_ZONE) ** 3) / 3
"""Mean square error of that rounding over the step's square, for remainders spread evenly over a step."""


@dataclass(frozen=True, slots=True)
class PlaceStatistics:
    """Power per place of a tile's spectrum, ordered as in :mod:`rings`."""

    weight: float
    """How far the rings' S is wrong: above 0, and 1 at a large misfit."""
    share: NDArray[np.float32]
    """(SIDE, SIDE / 2 - 1) S of each place over that of its ring."""
    passed: NDArray[np.float32]
    """(SIDE, SIDE / 2 - 1) mean |K|² of the kernels."""

    def after(self, passed: Array) -> PlaceStatistics:
        """The same after further blur that passes the fraction ``passed`` (RINGS,) of |G|²."""
        return replace(self, passed=(self.passed * passed[place_ring()]).astype(np.float32))

    def expected_gain_db(self, signal: Array, noise: Array) -> float:
        """As :attr:`PictureStatistics.expected_gain_db`, from the rings' S and N, (RINGS,).

        Removing noise counts as a gain only up to the power that passes the blur: the rest may be a grating that the
        kernels nearly cancel, and removing that is no gain.
        """
        ring = place_ring()
        s, n = signal[ring] * self.share, noise[ring]
        through = self.passed * s
        left = np.sum((1 - np.sqrt(self.passed)) ** 2 * s + np.minimum(n, through))
        return max(float(10 * np.log10(left / np.sum(s * n / (through + n)))), 0.0)


@dataclass(frozen=True, slots=True)
class Misplaced:
    """Error caused by rows that straightening puts slightly off their true positions.

    Mean squares in grey levels squared, (n,), for n displacements with the probabilities ``weight``.
    """

    blurred: Array = field(default_factory=lambda: np.zeros(1))
    """Error added to the recorded picture."""
    restored: Array = field(default_factory=lambda: np.zeros(1))
    """Error added to the ideal filter's result: displaced sharp edges differ more than displaced blurred ones."""
    removed: float = 0.0
    """Squared error that the ideal filter removes from rows at their true positions."""
    weight: Array = field(default_factory=lambda: np.ones(1))
    """Probabilities, (n,), which sum to 1."""

    def errors(self, removed: float) -> tuple[Array, Array]:
        """Errors (n,) by displaced rows before and after a restoration that removes the squared error ``removed``.

        A restoration that removes less than the ideal filter sharpens less, and loses less by displaced edges.
        """
        part = min(removed / self.removed, 1.0) if self.removed > 0 else 1.0
        return self.blurred, self.blurred + part * (self.restored - self.blurred)


@dataclass(frozen=True, slots=True)
class PictureStatistics:
    """Statistics of one blurred picture over rings of spatial frequency; powers in grey levels squared."""

    frequency: Array
    """(RINGS,) centre of each ring, cycles per pixel."""
    signal: Array
    """(RINGS,) power of the sharp picture."""
    noise: Array
    """(RINGS,) power of the noise."""
    passed: Array
    """(RINGS,) mean |K|² of the kernels."""
    noise_levels: float
    """Standard deviation of the noise, weighted to frequencies where signal and noise are about equal."""
    measured: bool = True
    """False if the picture could not be measured and the values are placeholders."""
    misfit: float = 0.0
    """RMS over the cells of ln of |G|² over the fit's |K|² S + N."""
    places: PlaceStatistics | None = None
    """S per place, for a picture that the rings do not fit; None: they fit."""
    real: Array | None = None
    """(RINGS,) mean real part of the kernels' spectra; None: √passed."""
    cells: tuple[Array, Array] | None = None
    """Number of places in each cell, (RINGS, cells), and its |K|², which varies within a ring; None: the ring's mean
    only."""
    signal_variance: float | None = None
    """Of what comes through the blur, within squares that hold one period of the lowest ring; None: not measured."""
    part_of_picture: float = 1.0
    """Mean variance over the picture's tiles, over that of the tiles whose spectra these are."""

    @property
    def unevenness(self) -> float:
        """0 if S is even over each ring, up to 1 if it lies at few places."""
        return 0.0 if self.places is None else self.places.weight

    @property
    def noise_to_signal(self) -> Array:
        """(RINGS,) N / S."""
        return self.noise / self.signal

    @property
    def between_rings_and_level(self) -> PictureStatistics:
        """The same with the geometric mean of two noise estimates: the rings' own, and the level measured in light.

        The rings' noise contains overtones of blurred edges, mostly at low frequencies.  The level holds where signal
        and noise are about equal, but coding noise is not white.  The truth lies between the two.
        """
        return replace(self, noise=np.sqrt(self.noise) * self.noise_levels)

    @property
    def gradient_scale(self) -> float:
        """Unit u, grey levels, of the prior exp(−|∇f/u|^⅔), from the sharp picture's mean square gradient."""
        # forward differences pass 4 sin²(π f_x); its mean over a ring's directions is 2 − 2 J0(2π f)
        gain = 2 - 2 * _bessel_j0(2 * np.pi * self.frequency)
        area = 2 * np.pi * self.frequency * (self.frequency[1] - self.frequency[0]) * (self.frequency < 0.5)
        return float(_EDGES_BEYOND * np.sqrt(np.sum(area * gain * self.signal)) / _HYPER_LAPLACIAN_RMS)

    @property
    def below_noise(self) -> float:
        """0 if the picture's gradients stand out of the noise, towards 1 the less they do.

        The sparse gradient prior then takes texture for noise.
        """
        return 1 - min(1.0, self.gradient_scale / self.noise_levels / _STANDS_OUT)

    @property
    def finest(self) -> float:
        """Highest frequency, cycles per pixel, at which the signal that passes the blur exceeds the noise."""
        clear = np.flatnonzero(self.passed * self.signal > self.noise)
        return float(self.frequency[clear[-1] if len(clear) else 0])

    def scaled(self, scale: float) -> PictureStatistics:
        """Statistics of the picture enlarged ``scale`` times, where pixels are means over the area that they cover.

        The rings stay the same, at other frequencies.
        """
        return replace(
            self,
            frequency=self.frequency / scale,
            signal=scale**2 * self.signal,
            noise=scale**2 * self.noise,
            noise_levels=scale * self.noise_levels,
        )

    def with_error_share(self, share: float) -> PictureStatistics:
        """With ``share`` times S added to the noise: the known error of the tone curve.

        The error comes from edges, whose power lies at all places; it is reduced by ``unevenness``, since a grating's
        power lies at few.
        """
        share *= 1 - self.unevenness
        return self._with_noise(self.noise + share * self.signal) if self.measured and share else self

    def with_coder_noise(self, step: float) -> PictureStatistics:
        """With the noise at least that of a quantiser with this step, grey levels.

        Few measured tiles scatter below it, and tiles without detail have less of it than those that a filter changes.
        """
        if not self.measured:
            return self
        least = coder_noise(self.passed * self.signal + self.noise, step)
        return self._with_noise(np.maximum(self.noise, least))

    def _with_noise(self, noise: Array) -> PictureStatistics:
        """With more noise (RINGS,), and ``noise_levels`` raised as the noise where signal and noise are about equal."""
        through = self.frequency * self.passed * self.signal
        before, after = (
            np.sum(through * n * n / (self.passed * self.signal + n) ** 2)
            / np.sum(through * n / (self.passed * self.signal + n) ** 2)
            for n in (self.noise, noise)
        )
        return replace(self, noise=noise, noise_levels=self.noise_levels * float(np.sqrt(after / before)))

    def with_kernel_variance(self, spread: KernelSpread | None) -> PictureStatistics:
        """With uncertain kernels: their variance times S is added to the noise."""
        if spread is None:
            return self
        over_places = spread.variance(SIDE)[:, 1 : SIDE // 2]
        sums = np.bincount(place_ring().ravel(), over_places.ravel(), RINGS)
        in_ring = sums / np.maximum(np.bincount(place_ring().ravel(), minlength=RINGS), 1)
        return replace(self, noise=self.noise + in_ring * self.signal)

    @property
    def expected_gain_db(self) -> float:
        """:meth:`joint_gain_db` of the picture alone."""
        return self.joint_gain_db(np.zeros(RINGS))

    def joint_gain_db(self, further: Array) -> float:
        """Gain of the ideal linear filter over the recorded picture, for these spectra; ≥ 0, and 0 if not measured.

        The recorded picture's error is (1 − K) F, with |1 − K|² = 1 − 2 Re K + |K|², which exceeds 1 where a path
        reverses the phase.  further: (RINGS,) weighted |K|² of further pictures restored with it; not used for a
        picture with ``places``.
        """
        if not self.measured:
            return 0.0
        if self.places is not None:
            return self.places.expected_gain_db(self.signal, self.noise)
        left = np.sum(self.frequency * (self._blur_loss() + self.noise))
        return max(float(10 * np.log10(left / np.sum(self.frequency * self._remaining_error(further)))), 0.0)

    def ideal_error(self, further: Array) -> float:
        """Mean square error, grey levels squared, of the ideal linear filter; further: as in :meth:`joint_gain_db`."""
        return float(self._area() @ self._remaining_error(further))

    @property
    def period_px(self) -> float:
        """One period of the lowest ring."""
        return 0.5 / float(self.frequency[0])

    def variance_within_period(self, power: Array) -> float:
        """Mean variance, within squares of :attr:`period_px`, of a picture with this power (RINGS,).

        A mean over the square passes exp(−(2π f)² side² / 12) of the power, to second order; the rest is the variance.
        """
        passed = np.exp(-((2 * np.pi * self.frequency * self.period_px) ** 2) / 12)
        return float(self._area() @ ((1 - passed) * power))

    def least_variance(self, samples: float) -> float:
        """Standard deviation of the noise's variance, measured on ``samples`` samples."""
        return self.variance_within_period(self.noise) * float(np.sqrt(2 / samples))

    def with_signal_variance(self, recorded: float, samples: float, shape: PictureStatistics) -> PictureStatistics:
        """With the variance of the recorded tiles; where noise is most of it, S falls with frequency as ``shape``'s.

        The spectra of luma and of colour differences are parallel to within a factor of 1.5 in photographs.
        """
        noise, least = self.variance_within_period(self.noise), self.least_variance(samples)
        found = max(recorded - noise, least)
        if found > noise:
            return replace(self, signal_variance=found)
        scale = found / self.variance_within_period(shape.passed * shape.signal)
        return replace(self, signal_variance=found, signal=scale * shape.signal)

    def colour_error(self) -> tuple[float, float]:
        """Mean square errors of red, green and blue, grey levels squared, by colour differences with these statistics.

        First that which an ideal filter removes from a picture alone, then that which it leaves.  Neighbours add
        little, since a movie stores a quarter of the colour samples, and coarsely.
        """
        if not self.measured:
            return 0.0, 0.0
        per_power = PER_COLOUR_POWER * self.part_of_picture
        left = per_power * self.ideal_error(np.zeros(RINGS))
        return max(per_power * self.blur_error - left, 0.0), left

    @property
    def colour_noise_levels(self) -> float:
        """Standard deviation, grey levels, of red, green and blue by the noise of colour differences."""
        return float(np.sqrt(PER_COLOUR_POWER * self._area() @ self.noise)) if self.measured else 0.0

    @property
    def sharp_power(self) -> float:
        """Mean square, grey levels squared, of the sharp picture's detail in the rings."""
        return float(self._area() @ self.signal)

    @property
    def blur_error(self) -> float:
        """Mean square error, grey levels squared, of the recorded picture by its blur."""
        return float(self._area() @ self._blur_loss())

    def misplaced(self, std_px: float, further: Array) -> Misplaced:
        """Error by rows displaced with a deviation of ``std_px`` per axis; further: as in :meth:`joint_gain_db`.

        Power S at f, restored to a fraction R and displaced by δ, leaves the error |1 − R e^{2πi f δ}|² S.  Averaged
        over a ring that is (1 − R)² plus, by the displacement, 2 R (1 − J₀(2π f |δ|)).  R is √|K|² in the recorded
        picture.  |δ|² of a normal δ has an exponential distribution, hence the Gauss–Laguerre quadrature.
        """
        off = 2 - 2 * _bessel_j0(2 * np.pi * np.outer(std_px * np.sqrt(2 * _LIKELY_SQUARES), self.frequency))
        passed, power = self.passed + further, self._area() * self.signal
        restored, blurred = passed * self.signal / (passed * self.signal + self.noise), np.sqrt(self.passed)
        removed = float(power @ ((1 - blurred) ** 2 - (1 - restored) ** 2))
        return Misplaced(off @ (power * blurred), off @ (power * restored), removed, _LIKELY_WEIGHTS)

    def _area(self) -> Array:
        return np.asarray(2 * np.pi * self.frequency * (self.frequency[1] - self.frequency[0]))

    def _blur_loss(self) -> Array:
        """(RINGS,) power of (1 − K) F."""
        real = np.sqrt(self.passed) if self.real is None else self.real
        return np.asarray((1 - 2 * real + self.passed) * self.signal)

    def _remaining_error(self, further: Array) -> Array:
        """(RINGS,) power of the ideal linear filter's error."""
        count, passed = (np.ones((RINGS, 1)), self.passed[:, None]) if self.cells is None else self.cells
        signal, noise, passed = self.signal[:, None], self.noise[:, None], passed + further[:, None]
        wrong = count * signal * noise / (passed * signal + noise)
        return np.asarray(wrong.sum(axis=1) / np.maximum(count.sum(axis=1), 1))


def coded_variance(step: float) -> float:
    """Mean square error, grey levels squared, of coefficients that a coder quantises with this step."""
    return max(_CODER_SHARE * step**2, ROUNDING_POWER)


def coder_noise(observed: Array, step: float) -> Array:
    """Coding noise (RINGS,) of a picture with power ``observed`` (RINGS,), from the step of the coder's quantiser.

    Power far above the step gets the quantiser's error; power far below it is dropped and is itself the error: reverse
    water-filling (Cover & Thomas 2006, section 10.3.3), smooth in between, since rings hold weak and strong places.
    """
    level = coded_variance(step)
    falling = np.maximum(np.maximum.accumulate(observed[::-1])[::-1], ROUNDING_POWER)
    return np.asarray(level * falling / (level + falling))


def falling_power(frequency: Array, signal: Array, ring: int) -> Array:
    """S extrapolated from one ring as f⁻³: the law of edges, and nearly that of texture softened by the lens."""
    return np.asarray(signal[ring] * (frequency[ring] / frequency) ** _DETAIL_SLOPE)


def unknown_picture() -> PictureStatistics:
    """Placeholder for a picture that could not be measured: it is smaller than a tile, or its blur is too long."""
    frequency = (np.arange(RINGS) + 0.5) * 0.5 / RINGS
    return PictureStatistics(frequency, np.ones(RINGS), np.ones(RINGS), np.ones(RINGS), 1.0, False)


def _bessel_j0(x: Array) -> Array:
    angle = (np.arange(64) + 0.5) * np.pi / 64
    return np.asarray(np.cos(x[..., None] * np.sin(angle)).mean(axis=-1))
