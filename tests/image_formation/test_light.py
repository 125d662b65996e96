"""Flicker and vignetting: hand calculations, means over exposures, and effects on kernels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from laws import TurningCamera, phone

from virest.camera.field import Field
from virest.camera.profile import CameraProfile
from virest.image_formation.kernels import kernel_field
from virest.image_formation.light import (
    defocus_px,
    equivalent_length_px,
    frame_light,
    most_defocus_px,
    row_light,
    vignetting,
)
from virest.image_formation.neighbour import neighbour_view
from virest.image_formation.warp import straightened_points
from virest.motion.optics import moving_lens
from virest.simulation.sensor import sensor_light

PIXELS = np.array([[0.0, 0.0], [199, 135], [37, 101], [150, 12]])


def extended(**extensions: float) -> CameraProfile:
    """A phone with extensions."""
    profile = phone()
    return replace(profile, extensions=replace(profile.extensions, **extensions))


def test_the_mean_flicker_of_a_row_is_the_mean_over_its_exposure() -> None:
    """Each row's factor is the mean of 1 + a sin(2π f t + φ) over the row's exposure."""
    profile = extended(flicker_amplitude=0.3, flicker_frequency_hz=100.0, flicker_phase_rad=0.7)
    motion = TurningCamera(profile, exposure_s=0.013).motion
    instants = motion.row_time_s(PIXELS, 0.0)[:, None] + (np.arange(4000) + 0.5) / 4000 * 0.013
    expected = (1 + 0.3 * np.sin(2 * np.pi * 100 * instants + 0.7)).mean(axis=1)
    np.testing.assert_allclose(row_light(motion, PIXELS), expected, atol=1e-7)
    assert np.ptp(expected) > 0.02
    short = TurningCamera(profile, exposure_s=None).motion
    at_once = 1 + 0.3 * np.sin(2 * np.pi * 100 * short.row_time_s(PIXELS, 0.0) + 0.7)
    np.testing.assert_allclose(row_light(short, PIXELS), at_once, atol=1e-12)


def test_a_whole_period_of_flicker_leaves_no_bands() -> None:
    """With 10 ms at 100 Hz every row gathers the same light."""
    profile = extended(flicker_amplitude=0.3, flicker_frequency_hz=100.0)
    np.testing.assert_allclose(row_light(TurningCamera(profile, exposure_s=0.010).motion, PIXELS), 1.0, atol=1e-12)


def test_vignetting_matches_a_hand_calculation() -> None:
    """The loss is 0.4 at half the diagonal, 0.1 at a quarter, and 0 at the centre of a frame of 200 × 136."""
    profile = extended(vignetting_corner_loss=0.4)
    quarter = np.hypot(200, 136) / 4
    x, y = np.array([99.5, 99.5 + quarter, -0.5, 99.5]), np.array([67.5, 67.5, -0.5, 67.5 - quarter])
    np.testing.assert_allclose(vignetting(profile, x, y), [1.0, 0.9, 0.6, 0.9], atol=1e-12)


def test_a_field_of_gain_multiplies_the_vignetting() -> None:
    """The product holds in the program and in the simulator.

    10 % more light on the right, a loss of 0.4 in the corners.
    """
    lens = extended(vignetting_corner_loss=0.4)
    width, height = lens.width, lens.height
    ends = ((0.0, width - 1.0), (0.0, height - 1.0))
    profile = lens.with_fields([Field("gain", ("x", "y"), ends, ((0.0,), (0.0,), (0.1,), (0.1,)))])
    x, y = np.arange(width)[None, :], np.arange(height)[:, None]
    factor = vignetting(lens, x, y) * (1 + 0.1 * x / (width - 1))
    np.testing.assert_allclose(vignetting(profile, x, y), factor, atol=1e-12)
    flat = np.ones((height, width, 3), np.float32)
    np.testing.assert_allclose(sensor_light(flat, profile, 1.0, defocus=False)[..., 1], factor, atol=1e-6)
    only = profile.with_fields(profile.fields)
    motion = TurningCamera(replace(only, extensions=replace(only.extensions, vignetting_corner_loss=0.0))).motion
    light = frame_light(motion, 0.5, straighten=True)
    assert light is not None
    assert light.recorded[0, -1] == pytest.approx(1.1, abs=1e-6)
    assert (light.recorded.dtype, light.kept.dtype) == (np.float32, np.float32)


def test_vignetting_follows_the_straightened_pixel() -> None:
    """Light recorded at p and belonging at q loses p's vignetting and gets q's."""
    profile = extended(vignetting_corner_loss=0.5)
    motion = TurningCamera(profile, rate_rad_s=(0.5, -3.0, 0.4)).motion
    light = frame_light(motion, 0.5, straighten=True)
    assert light is not None
    x, y = 171, 88
    there = straightened_points(motion, np.array([[x, y]], float), 0.5)
    assert light.kept[y, x] == pytest.approx(vignetting(profile, *there[0]), abs=1e-4)
    assert light.recorded[y, x] == pytest.approx(vignetting(profile, x, y), abs=1e-6)
    assert light.most_change > 0.005
    still = frame_light(motion, 0.5, straighten=False)
    assert still is not None
    assert still.most_change == 0.0
    assert frame_light(TurningCamera(phone()).motion, 0.5, straighten=True) is None


def test_clipped_light_is_not_darkened_for_a_bright_row() -> None:
    """A clipped pixel in a row brightened by flicker stays clipped; a measured one is corrected."""
    profile = extended(flicker_amplitude=0.3, flicker_frequency_hz=50.0, flicker_phase_rad=0.4)
    light = frame_light(TurningCamera(profile, exposure_s=0.002).motion, 0.5, straighten=False)
    assert light is not None
    plane = np.ones(light.vignetting.shape, np.float32)
    evened = light.evened(plane, plane)
    assert evened.min() == 1.0
    np.testing.assert_allclose(light.evened(plane, None) * light.recorded, plane, atol=1e-6)
    assert light.evened(plane, None).min() < 0.9


def test_defocus_spreads_a_kernel_by_its_variance() -> None:
    """The second moments of a kernel grow by σ² along both axes; its sum and centre stay."""
    motion = TurningCamera(phone(), rate_rad_s=(0.9, -2.0, 0.6)).motion
    blurred = TurningCamera(extended(defocus_sigma_px=1.4), rate_rad_s=(0.9, -2.0, 0.6)).motion
    centres = np.array([[50.0, 100.0], [160.0, 30.0]])
    field = kernel_field(blurred, centres)
    before, after = kernel_field(motion, centres).arrays(field.radius_px), field.arrays()
    offset = np.arange(-field.radius_px, field.radius_px + 1)
    for axis in (1, 2):
        sharp, soft = (k.sum(axis=3 - axis) for k in (before, after))
        np.testing.assert_allclose(soft.sum(1), 1, atol=1e-5)
        np.testing.assert_allclose(soft @ offset, sharp @ offset, atol=1e-3)
        grown = (soft @ offset**2 - (soft @ offset) ** 2) - (sharp @ offset**2 - (sharp @ offset) ** 2)
        np.testing.assert_allclose(grown, 1.4**2, atol=0.03)
    half = field.scaled(0.5)
    np.testing.assert_allclose(half.defocus_sigma_px, 0.7)
    np.testing.assert_allclose(half.paths_px, field.paths_px / 2)
    assert equivalent_length_px(3.0, most_defocus_px(blurred.profile)) == pytest.approx(np.sqrt(9 + 12 * 1.4**2))


def test_flicker_weights_the_instants_of_a_path() -> None:
    """Light that is brighter late in the exposure moves the kernel's centre towards the end of the path."""
    profile = extended(flicker_amplitude=0.8, flicker_frequency_hz=20.0, flicker_phase_rad=0.2)
    motion = TurningCamera(profile, rate_rad_s=(0.0, -2.0, 0.0)).motion
    centre = np.array([[104.0, 63.92]])
    field = kernel_field(motion, centre, 0.0)
    part = (np.arange(field.paths_px.shape[1]) + 0.5) / field.paths_px.shape[1]
    light = 1 + 0.8 * np.sin(2 * np.pi * 20 * (motion.row_time_s(centre, 0.0)[0] + part * motion.exposure_s) + 0.2)
    expected = (field.paths_px[0, :, 0] * light).sum() / light.sum()
    kernel = field.arrays()[0]
    assert kernel.sum() == pytest.approx(1, abs=1e-5)
    found = kernel.sum(axis=0) @ np.arange(-field.radius_px, field.radius_px + 1)
    assert found == pytest.approx(expected, abs=1e-3)
    assert abs(expected - field.paths_px[0, :, 0].mean()) > 0.05


