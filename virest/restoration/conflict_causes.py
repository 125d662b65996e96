"""Profile errors beyond the stated uncertainties: starting values of their fits, plausible ranges, and messages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.effects.changes import k1_of, k2_of, mean_gyro_scale
from virest.effects.table import GYRO_SCALE_OFF, STABILISED_OFF
from virest.inference import profile_terms as terms_of
from virest.inference.fit_start import FitStart
from virest.inference.stabiliser_fit import stabiliser_starts
from virest.inference.track_fit import Term

SOURCE = "tracked points against the gyroscope, which contradict the profile's value"
SKEW_REACH, SKEW_ERROR_S, MOST_SKEWS = 0.015, 0.01, 61
"""Clock skews tried: the range, the largest error in s at the capture's ends of the nearest one, and the largest number
of them."""
FOCAL_REACH, FOCAL_STEPS = 0.95, 20
"""Focal scales tried: the range of the logarithm (factors of 0.39 to 2.6), and their number."""
GYRO_REACH, GYRO_STEPS = 0.14, 8
"""Gyroscope scales tried: the range of the logarithm, that of plausible errors, and their number."""
K1_REACH, K1_STEPS = 0.3, 7
"""Radial distortions tried: the range of the first coefficient, that of wide phone lenses, and their number."""
K2_REACH, K2_STEPS = 0.1, 3
"""The same for the second coefficient, beside the first.  A lens with angles in proportion to radii has 1.8 k₁²."""
LENS_RADII = 9
"""Radii from the centre to the corners at which a lens is checked."""
MOST_STABILISED = 0.95
"""No lens without ends cancels more of the shake than this: such frames were cropped and rotated by software."""
HIGHEST_CUTOFF_HZ = 15.0
"""Highest plausible cutoff of an optical stabiliser.  There is no lowest: within a second, one that follows the camera
in 10 s acts like one that never does."""


Starts = Callable[[FitStart], list[CameraProfile]]
"""Profiles at which fits of a cause begin, from one without it."""


@dataclass(frozen=True, slots=True)
class Cause:
    """One possible profile error."""

    name: str
    term: Term
    starts: Starts
    plausible: Callable[[CameraProfile, CameraProfile], bool]
    """Whether a phone can have such a value.  Arguments: given profile, fitted one."""
    change: Callable[[CameraProfile, CameraProfile], float]
    """Change from the given profile to the fitted one, in the units of the term's first value."""
    adopt: Callable[[CameraProfile, CameraProfile, Array], CameraProfile]
    """A profile with this cause's values from the fitted one.  Arguments: profile to change, fitted one, and standard
    deviations (k,) in the term's units."""
    message: Callable[[CameraProfile, CameraProfile, Array], str]
    """Message about the adopted value.  Arguments: given profile, fitted one, standard deviations (k,)."""


def _by_steps(term: Term, steps: Array) -> Starts:
    """Starts that change a term by each of the steps (n,)."""
    return lambda start: [term.change(start.profile, step) for step in steps[:, None]]


def _skews(start: FitStart) -> list[CameraProfile]:
    span_s = max(float(np.abs(start.table.second_stamp_s).max()), 0.1)
    count = min(2 * int(np.ceil(SKEW_REACH * span_s / (2 * SKEW_ERROR_S))) + 1, MOST_SKEWS)
    return _by_steps(terms_of.CLOCK_SKEW, np.linspace(-SKEW_REACH, SKEW_REACH, max(count, 5)))(start)


def _focal_px(profile: CameraProfile) -> float:
    assert profile.intrinsics is not None
    return profile.intrinsics.fx_px


def _with_focal(profile: CameraProfile, found: CameraProfile, std: Array) -> CameraProfile:
    focal_px = _focal_px(found)
    spread_px = focal_px * float(std[0])
    return profile.with_estimate("fx_px", focal_px, spread_px, SOURCE, intrinsics=found.intrinsics)


def _with_skew(profile: CameraProfile, found: CameraProfile, std: Array) -> CameraProfile:
    skew = found.clock_skew
    return profile.with_estimate("clock_skew", skew, float(std[0]), SOURCE, clock_skew=skew)


def _with_stabiliser(profile: CameraProfile, found: CameraProfile, std: Array) -> CameraProfile:
    ext = found.extensions
    fraction, cutoff_hz = ext.stabilisation_fraction, ext.stabilisation_cutoff_hz
    extensions = replace(
        profile.extensions,
        stabilisation_fraction=fraction,
        stabilisation_cutoff_hz=cutoff_hz,
        stabilisation_lean_rad=ext.stabilisation_lean_rad,
        stabilisation_travel_rad=ext.stabilisation_travel_rad,
        stabilisation_at_end=ext.stabilisation_at_end,
    )
    taken = profile.with_estimate("stabilisation_fraction", fraction, float(std[0]), SOURCE, extensions=extensions)
    taken = taken.with_estimate("stabilisation_cutoff_hz", cutoff_hz, cutoff_hz * float(std[1]), SOURCE)
    travel_rad = ext.stabilisation_travel_rad
    if travel_rad is None:
        return taken
    return taken.with_estimate("stabilisation_travel_rad", travel_rad, float(std[4]) * travel_rad**2, SOURCE)


def _stabiliser_message(given: CameraProfile, found: CameraProfile, std: Array) -> str:
    ext, travel_rad = found.extensions, found.extensions.stabilisation_travel_rad
    cancelled = f"{ext.stabilisation_fraction:.3f} ± {std[0]:.3f} of the shake"
    ends = "" if travel_rad is None else f", up to {travel_rad:.2g} rad,"
    return (
        f"stabiliser that cancels {cancelled} above {ext.stabilisation_cutoff_hz:.2g} Hz{ends} used instead of the "
        f"profile's {given.extensions.stabilisation_fraction:g}"
    )


