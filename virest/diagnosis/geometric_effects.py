"""Causes that move points: how each changes a profile, where its fit may begin, and what it means.

Each belongs to one name of the catalogue.  A cause with a word for a value (a direction, a stamp's meaning) is tried
word by word; the others are terms of the fit of tracked points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile
from virest.camera.shutter import READOUT_DIRECTIONS, STAMP_FRACTION
from virest.diagnosis.findings import ParameterChange
from virest.inference import profile_terms as terms_of
from virest.inference.track_fit import Term

Array = NDArray[np.float64]
INF = float("inf")


@dataclass(frozen=True, slots=True)
class GeometricEffect:
    """One cause."""

    name: str
    term: Term | None
    """None: nothing continuous to fit (a word)."""
    read: Callable[[CameraProfile], dict[str, Any]]
    """Its parameters' values in a profile."""
    spread: Callable[[CameraProfile, Array], dict[str, Any]]
    """Standard deviations of those parameters from those of the term's values (k,)."""
    sentence: str
    """For people; {} is filled with the values."""
    starts: tuple[tuple[float, ...], ...] = ()
    """Changes of the term's values to begin from, besides none."""
    words: tuple[str, ...] = ()
    with_word: Callable[[CameraProfile, str], CameraProfile] | None = None

    def changes(self, nominal: CameraProfile, found: CameraProfile, std: Array | None) -> dict[str, ParameterChange]:
        """The parameters before and after."""
        before, after = self.read(nominal), self.read(found)
        spread = {} if std is None else self.spread(found, std)
        return {name: ParameterChange(before[name], after[name], spread.get(name)) for name in after}


Reader = Callable[[CameraProfile], dict[str, Any]]
Spread = Callable[[CameraProfile, Array], dict[str, Any]]


def _one(name: str) -> Spread:
    return lambda profile, std: {name: float(std[0])}


def _scaled(
    name: str, read: Callable[[CameraProfile], dict[str, Any]]
) -> Callable[[CameraProfile, Array], dict[str, Any]]:
    return lambda profile, std: {name: float(std[0]) * abs(float(read(profile)[name]))}


def _many(name: str) -> Spread:
    return lambda profile, std: {name: [float(s) for s in std]}


def _plain_readout(profile: CameraProfile, v: Array) -> CameraProfile:
    """Add v[0] seconds to the readout, the first row kept where it was."""
    longer = max(profile.shutter.readout_time_s + float(v[0]), 0.0)
    return replace(profile, shutter=replace(profile.shutter, readout_time_s=longer))


def _k1(profile: CameraProfile) -> dict[str, Any]:
    lens = profile.intrinsics
    return {"k1": 0.0 if lens is None or not lens.coefficients else lens.coefficients[0]}


def _stabiliser(profile: CameraProfile) -> dict[str, Any]:
    extensions = profile.extensions
    return {"fraction": extensions.stabilisation_fraction, "cutoff_hz": extensions.stabilisation_cutoff_hz}


def _reversed(profile: CameraProfile, word: str) -> CameraProfile:
    return replace(profile, shutter=replace(profile.shutter, readout_direction=word))


def _restamped(profile: CameraProfile, word: str) -> CameraProfile:
    return replace(profile, shutter=replace(profile.shutter, timestamp=word))


PLAIN_READOUT = Term("readout_time", _plain_readout, (2e-4,), (0.01,), (INF,))

