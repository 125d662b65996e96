"""virest: deblur phone videos and correct their rolling shutter with the phone's own gyroscope.

>>> import virest
>>> capture = virest.open("sample_data/leaves")
>>> restored = capture.restore(5)

The functions below are the stable interface; their modules are imported on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"
__all__ = [
    "CameraProfile",
    "Capture",
    "ImuSamples",
    "RestoredFrame",
    "Trajectory",
    "VirestError",
    "__version__",
    "calibrate",
    "deblur",
    "diagnose",
    "open",
    "restore",
    "simulate",
]

if TYPE_CHECKING:
    from virest.app.api import Capture, calibrate, deblur, diagnose, open, restore, simulate
    from virest.camera.profile import CameraProfile
    from virest.capture.imu import ImuSamples
    from virest.errors import VirestError
    from virest.motion.trajectory import Trajectory
    from virest.restoration.frame import RestoredFrame

_HOMES = {
    "CameraProfile": "virest.camera.profile",
    "ImuSamples": "virest.capture.imu",
    "RestoredFrame": "virest.restoration.frame",
    "Trajectory": "virest.motion.trajectory",
    "VirestError": "virest.errors",
}


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    if name not in __all__:
        raise AttributeError(f"module 'virest' has no attribute '{name}'")
    from importlib import import_module

    value = getattr(import_module(_HOMES.get(name, "virest.app.api")), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
