"""Sharpening is found by the overshoot at edges and distinguished from other effects on edges."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.special import ndtr

from virest.app.diagnose import Source, open_source
from virest.app.simulate import simulate_command
from virest.diagnosis.edge_overshoot import (
    GRID_PX,
    EdgeProfiles,
    Sharpening,
    fit_sharpening,
    judge_sharpening,
    sharpened_step,
)
from virest.diagnosis.picture_ladder import PictureVerdict, climb_blur
from virest.diagnosis.selection import MAX_P
from virest.motion.integration import integrate_gyro
from virest.motion.trajectory import Trajectory
from virest.simulation.phone_isp import PhoneIsp


def edges(rng, shape, count=600, widths=(0.6, 1.4)):
    """Edges of a scene in 24 frames with different widths and the noise of a decoded movie."""
    profile = np.stack([shape(width) for width in rng.uniform(*widths, count)])
    noise = np.repeat(0.02 * rng.standard_normal((count, (len(GRID_PX) + 3) // 4)), 4, axis=1)[:, : len(GRID_PX)]
    rising = np.maximum.accumulate(profile, axis=1)
    half_width = np.array([0.5 * np.ptp(np.interp((0.16, 0.84), row, GRID_PX)) for row in rising])
    return EdgeProfiles(profile + noise, half_width, np.arange(count) % 24 / 30, np.arange(count) // 4)


def found(rng, shape, **kind) -> Sharpening:
    """The fit of these edges."""
    result = fit_sharpening(edges(rng, shape, **kind))
    assert result is not None
    return result


@pytest.mark.parametrize(("amount", "radius_px"), [(0.8, 1.6), (1.5, 1.1)])
def test_amount_and_radius_are_recovered(rng, amount, radius_px):
    """Errors lie within 2.5 deviations, which are small, and the mask predicts held-out blocks better."""
    seen = found(rng, lambda width: sharpened_step(width, amount, radius_px))
    assert seen.p_value < MAX_P
    assert abs(seen.amount - amount) < 2.5 * seen.amount_std < 2.5 * amount
    assert abs(seen.radius_px - radius_px) < 2.5 * seen.radius_std_px < 2.5 * radius_px
    assert seen.held_out.after < 0.5 * seen.held_out.before


@pytest.mark.parametrize("soft_px", [0.0, 1.5])
def test_defocus_and_response_curve_are_not_sharpening(rng, soft_px):
    """A step in light, defocused or not, with a curve of gamma 2 gives no sharpening."""

    def bent(width):
        grey = np.sqrt(0.05 + 0.6 * ndtr(GRID_PX / np.hypot(width, soft_px)))
        grey = (grey - grey[0]) / (grey[-1] - grey[0])
        middle = np.interp(0.5, grey, GRID_PX)
        return np.interp(GRID_PX + middle, GRID_PX, grey)

    for _ in range(5):
        assert found(rng, bent).p_value > 100 * MAX_P


def test_bright_lines_beside_edges_are_not_sharpening(rng):
    """An unsharp mask overshoots on both sides of an edge, unlike a bright seam, as of print on glossy paper."""

    def seamed(width):
        return ndtr(GRID_PX / width) + 0.12 * np.exp(-0.5 * ((GRID_PX - 2.0) / 0.8) ** 2)

    assert found(rng, seamed).p_value > MAX_P


@pytest.mark.parametrize("darkest", [0.005, 0.02, 0.1, 0.3, 0.6])
@pytest.mark.parametrize("width", [0.4, 0.8, 2.0])
@pytest.mark.parametrize("radius_px", [0.8, 1.2, 3.0])
def test_a_mask_overshoots_no_more_on_the_bright_side(darkest, width, radius_px):
    """A step in light, blurred, encoded by sRGB's curve and sharpened: less above the bright plateau than below."""
    u = np.arange(-30.0, 30.0, 0.05)
    light = darkest + (1 - darkest) * ndtr(u / width)
    grey = np.where(light < 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    grey = (grey - grey[0]) / (grey[-1] - grey[0])
    sharpened = grey + 0.7 * (grey - gaussian_filter1d(grey, radius_px / 0.05))
    assert 0 < sharpened.max() - 1 < -sharpened.min()


@pytest.mark.parametrize(("dark", "bright", "is_scene"), [(0.09, 0.5, True), (0.09, 0.09, False), (0.2, 0.08, False)])
def test_edges_that_overshoot_more_on_the_bright_side_are_outlined(rng, dark, bright, is_scene):
    """A curve leaves the dark side of a step steeper, so a mask overshoots more there; white window frames do not."""

    def outlined(width):
        line = np.exp(-0.5 * ((np.abs(GRID_PX) - 1.5) / 0.7) ** 2)
        return ndtr(GRID_PX / width) + np.where(GRID_PX > 0, bright, -dark) * line

    seen = found(rng, outlined)
    assert seen.p_value < MAX_P
    assert seen.is_scene is is_scene


@pytest.mark.parametrize("texture", [0.1, 0.3])
def test_texture_beside_edges_is_not_sharpening(texture):
    """Overshoot and undershoot are equally frequent; the steepest edges, which overshoot, do not represent all."""
    for seed in range(4):
        rng = np.random.default_rng(seed)

        def textured(width, rng=rng):
            step = ndtr(GRID_PX / width)
            bright, dark = 1 + texture * rng.standard_normal(2)
            beside = np.exp(-0.5 * (GRID_PX / 2.0) ** 2)
            return 0.5 + (step - 0.5) * (1 + beside * (np.where(GRID_PX > 0, bright, dark) - 1))

        assert found(rng, textured, widths=(0.7, 0.9)).p_value > 0.01


def test_one_edge_seen_in_many_frames_counts_once(rng):
    """The bright rim of one object in all frames is not sufficient evidence."""
    seen = edges(rng, lambda width: sharpened_step(width, 0.6, 1.2))
    one = replace(seen, place=np.zeros(len(seen), int))
    assert fit_sharpening(seen) is not None
    assert fit_sharpening(one) is None


def test_few_edges_give_no_result(rng):
    """Twenty edges are too few for a fit."""
    assert fit_sharpening(edges(rng, lambda width: ndtr(GRID_PX / width), count=20)) is None


def opened(folder: Path, **options) -> tuple[Source, Trajectory]:
    """Simulate a capture and integrate its motion with its own profile."""
    simulate_command(folder, width=480, height=360, frames=20, seed=3, exposure_ms=5.0, rate_rad_s=0.8,
                     truth_frames=False, **options)  # fmt: skip
    source = open_source(folder)
    return source, integrate_gyro(source.capture.imu, source.profile)


def judged(source: Source, trajectory: Trajectory) -> PictureVerdict:
    """The verdict from the capture's edges."""
    return judge_sharpening(source.capture, source.profile, trajectory, source.gray)


@pytest.fixture(scope="module")
def processed(tmp_path_factory) -> tuple[Source, Trajectory]:
    """A capture by a phone that denoises in space and time and sharpens, at the recorder's bit rate."""
    isp = PhoneIsp(denoise=1.5, temporal_denoise=0.4)
    return opened(tmp_path_factory.mktemp("edges") / "phone", isp=isp, effects=["sharpening=0.9,1.4"])


def test_a_hidden_sharpening_is_found_with_its_size(processed):
    """Amount and radius are estimated from the movie alone, within 2.5 deviations."""
    (finding,) = judged(*processed).findings
    assert finding.name == "sharpening"
    for name, truth in (("amount", 0.9), ("radius_px", 1.4)):
        change = finding.parameters[name]
        assert abs(change.estimate - truth) < 2.5 * change.std < 2.5 * truth, (name, change)
    assert finding.held_out.gain > 0.5
    assert "unsharp" in finding.sentence


def test_a_sharpening_recorded_in_the_profile_is_not_a_new_cause(processed):
    """An extended profile records it as an estimate; a different mask is a change."""
    source, trajectory = processed
    (first,) = judged(*processed).findings
    for factor, named in ((1.0, 0), (3.0, 1)):
        profile = source.profile
        for name, change in first.parameters.items():
            profile = profile.with_estimate(name, factor * change.estimate, change.std, "virest diagnose, sharpening")
        verdict = judged(replace(source, profile=profile), trajectory)
        assert len(verdict.findings) == named
        assert bool(verdict.notes) != bool(named)
        for finding in verdict.findings:
            assert finding.parameters["amount"].nominal == pytest.approx(3.0 * first.parameters["amount"].estimate)


def test_sharpening_and_denoising_are_not_reported_as_defocus_or_exposure(processed):
    """Widths of edges and ratios of spectra give no finding."""
    source, trajectory = processed
    verdict, is_exposure = climb_blur(source.capture, source.profile, trajectory, source.gray, None)
    assert verdict.blur_rms_px is not None
    assert not verdict.findings
    assert not is_exposure


def test_an_unsharpened_movie_gives_no_sharpening(tmp_path):
    """Defocus and another response curve cause no overshoot, and there are enough edges to decide."""
    verdict = judged(*opened(tmp_path / "plain", scene="board", effects=["defocus=0.8", "response_curve=1.3"]))
    assert not verdict.findings
    assert not verdict.notes