GEOMETRIC_EFFECTS: tuple[GeometricEffect, ...] = (
    GeometricEffect(
        "time_offset",
        terms_of.TIME_OFFSET,
        lambda p: {"time_offset_s": p.time_offset_s},
        _one("time_offset_s"),
        "the inertial clock runs {time_offset_s} s off the camera's",
        tuple((0.02 * k,) for k in (-3, -2, -1, 1, 2, 3)),
    ),
    GeometricEffect(
        "clock_skew",
        terms_of.CLOCK_SKEW,
        lambda p: {"clock_skew": p.clock_skew},
        _one("clock_skew"),
        "the two clocks drift apart by {clock_skew} s a second",
        ((-0.003,), (0.003,)),
    ),
    GeometricEffect(
        "readout_time",
        PLAIN_READOUT,
        lambda p: {"readout_time_s": p.shutter.readout_time_s},
        _one("readout_time_s"),
        "the rows are read within {readout_time_s} s",
        ((0.008,), (-0.008,)),
    ),
    GeometricEffect(
        "readout_direction",
        None,
        lambda p: {"readout_direction": p.shutter.readout_direction},
        lambda p, s: {},
        "the sensor is read {readout_direction}",
        words=READOUT_DIRECTIONS,
        with_word=_reversed,
    ),
    GeometricEffect(
        "timestamp_reference",
        None,
        lambda p: {"timestamp": p.shutter.timestamp},
        lambda p, s: {},
        "a frame's stamp means its {timestamp}",
        words=tuple(STAMP_FRACTION),
        with_word=_restamped,
    ),
    GeometricEffect(
        "gyro_bias",
        terms_of.GYRO_BIAS,
        lambda p: {"gyro_bias_rad_s": list(p.gyro_bias_rad_s)},
        _many("gyro_bias_rad_s"),
        "the gyroscope reads {gyro_bias_rad_s} rad/s at rest",
    ),
    GeometricEffect(
        "gyro_scale",
        terms_of.GYRO_SCALE,
        lambda p: {"gyro_scale": float(np.mean(p.gyro_scale))},
        _scaled("gyro_scale", lambda p: {"gyro_scale": float(np.mean(p.gyro_scale))}),
        "the gyroscope's rates are {gyro_scale} times the true ones",
    ),
    GeometricEffect(
        "imu_rotation",
        terms_of.IMU_ROTATION,
        lambda p: {"rotation_rad": [0.0, 0.0, 0.0]},
        _many("rotation_rad"),
        "the inertial sensor sits turned by {rotation_rad} rad against the camera",
    ),
    GeometricEffect(
        "focal_length",
        terms_of.FOCAL,
        lambda p: {"focal_scale": 1.0 if p.intrinsics is None else p.intrinsics.fx_px},
        _one("focal_scale"),
        "the focal length is {focal_scale} times the profile's",
    ),
    GeometricEffect(
        "exposure_time",
        terms_of.EXPOSURE_SCALE,
        lambda p: {"exposure_scale": p.shutter.exposure_scale},
        _scaled("exposure_scale", lambda p: {"exposure_scale": p.shutter.exposure_scale}),
        "the true exposure is {exposure_scale} times the logged one",
    ),
    GeometricEffect(
        "focal_drift",
        terms_of.FOCAL_DRIFT,
        lambda p: {"focal_drift_per_s": p.extensions.focal_drift_per_s},
        _one("focal_drift_per_s"),
        "the focal length changes by {focal_drift_per_s} of itself a second (refocusing)",
    ),
    GeometricEffect(
        "radial_distortion",
        terms_of.K1,
        _k1,
        _one("k1"),
        "the lens bends rays by k1 = {k1}",
    ),
    GeometricEffect(
        "principal_point",
        terms_of.PRINCIPAL_POINT,
        lambda p: {"offset_px": [0.0, 0.0]},
        _many("offset_px"),
        "the optical axis meets the picture {offset_px} px from where the profile says",
    ),
    GeometricEffect(
        "stabilisation",
        terms_of.STABILISATION,
        _stabiliser,
        lambda p, s: {"fraction": float(s[0]), "cutoff_hz": float(s[1]) * p.extensions.stabilisation_cutoff_hz},
        "the lens is moved against the shake: it cancels {fraction} of what is faster than {cutoff_hz} Hz",
        ((0.5, 0.0, 0.0, 0.0), (0.5, 1.2, 0.0, 0.0), (0.5, -1.2, 0.0, 0.0)),
    ),
)
