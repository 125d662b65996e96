"""Blur paths and kernels compared with formulas, brute force, and the blur of a known picture."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from laws import FISHEYE, RADTAN, UNDISTORTED, AtDepth, TurningCamera, phone
from numpy.typing import NDArray

from virest.camera.shutter import READOUT_DIRECTIONS
from virest.capture.imu import ImuSamples
from virest.image_formation.kernels import KernelField, angle_and_length, blur_chords, kernel_field, smooth_field
from virest.image_formation.row_motion import FrameTranslation, RowMotion, row_motion
from virest.motion.integration import integrate_gyro
from virest.motion.relief_surface import Relief

CENTRES = np.array([[12.0, 20.0], [104.0, 63.92], [171.0, 41.0], [66.0, 118.0]])
YAW_RIGHT = TurningCamera(phone(readout_time_s=0.0), rate_rad_s=(0, 3.0, 0))


def _kernel_mean(kernel: NDArray[np.float32]) -> NDArray[np.float64]:
    """(x, y) of a kernel's centre of mass relative to its centre."""
    radius = kernel.shape[0] // 2
    along = np.arange(-radius, radius + 1)
    return np.array([(kernel.sum(axis=0) * along).sum(), (kernel.sum(axis=1) * along).sum()])


def test_the_chord_of_a_constant_yaw_rate() -> None:
    """At the principal point, a yaw at ω over an exposure e blurs by f tan(ω e), to the left."""
    chord = blur_chords(YAW_RIGHT.motion, CENTRES[1:2])
    np.testing.assert_allclose(chord, [[-220 * np.tan(3.0 * 0.012), 0]], atol=1e-4)
    angle, length = angle_and_length(chord)
    assert length[0] == pytest.approx(7.92, abs=0.01)
    assert angle[0] == pytest.approx(np.pi, abs=1e-5)


def test_the_chord_of_a_roll() -> None:
    """A clockwise roll moves a point 60 px right of the centre up by 60 ω e (times fy/fx)."""
    camera = replace(YAW_RIGHT, rate_rad_s=(0, 0, 2.0))
    chord = blur_chords(camera.motion, np.array([[164.0, 63.92]]))[0]
    np.testing.assert_allclose(chord, [60 * (np.cos(0.024) - 1), -60 * 0.985 * np.sin(0.024)], atol=1e-4)


@pytest.mark.parametrize("direction", READOUT_DIRECTIONS)
def test_chords_belong_to_the_exposure_of_their_own_row(direction: str) -> None:
    """A chord spans the exposure of its own row, with depth and distortion."""
    camera = TurningCamera(phone(lens=RADTAN, readout_direction=direction), velocity_m_s=(0.9, -0.6, 0.8))
    motion = camera.motion
    start_s = camera.row_start_s(CENTRES, motion.start_s)
    expected = camera.seen(CENTRES, start_s, start_s + 0.012, motion.reference_s, depth_m=1.3) - CENTRES
    np.testing.assert_allclose(blur_chords(AtDepth(motion, 1 / 1.3), CENTRES), expected, atol=1e-3)


@pytest.mark.parametrize(
    ("chord", "angle"),
    [
        ((3, 0), 0),
        ((0, 2), np.pi / 2),
        ((0, -2), -np.pi / 2),
        ((-4, 0.0), np.pi),
        ((-4, -0.0), np.pi),
        ((-1, -1), -0.75 * np.pi),
    ],
)
def test_angles_lie_in_a_half_open_interval(chord: tuple[float, float], angle: float) -> None:
    """Angles run from x (right) towards y (down), in (−π, π]; straight left is +π for either sign of zero."""
    found, length = angle_and_length(np.array(chord, float))
    assert float(found) == pytest.approx(angle)
    assert float(length) == pytest.approx(np.hypot(*chord))


