"""The photometric effects (contract, section 4): where each value goes in a profile, where a fit may start."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from virest.camera.profile import CameraProfile
from virest.camera.response import ResponseCurve
from virest.diagnosis.photometry import Array, PhotometricObservations, predict
from virest.effects.changes import extended
from virest.effects.table import EFFECTS
from virest.image_formation.row_clock import ROW_MIDDLE

_SCAN_OBSERVATIONS = 7_000
"""Enough to find a frequency; larger temporary arrays are allocated anew each time, ten times slower."""
_SCAN_STEP_CYCLES = 0.3
"""Scan step as a product with the capture's length, cycles."""
_LEAST_SINC = 0.03
"""An exposure of nearly whole periods leaves less of the flicker than this: such frequencies are not searched."""
Bounds = tuple[tuple[float, ...], tuple[float, ...]]


class PhotometricEffect(Protocol):
    """One named effect on brightness."""

    @property
    def name(self) -> str:
        """Name in the contract."""
        ...

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of its values."""
        ...

    @property
    def scale(self) -> Array:
        """Typical size of a change of each value."""
        ...

    @property
    def per_frame(self) -> bool:
        """Whether each value belongs to one frame only, so that other frames cannot judge it; other places can."""
        ...

    @property
    def bounds(self) -> Bounds:
        """Least and greatest of each value."""
        ...

    def starts(self, observations: PhotometricObservations, profile: CameraProfile) -> list[Array]:
        """Values from which a fit may begin, best first."""
        ...

    def apply(self, profile: CameraProfile, values: Array) -> CameraProfile:
        """The profile with these values in it."""
        ...


@dataclass(frozen=True, slots=True)
class _OneValue:
    """An effect of one value that the profile has."""

    name: str
    size: float
    """Typical change."""
    bounds: Bounds
    per_frame: bool = False

    @property
    def parameters(self) -> tuple[str, ...]:
        """As the table of effects has it."""
        return tuple(parameter.name for parameter in EFFECTS[self.name].parameters)

    @property
    def scale(self) -> Array:
        """The typical change."""
        return np.array([self.size])

    def starts(self, observations: PhotometricObservations, profile: CameraProfile) -> list[Array]:
        """What the profile has."""
        return [np.array(list(EFFECTS[self.name].read(profile, profile).values()))]


def _bent(profile: CameraProfile, **changes: Any) -> CameraProfile:
    return replace(profile, response=replace(profile.response or ResponseCurve("srgb"), **changes))


@dataclass(frozen=True, slots=True)
class ResponseGamma(_OneValue):
    """Another gamma on top of the profile's curve."""

    name: str = "response_curve"
    size: float = 0.1
    bounds: Bounds = ((0.2,), (5.0,))

    def apply(self, profile: CameraProfile, values: Array) -> CameraProfile:
        """Set response.extra_gamma."""
        return _bent(profile, extra_gamma=float(values[0]))


@dataclass(frozen=True, slots=True)
class BlackLevel(_OneValue):
    """Grey where there is no light: a change of two grey levels or so."""

    name: str = "black_level"
    size: float = 0.01
    bounds: Bounds = ((0.0,), (0.5,))

    def apply(self, profile: CameraProfile, values: Array) -> CameraProfile:
        """Set response.black_level."""
        return _bent(profile, black_level=float(values[0]))


@dataclass(frozen=True, slots=True)
class Vignetting(_OneValue):
    """Loss of light towards the corners."""

    name: str = "vignetting"
    size: float = 0.1
    bounds: Bounds = ((-0.9,), (0.95,))

    def apply(self, profile: CameraProfile, values: Array) -> CameraProfile:
        """Set extensions.vignetting_corner_loss."""
        return extended(profile, vignetting_corner_loss=float(values[0]))


