"""Values that a calibration held fixed but the tracked points contradict, found by one more fit with all free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from virest.arrays import Array
from virest.capture.imu import ImuSamples
from virest.effects.table import EFFECTS, is_sought
from virest.image_formation.point_model import TrackTable
from virest.inference import profile_terms as terms_of
from virest.inference.track_fit import TrackFit, fit_tracks
from virest.inference.tracking_bias import bias_std

_SECTIONS = ("intrinsics", "imu", "shutter")
_NAMED = sorted(
    (effect for effect in EFFECTS.values() if effect.calibrated is not None and effect.calibrated.option),
    key=lambda effect: _SECTIONS.index(effect.place.partition(".")[0]),
)
_CALIBRATED = {effect.calibrated.option: effect.calibrated for effect in _NAMED if effect.calibrated is not None}
OPTIONAL = {option: terms_of.TERMS[effect.name] for option, effect in zip(_CALIBRATED, _NAMED, strict=True)}
"""Terms that ``--with`` adds to the fit: lens, inertial sensor, shutter."""
TWINS = {"focal": "gyro-scale", "gyro-scale": "focal"}
"""Pairs of which pitch and yaw determine only the product; roll separates them."""
TWIN_SIGMA, TWIN_STD = 3.0, 0.01
"""A fixed twin is reported as wrong above this many σ, and as undetermined above this relative standard deviation."""
WRONG_SIGMA = 6.0
"""Any other fixed value is reported as wrong above this many σ."""


@dataclass(frozen=True, slots=True)
class HeldValue:
    """A value that the calibration held fixed, as estimated by the fit with all values free."""

    name: str
    """Key of OPTIONAL."""
    change: Array
    """(k,) change from the fixed value, in the term's units."""
    std: Array
    """(k,) standard deviation, including tracking bias."""

    @property
    def sigma(self) -> float:
        """Largest change in standard deviations."""
        return float(np.max(np.abs(self.change) / self.std))

    @property
    def wrong(self) -> bool:
        """Whether the points contradict the fixed value."""
        return self.sigma > WRONG_SIGMA

    @property
    def believable(self) -> bool:
        """Whether the change is plausible for a phone."""
        return bool(np.all(np.abs(self.change) <= _CALIBRATED[self.name].believable))

    def __str__(self) -> str:
        if _CALIBRATED[self.name].is_factor:
            change = np.expm1(self.change)
            return f"{self.name} ({change[0]:+.1%} ± {(1 + change[0]) * self.std[0]:.1%})"
        pairs = zip(self.change, self.std, strict=True)
        unit = " px" if self.name == "principal-point" else ""
        return f"{self.name} ({', '.join(f'{change:+.3g} ± {std:.2g}' for change, std in pairs)}{unit})"


def held_values(
    imu: ImuSamples, table: TrackTable, fit: TrackFit, noise_px: float, exposures_vary: bool
) -> dict[str, HeldValue]:
    """Fit once more with all optional terms free: the values that ``fit`` held fixed, by key of OPTIONAL.

    noise_px: tracking noise.  exposures_vary: if not, an exposure scale is indistinguishable from a time offset and is
    left out.  A value that refines another is free only beside that one.
    """
    fitted = {term.name for term in fit.terms}
    wanted = {
        name: term
        for name, term in OPTIONAL.items()
        if term.name not in fitted
        and (exposures_vary or name != "exposure-scale")
        and is_sought(term.name, fitted, fit.profile)
    }
    free = fit_tracks(imu, table, fit.profile, [*fit.terms, *wanted.values()], fit.scene)
    return {
        name: HeldValue(name, free.value(term.name), np.hypot(free.std(term.name), bias_std(free, term.name, noise_px)))
        for name, term in wanted.items()
    }


def held_notes(held: dict[str, HeldValue], fitted: Sequence[str]) -> list[str]:
    """Notes on contradicted or undetermined fixed values; fitted: keys of OPTIONAL that were fitted."""
    notes, reported = [], set()
    for name in fitted:
        twin = held.get(TWINS.get(name, ""))
        if twin is None:
            continue
        reported.add(twin.name)
        if twin.sigma > TWIN_SIGMA:
            pair = f"--with {','.join([*fitted, twin.name])}"
            notes.append(f"{name} is absorbing a wrong {twin}, which the points contradict; fit both: {pair}")
        elif twin.std[0] > TWIN_STD:
            notes.append(
                f"{name} depends on {twin.name}, which was held fixed and is determined by this motion to "
                f"± {twin.std[0]:.1%} only; also rotate the phone about its optical axis"
            )
    wrong = [value for name, value in held.items() if name not in reported and value.wrong]
    if [value.name for value in wrong if not value.believable] == ["focal"]:
        (focal,) = (value for value in wrong if value.name == "focal")
        notes.append(
            f"the points contradict intrinsics.fx_px: {focal}; is it for another resolution or zoom? "
            f"Correct it, or fit with --with {','.join([*fitted, 'focal'])}"
        )
    elif wrong and all(value.believable for value in wrong):
        names = ",".join([*fitted, *(value.name for value in wrong)])
        notes.append(
            f"held fixed, and contradicted by the points: {', '.join(map(str, wrong))}; "
            f"fit with --with {names}, or ask virest diagnose"
        )
    elif wrong:
        notes.append(
            "the points do not fit the model; the fit needs implausible values of fixed parameters: "
            f"{', '.join(str(value) for value in wrong if not value.believable)}; ask virest diagnose for the cause"
        )
    return notes
