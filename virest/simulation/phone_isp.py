"""Settings of a phone's own processing of frames and gyroscope samples, which no camera profile describes.

Every step is off by default.  Frames pass through the steps in the order of a phone's pipeline (Hasinoff et al. 2016,
"Burst photography for high dynamic range and low-light imaging on mobile cameras", doi:10.1145/2980179.2980254, section
6): highlight roll-off before the response curve; noise; temporal and spatial denoising; global tone curve; local tone
mapping; sharpening; encoder.  :mod:`phone_pictures` and :mod:`phone_gyro` implement them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from virest.camera.profile import CameraProfile
from virest.errors import SettingsError

_BELONGS_TO = {"sharpen_radius_px": "sharpen", "stabiliser_cutoff_hz": "stabiliser_rest"}
_LIMITS: dict[str, tuple[float, float]] = {
    "tone": (0.0, 1.0),
    "local_tone": (0.0, 0.9),
    "highlights": (0.0, 0.9),
    "denoise": (0.0, 20.0),
    "temporal_denoise": (0.0, 0.95),
    "sharpen": (0.0, 5.0),
    "sharpen_radius_px": (0.3, 20.0),
    "gyro_noise": (0.0, 1.0),
    "gyro_jitter_s": (0.0, 0.1),
    "gyro_lowpass_hz": (0.0, 900.0),
    "stabiliser_rest": (0.0, 1.0),
    "stabiliser_cutoff_hz": (0.01, 100.0),
    "offset_s": (-1.0, 1.0),
    "bits_per_px": (0.01, 20.0),
}


@dataclass(frozen=True, slots=True)
class PhoneIsp:
    """Strengths of a phone's own processing; 0 (or None) is off."""

    tone: float = 0.0
    """Weight of an S-shaped curve in the global tone curve, 0 to 1, on top of the profile's response."""
    local_tone: float = 0.0
    """Compression of the low-frequency brightness, 0 to 0.9: 2 stops become 2 (1 − strength) stops."""
    highlights: float = 0.0
    """Fraction of the light range, at its top, in which highlights roll off instead of clipping, 0 to 0.9."""
    denoise: float = 0.0
    """Spatial denoising: range sigma of the luma's bilateral filter in noise standard deviations; chroma takes 2×."""
    temporal_denoise: float = 0.0
    """Weight of the previous output in static regions, 0 to 0.95."""
    sharpen: float = 0.0
    """Amount of the unsharp mask, 0 to 5."""
    sharpen_radius_px: float = 1.0
    """Standard deviation of the unsharp mask's Gaussian."""
    gyro_noise: float = 0.0
    """Gyroscope noise density, rad/s/√Hz; replaces SessionSettings.gyro_noise_rad_s."""
    gyro_jitter_s: float = 0.0
    """Standard deviation of the timestamp jitter of inertial samples."""
    gyro_lowpass_hz: float = 0.0
    """Corner of a second-order low-pass filter on the rates."""
    stabiliser_rest: float = 0.0
    """Fraction of fast pitch and yaw removed by a stabiliser that the nominal profile omits, 0 to 1."""
    stabiliser_cutoff_hz: float = 1.0
    """High-pass cutoff of that stabiliser."""
    offset_s: float = 0.0
    """Time offset added to the profile's, inertial clock − camera clock."""
    bits_per_px: float | None = None
    """Encoder bit rate per pixel and frame; None: the recorder's default."""

    def __post_init__(self) -> None:
        for name, (low, high) in _LIMITS.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise SettingsError(f"phone's processing: {name} {value:g}", hint=f"use {low:g} to {high:g}")

    @property
    def develops(self) -> bool:
        """Whether any step between noise and encoder is on."""
        return any((self.tone, self.local_tone, self.denoise, self.temporal_denoise, self.sharpen))

    def true_profile(self, profile: CameraProfile) -> CameraProfile:
        """Add the time offset and stabiliser that the nominal profile omits."""
        if self.offset_s:
            profile = replace(profile, time_offset_s=(profile.time_offset_s or 0.0) + self.offset_s)
        if not self.stabiliser_rest:
            return profile
        extensions = profile.extensions
        if extensions.stabilisation_fraction:
            raise SettingsError("two stabilisers in one phone", hint="drop the effect or the stabiliser's rest")
        extensions = replace(
            extensions,
            stabilisation_fraction=self.stabiliser_rest,
            stabilisation_cutoff_hz=self.stabiliser_cutoff_hz,
        )
        return replace(profile, extensions=extensions)

    def in_force(self) -> dict[str, float]:
        """The strengths that are on, with their dependent settings."""
        on = {name: value for name, value in asdict(self).items() if name not in _BELONGS_TO and value}
        return on | {name: getattr(self, name) for name, to in _BELONGS_TO.items() if to in on}


OFF = PhoneIsp()
ISPS: dict[str, PhoneIsp] = {
    "none": OFF,
    "phone": PhoneIsp(
        tone=0.4,
        local_tone=0.1,
        highlights=0.25,
        denoise=1.5,
        temporal_denoise=0.4,
        sharpen=0.5,
        sharpen_radius_px=1.0,
        gyro_noise=0.001,
        gyro_jitter_s=0.0002,
        gyro_lowpass_hz=60.0,
        stabiliser_rest=0.1,
        offset_s=0.002,
        bits_per_px=0.3,
    ),
}
"""Named presets.  ``phone``: 0.01 rad/s noise at 200 Hz, a 10 % stabiliser error, a 2 ms clock error."""


def make_isp(name: str | None, **strengths: float | None) -> PhoneIsp:
    """A preset, with any given strengths overriding its own."""
    if name is not None and name not in ISPS:
        raise SettingsError(f"phone's processing '{name}' is not known", hint=f"use one of {', '.join(ISPS)}")
    known = {field.name for field in fields(PhoneIsp)}
    assert strengths.keys() <= known, strengths.keys() - known
    given: dict[str, Any] = {key: value for key, value in strengths.items() if value is not None}
    return replace(ISPS[name or "none"], **given)
