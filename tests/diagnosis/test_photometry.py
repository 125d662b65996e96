"""Hidden photometric effects are recovered from brightness alone, without false alarms."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from virest.app.simulate import simulate_command
from virest.camera.profile import CameraProfile, Extensions
from virest.camera.profile_file import read_profile
from virest.camera.response import ResponseCurve
from virest.camera.shutter import Shutter
from virest.capture.folder import read_capture
from virest.capture.video import probe_movie, read_frames
from virest.diagnosis.curve_from_blur import MixingEvidence, estimate_mixing, judge_mixing, observe_mixing
from virest.diagnosis.field.brightness import (
    BAND,
    SLOPE,
    instead_of_flicker,
    instead_of_gain,
    light_field,
    with_light_field,
)
from virest.diagnosis.findings import BLUR, PHOTOMETRY, Finding, HeldOutGain, ParameterChange
from virest.diagnosis.photometry import PhotometricObservations, log_light_factor, remembered, residuals
from virest.diagnosis.photometry_effects import (
    BLACK_LEVEL,
    RESPONSE_GAMMA,
    VIGNETTING,
    Flicker,
    GainDrift,
    PhotometricEffect,
    photometric_effects,
)
from virest.diagnosis.photometry_fit import RESOLUTION, fit_photometry, judge, pulls, significance, time_blocks
from virest.diagnosis.photometry_noise import measured_noise
from virest.diagnosis.photometry_patches import observe_photometry
from virest.diagnosis.picture_ladder import (
    UNEVEN,
    PictureVerdict,
    changes_of,
    climb_observations,
    name_curve,
    values_of,
)
from virest.diagnosis.refit_photometry import settle_light
from virest.diagnosis.selection import LIGHT_LEVELS
from virest.motion.integration import integrate_gyro

FRAMES, NOISE = 60, 0.5
NOMINAL = CameraProfile(
    640, 480, shutter=Shutter(0.018, "bottom_to_top"), response=ResponseCurve("srgb"), time_offset_s=0.002
)


def made_observations(
    true: CameraProfile,
    rng: np.random.Generator,
    products: float = 0.0,
    pace: float = 0.4,
    exposures_s: tuple[float, ...] = (0.007,),
    patches: int = 150,
) -> PhotometricObservations:
    """Patches that move through the frame, with grey levels from the documented model.

    ``products`` is the spread of the logged exposure × ISO in log light, ``pace`` the speed of its walk in rad per
    frame, and ``exposures_s`` the frames' exposures in turn.
    """
    frame = np.tile(np.arange(FRAMES), patches)
    patch = np.repeat(np.arange(patches), FRAMES)
    sway = 90 * np.stack([np.sin(0.31 * np.arange(FRAMES)), np.cos(0.17 * np.arange(FRAMES))], axis=-1)
    at = rng.uniform((100, 100), (540, 380), (patches, 2))[patch] + sway[frame]
    light = np.exp(rng.uniform(np.log(0.02), np.log(0.5), patches))[patch]
    log_product = products * np.sin(pace * frame + 0.3)
    fraction = 1 - (at[:, 1] + 1) / 480
    radius = np.hypot(at[:, 0] - 319.5, at[:, 1] - 239.5) / 400.0
    ext, exposure = true.extensions, np.resize(exposures_s, FRAMES)[frame]
    time = frame / 29.7 + 0.002 + fraction * 0.018
    fine = time[:, None] + exposure[:, None] * (np.arange(64) + 0.5) / 64
    wave = 1 + ext.flicker_amplitude * np.sin(2 * np.pi * ext.flicker_frequency_hz * fine + ext.flicker_phase_rad)
    light = light * np.exp(log_product) * wave.mean(axis=1) * (1 - ext.vignetting_corner_loss * radius**2)
    light = light * np.array(ext.gain or np.ones(FRAMES))[frame]
    assert true.response is not None
    plain = np.where(light > 0.0031308, 1.055 * light ** (1 / 2.4) - 0.055, 12.92 * light) ** true.response.extra_gamma
    grey = 255 * (true.response.black_level + (1 - true.response.black_level) * plain)
    grey += NOISE * rng.normal(size=len(grey))
    return PhotometricObservations(
        3 * patch, frame, frame / 29.7, fraction, at[:, 0], at[:, 1], radius, grey, np.full(len(grey), NOISE),
        exposure, log_product, np.zeros(len(grey)), frame == 0, True, 640, 480,
    )  # fmt: skip


def hidden(gamma: float = 1.0, black: float = 0.0, **extensions: object) -> CameraProfile:
    """The nominal profile with hidden effects."""
    curve = ResponseCurve("srgb", extra_gamma=gamma, black_level=black)
    return replace(NOMINAL, response=curve, extensions=Extensions(**extensions))  # type: ignore[arg-type]


def test_the_true_profile_leaves_only_noise(rng: np.random.Generator) -> None:
    """With the profile that made the observations, residuals equal the noise."""
    true = hidden(1.25, 0.04, vignetting_corner_loss=0.35, flicker_amplitude=0.2, flicker_frequency_hz=120.0)
    left = residuals(made_observations(true, rng, 0.3), true)
    assert np.std(left) == pytest.approx(NOISE, rel=0.03)
    assert np.std(residuals(made_observations(true, rng, 0.3), NOMINAL)) > 4 * NOISE


def test_a_shadow_on_one_side_is_a_field_of_gain(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """The map is recovered beside a vignette in the profile; without the shadow there is none.

    If all patches move alike, an even slope equals a gain per frame: only the curvature of the map is determined.
    """

    def shadow(x_px):
        return -0.2 * (x_px / 639) ** 3

    profile = hidden(vignetting_corner_loss=0.3)
    observed = made_observations(profile, rng)
    assert light_field(observed, profile) is None
    factor = np.exp(shadow(observed.x_px))
    grey = np.asarray(NOMINAL.response.encode(NOMINAL.response.linearise(observed.grey / 255) * factor)) * 255
    found = light_field(replace(observed, grey=grey), profile)
    assert found is not None
    x, y = np.meshgrid(np.linspace(100, 540, 9), np.linspace(80, 400, 7), indexing="ij")
    off = np.log(1 + found.field.at(x, y)[..., 0]) - shadow(x)
    plane = np.stack([np.ones(x.size), x.ravel(), y.ravel()], axis=-1)
    bend = off.ravel() - plane @ np.linalg.lstsq(plane, off.ravel(), rcond=None)[0]
    assert np.abs(bend).max() < 0.03
    assert found.held_out.gain > 0.8
    assert light_field(replace(observed, grey=grey), with_light_field(profile, found)) is None
    worse = HeldOutGain(PHOTOMETRY, 0.71, 0.72, 0.6)
    monkeypatch.setattr("virest.diagnosis.field.brightness._held_out", lambda *_: worse)
    assert light_field(replace(observed, grey=grey), profile) is None  # it predicts other patches worse


def test_stationary_flicker_is_replaced_by_a_shadow(rng: np.random.Generator) -> None:
    """A shadow over the rows is no light at the frame rate; a light at a multiple of it is as bands of the rows."""
    standing = {"flicker_amplitude": 0.03, "flicker_frequency_hz": 29.7, "flicker_phase_rad": 1.0}
    observed = made_observations(hidden(), rng)
    factor = 1 - 0.2 * (observed.x_px / 639) ** 3 - 0.1 * (observed.y_px / 479) ** 3
    linear = NOMINAL.response.linearise(observed.grey / 255) * factor
    shaded = replace(observed, grey=np.asarray(NOMINAL.response.encode(linear)) * 255)
    found = instead_of_flicker(shaded, hidden(**standing))
    assert found is not None
    assert found.finding.confounded == ("flicker at 29.7 Hz",)
    lamp = hidden(flicker_amplitude=0.15, flicker_frequency_hz=4 * 29.7, flicker_phase_rad=2.0)
    bands = instead_of_flicker(made_observations(lamp, rng), lamp)
    assert bands is not None
    assert (found.is_bands, bands.is_bands) == (False, True)
    assert bands.finding.shape == BAND
    drifting = hidden(flicker_amplitude=0.15, flicker_frequency_hz=4 * 29.7 + 1.0, flicker_phase_rad=2.0)
    assert instead_of_flicker(made_observations(drifting, rng), drifting) is None
    assert instead_of_flicker(shaded, hidden(**standing | {"flicker_frequency_hz": 31.0})) is None


def dimmed(observed: PhotometricObservations, factor: NDArray[np.float64]) -> PhotometricObservations:
    """The patches with their light multiplied by a factor (n,)."""
    linear = NOMINAL.response.linearise(observed.grey / 255) * factor
    return replace(observed, grey=np.asarray(NOMINAL.response.encode(linear)) * 255)


def named(observed: PhotometricObservations) -> dict[str, PictureVerdict]:
    """The verdict of the brightness ladder, by the causes that it names."""
    verdict = PictureVerdict(NOMINAL)
    climb_observations(verdict, observed, FRAMES)
    return dict.fromkeys([finding.name for finding in verdict.findings], verdict)


def test_a_shadow_over_part_of_the_frame_is_not_a_global_cause(rng: np.random.Generator) -> None:
    """The shadow is static, temporary or moving. Dimming of the whole frame is a gain drift."""
    observed = made_observations(hidden(), rng, patches=80)
    x, t = observed.x_px / 639, observed.frame / FRAMES
    side, while_there = 1 / (1 + np.exp(-(x - 0.5) / 0.06)), np.exp(-(((t - 0.5) / 0.2) ** 2))
    one_side = 1 / (1 + np.exp(-(x - 0.6) / 0.06))
    for shade in (one_side, side * while_there, np.exp(-(((x - 1.4 * t + 0.2) / 0.2) ** 2))):
        verdict = PictureVerdict(NOMINAL)
        climb_observations(verdict, dimmed(observed, 1 - 0.2 * shade), FRAMES)
        assert not verdict.findings
        assert verdict.notes == [UNEVEN]
    assert list(named(dimmed(observed, 1 - 0.2 * while_there))) == ["gain_drift"]


def test_a_vignette_keeps_its_name_beside_a_shadow(rng: np.random.Generator) -> None:
    """Its size is nearly right, and no flicker at the frame rate is named."""
    observed = made_observations(hidden(vignetting_corner_loss=0.2), rng, patches=80)
    shade = 1 / (1 + np.exp(-(observed.x_px / 639 - 0.6) / 0.06))
    found = named(dimmed(observed, 1 - 0.2 * shade))
    assert list(found) == ["vignetting"]
    assert found["vignetting"].profile.extensions.vignetting_corner_loss == pytest.approx(0.2, abs=0.05)


def test_a_slope_of_the_light_is_not_a_gain_drift(rng: np.random.Generator) -> None:
    """For patches that move alike both are equivalent.

    The slope with few parameters is reported, with the gain drift as rival.
    """
    observed = made_observations(hidden(), rng, patches=80)
    found = named(dimmed(observed, 1 - 0.15 * observed.x_px / 639))
    verdict = found["gain_drift"]
    assert verdict.observations is not None
    slope = instead_of_gain(verdict.observations, verdict.profile)
    assert slope is not None
    assert slope.finding.shape == SLOPE
    assert slope.finding.confounded == ("gain_drift",)
    walk = np.cumsum(rng.normal(size=FRAMES))
    jitter = 0.008 * rng.normal(size=FRAMES)[observed.frame]  # gains too small to be told
    both = named(dimmed(observed, (1 - 0.15 * observed.x_px / 639) * np.exp(jitter)))["gain_drift"]
    assert both.observations is not None
    assert instead_of_gain(both.observations, both.profile) is not None
    drift = named(dimmed(observed, np.exp(0.15 * walk / np.ptp(walk))[observed.frame]))["gain_drift"]
    assert drift.observations is not None
    assert instead_of_gain(drift.observations, drift.profile) is None


def test_each_effect_is_recovered_within_its_deviation(rng: np.random.Generator) -> None:
    """Vignetting and flicker are found at a constant exposure, gamma and black level with a changing one."""
    observed = made_observations(hidden(vignetting_corner_loss=0.35), rng)
    fit = fit_photometry(observed, NOMINAL, [VIGNETTING])
    assert fit.values[0] == pytest.approx(0.35, abs=3 * fit.std[0] + 1e-9)
    assert fit.std[0] < 0.01
    lamp = hidden(flicker_amplitude=0.22, flicker_frequency_hz=100.0, flicker_phase_rad=2.0)
    fit = fit_photometry(made_observations(lamp, rng), NOMINAL, [Flicker()])
    np.testing.assert_array_less(np.abs(fit.values - (0.22, 100.0, 2.0)), 4 * fit.std)
    assert fit.std[0] < 0.012  # the exposure of 7 ms leaves 0.37 of the amplitude visible
    fit = fit_photometry(made_observations(hidden(1.2, 0.05), rng, 0.25), NOMINAL, [RESPONSE_GAMMA, BLACK_LEVEL])
    np.testing.assert_array_less(np.abs(fit.values - (1.2, 0.05)), 4 * fit.std)
    np.testing.assert_array_less(fit.std, (0.03, 0.01))
    # both deviations include the correlation, which makes them larger than with one effect alone
    alone = fit_photometry(made_observations(hidden(1.2, 0.05), rng, 0.25), hidden(1.2), [BLACK_LEVEL])
    floor = RESOLUTION["black_level"] ** 2
    assert fit.covariance[1, 1] - floor > 1.5 * (alone.covariance[0, 0] - floor)


def test_gains_are_judged_on_other_patches(rng: np.random.Generator) -> None:
    """Gains per frame are recovered with median 1 and hold for patches that were not fitted."""
    gain = np.exp(0.08 * np.sin(0.9 * np.arange(FRAMES)) + 0.05 * np.cos(0.21 * np.arange(FRAMES)))
    gain /= np.median(gain)
    observed = made_observations(hidden(gain=tuple(gain)), rng)
    effect = GainDrift(tuple(range(FRAMES)), FRAMES)
    fit = fit_photometry(observed, NOMINAL, [effect])
    off = np.log(fit.profile.extensions.gain) - np.log(gain)
    assert np.median(fit.profile.extensions.gain) == pytest.approx(1.0, abs=1e-6)
    # the errors of these patches are independent, while the deviations allow for correlated ones
    assert 0.15 < np.std(off / fit.std) < 1.3
    held = judge(observed, NOMINAL, [effect])
    assert held.gain > 0.98


def test_constant_exposure_leaves_the_curve_undetermined(rng: np.random.Generator) -> None:
    """Without a change of light, brightness does not determine gamma or black level: deviations are large."""
    observed = made_observations(hidden(1.2, 0.05), rng)
    for effect, wide in ((RESPONSE_GAMMA, 0.3), (BLACK_LEVEL, 0.03)):
        fit = fit_photometry(observed, NOMINAL, [effect])
        assert fit.std[0] > wide
        assert significance(fit, effect.name, observed, NOMINAL)[1] > 1e-3


def test_flicker_that_the_exposure_averages_away_is_not_found(rng: np.random.Generator) -> None:
    """An exposure of a whole number of periods removes the flicker."""
    observed = made_observations(hidden(flicker_amplitude=0.4, flicker_frequency_hz=1 / 0.007), rng)
    fit = fit_photometry(observed, NOMINAL, [Flicker()])
    assert significance(fit, "flicker", observed, NOMINAL)[1] > 1e-3


@pytest.mark.parametrize("exposures_s", [(0.013, 0.008, 0.010), (0.012, 0.007)])
def test_alternating_exposures_do_not_bias_flicker(exposures_s: tuple[float, ...], rng: np.random.Generator) -> None:
    """Each exposure averages the light by its own factor; the exposures' rhythm is not that of the light."""
    lamp = hidden(flicker_amplitude=0.3, flicker_frequency_hz=120.0, flicker_phase_rad=2.0)
    fit = fit_photometry(made_observations(lamp, rng, exposures_s=exposures_s), NOMINAL, [Flicker()])
    assert fit.values[1] == pytest.approx(120.0, abs=0.02)
    assert abs(fit.values[0]) == pytest.approx(0.3, abs=0.02)


