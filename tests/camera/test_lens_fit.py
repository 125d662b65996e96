"""The standard lens closest to a lens with a displacement field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from virest.camera.field import Field
from virest.camera.intrinsics import Intrinsics
from virest.camera.lens_fit import standard_lens

LENS = Intrinsics(640, 480, 500.0, 503.0, 322.0, 238.0, "radtan", (-0.03, 0.0, 0.0, 0.0, 0.0))


def displaced_by(lens: Intrinsics, other: Intrinsics) -> Intrinsics:
    """A lens that projects rays like another lens, by means of a displacement field."""
    knots = tuple(tuple(np.linspace(0, side - 1, 7).tolist()) for side in (lens.width, lens.height))
    pixels = np.stack(np.meshgrid(*knots, indexing="ij"), axis=-1).reshape(-1, 2)
    shift = other.project(lens.rays(pixels)) - pixels
    return replace(lens, displaced=Field("displacement", ("x", "y"), knots, tuple(map(tuple, shift.tolist()))))


@pytest.mark.parametrize("model", ["none", "radtan"])
def test_a_tangential_displacement_becomes_p1_and_p2(model: str) -> None:
    """The fit is accurate within 0.2 px, for a lens with and without own distortion."""
    k1 = -0.03 if model == "radtan" else 0.0
    own = LENS if model == "radtan" else LENS.pinhole
    off_centre = replace(LENS, coefficients=(k1, 0.0, 0.006, -0.004, 0.0))
    found, off_px = standard_lens(displaced_by(own, off_centre))
    assert found.displaced is None
    assert off_px < 0.2
    np.testing.assert_allclose(found.coefficients[2:4], (0.006, -0.004), atol=3e-4)


def test_the_error_of_the_standard_lens_is_in_pixels() -> None:
    """The error is the largest distance between the two lenses."""
    knots = (tuple(np.linspace(0, 639, 9).tolist()), tuple(np.linspace(0, 479, 9).tolist()))
    x, y = np.meshgrid(*knots, indexing="ij")
    waves = np.stack([2 * np.sin(x / 60), 2 * np.cos(y / 50)], axis=-1).reshape(-1, 2)
    lens = replace(LENS, displaced=Field("displacement", ("x", "y"), knots, tuple(map(tuple, waves.tolist()))))
    found, off_px = standard_lens(lens)
    pixels = np.stack(np.meshgrid(np.linspace(0, 639, 40), np.linspace(0, 479, 40)), axis=-1)
    apart = np.linalg.norm(found.project(lens.rays(pixels)) - pixels, axis=-1)
    assert off_px > 1.0
    assert off_px == pytest.approx(apart.max(), rel=0.2)


def test_a_lens_without_displacement_is_unchanged() -> None:
    """There is no fit and no error."""
    assert standard_lens(LENS) == (LENS, 0.0)