@pytest.mark.parametrize("positive", [False, True])
@pytest.mark.parametrize("anchor", [0.0, 0.5, 0.8])
def test_kernels_sum_to_one_and_lie_at_their_path(anchor: float, positive: bool) -> None:
    """A kernel sums to 1 and its centre of mass is the mean of the path, for both kinds of splatting."""
    camera = TurningCamera(phone(lens=FISHEYE), rate_rad_s=(1.5, -3.0, 2.0))
    field = kernel_field(camera.motion, CENTRES, anchor)
    kernels = field.arrays(positive=positive)
    assert kernels.shape == (4, 2 * field.radius_px + 1, 2 * field.radius_px + 1)
    assert kernels.dtype == np.float32
    np.testing.assert_allclose(kernels.sum(axis=(1, 2), dtype=float), 1, atol=1e-5)
    for kernel, path in zip(kernels, field.paths_px, strict=True):
        np.testing.assert_allclose(_kernel_mean(kernel), path.mean(axis=0), atol=1e-3)
    if positive:
        assert kernels.min() >= 0


def test_a_larger_array_holds_the_same_kernel() -> None:
    """A larger radius only adds zeros around the kernel."""
    field = kernel_field(TurningCamera(phone()).motion, CENTRES, 0.2)
    tight, wide = field.arrays(), field.arrays(field.radius_px + 5)
    np.testing.assert_array_equal(wide[:, 5:-5, 5:-5], tight)
    assert np.count_nonzero(wide) == np.count_nonzero(tight)


def test_the_anchor_moves_the_kernel_by_its_part_of_the_chord() -> None:
    """With the camera yawing right, a pixel's later light came from further right in the frame of the exposure's start.

    So the mean path is +½ f ω e at anchor 0, zero at the middle, and −½ f ω e at the end.
    """
    half = 0.5 * 220 * 3.0 * 0.012
    for anchor, mean in ((0.0, half), (0.5, 0.0), (1.0, -half)):
        field = kernel_field(YAW_RIGHT.motion, CENTRES[1:2], anchor)
        np.testing.assert_allclose(field.paths_px[0].mean(axis=0), [mean, 0], atol=5e-3)
        assert field.length_px[0] == pytest.approx(2 * half, rel=0.07)


@pytest.mark.parametrize("direction", READOUT_DIRECTIONS)
@pytest.mark.parametrize("anchor", [0.0, 0.5])
@pytest.mark.parametrize("lens", [pytest.param(lens, id=lens[0]) for lens in (UNDISTORTED, RADTAN)])
def test_kernel_fields_match_explicit_projections(
    direction: str, anchor: float, lens: tuple[str, tuple[float, ...]]
) -> None:
    """Brute force finds the point that a pixel gathers at each instant in the frame of the anchored rows."""
    camera = TurningCamera(phone(lens=lens, readout_direction=direction), rate_rad_s=(0.9, -1.6, 0.7))
    motion = camera.motion
    field = kernel_field(motion, CENTRES, anchor)
    count = field.paths_px.shape[1]
    part = (np.arange(count) + 0.5) / count
    for centre, path in zip(CENTRES, field.paths_px, strict=True):
        pixel = np.tile(centre, (count, 1))
        gathered_s = camera.row_start_s(pixel, motion.start_s) + part * 0.012
        seen = pixel
        for _ in range(30):  # the row that records a point depends on the point's position
            at_anchor_s = camera.row_start_s(seen, motion.start_s) + anchor * 0.012
            seen = camera.seen(pixel, gathered_s, at_anchor_s, motion.reference_s)
        np.testing.assert_allclose(path, seen - pixel, atol=1e-4)


def _shaken(direction: str, lens: tuple[str, tuple[float, ...]], relief: Relief | None = None) -> RowMotion:
    """A hand-held phone that trembles at 9 Hz about all axes while moving in front of a slanted plane."""
    profile = phone(360, 480, 420.0, lens, 0.025, direction)
    time_s = np.arange(-0.2, 0.6, 0.004)
    phase = 2 * np.pi * 9.0 * time_s[:, None] + np.array([0.3, 1.7, 4.0])
    rates = np.array([0.9, -1.3, 0.7]) + np.array([0.8, 0.6, 0.9]) * np.sin(phase)
    samples = ImuSamples(time_s, rates, np.full((len(time_s), 3), np.nan))
    sway = FrameTranslation(np.array([0.2, -0.1, 0.05]), np.zeros(3), np.array([0.1, -0.2, 0.5]), relief=relief)
    return row_motion(integrate_gyro(samples, profile), profile, 0.1, 0.012, translation=sway)