def test_the_memory_of_an_encoder_does_not_weaken_flicker(rng: np.random.Generator) -> None:
    """A movie that follows brightness slowly still gives the light's own amplitude and phase."""
    lamp = hidden(flicker_amplitude=0.2, flicker_frequency_hz=100.0, flicker_phase_rad=1.0)
    observed = made_observations(lamp, rng)
    slow = replace(observed, grey=remembered(observed.with_memory(0.3), observed.grey))
    by_hand = 0.7 * observed.grey[1] + 0.3 * observed.grey[0], observed.grey[FRAMES]
    np.testing.assert_allclose((slow.grey[1], slow.grey[FRAMES]), by_hand)
    fit = fit_photometry(slow, NOMINAL, [Flicker()])
    assert fit.memory == pytest.approx(0.3, abs=0.05)
    np.testing.assert_array_less(np.abs(fit.values - (0.2, 100.0, 1.0)), 3 * fit.std)


def test_a_slow_encoder_does_not_hide_flicker(rng: np.random.Generator) -> None:
    """An error of the encoder's memory scales the flicker, so it is no reason to doubt that there is one."""
    observed = made_observations(hidden(flicker_amplitude=0.2, flicker_frequency_hz=100.0), rng)
    slow = replace(observed, grey=remembered(observed.with_memory(0.5), observed.grey))
    fit = fit_photometry(slow, NOMINAL, [Flicker()])
    assert LIGHT_LEVELS.significant(significance(fit, "flicker", slow, NOMINAL)[1])
    assert fit.std[0] > fit.memory_error[0] > 0.1 * fit.values[0]


