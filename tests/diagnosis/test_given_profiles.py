"""Causes are changes from the given profile: a profile with the right values has none."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnosis.test_photometry import FRAMES, NOMINAL, hidden, made_observations

from virest.camera.profile import CameraProfile, Extensions
from virest.camera.shutter import Shutter
from virest.diagnosis import local_blur, local_blur_fit, picture_ladder
from virest.diagnosis.ambiguities import as_exposure, exposure_hypothesis
from virest.diagnosis.findings import GEOMETRY, Finding, HeldOutGain, ParameterChange
from virest.diagnosis.geometric_findings import with_depth_of
from virest.diagnosis.local_blur_fit import BlurFit
from virest.diagnosis.photometry import PhotometricObservations
from virest.diagnosis.photometry_effects import BLACK_LEVEL, RESPONSE_GAMMA, VIGNETTING, Flicker, GainDrift
from virest.diagnosis.photometry_fit import fit_photometry, significance
from virest.diagnosis.picture_ladder import (
    PictureVerdict,
    changes_of,
    climb_blur,
    climb_observations,
    frames_of,
    values_of,
)

GAIN = np.exp(0.1 * np.sin(0.9 * np.arange(FRAMES)))
LIGHT = {
    "vignetting": (VIGNETTING, hidden(vignetting_corner_loss=0.4)),
    "flicker": (Flicker(), hidden(flicker_amplitude=0.3, flicker_frequency_hz=113.0, flicker_phase_rad=6.2)),
    "gain_drift": (GainDrift(tuple(range(FRAMES)), FRAMES), hidden(gain=tuple((GAIN / np.median(GAIN)).tolist()))),
    "response_curve": (RESPONSE_GAMMA, hidden(1.25)),
    "black_level": (BLACK_LEVEL, hidden(1.0, 0.05)),
}


@pytest.mark.parametrize("name", LIGHT)
def test_a_brightness_effect_is_significant_only_as_a_change_of_the_profile(
    name: str, rng: np.random.Generator
) -> None:
    """It is significant for the profile without it and not for the profile with it."""
    effect, true = LIGHT[name]
    observed = made_observations(true, rng, 0.5)
    for given in (NOMINAL, true):
        p_value = significance(fit_photometry(observed, given, [effect]), name, observed, given)[1]
        assert (p_value < 1e-6) == (given is NOMINAL), p_value
        assert given is NOMINAL or p_value > 1e-3


@pytest.mark.parametrize(
    ("name", "wrong", "parameter"),
    [
        ("vignetting", {"vignetting_corner_loss": 0.7}, "corner_loss"),
        ("flicker", {"flicker_amplitude": 0.3, "flicker_frequency_hz": 96.0}, "frequency_hz"),
    ],
)
def test_a_cause_is_measured_from_the_given_profile(
    name: str, wrong: dict[str, float], parameter: str, rng: np.random.Generator
) -> None:
    """The true profile has no cause; a wrong value becomes the nominal value of its cause."""
    _, true = LIGHT[name]
    observed = made_observations(true, rng, 0.5)
    observed = observed.subset(observed.place % 5 == 0)
    assert not climbed(true, observed)
    given = hidden(**wrong)
    (finding,) = climbed(given, observed)
    change = finding.parameters[parameter]
    assert change.nominal == values_of(LIGHT[name][0], given)[parameter]
    assert change.estimate == pytest.approx(values_of(LIGHT[name][0], true)[parameter], rel=0.05)


def climbed(given: CameraProfile, observed: PhotometricObservations) -> list[Finding]:
    """The brightness causes that a profile lacks."""
    verdict = PictureVerdict(given)
    climb_observations(verdict, observed, FRAMES)
    return verdict.findings


def test_gains_are_measured_from_those_of_the_profile(rng: np.random.Generator) -> None:
    """Frames beyond the profile's list have a gain of 1."""
    effect, true = LIGHT["gain_drift"]
    fit = fit_photometry(made_observations(true, rng), true, [effect])
    std = np.sqrt(np.diag(fit.of("gain_drift")[1]))
    before = {"gain": values_of(effect, true)["gain"][:10]}
    change = changes_of(before, values_of(effect, fit.profile), std, frames_of(fit))["gain"]
    assert change.nominal == [*true.extensions.gain[:10], *[1.0] * (FRAMES - 10)]