@pytest.mark.parametrize("direction", READOUT_DIRECTIONS)
@pytest.mark.parametrize("lens", [pytest.param(lens, id=lens[0]) for lens in (UNDISTORTED, RADTAN)])
def test_smooth_fields_interpolate_the_paths(
    direction: str, lens: tuple[str, tuple[float, ...]], rng: np.random.Generator
) -> None:
    """Splines give the paths within 0.01 px anywhere in the frame, including the corners."""
    motion = _shaken(direction, lens)
    centres = np.concatenate([rng.uniform((0, 0), (359, 479), (60, 2)), [[0, 0], [359, 0], [0, 479], [359, 479]]])
    smooth, exact = smooth_field(motion, 0.5)(centres), kernel_field(motion, centres, 0.5)
    assert exact.length_px.max() > max(2.0, 1.25 * exact.length_px.min()), "the field must vary over the frame"
    np.testing.assert_allclose(smooth.paths_px, exact.paths_px, atol=0.01)
    np.testing.assert_array_equal(smooth.centres_px, centres)


def test_with_relief_each_path_is_computed() -> None:
    """Paths change at depth edges, where a spline would oscillate."""
    values = np.where(np.arange(40) > 20, 0.8, 0.0) * np.ones((30, 1))
    motion = _shaken("top_to_bottom", UNDISTORTED, Relief(np.array([-0.5, -0.6]), np.array([1.0, 1.2]), values, values))
    centres = np.stack([np.linspace(20, 340, 30), np.full(30, 240.0)], -1)
    paths_px = smooth_field(motion, 0.5)(centres).paths_px
    np.testing.assert_array_equal(paths_px, kernel_field(motion, centres, 0.5).paths_px)


def test_paths_with_depth_include_translation() -> None:
    """With a global shutter, a sideways velocity v over the exposure e at depth Z blurs by f v e / Z."""
    camera = TurningCamera(phone(readout_time_s=0.0), rate_rad_s=(0, 0, 0), velocity_m_s=(0.7, 0, 0))
    field = kernel_field(AtDepth(camera.motion, 1 / 2.0), CENTRES[1:2], 0.0)
    count = field.paths_px.shape[1]
    expected = 220 * 0.7 * 0.012 / 2.0 * (np.arange(count) + 0.5) / count
    np.testing.assert_allclose(field.paths_px[0, :, 0], expected, atol=1e-4)
    np.testing.assert_allclose(field.paths_px[0, :, 1], 0, atol=1e-6)


def test_a_still_camera_has_points_for_kernels() -> None:
    """Without motion every kernel is 1 at its centre and 0 elsewhere."""
    field = kernel_field(replace(YAW_RIGHT, rate_rad_s=(0, 0, 0)).motion, CENTRES, 0.0)
    kernels = field.arrays()
    middle = kernels.shape[1] // 2
    np.testing.assert_allclose(kernels[:, middle, middle], 1, atol=1e-4)
    np.testing.assert_allclose(np.abs(kernels).sum(axis=(1, 2)), 1, atol=1e-3)


def test_a_kernel_blurs_as_the_mean_over_its_path() -> None:
    """Correlating a blob with a kernel gives the mean of the blob along the curved path: g(p) = mean f(p + d)."""
    part = (np.arange(60) + 0.5) / 60
    path = np.stack([9.3 * part - 2.2, 5.1 * part**2 - 4.4], -1)
    field = KernelField(np.array([[30.0, 30.0]]), path[None], 0.0)
    y, x = np.mgrid[:61, :71].astype(float)

    def blob(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.exp(-((x - 33.7) ** 2 + (y - 27.2) ** 2 + 0.5 * (x - 33.7) * (y - 27.2)) / (2 * 2.0**2))

    expected = np.mean([blob(x + dx, y + dy) for dx, dy in path], axis=0)
    blurred = cv2.filter2D(blob(x, y), -1, field.arrays()[0].astype(float))
    np.testing.assert_allclose(blurred[12:-12, 12:-12], expected[12:-12, 12:-12], atol=4e-3 * expected.max())