def test_an_exposure_of_nearly_a_period_widens_the_amplitude(rng: np.random.Generator) -> None:
    """The least visible error of brightness is a large one of the lamp's amplitude, of which little is visible."""
    lamp = hidden(flicker_amplitude=0.4, flicker_frequency_hz=100.0)
    for exposure_s in (5e-3, 9.2e-3):
        fit = fit_photometry(made_observations(lamp, rng, exposures_s=(exposure_s,)), NOMINAL, [Flicker()])
        assert fit.std[0] > RESOLUTION["flicker"] / np.sinc(100.0 * exposure_s)
        assert abs(fit.values[0] - 0.4) < 2 * fit.std[0]


@pytest.mark.parametrize("seen", [1.0, 0.3])
def test_noise_excludes_changes_of_the_light(rng: np.random.Generator, seen: float) -> None:
    """A changing exposure, flicker and an unknown curve do not count as noise.

    Nor does it matter if patches are seen only in a part of the movie, each at other exposures.
    """
    lamp = {"flicker_amplitude": 0.2, "flicker_frequency_hz": 120.0}
    observed = made_observations(hidden(1.2, 0.05, vignetting_corner_loss=0.3, **lamp), rng, 0.3)
    first = rng.integers(0, FRAMES, 150)[observed.place]
    observed = observed.subset((observed.frame - first) % FRAMES < seen * FRAMES)
    found = measured_noise(observed, NOMINAL.response).noise
    assert np.sqrt(np.mean(found**2)) == pytest.approx(NOISE, rel=0.25)
    assert np.quantile(found, 0.95) < 2 * NOISE


