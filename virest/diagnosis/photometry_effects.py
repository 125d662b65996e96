"""The photometric effects (contract, section 4): where each value goes in a profile, and where a fit may start."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.diagnosis.photometry import PhotometricObservations, predict
from virest.effects.table import EFFECTS
from virest.image_formation.row_clock import ROW_MIDDLE

_SCAN_OBSERVATIONS = 7_000
"""Enough to find a frequency; larger temporary arrays are reallocated each time, which is ten times slower."""
SEARCH_HZ = (20.0, 400.0)
"""Frequencies of the scan: lamps pulse at 100 or 120 Hz and their multiples, or are dimmed at lower rates."""
_CANDIDATES = 4
"""Number of scan peaks from which fits start: aliases look alike until they are refined."""
_SCAN_STEP_CYCLES = 0.3
"""Frequency step of the scan times the length of the capture, cycles."""
_LEAST_SINC = 0.03
"""Skip frequencies of which the exposure leaves less than this fraction: it lasts nearly a whole number of periods."""
Bounds = tuple[tuple[float, ...], tuple[float, ...]]


@dataclass(frozen=True, slots=True)
class OneValue:
    """An effect with a single value, which every profile has."""

    name: str
    key: str
    """Of the value in the profile."""
    size: float
    """Typical change."""
    bounds: Bounds
    of_curve: bool = False
    """Whether the value belongs to the response curve; otherwise to the extensions."""
    per_frame: bool = False

    @property
    def parameters(self) -> tuple[str, ...]:
        """As in the table of effects."""
        return tuple(parameter.name for parameter in EFFECTS[self.name].parameters)

    @property
    def scale(self) -> Array:
        """The typical change."""
        return np.array([self.size])

    def starts(self, observations: PhotometricObservations, profile: CameraProfile) -> list[Array]:
        """The profile's value."""
        return [np.array(list(EFFECTS[self.name].read(profile, profile).values()))]

    def apply(self, profile: CameraProfile, values: Array) -> CameraProfile:
        """Set the value."""
        value: dict[str, Any] = {self.key: float(values[0])}
        return profile.with_curve(**value) if self.of_curve else profile.with_extensions(**value)


RESPONSE_GAMMA = OneValue("response_curve", "extra_gamma", 0.1, ((0.2,), (5.0,)), of_curve=True)
"""An additional gamma on the profile's curve."""
BLACK_LEVEL = OneValue("black_level", "black_level", 0.01, ((0.0,), (0.5,)), of_curve=True)
"""Grey level without light; its typical change is 2.5 of 255 levels."""
VIGNETTING = OneValue("vignetting", "vignetting_corner_loss", 0.1, ((-0.9,), (0.95,)))
"""Loss of light towards the corners."""


@dataclass(frozen=True, slots=True)
class Flicker:
    """Flicker of the lighting."""

    name: str = "flicker"
    parameters: tuple[str, ...] = ("amplitude", "frequency_hz", "phase_rad")
    per_frame: bool = False
    bounds: Bounds = ((-0.95, 1.0, -np.inf), (0.95, np.inf, np.inf))

    @property
    def scale(self) -> Array:
        """0.05 of the light, 0.1 Hz, 0.1 rad."""
        return np.array([0.05, 0.1, 0.1])

    def starts(self, observations: PhotometricObservations, profile: CameraProfile) -> list[Array]:
        """The profile's flicker, and the highest peaks of the scan over frequency."""
        own = [_flicker_of(profile)] if profile.extensions.flicker_amplitude else []
        scan = scan_flicker(observations, profile.with_extensions(flicker_amplitude=0.0))
        return [*own, *(scan.start(i) for i in scan.peaks(_CANDIDATES))] or [np.array([0.0, 100.0, 0.0])]

    def apply(self, profile: CameraProfile, values: Array) -> CameraProfile:
        """Set the flicker extensions; a negative amplitude is a positive one half a period later."""
        amplitude, frequency, phase = (float(v) for v in values)
        phase = float(np.mod(phase + (np.pi if amplitude < 0 else 0.0), 2 * np.pi))
        return profile.with_extensions(
            flicker_amplitude=abs(amplitude), flicker_frequency_hz=frequency, flicker_phase_rad=phase
        )


