"""Settings of a restoration, and the presets."""

from __future__ import annotations

from dataclasses import dataclass

DEBLUR_METHODS = (
    "none",
    "inverse",
    "wiener",
    "gradient-wiener",
    "richardson-lucy",
    "hyper-laplacian",
    "hyper-laplacian-global",
)
JOINT_METHODS = ("gradient-wiener", "hyper-laplacian")
"""Methods that can restore a frame jointly with its neighbours."""
SHUTTER_METHODS = ("none", "perspective", "rowwise")
REFERENCES = ("exposure-start", "frame-middle")
MOST_NEIGHBOURS = 8
"""Frames on each side: farther away even a capture at 30 frames/s shows a different scene."""
FEW_ITERATIONS = 2
"""At or below this iteration count, cheaper approximations are used elsewhere too."""


@dataclass(frozen=True, slots=True)
class RestorationSettings:
    """How frames are restored; each preset is one such record."""

    preset: str = "balanced"
    deblur: str = "hyper-laplacian"
    """One of DEBLUR_METHODS."""
    shutter: str = "rowwise"
    """One of SHUTTER_METHODS."""
    reference: str = "exposure-start"
    """Time of the restored picture: exposure start of the first row read, or the frame's middle."""
    iterations: int = 4
    """Iterations of the iterative methods."""
    joined_iterations: int = 5
    """Iteration limit for frames restored with neighbours: more measurements leave less to the prior."""
    inner_iterations: int = 4
    """Conjugate-gradient steps per iteration of ``hyper-laplacian-global``."""
    tile_px: int = 128
    """Side of a tile; each has its own kernel."""
    strength: float = 1.0
    """Factor on the measured noise in the regularisation: 1 uses it as measured, a larger value is smoother."""
    min_blur_px: float = 1.0
    """Frames whose longest blur path is shorter are not deblurred."""
    neighbours: int = 0
    """Number of frames on each side among which neighbours for joint restoration are chosen."""
    most_joined: int = 6
    """Largest number of neighbours used; those are chosen that best pass the frequencies that the frame's path cancels.
    """
    undistort: bool = False
    """Correct lens distortion: output a pinhole picture with the profile's focal lengths and principal point."""
    keep_start_up: bool = False
    """Process the frames of the recorder's start-up too, although their content is later than their stamps."""


PRESETS: dict[str, RestorationSettings] = {
    "fast": RestorationSettings("fast", "hyper-laplacian", iterations=2, tile_px=176, strength=0.8),
    "balanced": RestorationSettings(
        "balanced",
        "hyper-laplacian",
        iterations=6,
        joined_iterations=4,
        tile_px=104,
        strength=1.0,
        neighbours=3,
        most_joined=2,
    ),
    "best": RestorationSettings(
        "best", "hyper-laplacian", iterations=6, tile_px=104, strength=1.0, neighbours=3, most_joined=3
    ),
}
