"""The constant-velocity baseline with a frame that moves at constant velocity, and its failures."""

import numpy as np
import pytest

from virest.camera.shutter import READOUT_DIRECTIONS, Shutter
from virest.evaluation.schubert2018 import PictureVelocity, fit_velocity, velocity_map
from virest.inference.tracking import TrackPair

WIDTH, HEIGHT = 320, 240
MIDDLE_S = {4: 0.1332, 5: 0.1668, 6: 0.1999}
CENTRE = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
TERMS = np.array([[610.0, -150.0], [0.4, 0.15], [-0.3, 0.25]])


def seen_at(start: np.ndarray, shutter: Shutter, first_row_s: float) -> np.ndarray:
    """Positions recorded by the rows at their own times, for points at ``start`` at time 0.1668 s."""
    seen = start
    for _ in range(30):
        row_s = first_row_s + shutter.readout_time_s * shutter.readout_fraction(seen, WIDTH, HEIGHT) - MIDDLE_S[5]
        seen = start + row_s[:, None] * PictureVelocity(CENTRE, TERMS).at(start)
    return seen


def pairs_of(shutter: Shutter, rng: np.random.Generator, noise_px: float = 0.0) -> list[TrackPair]:
    """Tracks over three frames with constant velocities; a tenth are outliers."""
    start = rng.uniform((20, 20), (WIDTH - 20, HEIGHT - 20), (200, 2))
    shown = {k: seen_at(start, shutter, s) + rng.normal(0, noise_px, start.shape) for k, s in MIDDLE_S.items()}
    shown[6][:20] += rng.uniform(5, 20, (20, 2))
    return [TrackPair(4, 5, shown[4], shown[5]), TrackPair(5, 6, shown[5], shown[6])]


@pytest.mark.parametrize("direction", READOUT_DIRECTIONS)
def test_a_constant_velocity_is_found_at_every_row_time(direction: str, rng: np.random.Generator) -> None:
    """The velocity at the centre is right within 2 % in all readout directions, despite outliers."""
    shutter = Shutter(0.021, direction)
    velocity = fit_velocity(pairs_of(shutter, rng, 0.05), 5, MIDDLE_S, shutter, WIDTH, HEIGHT)
    assert velocity is not None
    np.testing.assert_allclose(velocity.terms[0], TERMS[0], rtol=0.02)
    np.testing.assert_allclose(velocity.terms[1:], TERMS[1:], atol=0.1)


def test_the_map_gives_the_recorded_positions(rng: np.random.Generator) -> None:
    """A straightened pixel maps to the position at which its row recorded it."""
    shutter = Shutter(0.021, "right_to_left")
    mapped = velocity_map(PictureVelocity(CENTRE, TERMS), shutter, WIDTH, HEIGHT, 0.0)
    assert mapped.shape == (HEIGHT, WIDTH, 2)
    points = np.array([[30.0, 50], [200, 120], [290, 210]])
    expected = seen_at(points, shutter, MIDDLE_S[5])
    x, y = points.astype(int).T
    np.testing.assert_allclose(mapped[y, x], expected, atol=1e-2)


def test_too_few_points_give_no_velocity() -> None:
    """A few points, or none in the frame itself, give no result."""
    few = TrackPair(4, 5, np.zeros((3, 2)), np.ones((3, 2)))
    for frame in (5, 6):
        assert fit_velocity([few], frame, MIDDLE_S, Shutter(0.02), WIDTH, HEIGHT) is None