def _flicker_of(profile: CameraProfile) -> Array:
    """(amplitude, frequency, phase)."""
    ext = profile.extensions
    return np.array([ext.flicker_amplitude, ext.flicker_frequency_hz, ext.flicker_phase_rad])


def flicker_change(given: CameraProfile, values: Array) -> Array:
    """Change (3,) of amplitude, frequency and phase between a profile's flicker and fitted values."""
    amplitude, frequency, phase = values - _flicker_of(given)
    if values[0] < 0:
        amplitude, phase = amplitude - 2 * values[0], phase + np.pi
    return np.array([amplitude, frequency, (phase + np.pi) % (2 * np.pi) - np.pi])


@dataclass(frozen=True, slots=True)
class GainDrift:
    """One factor on the light per frame, as log gain; only differences are observable, so the median gain is 1."""

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
        """0.1 in log light."""
        return np.full(len(self.frames), 0.1)

    @property
    def bounds(self) -> Bounds:
        """Unbounded."""
        return (-np.inf,) * len(self.frames), (np.inf,) * len(self.frames)

    def starts(self, observations: PhotometricObservations, profile: CameraProfile) -> list[Array]:
        """The profile's gains."""
        return [np.log(profile.extensions.gain_of(self.frames))]

    def seen_in(self, observations: PhotometricObservations) -> GainDrift:
        """The effect with values for its observed frames only; those of other frames are not determined."""
        seen = set(observations.frames.tolist())
        return GainDrift(tuple(k for k in self.frames if k in seen), self.movie_frames)

    def columns(self, observations: PhotometricObservations) -> Array:
        """(n, k) derivative of the log light factor with respect to the values."""
        return np.asarray((observations.frame[:, None] == np.array(self.frames)).astype(float))

    def apply(self, profile: CameraProfile, values: Array) -> CameraProfile:
        """Set extensions.gain, with median 1 over the movie."""
        log_gain = np.interp(np.arange(self.movie_frames), self.frames, values)
        gain = np.exp(np.clip(log_gain - np.median(log_gain), -3.0, 3.0))
        return profile.with_extensions(gain=tuple((gain / np.median(gain)).tolist()))


@dataclass(frozen=True, eq=False)
class FollowedGain:
    """Log gains of frames, beside the given ones, that are linear in some numbers: along something that is logged."""

    given: Array
    """(movie frames,) log gains of the profile."""
    basis: Array
    """(movie frames, k) log gain of each frame per number."""
    start: Array
    """(k,) the numbers from which a fit starts."""
    name: str = "gain_drift"
    per_frame: bool = False

    @property
    def parameters(self) -> tuple[str, ...]:
        """One per number."""
        return tuple(f"log_gain[{k}]" for k in range(self.basis.shape[1]))

    @property
    def scale(self) -> Array:
        """0.1 in log light."""
        return np.full(self.basis.shape[1], 0.1)

    @property
    def bounds(self) -> Bounds:
        """Unbounded."""
        return (-np.inf,) * self.basis.shape[1], (np.inf,) * self.basis.shape[1]

    def starts(self, observations: PhotometricObservations, profile: CameraProfile) -> list[Array]:
        """The given one."""
        return [self.start]

    def columns(self, observations: PhotometricObservations) -> Array:
        """(n, k) derivative of the log light factor with respect to the values."""
        return np.asarray(self.basis[observations.frame])

    def apply(self, profile: CameraProfile, values: Array) -> CameraProfile:
        """Set extensions.gain."""
        return profile.with_extensions(
            gain=tuple(np.exp(self.given + np.clip(self.basis @ values, -3.0, 3.0)).tolist())
        )


PhotometricEffect = OneValue | Flicker | GainDrift | FollowedGain
"""One named effect on brightness: its parameters, and their places in a profile."""


def photometric_effects(observations: PhotometricObservations, movie_frames: int) -> tuple[PhotometricEffect, ...]:
    """All effects that brightness can reveal; a gain is unexplained only if exposure and ISO are logged."""
    frames = tuple(observations.frames.tolist())
    common: tuple[PhotometricEffect, ...] = (RESPONSE_GAMMA, BLACK_LEVEL, VIGNETTING, Flicker())
    return (*common, GainDrift(frames, movie_frames)) if observations.product_known and frames else common