def test_a_neighbour_brings_the_flicker_and_softness_of_its_own_rows() -> None:
    """Its kernels at a pixel of the frame are those of the place, and so of the row, where it recorded the point."""
    soft = Field("blur", ("radius",), ((0.0, 150.0),), ((0.2,), (2.0,)))
    profile = extended(flicker_amplitude=0.5, flicker_frequency_hz=90.0).with_fields([soft])
    first = TurningCamera(profile, rate_rad_s=(4.0, -1.0, 0.5))
    second = replace(first, stamp_s=first.stamp_s + 1 / 30)
    lens = moving_lens(first.trajectory, profile)
    view = neighbour_view(first.motion, second.motion, first.trajectory, lens)
    at_px = np.array([[90.0, 70.0], [120.0, 60.0]])
    there_px = view.places_px(at_px)
    assert np.abs(there_px - at_px).min(axis=0)[1] > 20
    found = view.field()(at_px)
    assert found.light is not None
    count = found.light.shape[1]
    middles_s = second.motion.row_time_s(there_px[:, None], (np.arange(count) + 0.5) / count)
    assert found.light == pytest.approx(1 + 0.5 * np.sin(2 * np.pi * 90 * middles_s), abs=1e-3)
    assert found.defocus_sigma_px == pytest.approx(defocus_px(profile, there_px), abs=1e-6)
    assert found.centres_px == pytest.approx(at_px)