@dataclass(frozen=True, slots=True)
class Flicker:
    """Flickering lamps."""

    name: str = "flicker"
    parameters: tuple[str, ...] = ("amplitude", "frequency_hz", "phase_rad")
    per_frame: bool = False
    bounds: Bounds = ((-0.95, 1.0, -np.inf), (0.95, np.inf, np.inf))
    search_hz: tuple[float, float] = (20.0, 400.0)
    candidates: int = 4
    """How many peaks of the scan a fit begins at: aliases of each other look alike until they are refined."""

    @property
    def scale(self) -> Array:
        """A twentieth of the light, a tenth of a hertz, a tenth of a radian."""
        return np.array([0.05, 0.1, 0.1])

    def starts(self, observations: PhotometricObservations, profile: CameraProfile) -> list[Array]:
        """Highest peaks of the scan over frequency."""
        ext = profile.extensions
        if ext.flicker_amplitude:
            return [np.array([ext.flicker_amplitude, ext.flicker_frequency_hz, ext.flicker_phase_rad])]
        scan = scan_flicker(observations, profile, self.search_hz)
        return [scan.start(i) for i in scan.peaks(self.candidates)] or [np.array([0.0, 100.0, 0.0])]

    def apply(self, profile: CameraProfile, values: Array) -> CameraProfile:
        """A negative amplitude is a positive one half a period later."""
        amplitude, frequency, phase = (float(v) for v in values)
        phase = float(np.mod(phase + (np.pi if amplitude < 0 else 0.0), 2 * np.pi))
        return extended(
            profile,
            flicker_amplitude=abs(amplitude),
            flicker_frequency_hz=frequency,
            flicker_phase_rad=phase,
        )


@dataclass(frozen=True, slots=True)
class GainDrift:
    """One factor on the light per frame, in log light; only differences between frames are observable: median 1."""

    frames: tuple[int, ...]
    """Movie indices that have a value."""
    movie_frames: int
    """Length of the list in the profile; frames without a value take their neighbours'."""
    name: str = "gain_drift"
    per_frame: bool = True
    parameters: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", tuple(f"log_gain[{k}]" for k in self.frames))

    @property
    def scale(self) -> Array:
        """A tenth of the light."""
        return np.full(len(self.frames), 0.1)

    @property
    def bounds(self) -> Bounds:
        """None."""
        return (-np.inf,) * len(self.frames), (np.inf,) * len(self.frames)

    def starts(self, observations: PhotometricObservations, profile: CameraProfile) -> list[Array]:
        """What the profile has."""
        gain = np.append(profile.extensions.gain, 1.0)
        return [np.log(gain[np.minimum(self.frames, len(gain) - 1)])]

    def seen_in(self, observations: PhotometricObservations) -> GainDrift:
        """The effect with values for those of its frames that are observed; the others' are not determined."""
        seen = set(observations.frames.tolist())
        return GainDrift(tuple(k for k in self.frames if k in seen), self.movie_frames)

    def columns(self, observations: PhotometricObservations) -> Array:
        """Derivative of the log light factor by the values, (n, k)."""
        return np.asarray((observations.frame[:, None] == np.array(self.frames)).astype(float))

    def apply(self, profile: CameraProfile, values: Array) -> CameraProfile:
        """Median 1 over the movie."""
        log_gain = np.interp(np.arange(self.movie_frames), self.frames, values)
        gain = np.exp(np.clip(log_gain - np.median(log_gain), -3.0, 3.0))
        return extended(profile, gain=tuple((gain / np.median(gain)).tolist()))


def photometric_effects(observations: PhotometricObservations, movie_frames: int) -> tuple[PhotometricEffect, ...]:
    """All effects that brightness can tell of; without logged exposure and ISO no gain can be unexplained."""
    frames = tuple(observations.frames.tolist())
    common: tuple[PhotometricEffect, ...] = (ResponseGamma(), BlackLevel(), Vignetting(), Flicker())
    return (*common, GainDrift(frames, movie_frames)) if observations.product_known and frames else common