def test_gains_do_not_replace_a_gamma(rng: np.random.Generator) -> None:
    """A gamma with changing exposures is one cause, although a free gain per frame would remove as much."""
    observed = measured_noise(made_observations(hidden(1.15), rng, 0.2), NOMINAL.response)
    verdict = PictureVerdict(NOMINAL)
    climb_observations(verdict, observed, FRAMES)
    (cause,) = verdict.findings
    assert cause.name == "response_curve"
    assert cause.parameters["gamma"].estimate == pytest.approx(1.15, abs=3 * cause.parameters["gamma"].std)
    assert cause.held_out.after < cause.held_out.before
    # the noise is the measured one, not the residual of the fit
    assert cause.held_out.noise == pytest.approx(np.sqrt(np.mean(observed.noise**2)), rel=0.02)


# ── mixing by blur ─────────────────────────────────────────────────────────────────────────────────────────────────


def mixing_evidence(rng: np.random.Generator, strength: float, gamma: float, agreement: float) -> MixingEvidence:
    """Tiles of ten pairs of frames in which a change of the curve equals ``strength`` times the noise per pixel.

    ``agreement`` is the correlation of the coding error with such a change.
    """
    pair, steps = np.repeat(np.arange(10), 40), np.log([0.8, 1.0, 1.25])
    pixels = np.full(len(pair), 1000.0)
    stiffness = pixels * (strength * rng.uniform(0.6, 1.4, len(pair))) ** 2
    pull = np.sqrt(stiffness) * (rng.normal(size=len(pair)) + agreement * np.sqrt(pixels))
    score = stiffness[:, None] * (steps - np.log(gamma)) - pull[:, None]
    rows = {"response_curve": steps}
    return MixingEvidence(
        pair, pixels, np.full(len(pair), 1.5), 30.0, rows, {"response_curve": stiffness}, {"response_curve": score},
        {"response_curve": pixels},
    )  # fmt: skip


