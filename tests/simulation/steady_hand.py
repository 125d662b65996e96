"""A hand with a constant turn rate and a fixed position."""

import numpy as np

from virest.simulation.hand_motion import HandMotion, Waves, integrate_motion


def constant_motion(
    rate_rad_s: tuple[float, float, float],
    *,
    start_s: float = -1.0,
    end_s: float = 1.0,
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> HandMotion:
    """Rotate at a constant rate (camera axes) with a fixed position; world axes are the camera's at time 0."""
    rate = Waves(np.zeros((3, 1)), np.array(rate_rad_s, float)[:, None], np.zeros((3, 1)))
    sway = Waves(np.zeros((3, 1)), np.array(position_m, float)[:, None], np.zeros((3, 1)))
    return integrate_motion(rate, sway, start_s, end_s, centre_on_s=(0.0, 0.0))