# ── flicker ────────────────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class FlickerScan:
    """Reduction of the residuals by a sine of each frequency."""

    frequency_hz: Array
    power: Array
    """Fall of the weighted sum of squares; under noise alone a chi-squared of two degrees of freedom."""
    amplitude: Array
    """Of the light, corrected for what the exposure averages away; 0 where it averages away everything."""
    phase_rad: Array

    def peaks(self, count: int) -> list[int]:
        """Positions of the highest local maxima."""
        inner = (self.power[1:-1] >= self.power[:-2]) & (self.power[1:-1] > self.power[2:])
        top = np.flatnonzero(inner & (self.amplitude[1:-1] > 0)) + 1
        return [int(i) for i in top[np.argsort(-self.power[top])][:count]]

    def start(self, position: int) -> Array:
        """(amplitude, frequency, phase) there."""
        found = self.amplitude[position], self.frequency_hz[position], self.phase_rad[position]
        return np.array([min(found[0], 0.6), *found[1:]])


def scan_flicker(
    observations: PhotometricObservations, profile: CameraProfile, search_hz: tuple[float, float]
) -> FlickerScan:
    """Fit a sine of each frequency to the residuals in log light by least squares, the patches' light following."""
    weight = 1 / observations.noise**2
    prediction = predict(observations, profile)
    limit = 4 * observations.noise + 2.0
    relative = np.clip(prediction.residual, -limit, limit) / prediction.slope
    stiffness = weight * prediction.slope**2
    thin = max(1, int(np.ceil(len(observations) / _SCAN_OBSERVATIONS)))
    keep = observations.place % thin == 0 if thin > 1 else np.ones(len(observations), bool)
    keep |= not keep.any()
    exposure = np.asarray(profile.shutter.true_exposure_s(observations.exposure_s), float)
    time_s = observations.row_time_s(profile, ROW_MIDDLE)[keep]
    span = max(float(np.ptp(time_s)), 0.1)
    frequency = np.arange(search_hz[0], search_hz[1], _SCAN_STEP_CYCLES / span)
    coefficients, power = _sines(observations.patch[keep], relative[keep], stiffness[keep], time_s, frequency)
    left = np.sinc(frequency * np.median(exposure))
    whole = np.where(np.abs(left) > _LEAST_SINC, left, np.inf)
    complex_amplitude = (coefficients[:, 0] + 1j * coefficients[:, 1]) / whole
    return FlickerScan(frequency, power * thin, np.abs(complex_amplitude), np.angle(complex_amplitude))


def _sines(patch: Any, values: Array, stiffness: Array, time_s: Array, frequency: Array) -> tuple[Array, Array]:
    """Coefficients (m, 2) of sin and cos at each frequency and the power they take; patch means are taken off."""
    dense = np.unique(patch, return_inverse=True)[1]
    order = np.argsort(dense, kind="stable")
    dense, values, stiffness, time_s = dense[order], values[order], stiffness[order], time_s[order]
    start = np.flatnonzero(np.diff(dense, prepend=-1))
    total = np.add.reduceat(stiffness, start)
    root = np.sqrt(stiffness)
    right = root * (values - (np.add.reduceat(stiffness * values, start) / total)[dense])
    wave = np.exp(2j * np.pi * frequency[0] * time_s)
    turn = np.exp(2j * np.pi * (frequency[1] - frequency[0]) * time_s)
    fit, power = np.zeros((len(frequency), 2)), np.zeros(len(frequency))
    for i in range(len(frequency)):
        column = root * (wave - (np.add.reduceat(stiffness * wave, start) / total)[dense])
        sine, cosine = column.imag, column.real
        a, b, c = sine @ sine, sine @ cosine, cosine @ cosine
        p, q = sine @ right, cosine @ right
        determinant = max(a * c - b * b, 1e-9 * a * c + 1e-12)
        fit[i] = (c * p - b * q) / determinant, (a * q - b * p) / determinant
        power[i] = fit[i] @ (p, q)
        wave *= turn
    return fit, power
