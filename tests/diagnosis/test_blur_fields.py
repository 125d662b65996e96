"""Fields of blur from synthetic edge widths: an added blur is recovered, and nothing else is reported."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from virest.camera.field import Field
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.camera.shutter import Shutter
from virest.capture.imu import ImuSamples
from virest.capture.records import Capture, CaptureMetadata, Frame
from virest.diagnosis.field.blur import blur_field
from virest.diagnosis.field.focus import FocusOverTime, blur_fields
from virest.diagnosis.local_blur import LENS_SIGMA_PX, BlurObservations
from virest.diagnosis.local_blur_edges import EdgeWidths
from virest.diagnosis.local_blur_spectra import join_ratios
from virest.image_formation.kernels import kernel_field
from virest.image_formation.row_motion import row_motion
from virest.motion.integration import integrate_gyro

Array = NDArray[np.float64]
CAMERA = CameraProfile(
    640, 480, intrinsics=Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0), shutter=Shutter(0.02), time_offset_s=0.0
)
STILL = ImuSamples(np.arange(-0.5, 3.5, 0.01), np.zeros((400, 3)), np.zeros((400, 3)))
FRAMES, EACH = 40, 40


def focus_dioptres(time_s: Array) -> Array:
    """A change of focus and back."""
    return 0.5 + 2 * np.exp(-(((time_s - 1.3) / 0.4) ** 2))


def seen(added_px: Array | float, seed: int = 5) -> tuple[BlurObservations, Capture]:
    """Edge widths with an added Gaussian blur of this size, and the log."""
    rng = np.random.default_rng(seed)
    count = FRAMES * EACH
    frame = np.repeat(np.arange(FRAMES), EACH)
    turn = rng.uniform(0, 2 * np.pi, count)
    width = np.sqrt(LENS_SIGMA_PX**2 + np.broadcast_to(added_px, count) ** 2) * np.exp(rng.normal(0, 0.12, count))
    edges = EdgeWidths(
        frame, STAMPS[frame], np.full(count, 0.004), PLACES, np.stack([np.cos(turn), np.sin(turn)], -1),
        np.tile(np.arange(EACH), FRAMES), np.full(count, 5.5), width,
        rng.uniform(20, 90, count), rng.uniform(0.2, 0.8, count), candidates=20 * count,
    )  # fmt: skip
    logged = tuple(Frame(k, 0, float(t), 0.004, focus_dioptres=float(focus_dioptres(t))) for k, t in enumerate(STAMPS))
    nowhere = Path("nowhere")
    capture = Capture("edges", nowhere, nowhere, 640, 480, logged, STILL, CaptureMetadata(), "REALTIME", 0)
    return BlurObservations(edges, join_ratios([]), count), capture


STAMPS = np.arange(FRAMES) / 15
PLACES = np.random.default_rng(3).uniform(5, (635, 475), (FRAMES * EACH, 2))
RADIUS = np.linalg.norm(PLACES - (320, 240), axis=-1)
WHEN = np.repeat(STAMPS, EACH)


@pytest.mark.parametrize("seed", range(4))
def test_normal_edge_widths_give_no_field(seed: int) -> None:
    """Neither even defocus nor the usual softening of corners by lens and encoder raises a false alarm."""
    for added in (0.0, 1.2, 0.5 * (RADIUS / 350) ** 2):
        observations, capture = seen(added, seed)
        assert blur_field(observations, CAMERA, integrate_gyro(STILL, CAMERA), capture) is None


def test_soft_corners_give_a_field_over_the_radius() -> None:
    """Each tile's kernel includes the field; with the field in the profile no further field is found."""
    observations, capture = seen(1.5 * (RADIUS / 350) ** 2)
    found = blur_field(observations, CAMERA, integrate_gyro(STILL, CAMERA), capture)
    assert found is not None
    finding, profile = found
    assert (finding.kind, finding.covariates) == ("blur", ("radius",))
    assert finding.size == pytest.approx(1.5 * (finding.fields[0].knots[0][-1] / 350) ** 2, rel=0.15)
    assert finding.held_out.after < 0.8 * finding.held_out.before
    (known,) = finding.fields
    off_px = np.array(known.values)[:, 0] - 1.5 * (np.array(known.knots[0]) / 350) ** 2
    assert np.all(np.abs(off_px[1:]) < 2 * np.array(known.std)[1:, 0])
    trajectory = integrate_gyro(STILL, CAMERA)
    places = np.array([[320.0, 240.0], [320.0, 20.0], [600.0, 450.0]])
    field = kernel_field(row_motion(trajectory, profile, 0.1, 0.004), places)
    radius = np.linalg.norm(places - (320, 240), axis=-1)
    assert field.defocus_sigma_px == pytest.approx(1.5 * (radius / 350) ** 2, abs=0.35)
    offsets = np.arange(-field.radius_px, field.radius_px + 1)
    spread = np.sqrt(field.arrays().sum(axis=1) @ offsets**2)
    assert spread[1:] == pytest.approx(field.defocus_sigma_px[1:], abs=0.05)
    assert blur_field(observations, profile, trajectory, capture) is None


def test_a_moving_focus_gives_a_field_over_time() -> None:
    """A few defocused frames are found with and without a log of the focus, and a frame's kernels include the blur."""
    soft = 2.0 * (focus_dioptres(WHEN) - 0.5) / 2
    observations, capture = seen(soft)
    trajectory = integrate_gyro(STILL, CAMERA)
    for logged in (capture, replace(capture, frames=tuple(replace(f, focus_dioptres=None) for f in capture.frames))):
        found = blur_field(observations, CAMERA, trajectory, logged)
        assert found is not None
        finding, profile = found
        assert finding.size == pytest.approx(2.0, rel=0.2)
        sharp, wide = (row_motion(trajectory, profile, t, 0.004).profile.extensions for t in (0.1, 1.33))
        assert sharp.defocus_sigma_px < 0.5
        assert wide.defocus_sigma_px == pytest.approx(2.0, rel=0.2)
    assert finding.covariates == ("time",)


def test_edges_that_widen_at_times_are_no_focus_where_spectra_show_that_it_rests() -> None:
    """Denoising and coding of long blurs widen edges too."""
    observations, capture = seen(2.0 * (focus_dioptres(WHEN) - 0.5) / 2)
    trajectory = integrate_gyro(STILL, CAMERA)
    unlogged = replace(capture, frames=tuple(replace(f, focus_dioptres=None) for f in capture.frames))
    (told,), _ = blur_fields(observations, CAMERA, trajectory, unlogged)
    assert told.covariates == ("time",)
    assert blur_fields(observations, CAMERA, trajectory, unlogged, FocusOverTime(None)) == ([], CAMERA)


def test_a_blur_field_adds_to_an_even_defocus() -> None:
    """The variances add."""
    blur = Field("blur", ("time",), ((0.0, 1.0),), ((0.0,), (2.0,)), (), 0)
    even = replace(CAMERA, extensions=replace(CAMERA.extensions, defocus_sigma_px=1.5))
    motion = row_motion(integrate_gyro(STILL, CAMERA), even.with_fields([blur]), 1.0, 0.004)
    assert motion.profile.extensions.defocus_sigma_px == pytest.approx(2.5)