# ── blur ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def blur_findings(
    monkeypatch: pytest.MonkeyPatch, given: CameraProfile, scale: float, sigma: float, widest_px: float = float("inf")
) -> list[Finding]:
    """Findings for a blur with this exposure scale and defocus, in frames whose spectra allow ``widest_px``."""
    widths = (np.array([scale]), np.array([sigma]))
    nuisance = np.array([0.6, 0.0])
    found = BlurFit(("", ""), widths, np.diag([0.02**2, 0.05**2]), nuisance, given, 0.1, (True, True))
    judged: list[Any] = []
    observations = type("Seen", (SimpleNamespace,), {"__len__": lambda _: 500})(steps=None, allow=widest_px.__ge__)
    monkeypatch.setattr(picture_ladder, "moving_focus", lambda *_: None)
    monkeypatch.setattr(local_blur, "frames_to_read", lambda _: [1, 2])
    monkeypatch.setattr(local_blur, "look_for_blur", lambda *_: observations)
    monkeypatch.setattr(local_blur_fit, "fit", lambda *_: found)
    monkeypatch.setattr(local_blur_fit, "judge", lambda *_: 0.1)
    gain = HeldOutGain("", 2.0, 1.0, None)
    monkeypatch.setattr(local_blur_fit, "held_out", lambda *a: judged.append(a) or [gain] * len(a[3]))
    verdict, _ = climb_blur(None, given, None, None, None)  # type: ignore[arg-type]
    assert ("the scene has soft edges" in "".join(verdict.notes)) is (widest_px < sigma - 0.1)
    assert len(judged) == bool(verdict.findings)
    return verdict.findings


def test_a_defocus_wider_than_the_spectra_of_frames_allow_is_not_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Edges of the scene may be soft; two standard deviations are left to the edges' errors."""
    given = CameraProfile(64, 48)
    assert [found.name for found in blur_findings(monkeypatch, given, 1.0, 2.0, 1.95)] == ["defocus"]
    assert not blur_findings(monkeypatch, given, 1.0, 2.0, 1.5)


def blurred(scale: float, sigma: float) -> CameraProfile:
    """A profile with this exposure scale and defocus."""
    return CameraProfile(64, 48, shutter=Shutter(exposure_scale=scale), extensions=Extensions(defocus_sigma_px=sigma))


@pytest.mark.parametrize("given", [(1.0, 0.0), (0.8, 2.0), (1.5, 1.3)])
def test_a_blur_already_in_the_profile_is_not_a_cause(monkeypatch, given: tuple[float, float]) -> None:
    """The profile already contains the measured exposure scale and defocus, so nothing is found."""
    assert not blur_findings(monkeypatch, blurred(*given), given[0] + 0.01, given[1] + 0.02)


@pytest.mark.parametrize(("scale", "sigma"), [(1.0, 0.02), (1.0, 0.0), (0.5, 3.2)])
def test_blur_is_named_as_a_change_of_the_profile(monkeypatch, scale: float, sigma: float) -> None:
    """Exposure scale and defocus may both be larger or smaller."""
    found = {f.name: f for f in blur_findings(monkeypatch, blurred(0.8, 2.0), scale, sigma)}
    assert found.keys() == {"exposure_time", "defocus"}
    assert found["exposure_time"].parameters["exposure_scale"] == ParameterChange(0.8, scale, 0.02)
    assert found["defocus"].parameters["sigma_px"] == ParameterChange(2.0, sigma, 0.05)
    assert all(finding.p_value is not None and finding.p_value < 1e-4 for finding in found.values())


# ── points ───────────────────────────────────────────────────────────────────────────────────────────────────────


def cause(name: str, parameter: str, change: ParameterChange) -> Finding:
    """A cause found with the points."""
    return Finding(name, {parameter: change}, HeldOutGain(GEOMETRY, 1.0, 0.1, 0.1), (), 1e-9, "")


@pytest.mark.parametrize(("stamp", "share"), [("exposure_start", 0.5), ("exposure_end", -0.5)])
def test_an_offset_is_explained_as_an_exposure_change(stamp: str, share: float) -> None:
    """10 ms logged, 8 ms by the profile, 12 ms in truth: the middle of each row's exposure shifts by 2 ms."""
    given = CameraProfile(64, 48, shutter=Shutter(timestamp=stamp, exposure_scale=0.8))
    offset = cause("time_offset", "time_offset_s", ParameterChange(0.001, 0.001 + share * 0.004, 5e-5))
    change = exposure_hypothesis([offset], np.full(9, 0.01), given)
    assert change is not None
    assert (change.nominal, change.estimate, change.std) == pytest.approx((0.8, 1.2, 0.01))
    finding = as_exposure([offset], change)
    assert finding.parameters == {"exposure_scale": change}


def test_timestamps_at_exposure_middle_are_independent_of_exposure() -> None:
    """An offset then cannot be explained by the exposure."""
    given = CameraProfile(64, 48, shutter=Shutter(timestamp="exposure_middle"))
    offset = cause("time_offset", "time_offset_s", ParameterChange(0.0, 0.002, 5e-5))
    assert exposure_hypothesis([offset], np.full(9, 0.01), given) is None


def test_an_estimated_depth_is_written_into_the_profile() -> None:
    """The profile used for the fits keeps the given depth; the scene is stored separately."""
    given = CameraProfile(64, 48, depth_m=np.inf)
    depth = cause("scene_depth", "depth_m", ParameterChange(np.inf, 1.5, 0.01))
    assert with_depth_of([depth], given).depth_m == 1.5
    assert with_depth_of([], given) is given
