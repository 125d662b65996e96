"""The line of ``parameters.jsonl`` that a frame's result is written as."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from virest.camera.profile import CameraProfile
from virest.restoration.frame import RestoredFrame
from virest.restoration.parameters import Json


def frame_line(
    capture: str, profile: CameraProfile, restored: RestoredFrame, picture: Path, seconds: dict[str, float]
) -> Json:
    """What was found out about one frame and what became of it.  picture: where it is written, if there is one."""
    frame, found = restored.frame, restored.degradation
    line: Json = {
        "capture": capture,
        "frame": frame.index,
        "timestamp_ns": frame.timestamp_ns,
        "exposure_s": None if frame.exposure_s is None else frame.exposure_s * profile.shutter.exposure_scale,
        "status": restored.status,
        "done": steps_done(restored),
        "output": None if restored.picture is None else f"frames/{picture.name}",
        "warnings": list(restored.warnings),
        "valid_px": list(restored.valid_px),
    }
    line |= _not_looked_at(profile) if found is None else found.as_json()
    return line | {"seconds": {name: round(s, 4) for name, s in seconds.items()}}


def steps_done(restored: RestoredFrame) -> list[str]:
    """What was done to a frame: ``deblurred``, ``straightened``, ``undistorted``."""
    found, is_restored = restored.degradation, restored.status == "restored"
    steps = {
        "deblurred": is_restored and found is not None and found.deblur is not None,
        "straightened": is_restored and found is not None and found.shutter.method != "none",
        "undistorted": restored.undistorted and restored.picture is not None,
    }
    return [name for name, done in steps.items() if done]


def _not_looked_at(profile: CameraProfile) -> dict[str, Any]:
    """Of a frame that was left out, or failed, before its motion was looked at."""
    return {
        "motion": None,
        "depth_m": None,
        "depth_source": "none",
        "blur": None,
        "shutter": None,
        "response": profile.response.kind if profile.response else "srgb",
        "deblur": {"method": "none"},
    }