def _gyro_ratio(given: CameraProfile, found: CameraProfile) -> float:
    return mean_gyro_scale(found) / mean_gyro_scale(given)


def _with_gyro_scale(profile: CameraProfile, found: CameraProfile, std: Array) -> CameraProfile:
    scale = found.gyro_scale
    spread = [value * float(std[0]) for value in scale]
    return profile.with_estimate("gyro_scale", list(scale), spread, SOURCE, gyro_scale=scale)


def _distortion(name: str, key: str, term: Term, steps: Array, read: Callable[[CameraProfile], float]) -> Cause:
    """A wrong radial coefficient, ``key`` in the profile; steps (n,): its starting changes."""

    def adopt(profile: CameraProfile, found: CameraProfile, std: Array) -> CameraProfile:
        assert profile.intrinsics is not None
        assert found.intrinsics is not None
        lens = replace(profile.intrinsics, model=found.intrinsics.model, coefficients=found.intrinsics.coefficients)
        return profile.with_estimate(key, read(found), float(std[0]), SOURCE, intrinsics=lens)

    def message(given: CameraProfile, found: CameraProfile, std: Array) -> str:
        told = f"radial distortion of {key} = {read(found):+.4f} ± {std[0]:.4f}"
        return f"{told} used instead of the profile's {read(given):+g}"

    return Cause(
        name, term, _by_steps(term, steps), _is_lens, lambda given, found: read(found) - read(given), adopt, message
    )


def _is_lens(given: CameraProfile, found: CameraProfile) -> bool:
    """Whether the coefficients are plausible and the pictured radius grows up to the corners."""
    lens = found.intrinsics
    assert lens is not None
    corner = np.array([lens.width / lens.fx_px, lens.height / lens.fy_px]) / 2
    plane = np.linspace(0.0, 1.0, LENS_RADII)[:, None] * corner
    radius_px = lens.radius_px(lens.project(np.concatenate([plane, np.ones((LENS_RADII, 1))], axis=1)))
    added = abs(k2_of(found) - k2_of(given))
    return abs(k1_of(found)) < 2 * K1_REACH and added < 4 * K2_REACH and bool((np.diff(radius_px, axis=0) > 0).all())


def _is_stabiliser(_: CameraProfile, found: CameraProfile) -> bool:
    ext, most = found.extensions, MOST_STABILISED
    if ext.stabilisation_travel_rad is not None:
        most = STABILISED_OFF
    return 0 < ext.stabilisation_fraction < most and ext.stabilisation_cutoff_hz < HIGHEST_CUTOFF_HZ


FOCAL_LENGTH, GYROSCOPE = "focal length", "gyroscope scale"
TWINS = {FOCAL_LENGTH: GYROSCOPE, GYROSCOPE: FOCAL_LENGTH}
"""Rotation about the picture's axes determines only the product of the two; rotation about the optical axis determines
the gyroscope's scale alone."""
CAUSES = (
    Cause(
        FOCAL_LENGTH,
        replace(terms_of.FOCAL, prior_std=(0.6,)),
        _by_steps(terms_of.FOCAL, np.linspace(-FOCAL_REACH, FOCAL_REACH, FOCAL_STEPS)),
        lambda given, found: 0.35 < _focal_px(found) / _focal_px(given) < 2.9,
        lambda given, found: float(np.log(_focal_px(found) / _focal_px(given))),
        _with_focal,
        lambda given, found, std: (
            f"focal length of {_focal_px(found):.1f} ± {_focal_px(found) * std[0]:.1f} px used "
            f"instead of the profile's {_focal_px(given):.1f} px"
        ),
    ),
    Cause(
        GYROSCOPE,
        terms_of.GYRO_SCALE,
        _by_steps(terms_of.GYRO_SCALE, np.linspace(-GYRO_REACH, GYRO_REACH, GYRO_STEPS)),
        lambda given, found: abs(mean_gyro_scale(found) - 1) < GYRO_SCALE_OFF,
        lambda given, found: float(np.log(_gyro_ratio(given, found))),
        _with_gyro_scale,
        lambda given, found, std: (
            f"gyroscope scale of {mean_gyro_scale(found):.4f} ± {mean_gyro_scale(found) * std[0]:.4f} used "
            f"instead of the profile's {mean_gyro_scale(given):g}"
        ),
    ),
    Cause(
        "clock skew",
        terms_of.CLOCK_SKEW,
        _skews,
        lambda given, found: abs(found.clock_skew - given.clock_skew) < 2 * SKEW_REACH,
        lambda given, found: found.clock_skew - given.clock_skew,
        _with_skew,
        lambda given, found, std: (
            f"clock skew of {found.clock_skew:+.5f} ± {std[0]:.5f} used instead of the profile's {given.clock_skew:+g}"
        ),
    ),
    _distortion("radial distortion", "k1", terms_of.K1, np.linspace(-K1_REACH, K1_REACH, K1_STEPS), k1_of),
    _distortion("higher distortion", "k2", terms_of.K2, np.linspace(-K2_REACH, K2_REACH, K2_STEPS), k2_of),
    Cause(
        "stabilisation",
        terms_of.STABILISATION,
        stabiliser_starts,
        _is_stabiliser,
        lambda given, found: found.extensions.stabilisation_fraction - given.extensions.stabilisation_fraction,
        _with_stabiliser,
        _stabiliser_message,
    ),
)