# ── flicker ────────────────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class FlickerScan:
    """Reduction of the residuals by a sine at each frequency."""

    frequency_hz: Array
    power: Array
    """Reduction of the weighted sum of squares; for noise alone, chi-squared with two degrees of freedom."""
    amplitude: Array
    """Of the light, before the averaging over exposures; 0 where that leaves nothing."""
    phase_rad: Array

    def peaks(self, count: int) -> list[int]:
        """Indices of the highest local maxima."""
        inner = (self.power[1:-1] >= self.power[:-2]) & (self.power[1:-1] > self.power[2:])
        top = np.flatnonzero(inner & (self.amplitude[1:-1] > 0)) + 1
        return [int(i) for i in top[np.argsort(-self.power[top])][:count]]

    def start(self, position: int) -> Array:
        """(amplitude, frequency, phase) at an index, with the amplitude limited to 0.6."""
        found = self.amplitude[position], self.frequency_hz[position], self.phase_rad[position]
        return np.array([min(found[0], 0.6), *found[1:]])


def scan_flicker(observations: PhotometricObservations, profile: CameraProfile) -> FlickerScan:
    """Fit a sine at each frequency to the residuals in log light by least squares, with the patches' light refitted."""
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
    frequency = np.arange(*SEARCH_HZ, _SCAN_STEP_CYCLES / span)
    coefficients, power = _sines(
        observations.patch[keep], relative[keep], stiffness[keep], time_s, exposure[keep], frequency
    )
    left = np.abs(np.sinc(frequency[:, None] * np.unique(exposure[keep]))).max(axis=1)
    amplitude = np.where(left > _LEAST_SINC, np.linalg.norm(coefficients, axis=-1), 0.0)
    return FlickerScan(frequency, power * thin, amplitude, np.arctan2(coefficients[:, 1], coefficients[:, 0]))


def _sines(
    patch: Any, values: Array, stiffness: Array, time_s: Array, exposure_s: Array, frequency: Array
) -> tuple[Array, Array]:
    """(coefficients (m, 2) of sin and cos at each frequency, power (m,) that they explain); patch means are removed.

    Each exposure averages a sine by its own factor: with one factor for all, exposures that repeat every few frames
    would put the power into aliases.
    """
    dense = np.unique(patch, return_inverse=True)[1]
    order = np.argsort(dense, kind="stable")
    dense, values, stiffness = dense[order], values[order], stiffness[order]
    time_s, exposure_s = time_s[order], exposure_s[order]
    start = np.flatnonzero(np.diff(dense, prepend=-1))
    total = np.add.reduceat(stiffness, start)
    root = np.sqrt(stiffness)
    right = (root * (values - (np.add.reduceat(stiffness * values, start) / total)[dense])).astype(np.float32)
    exposures_s, which = np.unique(exposure_s, return_inverse=True)
    wave = np.exp(2j * np.pi * frequency[0] * time_s).astype(np.complex64)
    turn = np.exp(2j * np.pi * (frequency[1] - frequency[0]) * time_s).astype(np.complex64)
    mean_by, stiff, scale = (part.astype(np.float32) for part in (1 / total, stiffness, root))
    factor = np.sinc(frequency[:, None] * exposures_s).astype(np.float32)
    fit, power = np.zeros((len(frequency), 2)), np.zeros(len(frequency))
    for i in range(len(frequency)):
        seen = factor[i][which] * wave
        column = scale * (seen - (np.add.reduceat(stiff * seen, start) * mean_by)[dense])
        pair = column.view(np.float32).reshape(-1, 2)  # cosine, sine
        (c, b), (_, a) = (pair.T @ pair).tolist()
        q, p = (right @ pair).tolist()
        determinant = max(a * c - b * b, 1e-9 * a * c + 1e-12)
        fit[i] = (c * p - b * q) / determinant, (a * q - b * p) / determinant
        power[i] = fit[i] @ (p, q)
        wave *= turn
    return fit, power