def test_an_encoder_that_mixes_grey_is_not_a_gamma(rng: np.random.Generator) -> None:
    """A coding error that resembles a gamma in every pair is outweighed only if enough light is mixed."""
    false = mixing_evidence(rng, 0.12, 1.0, 0.07)
    found = estimate_mixing(false, NOMINAL, "response_curve")
    assert found is not None
    assert found.value > 1.5
    assert found.p_value > 0.05
    true = mixing_evidence(rng, 1.5, 1.25, 0.07)
    found, held = estimate_mixing(true, NOMINAL, "response_curve"), judge_mixing(true, "response_curve")
    assert found is not None
    assert held is not None
    assert found.p_value < 1.5e-3
    assert found.value == pytest.approx(1.25, abs=2 * found.std)
    # 1.5 times the noise of 1.5 levels per pixel, times the change of log gamma, added to these 1.5 levels
    assert held.before == pytest.approx(1.5 * np.sqrt(1 + 1.05 * (1.5 * np.log(1.25) + 0.07) ** 2), rel=0.02)
    assert held.after == pytest.approx(1.5, rel=0.02)


def test_time_blocks_are_contiguous_and_of_several_lengths(rng: np.random.Generator) -> None:
    """Time blocks never split a frame, are consecutive, and vary in length."""
    observed = made_observations(NOMINAL, rng)
    block = time_blocks(observed)
    first = block[:FRAMES]
    assert np.array_equal(block, np.tile(first, len(block) // FRAMES))
    assert np.all(np.isin(np.diff(first), (0, 1)))
    assert len(set(np.bincount(first)[:-1].tolist())) > 1


# ── with a movie ───────────────────────────────────────────────────────────────────────────────────────────────────

Observe = Callable[..., tuple[PhotometricObservations, CameraProfile, CameraProfile]]


@pytest.fixture
def observe(tmp_path: Path) -> Observe:
    """Simulate a small capture with hidden effects and observe its patches with the nominal profile."""

    def run(*effects: str, log_gains: bool = False, **options: object):
        folder = tmp_path / "capture"
        simulate_command(
            folder, width=320, height=240, frames=30, effects=effects, overwrite=True, seed=41,
            **{"bitrate_bits_per_px": 1.0, "truth_frames": False, **options},  # type: ignore[arg-type]
        )  # fmt: skip
        capture = read_capture(folder, look_at_pictures=False)
        nominal, true = read_profile(folder / "camera.yaml"), read_profile(folder / "truth" / "camera.yaml")
        gain = true.extensions.gain if log_gains else (1.0,) * 30
        movie = read_frames(capture.movie, probe_movie(capture.movie), 0, 29)
        pictures = ((replace(capture.frames[i], iso=144 * gain[i] + 1e-6), picture) for i, picture in movie)
        trajectory = integrate_gyro(capture.imu, nominal)
        return observe_photometry(pictures, trajectory, nominal, intra_frames=capture.keyframes), nominal, true

    return run


def test_vignetting_is_found_despite_wrong_geometry(observe: Observe) -> None:
    """A clock offset of 10 ms moves patches by several pixels; the corner loss is still recovered."""
    observed, nominal, true = observe("vignetting=0.4", "time_offset=0.01", rate_rad_s=1.4)
    fit = fit_photometry(observed, nominal, [VIGNETTING])
    assert fit.values[0] == pytest.approx(true.extensions.vignetting_corner_loss, abs=0.04)
    assert fit.values[0] == pytest.approx(true.extensions.vignetting_corner_loss, abs=3 * fit.std[0])
    assert significance(fit, "vignetting", observed, nominal)[1] < 1e-6
    assert judge(observed, nominal, [VIGNETTING]).gain > 0.8


def test_flicker_is_found_in_a_movie(observe: Observe) -> None:
    """Amplitude, frequency and phase are recovered from rows and frames."""
    observed, nominal, _ = observe("flicker=0.25,100,1.3", exposure_ms=8.0)
    fit = fit_photometry(observed, nominal, [Flicker()])
    assert fit.values[0] == pytest.approx(0.25, abs=0.03)
    assert fit.values[1] == pytest.approx(100.0, abs=0.3)
    assert np.sin(fit.values[2] - 1.3) == pytest.approx(0.0, abs=0.25)


def test_a_curve_is_found_with_changing_logged_light(observe: Observe) -> None:
    """If exposure × ISO changes as logged, gamma is recovered."""
    observed, nominal, _ = observe("gain_drift=0.2", "response_curve=1.25", log_gains=True)
    fit = fit_photometry(observed, nominal, [RESPONSE_GAMMA])
    assert fit.values[0] == pytest.approx(1.25, abs=0.06)
    assert fit.values[0] == pytest.approx(1.25, abs=3 * fit.std[0] + 0.01)
    assert log_light_factor(observed, nominal) == pytest.approx(observed.log_product)


def test_a_true_profile_has_no_photometric_effect(observe: Observe) -> None:
    """No effect is significant for a capture that its profile describes, even with a wrong clock offset."""
    observed, nominal, _ = observe("time_offset=-0.008", scene="bright")
    noise = np.sqrt(np.mean(observed.noise**2))
    assert np.sqrt(np.mean(np.clip(residuals(observed, nominal), -4, 4) ** 2)) < 1.6 * noise
    for effect in photometric_effects(observed, 30):
        fit = fit_photometry(observed, nominal, [effect])
        assert significance(fit, effect.name, observed, nominal)[1] > 1e-4, effect.name


def test_blur_shows_the_curve_at_constant_exposure(tmp_path: Path) -> None:
    """Comparing blurred and sharp frames determines a gamma, unlike brightness alone; the true profile needs none."""
    folder = tmp_path / "capture"
    simulate_command(
        folder, width=400, height=320, focal_px=420, frames=30, exposure_ms=10, rate_rad_s=1.2, seed=53,
        effects=["response_curve=1.3"], bitrate_bits_per_px=1.0, truth_frames=False,
    )  # fmt: skip
    capture = read_capture(folder, look_at_pictures=False)
    index = probe_movie(capture.movie)
    nominal, true = read_profile(folder / "camera.yaml"), read_profile(folder / "truth" / "camera.yaml")
    trajectory = integrate_gyro(capture.imu, nominal)

    def rgb(wanted: Sequence[int]) -> Iterator[tuple[int, NDArray[np.uint8] | None]]:
        return (one for one in read_frames(capture.movie, index, 0, 29) if one[0] in wanted)

    found = []
    for profile in (nominal, true):
        evidence = observe_mixing(rgb, capture.frames, trajectory, profile)
        found.append(estimate_mixing(evidence, profile, "response_curve"))
        held = judge_mixing(evidence, "response_curve")
        assert held is not None
        assert (held.gain > 0.7) == (profile is nominal)
        assert held.noise <= held.after
    hidden_gamma, nothing = found
    assert hidden_gamma is not None
    assert nothing is not None
    assert hidden_gamma.value == pytest.approx(1.3, abs=min(3 * hidden_gamma.std, 0.13))
    assert hidden_gamma.p_value < 1e-3 < nothing.p_value


# ── values with the estimated curve ────────────────────────────────────────────────────────────────────────────────


def lit(observed: PhotometricObservations, nominal: CameraProfile, effect: PhotometricEffect) -> PictureVerdict:
    """The ladder's verdict that names this one effect."""
    fit = fit_photometry(observed, nominal, [effect])
    std = np.sqrt(np.diag(fit.of(effect.name)[1]))
    changes = changes_of(values_of(effect, nominal), values_of(effect, fit.profile), std)
    p_value = significance(fit, effect.name, observed, nominal)[1]
    finding = Finding(effect.name, changes, HeldOutGain(PHOTOMETRY, 2.0, 0.5, 0.5), (), p_value, "")
    return PictureVerdict(fit.profile, [finding], observations=observed, fitted=fit)


def settled(
    observed: PhotometricObservations, evidence: MixingEvidence | None, given: CameraProfile = NOMINAL
) -> tuple[PictureVerdict, PictureVerdict, CameraProfile]:
    """(ladder's verdict, the same settled, profile) for patches and mixing by blur."""
    light = lit(observed, given, VIGNETTING)
    curve = PictureVerdict(light.profile)
    if evidence is not None:
        name_curve(curve, evidence)
    return light, *settle_light(light, curve, given, [])


def loss_of(verdict: PictureVerdict) -> tuple[float, float]:
    """The named corner loss and its deviation."""
    change = next(f for f in verdict.findings if f.name == "vignetting").parameters["corner_loss"]
    return change.estimate, change.std


def test_vignetting_uses_the_curve_determined_by_blur(rng: np.random.Generator) -> None:
    """A gamma darkens corners further.

    With the estimated gamma, the loss is right and its deviation includes that of gamma.
    """
    observed = made_observations(hidden(1.3, vignetting_corner_loss=0.5), rng)
    light, final, profile = settled(observed, mixing_evidence(rng, 1.5, 1.3, 0.02))
    assert profile.response is not None
    gamma = profile.response.extra_gamma
    assert gamma == pytest.approx(1.3, abs=0.15)
    (taken, _), (loss, std) = loss_of(light), loss_of(final)
    assert taken == pytest.approx(1 - 0.5**1.3, abs=0.02)
    assert loss == pytest.approx(0.5, abs=2 * std)
    assert profile.extensions.vignetting_corner_loss == loss
    assert f"{loss:.3g}" in next(f.sentence for f in final.findings if f.name == "vignetting")
    # patches determine (1 − loss)^gamma
    mixed = PictureVerdict(NOMINAL)
    name_curve(mixed, mixing_evidence(np.random.default_rng(1), 1.5, 1.3, 0.02))
    gamma_std = mixed.findings[0].parameters["gamma"].std
    assert std == pytest.approx(0.5 * np.log(2) * gamma_std / gamma, rel=0.25)


@pytest.mark.parametrize(("strength", "true"), [(None, 1.25), (0.12, 0.8), (None, 1.0)])
def test_an_unknown_curve_widens_the_deviation_of_vignetting(
    rng: np.random.Generator, strength: float | None, true: float
) -> None:
    """Without sufficient blur, the loss holds for the profile's curve with a larger deviation.

    The significance of vignetting does not depend on the curve. A well-known curve does not change the result.
    """
    observed = made_observations(hidden(true, vignetting_corner_loss=0.5), rng)
    evidence = None if strength is None else mixing_evidence(rng, strength, true, 0.02)
    light, final, profile = settled(observed, evidence)
    assert profile.response == NOMINAL.response
    (taken, narrow), (loss, std) = loss_of(light), loss_of(final)
    assert loss == taken
    assert abs(loss - 0.5) < 2.5 * std
    assert std > 3 * narrow
    assert [f.p_value for f in final.findings] == pytest.approx([f.p_value for f in light.findings])
    assert any("could not be estimated at constant exposure" in note for note in final.notes) == (strength is None)
    known = NOMINAL.with_estimate("gamma", 1.0, 0.002, "calibrated")
    sure = loss_of(settled(observed, evidence, known)[1])
    assert sure == pytest.approx((taken, narrow), rel=0.05)


def test_flicker_uses_the_estimated_exposure(rng: np.random.Generator) -> None:
    """A longer exposure averages out more flicker.

    The amplitude is corrected, and its deviation includes that of the exposure.
    """
    true = hidden(flicker_amplitude=0.2, flicker_frequency_hz=100.0, flicker_phase_rad=1.0)
    short = replace(NOMINAL, shutter=replace(NOMINAL.shutter, exposure_scale=0.8))
    short = short.with_estimate("gamma", 1.0, 0.001, "calibrated")
    light = lit(made_observations(true, rng), short, Flicker())
    scale = ParameterChange(0.8, 1.0, 0.05)
    cause = Finding("exposure_time", {"exposure_scale": scale}, HeldOutGain(BLUR, 1.0, 0.5, 0.5), (), 0.0, "")
    found = replace(light.profile, shutter=NOMINAL.shutter)
    final, profile = settle_light(light, PictureVerdict(found), short, [cause])
    amplitude = final.findings[0].parameters["amplitude"]
    assert light.profile.extensions.flicker_amplitude < 0.17
    assert amplitude.estimate == profile.extensions.flicker_amplitude == pytest.approx(0.2, abs=0.01)
    # averaging over 0.7 of a period: d log sinc(0.7 s) / d log s = x cot x − 1 with x = 0.7 π
    x = 0.7 * np.pi
    assert amplitude.std == pytest.approx(0.2 * 0.05 * (1 - x / np.tan(x)), rel=0.15)


def test_an_insignificant_gamma_widens_the_deviation(rng: np.random.Generator) -> None:
    """With changing exposures, brightness limits the error of the curve and its effect on other parameters."""
    observed = made_observations(hidden(1.05, vignetting_corner_loss=0.5), rng, 0.25)
    light = lit(observed, NOMINAL, VIGNETTING)
    final, profile = settle_light(light, PictureVerdict(light.profile), NOMINAL, [])
    (taken, narrow), (loss, std) = loss_of(light), loss_of(final)
    assert loss == taken
    assert profile.response == NOMINAL.response
    assert light.fitted is not None
    pull = pulls(observed, light.profile, light.fitted, [(hidden(float(np.exp(0.01))), 0.01)])[0, 0]
    assert pull == pytest.approx(-0.5 * np.log(2), rel=0.25)
    assert std == pytest.approx(np.hypot(narrow, pull * np.log(1.05)), rel=0.2)


def followed_late(
    observed: PhotometricObservations, rng: np.random.Generator, most: float = 0.7
) -> PhotometricObservations:
    """The same patches after an encoder: each keeps a random part of its previous frame."""
    return kept_in_part(observed, rng.uniform(0.0, most, int(observed.patch.max()) + 1)[observed.patch])


def kept_in_part(observed: PhotometricObservations, keeps: NDArray[np.float64]) -> PhotometricObservations:
    """The same with the part of the previous frame given for each observation (n,)."""
    grey = observed.grey.copy()
    for k in range(1, FRAMES):
        now, before = observed.frame == k, observed.frame == k - 1
        grey[now] += keeps[now] * (grey[before] - grey[now])
    return replace(observed, grey=grey)


def p_of_gains(observed: PhotometricObservations) -> float:
    """p-value for no gain drift."""
    fit = fit_photometry(observed, NOMINAL, [GainDrift(tuple(range(FRAMES)), FRAMES)])
    return significance(fit, "gain_drift", observed, NOMINAL)[1]


def test_an_exposure_change_with_encoder_lag_is_not_a_gain(rng: np.random.Generator) -> None:
    """Free gains absorb what one memory for all patches leaves of an exposure change; true gains are still found."""
    assert p_of_gains(followed_late(made_observations(hidden(), rng, 1.0, 0.1), rng)) > 1e-4
    walk = np.exp(0.08 * np.sin(0.35 * np.arange(FRAMES) + 1))
    drifting = made_observations(hidden(gain=tuple(walk / np.median(walk))), rng, 1.0, 0.1)
    assert p_of_gains(followed_late(drifting, rng)) < 1e-5


def test_a_jitter_of_three_percent_shows_between_neighbouring_frames(rng: np.random.Generator) -> None:
    """While the exposure changes, the shared error of frames hides a small gain, but not from frame to frame."""
    jitter = np.exp(0.03 * rng.normal(size=FRAMES))
    true = hidden(gain=tuple(jitter / np.median(jitter)))
    shaken, steady = (
        followed_late(made_observations(profile, rng, 1.0, 0.1), rng, 0.3) for profile in (true, hidden())
    )
    assert p_of_gains(shaken) < 1e-5
    assert p_of_gains(steady) > 1e-3


def test_gains_of_frames_without_a_common_patch_cannot_be_compared(rng: np.random.Generator) -> None:
    """Half of the patches are seen early, the others late.

    The ratio of the halves is undetermined, gains within each are known.
    """
    observed = made_observations(hidden(), rng)
    early = observed.frame < FRAMES // 2
    parted = observed.subset(early == (observed.place < 75))
    fit = fit_photometry(parted, NOMINAL, [GainDrift(tuple(range(FRAMES)), FRAMES)])
    half = np.where(np.arange(FRAMES) < FRAMES // 2, 1.0, -1.0) / (FRAMES // 2)
    step = np.zeros(FRAMES)
    step[:2] = 1, -1
    assert np.sqrt(half @ fit.covariance @ half) > 0.3
    assert np.sqrt(step @ fit.covariance @ step) < 0.03


@pytest.mark.parametrize("seed", [0, 1])
def test_a_low_bit_rate_that_keeps_dark_patches_is_not_a_cause(seed: int) -> None:
    """Dark patches hardly follow the exposure in a movie that mostly repeats frames: no cause is named."""
    rng = np.random.default_rng(seed)
    made = made_observations(hidden(), rng, 0.8, 0.2)
    verdict = PictureVerdict(NOMINAL)
    climb_observations(verdict, kept_in_part(made, np.clip(0.95 - made.grey / 400, 0.45, 0.97)), FRAMES)
    assert verdict.findings == []


def test_a_black_level_beside_an_encoder_s_memory_is_named(rng: np.random.Generator) -> None:
    """An encoder that keeps a fifth of each frame does not hide a black level."""
    made = made_observations(hidden(black=0.04), rng, 0.8, 0.2)
    verdict = PictureVerdict(NOMINAL)
    climb_observations(verdict, kept_in_part(made, np.full(len(made), 0.2)), FRAMES)
    assert [finding.name for finding in verdict.findings] == ["black_level"]
